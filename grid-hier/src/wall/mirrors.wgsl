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
