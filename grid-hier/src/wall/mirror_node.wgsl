
// Gives a node behind mirrors the velocity of its image, turned; what the walls give to that [N s].
fn mirror_node(g: u32, n: u32, layer: u32, image: Image) -> vec3<f32> {
    let u = image.inner * velocity_at(layer, image.cell);
    let mass = grid[g * 64u + n].w;
    grid[g * 64u + n] = vec4<f32>(image.outer * u, mass);
    return given_behind(image, u, mass);
}
