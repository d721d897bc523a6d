
// Are there some behind mirrors among 4x4x4 nodes of a layer, from the first one on? Those are its own, or the parents of a finer one's block.
fn has_nodes_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer));
    return any(low | high);
}
