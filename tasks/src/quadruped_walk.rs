//! QuadrupedWalk: a quadruped walks over level ground.
//!
//! # Source
//! UBSoft (CoRL 2024), "Quadruped Walk": L = Σ d_t, d_t the distance from a target that goes forward at 1 m/s.

use crate::base::{Base, Size};
use crate::ground;
use crate::legged::{self, Legged, QUADRUPED, Standing};
use crate::reward::Scale;
use crate::trot::Trot;
use crate::view::View;
use crate::walk::{left, length, to_target};
use barchan_core::parameter::Parameter;
use barchan_core::registry::TaskSetup;
use barchan_core::scene::{Gait, Shape, Surface};
use barchan_core::task::{Episode, Limits, Outcome, Part, Sampled, Seen, Watch};
use barchan_core::{Registry, Result, Scene, Simulation, Task};

const DOC: &str = "A quadruped is to walk forward over level ground, after a target that goes 1 m/s. Success: it is 3 m on, and has not fallen.";

/// Standing still for the whole episode gets nothing: Σ d_t is 2505 m then. A robot that follows its target gets 2500.
const SCALE: Scale = Scale { alpha: 1.0, beta: 2500.0 };

/// What differs between walks of a quadruped.
pub(crate) struct Rules {
    pub(crate) doc: &'static str,
    /// The scene's file, and what is changed in it for the small size.
    pub(crate) file: &'static str,
    pub(crate) lite: &'static [&'static str],
    /// What is changed besides where the small size is on sand.
    pub(crate) on_sand: &'static [&'static str],
    pub(crate) scale: Scale,
    /// Simulated time of an episode [s].
    pub(crate) seconds: f64,
    /// How far it has to come [m].
    pub(crate) far: f64,
    /// What a seed changes, besides the ground's stiffness and the heading.
    pub(crate) ranges: &'static [(&'static str, f64, f64)],
}

const RULES: Rules = Rules {
    doc: DOC,
    file: include_str!("../scenes/tasks/quadruped-walk.toml"),
    // A patch of one level whose sides are one: what runs over one comes back at the other. So nothing of it has to follow the robot.
    lite: &[
        "world.cell=0.04",
        "world.min=[-0.8, -0.48, 0.0]",
        "world.max=[0.8, 0.48, 1.2]",
        "world.walls={ x_min = 'periodic', x_max = 'periodic', y_min = 'periodic', y_max = 'periodic', z_min = 'stick' }",
        "levels.count=1",
        "body.bed.spacing=0.02666666666666667",
        "body.bed.shape.terrain.min=[-0.8, -0.48]",
        "body.bed.shape.terrain.max=[0.8, 0.48]",
        "body.bed.shape.terrain.origin=[0.0, 0.0, 0.24]",
        "robot.dog.position=[0.0, 0.0, 0.56]",
    ],
    // 0.72 of the bound, and ten of them in a control step; by itself it is 0.6, and thirteen.
    on_sand: &["time.step=2e-3"],
    scale: SCALE,
    seconds: 10.0,
    far: 3.0,
    ranges: &[],
};

/// Most by which an action moves a joint [rad]: from where it stands, twice what the trot needs; from the trot, a third of that.
const FROM_STAND: f64 = 1.0;
const FROM_TROT: f64 = 0.3;
/// What a seed changes of how it stands.
const HEADING: (&str, f64, f64) = ("heading at the start [deg]", -15.0, 15.0);
/// Distance from the robot to the sides of the height map [m]: a stride beyond its feet.
const REACH: f64 = 0.6;

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    let make = |setup: &TaskSetup<'_>, size| QuadrupedWalk::new(setup, size, &RULES);
    crate::base::register(registry, "QuadrupedWalk", DOC, parameters(), make)
}

/// What a walk of a quadruped may be asked for.
pub(crate) fn parameters() -> Vec<Parameter> {
    let from = "Where an action moves joints away from: where they stand, by up to 1 rad; or a trot without looking, by up to 0.3 rad.";
    let from = Parameter::text("from", &["stand", "trot"], from).or("stand");
    vec![ground::parameter(), from, View::parameter("none"), legged::interval()]
}

/// A walk of a quadruped, on level ground or on dunes.
pub(crate) struct QuadrupedWalk {
    base: Base,
    rules: &'static Rules,
    legged: Legged,
    gait: Gait,
    from_trot: bool,
    view: View,
}

