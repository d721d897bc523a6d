// Where rims note what walls give: with what is booked, if nothing can halt the step any more, or with what will be once the step is known to be short enough.
const TO_BOOK: u32 = select(PENDING, WALL, MIRRORED);

// Adds to what walls have given, or will have.
fn book(at: u32, given: vec4<f32>) {
    lists[at] = bitcast<vec4<i32>>(bitcast<vec4<f32>>(lists[at]) + given);
}

// The node before all mirrors that one is the image of, or itself.
fn before_mirrors(layer: u32, cell: vec3<i32>) -> vec3<i32> {
    let low = world_min(layer);
    let high = world_max(layer);
    let below = (LOW != vec3<u32>(0u)) & (cell < low);
    let above = (HIGH != vec3<u32>(0u)) & (cell >= high);
    return select(select(cell, 2 * high - 1 - cell, above), 2 * low - 1 - cell, below);
}

// Is a layer's node behind mirrors? An image is never the node itself.
fn is_behind(layer: u32, cell: vec3<i32>) -> bool {
    return any(before_mirrors(layer, cell) != cell);
}

// Are there some behind mirrors among 4x4x4 nodes of a layer, from the first one on? Those are its own, or the parents of a finer one's block.
fn has_nodes_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer));
    return any(low | high);
}
