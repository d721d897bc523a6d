// The twin of NeoHookean's tangent_moduli.

fn neo_hookean_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let bound = 1.0 + sqrt(barchan_norm2(barchan_sym(strain)));
    return barchan_stiffness(Lame(law.lambda, law.mu * bound));
}
