//! The step that a law's stiffness, viscosity and damping allow. The law's callbacks give it for 16 particles at a
//! time.

use crate::backend::Bound;
use crate::batch::{Matter, Plane};
use crate::material::ErrorBuffer;
use crate::plan::PlannedMaterial;
use crate::{Error, Result};

/// Particles in one call of a law.
pub const PARTICLES: usize = 16;

/// A law that is asked how long a step its particles bear.
#[derive(Debug)]
pub struct Stiffness<'a> {
    planned: &'a PlannedMaterial,
    params: Vec<f32>,
}

/// What bounds the step of one particle.
#[derive(Clone, Copy, Debug)]
pub struct Moduli {
    /// λ + 2μ [Pa].
    pub p_wave: f64,
    /// 3λ + 2μ [Pa].
    pub triple_bulk: f64,
    /// Viscosity [Pa s].
    pub viscosity: f64,
    /// The viscosity that bounds the step as damping does [Pa s]; see [`Damping::viscosity`].
    pub damping: f64,
}

/// Kelvin and Voigt's damping of a material: stress λ tr(D) I + 2 μ D of the elastic part D of its rate of strain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Damping {
    /// β λ [Pa s].
    pub lambda: f64,
    /// β μ [Pa s].
    pub mu: f64,
}

impl Damping {
    /// Damping by a time β [s] of a material with these moduli at rest. Every kind of elastic wave loses the same part
    /// of its energy in a given time.
    pub fn new(time: f64, at_rest: &Moduli) -> Self {
        let Moduli { p_wave, triple_bulk, .. } = at_rest;
        // Rounding may leave a liquid a shear modulus below zero, which would feed its motion.
        let mu = (0.25 * (3.0 * p_wave - triple_bulk)).max(0.0);
        Self { lambda: time * (p_wave - 2.0 * mu), mu: time * mu }
    }

    /// η [Pa s] in [`Moduli::need`]. There stress grows by 2 η C, and here by β k C, with the k of stiffness: of volume
    /// change, or of stretch along an axis if λ is negative.
    pub fn viscosity(&self) -> f64 {
        let Self { lambda, mu } = self;
        mu + 0.5 * lambda.max(3.0 * lambda)
    }
}

/// What bounds the step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Limit {
    /// The moduli of the present tangent.
    #[default]
    Stiffness,
    /// Viscosity: without it, less than half as many steps would do.
    Viscosity,
    /// Damping that the scene asks for, by the same rule.
    Damping,
}

/// How many steps a second a set of particles needs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Need {
    /// The greatest number among the particles [1/s].
    pub rate: f64,
    /// What bounds it.
    pub by: Limit,
}

impl Need {
    /// The need of both sets together.
    pub fn or(self, other: Self) -> Self {
        if other.rate > self.rate { other } else { self }
    }
}

/// a and v/2 of [`Moduli::need`].
struct Terms {
    a: f64,
    half_v: f64,
}

impl Terms {
    fn rate(&self) -> f64 {
        self.half_v + (self.half_v * self.half_v + self.a).sqrt()
    }
}

impl Moduli {
    /// Steps a second that a particle alone in its cells needs, for cell width `h` [m] and density at rest [kg/m³].
    ///
    /// The strain rate C of such a particle, with stress τ = k ε + 2 η C, follows C' = C − dt (4/(ρ h²)) (k ε' + 2 η
    /// C), ε' = ε + dt C. k = 3λ + 2μ for a change of volume, and less in shear. That is stable where a dt² + v dt <=
    /// 1, a = k/(ρ h²), v = 4 η/(ρ h²). So without viscosity the step is at most h sqrt(ρ/k) = (h/c_p) sqrt((λ +
    /// 2μ)/(3λ + 2μ)), c_p² = (λ + 2μ)/ρ, and without stiffness ρ h²/(4 η). Both are below the bounds of a filled grid,
    /// so they hold for spray as well as for bulk.
    pub fn need(&self, h: f64, density: f64) -> Need {
        let terms = self.terms(h, density);
        let rate = terms.rate();
        let by = match rate > 2.0 * terms.a.sqrt() {
            false => Limit::Stiffness,
            true if self.damping > self.viscosity => Limit::Damping,
            true => Limit::Viscosity,
        };
        Need { rate, by }
    }

    fn terms(&self, h: f64, density: f64) -> Terms {
        let inertia = density * h * h;
        // Where λ is negative the bulk's bound is the lower one.
        let k = if self.triple_bulk > self.p_wave { self.triple_bulk } else { self.p_wave };
        Terms { a: k / inertia, half_v: 2.0 * (self.viscosity + self.damping) / inertia }
    }
}

/// [`Moduli`] of 16 particles.
struct ModuliOf16 {
    p_wave: [f32; PARTICLES],
    triple_bulk: [f32; PARTICLES],
    viscosity: [f32; PARTICLES],
    damping: f64,
}

