// Moves the particles' motion and stress.
@compute @workgroup_size(128)
fn move_motion(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if halted() || i >= extent.particles {
        return;
    }
    let q = order[i];
    for (var k = 0u; k < 3u; k++) {
        new_motion[k * extent.slots + i] = motion[k * extent.slots + q];
    }
    for (var k = 0u; k < 2u; k++) {
        new_stress[k * extent.slots + i] = stress[k * extent.slots + q];
    }
}
