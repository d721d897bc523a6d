//! Hencky's solid.

use barchan_material_kit::*;

/// τ = 2μ ε + λ tr(ε) I of the Hencky strain ε = ½ ln b: linear in ε, so superposed volume changes add up and tension
/// and compression are alike.
///
/// Energy ψ = μ ‖ε‖² + ½ λ tr(ε)². Principal stretches below 10⁻⁴ are raised to that and counted as floored.
///
/// # Source
/// Hencky 1928; Klar et al. 2016, "Drucker–Prager elastoplasticity for sand animation", eq. 20 is the same energy.
#[derive(Debug)]
pub struct HenckyElastic;

impl Material for HenckyElastic {
    const NAME: &'static str = "hencky";
    const DOC: &'static str =
        "Hencky solid: linear elasticity in the logarithmic strain, the elastic part of sand and metal.";
    const REFERENCE: &'static str =
        "Hencky 1928, Z. techn. Phys. 9, 215; Klar et al. 2016, doi:10.1145/2897824.2925906";
    const PARAMS: &'static [Param] = &[young_modulus(1e5), poisson_ratio(0.3)];
    const WGSL: &'static str = include_str!("hencky.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = Lame<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> Lame<T> {
        Lame::new(params[0], params[1])
    }

    #[inline(always)]
    fn update<T: Real>(law: &Lame<T>, x: MatIn<T, SymMat3<T>>, _state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let log = Hencky::of(x.strain);
        let events = Events { floored: log.floored, ..Events::none() };
        MatOut { strain: x.strain, kirchhoff: law.stress(log.strain), events }
    }

    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &Lame<T>, _b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        law.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &Lame<T>, b: SymMat3<T>, _state: &[T]) -> T {
        law.energy(b)
    }
}