impl QuadrupedWalk {
    pub(crate) fn new(setup: &TaskSetup<'_>, size: Size, rules: &'static Rules) -> Result<Self> {
        let ground = ground::changes(setup, size)?;
        let own = if ground::is_sand(setup.parameters) { [rules.lite, rules.on_sand] } else { [rules.lite, &[]] };
        let own = size.of(Vec::new(), own.concat());
        let changes: Vec<&str> = own.into_iter().chain(ground.iter().map(String::as_str)).collect();
        let range = |&(name, low, high): &(&str, f64, f64)| Limits { name: name.to_owned(), low, high };
        let ranges = [ground::stiffness(), range(&HEADING)].into_iter().chain(rules.ranges.iter().map(range));
        let base = Base::new(setup, rules.file, &changes, ranges.collect())?;
        let from_trot = setup.parameters.text("from") == "trot";
        let most = if from_trot { FROM_TROT } else { FROM_STAND };
        Ok(Self {
            legged: Legged::new(setup, &base.scene, &QUADRUPED, most)?,
            gait: Trot::of(setup, &base.scene)?,
            view: View::new(&base.scene, setup.parameters, REACH),
            from_trot,
            base,
            rules,
        })
    }
}

impl Task for QuadrupedWalk {
    fn name(&self) -> &str {
        &self.base.name
    }
    fn doc(&self) -> &str {
        self.rules.doc
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        let mut scene = self.base.scene(seed);
        if let [stiffer, heading_deg, ref others @ ..] = self.base.drawn(seed)[..] {
            ground::stiffen(&mut scene, stiffer);
            legged::turn(&mut scene, heading_deg);
            if let (&[wind, high], Shape::Terrain(terrain)) = (others, &mut scene.body[0].shape)
                && let Surface::Dunes { wind_deg, height, .. } = &mut terrain.surface
            {
                (*wind_deg, *height) = (wind, high);
            }
        }
        Ok(scene)
    }
    fn actions(&self) -> Vec<Limits> {
        self.legged.actions()
    }
    fn observations(&self) -> Vec<Part> {
        let own = [
            Part::new("x, y from the robot to its target [m]", 2),
            Part::new("sine and cosine of the trot's phase", 2),
        ];
        self.view.parts().into_iter().chain(self.legged.parts()).chain(own).collect()
    }
    fn interval(&self) -> f64 {
        self.legged.interval
    }
    fn horizon(&self) -> u64 {
        self.legged.steps(self.rules.seconds)
    }
    fn ranges(&self) -> Vec<Limits> {
        self.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let standing = self.legged.stand(world)?;
        Ok(Box::new(Walking {
            trot: Trot::new(&self.gait, &standing),
            standing,
            from_trot: self.from_trot,
            view: self.view.clone(),
            rules: self.rules,
            horizon: self.horizon(),
            steps: 0,
        }))
    }
}

struct Walking {
    standing: Standing,
    trot: Trot,
    from_trot: bool,
    view: View,
    rules: &'static Rules,
    horizon: u64,
    /// Control steps taken.
    steps: u64,
}

impl Walking {
    /// Targets of the joints that an action moves: those of the middle of the control step to come.
    fn from(&self, world: &Simulation) -> Vec<f64> {
        if self.from_trot { self.trot.targets(self.ahead(world), 0.0) } else { self.standing.joints.clone() }
    }

    fn ahead(&self, world: &Simulation) -> f64 {
        self.standing.time(world) + 0.5 * self.standing.legged.interval
    }
}

impl Episode for Walking {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        self.steps += 1;
        self.standing.act(world, &self.from(world), action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        self.standing.watch(world, self.view.watch(self.standing.place(world)))
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let Self { standing, rules, horizon, steps, .. } = self;
        let Legged { interval, .. } = standing.legged;
        let (state, time) = (standing.legged.state(world)?, standing.time(world));
        let target = to_target(standing.position, state.position, time);
        let terminated = standing.fallen(&state, seen);
        let share = standing.legged.share();
        let mut reward = rules.scale.reward(share * length(target), *horizon);
        if terminated {
            let losses = left(time, interval, horizon.saturating_sub(*steps));
            reward += rules.scale.rest(losses.map(|loss| share * loss), *horizon);
        }
        let walked = state.position[0] - standing.position[0];
        // Beside it, where the world is periodic.
        let ends = &world.plan().scene.world;
        let beside = |one: &Sampled| Sampled { position: ends.image_near(one.position, state.position), ..*one };
        let seen = &Seen { sample: seen.sample.iter().map(beside).collect(), ..seen.clone() };
        let mut observation = self.view.numbers(world, seen);
        observation.extend(standing.numbers(world, &state));
        let turn = std::f64::consts::TAU * self.trot.phase(time);
        observation.extend([target[0], target[1], turn.sin(), turn.cos()]);
        Ok(Outcome {
            observation,
            reward,
            success: walked >= rules.far && !terminated,
            terminated,
            info: vec![("distance walked [m]", walked), ("off the line [m]", -target[1])],
        })
    }
    /// It trots, and turns back to the line on which it started.
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        let state = self.standing.legged.state(world).ok()?;
        let turning = Trot::steer(&self.standing, &state);
        let wanted = self.trot.targets(self.ahead(world), turning);
        Some(wanted.iter().zip(self.from(world)).map(|(wanted, from)| wanted - from).collect())
    }
}
