//! Drucker–Prager sand.

use barchan_material_kit::*;
use core::f64::consts::{FRAC_PI_2, FRAC_PI_4, SQRT_2};

/// Elastoplastic sand: Hencky elasticity, the cone of Drucker and Prager, isochoric flow.
///
/// With ε = ½ ln b_e and p = −(λ + ⅔ μ) tr ε, stresses are bounded by ‖dev τ‖ ≤ 3α p + k. Beyond the cone the deviator is
/// shrunk back to it at constant volume; beyond its tip the particle is set on the tip and bears nothing but what
/// cohesion holds.
///
/// The cone, by the parameter `cone`:
/// - 0: matched to Mohr and Coulomb in triaxial compression, 3α = √⅔ · 6 sin φ / (3 − sin φ) and k = √⅔ · 6 c cos φ / (3 − sin φ).
///   Stronger than φ in other paths: for φ ≥ 42.2° there is no shear failure in plane strain at all.
/// - 1: matched in simple shear, so that shear stress over normal stress is tan φ: 3α = √2 tan φ and k = √2 c.
///
/// **Volume correction** (parameter `volume_correction`, on by default): the volume that a particle gains beyond the tip, as
/// a logarithm v_c, is kept in the state `volume_gap` and must be closed before pressure builds up again. Without it each
/// cycle of opening and closing leaves extra pressure. v_c is at most 0.5 (a density of 61 % of that at rest), counted as clamped
/// beyond: what is looser flies apart as a gas does, and a particle that had its gap grow without bound in free
/// flight would land without ever bearing load.
///
/// Principal stretches below 10⁻⁴ are raised to that before the logarithm, counted as floored.
///
/// # Source
/// Klar et al. 2016, "Drucker–Prager elastoplasticity for sand animation", eqs. 20 to 29; Tampubolon et al. 2017,
/// "Multi-species simulation of porous sand and water mixtures", section 4.3.4 (volume correction). We add v_c/3 to each
/// principal strain, so that the deviator stays traceless.
#[derive(Debug)]
pub struct Sand;

/// Greatest v_c kept.
const MAX_VOLUME_GAP: f64 = 0.5;

/// Constants derived from the parameters.
#[derive(Clone, Copy, Debug)]
pub struct SandLaw<T> {
    elastic: Lame<T>,
    /// Slope of the cone in strains: ‖dev ε‖ ≤ slope · (tip − tr ε).
    slope: T,
    /// k / 2μ, the bound on ‖dev ε‖ at tr ε = 0.
    cohesion: T,
    /// tr ε at the cone's tip.
    tip: T,
    /// 1 if the volume correction is on, 0 if not.
    correction: T,
}

/// sin and cos on [0, π/2] by Taylor's series.
#[inline(always)]
fn sin_cos<T: Real>(x: T) -> (T, T) {
    let z = x * x;
    let (mut sin, mut cos) = (T::one(), T::one());
    // The first omitted terms are below 2⁻²⁴ and 2⁻⁵³.
    let terms = if T::EPSILON > 1e-10 { 6 } else { 10 };
    for k in (1..=terms).rev() {
        let k = f64::from(k);
        sin = (sin * z).mul_add(T::splat(-1.0 / (2.0 * k * (2.0 * k + 1.0))), T::one());
        cos = (cos * z).mul_add(T::splat(-1.0 / (2.0 * k * (2.0 * k - 1.0))), T::one());
    }
    (x * sin, cos)
}

