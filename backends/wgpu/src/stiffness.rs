//! The step that materials' stiffness allows, asked of their laws on the host.

use crate::layout::law_of;
use barchan_abi as abi;
use barchan_core::backend::Bound;
use barchan_core::material::{ErrorBuffer, stable_step};
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Error, ParticleList, Result};
use rayon::prelude::*;

const LANES: usize = 16;
/// Particles that are worth a thread.
const GRAIN: usize = 1 << 14;

/// One plane of a chunk, aligned as the ABI promises.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Plane([f32; LANES]);

/// The least stable step of all particles in the cells of their lists, of which the finest level takes so many within it.
pub(crate) fn bound(lists: &[ParticleList], materials: &[PlannedMaterial], substeps: u32) -> Result<Bound> {
    let mut bound = nothing();
    for list in lists {
        let planned = &materials[list.material as usize];
        let reach = list.cell_width * f64::from(steps_within(substeps, list.level));
        // A law that does not harden is as stiff everywhere as at its first particle.
        let hardens = planned.material.has(abi::BARCHAN_CAP_HARDENS);
        let count = if hardens { list.len() } else { list.len().min(LANES) };
        for from in (0..count).step_by(LANES) {
            let n = (count - from).min(LANES);
            // Lanes without a particle repeat the last one: laws see nothing they have not seen.
            let fill = |plane: &Vec<f64>| Plane(std::array::from_fn(|i| plane[from + i.min(n - 1)] as f32));
            let planes: Vec<_> = list.strain.iter().chain(&list.state).map(fill).collect();
            let density = |i: usize| list.mass[from + i] / list.volume0[from + i];
            let least = of_chunk(&planes, n, planned, reach, density, |i| Some(list.id[from + i]))?;
            tighten(&mut bound, least, planned);
        }
    }
    Ok(bound)
}

/// Steps that a level takes within one of the simulation, of which the finest takes so many.
pub(crate) fn steps_within(substeps: u32, level: u32) -> u32 {
    (substeps >> level).max(1)
}

/// Strain and history as the device holds them, and the particles' places if there are several laws.
pub(crate) struct Held<'a> {
    pub(crate) rest: &'a [[f32; 4]],
    pub(crate) places: Option<&'a [[u32; 4]]>,
    pub(crate) slots: usize,
    pub(crate) count: usize,
}

/// The least stable step of particles whose law hardens, with at least the density that each law has in `densities` [kg/m³].
pub(crate) fn bound_of_hardening(
    held: &Held<'_>,
    materials: &[PlannedMaterial],
    densities: &[f64],
    h: f64,
) -> Result<Bound> {
    let mut bound = nothing();
    for (law, planned) in materials.iter().enumerate().filter(|(_, m)| m.material.has(abi::BARCHAN_CAP_HARDENS)) {
        let starts: Vec<usize> = (0..held.count).step_by(GRAIN).collect();
        let of_stretch = |from| of_stretch(held, law, planned, densities[law], h, from);
        let least: Vec<Result<f64>> = starts.into_par_iter().map(of_stretch).collect();
        for least in least {
            tighten(&mut bound, least?, planned);
        }
    }
    Ok(bound)
}

/// The least step of one law's particles among [`GRAIN`] slots from `from` on.
fn of_stretch(
    held: &Held<'_>,
    law: usize,
    planned: &PlannedMaterial,
    density: f64,
    h: f64,
    from: usize,
) -> Result<f64> {
    let is_own = |q: &usize| held.places.is_none_or(|places| law_of(places[*q][3]) == law);
    let own: Vec<usize> = (from..(from + GRAIN).min(held.count)).filter(is_own).collect();
    let identity = planned.material.strain_identity();
    let planes = identity.len() + planned.material.states.len();
    let mut least = f64::INFINITY;
    for chunk in own.chunks(LANES) {
        let value = |k: usize, q: usize| {
            // Strain is held minus I.
            held.rest[k / 4 * held.slots + q][k % 4] + identity.get(k).map_or(0.0, |one| *one as f32)
        };
        let fill = |k: usize| Plane(std::array::from_fn(|i| value(k, chunk[i.min(chunk.len() - 1)])));
        let planes: Vec<_> = (0..planes).map(fill).collect();
        least = least.min(of_chunk(&planes, chunk.len(), planned, h, |_| density, |_| None)?);
    }
    Ok(least)
}

fn nothing() -> Bound {
    Bound { dt: f64::INFINITY, by: "nothing".into() }
}

fn tighten(bound: &mut Bound, least: f64, planned: &PlannedMaterial) {
    if least < bound.dt {
        *bound = Bound { dt: least, by: format!("stiffness of material '{}'", planned.name) };
    }
}

/// The least step of up to 16 particles: their planes of strain and history, densities and ids.
fn of_chunk(
    planes: &[Plane],
    count: usize,
    planned: &PlannedMaterial,
    h: f64,
    density: impl Fn(usize) -> f64,
    id: impl Fn(usize) -> Option<u64>,
) -> Result<f64> {
    let Some(moduli) = planned.material.table.tangent_moduli_f32 else { return Ok(f64::INFINITY) };
    let (strain, state) = planes.split_at(planned.material.strain_planes());
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
    let named = |i: u64| usize::try_from(i).ok().filter(|i| *i < count).and_then(&id).unwrap_or(u64::MAX);
    message.check(status, &planned.material, "tangent_moduli", named)?;
    let mut least = f64::INFINITY;
    for i in 0..count {
        let [p_wave, bulk] = [out[0].0[i], out[1].0[i]].map(f64::from);
        if !(p_wave.is_finite() && bulk.is_finite() && p_wave > 0.0 && bulk > 0.0) {
            return Err(Error::MaterialFailed {
                material: planned.name.clone(),
                origin: planned.material.origin.clone(),
                callback: "tangent_moduli",
                message: format!("the moduli are {:?} Pa; they must be finite and above 0", [p_wave, bulk]),
                particle: id(i),
            });
        }
        least = least.min(stable_step(h, density(i), p_wave, bulk));
    }
    Ok(least)
}
