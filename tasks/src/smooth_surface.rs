//! SmoothSurface: a heap on a bed of sand is smoothed with a scraper.
//!
//! # Source
//! UBSoft (CoRL 2024), "Smooth Surface": L = Σ (n_t − n_{t−1}), n the number of particles above the mean height of the surface. Here n is a share of what it was at the
//! start, so that α does not depend on the size of particles.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path, Way};
use crate::reward::Scale;
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::{Region, Shape};
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{Aabb, Registry, Result, Scene, Simulation, Task};
use std::f64::consts::FRAC_PI_2;

const DOC: &str = "A heap on a bed of sand is to be smoothed with a scraper. Success: less than a fifth of the particles above the mean height of the surface are left.";
const FILE: &str = include_str!("../scenes/tasks/smooth-surface.toml");

/// Reward of the whole heap: the paper's constants are unknown, and with a thousand an episode's reward is of the size that its table has.
const SCALE: Scale = Scale { alpha: 1000.0, beta: 0.0 };
/// The tool that is moved.
const TOOL: &str = "scraper";
/// Share of the heap that may be left.
const LEFT: f64 = 0.2;
/// Soil steps of a control step: the paper's.
const STEPS: f64 = 10.0;

/// What differs between the paper's size and a small one.
struct Sizes {
    /// What is changed in the scene's file.
    changes: &'static [&'static str],
    /// Height of the heap, and its radius [m]: at the angle of rest.
    heap: [f64; 2],
    /// Where it is on average [m].
    middle: [f64; 2],
    /// Most that the scraper moves in a control step, along each axis [m]: at the paper's size what FluidLab, of the same authors, lets tools do (0.003 a step of
    /// 2 ms), less by as much as steps are shorter.
    most: f64,
    /// Control steps: enough to cross the bed twice.
    horizon: u64,
    /// Distance from the scraper's middle to the sides of the height map [m].
    reach: f64,
}

const FULL: Sizes =
    Sizes { changes: &[], heap: [0.12, 0.17], middle: [0.5, 0.5], most: 0.0015, horizon: 1000, reach: 0.25 };
const LITE: Sizes = Sizes {
    changes: &[
        "world.cell=0.0125",
        "world.max=[0.4, 0.3, 0.3]",
        "levels.count=1",
        "time.step=3e-4",
        "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.4, 0.3, 0.0625] }",
        "tool.scraper.position=[0.06, 0.15, 0.22]",
        "tool.scraper.shape.box={ half = [0.015, 0.1, 0.06] }",
    ],
    heap: [0.08, 0.115],
    middle: [0.2, 0.15],
    most: 0.003,
    horizon: 600,
    reach: 0.12,
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "SmoothSurface", DOC, vec![View::parameter("particles")], SmoothSurface::new)
}

struct SmoothSurface {
    base: Base,
    sizes: &'static Sizes,
    effector: Effector,
    view: View,
}

impl SmoothSurface {
    fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        let sizes = size.of(&FULL, &LITE);
        let base = Base::new(setup, FILE, sizes.changes, sizes.ranges())?;
        let [min, max] = [base.scene.world.min, base.scene.world.max];
        let along = |d: usize| Degree { way: Way::Along(d), most: sizes.most, range: [min[d], max[d]] };
        let yaw = Degree { way: Way::About(2), most: YAW, range: [-FRAC_PI_2, FRAC_PI_2] };
        let degrees = [along(0), along(1), along(2), yaw];
        Ok(Self {
            effector: Effector::new(setup, &base.scene, TOOL, &degrees, base.seconds_of(STEPS))?,
            view: View::new(&base.scene, setup.parameters, sizes.reach),
            base,
            sizes,
        })
    }
}

impl Sizes {
    /// Where the heap is, how high, and how steep sand lies.
    fn ranges(&self) -> Vec<Limits> {
        let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
        let ([x, y], [height, radius]) = (self.middle, self.heap);
        vec![
            range("x of the heap [m]", x - 0.5 * radius, x + 0.5 * radius),
            range("y of the heap [m]", y - 0.5 * radius, y + 0.5 * radius),
            range("height of the heap [m]", 0.75 * height, 1.25 * height),
            range("friction angle of the sand [deg]", 30.0, 40.0),
        ]
    }
}

