//! A hand-written agent that walks on two legs.
//!
//! Once it has shifted its weight, it steps as a clock says and goes with its fall: its weight is an inverted pendulum above the sole that bears it, whose
//! capture point ξ = x + v/ω runs away from that sole as exp(ω t). So it knows where ξ will be when the step ends, and puts its foot there less the offset with
//! which the step after that will end a stride further on.
//! - The bearing leg keeps the pelvis upright and at its height, and lets it move along. Its ankle presses where that brings ξ closer to its plan.
//! - The swinging leg goes to where the foot is to be, its sole level, whatever the pelvis does.
//! - Motors are told what torque that needs: a target is off by torque over stiffness.
//!
//! # Source
//! Englsberger, Ott and Albu-Schäffer 2015, "Three-dimensional bipedal walking control based on divergent component of motion": offsets of steps.

use crate::humanoid::{ANKLE_PITCH, ANKLE_ROLL, DAMPING, HANGS, LEGS, MASS, Posture, SIDE, SOLE, STIFFNESS, angles_of};
use barchan_core::glam::{DVec2, DVec3};

/// Simulated time that it stands, and in which it shifts its weight at most [s].
const REST: f64 = 0.5;
const SHIFT: f64 = 0.8;
/// Time of a step, and how much of that both feet are down [s].
const STEP: f64 = 0.45;
const BOTH: f64 = 0.08;
/// How far a foot goes past the other, how far apart they are to the sides, and how high a foot is lifted [m].
const STRIDE: f64 = 0.2;
const WIDTH: f64 = 0.18;
const LIFT: f64 = 0.05;
/// Height of its hips above the ankles, as it stands and as it walks; how far its weight is shifted [m].
const STANDS: f64 = 0.57;
const WALKS: f64 = 0.555;
const SHIFTED: f64 = 0.06;
/// Its centre of mass above the ground, less the height of its hips above the ankles as it walks [m].
const CENTRE: f64 = 0.107;
/// The middle of a sole from its ankle; how far ankles may press off it along x and y [m].
const MIDDLE: f64 = 0.02;
const PRESS: DVec2 = DVec2::new(0.06, 0.03);
/// Where a foot is put from the bearing one: along x, and to its side [m].
const AHEAD: [f64; 2] = [-0.25, 0.3];
const APART: [f64; 2] = [0.11, 0.3];
/// How far below the bearing foot a foot is sent as it lands [m], and the share of its time in the air after which it is where it is to be.
const LANDS: f64 = 0.01;
const ARRIVES: f64 = 0.9;
/// Most torque of an ankle in pitch and in roll: what its motor has, less a tenth [N m].
const ANKLE: [f64; 2] = [45.0, 35.0];
const GRAVITY: f64 = 9.81;

/// What it is doing.
#[derive(Clone, Debug)]
pub(crate) struct Stepping {
    /// The step under way.
    step: Option<Step>,
    /// How many have been taken.
    pub(crate) taken: u64,
}

#[derive(Clone, Copy, Debug)]
struct Step {
    begun: f64,
    /// The leg that bears, as a number of [`LEGS`].
    bears: usize,
    /// From its ankle to the other one as the step began [m].
    from: DVec3,
}

impl Step {
    fn begin(posture: &Posture, bears: usize, begun: f64) -> Self {
        Self { begun, bears, from: posture.legs[1 - bears].ankle - posture.legs[bears].ankle }
    }
}

impl Stepping {
    pub(crate) fn new() -> Self {
        Self { step: None, taken: 0 }
    }

    /// Targets of all joints at a time since the start, from those of the standing pose.
    pub(crate) fn targets(&mut self, time: f64, posture: &Posture, stand: &[f64]) -> Vec<f64> {
        let mut targets = stand.to_vec();
        let step = match self.step {
            None if time < REST || (time < REST + SHIFT && !is_aside(posture)) => {
                shift(time, posture, &mut targets);
                return targets;
            }
            None => Step::begin(posture, 0, time),
            Some(step) if time - step.begun >= STEP => {
                self.taken += 1;
                Step::begin(posture, 1 - step.bears, time)
            }
            Some(step) => step,
        };
        self.step = Some(step);
        step.go(time - step.begun, posture, &mut targets);
        targets
    }
}

/// Rate at which the capture point runs away from the sole that bears [1/s].
fn rate() -> f64 {
    (GRAVITY / (WALKS + CENTRE)).sqrt()
}

/// From the foot that lands to the capture point, as a step begins that is to end a stride further on and with the feet as far apart [m].
fn offset(side: f64) -> DVec2 {
    let whole = (rate() * STEP).exp();
    DVec2::new(STRIDE / (whole - 1.0), -side * WIDTH / (1.0 + whole))
}

/// Where the capture point is to be from the bearing sole, so much time before the end of a step [m].
fn planned(side: f64, left: f64) -> DVec2 {
    (DVec2::new(STRIDE, -side * WIDTH) + DVec2::new(1.0, -1.0) * offset(side)) / (rate() * left).exp()
}

/// Is the weight so far to the left that the right foot may step?
fn is_aside(posture: &Posture) -> bool {
    let capture = posture.centre.y + posture.velocity.y / rate();
    capture - posture.legs[0].ankle.y > planned(1.0, STEP).y
}

