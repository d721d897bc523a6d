//! SmoothSurface: a heap on a bed of sand is smoothed with a scraper.
//!
//! # Source
//! UBSoft (CoRL 2024), "Smooth Surface": L = Σ (n_t − n_{t−1}), n the number of particles above the mean height of the surface. Here they are counted from a
//! particle's width above it, and by their share of what they were at the start, so that α does not depend on the size of particles.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path};
use crate::reward::Scale;
use crate::tooling::{Goal, ToolTask, Tooling, Verdict, Work};
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::{Region, Shape};
use barchan_core::task::{Limits, Seen, Watch};
use barchan_core::{Aabb, BodyState, Registry, Result, Scene, Simulation};
use std::f64::consts::FRAC_PI_2;

const DOC: &str = "A heap on a bed of sand is to be smoothed with a scraper. Success: less than a fifth of the particles that lay above the mean height of the surface are left there.";
const FILE: &str = include_str!("../scenes/tasks/smooth-surface.toml");

/// Reward of the whole heap: the paper's constants are unknown, and with a thousand an episode's reward is of the size that its table has.
const SCALE: Scale = Scale { alpha: 1000.0, beta: 0.0 };
/// The tool that is moved.
const TOOL: &str = "scraper";
/// Share of the heap that may be left.
const LEFT: f64 = 0.2;

/// What differs between the paper's size and a small one.
struct Sizes {
    /// What is changed in the scene's file.
    changes: &'static [&'static str],
    /// Height of the heap, and its radius [m]: at the angle of rest.
    heap: [f64; 2],
    /// Where it is on average [m].
    middle: [f64; 2],
    /// Thickness of the scraper, and its middle's height above its lower side [m].
    blade: [f64; 2],
    /// Most that the scraper moves in a control step, along each axis [m]: at the paper's size what FluidLab, of the same authors, lets tools do (0.003 a step of
    /// 2 ms), less by as much as steps are shorter.
    most: f64,
    /// Control steps: enough for the hand-written agent.
    horizon: u64,
    /// Distance from the scraper's middle to the sides of the height map [m].
    reach: f64,
}

const FULL: Sizes = Sizes {
    changes: &[],
    heap: [0.12, 0.17],
    middle: [0.5, 0.5],
    blade: [0.04, 0.06],
    most: 0.0015,
    horizon: 2500,
    reach: 0.25,
};
const LITE: Sizes = Sizes {
    changes: &[
        "world.cell=0.0125",
        "world.max=[0.4, 0.3, 0.3]",
        "levels.count=1",
        "time.step=4e-4",
        "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.4, 0.3, 0.0625] }",
        "tool.scraper.position=[0.06, 0.15, 0.22]",
        "tool.scraper.shape.box={ half = [0.015, 0.1, 0.06] }",
    ],
    heap: [0.06, 0.082],
    middle: [0.2, 0.15],
    blade: [0.03, 0.06],
    most: 0.002,
    horizon: 900,
    reach: 0.12,
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "SmoothSurface", DOC, vec![View::parameter("particles")], make)
}

struct SmoothSurface {
    sizes: &'static Sizes,
}

