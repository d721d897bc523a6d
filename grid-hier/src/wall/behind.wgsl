// Where rims note what walls give: with what is booked, if nothing can halt the step any more, or with what will be once the step is known to be short enough.
const TO_BOOK: u32 = select(PENDING, WALL, MIRRORED);

// Adds to what walls have given, or will have.
fn book(at: u32, given: vec4<f32>) {
    lists[at] = bitcast<vec4<i32>>(bitcast<vec4<f32>>(lists[at]) + given);
}

// Are there some behind mirrors among 4x4x4 nodes of a layer, from the first one on? Those are its own, or the parents of a finer one's block.
fn has_nodes_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer));
    return any(low | high);
}
