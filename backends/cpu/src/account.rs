//! What a ledger is told of the particles: mass, momenta, energies, the materials' counts.

use crate::engine::CpuEngine;
use crate::store::List;
use barchan_abi as abi;
use barchan_core::Ledger;
use barchan_core::account::{BATCH, MaterialSums, add_particle};
use barchan_core::batch::{Answer, Matter, Motion, Plane};
use barchan_core::material::{ErrorBuffer, Material};
use barchan_grid::particles::{Run, STRAIN};
use barchan_grid::rest::ASLEEP;
use barchan_grid::transfer::{MAX_STATE, Scalar, Step, deformed};
use barchan_lanes::CHUNK;

/// Values of the particles of a batch.
type Planes<T, const N: usize> = [Plane<T, BATCH>; N];

impl<T: Scalar> CpuEngine<T> {
    /// Adds mass, momenta, energies and the materials' counts.
    pub(crate) fn account_particles(&self, ledger: &mut Ledger) {
        for ((level, _), list) in self.lists() {
            let h = self.levels[level].h();
            for (chunk, lane) in list.places() {
                let motion = list.motion_of(chunk, lane);
                let at = (list.mass_of(chunk, lane), list.position_of(chunk, lane, h));
                add_particle(ledger, at, (&motion[..3], &motion[3..]), h, self.scene.gravity);
            }
            self.account_material(level, list, ledger);
        }
    }

    /// Strain and history of up to [`BATCH`] particles of a run, in planes, where the particles are now: strain is held as it was when the
    /// last step began, and is carried along here as the next `step` would do it. `None` if the material cannot.
    fn strain_now(
        list: &List<T>,
        material: &Material,
        run: &Run,
        from: usize,
        step: &Step,
    ) -> Option<(Planes<f64, 9>, Planes<f64, MAX_STATE>)> {
        let (planes, n_state) = (list.strain_planes(), list.law.table.n_state);
        let n = (run.count - from).min(BATCH);
        let (mut strain, mut rate) = ([Plane::default(); 9], [Plane::default(); 9]);
        let mut state = [Plane::default(); MAX_STATE];
        // The last particle stands in for those behind it, so that no material sees a strain that nothing can have.
        for i in 0..BATCH {
            let at = from + i.min(n - 1);
            let (chunk, lane) = (run.first + at / CHUNK, at % CHUNK);
            let rest = |plane: usize| T::from_f64(list.rest_of(chunk, lane, STRAIN + plane));
            strain[..planes].iter_mut().enumerate().for_each(|(p, plane)| plane.0[i] = rest(p));
            state[..n_state].iter_mut().enumerate().for_each(|(q, plane)| plane.0[i] = rest(planes + q));
            let motion = list.motion_of(chunk, lane);
            rate.iter_mut().zip(&motion[3..]).for_each(|(plane, c)| plane.0[i] = T::from_f64(*c));
        }
        let dt = T::from_f64(step.strain_dt / f64::from(step.strain_parts));
        for _ in 0..if step.strain_dt > 0.0 { step.strain_parts } else { 0 } {
            let (mut trial, mut kirchhoff, before) = ([Plane::default(); 9], [Plane::default(); 6], state);
            for i in 0..BATCH {
                let old: [T; 9] = std::array::from_fn(|p| strain[p].0[i]);
                let new = deformed(&std::array::from_fn(|c| rate[c].0[i] * dt), &old[..planes]);
                trial.iter_mut().zip(new).for_each(|(plane, x)| plane.0[i] = x);
            }
            let trial = Matter { count: n, parameters: &list.law.params, strain: &trial, state: &before };
            let answer = Answer { strain: &mut strain, kirchhoff: &mut kirchhoff, state: &mut state };
            let motion = Motion { dt, vel_grad: &rate };
            if material.update(&trial, Some(motion), answer, &mut ErrorBuffer::default()) != Some(abi::BARCHAN_OK) {
                return None;
            }
        }
        let widened = |plane: Plane<T, BATCH>| Plane(plane.0.map(T::to_f64));
        Some((strain.map(widened), state.map(widened)))
    }

    /// Adds elastic energy and the counts of one list.
    fn account_material(&self, level: usize, list: &List<T>, ledger: &mut Ledger) {
        let planned = &self.materials[list.material];
        let mut sums = MaterialSums::new(planned, ledger);
        // What cannot be carried along ends the next step, which says why.
        let lagging = self.whole_step(level, 0.0).ok();
        let asleep = Step { strain_dt: 0.0, strain_parts: 1, ..self.step_of(level, 0.0) };
        let mut volume0 = Vec::with_capacity(BATCH);
        // Before the first step nobody knows yet which blocks rest.
        let rest = &self.levels[level].store.rest;
        for (b, run) in list.runs.iter().enumerate() {
            let step = if rest.get(b) == Some(&ASLEEP) { Some(&asleep) } else { lagging.as_ref() };
            for from in (0..run.count).step_by(BATCH) {
                let now = step.and_then(|step| Self::strain_now(list, &planned.material, run, from, step));
                let Some((strain, state)) = now else {
                    ledger.elastic = f64::NAN;
                    continue;
                };
                let here = from..run.count.min(from + BATCH);
                volume0.clear();
                volume0.extend(here.map(|i| list.volume0_of(run.first + i / CHUNK, i % CHUNK)));
                sums.add(ledger, &strain, &state, &volume0);
            }
        }
        sums.end(ledger);
    }
}
