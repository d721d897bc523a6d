// What the particles gave that have left the world, in all: impulse [N s] and mass [kg]. One workgroup a layer, each thread in the blocks'
// order.
var<workgroup> sums_left: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn sum_left(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let layer = group.x;
    var end = atomicLoad(&status[BLOCKS]);
    if layer + 1u < LAYERS {
        end = atomicLoad(&status[layer_word(layer + 1u, FIRST_BLOCK)]);
    }
    var sum = vec4<f32>(0.0);
    if !halted() {
        for (var b = atomicLoad(&status[layer_word(layer, FIRST_BLOCK)]) + thread; b < end; b += 256u) {
            sum += bitcast<vec4<f32>>(lists[b * ENTRY + PENDING]);
        }
    }
    sums_left[thread] = sum;
    workgroupBarrier();
    if thread == 0u {
        var all = vec4<f32>(0.0);
        for (var t = 0u; t < 256u; t++) {
            all += sums_left[t];
        }
        for (var d = 0u; d < 4u; d++) {
            let word = sum_word(layer, LEFT_IMPULSE + d);
            atomicStore(&status[word], bitcast<u32>(bitcast<f32>(atomicLoad(&status[word])) + all[d]));
        }
    }
}
