// Marks the blocks that hold particles, and finds those that have left the world.
var<workgroup> on: u32;

@compute @workgroup_size(128)
fn mark(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    if thread == 0u {
        on = u32(b < atomicLoad(&status[BLOCKS]) && !halted());
    }
    if workgroupUniformLoad(&on) == 0u {
        return;
    }
    let block = lists[b * ENTRY].xyz;
    let layer = u32(lists[b * ENTRY].w);
    let due = is_sorted(layer);
    let end = cells[b * 64u + 64u];
    $BEGIN
    for (var q = cells[b * 64u] + thread; q < end; q += 128u) {
        let tag = record_of(q, 0u).w;
        if (tag & GONE) != 0u {
            continue;
        }
        var local = cell_to_be(tag, due);
        let cell = block * 4 + local;
        if $OUTSIDE {
            $LEAVE
        }$CHECK
        let at = place_in_box(layer, block + (local >> vec3<u32>(2u)));
        if at != NONE {
            atomicStore(&flags[at], 1u);
        }
    }
    $END
}
