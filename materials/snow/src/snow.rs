//! Snow that hardens as it is packed.

use barchan_material_kit::*;

/// Elastoplastic snow: fixed corotated elasticity whose principal stretches are kept in [1 − θ_c, 1 + θ_s], and whose
/// moduli grow by e^{ξ (1 − J_p)} as the plastic volume J_p shrinks.
///
/// τ = h [2μ (V² − V) + λ (J − 1) J I] with V² = b_e, J = det V, h = e^{ξ (1 − J_p)}; J_p takes up what the stretches lose.
///
/// The flow is not normal to a yield surface, and what has hardened stores more at the same strain: closed strain cycles make energy where θ_s is below
/// about a fifth of θ_c, or ξ θ_c above about 1. The defaults are far from both.
///
/// h is at most the parameter `hardening_max`, and J_p stays in [0.05, 20]; a particle at either bound is counted as clamped.
///
/// # Source
/// Stomakhin et al. 2013, "A material point method for snow simulation", eqs. 1 and 2 and section 6 (θ, ξ, plastic update). Written on b_e, which
/// gives the same stress for every particle that is not inverted.
#[derive(Debug)]
pub struct Snow;

const PLASTIC_VOLUME_RANGE: (f64, f64) = (0.05, 20.0);

/// Up to this stretch the moduli at rest serve for the tangent's.
const LINEAR_STRETCH: f64 = 1.01;

/// Constants derived from the parameters.
#[derive(Clone, Copy, Debug)]
pub struct SnowLaw<T> {
    elastic: Lame<T>,
    least_stretch: T,
    greatest_stretch: T,
    /// Where ‖b − I‖² is below this, no principal stretch is beyond its bounds.
    elastic_radius_squared: T,
    hardening: T,
    /// Logarithm of the greatest h.
    hardening_max_log: T,
}

impl<T: Real> SnowLaw<T> {
    /// ln h, and where it was cut.
    #[inline(always)]
    fn log_hardening(&self, plastic_volume: T) -> (T, T::Mask) {
        let log = self.hardening * (T::one() - plastic_volume);
        (log.min(self.hardening_max_log), log.gt(self.hardening_max_log))
    }

    #[inline(always)]
    fn hardened(&self, plastic_volume: T) -> Lame<T> {
        self.elastic.scale(self.log_hardening(plastic_volume).0.exp())
    }
}

#[inline(always)]
fn clamp<T: Real>(x: T, (least, greatest): (T, T)) -> T {
    x.max(least).min(greatest)
}

#[inline(always)]
fn outside<T: Real>(x: T, (least, greatest): (T, T)) -> T::Mask {
    x.lt(least) | x.gt(greatest)
}

/// 1 for what a clamp leaves as it is, 0 for what it holds.
#[inline(always)]
fn follows<T: Real>(x: T, bounds: (T, T)) -> T {
    T::select(outside(x, bounds), T::zero(), T::one())
}

/// Principal stretch of an eigenvalue of b.
#[inline(always)]
fn stretch<T: Real>(eigenvalue: T) -> T {
    eigenvalue.max(T::splat(MIN_STRETCH_SQUARED)).sqrt()
}

