//! ArmScoops: an arm of seven joints scoops a soft cube out of sand.
//!
//! # Source
//! UBSoft (CoRL 2024), real-world experiment: an arm with a shovel lifts a cube of 4 cm out of sand by more than 0.1
//! m and holds it for two seconds. There it is no task: the loss is ours, in the manner of "Scoop Out".

use crate::arm::{Arm, INTERVAL, Track};
use crate::base::{Base, Size};
use crate::reward::Scale;
use crate::tooling::distance;
use crate::view::View;
use barchan_core::probe::Filter;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::Region;
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{Registry, Result, Scene, Simulation, Sought, Sums, Task, Vec3};

const DOC: &str = "A soft cube that lies in sand is to be scooped out by an arm of seven joints with a shovel. Success: it has been held 0.1 m above its place for two \
                   seconds.";
const FILE: &str = include_str!("../scenes/arm-scoops.toml");
/// Positions of the joints while the scene's own path is followed.
const TRACK: &str = include_str!("../scenes/tasks/arm-scoops.csv");
/// The body that is scooped out.
const CUBE: &str = "cube";
const ARM: Arm = Arm { robot: "arm", link: "arm/shovel", joints: 7, most: 0.03 };

/// Reward of a metre in a control step.
const ALPHA: f64 = 10.0;
/// Where the shovel is to get: so far below the middle of the cube, as in ScoopOut; and how near, for the first stage
/// to end [m]: its centre of mass is behind the middle of its blade.
const BELOW: f64 = 0.03;
const REACHED: f64 = 0.05;
/// How high the cube must be above its start [m], and for how long [s].
const HIGH: f64 = 0.1;
const HELD: f64 = 2.0;
/// Heights above the cube's middle at the start at which it is looked at how much of it is above [m]: the mean of its
/// height is a sum of those.
const SLICE: f64 = 0.02;
const SLICES: usize = 16;
/// Control steps: the scene's own path, and two seconds to hold the cube.
const HORIZON: u64 = 640;

/// What is changed in the scene's file for a small size: cells of 9.6 mm, walls and sand that end on them, and steps of 0.76 of their bound, 20 in a control step.
const LITE: [&str; 5] = [
    "world.cell=0.0096",
    "time.step=4e-4",
    "world.max=[0.6528, 0.096, 0.4032]",
    "body.bed.shape.box.max=[0.6528, 0.096, 0.032]",
    "body.before.shape.box.max=[0.6528, 0.096, 0.064]",
];

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "ArmScoops", DOC, vec![View::parameter("particles")], ArmScoops::new)
}

struct ArmScoops {
    base: Base,
    view: View,
}

impl ArmScoops {
    fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
        let ranges = vec![
            range("friction angle of the sand [deg]", 30.0, 40.0),
            range("density of the cube [kg/m³]", 800.0, 1200.0),
        ];
        let base = Base::new(setup, FILE, size.of(&[][..], &LITE[..]), ranges)?;
        if !base.scene.robot.iter().any(|robot| robot.name == ARM.robot) {
            let mend = format!("add a [[robot]] with name = \"{}\" and model = \"arm-shovel\"", ARM.robot);
            return Err(setup.unfit(format!("the task moves a robot '{}', and the scene has none", ARM.robot), mend));
        }
        if !base.scene.body.iter().any(|body| body.name == CUBE) {
            let what = format!("the task is about a soft body '{CUBE}', and the scene has none");
            return Err(setup.unfit(what, format!("add a [[body]] with name = \"{CUBE}\"")));
        }
        Ok(Self { view: View::new(&base.scene, setup.parameters, 0.12), base })
    }
}

