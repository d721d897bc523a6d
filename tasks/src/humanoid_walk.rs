//! HumanoidWalk: a humanoid walks over level ground.
//!
//! # Source
//! UBSoft (CoRL 2024), "Humanoid Walk": L = Σ (d_t + d_h), d_t the distance of the pelvis from a target that goes forward at 1 m/s, d_h by how much the head is off the
//! height at which it started.

use crate::base::Size;
use crate::humanoid::Posture;
use crate::humanoid_stand::{Humanoid, head, parameters};
use crate::legged::Standing;
use crate::reward::Scale;
use crate::stepping::Stepping;
use crate::view::View;
use crate::walk::{left, length, to_target};
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{Registry, Result, Scene, Simulation, Task};

const DOC: &str = "A humanoid is to walk forward over soft ground, after a target that goes 1 m/s. Success: it is 1 m on, and has not fallen.";

/// Standing still for the whole episode gets nothing: Σ d_t is 2505 m then. A robot that follows its target with its head up gets 2500.
const SCALE: Scale = Scale { alpha: 1.0, beta: 2500.0 };
/// Simulated time of an episode [s], and how far it has to come [m].
const SECONDS: f64 = 10.0;
const FAR: f64 = 1.0;
/// How much lower than at the start its head is as it lies [m].
const LIES: f64 = 1.0;

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "HumanoidWalk", DOC, parameters(), HumanoidWalk::new)
}

struct HumanoidWalk(Humanoid);

impl HumanoidWalk {
    fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        Ok(Self(Humanoid::new(setup, size)?))
    }
}

impl Task for HumanoidWalk {
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
        let target = Part::new("x, y from the pelvis to its target [m]", 2);
        self.0.observations().into_iter().chain([target]).collect()
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
        Ok(Box::new(Walking {
            standing: self.0.legged.stand(world)?,
            head: head(&self.0.legged.state(world)?)?,
            view: self.0.view.clone(),
            agent: Stepping::new(),
            horizon: self.horizon(),
            steps: 0,
        }))
    }
}

struct Walking {
    standing: Standing,
    /// Height of the head at the start [m].
    head: f64,
    view: View,
    agent: Stepping,
    horizon: u64,
    /// Control steps taken.
    steps: u64,
}

impl Episode for Walking {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        self.steps += 1;
        self.standing.act(world, &self.standing.joints, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        self.standing.watch(world, self.view.watch(self.standing.place(world)))
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let standing = &self.standing;
        let (state, time) = (standing.legged.state(world)?, standing.time(world));
        let target = to_target(standing.position, state.position, time);
        let of_head = head(&state)? - self.head;
        let terminated = standing.fallen(&state, seen);
        let share = standing.legged.share();
        let mut reward = SCALE.reward(share * (length(target) + of_head.abs()), self.horizon);
        if terminated {
            let steps = self.horizon.saturating_sub(self.steps);
            let losses = left(time, standing.legged.interval, steps);
            reward += SCALE.rest(losses.map(|loss| share * (loss + LIES)), self.horizon);
        }
        let walked = state.position[0] - standing.position[0];
        let mut observation = self.view.numbers(world, seen);
        observation.extend(standing.numbers(world, &state));
        observation.extend([of_head, target[0], target[1]]);
        let taken = self.agent.taken as f64;
        Ok(Outcome {
            observation,
            reward,
            success: walked >= FAR && !terminated,
            terminated,
            info: vec![
                ("distance walked [m]", walked),
                ("off the line [m]", -target[1]),
                ("steps of the hand-written agent", taken),
            ],
        })
    }
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        let posture = Posture::of(&self.standing.legged, world).ok()?;
        let targets = self.agent.targets(self.standing.time(world), &posture, &self.standing.joints);
        Some(targets.iter().zip(&self.standing.joints).map(|(target, stood)| target - stood).collect())
    }
}
