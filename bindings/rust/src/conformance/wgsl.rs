//! A law's WGSL on an adapter against its f64 form on the processor, or its f32 form if it has no other, at the very strains that the device is
//! given, so that only arithmetic differs.
//!
//! Near-singular strains magnify what f32 cannot hold: there, the answer must be that for a strain within a few roundings of the one given. Where
//! those roundings are all there is, it must be finite.
//!
//! ```
//! use barchan::conformance::Outcome;
//! use barchan::conformance::wgsl::{Gpu, Offer, open_with, survey};
//!
//! // The first adapter, with no more than the poorest one offers.
//! let gpu: Gpu = open_with(None, Offer::Least)?;
//! let registry = barchan::registry();
//! let findings = survey(&gpu, registry.material("hencky")?, 0, 64, &mut |_| {})?;
//! assert!(findings.iter().all(|finding| !matches!(finding.outcome, Outcome::Failed(_))), "{findings:?}");
//! # Ok::<(), barchan::Error>(())
//! ```

use super::{SEED, subject, whole};
use barchan_abi::{BARCHAN_CAP_FLUID, BARCHAN_CAP_HARDENS};
use barchan_core::{Material, Result};
use barchan_material_kit::conformance::{self, Finding, Outcome, Worst};
use barchan_material_kit::random::Random;
use barchan_material_kit::{Answer, Mat3, Particle, Precision, Subject, SymMat3};
use barchan_wgpu::points::{Asked, Point, PointAnswer, evaluate};

pub use barchan_wgpu::device::{Gpu, Offer, open, open_with};

/// Step that laws are asked over [s].
const DT: f64 = 1e-4;
/// Roundings of the strain given, of 2⁻²⁴ of its greatest component or 1, that the answer may be off by: those of the eigenvalues in
/// closed form, 10⁻⁶.
const ROUNDINGS: f64 = 16.0;

const ACCEPTED: &str = "WGSL is there, valid and pure";
const STRESS: &str = "WGSL gives the stress";
const OWN: &str = "WGSL gives strain and state";
const SYMMETRY: &str = "WGSL gives symmetric tensors";
const STIFFNESS: &str = "WGSL gives moduli and viscosity";
const FINITE: &str = "WGSL is finite where f32 tells no more";

/// Error in stress allowed, over λ + 2μ, at present or at rest, or over the stress where that is greater; against f64, and against f32.
const STRESS_TOLERANCE: [f64; 2] = [2e-6, 1e-5];
/// Error in strain allowed, relative to its own size or 1, and in state variables, to the greatest that each takes.
const OWN_TOLERANCE: [f64; 2] = [1e-5, 2e-5];
/// Greatest part of stress or strain that may be skew.
const SYMMETRY_TOLERANCE: f64 = 1e-6;
/// Stress above which f32 has no room for moduli beside it [Pa].
const BEYOND_F32: f64 = 1e30;
/// Error in moduli and viscosity allowed, relative to their own size.
const STIFFNESS_TOLERANCE: f64 = 1e-4;

/// Kinds of deformation.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Rest,
    Small,
    Yielding,
    Large,
    /// Least stretch from 3·10⁻³.
    NearSingular,
    /// Least stretch from 10⁻⁸: its square is below the rounding of the others'.
    Degenerate,
}
use Kind::{Degenerate, Large, NearSingular, Rest, Small, Yielding};

/// H = F − I.
fn deformation(kind: Kind, inverted: bool, random: &mut Random) -> Mat3<f64> {
    let around =
        |scale: f64, random: &mut Random| Mat3::from_components(random.matrix().components().map(|x| x * scale));
    let stretched = |stretches: [f64; 3], random: &mut Random| {
        let mut diagonal = Mat3::from_components([0.0; 9]);
        (0..3).for_each(|d| diagonal.rows[d][d] = stretches[d]);
        let mut h = random.rotation() * diagonal * random.rotation();
        (0..3).for_each(|d| h.rows[d][d] -= 1.0);
        h
    };
    match kind {
        Rest => around(0.0, random),
        Small => around(1e-6, random),
        Yielding => around(0.04, random),
        Large => stretched([0; 3].map(|_| random.signed().exp2()), random),
        NearSingular | Degenerate => {
            let exponent = if kind == NearSingular { -2.5 * random.unit() } else { -3.0 - 5.0 * random.unit() };
            let least = 10f64.powf(exponent);
            let sign = if inverted && random.unit() < 0.5 { -1.0 } else { 1.0 };
            stretched([sign * least, random.signed().exp2(), random.signed().exp2()], random)
        }
    }
}

