//! Derivatives that a law gives, against differences of its answers.

use super::setting::{Setting, short, stretched};
use super::{Checked, Worst, not_asked};
use crate::random::Random;
use crate::subject::{Answer, Particle, Precision};
use barchan_abi::{BARCHAN_CAP_VEL_GRAD, BARCHAN_PARAM_DIFFERENTIABLE};

/// A step of a strain, and of a parameter relative to its size: differences are good to its square.
const STEP: f64 = 1e-6;
/// Derivatives from one side and from the other, or from steps half as long, that are further apart than this, as a part of them, have a kink between them,
/// or a bend that is as short as the step: nothing is held to these.
const ROUGH: f64 = 1e-6;

/// Sum of an answer's values, each times its cotangent.
fn weighed(answer: &Answer, cotangent: &Answer) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    dot(&answer.strain, &cotangent.strain)
        + dot(&answer.kirchhoff, &cotangent.kirchhoff)
        + dot(&answer.state, &cotangent.state)
}

/// A derivative from values at so many steps, from -2 to 2; `None` where differences do not tell it.
fn slope(at: [f64; 5], size: f64) -> Option<f64> {
    let side = |near: f64, far: f64| (4.0 * near - 3.0 * at[2] - far) / (2.0 * STEP);
    let [after, before] = [side(at[3], at[4]), -side(at[1], at[0])];
    let [near, far] = [(at[3] - at[1]) / (2.0 * STEP), (at[4] - at[0]) / (4.0 * STEP)];
    let tells = (after - before).abs().max((far - near).abs()) <= ROUGH * size.max(near.abs());
    tells.then_some((4.0 * near - far) / 3.0)
}

/// Of strain, velocity gradient, history and parameters, the derivatives are those of strain, stress and history that come out: also at rest, and where
/// principal stretches are equal.
pub(super) fn follows_answers(s: &Setting<'_>) -> Checked {
    if s.subject.table().update_adj_f64.is_none() || s.best != Precision::F64 {
        return not_asked("it has no update_adj_f64");
    }
    let mut random = Random::new(31);
    let mut particles = s.particles();
    for stretches in [[0.7; 3], [1.4; 3], [0.6, 0.9, 0.9], [1.3, 1.3, 0.8], [0.75, 0.75, 1.0]] {
        let axes = random.rotation();
        particles.push(Particle { vel_grad: random.matrix().components(), ..s.particle(stretched(axes, stretches)) });
    }
    let (dt, modulus) = (1e-4, s.scales()?.modulus);
    let (strains, states) = (s.subject.strain_planes(), s.subject.states().count());
    let rates = if s.subject.has(BARCHAN_CAP_VEL_GRAD) { 9 } else { 0 };
    let params: Vec<_> = s.subject.params().collect();
    let (mut worst, mut smooth) = (Worst::default(), 0);
    for particle in particles {
        let mut cotangent = Answer { strain: [0.0; 9], kirchhoff: [0.0; 6], state: [0.0; 16] };
        cotangent.strain[..strains].iter_mut().for_each(|x| *x = random.signed());
        cotangent.kirchhoff.iter_mut().for_each(|x| *x = random.signed() / modulus);
        cotangent.state[..states].iter_mut().for_each(|x| *x = random.signed());
        let answer = |params: &[f64], particle: Particle| -> Result<f64, String> {
            let answers = s.subject.update(Precision::F64, params, dt, &[particle]);
            Ok(weighed(&answers.map_err(|e| format!("update: {e}"))?[0], &cotangent))
        };
        let given = s.subject.pull_back(s.params, dt, &[particle], &[cotangent]);
        let Some((given, of_params)) = given.map_err(|e| format!("update_adj: {e}"))? else {
            return not_asked("it has no update_adj_f64");
        };
        let size = given[0].strain.iter().map(|x| x.abs()).fold(1.0, f64::max);
        let mut compare = |what: String, given: f64, found: Option<f64>, size: f64| {
            if let Some(found) = found {
                smooth += 1;
                worst.see((given - found).abs() / size.max(found.abs()), || {
                    let strain = short(&particle.strain[..strains]);
                    format!(": by {what} it is given as {given:.6e} at strain {strain}, differences say {found:.6e}")
                });
            }
        };
        let steps = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|step| step * STEP);
        for (kind, count) in [("strain", strains), ("velocity gradient", rates), ("state", states)] {
            for c in 0..count {
                // A rate counts by what it comes to in the step.
                let unit = if kind == "velocity gradient" { 1.0 / dt } else { 1.0 };
                let mut at = [0.0; 5];
                for (at, step) in at.iter_mut().zip(steps) {
                    let mut moved = particle;
                    match kind {
                        "strain" => moved.strain[c] += step,
                        "velocity gradient" => moved.vel_grad[c] += step * unit,
                        _ => moved.state[c] += step,
                    }
                    *at = answer(s.params, moved)?;
                }
                let own = match kind {
                    "strain" => given[0].strain[c],
                    "velocity gradient" => given[0].vel_grad[c] * unit,
                    _ => given[0].state[c],
                };
                compare(format!("{kind} {c}"), own, slope(at, size), size);
            }
        }
        for (i, param) in params.iter().enumerate() {
            let unit = s.params[i].abs().max(param.default_value.abs());
            let room = (s.params[i] - param.min_value).min(param.max_value - s.params[i]);
            // At an end of its range there is a derivative to one side only.
            if param.flags & BARCHAN_PARAM_DIFFERENTIABLE == 0 || unit <= 0.0 || room <= 2.0 * STEP * unit {
                continue;
            }
            let mut at = [0.0; 5];
            for (at, step) in at.iter_mut().zip(steps) {
                let mut moved = s.params.to_vec();
                moved[i] += step * unit;
                *at = answer(&moved, particle)?;
            }
            compare(format!("parameter {i}"), of_params[i] * unit, slope(at, size), size);
        }
    }

    if smooth == 0 { Err("there is a kink wherever it was tried".into()) } else { Ok(worst.into()) }
}
