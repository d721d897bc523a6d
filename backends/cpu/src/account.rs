//! What a ledger is told of the particles: mass, momenta, energies, the materials' counts.

use crate::engine::CpuEngine;
use crate::store::List;
use barchan_abi as abi;
use barchan_core::Ledger;
use barchan_core::material::ErrorBuffer;
use barchan_grid::particles::{Run, STRAIN};
use barchan_grid::rest::ASLEEP;
use barchan_grid::transfer::{BATCH, Batch, MAX_STATE, Scalar, Step, deformed};
use barchan_lanes::CHUNK;

/// Values of the particles of a batch.
type Planes<const N: usize> = [[f64; BATCH]; N];

/// Planes where materials expect them.
#[repr(align(64))]
struct Aligned<A>(A);

impl<T: Scalar> CpuEngine<T> {
    /// Adds mass, momenta, energies and the materials' counts.
    pub(crate) fn account_particles(&self, ledger: &mut Ledger) {
        for ((level, _), list) in self.lists() {
            let h = self.levels[level].h();
            let quarter = 0.25 * h * h;
            for (chunk, lane) in list.places() {
                let m = list.mass_of(chunk, lane);
                let motion = list.motion_of(chunk, lane);
                let (v, c) = ([motion[0], motion[1], motion[2]], &motion[3..]);
                let x = list.position_of(chunk, lane, h);
                ledger.particles += 1;
                ledger.mass += m;
                for d in 0..3 {
                    let (a, b) = ((d + 1) % 3, (d + 2) % 3);
                    ledger.momentum[d] += m * v[d];
                    // x × v, and the spin that C carries about the particle.
                    ledger.angular_momentum[d] +=
                        m * (x[a] * v[b] - x[b] * v[a] + quarter * (c[3 * b + a] - c[3 * a + b]));
                    ledger.potential -= m * self.scene.gravity[d] * x[d];
                }
                ledger.kinetic += list.kinetic_of(chunk, lane, h);
            }
            self.account_material(level, list, ledger);
        }
    }

    /// Strain and history of up to [`BATCH`] particles of a run, in planes, where the particles are now: strain is held as it was when the
    /// last step began, and is carried along here as the next `step` would do it. `None` if the material cannot.
    fn strain_now(list: &List<T>, run: &Run, from: usize, step: &Step) -> Option<(Planes<9>, Planes<MAX_STATE>)> {
        let (planes, n_state) = (list.strain_planes(), list.law.table.n_state);
        let wants_rate = list.law.table.capabilities & abi::BARCHAN_CAP_VEL_GRAD != 0;
        let n = (run.count - from).min(BATCH);
        let zeros = [T::default(); BATCH];
        let (mut strain, mut state) = (Aligned([zeros; 9]), Aligned([zeros; MAX_STATE]));
        let mut rate = Aligned([zeros; 9]);
        // The last particle stands in for those behind it, so that no material sees a strain that nothing can have.
        for i in 0..BATCH {
            let at = from + i.min(n - 1);
            let (chunk, lane) = (run.first + at / CHUNK, at % CHUNK);
            let rest = |plane: usize| T::from_f64(list.rest_of(chunk, lane, STRAIN + plane));
            strain.0[..planes].iter_mut().enumerate().for_each(|(p, plane)| plane[i] = rest(p));
            state.0[..n_state].iter_mut().enumerate().for_each(|(q, plane)| plane[i] = rest(planes + q));
            let motion = list.motion_of(chunk, lane);
            rate.0.iter_mut().zip(&motion[3..]).for_each(|(plane, c)| plane[i] = T::from_f64(*c));
        }
        let dt = T::from_f64(step.strain_dt / f64::from(step.strain_parts));
        for _ in 0..if step.strain_dt > 0.0 { step.strain_parts } else { 0 } {
            let (mut trial, mut kirchhoff, before) = (Aligned([zeros; 9]), Aligned([zeros; 6]), Aligned(state.0));
            for i in 0..BATCH {
                let old: [T; 9] = std::array::from_fn(|p| strain.0[p][i]);
                let new = deformed(&std::array::from_fn(|c| rate.0[c][i] * dt), &old[..planes]);
                trial.0.iter_mut().zip(new).for_each(|(plane, x)| plane[i] = x);
            }
            let batch = Batch {
                n,
                stride: BATCH,
                dt,
                params: list.law.params.as_ptr(),
                strain_trial: trial.0.as_ptr().cast(),
                vel_grad: if wants_rate { rate.0.as_ptr().cast() } else { std::ptr::null() },
                state_in: if n_state > 0 { before.0.as_ptr().cast() } else { std::ptr::null() },
                strain: strain.0.as_mut_ptr().cast(),
                kirchhoff: kirchhoff.0.as_mut_ptr().cast(),
                state_out: if n_state > 0 { state.0.as_mut_ptr().cast() } else { std::ptr::null_mut() },
            };
            // SAFETY: all planes are BATCH long, n <= BATCH, and nothing overlaps.
            let status = unsafe { T::update(&list.law.table, &batch, ErrorBuffer::default().as_raw()) };
            if status != abi::BARCHAN_OK {
                return None;
            }
        }
        Some((strain.0.map(|plane| plane.map(T::to_f64)), state.0.map(|plane| plane.map(T::to_f64))))
    }

