
// Free bodies that levels follow, and behind them blocks at rims. Such bodies meet nodes of the finest level alone, and none at a rim: neither reads
// what the other writes.
@compute @workgroup_size(256)
fn free_and_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    if w < WORLDS * FREES {
        free_body(w, thread);
    } else {
        rims_of(ABREAST * (w - WORLDS * FREES), thread);
    }
}
