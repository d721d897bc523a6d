// Marks the blocks that hold particles, and finds those that have left the world.
@compute @workgroup_size(128)
fn mark(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    if b >= atomicLoad(&status[BLOCKS]) || halted() {
        return;
    }
    let block = lists[b * ENTRY].xyz;
    let layer = u32(lists[b * ENTRY].w);
    let due = is_sorted(layer);
    let end = cells[b * 64u + 64u];
    for (var q = cells[b * 64u] + thread; q < end; q += 128u) {
        let tag = record[vector(q, 0u)].w;
        if (tag & GONE) != 0u {
            continue;
        }
        let local = cell_to_be(tag, due);
        let cell = block * 4 + local;
        if any(((cell < world_min(layer)) | (cell >= world_max(layer))) & (PERIOD == vec3<i32>(0))) {
            atomicMin(&status[WHO], q);
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], LEFT_WORLD);
        }$CHECK
        let at = place_in_box(layer, block + (local >> vec3<u32>(2u)));
        if at != NONE {
            atomicStore(&flags[at], 1u);
        }
    }
}
