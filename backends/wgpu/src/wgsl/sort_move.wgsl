// Moves particles to their new places.
@compute @workgroup_size(128)
fn move_rest(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if halted() || i >= extent.particles {
        return;
    }
    let q = order[i];
    let p = place[q];
    new_place[i] = vec4<u32>(p.xyz, (p.w & 0xfffffe00u) | tag_of(cell_of(p.w) & vec3<i32>(3)));
    new_ids[i] = ids[q];
    for (var k = 0u; k < REST; k++) {
        new_rest[k * extent.slots + i] = rest[k * extent.slots + q];
    }
}
