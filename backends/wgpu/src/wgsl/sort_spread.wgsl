// Marks the blocks that are reached: the 27 about each block that holds particles, and the eight of the next coarser level to whose nodes an edge block
// hands something. Most places of the directory are empty, so those that are not tell their neighbours, rather than each place asking all of its own.
@compute @workgroup_size(256)
fn spread(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    let layer = layer_at(w * 1024u);
    let end = layers[layer].first_place + layers[layer].places;
    if halted() {
        return;
    }
    for (var k = 0u; k < 4u; k++) {
        let at = w * 1024u + thread * 4u + k;
        if at >= end || (atomicLoad(&flags[at]) & HOLDS) == 0u {
            continue;
        }
        let block = block_at(layer, at);
        for (var n = 0u; n < 27u; n++) {
            mark_reached(place_in_box(layer, block + offset_of(n)));
        }
        @if(levels)
        if is_edge(layer, block) {
            let coarse = (block - vec3<i32>(1)) >> vec3<u32>(1u);
            for (var n = 0u; n < 8u; n++) {
                let by = vec3<i32>(i32(n >> 2u), i32((n >> 1u) & 1u), i32(n & 1u));
                mark_reached(place_in_box(layer + 1u, coarse + by));
            }
        }
    }
}

fn mark_reached(place: u32) {
    if place != NONE {
        atomicOr(&flags[place], REACHED);
    }
}
