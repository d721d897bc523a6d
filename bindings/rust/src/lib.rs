//! Barchan simulates robots on and in soft ground: sand, snow, elastic and elastoplastic bodies, coupled with rigid tools.
//!
//! This crate registers everything built in and re-exports what a program needs, plugins of every kind among it:
//!
//! ```
//! use barchan::scene::{Body, MaterialSpec, Shape, Tool, Wall, World};
//! use barchan::{Options, Scene, Simulation};
//!
//! let world = World::new(0.05, [0.0; 3], [0.6, 0.4, 0.4]).with_walls(Wall::Slip);
//! let scene = Scene::new("furrow", world, 0.02)
//!     .with(MaterialSpec::new("sand", "sand", 1600.0).with("friction_angle_deg", 32.0))
//!     .with(Body::new("sand", Shape::cuboid([0.0; 3], [0.6, 0.4, 0.1])))
//!     .with(Tool::new("blade", Shape::half([0.05, 0.1, 0.1])).at([0.2, 0.2, 0.15]).driven([0.5, 0.0, 0.0]));
//! let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
//! println!("{}", simulation.plan());
//! while simulation.time() < scene.time.end {
//!     simulation.step()?;
//! }
//! assert!(simulation.wrenches()[0].force[0] < 0.0, "sand holds the blade back");
//! # Ok::<(), barchan::Error>(())
//! ```
//! [`Scene::from_file`] reads the same from TOML.
//! [`run::run`] does the same with pictures, traces and a summary; [`picture`] draws, [`stress`](mod@stress) asks for stress, [`accuracy`]
//! tells how far a run is from a finer one, [`worlds`] steps many scenes side by side, [`environment`] does so under the actions of a benchmark task.
//!
//! Both features are on unless `default-features = false` leaves them out: `pictures` (the module [`picture`], and the pictures that
//! [`run::run`] makes) and `wgpu` (the backend of that name). Without them a program is built of 111 crates instead of 153.

pub mod accuracy;
pub mod conformance;
pub mod environment;
pub mod export;
#[cfg(feature = "pictures")]
pub mod gallery;
mod nets;
#[cfg(feature = "pictures")]
pub mod picture;
pub mod run;
pub mod worlds;

/// A scene is put on a backend and stepped; what goes wrong says what, where and how to mend it.
///
/// ```
/// use barchan::{Error, Options, Precision, Result, Simulation};
///
/// fn lowest(options: &Options) -> Result<f64> {
///     let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), options)?;
///     simulation.advance(0.02, |_, _| std::ops::ControlFlow::Continue(()))?;
///     Ok(simulation.spots().iter().map(|spot| spot.position[2]).fold(f64::INFINITY, f64::min))
/// }
///
/// let options = Options { precision: Precision::F64, threads: 1, ..Options::default() };
/// assert!(lowest(&options)? > 0.0);
/// let error = lowest(&Options { backend: "abacus".into(), ..options }).unwrap_err();
/// assert!(matches!(error, Error::Unknown { .. }) && error.to_string().contains("cpu"));
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Error, Options, Precision, Result, Simulation};

/// Plugins of every kind meet in a registry.
///
/// ```
/// let registry: barchan::Registry = barchan::registry();
/// let laws: Vec<&str> = registry.materials().map(|material| material.name.as_str()).collect();
/// assert!(laws.contains(&"sand") && laws.contains(&"snow"));
/// assert!(registry.backends().any(|backend| backend.name() == "cpu"));
/// ```
#[doc(inline)]
pub use barchan_core::Registry;

/// A scene in code, and the same from a file's text.
///
/// ```
/// use barchan::Scene;
/// use barchan::scene::{Body, MaterialSpec, Shape, World};
///
/// let scene = Scene::new("cube", World::new(0.1, [0.0; 3], [1.0; 3]), 0.5)
///     .with(MaterialSpec::new("jelly", "neo_hookean", 1000.0))
///     .with(Body::new("jelly", Shape::cuboid([0.4; 3], [0.6; 3])));
/// let text = r#"
///     name = "cube"
///     world = { cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }
///     time = { end = 0.5 }
///     material = [{ name = "jelly", law = "neo_hookean", density = 1000 }]
///     body = [{ material = "jelly", shape = { box = { min = [0.4, 0.4, 0.4], max = [0.6, 0.6, 0.6] } } }]
/// "#;
/// assert_eq!(scene.difference(&Scene::from_str(text, "cube.toml", "")?), None);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::Scene;

