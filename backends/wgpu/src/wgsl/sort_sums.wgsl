// Particles in each block.
@compute @workgroup_size(64)
fn sum_cells(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = (group.y * extent.row + group.x) * 64u + thread;
    if halted() || b >= atomicLoad(&status[BLOCKS]) {
        return;
    }
    var sum = 0u;
    for (var c = 0u; c < 64u; c++) {
        sum += counts[b * 64u + c];
    }
    sums[b] = vec2<u32>(sum, 0u);
}
