// Blocks of nodes as the law on the host left them.
@compute @workgroup_size(64)
fn scatter_near(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let at = group.y * extent.row + group.x;
    if at < atomicLoad(&status[BACK]) {
        grid[near[at * NEAR_BLOCK].w * 64u + n] = bitcast<vec4<f32>>(near[at * NEAR_BLOCK + 1u + n]);
    }
}
