//! DigAHole: a shovel goes down into a bed of sand and up again, and leaves a hole.
//!
//! # Source
//! UBSoft (CoRL 2024), "Dig A Hole": L = Σ (σ |z − z_p| + (1 − σ) (−(z − z_p))), z the height of the shovel, z_p that of a point below the surface, σ = 1 in the first
//! stage. When a stage ends is not printed: here the first one ends for good once the shovel's edge has been within a centimetre of z_p.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path};
use crate::reward::Scale;
use crate::tooling::{Goal, ToolTask, Tooling, Verdict, Work, points};
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Limits, Seen, Watch};
use barchan_core::{BodyState, Registry, Result, Scene, Simulation};

const DOC: &str = "A hole is to be dug in a bed of sand with a shovel, which goes down below the surface and up again. Success: the shovel is above the surface, and a hole \
                   of more than half the depth that it was to reach is left.";
const FILE: &str = include_str!("../scenes/tasks/dig-a-hole.toml");
const TOOL: &str = "shovel";

/// Reward of a metre in a control step.
const ALPHA: f64 = 10.0;
/// The first stage ends within this distance of z_p [m].
const REACHED: f64 = 0.01;
/// Share of the depth of z_p that a hole must have, and how far above the surface the edge must be in the end [m].
const DEEP: f64 = 0.5;
const CLEAR: f64 = 0.03;
/// Most that the shovel turns about y in a control step, and between what [rad].
const TURN: f64 = 0.02;
const TURNED: [f64; 2] = [-0.8, 1.0];
/// Heights that are looked at for a hole, along x and y.
const LOOKED_AT: [usize; 2] = [24, 16];

/// What differs between the paper's size and a small one.
struct Sizes {
    changes: &'static [&'static str],
    /// Depth of z_p below the surface [m]: as deep as the blade is long, or half as deep where the bed is shallow.
    depth: f64,
    /// Most that the shovel moves in a control step, along each axis [m]: 0.5 m/s on `-lite`, as fast as tools are drawn through sand in `letters`.
    most: f64,
    horizon: u64,
    /// α times the shovel's distance from z_p at the start, over all control steps: so an agent that does nothing has no reward.
    beta: f64,
    /// Where the edge enters the ground, how far it goes in it, and how high it is lifted above the surface [m].
    strokes: [f64; 3],
    reach: f64,
}

const FULL: Sizes = Sizes {
    changes: &[],
    depth: 0.1,
    most: 0.001,
    horizon: 1000,
    beta: ALPHA * 1000.0 * 0.2,
    strokes: [0.4, 0.24, 0.15],
    reach: 0.25,
};
const LITE: Sizes = Sizes {
    changes: &[
        "world.cell=0.0125",
        "world.max=[0.45, 0.25, 0.4]",
        "levels.count=1",
        "time.step=4e-4",
        "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.45, 0.25, 0.0875] }",
        "tool.shovel.position=[0.1, 0.125, 0.15]",
        "tool.shovel.shape.union=[\
         { shape = { box = { half = [0.045, 0.05, 0.0125] } }, position = [-0.045, 0.0, 0.0] }, \
         { shape = { box = { half = [0.0125, 0.05, 0.025] } }, position = [-0.0775, 0.0, 0.0375] }, \
         { shape = { box = { half = [0.0125, 0.0125, 0.06] } }, position = [-0.0775, 0.0, 0.1225] }]",
    ],
    depth: 0.045,
    most: 0.002,
    horizon: 400,
    beta: ALPHA * 400.0 * 0.1075,
    strokes: [0.14, 0.16, 0.12],
    reach: 0.12,
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "DigAHole", DOC, vec![View::parameter("particles")], make)
}

