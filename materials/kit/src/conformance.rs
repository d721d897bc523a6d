//! What every material must do, checked on its table alone: built-in, plugin in Rust, or plugin in C.
//!
//! [`survey`] runs every check at the defaults and at parameters drawn from their declared ranges, and tells of each what it found;
//! [`run_all`] runs them at one set of parameters and stops at the first that fails. What a law need not do follows from what it declares
//! (capabilities, state variables, callbacks, counts), never from its name. A law without `update_f64` is held to its f32 update, as far as f32
//! tells.

mod contract;
mod elastic;
mod gradient;
mod moduli;
mod paths;
mod rates;
mod setting;

use crate::random::Random;
use crate::subject::{Precision, Subject};
use barchan_abi::*;
use core::fmt;
use setting::Setting;

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

/// How a check came out.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The error stays within the tolerance.
    Passed,
    /// It does not, or something else is wrong: what, and where.
    Failed(String),
    /// What the law declares, or lacks, for which it is not held to this.
    NotAsked(&'static str),
}

/// What a check found.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// The check's name.
    pub check: &'static str,
    /// The greatest error found; absent if there is no number to it.
    pub error: Option<f64>,
    /// What it must stay within; 0 where the contract is to the bit, or without numbers.
    pub tolerance: f64,
    /// How it came out.
    pub outcome: Outcome,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.outcome {
            Outcome::Failed(what) => write!(f, "{}: {what}", self.check),
            Outcome::NotAsked(why) => write!(f, "{}: not asked, {why}", self.check),
            Outcome::Passed => {
                write!(f, "{}: error {:.1e}, tolerance {:.1e}", self.check, self.error.unwrap_or(0.0), self.tolerance)
            }
        }
    }
}

impl Finding {
    /// Has the law failed it?
    pub fn is_failure(&self) -> bool {
        matches!(self.outcome, Outcome::Failed(_))
    }

    /// Of an error, measured at a place, that must stay within a tolerance.
    pub fn of(check: &'static str, worst: Worst, tolerance: f64) -> Self {
        // Not `error > tolerance`: NaN must fail.
        let outcome = if worst.error <= tolerance {
            Outcome::Passed
        } else {
            let Worst { error, place } = &worst;
            Outcome::Failed(format!("error {error:.2e} is beyond the tolerance {tolerance:.1e}{place}"))
        };
        Self { check, error: Some(worst.error), tolerance, outcome }
    }

    /// Of something wrong that is no number.
    pub fn failed(check: &'static str, tolerance: f64, what: impl Into<String>) -> Self {
        Self { check, error: None, tolerance, outcome: Outcome::Failed(what.into()) }
    }

    /// Of something that the law is not held to.
    pub fn not_asked(check: &'static str, tolerance: f64, why: &'static str) -> Self {
        Self { check, error: None, tolerance, outcome: Outcome::NotAsked(why) }
    }

    /// Takes over what another run of the same check found if that is worse: a failure, else the greater error.
    pub fn worsen(&mut self, other: Self) {
        let rank = |f: &Self| match f.outcome {
            Outcome::NotAsked(_) => 0,
            Outcome::Passed => 1,
            Outcome::Failed(_) => 2,
        };
        let own = (rank(self), self.error.unwrap_or(0.0));
        if rank(&other) > own.0 || (rank(&other) == own.0 && own.0 < 2 && other.error.unwrap_or(0.0) > own.1) {
            *self = other;
        }
    }
}

/// The greatest of errors, and where it was found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Worst {
    /// The greatest error; NaN if any was.
    pub error: f64,
    /// Where, as a continuation of a sentence; empty if there is nothing to say.
    pub place: String,
}

impl Worst {
    /// Takes an error into account; NaN stays.
    pub fn see(&mut self, error: f64, place: impl FnOnce() -> String) {
        if !self.error.is_nan() && (error > self.error || error.is_nan()) {
            *self = Self { error, place: place() };
        }
    }
}

