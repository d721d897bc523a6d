//! What must hold for every scene.

use crate::scenes::Noise;
use barchan::gradient::RobotCotangents;
use barchan::scene::{Leaving, OverBound};
use barchan::{Cotangents, Error, Gradient, Ledger, Options, Precision, Registry, Scene, Simulation, Tape, Vec3};
use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use toml::Table;

/// Particles that a scene may have: one that has more is left alone.
const MOST_PARTICLES: usize = 20_000;
/// Bytes that particles may take while they are seeded.
const MOST_BYTES: u64 = 32 << 20;
/// Mass may be off by this, relative: particles hold it in f32, and merging rounds it.
const MASS: f64 = 1e-5;
/// Momentum that the ledger does not explain, of all that was exchanged: in f64, and in f32.
const MOMENTUM: [f64; 2] = [1e-9, 1e-3];
/// Half of all particles may be this far apart in two number formats or on two backends, and all but a twentieth [cells].
const APART: [f64; 2] = [1e-3, 0.05];
/// Gradients over parts may be off by this from that over all, relative to the greatest: both are found in f64.
const CHAIN: f64 = 1e-9;
/// And by this where robots, whose own equations are differentiated by differences, take part.
const CHAIN_OF_ROBOTS: f64 = 1e-6;

/// A rule that a scene breaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Rule {
    /// Nothing panics.
    Panic,
    /// A scene that is written and read again is the same.
    Written,
    /// Numbers stay finite, and energy bounded, where the step is.
    Stable,
    /// The ledger accounts for all mass.
    Mass,
    /// The ledger accounts for all momentum.
    Momentum,
    /// Two threads give the bits of one.
    Threads,
    /// A run that is saved and gone on with has the bits of a whole one.
    Resume,
    /// f32 is near f64.
    Precision,
    /// Another backend is near the CPU.
    Backend,
    /// It takes many steps at once as it takes them one by one.
    Looking,
    /// Gradients obey the chain rule, with any number of threads.
    Gradient,
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Panic => "it panics",
            Self::Written => "it is another scene once it has been written",
            Self::Stable => "it becomes unstable below the bound of its step",
            Self::Mass => "mass is not closed",
            Self::Momentum => "momentum is not closed",
            Self::Threads => "two threads give other bits than one",
            Self::Resume => "resumed it has other bits",
            Self::Precision => "f32 is far from f64",
            Self::Backend => "the backend is far from the CPU",
            Self::Looking => "many steps at once give other bits than one by one",
            Self::Gradient => "a gradient is not that of its parts",
        })
    }
}

/// How a scene breaks a rule.
#[derive(Clone, Debug)]
pub struct Failure {
    /// The rule.
    pub rule: Rule,
    /// How.
    pub what: String,
}

/// What becomes of a scene.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// It cannot be run, and an error says why.
    Refused(String),
    /// It ran so many steps, to the end or until an error said why not further.
    Ran(u64, Option<String>),
    /// It breaks a rule.
    Failed(Failure),
}

/// Holds scenes to the rules.
pub struct Judge {
    registry: Registry,
    folder: PathBuf,
    steps: u64,
    backend: Option<String>,
}

/// What a run comes to.
struct Run {
    simulation: Simulation,
    start: Ledger,
    /// What bodies have taken from the ground [N s], and how much was exchanged in all.
    given: Vec3,
    exchanged: f64,
    /// What stopped it.
    error: Option<Error>,
}

type Held<T> = Result<T, Failure>;

fn broken<T>(rule: Rule, what: impl Into<String>) -> Held<T> {
    Err(Failure { rule, what: what.into() })
}

impl Judge {
    /// One that lets scenes run so many steps. `folder` holds the files that they name and is written into; `backend` is held against the
    /// CPU, if there is one.
    pub fn new(registry: Registry, folder: &Path, steps: u64, backend: Option<String>) -> Self {
        Self { registry, folder: folder.to_owned(), steps, backend }
    }

