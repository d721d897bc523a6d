// Nodes: sums of tiles, and velocities from them.

var<workgroup> go: u32;
var<workgroup> greatest: atomic<u32>;

// What one of the tiles that reach a node holds for it. All eight are asked for at once, also where there is none.
fn of_tile(entry: u32, local: vec3<i32>, other: vec3<bool>) -> vec4<f32> {
    let upper = local >= vec3<i32>(2);
    // From the tile's block to this node's, and the node in that tile.
    let to_block = select(vec3<i32>(1), vec3<i32>(-1), upper);
    let in_other = select(local + vec3<i32>(6), local - vec3<i32>(2), upper);
    let by = select(vec3<i32>(0), to_block, other) + vec3<i32>(1);
    let at = select(local + vec3<i32>(2), in_other, other);
    let which = u32(by.x * 9 + by.y * 3 + by.z);
    let tile = u32(lists[entry + 1u + (which >> 2u)][which & 3u]);
    let held = grid[extent.node_room * 64u + select(tile, 0u, tile == NONE) * 512u + u32(at.x * 64 + at.y * 8 + at.z)];
    return select(held, vec4<f32>(0.0), tile == NONE);
}

// What the tiles around a node hold for it: two along each axis reach it.
fn sum_of_tiles(entry: u32, n: u32) -> vec4<f32> {
    let local = vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
    return of_tile(entry, local, vec3<bool>(false, false, false)) + of_tile(entry, local, vec3<bool>(false, false, true))
        + of_tile(entry, local, vec3<bool>(false, true, false)) + of_tile(entry, local, vec3<bool>(false, true, true))
        + of_tile(entry, local, vec3<bool>(true, false, false)) + of_tile(entry, local, vec3<bool>(true, false, true))
        + of_tile(entry, local, vec3<bool>(true, true, false)) + of_tile(entry, local, vec3<bool>(true, true, true));
}

fn layer_of(g: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[(extent.block_room + g) * ENTRY].w);
}

fn is_on(g: u32) -> u32 {
    return u32(atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) && is_live(layer_of(g)));
}

// Momentum to velocity. Nodes that hardly weigh anything carry nothing; what is too slow to deform anything is at rest.
fn velocity(g: u32, node: vec4<f32>) -> vec4<f32> {
    if !(node.w > layers[layer_of(g)].least) {
        // NaN stays, to be found.
        return vec4<f32>(select(vec3<f32>(0.0), vec3<f32>(node.w), node.w != node.w), node.w);
    }
    let u = node.xyz / node.w;
    return vec4<f32>(select(u, vec3<f32>(0.0), abs(u) < vec3<f32>(1e-18)), node.w);
}

// Notes the greatest speed that a particle may feel: a node takes part in a particle's velocity by no more than its share of mass.
fn note_speed(g: u32, node: vec4<f32>, n: u32) {
    let felt = min(node.w * layers[layer_of(g)].felt, 1.0);
    let bits = max(max(magnitude_bits(felt * node.x), magnitude_bits(felt * node.y)), magnitude_bits(felt * node.z));
    atomicMax(&greatest, bits);
    workgroupBarrier();
    if n == 0u {
        atomicMax(&status[step_word(step.number, layer_of(g), SPEED)], atomicLoad(&greatest));
        if LAYERS > 1u {
            atomicMax(&status[greatest_word(step.number)], atomicLoad(&greatest));
        }
    }
}

@compute @workgroup_size(64)
fn sum_tiles(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = is_on(g)$AND_MIRRORS;
    }
    $TOUCHED
    let on = workgroupUniformLoad(&go);
    if on == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    $SUM_TILES
}
