//! A running simulation.

use crate::backend::{Bound, Timing, Turn};
use crate::plan::{cut, tighten, wanted_step};
use crate::scene::OverBound;
use crate::snapshot::Snapshot;
use crate::{
    Backend, BodyState, Coupling, Engine, Error, Ledger, ParticleState, Plan, Precision, Registry, Result, Scene, Spot,
    StepReport, Vec3, Wrench,
};
use std::fmt;
use std::ops::ControlFlow;
use std::path::Path;

/// How a scene is run; nothing here changes what is simulated but the number format.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Name of the backend.
    pub backend: String,
    /// Number format.
    pub precision: Precision,
    /// Worker threads; 0: as many as the machine has.
    pub threads: usize,
    /// Name or number of the adapter to run on, for backends that run on one; `None`: the first.
    pub adapter: Option<String>,
    /// Most bytes that particles may take while they are seeded; `None`: four fifths of the memory available.
    pub max_bytes: Option<u64>,
}

impl Default for Options {
    fn default() -> Self {
        Self { backend: "cpu".to_owned(), precision: Precision::F32, threads: 0, adapter: None, max_bytes: None }
    }
}

/// What summed-up times may be off, in steps: half a unit in the last place of 1000 s is 6e-9 steps of 10 µs, times
/// hundreds of steps between two stops.
const ROUNDING: f64 = 1e-6;
/// Steps over which growth of energy is judged.
const WATCH_STEPS: u64 = 50;
/// Growth of energy within them that ends a run.
const WATCH_GROWTH: f64 = 2.0;

/// A compiled scene: engine, couplings, time.
pub struct Simulation {
    plan: Plan,
    /// Name of the backend that runs.
    backend: String,
    engine: Box<dyn Engine>,
    /// Time by effect of the backends before this one.
    past: Vec<Timing>,
    couplings: Vec<Box<dyn Coupling>>,
    time: f64,
    step: u64,
    /// Where steps must land; infinite: nowhere.
    stop: f64,
    /// Ledger entries that add up over time, from before this process took over.
    carried: Ledger,
    /// Steps that were cut since they were above the bound.
    cut_steps: u64,
    watch: Option<Watch>,
    /// Mean wrenches over the last step, if the couplings took several within it.
    wrenches: Option<Vec<Wrench>>,
    /// Is its engine a world's of a batch?
    in_batch: bool,
}

impl fmt::Debug for Simulation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Simulation")
            .field("scene", &self.plan.scene.name)
            .field("particles", &self.engine.particle_count())
            .field("time", &self.time)
            .field("step", &self.step)
            .finish_non_exhaustive()
    }
}

/// Steps that a simulation is to take next.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wish {
    /// Length of each [s].
    pub(crate) dt: f64,
    /// How many at once.
    pub(crate) count: usize,
    /// After how many of this length the next stop is reached.
    pub(crate) to_stop: usize,
    /// Are they above the bound?
    pub(crate) above: bool,
}

/// Energy at the start of a stretch of [`WATCH_STEPS`] steps above the bound.
#[derive(Clone, Copy, Debug)]
struct Watch {
    step: u64,
    /// Kinetic and elastic.
    inner: f64,
    potential: f64,
    /// Work that driven bodies have done on the ground since.
    work: f64,
    /// What has come within reach, and what has fallen out of it [kg]: as either changes, so does energy.
    exchanged: [f64; 2],
}

/// The backend asked for; an adapter may be named only if it runs on one.
pub(crate) fn find_backend<'a>(registry: &'a Registry, options: &Options) -> Result<&'a dyn Backend> {
    let backend = &**registry.backend(&options.backend)?;
    match &options.adapter {
        Some(adapter) if backend.adapters().is_none() => Err(Error::Missing {
            kind: "backend",
            name: options.backend.clone(),
            origin: "it runs on the processor".to_owned(),
            what: "adapters".to_owned(),
            why: format!("the adapter '{adapter}' is asked for"),
            mend: "ask for none, or use a backend that runs on one".to_owned(),
        }),
        _ => Ok(backend),
    }
}

