// Drucker-Prager sand: Hencky elasticity, isochoric flow, volume correction. The twin of sand.rs.

// Greatest volume gap kept.
const sand_MAX_VOLUME_GAP: f32 = 0.5;

// The cone in strains: ||dev e|| <= slope (tip - tr e), and at tr e = 0 at most cohesion.
struct sand_Cone { slope: f32, cohesion: f32, tip: f32 }

fn sand_cone(base: u32) -> sand_Cone {
    let young = barchan_param(base, 0u);
    let nu = barchan_param(base, 1u);
    let angle = barchan_sin_cos(barchan_param(base, 2u));
    let c = barchan_param(base, 3u);
    // 3 alpha and k of both cones: matched in triaxial compression, or in simple shear.
    let is_triaxial = barchan_param(base, 4u) < 0.5;
    let triaxial = 4.8989797 / (3.0 - angle.x);
    let friction = select(1.4142135 * angle.x / angle.y, triaxial * angle.x, is_triaxial);
    let cohesion = select(1.4142135 * c, triaxial * c * angle.y, is_triaxial);
    let incompressibility = 1.0 - nu - nu;
    // Without friction the tip of a cohesive cone is at infinity; a millionth is as good.
    let tip = 3.0 * c * angle.y * incompressibility / (max(angle.x, 1e-6) * young);
    return sand_Cone(friction * (1.0 + nu) / (3.0 * incompressibility), cohesion * (1.0 + nu) / young, tip);
}

fn sand_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let cone = sand_cone(base);
    let correction = select(1.0, 0.0, barchan_param(base, 5u) < 0.5);
    let gap = (*q)[0] * correction;

    let eigen = barchan_eigen(barchan_sym(x.strain));
    let least = min(eigen.values.x, min(eigen.values.y, eigen.values.z));
    let floored = 1.0 + least < BARCHAN_MIN_STRETCH_SQUARED;
    let strain = barchan_principal_hencky(eigen.values);
    let sum = strain.x + strain.y + strain.z;
    let deviator = strain - vec3<f32>(sum * (1.0 / 3.0));
    let norm = length(deviator);
    // The gap is closed before pressure builds up.
    let trace = sum + gap;

    let apex = trace >= cone.tip;
    let limit = max(cone.cohesion - cone.slope * trace, 0.0);
    let yielding = norm > limit && !apex;
    let scale = select(select(1.0, limit / max(norm, 1e-30), yielding), 0.0, apex);
    let trace_kept = select(trace, cone.tip, apex);
    (*q)[0] = select(0.0, min((trace - cone.tip) * correction, sand_MAX_VOLUME_GAP), apex);

    let elastic = scale * deviator + vec3<f32>(trace_kept * (1.0 / 3.0));
    let kirchhoff = barchan_mat(barchan_compose(eigen, barchan_hencky_stress(law, elastic)));
    if apex || yielding || gap > 0.0 || floored {
        return MatOut(barchan_mat(barchan_compose(eigen, barchan_principal_strain(elastic))), kirchhoff);
    }
    return MatOut(x.strain, kirchhoff);
}
