//! A material plugin that fails on demand: what its parameter `fault` names goes wrong in `update`.

use barchan_material_kit::*;

/// τ = E (b − I), until it fails.
#[derive(Debug)]
pub struct Failing;

/// `fault`: the update panics, with a text longer than any host's buffer.
const PANICS: f64 = 1.0;
/// `fault`: stress is NaN where the ground is strained.
const NAN: f64 = 2.0;

impl Material for Failing {
    const NAME: &'static str = "failing";
    const DOC: &'static str = "A material that fails on demand.";
    const REFERENCE: &'static str = "none";
    const PARAMS: &'static [Param] = &[
        young_modulus(1e5),
        param("fault", "1", 0.0, 0.0, 2.0, "0: none, 1: panics in the update, 2: stress is NaN where strained."),
    ];
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = (T, T);

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> (T, T) {
        (params[0], params[1])
    }

    #[inline(always)]
    fn update<T: Real>(law: &(T, T), x: MatIn<T, SymMat3<T>>, _state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let near = |value: f64| (law.1 - T::splat(value)).abs().lt(T::splat(0.5));
        // Each character has two bytes, and there are more of them than a buffer of 512 bytes holds.
        assert!(!near(PANICS).any(), "ä{}", "ö".repeat(400));
        let excess = x.strain.add_scalar(-T::one());
        let strained = excess.norm_squared().gt(T::splat(1e-8)) & near(NAN);
        let modulus = T::select(strained, T::splat(f64::NAN), law.0);
        MatOut::new(x.strain, excess.scale(modulus))
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &(T, T), _b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        let two = law.0 + law.0;
        TangentModuli { p_wave: two, triple_bulk: two }
    }

    /// E/2 (tr b - 3 - ln det b): τ = E (b − I) derives from it.
    #[inline(always)]
    fn energy<T: Real>(law: &(T, T), b: SymMat3<T>, _state: &[T]) -> T {
        let (ln_j, _) = log_volume(b);
        T::splat(0.5) * law.0 * (b.add_scalar(-T::one()).trace() - ln_j - ln_j)
    }
}

export_materials!(Failing);
