//! Robots in a scene.

use super::{Contact, Keyframe, fits};
use crate::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A robot of links and joints.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Robot {
    /// Name in traces and messages. Its links are called `name/link`.
    pub name: String,
    /// A URDF file.
    #[serde(default)]
    pub urdf: Option<PathBuf>,
    /// A robot that comes with the program, instead of a file: "quadruped", "humanoid", "arm", or the arm with a
    /// tool: "arm-rod", "arm-shovel", "arm-scraper".
    #[serde(default)]
    pub model: Option<String>,
    /// Where the frame of its base starts [m].
    #[serde(default)]
    pub position: Vec3,
    /// Starting orientation of its base, quaternion (w, x, y, z).
    #[serde(default = "super::no_rotation")]
    pub rotation: [f64; 4],
    /// Stays its base where it is? Else it floats freely.
    #[serde(default)]
    pub fixed: bool,
    /// Starting velocity of its base's frame [m/s].
    #[serde(default)]
    pub velocity: Vec3,
    /// Starting angular velocity of its base [rad/s].
    #[serde(default)]
    pub angular_velocity: Vec3,
    /// Contact of its links with the ground, and friction on rigid things.
    #[serde(default)]
    pub contact: Contact,
    /// Starting positions of its joints [rad or m], by name; a `*` stands for any letters. Whole names count before patterns, and patterns with more letters before those with
    /// fewer. Joints without one start at 0, or at the stop nearest to it. Motors hold them
    /// there until they are told otherwise.
    #[serde(default)]
    pub joints: BTreeMap<String, f64>,
    /// Its motors: what a later entry gives counts. Joints without one are free.
    #[serde(default)]
    pub motor: Vec<Motor>,
    /// Where its joints are to go.
    #[serde(default)]
    pub motion: Option<JointMotion>,
    /// Corrections of joints' targets by how its base leans.
    #[serde(default)]
    pub balance: Vec<Balance>,
    /// Points around its base at which it senses the height of the ground.
    #[serde(default)]
    pub scan: Option<Scan>,
    /// Do its links touch one another? Neighbours at a joint never do, nor do links that overlap at the start.
    #[serde(default)]
    pub self_collision: bool,
    /// Masses of its links instead of the URDF's [kg], by name; a `*` stands for any letters, and names count before patterns as those of `joints` do. A link's inertia
    /// grows with its mass. What it carries is mass of its base, or of its hand.
    #[serde(default)]
    pub masses: BTreeMap<String, f64>,
    /// Mend inertias that no body has, instead of refusing them.
    #[serde(default)]
    pub mend_inertias: bool,
    /// What its collision meshes stand for. A plan warns of hollow ones that are taken as hulls.
    #[serde(default)]
    pub collision_meshes: CollisionMeshes,
}

/// What a robot's collision meshes stand for.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CollisionMeshes {
    /// Their convex hulls, which is what most files mean by them. They need not be closed.
    #[default]
    Hull,
    /// Themselves, hollows and all: buckets, forks, treads. They have to be closed. Rigid bodies meet them as several convex bodies.
    Exact,
    /// Themselves for the links of these names, and their convex hulls for all others; a `*` stands for any letters.
    ExactLinks(Vec<String>),
}

impl CollisionMeshes {
    /// Are the meshes of a link taken as they are?
    pub fn are_exact(&self, link: &str) -> bool {
        match self {
            Self::Hull => false,
            Self::Exact => true,
            Self::ExactLinks(patterns) => patterns.iter().any(|pattern| fits(pattern, link)),
        }
    }
}

/// Motors of some of a robot's joints. Torque = kp (target − position) + kd (target rate − rate), within the effort.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Motor {
    /// Their joints' names; a `*` stands for any letters.
    #[serde(default = "all")]
    pub joints: String,
    /// Torque for each radian off the target [N m/rad], or force for each metre [N/m].
    #[serde(default)]
    pub kp: Option<f64>,
    /// Torque for each unit of rate off the target's [N m s/rad], or force [N s/m].
    #[serde(default)]
    pub kd: Option<f64>,
    /// Greatest torque [N m] or force [N], instead of the URDF's.
    #[serde(default)]
    pub effort: Option<f64>,
    /// Inertia of the motor as the joint feels it [kg m² or kg]; absent: 0.01.
    #[serde(default)]
    pub armature: Option<f64>,
}

