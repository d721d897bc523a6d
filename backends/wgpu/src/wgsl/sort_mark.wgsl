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
    @if(!halts)
    var mine = vec4<f32>(0.0);
    for (var q = cells[b * 64u] + thread; q < end; q += 128u) {
        let tag = record_of(q, 0u).w;
        if (tag & GONE) != 0u {
            continue;
        }
        var local = cell_to_be(tag, due);
        let cell = block * 4 + local;
        // Whom the world ends for at a face of cells is put back there, or goes; an error is one at the side itself. Those of layers that are not
        // due stand in their homes.
        @if(halts)
        let is_outside = due && is_beyond(layer, cell, record_of(q, 0u).xyz);
        @else
        let is_outside = any(((cell < world_min(layer)) | (cell >= world_max(layer))) & !IS_PERIODIC);
        if is_outside {
            @if(halts) {
                atomicMin(&status[WHO], q);
                atomicStore(&status[HALT_STEP], step.number);
                atomicStore(&status[HALTED], LEFT_WORLD);
            }
            // One that keeps its home is put back when its layer is due.
            @elif(puts_back)
            if due {
                mine += put_back(q, layer, block, &local);
            }
            @else {
                set_record(q, 0u, vec4<u32>(record_of(q, 0u).xyz, tag | GONE));
                mine.w += bitcast<f32>(record_of(q, 1u).w);
                atomicAdd(&status[sum_word(layer, LEFT)], 1u);
                continue;
            }
        } else {
            @if(levels)
            if due && !is_placed(layer, cell, vec3<i32>(record_of(q, 0u).xyz >> vec3<u32>(31u))) {
                atomicStore(&status[sum_word(layer, ASTRAY)], 1u);
            }
        }
        let at = place_in_box(layer, block + (local >> vec3<u32>(2u)));
        if at != NONE {
            atomicStore(&flags[at], HOLDS);
        }
    }
    @if(!halts)
    note_left(b, thread, mine);
}