    /// Runs a scene.
    pub fn judge(&self, scene: &Table) -> Outcome {
        match catch_unwind(AssertUnwindSafe(|| self.hold(scene))) {
            Ok(Ok(outcome)) => outcome,
            Ok(Err(failure)) => Outcome::Failed(failure),
            Err(panic) => {
                let text = panic.downcast_ref::<String>().cloned();
                let what = text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
                Outcome::Failed(Failure { rule: Rule::Panic, what: what.unwrap_or_default() })
            }
        }
    }

    fn options(&self, precision: Precision, threads: usize) -> Options {
        Options { precision, threads, max_bytes: Some(MOST_BYTES), ..Options::default() }
    }

    fn hold(&self, scene: &Table) -> Held<Outcome> {
        let text = toml::to_string(scene).unwrap_or_default();
        let scene = match self.read(&text) {
            Ok(scene) => scene,
            Err(error) => return Ok(Outcome::Refused(error.to_string())),
        };
        let written = scene.to_toml().or_else(|error| broken(Rule::Written, error.to_string()))?;
        let again = self.read(&written).and_then(|again| again.to_toml());
        if again.as_ref().ok() != Some(&written) {
            return broken(Rule::Written, format!("{again:?} instead of {written}"));
        }
        let start = |precision, threads| Simulation::new(&self.registry, &scene, &self.options(precision, threads));
        let simulation = match start(Precision::F32, 1) {
            Ok(simulation) if simulation.particle_count() > MOST_PARTICLES => {
                return Ok(Outcome::Refused("it has more particles than are run here".to_owned()));
            }
            Ok(simulation) => simulation,
            Err(error) => return Ok(Outcome::Refused(error.to_string())),
        };
        let half = self.folder.join("half.barchan");
        let whole = self.run(simulation, Some(&half))?;
        whole.is_closed(&scene, MOMENTUM[1])?;
        let Run { simulation: one, error, .. } = &whole;
        let bits = self.bits(one, "one")?;

        let two = self.run(start(Precision::F32, 2).or_else(|e| broken(Rule::Threads, e.to_string()))?, None)?;
        if self.bits(&two.simulation, "two")? != bits || two.says() != whole.says() {
            return broken(Rule::Threads, difference(one, &two.simulation));
        }
        if half.exists() {
            let resumed = Simulation::resume(&self.registry, &half, &self.options(Precision::F32, 1));
            let resumed = self.run(resumed.or_else(|e| broken(Rule::Resume, e.to_string()))?, None)?;
            if self.bits(&resumed.simulation, "resumed")? != bits || resumed.says() != whole.says() {
                return broken(Rule::Resume, difference(one, &resumed.simulation));
            }
        }
        if let Some(error) = error {
            return Ok(Outcome::Ran(one.step_count(), Some(error.to_string())));
        }
        self.is_near_others(&scene, one.plan().dt)?;
        self.is_the_same_at_once(&scene)?;
        self.gradients_chain(&scene, one.plan().dt)?;
        Ok(Outcome::Ran(one.step_count(), None))
    }

    /// Is f32 near f64, and the other backend near the CPU? With steps of one length, half of what is stable at first: of other steps, other results
    /// come.
    fn is_near_others(&self, scene: &Scene, dt: f64) -> Held<()> {
        let mut scene = scene.clone();
        scene.time.step = Some(0.5 * dt / f64::from(scene.levels.substeps()));
        scene.time.over_bound = OverBound::Substep;
        let run = |backend: &str, precision, rule| {
            let options = Options { backend: backend.to_owned(), ..self.options(precision, 1) };
            match Simulation::new(&self.registry, &scene, &options) {
                Ok(simulation) => self.run(simulation, None).map(Some),
                // What a backend lacks it names.
                Err(Error::Missing { .. }) => Ok(None),
                // Particles are larger than those that fitted.
                Err(Error::Capacity { .. }) if precision == Precision::F64 => Ok(None),
                Err(error) => broken(rule, error.to_string()),
            }
        };
        let Some(single) = run("cpu", Precision::F32, Rule::Precision)? else { return Ok(()) };
        let Some(exact) = run("cpu", Precision::F64, Rule::Precision)? else { return Ok(()) };
        exact.is_closed(&scene, MOMENTUM[0])?;
        are_near(Rule::Precision, &exact, &single)?;
        let backend = self.backend.as_ref().map(|backend| run(backend, Precision::F32, Rule::Backend));
        let Some(other) = backend.transpose()?.flatten() else { return Ok(()) };
        other.is_closed(&scene, MOMENTUM[1])?;
        are_near(Rule::Backend, &exact, &other)
    }

