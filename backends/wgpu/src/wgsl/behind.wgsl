
// Has a layer's block of nodes some behind mirrors?
fn has_nodes_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer));
    return any(low | high);
}
