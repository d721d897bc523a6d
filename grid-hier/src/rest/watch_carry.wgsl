// What is known of blocks goes with them to their new numbers. Tiles do not.
@compute @workgroup_size(64)
fn carry(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let old = (group.y * extent.row + group.x) * 64u + thread;
    if halted() || old >= atomicLoad(&status[OLD_BLOCKS]) {
        return;
    }
    let at = place_in_box(u32(old_lists[old * ENTRY].w), old_lists[old * ENTRY].xyz);
    if at == NONE || directory[at].x == NONE {
        return;
    }
    let b = directory[at].x;
    // Particles that come in stand in blocks of their own, which know of no rest.
    let rest = atomicLoad(&old_watch[watch_word(old, RESTS)]);
    if rest != NONE {
        atomicStore(&watch[watch_word(b, RESTS)], rest);
        for (var k = MASS; k < WATCHED; k++) {
            atomicStore(&watch[watch_word(b, k)], atomicLoad(&old_watch[watch_word(old, k)]));
        }
    }
    note_happened(b, atomicLoad(&old_watch[watch_word(old, HAPPENED)]));
}
