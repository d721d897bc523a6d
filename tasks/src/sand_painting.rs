//! SandPainting: a heart is drawn in sand with a stirrer.
//!
//! # Source
//! UBSoft (CoRL 2024), "Sand Painting": L = Σ d, d the chamfer distance of the particles from their state under a "ground-truth policy", which is not printed. Here d is that
//! of the surface, by points of its height map, from the surface that the hand-written agent leaves: the bed with a groove along the heart, of the profile that was measured.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path};
use crate::reward::Scale;
use crate::tooling::{Goal, ToolTask, Tooling, Verdict, Work, points};
use crate::view::View;
use barchan_core::nearest::Nearest;
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Limits, Seen, Watch};
use barchan_core::{BodyState, Registry, Result, Scene, Simulation};
use std::f64::consts::TAU;

const DOC: &str = "A heart is to be drawn in a bed of sand with a stirrer. Success: the surface is less than half as far from the heart's as the untouched bed is, \
                   and the stirrer is above it.";
const FILE: &str = include_str!("../scenes/tasks/sand-painting.toml");
const TOOL: &str = "stirrer";

/// Chamfer distance that may be left, by that of the untouched bed.
const LEFT: f64 = 0.5;
/// How far above the surface the rod's tip must be in the end [m].
const CLEAR: f64 = 0.01;
/// Corners of the heart's line.
const CORNERS: usize = 64;
/// Heights of the surface beside the line by that of the bed, in radii of the rod, at distances from the line in radii, negative within the heart.
///
/// # Source
/// What the hand-written agent leaves on SandPainting-lite, averaged along the line. It goes around clockwise, and sand goes outwards rather than inwards.
const PROFILE: [[f64; 2]; 19] = [
    [-5.5, 0.0],
    [-4.2, 0.13],
    [-3.2, 0.22],
    [-2.5, 0.4],
    [-1.8, 0.37],
    [-1.5, 0.01],
    [-1.15, -0.6],
    [-0.8, -1.0],
    [-0.2, -1.3],
    [0.2, -1.3],
    [0.5, -1.04],
    [0.85, -0.46],
    [1.15, 0.0],
    [1.5, 0.42],
    [1.85, 0.6],
    [2.5, 0.65],
    [3.2, 0.37],
    [4.2, 0.1],
    [5.5, 0.0],
];

/// What differs between the paper's size and a small one.
struct Sizes {
    changes: &'static [&'static str],
    /// Where the heart is, and its width [m].
    middle: [f64; 2],
    width: f64,
    /// Radius of the rod, its middle's height above its tip, and how deep the tip goes [m].
    rod: [f64; 3],
    /// Most that the rod moves in a control step, along each axis [m].
    most: f64,
    horizon: u64,
    /// Heights that are compared, along x and y.
    map: [usize; 2],
    /// β is α times the chamfer distance of the untouched bed, over all control steps: so an agent that does nothing has no reward.
    scale: Scale,
    reach: f64,
}

const FULL: Sizes = Sizes {
    changes: &[],
    middle: [0.5, 0.5],
    width: 0.5,
    rod: [0.016, 0.076, 0.024],
    most: 0.0015,
    horizon: 1500,
    map: [64, 64],
    scale: Scale { alpha: 1000.0, beta: 1000.0 * 1500.0 * 0.003_454 },
    reach: 0.25,
};
const LITE: Sizes = Sizes {
    changes: &[
        "world.cell=0.01",
        "world.max=[0.36, 0.36, 0.2]",
        "levels.count=1",
        "time.step=3e-4",
        "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.36, 0.36, 0.04] }",
        "tool.stirrer.position=[0.18, 0.2, 0.15]",
        "tool.stirrer.shape.capsule={ radius = 0.014, half_height = 0.05 }",
    ],
    middle: [0.18, 0.18],
    width: 0.24,
    rod: [0.014, 0.064, 0.016],
    most: 0.0015,
    horizon: 700,
    map: [36, 36],
    scale: Scale { alpha: 1000.0, beta: 1000.0 * 700.0 * 0.0094 },
    reach: 0.12,
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "SandPainting", DOC, vec![View::parameter("particles")], make)
}

fn make(setup: &TaskSetup<'_>, size: Size) -> Result<ToolTask<SandPainting>> {
    let sizes = size.of(&FULL, &LITE);
    let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
    let ranges = vec![
        range("friction angle of the sand [deg]", 30.0, 40.0),
        range("density of the sand [kg/m³]", 1400.0, 1800.0),
    ];
    let base = Base::new(setup, FILE, sizes.changes, ranges)?;
    let along = |axis: usize| Degree::along(&base.scene, axis, sizes.most, 0.02);
    let degrees = [along(0), along(1), along(2)];
    let tooling = Tooling { doc: DOC, tool: TOOL, degrees: &degrees, horizon: sizes.horizon, reach: sizes.reach };
    ToolTask::new(setup, base, &tooling, SandPainting { sizes })
}

struct SandPainting {
    sizes: &'static Sizes,
}

impl Work for SandPainting {
    fn vary(&self, scene: &mut Scene, drawn: &[f64]) {
        if let [angle, density] = *drawn {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle.into());
            scene.material[0].density = density;
        }
    }
    fn begin(&self, world: &Simulation, effector: &Effector) -> Result<(Box<dyn Goal>, Path)> {
        let sizes = self.sizes;
        let wanted = looked_at(world, sizes);
        let floor = world.plan().scene.world.min[2];
        let bed: Vec<f64> = world.heights(&wanted)?.into_iter().map(|height| height.unwrap_or(floor)).collect();
        let level = bed.iter().sum::<f64>() / bed.len() as f64;
        let line = heart(sizes);
        let target: Vec<f64> = wanted.iter().map(|point| level + groove(&line, *point, sizes.rod[0])).collect();
        let target = cloud(&wanted, &target);
        let start = chamfer(&cloud(&wanted, &bed), &target);
        let goal = Painting { sizes, points: wanted, target, level, start };
        Ok((Box::new(goal), drawing(world, effector, &line, level, sizes)))
    }
}

