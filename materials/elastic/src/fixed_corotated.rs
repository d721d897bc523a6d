//! Fixed corotated solid.

use barchan_material_kit::*;

/// τ = 2μ (F − R) Fᵀ + λ (J − 1) J I on the deformation gradient F = V R: 2μ (V² − V) + λ (J − 1) J I.
///
/// Energy ψ = μ ‖V − I‖² + ½ λ (J − 1)². The rotation R is proper, so an inverted particle (det F < 0) has one negative
/// principal stretch and is pushed back through the flat state; nothing is floored.
///
/// # Source
/// Stomakhin et al. 2012, "Energetically consistent invertible elasticity", eq. 8; Jiang et al. 2016, MPM course notes, eq. 50.
#[derive(Debug)]
pub struct FixedCorotated;

impl Material for FixedCorotated {
    const NAME: &'static str = "fixed_corotated";
    const DOC: &'static str = "Fixed corotated solid: linear in the stretch, finite when flat or inverted; what many MPM codes call elastic or jelly.";
    const REFERENCE: &'static str = "Stomakhin et al. 2012, Energetically consistent invertible elasticity, eq. 8";
    const PARAMS: &'static [Param] = &[young_modulus(1e5), poisson_ratio(0.3)];
    const CAPABILITIES: u64 = BARCHAN_CAP_HARDENS;
    const WGSL: &'static str = include_str!("fixed_corotated.wgsl");
    const WGSL_STIFFNESS: &'static str = include_str!("fixed_corotated_stiffness.wgsl");
    type Strain<T: Real> = Mat3<T>;
    type Law<T: Real> = Lame<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> Lame<T> {
        Lame::new(params[0], params[1])
    }

    #[inline(always)]
    fn update<T: Real>(law: &Lame<T>, x: MatIn<T, Mat3<T>>, _state: &mut [T]) -> MatOut<T, Mat3<T>> {
        let f = x.strain;
        let j = f.determinant();
        let stretch = left_stretch(f);
        let pressure = law.lambda * (j - T::one()) * j;
        let kirchhoff = (f.times_transpose() - stretch).scale(law.mu + law.mu).add_scalar(pressure);
        MatOut::new(f, kirchhoff)
    }

    /// Along an axis of stretch s the stiffness is 2μ (2s² − s) + λ (2J² − J); m = 1 + ‖b − I‖ bounds s², and J² ≤ m³.
    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &Lame<T>, f: Mat3<T>, _state: &[T]) -> TangentModuli<T> {
        let one = T::one();
        let square = one + f.times_transpose().add_scalar(-one).norm_squared().sqrt();
        let volume = f.determinant().abs().max(one);
        let shear = square + square - square.sqrt();
        let bulk = volume * (volume + volume - one);
        // Negative in an auxetic solid: stretched, it would take away from the bound what the shear adds.
        let lambda = law.lambda.max(law.lambda * bulk);
        Lame { lambda, mu: law.mu * shear }.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &Lame<T>, f: Mat3<T>, _state: &[T]) -> T {
        let compression = f.determinant() - T::one();
        let shape = left_stretch(f).add_scalar(-T::one()).norm_squared();
        law.mu.mul_add(shape, T::splat(0.5) * law.lambda * compression * compression)
    }
}