/// Before the first step: the weight goes to the left.
fn shift(time: f64, posture: &Posture, targets: &mut [f64]) {
    let share = eased((time - REST) / SHIFT);
    let aside = share * SHIFTED;
    let [pitch, roll] = posture.balance();
    for (leg, (first, side)) in LEGS.into_iter().enumerate() {
        let hip_to_ankle = DVec3::new(-MIDDLE, -aside, -(STANDS + share * (WALKS - STANDS)));
        let mut angles = angles_of(hip_to_ankle);
        angles[ANKLE_PITCH] += pitch;
        angles[ANKLE_ROLL] += roll;
        let bears = 0.5 + 0.5 * side * (aside / SIDE).min(1.0);
        let force = DVec3::new(0.0, 0.0, bears * MASS * GRAVITY);
        let sole = posture.legs[leg].ankle + DVec3::new(MIDDLE, 0.0, -SOLE);
        let [hip_roll, hip_pitch, knee] = bearing(posture, leg, sole, force);
        tell(targets, first, angles, [0.0, hip_roll, hip_pitch, knee, 0.0, 0.0]);
    }
}

impl Step {
    /// A moment of a step.
    fn go(&self, time: f64, posture: &Posture, targets: &mut [f64]) {
        let (first, side) = LEGS[self.bears];
        let leg = posture.legs[self.bears];
        let sole = leg.ankle + DVec3::new(MIDDLE, 0.0, -SOLE);
        let reach = (posture.centre - sole).truncate();
        let capture = reach + posture.velocity.truncate() / rate();
        let (offset, left) = (offset(side), STEP - time);
        let press = (capture - planned(side, left)).clamp(-PRESS, PRESS);
        let ends = press + (rate() * left).exp() * (capture - press);
        let lands = DVec2::new(
            (ends.x - offset.x).clamp(AHEAD[0], AHEAD[1]),
            -side * (-side * (ends.y + offset.y)).clamp(APART[0], APART[1]),
        );
        // The bearing leg.
        let force = MASS * GRAVITY * ((reach - press) / (WALKS + CENTRE)).extend(1.0);
        let pressed = sole + press.extend(0.0);
        let level_hip = DVec3::new(0.0, side * SIDE, 0.0);
        let mut angles = angles_of((leg.ankle - level_hip).with_z(-WALKS));
        let [hip_roll, hip_pitch, knee] = bearing(posture, self.bears, pressed, force);
        let moment = -(pressed - leg.ankle).cross(force);
        let ankle = [moment.y.clamp(-ANKLE[0], ANKLE[0]), moment.x.clamp(-ANKLE[1], ANKLE[1])];
        for joint in [ANKLE_PITCH, ANKLE_ROLL] {
            angles[joint] = yields(posture, first, joint);
        }
        tell(targets, first, angles, [0.0, hip_roll, hip_pitch, knee, ankle[0], ankle[1]]);
        self.swing(time, lands, posture, targets);
    }

    /// The other leg, which is to land there from the bearing foot.
    fn swing(&self, time: f64, lands: DVec2, posture: &Posture, targets: &mut [f64]) {
        let (first, side) = LEGS[1 - self.bears];
        let (bearing, leg) = (posture.legs[self.bears], posture.legs[1 - self.bears]);
        let share = (time - BOTH) / (STEP - BOTH);
        if share <= 0.0 {
            let mut angles = angles_of(leg.ankle - DVec3::new(0.0, side * SIDE, 0.0));
            for joint in [ANKLE_PITCH, ANKLE_ROLL] {
                angles[joint] = yields(posture, first, joint);
            }
            tell(targets, first, angles, [0.0; 6]);
            return;
        }
        let gone = eased(share / ARRIVES);
        let way = self.from.truncate().lerp(lands, gone);
        let lifted = 0.5 * LIFT * (1.0 - (std::f64::consts::TAU * share).cos());
        let height = (1.0 - gone) * self.from.z + lifted - LANDS * eased(2.0 * share - 1.0);
        let wanted = bearing.ankle + way.extend(height);
        let mut angles = angles_of(posture.turn.transpose() * (wanted - leg.hip));
        angles[ANKLE_PITCH] -= posture.pitch;
        angles[ANKLE_ROLL] -= posture.roll;
        let weight = -(leg.centre() - leg.hip).cross(DVec3::new(0.0, 0.0, -HANGS * GRAVITY));
        tell(targets, first, angles, [0.0, weight.x, weight.y, 0.0, 0.0, 0.0]);
    }
}

/// Torques of hip roll, hip pitch and knee of a leg on whose sole the ground gives a force at a point.
fn bearing(posture: &Posture, leg: usize, point: DVec3, force: DVec3) -> [f64; 3] {
    let leg = posture.legs[leg];
    let (along, across) = (posture.turn.x_axis, posture.turn.y_axis);
    [(leg.hip, along), (leg.hip, across), (leg.knee, across)]
        .map(|(joint, axis)| -axis.dot((point - joint).cross(force)))
}

/// Where a joint's motor has to aim to give no torque.
fn yields(posture: &Posture, first: usize, joint: usize) -> f64 {
    posture.joints[first + joint] + DAMPING * posture.rates[first + joint] / STIFFNESS[joint]
}

/// Targets of a leg's joints that give these torques at these angles.
fn tell(targets: &mut [f64], first: usize, angles: [f64; 6], torques: [f64; 6]) {
    for joint in 0..6 {
        targets[first + joint] = angles[joint] + torques[joint] / STIFFNESS[joint];
    }
}

/// From 0 to 1, at rest at both ends.
fn eased(share: f64) -> f64 {
    let share = share.clamp(0.0, 1.0);
    share.powi(3) * (10.0 + share * (6.0 * share - 15.0))
}
