//! Robots in a scene.

use super::Contact;
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
    /// A robot that comes with the program, instead of a file: "quadruped", "humanoid" or "arm".
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
    /// Starting velocity of its base [m/s].
    #[serde(default)]
    pub velocity: Vec3,
    /// Contact of its links with the ground, and friction on rigid things.
    #[serde(default)]
    pub contact: Contact,
    /// Starting positions of its joints [rad or m], by name; a `*` stands for any letters. Joints without one start at 0, or at the stop nearest to it. Motors hold them
    /// there until they are told otherwise.
    #[serde(default)]
    pub joints: BTreeMap<String, f64>,
    /// Its motors: what a later entry gives counts. Joints without one are free.
    #[serde(default)]
    pub motor: Vec<Motor>,
    /// Where its joints are to go.
    #[serde(default)]
    pub motion: Option<JointMotion>,
    /// Mend inertias that no body has, instead of refusing them.
    #[serde(default)]
    pub mend_inertias: bool,
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
    /// Repeats what comes after this time [s], from the last frame on.
    #[serde(default)]
    pub repeat_from: Option<f64>,
}

/// Joint positions at a time.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct JointFrame {
    /// Time [s].
    pub time: f64,
    /// Positions [rad or m] by joints' names; a `*` stands for any letters. Joints that are not named stay at what the frame before says.
    pub joints: BTreeMap<String, f64>,
}

fn all() -> String {
    "*".to_owned()
}