fn make(setup: &TaskSetup<'_>, size: Size) -> Result<ToolTask<SmoothSurface>> {
    let sizes = size.of(&FULL, &LITE);
    let base = Base::new(setup, FILE, sizes.changes, sizes.ranges())?;
    let along = |axis: usize| Degree::along(&base.scene, axis, sizes.most, 0.0);
    let degrees = [along(0), along(1), along(2), Degree::about(2, YAW, [-FRAC_PI_2, FRAC_PI_2])];
    let tooling = Tooling { doc: DOC, tool: TOOL, degrees: &degrees, horizon: sizes.horizon, reach: sizes.reach };
    ToolTask::new(setup, base, &tooling, SmoothSurface { sizes })
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

impl Work for SmoothSurface {
    fn vary(&self, scene: &mut Scene, drawn: &[f64]) {
        if let [x, y, height, angle] = *drawn {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle.into());
            scene.body[0].shape = heap_on(scene, [x, y], height, height * self.sizes.heap[1] / self.sizes.heap[0]);
        }
    }
    fn begin(&self, world: &Simulation, effector: &Effector) -> Result<(Box<dyn Goal>, Path)> {
        let spots = world.spots();
        // The mean height is where all ground would end if it lay level. Of a surface of particles more than that cannot be said, so what lies less than a
        // particle's width above it is level.
        let volume: f64 = spots.iter().map(|spot| spot.volume0).sum();
        let width = spots.iter().map(|spot| spot.volume0).fold(f64::INFINITY, f64::min).cbrt();
        let Aabb { min, max } = world.plan().scene.world_box();
        let mean = min[2] + volume / ((max[0] - min[0]) * (max[1] - min[1]));
        let threshold = mean + width;
        let above = spots.iter().filter(|spot| spot.position[2] > threshold);
        let (mut count, mut middle) = (0.0, [0.0; 2]);
        for spot in above {
            count += 1.0;
            (0..2).for_each(|d| middle[d] += spot.position[d]);
        }
        let start = f64::max(count, 1.0);
        let path = presses(world, effector, mean, middle.map(|sum| sum / start), self.sizes);
        Ok((Box::new(Smoothing { horizon: self.sizes.horizon, threshold, start, above: count }), path))
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

/// The hand-written agent: it presses the heap flat with the scraper's lower side, from the middle outwards, first along x, then along y. To push the heap
/// makes ridges of it, since what a blade leaves behind is a cell thick or nothing.
fn presses(world: &Simulation, effector: &Effector, mean: f64, heap: [f64; 2], sizes: &Sizes) -> Path {
    let [.., high] = effector.position(world);
    let [thickness, height] = sizes.blade;
    let mut stops = vec![(vec![heap[0], heap[1], high, 0.0], 0)];
    for Lap { yaw, reach, low, lift } in LAPS {
        let [low, lift] = [low, lift].map(|above| mean + height + above * sizes.heap[0]);
        let most = (reach * sizes.heap[1] / thickness) as i32;
        stops.push((vec![heap[0], heap[1], high, yaw], 0));
        for k in (0..=2 * most).map(|k| if k % 2 == 0 { k / 2 } else { -(k + 1) / 2 }) {
            let off = f64::from(k) * thickness;
            let [x, y] = if yaw == 0.0 { [heap[0] + off, heap[1]] } else { [heap[0], heap[1] + off] };
            stops.extend([lift, low, lift].map(|z| (vec![x, y, z, yaw], 0)));
        }
    }
    stops.push((vec![heap[0], heap[1], high, 0.0], 0));
    Path::new(stops)
}

/// How often the hand-written agent goes over the heap, and how.
struct Lap {
    /// How the scraper is turned [rad].
    yaw: f64,
    /// How far it goes to either side, by the heap's radius.
    reach: f64,
    /// How far above the mean height its lower side goes and is lifted, by the heap's height.
    low: f64,
    lift: f64,
}

const LAPS: [Lap; 2] =
    [Lap { yaw: 0.0, reach: 0.75, low: 0.02, lift: 0.4 }, Lap { yaw: FRAC_PI_2, reach: 1.1, low: -0.05, lift: 0.32 }];
/// Most that the scraper turns about the vertical in a control step [rad].
const YAW: f64 = 0.02;

struct Smoothing {
    horizon: u64,
    /// Height above which particles are counted [m].
    threshold: f64,
    /// Particles above it at the start, and now.
    start: f64,
    above: f64,
}

impl Goal for Smoothing {
    fn watch(&self, world: &Simulation) -> Watch {
        let Aabb { min, max } = world.plan().scene.world_box();
        Watch::default().and_within(Region::Box { min: [min[0], min[1], self.threshold], max })
    }
    fn judge(&mut self, _world: &Simulation, _tool: &BodyState, seen: &Seen) -> Result<Verdict> {
        let above = seen.sums[0].count as f64;
        let loss = (above - self.above) / self.start;
        self.above = above;
        let left = above / self.start;
        Ok(Verdict {
            reward: SCALE.reward(loss, self.horizon),
            success: left < LEFT,
            info: vec![("share of the heap that is left", left)],
        })
    }
}
