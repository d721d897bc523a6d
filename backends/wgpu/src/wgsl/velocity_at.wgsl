// The velocity of a layer's node, brought into the world by periodic axes only; that of a node which the grid does not hold is that of
// nothing.
fn velocity_at(layer: u32, cell: vec3<i32>) -> vec3<f32> {
    let at = place_in_box(layer, cell >> vec3<u32>(2u));
    if at == NONE || directory[at].y == NONE {
        return vec3<f32>(0.0);
    }
    let local = cell & vec3<i32>(3);
    return grid[directory[at].y * 64u + u32(local.x * 16 + local.y * 4 + local.z)].xyz;
}