/// What has come within reach of agents, and what has fallen out of it [kg].
fn exchanged(ledger: &Ledger) -> [f64; 2] {
    [ledger.seeded_mass, ledger.archived_mass]
}

impl Simulation {
    /// Assembles a scene and compiles it.
    ///
    /// # Errors
    /// Those of [`Plan::assemble`] and of the backend.
    pub fn new(registry: &Registry, scene: &Scene, options: &Options) -> Result<Self> {
        let backend = find_backend(registry, options)?;
        let (plan, particles, couplings) = Plan::assemble(registry, scene, options)?;
        let engine = backend.compile(&plan, particles)?;
        Ok(Self::start(plan, backend.name(), engine, couplings))
    }

    /// A world of a batch.
    pub(crate) fn in_batch(
        plan: Plan,
        backend: &str,
        engine: Box<dyn Engine>,
        couplings: Vec<Box<dyn Coupling>>,
    ) -> Self {
        Self { in_batch: true, ..Self::start(plan, backend, engine, couplings) }
    }

    fn start(plan: Plan, backend: &str, engine: Box<dyn Engine>, couplings: Vec<Box<dyn Coupling>>) -> Self {
        Self {
            plan,
            backend: backend.to_owned(),
            engine,
            past: Vec::new(),
            couplings,
            time: 0.0,
            step: 0,
            stop: f64::INFINITY,
            carried: Ledger::default(),
            cut_steps: 0,
            watch: None,
            wrenches: None,
            in_batch: false,
        }
    }

    /// Continues from a snapshot, bit for bit if backend and machine are the same; another backend sorts the particles anew. The number format is the snapshot's;
    /// asking for another is an error.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the file cannot be used, and those of [`new`](Self::new).
    pub fn resume(registry: &Registry, path: impl AsRef<Path>, options: &Options) -> Result<Self> {
        let path = path.as_ref();
        let mut snapshot = Snapshot::read(path)?;
        let refuse = |what: String, mend: &str| Error::Snapshot { file: path.to_owned(), what, mend: mend.to_owned() };
        if snapshot.precision != options.precision {
            return Err(refuse(
                format!("was written by a run in {}, and {} is asked for", snapshot.precision, options.precision),
                "resume with the same precision",
            ));
        }
        let backend = find_backend(registry, options)?;
        let scene = Scene::from_str(&snapshot.scene, &path.display().to_string(), &snapshot.folder)?;
        if !snapshot.backend.is_empty() && snapshot.backend != backend.name() {
            snapshot.particles.sort = None;
        }
        let (plan, particles, mut couplings) =
            Plan::assemble_with(registry, &scene, options, Some(snapshot.particles))?;
        let named: Vec<_> = couplings.iter().map(|c| c.name().to_owned()).collect();
        let saved: Vec<_> = snapshot.couplings.iter().map(|(name, _)| name.clone()).collect();
        if named != saved {
            return Err(refuse(
                format!("holds couplings [{}], its scene makes [{}]", saved.join(", "), named.join(", ")),
                "resume with the plugins of the first run",
            ));
        }
        for (coupling, (name, bytes)) in couplings.iter_mut().zip(&snapshot.couplings) {
            coupling.restore(bytes).map_err(|what| {
                refuse(format!("coupling '{name}': {what}"), "resume with the version that wrote it")
            })?;
        }
        let engine = backend.compile(&plan, particles)?;
        Ok(Self {
            time: snapshot.time,
            step: snapshot.step,
            stop: snapshot.stop.unwrap_or(f64::INFINITY),
            cut_steps: snapshot.cut_steps,
            carried: snapshot.carried,
            ..Self::start(plan, backend.name(), engine, couplings)
        })
    }

