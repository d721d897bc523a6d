// The order within each cell: as many come before as are less. And each particle's block and mass.
@compute @workgroup_size(128)
fn rank(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if halted() || i >= extent.particles {
        return;
    }
    if i >= atomicLoad(&status[COUNTED]) {
        order[i] = NONE;
        return;
    }
    let mine = loose[i];
    let q = mine & 0x0fffffffu;
    let cell = keys[q].x;
    let first = cells[cell];
    let last = cells[cell + 1u];
    var before = 0u;
    for (var j = first; j < last; j++) {
        before += u32(loose[j] < mine);
    }
    let to = slot_of(cell >> 6u, cell & 63u, before);
    order[to] = q | (keys[q].y & KEPT);
    owners[to] = vec2<u32>(cell >> 6u, record_of(q, 1u).w);
}
