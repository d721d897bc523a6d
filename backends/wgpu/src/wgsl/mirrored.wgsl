// Where nothing changes velocities between the grid and the particles, nodes behind mirrors take those of their images at once. What walls give
// is booked by the next step, which comes only if this one was short enough, or when the submission ends.

fn mirrors(g: u32) -> bool {
    return has_nodes_behind(layer_of(g), lists[(extent.block_room + g) * ENTRY].xyz * 4);
}

// The sum of tiles for any node of a layer.
fn sum_at(layer: u32, cell: vec3<i32>) -> vec4<f32> {
    let at = place_in_box(layer, cell >> vec3<u32>(2u));
    if at == NONE || directory[at].y == NONE {
        return vec4<f32>(0.0);
    }
    let local = vec3<u32>(cell & vec3<i32>(3));
    return sum_of_tiles((extent.block_room + directory[at].y) * ENTRY, local.x * 16u + local.y * 4u + local.z);
}

// A node's velocity from that of its image, if it is one behind mirrors.
fn reflected(g: u32, entry: u32, n: u32, node: vec4<f32>) -> vec4<f32> {
    let layer = layer_of(g);
    let cell = lists[entry].xyz * 4 + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
    let image = image_of(layer, cell);
    var now = node;
    var impulse = vec3<f32>(0.0);
    if any(image.cell != cell) {
        let u = image.inner * velocity(g, sum_at(layer, image.cell)).xyz;
        impulse = given_behind(image, u, node.w);
        now = vec4<f32>(image.outer * u, node.w);
    }
    let total = sum_of_block(n, impulse);
    if n == 0u {
        let before = bitcast<vec4<f32>>(lists[entry + WALL]) + bitcast<vec4<f32>>(lists[entry + PENDING]);
        lists[entry + WALL] = bitcast<vec4<i32>>(before);
        lists[entry + PENDING] = vec4<i32>(bitcast<vec3<i32>>(total.xyz), i32(step.number));
    }
    return now;
}
