//! Tasks: a scene, what an agent may do in it, what it sees, and what counts as success.
//!
//! A task never steps. Whoever steps asks, in every control step and for each world: [`Episode::act`] before, [`Episode::watch`] and
//! [`Episode::observe`] after it. So many worlds of one task step together, and what they are looked at for is found together.

use crate::backend::Looked;
use crate::probe::Filter;
use crate::scene::Region;
use crate::seed::uniform;
use crate::{Aabb, Fields, Result, Scene, Simulation, Sought, Sums, Vec3};
use std::fmt;

/// A benchmark task. One object serves any number of worlds: what differs between them is their [`Episode`]'s.
pub trait Task: Send + Sync {
    /// Name as registered.
    fn name(&self) -> &str;
    /// One paragraph.
    fn doc(&self) -> &str;
    /// The scene of a world: the one that the task was [made for](crate::registry::TaskSetup::scene), or its own. Worlds of the same seed
    /// are the same; what else a seed changes is the task's affair.
    ///
    /// # Errors
    /// If the scene cannot be made.
    fn scene(&self, seed: u64) -> Result<Scene>;
    /// The numbers of an action, with their units and limits. What is given beyond them is cut off and counted.
    fn actions(&self) -> Vec<Limits>;
    /// The parts of an observation, in their order.
    fn observations(&self) -> Vec<Part>;
    /// Simulated seconds of a control step.
    fn interval(&self) -> f64;
    /// Control steps after which an episode is cut off.
    fn horizon(&self) -> u64;
    /// What a seed changes, by key path of the scene, and between what it lies: nothing, unless the task is asked to.
    fn ranges(&self) -> Vec<Limits> {
        Vec::new()
    }
    /// Begins an episode in a world that stands at the start of [`scene`](Self::scene) with the same seed.
    ///
    /// # Errors
    /// If the simulation cannot be read.
    fn reset(&self, world: &Simulation, seed: u64) -> Result<Box<dyn Episode>>;
}

/// What a task knows of one world since its episode began.
pub trait Episode: Send {
    /// Turns an action, which lies within the [limits](Task::actions), into commands for the next control step.
    ///
    /// # Errors
    /// If a body does not take the command.
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()>;
    /// What is to be looked at in the world as it is now: it is found where the particles live.
    fn watch(&self, world: &Simulation) -> Watch;
    /// What came of the last control step, from what was seen; after [`Task::reset`], what the agent sees first, with a reward that does not count.
    ///
    /// # Errors
    /// If the simulation cannot be read.
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome>;
    /// What somebody's hand-written agent does now; `None` if the task has none.
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        let _ = world;
        None
    }
}

/// A number with its limits.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    /// Name and unit, such as "dx [m]".
    pub name: String,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
}

impl Limits {
    /// From `-most` to `most`.
    pub fn within(name: impl Into<String>, most: f64) -> Self {
        Self { name: name.into(), low: -most, high: most }
    }
}

/// One number between each of these limits, by a seed: the middle at `share` 0, anywhere between them at 1.
pub fn draw(limits: &[Limits], share: f64, seed: u64) -> Vec<f64> {
    let one = |(number, Limits { low, high, .. }): (usize, &Limits)| {
        let off = uniform(seed, DRAWS, number as u64, 0) - 0.5;
        0.5 * (low + high) + share * off * (high - low)
    };
    limits.iter().enumerate().map(one).collect()
}

/// Sets the numbers of tasks apart from those of the bodies of a scene.
const DRAWS: u64 = 1 << 32;

/// A part of an observation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// What its numbers are, with their units.
    pub name: String,
    /// How many there are.
    pub size: usize,
}

impl Part {
    /// So many numbers.
    pub fn new(name: impl Into<String>, size: usize) -> Self {
        Self { name: name.into(), size }
    }
}

/// What came of a control step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// What the agent sees, in the order of [`Task::observations`].
    pub observation: Vec<f64>,
    /// Reward of the control step.
    pub reward: f64,
    /// What the task asks for has been reached.
    pub success: bool,
    /// The episode has ended by success or failure.
    pub terminated: bool,
    /// Numbers by name, for people and plots.
    pub info: Vec<(&'static str, f64)>,
}

