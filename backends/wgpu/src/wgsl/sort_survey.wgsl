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
            let block = block_at(layer, at);
            var reached = 0u;
            for (var n = 0u; n < 27u; n++) {
                let other = place_in_box(layer, block + offset_of(n));
                // Asked for in any case, so that none waits for another.
                reached |= select(flags[min(other, extent.places - 1u)] & HOLDS, 0u, other == NONE);
            }
            let own = flags[at];
            let here = vec2<u32>(own & HOLDS, reached | u32((own & TAKES) != 0u));
            directory[at] = here;
            count += here;
        }
    }
    let all = sums_of(thread, count).all;
    if thread == 0u {
        sums[w] = all;
    }
}
