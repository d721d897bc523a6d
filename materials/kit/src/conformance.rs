//! What every material must do, checked on its table alone: built-in, plugin in Rust, or plugin in C.
//!
//! [`run_all`] runs the suite; each check returns what it measured, or says what is wrong.

use crate::random::Random;
use crate::subject::{Answer, Particle, Precision, Subject, SubjectError};
use crate::tensor::{Mat3, SymMat3};
use barchan_abi::*;
use core::fmt;
use core::ptr::{null, null_mut};

/// A check that passed.
#[derive(Clone, Debug)]
pub struct Measured {
    /// The check's name.
    pub check: &'static str,
    /// The greatest error found.
    pub error: f64,
    /// What it must stay within.
    pub tolerance: f64,
}

impl fmt::Display for Measured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: error {:.1e}, tolerance {:.1e}", self.check, self.error, self.tolerance)
    }
}

/// A check that failed.
#[derive(Clone, Debug)]
pub struct Violation {
    /// The material's name.
    pub material: String,
    /// The check's name.
    pub check: &'static str,
    /// What is wrong.
    pub message: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "material '{}' violates '{}': {}", self.material, self.check, self.message)
    }
}
impl std::error::Error for Violation {}

/// What a check returns: the greatest error, or a description of what is wrong.
type Outcome = Result<f64, String>;

/// A check by name, with its tolerance.
struct Check {
    name: &'static str,
    tolerance: f64,
    run: fn(&Setting<'_>) -> Outcome,
}

const CHECKS: &[Check] = &[
    Check { name: "declarations are sound", tolerance: 0.0, run: declarations },
    Check { name: "no stress at the identity", tolerance: 1e-6, run: zero_stress_at_identity },
    Check { name: "a particle's result is its own, bit by bit", tolerance: 0.0, run: batch_independence },
    Check { name: "dt = 0 is idempotent in f64", tolerance: 1e-11, run: |s| idempotence(s, Precision::F64) },
    Check { name: "dt = 0 is idempotent in f32", tolerance: 2e-5, run: |s| idempotence(s, Precision::F32) },
    Check { name: "stress turns with the frame", tolerance: 1e-11, run: isotropy },
    Check { name: "stress is the derivative of the energy", tolerance: 1e-6, run: stress_derives_from_energy },
    Check { name: "f32 agrees with f64 near rest", tolerance: 1e-5, run: precisions_agree },
    Check { name: "tangent moduli at rest", tolerance: 1e-4, run: moduli_at_rest },
    Check { name: "tangent moduli are positive", tolerance: 0.0, run: moduli_are_positive },
    Check { name: "NaN and infinity are reported with their particle", tolerance: 0.0, run: non_finite_is_reported },
    Check { name: "bad structs are refused", tolerance: 0.0, run: bad_structs_are_refused },
];

/// Runs every check on a material with these parameters.
///
/// # Errors
/// The first check that fails.
pub fn run_all(subject: &Subject<'_>, params: &[f64]) -> Result<Vec<Measured>, Violation> {
    let setting = Setting { subject, params };
    CHECKS
        .iter()
        .map(|check| {
            let violation = |message| Violation { material: subject.name().into(), check: check.name, message };
            let error = (check.run)(&setting).map_err(violation)?;
            // Not `error > tolerance`: NaN must fail.
            if error <= check.tolerance {
                Ok(Measured { check: check.name, error, tolerance: check.tolerance })
            } else {
                Err(violation(format!("error {error:.2e} is beyond the tolerance {:.2e}", check.tolerance)))
            }
        })
        .collect()
}

/// A material with parameters.
struct Setting<'a> {
    subject: &'a Subject<'a>,
    params: &'a [f64],
}

