//! The step that materials' stiffness allows, asked of their laws on the host.

use barchan_abi as abi;
use barchan_core::backend::Bound;
use barchan_core::material::{ErrorBuffer, stable_step};
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Error, ParticleList, Result};

const LANES: usize = 16;

/// The least stable step of all particles in cells of width `h` [m].
pub(crate) fn bound(lists: &[ParticleList], materials: &[PlannedMaterial], h: f64) -> Result<Bound> {
    let mut bound = Bound { dt: f64::INFINITY, by: "nothing".into() };
    for list in lists {
        let planned = &materials[list.material as usize];
        // A law that does not harden is as stiff everywhere as at its first particle.
        let hardens = planned.material.has(abi::BARCHAN_CAP_HARDENS);
        let count = if hardens { list.len() } else { list.len().min(LANES) };
        for from in (0..count).step_by(LANES) {
            let least = of_chunk(list, from, (count - from).min(LANES), planned, h)?;
            if least < bound.dt {
                bound = Bound { dt: least, by: format!("stiffness of material '{}'", planned.name) };
            }
        }
    }
    Ok(bound)
}

fn of_chunk(list: &ParticleList, from: usize, count: usize, planned: &PlannedMaterial, h: f64) -> Result<f64> {
    let Some(moduli) = planned.material.table.tangent_moduli_f32 else { return Ok(f64::INFINITY) };
    /// One plane, aligned as the ABI promises.
    #[derive(Clone, Copy)]
    #[repr(C, align(64))]
    struct Plane([f32; LANES]);
    // Lanes without a particle repeat the last one: laws see nothing they have not seen.
    let filled = |plane: &Vec<f64>| Plane(std::array::from_fn(|i| plane[from + i.min(count - 1)] as f32));
    let strain: Vec<_> = list.strain.iter().map(filled).collect();
    let state: Vec<_> = list.state.iter().map(filled).collect();
    // Stiffness is asked of matter at rest.
    let no_rate = [Plane([0.0; LANES]); 9];
    let mut out = [Plane([0.0; LANES]); 2];
    let params: Vec<f32> = planned.parameters.iter().map(|&p| p as f32).collect();
    let batch = abi::BarchanBatchF32 {
        struct_size: size_of::<abi::BarchanBatchF32>(),
        n: LANES,
        stride: LANES,
        dt: 0.0,
        reserved: 0,
        params: params.as_ptr(),
        strain_trial: strain.as_ptr().cast(),
        vel_grad: no_rate.as_ptr().cast(),
        state_in: state.as_ptr().cast(),
        strain: std::ptr::null_mut(),
        kirchhoff: std::ptr::null_mut(),
        state_out: std::ptr::null_mut(),
    };
    let mut message = ErrorBuffer::default();
    // SAFETY: the planes that this callback reads, and the two that it writes, hold 16 values each.
    let status = unsafe { moduli(&batch, out.as_mut_ptr().cast(), message.as_raw()) };
    let id = |i: u64| usize::try_from(i).ok().filter(|i| *i < count).map_or(u64::MAX, |i| list.id[from + i]);
    message.check(status, &planned.material, "tangent_moduli", id)?;
    let mut least = f64::INFINITY;
    for i in 0..count {
        let [p_wave, bulk] = [out[0].0[i], out[1].0[i]].map(f64::from);
        if !(p_wave.is_finite() && bulk.is_finite() && p_wave > 0.0 && bulk > 0.0) {
            return Err(Error::MaterialFailed {
                material: planned.name.clone(),
                origin: planned.material.origin.clone(),
                callback: "tangent_moduli",
                message: format!("the moduli are {:?} Pa; they must be finite and above 0", [p_wave, bulk]),
                particle: Some(list.id[from + i]),
            });
        }
        least = least.min(stable_step(h, list.mass[from + i] / list.volume0[from + i], p_wave, bulk));
    }
    Ok(least)
}
