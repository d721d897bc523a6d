// Marks the blocks to whose nodes edge blocks of the next finer layer hand something: the eight about each of those. So the question is asked once for
// each edge block, and not 64 times for each place.
@compute @workgroup_size(256)
fn find_takers(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    let layer = layer_at(w * 1024u);
    let end = layers[layer].first_place + layers[layer].places;
    if halted() || !has_region(layer) {
        return;
    }
    for (var k = 0u; k < 4u; k++) {
        let at = w * 1024u + thread * 4u + k;
        if at >= end || (atomicLoad(&flags[at]) & HOLDS) == 0u {
            continue;
        }
        let block = block_at(layer, at);
        if is_edge(layer, block) {
            for (var n = 0u; n < 8u; n++) {
                let coarse = ((block - vec3<i32>(1)) >> vec3<u32>(1u)) + vec3<i32>(i32(n >> 2u), i32((n >> 1u) & 1u), i32(n & 1u));
                let taker = place_in_box(layer + 1u, coarse);
                if taker != NONE {
                    atomicOr(&flags[taker], TAKES);
                }
            }
        }
    }
}