/// What a check comes to: a number, or a reason not to ask.
enum Answered {
    Worst(Worst),
    NotAsked(&'static str),
}

/// What a check returns: what it comes to, or a description of what is wrong.
type Checked = Result<Answered, String>;

/// An outcome without a number to it.
fn sound() -> Checked {
    Ok(Answered::Worst(Worst::default()))
}

fn not_asked(why: &'static str) -> Checked {
    Ok(Answered::NotAsked(why))
}

/// A check by name, with its tolerance for laws in f64 and for those that have only f32.
struct Check {
    name: &'static str,
    tolerance: [f64; 2],
    run: fn(&Setting<'_>) -> Checked,
}

const CHECKS: &[Check] = &[
    Check { name: "declarations are sound", tolerance: [0.0; 2], run: contract::declarations },
    Check { name: "no stress at the identity", tolerance: [1e-6; 2], run: contract::zero_stress_at_identity },
    Check {
        name: "a particle's result is its own, bit by bit",
        tolerance: [0.0; 2],
        run: contract::batch_independence,
    },
    Check {
        name: "dt = 0 is idempotent in f64",
        tolerance: [1e-11; 2],
        run: |s| contract::idempotence(s, Precision::F64),
    },
    Check {
        name: "dt = 0 is idempotent in f32",
        tolerance: [2e-5; 2],
        run: |s| contract::idempotence(s, Precision::F32),
    },
    Check { name: "stress turns with the frame", tolerance: [1e-11, 2e-5], run: rates::objectivity },
    Check {
        name: "stress turns with the frame while it spins",
        tolerance: [1e-11, 2e-5],
        run: rates::rate_objectivity,
    },
    Check { name: "stress is symmetric, with rates too", tolerance: [1e-6, 2e-5], run: rates::symmetry },
    Check {
        name: "stress is the derivative of the energy",
        tolerance: [1e-6, 2e-5],
        run: elastic::derives_from_energy,
    },
    Check { name: "f32 agrees with f64 near rest", tolerance: [1e-5; 2], run: contract::precisions_agree },
    Check { name: "gradients are those of the answers", tolerance: [1e-6; 2], run: gradient::follows_answers },
    Check { name: "tangent moduli at rest", tolerance: [1e-4, 1e-2], run: moduli::at_rest },
    Check { name: "tangent moduli are positive", tolerance: [0.0; 2], run: moduli::are_positive },
    Check { name: "tangent moduli bound the measured tangent", tolerance: [0.1; 2], run: moduli::bound_the_tangent },
    Check { name: "viscosity bounds the measured one", tolerance: [1e-4, 1e-3], run: moduli::viscosity },
    Check { name: "no answer follows dt", tolerance: [1e-12, 1e-6], run: paths::step_length },
    Check { name: "a strain path has one answer in 1 or n steps", tolerance: [1e-3; 2], run: paths::step_count },
    Check { name: "elastic cycles give back stress and energy", tolerance: [1e-4, 1e-3], run: paths::elastic_cycles },
    Check { name: "no closed strain cycle makes energy", tolerance: [1e-2, 2e-2], run: paths::dissipation },
    Check {
        name: "NaN and infinity are reported with their particle",
        tolerance: [0.0; 2],
        run: contract::non_finite_is_reported,
    },
    Check { name: "bad structs are refused", tolerance: [0.0; 2], run: contract::bad_structs_are_refused },
];

/// Number of checks that [`findings`] makes.
pub const COUNT: usize = CHECKS.len();

/// Runs every check on a material with these parameters, one after the other. `on_check` is told the name of each before it runs.
pub fn findings(subject: &Subject<'_>, params: &[f64], on_check: &mut dyn FnMut(&'static str)) -> Vec<Finding> {
    CHECKS
        .iter()
        .map(|check| {
            on_check(check.name);
            one(check, subject, params)
        })
        .collect()
}

fn one(check: &Check, subject: &Subject<'_>, params: &[f64]) -> Finding {
    let setting = Setting::new(subject, params);
    let tolerance = check.tolerance[usize::from(setting.best == Precision::F32)];
    match (check.run)(&setting) {
        Ok(Answered::Worst(worst)) => Finding::of(check.name, worst, tolerance),
        Ok(Answered::NotAsked(why)) => Finding::not_asked(check.name, tolerance, why),
        Err(what) => Finding::failed(check.name, tolerance, what),
    }
}

/// Runs every check at the defaults and at [`samples`] of the parameters, and gives the worst of each check; a failure says at which
/// parameters. `on_check` is told the set's number, from 0, and the check's name.
pub fn survey(
    subject: &Subject<'_>,
    samples: &[Vec<f64>],
    on_check: &mut dyn FnMut(usize, &'static str),
) -> Vec<Finding> {
    let defaults = subject.default_params();
    let mut worst = findings(subject, &defaults, &mut |check| on_check(0, check));
    for (number, params) in samples.iter().enumerate() {
        let place = parameters(subject, params);
        for (worst, mut found) in
            worst.iter_mut().zip(findings(subject, params, &mut |check| on_check(number + 1, check)))
        {
            if let Outcome::Failed(what) = &mut found.outcome {
                *what = format!("{what}; with {place}");
            }
            worst.worsen(found);
        }
    }
    worst
}

/// Runs every check on a material with these parameters.
///
/// # Errors
/// The first check that fails.
pub fn run_all(subject: &Subject<'_>, params: &[f64]) -> Result<Vec<Measured>, Violation> {
    let mut measured = Vec::new();
    for check in CHECKS {
        let Finding { check, error, tolerance, outcome } = one(check, subject, params);
        match outcome {
            Outcome::Passed => measured.push(Measured { check, error: error.unwrap_or(0.0), tolerance }),
            Outcome::NotAsked(_) => {}
            Outcome::Failed(message) => return Err(Violation { material: subject.name().into(), check, message }),
        }
    }
    Ok(measured)
}

/// The modulus that a law's stresses are measured in [Pa]: λ + 2μ at rest, or K if a compression along one axis yields at once.
///
/// # Errors
/// If the law's update fails, or its stress does not follow the strain.
pub fn modulus(subject: &Subject<'_>, params: &[f64]) -> Result<f64, String> {
    Setting::new(subject, params).modulus()
}

/// Parameters by name, for people.
pub fn parameters(subject: &Subject<'_>, params: &[f64]) -> String {
    let each = subject.params().zip(params).map(|(p, value)| format!("{} = {value:.6e}", subject.text(p.name)));
    each.collect::<Vec<_>>().join(", ")
}

/// Sets of parameters drawn from their declared ranges, those that `check_params` refuses left out. A parameter on a logarithmic scale is drawn
/// within two decades of its default; one whose range is a thousand times as wide as its default, or has no end, is from a thousandth to a
/// million above its least value, or its default if there is none; any other is anywhere in its range. A fiftieth of the range is kept from an end
/// that is excluded.
pub fn samples(subject: &Subject<'_>, count: usize, seed: u64) -> Vec<Vec<f64>> {
    let mut random = Random::new(seed);
    let mut sets = Vec::new();
    for _ in 0..50 * count {
        if sets.len() == count {
            break;
        }
        let set: Vec<f64> = subject.params().map(|p| draw(&p, &mut random)).collect();
        if subject.check_params(&set).is_ok() {
            sets.push(set);
        }
    }
    sets
}

fn draw(p: &BarchanParam, random: &mut Random) -> f64 {
    let (default, least, most) = (p.default_value, p.min_value, p.max_value);
    let width = most - least;
    if p.flags & BARCHAN_PARAM_LOG_SCALE != 0 && default > 0.0 && default.is_finite() {
        return (default * 10f64.powf(2.0 * random.signed())).clamp(least, most);
    }
    // An infinite range is wide, too.
    if width > 1e3 * default.abs().max(1.0) || width.is_nan() {
        let from = if least.is_finite() { least } else { default };
        return (from + 10f64.powf(9.0 * random.unit() - 3.0)).clamp(least, most);
    }
    let margin = |open: u64| if p.flags & open != 0 { 0.02 * width } else { 0.0 };
    let (from, to) = (least + margin(BARCHAN_PARAM_MIN_OPEN), most - margin(BARCHAN_PARAM_MAX_OPEN));
    from + (to - from) * random.unit()
}
