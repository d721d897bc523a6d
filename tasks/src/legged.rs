//! Robots on legs: what their joints are told, what they feel, and when they have fallen.

use barchan_core::parameter::{Parameter, Range};
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Limits, Part, Seen, Watch};
use barchan_core::{Command, Error, JointState, Result, RobotState, Scene, Simulation, Vec3};

/// What a kind of robot is.
#[derive(Debug)]
pub(crate) struct Kind {
    /// The model that comes with Barchan.
    pub(crate) model: &'static str,
    /// Its joints, in its own order.
    pub(crate) joints: &'static [&'static str],
    /// It has fallen with its base less high than this above the ground [m].
    pub(crate) low: f64,
    /// It has fallen with its base's z axis further from the vertical than this [degrees].
    pub(crate) lean_deg: f64,
}

pub(crate) const QUADRUPED: Kind = Kind {
    model: "quadruped",
    joints: &[
        "FL_hip_joint",
        "FL_thigh_joint",
        "FL_calf_joint",
        "FR_hip_joint",
        "FR_thigh_joint",
        "FR_calf_joint",
        "RL_hip_joint",
        "RL_thigh_joint",
        "RL_calf_joint",
        "RR_hip_joint",
        "RR_thigh_joint",
        "RR_calf_joint",
    ],
    // Its trunk stands at 0.31 m and lies at 0.055 m.
    low: 0.12,
    lean_deg: 60.0,
};

pub(crate) const HUMANOID: Kind = Kind {
    model: "humanoid",
    joints: &[
        "waist_joint",
        "left_shoulder_pitch_joint",
        "left_shoulder_roll_joint",
        "left_shoulder_yaw_joint",
        "left_elbow_joint",
        "right_shoulder_pitch_joint",
        "right_shoulder_roll_joint",
        "right_shoulder_yaw_joint",
        "right_elbow_joint",
        "left_hip_yaw_joint",
        "left_hip_roll_joint",
        "left_hip_pitch_joint",
        "left_knee_joint",
        "left_ankle_pitch_joint",
        "left_ankle_roll_joint",
        "right_hip_yaw_joint",
        "right_hip_roll_joint",
        "right_hip_pitch_joint",
        "right_knee_joint",
        "right_ankle_pitch_joint",
        "right_ankle_roll_joint",
    ],
    // Its pelvis stands at 0.63 m.
    low: 0.4,
    lean_deg: 45.0,
};

/// The robot of a task.
#[derive(Clone, Debug)]
pub(crate) struct Legged {
    name: String,
    kind: &'static Kind,
    /// Most by which an action moves a joint's target [rad].
    most: f64,
    /// Simulated seconds of a control step.
    pub(crate) interval: f64,
}

/// Control steps of 20 ms are what losses are given for [s].
const STEP: f64 = 0.02;
/// Name of the parameter with their length.
const INTERVAL: &str = "interval_ms";

/// The parameter with the length of control steps, for a task's list.
pub(crate) fn interval() -> Parameter {
    let doc = "Simulated time of a control step; the paper's is 2. Rewards of an episode do not depend on it.";
    Parameter::number(INTERVAL, "ms", Range::new(1.0, 100.0), doc).or(1e3 * STEP)
}

impl Legged {
    /// The first robot of a scene, which may be somebody's own.
    ///
    /// # Errors
    /// If it has none.
    pub(crate) fn new(setup: &TaskSetup<'_>, scene: &Scene, kind: &'static Kind, most: f64) -> Result<Self> {
        let robot = scene.robot.first().ok_or_else(|| {
            setup.unfit(
                "the task moves a robot, and the scene has none",
                format!("add a [[robot]] with model = \"{}\"", kind.model),
            )
        })?;
        Ok(Self { name: robot.name.clone(), kind, most, interval: 1e-3 * setup.parameters.number(INTERVAL) })
    }

    /// Control steps in so much time [s].
    pub(crate) fn steps(&self, seconds: f64) -> u64 {
        (seconds / self.interval).round() as u64
    }

    /// Parts of a control step of 20 ms that one of these is.
    pub(crate) fn share(&self) -> f64 {
        self.interval / STEP
    }

    /// What an action holds: by how much each joint's target is moved.
    pub(crate) fn actions(&self) -> Vec<Limits> {
        self.kind.joints.iter().map(|joint| Limits::within(format!("{joint} [rad]"), self.most)).collect()
    }

    /// What of itself it feels.
    pub(crate) fn parts(&self) -> Vec<Part> {
        let count = self.kind.joints.len();
        vec![
            Part::new("x, y, z of the base from its start [m]", 3),
            Part::new("orientation of the base, quaternion w, x, y, z", 4),
            Part::new("direction of gravity along the base's axes", 3),
            Part::new("velocity of the base along its axes [m/s]", 3),
            Part::new("angular velocity of the base along its axes [rad/s]", 3),
            Part::new("positions of the joints from where they stand [rad]", count),
            Part::new("rates of the joints [rad/s]", count),
        ]
    }

