// Where each cell's particles begin.
@compute @workgroup_size(64)
fn starts(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    var mine = 0u;
    let on = !halted() && b < atomicLoad(&status[BLOCKS]);
    if on {
        mine = counts[b * 64u + thread];
    }
    partial[thread] = vec2<u32>(mine, 0u);
    workgroupBarrier();
    if !on {
        return;
    }
    var before = sums[b].x;
    for (var t = 0u; t < thread; t++) {
        before += partial[t].x;
    }
    counts[b * 64u + thread] = before;
    if b + 1u == atomicLoad(&status[BLOCKS]) && thread == 63u {
        counts[b * 64u + 64u] = before + mine;
    }
}
