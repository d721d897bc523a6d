// Numbers the blocks in the order of the directory, and writes where they are.
@compute @workgroup_size(256)
fn number(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let w = group.y * extent.row + group.x;
    let layer = layer_at(w * 1024u);
    let end = layers[layer].first_place + layers[layer].places;
    var here: array<vec2<u32>, 4>;
    var count = vec2<u32>(0u);
    for (var k = 0u; k < 4u; k++) {
        let at = w * 1024u + thread * 4u + k;
        here[k] = vec2<u32>(0u);
        if at < end {
            here[k] = directory[at];
        }
        count += here[k];
    }
    let before = sums_of(thread, count).before;
    if halted() {
        return;
    }
    var next = sums[w];
    if thread == 0u && w * 1024u == layers[layer].first_place {
        atomicStore(&status[layer_word(layer, FIRST_BLOCK)], next.x);
        atomicStore(&status[layer_word(layer, FIRST_NODE_BLOCK)], next.y);
    }
    next += before;
    for (var k = 0u; k < 4u; k++) {
        let at = w * 1024u + thread * 4u + k;
        if at < end {
            let block = block_at(layer, at);
            if here[k].x != 0u {
                lists[next.x * ENTRY] = vec4<i32>(block, i32(layer));
                lists[next.x * ENTRY + WALL] = vec4<i32>(0);
                lists[next.x * ENTRY + PENDING] = vec4<i32>(0);
                for (var d = 0u; d < 3u; d++) {
                    atomicMin(&status[layer_word(layer, LEAST_BLOCK + d)], u32(block[d] + BIAS));
                    atomicMax(&status[layer_word(layer, GREATEST_BLOCK + d)], u32(block[d] + BIAS));
                }
            }
            if here[k].y != 0u {
                let entry = (extent.block_room + next.y) * ENTRY;
                lists[entry] = vec4<i32>(block, i32(layer));
                lists[entry + WALL] = vec4<i32>(0);
                lists[entry + PENDING] = vec4<i32>(0);
            }
            directory[at] = select(vec2<u32>(NONE), next, here[k] != vec2<u32>(0u));
            next += here[k];
        }
    }
}
