// A sort that has left particles behind is the last before the host knows how many there are.
@compute @workgroup_size(1)
fn gone() {
    if !halted() && atomicLoad(&status[COUNTED]) != extent.particles {
        atomicStore(&status[HALT_STEP], step.number);
        atomicStore(&status[HALTED], FEWER);
    }
}