    /// Adds elastic energy and the counts of one list.
    fn account_material(&self, level: usize, list: &List<T>, ledger: &mut Ledger) {
        let planned = &self.materials[list.material];
        let table = &planned.material.table;
        if table.energy_f64.is_none() {
            ledger.elastic = f64::NAN;
        }
        let n_state = table.n_state;
        // What cannot be carried along ends the next step, which says why.
        let lagging = self.whole_step(level, 0.0).ok();
        let asleep = Step { strain_dt: 0.0, strain_parts: 1, ..self.step_of(level, 0.0) };
        let mut energy = [0f64; BATCH];
        let no_rate = [[0f64; BATCH]; 9];
        let wants_rate = planned.material.has(abi::BARCHAN_CAP_VEL_GRAD);
        let mut counts = [0u64; abi::BARCHAN_N_COUNTERS];
        for (run, &rest) in list.runs.iter().zip(&self.levels[level].store.rest) {
            let step = if rest == ASLEEP { Some(&asleep) } else { lagging.as_ref() };
            for from in (0..run.count).step_by(BATCH) {
                let n = (run.count - from).min(BATCH);
                let place = |i: usize| (run.first + (from + i) / CHUNK, (from + i) % CHUNK);
                let Some((strain, state)) = step.and_then(|step| Self::strain_now(list, run, from, step)) else {
                    ledger.elastic = f64::NAN;
                    continue;
                };
                let batch = abi::BarchanBatchF64 {
                    struct_size: size_of::<abi::BarchanBatchF64>(),
                    n,
                    stride: BATCH,
                    dt: 0.0,
                    params: planned.parameters.as_ptr(),
                    strain_trial: strain.as_ptr().cast(),
                    vel_grad: if wants_rate { no_rate.as_ptr().cast() } else { std::ptr::null() },
                    state_in: if n_state > 0 { state.as_ptr().cast() } else { std::ptr::null() },
                    strain: std::ptr::null_mut(),
                    kirchhoff: std::ptr::null_mut(),
                    state_out: std::ptr::null_mut(),
                };
                let mut message = ErrorBuffer::default();
                if let Some(callback) = table.energy_f64 {
                    // SAFETY: the planes that this callback reads are BATCH long and n <= BATCH.
                    let status = unsafe { callback(&batch, energy.as_mut_ptr(), message.as_raw()) };
                    for (i, e) in energy[..n].iter().enumerate() {
                        let (chunk, lane) = place(i);
                        ledger.elastic +=
                            if status == abi::BARCHAN_OK { e * list.volume0_of(chunk, lane) } else { f64::NAN };
                    }
                }
                if let Some(callback) = table.count_f64 {
                    let mut here = [0u64; abi::BARCHAN_N_COUNTERS];
                    // SAFETY: as above.
                    if unsafe { callback(&batch, here.as_mut_ptr(), message.as_raw()) } == abi::BARCHAN_OK {
                        for (sum, count) in counts.iter_mut().zip(here) {
                            *sum += count;
                        }
                    }
                }
            }
        }
        for (what, index) in [
            ("yielding", abi::BARCHAN_COUNT_YIELDING),
            ("stress-free at the apex", abi::BARCHAN_COUNT_APEX),
            ("with a floored stretch", abi::BARCHAN_COUNT_FLOORED),
            ("with a clamped state", abi::BARCHAN_COUNT_CLAMPED),
        ] {
            ledger.count(&format!("{} particles {what} now", planned.name), counts[index]);
        }
    }
}
