//! What a material's update costs.

use crate::subject::{Particle, Subject};
use barchan_abi::BARCHAN_OK;
use barchan_abi::batch::{Batch, Inputs, Outputs};
use core::ptr::null_mut;
use std::hint::black_box;
use std::time::Instant;

/// Particles in a call, and the distance between planes.
const BATCH: usize = 64;

/// Planes are aligned as the host aligns them.
#[derive(Clone)]
#[repr(C, align(64))]
struct Plane([f32; BATCH]);

/// All of some planes' entries.
fn flat(planes: &mut [Plane]) -> &mut [f32] {
    // SAFETY: a plane is its entries, which fill whole lines, and nothing else.
    unsafe { core::slice::from_raw_parts_mut(planes.as_mut_ptr().cast(), planes.len() * BATCH) }
}

/// Nanoseconds per particle of `update_f32`, in calls of 64 copies of `particle` that stay in the cache; the least of
/// several rounds, since what disturbs a measurement only ever adds to it.
///
/// # Panics
/// If the material has no `update_f32`, or the update fails.
pub fn ns_per_particle(subject: &Subject<'_>, params: &[f64], particle: &Particle) -> f64 {
    let update = subject.table().update_f32.expect("a material with update_f32");
    let planes = |values: &[f64]| values.iter().map(|&x| Plane([x as f32; BATCH])).collect::<Vec<_>>();
    let params: Vec<f32> = params.iter().map(|&p| p as f32).collect();
    let (mut trial, mut vel_grad) = (planes(&particle.strain), planes(&particle.vel_grad));
    let mut before = planes(&particle.state);
    let (mut strain, mut kirchhoff, mut after) = (trial.clone(), planes(&[0.0; 6]), before.clone());
    let inputs = Inputs {
        n: BATCH,
        stride: BATCH,
        dt: 1e-4,
        params: &params,
        strain: flat(&mut trial),
        vel_grad: flat(&mut vel_grad),
        state: flat(&mut before),
    };
    let outputs = Outputs { strain: flat(&mut strain), kirchhoff: flat(&mut kirchhoff), state: flat(&mut after) };
    let batch = Batch::new(subject.table(), inputs, Some(outputs));
    let calls = 2000;
    let round = || {
        let start = Instant::now();
        for _ in 0..calls {
            // SAFETY: `Subject::new`'s caller vouches for the function; the batch's planes hold BATCH entries each.
            let status = unsafe { update(black_box(batch.as_raw()), null_mut()) };
            assert_eq!(status, BARCHAN_OK, "the update failed");
        }
        start.elapsed().as_secs_f64() * 1e9 / (calls * BATCH) as f64
    };
    (0..50).map(|_| round()).fold(f64::INFINITY, f64::min)
}
