
// Free bodies that levels follow, and behind them blocks at rims. Such bodies meet nodes of the finest level alone, and none at a rim: neither reads
// what the other writes, but for images of nodes further from walls than any particle reads. The workgroups are wide, so that more rims are under way at once
// where what a body needs lets few of them share a multiprocessor.
@compute @workgroup_size(64u * ABREAST)
fn free_and_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let bodies = WORLDS * FREES + 1u;
    let w = group.y * extent.row + group.x;
    if w < bodies {
        free_body(w, thread);
    } else {
        rims_and_walls(w - bodies, thread);
    }
}
