//! When sort, adapt and archive are due, for every backend; `due.wgsl` is the rule of sorts on devices.
//!
//! - **Sort**: when particles may have drifted as far as tiles allow, or far enough for a sort to be worth its time ([`is_sort_due`]).
//! - **Adapt**: when regions have moved after their agents ([`Adapt::follow`](crate::adapt::Adapt::follow)), and with a sort, which finds who is on another level
//!   than it should be. Levels that have not been [stirred](MARGIN_DRIFT) need not be looked at.
//! - **Archive**: with adapt, when tiles have come within reach or fallen out of it ([`Reach::advance`](crate::archive::Reach::advance)).

use crate::limits::{MAX_DRIFT, MAX_MOVE};
use barchan_core::scene::Leaving;

/// Particles that left the world are put back when particles are sorted, which is before any is further outside than
/// this, in cells. Backends sort at different times, and this makes them put particles back in the same step.
const PUT_BACK_DRIFT: f64 = 0.05;
/// As long as regions stay, nobody on a level has to change it before something there has moved by this since the last sort, in cells:
/// levels have a margin for that.
pub const MARGIN_DRIFT: f64 = 0.2;

/// A sort that is worth its time: of particles that may have drifted by more than this [cells], as so many steps have passed since the last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace<T> {
    /// From so many steps on.
    pub from: u32,
    /// Whenever so many have passed.
    pub every: u32,
    /// Drift [cells].
    pub drift: T,
}

/// On a processor: a late sort costs the transfers more than it saves, and one that finds nobody far from home is not worth its time.
pub const ON_PROCESSOR: [Pace<f64>; 1] = [Pace { from: 20, every: 1, drift: 0.4 }];
/// On a device, whose sort is cheap beside its transfers.
///
/// As much again as the first in as many steps is what tiles allow for. Of ground at rest few cross into another cell, but whoever has costs P2G
/// a fifth of its time in each step: hence the last.
pub const ON_DEVICE: [Pace<f32>; 3] = [
    Pace { from: 0, every: 4, drift: 0.5 },
    Pace { from: 0, every: 20, drift: 0.1 },
    Pace { from: 0, every: 160, drift: 0.002 },
];

impl<T: Copy + PartialOrd> Pace<T> {
    /// Is a sort worth its time so many steps after the last one, if particles may have drifted by so much since then [cells]?
    pub fn is_met(&self, age: u32, drift: T) -> bool {
        age >= self.from && age.is_multiple_of(self.every) && drift > self.drift
    }
}

/// Must particles be sorted before the next step, so many steps after the last sort, if they may have drifted by so much since then [cells]? `most` is how
/// far they may; NaN is further.
pub fn is_sort_due<T: Copy + PartialOrd>(age: u32, drift: T, most: T, paces: &[Pace<T>]) -> bool {
    let is_within = drift <= most;
    !is_within || paces.iter().any(|pace| pace.is_met(age, drift))
}

/// So much may particles have drifted before a step [cells]. A subcycled one moves them several times before they can be sorted; and who leaves the world, which
/// can only be where they come to an open side, is to be found within a cell.
pub fn most_drift(leaving: Leaving, comes_to_open_side: bool, is_subcycled: bool) -> f64 {
    match leaving {
        Leaving::Clamp if comes_to_open_side => PUT_BACK_DRIFT,
        Leaving::Error if comes_to_open_side => MAX_DRIFT - MAX_MOVE,
        _ if is_subcycled => MAX_DRIFT - MAX_MOVE,
        _ => MAX_DRIFT,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps between sorts at a steady speed, in cells a step.
    fn between(speed: f32) -> Vec<u32> {
        let (mut age, mut drift, mut ages) = (0, 0.0, Vec::new());
        for _ in 0..200 {
            if is_sort_due(age, drift, MAX_DRIFT as f32, &ON_DEVICE) {
                ages.push(age);
                (age, drift) = (0, 0.0);
            }
            (age, drift) = (age + 1, drift + speed);
            assert!(drift <= MAX_DRIFT as f32 + 0.5, "tiles do not allow for {drift} cells");
        }
        ages
    }

    #[test]
    fn ground_at_rest_is_not_sorted_and_fast_ground_before_it_leaves_its_tiles() {
        assert!(between(0.0).is_empty());
        assert!(between(1e-5).is_empty());
        assert_eq!(between(1e-4), [160]);
        assert!(between(0.01).iter().all(|age| *age == 20));
        assert!(between(0.1).iter().all(|age| *age == 8));
        assert!(between(0.24).iter().all(|age| *age == 4));
        assert!(between(0.48).iter().all(|age| *age <= 3));
    }

    #[test]
    fn a_drift_that_is_no_number_is_sorted_at_once() {
        assert!(is_sort_due(1, f64::NAN, MAX_DRIFT, &ON_PROCESSOR));
        assert!(!is_sort_due(19, 0.5, MAX_DRIFT, &ON_PROCESSOR) && is_sort_due(21, 0.5, MAX_DRIFT, &ON_PROCESSOR));
    }

    /// Who is to be put back is so in the same step by every backend; so is who ends a run by leaving. What comes to no open side cannot leave.
    #[test]
    fn open_sides_and_subcycling_leave_less_room() {
        assert_eq!(most_drift(Leaving::Clamp, true, true), PUT_BACK_DRIFT);
        assert_eq!(most_drift(Leaving::Clamp, false, false), MAX_DRIFT);
        assert_eq!(most_drift(Leaving::Error, true, false), MAX_DRIFT - MAX_MOVE);
        assert_eq!(most_drift(Leaving::Error, false, true), MAX_DRIFT - MAX_MOVE);
        assert_eq!(most_drift(Leaving::Delete, true, false), MAX_DRIFT);
    }
}
