// The twin of Liquid's tangent_moduli and viscosity.

fn liquid_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let modulus = barchan_param(base, 0u);
    let exponent = barchan_param(base, 1u);
    let ln_j = barchan_log_volume(barchan_sym(strain));
    let j = barchan_exp(ln_j);
    let power = exponent - 1.0;
    let bulk = max(modulus / exponent * (power * barchan_exp(-power * ln_j) + j), modulus);
    return Stiffness(bulk, 3.0 * bulk, barchan_param(base, 2u) * j);
}
