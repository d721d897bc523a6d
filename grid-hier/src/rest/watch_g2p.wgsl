
// The first particle's block, and was any of its particles here fast?
var<workgroup> first_block: u32;
var<workgroup> is_fast: atomic<u32>;

// Notes how fast a particle of a block awake is.
fn note_speed(b: u32, v: vec3<f32>) {
    // NaN is fast. So is all while gravity grows.
    let grows = GRAVITY_GROWS && bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)])) < 1.0;
    // As `slow_in` of `rest.rs`: in short steps less is slow, for whatever falls becomes fast.
    let fallen = FALLS * length(step.gravity) * steps_of(layer_now);
    let slow = select(SLOW, min(SLOW, fallen), fallen > 0.0);
    let bits = select(STEPPED | FAST, STEPPED, all(abs(v) <= vec3<f32>(slow)) && !grows);
    if b != first_block {
        note_happened(b, bits);
    } else if bits != STEPPED {
        atomicStore(&is_fast, 1u);
    }
}
