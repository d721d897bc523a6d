// How many steps a second particles whose stiffness follows their state need; stiffness.rs of the core says why.

// What the particle that was worked on last needs [1/s], as the bits of a float; NaN where its law gives moduli that bound no step.
var<private> need_now: u32;

// A particle of that mass and rest volume.
fn need_of(s: Stiffness, mass: f32, volume: f32) -> u32 {
    let per_h = shrink_of(layer_now) / extent.world.cell;
    let scale = volume / mass * per_h * per_h;
    let a = max(s.triple_bulk, s.p_wave) * scale;
    let half_v = 2.0 * s.viscosity * scale;
    let is_valid = s.p_wave > 0.0 && s.triple_bulk > 0.0 && s.viscosity >= 0.0;
    return select(0x7fc00000u, magnitude_bits(half_v + sqrt(half_v * half_v + a)), is_valid);
}