/// A law with parameters, and where it is asked.
struct Set<'a> {
    subject: &'a Subject<'a>,
    parameters: Vec<f64>,
    /// [`parameters`](Self::parameters) for people.
    place: String,
    best: Precision,
    /// Part of what [`ROUNDINGS`] of the strain do that is allowed everywhere: drawn parameters may magnify two of them, as a hardening
    /// of exponent 60 does.
    magnified: f64,
    kinds: Vec<Kind>,
    points: Vec<Point>,
}

/// Components of the strain's planes among the nine of a matrix.
fn planes(subject: &Subject<'_>) -> &'static [usize] {
    if subject.is_left_cauchy_green() { &[0, 4, 8, 1, 2, 5] } else { &[0, 1, 2, 3, 4, 5, 6, 7, 8] }
}

/// A callback's failure while the suite runs it.
fn failed(error: impl std::fmt::Display) -> String {
    format!("the law's form on the processor: {error}")
}

impl<'a> Set<'a> {
    /// `count` points of each kind.
    fn new(subject: &'a Subject<'a>, parameters: Vec<f64>, count: usize, seed: u64) -> Result<Self, String> {
        let best = if subject.table().update_f64.is_some() { Precision::F64 } else { Precision::F32 };
        let place = conformance::parameters(subject, &parameters);
        let mut set = Self { subject, parameters, place, best, magnified: 0.0, kinds: Vec::new(), points: Vec::new() };
        let mut random = Random::new(seed);
        for kind in [Rest, Small, Yielding, Large, NearSingular, Degenerate] {
            for number in 0..count {
                // Half of them have flowed before, by as much as the law itself says.
                let past = if number % 2 == 0 { Rest } else { [Yielding, Large][number / 2 % 2] };
                let state = set.history(deformation(past, false, &mut random))?;
                let h = deformation(kind, !subject.is_left_cauchy_green(), &mut random);
                let strain = if subject.is_left_cauchy_green() { left_cauchy_green(h) } else { h.components() };
                let vel_grad = random.matrix().components().map(|x| (10.0 * x) as f32);
                set.kinds.push(kind);
                set.points.push(Point { strain: strain.map(|x| x as f32), vel_grad, state });
            }
        }
        Ok(set)
    }

    /// The state variables that the law has after a deformation from rest by I + H.
    fn history(&self, h: Mat3<f64>) -> Result<Vec<f32>, String> {
        let strain = if self.subject.is_left_cauchy_green() { left_cauchy_green(h) } else { h.components() };
        let mut particle = self.subject.particle_at_rest();
        for (plane, &c) in planes(self.subject).iter().enumerate() {
            particle.strain[plane] += strain[c];
        }
        let answer = self.update(self.best, &[particle])?[0];
        Ok(answer.state[..self.subject.table().n_state].iter().map(|x| *x as f32).collect())
    }

    fn update(&self, precision: Precision, particles: &[Particle]) -> Result<Vec<Answer>, String> {
        self.subject.update(precision, &self.parameters, DT, particles).map_err(failed)
    }

    /// A point for the processor; `nudge` is added to the strain, in units of its rounding.
    fn particle(&self, point: &Point, nudge: Option<Mat3<f64>>) -> Particle {
        let mut particle = self.subject.particle_at_rest();
        let size = point.strain.iter().fold(1f64, |m, x| m.max(f64::from(x.abs())));
        for (plane, &c) in planes(self.subject).iter().enumerate() {
            particle.strain[plane] += f64::from(point.strain[c]);
            if let Some(nudge) = nudge {
                particle.strain[plane] += ROUNDINGS * 6e-8 * size * nudge.components()[c];
            }
        }
        particle.vel_grad = point.vel_grad.map(f64::from);
        for (to, from) in particle.state.iter_mut().zip(&point.state) {
            *to = f64::from(*from);
        }
        particle
    }

    /// A device's answer as the processor's are.
    fn answer(&self, from: &PointAnswer) -> Answer {
        let rest = self.subject.particle_at_rest();
        let mut answer = Answer { strain: [0.0; 9], kirchhoff: [0.0; 6], state: rest.state };
        for (plane, &c) in planes(self.subject).iter().enumerate() {
            answer.strain[plane] = f64::from(from.strain[c]) + rest.strain[plane];
        }
        for (plane, c) in [0, 4, 8, 1, 2, 5].into_iter().enumerate() {
            answer.kirchhoff[plane] = f64::from(from.kirchhoff[c]);
        }
        for (to, from) in answer.state.iter_mut().zip(&from.state) {
            *to = f64::from(*from);
        }
        answer
    }

    /// Where a point is, for people.
    fn place(&self, i: usize) -> String {
        let Point { strain, state, vel_grad } = &self.points[i];
        let history = if state.is_empty() { String::new() } else { format!(", state {state:?}") };
        let kind = self.kinds[i];
        format!("at strain - I {strain:?}{history}, velocity gradient {vel_grad:?} ({kind:?}), with {}", self.place)
    }
}

/// b − I of F = I + H, as nine components.
fn left_cauchy_green(h: Mat3<f64>) -> [f64; 9] {
    let own = h.times_transpose();
    let twice = h.symmetric_part();
    Mat3::from(own + twice.scale(2.0)).components()
}

/// `f64::max` hides NaN.
fn greater(a: f64, b: f64) -> f64 {
    if a.is_nan() || a > b { a } else { b }
}

/// Errors of an answer in stress and in strain and state, in units of what they are measured against.
fn errors(answer: &Answer, exact: &Answer, modulus: f64, states: &[f64]) -> [f64; 2] {
    let worst = |a: &[f64], b: &[f64], least: f64| {
        let scale = b.iter().fold(least, |m, x| m.max(x.abs()));
        a.iter().zip(b).map(|(a, b)| (a - b).abs() / scale).fold(0.0, greater)
    };
    let state = answer.state.iter().zip(&exact.state).zip(states).map(|((a, b), scale)| {
        let apart = (a - b).abs();
        if apart <= 0.0 { 0.0 } else { apart / scale.max(b.abs()) }
    });
    let own = state.fold(worst(&answer.strain, &exact.strain, 1.0), greater);
    [worst(&answer.kirchhoff, &exact.kirchhoff, modulus), own]
}

/// Holds a law's WGSL to its form on the processor at so many strains of each of six kinds, at its defaults and, at a quarter as many strains each, at
/// `samples` sets of parameters drawn from their declared ranges. `on_check` is told what is under way.
///
/// # Errors
/// [`Error::Device`](barchan_core::Error::Device) if the adapter fails. What is wrong with the law is in the findings.
pub fn survey(
    gpu: &Gpu,
    material: &Material,
    samples: usize,
    count: usize,
    on_check: &mut dyn FnMut(&'static str),
) -> Result<Vec<Finding>> {
    let table = whole(material);
    let subject = subject(material, &table)?;
    let sets = std::iter::once(subject.default_params()).chain(conformance::samples(&subject, samples, SEED));
    survey_at(gpu, material, &sets.collect::<Vec<_>>(), count, on_check)
}

/// [`survey`] at these sets of parameters, the first as the defaults are.
///
/// # Errors
/// As there.
pub fn survey_at(
    gpu: &Gpu,
    material: &Material,
    parameters: &[Vec<f64>],
    count: usize,
    on_check: &mut dyn FnMut(&'static str),
) -> Result<Vec<Finding>> {
    on_check(ACCEPTED);
    if let Err(error) = barchan_wgpu::material::check(material) {
        return Ok(vec![Finding::failed(ACCEPTED, 0.0, error.to_string())]);
    }
    let table = whole(material);
    let subject = subject(material, &table)?;
    let sets: Result<Vec<_>, String> = (0..)
        .zip(parameters)
        .map(|(i, set)| match i {
            0 => Set::new(&subject, set.clone(), count, SEED),
            _ => {
                Ok(Set { magnified: 2.0 / ROUNDINGS, ..Set::new(&subject, set.clone(), count.div_ceil(4), SEED + i)? })
            }
        })
        .collect();
    on_check(STRESS);
    let outcome = match sets {
        Err(what) => Err(what),
        Ok(sets) => {
            let asked: Vec<_> = sets
                .iter()
                .map(|set| Asked { law: material, parameters: &set.parameters, points: &set.points })
                .collect();
            let answers = evaluate(gpu, DT as f32, &asked)?;
            sets.iter().zip(&answers).map(|(set, answers)| compared(material, set, answers)).collect()
        }
    };
    let accepted = Finding::of(ACCEPTED, Worst::default(), 0.0);
    let all: Vec<Vec<Finding>> = match outcome {
        Err(what) => return Ok(vec![accepted, Finding::failed(STRESS, STRESS_TOLERANCE[0], what)]),
        Ok(all) => all,
    };
    let mut findings = all.into_iter().reduce(|mut worst, found| {
        worst.iter_mut().zip(found).for_each(|(worst, found)| worst.worsen(found));
        worst
    });
    let mut all = vec![accepted];
    all.append(findings.get_or_insert_default());
    Ok(all)
}

/// A device's answers at one set of parameters, held to the processor's.
fn compared(material: &Material, set: &Set<'_>, answers: &[PointAnswer]) -> Result<Vec<Finding>, String> {
    let determined = set.kinds.iter().filter(|kind| **kind != Degenerate).count();
    let (points, _) = set.points.split_at(determined);
    let in_f32 = usize::from(set.best == Precision::F32);
    let given: Vec<_> = answers.iter().map(|answer| set.answer(answer)).collect();
    let update = |nudge: Option<u64>| {
        let mut random = Random::new(nudge.unwrap_or(0));
        // Both ways along the identity, which moves the least eigenvalue most, and at random.
        let mut nudged = || match nudge {
            Some(1) => Some(Mat3::identity()),
            Some(2) => Some(Mat3::from(SymMat3::scalar(-1.0))),
            other => other.map(|_| Mat3::from(random.symmetric())),
        };
        let particles: Vec<_> = points.iter().map(|point| set.particle(point, nudged())).collect();
        set.update(set.best, &particles)
    };
    let exact = update(None)?;
    let nudged = [1, 2, 3, 4].map(|seed| update(Some(seed)));
    let nudged = nudged.into_iter().collect::<Result<Vec<_>, String>>()?;
    let kept = |a: &Answer| a.kirchhoff.iter().all(|x| x.abs() < BEYOND_F32);
    let told: Vec<usize> = (0..determined).filter(|i| kept(&exact[*i])).collect();
    let moduli = present_moduli(set, &told.iter().map(|i| exact[*i]).collect::<Vec<_>>())?;
    let mut states = set.subject.particle_at_rest().state.map(f64::abs);
    for i in &told {
        states.iter_mut().zip(exact[*i].state).for_each(|(scale, x)| *scale = scale.max(x.abs()));
    }

    let mut worst = [Worst::default(), Worst::default()];
    let mut symmetry = Worst::default();
    for (&i, &modulus) in told.iter().zip(&moduli) {
        let found = errors(&given[i], &exact[i], modulus, &states);
        for (k, worst) in worst.iter_mut().enumerate() {
            // What a few roundings of the strain do.
            let part = if set.kinds[i] == NearSingular { 1.0 } else { set.magnified };
            let nudged = nudged.iter().map(|n| errors(&n[i], &exact[i], modulus, &states)[k]);
            let slack = if part > 0.0 { part * nudged.fold(0.0, f64::max) } else { 0.0 };
            let beyond = found[k] - slack;
            worst.see(if beyond < 0.0 { 0.0 } else { beyond }, || {
                format!(": {}, WGSL gives {:?}, the processor {:?}", set.place(i), given[i], exact[i])
            });
        }
        symmetry.see(skew(set, &answers[i], modulus), || format!(": {}, WGSL gives {:?}", set.place(i), answers[i]));
    }
    let [stress, own] = worst;
    Ok(vec![
        Finding::of(STRESS, stress, STRESS_TOLERANCE[in_f32]),
        Finding::of(OWN, own, OWN_TOLERANCE[in_f32]),
        Finding::of(SYMMETRY, symmetry, SYMMETRY_TOLERANCE),
        stiffness(material, set, &told, &given, answers)?,
        finite(set, &answers[determined..], determined),
    ])
}

/// λ + 2μ [Pa] after each answer, or at rest where it has softened to less, which nothing around it will feel; the modulus at rest of a law that does not
/// give it.
fn present_moduli(set: &Set<'_>, answers: &[Answer]) -> Result<Vec<f64>, String> {
    let after = |a: &Answer| Particle { strain: a.strain, state: a.state, ..set.subject.particle_at_rest() };
    let particles: Vec<_> = answers.iter().map(after).collect();
    let at_rest = conformance::modulus(set.subject, &set.parameters).map_err(failed)?;
    let moduli = set.subject.tangent_moduli(&set.parameters, &particles).map_err(failed)?;
    Ok(match moduli {
        Some(moduli) => moduli.into_iter().map(|m| m[0].max(at_rest)).collect(),
        None => vec![at_rest; answers.len()],
    })
}

/// Greatest skew component, relative to the size of its tensor.
fn skew(set: &Set<'_>, answer: &PointAnswer, modulus: f64) -> f64 {
    let of = |m: &[f32; 9], least: f64| {
        let scale = m.iter().fold(least, |s, x| s.max(f64::from(x.abs())));
        [(1, 3), (2, 6), (5, 7)].map(|(a, b)| f64::from(m[a] - m[b]).abs() / scale).into_iter().fold(0.0, greater)
    };
    let stress = of(&answer.kirchhoff, modulus);
    if set.subject.is_left_cauchy_green() { greater(stress, of(&answer.strain, 1.0)) } else { stress }
}

/// Moduli and viscosity in WGSL are those that the processor gives for the same strain and history, at the points `told`.
fn stiffness(
    material: &Material,
    set: &Set<'_>,
    told: &[usize],
    given: &[Answer],
    answers: &[PointAnswer],
) -> Result<Finding, String> {
    if material.wgsl_stiffness.is_empty() {
        let why = match set.subject.has(BARCHAN_CAP_HARDENS) {
            true => "it has no WGSL for them, so that its particles are copied to the host to be asked",
            false => "they stay as they are at rest, where the host asks",
        };
        return Ok(Finding::not_asked(STIFFNESS, STIFFNESS_TOLERANCE, why));
    }
    let particle = |a: &Answer| Particle { strain: a.strain, state: a.state, ..set.subject.particle_at_rest() };
    let particles: Vec<_> = told.iter().map(|i| particle(&given[*i])).collect();
    let Some(moduli) = set.subject.tangent_moduli(&set.parameters, &particles).map_err(failed)? else {
        return Ok(Finding::not_asked(STIFFNESS, STIFFNESS_TOLERANCE, "it has no tangent_moduli_f32"));
    };
    let viscosity = set.subject.viscosity(&set.parameters, &particles).map_err(failed)?;
    let mut worst = Worst::default();
    for (at, &i) in told.iter().enumerate() {
        let own = [moduli[at][0], moduli[at][1], viscosity.as_ref().map_or(0.0, |v| v[at])];
        for (found, own) in answers[i].stiffness.map(f64::from).into_iter().zip(own) {
            // Both may be beyond f32.
            let error = if found == own { 0.0 } else { (found - own).abs() / own.abs().max(f64::MIN_POSITIVE) };
            worst.see(error, || format!(": {}, WGSL gives {found:e}, the processor {own:e}", set.place(i)));
        }
    }
    Ok(Finding::of(STIFFNESS, worst, STIFFNESS_TOLERANCE))
}

/// What is given of the strains that f32 cannot tell from singular ones, which begin at point `first`.
fn finite(set: &Set<'_>, answers: &[PointAnswer], first: usize) -> Finding {
    // A liquid resists being squashed to nothing with more than f32 can say, on the processor as well.
    if set.subject.has(BARCHAN_CAP_FLUID) {
        return Finding::not_asked(FINITE, 0.0, "it declares BARCHAN_CAP_FLUID, and no float holds its pressure there");
    }
    let is_finite = |a: &PointAnswer| a.strain.iter().chain(&a.kirchhoff).chain(&a.state).all(|x| x.is_finite());
    match answers.iter().position(|a| !is_finite(a)) {
        None => Finding { check: FINITE, error: None, tolerance: 0.0, outcome: Outcome::Passed },
        Some(i) => Finding::failed(FINITE, 0.0, format!("{}, it gives {:?}", set.place(first + i), answers[i])),
    }
}
