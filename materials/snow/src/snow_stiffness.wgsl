// The twin of Snow's tangent_moduli.

fn snow_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let elastic = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let factor = barchan_exp(min(barchan_param(base, 4u) * (1.0 - (*q)[0]), barchan_log(barchan_param(base, 5u))));
    if 1.0 + barchan_param(base, 3u) <= 1.01 {
        return barchan_stiffness(Lame(factor * elastic.lambda, factor * elastic.mu));
    }
    let b = barchan_sym(strain);
    let above_mean = sqrt((2.0 / 3.0) * barchan_norm2(barchan_deviator(b)));
    let square = max(1.0 + barchan_trace(b) * (1.0 / 3.0) + above_mean, 1.0);
    let volume = sqrt(max(1.0 + barchan_det1p(b), 0.0));
    let shear = 2.0 * square - sqrt(square);
    let bulk = volume * (2.0 * volume - 1.0);
    return barchan_stiffness(Lame(factor * max(elastic.lambda, elastic.lambda * bulk), factor * elastic.mu * shear));
}