    /// Does the other backend leave the same particles and bodies, bit for bit, whether anyone looks after each step or only at the end?
    fn is_the_same_at_once(&self, scene: &Scene) -> Held<()> {
        let Some(backend) = &self.backend else { return Ok(()) };
        let options = Options { backend: backend.clone(), ..self.options(Precision::F32, 1) };
        let start = || match Simulation::new(&self.registry, scene, &options) {
            Ok(simulation) => Ok(Some(simulation)),
            Err(Error::Missing { .. }) => Ok(None),
            Err(error) => broken(Rule::Looking, error.to_string()),
        };
        let (Some(one), Some(many)) = (start()?, start()?) else { return Ok(()) };
        let (one, mut many) = (self.run(one, None)?, Run::new(many));
        while many.simulation.step_count() < self.steps && many.error.is_none() {
            let left = self.steps - many.simulation.step_count();
            many.error = many.simulation.steps(left as usize, f64::INFINITY).err();
        }
        // Not the ledger: what many steps come to is summed up on a device in 32 bits.
        let left = |run: &Run| {
            let (simulation, particles) = (&run.simulation, run.simulation.particles());
            let time = (simulation.step_count(), simulation.time().to_bits());
            (particles.lists, particles.levels, particles.archive, simulation.bodies(), time, run.says())
        };
        if left(&one) != left(&many) {
            return broken(Rule::Looking, difference(&one.simulation, &many.simulation));
        }
        Ok(())
    }

