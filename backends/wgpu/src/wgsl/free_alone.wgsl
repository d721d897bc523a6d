
@compute @workgroup_size(256)
fn free_bodies(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    free_body(group.y * extent.row + group.x, thread);
}
