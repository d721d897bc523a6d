// Snow: fixed corotated elasticity whose principal stretches are kept in [1 - theta_c, 1 + theta_s], hardening as it is packed. The
// twin of snow.rs.

const snow_LEAST_PLASTIC_VOLUME: f32 = 0.05;
const snow_GREATEST_PLASTIC_VOLUME: f32 = 20.0;

fn snow_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let elastic = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let least = -barchan_param(base, 2u);
    let greatest = barchan_param(base, 3u);
    let hardening = barchan_param(base, 4u);
    let hardening_max_log = barchan_log(barchan_param(base, 5u));

    let eigen = barchan_eigen(barchan_sym(x.strain));
    // Principal stretches minus 1, from b - I.
    let squared = max(eigen.values + vec3<f32>(1.0), vec3<f32>(BARCHAN_MIN_STRETCH_SQUARED));
    let tried = max(eigen.values, vec3<f32>(-1.0)) / (sqrt(squared) + vec3<f32>(1.0));
    let kept = clamp(tried, vec3<f32>(least), vec3<f32>(greatest));
    let yielding = any(kept != tried);

    let lost = (vec3<f32>(1.0) + tried) / (vec3<f32>(1.0) + kept);
    let plastic_volume = select((*q)[0], (*q)[0] * lost.x * lost.y * lost.z, yielding);
    (*q)[0] = clamp(plastic_volume, snow_LEAST_PLASTIC_VOLUME, snow_GREATEST_PLASTIC_VOLUME);
    let factor = barchan_exp(min(hardening * (1.0 - (*q)[0]), hardening_max_log));

    // V^2 - V and J - 1.
    let excess = kept * (vec3<f32>(1.0) + kept);
    let minors = kept.x * kept.y + kept.x * kept.z + kept.y * kept.z;
    let volume_change = kept.x + kept.y + kept.z + minors + kept.x * kept.y * kept.z;
    let stress = 2.0 * elastic.mu * excess + vec3<f32>(elastic.lambda * volume_change * (1.0 + volume_change));
    let kirchhoff = barchan_mat(barchan_compose(eigen, factor * stress));
    if yielding {
        return MatOut(barchan_mat(barchan_compose(eigen, kept * (vec3<f32>(2.0) + kept))), kirchhoff);
    }
    return MatOut(x.strain, kirchhoff);
}
