//! DuneWalk: a quadruped walks over dunes without end. Only what lies near its feet is live, and its footprints are kept.
//!
//! Not in UBSoft (CoRL 2024): its reward is that of QuadrupedWalk there, over a longer time.

use crate::quadruped_walk::{QuadrupedWalk, Rules, parameters};
use crate::reward::Scale;
use barchan_core::registry::TaskSetup;
use barchan_core::{Registry, Result};

const DOC: &str = "A quadruped is to walk over dunes without end, after a target that goes 1 m/s. Success: it is 50 m on, and has not fallen.";

const RULES: Rules = Rules {
    doc: DOC,
    file: include_str!("../scenes/tasks/dune-walk.toml"),
    lite: &[
        "world.cell=0.04",
        "levels.count=2",
        "levels.half=8",
        "body.dunes.spacing=0.02666666666666667",
        "body.dunes.shape.terrain.origin=[0.0, 0.0, 0.16]",
        "robot.dog.position=[0.0, 0.0, 0.58]",
    ],
    on_sand: &[],
    // Standing still for the whole episode gets nothing, as in QuadrupedWalk: Σ d_t is 360,060 m then.
    scale: Scale { alpha: 1.0 / 144.0, beta: 2500.0 },
    seconds: 120.0,
    far: 50.0,
    ranges: &[("direction of the wind [deg]", 0.0, 40.0), ("height of the dunes [m]", 0.08, 0.16)],
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    let make = |setup: &TaskSetup<'_>, size| QuadrupedWalk::new(setup, size, &RULES);
    crate::base::register(registry, "DuneWalk", DOC, parameters(), make)
}
