// What rims have to do with a node's sums.

// What the next finer layer hands to a node: three blocks along each axis reach it.
fn handed_to(g: u32, n: u32) -> vec4<f32> {
    var sum = vec4<f32>(0.0);
    if rims[g].z == 0u {
        return sum;
    }
    let finer = layer_of(g) - 1u;
    let cell = 4 * lists[(extent.block_room + g) * ENTRY].xyz + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
    for (var k = 0u; k < 27u; k++) {
        let block = (cell >> vec3<u32>(1u)) + offset_of(k);
        let at = place_in_box(finer, block);
        if at != NONE {
            let b = directory[at].x;
            if b != NONE && rims[extent.node_room + b].x != 0u {
                let place = cell - 2 * block + vec3<i32>(2);
                sum += handed[b * 216u + u32(place.x * 36 + place.y * 6 + place.z)];
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
