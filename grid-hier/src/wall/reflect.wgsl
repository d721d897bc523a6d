// Nodes behind mirrors move as their images before them, and what the walls give in this step is booked.

var<workgroup> go: u32;

fn layer_of(g: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[(extent.block_room + g) * ENTRY].w);
}

// Books what folding gave to a block's nodes, and handing on to parents behind walls, unless the step is too long: then it will be repeated. All is asked for at once.
fn ready(w: u32) -> u32 {
    let too_fast = atomicLoad(&status[fast_word(step.number)]);
    let is_halted = atomicLoad(&status[HALTED]) != 0u;
    let node_blocks = atomicLoad(&status[NODE_BLOCKS]);
    let first = lists[(extent.block_room + w) * ENTRY].xyz * 4;
    @if(!mirrored)
    let blocks = atomicLoad(&status[BLOCKS]);
    @if(!mirrored)
    let pending = bitcast<vec4<f32>>(lists[w * ENTRY + PENDING]);
    @if(!mirrored)
    let before = bitcast<vec4<f32>>(lists[w * ENTRY + WALL]);
    if is_halted || w >= node_blocks || too_fast != 0u {
        return 0u;
    }
    // What folding gave to a block's nodes, and handing on to parents behind walls.
    @if(!mirrored) {
        if w < blocks && any(pending != vec4<f32>(0.0)) && is_live(u32(lists[w * ENTRY].w)) {
            lists[w * ENTRY + WALL] = bitcast<vec4<i32>>(before + pending);
        }
        if LEVELS > 1u && is_live(layer_of(w)) {
            let entry = (extent.block_room + w) * ENTRY;
            book(entry + WALL, bitcast<vec4<f32>>(lists[entry + PENDING]));
        }
    }
    @if(sleeps)
    return u32(has_nodes_behind(layer_of(w), first) && is_live(layer_of(w)) && atomicLoad(&watch[touched_word(w)]) != 0u);
    @else
    return u32(has_nodes_behind(layer_of(w), first) && is_live(layer_of(w)));
}

@compute @workgroup_size(64)
fn reflect_nodes(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    @if(listed)
    let g = listed_block(WALLED, group.y * extent.row + group.x);
    @else
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = ready(g);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    let cell = lists[entry].xyz * 4 + local_of(n);
    let image = image_of(layer_of(g), cell);
    var impulse = vec3<f32>(0.0);
    if image.is_other {
        impulse = mirror_node(g, n, layer_of(g), image);
    }
    let total = sum_of_block(n, impulse);
    if n == 0u {
        book(entry + WALL, total);
    }
}
