//! HumanoidStand: a humanoid stays on its feet.
//!
//! # Source
//! UBSoft (CoRL 2024), "Humanoid Stand": L = Σ (d_p + d_h), by how much pelvis and head are off the heights at which they started.

use crate::base::{Base, Size};
use crate::ground;
use crate::humanoid::{ANKLE_PITCH, ANKLE_ROLL, LEGS, Posture};
use crate::legged::{self, HUMANOID, Legged, Standing};
use crate::reward::Scale;
use crate::view::View;
use barchan_core::parameter::Parameter;
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{Error, Registry, Result, RobotState, Scene, Simulation, Task};

const DOC: &str = "A humanoid is to stand on soft ground as it starts. Success: after 5 s it has not fallen.";

/// A robot that lies, its pelvis 0.5 m and its head 1 m lower than at the start, gets nothing: so an episode that a fall ends loses all that was left of it, and
/// no more.
const SCALE: Scale = Scale { alpha: 2.0, beta: 750.0 };
/// Simulated time of an episode [s].
const SECONDS: f64 = 5.0;

/// What humanoids' tasks change in the scene for the small size.
const LITE: &[&str] = &[
    "world.cell=0.04",
    "world.min=[-20.0, -20.0, 0.0]",
    "world.max=[40.0, 20.0, 2.5]",
    "world.walls={ z_min = 'stick' }",
    "levels.count=2",
    "levels.half=8",
    "levels.reach=4",
    "body.bed.spacing=0.02666666666666667",
    "body.bed.shape.terrain.min=[-20.0, -20.0]",
    "body.bed.shape.terrain.max=[40.0, 20.0]",
    "body.bed.shape.terrain.origin=[0.0, 0.0, 0.16]",
    "robot.human.position=[0.025, 0.0, 0.791]",
];
/// And on elastic ground besides: it does not tear, and sticks to soles of 3 cm where they are thinner than a cell.
const LITE_ELASTIC: &[&str] = &[
    "world.cell=0.025",
    "body.bed.spacing=0.02",
    "body.bed.shape.terrain.origin=[0.0, 0.0, 0.15]",
    "robot.human.position=[0.025, 0.0, 0.781]",
];
const FILE: &str = include_str!("../scenes/tasks/humanoid.toml");
/// Most by which an action moves a joint from where it stands [rad]: a step needs 0.5.
const MOST: f64 = 0.8;
/// Distance from the robot to the sides of the height map [m].
const REACH: f64 = 0.6;
const HEAD: &str = "head";

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "HumanoidStand", DOC, parameters(), HumanoidStand::new)
}

/// What a humanoid's task may be asked for.
pub(crate) fn parameters() -> Vec<Parameter> {
    vec![ground::parameter(), View::parameter("none"), legged::interval()]
}

/// What humanoids' tasks are made of.
pub(crate) struct Humanoid {
    pub(crate) base: Base,
    pub(crate) legged: Legged,
    pub(crate) view: View,
}

impl Humanoid {
    pub(crate) fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        let ground = ground::changes(setup, size)?;
        let lite = if ground::is_elastic(setup.parameters) { [LITE, LITE_ELASTIC] } else { [LITE, &[]] };
        let own = size.of(Vec::new(), lite.concat());
        let changes: Vec<&str> = own.into_iter().chain(ground.iter().map(String::as_str)).collect();
        let ranges = vec![ground::stiffness()];
        let base = Base::new(setup, FILE, &changes, ranges)?;
        Ok(Self {
            legged: Legged::new(setup, &base.scene, &HUMANOID, MOST)?,
            view: View::new(&base.scene, setup.parameters, REACH),
            base,
        })
    }

    pub(crate) fn scene(&self, seed: u64) -> Scene {
        let mut scene = self.base.scene(seed);
        if let [stiffer] = self.base.drawn(seed)[..] {
            ground::stiffen(&mut scene, stiffer);
        }
        scene
    }

    pub(crate) fn observations(&self) -> Vec<Part> {
        let head = Part::new("height of the head from its start [m]", 1);
        self.view.parts().into_iter().chain(self.legged.parts()).chain([head]).collect()
    }
}

/// Where a humanoid's head is [m].
///
/// # Errors
/// If it has none.
pub(crate) fn head(state: &RobotState) -> Result<f64> {
    let of_head = state.links.iter().find(|link| link.name.rsplit('/').next() == Some(HEAD));
    of_head.map(|link| link.centre[2]).ok_or_else(|| Error::Body {
        path: format!("robot '{}'", state.name),
        what: format!("it has no link '{HEAD}'"),
        mend: format!("give it model = \"{}\"", HUMANOID.model),
    })
}

struct HumanoidStand(Humanoid);

impl HumanoidStand {
    fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        Ok(Self(Humanoid::new(setup, size)?))
    }
}

impl Task for HumanoidStand {
    fn name(&self) -> &str {
        &self.0.base.name
    }
    fn doc(&self) -> &str {
        DOC
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        Ok(self.0.scene(seed))
    }
    fn actions(&self) -> Vec<Limits> {
        self.0.legged.actions()
    }
    fn observations(&self) -> Vec<Part> {
        self.0.observations()
    }
    fn interval(&self) -> f64 {
        self.0.legged.interval
    }
    fn horizon(&self) -> u64 {
        self.0.legged.steps(SECONDS)
    }
    fn ranges(&self) -> Vec<Limits> {
        self.0.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        Ok(Box::new(Staying {
            standing: self.0.legged.stand(world)?,
            head: head(&self.0.legged.state(world)?)?,
            view: self.0.view.clone(),
            horizon: self.horizon(),
            steps: 0,
        }))
    }
}

struct Staying {
    standing: Standing,
    /// Height of the head at the start [m].
    head: f64,
    view: View,
    horizon: u64,
    /// Control steps taken.
    steps: u64,
}

impl Episode for Staying {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        self.steps += 1;
        self.standing.act(world, &self.standing.joints, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        self.standing.watch(world, self.view.watch(self.standing.place(world)))
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let state = self.standing.legged.state(world)?;
        let of_head = head(&state)? - self.head;
        let of_pelvis = state.position[2] - self.standing.position[2];
        let terminated = self.standing.fallen(&state, seen);
        let loss = self.standing.legged.share() * (of_pelvis.abs() + of_head.abs());
        let mut observation = self.view.numbers(world, seen);
        observation.extend(self.standing.numbers(world, &state));
        observation.push(of_head);
        Ok(Outcome {
            observation,
            reward: SCALE.reward(loss, self.horizon),
            success: !terminated && self.steps >= self.horizon,
            terminated,
            info: vec![("pelvis from its start [m]", of_pelvis), ("head from its start [m]", of_head)],
        })
    }
    /// Its ankles turn against how its pelvis leans.
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        let [pitch, roll] = Posture::of(&self.standing.legged, world).ok()?.balance();
        let mut action = vec![0.0; HUMANOID.joints.len()];
        for (first, _) in LEGS {
            action[first + ANKLE_PITCH] = pitch;
            action[first + ANKLE_ROLL] = roll;
        }
        Some(action)
    }
}
