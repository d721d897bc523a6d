// Elastoplastic solid: Hencky elasticity, von Mises yield, linear isotropic hardening. The twin of von_mises.rs.

const von_mises_SQRT_TWO_THIRDS: f32 = 0.81649658;

fn von_mises_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let to_strain = 0.5 * von_mises_SQRT_TWO_THIRDS / law.mu;
    // A yield stress may be infinite, which WGSL may not compute with.
    let yield_strain = min(barchan_param(base, 2u), 1e30) * to_strain;
    let growth = barchan_param(base, 3u) * to_strain;

    let eigen = barchan_eigen(barchan_sym(x.strain));
    let least = min(eigen.values.x, min(eigen.values.y, eigen.values.z));
    let floored = 1.0 + least < BARCHAN_MIN_STRETCH_SQUARED;
    let strain = barchan_principal_hencky(eigen.values);
    let mean = (strain.x + strain.y + strain.z) * (1.0 / 3.0);
    let deviator = strain - vec3<f32>(mean);
    let norm = length(deviator);

    // Plastic strain from ||dev e|| - flow = yield strain at kappa + sqrt(2/3) flow.
    let excess = norm - (growth * (*q)[0] + yield_strain);
    let yielding = excess > 0.0;
    let flow = excess / (growth * von_mises_SQRT_TWO_THIRDS + 1.0);
    let scale = select(1.0, max(1.0 - flow / max(norm, 1e-30), 0.0), yielding);
    (*q)[0] += select(0.0, von_mises_SQRT_TWO_THIRDS * flow, yielding);

    let elastic = scale * deviator + vec3<f32>(mean);
    let kirchhoff = barchan_mat(barchan_compose(eigen, barchan_hencky_stress(law, elastic)));
    if yielding || floored {
        return MatOut(barchan_mat(barchan_compose(eigen, barchan_principal_strain(elastic))), kirchhoff);
    }
    return MatOut(x.strain, kirchhoff);
}