impl Setting<'_> {
    fn update(&self, precision: Precision, particles: &[Particle]) -> Result<Vec<Answer>, String> {
        self.subject.update(precision, self.params, 0.0, particles).map_err(|e| format!("{precision:?} update: {e}"))
    }

    /// Particles with deformation gradient `f`.
    fn particle(&self, f: Mat3<f64>) -> Particle {
        let mut particle = self.subject.particle_at_rest();
        if self.subject.is_left_cauchy_green() {
            particle.strain[..6].copy_from_slice(&f.times_transpose().components());
        } else {
            particle.strain = f.components();
        }
        particle
    }

    /// Deformation gradients at a distance of about `size` from `center` I.
    fn deformations(&self, seed: u64, count: usize, center: f64, size: f64) -> Vec<Mat3<f64>> {
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
    fn particles(&self) -> Vec<Particle> {
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

    /// λ + 2μ [Pa], which stresses are measured in: from the stress's slope in a uniaxial compression from rest.
    fn modulus(&self) -> Result<f64, String> {
        Ok(self.slope([1.0, 0.0, 0.0])?.abs())
    }

    /// dτ_xx/dε at rest along a diagonal strain, in compression.
    fn slope(&self, direction: [f64; 3]) -> Result<f64, String> {
        let small = 1e-6;
        let mut f = Mat3::identity();
        for (i, d) in direction.into_iter().enumerate() {
            f.rows[i][i] = (-small * d).exp();
        }
        let answers = self.update(Precision::F64, &[self.particle(f), self.subject.particle_at_rest()])?;
        Ok((answers[1].kirchhoff[0] - answers[0].kirchhoff[0]) / small)
    }
}

/// Greatest magnitude of the differences.
fn distance<'a>(a: impl IntoIterator<Item = &'a f64>, b: impl IntoIterator<Item = &'a f64>) -> f64 {
    a.into_iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

/// Greatest difference of two answers; stresses in units of `modulus`, and of themselves where they are above it.
fn difference(a: &Answer, b: &Answer, modulus: f64) -> f64 {
    let scale = a.kirchhoff.iter().fold(modulus, |m, x| m.max(x.abs()));
    (distance(&a.kirchhoff, &b.kirchhoff) / scale).max(distance(&a.strain, &b.strain)).max(distance(&a.state, &b.state))
}

fn declarations(s: &Setting<'_>) -> Outcome {
    let table = s.subject.table();
    if s.subject.name().is_empty() {
        return Err("the name is empty".into());
    }
    if table.strain_kind != BARCHAN_STRAIN_DEF_GRAD && table.strain_kind != BARCHAN_STRAIN_LEFT_CAUCHY_GREEN {
        return Err(format!("strain_kind is {}", table.strain_kind));
    }
    let mut names = Vec::new();
    for p in s.subject.params() {
        let name = s.subject.text(p.name);
        let value = p.default_value;
        let below = value < p.min_value || (value <= p.min_value && p.flags & BARCHAN_PARAM_MIN_OPEN != 0);
        let above = value > p.max_value || (value >= p.max_value && p.flags & BARCHAN_PARAM_MAX_OPEN != 0);
        if below || above || value.is_nan() {
            return Err(format!("the default {value} of '{name}' is outside {} .. {}", p.min_value, p.max_value));
        }
        names.push(name);
    }
    for q in s.subject.states() {
        let name = s.subject.text(q.name);
        if !q.initial_value.is_finite() || q.merge > BARCHAN_MERGE_REFUSE {
            return Err(format!("state '{name}' starts at {} with merge rule {}", q.initial_value, q.merge));
        }
        names.push(name);
    }
    for name in &names {
        let snake = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if name.is_empty() || !name.chars().all(snake) {
            return Err(format!("'{name}' is not in snake_case"));
        }
        if names.iter().filter(|other| *other == name).count() > 1 {
            return Err(format!("'{name}' is declared twice"));
        }
    }
    s.subject.check_params(s.params).map_err(|e| format!("check_params refuses the parameters: {e}"))?;
    Ok(0.0)
}

fn zero_stress_at_identity(s: &Setting<'_>) -> Outcome {
    let modulus = s.modulus()?;
    let mut worst = 0f64;
    for precision in [Precision::F32, Precision::F64] {
        let answer = s.update(precision, &[s.subject.particle_at_rest()])?[0];
        worst = worst.max(distance(&answer.kirchhoff, &[0.0; 6]) / modulus);
    }
    Ok(worst)
}

fn batch_independence(s: &Setting<'_>) -> Outcome {
    let particles = s.particles();
    let n = particles.len();
    for precision in [Precision::F32, Precision::F64] {
        let update = |particles: &[Particle], stride: usize| {
            s.subject
                .update_strided(precision, s.params, 1e-4, particles, stride)
                .map_err(|e| format!("{precision:?} update: {e}"))
        };
        let alone: Vec<Answer> = particles.iter().map(|&p| Ok(update(&[p], 1)?[0])).collect::<Result<_, String>>()?;
        // Other neighbours, other lanes, other batch sizes, strides that are and are not multiples of 16.
        for (shift, count, stride) in [(0, n, n), (5, n, n + 13), (16, 16, 16), (3, 20, 64), (11, 15, 16)] {
            let order: Vec<usize> = (0..count).map(|i| (i * 7 + shift) % n).collect();
            let batch: Vec<Particle> = order.iter().map(|&i| particles[i]).collect();
            for (lane, (answer, &i)) in update(&batch, stride)?.iter().zip(&order).enumerate() {
                let bits = |a: &Answer| {
                    let all = a.strain.iter().chain(&a.kirchhoff).chain(&a.state);
                    all.map(|x| x.to_bits()).collect::<Vec<u64>>()
                };
                if bits(answer) != bits(&alone[i]) {
                    return Err(format!(
                        "{precision:?}: particle {lane} of {count} gets {answer:?}, alone it gets {:?}",
                        alone[i]
                    ));
                }
            }
        }
    }
    Ok(0.0)
}

fn idempotence(s: &Setting<'_>, precision: Precision) -> Outcome {
    let modulus = s.modulus()?;
    let particles = s.particles();
    let first = s.update(precision, &particles)?;
    let again: Vec<Particle> = particles
        .iter()
        .zip(&first)
        .map(|(p, a)| Particle { strain: a.strain, state: a.state, vel_grad: p.vel_grad })
        .collect();
    let second = s.update(precision, &again)?;
    Ok(first.iter().zip(&second).map(|(a, b)| difference(a, b, modulus)).fold(0.0, f64::max))
}

fn isotropy(s: &Setting<'_>) -> Outcome {
    let modulus = s.modulus()?;
    let mut random = Random::new(7);
    let mut worst = 0f64;
    for (center, size) in [(0.9995, 1e-3), (0.9, 0.2)] {
        for f in s.deformations(8, 20, center, size) {
            let rotation = random.rotation();
            let answers = s.update(Precision::F64, &[s.particle(f), s.particle(rotation * f)])?;
            let turned = |tensor: [f64; 6]| {
                let m = rotation * Mat3::from(SymMat3::from_components(tensor)) * rotation.transpose();
                m.symmetric_part().components()
            };
            let expected = turned(answers[0].kirchhoff);
            let scale = expected.iter().fold(modulus, |m, x| m.max(x.abs()));
            worst = worst.max(distance(&expected, &answers[1].kirchhoff) / scale);
            let strain = answers[0].strain;
            let expected = if s.subject.is_left_cauchy_green() {
                let [xx, yy, zz, xy, xz, yz, ..] = strain;
                turned([xx, yy, zz, xy, xz, yz]).to_vec()
            } else {
                (rotation * Mat3::from_components(strain)).components().to_vec()
            };
            worst = worst.max(distance(&expected, &answers[1].strain));
        }
    }
    Ok(worst)
}

fn stress_derives_from_energy(s: &Setting<'_>) -> Outcome {
    let modulus = s.modulus()?;
    let describe = |e: SubjectError| format!("energy: {e}");
    let energies = |particles: &[Particle]| s.subject.energy(s.params, particles).map_err(describe);
    let mut deformations = s.deformations(9, 20, 0.999, 1e-4);
    deformations.extend(s.deformations(10, 20, 0.95, 0.03));
    deformations.extend(s.deformations(11, 20, 0.9, 0.2));
    let (mut worst, mut elastic) = (0f64, 0);
    for f in deformations {
        let particle = s.particle(f);
        let answer = s.update(Precision::F64, &[particle])?[0];
        let after = Particle { strain: answer.strain, state: answer.state, ..particle };
        let Some(energy) = energies(&[particle, after])? else { return Ok(0.0) };
        // Plastic flow loses energy, and there the stress is that of another strain.
        if (energy[0] - energy[1]).abs() > 1e-12 * modulus {
            continue;
        }
        elastic += 1;
        let step = 1e-6;
        let mut pairs = Vec::new();
        for component in 0..9 {
            for sign in [1.0, -1.0] {
                let mut varied = f.components();
                varied[component] += sign * step;
                pairs.push(s.particle(Mat3::from_components(varied)));
            }
        }
        let Some(energy) = energies(&pairs)? else { return Ok(0.0) };
        let mut piola = [0.0; 9];
        for (p, pair) in piola.iter_mut().zip(energy.chunks(2)) {
            *p = (pair[0] - pair[1]) / (2.0 * step);
        }
        let expected = (Mat3::from_components(piola) * f.transpose()).symmetric_part().components();
        let scale = expected.iter().fold(modulus, |m, x| m.max(x.abs()));
        worst = worst.max(distance(&expected, &answer.kirchhoff) / scale);
    }
    if elastic == 0 { Err("none of the deformations tried is elastic".into()) } else { Ok(worst) }
}

fn precisions_agree(s: &Setting<'_>) -> Outcome {
    let modulus = s.modulus()?;
    let mut particles = Vec::new();
    for (seed, size) in [(12, 1e-4), (13, 1e-3), (14, 1e-2)] {
        particles.extend(s.deformations(seed, 30, 1.0 - size, size).into_iter().map(|f| s.particle(f)));
    }
    // Both see the same input, so that only the arithmetic differs.
    for particle in &mut particles {
        particle.strain = particle.strain.map(|x| f64::from(x as f32));
    }
    let (single, double) = (s.update(Precision::F32, &particles)?, s.update(Precision::F64, &particles)?);
    Ok(double.iter().zip(&single).map(|(a, b)| difference(a, b, modulus)).fold(0.0, f64::max))
}

fn moduli_at_rest(s: &Setting<'_>) -> Outcome {
    let rest = [s.subject.particle_at_rest()];
    let moduli = s.subject.tangent_moduli(s.params, &rest).map_err(|e| format!("tangent_moduli: {e}"))?;
    let Some(moduli) = moduli else { return Ok(0.0) };
    let expected = [s.slope([1.0, 0.0, 0.0])?, s.slope([1.0; 3])?];
    Ok((0..2).map(|i| (moduli[0][i] / expected[i] - 1.0).abs()).fold(0.0, f64::max))
}

fn moduli_are_positive(s: &Setting<'_>) -> Outcome {
    let particles = s.particles();
    let moduli = s.subject.tangent_moduli(s.params, &particles).map_err(|e| format!("tangent_moduli: {e}"))?;
    match moduli.into_iter().flatten().position(|m| !(m[0] > 0.0 && m[1] > 0.0)) {
        None => Ok(0.0),
        Some(i) => Err(format!("they are not at strain {:?}", particles[i].strain)),
    }
}

fn non_finite_is_reported(s: &Setting<'_>) -> Outcome {
    let places = s.subject.strain_planes() + s.subject.table().n_state;
    for precision in [Precision::F32, Precision::F64] {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for (count, victim) in [(1, 0), (40, 21), (40, 39), (64, 16)] {
                for place in 0..places {
                    let mut particles = vec![s.subject.particle_at_rest(); count];
                    match place.checked_sub(s.subject.strain_planes()) {
                        None => particles[victim].strain[place] = bad,
                        Some(state) => particles[victim].state[state] = bad,
                    }
                    let what = format!("{precision:?}: {bad} in plane {place} of particle {victim} of {count}");
                    match s.subject.update(precision, s.params, 1e-4, &particles) {
                        Ok(_) => return Err(format!("{what} is not reported")),
                        Err(e) if e.status != BARCHAN_E_NON_FINITE || e.particle != Some(victim as u64) => {
                            return Err(format!("{what} is reported as {e}"));
                        }
                        Err(_) => {}
                    }
                }
            }
        }
    }
    Ok(0.0)
}

