//! A law with parameters, and how it is moved along strains.

use crate::random::Random;
use crate::subject::{Answer, MOST_STATES, Particle, Precision, Subject};
use crate::tensor::{Mat3, SymMat3};

/// A material with parameters.
pub(super) struct Setting<'a> {
    pub(super) subject: &'a Subject<'a>,
    pub(super) params: &'a [f64],
    /// The precision that derivatives are measured in: f64 if the law has it.
    pub(super) best: Precision,
}

/// What answers are measured in: stress in units of the modulus, each state variable in units of the greatest value that it takes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scales {
    /// [Pa].
    pub(super) modulus: f64,
    states: [f64; MOST_STATES],
}

impl Scales {
    /// Greatest difference of two answers; stresses above the modulus, strains above 1 and states above their scale in units of themselves.
    pub(super) fn difference(&self, a: &Answer, b: &Answer) -> f64 {
        let strain = distance(&a.strain, &b.strain) / greatest(&a.strain).max(1.0);
        self.stress(&a.kirchhoff, &b.kirchhoff).max_or_nan(strain).max_or_nan(self.state(a, b))
    }

    /// That of two stresses.
    pub(super) fn stress(&self, a: &[f64; 6], b: &[f64; 6]) -> f64 {
        distance(a, b) / greatest(a).max(self.modulus)
    }

    /// That of the state variables, each in its own unit: what is in J/m³ is of another size than what is a strain.
    pub(super) fn state(&self, a: &Answer, b: &Answer) -> f64 {
        let each = a.state.iter().zip(&b.state).zip(&self.states);
        let relative = each.map(|((x, y), scale)| {
            let apart = (x - y).abs();
            // A variable that never leaves 0 has no size.
            if apart <= 0.0 { 0.0 } else { apart / scale.max(x.abs()).max(y.abs()) }
        });
        relative.fold(0.0, f64::max_or_nan)
    }
}

/// `f64::max` hides NaN.
pub(super) trait MaxOrNan {
    /// The greater one, NaN if either is.
    fn max_or_nan(self, other: Self) -> Self;
}

impl MaxOrNan for f64 {
    fn max_or_nan(self, other: Self) -> Self {
        if self.is_nan() || self > other { self } else { other }
    }
}

/// Greatest magnitude of the differences.
pub(super) fn distance<'a>(a: impl IntoIterator<Item = &'a f64>, b: impl IntoIterator<Item = &'a f64>) -> f64 {
    a.into_iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max_or_nan)
}

/// Greatest magnitude.
pub(super) fn greatest(values: &[f64]) -> f64 {
    values.iter().map(|x| x.abs()).fold(0.0, f64::max_or_nan)
}

impl<'a> Setting<'a> {
    pub(super) fn new(subject: &'a Subject<'a>, params: &'a [f64]) -> Self {
        let best = if subject.table().update_f64.is_some() { Precision::F64 } else { Precision::F32 };
        Self { subject, params, best }
    }

