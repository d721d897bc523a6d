// Which nodes are at the rims of regions, which node blocks rims hand something to, and which blocks are near them.
var<workgroup> slaves: array<atomic<u32>, 2>;
var<workgroup> known: atomic<u32>;
var<workgroup> gives: atomic<u32>;

// Do a block of the next finer layer's particles hand something on?
fn hands_on(layer: u32, finer: vec3<i32>) -> bool {
    let at = place_in_box(layer - 1u, finer);
    return at != NONE && directory[at].x != NONE && is_edge(layer - 1u, finer);
}

// Is the node of a cell at the rim? Then its spline reaches out of the region, and particles of the layer may give to it: when they are
// sorted they are up to SPLIT_AHEAD parent cells outside, drift by a cell, and touch the next cell's node.
fn is_slave(layer: u32, node: vec3<i32>) -> bool {
    // An image of such a node moves like it, or else takes its velocity later.
    if !MIRRORED && is_behind(layer, node) {
        return false;
    }
    let cell = before_mirrors(layer, node);
    if !holds(layer, cell, cell + vec3<i32>(1), 2 * SPLIT_AHEAD + 2) {
        return false;
    }
    if holds(layer, cell - vec3<i32>(1), cell + vec3<i32>(2), 0) {
        return false;
    }
    // Several boxes may hold them together.
    for (var n = 0u; n < 27u; n++) {
        let here = cell + offset_of(n);
        if !holds(layer, here, here + vec3<i32>(1), 0) {
            return true;
        }
    }
    return false;
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
            if !is_behind(layer, 4 * block + local_of(n)) {
                atomicOr(&known, HANDS_ON);
            }
        }
        @if(unbounded)
        find_edge(layer, block, n);
        let has_images = MIRRORED && has_nodes_behind(layer, 4 * block);
        if has_images {
            atomicOr(&known, IS_BEHIND);
        }
        if level_of(layer) > 0u {
            let finer = 2 * block - vec3<i32>(1) + local_of(n);
            if hands_on(layer, finer) {
                atomicOr(&known, IS_GIVEN);
            }
            if has_images {
                // Of the blocks with images of its nodes, and of its own.
                let one = before_mirrors(layer, 4 * block) >> vec3<u32>(2u);
                let other = before_mirrors(layer, 4 * block + vec3<i32>(3)) >> vec3<u32>(2u);
                let least = min(min(one, other), block);
                let size = vec3<u32>(2 * (max(max(one, other), block) - least) + vec3<i32>(4));
                for (var k = n; k < size.x * size.y * size.z; k += 64u) {
                    let from_least = vec3<i32>(vec3<u32>(k % size.x, k / size.x % size.y, k / (size.x * size.y)));
                    if hands_on(layer, 2 * least - vec3<i32>(1) + from_least) {
                        atomicOr(&known, IMAGES_GIVEN);
                    }
                }
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
            @if(unbounded)
            let at_edge = atomicLoad(&edge);
            @else
            let at_edge = 0u;
            let rim = vec4<u32>(atomicLoad(&slaves[0]), atomicLoad(&slaves[1]), atomicLoad(&known), at_edge);
            rims[w] = rim;
            let is_at_rim = any(rim.xy != vec2<u32>(0u));
            let layer = u32(lists[entry].w);
            let block = lists[entry].xyz;
            let hands_behind = is_at_rim && has_nodes_behind(layer + 1u, 2 * block - vec3<i32>(1));
            let is_taking = SUBCYCLED && (rim.z & (IS_GIVEN | IMAGES_GIVEN)) != 0u;
            var is_walled = hands_behind || rim.w != 0u || has_nodes_behind(layer, block * 4);
            if MIRRORED {
                // The others see to their mirrors by themselves.
                is_walled = (rim.z & IS_BEHIND) != 0u && !is_at_rim && !is_taking;
            }
            kinds |= (u32(is_at_rim) << AT_RIM) | (u32(is_taking) << TAKING) | (u32(is_walled) << WALLED);
        }
        if w < atomicLoad(&status[BLOCKS]) {
            let layer = u32(lists[w * ENTRY].w);
            let block = lists[w * ENTRY].xyz;
            rims[extent.node_room + w] = vec4<u32>(u32(is_near_edge(layer, block)), 0u, 0u, 0u);
            lists[w * ENTRY + OF_RIMS].w = i32(is_near_edge(layer, block));
            kinds |= (atomicLoad(&gives) << GIVING) | (u32(!MIRRORED && reaches_wall(layer, block * 4 - vec3<i32>(2))) << WALLED);
        }
        listed[place_in_list(LIST_KINDS, w)] = kinds;
    }
}
