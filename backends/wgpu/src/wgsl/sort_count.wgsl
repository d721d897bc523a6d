// Each particle's new cell, or none, and how many there are in each; whether it keeps its tag.
@compute @workgroup_size(128)
fn count_cells(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    if halted() || b >= atomicLoad(&status[OLD_BLOCKS]) {
        return;
    }
    let block = old_lists[b * ENTRY].xyz;
    let layer = u32(old_lists[b * ENTRY].w);
    let due = is_sorted(layer);
    let end = cells[b * 64u + 64u];
    for (var q = cells[b * 64u] + thread; q < end; q += 128u) {
        let tag = record_of(q, 0u).w;
        if (tag & GONE) != 0u {
            keys[q] = vec2<u32>(NONE);
            @if(sleeps)
            stir(place_in_box(layer, block));
            continue;
        }
        let local = cell_to_be(tag, due);
        let at = place_in_box(layer, block + (local >> vec3<u32>(2u)));
        @if(sleeps)
        if any((local >> vec3<u32>(2u)) != vec3<i32>(0)) {
            stir(at);
        }
        let inner = local & vec3<i32>(3);
        let cell = directory[at].x * 64u + u32(inner.x * 16 + inner.y * 4 + inner.z);
        keys[q] = vec2<u32>(cell, atomicAdd(&counts[cell], 1u) | select(KEPT, 0u, due));
    }
}

// Where particles come or go, nobody goes on sleeping.
@if(sleeps)
fn stir(at: u32) {
    if at != NONE && directory[at].x != NONE {
        note_happened(directory[at].x, STIRRED);
    }
}
