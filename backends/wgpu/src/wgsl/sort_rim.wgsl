// Which nodes are at the rims of regions, which node blocks rims hand something to, and which blocks are near them.
var<workgroup> slaves: array<atomic<u32>, 2>;
var<workgroup> takes: atomic<u32>;

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
        if level_of(layer) > 0u {
            let finer = 2 * block - vec3<i32>(1) + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
            let at = place_in_box(layer - 1u, finer);
            if at != NONE && directory[at].x != NONE && is_edge(layer - 1u, finer) {
                atomicStore(&takes, 1u);
            }
        }
    }
    workgroupBarrier();
    if n == 0u {
        if w < atomicLoad(&status[NODE_BLOCKS]) {
            rims[w] = vec4<u32>(atomicLoad(&slaves[0]), atomicLoad(&slaves[1]), atomicLoad(&takes), 0u);
        }
        if w < atomicLoad(&status[BLOCKS]) {
            rims[extent.node_room + w] = vec4<u32>(u32(is_near_edge(u32(lists[w * ENTRY].w), lists[w * ENTRY].xyz)), 0u, 0u, 0u);
        }
    }
}
