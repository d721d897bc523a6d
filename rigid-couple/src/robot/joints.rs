//! What acts in a robot's joints over a step: motors, stops, damping and dry friction.
//!
//! Each is an impulse that falls as the joint's rate grows. It is taken at the rate at the end of the step, which is solved for: so no gain,
//! however high, makes a step unstable or creates energy.

use super::model::Drive;
use serde::{Deserialize, Serialize};

/// How stiff stops are, in inertias of their joint for each step.
const STIFF: f64 = 1e6;
/// Rate at which dry friction has grown to 0.7 of its greatest [rad/s or m/s]: a joint that it holds creeps at less. With none, rates that are solved for jump
/// from one side to the other.
const CREEP: f64 = 1e-3;
/// What a joint beyond its stop goes back in a step, as a share of how far it is beyond: it should not be thrown back.
const BACK: f64 = 0.1;
/// The share of a motor's greatest speed over which its torque fades.
const FADE: f64 = 0.1;

/// How a joint's motor is controlled: torque = kp (target − position) + kd (target rate − rate) + feed-forward, up to the drive's effort.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Gains {
    /// Torque for each unit of position [N m/rad or N/m].
    pub kp: f64,
    /// Torque for each unit of rate [N m s/rad or N s/m].
    pub kd: f64,
}

/// What a motor is told.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Order {
    /// Position [rad or m].
    pub target: f64,
    /// Rate [rad/s or m/s].
    pub rate: f64,
    /// Torque or force besides [N m or N].
    pub torque: f64,
    /// Do the gains act? A motor driven by torques does not hold its place.
    pub holds: bool,
}

/// A joint in a step of `dt` [s].
#[derive(Clone, Copy, Debug)]
pub struct Joint<'a> {
    /// What it is.
    pub drive: &'a Drive,
    /// Its motor's gains.
    pub gains: Gains,
    /// What its motor is told.
    pub order: Order,
    /// Where it is [rad or m].
    pub position: f64,
    /// Its inertia, all else held [kg m² or kg].
    pub inertia: f64,
    /// The step [s].
    pub dt: f64,
}

/// An impulse, and by how much it falls for each unit of the rate.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Impulse {
    /// The impulse [N m s or N s].
    pub value: f64,
    /// Its slope, turned around: 0 or more.
    pub slope: f64,
}

/// How the impulse changes with what it is made of, at the rate at which it is taken and on the side of each case distinction on which it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Slopes {
    /// By where the joint is, and by its inertia.
    pub position: f64,
    pub inertia: f64,
    /// By what its motor is told: position, rate, torque.
    pub target: f64,
    pub rate: f64,
    pub torque: f64,
    /// By its gains.
    pub kp: f64,
    pub kd: f64,
}