    /// Goes on with another backend or number format from the next step on. Particles, levels, archive, bodies, time and ledger are
    /// kept; particles are sorted anew, and f64 is rounded where f32 takes over. On an error the simulation is as it was.
    ///
    /// 1. The state is copied out, the scene is planned for the other backend and compiled with that state.
    /// 2. What the ledger sums up is carried over, and so is the time that effects took.
    ///
    /// # Errors
    /// Those of [`new`](Self::new), by name if the backend lacks something that the scene calls for.
    pub fn swap(&mut self, registry: &Registry, options: &Options) -> Result<()> {
        let backend = find_backend(registry, options)?;
        let mut particles = self.engine.download();
        if self.backend != backend.name() || self.plan.precision != options.precision {
            particles.sort = None;
        }
        // The couplings that go with a new plan are those of the start: ours stay.
        let (plan, particles, _) = Plan::assemble_with(registry, &self.plan.scene, options, Some(particles))?;
        let engine = backend.compile(&plan, particles)?;
        let mut carried = std::mem::take(&mut self.carried);
        self.engine.account(&mut carried);
        self.carried = only_sums(carried);
        let named =
            |t: Timing| Timing { effect: format!("{} ({} {})", t.effect, self.backend, self.plan.precision), ..t };
        self.past.extend(self.engine.timings().into_iter().map(named));
        self.backend = backend.name().to_owned();
        self.plan = plan;
        self.engine = engine;
        self.in_batch = false;
        self.watch = None;
        Ok(())
    }

