
// The first particle's block, and was any of its particles here fast?
var<workgroup> first_block: u32;
var<workgroup> is_fast: atomic<u32>;

// Notes how fast a particle of a block awake is.
fn note_speed(b: u32, v: vec3<f32>) {
    // NaN is fast. So is all while gravity grows.
    let grows = GRAVITY_GROWS && bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)])) < 1.0;
    let bits = select(STEPPED | FAST, STEPPED, all(abs(v) <= vec3<f32>(SLOW)) && !grows);
    if b != first_block {
        note_happened(b, bits);
    } else if bits != STEPPED {
        atomicStore(&is_fast, 1u);
    }
}
