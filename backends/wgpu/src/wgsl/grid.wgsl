// Nodes: sums of tiles, and velocities from them.

var<workgroup> go: u32;
var<workgroup> at_rim: u32;
var<workgroup> takes: u32;
var<workgroup> greatest: array<atomic<u32>, ABREAST>;

// The tiles that reach a node, two along each axis, or NONE.
struct Tiles {
    low: vec4<u32>,
    high: vec4<u32>,
}

// The block whose tile is this node's own one, or its neighbour's along some axes.
fn tile_of(entry: u32, local: vec3<i32>, other: vec3<bool>) -> u32 {
    let to_block = select(vec3<i32>(1), vec3<i32>(-1), local >= vec3<i32>(2));
    let by = select(vec3<i32>(0), to_block, other) + vec3<i32>(1);
    let which = u32(by.x * 9 + by.y * 3 + by.z);
    return u32(lists[entry + 1u + (which >> 2u)][which & 3u]);
}

fn tiles_of(entry: u32, local: vec3<i32>) -> Tiles {
    let low = vec4<u32>(tile_of(entry, local, vec3<bool>(false, false, false)), tile_of(entry, local, vec3<bool>(false, false, true)),
        tile_of(entry, local, vec3<bool>(false, true, false)), tile_of(entry, local, vec3<bool>(false, true, true)));
    let high = vec4<u32>(tile_of(entry, local, vec3<bool>(true, false, false)), tile_of(entry, local, vec3<bool>(true, false, true)),
        tile_of(entry, local, vec3<bool>(true, true, false)), tile_of(entry, local, vec3<bool>(true, true, true)));
    return Tiles(low, high);
}

// Where a node stands in its own block's tile, or in that of the neighbour along some axes.
fn in_tile(local: vec3<i32>, other: vec3<bool>) -> u32 {
    let in_other = select(local + vec3<i32>(6), local - vec3<i32>(2), local >= vec3<i32>(2));
    let at = select(local + vec3<i32>(2), in_other, other);
    return u32(at.x * 64 + at.y * 8 + at.z);
}

// What one of them holds for the node. All eight are asked for at once, also where there is none.
fn of_tile(tile: u32, local: vec3<i32>, other: vec3<bool>) -> vec4<f32> {
    let held = grid[extent.node_room * 64u + select(tile, 0u, tile == NONE) * 512u + in_tile(local, other)];
    return select(held, vec4<f32>(0.0), tile == NONE);
}

fn sum_of(tiles: Tiles, local: vec3<i32>) -> vec4<f32> {
    return of_tile(tiles.low.x, local, vec3<bool>(false, false, false)) + of_tile(tiles.low.y, local, vec3<bool>(false, false, true))
        + of_tile(tiles.low.z, local, vec3<bool>(false, true, false)) + of_tile(tiles.low.w, local, vec3<bool>(false, true, true))
        + of_tile(tiles.high.x, local, vec3<bool>(true, false, false)) + of_tile(tiles.high.y, local, vec3<bool>(true, false, true))
        + of_tile(tiles.high.z, local, vec3<bool>(true, true, false)) + of_tile(tiles.high.w, local, vec3<bool>(true, true, true));
}

// What the tiles around a node hold for it.
fn sum_of_tiles(entry: u32, n: u32) -> vec4<f32> {
    return sum_of(tiles_of(entry, local_of(n)), local_of(n));
}

fn layer_of(g: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[(extent.block_room + g) * ENTRY].w);
}

fn is_on(g: u32) -> u32 {
    let is_halted = atomicLoad(&status[HALTED]) != 0u;
    let node_blocks = atomicLoad(&status[NODE_BLOCKS]);
    return u32(!is_halted && g < node_blocks && is_live(layer_of(g)));
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
    atomicMax(&greatest[abreast], bits);
    // Bodies may hold it yet.
    if is_too_fast(layer_of(g), bitcast<f32>(bits)) {
        atomicAdd(&status[fast_word(step.number)], 1u);
    }
    workgroupBarrier();
    if n == 0u {
        atomicMax(&status[step_word(step.number, layer_of(g), SPEED)], atomicLoad(&greatest[abreast]));
        atomicStore(&greatest[abreast], 0u);
    }
}

