// When a layer is sorted. This goes by its own steps and its own particles' drift since its last sort alone, so that it does not matter
// how steps are cut into submissions, or what other layers do; the host knows the same rule (`world.rs`).
fn is_due(layer: u32) -> bool {
    var age = layers[layer].age;
    // Upper bound of the drift when the step begins [cells].
    var drift = layers[layer].drift;
    var s = 0u;
    let sorted = atomicLoad(&status[sum_word(layer, SORTED)]);
    if sorted != 0u {
        age = 0u;
        drift = 0.0;
        s = sorted - 1u;
    }
    for (; s < step.number; s++) {
        age += 1u;
        drift += bitcast<f32>(atomicLoad(&status[step_word(s, layer, MOVE)]));
    }
    return !(drift <= MAX_DRIFT)
        || (age % SORT_OFTEN == 0u && drift > OFTEN_DRIFT)
        || (age % SORT_AGE == 0u && drift > SORT_DRIFT);
}
