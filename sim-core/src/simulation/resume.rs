//! States of a simulation, in memory and in files: one form for going back, for copies and for snapshots.

use super::{Chosen, Options, Simulation, find_backend};
use crate::file::{Stamp, changed};
use crate::flow::FlowState;
use crate::plan::PARTICLES;
use crate::snapshot::{self, Snapshot};
use crate::{Backend, Coupling, Error, Ledger, ParticleState, Plan, Precision, Registry, Result, Scene, Wrench};
use std::fmt;
use std::path::Path;
use std::sync::Arc;

/// Everything that a simulation goes on from, bit for bit: a copy in memory.
///
/// [`Simulation::state`] takes it, [`Simulation::set_state`] goes back to it, [`Simulation::from_state`] makes another simulation of it,
/// and a snapshot is the same in a file ([`State::save`]). It takes as much memory as the particles in f64: about 300 bytes each, and a clone as much again.
#[derive(Clone)]
pub struct State {
    pub(super) plan: Arc<Plan>,
    pub(super) moment: Moment,
}

impl fmt::Debug for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("State")
            .field("scene", &self.plan.scene.name)
            .field("time", &self.moment.time)
            .field("step", &self.moment.step)
            .finish_non_exhaustive()
    }
}

/// What a state holds besides the scene.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Moment {
    pub(crate) precision: Precision,
    /// Name of the backend whose phase of the sort it holds.
    pub(crate) backend: String,
    pub(crate) time: f64,
    pub(crate) step: u64,
    pub(crate) stop: Option<f64>,
    /// The length of the next steps.
    pub(crate) chosen: Option<Chosen>,
    pub(crate) cut_steps: u64,
    /// Mean wrenches over the last step, if couplings do not know them.
    pub(crate) wrenches: Option<Vec<Wrench>>,
    /// What sources and sinks have done.
    pub(crate) flow: FlowState,
    /// Ledger entries that add up over time.
    pub(crate) carried: Ledger,
    pub(crate) particles: ParticleState,
    /// Name and bytes of each coupling.
    pub(crate) couplings: Saved,
}

impl Moment {
    /// A phase of the sort is of use to the backend alone that has it.
    fn particles_for(&self, backend: &str) -> ParticleState {
        let mut particles = self.particles.clone();
        if !self.backend.is_empty() && self.backend != backend {
            (particles.sort, particles.kept) = (None, None);
        }
        particles
    }
}

/// What to do with a state of another scene.
const OTHER_SCENE: &str =
    "make a simulation of the state's scene and restore it there (in Rust, Simulation::from_state makes one)";

/// The plan and the couplings of a simulation that goes on from a state.
type Prepared = (Arc<Plan>, Vec<Box<dyn Coupling>>);

impl State {
    /// Simulated seconds.
    pub fn time(&self) -> f64 {
        self.moment.time
    }
    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.moment.step
    }
    /// The scene that it is a state of.
    pub fn scene(&self) -> &Scene {
        &self.plan.scene
    }
    /// Its particles: one list a level and material, in f64.
    pub fn particles(&self) -> &ParticleState {
        &self.moment.particles
    }

    /// The plan and the couplings of a simulation that goes on from it; in the words of `own`, if it takes the place of that scene's.
    pub(crate) fn prepared(
        &self,
        registry: &Registry,
        backend: &dyn Backend,
        options: &Options,
        own: Option<&Scene>,
    ) -> Result<Prepared> {
        options.check()?;
        let moment = &self.moment;
        if moment.precision != options.precision {
            let what = format!("the state is in {}, and {} is asked for", moment.precision, options.precision);
            return Err(unfit(what, "ask for the same precision, and swap then"));
        }
        let mut plan = Arc::clone(&self.plan);
        if plan.threads != options.threads || plan.adapter != options.adapter {
            let (threads, adapter) = (options.threads, options.adapter.clone());
            plan = Arc::new(Plan { threads, adapter, ..(*plan).clone() });
        }
        if let Some(own) = own {
            plan = Arc::new(Plan { scene: plan.scene.in_words_of(own), ..(*plan).clone() });
        }
        plan.check_forms(backend)?;
        let mut couplings = plan.make_couplings(registry)?;
        restore(&mut couplings, &moment.couplings).map_err(|(what, mend)| unfit(what, mend))?;
        Ok((plan, couplings))
    }

    /// The particles, as an engine of a backend takes them.
    pub(crate) fn particles_for(&self, backend: &str) -> ParticleState {
        self.moment.particles_for(backend)
    }

    /// Writes a snapshot: to a temporary file beside `path`, then renamed.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be written; an older file of that name is intact then.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let scene = &self.plan.scene;
        // Absolute, so that a run can be resumed from another folder.
        let folder = std::env::current_dir().map_or_else(|_| scene.folder.clone(), |here| here.join(&scene.folder));
        let (files, set) = (self.plan.files.clone(), scene.overrides().to_vec());
        snapshot::write(path.as_ref(), scene.to_toml()?, folder, set, files, &self.moment)
    }
}

