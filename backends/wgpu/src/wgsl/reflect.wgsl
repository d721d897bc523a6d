// Nodes behind mirrors move as their images before them, and what the walls give in this step is booked.

var<workgroup> go: u32;
var<workgroup> given: array<vec4<f32>, 64>;

fn has_nodes_behind(layer: u32, first: vec3<i32>) -> bool {
    let low = (LOW != vec3<u32>(0u)) & (first < world_min(layer));
    let high = (HIGH != vec3<u32>(0u)) & (first + vec3<i32>(3) >= world_max(layer));
    return any(low | high);
}

fn layer_of(g: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[(extent.block_room + g) * ENTRY].w);
}

// Books what folding gave to a block's nodes, and handing on to parents behind walls, unless the step is too long: then it will be repeated. All is asked for at once.
fn ready(w: u32) -> u32 {
    let speed = bitcast<f32>(atomicLoad(&status[greatest_word(step.number)]));
    let is_halted = atomicLoad(&status[HALTED]) != 0u;
    let node_blocks = atomicLoad(&status[NODE_BLOCKS]);
    let blocks = atomicLoad(&status[BLOCKS]);
    let first = lists[(extent.block_room + w) * ENTRY].xyz * 4;
    let pending = bitcast<vec4<f32>>(lists[w * ENTRY + PENDING]);
    let before = bitcast<vec4<f32>>(lists[w * ENTRY + WALL]);
    if is_halted || w >= node_blocks || !is_slow_enough(speed) {
        return 0u;
    }
    if w < blocks && any(pending != vec4<f32>(0.0)) && is_live(u32(lists[w * ENTRY].w)) {
        lists[w * ENTRY + WALL] = bitcast<vec4<i32>>(before + pending);
    }
    if LEVELS > 1u && is_live(layer_of(w)) {
        let entry = (extent.block_room + w) * ENTRY;
        lists[entry + WALL] = bitcast<vec4<i32>>(bitcast<vec4<f32>>(lists[entry + WALL]) + bitcast<vec4<f32>>(lists[entry + PENDING]));
    }
    return u32(has_nodes_behind(layer_of(w), first) && is_live(layer_of(w))$IF_TOUCHED);
}

@compute @workgroup_size(64)
fn reflect_nodes(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = ready(g);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    let cell = lists[entry].xyz * 4 + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
    // P2G folds along the first axis first: what the wall across it gives, the other mirrors have turned already.
    let low = world_min(layer_of(g));
    let high = world_max(layer_of(g));
    var image = cell;
    var outer = vec3<f32>(1.0);
    var inner = vec3<f32>(1.0);
    for (var axis = 0; axis < 3; axis++) {
        for (var end = 0; end < 2; end++) {
            let kind = select(LOW[axis], HIGH[axis], end == 1);
            let beyond = select(cell[axis] < low[axis], cell[axis] >= high[axis], end == 1);
            if kind != 0u && beyond {
                if all(image == cell) {
                    outer = wall_signs(kind, axis);
                } else {
                    inner *= wall_signs(kind, axis);
                }
                image[axis] = 2 * select(low[axis], high[axis], end == 1) - 1 - cell[axis];
            }
        }
    }
    var impulse = vec3<f32>(0.0);
    if any(image != cell) {
        let mass = grid[g * 64u + n].w;
        let u = inner * velocity_at(layer_of(g), image);
        impulse = (outer - vec3<f32>(1.0)) * u * mass;
        grid[g * 64u + n] = vec4<f32>(outer * u, mass);
    }
    given[n] = vec4<f32>(impulse, 0.0);
    workgroupBarrier();
    if n < 8u {
        for (var t = 1u; t < 8u; t++) {
            given[n] += given[n + 8u * t];
        }
    }
    workgroupBarrier();
    if n == 0u {
        var total = bitcast<vec4<f32>>(lists[entry + WALL]);
        for (var t = 0u; t < 8u; t++) {
            total += given[t];
        }
        lists[entry + WALL] = bitcast<vec4<i32>>(total);
    }
}
