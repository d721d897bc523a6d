
// What is to be done with a block at a rim, as bits.
fn tasks_of(g: u32, list: u32) -> u32 {
    let here = min(g, extent.node_room - 1u);
    let too_fast = atomicLoad(&status[fast_word(step.number)]);
    let fits = atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) && too_fast == 0u;
    return u32(fits && is_live(u32(lists[(extent.block_room + here) * ENTRY].w))) * MOVES;
}
