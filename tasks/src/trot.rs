//! A quadruped's trot, as joint targets: what a scene's `robot.motion.gait` says, and turned as somebody wants.

use crate::legged::{Standing, heading};
use barchan_core::registry::TaskSetup;
use barchan_core::scene::{Gait, Scene};
use barchan_core::{Result, RobotState};

/// The legs in the order of the joints: their feet, and where their hips are from the base: forwards, and to which side.
///
/// These lengths are those of the built-in model.
const LEGS: [(&str, [f64; 2]); 4] =
    [("FL_foot", [0.19, 1.0]), ("FR_foot", [0.19, -1.0]), ("RL_foot", [-0.19, 1.0]), ("RR_foot", [-0.19, -1.0])];
/// From the base's middle to a hip's axis, and on to its leg's plane [m].
const SIDE: f64 = 0.05;
const HIP: f64 = 0.085;
/// Length of a thigh and of a calf [m].
const LENGTH: f64 = 0.21;

/// Rate of turning for each radian off the heading, and for each metre off the line; and most of it [1/s, rad/(m s), rad/s].
const BY_HEADING: f64 = 1.5;
const BY_LINE: f64 = 0.8;
const MOST_TURN: f64 = 0.5;

#[derive(Clone, Debug)]
pub(crate) struct Trot {
    gait: Gait,
    /// The phase of each leg, and where its foot stands from its hip [m].
    legs: Vec<(f64, [f64; 3])>,
}

impl Trot {
    /// The gait of a scene's first robot.
    ///
    /// # Errors
    /// If it has none, or not one of all four feet.
    pub(crate) fn of(setup: &TaskSetup<'_>, scene: &Scene) -> Result<Gait> {
        let gait = scene.robot.first().and_then(|robot| robot.motion.as_ref()?.gait.as_ref());
        gait.filter(|gait| LEGS.iter().all(|(foot, _)| gait.feet.contains_key(*foot))).cloned().ok_or_else(|| {
            setup.unfit(
                "the task's robot has no gait of its four feet",
                "give its [robot.motion.gait] feet = { FL_foot = 0.0, RR_foot = 0.0, FR_foot = 0.5, RL_foot = 0.5 }, a period, a stride and a lift",
            )
        })
    }

    /// That gait, from where a robot stands.
    pub(crate) fn new(gait: &Gait, standing: &Standing) -> Self {
        let leg = |(number, (foot, [_, side])): (usize, &(&str, [f64; 2]))| {
            let phase = gait.feet.get(*foot).copied().unwrap_or_default();
            let angles = &standing.joints[3 * number..3 * number + 3];
            (phase, foot_of(angles, *side))
        };
        Self { gait: gait.clone(), legs: LEGS.iter().enumerate().map(leg).collect() }
    }

    /// The share of a period that has gone.
    pub(crate) fn phase(&self, time: f64) -> f64 {
        ((time - self.gait.start) / self.gait.period).max(0.0).rem_euclid(1.0)
    }

    /// Targets of all joints at a time since the start [s], turning at a rate [rad/s].
    pub(crate) fn targets(&self, time: f64, turning: f64) -> Vec<f64> {
        let Gait { period, stance, stride, lift, start, ramp, .. } = self.gait;
        let gone = (time - start) / period;
        let grown = if gone < 0.0 { 0.0 } else { (gone / f64::from(ramp.max(1))).min(1.0) };
        let mut targets = Vec::with_capacity(3 * LEGS.len());
        for (&(phase, [x, y, z]), (_, [hip, side])) in self.legs.iter().zip(&LEGS) {
            let [along, up] = self.gait.foot(gone - phase);
            // A foot on the ground goes back as fast as the ground below it seems to.
            let turned = turning * stance * period;
            let step = [stride[0] - turned * (y + side * SIDE), stride[1] + turned * (x + hip), stride[2]];
            let at = [x + grown * along * step[0], y + grown * along * step[1]];
            targets.extend(angles_of([at[0], at[1], z + grown * (along * step[2] + up * lift)], *side));
        }
        targets
    }

    /// The rate of turning that brings a robot back to the line on which it started [rad/s].
    pub(crate) fn steer(standing: &Standing, state: &RobotState) -> f64 {
        let off = state.position[1] - standing.position[1];
        (-BY_HEADING * heading(state) - BY_LINE * off).clamp(-MOST_TURN, MOST_TURN)
    }
}

/// Where a foot is from its hip with its joints at these angles.
fn foot_of(angles: &[f64], side: f64) -> [f64; 3] {
    let &[hip, thigh, calf] = angles else { return [0.0, side * HIP, -LENGTH] };
    let along = -LENGTH * (thigh.sin() + (thigh + calf).sin());
    let down = LENGTH * (thigh.cos() + (thigh + calf).cos());
    let out = side * HIP;
    [along, out * hip.cos() + down * hip.sin(), out * hip.sin() - down * hip.cos()]
}

/// Angles of hip, thigh and calf that bring a foot there from its hip; the nearest that its leg can reach.
fn angles_of([x, y, z]: [f64; 3], side: f64) -> [f64; 3] {
    let out = side * HIP;
    let down = (y * y + z * z - out * out).max(0.0).sqrt();
    let hip = y.atan2(-z) - out.atan2(down);
    let bend = (x * x + down * down - 2.0 * LENGTH * LENGTH) / (2.0 * LENGTH * LENGTH);
    let calf = -bend.clamp(-1.0, 1.0).acos();
    let thigh = (-x).atan2(down) - (LENGTH * calf.sin()).atan2(LENGTH + LENGTH * calf.cos());
    [hip, thigh, calf]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_bring_a_foot_where_it_is_wanted() {
        for side in [1.0, -1.0] {
            for wanted in [[0.0, side * 0.085, -0.29], [0.1, side * 0.12, -0.25], [-0.12, side * 0.05, -0.33]] {
                let reached = foot_of(&angles_of(wanted, side), side);
                assert!((0..3).all(|d| (reached[d] - wanted[d]).abs() < 1e-12), "{reached:?} for {wanted:?}");
            }
        }
        // The standing pose: feet below hips.
        let [x, _, z] = foot_of(&[0.0, 0.8, -1.6], 1.0);
        assert!(x.abs() < 1e-12 && (z + 0.42 * 0.8_f64.cos()).abs() < 1e-12);
    }
}
