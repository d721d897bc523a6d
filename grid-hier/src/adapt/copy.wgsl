// Copies the particles that were found to where the host reads them.
@compute @workgroup_size(128)
fn copy_found(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if i >= atomicLoad(&status[COUNTED]) {
        return;
    }
    let q = order[i];
    for (var k = 0u; k < 5u; k++) {
        set_new_record(i, k, record_of(q, k));
    }
    new_ids[i] = ids[q];
    for (var k = 0u; k < REST; k++) {
        set_new_rest(i, k, rest_of(q, k));
    }
}
