//! The step that materials' stiffness and viscosity allow, from callbacks of their laws on the host.

use crate::device::layout::law_of;
use crate::passes::laws::is_asked_on_device;
use barchan_abi as abi;
use barchan_core::backend::Bound;
use barchan_core::batch::Plane;
use barchan_core::plan::PlannedMaterial;
use barchan_core::stiffness::{Need, PARTICLES, Stiffness};
use barchan_core::{ParticleList, Result};
use rayon::prelude::*;

/// Particles that are worth a thread.
pub(crate) const GRAIN: usize = 1 << 14;

/// The least stable step of all particles in the cells of their lists, of which the finest level takes so many within it.
pub(crate) fn bound<'a>(
    lists: impl IntoIterator<Item = &'a ParticleList>,
    materials: &[PlannedMaterial],
    substeps: u32,
) -> Result<Bound> {
    let mut bound = nothing();
    for list in lists {
        let planned = &materials[list.material as usize];
        let Some(stiffness) = Stiffness::of(planned) else { continue };
        // A law that does not harden is as stiff everywhere as at its first particle.
        let hardens = planned.material.has(abi::BARCHAN_CAP_HARDENS);
        let count = if hardens { list.len() } else { list.len().min(PARTICLES) };
        let mut need = Need::default();
        for from in (0..count).step_by(PARTICLES) {
            let n = (count - from).min(PARTICLES);
            // Lanes without a particle repeat the last one: laws see nothing they have not seen.
            let fill = |plane: &Vec<f64>| Plane(std::array::from_fn(|i| plane[from + i.min(n - 1)] as f32));
            let strain: Vec<_> = list.strain.iter().map(fill).collect();
            let state: Vec<_> = list.state.iter().map(fill).collect();
            let of_lane = |i: usize| from + i.min(n - 1);
            let density = std::array::from_fn(|i| list.mass[of_lane(i)] / list.volume0[of_lane(i)]);
            let id = |i: usize| Some(list.id[from + i]);
            need = need.or(stiffness.need([&strain[..], &state[..]], n, (list.cell_width, &density), id)?);
        }
        bound = lesser(bound, stiffness.bound(need, steps_within(substeps, list.level)));
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

/// The least stable step of a level's particles whose law `is_asked`, with at least the density that each law has in `densities` [kg/m³].
pub(crate) fn bound_held(
    held: &Held<'_>,
    materials: &[PlannedMaterial],
    is_asked: fn(&PlannedMaterial) -> bool,
    densities: &[f64],
    (h, steps_within): (f64, u32),
) -> Result<Bound> {
    let mut bound = nothing();
    for (law, planned) in materials.iter().enumerate().filter(|(_, planned)| is_asked(planned)) {
        let Some(stiffness) = Stiffness::of(planned) else { continue };
        let starts: Vec<usize> = (0..held.count).step_by(GRAIN).collect();
        let of_stretch = |from| of_stretch(held, law, (planned, &stiffness), densities[law], h, from);
        let need = starts.into_par_iter().map(of_stretch).try_reduce(Need::default, |a, b| Ok(a.or(b)))?;
        bound = lesser(bound, stiffness.bound(need, steps_within));
    }
    Ok(bound)
}

/// What one law's particles need among [`GRAIN`] slots from `from` on.
pub(crate) fn of_stretch(
    held: &Held<'_>,
    law: usize,
    (planned, stiffness): (&PlannedMaterial, &Stiffness<'_>),
    density: f64,
    h: f64,
    from: usize,
) -> Result<Need> {
    let is_own = |q: &usize| held.places.is_none_or(|places| law_of(places[*q][3]) == law);
    let own: Vec<usize> = (from..(from + GRAIN).min(held.count)).filter(is_own).collect();
    let identity = planned.material.strain_identity();
    let planes = identity.len() + planned.material.states.len();
    let mut need = Need::default();
    for chunk in own.chunks(PARTICLES) {
        let value = |k: usize, q: usize| {
            // Strain is held minus I.
            held.rest[k / 4 * held.slots + q][k % 4] + identity.get(k).map_or(0.0, |one| *one as f32)
        };
        let fill = |k: usize| Plane(std::array::from_fn(|i| value(k, chunk[i.min(chunk.len() - 1)])));
        let planes: Vec<_> = (0..planes).map(fill).collect();
        let (strain, state) = planes.split_at(identity.len());
        need = need.or(stiffness.need([strain, state], chunk.len(), (h, &[density; PARTICLES]), |_| None)?);
    }
    Ok(need)
}

/// What particles whose laws are asked on the device set as a bound, if they need so many steps of the simulation a second; NaN stays.
pub(crate) fn bound_of_need(materials: &[PlannedMaterial], need: f32) -> Bound {
    let names: Vec<_> = materials.iter().filter(|planned| is_asked_on_device(planned)).collect();
    let names: Vec<_> = names.iter().map(|planned| format!("'{}'", planned.name)).collect();
    let kind = if names.len() > 1 { "one of the materials" } else { "material" };
    let damps = materials.iter().any(|planned| is_asked_on_device(planned) && planned.damping.is_some());
    let what = if damps { "stiffness or damping" } else { "stiffness" };
    Bound { dt: 1.0 / f64::from(need), by: format!("{what} of {kind} {}", names.join(", ")) }
}

/// The lesser of two bounds. NaN is for whoever asks laws next to find.
pub(crate) fn lesser(a: Bound, b: Bound) -> Bound {
    if b.dt < a.dt || b.dt.is_nan() { b } else { a }
}

pub(crate) fn nothing() -> Bound {
    Bound { dt: f64::INFINITY, by: "nothing".into() }
}
