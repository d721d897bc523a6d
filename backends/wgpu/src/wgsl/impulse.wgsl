// The impulse on each body, summed over the node blocks in their order. One workgroup a layer and body.
var<workgroup> forces: array<vec4<f32>, 256>;
var<workgroup> torques: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn impulse_on_bodies(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let layer = group.x / BODIES;
    let b = group.x % BODIES;
    if !is_live(layer) {
        return;
    }
    var force = vec4<f32>(0.0);
    var torque = vec4<f32>(0.0);
    var end = atomicLoad(&status[NODE_BLOCKS]);
    if layer + 1u < LAYERS {
        end = atomicLoad(&status[layer_word(layer + 1u, FIRST_NODE_BLOCK)]);
    }
    for (var g = atomicLoad(&status[layer_word(layer, FIRST_NODE_BLOCK)]) + thread; g < end; g += 256u) {
        force += partials[(g * BODIES + b) * 2u];
        torque += partials[(g * BODIES + b) * 2u + 1u];
    }
    forces[thread] = force;
    torques[thread] = torque;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half = half >> 1u) {
        if thread < half {
            forces[thread] += forces[thread + half];
            torques[thread] += torques[thread + half];
        }
        workgroupBarrier();
    }
    if thread == 0u {
        impulses[((slot_now() * LAYERS + layer) * BODIES + b) * 2u] = forces[0];
        impulses[((slot_now() * LAYERS + layer) * BODIES + b) * 2u + 1u] = torques[0];
    }
}
