// Fixed corotated solid: tau = 2 mu (V^2 - V) + lambda (J - 1) J I of F = V R with a proper rotation R. The twin of
// fixed_corotated.rs.

fn fixed_corotated_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let volume_change = barchan_det1p_mat(x.strain);
    let j = 1.0 + volume_change;
    let eigen = barchan_eigen(barchan_left_cauchy_green(x.strain));
    let change = eigen.values;

    // s^2 - s of each principal stretch s, from s^2 - 1.
    let s = sqrt(max(change + vec3<f32>(1.0), vec3<f32>(0.0)));
    var excess = s * change / (s + vec3<f32>(1.0));
    // Of a particle that is squashed or inverted, the least stretch is J over the other two: it keeps its digits, and its sign
    // turns the particle back through the flat state.
    let least = min(change.x, min(change.y, change.z));
    if j < 0.5 || least < -0.5 {
        if change.x == least {
            let t = j / max(s.y * s.z, 1e-12);
            excess.x = t * t - t;
        } else if change.y == least {
            let t = j / max(s.x * s.z, 1e-12);
            excess.y = t * t - t;
        } else {
            let t = j / max(s.x * s.y, 1e-12);
            excess.z = t * t - t;
        }
    }
    let stress = 2.0 * law.mu * excess + vec3<f32>(law.lambda * volume_change * j);
    return MatOut(x.strain, barchan_mat(barchan_compose(eigen, stress)));
}
