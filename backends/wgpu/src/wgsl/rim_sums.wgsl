// What rims have to do with a node's sums.

// What the next finer layer hands to a node: two of its blocks along each axis have it among their parents.
fn handed_to(g: u32, n: u32) -> vec4<f32> {
    var sum = vec4<f32>(0.0);
    if rims[g].z == 0u {
        return sum;
    }
    let finer = layer_of(g) - 1u;
    let cell = 4 * lists[(extent.block_room + g) * ENTRY].xyz + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
    for (var k = 0u; k < 8u; k++) {
        let block = ((cell - vec3<i32>(1)) >> vec3<u32>(1u)) + vec3<i32>(vec3<u32>(k >> 2u, k >> 1u, k) & vec3<u32>(1u));
        let at = place_in_box(finer, block);
        if at != NONE {
            let rim = directory[at].y;
            if rim != NONE && any(rims[rim].xy != vec2<u32>(0u)) {
                let place = cell - 2 * block + vec3<i32>(1);
                sum += handed[rim * 64u + u32(place.x * 16 + place.y * 4 + place.z)];
            }
        }
    }
    return sum;
}

fn is_slave(g: u32, n: u32) -> bool {
    return (rims[g][n >> 5u] & (1u << (n & 31u))) != 0u;
}

// A layer's own sum at a node, or nothing if it has handed it on. What that weighed it shows as a negative mass.
fn kept(g: u32, n: u32, node: vec4<f32>) -> vec4<f32> {
    return select(node, vec4<f32>(0.0, 0.0, 0.0, -node.w), is_slave(g, n));
}