fn make(setup: &TaskSetup<'_>, size: Size) -> Result<ToolTask<DigAHole>> {
    let sizes = size.of(&FULL, &LITE);
    let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
    let ranges = vec![
        range("friction angle of the sand [deg]", 30.0, 40.0),
        range("density of the sand [kg/m³]", 1400.0, 1800.0),
    ];
    let base = Base::new(setup, FILE, sizes.changes, ranges)?;
    let along = |axis: usize| Degree::along(&base.scene, axis, sizes.most, 0.02);
    let degrees = [along(0), along(2), Degree::about(1, TURN, TURNED)];
    let tooling = Tooling { doc: DOC, tool: TOOL, degrees: &degrees, horizon: sizes.horizon, reach: sizes.reach };
    ToolTask::new(setup, base, &tooling, DigAHole { sizes })
}

struct DigAHole {
    sizes: &'static Sizes,
}

impl Work for DigAHole {
    fn vary(&self, scene: &mut Scene, drawn: &[f64]) {
        if let [angle, density] = *drawn {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle.into());
            scene.material[0].density = density;
        }
    }
    fn begin(&self, world: &Simulation, _effector: &Effector) -> Result<(Box<dyn Goal>, Path)> {
        let heights = world.heights(&looked_at(world))?;
        let known: Vec<f64> = heights.into_iter().flatten().collect();
        let surface = known.iter().sum::<f64>() / known.len().max(1) as f64;
        let point = surface - self.sizes.depth;
        let goal = Digging { sizes: self.sizes, surface, point, reached: false };
        Ok((Box::new(goal), parabola(surface, point, self.sizes)))
    }
}

fn looked_at(world: &Simulation) -> Vec<[f64; 2]> {
    let world = &world.plan().scene.world;
    points([world.min[0], world.min[1]], [world.max[0], world.max[1]], LOOKED_AT)
}

/// The hand-written agent: the edge goes down and up along a parabola with the blade along it, then is lifted level.
fn parabola(surface: f64, point: f64, sizes: &Sizes) -> Path {
    let [enter, length, lift] = sizes.strokes;
    let depth = surface - point;
    let at = |k: usize| {
        let way = k as f64 / STROKE as f64;
        let slope = 4.0 * depth / length * (2.0 * way - 1.0);
        let z = point + depth * (2.0 * way - 1.0).powi(2);
        // A little steeper than the path, so that the blade's lower side does not press on the ground.
        (vec![enter + way * length, z, (-slope.atan() + 0.1).clamp(TURNED[0], TURNED[1])], 0)
    };
    let mut stops: Vec<_> = (0..=STROKE).map(at).collect();
    let before = vec![enter - 0.2 * length, surface + CLEAR, stops[0].0[2]];
    stops.insert(0, (before, 0));
    let after = vec![enter + 1.1 * length, surface + lift, LEVEL];
    stops.push((after, 0));
    Path::new(stops)
}

/// Parts of the parabola.
const STROKE: usize = 12;
/// How far back the shovel is tipped with its load [rad].
const LEVEL: f64 = -0.4;

struct Digging {
    sizes: &'static Sizes,
    /// Height of the ground at the start, and of z_p [m].
    surface: f64,
    point: f64,
    /// The first stage is over.
    reached: bool,
}

impl Goal for Digging {
    fn watch(&self, world: &Simulation) -> Watch {
        Watch { heights: looked_at(world), ..Watch::default() }
    }
    fn judge(&mut self, _world: &Simulation, tool: &BodyState, seen: &Seen) -> Result<Verdict> {
        let off = tool.position[2] - self.point;
        self.reached |= off.abs() < REACHED;
        let loss = if self.reached { -off } else { off.abs() };
        let lowest = seen.heights.iter().flatten().copied().fold(self.surface, f64::min);
        let hole = self.surface - lowest;
        let clear = tool.position[2] > self.surface + CLEAR;
        let scale = Scale { alpha: ALPHA, beta: self.sizes.beta };
        Ok(Verdict {
            reward: scale.reward(loss, self.sizes.horizon),
            success: self.reached && clear && hole > DEEP * self.sizes.depth,
            info: vec![("stage", if self.reached { 2.0 } else { 1.0 }), ("depth of the hole [m]", hole)],
        })
    }
}
