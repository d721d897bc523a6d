//! A task outside Barchan's own crates: push a block of ground with a tool.
//!
//! It is played in a scene of its own, or in any scene whose `[task]` asks for it by `name = "push"`.

use barchan::parameter::{Parameter, Parameters, Range};
use barchan::registries::TaskSetup;
use barchan::scene::Motion;
use barchan::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan::{Command, Registry, Result, Scene, Simulation, Task};
use std::sync::Arc;

/// Name of the task.
pub const NAME: &str = "push";

const SCENE: &str = r#"
name = "push"
doc = "A plate stands behind a cube of jelly on a slippery floor."

[world]
cell = 0.05
min = [0.0, 0.0, 0.0]
max = [1.6, 0.6, 0.6]
walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "slip" }

[time]
end = 2.0

[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000.0
parameters = { young_modulus = 2e4 }

[[body]]
name = "cube"
material = "jelly"
shape = { box = { min = [0.5, 0.2, 0.0], max = [0.7, 0.4, 0.2] } }

[[tool]]
name = "plate"
shape = { box = { half = [0.05, 0.2, 0.15] } }
position = [0.4, 0.3, 0.16]
contact = "slip"
motion = { velocity = {} }
"#;

/// Fastest that an action may move the tool [m/s].
const MAX_SPEED: f64 = 1.0;
/// Simulated seconds of an action.
const INTERVAL: f64 = 0.05;

/// Registers the task.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let parameters = vec![
        Parameter::number("goal", "m", Range::POSITIVE, "How far along x the ground is to be pushed.").or(0.1),
        Parameter::number("actions", "1", Range::new(1.0, 1e6), "Actions until the time is up.").or(20.0),
        Parameter::text("tool", &[], "The tool that pushes; it is driven by velocity.").or("plate"),
    ];
    registry.add_task(NAME, DOC, parameters, Arc::new(|setup| Ok(Box::new(Push::new(setup)?))))
}

const DOC: &str = "Push ground along x with a tool.";

/// The task; an action is the tool's speed along x, as a share of 1 m/s, and an observation is the tool's x and the mean x of the ground's first
/// material [m].
#[derive(Clone, Debug)]
pub struct Push {
    scene: Scene,
    parameters: Parameters,
}

/// One world of it.
struct Pushing {
    tool: String,
    goal: f64,
    start: f64,
    now: f64,
}

fn ground(simulation: &Simulation) -> f64 {
    let particles = simulation.particles();
    let list = &particles.lists[0];
    (0..list.len()).map(|i| list.position(i)[0]).sum::<f64>() / list.len() as f64
}

impl Push {
    fn new(setup: &TaskSetup<'_>) -> Result<Self> {
        let scene = match setup.scene {
            Some(scene) => scene.clone(),
            None => Scene::from_str(SCENE, "push (task)", "")?,
        };
        let wanted = setup.parameters.text("tool");
        let tool = scene.tool.iter().find(|tool| tool.name == wanted);
        if !tool.is_some_and(|tool| matches!(tool.motion, Motion::Velocity { .. })) {
            let what = format!("no tool '{wanted}' of the scene is driven by velocity");
            return Err(setup.fault("tool", what, "name one with motion = { velocity = {} }"));
        }
        if scene.body.is_empty() {
            return Err(setup.fault("goal", "the scene has no ground to push", "add a [[body]]"));
        }
        Ok(Self { scene, parameters: setup.parameters.clone() })
    }
}

impl Task for Push {
    fn name(&self) -> &str {
        NAME
    }
    fn doc(&self) -> &str {
        DOC
    }
    fn scene(&self, _seed: u64) -> Result<Scene> {
        Ok(self.scene.clone())
    }
    fn actions(&self) -> Vec<Limits> {
        vec![Limits::within("share of 1 m/s along x", 1.0)]
    }
    fn observations(&self) -> Vec<Part> {
        vec![Part::new("x of the tool [m]", 1), Part::new("mean x of the ground [m]", 1)]
    }
    fn interval(&self) -> f64 {
        INTERVAL
    }
    fn horizon(&self) -> u64 {
        self.parameters.number("actions") as u64
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let (tool, goal) = (self.parameters.text("tool").to_owned(), self.parameters.number("goal"));
        Ok(Box::new(Pushing { tool, goal, start: ground(world), now: ground(world) }))
    }
}

impl Episode for Pushing {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        let linear = [MAX_SPEED * action[0], 0.0, 0.0];
        world.act(&self.tool, &Command::Twist { linear, angular: [0.0; 3] })
    }
    fn watch(&self, _world: &Simulation) -> Watch {
        Watch::default()
    }
    fn observe(&mut self, world: &Simulation, _seen: &Seen) -> Result<Outcome> {
        let before = std::mem::replace(&mut self.now, ground(world));
        let tool = world.bodies().into_iter().find(|body| body.name == self.tool);
        let moved = self.now - self.start;
        Ok(Outcome {
            observation: vec![tool.map_or(f64::NAN, |tool| tool.position[0]), self.now],
            reward: self.now - before,
            success: moved >= self.goal,
            terminated: moved >= self.goal,
            info: vec![("moved [m]", moved)],
        })
    }
}
