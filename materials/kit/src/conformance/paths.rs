//! Strain paths: steps of any length and number, and closed cycles.

use super::contract::what;
use super::elastic::energies;
use super::setting::{MaxOrNan, Setting, distance, greatest, short, stress, stretched};
use super::{Checked, Worst, not_asked};
use crate::random::Random;
use crate::subject::{Answer, Particle, Precision};
use crate::tensor::{Mat3, SymMat3};
use barchan_abi::{BARCHAN_CAP_MAY_MAKE_ENERGY, BARCHAN_CAP_RATE_DEPENDENT, BARCHAN_CAP_VEL_GRAD};

/// Why a law need not answer alike at every rate.
fn rate_dependence(s: &Setting<'_>) -> Option<&'static str> {
    if s.subject.has(BARCHAN_CAP_RATE_DEPENDENT) {
        return Some("it declares BARCHAN_CAP_RATE_DEPENDENT");
    }
    s.subject.has(BARCHAN_CAP_VEL_GRAD).then_some("it declares BARCHAN_CAP_VEL_GRAD")
}

/// The same trial strain over steps of other lengths.
pub(super) fn step_length(s: &Setting<'_>) -> Checked {
    if let Some(why) = rate_dependence(s) {
        return not_asked(why);
    }
    let scales = s.scales()?;
    let particles = s.particles();
    let first = s.update_in(s.best, 1e-4, &particles)?;
    let mut worst = Worst::default();
    for dt in [1e-7, 1e-2, 10.0] {
        for ((a, b), p) in first.iter().zip(&s.update_in(s.best, dt, &particles)?).zip(&particles) {
            worst.see(scales.difference(a, b), || {
                let strain = short(&p.strain[..s.subject.strain_planes()]);
                format!(
                    ": trial strain {strain} gives {} over 1e-4 s, and {} over {dt} s; a law that creeps declares BARCHAN_CAP_RATE_DEPENDENT",
                    what(s, a),
                    what(s, b)
                )
            });
        }
    }
    Ok(worst.into())
}

/// A straight path of logarithmic strain, in 1, 4 and 64 steps, relative to the path's length.
pub(super) fn step_count(s: &Setting<'_>) -> Checked {
    if let Some(why) = rate_dependence(s) {
        return not_asked(why);
    }
    let scales = s.scales()?;
    let mut random = Random::new(24);
    let mut worst = Worst::default();
    for size in [0.01, 0.1] {
        for number in 0..12 {
            let axes = random.rotation();
            let alike = [-size, size].get(number).copied();
            let strain = [0; 3].map(|_| alike.unwrap_or_else(|| size * random.signed()));
            let ends = [1u32, 4, 64].map(|steps| {
                let step = stretched(axes, strain.map(|e| (e / f64::from(steps)).exp()));
                let mut particle = s.subject.particle_at_rest();
                let mut answer = s.answer(1e-4, &particle)?;
                for _ in 0..steps {
                    answer = s.answer(1e-4, &s.deformed(&particle, step))?;
                    particle = Setting::after(&answer);
                }
                Ok::<Answer, String>(answer)
            });
            let [one, four, many] = ends;
            let (one, four, many) = (one?, four?, many?);
            for (steps, answer) in [(1, one), (4, four)] {
                worst.see(scales.difference(&answer, &many) / size, || {
                    format!(
                        ": principal strains {} in {steps} steps give {}, in 64 steps {}",
                        short(&strain),
                        what(s, &answer),
                        what(s, &many)
                    )
                });
            }
        }
    }
    Ok(worst.into())
}

fn inverse(m: Mat3<f64>) -> Mat3<f64> {
    let [a, b, c] = m.rows;
    let cross = |u: [f64; 3], v: [f64; 3]| {
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]].map(|x| x / m.determinant())
    };
    // Its columns are the cross products of the rows.
    Mat3 { rows: [cross(b, c), cross(c, a), cross(a, b)] }.transpose()
}

/// A closed path of the deformation gradient that starts and ends at I.
struct Cycle {
    size: f64,
    there: [f64; 9],
    around: [f64; 9],
}

/// Steps once around.
const STEPS: u32 = 512;

impl Cycle {
    /// Cycles of a size: one of volume alone, in compression, others of all kinds.
    fn all(size: f64, count: usize) -> Vec<Self> {
        let mut random = Random::new(25);
        (0..count)
            .map(|number| match number {
                0 => Self { size, there: [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0], around: [0.0; 9] },
                _ => Self { size, there: random.matrix().components(), around: random.matrix().components() },
            })
            .collect()
    }

