// Where each cell's particles begin, counted cell by cell, and where those of each round stand.
@compute @workgroup_size(64)
fn starts(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    var mine = 0u;
    let on = !halted() && b < atomicLoad(&status[BLOCKS]);
    if on {
        mine = cells[b * 64u + thread];
    }
    partial[thread] = vec2<u32>(mine, 0u);
    workgroupBarrier();
    if !on {
        return;
    }
    var before = sums[b].x;
    var most = 0u;
    for (var t = 0u; t < 64u; t++) {
        before += select(0u, partial[t].x, t < thread);
        most = max(most, partial[t].x);
    }
    cells[b * 64u + thread] = before;
    for (var round = 0u; round <= round_of(most); round++) {
        // Those of earlier rounds, and of this one in cells before.
        let earlier = round * TOGETHER;
        let later = select(earlier + TOGETHER, NONE, round == ROUNDS);
        var at = sums[b].x;
        for (var t = 0u; t < 64u; t++) {
            at += min(partial[t].x, select(earlier, later, t < thread));
        }
        cells[round_at(b, round, thread)] = at;
    }
    if b + 1u == atomicLoad(&status[BLOCKS]) && thread == 63u {
        cells[b * 64u + 64u] = before + mine;
    }
}
