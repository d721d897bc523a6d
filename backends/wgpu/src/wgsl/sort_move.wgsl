// Moves particles to their new places, which are their homes until the next sort.
@compute @workgroup_size(128)
fn move_rest(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if halted() || i >= extent.particles || order[i] == NONE {
        return;
    }
    let q = order[i] & ~KEPT;
    let p = record_of(q, 0u);
    var tag = p.w;
    if (order[i] & KEPT) == 0u {
        let home = tag_of(cell_of(p.w) & vec3<i32>(3));
        tag = home | (law_of(p.w) << 9u) | (home << 16u);
    }
    set_new_record(i, 0u, vec4<u32>(p.xyz, tag));
    for (var k = 1u; k < 6u; k++) {
        set_new_record(i, k, record_of(q, k));
    }
    new_ids[i] = ids[q];
    for (var k = 0u; k < REST; k++) {
        set_new_rest(i, k, rest_of(q, k));
    }
}