/// Back to an earlier state, bit for bit.
///
/// ```
/// use barchan::{Options, Simulation, State};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// simulation.step()?;
/// let state: State = simulation.state()?;
/// simulation.step()?;
/// let end = simulation.particles();
/// simulation.set_state(&state)?;
/// assert_eq!(simulation.step_count(), 1);
/// simulation.step()?;
/// assert_eq!(simulation.particles(), end);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::State;

/// Nothing gets lost unseen.
///
/// ```
/// use barchan::{Ledger, Options, Simulation};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// let start: Ledger = simulation.ledger();
/// simulation.step()?;
/// assert!((simulation.ledger().mass - start.mass).abs() < 1e-9 * start.mass);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::Ledger;

/// Tools and free bodies, and what the ground does to them.
///
/// ```
/// use barchan::{BodyState, Options, Simulation, Vec3, Wrench};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// simulation.step()?;
/// let bodies: Vec<BodyState> = simulation.bodies();
/// let fall: Vec3 = bodies[0].velocity;
/// assert!(bodies[0].name == "ball" && fall[2] < 0.0);
/// let felt: &[Wrench] = &simulation.wrenches();
/// assert_eq!(felt[0].scaled(2.0).force, felt[0].force.map(|f| 2.0 * f));
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{BodyState, Vec3, Wrench};

/// Copies of all particles, which can be changed and handed back; and where they are, for less.
///
/// ```
/// use barchan::{Options, ParticleList, ParticleState, Simulation, Spot};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// let mut particles: ParticleState = simulation.particles();
/// let list: &mut ParticleList = &mut particles.lists[0];
/// list.velocity.fill([0.0, 0.0, 1.0]);
/// simulation.set_particles(particles)?;
/// let ledger = simulation.ledger();
/// assert!((ledger.momentum[2] / ledger.mass - 1.0).abs() < 1e-6);
/// let spots: Vec<Spot> = simulation.spots();
/// assert_eq!(spots.len(), simulation.particle_count());
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{ParticleList, ParticleState, Spot};

/// Parts of the particles: of a region, what is asked for, in f32.
///
/// ```
/// use barchan::{Aabb, Fields, Options, Reading, Simulation};
///
/// let simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// let lower = Aabb { min: [0.0; 3], max: [0.4, 0.4, 0.05] };
/// let reading: Reading = simulation.read(Some(lower), Fields { velocity: true, ..Fields::default() })?;
/// assert_eq!(reading.velocity.len(), reading.len());
/// assert!(reading.mass.is_empty() && reading.len() < simulation.particle_count());
/// assert!((0..reading.len()).all(|i| reading.at(i)[2] <= 0.05 + 1e-6));
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Aabb, Fields, Reading};

/// What probes of a scene find, and the same for any region.
///
/// ```
/// use barchan::scene::{Probe, Region, Section};
/// use barchan::{Apart, Closest, Crossed, Options, Probed, Simulation, Sought, Sums, probe};
///
/// let mut scene = barchan::example();
/// let lower = Region::Box { min: [0.0; 3], max: [0.4, 0.4, 0.05] };
/// let middle = Section::Rectangle { min: [0.0, 0.0, 0.05], max: [0.4, 0.4, 0.05] };
/// scene.probe.push(Probe { name: "lower".into(), within: Some(lower), ..Probe::default() });
/// scene.probe.push(Probe { name: "middle".into(), flux: Some(middle), ..Probe::default() });
/// let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
/// let sought = [Sought { region: lower, filter: probe::Filter::default() }];
/// let before = simulation.sums_within(&sought)?[0].mass;
/// simulation.advance(0.1, |_, _| std::ops::ControlFlow::Continue(()))?;
/// let found: Vec<Probed> = simulation.probes(|_| true)?;
/// assert_eq!((found[0].name.as_str(), found[0].values[1].0.as_str()), ("lower", "mass [kg]"));
/// let sums: Vec<Sums> = simulation.sums_within(&sought)?;
/// assert_eq!(found[0].values[1].1, Some(sums[0].mass));
/// // The lower half has what it had, and what has come down less what has risen.
/// let crossed: Vec<Crossed> = simulation.crossed()?;
/// let [up, down] = crossed[0].mass;
/// assert!((sums[0].mass - before - down + up).abs() < 1e-9);
/// // The particle nearest to a point is as far from it as its place says, and none is nearer.
/// let point = [0.2, 0.2, 0.05];
/// let apart: Apart = simulation.apart(&[point], probe::Filter::default())?;
/// let nearest: Closest = apart.nearest[0].expect("there are particles");
/// assert!(nearest.distance(point) * apart.count as f64 <= apart.distance);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Apart, Closest, Crossed, Probed, Sought, Sums};

