//! Stress of particles as they are, for pictures and probes.

use barchan_abi::{BARCHAN_CAP_VEL_GRAD, BarchanBatchF64};
use barchan_core::material::ErrorBuffer;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Error, ParticleList, Result};

/// Kirchhoff stress of the particles `which` of a list [Pa]: xx, yy, zz, xy, xz, yz.
///
/// Asks the material for its update over no time at all, which by contract leaves strain and state as they are.
///
/// # Errors
/// If the material has no f64 update, or fails.
pub fn kirchhoff(material: &PlannedMaterial, list: &ParticleList, which: &[usize]) -> Result<Vec<[f64; 6]>> {
    let law = &material.material;
    let update = law.table.update_f64.ok_or_else(|| Error::Missing {
        kind: "material",
        name: law.name.clone(),
        origin: law.origin.clone(),
        what: "f64 update".to_owned(),
        why: "pictures and probes ask for stress in f64".to_owned(),
        mend: "set output.picture.cut to \"speed\", or give the plugin update_f64".to_owned(),
    })?;
    if which.is_empty() {
        return Ok(Vec::new());
    }
    let stride = which.len().next_multiple_of(16);
    // Padded lanes are at rest, so that no material sees a singular strain.
    let planes = |of: &[Vec<f64>], rest: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let plane = |(c, values): (usize, &Vec<f64>)| {
            let mut plane = vec![rest(c); stride];
            plane.iter_mut().zip(which).for_each(|(out, &i)| *out = values[i]);
            plane
        };
        of.iter().enumerate().flat_map(plane).collect()
    };
    let identity = law.strain_identity();
    let strain = planes(&list.strain, &|c| identity[c]);
    let state = planes(&list.state, &|c| law.states[c].initial);
    let no_gradient = law.has(BARCHAN_CAP_VEL_GRAD).then(|| vec![0.0; 9 * stride]);
    let mut strain_out = strain.clone();
    let mut state_out = state.clone();
    let mut tau = vec![0.0; 6 * stride];
    let batch = BarchanBatchF64 {
        struct_size: size_of::<BarchanBatchF64>(),
        n: which.len(),
        stride,
        dt: 0.0,
        params: material.parameters.as_ptr(),
        strain_trial: strain.as_ptr(),
        vel_grad: no_gradient.as_ref().map_or(std::ptr::null(), |zeros| zeros.as_ptr()),
        state_in: if state.is_empty() { std::ptr::null() } else { state.as_ptr() },
        strain: strain_out.as_mut_ptr(),
        kirchhoff: tau.as_mut_ptr(),
        state_out: if state.is_empty() { std::ptr::null_mut() } else { state_out.as_mut_ptr() },
    };
    let mut error = ErrorBuffer::default();
    // SAFETY: every plane holds `stride` values and there are as many planes as the table declares; nothing overlaps and
    // all buffers outlive the call.
    let status = unsafe { update(&raw const batch, error.as_raw()) };
    error.check(status, law, "update_f64", |i| list.id[which[i as usize]])?;
    Ok((0..which.len()).map(|i| std::array::from_fn(|c| tau[c * stride + i])).collect())
}

/// Pressure of the particles `which` of a list [Pa]: minus a third of the trace of the Cauchy stress.
///
/// # Errors
/// If the material has no f64 update, or fails.
pub fn pressure(material: &PlannedMaterial, list: &ParticleList, which: &[usize]) -> Result<Vec<f64>> {
    let volume = |i: usize| {
        let s = |c: usize| list.strain[c][i];
        match list.strain.len() {
            9 => {
                s(0) * (s(4) * s(8) - s(5) * s(7)) - s(1) * (s(3) * s(8) - s(5) * s(6))
                    + s(2) * (s(3) * s(7) - s(4) * s(6))
            }
            _ => {
                let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(s);
                (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)).max(0.0).sqrt()
            }
        }
    };
    let tau = kirchhoff(material, list, which)?;
    Ok(which.iter().zip(tau).map(|(&i, t)| -(t[0] + t[1] + t[2]) / (3.0 * volume(i))).collect())
}
