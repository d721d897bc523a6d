
// Bodies that levels follow, and behind their groups blocks at rims. Such bodies meet nodes of the finest level alone, and none at a rim: neither reads
// what the other writes, but for images of nodes further from walls than any particle reads. The workgroups are wide, so that more rims are under way at once
// where what a group needs lets few of them share a multiprocessor.
@compute @workgroup_size(64u * ABREAST)
fn answering_and_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let groups = ALL_GROUPS + 1u;
    let w = group.y * extent.row + group.x;
    if w < groups {
        answer_of_group(w, thread);
    } else {
        rims_and_walls(w - groups, thread);
    }
}