/// How a backend holds its particles, which comes with a copy of them. Without it they are sorted afresh.
///
/// ```
/// use barchan::{Measured, Options, Simulation, SortPhase};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// simulation.step()?;
/// let mut particles = simulation.particles();
/// let phase: SortPhase = particles.sort.take().expect("they have been sorted for the first step");
/// let measured: Measured = phase.measured;
/// assert!((measured.mass / simulation.ledger().mass - 1.0).abs() < 1e-6);
/// simulation.set_particles(particles)?;
/// assert!(simulation.step()?.sorted);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Measured, SortPhase};

/// What a scene calls for, and what a step does.
///
/// ```
/// use barchan::{Effect, Form, Options, Plan, Schedule, Simulation, Stage};
///
/// let registry = barchan::registry();
/// let simulation = Simulation::new(&registry, &barchan::example(), &Options::default())?;
/// let plan: &Plan = simulation.plan();
/// let effects: &[Effect] = &plan.effects;
/// assert!(!effects.is_empty());
/// let schedule: &Schedule = &plan.schedule;
/// assert!(schedule.has(Stage::CONTACT) && !schedule.has(Stage::ADAPT));
/// assert!(registry.backend("cpu")?.has_form(Stage::CONTACT, Form::Forward));
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Effect, Form, Plan, Schedule, Stage};

/// What looks at a run at an interval of its own, with a column in the trace.
///
/// ```
/// use barchan::run::{Existing, Request, Until, run_with};
/// use barchan::{Observer, Options, Output, Result, Simulation};
///
/// struct Height(f64);
///
/// impl Observer for Height {
///     fn name(&self) -> &str {
///         "height"
///     }
///     fn interval(&self) -> f64 {
///         5e-3
///     }
///     fn columns(&self) -> Vec<String> {
///         vec!["top [m]".into()]
///     }
///     fn observe(&mut self, simulation: &Simulation, output: &mut dyn Output) -> Result<()> {
///         self.0 = simulation.spots().iter().map(|spot| spot.position[2]).fold(0.0, f64::max);
///         output.set(0, self.0);
///         Ok(())
///     }
/// }
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// # // Shown at both names, this runs twice at once.
/// # let folder = tempfile::tempdir().expect("a temporary folder can be made");
/// # let out = folder.path().join("height");
/// let (until, existing) = (Until::Time(0.01), Existing::Refuse);
/// let request = Request { out, until, pictures: false, export: None, existing, swap: None };
/// let mut height = Height(0.0);
/// run_with(&mut simulation, &request, &mut [&mut height], &mut |_| std::ops::ControlFlow::Continue(()))?;
/// assert!(height.0 > 0.05);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Observer, Output};

/// What acts on the ground through its nodes. `tests/seams/coupling` of the repository is one of somebody's own.
///
/// ```
/// use barchan::coupling::NodeBatch;
/// use barchan::{Coupling, Options, Simulation};
///
/// let simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// let tools: &dyn Coupling = &*simulation.couplings()[0];
/// assert_eq!(tools.name(), "rigid");
/// // The ball of radius 6 cm has its middle at a height of 20 cm.
/// assert!((tools.distance(&[[0.2, 0.2, 0.1]])[0] - 0.04).abs() < 1e-9);
/// let none = NodeBatch::default();
/// assert!(none.is_empty());
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Coupling, NodeBatch};

/// What a body is told to do. Tools that are driven by velocity take twists; a free ball takes none, but can be put elsewhere.
///
/// ```
/// use barchan::{Command, GREATEST, Options, Placement, Simulation};
///
/// let mut simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
/// let error = simulation.act("ball", &Command::Twist { linear: [0.1, 0.0, 0.0], angular: [0.0; 3] }).unwrap_err();
/// assert!(error.to_string().contains("ball"));
/// let higher = Placement { position: Some([0.2, 0.2, 0.3]), ..Placement::default() };
/// simulation.act("ball", &Command::Place(higher))?;
/// assert_eq!(simulation.bodies()[0].position[2], 0.3);
/// let too_fast = Placement { velocity: Some([0.0, 0.0, 2.0 * GREATEST]), ..Placement::default() };
/// assert!(simulation.act("ball", &Command::Place(too_fast)).is_err());
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Command, GREATEST, Placement};