    /// The robot as it is.
    ///
    /// # Errors
    /// If it is not there any more.
    pub(crate) fn state(&self, world: &Simulation) -> Result<RobotState> {
        world.robots().into_iter().find(|robot| robot.name == self.name).ok_or_else(|| {
            self.fault("it is no longer there".to_owned(), "keep it as long as the task is played".to_owned())
        })
    }

    fn fault(&self, what: String, mend: String) -> Error {
        Error::Body { path: format!("robot '{}'", self.name), what, mend }
    }

    /// Its joints as they are.
    pub(crate) fn joints(&self, world: &Simulation) -> Vec<JointState> {
        world.joints().into_iter().filter(|joint| joint.body == self.name).collect()
    }

    /// The robot at the start of an episode.
    ///
    /// # Errors
    /// If its joints are not those of its kind.
    pub(crate) fn stand(&self, world: &Simulation) -> Result<Standing> {
        let joints = self.joints(world);
        if !joints.iter().map(|joint| joint.name.as_str()).eq(self.kind.joints.iter().copied()) {
            return Err(self.fault(
                "its joints are not those that the task moves".to_owned(),
                format!("give it model = \"{}\", or joints {}", self.kind.model, self.kind.joints.join(", ")),
            ));
        }
        Ok(Standing {
            legged: self.clone(),
            begun: world.time(),
            position: self.state(world)?.position,
            joints: joints.iter().map(|joint| joint.position).collect(),
        })
    }
}

/// A robot since it stood at the start of an episode.
#[derive(Clone, Debug)]
pub(crate) struct Standing {
    pub(crate) legged: Legged,
    begun: f64,
    /// Where its base was [m].
    pub(crate) position: Vec3,
    /// Where its joints were [rad].
    pub(crate) joints: Vec<f64>,
}

impl Standing {
    /// How long ago that was [s].
    pub(crate) fn time(&self, world: &Simulation) -> f64 {
        world.time() - self.begun
    }

    /// Tells its joints where to go: an action away from there.
    ///
    /// # Errors
    /// If it does not take the command.
    pub(crate) fn act(&self, world: &mut Simulation, from: &[f64], action: &[f64]) -> Result<()> {
        let targets = from.iter().zip(action).map(|(from, by)| from + by).collect();
        world.act(&self.legged.name, &Command::JointTargets(targets))
    }

    /// Besides what a task looks at: the height of the ground below the base.
    pub(crate) fn watch(&self, world: &Simulation, mut watch: Watch) -> Watch {
        let [x, y, _] = self.place(world);
        watch.heights.push([x, y]);
        watch
    }

    /// Where its base is [m]; where it stood if it is not there any more.
    pub(crate) fn place(&self, world: &Simulation) -> Vec3 {
        self.legged.state(world).map_or(self.position, |state| state.position)
    }

    /// The numbers of its [parts](Legged::parts).
    pub(crate) fn numbers(&self, world: &Simulation, state: &RobotState) -> Vec<f64> {
        let joints = self.legged.joints(world);
        let moved = (0..3).map(|d| state.position[d] - self.position[d]);
        let offsets = joints.iter().zip(&self.joints).map(|(joint, stood)| joint.position - stood);
        let base = [state.projected_gravity, state.velocity, state.angular_velocity].concat();
        let rates = joints.iter().map(|joint| joint.rate);
        moved.chain(state.rotation).chain(base).chain(offsets).chain(rates).collect()
    }

    /// Has it fallen? Without ground below it, its height is that above where it stood less the height at which it stands.
    pub(crate) fn fallen(&self, state: &RobotState, seen: &Seen) -> bool {
        let Kind { low, lean_deg, .. } = *self.legged.kind;
        let ground = seen.heights.last().copied().flatten();
        let is_low = ground.is_some_and(|ground| state.position[2] - ground < low);
        is_low || up(state) < lean_deg.to_radians().cos()
    }
}

/// The upward part of the base's z axis.
pub(crate) fn up(state: &RobotState) -> f64 {
    let [_, x, y, _] = state.rotation;
    1.0 - 2.0 * (x * x + y * y)
}

/// Where the base's x axis points, from the world's x axis towards y [rad].
pub(crate) fn heading(state: &RobotState) -> f64 {
    let [w, x, y, z] = state.rotation;
    (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
}

/// Turns a scene's first robot about the vertical by an angle [degrees].
pub(crate) fn turn(scene: &mut Scene, by_deg: f64) {
    if let Some(robot) = scene.robot.first_mut() {
        let half = 0.5 * by_deg.to_radians();
        robot.rotation = [half.cos(), 0.0, 0.0, half.sin()];
    }
}
