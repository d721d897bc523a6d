//! A running simulation.

mod resume;

pub(crate) use resume::Moment;
pub use resume::State;

use crate::backend::{Bound, Timing, WorldStep};
use crate::coupling::Kept;
use crate::flow::FlowState;
use crate::parameter::{Giver, Parameters, Table};
use crate::plan::{SCENE_COUPLINGS, cut, tighten, wanted_step};
use crate::scene::{INSTANT, OverBound};
use crate::{
    Aabb, Backend, BodyState, Command, Coupling, Engine, Error, Fields, JointState, Ledger, ParticleState, Plan,
    Precision, Reading, Registry, Result, Scene, Spot, StepReport, Wrench,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

/// How a scene is run; nothing here changes what is simulated but the number format.
#[derive(Clone, Debug, PartialEq)]
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
    /// What the backend is asked for, of what it [declares](Backend::parameters); files are named relative to the folder that the program runs in.
    pub backend_parameters: Table,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            backend: "cpu".to_owned(),
            precision: Precision::F32,
            threads: 0,
            adapter: None,
            max_bytes: None,
            backend_parameters: Table::new(),
        }
    }
}

impl Options {
    /// More threads than any machine has.
    pub const MOST_THREADS: usize = 1024;

    /// What a backend is asked for, and its defaults.
    ///
    /// # Errors
    /// [`Error::Scene`] for what it has not declared.
    pub fn parameters_of(&self, backend: &dyn Backend) -> Result<Parameters> {
        let fault = |path: &str, what: String, mend: String| Error::Scene {
            file: "--backend-parameter".to_owned(),
            line: 0,
            path: path.to_owned(),
            what,
            allowed: Some(mend),
        };
        let giver = Giver { whose: format!("backend '{}'", backend.name()), folder: Path::new(""), fault: &fault };
        giver.resolve(&backend.parameters(), &self.backend_parameters, "")
    }

    /// Holds what could not be meant to be refused before it is tried.
    ///
    /// # Errors
    /// [`Error::Capacity`] for more than [`MOST_THREADS`](Self::MOST_THREADS).
    pub fn check(&self) -> Result<()> {
        if self.threads <= Self::MOST_THREADS {
            return Ok(());
        }
        Err(Error::Capacity {
            what: "worker threads",
            asked: self.threads as u64,
            cap: Self::MOST_THREADS as u64,
            mend: "ask for 0 to have as many as the machine has",
        })
    }
}

/// What summed-up times may be off, in steps: half a unit in the last place of 1000 s is 6e-9 steps of 10 µs, times
/// hundreds of steps between two stops.
const ROUNDING: f64 = 1e-6;
/// A step is chosen for this many at least, if the engine likes many, and for more as long as it is no shorter than this part of what the next one bears.
const LEAST_STRIDE: u64 = 8;
const MOST_LOSS: f64 = 0.95;
/// Steps over which growth of energy is judged.
const WATCH_STEPS: u64 = 50;
/// Growth of energy within them that ends a run.
const WATCH_GROWTH: f64 = 2.0;

/// A compiled scene: engine, couplings, time.
pub struct Simulation {
    plan: Arc<Plan>,
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
    /// The length of the next steps, if it has been chosen.
    chosen: Option<Chosen>,
    /// Counts from before this process took over.
    carried: BTreeMap<String, u64>,
    /// Steps that were cut since they were above the bound.
    cut_steps: u64,
    watch: Option<Watch>,
    /// What sources and sinks have done.
    flow: FlowState,
    /// Mean wrenches over the last step, if the couplings took several within it.
    wrenches: Option<Vec<Wrench>>,
    /// Are reports to say where bodies are after each of several steps?
    reports_bodies: bool,
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

/// The length of the steps up to one, chosen before the first of them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Chosen {
    /// Length of each [s]: steps of this length land on the stop, if there is one.
    dt: f64,
    /// The step before which another is chosen.
    until: u64,
    /// Is it above the bound?
    above: bool,
    /// Is it below the scene's, since that is above the bound?
    cut: bool,
}

impl Chosen {
    /// Does it move time on?
    pub(crate) fn is_sound(&self) -> bool {
        self.dt > 0.0 && self.dt.is_finite()
    }
}

/// Steps that a simulation is to take next.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WantedSteps {
    /// Length of each [s].
    pub(crate) dt: f64,
    /// How many at once.
    pub(crate) count: usize,
    /// After how many of this length the next stop is reached.
    pub(crate) to_stop: usize,
    /// Are they above the bound?
    pub(crate) above: bool,
}

