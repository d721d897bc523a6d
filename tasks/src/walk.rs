//! Walking: how far a robot is from a target that goes before it.

use barchan_core::Vec3;

/// Speed of the target, along x [m/s].
///
/// # Source
/// UBSoft (CoRL 2024), appendix "Reward Design".
pub(crate) const SPEED: f64 = 1.0;

/// From a robot to its target [m], which was where the robot started: along x and y.
pub(crate) fn to_target(start: Vec3, now: Vec3, time: f64) -> [f64; 2] {
    [start[0] + SPEED * time - now[0], start[1] - now[1]]
}

/// Losses d_t of the control steps that are left when a robot falls: as if it lay where it started, while the target goes on. Where it fell would pay for a leap.
pub(crate) fn left(time: f64, interval: f64, steps: u64) -> impl Iterator<Item = f64> {
    (1..=steps).map(move |step| SPEED * (time + step as f64 * interval))
}

/// Length of a vector.
pub(crate) fn length([x, y]: [f64; 2]) -> f64 {
    x.hypot(y)
}
