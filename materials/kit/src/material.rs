//! The trait that a material's author implements.

use crate::declare::{Param, State};
use crate::spectral::Hencky;
use crate::tensor::{Mat3, SymMat3};
use barchan_abi::{BARCHAN_STRAIN_DEF_GRAD, BARCHAN_STRAIN_LEFT_CAUCHY_GREEN};
use barchan_lanes::{Mask, Real};

/// Most state variables that a material may declare.
pub const MAX_STATE: usize = 8;
/// Most parameters that a material may declare.
pub const MAX_PARAMS: usize = 16;

/// What a particle carries as its strain: [`Mat3`] for the deformation gradient F, [`SymMat3`] for the left Cauchy–Green
/// tensor b_e of an isotropic law.
pub trait Strain<T>: Copy {
    /// `BARCHAN_STRAIN_*`.
    const KIND: u32;
    /// Components, and planes of the batch.
    const PLANES: usize;
    /// From the first [`Strain::PLANES`] entries.
    fn from_planes(planes: [T; 9]) -> Self;
    /// Into the first [`Strain::PLANES`] entries; the others repeat some component.
    fn into_planes(self) -> [T; 9];
    /// The undeformed state.
    fn rest() -> Self;
}

impl<T: Real> Strain<T> for Mat3<T> {
    const KIND: u32 = BARCHAN_STRAIN_DEF_GRAD;
    const PLANES: usize = 9;
    #[inline(always)]
    fn from_planes(planes: [T; 9]) -> Self {
        Self::from_components(planes)
    }
    #[inline(always)]
    fn into_planes(self) -> [T; 9] {
        self.components()
    }
    #[inline(always)]
    fn rest() -> Self {
        Self::identity()
    }
}

impl<T: Real> Strain<T> for SymMat3<T> {
    const KIND: u32 = BARCHAN_STRAIN_LEFT_CAUCHY_GREEN;
    const PLANES: usize = 6;
    #[inline(always)]
    fn from_planes([xx, yy, zz, xy, xz, yz, ..]: [T; 9]) -> Self {
        Self { xx, yy, zz, xy, xz, yz }
    }
    #[inline(always)]
    fn into_planes(self) -> [T; 9] {
        [self.xx, self.yy, self.zz, self.xy, self.xz, self.yz, self.xx, self.yy, self.zz]
    }
    #[inline(always)]
    fn rest() -> Self {
        Self::identity()
    }
}

/// What a material is given of one particle.
#[derive(Clone, Copy, Debug)]
pub struct MatIn<T, S> {
    /// Trial strain [1]: the strain at the step's end if the step were elastic.
    pub strain: S,
    /// Velocity gradient [1/s]; zero unless the material has `BARCHAN_CAP_VEL_GRAD`.
    pub vel_grad: Mat3<T>,
    /// The step [s]; 0 asks for the stress at the given strain.
    pub dt: T,
}

/// What a material answers.
#[derive(Clone, Copy, Debug)]
pub struct MatOut<T: Real, S> {
    /// Strain after the return map [1].
    pub strain: S,
    /// Kirchhoff stress τ = J σ [Pa].
    pub kirchhoff: SymMat3<T>,
    /// What the ledger counts.
    pub events: Events<T>,
}

impl<T: Real, S> MatOut<T, S> {
    /// An answer without events.
    #[inline(always)]
    pub fn new(strain: S, kirchhoff: SymMat3<T>) -> Self {
        Self { strain, kirchhoff, events: Events::none() }
    }
}

/// What happened to a particle that a run's ledger should know of.
#[derive(Clone, Copy, Debug)]
pub struct Events<T: Real> {
    /// It was on the yield surface.
    pub yielding: T::Mask,
    /// It was at the tip of the cone: stress-free, or at the greatest tension that cohesion bears.
    pub apex: T::Mask,
    /// A stretch was floored before a logarithm or a quotient.
    pub floored: T::Mask,
    /// Its hardening or volume state was clamped.
    pub clamped: T::Mask,
}

impl<T: Real> Events<T> {
    /// Nothing.
    #[inline(always)]
    pub fn none() -> Self {
        let no = T::Mask::splat(false);
        Self { yielding: no, apex: no, floored: no, clamped: no }
    }
}

/// The moduli that bound the time step.
#[derive(Clone, Copy, Debug)]
pub struct TangentModuli<T> {
    /// λ + 2μ [Pa].
    pub p_wave: T,
    /// 3λ + 2μ [Pa].
    pub triple_bulk: T,
}

