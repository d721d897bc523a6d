
// Velocities of nodes that a finer layer, whose step it is, hands something to. Their own momentum in its second step is what they have at the
// velocity of the first, and what forces add. Nodes at rims move with such nodes, and find what they come to by themselves, so that one need not
// wait for the other.

fn takes_part(layer: u32) -> bool {
    return level_of(layer) <= step.end_level && layers[layer].on != 0u;
}

// What a shared node has of its own in the finer layer's present step: its first one begins with the layer's own.
fn own_now(g: u32, n: u32) -> vec4<f32> {
    return shared_nodes[own_at(g, n) + select(128u, 0u, is_live(layer_of(g)))];
}

// What the next finer layer hands to a node in all, as `handed_to` of a block whose givers are found: all are asked for at once.
fn handed_to_cell(finer: u32, cell: vec3<i32>) -> vec4<f32> {
    var held: array<u32, 8>;
    for (var k = 0u; k < 8u; k++) {
        let block = ((cell - vec3<i32>(1)) >> vec3<u32>(1u)) + vec3<i32>((vec3<u32>(k >> 2u, k >> 1u, k) & vec3<u32>(1u)));
        let at = place_in_box(finer, block);
        let rim = directory[select(at, 0u, at == NONE)].y;
        let place = cell - 2 * block + vec3<i32>(1);
        held[k] = select(rim * 64u + u32(place.x * 16 + place.y * 4 + place.z), NONE, at == NONE || rim == NONE);
    }
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < 8u; k++) {
        let is_rim = held[k] != NONE && (rims[select(held[k] >> 6u, 0u, held[k] == NONE)].z & HANDS_ON) != 0u;
        let of_giver = handed[select(0u, held[k], is_rim)];
        sum += select(vec4<f32>(0.0), of_giver, is_rim);
    }
    return sum;
}

// The velocity of a layer's node, brought into the world by periodic axes only; that of a node which the grid does not hold is that of
// nothing.
fn velocity_at(layer: u32, cell: vec3<i32>) -> vec3<f32> {
    let at = place_in_box(layer, cell >> vec3<u32>(2u));
    if at == NONE || directory[at].y == NONE {
        return vec3<f32>(0.0);
    }
    let g = directory[at].y;
    let local = cell & vec3<i32>(3);
    let n = u32(local.x * 16 + local.y * 4 + local.z);
    if is_shared(g, n) {
        return velocity(g, own_now(g, n) + handed_to_cell(layer - 1u, 4 * lists[(extent.block_room + g) * ENTRY].xyz + local)).xyz;
    }
    return grid[g * 64u + n].xyz;
}

// `is_on`: does a finer layer hand anything to the block's nodes in this slot?
fn solve_block(g: u32, n: u32, is_on: bool) {
    if is_on {
        find_givers(g, n);
    }
    workgroupBarrier();
    var node = vec4<f32>(0.0);
    if is_on && is_shared(g, n) {
        let at = own_at(g, n);
        let own = own_now(g, n);
        let gain = shared_nodes[at + 64u].xyz;
        node = velocity(g, own + handed_to(n));
        grid[g * 64u + n] = node;
        if is_live(layer_of(g)) {
            shared_nodes[at + 128u] = vec4<f32>(own.w * node.xyz + gain, own.w);
        }
    }
    note_speed(g, node, n);
}

// Nodes behind mirrors move as their images before them; those at rims have found that. Of a block with images of given ones, walls are booked for
// what particles read in the end.
fn reflect(g: u32, n: u32, is_on: bool) {
    let layer = layer_of(g);
    let entry = (extent.block_room + g) * ENTRY;
    var impulse = vec3<f32>(0.0);
    if is_on && !is_slave(g, n) {
        let image = image_of(layer, 4 * lists[entry].xyz + local_of(n));
        if image.is_other {
            impulse = mirror_node(g, n, layer, image);
        }
    }
    // What is exchanged before is done with.
    workgroupBarrier();
    let total = sum_of_block(n, impulse);
    if n == 0u && is_on && is_live(layer) != ((rims[g].z & IMAGES_GIVEN) != 0u) {
        book(entry + TO_BOOK, total);
    }
}

// What is to be done with a block on a list, as bits: does it take something, is it at a rim, and has it nodes behind mirrors?
fn tasks_of(g: u32, list: u32) -> u32 {
    let here = min(g, extent.node_room - 1u);
    let rim = rims[here];
    let layer = layer_of(here);
    if atomicLoad(&status[HALTED]) != 0u || g >= atomicLoad(&status[NODE_BLOCKS]) {
        return 0u;
    }
    let is_behind = step.mirrors != 0u && (rim.z & IS_BEHIND) != 0u;
    let images_given = (rim.z & IMAGES_GIVEN) != 0u;
    if list == TAKING {
        return select(0u, (u32((rim.z & IS_GIVEN) != 0u) * TAKES) | (u32(is_behind && images_given) * REFLECTS), takes_part(layer));
    }
    return select(0u, (u32(any(rim.xy != vec2<u32>(0u))) * MOVES) | (u32(is_behind && !images_given) * REFLECTS), is_live(layer));
}
