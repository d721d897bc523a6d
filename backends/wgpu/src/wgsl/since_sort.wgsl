// When a layer is sorted. This goes by its own steps and its own particles' drift since its last sort alone, so that it does not matter
// how steps are cut into submissions, or what other layers do; the host knows the same (`since_sort.rs`).
struct SinceSort {
    // Steps since the last sort.
    age: u32,
    // How far particles may have drifted since then [cells].
    drift: f32,
}

// A layer's age and drift when the step begins. P2G notes the drift for the next step, which would wait long for the moves of all steps before; so
// it asks for all that it needs at once.
fn since_sort_of(layer: u32) -> SinceSort {
    let last = max(step.number, 1u) - 1u;
    let sorted = atomicLoad(&status[sum_word(layer, SORTED)]);
    let before = atomicLoad(&status[step_word(last, layer, DRIFT)]);
    let word = atomicLoad(&status[step_word(last, layer, MOVE)]);
    var moved = bitcast<f32>(word);
    if SUBCYCLED {
        // As often as the level steps within one of the coarsest.
        moved = ldexp(moved, i32(LEVELS - 1u - level_of(layer)));
    }
    var since_sort = SinceSort(layers[layer].age + step.number, bitcast<f32>(before) + moved);
    if step.number == 0u {
        since_sort.drift = layers[layer].drift;
    }
    if sorted != 0u {
        since_sort.age = step.number + 1u - sorted;
    }
    if sorted == step.number + 1u {
        since_sort.drift = 0.0;
    }
    return since_sort;
}

// Must a layer of that age and drift be sorted before the step?
fn is_due(since_sort: SinceSort) -> bool {
    return is_sort_due(since_sort.age, since_sort.drift);
}

// Must a layer be sorted, which has that age and drift? A world's levels are sorted together.
fn is_world_due(layer: u32, since_sort: SinceSort) -> bool {
    if LEVELS == 1u {
        return is_due(since_sort);
    }
    let first = layer - level_of(layer);
    var due = false;
    for (var l = 0u; l < LEVELS; l++) {
        due |= is_due(since_sort_of(first + l));
    }
    return due;
}
