// Newtonian liquid with Tait's equation of state: tau = -J p I + 2 eta J dev D, p = K/gamma (J^-gamma - 1). The twin of liquid.rs.

fn liquid_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let exponent = barchan_param(base, 1u);
    let stiffness = barchan_param(base, 0u) / exponent;
    let viscosity = barchan_param(base, 2u);

    let ln_j = barchan_log_volume(barchan_sym(x.strain));
    let volume_change = barchan_expm1(ln_j);
    let minus_jp = stiffness * (volume_change - barchan_expm1((1.0 - exponent) * ln_j));
    let rate = barchan_deviator(barchan_sym(0.5 * (x.vel_grad + transpose(x.vel_grad))));
    let kirchhoff = barchan_affine(2.0 * viscosity * (1.0 + volume_change), rate, minus_jp);
    // Shear is forgotten.
    let strain = Sym(vec3<f32>(barchan_expm1((2.0 / 3.0) * ln_j)), vec3<f32>(0.0));
    return MatOut(barchan_mat(strain), barchan_mat(kirchhoff));
}