fn looked_at(world: &Simulation, sizes: &Sizes) -> Vec<[f64; 2]> {
    let world = &world.plan().scene.world;
    points([world.min[0], world.min[1]], [world.max[0], world.max[1]], sizes.map)
}

/// Corners of the heart, from its notch around and back to it [m].
fn heart(sizes: &Sizes) -> Vec<[f64; 2]> {
    // The well-known curve is 32 wide, and its middle is 2.5 below its origin.
    let unit = sizes.width / 32.0;
    let at = |k: usize| {
        let t = TAU * k as f64 / CORNERS as f64;
        let x = 16.0 * t.sin().powi(3);
        let y = 13.0 * t.cos() - 5.0 * (2.0 * t).cos() - 2.0 * (3.0 * t).cos() - (4.0 * t).cos() + 2.5;
        [sizes.middle[0] + unit * x, sizes.middle[1] + unit * y]
    };
    (0..=CORNERS).map(at).collect()
}

/// Height of the drawn surface above the bed's at a point [m].
fn groove(line: &[[f64; 2]], point: [f64; 2], radius: f64) -> f64 {
    let to_part = |part: &[[f64; 2]]| {
        let (a, b) = (part[0], part[1]);
        let (along, off) = ([b[0] - a[0], b[1] - a[1]], [point[0] - a[0], point[1] - a[1]]);
        let length = along[0] * along[0] + along[1] * along[1];
        let way = ((along[0] * off[0] + along[1] * off[1]) / length).clamp(0.0, 1.0);
        (off[0] - way * along[0]).hypot(off[1] - way * along[1])
    };
    let away = line.windows(2).map(to_part).fold(f64::INFINITY, f64::min) / radius;
    let away = if is_within(line, point) { -away } else { away };
    let next = PROFILE.iter().position(|[at, _]| *at > away).unwrap_or(0);
    if next == 0 {
        return 0.0;
    }
    let ([from, low], [to, high]) = (PROFILE[next - 1], PROFILE[next]);
    radius * (low + (high - low) * (away - from) / (to - from))
}

/// Is a point within a closed line? A ray from it along x crosses the line an odd number of times then.
fn is_within(line: &[[f64; 2]], point: [f64; 2]) -> bool {
    let crosses = |part: &&[[f64; 2]]| {
        let (a, b) = (part[0], part[1]);
        let spans = (a[1] > point[1]) != (b[1] > point[1]);
        spans && point[0] < a[0] + (point[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
    };
    line.windows(2).filter(crosses).count() % 2 == 1
}

/// The hand-written agent: it goes down at the notch, along the line, and up again.
fn drawing(world: &Simulation, effector: &Effector, line: &[[f64; 2]], level: f64, sizes: &Sizes) -> Path {
    let [_, _, high] = effector.position(world);
    let [_, middle, depth] = sizes.rod;
    let low = level + middle - depth;
    let mut stops = vec![(vec![line[0][0], line[0][1], high], 0)];
    stops.extend(line.iter().map(|[x, y]| (vec![*x, *y, low], 0)));
    stops.push((vec![line[0][0], line[0][1], high], 0));
    Path::new(stops)
}

/// A surface by points of it.
fn cloud(points: &[[f64; 2]], heights: &[f64]) -> Vec<[f32; 3]> {
    points.iter().zip(heights).map(|([x, y], z)| [*x as f32, *y as f32, *z as f32]).collect()
}

/// Chamfer distance of two clouds: the mean distance of each one's points from the nearest of the other's, both added [m].
fn chamfer(one: &[[f32; 3]], other: &[[f32; 3]]) -> f64 {
    let one_way = |from: &[[f32; 3]], to: &[[f32; 3]]| {
        let nearest = Nearest::new(to.to_vec());
        from.iter().map(|point| nearest.distance(*point)).sum::<f64>() / from.len() as f64
    };
    one_way(one, other) + one_way(other, one)
}

struct Painting {
    sizes: &'static Sizes,
    /// Where the surface is looked at, the surface with the heart, and height of the bed [m].
    points: Vec<[f64; 2]>,
    target: Vec<[f32; 3]>,
    level: f64,
    /// Chamfer distance of the untouched bed [m].
    start: f64,
}

impl Goal for Painting {
    fn watch(&self, _world: &Simulation) -> Watch {
        Watch { heights: self.points.clone(), ..Watch::default() }
    }
    fn judge(&mut self, world: &Simulation, tool: &BodyState, seen: &Seen) -> Result<Verdict> {
        let floor = world.plan().scene.world.min[2];
        let heights: Vec<f64> = seen.heights.iter().map(|height| height.unwrap_or(floor)).collect();
        let away = chamfer(&cloud(&self.points, &heights), &self.target);
        let left = away / self.start.max(f64::MIN_POSITIVE);
        let clear = tool.position[2] - self.sizes.rod[1] > self.level + CLEAR;
        Ok(Verdict {
            reward: self.sizes.scale.reward(away, self.sizes.horizon),
            success: clear && left < LEFT,
            info: vec![
                ("chamfer distance [mm]", 1000.0 * away),
                ("chamfer distance, by that of the untouched bed", left),
            ],
        })
    }
}
