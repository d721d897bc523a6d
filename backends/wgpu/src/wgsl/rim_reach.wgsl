
// Do blocks of the next finer layer hand something to a block's nodes?
fn takes_from_rim(layer: u32, block: vec3<i32>) -> bool {
    if level_of(layer) == 0u {
        return false;
    }
    for (var k = 0u; k < 64u; k++) {
        let finer = 2 * block - vec3<i32>(1) + vec3<i32>(i32(k >> 4u), i32((k >> 2u) & 3u), i32(k & 3u));
        let at = place_in_box(layer - 1u, finer);
        if at != NONE && flags[at] != 0u && is_edge(layer - 1u, finer) {
            return true;
        }
    }
    return false;
}
