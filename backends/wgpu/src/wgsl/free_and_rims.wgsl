
// Free bodies that levels follow, and behind them blocks at rims. Such bodies meet nodes of the finest level alone, and none at a rim: neither reads
// what the other writes. Where there are many rims they take two turns; written out one after the other these took an H200 longer.
@compute @workgroup_size(256)
fn free_and_rims(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups_now: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let bodies = WORLDS * FREES;
    let w = group.y * extent.row + group.x;
    if w < bodies {
        free_body(w, thread);
    } else {
        let all = groups_now.x * groups_now.y - bodies;
        for (var turn = 0u; turn < 2u; turn++) {
            rims_of(ABREAST * (w - bodies + turn * all), thread);
        }
    }
}