    /// After so many steps.
    fn at(&self, step: u32) -> Mat3<f64> {
        let angle = core::f64::consts::TAU * f64::from(step % STEPS) / f64::from(STEPS);
        let mut f = Mat3::identity().components();
        for (i, x) in f.iter_mut().enumerate() {
            *x += self.size * (0.5 * (1.0 - angle.cos()) * self.there[i] + 0.5 * angle.sin() * self.around[i]);
        }
        Mat3::from_components(f)
    }

    /// What carries the deformation gradient from one step to the next, and the logarithm of that to the second order.
    fn increment(&self, step: u32) -> (Mat3<f64>, Mat3<f64>) {
        let (old, new) = (self.at(step), self.at(step + 1));
        let pick = |of: &dyn Fn(f64, f64) -> f64| {
            let (old, new) = (old.components(), new.components());
            Mat3::from_components(core::array::from_fn(|i| of(old[i], new[i])))
        };
        (new * inverse(old), pick(&|o, n| n - o) * inverse(pick(&|o, n| 0.5 * (o + n))))
    }
}

/// Work of the mean of two stresses along a strain [J/m³].
fn work(before: &[f64; 6], after: &[f64; 6], strain: SymMat3<f64>) -> f64 {
    let mean: [f64; 6] = core::array::from_fn(|c| 0.5 * (before[c] + after[c]));
    let strain = strain.components();
    (0..6).map(|c| if c < 3 { 1.0 } else { 2.0 } * mean[c] * strain[c]).sum()
}

/// A cycle that is elastic all along ends at the stress and the energy that it began with, and has taken no work. Velocity gradients are not
/// given: what follows them is not elastic.
pub(super) fn elastic_cycles(s: &Setting<'_>) -> Checked {
    if s.subject.has(BARCHAN_CAP_RATE_DEPENDENT) {
        return not_asked("it declares BARCHAN_CAP_RATE_DEPENDENT");
    }
    // In f32, small cycles are lost in the rounding of their steps.
    let sizes: &[f64] = if s.best == Precision::F64 { &[1e-5, 1e-3, 0.03, 0.2] } else { &[0.1, 0.2] };
    let (mut worst, mut elastic) = (Worst::default(), 0);
    for &size in sizes {
        'cycles: for (number, cycle) in Cycle::all(size, 5).iter().enumerate() {
            let mut particle = s.subject.particle_at_rest();
            let start = s.answer(0.0, &particle)?;
            let (mut last, mut sum, mut most_work, mut most_stress) = (start, 0.0, 0f64, 0f64);
            for step in 0..STEPS {
                let (carried, strain) = cycle.increment(step);
                let trial = s.deformed(&particle, carried);
                let answer = s.answer(1e-4, &trial)?;
                if !s.is_elastic(&trial, &answer)? {
                    continue 'cycles;
                }
                sum += work(&last.kirchhoff, &answer.kirchhoff, strain.symmetric_part());
                most_work = most_work.max_or_nan(sum.abs());
                most_stress = most_stress.max_or_nan(greatest(&answer.kirchhoff));
                (particle, last) = (Setting::after(&answer), answer);
            }
            elastic += 1;
            let place = |what: String| format!(": cycle {number} of size {size}, elastic all along, {what}");
            let off = distance(&start.kirchhoff, &last.kirchhoff);
            worst.see(off / most_stress, || {
                place(format!(
                    "ends at stress {}, after up to {most_stress:.3e} Pa on the way",
                    stress(&last.kirchhoff)
                ))
            });
            worst.see(sum.abs() / most_work, || {
                place(format!("takes work of {sum:.3e} J/m³, after up to {most_work:.3e} J/m³ on the way"))
            });
            if let Some(energy) = energies(s, &[s.subject.particle_at_rest(), particle])? {
                worst.see((energy[1] - energy[0]).abs() / most_work, || {
                    place(format!("changes the energy by {:.3e} J/m³", energy[1] - energy[0]))
                });
            }
        }
    }
    if elastic == 0 { not_asked("none of the cycles tried is elastic") } else { Ok(worst.into()) }
}

