//! ScoopOut: a duck that lies half in sand is scooped out with a shovel.
//!
//! # Source
//! UBSoft (CoRL 2024), "Scoop Out": L = Σ (σ l1 + (1 − σ) l2) with l1 = ‖p − (p_duck − (0, 0, 0.03))‖ and l2 = −z + n, p the shovel's place, z its height, n the number of
//! particles within 0.1 m of the duck, σ = 1 in the first stage. When a stage ends is not printed: here the first one ends for good once l1 has been less than 4 cm. n counts
//! by its share of what it was at the start.

use crate::base::{Base, Size};
use crate::effector::{Degree, Effector, Path};
use crate::reward::Scale;
use crate::tooling::{Goal, ToolTask, Tooling, Verdict, Work, distance};
use crate::view::View;
use barchan_core::parameter::Parameter;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::Region;
use barchan_core::task::{Limits, Part, Seen, Watch};
use barchan_core::{BodyState, Error, Registry, Result, Scene, Simulation};

const DOC: &str = "A duck that lies half in a bed of sand is to be scooped out with a shovel. Success: it lies on the shovel, above the surface.";
const FILE: &str = include_str!("../scenes/tasks/scoop-out.toml");
const TOOL: &str = "shovel";
const DUCK: &str = "duck";

/// Reward of a metre in a control step.
const ALPHA: f64 = 10.0;
/// Where the shovel is to get: so far below the duck's centre [m].
///
/// # Source
/// UBSoft (CoRL 2024), appendix, as is the distance within which particles are counted [m].
const BELOW: f64 = 0.03;
const NEAR: f64 = 0.1;
/// The first stage ends within this distance [m]: a centimetre more than the duck's body has below its
/// centre, so the shovel's floor is then under the duck.
const REACHED: f64 = 0.04;
/// What the particles near the duck at the start count, in metres of height.
const COUNT: f64 = 0.05;
/// How far the duck must be above where it was at the start, and how near to where the shovel is to get, in the end [m].
const HIGH: f64 = 0.06;
const HELD: f64 = 0.06;
/// Most that the shovel turns about y in a control step, and between what [rad].
const TURN: f64 = 0.02;
const TURNED: [f64; 2] = [-0.8, 0.8];
/// Signs that the particles near the duck may have in the loss.
const SIGNS: [&str; 2] = ["sensible", "printed"];

/// What differs between the paper's size and a small one.
struct Sizes {
    changes: &'static [&'static str],
    /// Most that the shovel moves in a control step, along each axis [m].
    most: f64,
    horizon: u64,
    /// α times the first loss, over all control steps: so an agent that does nothing has no reward.
    beta: f64,
    /// Where the duck is on average [m].
    duck: [f64; 2],
    reach: f64,
}

const FULL: Sizes =
    Sizes { changes: &[], most: 0.001, horizon: 1000, beta: ALPHA * 1000.0 * 0.196, duck: [0.5, 0.5], reach: 0.25 };
const LITE: Sizes = Sizes {
    changes: &[
        "world.cell=0.0125",
        "world.max=[0.475, 0.25, 0.4]",
        "levels.count=1",
        "time.step=4e-4",
        "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.475, 0.25, 0.1] }",
        "tool.shovel.position=[0.11, 0.125, 0.19]",
        "tool.shovel.shape.union=[\
         { shape = { box = { half = [0.0675, 0.075, 0.0125] } }, position = [-0.0075, 0.0, -0.0125] }, \
         { shape = { box = { half = [0.0125, 0.075, 0.03] } }, position = [-0.0625, 0.0, 0.03] }, \
         { shape = { box = { half = [0.0675, 0.0125, 0.015] } }, position = [-0.0075, 0.0625, 0.015] }, \
         { shape = { box = { half = [0.0675, 0.0125, 0.015] } }, position = [-0.0075, -0.0625, 0.015] }, \
         { shape = { box = { half = [0.0125, 0.0125, 0.05] } }, position = [-0.0625, 0.0, 0.11] }]",
        "tool.duck.position=[0.275, 0.125, 0.1]",
    ],
    most: 0.002,
    horizon: 500,
    beta: ALPHA * 500.0 * 0.2,
    duck: [0.275, 0.125],
    reach: 0.12,
};

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    let doc = "What the number of particles near the duck is in the loss of the second stage: 'printed' a loss, as in the paper's formula; 'sensible' a gain, as in its \
               text, by which scooped particles are rewarded.";
    let parameters = vec![View::parameter("particles"), Parameter::text("sign", &SIGNS, doc).or(SIGNS[0])];
    crate::base::register(registry, "ScoopOut", DOC, parameters, make)
}

