// What the ground that sleeps would have been given by gravity, and what falling asleep took, since the last time. One workgroup a layer, each
// thread in the blocks' order.
var<workgroup> slept: array<f32, 256>;
var<workgroup> lost: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn sum_sleep(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let layer = group.x;
    var end = atomicLoad(&status[BLOCKS]);
    if layer + 1u < LAYERS {
        end = atomicLoad(&status[layer_word(layer + 1u, FIRST_BLOCK)]);
    }
    var by_mass = 0.0;
    var by_motion = vec4<f32>(0.0);
    for (var b = atomicLoad(&status[layer_word(layer, FIRST_BLOCK)]) + thread; b < end; b += 256u) {
        book_sleep(b);
        by_mass += bitcast<f32>(atomicExchange(&watch[watch_word(b, SLEPT)], 0u));
        let fell = atomicExchange(&watch[watch_word(b, FELL)], 0u);
        if fell > 0u {
            atomicAdd(&status[sum_word(layer, SUM_FELL)], fell);
            for (var k = 0u; k < 4u; k++) {
                by_motion[k] += bitcast<f32>(atomicExchange(&watch[watch_word(b, LOST + k)], 0u));
            }
        }
    }
    slept[thread] = by_mass;
    lost[thread] = by_motion;
    workgroupBarrier();
    if thread == 0u {
        var all_mass = bitcast<f32>(atomicLoad(&status[sum_word(layer, SUM_SLEPT)]));
        var all_motion = vec4<f32>(0.0);
        for (var t = 0u; t < 256u; t++) {
            all_mass += slept[t];
            all_motion += lost[t];
        }
        atomicStore(&status[sum_word(layer, SUM_SLEPT)], bitcast<u32>(all_mass));
        for (var k = 0u; k < 4u; k++) {
            let word = sum_word(layer, SUM_LOST + k);
            atomicStore(&status[word], bitcast<u32>(bitcast<f32>(atomicLoad(&status[word])) + all_motion[k]));
        }
    }
}