/// A robot: what its URDF says, and how its joints are. Targets come in the order of [`Simulation::joints`].
///
/// ```
/// use barchan::scene::{Robot, World};
/// use barchan::{Command, JointState, Options, RobotModel, Scene, Simulation};
///
/// let dog = Robot::built_in("dog", "quadruped").at([0.0, 0.0, 1.0]).with_motors(100.0, 3.0);
/// let model = RobotModel::of(&dog, std::path::Path::new("")).unwrap();
/// assert_eq!((model.drives.len(), model.mass().round()), (12, 15.0));
///
/// let mut scene = Scene::new("fall", World::new(0.1, [-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]), 0.1).with(dog);
/// scene.time.step = Some(1e-3);
/// let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
/// simulation.act("dog", &Command::JointTargets(vec![0.0, 0.8, -1.6].repeat(4)))?;
/// simulation.step()?;
/// let joints: Vec<JointState> = simulation.joints();
/// assert_eq!(joints[2].name, "FL_calf_joint");
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::JointState;
#[doc(inline)]
pub use barchan_rigid::robot::RobotModel;

/// What a robot senses besides its joints.
///
/// ```
/// use barchan::scene::{Robot, Scan, Wall, World};
/// use barchan::{HeightScan, LinkState, Options, Patch, PointForce, RobotState, Scene, Simulation};
///
/// let mut dog = Robot::built_in("dog", "quadruped").at([0.0, 0.0, 1.0]).with_motors(100.0, 3.0);
/// dog.scan = Some(Scan { min: [-0.3, -0.2], max: [0.3, 0.2], points: [3, 2] });
/// let world = World::new(0.1, [-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]).with_walls(Wall::Stick);
/// let mut scene = Scene::new("fall", world, 0.1).with(dog);
/// scene.time.step = Some(1e-3);
/// let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
/// simulation.step()?;
///
/// let state: RobotState = simulation.robot("dog")?;
/// assert!(state.projected_gravity[2] < -0.99 && state.specific_force[2].abs() < 0.1, "it falls");
/// let foot: &LinkState = state.links.last().unwrap();
/// let points: &[PointForce] = &foot.rigid;
/// assert!(!foot.touches(0.1) && points.is_empty());
/// let patches: Vec<Option<Patch>> = simulation.patches("dog", 0.1)?;
/// assert!(patches.iter().all(Option::is_none));
/// let scan: HeightScan = simulation.scan("dog")?;
/// assert_eq!(scan.heights.len(), 6);
/// assert!((scan.heights[0].unwrap() + 1.0).abs() < 1e-3, "the floor is a metre below");
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{HeightScan, LinkState, Patch, PointForce, RobotState};

/// Gradients: what a loss at the end of some steps owes to what was before them.
///
/// ```
/// use barchan::scene::{Body, MaterialSpec, Shape, World};
/// use barchan::{Cotangents, Gradient, Options, Precision, Scene, Simulation, Tape};
///
/// let mut scene = Scene::new("fall", World::new(0.1, [0.0; 3], [1.0, 1.0, 2.0]), 0.1)
///     .with(MaterialSpec::new("jelly", "neo_hookean", 1000.0))
///     .with(Body::new("jelly", Shape::cuboid([0.4, 0.4, 1.0], [0.6, 0.6, 1.2])));
/// scene.sleep.on = Some(false);
/// let options = Options { precision: Precision::F64, ..Options::default() };
/// let registry = barchan::registry();
/// let mut simulation = Simulation::new(&registry, &scene, &options)?;
/// let tape: Tape = simulation.record(&registry, 0.1)?;
///
/// // The loss is the mean height. It owes 0.1 s for each m/s that particles had at the start.
/// let particles = tape.end().id.len();
/// let mut loss = Cotangents::zero(particles);
/// loss.position.iter_mut().for_each(|x| x[2] = 1.0 / particles as f64);
/// let gradient: Gradient = tape.pull_back(loss)?;
/// let by_speed: f64 = gradient.particles.velocity.iter().map(|v| v[2]).sum();
/// assert!((by_speed - 0.1).abs() < 1e-9);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Cotangents, Gradient, Tape};

/// What carries a plan out. `tests/seams/backend` of the repository is one of somebody's own.
///
/// ```
/// use barchan::{Adjoint, Backend, Engine, Options, Plan, StepReport};
///
/// let registry = barchan::registry();
/// let (plan, particles, mut couplings) = Plan::assemble(&registry, &barchan::example(), &Options::default())?;
/// let backend: &dyn Backend = &**registry.backend("cpu")?;
/// let mut engine: Box<dyn Engine> = backend.compile(&plan, particles)?;
/// let report: StepReport = engine.step(0.0, plan.dt, &mut couplings)?;
/// assert!(report.dt > 0.0 && report.dt <= engine.bound().dt);
/// // What goes back through steps, if the backend has adjoint forms of their stages.
/// let _backwards: Box<dyn Adjoint> = backend.adjoint(&plan)?;
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::{Adjoint, Backend, Engine, StepReport};

