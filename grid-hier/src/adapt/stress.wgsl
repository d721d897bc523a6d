// The stress of particles that have come in, from their strain. Where it is to stand they have their layers.
@compute @workgroup_size(128)
fn stress_of_new(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let i = (group.y * extent.row + group.x) * 128u + thread;
    if i >= step.count {
        return;
    }
    let q = step.first + i;
    layer_now = record_of(q, 5u).w;
    let mass = bitcast<f32>(record_of(q, 1u).w);
    deform(q, law_of(record_of(q, 0u).w), mass, held_by(q), mat3x3<f32>(), 0.0);
}
