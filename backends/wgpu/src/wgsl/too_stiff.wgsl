// Do particles of a layer, or of any level of its world, need shorter steps after the step before this one? NaN does.
fn is_too_stiff(layer: u32) -> bool {
    let first = layer - level_of(layer);
    var is_stiff = false;
    for (var l = 0u; l < LEVELS; l++) {
        let need = bitcast<f32>(atomicLoad(&status[need_word(step.number + 1u, first + l)]));
        is_stiff |= !(need * steps_of(first + l) <= step.most_need);
    }
    return is_stiff && step.number > 0u;
}
