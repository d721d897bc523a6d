// Hencky's solid: tau = 2 mu e + lambda tr(e) I with e = ln(b) / 2. The twin of hencky.rs.

fn hencky_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let eigen = barchan_eigen(barchan_sym(x.strain));
    let stress = barchan_hencky_stress(law, barchan_principal_hencky(eigen.values));
    return MatOut(x.strain, barchan_mat(barchan_compose(eigen, stress)));
}