fn bad_structs_are_refused(s: &Setting<'_>) -> Outcome {
    let (Some(single), Some(double)) = (s.subject.table().update_f32, s.subject.table().update_f64) else {
        return Err("an update is missing".into());
    };
    let empty = BarchanBatchF64 {
        struct_size: size_of::<BarchanBatchF64>(),
        n: 0,
        stride: 0,
        dt: 0.0,
        params: s.params.as_ptr(),
        strain_trial: null(),
        vel_grad: null(),
        state_in: null(),
        strain: null_mut(),
        kirchhoff: null_mut(),
        state_out: null_mut(),
    };
    let short = BarchanBatchF64 { struct_size: 8, ..empty };
    let without_planes = BarchanBatchF64 { n: 4, stride: 16, ..empty };
    // SAFETY: these are the cases that the ABI obliges a callback to refuse before it follows a pointer; NULL errors are
    // allowed.
    let (null_single, null_double, short, without_planes, empty) = unsafe {
        (
            single(null(), null_mut()),
            double(null(), null_mut()),
            double(&short, null_mut()),
            double(&without_planes, null_mut()),
            double(&empty, null_mut()),
        )
    };
    for (what, status) in [
        ("a NULL batch (f32)", null_single),
        ("a NULL batch (f64)", null_double),
        ("a batch of 8 bytes", short),
        ("a batch without planes", without_planes),
    ] {
        if status == BARCHAN_OK {
            return Err(format!("{what} is accepted"));
        }
    }
    if empty != BARCHAN_OK {
        return Err(format!("a batch of no particles is refused with status {empty}"));
    }
    Ok(0.0)
}
