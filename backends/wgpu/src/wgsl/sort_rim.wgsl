// Which nodes are at the rims of regions, which node blocks rims hand something to, and which blocks are near them.
var<workgroup> slaves: array<atomic<u32>, 2>;
var<workgroup> takes: atomic<u32>;
var<workgroup> gives: atomic<u32>;

// Do a block of the next finer layer's particles hand something on?
fn hands_on(layer: u32, finer: vec3<i32>) -> bool {
    let at = place_in_box(layer - 1u, finer);
    return at != NONE && directory[at].x != NONE && is_edge(layer - 1u, finer);
}

@compute @workgroup_size(64)
fn find_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let w = group.y * extent.row + group.x;
    if halted() {
        return;
    }
    let entry = (extent.block_room + w) * ENTRY;
    if w < atomicLoad(&status[NODE_BLOCKS]) {
        let layer = u32(lists[entry].w);
        let block = lists[entry].xyz;
        if is_slave(layer, 4 * block + local_of(n)) {
            atomicOr(&slaves[n >> 5u], 1u << (n & 31u));
        }
        $FIND
        if level_of(layer) > 0u {
            let finer = 2 * block - vec3<i32>(1) + local_of(n);
            if hands_on(layer, finer) {
                atomicStore(&takes, 1u);
            }
        }
    }
    if SUBCYCLED && w < atomicLoad(&status[BLOCKS]) && level_of(u32(lists[w * ENTRY].w)) > 0u {
        // Of any of the blocks of nodes around, which take part from one before to two behind their own place.
        for (var k = n; k < 512u; k += 64u) {
            let finer = 2 * lists[w * ENTRY].xyz - vec3<i32>(3) + vec3<i32>(i32(k >> 6u), i32((k >> 3u) & 7u), i32(k & 7u));
            if hands_on(u32(lists[w * ENTRY].w), finer) {
                atomicStore(&gives, 1u);
            }
        }
    }
    workgroupBarrier();
    if n == 0u {
        var kinds = 0u;
        if w < atomicLoad(&status[NODE_BLOCKS]) {
            let rim = vec4<u32>(atomicLoad(&slaves[0]), atomicLoad(&slaves[1]), atomicLoad(&takes), $EDGE);
            rims[w] = rim;
            let is_at_rim = any(rim.xy != vec2<u32>(0u));
            let layer = u32(lists[entry].w);
            let block = lists[entry].xyz;
            let hands_behind = is_at_rim && has_nodes_behind(layer + 1u, 2 * block - vec3<i32>(1));
            let is_walled = hands_behind || rim.w != 0u || has_nodes_behind(layer, block * 4);
            kinds |= (u32(is_at_rim || (SUBCYCLED && rim.z != 0u)) << AT_RIM) | (u32(is_walled) << WALLED);
        }
        if w < atomicLoad(&status[BLOCKS]) {
            let layer = u32(lists[w * ENTRY].w);
            let block = lists[w * ENTRY].xyz;
            rims[extent.node_room + w] = vec4<u32>(u32(is_near_edge(layer, block)), 0u, 0u, 0u);
            lists[w * ENTRY + OF_RIMS].w = i32(is_near_edge(layer, block));
            kinds |= (atomicLoad(&gives) << GIVING) | (u32(reaches_wall(layer, block * 4 - vec3<i32>(2))) << WALLED);
        }
        listed[place_in_list(LIST_KINDS, w)] = kinds;
    }
}
