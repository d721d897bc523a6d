
// Node i of the tile and its image j behind a wall satisfy i + j = sum; are there such nodes?
fn in_reach(sum: vec3<i32>) -> vec3<bool> {
    return (sum >= vec3<i32>(1)) & (sum <= vec3<i32>(13));
}

fn reaches_wall(layer: u32, corner: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & in_reach(2 * (world_min(layer) - corner) - vec3<i32>(1));
    let high = (HIGH != vec3<u32>(0u)) & in_reach(2 * (world_max(layer) - corner) - vec3<i32>(1));
    return any(low | high);
}