impl ModuliOf16 {
    fn of(&self, i: usize) -> Moduli {
        let [p_wave, triple_bulk, viscosity] =
            [self.p_wave, self.triple_bulk, self.viscosity].map(|all| f64::from(all[i]));
        Moduli { p_wave, triple_bulk, viscosity, damping: self.damping }
    }
}

impl<'a> Stiffness<'a> {
    /// `None` if the law does not give its tangent moduli.
    pub fn of(planned: &'a PlannedMaterial) -> Option<Self> {
        planned.material.table.tangent_moduli_f32?;
        let params = planned.parameters.iter().map(|&p| p as f32).collect();
        Some(Self { planned, params })
    }

    /// How many steps a second the first `count` of 16 particles need, given their planes of strain and of history, in
    /// cells `h` wide [m] and with these densities at rest [kg/m³].
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] if a callback fails, or if its moduli are not finite and above 0. The error names the
    /// particle by the number that `id` gives.
    pub fn need(
        &self,
        [strain, state]: [&[Plane<f32, PARTICLES>]; 2],
        count: usize,
        (h, density): (f64, &[f64; PARTICLES]),
        id: impl Fn(usize) -> Option<u64>,
    ) -> Result<Need> {
        let moduli = self.moduli([strain, state], count, id)?;
        let mut rates = [0.0; PARTICLES];
        for (i, rate) in rates.iter_mut().enumerate() {
            *rate = moduli.of(i).terms(h, density[i]).rate();
        }
        let mut greatest = 0;
        for i in 1..count {
            if rates[i] > rates[greatest] {
                greatest = i;
            }
        }
        Ok(if count == 0 { Need::default() } else { moduli.of(greatest).need(h, density[greatest]) })
    }

    /// What the law says of the first `count` of 16 particles, see [`need`](Self::need).
    fn moduli(
        &self,
        [strain, state]: [&[Plane<f32, PARTICLES>]; 2],
        count: usize,
        id: impl Fn(usize) -> Option<u64>,
    ) -> Result<ModuliOf16> {
        let law = &self.planned.material;
        let matter = Matter { count: PARTICLES, parameters: &self.params, strain, state };
        let mut out = [Plane::<f32, PARTICLES>::default(); 2];
        let mut viscosity = Plane::default();
        let mut message = ErrorBuffer::default();
        let named = |i: u64| usize::try_from(i).ok().filter(|i| *i < count).and_then(&id).unwrap_or(u64::MAX);
        if let Some(status) = law.tangent_moduli(&matter, &mut out, &mut message) {
            message.check(status, law, "tangent_moduli", named)?;
        }
        if let Some(status) = law.viscosity(&matter, &mut viscosity, &mut message) {
            message.check(status, law, "viscosity", named)?;
        }
        let wrong = |callback: &'static str, message: String, i: usize| Error::MaterialFailed {
            material: self.planned.name.clone(),
            origin: law.origin.clone(),
            callback,
            message,
            particle: id(i),
        };
        for i in 0..count {
            let moduli = [out[0].0[i], out[1].0[i]];
            if !moduli.iter().all(|m| m.is_finite() && *m > 0.0) {
                let what = format!("the moduli are {moduli:?} Pa; they must be finite and above 0");
                return Err(wrong("tangent_moduli", what, i));
            }
            let viscosity = viscosity.0[i];
            if !(viscosity.is_finite() && viscosity >= 0.0) {
                let what = format!("the viscosity is {viscosity} Pa s; it must be finite and not below 0");
                return Err(wrong("viscosity", what, i));
            }
        }
        let damping = self.planned.damping.map_or(0.0, |damping| damping.viscosity());
        Ok(ModuliOf16 { p_wave: out[0].0, triple_bulk: out[1].0, viscosity: viscosity.0, damping })
    }

    /// The moduli of the undeformed material.
    ///
    /// # Errors
    /// As [`need`](Self::need).
    pub fn at_rest(&self) -> Result<Moduli> {
        let filled = |value: &f64| Plane([*value as f32; PARTICLES]);
        let strain: Vec<_> = self.planned.material.strain_identity().iter().map(filled).collect();
        let state: Vec<_> = self.planned.material.states.iter().map(|s| filled(&s.initial)).collect();
        Ok(self.moduli([&strain[..], &state[..]], 1, |_| None)?.of(0))
    }

    /// The bound of the step from particles of the law with this need. The simulation's step contains `steps_within`
    /// steps of theirs.
    pub fn bound(&self, need: Need, steps_within: u32) -> Bound {
        let what = match need.by {
            Limit::Stiffness => "stiffness",
            Limit::Viscosity => "viscosity",
            Limit::Damping => "damping",
        };
        Bound { dt: f64::from(steps_within) / need.rate, by: format!("{what} of material '{}'", self.planned.name) }
    }
}
