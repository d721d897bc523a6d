// For each place of the directory: does the block hold particles, and do any reach its nodes? And how many do, of 1024 places each.
// A sort that is not to be leaves the directory alone.
@compute @workgroup_size(256)
fn survey(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    let layer = layer_at(w * 1024u);
    let end = layers[layer].first_place + layers[layer].places;
    let on = !halted();
    var count = vec2<u32>(0u);
    for (var k = 0u; k < 4u; k++) {
        let at = w * 1024u + thread * 4u + k;
        if on && at < end {
            let marks = flags[at];
            let here = vec2<u32>(u32((marks & HOLDS) != 0u), u32((marks & REACHED) != 0u));
            directory[at] = here;
            count += here;
        }
    }
    let all = sums_of(thread, count).all;
    if thread == 0u {
        sums[w] = all;
    }
}