impl Simulation {
    /// A copy of all that the simulation goes on from, in memory.
    ///
    /// # Errors
    /// [`Error::Device`] if the particles were lost with their device.
    pub fn state(&self) -> Result<State> {
        let carried = self.sums();
        let particles = self.engine.state();
        self.engine.check()?;
        let moment = Moment {
            precision: self.plan.precision,
            backend: self.backend.clone(),
            time: self.time,
            step: self.step,
            stop: self.stop.is_finite().then_some(self.stop),
            chosen: self.chosen,
            cut_steps: self.cut_steps,
            wrenches: self.wrenches.clone(),
            flow: self.flow.clone(),
            carried,
            particles,
            couplings: self.couplings.iter().map(|c| (c.name().to_owned(), c.save())).collect(),
        };
        Ok(State { plan: Arc::clone(&self.plan), moment })
    }

    /// Goes on from a state of the same scene: an earlier one of its own, or another simulation's. What follows is bit for bit what followed there
    /// if backend and machine are the same; another backend sorts the particles anew. Nothing is planned or seeded. Particles go through the host's memory.
    /// Names and what is written and drawn (`name`, `doc`, `output`) may differ, and when the scene ends: these stay its own.
    ///
    /// # Errors
    /// [`Error::Body`] if it is a state of another scene or number format, or of couplings of another version; everything is as before then.
    pub fn set_state(&mut self, state: &State) -> Result<()> {
        let before = self.take_couplings(state)?;
        if let Err(error) = self.engine.upload(self.particles_of(state)) {
            self.put_back(&before)?;
            return Err(error);
        }
        self.take_rest(state);
        Ok(())
    }

    /// Goes on from a state of the same scene by [`set_state`](Self::set_state), or, by [`from_state`](Self::from_state), from one of a scene with another random seed, which it
    /// takes over.
    ///
    /// # Errors
    /// Those of the two; everything is as before then.
    pub fn restore(&mut self, registry: &Registry, state: &State, options: &Options) -> Result<()> {
        if !self.is_seeded_otherwise(state) {
            return self.set_state(state);
        }
        let mut other = Self::from_state_as(registry, state, options, Some(&self.plan.scene))?;
        other.report_bodies(self.reports_bodies());
        *self = other;
        Ok(())
    }

    /// Is it a state that [`restore`](Self::restore) takes? Nothing is changed.
    ///
    /// # Errors
    /// [`Error::Body`] if it is one of another scene or number format.
    pub fn check_state(&self, state: &State) -> Result<()> {
        match self.differs(state).filter(|_| !self.is_seeded_otherwise(state)) {
            Some(what) => Err(unfit(what, OTHER_SCENE)),
            None => Ok(()),
        }
    }

    /// First, couplings as a state has them; returns what they were.
    pub(crate) fn take_couplings(&mut self, state: &State) -> Result<Saved> {
        if let Some(what) = self.differs(state) {
            return Err(unfit(what, OTHER_SCENE));
        }
        let before: Saved = self.couplings.iter().map(|c| (c.name().to_owned(), c.save())).collect();
        if let Err((what, mend)) = restore(&mut self.couplings, &state.moment.couplings) {
            self.put_back(&before)?;
            return Err(unfit(what, mend));
        }
        Ok(before)
    }

    /// The state's particles, as the engine takes them.
    pub(crate) fn particles_of(&self, state: &State) -> ParticleState {
        state.particles_for(&self.backend)
    }

