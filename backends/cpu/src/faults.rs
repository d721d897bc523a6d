//! What went wrong, in words that a user can act upon.

use crate::engine::CpuEngine;
use crate::level::Stopped;
use barchan_core::account::NonFinite;
use barchan_core::{Coupling, Error};
use barchan_grid::particles::STRAIN;
use barchan_grid::transfer::{Fault, Scalar};
use barchan_lanes::CHUNK;

pub(crate) fn cannot_go_back(coupling: &dyn Coupling, what: String) -> Error {
    Error::Body {
        path: format!("coupling '{}'", coupling.name()),
        what: format!("cannot go back to the start of the step: {what}"),
        mend: "lower time.safety or time.step, so that no step has to be repeated".to_owned(),
    }
}

/// A fault in the state, with the time at which it was found.
pub(crate) fn at_time(error: Error, at: f64) -> Error {
    match error {
        Error::NonFinite { step, field, particle, list, value, count, .. } => {
            Error::NonFinite { step, time: at, field, particle, list, value, count }
        }
        other => other,
    }
}

impl<T: Scalar> CpuEngine<T> {
    /// Turns a fault of a transfer into what a user can act upon.
    pub(crate) fn explain(&self, level: usize, stopped: Stopped) -> Error {
        if let Some(error) = self.find_non_finite() {
            return error;
        }
        let Stopped { block, list, fault, message } = stopped;
        let place = (level, list);
        let l = &self.levels[level].store.lists[list];
        let first = l.runs[block].first;
        match fault {
            Fault::Material { status, chunk } => {
                let id = |i: u64| {
                    let chunk = first + chunk + i as usize / CHUNK;
                    l.id.get(chunk).map_or(u64::MAX, |ids| u64::from(ids[i as usize % CHUNK]))
                };
                message.failure(status, &self.materials[l.material].material, "update", id)
            }
            // The particle is finite, so its momentum has overflowed.
            Fault::NonFinite { chunk, lane } => {
                self.non_finite("momentum", place, first + chunk, lane, f64::INFINITY, 1)
            }
            Fault::Unsound { chunk, lane } => {
                let planned = &self.materials[l.material];
                Error::MaterialFailed {
                    material: planned.material.name.clone(),
                    origin: planned.material.origin.clone(),
                    callback: "update",
                    message: "what it gives for a finite strain is NaN or infinite".into(),
                    particle: l.id.get(first + chunk).map(|ids| u64::from(ids[lane])),
                }
            }
            Fault::Strayed { chunk } => self.non_finite("cell", place, first + chunk, 0, f64::NAN, 1),
        }
    }

    pub(crate) fn non_finite(
        &self,
        field: &'static str,
        (level, list): (usize, usize),
        chunk: usize,
        lane: usize,
        value: f64,
        count: u64,
    ) -> Error {
        let list = &self.levels[level].store.lists[list];
        Error::NonFinite {
            step: self.steps,
            time: 0.0,
            field,
            particle: u64::from(list.id[chunk][lane]),
            list: self.materials[list.material].label(),
            value,
            count,
        }
    }

    /// The particle of least id with a NaN or infinite value.
    pub(crate) fn find_non_finite(&self) -> Option<Error> {
        let mut search = NonFinite::default();
        for (_, list) in self.lists() {
            let planes = list.strain_planes();
            for (chunk, lane) in list.places() {
                let motion = list.motion_of(chunk, lane);
                let rest = (0..STRAIN + planes + list.law.table.n_state).map(|p| list.rest_of(chunk, lane, p));
                let who = (u64::from(list.id[chunk][lane]), list.material);
                search.see(who, (&motion[..3], &motion[3..]), rest, planes);
            }
        }
        search.error(self.steps, 0.0, &self.materials)
    }
}