/// Where strain is the same in all directions, what the rate of deformation adds to the stress takes power from it: the stored energy does not know of
/// the rate.
fn rates_take_power(s: &Setting<'_>, worst: &mut Worst) -> Result<(), String> {
    let lost = if s.best == Precision::F64 { 1e-12 } else { 1e-5 };
    let mut random = Random::new(26);
    for stretch in [1.0, 0.99, 1.01] {
        let still = s.particle(stretched(Mat3::identity(), [stretch; 3]));
        for _ in 0..6 {
            let rate = random.matrix();
            let moving = Particle { vel_grad: rate.components(), ..still };
            let answers = s.update(s.best, &[still, moving])?;
            let added = core::array::from_fn(|c| answers[1].kirchhoff[c] - answers[0].kirchhoff[c]);
            if greatest(&added) <= lost * greatest(&answers[1].kirchhoff) {
                continue;
            }
            let rate = rate.symmetric_part();
            let norms = SymMat3::from_components(added).norm_squared().sqrt() * rate.norm_squared().sqrt();
            worst.see(0f64.max_or_nan(-work(&added, &added, rate) / norms), || {
                let rate = short(&rate.components());
                format!(": the rate of deformation {rate} 1/s adds stress {}, which drives it on", stress(&added))
            });
        }
    }
    Ok(())
}

/// Twice around closed cycles from rest, at a rate: the work done on a particle is nowhere less than what it stores, and the second time around
/// takes no less than it adds to the store. Of a law without an energy only that is known which rest says: the work is nowhere below zero.
pub(super) fn dissipation(s: &Setting<'_>) -> Checked {
    const DT: f64 = 1e-2;
    if s.subject.has(BARCHAN_CAP_MAY_MAKE_ENERGY) && s.params != s.subject.default_params() {
        return not_asked("it declares BARCHAN_CAP_MAY_MAKE_ENERGY, which leaves only its defaults to be held to this");
    }
    let sizes: &[f64] = if s.best == Precision::F64 { &[1e-4, 3e-3, 0.03, 0.2] } else { &[0.1, 0.2] };
    let mut worst = Worst::default();
    if s.subject.has(BARCHAN_CAP_VEL_GRAD) {
        rates_take_power(s, &mut worst)?;
    }
    for &size in sizes {
        let cycles = Cycle::all(size, 8);
        let mut particles: Vec<Particle> = vec![s.subject.particle_at_rest(); cycles.len()];
        let mut answers = s.update(s.best, &particles)?;
        let at_rest = energies(s, &particles)?;
        // Of each cycle: the work, the greatest size of work and energy, what is lost when a lap begins, and how much has come from nowhere.
        let mut sums = vec![[0f64; 4]; cycles.len()];
        for step in 0..2 * STEPS {
            let moves: Vec<_> = cycles.iter().map(|cycle| cycle.increment(step)).collect();
            for (particle, (carried, _)) in particles.iter_mut().zip(&moves) {
                let mut rate = carried.components();
                [0, 4, 8].into_iter().for_each(|d| rate[d] -= 1.0);
                *particle = Particle { vel_grad: rate.map(|x| x / DT), ..s.deformed(particle, *carried) };
            }
            let next = s.update_in(s.best, DT, &particles)?;
            particles = next.iter().map(Setting::after).collect();
            let energy = energies(s, &particles)?;
            for (i, [sum, scale, lost_before, made]) in sums.iter_mut().enumerate() {
                *sum += work(&answers[i].kirchhoff, &next[i].kirchhoff, moves[i].1.symmetric_part());
                let stored = match (&energy, &at_rest) {
                    (Some(energy), Some(at_rest)) => Some(energy[i] - at_rest[i]),
                    _ => None,
                };
                *scale = scale.max_or_nan(sum.abs()).max_or_nan(stored.unwrap_or(0.0).abs());
                let lost = *sum - stored.unwrap_or(0.0);
                *made = made.max_or_nan(-lost);
                if stored.is_some() && (step + 1) % STEPS == 0 {
                    *made = made.max_or_nan(*lost_before - lost);
                    *lost_before = lost;
                }
            }
            answers = next;
        }
        for (number, [sum, scale, _, made]) in sums.into_iter().enumerate() {
            // What never bore stress, such as a fluid that is only sheared, has no scale.
            worst.see(if made <= 0.0 { made } else { made / scale }, || {
                format!(
                    ": cycle {number} of size {size} gives {made:.3e} J/m³ more than was put in, of up to {scale:.3e} J/m³ on the way; its work in all is {sum:.3e} J/m³"
                )
            });
        }
    }
    Ok(worst.into())
}