    /// Of a scene without what gradients do not go through: is a gradient over some steps that of their halves, one after the other, and the same bits on two threads?
    fn gradients_chain(&self, scene: &Scene, dt: f64) -> Held<()> {
        let mut scene = scene.clone();
        scene.coupling = Vec::new();
        scene.tool.retain(|tool| tool.from <= 0.0 && tool.until.is_none());
        (scene.inflow, scene.outflow, scene.probe, scene.task) = (Vec::new(), Vec::new(), Vec::new(), None);
        (scene.levels.subcycle, scene.sleep.on) = (false, Some(false));
        (scene.time.step, scene.time.over_bound) = (Some(0.25 * dt), OverBound::Substep);
        let start = |threads| Simulation::new(&self.registry, &scene, &self.options(Precision::F64, threads));
        // What is left may be no scene: levels may follow a tool, or hold up what is too large without them.
        let (Ok(mut whole), Ok(mut parted), Ok(mut other)) = (start(1), start(1), start(2)) else { return Ok(()) };
        let end = scene.time.step.unwrap_or_default() * 6.0;
        let record = |simulation: &mut Simulation, until: f64| match simulation.record(&self.registry, until) {
            Ok(tape) => Ok(Some(tape)),
            Err(error @ (Error::Missing { .. } | Error::Unstable { .. })) => broken(Rule::Gradient, error.to_string()),
            // Particles that leave.
            Err(_) => Ok(None),
        };
        let (Some(tape), Some(same)) = (record(&mut whole, end)?, record(&mut other, end)?) else { return Ok(()) };
        let (Some(first), Some(second)) = (record(&mut parted, 0.5 * end)?, record(&mut parted, end)?) else {
            return Ok(());
        };
        if first.len() + second.len() != tape.len() {
            return Ok(());
        }
        let (particles, mass) = (tape.end().id.len(), tape.end().mass.iter().sum::<f64>());
        // Of a scene without ground no tool feels anything.
        let mass = if mass > 0.0 { mass } else { 1.0 };
        let mut loss = Cotangents::zero(particles);
        loss.bodies.resize_with(tape.end().bodies.len(), Default::default);
        loss.robots.resize_with(tape.end().robots.len(), Default::default);
        let mut noise = Noise::new(3);
        for (x, v) in loss.position.iter_mut().zip(&mut loss.velocity) {
            *x = std::array::from_fn(|_| noise.draw() / scene.world.cell);
            *v = std::array::from_fn(|_| noise.draw() * end / scene.world.cell);
        }
        for body in &mut loss.bodies {
            body.pose.position = std::array::from_fn(|_| noise.draw() / scene.world.cell);
            body.velocity = std::array::from_fn(|_| noise.draw() * end / scene.world.cell);
            body.impulse.force = std::array::from_fn(|_| noise.draw() * end / (scene.world.cell * mass));
        }
        for (owed, robot) in loss.robots.iter_mut().zip(&tape.end().robots) {
            owed.positions = robot.positions.iter().map(|_| noise.draw()).collect();
            owed.rates = robot.rates.iter().map(|_| noise.draw() * end).collect();
        }
        let is_refused = |what: &str| {
            ["a wall of the world has pushed it", "come and go", "of two levels at once"]
                .iter()
                .any(|refusal| what.contains(refusal))
        };
        let back = |tape: &Tape, loss| match tape.pull_back(loss) {
            Ok(gradient) => Ok(Some(gradient)),
            Err(Error::Body { what, .. }) if is_refused(&what) => Ok(None),
            Err(error) => broken(Rule::Gradient, error.to_string()),
        };
        let (Some(whole), Some(other)) = (back(&tape, loss.clone())?, back(&same, loss.clone())?) else {
            return Ok(());
        };
        if whole != other {
            return broken(Rule::Gradient, "two threads give other bits than one");
        }
        let Some(later) = back(&second, loss.clone())? else { return Ok(()) };
        let told = |gradient: &Gradient| {
            gradient.bodies.iter().flat_map(|body| [body.linear, body.angular]).collect::<Vec<Vec3>>()
        };
        let (told_later, mut between) = (told(&later), later.particles);
        // What a tool feels over both, and what it is told in both.
        between.bodies.iter_mut().zip(&loss.bodies).for_each(|(body, loss)| body.impulse = loss.impulse);
        let Some(parted) = back(&first, between)? else { return Ok(()) };
        let places = |gradient: &Gradient| {
            gradient
                .particles
                .bodies
                .iter()
                .flat_map(|body| [body.pose.position, body.pose.rotation])
                .collect::<Vec<Vec3>>()
        };
        let thrown = |gradient: &Gradient| {
            gradient
                .particles
                .bodies
                .iter()
                .flat_map(|body| [body.velocity, body.angular_velocity])
                .collect::<Vec<Vec3>>()
        };
        let joints = |gradient: &Gradient| {
            let of_robot = |robot: &RobotCotangents| [robot.positions.clone(), robot.rates.clone()].concat();
            gradient.particles.robots.iter().flat_map(of_robot).map(|x| [x, 0.0, 0.0]).collect::<Vec<Vec3>>()
        };
        let both: Vec<Vec3> =
            told(&parted).into_iter().zip(told_later).map(|(a, b)| std::array::from_fn(|d| a[d] + b[d])).collect();
        for (what, whole, parted) in [
            ("positions", &whole.particles.position, &parted.particles.position),
            ("velocities", &whole.particles.velocity, &parted.particles.velocity),
            ("places of tools", &places(&whole), &places(&parted)),
            ("speeds that tools start with", &thrown(&whole), &thrown(&parted)),
            ("speeds of tools", &told(&whole), &both),
            ("joints", &joints(&whole), &joints(&parted)),
        ] {
            let size = whole.iter().flatten().fold(0.0, |most: f64, x| most.max(x.abs()));
            let apart = whole.iter().flatten().zip(parted.iter().flatten()).map(|(a, b)| (a - b).abs());
            let apart = apart.fold(0.0, |most: f64, x| if x > most || x.is_nan() { x } else { most });
            let most = if scene.has_robots() { CHAIN_OF_ROBOTS } else { CHAIN };
            if apart.is_nan() || apart > most * size {
                return broken(Rule::Gradient, format!("by {what} it is off by {apart:e} of {size:e}"));
            }
        }
        Ok(())
    }

    fn read(&self, text: &str) -> Result<Scene, Error> {
        Scene::from_str(text, "random.toml", &self.folder)
    }

