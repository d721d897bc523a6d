//! How far things may move in a step, and how often the host looks: the same for every backend.

use barchan_core::backend::Bound;
use barchan_lanes::Float;

/// No particle may move further in a step, in cells: fixed-point positions and the halo rely on it.
pub const MAX_MOVE: f64 = 0.5;
/// So no node that a particle feels may carry one further than this in a step, in cells; those that hardly weigh anything may
/// add the rest.
pub const NODE_MOVE: f64 = 0.48;
/// The halo allows for this much drift since the last sort, in cells.
pub const MAX_DRIFT: f64 = 1.0;
/// Steps after which particles are sorted again, if they have moved at all: a late sort costs the transfers more than it saves.
pub const SORT_AGE: u32 = 20;
/// Strain is applied in parts that deform by no more than this.
pub const MAX_DEFORMATION: f64 = 0.5;
/// More parts than any motion needs that the grid gave: nodes move by half a cell at most.
pub const MAX_PARTS: f64 = 1000.0;
/// Steps between measurements of the stiffness of materials that harden, on the host: it takes about as long as a transfer, and strain
/// changes little in between.
pub const STIFFNESS_AGE: u32 = 10;
/// Nodes lighter than this part of the lightest particle carry nothing that a particle could feel.
pub const LEAST_MASS: f64 = 1e-20;
/// From how many times the least mass on a node's speed counts in full: a thousandth of the lightest particle's. A node takes part
/// in a particle's velocity by no more than its mass over the particle's, so the speed of lighter ones counts in proportion.
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
