
@compute @workgroup_size(256)
fn rims_alone(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    rims_and_walls(group.y * extent.row + group.x, thread);
}