    /// All that there is of a simulation, as it would be saved.
    fn bits(&self, simulation: &Simulation, name: &str) -> Held<Vec<u8>> {
        let file = self.folder.join(name).with_extension("barchan");
        simulation.save(&file).or_else(|e| broken(Rule::Resume, e.to_string()))?;
        std::fs::read(&file).or_else(|e| broken(Rule::Resume, e.to_string()))
    }

    /// Runs to the last step, and saves half-way.
    fn run(&self, simulation: Simulation, half: Option<&Path>) -> Held<Run> {
        half.map(std::fs::remove_file);
        let mut run = Run::new(simulation);
        while run.simulation.step_count() < self.steps && run.error.is_none() {
            if let Some(half) = half.filter(|_| run.simulation.step_count() == self.steps / 2) {
                run.simulation.save(half).or_else(|e| broken(Rule::Resume, e.to_string()))?;
            }
            run.step()?;
        }
        Ok(run)
    }
}

impl Run {
    fn new(simulation: Simulation) -> Self {
        Self { start: simulation.ledger(), given: [0.0; 3], exchanged: 0.0, error: None, simulation }
    }

    /// A step, or the error that ends the run.
    fn step(&mut self) -> Held<()> {
        let before = self.simulation.ledger();
        match self.simulation.step() {
            Ok(report) => {
                let wrenches = report.wrenches.unwrap_or_else(|| self.simulation.wrenches());
                for d in 0..3 {
                    let impulses: Vec<f64> = wrenches.iter().map(|wrench| wrench.force[d] * report.dt).collect();
                    self.given[d] += impulses.iter().sum::<f64>();
                    self.exchanged += impulses.iter().map(|impulse| impulse.abs()).sum::<f64>();
                    let now = self.simulation.ledger();
                    self.exchanged += (now.wall_impulse[d] - before.wall_impulse[d]).abs();
                    self.exchanged += (now.gravity_impulse[d] - before.gravity_impulse[d]).abs();
                }
            }
            Err(error) => {
                let allowed = self.simulation.plan().scene.time.over_bound == OverBound::Allow;
                let unstable =
                    matches!(error, Error::NonFinite { .. } | Error::Unstable { .. } | Error::MaterialFailed { .. });
                if unstable && !allowed {
                    return broken(Rule::Stable, error.to_string());
                }
                self.error = Some(error);
            }
        }
        Ok(())
    }

    fn says(&self) -> Option<String> {
        self.error.as_ref().map(ToString::to_string)
    }

    /// Are mass and momentum what the ledger says?
    fn is_closed(&self, scene: &Scene, tolerance: f64) -> Held<()> {
        let (then, now) = (&self.start, self.simulation.ledger());
        let come = now.seeded_mass - then.seeded_mass + now.sources.mass - now.sinks.mass;
        let mass = now.mass + now.deleted_mass - then.mass - come;
        if mass.abs() > MASS * (then.mass + come.abs() + now.sinks.mass) {
            return broken(Rule::Mass, format!("{mass:e} kg of {} kg came from nowhere", then.mass));
        }
        // What leaves for good takes momentum along that nobody counts, and what fails within a subcycled step leaves finer levels ahead.
        let torn = self.error.is_some() && scene.levels.subcycle;
        if torn || now.deleted_mass > 0.0 || !now.momentum.iter().all(|p| p.is_finite()) {
            return Ok(());
        }
        let speed: f64 = self
            .simulation
            .particles()
            .lists
            .iter()
            .flat_map(|list| list.mass.iter().zip(&list.velocity))
            .map(|(m, v)| m * v.iter().map(|v| v.abs()).sum::<f64>())
            .sum();
        // A thousandth of a cell in a step is nothing that anyone would see.
        let still = 1e-3 * (now.mass + now.sinks.mass) * scene.world.cell / self.simulation.plan().dt;
        let scale = self.exchanged + speed + still;
        let off: Vec3 = std::array::from_fn(|d| {
            let of = |ledger: &Ledger| {
                ledger.momentum[d] - ledger.sources.momentum[d] + ledger.sinks.momentum[d]
                    - ledger.gravity_impulse[d]
                    - ledger.wall_impulse[d]
                    + ledger.slept_momentum[d]
            };
            of(&now) - of(then) + self.given[d]
        });
        let most = off.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        if most > tolerance * scale {
            return broken(Rule::Momentum, format!("{off:?} N s are open, of {scale:e} that were exchanged"));
        }
        Ok(())
    }
}