@compute @workgroup_size(64)
fn sum_tiles(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    // Asked for before it is known whether there is such a block.
    let entry = (extent.block_room + min(g, extent.node_room - 1u)) * ENTRY;
    let local = local_of(n);
    let tiles = tiles_of(entry, local);
    // Of nodes behind mirrors, what their velocity is made of.
    @if(mirrored)
    let first = 4 * lists[entry].xyz;
    @if(mirrored)
    let layer = layer_of(min(g, extent.node_room - 1u));
    @if(mirrored)
    let behind = has_nodes_behind(layer, first);
    @if(mirrored)
    var image = Image(first + local, vec3<f32>(1.0), vec3<f32>(1.0), false);
    @if(mirrored)
    var there = tiles;
    @if(mirrored)
    var booked = vec4<f32>(0.0);
    @if(mirrored) {
        if behind {
            image = image_of(layer, first + local);
            if image.is_other {
                there = tiles_at(layer, image.cell);
            }
            if n == 0u {
                booked = bitcast<vec4<f32>>(lists[entry + WALL]) + bitcast<vec4<f32>>(lists[entry + PENDING]);
            }
        }
        if n == 0u {
            mirrors = u32(behind);
        }
    }
    if n == 0u {
        go = is_on(g);
        @if(subcycled)
        at_rim = rims[min(g, extent.node_room - 1u)].z & HANDS_ON;
        @if(levels && !subcycled)
        takes = rims[min(g, extent.node_room - 1u)].z & IS_GIVEN;
    }
    // Half of the threads find out while the first one looks whether there is such a block.
    @if(sleeps) {
        if n >= 32u && n < 59u {
            look_at(g, n - 32u);
        }
        workgroupBarrier();
        if n == 0u && go != 0u {
            @if(levels)
            go = atomicLoad(&touched) | u32(any(rims[min(g, extent.node_room - 1u)].xyz != vec3<u32>(0u)));
            @else
            go = atomicLoad(&touched);
            atomicStore(&watch[touched_word(g)], go);
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    // Subcycled, what rims hand on is not needed here, and both begin with the same sums.
    @if(subcycled)
    let sum = sum_of(tiles, local);
    @if(subcycled)
    if workgroupUniformLoad(&at_rim) != 0u {
        let hands = is_slave(g, n) && !(MIRRORED && is_behind(layer_of(g), 4 * lists[entry].xyz + local));
        hand_on(g, entry, n, select(vec4<f32>(0.0), sum, hands));
    }
    // Else it is, where blocks get any.
    @if(levels && !subcycled)
    var given = vec4<f32>(0.0);
    @if(levels && !subcycled)
    if workgroupUniformLoad(&takes) != 0u {
        find_givers(g, n);
        workgroupBarrier();
        given = handed_to(n);
    }
    @if(!levels)
    let held = sum_of(tiles, local);
    @elif(!subcycled)
    let held = kept(g, n, sum_of(tiles, local) + given);
    @else
    let held = kept_back(g, n, sum, tiles, local);
    // Walls that let go begin with momenta.
    @if(sums)
    grid[g * 64u + n] = held;
    @else {
        let node = velocity(g, held);
        @if(mirrored)
        var now = node;
        @if(mirrored)
        if workgroupUniformLoad(&mirrors) != 0u {
            now = reflect(g, entry, n, image, there, booked, node);
        }
        @if(mirrored)
        grid[g * 64u + n] = now;
        @else
        grid[g * 64u + n] = node;
        note_speed(g, node, n);
    }
}
