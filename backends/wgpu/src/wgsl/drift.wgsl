// Upper bound of the drift of a layer's particles since its last sort, when the step begins [cells].
fn drift_of(layer: u32) -> f32 {
    var drift = layers[layer].drift;
    var s = 0u;
    let sorted = atomicLoad(&status[layer_word(layer, SORTED)]);
    if sorted != 0u {
        drift = 0.0;
        s = sorted - 1u;
    }
    for (; s < step.number; s++) {
        drift += bitcast<f32>(atomicLoad(&status[step_word(s, layer, MOVE)]));
    }
    return drift;
}
