// What walls have given since the last time, in all: [N s]. One workgroup a layer, each thread in the blocks' order.
var<workgroup> partial: array<vec4<f32>, 256>;

// What has been booked at an entry. It forgets that.
fn take(entry: u32) -> vec4<f32> {
    var sum = bitcast<vec4<f32>>(lists[entry + WALL]);
    lists[entry + WALL] = vec4<i32>(0);
    // The last step's gifts still wait for the next one, but for those of a step that was not done.
    @if(mirrored) {
        let done = select(NONE, atomicLoad(&status[HALT_STEP]), atomicLoad(&status[HALTED]) != 0u);
        if u32(lists[entry + PENDING].w) < done {
            sum += vec4<f32>(bitcast<vec3<f32>>(lists[entry + PENDING].xyz), 0.0);
        }
        lists[entry + PENDING] = vec4<i32>(0);
    }
    return sum;
}

@compute @workgroup_size(256)
fn collect(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var sum = vec4<f32>(0.0);
    let layer = group.x;
    var end = vec2<u32>(atomicLoad(&status[BLOCKS]), atomicLoad(&status[NODE_BLOCKS]));
    if layer + 1u < LAYERS {
        end.x = atomicLoad(&status[layer_word(layer + 1u, FIRST_BLOCK)]);
        end.y = atomicLoad(&status[layer_word(layer + 1u, FIRST_NODE_BLOCK)]);
    }
    for (var b = atomicLoad(&status[layer_word(layer, FIRST_BLOCK)]) + thread; b < end.x; b += 256u) {
        sum += take(b * ENTRY);
    }
    for (var g = atomicLoad(&status[layer_word(layer, FIRST_NODE_BLOCK)]) + thread; g < end.y; g += 256u) {
        sum += take((extent.block_room + g) * ENTRY);
    }
    partial[thread] = sum;
    workgroupBarrier();
    if thread == 0u {
        var all = vec4<f32>(0.0);
        for (var t = 0u; t < 256u; t++) {
            all += partial[t];
        }
        for (var d = 0u; d < 3u; d++) {
            let before = bitcast<f32>(atomicLoad(&status[sum_word(layer, WALL_IMPULSE + d)]));
            atomicStore(&status[sum_word(layer, WALL_IMPULSE + d)], bitcast<u32>(before + all[d]));
        }
    }
}