/// A constitutive law: a pure function of one particle, written once for all precisions, vector widths and dual numbers.
///
/// Mark every method `#[inline(always)]`, or it is compiled without the machine's vector instructions. There is no `if` on
/// values: compare to a mask and [`Real::select`]. What is worth skipping may be skipped where no lane needs it
/// ([`Mask::any`]), provided that the result of each lane depends on that lane alone.
pub trait Material: 'static {
    /// snake_case name, unique in the registry.
    const NAME: &'static str;
    /// The material's own version.
    const VERSION: &'static str = env!("CARGO_PKG_VERSION");
    /// One paragraph.
    const DOC: &'static str;
    /// Paper or DOI.
    const REFERENCE: &'static str;
    /// At most [`MAX_PARAMS`].
    const PARAMS: &'static [Param];
    /// At most [`MAX_STATE`].
    const STATES: &'static [State] = &[];
    /// `BARCHAN_CAP_*` bits.
    const CAPABILITIES: u64 = 0;
    /// `<NAME>_update` in WGSL; empty: not available on the GPU.
    const WGSL: &'static str = "";
    /// `<NAME>_stiffness` in WGSL, [`tangent_moduli`](Material::tangent_moduli) and [`viscosity`](Material::viscosity) of a particle; empty:
    /// for a law with `BARCHAN_CAP_HARDENS` they are asked on the host, which slows a GPU down.
    const WGSL_STIFFNESS: &'static str = "";

    /// [`Mat3`] or [`SymMat3`].
    type Strain<T: Real>: Strain<T>;
    /// Constants of the law that follow from the parameters; derived once a batch.
    type Law<T: Real>: Copy;

    /// Derives the constants from the parameters, in the order of [`Material::PARAMS`].
    fn law<T: Real>(params: &[T]) -> Self::Law<T>;

    /// Advances one particle; `state` holds the variables of [`Material::STATES`] before and after.
    fn update<T: Real>(law: &Self::Law<T>, x: MatIn<T, Self::Strain<T>>, state: &mut [T])
    -> MatOut<T, Self::Strain<T>>;

    /// Moduli of the present tangent, none below its value at rest unless the material has softened.
    fn tangent_moduli<T: Real>(law: &Self::Law<T>, strain: Self::Strain<T>, state: &[T]) -> TangentModuli<T>;

    /// Greatest ratio [Pa s] of a Kirchhoff stress that follows the rate of deformation to twice that rate: η where τ = 2 η dev D. It bounds the
    /// time step, and is asked only of laws with `BARCHAN_CAP_VEL_GRAD`.
    #[inline(always)]
    fn viscosity<T: Real>(law: &Self::Law<T>, strain: Self::Strain<T>, state: &[T]) -> T {
        let _ = (law, strain, state);
        T::zero()
    }

    /// Elastic energy per rest volume [J/m³], whose derivative the Kirchhoff stress is: τ = (∂ψ/∂F) Fᵀ.
    fn energy<T: Real>(law: &Self::Law<T>, strain: Self::Strain<T>, state: &[T]) -> T;

    /// Checks parameters against each other; each is inside its own range already.
    ///
    /// # Errors
    /// What is wrong, and what would mend it.
    fn check(params: &[f64]) -> Result<(), String> {
        let _ = params;
        Ok(())
    }
}

/// Lamé's constants.
#[derive(Clone, Copy, Debug)]
pub struct Lame<T> {
    /// λ [Pa].
    pub lambda: T,
    /// Shear modulus μ [Pa].
    pub mu: T,
}

impl<T: Real> Lame<T> {
    /// From Young's modulus [Pa] and Poisson's ratio.
    #[inline(always)]
    pub fn new(young_modulus: T, poisson_ratio: T) -> Self {
        let one = T::one();
        let twice_mu = young_modulus / (one + poisson_ratio);
        let lambda = twice_mu * poisson_ratio / (one - poisson_ratio - poisson_ratio);
        Self { lambda, mu: T::splat(0.5) * twice_mu }
    }

    /// Both constants times `factor`.
    #[inline(always)]
    pub fn scale(self, factor: T) -> Self {
        Self { lambda: self.lambda * factor, mu: self.mu * factor }
    }

    /// 3λ + 2μ, three times the bulk modulus [Pa].
    #[inline(always)]
    pub fn triple_bulk(self) -> T {
        self.lambda.mul_add(T::splat(3.0), self.mu + self.mu)
    }

    /// Moduli of the linear law.
    #[inline(always)]
    pub fn tangent_moduli(self) -> TangentModuli<T> {
        TangentModuli { p_wave: self.lambda + self.mu + self.mu, triple_bulk: self.triple_bulk() }
    }

    /// Hencky's law: τ = 2μ ε + λ tr(ε) I of the strain ε = ½ ln b_e.
    #[inline(always)]
    pub fn stress(self, strain: SymMat3<T>) -> SymMat3<T> {
        strain.scale(self.mu + self.mu).add_scalar(self.lambda * strain.trace())
    }

    /// Energy of Hencky's law [J/m³]: μ ‖ε‖² + ½ λ tr(ε)².
    #[inline(always)]
    pub fn energy(self, b: SymMat3<T>) -> T {
        let strain = Hencky::of(b).strain;
        let trace = strain.trace();
        self.mu.mul_add(strain.norm_squared(), T::splat(0.5) * self.lambda * trace * trace)
    }
}
