// The blocks with nodes near bodies whose law runs on the host, in any order: first cell and number of the block, and its nodes. `around` holds
// how many boxes a layer has, and of each box the least and the greatest node.
var<workgroup> go: u32;
var<workgroup> held: atomic<u32>;
var<workgroup> slot: u32;

@compute @workgroup_size(64)
fn gather(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    let entry = (extent.block_room + min(g, extent.node_room - 1u)) * ENTRY;
    if n == 0u {
        go = 0u;
        if atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) {
            go = u32(is_live(u32(lists[entry].w)));
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let layer = u32(lists[entry].w);
    let first = lists[entry].xyz * 4;
    let node = grid[g * 64u + n];
    let mass = $MASS;
    // Nodes behind mirrors move as their images.
    if !(mass <= layers[layer].least) && !is_behind(layer, first + local_of(n)) {
        let boxes = u32(around[0].x);
        for (var b = 0u; b < boxes; b++) {
            let at = 1u + 2u * (layer * boxes + b);
            let cell = image_near(layer, first, middle_of(around[at].xyz, around[at + 1u].xyz)) + local_of(n);
            if all(cell >= around[at].xyz) && all(cell <= around[at + 1u].xyz) {
                atomicStore(&held, 1u);
            }
        }
    }
    workgroupBarrier();
    if n == 0u {
        slot = NONE;
        if atomicLoad(&held) != 0u {
            slot = atomicAdd(&status[NEAR], 1u);
        }
    }
    let at = workgroupUniformLoad(&slot);
    // The host finds out how many there are, and makes room.
    if at >= arrayLength(&near) / NEAR_BLOCK {
        return;
    }
    if n == 0u {
        near[at * NEAR_BLOCK] = vec4<u32>(bitcast<vec3<u32>>(first), g);
    }
    near[at * NEAR_BLOCK + 1u + n] = bitcast<vec4<u32>>(vec4<f32>(node.xyz, select(mass, 0.0, is_behind(layer, first + local_of(n)))));
}
