@compute @workgroup_size(64)
fn velocities(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = is_on(g);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let node = velocity(g, grid[g * 64u + n]);
    grid[g * 64u + n] = node;
    note_speed(g, node, n);
}