    /// Couplings as they were.
    pub(crate) fn put_back(&mut self, before: &Saved) -> Result<()> {
        restore(&mut self.couplings, before).map_err(|(what, mend)| unfit(what, mend))
    }

    /// Last, once the engine has the particles, all else.
    pub(crate) fn take_rest(&mut self, state: &State) {
        self.engine.carry_on(&state.moment.carried);
        self.take_up(&state.moment);
    }

    /// Is it a state of the same scene, to the last word, in the same number format?
    pub fn is_of(&self, state: &State) -> bool {
        self.differs(state).is_none() && self.plan.scene.difference(&state.plan.scene).is_none()
    }

    /// Is it a state of a scene with another random seed, and the same in all else?
    pub(crate) fn is_seeded_otherwise(&self, state: &State) -> bool {
        let (seed, theirs) = (self.plan.scene.seed, &state.plan.scene);
        seed != theirs.seed && self.differs_as(state, &Scene { seed, ..theirs.clone() }).is_none()
    }

    /// In what the scene and the number format of a state are others than ours.
    fn differs(&self, state: &State) -> Option<String> {
        if Arc::ptr_eq(&self.plan, &state.plan) {
            return None;
        }
        // What is more than a seed is told first.
        let seeded = Scene { seed: self.plan.scene.seed, ..state.plan.scene.clone() };
        self.differs_as(state, &seeded).or_else(|| self.differs_as(state, &state.plan.scene))
    }

    /// The same, were the state one of `scene`.
    fn differs_as(&self, state: &State, scene: &Scene) -> Option<String> {
        let (ours, theirs) = (&*self.plan, &*state.plan);
        if ours.precision != theirs.precision {
            return Some(format!("it is in {}, and this simulation in {}", theirs.precision, ours.precision));
        }
        // What files held counts, not where they are.
        if ours.files != theirs.files {
            let (ours, theirs) = (listed(&ours.files), listed(&theirs.files));
            let what = if ours == theirs {
                "other contents".to_owned()
            } else {
                format!("[{theirs}] there and [{ours}] here")
            };
            return Some(format!("it is of a scene that reads other files: {what}"));
        }
        let (path, [here, there]) = ours.scene.difference(&scene.in_words_of(&ours.scene))?;
        Some(format!("it is of another scene: {path} is {there} there and {here} here"))
    }

    /// Another simulation that goes on from a state, as the one that it was taken of: bit for bit with the same backend on the same machine. The plan
    /// is the state's, with the threads and the adapter of the options; nothing is planned or seeded anew.
    ///
    /// # Errors
    /// [`Error::Body`] if another number format is asked for; those of the backend and of couplings that are made from the scene.
    pub fn from_state(registry: &Registry, state: &State, options: &Options) -> Result<Self> {
        Self::from_state_as(registry, state, options, None)
    }

    /// The same, in the words of another scene.
    fn from_state_as(registry: &Registry, state: &State, options: &Options, own: Option<&Scene>) -> Result<Self> {
        let backend = find_backend(registry, options)?;
        let (plan, couplings) = state.prepared(registry, backend, options, own)?;
        let moment = &state.moment;
        let mut engine = backend.compile(&plan, moment.particles_for(backend.name()))?;
        engine.carry_on(&moment.carried);
        let mut simulation = Self::start(plan, backend.name(), engine, couplings);
        simulation.take_up(moment);
        Ok(simulation)
    }