/// Energy of the ground at the start of a stretch of [`WATCH_STEPS`] steps above the bound.
#[derive(Clone, Copy, Debug)]
struct Watch {
    step: u64,
    /// Kinetic and elastic.
    inner: f64,
    potential: f64,
    /// Work that bodies have done on it since.
    work: f64,
    /// What has come within reach or from sources, and what has fallen out of reach or into sinks [kg]: as any of it changes, so does energy.
    exchanged: [f64; 4],
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

/// What has come within reach of agents, and what has fallen out of it; what has come from sources, and what has gone into sinks [kg].
fn exchanged(ledger: &Ledger) -> [f64; 4] {
    [ledger.seeded_mass, ledger.archived_mass, ledger.sources.mass, ledger.sinks.mass]
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
        Ok(Self::start(Arc::new(plan), backend.name(), engine, couplings))
    }

    /// A world of a batch.
    pub(crate) fn in_batch(
        plan: Plan,
        backend: &str,
        engine: Box<dyn Engine>,
        couplings: Vec<Box<dyn Coupling>>,
    ) -> Self {
        Self { in_batch: true, ..Self::start(Arc::new(plan), backend, engine, couplings) }
    }

    fn start(plan: Arc<Plan>, backend: &str, engine: Box<dyn Engine>, couplings: Vec<Box<dyn Coupling>>) -> Self {
        let flow = plan.flows.as_ref().map(|flows| flows.start(plan.particle_count as u64)).unwrap_or_default();
        Self {
            flow,
            plan,
            backend: backend.to_owned(),
            engine,
            past: Vec::new(),
            couplings,
            time: 0.0,
            step: 0,
            stop: f64::INFINITY,
            chosen: None,
            carried: BTreeMap::new(),
            cut_steps: 0,
            watch: None,
            wrenches: None,
            reports_bodies: false,
            in_batch: false,
        }
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
        let plan = Plan { files: self.plan.files.clone(), ..plan };
        let mut engine = backend.compile(&plan, particles)?;
        let sums = self.sums();
        engine.carry_on(&sums);
        self.carried = sums.counts;
        let named =
            |t: Timing| Timing { effect: format!("{} ({} {})", t.effect, self.backend, self.plan.precision), ..t };
        self.past.extend(self.engine.timings().into_iter().map(named));
        self.backend = backend.name().to_owned();
        self.plan = Arc::new(plan);
        self.engine = engine;
        self.in_batch = false;
        self.watch = None;
        self.chosen = None;
        Ok(())
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
        self.engine.download_where(None, wanted)
    }
    /// Where every particle of [`ground`](Self::ground) is and how large, for a fraction of its cost.
    pub fn spots(&self) -> Vec<Spot> {
        self.engine.spots()
    }
    /// Reads some values of the particles in a region, or of all: their positions and what `fields` asks for, in f32 and without a copy of the rest. Those
    /// in the archive of ground out of reach are among them. On a GPU only what was asked for comes to the host.
    ///
    /// # Errors
    /// [`Error::Device`] if the particles were lost with their device.
    pub fn read(&self, region: Option<Aabb>, fields: Fields) -> Result<Reading> {
        let least = region.map(|region| region.min).filter(|min| min.iter().all(|x| x.is_finite()));
        let reading = self.engine.read(region.as_ref(), fields, least.unwrap_or(self.plan.scene.world.min));
        self.engine.check()?;
        Ok(reading)
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
        self.chosen = None;
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
    /// One of them, and the wrench on it.
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such body.
    pub fn body(&self, name: &str) -> Result<(BodyState, Wrench)> {
        let mut bodies = self.bodies();
        match bodies.iter().position(|body| body.name == name) {
            Some(i) => Ok((bodies.swap_remove(i), self.wrenches()[i])),
            None => Err(no_body(&bodies, name)),
        }
    }
    pub(crate) fn plan_shared(&self) -> Arc<Plan> {
        Arc::clone(&self.plan)
    }
    /// Particles that the world's sides have put back or taken so far.
    pub(crate) fn lost(&self) -> u64 {
        let mut ledger = Ledger::default();
        self.engine.account(&mut ledger);
        let named = ["particles put back into the world", "particles deleted on leaving"];
        named.iter().filter_map(|name| ledger.counts.get(*name)).sum()
    }
    pub(crate) fn engine(&self) -> &dyn Engine {
        &*self.engine
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
    /// Transfers from a device to the host for what was looked at, and their bytes; of all worlds together that share a batch.
    pub fn transferred(&self) -> (u64, u64) {
        self.engine.transferred()
    }

    /// Totals, and counts of everything clamped, floored, cut or lost since the scene's start.
    pub fn ledger(&self) -> Ledger {
        let mut ledger = Ledger { counts: self.carried.clone(), ..Ledger::default() };
        self.engine.account(&mut ledger);
        ledger.count("steps cut below time.step", self.cut_steps);
        (ledger.sources, ledger.sinks) = (self.flow.came.clone(), self.flow.went.clone());
        ledger.count("particles that sources held back", self.flow.held_back);
        for (coupling, planned) in self.couplings.iter().zip(&self.plan.couplings) {
            for body in coupling.bodies() {
                ledger.body_kinetic += body.kinetic_energy;
                ledger.body_potential += body.potential_energy;
                for d in 0..3 {
                    ledger.body_momentum[d] += body.momentum[d];
                    ledger.body_angular_momentum[d] += body.angular_momentum[d];
                }
            }
            for (name, count) in coupling.counts() {
                match SCENE_COUPLINGS.contains(&planned.kind.as_str()) {
                    true => ledger.count(&name, count),
                    false => ledger.count(&format!("{}: {name}", planned.name), count),
                }
            }
        }
        ledger
    }

    /// The entries of the ledger that add up over time.
    fn sums(&self) -> Ledger {
        let mut ledger = Ledger { counts: self.carried.clone(), ..Ledger::default() };
        self.engine.account(&mut ledger);
        only_sums(ledger)
    }

    /// Joints of all robots as they are now, in the order of commands to them.
    pub fn joints(&self) -> Vec<JointState> {
        self.couplings.iter().flat_map(|coupling| coupling.joints()).collect()
    }

    /// Tells a body what to do from now on, or gives it a blow.
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such body, it does not take such commands, or numbers are not finite or beyond [`GREATEST`](crate::GREATEST).
    pub fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        for coupling in &mut self.couplings {
            if coupling.has_body(body) {
                command.check(body)?;
                self.chosen = None;
                return coupling.act(body, command);
            }
        }
        Err(no_body(&self.bodies(), body))
    }

    /// Makes steps land on `time` [s]: the time left is divided evenly, and the last step ends there exactly. A stop that
    /// is not ahead means none.
    pub fn set_stop(&mut self, time: f64) {
        let stop = if time > self.time { time } else { f64::INFINITY };
        if stop != self.stop {
            (self.stop, self.chosen) = (stop, None);
        }
    }

    /// Greatest stable step of the present state, tools included.
    pub fn bound(&self) -> Bound {
        tighten(self.engine.bound(), &self.couplings, self.time, self.plan.scene.world.cell, 1)
    }

    /// One step of the engine.
    ///
    /// 1. The step is the scene's, or what the bound allows; a step above the bound is refused, cut, or watched. One choice holds for as many
    ///    steps as the engine likes ([`Engine::stride`]), whoever looks in between.
    /// 2. It is shortened so that equal steps land on the stop.
    /// 3. Before it, sinks and sources do what is due.
    /// 4. The engine takes it, calling the couplings; on an error everything is as before the step.
    ///
    /// # Errors
    /// [`Error::TimeStep`], [`Error::Unstable`], and the engine's.
    pub fn step(&mut self) -> Result<StepReport> {
        let mut reports = self.steps(1, f64::INFINITY)?;
        Ok(reports.pop().expect("`finish` has refused an engine that takes no step"))
    }

    /// As [`step`](Self::step), up to `most` times if the engine is faster when it is asked for many steps at once; none of them
    /// begins at `until` [s] or later. Where calls begin and end changes no bit of what is simulated.
    ///
    /// # Errors
    /// As [`step`](Self::step): everything is as before the first of these steps.
    pub fn steps(&mut self, most: usize, until: f64) -> Result<Vec<StepReport>> {
        let wanted = self.wanted(most, until)?;
        let before = self.begin(&wanted);
        let result = self.engine.steps(self.time, wanted.dt, wanted.count, &mut self.couplings, self.reports_bodies);
        self.finish(&wanted, before, result)
    }

    /// Says whether reports of [`steps`](Self::steps) that a device takes at once are to [say](StepReport::bodies) where bodies were after each of
    /// them. They do not unless this is called: to bring back all links of many robots takes longer than to move them.
    pub fn report_bodies(&mut self, wanted: bool) {
        self.reports_bodies = wanted;
    }

    /// The steps that are to be taken next, once bodies have come and gone, and sinks and sources have done what is due before them.
    pub(crate) fn wanted(&mut self, most: usize, until: f64) -> Result<WantedSteps> {
        self.change_bodies()?;
        let (flows, now) = (self.plan.flows.clone(), (self.time, self.step));
        if let Some(flows) = &flows
            && flows.advance(&mut self.flow, &self.plan, now, &mut *self.engine, &self.couplings)?
        {
            self.chosen = None;
        }
        let holds = |chosen: &Chosen| self.step < chosen.until && !self.engine.is_outgrown(chosen.dt);
        let chosen = match self.chosen.filter(holds) {
            Some(chosen) => chosen,
            None => self.choose()?,
        };
        let left = self.stop - self.time;
        // In a batch, steps may have been shorter than what was chosen.
        let chosen = Chosen { dt: landing(left, chosen.dt), ..chosen };
        self.chosen = Some(chosen);
        let Chosen { dt, above, .. } = chosen;
        let mut count = usize::try_from(chosen.until - self.step).unwrap_or(usize::MAX).min(most.max(1));
        if above {
            // Energy is watched step by step.
            count = 1;
        }
        let to_stop = if left.is_finite() { parts(left, dt) as usize } else { usize::MAX };
        count = count.min(to_stop);
        if count > 1 && until.is_finite() {
            count = count.min(parts(until - self.time, dt) as usize);
        }
        if let Some(flows) = &flows {
            count = flows.steps_until_due(&self.flow, now, dt, count);
        }
        let change =
            self.couplings.iter().map(|coupling| coupling.next_change(self.time)).fold(f64::INFINITY, f64::min);
        if change.is_finite() {
            // Time is added up just as steps do it.
            let mut at = self.time;
            let comes_by = |_: &usize| {
                at += dt;
                change <= at + INSTANT
            };
            count = (1..count).find(comes_by).unwrap_or(count);
        }
        Ok(WantedSteps { dt, count, to_stop, above })
    }

    /// Bodies appear and vanish whose time has come.
    fn change_bodies(&mut self) -> Result<()> {
        let (engine, mut changed) = (&mut self.engine, false);
        let mut places = |region: &Aabb| {
            let found = engine.read(Some(region), Fields { exact: true, ..Fields::default() }, region.min);
            engine.check()?;
            Ok((0..found.len()).map(|i| found.at(i)).collect())
        };
        for coupling in &mut self.couplings {
            changed |= coupling.change(self.time, &mut places)?;
        }
        if changed {
            self.chosen = None;
        }
        Ok(())
    }

    /// What must be kept to go back to before the steps: of each coupling what steps change.
    pub(crate) fn begin(&mut self, wanted: &WantedSteps) -> Vec<Kept> {
        if wanted.above {
            self.begin_watch();
        } else {
            self.watch = None;
        }
        self.couplings.iter().map(|c| c.keep()).collect()
    }

    /// Takes in what the engine did, or goes back.
    pub(crate) fn finish(
        &mut self,
        wanted: &WantedSteps,
        before: Vec<Kept>,
        result: Result<Vec<StepReport>>,
    ) -> Result<Vec<StepReport>> {
        let some = |reports: Vec<_>| if reports.is_empty() { Err(no_step(&self.backend)) } else { Ok(reports) };
        let reports = match result.and_then(some) {
            Ok(reports) => reports,
            Err(mut error) => {
                // The engine counts from where it was compiled or resumed.
                if let Error::NonFinite { step, .. } | Error::LeftWorld { step, .. } | Error::TimeStep { step, .. } =
                    &mut error
                {
                    *step = self.step;
                }
                for (coupling, kept) in self.couplings.iter_mut().zip(before) {
                    coupling.go_back(kept).map_err(|what| Error::Body {
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
            self.cut_steps += u64::from(self.chosen.is_some_and(|chosen| chosen.cut));
            self.wrenches.clone_from(&report.wrenches);
            if i + 1 == wanted.to_stop && report.dt == wanted.dt {
                self.time = self.stop;
                self.stop = f64::INFINITY;
                self.chosen = None;
            } else {
                self.time += report.dt;
            }
            self.judge_watch(report.dt)?;
        }
        // What was too fast for the length that was chosen is likely to be so in the steps that it was chosen for.
        let shorter = reports.last().map_or(wanted.dt, |report| report.dt);
        if let Some(chosen) = self.chosen.filter(|_| shorter < wanted.dt) {
            self.chosen = Some(Chosen { dt: shorter, ..chosen });
        }
        Ok(reports)
    }

    /// This world's part in steps of a batch.
    pub(crate) fn world_step(&mut self, world: usize) -> WorldStep<'_> {
        WorldStep { world, time: self.time, couplings: &mut self.couplings, reports_bodies: self.reports_bodies }
    }

    /// Are reports to say where bodies are?
    pub(crate) fn reports_bodies(&self) -> bool {
        self.reports_bodies
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

    /// The length of the next steps under the scene's rule.
    fn choose(&mut self) -> Result<Chosen> {
        let scene = &self.plan.scene;
        let ground = self.engine.bound();
        let bound_until = |until: u64| {
            let steps = until - self.step;
            tighten(self.engine.bound_within(steps), &self.couplings, self.time, scene.world.cell, steps)
        };
        // Where tools or particles are about to be faster, fewer steps are chosen for: none is much shorter than it need be.
        let (next, mut stride) = (bound_until(self.step + 1).dt, self.engine.stride().max(1));
        let (until, bound) = loop {
            let until = (self.step / stride + 1) * stride;
            let bound = bound_until(until);
            if stride <= LEAST_STRIDE || bound.dt >= MOST_LOSS * next {
                break (until, bound);
            }
            stride /= 2;
        };
        let refuse = |dt: f64| Error::TimeStep { step: self.step, dt, bound: bound.dt, by: bound.by.clone() };
        let wanted = wanted_step(scene, &ground, &bound);
        let (dt, above, is_cut) = match scene.time.over_bound {
            _ if wanted <= bound.dt => (wanted, false, false),
            OverBound::Refuse => return Err(refuse(wanted)),
            OverBound::Substep => (cut(wanted, scene.time.safety * bound.dt), false, true),
            OverBound::Allow => (wanted, true, false),
        };
        // Time must not stand still, nor go astray.
        if !(self.time < self.time + dt && dt.is_finite()) {
            return Err(refuse(dt));
        }
        Ok(Chosen { dt, until, above, cut: is_cut })
    }

    fn begin_watch(&mut self) {
        if self.watch.is_none() {
            let ledger = self.ledger();
            self.watch = Some(Watch {
                step: self.step,
                inner: inner(&ledger),
                potential: ledger.potential,
                work: 0.0,
                exchanged: exchanged(&ledger),
            });
        }
    }

    /// Ends the run if, within [`WATCH_STEPS`] steps above the bound, energy of the ground grew more than [`WATCH_GROWTH`]-fold and neither
    /// falling nor the bodies that push it explain it. What bodies do to each other is no concern of the bound.
    fn judge_watch(&mut self, dt: f64) -> Result<()> {
        let Some(mut watch) = self.watch else { return Ok(()) };
        for (body, wrench) in self.bodies().iter().zip(self.wrenches()) {
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
        let fallen = watch.potential - ledger.potential;
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

/// Steps of `dt` in the time left to a stop.
fn parts(left: f64, dt: f64) -> f64 {
    (left / dt - ROUNDING).ceil().max(1.0)
}

/// What is wrong with an engine that gives neither a step nor an error.
pub(crate) fn no_step(backend: &str) -> Error {
    Error::Device {
        backend: backend.to_owned(),
        device: "this machine".to_owned(),
        what: "its engine took no step and did not say why".to_owned(),
        mend: "use another backend, and tell the author of this one".to_owned(),
    }
}

/// The length of equal steps of at most `dt` that land on a stop, if there is one; steps that divide the time left but for rounding keep
/// their bits.
fn landing(left: f64, dt: f64) -> f64 {
    let parts = parts(left, dt);
    if left.is_finite() && (left - parts * dt).abs() > ROUNDING * dt { left / parts } else { dt }
}

/// Says which bodies there are.
fn no_body(bodies: &[BodyState], name: &str) -> Error {
    let names: Vec<&str> = bodies.iter().map(|body| body.name.as_str()).collect();
    Error::Body {
        path: name.to_owned(),
        what: "no body has this name".to_owned(),
        mend: if names.is_empty() {
            "the scene has none".to_owned()
        } else {
            format!("there are {}", names.join(", "))
        },
    }
}

/// Kinetic and elastic energy of the ground; laws that give no elastic energy are left out.
fn inner(ledger: &Ledger) -> f64 {
    ledger.kinetic + if ledger.elastic.is_nan() { 0.0 } else { ledger.elastic }
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
        damped: ledger.damped,
        crossed: ledger.crossed,
        pressed: ledger.pressed,
        counts: ledger.counts,
        ..Ledger::default()
    }
}