/// A law of the ground. `materials/template` of the repository holds some to copy.
///
/// ```
/// let registry = barchan::registry();
/// let sand: &barchan::Material = registry.material("sand")?;
/// assert!(sand.parameters.iter().any(|parameter| parameter.name == "young_modulus"));
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::Material;

/// A scene to be played in by an agent. `tests/seams/task` of the repository is one of somebody's own.
///
/// ```
/// use barchan::environment::Environment;
/// use barchan::task::{Episode, Limits, Outcome, Part, Seen, Watch};
/// use barchan::{Options, Result, Scene, Simulation, Task};
///
/// /// Wait until the ball lies still.
/// struct Wait;
///
/// impl Task for Wait {
///     fn name(&self) -> &str {
///         "wait"
///     }
///     fn doc(&self) -> &str {
///         "A ball falls onto jelly."
///     }
///     fn scene(&self, _seed: u64) -> Result<Scene> {
///         Ok(barchan::example())
///     }
///     fn actions(&self) -> Vec<Limits> {
///         Vec::new()
///     }
///     fn observations(&self) -> Vec<Part> {
///         vec![Part::new("speed [m/s]", 1)]
///     }
///     fn interval(&self) -> f64 {
///         0.01
///     }
///     fn horizon(&self) -> u64 {
///         100
///     }
///     fn reset(&self, _world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
///         Ok(Box::new(Waiting))
///     }
/// }
///
/// struct Waiting;
///
/// impl Episode for Waiting {
///     fn act(&mut self, _world: &mut Simulation, _action: &[f64]) -> Result<()> {
///         Ok(())
///     }
///     fn watch(&self, _world: &Simulation) -> Watch {
///         Watch::default()
///     }
///     fn observe(&mut self, world: &Simulation, _seen: &Seen) -> Result<Outcome> {
///         let speed = world.bodies()[0].velocity[2];
///         let still = speed.abs() < 1e-3;
///         Ok(Outcome { observation: vec![speed], success: still, terminated: still, ..Outcome::default() })
///     }
/// }
///
/// let registry = barchan::registry();
/// let mut environment = Environment::new(&registry, Box::new(Wait), &[0], &Options::default())?;
/// assert_eq!(environment.observation(0), [0.0]);
/// assert!(environment.step(&[vec![]])?.remove(0)?.observation[0] < 0.0);
/// # Ok::<(), barchan::Error>(())
/// ```
#[doc(inline)]
pub use barchan_core::Task;

pub use barchan_core::{
    backend, contact, coupling, file, glam, gradient, ledger, material, nearest, observer, parameter, plan, probe,
    reading, registry as registries, scene, schedule, simulation, snapshot, solid, state, stress, surface, task,
};
pub use barchan_tasks as tasks;

/// A ball above a slab of jelly, ready within seconds: the scene of these pages' examples.
pub fn example() -> Scene {
    let world = scene::World::new(0.05, [0.0; 3], [0.4; 3]).with_walls(scene::Wall::Slip);
    Scene::new("ball-on-jelly", world, 0.1)
        .with(scene::MaterialSpec::new("jelly", "neo_hookean", 1000.0).with("young_modulus", 2e4))
        .with(scene::Body::new("jelly", scene::Shape::cuboid([0.1, 0.1, 0.0], [0.3, 0.3, 0.1])))
        .with(scene::Tool::new("ball", scene::Shape::sphere(0.06)).at([0.2; 3]).free(0.5))
}

/// A registry of everything that comes with Barchan; GPUs with the feature `wgpu`.
///
/// # Panics
/// If a built-in plugin breaks the rules for plugins, which the tests rule out.
pub fn registry() -> Registry {
    let mut registry = Registry::new();
    let materials = [
        barchan_elastic::materials(),
        barchan_sand::materials(),
        barchan_snow::materials(),
        barchan_elastoplastic::materials(),
        barchan_liquid::materials(),
    ];
    let registered = materials
        .into_iter()
        .flatten()
        .try_for_each(|table| registry.add_material(table, plan::BUILT_IN))
        .and_then(|()| barchan_rigid::register(&mut registry))
        .and_then(|()| barchan_backend_cpu::register(&mut registry))
        .and_then(|()| barchan_tasks::register(&mut registry));
    #[cfg(feature = "wgpu")]
    let registered = registered.and_then(|()| barchan_wgpu::register(&mut registry));
    registered.expect("built-in plugins keep to the rules and have names of their own");
    registry
}
