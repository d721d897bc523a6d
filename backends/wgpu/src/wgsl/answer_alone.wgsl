
@compute @workgroup_size(256)
fn answering_bodies(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    answer_of_group(group.y * extent.row + group.x, thread);
}