impl Material for Sand {
    const NAME: &'static str = "sand";
    const DOC: &'static str =
        "Dry or cohesive sand: Hencky elasticity with a Drucker-Prager cone, isochoric flow and volume correction.";
    const REFERENCE: &'static str =
        "Klar et al. 2016, doi:10.1145/2897824.2925906; Tampubolon et al. 2017, doi:10.1145/3072959.3073651";
    const PARAMS: &'static [Param] = &[
        young_modulus(1e6),
        poisson_ratio(0.2),
        param(
            "friction_angle",
            "rad",
            FRAC_PI_4,
            0.0,
            FRAC_PI_2,
            "Angle of internal friction; what it means in which path, 'cone' says.",
        )
        .max_open()
        .differentiable(),
        param("cohesion", "Pa", 0.0, 0.0, 1e9, "Shear strength at zero pressure, c of Mohr and Coulomb.")
            .differentiable(),
        param(
            "cone",
            "1",
            0.0,
            0.0,
            1.0,
            "0: cone matched in triaxial compression (Klar et al.); 1: in simple shear. Cut at 0.5.",
        ),
        param(
            "volume_correction",
            "1",
            1.0,
            0.0,
            1.0,
            "1: volume gained in tension must be closed before pressure builds up; 0: it is forgotten. Cut at 0.5.",
        ),
    ];
    const STATES: &'static [State] =
        &[state("volume_gap", "1", 0.0, "Logarithm of the volume gained beyond the tip of the cone, v_c.")];
    const WGSL: &'static str = include_str!("sand.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = SandLaw<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> SandLaw<T> {
        let (sin, cos) = sin_cos(params[2]);
        let c = params[3];
        // 3α and k of both cones; both have their tip at the pressure -c cot φ.
        let triaxial = T::splat((2.0f64 / 3.0).sqrt() * 6.0) / (T::splat(3.0) - sin);
        let shear = T::splat(SQRT_2);
        let is_triaxial = params[4].lt(T::splat(0.5));
        let friction = T::select(is_triaxial, triaxial * sin, shear * sin / cos);
        let cohesion = T::select(is_triaxial, triaxial * c * cos, shear * c);
        // 1/2μ = (1 + nu)/E and 3λ + 2μ = E/(1 − 2 nu), written out to keep the chain of divisions short.
        let (young, nu) = (params[0], params[1]);
        let one = T::one();
        let incompressibility = one - nu - nu;
        let compliance = (one + nu) / young;
        // Without friction the tip of a cohesive cone is at infinity; a millionth is as good.
        let tip = T::splat(3.0) * c * cos * incompressibility / (sin.max(T::splat(1e-6)) * young);
        SandLaw {
            elastic: Lame::new(young, nu),
            slope: T::splat(1.0 / 3.0) * friction * (one + nu) / incompressibility,
            cohesion: cohesion * compliance,
            tip,
            correction: T::select(params[5].lt(T::splat(0.5)), T::zero(), one),
        }
    }

    #[inline(always)]
    fn update<T: Real>(law: &SandLaw<T>, x: MatIn<T, SymMat3<T>>, state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let zero = T::zero();
        let gap = state[0] * law.correction;
        let log = Hencky::of(x.strain);
        let deviator = log.strain.deviator();
        // The gap is closed before pressure builds up.
        let trace = log.strain.trace() + gap;
        let norm = deviator.norm_squared().sqrt();

        let apex = trace.ge(law.tip);
        let limit = (-law.slope).mul_add(trace, law.cohesion).max(zero);
        let yielding = norm.gt(limit) & !apex;
        let scale = T::select(yielding, limit / norm.max(T::splat(T::TINY)), T::one());
        let scale = T::select(apex, zero, scale);
        let trace_kept = T::select(apex, law.tip, trace);
        let opened = (trace - law.tip) * law.correction;
        let greatest = T::splat(MAX_VOLUME_GAP);
        let clamped = apex & opened.gt(greatest);
        state[0] = T::select(apex, opened.min(greatest), zero);

        let changed = apex | yielding | gap.gt(zero) | log.floored;
        let strain =
            if changed.any() { SymMat3::select(changed, log.rescaled(scale, trace_kept), x.strain) } else { x.strain };
        let elastic = deviator.scale(scale).add_scalar(T::splat(1.0 / 3.0) * trace_kept);
        let events = Events { yielding, apex, floored: log.floored, clamped };
        MatOut { strain, kirchhoff: law.elastic.stress(elastic), events }
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &SandLaw<T>, _b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        law.elastic.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &SandLaw<T>, b: SymMat3<T>, _state: &[T]) -> T {
        law.elastic.energy(b)
    }
}