/// A correction of some joints' targets, in every step and wherever their motors hold a position, within the joints' limits: gain · angle + rate · angular velocity, of
/// the base. Ankles that follow its lean keep a robot upright on soft ground.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Balance {
    /// The joints' names; a `*` stands for any letters.
    pub joints: String,
    /// Which way the base leans.
    pub of: Lean,
    /// Change of the target for each radian that the base leans [rad/rad, or m/rad].
    #[serde(default)]
    pub gain: f64,
    /// Change of the target for each rad/s at which it does [s, or m s/rad].
    #[serde(default)]
    pub rate: f64,
}

/// A way to lean. Both angles are 0 where the base's z axis points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Lean {
    /// About the base's y axis: forward is positive.
    Pitch,
    /// About the base's x axis: to the right is positive.
    Roll,
}

/// Points around a robot's base, a grid that turns with it about the vertical and stays level.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scan {
    /// Its least corner from the base's origin: along x ahead, along y to the left [m].
    pub min: [f64; 2],
    /// Its greatest corner [m].
    pub max: [f64; 2],
    /// Points along x and along y.
    pub points: [u32; 2],
}

impl Scan {
    /// Where the points are from the base [m], rows along x; a single one is in the middle.
    pub fn places(&self) -> impl Iterator<Item = [f64; 2]> {
        let along = |d: usize, i: u32| match self.points[d] {
            1 => 0.5 * (self.min[d] + self.max[d]),
            n => self.min[d] + (self.max[d] - self.min[d]) * f64::from(i) / f64::from(n - 1),
        };
        (0..self.points[1]).flat_map(move |j| (0..self.points[0]).map(move |i| [along(0, i), along(1, j)]))
    }
}

/// Where a robot's joints are to go: straight from frame to frame, at rest before the first and after the last.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct JointMotion {
    /// Frames, with rising times.
    #[serde(default)]
    pub frames: Vec<JointFrame>,
    /// A CSV file with the frames, instead: a header of `time` and joints' names, then a row for each frame.
    #[serde(default)]
    pub file: Option<PathBuf>,
    /// Frames that come with the program, instead: "quadruped-trot" or "humanoid-step".
    #[serde(default)]
    pub model: Option<String>,
    /// Repeats what comes after this time [s], from the last frame on.
    #[serde(default)]
    pub repeat_from: Option<f64>,
    /// Steps of its feet, instead of frames.
    #[serde(default)]
    pub gait: Option<Gait>,
    /// A path of one of its links, instead of frames.
    #[serde(default)]
    pub path: Option<LinkPath>,
}

/// Steps of a robot's feet, by inverse kinematics from where they are at the start, seen from the base. On the ground a foot goes back by the stride, in the
/// air forward again.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gait {
    /// The feet's links, and the share of a period at which each is set down: a trot has diagonal feet at 0 and 0.5.
    pub feet: BTreeMap<String, f64>,
    /// Time of a step of all feet [s].
    pub period: f64,
    /// Share of the period for which a foot is on the ground.
    #[serde(default = "half")]
    pub stance: f64,
    /// How far a foot goes in a step, in the base's frame [m].
    pub stride: Vec3,
    /// How high it is lifted [m].
    pub lift: f64,
    /// When it begins [s].
    #[serde(default)]
    pub start: f64,
    /// Periods over which strides grow to their length.
    #[serde(default = "two")]
    pub ramp: u32,
}

impl Gait {
    /// Where a foot is at a time after it was first set down, in periods: from half a stride ahead back to half a stride behind on the ground, then forward again
    /// through the air, at rest where it leaves the ground and comes to it; and how high, in parts of the lift.
    pub fn foot(&self, periods: f64) -> [f64; 2] {
        let share = periods.rem_euclid(1.0);
        if share < self.stance {
            return [0.5 - share / self.stance, 0.0];
        }
        let air = (share - self.stance) / (1.0 - self.stance);
        let turn = std::f64::consts::TAU * air;
        [air - turn.sin() / std::f64::consts::TAU - 0.5, 0.5 * (1.0 - turn.cos())]
    }
}

/// A path of a link's frame in the world, by inverse kinematics, for a robot whose base is fixed. The robot starts where the path does.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LinkPath {
    /// The link.
    pub link: String,
    /// Places with rising times. A rotation that is absent does not matter.
    pub frames: Vec<Keyframe>,
}

fn half() -> f64 {
    0.5
}
fn two() -> u32 {
    2
}

/// Joint positions at a time.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct JointFrame {
    /// Time [s].
    pub time: f64,
    /// Positions [rad or m] by joints' names; a `*` stands for any letters, as in a robot's `joints`. Joints that are not named stay at what the frame before says.
    pub joints: BTreeMap<String, f64>,
}

fn all() -> String {
    "*".to_owned()
}
