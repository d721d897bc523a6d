//! What a material's update costs.

use crate::subject::{Particle, Subject};
use barchan_abi::{BARCHAN_CAP_VEL_GRAD, BARCHAN_OK, BarchanBatchF32};
use core::ptr::{null, null_mut};
use std::hint::black_box;
use std::time::Instant;

/// Particles in a call, and the distance between planes.
const BATCH: usize = 64;

/// Planes are aligned as the host aligns them.
#[derive(Clone)]
#[repr(align(64))]
struct Plane {
    _entries: [f32; BATCH],
}

/// Nanoseconds per particle of `update_f32`, in calls of 64 copies of `particle` that stay in the cache; the least of
/// several rounds, since what disturbs a measurement only ever adds to it.
///
/// # Panics
/// If the material has no `update_f32`, or the update fails.
pub fn ns_per_particle(subject: &Subject<'_>, params: &[f64], particle: &Particle) -> f64 {
    let update = subject.table().update_f32.expect("a material with update_f32");
    let planes = |values: &[f64]| values.iter().map(|&x| Plane { _entries: [x as f32; BATCH] }).collect::<Vec<_>>();
    let params: Vec<f32> = params.iter().map(|&p| p as f32).collect();
    let (strain_trial, vel_grad) = (planes(&particle.strain), planes(&particle.vel_grad));
    let state_in = planes(&particle.state);
    let (mut strain, mut kirchhoff, mut state_out) = (strain_trial.clone(), planes(&[0.0; 6]), state_in.clone());
    let has_state = subject.table().n_state > 0;
    let batch = BarchanBatchF32 {
        struct_size: size_of::<BarchanBatchF32>(),
        n: BATCH,
        stride: BATCH,
        dt: 1e-4,
        reserved: 0,
        params: params.as_ptr(),
        strain_trial: strain_trial.as_ptr().cast(),
        vel_grad: if subject.has(BARCHAN_CAP_VEL_GRAD) { vel_grad.as_ptr().cast() } else { null() },
        state_in: if has_state { state_in.as_ptr().cast() } else { null() },
        strain: strain.as_mut_ptr().cast(),
        kirchhoff: kirchhoff.as_mut_ptr().cast(),
        state_out: if has_state { state_out.as_mut_ptr().cast() } else { null_mut() },
    };
    let calls = 2000;
    let round = || {
        let start = Instant::now();
        for _ in 0..calls {
            // SAFETY: `Subject::new`'s caller vouches for the function; the batch's planes hold BATCH entries each.
            let status = unsafe { update(black_box(&batch), null_mut()) };
            assert_eq!(status, BARCHAN_OK, "the update failed");
        }
        start.elapsed().as_secs_f64() * 1e9 / (calls * BATCH) as f64
    };
    (0..50).map(|_| round()).fold(f64::INFINITY, f64::min)
}