/// What a task wants to see of a world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Watch {
    /// Sums over the particles in regions.
    pub sums: Vec<Sought>,
    /// Heights of the ground at points [m].
    pub heights: Vec<[f64; 2]>,
    /// They are those of soft ground alone. Otherwise tools that stay where they are count as ground.
    pub only_soft: bool,
    /// How many particles are sampled of each level, the finest first.
    pub sample: Vec<usize>,
    /// Particles of which all places are wanted: those in a box.
    pub places: Option<Aabb>,
}

impl Watch {
    /// Counts all particles in a region, besides.
    #[must_use]
    pub fn and_within(mut self, region: Region) -> Self {
        self.sums.push(Sought { region, filter: Filter::default() });
        self
    }
}

/// A particle that was sampled.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sampled {
    /// Where it is [m].
    pub position: Vec3,
    /// Its velocity [m/s].
    pub velocity: Vec3,
}

/// What was seen, in the order of what was [wanted](Watch).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seen {
    /// Sums over the particles in regions.
    pub sums: Vec<Sums>,
    /// Heights of the ground [m]; none where there is neither ground nor floor.
    pub heights: Vec<Option<f64>>,
    /// The particles of each level in the engine's own order, which follows space, cut into as many parts as are wanted, and the first of
    /// each part. A level without particles gives those of the next one that has some; without any at all there are none.
    pub sample: Vec<Sampled>,
    /// Where the particles in the box are [m].
    pub places: Vec<Vec3>,
}

impl Simulation {
    /// Looks at what a task wants to see.
    ///
    /// # Errors
    /// As [`sums_within`](Self::sums_within), [`heights`](Self::heights) and [`read`](Self::read).
    pub fn watch(&self, watch: &Watch) -> Result<Seen> {
        let sums = if watch.sums.is_empty() { Vec::new() } else { self.sums_within(&watch.sums)? };
        self.seen(watch, Looked { sums, sample: self.sample(&watch.sample)?, heights: None })
    }

    /// The same, where something has been looked at before.
    pub(crate) fn seen(&self, watch: &Watch, Looked { sums, sample, heights }: Looked) -> Result<Seen> {
        let heights = match heights {
            Some(found) => self.completed(&watch.heights, found),
            None => self.heights(&watch.heights)?,
        };
        let heights = if watch.only_soft { heights } else { self.with_hard_ground(&watch.heights, heights) };
        let exact = Fields { exact: true, ..Fields::default() };
        let places = watch.places.map(|region| self.read(Some(region), exact)).transpose()?;
        Ok(Seen { sums, heights, sample, places: places.map(|reading| reading.exact).unwrap_or_default() })
    }

    /// A sample of particles: so many of each level, as [`Seen::sample`] says.
    ///
    /// # Errors
    /// [`Error::Device`](crate::Error::Device) if the particles were lost with their device.
    pub fn sample(&self, counts: &[usize]) -> Result<Vec<Sampled>> {
        if counts.iter().all(|count| *count == 0) {
            return Ok(Vec::new());
        }
        let sample = self.engine().sample(counts);
        self.engine().check()?;
        Ok(sample)
    }
}

/// Which of a level's particles are sampled: `counts` of each level, of `present` particles.
pub fn chosen(counts: &[usize], present: &[usize]) -> Vec<(usize, usize)> {
    let mut all = Vec::with_capacity(counts.iter().sum());
    for (level, &count) in counts.iter().enumerate() {
        let coarser = (level..present.len()).find(|l| present[*l] > 0);
        let Some(from) = coarser.or_else(|| (0..level.min(present.len())).rev().find(|l| present[*l] > 0)) else {
            continue;
        };
        all.extend((0..count).map(|k| (from, k * present[from] / count)));
    }
    all
}

impl fmt::Debug for dyn Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Task").field("name", &self.name()).finish_non_exhaustive()
    }
}
