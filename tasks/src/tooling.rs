//! What those tasks have in common in which an agent moves one tool.

use crate::base::Base;
use crate::effector::{Degree, Effector, Path};
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{BodyState, Result, Scene, Simulation, Task, Vec3};

/// Soil steps of a control step.
///
/// # Source
/// UBSoft (CoRL 2024), appendix: 0.002 s and 2e-4 s.
const STEPS: f64 = 10.0;

/// A task with a tool.
pub(crate) struct ToolTask<W> {
    common: Common,
    work: W,
}

/// What it is made of, whatever is to be done.
pub(crate) struct Common {
    base: Base,
    doc: &'static str,
    effector: Effector,
    view: View,
    horizon: u64,
}

/// A tool of a task, and how long an agent has it.
pub(crate) struct Tooling<'a> {
    /// What the task is, in a sentence or two.
    pub(crate) doc: &'static str,
    /// Name of the tool.
    pub(crate) tool: &'a str,
    /// How it moves.
    pub(crate) degrees: &'a [Degree],
    /// Control steps of an episode.
    pub(crate) horizon: u64,
    /// Distance from the tool to the sides of the height map that an agent may see [m].
    pub(crate) reach: f64,
}

/// What is to be done with the tool.
pub(crate) trait Work: Send + Sync {
    /// Puts into the scene what a seed has drawn: a number for each of the ranges that the [`Base`] was made with; none for a scene that was given.
    fn vary(&self, scene: &mut Scene, drawn: &[f64]);
    /// What an agent sees besides ground and tool.
    fn part(&self) -> Option<Part> {
        None
    }
    /// Begins an episode, with a path for the hand-written agent.
    ///
    /// # Errors
    /// If the scene lacks what the task needs.
    fn begin(&self, world: &Simulation, effector: &Effector) -> Result<(Box<dyn Goal>, Path)>;
}

/// How far a world is from what is to be done.
pub(crate) trait Goal: Send {
    /// What is to be looked at, besides what the agent sees: sums, heights and places.
    fn watch(&self, world: &Simulation) -> Watch;
    /// What came of a control step. What was seen holds what [`watch`](Self::watch) asked for alone.
    ///
    /// # Errors
    /// If a body is missing.
    fn judge(&mut self, world: &Simulation, tool: &BodyState, seen: &Seen) -> Result<Verdict>;
    /// The numbers of [`Work::part`].
    ///
    /// # Errors
    /// If a body is missing.
    fn numbers(&self, world: &Simulation) -> Result<Vec<f64>> {
        let _ = world;
        Ok(Vec::new())
    }
}

/// What came of a control step.
pub(crate) struct Verdict {
    /// Reward.
    pub(crate) reward: f64,
    /// Is it done?
    pub(crate) success: bool,
    /// Numbers by name, for people.
    pub(crate) info: Vec<(&'static str, f64)>,
}

impl<W: Work> ToolTask<W> {
    /// With a tool of the scene, which may be somebody's own.
    ///
    /// # Errors
    /// If the scene has no such tool.
    pub(crate) fn new(setup: &TaskSetup<'_>, base: Base, tooling: &Tooling<'_>, work: W) -> Result<Self> {
        let interval = base.seconds_of(STEPS);
        let common = Common {
            doc: tooling.doc,
            effector: Effector::new(setup, &base.scene, tooling.tool, tooling.degrees, interval)?,
            view: View::new(&base.scene, setup.parameters, tooling.reach),
            horizon: tooling.horizon,
            base,
        };
        Ok(Self { common, work })
    }
}

impl<W: Work> Task for ToolTask<W> {
    fn name(&self) -> &str {
        &self.common.base.name
    }
    fn doc(&self) -> &str {
        self.common.doc
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        let mut scene = self.common.base.scene(seed);
        self.work.vary(&mut scene, &self.common.base.drawn(seed));
        Ok(scene)
    }
    fn actions(&self) -> Vec<Limits> {
        self.common.effector.actions()
    }
    fn observations(&self) -> Vec<Part> {
        let parts = self.common.view.parts().into_iter().chain([self.common.effector.part()]);
        parts.chain(self.work.part()).collect()
    }
    fn interval(&self) -> f64 {
        self.common.base.seconds_of(STEPS)
    }
    fn horizon(&self) -> u64 {
        self.common.horizon
    }
    fn ranges(&self) -> Vec<Limits> {
        self.common.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let Common { effector, view, .. } = &self.common;
        let (goal, path) = self.work.begin(world, effector)?;
        Ok(Box::new(Play { effector: effector.clone(), view: view.clone(), goal, path }))
    }
}

/// An episode of it.
struct Play {
    effector: Effector,
    view: View,
    goal: Box<dyn Goal>,
    path: Path,
}

impl Episode for Play {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        self.effector.act(world, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        let Watch { sums, heights, places, .. } = self.goal.watch(world);
        let mut watch = self.view.watch(self.effector.position(world));
        watch.sums = sums;
        watch.heights.extend(heights);
        watch.places = places;
        watch
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let mut observation = self.view.numbers(world, seen);
        observation.extend(self.effector.numbers(world)?);
        observation.extend(self.goal.numbers(world)?);
        let heights = seen.heights[self.view.heights()..].to_vec();
        let own = Seen { sums: seen.sums.clone(), heights, places: seen.places.clone(), ..Seen::default() };
        let Verdict { reward, success, info } = self.goal.judge(world, &self.effector.body(world)?, &own)?;
        Ok(Outcome { observation, reward, success, terminated: false, info })
    }
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        Some(self.path.next(&self.effector, world))
    }
}

/// Points at the middles of so many by so many equal parts of a box, row by row along x.
pub(crate) fn points(min: [f64; 2], max: [f64; 2], counts: [usize; 2]) -> Vec<[f64; 2]> {
    let at = |i: usize, d: usize| min[d] + (max[d] - min[d]) * (i as f64 + 0.5) / counts[d] as f64;
    (0..counts[0] * counts[1]).map(|i| [at(i % counts[0], 0), at(i / counts[0], 1)]).collect()
}

/// Distance between two points [m].
pub(crate) fn distance(a: Vec3, b: Vec3) -> f64 {
    (0..3).map(|d| (a[d] - b[d]).powi(2)).sum::<f64>().sqrt()
}
