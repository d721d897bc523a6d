//! Limits on motion in a step, and how often the host checks; the same for every backend.

use barchan_core::backend::Bound;
use barchan_lanes::Float;

/// No particle may move further than this in a step, in cells. Fixed-point positions and the halo rely on it.
pub const MAX_MOVE: f64 = 0.5;
/// No node that a particle feels may move it further than this in a step, in cells. Nodes that hardly weigh anything may
/// add the rest.
pub const NODE_MOVE: f64 = 0.48;
/// Drift since the last sort that the halo allows, in cells.
pub const MAX_DRIFT: f64 = 1.0;
/// Strain is applied in parts, each of which deforms by no more than this.
pub const MAX_DEFORMATION: f64 = 0.5;
/// Upper limit of the number of parts. No motion from the grid needs as many, since nodes move by half a cell at most.
pub const MAX_PARTS: f64 = 1000.0;
/// Steps between measurements of the stiffness of materials that harden, on the host: it takes about as long as a transfer, and strain
/// changes little in between.
pub const STIFFNESS_AGE: u32 = 10;
/// Nodes lighter than this part of the lightest particle carry nothing that a particle could feel.
pub const LEAST_MASS: f64 = 1e-20;
/// Multiple of the least mass from which a node's speed counts in full: a thousandth of the lightest particle's mass. A
/// node takes part in a particle's velocity by no more than its mass over the particle's, so the speed of lighter nodes
/// counts in proportion.
pub const FULL_SPEED: f64 = 1e17;

/// The bound that is the lower: of stiffness, or that on a step of so many seconds in which the fastest particle would move as far as any may.
/// What is not a bound at all, of infinite or NaN speed, is for the step to find, with the particle's name.
pub fn bound(speed: f64, stiffness: Bound) -> Bound {
    if speed < stiffness.dt && speed > 0.0 {
        Bound { dt: speed, by: "particle speed: no particle may move further than half a cell in a step".into() }
    } else {
        stiffness
    }
}

/// The greater of two magnitudes; NaN wins, so that it cannot hide.
pub fn greater<T: Float>(a: T, b: T) -> T {
    if a >= b || a.to_f64().is_nan() { a } else { b }
}
