//! Metal-like plasticity.

use barchan_material_kit::*;

/// Elastoplastic solid: Hencky elasticity, the yield criterion of von Mises, isochoric flow, linear isotropic hardening.
///
/// Stresses are bounded by ‖dev τ‖ ≤ √⅔ (σ_y + H κ) with the equivalent plastic strain κ; beyond, the deviator is returned
/// radially, which in Hencky strains is exact. σ_y = 0 (with H = 0) is a fluid that bears no shear, σ_y = ∞ Hencky's elastic solid.
///
/// Principal stretches below 10⁻⁴ are raised to that before the logarithm, counted as floored.
///
/// # Source
/// Simo and Hughes 1998, "Computational Inelasticity", box 3.1, in logarithmic strains (Simo 1992, eq. 4.6 ff.).
#[derive(Debug)]
pub struct VonMises;

/// Constants derived from the parameters.
#[derive(Clone, Copy, Debug)]
pub struct VonMisesLaw<T> {
    elastic: Lame<T>,
    /// √⅔ σ_y / 2μ: ‖dev ε‖ at first yield.
    yield_strain: T,
    /// √⅔ H / 2μ: its growth with κ.
    growth: T,
}

const SQRT_TWO_THIRDS: f64 = 0.816_496_580_927_726;

impl Material for VonMises {
    const NAME: &'static str = "von_mises";
    const DOC: &'static str = "Elastoplastic solid with von Mises yield and linear hardening: clay, plasticine, metal.";
    const REFERENCE: &'static str =
        "Simo and Hughes 1998, Computational Inelasticity, box 3.1; Simo 1992, doi:10.1016/0045-7825(92)90123-2";
    const PARAMS: &'static [Param] = &[
        young_modulus(1e6),
        poisson_ratio(0.3),
        param(
            "yield_stress",
            "Pa",
            1e4,
            0.0,
            f64::INFINITY,
            "Tensile yield stress σ_y; 0 is a fluid, inf an elastic solid.",
        )
        .log_scale()
        .differentiable(),
        param(
            "hardening_modulus",
            "Pa",
            0.0,
            0.0,
            1e13,
            "H: growth of the yield stress with the equivalent plastic strain.",
        )
        .differentiable(),
    ];
    const STATES: &'static [State] =
        &[state("equivalent_plastic_strain", "1", 0.0, "κ, the accumulated √⅔ ‖plastic strain increment‖.")];
    const WGSL: &'static str = include_str!("von_mises.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = VonMisesLaw<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> VonMisesLaw<T> {
        let elastic = Lame::new(params[0], params[1]);
        let to_strain = T::splat(0.5 * SQRT_TWO_THIRDS) / elastic.mu;
        VonMisesLaw { elastic, yield_strain: params[2] * to_strain, growth: params[3] * to_strain }
    }

    #[inline(always)]
    fn update<T: Real>(law: &VonMisesLaw<T>, x: MatIn<T, SymMat3<T>>, state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let one = T::one();
        let log = Hencky::of(x.strain);
        let deviator = log.strain.deviator();
        let norm = deviator.norm_squared().sqrt();
        // Plastic strain Δγ from ‖dev ε‖ − Δγ = yield strain at κ + √⅔ Δγ.
        let excess = norm - law.growth.mul_add(state[0], law.yield_strain);
        let yielding = excess.gt(T::zero());
        let flow = excess / law.growth.mul_add(T::splat(SQRT_TWO_THIRDS), one);
        let scale = T::select(yielding, one - flow / norm.max(T::splat(T::TINY)), one).max(T::zero());
        state[0] += T::select(yielding, T::splat(SQRT_TWO_THIRDS) * flow, T::zero());

        let trace = log.strain.trace();
        let changed = yielding | log.floored;
        let strain =
            if changed.any() { SymMat3::select(changed, log.rescaled(scale, trace), x.strain) } else { x.strain };
        let elastic = deviator.scale(scale).add_scalar(T::splat(1.0 / 3.0) * trace);
        let events = Events { yielding, floored: log.floored, ..Events::none() };
        MatOut { strain, kirchhoff: law.elastic.stress(elastic), events }
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &VonMisesLaw<T>, _b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        law.elastic.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &VonMisesLaw<T>, b: SymMat3<T>, _state: &[T]) -> T {
        law.elastic.energy(b)
    }
}