impl Task for ArmScoops {
    fn name(&self) -> &str {
        &self.base.name
    }
    fn doc(&self) -> &str {
        DOC
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        let mut scene = self.base.scene(seed);
        if let [angle, density] = self.base.drawn(seed)[..] {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle);
            scene.material[1].density = density;
        }
        Ok(scene)
    }
    fn actions(&self) -> Vec<Limits> {
        ARM.actions()
    }
    fn observations(&self) -> Vec<Part> {
        self.view.parts().into_iter().chain([ARM.part()]).collect()
    }
    fn interval(&self) -> f64 {
        INTERVAL
    }
    fn horizon(&self) -> u64 {
        HORIZON
    }
    fn ranges(&self) -> Vec<Limits> {
        self.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let plan = world.plan();
        let body = plan.scene.body.iter().position(|body| body.name == CUBE).unwrap_or_default();
        // The setup has made sure that it is a shape with bounds, unless there is none of it.
        let bounds = plan.scene.body[body].shape.bounds().unwrap_or_else(|| plan.scene.world_box());
        let middle: Vec3 = std::array::from_fn(|d| 0.5 * (bounds.min[d] + bounds.max[d]));
        let [targets, _] = ARM.state(world)?;
        let mut episode = Scooping {
            view: self.view.clone(),
            targets,
            track: Track::new(TRACK),
            slices: slices(world, body as u16, middle[2]),
            place: [middle[0], middle[1], middle[2] - BELOW],
            start: 0.0,
            first: distance(ARM.position(world), [middle[0], middle[1], middle[2] - BELOW]),
            reached: false,
            held: 0.0,
        };
        let watch = Watch { sums: episode.slices.clone(), ..Watch::default() };
        episode.start = height(&world.watch(&watch)?.sums);
        Ok(Box::new(episode))
    }
}

/// All of the cube, and what of it is above each of some heights.
fn slices(world: &Simulation, body: u16, middle: f64) -> Vec<Sought> {
    let all = world.plan().scene.world_box();
    let above = |height: f64| Sought {
        region: Region::Box { min: [all.min[0], all.min[1], height], max: all.max },
        filter: Filter { body: Some(body), ..Filter::default() },
    };
    let heights = (0..SLICES).map(|k| middle + SLICE * (k as f64 + 0.5));
    [all.min[2]].into_iter().chain(heights).map(above).collect()
}

/// Mean height of the cube above its middle at the start, as far as it is above [m].
fn height(sums: &[Sums]) -> f64 {
    let above: u64 = sums.iter().skip(1).map(|sums| sums.count).sum();
    SLICE * above as f64 / sums.first().map_or(1, |all| all.count.max(1)) as f64
}

struct Scooping {
    view: View,
    /// Joints' targets [rad].
    targets: Vec<f64>,
    track: Track,
    slices: Vec<Sought>,
    /// Where the shovel is to get [m].
    place: Vec3,
    /// Mean height of the cube as it is measured, and the shovel's distance from its place, at the start [m].
    start: f64,
    first: f64,
    /// The first stage is over.
    reached: bool,
    /// For how long the cube has been high [s].
    held: f64,
}

impl Episode for Scooping {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        ARM.act(world, &mut self.targets, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        Watch { sums: self.slices.clone(), ..self.view.watch(ARM.position(world)) }
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let off = distance(ARM.tool(world)?.position, self.place);
        self.reached |= off < REACHED;
        let lifted = height(&seen.sums) - self.start;
        self.held = if lifted > HIGH { self.held + INTERVAL } else { 0.0 };
        let loss = if self.reached { -lifted } else { off };
        let mut observation = self.view.numbers(world, seen);
        observation.extend(ARM.state(world)?.into_iter().flatten());
        observation.extend(&self.targets);
        let scale = Scale { alpha: ALPHA, beta: ALPHA * HORIZON as f64 * self.first };
        Ok(Outcome {
            observation,
            reward: scale.reward(loss, HORIZON),
            success: self.held >= HELD,
            terminated: false,
            info: vec![
                ("stage", if self.reached { 2.0 } else { 1.0 }),
                ("height of the cube above its start [m]", lifted),
                ("distance of the shovel from below the cube [m]", off),
            ],
        })
    }
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        Some(ARM.follow(&self.track, world.time(), &self.targets))
    }
}
