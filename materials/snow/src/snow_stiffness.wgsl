// The twin of Snow's tangent_moduli.

fn snow_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let elastic = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let factor = barchan_exp(min(barchan_param(base, 4u) * (1.0 - (*q)[0]), barchan_log(barchan_param(base, 5u))));
    return barchan_stiffness(Lame(factor * elastic.lambda, factor * elastic.mu));
}
