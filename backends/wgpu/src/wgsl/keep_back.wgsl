
// What one of the tiles without forces holds for a node.
fn of_still(tile: u32, local: vec3<i32>, other: vec3<bool>) -> vec4<f32> {
    let here = select(tile, 0u, tile == NONE);
    let number = u32(lists[here * ENTRY + OF_RIMS].w) >> 1u;
    let held = handed[of_still_tile(max(number, 1u) - 1u) + in_tile(local, other)];
    return select(held, vec4<f32>(0.0), tile == NONE || number == 0u);
}

fn sum_of_still(tiles: Tiles, local: vec3<i32>) -> vec4<f32> {
    return of_still(tiles.low.x, local, vec3<bool>(false, false, false)) + of_still(tiles.low.y, local, vec3<bool>(false, false, true))
        + of_still(tiles.low.z, local, vec3<bool>(false, true, false)) + of_still(tiles.low.w, local, vec3<bool>(false, true, true))
        + of_still(tiles.high.x, local, vec3<bool>(true, false, false)) + of_still(tiles.high.y, local, vec3<bool>(true, false, true))
        + of_still(tiles.high.z, local, vec3<bool>(true, true, false)) + of_still(tiles.high.w, local, vec3<bool>(true, true, true));
}

// A layer's own sum at a node, or nothing as long as it is the finer layer's, too. Its momentum p + dt f, with p as it is without forces, is split:
// the finer layer's first step has p + dt f / 2, and the second one adds dt f / 2.
fn kept_back(g: u32, n: u32, node: vec4<f32>, tiles: Tiles, local: vec3<i32>) -> vec4<f32> {
    if is_shared(g, n) {
        let carried = sum_of_still(tiles, local);
        let gain = 0.5 * (node.xyz - carried.xyz);
        shared_nodes[own_at(g, n)] = vec4<f32>(carried.xyz + gain, node.w);
        shared_nodes[own_at(g, n) + 64u] = vec4<f32>(gain, 0.0);
        return vec4<f32>(0.0);
    }
    return kept(g, n, node);
}
