// Marks the particles that are to go, of which the host has made a list, for the next sort.
@compute @workgroup_size(128)
fn remove(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if i < step.count {
        let p = record_of(order[i], 0u);
        set_record(order[i], 0u, vec4<u32>(p.xyz, p.w | GONE));
    }
}
