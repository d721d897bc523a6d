//! When a world is sorted: `since_sort.wgsl` is the same rule on the device.

use barchan_core::Plan;
use barchan_core::scene::{Leaving, Wall};
use barchan_grid::bounds::PUT_BACK_DRIFT;
use barchan_grid::limits::{MAX_DRIFT, MAX_MOVE, SORT_AGE};

/// Whenever [`SORT_AGE`] steps have passed since its last sort, a world is sorted if its particles may have drifted by more than this: a sort that
/// finds nobody far from home is not worth its time [cells].
pub(crate) const SORT_DRIFT: f32 = 0.1;
/// Whenever so many have passed, if they may have drifted by more than [`SELDOM_DRIFT`]: few at rest cross into another cell, but whoever has costs
/// P2G a fifth of its time in each step.
pub(crate) const SORT_SELDOM: u32 = 160;
pub(crate) const SELDOM_DRIFT: f32 = 0.002;
/// Whenever so many have passed, if they may have drifted by more than [`OFTEN_DRIFT`].
pub(crate) const SORT_OFTEN: u32 = 4;
/// As much again in as many steps is what tiles allow for [cells].
pub(crate) const OFTEN_DRIFT: f32 = 0.5;

/// So much may particles have drifted before a step [cells]: a subcycled one moves them several times before they can be sorted, and who has left
/// the world is to be found within a cell.
pub(crate) fn most_drift(plan: &Plan) -> f32 {
    let world = &plan.scene.world;
    let open = (0..3).flat_map(|axis| world.walls.pair(axis)).any(|wall| wall == Wall::Open);
    if world.leaving == Leaving::Clamp && open {
        return PUT_BACK_DRIFT as f32;
    }
    let watched = world.leaving == Leaving::Error && open;
    if plan.substeps > 1 || watched { (MAX_DRIFT - MAX_MOVE) as f32 } else { MAX_DRIFT as f32 }
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
    /// Must the world be sorted before its next step, if particles may drift by so much?
    pub(crate) fn is_due(self, most: f32) -> bool {
        let every = |steps: u32| self.age.is_multiple_of(steps);
        // NaN is due.
        self.drift.is_nan()
            || self.drift > most
            || (every(SORT_OFTEN) && self.drift > OFTEN_DRIFT)
            || self.is_far()
            || (every(SORT_SELDOM) && self.drift > SELDOM_DRIFT)
    }

    /// Have particles come far enough for a sort as there may be one every [`SORT_AGE`] steps?
    pub(crate) fn is_far(self) -> bool {
        self.age.is_multiple_of(SORT_AGE) && self.drift > SORT_DRIFT
    }

    /// After a step in which particles moved by up to `moved` cells.
    pub(crate) fn after(self, moved: f32) -> Self {
        Self { age: self.age + 1, drift: self.drift + moved }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps between sorts at a steady speed, in cells a step.
    pub(crate) fn between(speed: f32) -> Vec<u32> {
        let (mut since_sort, mut ages) = (SinceSort::default(), Vec::new());
        for _ in 0..200 {
            if since_sort.is_due(MAX_DRIFT as f32) {
                ages.push(since_sort.age);
                since_sort = SinceSort::default();
            }
            since_sort = since_sort.after(speed);
            assert!(since_sort.drift <= MAX_DRIFT as f32 + 0.5, "tiles do not allow for {} cells", since_sort.drift);
        }
        ages
    }

    #[test]
    pub(crate) fn ground_at_rest_is_not_sorted_and_fast_ground_before_it_leaves_its_tiles() {
        assert!(between(0.0).is_empty());
        assert!(between(1e-5).is_empty());
        assert_eq!(between(1e-4), [160]);
        assert!(between(0.01).iter().all(|age| *age == 20));
        assert!(between(0.1).iter().all(|age| *age == 8));
        assert!(between(0.24).iter().all(|age| *age == 4));
        assert!(between(0.48).iter().all(|age| *age <= 3));
    }
}
