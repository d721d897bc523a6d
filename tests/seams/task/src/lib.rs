//! A task outside Barchan's own crates: push a cube of jelly by two cells with a plate.

use barchan::task::TaskStep;
use barchan::{Error, Registry, Result, Scene, Simulation, Task};
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

/// Fastest that an action may move the plate [m/s].
const MAX_SPEED: f64 = 1.0;
/// Simulated seconds of an action.
const INTERVAL: f64 = 0.05;
/// Distance that counts as success [m].
const GOAL: f64 = 0.1;
/// Actions until the time is up.
const ACTIONS: u32 = 20;

/// Registers the task.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    registry.add_task(NAME, Push::default().doc(), Arc::new(|| Box::new(Push::default())))
}

/// The task; an action is the plate's speed along x, as a share of 1 m/s, and an observation is the plate's x and the cube's
/// mean x [m].
#[derive(Clone, Debug, Default)]
pub struct Push {
    start: f64,
    actions: u32,
}

fn cube(simulation: &Simulation) -> f64 {
    let particles = simulation.particles();
    let list = &particles.lists[0];
    (0..list.len()).map(|i| list.position(i)[0]).sum::<f64>() / list.len() as f64
}

fn observe(simulation: &Simulation) -> Vec<f64> {
    vec![simulation.bodies()[0].position[0], cube(simulation)]
}

impl Task for Push {
    fn name(&self) -> &str {
        NAME
    }
    fn doc(&self) -> &str {
        "Push a cube of jelly by 0.1 m with a plate."
    }
    fn scene(&self) -> Result<Scene> {
        Scene::from_str(SCENE, "push (task)", "")
    }
    fn action_size(&self) -> usize {
        1
    }
    fn observation_size(&self) -> usize {
        2
    }
    fn reset(&mut self, simulation: &mut Simulation, _seed: u64) -> Result<Vec<f64>> {
        (self.start, self.actions) = (cube(simulation), 0);
        Ok(observe(simulation))
    }
    fn step(&mut self, simulation: &mut Simulation, action: &[f64]) -> Result<TaskStep> {
        let &[share] = action else {
            return Err(Error::Body {
                path: format!("task '{NAME}'"),
                what: format!("an action has {} numbers", action.len()),
                mend: "give one: the plate's speed as a share of 1 m/s".to_owned(),
            });
        };
        simulation.drive("plate", [MAX_SPEED * share.clamp(-1.0, 1.0), 0.0, 0.0], [0.0; 3])?;
        let before = cube(simulation);
        let until = simulation.time() + INTERVAL;
        simulation.advance(until, |_, _| std::ops::ControlFlow::Continue(()))?;
        self.actions += 1;
        let observation = observe(simulation);
        let moved = observation[1] - self.start;
        Ok(TaskStep {
            reward: observation[1] - before,
            terminated: moved >= GOAL,
            truncated: self.actions >= ACTIONS,
            observation,
        })
    }
}
