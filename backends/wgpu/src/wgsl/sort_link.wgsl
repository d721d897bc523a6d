// For each block the node blocks around it, and for each node block the blocks whose tiles reach it. Nothing has been counted yet in the
// blocks' cells: they are cleared here, since a sort that is not to be leaves those that hold the particles alone.
@compute @workgroup_size(64)
fn link(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    let n = thread & 31u;
    if halted() {
        return;
    }
    if w < atomicLoad(&status[BLOCKS]) {
        counts[w * 64u + thread] = 0u;
        @if(sleeps)
        if thread < WATCHED {
            atomicStore(&watch[watch_word(w, thread)], select(select(0u, NONE, thread == DECIDED), 1u, thread == RESTS));
        }
    }
    if n >= 27u {
        return;
    }
    if thread < 32u {
        if w < atomicLoad(&status[BLOCKS]) {
            let at = place_in_box(u32(lists[w * ENTRY].w), lists[w * ENTRY].xyz + offset_of(n));
            var g = NONE;
            if at != NONE {
                g = directory[at].y;
            }
            lists[w * ENTRY + 1u + (n >> 2u)][n & 3u] = i32(g);
        }
    } else if w < atomicLoad(&status[NODE_BLOCKS]) {
        let entry = (extent.block_room + w) * ENTRY;
        // From the tile's block to the nodes'.
        let at = place_in_box(u32(lists[entry].w), lists[entry].xyz - offset_of(n));
        var b = NONE;
        if at != NONE {
            b = directory[at].x;
        }
        lists[entry + 1u + (n >> 2u)][n & 3u] = i32(b);
    }
}