impl Joint<'_> {
    /// The motor's torque at a rate, and by how much it falls for each unit of the rate.
    pub fn motor(&self, rate: f64) -> Impulse {
        let (demand, Gains { kp, kd }) = (self.demand(rate), self.acting());
        let Drive { effort, speed, .. } = *self.drive;
        // What is left of the effort as the motor nears its greatest speed that way.
        let left = |spare: f64| if speed.is_finite() { (spare / (FADE * speed)).clamp(0.0, 1.0) } else { 1.0 };
        let (up, down) = (left(speed - rate), left(speed + rate));
        let fades = |share: f64| if share > 0.0 && share < 1.0 { effort / (FADE * speed) } else { 0.0 };
        if demand > effort * up {
            Impulse { value: if up > 0.0 { effort * up } else { 0.0 }, slope: fades(up) }
        } else if demand < -effort * down {
            Impulse { value: if down > 0.0 { -effort * down } else { 0.0 }, slope: fades(down) }
        } else {
            Impulse { value: demand, slope: kp * self.dt + kd }
        }
    }

    /// What the motor is asked for at a rate.
    fn demand(&self, rate: f64) -> f64 {
        let (Order { target, rate: wanted, torque, .. }, Gains { kp, kd }) = (self.order, self.acting());
        kp * (target - self.position - self.dt * rate) + kd * (wanted - rate) + torque
    }

    /// The gains that act.
    fn acting(&self) -> Gains {
        if self.order.holds { self.gains } else { Gains::default() }
    }

    /// A stop is at one end, on this side of it: how far the rate is beyond what it allows, and how that changes with the joint's place.
    fn beyond(&self, end: f64, sign: f64, rate: f64) -> (f64, f64) {
        let gap = sign * (end - self.position);
        let share = if gap > 0.0 { 1.0 } else { BACK };
        let most = share * gap / self.dt;
        (sign * rate - most, sign * share / self.dt)
    }

    /// How [`impulse`](Self::impulse) changes, but for the rate.
    pub(super) fn slopes(&self, rate: f64) -> Slopes {
        let dt = self.dt;
        let mut sum = Slopes::default();
        // Where its effort or its speed bounds the motor, that alone counts.
        if self.demand(rate) == self.motor(rate).value {
            let Gains { kp, kd } = self.acting();
            sum.position = -dt * kp;
            (sum.target, sum.rate, sum.torque) = (dt * kp, dt * kd, dt);
            if self.order.holds {
                sum.kp = dt * (self.order.target - self.position - dt * rate);
                sum.kd = dt * (self.order.rate - rate);
            }
        }
        for (end, sign) in self.ends() {
            let (beyond, by_position) = self.beyond(end, sign, rate);
            if beyond > 0.0 {
                sum.position -= sign * STIFF * self.inertia * by_position;
                sum.inertia -= sign * STIFF * beyond;
            }
        }
        sum
    }

    fn ends(&self) -> [(f64, f64); 2] {
        let [least, most] = self.drive.limits;
        [(least, -1.0), (most, 1.0)]
    }

    /// All that acts in the joint over the step, if it ends with this rate.
    pub fn impulse(&self, rate: f64) -> Impulse {
        let dt = self.dt;
        let motor = self.motor(rate);
        let mut sum = Impulse { value: dt * motor.value, slope: dt * motor.slope };
        let mut add = |value: f64, slope: f64| {
            sum.value += value;
            sum.slope += slope;
        };
        let Drive { damping, friction, .. } = *self.drive;
        add(-dt * damping * rate, dt * damping);
        let grown = rate.hypot(CREEP);
        add(-dt * friction * rate / grown, dt * friction * CREEP * CREEP / grown.powi(3));
        let stiff = STIFF * self.inertia;
        for (end, sign) in self.ends() {
            let (beyond, _) = self.beyond(end, sign, rate);
            if beyond > 0.0 {
                add(-sign * stiff * beyond, stiff);
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive() -> Drive {
        Drive {
            name: "knee".to_owned(),
            turns: true,
            limits: [-1.0, 2.0],
            effort: 20.0,
            speed: 10.0,
            damping: 0.1,
            friction: 0.3,
            armature: 0.01,
        }
    }

    /// The solution is unique, and no gain makes it unstable, because of this.
    #[test]
    fn impulses_fall_as_the_rate_grows_and_slopes_are_theirs() {
        let drive = drive();
        for position in [-1.2, -0.999, 0.3, 1.9999, 2.1] {
            for holds in [true, false] {
                let order = Order { target: 0.5, rate: 0.2, torque: 1.5, holds };
                let gains = Gains { kp: 300.0, kd: 3.0 };
                let joint = Joint { drive: &drive, gains, order, position, inertia: 0.05, dt: 2e-4 };
                let mut last = f64::INFINITY;
                for i in -3000..3000 {
                    let rate = 0.005 * f64::from(i) + 1.234e-4;
                    let Impulse { value, slope } = joint.impulse(rate);
                    assert!(value <= last && slope >= 0.0, "at {rate}: {value} after {last}");
                    last = value;
                    let e = 1e-9;
                    let by_differences = (joint.impulse(rate - e).value - joint.impulse(rate + e).value) / (2.0 * e);
                    let close = (by_differences - slope).abs() <= 1e-4 * slope.max(1e-3);
                    assert!(close, "at {position}, {rate}: slope {slope}, by differences {by_differences}");
                }
            }
        }
    }

    #[test]
    fn motors_keep_to_their_effort_and_fade_at_their_speed() {
        let drive = drive();
        let order = Order { target: 9.0, rate: 0.0, torque: 0.0, holds: true };
        let joint =
            Joint { drive: &drive, gains: Gains { kp: 1e4, kd: 0.0 }, order, position: 0.0, inertia: 1.0, dt: 1e-4 };
        assert_eq!(joint.motor(0.0).value, 20.0);
        assert_eq!(joint.motor(9.5).value, 10.0);
        assert_eq!(joint.motor(11.0).value, 0.0);
    }
}
