// Brings strain up to where the particles are, and stress with it: after an upload.
@compute @workgroup_size(128)
fn stress_of_all(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let q = (group.y * extent.row + group.x) * 128u + thread;
    if q >= extent.particles {
        return;
    }
    layer_now = layer_of_particle(q);
    if !is_live(layer_now) {
        return;
    }
    let x = bitcast<vec4<f32>>(record_of(q, 2u)).yzw;
    let y = bitcast<vec4<f32>>(record_of(q, 3u)).yzw;
    let z = bitcast<vec4<f32>>(record_of(q, 4u)).yzw;
    let c = transpose(mat3x3<f32>(x, y, z));
    let mass = bitcast<f32>(record_of(q, 1u).w);
    // Subcycled, a coarser level lags by a longer step.
    deform(q, law_of(record_of(q, 0u).w), mass, held_by(q), c, step.dt * steps_of(layer_now));
}
