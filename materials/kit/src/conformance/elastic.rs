//! Stress against the energy.

use super::contract::what;
use super::setting::{Setting, distance, greatest, short, stress};
use super::{Checked, Worst, not_asked};
use crate::subject::{Particle, Precision, SubjectError};
use crate::tensor::Mat3;

pub(super) const NO_ENERGY: &str = "it has no energy_f64";

/// Elastic energy [J/m³] of particles, if the law gives it.
pub(super) fn energies(s: &Setting<'_>, particles: &[Particle]) -> Result<Option<Vec<f64>>, String> {
    s.subject.energy(s.params, particles).map_err(|e: SubjectError| format!("energy: {e}"))
}

/// (∂ψ/∂F) Fᵀ by central differences, all nine components; `None` if the law gives no energy.
pub(super) fn energy_slope(s: &Setting<'_>, f: Mat3<f64>) -> Result<Option<Mat3<f64>>, String> {
    let step = 1e-6;
    let mut pairs = Vec::new();
    for component in 0..9 {
        for sign in [1.0, -1.0] {
            let mut varied = f.components();
            varied[component] += sign * step;
            pairs.push(s.particle(Mat3::from_components(varied)));
        }
    }
    let Some(energy) = energies(s, &pairs)? else { return Ok(None) };
    let mut piola = [0.0; 9];
    for (p, pair) in piola.iter_mut().zip(energy.chunks(2)) {
        *p = (pair[0] - pair[1]) / (2.0 * step);
    }
    Ok(Some(Mat3::from_components(piola) * f.transpose()))
}

pub(super) fn derives_from_energy(s: &Setting<'_>) -> Checked {
    let modulus = s.modulus()?;
    let mut deformations = s.deformations(9, 20, 0.999, 1e-4);
    deformations.extend(s.deformations(10, 20, 0.95, 0.03));
    deformations.extend(s.deformations(11, 20, 0.9, 0.2));
    // However weak a law is, it bears pressure, or tension.
    deformations.extend(s.deformations(0, 1, 1.001, 0.0));
    deformations.extend(s.deformations(0, 1, 0.999, 0.0));
    deformations.extend(s.deformations(0, 1, 0.95, 0.0));
    let (mut worst, mut elastic) = (Worst::default(), 0);
    for f in deformations {
        let particle = s.particle(f);
        let answer = s.answer(0.0, &particle)?;
        let Some(energy) = energies(s, &[particle, Setting::after(&answer)])? else { return not_asked(NO_ENERGY) };
        // Plastic flow loses energy, and there the stress is that of another strain. In f32 the strain given is rounded.
        let rounding = if s.best == Precision::F64 { 1e-12 } else { 1e-6 };
        if (energy[0] - energy[1]).abs() > rounding * modulus || !s.is_elastic(&particle, &answer)? {
            continue;
        }
        let Some(slope) = energy_slope(s, f)? else { return not_asked(NO_ENERGY) };
        elastic += 1;
        let expected = slope.symmetric_part().components();
        worst.see(distance(&expected, &answer.kirchhoff) / greatest(&expected).max(modulus), || {
            let f = short(&f.components());
            format!(": at F = {f} the energy's derivative is {}, but {}", stress(&expected), what(s, &answer))
        });
    }
    if elastic == 0 { Err("none of the deformations tried is elastic".into()) } else { Ok(worst.into()) }
}
