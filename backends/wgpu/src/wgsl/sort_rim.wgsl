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
        if is_slave(layer, 4 * block + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u))) {
            atomicOr(&slaves[n >> 5u], 1u << (n & 31u));
        }
        $FIND
        if level_of(layer) > 0u {
            let finer = 2 * block - vec3<i32>(1) + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
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
        if w < atomicLoad(&status[NODE_BLOCKS]) {
            rims[w] = vec4<u32>(atomicLoad(&slaves[0]), atomicLoad(&slaves[1]), atomicLoad(&takes), $EDGE);
        }
        if w < atomicLoad(&status[BLOCKS]) {
            rims[extent.node_room + w] = vec4<u32>(u32(is_near_edge(u32(lists[w * ENTRY].w), lists[w * ENTRY].xyz)), 0u, 0u, 0u);
            lists[w * ENTRY + NEAR_SHARED].w = i32(atomicLoad(&gives));
        }
    }
}
