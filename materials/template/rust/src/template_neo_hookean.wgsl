// tau = mu (b - I) + lambda ln J I. The twin of lib.rs on the GPU.
//
// A pure function of one particle, without bindings; every name at module scope starts with the material's. What it may use is in
// Barchan's backends/wgpu/src/prelude.wgsl. Strains come and go minus I.

fn template_neo_hookean_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let strain = barchan_sym(x.strain);
    let kirchhoff = barchan_affine(law.mu, strain, law.lambda * barchan_log_volume(strain));
    return MatOut(x.strain, barchan_mat(kirchhoff));
}
