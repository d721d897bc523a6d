//! Compressible neo-Hookean solid.

use barchan_material_kit::*;

/// τ = μ (b − I) + λ ln J I on the left Cauchy–Green tensor b, ln J = ½ ln det b.
///
/// Energy ψ = ½ μ (tr b − 3 − 2 ln J) + ½ λ (ln J)². Where det b ≤ 10⁻²⁴ the logarithm is taken of 10⁻²⁴, and the particle
/// is counted as floored.
///
/// # Source
/// Bonet and Wood 2008, "Nonlinear Continuum Mechanics for Finite Element Analysis", eqs. 6.27 and 6.29.
#[derive(Debug)]
pub struct NeoHookean;

impl Material for NeoHookean {
    const NAME: &'static str = "neo_hookean";
    const DOC: &'static str = "Compressible neo-Hookean solid: rubber, gels and other soft solids at large strain.";
    const REFERENCE: &'static str =
        "Bonet and Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, eq. 6.29";
    const PARAMS: &'static [Param] = &[young_modulus(1e5), poisson_ratio(0.3)];
    const CAPABILITIES: u64 = BARCHAN_CAP_HARDENS;
    const WGSL: &'static str = include_str!("neo_hookean.wgsl");
    const WGSL_STIFFNESS: &'static str = include_str!("neo_hookean_stiffness.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = Lame<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> Lame<T> {
        Lame::new(params[0], params[1])
    }

    #[inline(always)]
    fn update<T: Real>(law: &Lame<T>, x: MatIn<T, SymMat3<T>>, _state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let b = x.strain;
        let (ln_j, floored) = log_volume(b);
        let kirchhoff = b.add_scalar(-T::one()).scale(law.mu).add_scalar(law.lambda * ln_j);
        MatOut { strain: b, kirchhoff, events: Events { floored, ..Events::none() } }
    }

    /// The stiffness along a stretched axis grows as μ b; 1 + ‖b − I‖ bounds b's greatest eigenvalue.
    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &Lame<T>, b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        let bound = T::one() + b.add_scalar(-T::one()).norm_squared().sqrt();
        Lame { mu: law.mu * bound, ..*law }.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &Lame<T>, b: SymMat3<T>, _state: &[T]) -> T {
        let (ln_j, _) = log_volume(b);
        let shape = b.add_scalar(-T::one()).trace() - ln_j - ln_j;
        T::splat(0.5) * (law.mu * shape + law.lambda * ln_j * ln_j)
    }
}
