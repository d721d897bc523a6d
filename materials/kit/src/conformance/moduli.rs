//! What bounds the time step, against what is measured: tangent moduli and viscosity.

use super::setting::{MaxOrNan, Setting, distance, short, stretch_along, stretched};
use super::{Checked, Worst, not_asked, sound};
use crate::random::Random;
use crate::subject::{Particle, Precision};
use crate::tensor::Mat3;
use barchan_abi::{BARCHAN_CAP_HARDENS, BARCHAN_CAP_VEL_GRAD};

const NO_MODULI: &str = "it has no tangent_moduli_f32";

/// λ + 2μ and 3λ + 2μ [Pa] as the law gives them.
fn given(s: &Setting<'_>, particles: &[Particle]) -> Result<Option<Vec<[f64; 2]>>, String> {
    s.subject.tangent_moduli(s.params, particles).map_err(|e| format!("tangent_moduli: {e}"))
}

/// A particle's stiffness against a small strain.
struct Slope {
    /// Change of the stress along the strain, over the strain [Pa].
    value: f64,
    /// Does the stress come back with the strain?
    reversible: bool,
}

/// Along the axis `n`, or in all directions; `strain` is signed.
fn slope(s: &Setting<'_>, from: &Particle, n: Option<[f64; 3]>, strain: f64) -> Result<Slope, String> {
    let stretch = |h: f64| match n {
        Some(n) => stretch_along(n, h),
        None => stretched(Mat3::identity(), [h.exp(); 3]),
    };
    let along = |t: &[f64; 6]| match n {
        Some([x, y, z]) => {
            x * x * t[0] + y * y * t[1] + z * z * t[2] + 2.0 * (x * y * t[3] + x * z * t[4] + y * z * t[5])
        }
        None => (t[0] + t[1] + t[2]) / 3.0,
    };
    let before = s.answer(0.0, from)?;
    let trial = s.deformed(&Setting::after(&before), stretch(strain));
    let strained = s.answer(0.0, &trial)?;
    let halfway = s.answer(0.0, &s.deformed(&Setting::after(&before), stretch(0.5 * strain)))?;
    let back = s.answer(0.0, &s.deformed(&Setting::after(&strained), stretch(-strain)))?;
    let change = distance(&before.kirchhoff, &strained.kirchhoff);
    let part = if s.best == Precision::F64 { 1e-3 } else { 0.05 };
    let slope = |to: f64, strain: f64| (to - along(&before.kirchhoff)) / strain;
    // Stress may come back over the tip of a cone, too.
    let reversible = s.yields(&trial)? != Some(true) && distance(&before.kirchhoff, &back.kirchhoff) <= part * change;
    let whole = slope(along(&strained.kirchhoff), strain);
    // Extrapolated to no strain: to one side only, for on the other a law may yield, and not over a kink.
    let extrapolated = 2.0 * slope(along(&halfway.kirchhoff), 0.5 * strain) - whole;
    let is_smooth = (extrapolated - whole).abs() <= 0.01 * whole.abs();
    Ok(Slope { value: if is_smooth { extrapolated } else { whole }, reversible })
}

const NAMES: [&str; 2] = ["lambda + 2 mu", "3 lambda + 2 mu"];

/// They are the slopes of the stress; where a law yields at once, no less.
pub(super) fn at_rest(s: &Setting<'_>) -> Checked {
    let rest = s.subject.particle_at_rest();
    let Some(moduli) = given(s, &[rest])? else { return not_asked(NO_MODULI) };
    let mut worst = Worst::default();
    for (i, n) in [Some([1.0, 0.0, 0.0]), None].into_iter().enumerate() {
        let Slope { value, reversible } = slope(s, &rest, n, -s.small())?;
        let error = moduli[0][i] / value - 1.0;
        worst.see(if reversible { error.abs() } else { 0f64.max_or_nan(-error) }, || {
            format!(": {} is given as {:.6e} Pa, the stress says {value:.6e} Pa", NAMES[i], moduli[0][i])
        });
    }
    Ok(worst.into())
}

pub(super) fn are_positive(s: &Setting<'_>) -> Checked {
    let particles = s.particles();
    let Some(moduli) = given(s, &particles)? else { return not_asked(NO_MODULI) };
    match moduli.iter().position(|m| !(m[0] > 0.0 && m[1] > 0.0)) {
        None => sound(),
        Some(i) => Err(format!("they are {:?} Pa at strain {:?}", moduli[i], particles[i].strain)),
    }
}

