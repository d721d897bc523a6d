// Compressible neo-Hookean solid: tau = mu (b - I) + lambda ln J I. The twin of neo_hookean.rs.

fn neo_hookean_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let strain = barchan_sym(x.strain);
    let kirchhoff = barchan_affine(law.mu, strain, law.lambda * barchan_log_volume(strain));
    return MatOut(x.strain, barchan_mat(kirchhoff));
}
