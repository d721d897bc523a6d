//! Weakly compressible liquid.

use barchan_material_kit::*;

/// Newtonian liquid with Tait's equation of state: τ = −J p I + 2 η J dev D, p = (K/γ) (J^{−γ} − 1).
///
/// Only J = √det b is kept of the strain: b becomes J^{⅔} I, so that shear is forgotten. γ = 1 gives p = K (1/J − 1).
/// There is no cavitation: J > 1 gives tension. Where J is below 10⁻¹² that is used instead, counted as floored.
///
/// Energy ψ = (K/γ) [(J^{1−γ} − 1)/(γ − 1) + J − 1]. K may be far below water's 2.2 GPa: the density changes by about ρ g H/K.
///
/// # Source
/// Becker and Teschner 2007, "Weakly compressible SPH for free surface flows", eq. 7 (Tait); viscosity: Batchelor 1967, eq. 3.3.11.
#[derive(Debug)]
pub struct Liquid;

/// The parameters.
#[derive(Clone, Copy, Debug)]
pub struct LiquidLaw<T> {
    /// K/γ [Pa].
    stiffness: T,
    exponent: T,
    viscosity: T,
}

impl Material for Liquid {
    const NAME: &'static str = "liquid";
    const DOC: &'static str = "Weakly compressible Newtonian liquid with Tait's equation of state: water, oil, slurry.";
    const REFERENCE: &'static str = "Becker and Teschner 2007, Weakly compressible SPH for free surface flows, eq. 7";
    const PARAMS: &'static [Param] = &[
        param("bulk_modulus", "Pa", 2e5, 0.0, 1e13, "Bulk modulus K at rest.").min_open().log_scale().differentiable(),
        param("tait_exponent", "1", 7.0, 1.0, 20.0, "γ of Tait's equation of state.").differentiable(),
        param("viscosity", "Pa s", 0.0, 0.0, 1e9, "Dynamic viscosity η.").differentiable(),
    ];
    const CAPABILITIES: u64 = BARCHAN_CAP_FLUID | BARCHAN_CAP_VEL_GRAD | BARCHAN_CAP_HARDENS;
    const WGSL: &'static str = include_str!("liquid.wgsl");
    const WGSL_STIFFNESS: &'static str = include_str!("liquid_stiffness.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = LiquidLaw<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> LiquidLaw<T> {
        LiquidLaw { stiffness: params[0] / params[1], exponent: params[1], viscosity: params[2] }
    }

    #[inline(always)]
    fn update<T: Real>(law: &LiquidLaw<T>, x: MatIn<T, SymMat3<T>>, _state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let (ln_j, floored) = log_volume(x.strain);
        let j = ln_j.exp();
        let strain = SymMat3::scalar((T::splat(2.0 / 3.0) * ln_j).exp());
        let minus_jp = law.stiffness * (j - ((T::one() - law.exponent) * ln_j).exp());
        let rate = x.vel_grad.symmetric_part().deviator();
        let twice = law.viscosity + law.viscosity;
        let kirchhoff = rate.scale(twice * j).add_scalar(minus_jp);
        MatOut { strain, kirchhoff, events: Events { floored, ..Events::none() } }
    }

    /// dτ/d ln J, no less than at rest.
    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &LiquidLaw<T>, b: SymMat3<T>, _state: &[T]) -> TangentModuli<T> {
        let (ln_j, _) = log_volume(b);
        let power = law.exponent - T::one();
        let bulk = law.stiffness * power.mul_add((-power * ln_j).exp(), ln_j.exp());
        let bulk = bulk.max(law.stiffness * law.exponent);
        TangentModuli { p_wave: bulk, triple_bulk: T::splat(3.0) * bulk }
    }

    #[inline(always)]
    fn viscosity<T: Real>(law: &LiquidLaw<T>, b: SymMat3<T>, _state: &[T]) -> T {
        law.viscosity * log_volume(b).0.exp()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &LiquidLaw<T>, b: SymMat3<T>, _state: &[T]) -> T {
        let (ln_j, _) = log_volume(b);
        let power = law.exponent - T::one();
        // (J^{1−γ} − 1)/(γ − 1), whose limit for γ = 1 is −ln J.
        let x = -power * ln_j;
        let tiny = x.abs().lt(T::splat(1e-9));
        let compressed = (x.exp() - T::one()) / T::select(tiny, T::one(), power);
        law.stiffness * (T::select(tiny, -ln_j, compressed) + ln_j.exp() - T::one())
    }
}
