// Where nothing changes velocities between the grid and the particles, nodes behind mirrors take those of their images at once. What walls give
// is booked by the next step, which comes only if this one was short enough, or when the submission ends.

var<workgroup> mirrors: u32;

// The tiles that reach any node of a layer.
fn tiles_at(layer: u32, cell: vec3<i32>) -> Tiles {
    let at = place_in_box(layer, cell >> vec3<u32>(2u));
    if at == NONE || directory[at].y == NONE {
        return Tiles(vec4<u32>(NONE), vec4<u32>(NONE));
    }
    return tiles_of((extent.block_room + directory[at].y) * ENTRY, cell & vec3<i32>(3));
}

// The velocity of a node behind mirrors from that of its image, and what that takes.
fn reflect(g: u32, entry: u32, n: u32, image: Image, tiles: Tiles, booked: vec4<f32>, node: vec4<f32>) -> vec4<f32> {
    var now = node;
    var impulse = vec3<f32>(0.0);
    if image.is_other {
        let u = image.inner * velocity(g, sum_of(tiles, image.cell & vec3<i32>(3))).xyz;
        impulse = given_behind(image, u, node.w);
        now = vec4<f32>(image.outer * u, node.w);
    }
    let total = sum_of_block(n, impulse);
    if n == 0u {
        lists[entry + WALL] = bitcast<vec4<i32>>(booked);
        lists[entry + PENDING] = vec4<i32>(bitcast<vec3<i32>>(total.xyz), i32(step.number));
    }
    return now;
}