fn make(setup: &TaskSetup<'_>, size: Size) -> Result<ToolTask<ScoopOut>> {
    let sizes = size.of(&FULL, &LITE);
    let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
    let ([x, y], off) = (sizes.duck, 0.02);
    let ranges = vec![
        range("x of the duck [m]", x - off, x + off),
        range("y of the duck [m]", y - off, y + off),
        range("mass of the duck [kg]", 0.05, 0.15),
        range("friction angle of the sand [deg]", 30.0, 40.0),
    ];
    let base = Base::new(setup, FILE, sizes.changes, ranges)?;
    if !base.scene.tool.iter().any(|tool| tool.name == DUCK) {
        let mend = format!("add a [[tool]] with name = \"{DUCK}\" and motion = {{ free = {{ mass = 0.1 }} }}");
        return Err(setup.unfit(format!("the task is about a body '{DUCK}', and the scene has none"), mend));
    }
    let along = |axis: usize| Degree::along(&base.scene, axis, sizes.most, 0.02);
    let degrees = [along(0), along(1), along(2), Degree::about(1, TURN, TURNED)];
    let tooling = Tooling { doc: DOC, tool: TOOL, degrees: &degrees, horizon: sizes.horizon, reach: sizes.reach };
    let sign = if setup.parameters.text("sign") == "printed" { 1.0 } else { -1.0 };
    ToolTask::new(setup, base, &tooling, ScoopOut { sizes, sign })
}

struct ScoopOut {
    sizes: &'static Sizes,
    sign: f64,
}

impl Work for ScoopOut {
    fn vary(&self, scene: &mut Scene, drawn: &[f64]) {
        if let [x, y, mass, angle] = *drawn {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle.into());
            for tool in scene.tool.iter_mut().filter(|tool| tool.name == DUCK) {
                (tool.position[0], tool.position[1]) = (x, y);
                if let barchan_core::scene::Motion::Free { mass: own, .. } = &mut tool.motion {
                    *own = mass;
                }
            }
        }
    }
    fn part(&self) -> Option<Part> {
        Some(Part::new("x, y, z of the duck [m]", 3))
    }
    fn begin(&self, world: &Simulation, _effector: &Effector) -> Result<(Box<dyn Goal>, Path)> {
        let duck = duck(world)?;
        let near = Watch::default().and_within(Region::Sphere { center: duck.position, radius: NEAR });
        let start = world.watch(&near)?.sums[0].count.max(1) as f64;
        let goal = Scooping { sizes: self.sizes, sign: self.sign, start, height: duck.position[2], reached: false };
        Ok((Box::new(goal), scoop(&duck)))
    }
}

fn duck(world: &Simulation) -> Result<BodyState> {
    world.bodies().into_iter().find(|body| body.name == DUCK).ok_or_else(|| Error::Body {
        path: format!("tool '{DUCK}'"),
        what: "it is no longer there".to_owned(),
        mend: "keep it as long as the task is played".to_owned(),
    })
}

/// The hand-written agent: down beside the duck with the edge ahead, so that little sand comes before it; level under the duck; back, so that it rolls against the
/// shovel's back; up.
fn scoop(duck: &BodyState) -> Path {
    let [x, y, z] = duck.position;
    let stop = |x_off: f64, z_off: f64, pitch: f64| (vec![x + x_off, y, z + z_off, pitch], 0);
    Path::new(vec![
        stop(-0.13, 0.08, 0.8),
        stop(-0.075, -0.004, 0.8),
        stop(-0.05, -0.029, 0.5),
        stop(0.0, -0.042, 0.05),
        stop(0.025, -0.029, -0.3),
        stop(0.025, 0.016, -0.5),
        stop(0.025, 0.146, -0.5),
    ])
}

struct Scooping {
    sizes: &'static Sizes,
    sign: f64,
    /// Particles near the duck at the start, and its height then [m].
    start: f64,
    height: f64,
    /// The first stage is over.
    reached: bool,
}

impl Goal for Scooping {
    fn watch(&self, world: &Simulation) -> Watch {
        // A duck that is gone is an error in `judge`.
        let center = duck(world).map(|duck| duck.position).unwrap_or_default();
        Watch::default().and_within(Region::Sphere { center, radius: NEAR })
    }
    fn judge(&mut self, world: &Simulation, tool: &BodyState, seen: &Seen) -> Result<Verdict> {
        let duck = duck(world)?;
        let [x, y, z] = duck.position;
        let off = distance(tool.position, [x, y, z - BELOW]);
        self.reached |= off < REACHED;
        let near = seen.sums[0].count as f64 / self.start;
        let loss = if self.reached { -tool.position[2] + self.sign * COUNT * near } else { off };
        let scale = Scale { alpha: ALPHA, beta: self.sizes.beta };
        let lifted = z - self.height;
        Ok(Verdict {
            reward: scale.reward(loss, self.sizes.horizon),
            success: lifted > HIGH && off < HELD,
            info: vec![
                ("stage", if self.reached { 2.0 } else { 1.0 }),
                ("height of the duck above its start [m]", lifted),
                ("distance of the shovel from below the duck [m]", off),
                ("particles near the duck, by those at the start", near),
            ],
        })
    }
    fn numbers(&self, world: &Simulation) -> Result<Vec<f64>> {
        Ok(duck(world)?.position.to_vec())
    }
}
