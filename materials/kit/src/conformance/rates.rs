//! Frames and rates: stress turns with the frame, and a spin makes none.

use super::contract::what;
use super::elastic::energy_slope;
use super::setting::{MaxOrNan, Scales, Setting, distance, greatest, short, stress, turned};
use super::{Checked, Worst, not_asked};
use crate::random::Random;
use crate::subject::{Answer, Particle};
use crate::tensor::{Mat3, SymMat3};
use barchan_abi::BARCHAN_CAP_VEL_GRAD;

/// Greatest rate of deformation and of spin that is tried [1/s].
const RATE: f64 = 10.0;
/// Step beside these rates [s].
const DT: f64 = 1e-4;

fn scaled(m: Mat3<f64>, factor: f64) -> Mat3<f64> {
    Mat3::from_components(m.components().map(|x| factor * x))
}

fn sum(a: Mat3<f64>, b: Mat3<f64>) -> Mat3<f64> {
    let (a, b) = (a.components(), b.components());
    Mat3::from_components(core::array::from_fn(|i| a[i] + b[i]))
}

/// A velocity gradient without deformation.
fn spin(random: &mut Random) -> Mat3<f64> {
    let [x, y, z] = [0; 3].map(|_| RATE * random.signed());
    Mat3 { rows: [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]] }
}

/// How far the second answer is from the first one seen from a frame that is turned by `rotation`.
fn apart(s: &Setting<'_>, scales: &Scales, rotation: Mat3<f64>, [own, seen]: [&Answer; 2]) -> f64 {
    let stress = scales.stress(&turned(rotation, own.kirchhoff), &seen.kirchhoff);
    let expected = if s.subject.is_left_cauchy_green() {
        let [xx, yy, zz, xy, xz, yz, ..] = own.strain;
        turned(rotation, [xx, yy, zz, xy, xz, yz]).to_vec()
    } else {
        (rotation * Mat3::from_components(own.strain)).components().to_vec()
    };
    let strain = distance(&expected, &seen.strain) / greatest(&own.strain).max(1.0);
    stress.max_or_nan(strain).max_or_nan(scales.state(own, seen))
}

fn place(s: &Setting<'_>, rotation: Mat3<f64>, trial: &Particle, [own, seen]: [&Answer; 2]) -> String {
    let strain = short(&trial.strain[..s.subject.strain_planes()]);
    let rotation = short(&rotation.components());
    format!(": trial strain {strain} gives {}, turned by {rotation} it gives {}", what(s, own), what(s, seen))
}

pub(super) fn objectivity(s: &Setting<'_>) -> Checked {
    let scales = s.scales()?;
    let mut random = Random::new(7);
    let mut worst = Worst::default();
    for (center, size) in [(0.9995, 1e-3), (0.9, 0.2)] {
        for f in s.deformations(8, 20, center, size) {
            let rotation = random.rotation();
            let trials = [s.particle(f), s.particle(rotation * f)];
            let answers = s.update(s.best, &trials)?;
            let pair = [&answers[0], &answers[1]];
            worst.see(apart(s, &scales, rotation, pair), || place(s, rotation, &trials[0], pair));
        }
    }
    Ok(worst.into())
}

/// A frame that is turned by Q and spins by W sees the deformation gradient Q F and the velocity gradient Q L Qᵀ + W, and must see the
/// stress Q τ Qᵀ.
pub(super) fn rate_objectivity(s: &Setting<'_>) -> Checked {
    let scales = s.scales()?;
    let mut random = Random::new(17);
    let mut worst = Worst::default();
    for (center, size) in [(1.0, 0.0), (0.9995, 1e-3), (0.9, 0.2)] {
        for f in s.deformations(18, 10, center, size) {
            let (rotation, rate, spin) = (random.rotation(), scaled(random.matrix(), RATE), spin(&mut random));
            let seen = sum(rotation * rate * rotation.transpose(), spin);
            let trials = [(f, rate), (rotation * f, seen)]
                .map(|(f, rate)| Particle { vel_grad: rate.components(), ..s.particle(f) });
            let answers = s.update_in(s.best, DT, &trials)?;
            let pair = [&answers[0], &answers[1]];
            worst.see(apart(s, &scales, rotation, pair), || {
                let rates = [rate, seen].map(|rate| short(&rate.components()));
                format!("{}; velocity gradients {} and {}", place(s, rotation, &trials[0], pair), rates[0], rates[1])
            });
        }
    }
    Ok(worst.into())
}

/// The moment of momentum is kept: (∂ψ/∂F) Fᵀ has no skew part, and a spin on top of a velocity gradient, or its transpose, changes no stress.
pub(super) fn symmetry(s: &Setting<'_>) -> Checked {
    let reads_rates = s.subject.has(BARCHAN_CAP_VEL_GRAD);
    let has_energy = s.subject.table().energy_f64.is_some();
    if !reads_rates && !has_energy {
        return not_asked("it gives no energy, and does not declare BARCHAN_CAP_VEL_GRAD");
    }
    let scales = s.scales()?;
    let mut random = Random::new(19);
    let mut worst = Worst::default();
    for (center, size) in [(0.9995, 1e-3), (0.9, 0.2)] {
        for f in s.deformations(20, 10, center, size) {
            if let Some(slope) = energy_slope(s, f)? {
                let all = slope.components();
                let skew = [all[1] - all[3], all[2] - all[6], all[5] - all[7]];
                worst.see(0.5 * greatest(&skew) / greatest(&all).max(scales.modulus), || {
                    format!(": at F = {} the energy's derivative is {}", short(&f.components()), stress(&all))
                });
            }
            if !reads_rates {
                continue;
            }
            let rate = scaled(random.matrix(), RATE);
            let same = [rate, sum(rate, spin(&mut random)), rate.transpose(), SymMat3::into(rate.symmetric_part())];
            let trials = same.map(|rate| Particle { vel_grad: rate.components(), ..s.particle(f) });
            let answers = s.update_in(s.best, DT, &trials)?;
            for (trial, answer) in trials.iter().zip(&answers).skip(1) {
                worst.see(scales.stress(&answers[0].kirchhoff, &answer.kirchhoff), || {
                    let rates = [&trials[0], trial].map(|trial| short(&trial.vel_grad));
                    let stresses = [answers[0], *answer].map(|answer| stress(&answer.kirchhoff));
                    format!(
                        ": the velocity gradients {} and {} deform alike, but make {} and {}",
                        rates[0], rates[1], stresses[0], stresses[1]
                    )
                });
            }
        }
    }
    Ok(worst.into())
}
