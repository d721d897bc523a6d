//! A robot arm that an agent moves by its joints.

use barchan_core::task::{Limits, Part};
use barchan_core::{BodyState, Command, Error, Result, Simulation, Vec3};

/// An arm of the scene, and how it is moved.
#[derive(Clone, Debug)]
pub(crate) struct Arm {
    /// Name of the robot, and of the link that holds the tool.
    pub(crate) robot: &'static str,
    pub(crate) link: &'static str,
    /// How many joints it has, and how far the target of each may change in a control step [rad].
    pub(crate) joints: usize,
    pub(crate) most: f64,
}

/// A joint's target stays this near to where the joint is [rad], so that an arm that is held up does not jump when it
/// is let go.
const LEASH: f64 = 0.3;

impl Arm {
    pub(crate) fn actions(&self) -> Vec<Limits> {
        (1..=self.joints)
            .map(|k| Limits::within(format!("change of the target of joint {k} [rad]"), self.most))
            .collect()
    }

    pub(crate) fn part(&self) -> Part {
        Part::new(
            format!("positions of {} joints [rad], their rates [rad/s], and their targets [rad]", self.joints),
            3 * self.joints,
        )
    }

    /// Positions and rates of its joints.
    ///
    /// # Errors
    /// If it is not there, or has other joints.
    pub(crate) fn state(&self, world: &Simulation) -> Result<[Vec<f64>; 2]> {
        let joints: Vec<_> = world.joints().into_iter().filter(|joint| joint.body == self.robot).collect();
        if joints.len() != self.joints {
            return Err(Error::Body {
                path: format!("robot '{}'", self.robot),
                what: format!("it has {} joints", joints.len()),
                mend: format!("give it a model of {} joints, such as 'arm-shovel'", self.joints),
            });
        }
        Ok([joints.iter().map(|joint| joint.position).collect(), joints.iter().map(|joint| joint.rate).collect()])
    }

    /// The link with the tool; its position is that of its centre of mass.
    ///
    /// # Errors
    /// If it is not there.
    pub(crate) fn tool(&self, world: &Simulation) -> Result<BodyState> {
        world.bodies().into_iter().find(|body| body.name == self.link).ok_or_else(|| Error::Body {
            path: format!("robot '{}'", self.robot),
            what: format!("it has no link '{}'", self.link),
            mend: "give it a model with one, such as 'arm-shovel'".to_owned(),
        })
    }

    pub(crate) fn position(&self, world: &Simulation) -> Vec3 {
        self.tool(world).map(|body| body.position).unwrap_or_default()
    }

    /// Changes the joints' targets.
    ///
    /// # Errors
    /// If it does not take the command.
    pub(crate) fn act(&self, world: &mut Simulation, targets: &mut [f64], action: &[f64]) -> Result<()> {
        let [positions, _] = self.state(world)?;
        for ((target, change), position) in targets.iter_mut().zip(action).zip(positions) {
            *target = (*target + change).clamp(position - LEASH, position + LEASH);
        }
        world.act(self.robot, &Command::JointTargets(targets.to_vec()))
    }

    /// The action that brings the targets to where a track is after the next control step.
    pub(crate) fn follow(&self, track: &Track, time: f64, targets: &[f64]) -> Vec<f64> {
        let wanted = track.at(time + INTERVAL + LEAD);
        wanted.iter().zip(targets).map(|(wanted, target)| (wanted - target).clamp(-self.most, self.most)).collect()
    }
}

/// Simulated seconds of a control step.
pub(crate) const INTERVAL: f64 = 0.008;
/// Motors pull towards a standing target, so joints are behind one that moves by kd / kp [s]: a track is followed so
/// far ahead.
const LEAD: f64 = 0.05;

/// Joints' positions over time, for a hand-written agent: rows of a time and a number for each joint.
#[derive(Clone, Debug)]
pub(crate) struct Track(Vec<Vec<f64>>);

impl Track {
    /// From lines of numbers with commas between them.
    pub(crate) fn new(text: &str) -> Self {
        let row = |line: &str| line.split(',').filter_map(|number| number.trim().parse().ok()).collect();
        Self(text.lines().filter(|line| !line.starts_with('#')).map(row).collect())
    }

    /// Where the joints are to be at a time [s]: straight between the rows, and as in the last one after it.
    pub(crate) fn at(&self, time: f64) -> Vec<f64> {
        let next = self.0.iter().position(|row| row[0] > time).unwrap_or(self.0.len());
        if next == 0 || next == self.0.len() {
            return self.0[next.saturating_sub(1)][1..].to_vec();
        }
        let (from, to) = (&self.0[next - 1], &self.0[next]);
        let share = (time - from[0]) / (to[0] - from[0]);
        from.iter().zip(to).skip(1).map(|(from, to)| from + share * (to - from)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_track_goes_straight_from_row_to_row_and_stays_at_its_ends() {
        let track = Track::new("# time, joints\n0.0, 1, 2\n0.5, 2, 0\n");
        for (time, wanted) in [(-1.0, [1.0, 2.0]), (0.25, [1.5, 1.0]), (0.5, [2.0, 0.0]), (9.0, [2.0, 0.0])] {
            assert_eq!(track.at(time), wanted, "at {time} s");
        }
    }
}
