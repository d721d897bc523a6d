// Which layers are to be sorted. In a sort, the others keep their particles' homes and order.
@compute @workgroup_size(64)
fn due(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let layer = group.x * 64u + thread;
    if layer < LAYERS {
        atomicStore(&status[sum_word(layer, DUE)], u32(is_live(layer) && is_world_due(layer, since_sort_of(layer))));
    }
    // Levels that have to follow a body do so before.
    if layer == 0u && atomicLoad(&status[FOLLOWED]) != 0u && atomicLoad(&status[HALTED]) == 0u {
        atomicStore(&status[HALT_STEP], step.number);
        atomicStore(&status[HALTED], FOLLOW);
    }
}