impl Task for SmoothSurface {
    fn name(&self) -> &str {
        &self.base.name
    }
    fn doc(&self) -> &str {
        DOC
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        let mut scene = self.base.scene(seed);
        if let [x, y, height, angle] = self.base.drawn(seed)[..] {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle.into());
            scene.body[0].shape = heap_on(&scene, [x, y], height, height * self.sizes.heap[1] / self.sizes.heap[0]);
        }
        Ok(scene)
    }
    fn actions(&self) -> Vec<Limits> {
        self.effector.actions()
    }
    fn observations(&self) -> Vec<Part> {
        self.view.parts().into_iter().chain([self.effector.part()]).collect()
    }
    fn interval(&self) -> f64 {
        self.base.seconds_of(STEPS)
    }
    fn horizon(&self) -> u64 {
        self.sizes.horizon
    }
    fn ranges(&self) -> Vec<Limits> {
        self.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let spots = world.spots();
        // The mean height is where all ground would end if it lay level.
        let volume: f64 = spots.iter().map(|spot| spot.volume0).sum();
        let Aabb { min, max } = world.plan().scene.world_box();
        let mean = min[2] + volume / ((max[0] - min[0]) * (max[1] - min[1]));
        let above = spots.iter().filter(|spot| spot.position[2] > mean);
        let (mut count, mut middle) = (0.0, [0.0; 2]);
        for spot in above {
            count += 1.0;
            (0..2).for_each(|d| middle[d] += spot.position[d]);
        }
        Ok(Box::new(Smoothing {
            effector: self.effector.clone(),
            view: self.view.clone(),
            horizon: self.sizes.horizon,
            mean,
            start: f64::max(count, 1.0),
            above: count,
            path: passes(world, &self.effector, mean, middle.map(|sum| sum / f64::max(count, 1.0)), self.sizes),
        }))
    }
}

/// The bed with a heap: a cone on the box that the scene's file has.
fn heap_on(scene: &Scene, middle: [f64; 2], height: f64, radius: f64) -> Shape {
    let Aabb { min, max } = scene.world_box();
    let bottom = min[2];
    let level = scene.body[0].shape.bounds().map_or(bottom, |bounds| bounds.max[2]);
    let counts = [0, 1].map(|d| ((max[d] - min[d]) / scene.world.cell).round() as usize);
    let at = |i: usize, d: usize| min[d] + (max[d] - min[d]) * i as f64 / counts[d] as f64;
    let above = |x: f64, y: f64| height * (1.0 - (x - middle[0]).hypot(y - middle[1]) / radius).max(0.0);
    let row = |j: usize| (0..=counts[0]).map(|i| level + above(at(i, 0), at(j, 1))).collect();
    let heights = (0..=counts[1]).map(row).collect();
    Shape::HeightField { min: [min[0], min[1]], max: [max[0], max[1]], bottom, heights, file: None }
}

/// The hand-written agent: it takes the heap off in layers, from both sides in turn.
fn passes(world: &Simulation, effector: &Effector, mean: f64, heap: [f64; 2], sizes: &Sizes) -> Path {
    let Aabb { min, max } = world.plan().scene.world_box();
    let [_, _, z] = effector.position(world);
    let [height, radius] = sizes.heap;
    let away = 2.0 * radius;
    let ends = [(heap[0] - away).max(min[0] + BLADE[0]), (heap[0] + away).min(max[0] - BLADE[0])];
    let mut stops = vec![(vec![ends[0], heap[1], z, 0.0], 0)];
    let mut side = 0;
    for layer in (0..PASSES).rev() {
        // The lowest pass leaves as much as the heap's sand makes when it lies level.
        let low = mean + BLADE[1] + height * layer as f64 / PASSES as f64;
        stops.push((vec![ends[side], heap[1], low, 0.0], 0));
        side = 1 - side;
        stops.push((vec![ends[side], heap[1], low, 0.0], 0));
    }
    stops.push((vec![ends[side], heap[1], z, 0.0], 0));
    Path::new(stops)
}

/// Most that the scraper turns about the vertical in a control step [rad].
const YAW: f64 = 0.02;
/// Layers in which the hand-written agent takes the heap off.
const PASSES: u32 = 3;
/// From the scraper's middle to its sides along x, and to its lower edge [m].
const BLADE: [f64; 2] = [0.02, 0.06];

struct Smoothing {
    effector: Effector,
    view: View,
    horizon: u64,
    /// Mean height of the surface [m].
    mean: f64,
    /// Particles above it at the start, and now.
    start: f64,
    above: f64,
    path: Path,
}

impl Episode for Smoothing {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        self.effector.act(world, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        let Aabb { min, max } = world.plan().scene.world_box();
        let above = Region::Box { min: [min[0], min[1], self.mean], max };
        self.view.watch(self.effector.position(world)).and_within(above)
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let above = seen.sums[0].count as f64;
        let loss = (above - self.above) / self.start;
        self.above = above;
        let mut observation = self.view.numbers(world, seen);
        observation.extend(self.effector.numbers(world)?);
        let left = above / self.start;
        Ok(Outcome {
            observation,
            reward: SCALE.reward(loss, self.horizon),
            success: left < LEFT,
            terminated: false,
            info: vec![("share of the heap that is left", left)],
        })
    }
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        Some(self.path.next(&self.effector, world))
    }
}