    /// Continues from a snapshot, bit for bit if backend and machine are the same; another backend sorts the particles anew. The number format is the snapshot's;
    /// asking for another is an error.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the file cannot be used, and those of [`new`](Self::new).
    pub fn resume(registry: &Registry, path: impl AsRef<Path>, options: &Options) -> Result<Self> {
        let path = path.as_ref();
        let snapshot = Snapshot::read(path)?;
        let refuse = |what: String, mend: &str| Error::Snapshot { file: path.to_owned(), what, mend: mend.to_owned() };
        if let Some(what) = snapshot.unsound_clock() {
            return Err(refuse(what, "the file is damaged: resume from an earlier snapshot"));
        }
        let Snapshot { scene, folder, set, files, moment } = snapshot;
        if moment.precision != options.precision {
            return Err(refuse(
                format!("was written by a run in {}, and {} is asked for", moment.precision, options.precision),
                "resume with the same precision",
            ));
        }
        let backend = find_backend(registry, options)?;
        let mut scene = Scene::from_str(&scene, &path.display().to_string(), &folder)?;
        scene.note_overrides(set);
        if let Some(file) = changed(&scene.folder, &files)? {
            return Err(refuse(
                format!("continues a scene whose file {} has changed since the run began", file.display()),
                "put the file back as it was, or start a new run",
            ));
        }
        let particles = moment.particles_for(backend.name());
        let assembled = Plan::assemble_with(registry, &scene, options, Some(particles));
        let (plan, particles, mut couplings) = assembled.map_err(|error| match error {
            Error::Body { path, what, .. } if path == PARTICLES => {
                refuse(format!("holds particles that do not fit its scene: {what}"), "resume from another snapshot")
            }
            other => other,
        })?;
        restore(&mut couplings, &moment.couplings).map_err(|(what, mend)| refuse(what, mend))?;
        let mut engine = backend.compile(&plan, particles)?;
        engine.carry_on(&moment.carried);
        let mut simulation = Self::start(Arc::new(plan), backend.name(), engine, couplings);
        simulation.take_up(&moment);
        Ok(simulation)
    }

    /// Writes everything needed to continue: to a temporary file beside `path`, then renamed.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be written, [`Error::Device`] if the particles were lost with their device; an older file of that name is
    /// intact then.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        self.state()?.save(path)
    }

    /// A copy in a batch, with an engine that goes on from the particles that this one's has.
    pub(crate) fn copy(&self, registry: &Registry, engine: Box<dyn crate::Engine>) -> Result<Self> {
        let mut couplings = self.plan.make_couplings(registry)?;
        let saved: Vec<_> = self.couplings.iter().map(|c| (c.name().to_owned(), c.save())).collect();
        restore(&mut couplings, &saved).map_err(|(what, mend)| unfit(what, mend))?;
        Ok(Self {
            time: self.time,
            step: self.step,
            stop: self.stop,
            chosen: self.chosen,
            carried: self.carried.clone(),
            cut_steps: self.cut_steps,
            watch: self.watch,
            wrenches: self.wrenches.clone(),
            flow: self.flow.clone(),
            reports_bodies: self.reports_bodies,
            in_batch: true,
            ..Self::start(Arc::clone(&self.plan), &self.backend, engine, couplings)
        })
    }

    /// Takes up what neither the engine nor the couplings hold.
    fn take_up(&mut self, moment: &Moment) {
        (self.time, self.step) = (moment.time, moment.step);
        self.stop = moment.stop.unwrap_or(f64::INFINITY);
        self.chosen = moment.chosen;
        self.cut_steps = moment.cut_steps;
        self.wrenches.clone_from(&moment.wrenches);
        self.flow.clone_from(&moment.flow);
        self.carried.clone_from(&moment.carried.counts);
        self.watch = None;
    }
}

/// Names of files, one behind the other.
fn listed(files: &[Stamp]) -> String {
    files.iter().map(|stamp| stamp.file.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// What couplings have saved, by their names.
pub(crate) type Saved = Vec<(String, Vec<u8>)>;

/// Why couplings cannot be restored, and what would mend it.
type Unfit = (String, &'static str);

/// Gives saved bytes back to couplings of the same names.
fn restore(couplings: &mut [Box<dyn Coupling>], saved: &[(String, Vec<u8>)]) -> Result<(), Unfit> {
    let list = |names: Vec<&str>| names.join(", ");
    let (ours, theirs): (Vec<_>, Vec<_>) =
        (couplings.iter().map(|c| c.name()).collect(), saved.iter().map(|(name, _)| name.as_str()).collect());
    if ours != theirs {
        let what = format!("holds couplings [{}], its scene makes [{}]", list(theirs), list(ours));
        return Err((what, "resume with the plugins of the first run"));
    }
    for (coupling, (name, bytes)) in couplings.iter_mut().zip(saved) {
        let restored = coupling.restore(bytes);
        restored.map_err(|what| (format!("coupling '{name}': {what}"), "resume with the version that wrote it"))?;
    }
    Ok(())
}

fn unfit(what: String, mend: &str) -> Error {
    Error::Body { path: "state".to_owned(), what, mend: mend.to_owned() }
}