/// In what two runs differ that should be the same.
fn difference(a: &Simulation, b: &Simulation) -> String {
    let (x, y) = (a.particles(), b.particles());
    if (a.step_count(), a.time()) != (b.step_count(), b.time()) {
        return format!("steps {} and {}, times {} and {}", a.step_count(), b.step_count(), a.time(), b.time());
    }
    if x.lists != y.lists {
        let lists = x.lists.iter().zip(&y.lists).position(|(a, b)| a != b);
        return format!("particles of list {lists:?}");
    }
    // Without particles there is nothing to sort.
    if x.sort != y.sort && x.lists.iter().any(|list| !list.is_empty()) {
        return "the phase of the sort".to_owned();
    }
    if x.levels != y.levels || x.archive != y.archive {
        return "levels or archive".to_owned();
    }
    if a.bodies() != b.bodies() {
        return "bodies".to_owned();
    }
    format!("the ledger: {:?} and {:?}", a.ledger(), b.ledger())
}

/// Are two runs near each other at the same time? Particles are held against each other one by one, or body by body where some have been split or
/// merged otherwise.
fn are_near(rule: Rule, a: &Run, b: &Run) -> Held<()> {
    if a.error.is_some() != b.error.is_some() {
        return broken(rule, format!("one says {:?}, the other {:?}", a.says(), b.says()));
    }
    let (a, b) = (&a.simulation, &b.simulation);
    // Where a step had to be shortened in one of them, they are not at the same time.
    if (a.time() - b.time()).abs() > 1e-9 * a.time() {
        return Ok(());
    }
    type Places = BTreeMap<u64, (f64, Vec3)>;
    let places = |simulation: &Simulation, by_body: bool| -> Places {
        let mut places = Places::new();
        for list in &simulation.ground().lists {
            for i in 0..list.len() {
                let key = if by_body { list.body[i].into() } else { list.id[i] };
                let (mass, moment) = places.entry(key).or_default();
                *mass += list.mass[i];
                let x = list.position(i);
                (0..3).for_each(|d| moment[d] += list.mass[i] * x[d]);
            }
        }
        places
    };
    let (mut x, mut y) = (places(a, false), places(b, false));
    // Who is outside and is deleted goes when particles are sorted, each backend at times of its own, and who lies at the edge of a sink goes as its last bits have it: bodies that have
    // lost other particles are no measure.
    let scene = &a.plan().scene;
    let loses = scene.world.leaving == Leaving::Delete || (!scene.outflow.is_empty() && scene.levels.count == 1);
    if !x.keys().eq(y.keys()) && !loses {
        (x, y) = (places(a, true), places(b, true));
    }
    let world = &a.plan().scene.world;
    let periods: Vec3 = std::array::from_fn(|d| {
        let periodic = world.walls.pair(d)[0] == barchan::scene::Wall::Periodic;
        if periodic { world.max[d] - world.min[d] } else { f64::INFINITY }
    });
    let mut apart: Vec<f64> = Vec::new();
    for (key, (mass, moment)) in &x {
        let Some((other_mass, other)) = y.get(key) else { continue };
        let gap = |d: usize| {
            let gap = (moment[d] / mass - other[d] / other_mass).abs();
            if periods[d].is_finite() { gap.min((gap - periods[d]).abs()) } else { gap }
        };
        apart.push((0..3).map(|d| gap(d).powi(2)).sum::<f64>().sqrt() / world.cell);
    }
    if apart.is_empty() {
        return Ok(());
    }
    apart.sort_by(f64::total_cmp);
    let [half, most] = [0.5, 0.95].map(|share| apart[((apart.len() - 1) as f64 * share) as usize]);
    if half > APART[0] || most > APART[1] || !most.is_finite() {
        let last = apart[apart.len() - 1];
        return broken(
            rule,
            format!(
                "half of {} are {half:.1e} cells apart or more, a twentieth {most:.1e}, one {last:.1e}",
                apart.len()
            ),
        );
    }
    Ok(())
}