    /// The precisions that the law has, the required one first.
    pub(super) fn precisions(&self) -> &'static [Precision] {
        if self.best == Precision::F64 { &[Precision::F32, Precision::F64] } else { &[Precision::F32] }
    }

    /// A strain that is small, and not lost in rounding.
    pub(super) fn small(&self) -> f64 {
        if self.best == Precision::F64 { 1e-6 } else { 2e-3 }
    }

    pub(super) fn update(&self, precision: Precision, particles: &[Particle]) -> Result<Vec<Answer>, String> {
        self.update_in(precision, 0.0, particles)
    }

    pub(super) fn update_in(
        &self,
        precision: Precision,
        dt: f64,
        particles: &[Particle],
    ) -> Result<Vec<Answer>, String> {
        self.subject.update(precision, self.params, dt, particles).map_err(|e| format!("{precision:?} update: {e}"))
    }

    /// One particle in the best precision.
    pub(super) fn answer(&self, dt: f64, particle: &Particle) -> Result<Answer, String> {
        Ok(self.update_in(self.best, dt, std::slice::from_ref(particle))?[0])
    }

    /// Particles with deformation gradient `f`.
    pub(super) fn particle(&self, f: Mat3<f64>) -> Particle {
        self.deformed(&self.subject.particle_at_rest(), f)
    }

    /// The trial of a particle that is deformed further by `f`; its velocity gradient is none.
    pub(super) fn deformed(&self, from: &Particle, f: Mat3<f64>) -> Particle {
        let mut particle = Particle { vel_grad: [0.0; 9], ..*from };
        if self.subject.is_left_cauchy_green() {
            let [xx, yy, zz, xy, xz, yz, ..] = from.strain;
            let b = Mat3::from(SymMat3 { xx, yy, zz, xy, xz, yz });
            let carried = (f * b * f.transpose()).symmetric_part();
            particle.strain[..6].copy_from_slice(&carried.components());
        } else {
            particle.strain = (f * Mat3::from_components(from.strain)).components();
        }
        particle
    }

    /// The particle that an update leaves.
    pub(super) fn after(answer: &Answer) -> Particle {
        Particle { strain: answer.strain, state: answer.state, vel_grad: [0.0; 9] }
    }

    /// Deformation gradients at a distance of about `size` from `center` I.
    pub(super) fn deformations(&self, seed: u64, count: usize, center: f64, size: f64) -> Vec<Mat3<f64>> {
        let mut random = Random::new(seed);
        (0..count)
            .map(|_| {
                let mut f = random.matrix().components().map(|x| x * size);
                for diagonal in [0, 4, 8] {
                    f[diagonal] += center;
                }
                Mat3::from_components(f)
            })
            .collect()
    }

    /// Particles at rest, near rest, and far from it in compression and tension.
    pub(super) fn particles(&self) -> Vec<Particle> {
        let mut deformations = vec![Mat3::identity()];
        for (seed, center, size) in [(1, 1.0, 1e-4), (2, 0.999, 1e-3), (3, 1.0, 0.03), (4, 0.8, 0.2), (5, 1.3, 0.3)] {
            deformations.extend(self.deformations(seed, 6, center, size));
        }
        let mut random = Random::new(6);
        deformations
            .into_iter()
            .map(|f| Particle { vel_grad: random.matrix().components(), ..self.particle(f) })
            .collect()
    }

    /// What this law's answers are measured in.
    pub(super) fn scales(&self) -> Result<Scales, String> {
        let mut states = [0f64; MOST_STATES];
        for answer in self.update_in(self.best, 1e-4, &self.particles())? {
            states.iter_mut().zip(answer.state).for_each(|(scale, x)| *scale = scale.max_or_nan(x.abs()));
        }
        Ok(Scales { modulus: self.modulus()?, states })
    }

    /// [`Self::scales`] for each of these answers, by its present λ + 2μ if the law gives it and it has grown.
    pub(super) fn scales_at(&self, answers: &[Answer]) -> Result<Vec<Scales>, String> {
        let scales = self.scales()?;
        let particles: Vec<_> = answers.iter().map(Self::after).collect();
        let moduli =
            self.subject.tangent_moduli(self.params, &particles).map_err(|e| format!("tangent_moduli: {e}"))?;
        let mut all = vec![scales; answers.len()];
        for (scales, moduli) in all.iter_mut().zip(moduli.into_iter().flatten()) {
            scales.modulus = scales.modulus.max(moduli[0]);
        }
        Ok(all)
    }

    /// The modulus that stresses are measured in [Pa]: λ + 2μ, or K if a compression along one axis yields at once.
    pub(super) fn modulus(&self) -> Result<f64, String> {
        let modulus = self.slope([1.0, 0.0, 0.0])?.abs().max(self.slope([1.0; 3])?.abs() / 3.0);
        if modulus > 0.0 && modulus.is_finite() {
            Ok(modulus)
        } else {
            Err(format!("a compression by {:.0e} from rest changes the stress by {modulus} times that", self.small()))
        }
    }

    /// dτ_xx/dε at rest along a diagonal strain, in compression.
    pub(super) fn slope(&self, direction: [f64; 3]) -> Result<f64, String> {
        let small = self.small();
        let mut f = Mat3::identity();
        for (i, d) in direction.into_iter().enumerate() {
            f.rows[i][i] = (-small * d).exp();
        }
        let answers = self.update(self.best, &[self.particle(f), self.subject.particle_at_rest()])?;
        Ok((answers[1].kirchhoff[0] - answers[0].kirchhoff[0]) / small)
    }

    /// Does the update of this trial flow, or floor or clamp anything? By the law's own counts, if it has them.
    pub(super) fn yields(&self, trial: &Particle) -> Result<Option<bool>, String> {
        let counts =
            self.subject.counts(self.params, std::slice::from_ref(trial)).map_err(|e| format!("count: {e}"))?;
        Ok(counts.map(|counts| counts.iter().any(|count| *count > 0)))
    }

    /// Does the update of this trial go without plastic flow? By the law's own counts if it has them, else by whether it leaves strain and
    /// state as they are.
    pub(super) fn is_elastic(&self, trial: &Particle, answer: &Answer) -> Result<bool, String> {
        Ok(match self.yields(trial)? {
            Some(yields) => !yields,
            None => distance(&trial.strain, &answer.strain) <= 1e-6 && trial.state == answer.state,
        })
    }
}

/// Tensor (xx yy zz xy xz yz) turned by `rotation`: R T Rᵀ.
pub(super) fn turned(rotation: Mat3<f64>, tensor: [f64; 6]) -> [f64; 6] {
    let m = rotation * Mat3::from(SymMat3::from_components(tensor)) * rotation.transpose();
    m.symmetric_part().components()
}

/// I + (e^h − 1) n nᵀ: a stretch by e^h along n.
pub(super) fn stretch_along(n: [f64; 3], h: f64) -> Mat3<f64> {
    let mut f = Mat3::identity();
    for i in 0..3 {
        for j in 0..3 {
            f.rows[i][j] += h.exp_m1() * n[i] * n[j];
        }
    }
    f
}

/// R diag(s) Rᵀ.
pub(super) fn stretched(rotation: Mat3<f64>, [x, y, z]: [f64; 3]) -> Mat3<f64> {
    let diagonal = Mat3 { rows: [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]] };
    rotation * diagonal * rotation.transpose()
}

/// Numbers of a place in a message, short.
pub(super) fn short(values: &[f64]) -> String {
    let each: Vec<_> = values.iter().map(|x| format!("{x:.6}")).collect();
    format!("[{}]", each.join(", "))
}

/// Stresses in a message.
pub(super) fn stress(values: &[f64]) -> String {
    let each: Vec<_> = values.iter().map(|x| format!("{x:.5e}")).collect();
    format!("[{}] Pa", each.join(", "))
}
