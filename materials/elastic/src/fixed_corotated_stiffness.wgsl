// The twin of FixedCorotated's tangent_moduli.

fn fixed_corotated_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let square = 1.0 + sqrt(barchan_norm2(barchan_left_cauchy_green(strain)));
    let volume = max(abs(1.0 + barchan_det1p_mat(strain)), 1.0);
    let shear = 2.0 * square - sqrt(square);
    let bulk = volume * (2.0 * volume - 1.0);
    return barchan_stiffness(Lame(max(law.lambda, law.lambda * bulk), law.mu * shear));
}