impl Material for Snow {
    const NAME: &'static str = "snow";
    const DOC: &'static str = "Snow: corotated elasticity with bounded principal stretches, hardening as it is packed.";
    const REFERENCE: &'static str = "Stomakhin et al. 2013, doi:10.1145/2461912.2461948";
    const PARAMS: &'static [Param] = &[
        young_modulus(1.4e5),
        poisson_ratio(0.2),
        param("critical_compression", "1", 2.5e-2, 0.0, 1.0, "θ_c: principal stretches below 1 - θ_c are plastic.")
            .max_open()
            .differentiable(),
        param("critical_stretch", "1", 7.5e-3, 0.0, 10.0, "θ_s: principal stretches above 1 + θ_s are plastic.")
            .differentiable(),
        param("hardening", "1", 10.0, 0.0, 100.0, "ξ: moduli grow by exp(ξ (1 - J_p)).").differentiable(),
        param("hardening_max", "1", 55.0, 1.0, 1e6, "Greatest factor by which the moduli grow.")
            .log_scale()
            .differentiable(),
    ];
    const STATES: &'static [State] =
        &[state("plastic_volume", "1", 1.0, "J_p, volume change kept by plastic flow.").merge_log_mean()];
    const CAPABILITIES: u64 = BARCHAN_CAP_HARDENS | BARCHAN_CAP_MAY_MAKE_ENERGY;
    const WGSL: &'static str = include_str!("snow.wgsl");
    const WGSL_STIFFNESS: &'static str = include_str!("snow_stiffness.wgsl");
    type Strain<T: Real> = SymMat3<T>;
    type Law<T: Real> = SnowLaw<T>;

    #[inline(always)]
    fn law<T: Real>(params: &[T]) -> SnowLaw<T> {
        let one = T::one();
        let (least_stretch, greatest_stretch) = (one - params[2], one + params[3]);
        let radius = (one - least_stretch * least_stretch).min(greatest_stretch * greatest_stretch - one);
        SnowLaw {
            elastic: Lame::new(params[0], params[1]),
            least_stretch,
            greatest_stretch,
            elastic_radius_squared: radius * radius,
            hardening: params[4],
            hardening_max_log: params[5].ln(),
        }
    }

    #[inline(always)]
    fn update<T: Real>(law: &SnowLaw<T>, x: MatIn<T, SymMat3<T>>, state: &mut [T]) -> MatOut<T, SymMat3<T>> {
        let no = T::Mask::splat(false);
        let trial = x.strain;
        let inside = near_identity(trial) & trial.add_scalar(-T::one()).norm_squared().lt(law.elastic_radius_squared);
        let (mut strain, mut left) = (trial, sqrt_near_identity(trial));
        let (mut yielding, mut floored) = (no, no);
        let mut plastic_volume = state[0];
        if !inside.all() {
            let eigen = Eigen::of(trial);
            let [a, b, c] = eigen.values;
            let bounds = (law.least_stretch, law.greatest_stretch);
            let tried = [stretch(a), stretch(b), stretch(c)];
            let kept = [clamp(tried[0], bounds), clamp(tried[1], bounds), clamp(tried[2], bounds)];
            let beyond = outside(tried[0], bounds) | outside(tried[1], bounds) | outside(tried[2], bounds);
            yielding = beyond & !inside;
            let least = T::splat(MIN_STRETCH_SQUARED);
            floored = (a.lt(least) | b.lt(least) | c.lt(least)) & !inside;
            let squares = [kept[0] * kept[0], kept[1] * kept[1], kept[2] * kept[2]];
            let follows = [follows(tried[0], bounds), follows(tried[1], bounds), follows(tried[2], bounds)];
            let half = T::splat(0.5);
            let slopes = [half * follows[0] / kept[0], half * follows[1] / kept[1], half * follows[2] / kept[2]];
            strain = SymMat3::select(yielding, eigen.compose(squares, follows), trial);
            left = SymMat3::select(inside, left, eigen.compose(kept, slopes));
            let lost = tried[0] * tried[1] * tried[2] / (kept[0] * kept[1] * kept[2]);
            plastic_volume = T::select(yielding, plastic_volume * lost, plastic_volume);
        }
        let (least, greatest) = PLASTIC_VOLUME_RANGE;
        let range = (T::splat(least), T::splat(greatest));
        state[0] = clamp(plastic_volume, range);
        let (log_h, cut) = law.log_hardening(state[0]);
        let clamped = cut | outside(plastic_volume, range);

        let j = left.determinant();
        let Lame { lambda, mu } = law.elastic.scale(log_h.exp());
        let kirchhoff = (strain - left).scale(mu + mu).add_scalar(lambda * (j - T::one()) * j);
        MatOut { strain, kirchhoff, events: Events { yielding, apex: no, floored, clamped } }
    }

    /// Along an axis of stretch s the stiffness is h times 2μ (2s² − s) + λ (2J² − J). Where stretches are kept within a hundredth of 1 that is within a
    /// tenth of the linear law's, which is given.
    #[inline(always)]
    fn tangent_moduli<T: Real>(law: &SnowLaw<T>, b: SymMat3<T>, state: &[T]) -> TangentModuli<T> {
        let one = T::one();
        let Lame { lambda, mu } = law.hardened(state[0]);
        // No eigenvalue is further above the mean.
        let above_mean = T::splat(2.0 / 3.0) * b.deviator().norm_squared();
        let square = (T::splat(1.0 / 3.0) * b.trace() + above_mean.sqrt()).max(one);
        let volume = b.determinant().max(T::zero()).sqrt();
        let stretches = law.greatest_stretch.gt(T::splat(LINEAR_STRETCH));
        let shear = T::select(stretches, square + square - square.sqrt(), one);
        let bulk = T::select(stretches, volume * (volume + volume - one), one);
        // Auxetic snow stiffens as it is packed, other snow as it is stretched.
        Lame { lambda: lambda.max(lambda * bulk), mu: mu * shear }.tangent_moduli()
    }

    #[inline(always)]
    fn energy<T: Real>(law: &SnowLaw<T>, b: SymMat3<T>, state: &[T]) -> T {
        let Lame { lambda, mu } = law.hardened(state[0]);
        let left = sqrt(b);
        let compression = left.determinant() - T::one();
        mu.mul_add(left.add_scalar(-T::one()).norm_squared(), T::splat(0.5) * lambda * compression * compression)
    }
}
