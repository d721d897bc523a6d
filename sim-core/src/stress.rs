//! Stress of particles as they are, for pictures and probes.

use crate::account::BATCH;
use crate::batch::{Answer, Matter, Plane};
use crate::material::ErrorBuffer;
use crate::plan::PlannedMaterial;
use crate::{Error, ParticleList, Result};

/// Kirchhoff stress of the particles `which` of a list [Pa]: xx, yy, zz, xy, xz, yz.
///
/// Asks the material for its update over no time at all, which by contract leaves strain and state as they are.
///
/// # Errors
/// If the material has no f64 update, or fails.
pub fn kirchhoff(material: &PlannedMaterial, list: &ParticleList, which: &[usize]) -> Result<Vec<[f64; 6]>> {
    let law = &material.material;
    let mut stress = Vec::with_capacity(which.len());
    for which in which.chunks(BATCH) {
        // The last particle stands in for those behind it, so that no material sees a strain that nothing can have.
        let fill = |values: &Vec<f64>| Plane(std::array::from_fn(|i| values[which[i.min(which.len() - 1)]]));
        let strain: Vec<Plane<f64, BATCH>> = list.strain.iter().map(fill).collect();
        let state: Vec<_> = list.state.iter().map(fill).collect();
        let matter = Matter { count: which.len(), parameters: &material.parameters, strain: &strain, state: &state };
        let (mut strain, mut state, mut tau) = (strain.clone(), state.clone(), [Plane::default(); 6]);
        let answer = Answer { strain: &mut strain, kirchhoff: &mut tau, state: &mut state };
        let mut error = ErrorBuffer::default();
        let status = law.update(&matter, None, answer, &mut error).ok_or_else(|| Error::Missing {
            kind: "material",
            name: law.name.clone(),
            origin: law.origin.clone(),
            what: "f64 update".to_owned(),
            why: "pictures and probes ask for stress in f64".to_owned(),
            mend: "set output.picture.cut to \"speed\", or give the plugin update_f64".to_owned(),
        })?;
        // A callback may name any particle at all.
        let named = |i: u64| usize::try_from(i).ok().and_then(|i| which.get(i)).map_or(u64::MAX, |&i| list.id[i]);
        error.check(status, law, "update_f64", named)?;
        stress.extend((0..which.len()).map(|i| tau.map(|plane| plane.0[i])));
    }
    Ok(stress)
}

/// How many times its rest volume a particle has, as far as its strain tells: of F, or of the elastic left Cauchy-Green tensor.
pub fn volume_ratio(list: &ParticleList, i: usize) -> f64 {
    let s = |c: usize| list.strain[c][i];
    match list.strain.len() {
        9 => {
            s(0) * (s(4) * s(8) - s(5) * s(7)) - s(1) * (s(3) * s(8) - s(5) * s(6)) + s(2) * (s(3) * s(7) - s(4) * s(6))
        }
        _ => {
            let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(s);
            (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)).max(0.0).sqrt()
        }
    }
}

/// Pressure of the particles `which` of a list [Pa]: minus a third of the trace of the Cauchy stress.
///
/// # Errors
/// If the material has no f64 update, or fails.
pub fn pressure(material: &PlannedMaterial, list: &ParticleList, which: &[usize]) -> Result<Vec<f64>> {
    let tau = kirchhoff(material, list, which)?;
    Ok(which.iter().zip(tau).map(|(&i, t)| -(t[0] + t[1] + t[2]) / (3.0 * volume_ratio(list, i))).collect())
}
