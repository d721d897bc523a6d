//! What hand-written agents know of the built-in humanoid: its legs, and where its weight is.

use crate::legged::Legged;
use barchan_core::glam::{DMat3, DQuat, DVec3};
use barchan_core::{Result, RobotState, Simulation};

/// Length of a thigh and of a calf, from the middle to a hip, and from an ankle down to its sole [m].
pub(crate) const LENGTH: f64 = 0.3;
pub(crate) const SIDE: f64 = 0.09;
pub(crate) const SOLE: f64 = 0.06;
/// Weights [kg]: of all; of what moves with the pelvis, and where that is above it [m].
pub(crate) const MASS: f64 = 35.0;
const BODY: f64 = 20.2;
const BODY_UP: f64 = 0.217;
/// Of a leg: at its hip, of its thigh and calf and how far along them, and of its foot [kg].
const AT_HIP: f64 = 1.6;
const THIGH: (f64, f64) = (3.0, 0.32);
const CALF: (f64, f64) = (2.0, 0.3);
const FOOT: f64 = 0.8;
/// What of a leg hangs on its hip [kg].
pub(crate) const HANGS: f64 = THIGH.0 + CALF.0 + FOOT;
/// Stiffness of the motors of hip yaw and of the leg's other joints, and their damping [N m/rad, N m s/rad], as the scene has them.
pub(crate) const STIFFNESS: [f64; 6] = [400.0, 600.0, 600.0, 600.0, 600.0, 600.0];
pub(crate) const DAMPING: f64 = 18.0;

/// Left and right: the number of the leg's first joint, and to which side it is.
pub(crate) const LEGS: [(usize, f64); 2] = [(9, 1.0), (15, -1.0)];
/// A leg's joints.
pub(crate) const ANKLE_PITCH: usize = 4;
pub(crate) const ANKLE_ROLL: usize = 5;

/// How a humanoid stands now, in axes that are level and look where its pelvis does, from the pelvis.
#[derive(Clone, Debug)]
pub(crate) struct Posture {
    /// How far its pelvis leans forward and to the right [rad], and at what rate [rad/s].
    pub(crate) pitch: f64,
    pub(crate) roll: f64,
    pub(crate) spin: DVec3,
    /// From the pelvis's axes to the level ones.
    pub(crate) turn: DMat3,
    /// Left and right.
    pub(crate) legs: [Leg; 2],
    /// Centre of mass [m], and its velocity as that of a rigid body [m/s].
    pub(crate) centre: DVec3,
    pub(crate) velocity: DVec3,
    /// Joints' positions and rates.
    pub(crate) joints: Vec<f64>,
    pub(crate) rates: Vec<f64>,
}

/// Where a leg's joints are [m].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Leg {
    pub(crate) hip: DVec3,
    pub(crate) knee: DVec3,
    pub(crate) ankle: DVec3,
}

impl Leg {
    /// Centre of mass of what hangs on the hip.
    pub(crate) fn centre(&self) -> DVec3 {
        self.moment() / HANGS
    }

    fn moment(&self) -> DVec3 {
        let Self { hip, knee, ankle } = *self;
        THIGH.0 * hip.lerp(knee, THIGH.1) + CALF.0 * knee.lerp(ankle, CALF.1) + FOOT * ankle
    }
}

impl Posture {
    /// Of a robot as it is.
    ///
    /// # Errors
    /// If it is not there any more.
    pub(crate) fn of(legged: &Legged, world: &Simulation) -> Result<Self> {
        let state = legged.state(world)?;
        let joints = legged.joints(world);
        let positions: Vec<f64> = joints.iter().map(|joint| joint.position).collect();
        Ok(Self::new(&state, positions, joints.iter().map(|joint| joint.rate).collect()))
    }

    fn new(state: &RobotState, joints: Vec<f64>, rates: Vec<f64>) -> Self {
        let [w, x, y, z] = state.rotation;
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
        let turn = DMat3::from_rotation_z(-axes.x_axis.y.atan2(axes.x_axis.x)) * axes;
        let up = turn.transpose() * DVec3::Z;
        let legs = LEGS.map(|(first, side)| {
            let at = turn * DVec3::new(0.0, side * SIDE, 0.0);
            let [yaw, roll, pitch, knee] = [0, 1, 2, 3].map(|joint| joints[first + joint]);
            let thigh =
                turn * DMat3::from_rotation_z(yaw) * DMat3::from_rotation_x(roll) * DMat3::from_rotation_y(pitch);
            let down = DVec3::new(0.0, 0.0, -LENGTH);
            let middle = at + thigh * down;
            Leg { hip: at, knee: middle, ankle: middle + thigh * DMat3::from_rotation_y(knee) * down }
        });
        let of_legs: DVec3 = legs.iter().map(|leg| AT_HIP * leg.hip + leg.moment()).sum();
        let centre = (BODY * (turn * DVec3::new(0.0, 0.0, BODY_UP)) + of_legs) / MASS;
        let spin = DVec3::from_array(state.angular_velocity);
        let velocity = turn * DVec3::from_array(state.velocity) + (turn * spin).cross(centre);
        let (pitch, roll) = ((-up.x).atan2(up.y.hypot(up.z)), up.y.atan2(up.z));
        Self { pitch, roll, spin, turn, legs, centre, velocity, joints, rates }
    }

    /// By how much ankles' pitch and roll are moved to hold it upright [rad].
    ///
    /// The gains are those that `rigid-couple/models/README.md` found for soft ground.
    pub(crate) fn balance(&self) -> [f64; 2] {
        [0.5 * self.pitch + 0.08 * self.spin.y, 0.5 * self.roll + 0.08 * self.spin.x]
    }
}

/// Angles of hip yaw, roll and pitch, knee, ankle pitch and roll that bring an ankle there from its hip, with pelvis and sole level.
pub(crate) fn angles_of(ankle: DVec3) -> [f64; 6] {
    let DVec3 { x, y, z } = ankle;
    let down = y.hypot(z);
    let roll = y.atan2(-z);
    let bend = (x * x + down * down - 2.0 * LENGTH * LENGTH) / (2.0 * LENGTH * LENGTH);
    let knee = bend.clamp(-1.0, 1.0).acos();
    let pitch = (-x).atan2(down) - (LENGTH * knee.sin()).atan2(LENGTH + LENGTH * knee.cos());
    [0.0, roll, pitch, knee, -(pitch + knee), -roll]
}
