// Blocks of nodes as the law on the host left them.
@compute @workgroup_size(64)
fn scatter_near(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let at = group.y * extent.row + group.x;
    if at < atomicLoad(&status[BACK]) {
        let node = near[at * NEAR_BLOCK].w * 64u + n;
        grid[node] = vec4<f32>(bitcast<vec3<f32>>(near[at * NEAR_BLOCK + 1u + n].xyz), grid[node].w);
    }
}
