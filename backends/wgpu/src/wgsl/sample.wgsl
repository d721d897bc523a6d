// Copies single particles, a thread each. The sixth and seventh word of the buffer say where they stand there, and how many they are. Of each are given its slot and its
// level's first block and one past the last; in their place come its cell with its tag and its place in there, its block, and its velocity.
const SAMPLED: u32 = 12u;

@compute @workgroup_size(64)
fn sample(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let i = (group.y * extent.row + group.x) * 64u + n;
    if i >= looked[6] {
        return;
    }
    let at = looked[5] + SAMPLED * i;
    let q = looked[at];
    // The last block that begins at its slot or before.
    var low = looked[at + 1u];
    var high = looked[at + 2u];
    for (var k = 0u; k < 32u && low + 1u < high; k++) {
        let middle = (low + high) / 2u;
        if cells[middle * 64u] <= q {
            low = middle;
        } else {
            high = middle;
        }
    }
    let place = record_of(q, 0u);
    let block = bitcast<vec3<u32>>(lists[low * ENTRY].xyz);
    for (var d = 0u; d < 4u; d++) {
        looked[at + d] = place[d];
    }
    for (var d = 0u; d < 3u; d++) {
        looked[at + 4u + d] = block[d];
        looked[at + 7u + d] = record_of(q, 2u + d).x;
    }
}
