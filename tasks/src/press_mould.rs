//! PressMould: a lump of dough is pressed into a mould with a plate. Not in the paper.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path};
use crate::reward::Scale;
use crate::tooling::{Goal, ToolTask, Tooling, Verdict, Work};
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::Region;
use barchan_core::task::{Limits, Seen, Watch};
use barchan_core::{BodyState, Registry, Result, Scene, Simulation};

const DOC: &str = "A lump of dough is to be pressed into a mould in the form of a plus with a plate. Success: more than 85 % of the mould is full.";
const FILE: &str = include_str!("../scenes/tasks/press-mould.toml");
const TOOL: &str = "plate";

/// Reward of a mould that becomes full: as much as of a heap that goes in SmoothSurface.
const SCALE: Scale = Scale { alpha: 1000.0, beta: 0.0 };
/// Share of the mould that must be full.
const FULL_ENOUGH: f64 = 0.85;
/// The mould: the world's middle and four arms, so wide and so deep [m].
const WIDTH: f64 = 0.1;
const DEPTH: f64 = 0.03;
/// From the mould's middle to where the plate presses on an arm, and how far it is lifted between [m].
const ARM: f64 = 0.055;
const LIFT: f64 = 0.045;
/// From the plate's middle to its lower side [m].
const PLATE: f64 = 0.015;

/// What differs between a fine size and a small one.
struct Sizes {
    changes: &'static [&'static str],
    /// Most that the plate moves in a control step, along each axis [m]: 0.5 m/s.
    most: f64,
    horizon: u64,
}

const FULL: Sizes = Sizes { changes: &[], most: 0.0005, horizon: 2100 };
const LITE: Sizes = Sizes { changes: &["world.cell=0.01", "time.step=3e-4"], most: 0.0015, horizon: 700 };

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "PressMould", DOC, vec![View::parameter("particles")], make)
}

fn make(setup: &TaskSetup<'_>, size: Size) -> Result<ToolTask<PressMould>> {
    let sizes = size.of(&FULL, &LITE);
    let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
    let ranges =
        vec![range("yield stress of the dough [Pa]", 1500.0, 2500.0), range("height of the lump [m]", 0.085, 0.095)];
    let base = Base::new(setup, FILE, sizes.changes, ranges)?;
    let along = |axis: usize| Degree::along(&base.scene, axis, sizes.most, PLATE);
    let degrees = [along(0), along(1), along(2)];
    let tooling = Tooling { doc: DOC, tool: TOOL, degrees: &degrees, horizon: sizes.horizon, reach: 0.12 };
    ToolTask::new(setup, base, &tooling, PressMould { sizes })
}

struct PressMould {
    sizes: &'static Sizes,
}

impl Work for PressMould {
    fn vary(&self, scene: &mut Scene, drawn: &[f64]) {
        if let [yield_stress, height] = *drawn {
            scene.material[0].parameters.insert("yield_stress".to_owned(), yield_stress.into());
            if let barchan_core::scene::Shape::Box { max: Some(max), .. } = &mut scene.body[0].shape {
                max[2] = height;
            }
        }
    }
    fn begin(&self, world: &Simulation, effector: &Effector) -> Result<(Box<dyn Goal>, Path)> {
        let parts = mould(world);
        let volume = |part: &Region| part.middle().1.iter().map(|half| 2.0 * half).product::<f64>();
        let room: f64 = parts.iter().map(volume).sum();
        let watch = parts.iter().cloned().fold(Watch::default(), Watch::and_within);
        let full = share(&world.watch(&watch)?, room);
        let goal = Pressing { sizes: self.sizes, watch, room, full };
        Ok((Box::new(goal), presses(world, effector)))
    }
}

/// The mould's inside: an arm along x from wall to wall, and the two along y.
fn mould(world: &Simulation) -> [Region; 3] {
    let world = &world.plan().scene.world;
    let [low, high] = [-0.5, 0.5].map(|half| [0, 1].map(|d| 0.5 * (world.min[d] + world.max[d]) + half * WIDTH));
    let [bottom, top] = [world.min[2], world.min[2] + DEPTH];
    let part = |min: [f64; 2], max: [f64; 2]| Region::Box { min: [min[0], min[1], bottom], max: [max[0], max[1], top] };
    [
        part([world.min[0], low[1]], [world.max[0], high[1]]),
        part([low[0], world.min[1]], [high[0], low[1]]),
        part([low[0], high[1]], [high[0], world.max[1]]),
    ]
}

/// Share of the room that dough fills.
fn share(seen: &Seen, room: f64) -> f64 {
    (seen.sums.iter().map(|sums| sums.volume0).sum::<f64>() / room).min(1.0)
}

/// The hand-written agent: it presses in the middle, then along the arms.
fn presses(world: &Simulation, effector: &Effector) -> Path {
    let [x, y, high] = effector.position(world);
    let low = world.plan().scene.world.min[2] + DEPTH + PLATE;
    // As far out as the plate goes.
    let out = ARM;
    let mut stops = vec![(vec![x, y, low], 0)];
    for [dx, dy] in [[out, 0.0], [-out, 0.0], [0.0, out], [0.0, -out], [0.0, 0.0]] {
        for z in [low + LIFT, low, low + LIFT] {
            stops.push((vec![x + dx, y + dy, z], 0));
        }
    }
    stops.push((vec![x, y, high], 0));
    Path::new(stops)
}

struct Pressing {
    sizes: &'static Sizes,
    watch: Watch,
    /// The mould's room [m³].
    room: f64,
    /// Share of it that is full.
    full: f64,
}

impl Goal for Pressing {
    fn watch(&self, _world: &Simulation) -> Watch {
        self.watch.clone()
    }
    fn judge(&mut self, _world: &Simulation, _tool: &BodyState, seen: &Seen) -> Result<Verdict> {
        let full = share(seen, self.room);
        let loss = self.full - full;
        self.full = full;
        Ok(Verdict {
            reward: SCALE.reward(loss, self.sizes.horizon),
            success: full > FULL_ENOUGH,
            info: vec![("share of the mould that is full", full)],
        })
    }
}
