//! When a world is sorted: `since_sort.wgsl` reads the same on the device.

use barchan_core::Plan;
use barchan_core::scene::Wall;
use barchan_grid::due::{self, ON_DEVICE, is_sort_due};
use barchan_grid::limits::MAX_DRIFT;
use barchan_grid::wgsl;

/// What passes know of it.
pub(crate) const SINCE_SORT: [&str; 2] = [include_str!("../wgsl/since_sort.wgsl"), wgsl::DUE];

/// So much may particles have drifted before a step [cells].
pub(crate) fn most_drift(plan: &Plan) -> f32 {
    let world = &plan.scene.world;
    let is_open = (0..3).flat_map(|axis| world.walls.pair(axis)).any(|wall| wall == Wall::Open);
    due::most_drift(world.leaving, is_open, plan.substeps > 1) as f32
}

/// When a world is sorted. This goes by its own steps and its own particles' drift since its last sort alone, so that it does not matter
/// how steps are cut into submissions, or what other worlds do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct SinceSort {
    /// Steps since the last sort.
    pub(crate) age: u32,
    /// Upper bound of the drift since then [cells], summed in the order and the number format of the device.
    pub(crate) drift: f32,
}

impl SinceSort {
    /// Sorted, and to be sorted again before the next step, however far particles may drift.
    pub(crate) const DUE: Self = Self { age: 0, drift: MAX_DRIFT as f32 };

    /// Must the world be sorted before its next step, if particles may drift by so much?
    pub(crate) fn is_due(self, most: f32) -> bool {
        is_sort_due(self.age, self.drift, most, &ON_DEVICE)
    }

    /// Have particles come far enough for a sort as there may be one every 20 steps?
    pub(crate) fn is_far(self) -> bool {
        ON_DEVICE[1].is_met(self.age, self.drift)
    }

    /// After a step in which particles moved by up to `moved` cells.
    pub(crate) fn after(self, moved: f32) -> Self {
        Self { age: self.age + 1, drift: self.drift + moved }
    }
}
