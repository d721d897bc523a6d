// A sort that has found particles on another level than they should be is the last before they are brought there.
@compute @workgroup_size(1)
fn placed() {
    if halted() {
        return;
    }
    for (var layer = 0u; layer < LAYERS; layer++) {
        if atomicLoad(&status[sum_word(layer, ASTRAY)]) != 0u {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], MISPLACED);
        }
    }
}
