
// Are there images behind mirrors among the parents of a block's nodes, which are 4x4x4 of the next coarser layer's, from the first one on?
fn has_parents_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer + 1u));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer + 1u));
    return any(low | high);
}
