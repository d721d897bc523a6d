
// Blocks of the levels whose step it is: of a world that is alone, those stand first.
fn blocks_now() -> u32 {
    if LAYERS == LEVELS && step.end_level < LEVELS {
        return atomicLoad(&status[layer_word(step.end_level, FIRST_BLOCK)]);
    }
    return atomicLoad(&status[BLOCKS]);
}