    /// Writes everything needed to continue: to a temporary file beside `path`, then renamed.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be written, [`Error::Device`] if the particles were lost with their device; an older file of that name is
    /// intact then.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let mut carried = self.carried.clone();
        self.engine.account(&mut carried);
        let particles = self.engine.download();
        self.engine.check()?;
        // Absolute, so that a run can be resumed from another folder.
        let folder = &self.plan.scene.folder;
        let folder = std::env::current_dir().map_or_else(|_| folder.clone(), |here| here.join(folder));
        Snapshot {
            scene: self.plan.scene.to_toml()?,
            folder,
            precision: self.plan.precision,
            backend: self.backend.clone(),
            time: self.time,
            step: self.step,
            stop: self.stop.is_finite().then_some(self.stop),
            cut_steps: self.cut_steps,
            carried: only_sums(carried),
            particles,
            couplings: self.couplings.iter().map(|c| (c.name().to_owned(), c.save())).collect(),
        }
        .write(path.as_ref())
    }

    /// Name of the backend that runs.
    pub fn backend(&self) -> &str {
        &self.backend
    }
    /// What is simulated, and why.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }
    /// Simulated seconds.
    pub fn time(&self) -> f64 {
        self.time
    }
    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.step
    }
    /// A copy of all particles.
    pub fn particles(&self) -> ParticleState {
        self.engine.download()
    }
    /// A copy of all particles, and of those in the archive of changed ground out of reach, which are at rest: a list each per
    /// level and material that a tile has. Not to be handed back.
    pub fn ground(&self) -> ParticleState {
        self.ground_where(&|_| true)
    }
    /// The particles of [`ground`](Self::ground) for which `wanted` holds: the same lists, shorter. Not to be handed back.
    pub fn ground_where(&self, wanted: &(dyn Fn(&Spot) -> bool + Sync)) -> ParticleState {
        self.engine.download_where(wanted)
    }
    /// Where every particle of [`ground`](Self::ground) is and how large, for a fraction of its cost.
    pub fn spots(&self) -> Vec<Spot> {
        self.engine.spots()
    }
    /// Number of particles.
    pub fn particle_count(&self) -> usize {
        self.engine.particle_count()
    }
    /// Replaces all particles.
    ///
    /// # Errors
    /// If the state does not fit the plan.
    pub fn set_particles(&mut self, particles: ParticleState) -> Result<()> {
        self.plan.check_particles(&particles)?;
        self.engine.upload(particles)
    }
    /// All bodies of all couplings, in the scene's order.
    pub fn bodies(&self) -> Vec<BodyState> {
        self.couplings.iter().flat_map(|c| c.bodies()).collect()
    }
    /// Mean wrench of the ground on each of [`bodies`](Self::bodies) over the last step.
    pub fn wrenches(&self) -> Vec<Wrench> {
        let own = || self.couplings.iter().flat_map(|c| c.wrenches().iter().copied()).collect();
        self.wrenches.clone().unwrap_or_else(own)
    }
    /// The couplings, for questions about their surfaces.
    pub fn couplings(&self) -> &[Box<dyn Coupling>] {
        &self.couplings
    }
    /// Time by effect since this process took over; that of backends before a [`swap`](Self::swap) comes first, with their names.
    pub fn timings(&self) -> Vec<Timing> {
        self.past.iter().cloned().chain(self.engine.timings()).collect()
    }
    /// Bytes resident for particles and grid.
    pub fn memory(&self) -> (u64, u64) {
        self.engine.memory()
    }

    /// Totals, and counts of everything clamped, floored, cut or lost since the scene's start.
    pub fn ledger(&self) -> Ledger {
        let mut ledger = self.carried.clone();
        self.engine.account(&mut ledger);
        ledger.count("steps cut below time.step", self.cut_steps);
        for coupling in &self.couplings {
            for body in coupling.bodies() {
                ledger.body_kinetic += body.kinetic_energy;
                ledger.body_potential += body.potential_energy;
                for d in 0..3 {
                    ledger.body_momentum[d] += body.momentum[d];
                    ledger.body_angular_momentum[d] += body.angular_momentum[d];
                }
            }
            for (name, count) in coupling.counts() {
                ledger.count(&name, count);
            }
        }
        ledger
    }

    /// Sets the velocity [m/s] and angular velocity [rad/s] of a driven body from now on.
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such body, it is not driven by velocity, or the numbers are not finite.
    pub fn drive(&mut self, body: &str, velocity: Vec3, angular_velocity: Vec3) -> Result<()> {
        for coupling in &mut self.couplings {
            if coupling.bodies().iter().any(|b| b.name == body) {
                return coupling.drive(body, velocity, angular_velocity);
            }
        }
        let names: Vec<_> = self.bodies().into_iter().map(|b| b.name).collect();
        Err(Error::Body {
            path: body.to_owned(),
            what: "no rigid body has this name".to_owned(),
            mend: if names.is_empty() {
                "the scene has none".to_owned()
            } else {
                format!("there are {}", names.join(", "))
            },
        })
    }

    /// Makes steps land on `time` [s]: the time left is divided evenly, and the last step ends there exactly. A stop that
    /// is not ahead means none.
    pub fn set_stop(&mut self, time: f64) {
        self.stop = if time > self.time { time } else { f64::INFINITY };
    }

    /// Greatest stable step of the present state, tools included.
    pub fn bound(&self) -> Bound {
        let scene = &self.plan.scene;
        tighten(self.engine.bound(), &self.couplings, self.time, scene.world.cell, scene.output.interval)
    }

    /// One step of the engine.
    ///
    /// 1. The step is the scene's, or what the bound allows; a step above the bound is refused, cut, or watched.
    /// 2. It is shortened so that equal steps land on the stop.
    /// 3. The engine takes it, calling the couplings; on an error everything is as before the step.
    ///
    /// # Errors
    /// [`Error::TimeStep`], [`Error::Unstable`], and the engine's.
    pub fn step(&mut self) -> Result<StepReport> {
        let mut reports = self.steps(1, f64::INFINITY)?;
        Ok(reports.pop().expect("an engine takes a step or says why not"))
    }

    /// As [`step`](Self::step), up to `most` times if the engine is faster when it is asked for many steps at once; none of them
    /// begins at `until` [s] or later. The length of all is chosen before the first.
    ///
    /// # Errors
    /// As [`step`](Self::step): everything is as before the first of these steps.
    pub fn steps(&mut self, most: usize, until: f64) -> Result<Vec<StepReport>> {
        let wish = self.wish(most, until)?;
        let before = self.begin(&wish);
        let result = self.engine.steps(self.time, wish.dt, wish.count, &mut self.couplings);
        self.finish(&wish, &before, result)
    }

    /// The steps that are to be taken next.
    pub(crate) fn wish(&mut self, most: usize, until: f64) -> Result<Wish> {
        let bound = self.bound();
        let (mut dt, above) = self.choose(&bound)?;
        let left = self.stop - self.time;
        // Energy is watched step by step.
        let mut count = if above { 1 } else { most.max(1) };
        let mut to_stop = usize::MAX;
        if left.is_finite() {
            let parts = (left / dt - ROUNDING).ceil().max(1.0);
            // Steps that divide the time left but for rounding keep their bits.
            if (left - parts * dt).abs() > ROUNDING * dt {
                dt = left / parts;
            }
            to_stop = parts as usize;
            count = count.min(to_stop);
        }
        if count > 1 && until.is_finite() {
            count = count.min(((until - self.time) / dt - ROUNDING).ceil().max(1.0) as usize);
        }
        Ok(Wish { dt, count, to_stop, above })
    }

    /// What must be kept to go back to before the steps: what each coupling saves.
    pub(crate) fn begin(&mut self, wish: &Wish) -> Vec<Vec<u8>> {
        if wish.above {
            self.begin_watch();
        } else {
            self.watch = None;
        }
        self.couplings.iter().map(|c| c.save()).collect()
    }

    /// Takes in what the engine did, or goes back.
    pub(crate) fn finish(
        &mut self,
        wish: &Wish,
        before: &[Vec<u8>],
        result: Result<Vec<StepReport>>,
    ) -> Result<Vec<StepReport>> {
        let reports = match result {
            Ok(reports) => reports,
            Err(mut error) => {
                // The engine counts from where it was compiled or resumed.
                if let Error::NonFinite { step, .. } | Error::LeftWorld { step, .. } | Error::TimeStep { step, .. } =
                    &mut error
                {
                    *step = self.step;
                }
                for (coupling, bytes) in self.couplings.iter_mut().zip(before) {
                    coupling.restore(bytes).map_err(|what| Error::Body {
                        path: format!("coupling '{}'", coupling.name()),
                        what: format!("cannot go back to before the step that failed ({error}): {what}"),
                        mend: "resume from the last snapshot".to_owned(),
                    })?;
                }
                return Err(error);
            }
        };
        for (i, report) in reports.iter().enumerate() {
            self.step += 1;
            self.wrenches.clone_from(&report.wrenches);
            if i + 1 == wish.to_stop && report.dt == wish.dt {
                self.time = self.stop;
                self.stop = f64::INFINITY;
            } else {
                self.time += report.dt;
            }
            self.judge_watch(report.dt)?;
        }
        Ok(reports)
    }

    /// A turn of this world in a batch.
    pub(crate) fn turn(&mut self, world: usize) -> Turn<'_> {
        Turn { world, time: self.time, couplings: &mut self.couplings }
    }

    /// Does the engine that it started with still run it?
    pub(crate) fn is_in_batch(&self) -> bool {
        self.in_batch
    }

    /// Steps until `until` [s] or until `on_step` breaks off; was `until` reached?
    ///
    /// # Errors
    /// As [`step`](Self::step).
    pub fn advance(
        &mut self,
        until: f64,
        mut on_step: impl FnMut(&Self, &StepReport) -> ControlFlow<()>,
    ) -> Result<bool> {
        while self.time < until {
            self.set_stop(until);
            let report = self.step()?;
            if on_step(self, &report).is_break() {
                return Ok(self.time >= until);
            }
        }
        Ok(true)
    }

    /// The step under the scene's rule, and whether it is above the bound.
    fn choose(&mut self, bound: &Bound) -> Result<(f64, bool)> {
        let scene = &self.plan.scene;
        let dt = wanted_step(scene, bound);
        if dt <= bound.dt {
            return Ok((dt, false));
        }
        match scene.time.over_bound {
            OverBound::Refuse => Err(Error::TimeStep { step: self.step, dt, bound: bound.dt, by: bound.by.clone() }),
            OverBound::Substep => {
                self.cut_steps += 1;
                Ok((cut(dt, scene.time.safety * bound.dt), false))
            }
            OverBound::Allow => Ok((dt, true)),
        }
    }

    fn begin_watch(&mut self) {
        if self.watch.is_none() {
            let ledger = self.ledger();
            self.watch = Some(Watch {
                step: self.step,
                inner: inner(&ledger),
                potential: potential(&ledger),
                work: 0.0,
                exchanged: exchanged(&ledger),
            });
        }
    }

    /// Ends the run if, within [`WATCH_STEPS`] steps above the bound, energy grew more than [`WATCH_GROWTH`]-fold and
    /// neither falling nor driven tools explain it.
    fn judge_watch(&mut self, dt: f64) -> Result<()> {
        let Some(mut watch) = self.watch else { return Ok(()) };
        for (body, wrench) in self.bodies().iter().zip(self.wrenches()).filter(|(body, _)| body.mass.is_infinite()) {
            for d in 0..3 {
                let power = wrench.force[d] * body.velocity[d] + wrench.torque[d] * body.angular_velocity[d];
                watch.work -= power * dt;
            }
        }
        self.watch = Some(watch);
        let steps = self.step - watch.step;
        if steps < WATCH_STEPS {
            return Ok(());
        }
        let ledger = self.ledger();
        let fallen = watch.potential - potential(&ledger);
        let unexplained = inner(&ledger) - watch.inner - fallen - watch.work;
        // Below a thousandth of the speed of one cell a step, growth is rounding's; of what falls and is pushed, a tenth
        // is allowed for the scheme's own error.
        let floor = 1e-6 * ledger.mass * (self.plan.scene.world.cell / dt).powi(2);
        let scale = watch.inner.max(floor) + 0.1 * (fallen.abs() + watch.work.abs());
        self.watch = None;
        if unexplained <= (WATCH_GROWTH - 1.0) * scale || exchanged(&ledger) != watch.exchanged {
            return Ok(());
        }
        Err(Error::Unstable {
            step: self.step,
            before: watch.inner,
            after: inner(&ledger),
            steps,
            particle: self.fastest(),
        })
    }

    fn fastest(&self) -> u64 {
        let particles = self.engine.download();
        let speeds = particles.lists.iter().flat_map(|list| {
            list.velocity.iter().zip(&list.id).map(|(v, id)| (v.iter().map(|c| c * c).sum::<f64>(), *id))
        });
        speeds.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(0, |(_, id)| id)
    }
}

/// Kinetic and elastic energy; laws that give no elastic energy are left out.
fn inner(ledger: &Ledger) -> f64 {
    ledger.kinetic + ledger.body_kinetic + if ledger.elastic.is_nan() { 0.0 } else { ledger.elastic }
}

fn potential(ledger: &Ledger) -> f64 {
    ledger.potential + ledger.body_potential
}

/// The entries that add up over time, without those that describe the present; such counts end in "now".
fn only_sums(mut ledger: Ledger) -> Ledger {
    ledger.counts.retain(|name, _| !name.ends_with(" now"));
    Ledger {
        wall_impulse: ledger.wall_impulse,
        gravity_impulse: ledger.gravity_impulse,
        deleted_mass: ledger.deleted_mass,
        seeded_mass: ledger.seeded_mass,
        archived_kinetic: ledger.archived_kinetic,
        resampled_kinetic: ledger.resampled_kinetic,
        resampled_angular_momentum: ledger.resampled_angular_momentum,
        slept_kinetic: ledger.slept_kinetic,
        slept_momentum: ledger.slept_momentum,
        counts: ledger.counts,
        ..Ledger::default()
    }
}