/// Along the principal axes and in all directions, compressed and stretched, the stress grows no faster than the moduli say: else the time
/// step that they give is not stable.
pub(super) fn bound_the_tangent(s: &Setting<'_>) -> Checked {
    let Some(at_rest) = given(s, &[s.subject.particle_at_rest()])? else { return not_asked(NO_MODULI) };
    let mut random = Random::new(21);
    let mut worst = Worst::default();
    for size in [0.0, 1e-3, 0.05, 0.3] {
        for number in 0..8 {
            let axes = random.rotation();
            // The first ones alike in all directions, which the weakest law bears.
            let alike = [-size, size].get(number).copied();
            let stretches = [0; 3].map(|_| alike.unwrap_or_else(|| size * random.signed()).exp());
            let trial = s.particle(stretched(axes, stretches));
            let particle = Setting::after(&s.answer(0.0, &trial)?);
            // Without the capability the host asks once, before the first step.
            let present = if s.subject.has(BARCHAN_CAP_HARDENS) { given(s, &[particle])? } else { None };
            let moduli = present.map_or(at_rest[0], |present| present[0]);
            let columns = axes.transpose().rows;
            for (i, n) in [(0, Some(columns[0])), (0, Some(columns[1])), (0, Some(columns[2])), (1, None)] {
                for sign in [-1.0, 1.0] {
                    let Slope { value, reversible } = slope(s, &particle, n, sign * s.small())?;
                    if !reversible {
                        continue;
                    }
                    worst.see(0f64.max_or_nan(value / moduli[i] - 1.0), || {
                        let strain = short(&particle.strain[..s.subject.strain_planes()]);
                        let once = if s.subject.has(BARCHAN_CAP_HARDENS) {
                            ""
                        } else {
                            " (asked once, at rest: the law does not declare BARCHAN_CAP_HARDENS)"
                        };
                        format!(
                            ": at strain {strain} {} is given as {:.6e} Pa{once}, the stress says {value:.6e} Pa",
                            NAMES[i], moduli[i]
                        )
                    });
                }
            }
        }
    }
    Ok(worst.into())
}

/// A stress that follows the rate of deformation D is at most 2 η |D|, for the η that bounds the time step.
pub(super) fn viscosity(s: &Setting<'_>) -> Checked {
    if !s.subject.has(BARCHAN_CAP_VEL_GRAD) {
        return not_asked("it does not declare BARCHAN_CAP_VEL_GRAD");
    }
    let lost = if s.best == Precision::F64 { 1e-12 } else { 1e-5 };
    let mut random = Random::new(22);
    let mut worst = Worst::default();
    for (center, size) in [(1.0, 0.0), (0.9995, 1e-3), (0.95, 0.1)] {
        for f in s.deformations(23, 6, center, size) {
            for rate in [1.0, 1e3] {
                let rate = Mat3::from_components(random.matrix().components().map(|x| rate * x));
                let still = s.particle(f);
                let moving = Particle { vel_grad: rate.components(), ..still };
                let answers = s.update(s.best, &[still, moving])?;
                let change: [f64; 6] = core::array::from_fn(|c| answers[1].kirchhoff[c] - answers[0].kirchhoff[c]);
                let norm = |t: [f64; 6]| crate::tensor::SymMat3::from_components(t).norm_squared().sqrt();
                if norm(change) <= lost * norm(answers[1].kirchhoff) {
                    continue;
                }
                let after = [Setting::after(&answers[0])];
                let given = s.subject.viscosity(s.params, &after).map_err(|e| format!("viscosity: {e}"))?;
                let Some(given) = given else {
                    return Err("stress follows the rate of deformation, but there is no viscosity_f32: the time step would not know of it".into());
                };
                let found = norm(change) / (2.0 * norm(rate.symmetric_part().components()));
                worst.see(0f64.max_or_nan(found / given[0] - 1.0), || {
                    let rate = short(&rate.components());
                    format!(": it is given as {:.6e} Pa s, the stress at velocity gradient {rate} 1/s says {found:.6e} Pa s", given[0])
                });
            }
        }
    }
    Ok(worst.into())
}
