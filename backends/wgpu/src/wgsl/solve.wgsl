
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
        let is_rim = held[k] != NONE && any(rims[select(held[k] >> 6u, 0u, held[k] == NONE)].xy != vec2<u32>(0u));
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

fn solve_block(g: u32, n: u32) {
    find_givers(g, n);
    var node = vec4<f32>(0.0);
    if is_shared(g, n) {
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

@compute @workgroup_size(64)
fn solve(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = $BLOCK;
    if n == 0u {
        let fits = atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]);
        let rim = rims[min(g, extent.node_room - 1u)];
        takes = u32(fits && rim.z != 0u && takes_part(layer_of(g)));
        at_rim = u32(fits && any(rim.xy != vec2<u32>(0u)) && is_live(layer_of(g)));
    }
    if workgroupUniformLoad(&takes) != 0u {
        solve_block(g, n);
    }
    if workgroupUniformLoad(&at_rim) != 0u {
        move_rim(g, n);
    }
}
