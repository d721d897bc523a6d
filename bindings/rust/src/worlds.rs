//! Many independent worlds, stepped together: what learners roll out.
//!
//! Each world has its own scene (so its own tools, parameters and random seed), its own time, actions and resets. World w of a batch is the
//! same world alone, bit for bit, when both take steps of the same length: worlds share nothing but the machine.
//!
//! ```
//! use barchan::worlds::Worlds;
//!
//! let mut worlds = Worlds::of(&barchan::registry(), &barchan::example(), 3, 0, &barchan::Options::default())?;
//! for reports in worlds.steps(5) {
//!     assert_eq!(reports?.len(), 5);
//! }
//! // All go on to the same time, and somebody may look in every tenth of a second.
//! let slice = std::time::Duration::from_millis(100);
//! while worlds.approach(&[0.05; 3], slice).into_iter().collect::<barchan::Result<Vec<bool>>>()?.contains(&false) {}
//! assert!(worlds.iter().all(|world| world.time() == 0.05));
//! // World 2 becomes a copy of world 0, and goes on as that one does.
//! worlds.fork(0, 2)?;
//! worlds.steps(5);
//! assert_eq!(worlds.world(2).particles(), worlds.world(0).particles());
//! worlds.reset(1, None)?;
//! assert_eq!(worlds.world(1).step_count(), 0);
//! # Ok::<(), barchan::Error>(())
//! ```

use barchan_core::task::{Seen, Watch};
use barchan_core::{
    Error, HeightScan, Options, Plan, Registry, Result, Scene, Simulation, State, StepReport, Together,
};
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Worlds of the same scene or of several.
///
/// On the processor whole worlds run side by side, each on one thread, as many at a time as there are threads: one world cut over all
/// threads waits for its slowest block at every pass, whole worlds never wait. Each takes its own steps. A world that is the only one has all threads.
///
/// On a backend that steps worlds together (`wgpu`), all take part in the same passes. Their steps are of the same length then, the least
/// that any of them would take alone; give scenes a fixed `time.step` if that should not depend on the others. Worlds may differ in
/// everything but cell width, extent, walls, gravity, levels, their materials' laws, their robots, how many tools go with these, and whether tools are sampled (meshes and
/// height fields; these may differ, too). Others are refused, by name.
#[derive(Debug)]
pub struct Worlds {
    registry: Registry,
    options: Options,
    scenes: Vec<Scene>,
    machine: Machine,
    pool: ThreadPool,
}

/// How worlds are stepped.
#[derive(Debug)]
enum Machine {
    /// Side by side, each on its own.
    Apart(Vec<Simulation>),
    /// In the same passes.
    Together(Together),
}

impl Machine {
    fn simulations(&self) -> &[Simulation] {
        match self {
            Self::Apart(simulations) => simulations,
            Self::Together(together) => together.worlds(),
        }
    }

    fn simulations_mut(&mut self) -> &mut [Simulation] {
        match self {
            Self::Apart(simulations) => simulations,
            Self::Together(together) => together.worlds_mut(),
        }
    }
}

impl Worlds {
    /// One world for each scene. `options.threads` is the number of worlds stepped at a time on the processor; 0: as many as the machine has
    /// threads.
    ///
    /// # Errors
    /// Those of [`Simulation::new`] for the first world that cannot be assembled; on a backend that steps worlds together, also if they
    /// differ in what they must have in common. [`Error::Io`] if the system gives no threads.
    pub fn new(registry: &Registry, scenes: Vec<Scene>, options: &Options) -> Result<Self> {
        options.check()?;
        let pool = ThreadPoolBuilder::new().num_threads(options.threads).build().map_err(|error| Error::Io {
            file: "threads".into(),
            what: "starting worker threads",
            source: std::io::Error::other(error),
        })?;
        let together = Together::new(registry, &scenes, options)?;
        // How many threads a world has changes no bit of it: one world has all of them.
        let threads = if scenes.len() == 1 { options.threads } else { 1 };
        let options = Options { threads, ..options.clone() };
        let apart = || -> Result<Vec<_>> {
            // Worlds are begun in their order, and none after the first that is refused.
            let refused = AtomicBool::new(false);
            let wanted = scenes.iter().take_while(|_| !refused.load(Ordering::Relaxed));
            let make = |scene: &Scene| {
                let made = Simulation::new(registry, scene, &options);
                made.inspect_err(|_| refused.store(true, Ordering::Relaxed))
            };
            side_by_side(&pool, wanted, make).into_iter().collect()
        };
        let machine = match together {
            Some(together) => Machine::Together(together),
            None => Machine::Apart(apart()?),
        };
        Ok(Self { registry: registry.clone(), options, scenes, machine, pool })
    }

    /// `count` worlds of one scene that differ in their random seeds: `seed`, `seed + 1`, …
    ///
    /// # Errors
    /// As [`new`](Self::new), and [`Error::Capacity`] for more than [`MOST_WORLDS`].
    pub fn of(registry: &Registry, scene: &Scene, count: usize, seed: u64, options: &Options) -> Result<Self> {
        check_count(count)?;
        let scenes = (0..count as u64).map(|world| Scene { seed: seed + world, ..scene.clone() }).collect();
        Self::new(registry, scenes, options)
    }

    /// Number of worlds.
    pub fn len(&self) -> usize {
        self.machine.simulations().len()
    }
    /// Are there none?
    pub fn is_empty(&self) -> bool {
        self.machine.simulations().is_empty()
    }
    /// Do they take part in the same passes, so that their steps are of the same length?
    pub fn are_together(&self) -> bool {
        matches!(self.machine, Machine::Together(_))
    }
    /// A world, to look at.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn world(&self, world: usize) -> &Simulation {
        &self.machine.simulations()[world]
    }
    /// A world, to act on: its bodies are driven through it. A step that is taken here moves this world only.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn world_mut(&mut self, world: usize) -> &mut Simulation {
        &mut self.machine.simulations_mut()[world]
    }
    /// All worlds in their order.
    pub fn iter(&self) -> impl Iterator<Item = &Simulation> {
        self.machine.simulations().iter()
    }

    /// One step of every world. A world that fails stays as it was and keeps its error; the others have taken their step.
    pub fn step(&mut self) -> Vec<Result<StepReport>> {
        let last = |reports: Vec<StepReport>| {
            reports.into_iter().next_back().expect("a simulation refuses an engine that takes no step")
        };
        match &mut self.machine {
            Machine::Apart(_) => self.each(Simulation::step),
            Machine::Together(together) => together.steps(1).into_iter().map(|reports| reports.map(last)).collect(),
        }
    }

    /// `count` steps of every world under the actions as they are, and what each did. A world that fails in one of them stays as it was
    /// before that step, and the others go on: it has taken fewer steps then, or says why if it has taken none. Asked again, it says why.
    pub fn steps(&mut self, count: usize) -> Vec<Result<Vec<StepReport>>> {
        match &mut self.machine {
            Machine::Apart(_) => self.each(|world| steps_of(world, count)),
            Machine::Together(together) => self.pool.install(|| steps_together(together, count)),
        }
    }

    /// Steps every world towards a time of its own [s], as many steps as go in about `within`, and says whether it is there. Its last step
    /// [ends there](Simulation::set_stop); where calls begin and end changes no bit.
    ///
    /// Where worlds [step together](Self::are_together), those that are there already wait for the others.
    ///
    /// # Panics
    /// If there are not as many times as worlds.
    pub fn approach(&mut self, until: &[f64], within: Duration) -> Vec<Result<bool>> {
        assert_eq!(until.len(), self.len(), "there is a time for each world");
        let begun = Instant::now();
        match &mut self.machine {
            Machine::Apart(simulations) => {
                let worlds = simulations.iter_mut().zip(until);
                side_by_side(&self.pool, worlds, |(world, until)| approach_of(world, *until, begun, within))
            }
            Machine::Together(together) => self.pool.install(|| {
                // What time is left, where rounding has kept steps from ending all at once, is not worth a step.
                let is_there = |world: &Simulation, until: f64| world.time() >= until - ROUNDING * until.abs();
                let mut results: Vec<Result<bool>> = until.iter().map(|_| Ok(false)).collect();
                loop {
                    for ((result, world), until) in results.iter_mut().zip(together.worlds()).zip(until) {
                        if let Ok(there) = result {
                            *there = is_there(world, *until);
                        }
                    }
                    let goes_on: Vec<bool> = results.iter().map(|result| matches!(result, Ok(false))).collect();
                    if !goes_on.contains(&true) || begun.elapsed() >= within {
                        return results;
                    }
                    for (w, world) in together.worlds_mut().iter_mut().enumerate().filter(|(w, _)| goes_on[*w]) {
                        world.set_stop(until[w]);
                    }
                    for (result, more) in results.iter_mut().zip(together.steps_of(MOST_AT_ONCE, |w| goes_on[w])) {
                        if let Err(error) = more {
                            *result = Err(error);
                        }
                    }
                }
            }),
        }
    }

    /// Runs `action` on every world and returns what it gave in the worlds' order. Worlds on the processor run side by side.
    pub fn each<R: Send>(&mut self, action: impl Fn(&mut Simulation) -> R + Send + Sync) -> Vec<R> {
        match &mut self.machine {
            Machine::Apart(simulations) => side_by_side(&self.pool, simulations, action),
            Machine::Together(together) => together.worlds_mut().iter_mut().map(action).collect(),
        }
    }

    /// Runs `action` on every world with what is given for it, side by side, and returns what it gave in the worlds' order.
    pub(crate) fn each_with<T: Send, R: Send>(
        &mut self,
        given: Vec<T>,
        action: impl Fn(&Simulation, T) -> R + Send + Sync,
    ) -> Vec<R> {
        let worlds = self.machine.simulations_mut().iter_mut();
        side_by_side(&self.pool, worlds.zip(given), |(world, given)| action(world, given))
    }

    /// Looks at every world for what is wanted of it ([`Simulation::watch`]), side by side on the processor.
    ///
    /// # Panics
    /// If there is not one for each world.
    pub fn watch(&mut self, watches: &[Watch]) -> Vec<Result<Seen>> {
        assert_eq!(watches.len(), self.len(), "there is one for each world");
        match &mut self.machine {
            Machine::Apart(simulations) => {
                side_by_side(&self.pool, simulations.iter_mut().zip(watches), |(world, watch)| world.watch(watch))
            }
            Machine::Together(together) => together.watch(watches),
        }
    }

    /// The [heights around a robot](Simulation::scan) in every world; worlds that step together take one transfer for it.
    ///
    /// # Errors
    /// Those of [`Simulation::scan`].
    pub fn scans(&mut self, robot: &str) -> Result<Vec<HeightScan>> {
        let scanned = self.iter().map(|world| world.scan_points(robot)).collect::<Result<Vec<_>>>()?;
        let watch = |(points, _): &(Vec<[f64; 2]>, f64)| Watch { heights: points.clone(), ..Watch::default() };
        let seen = self.watch(&scanned.iter().map(watch).collect::<Vec<_>>());
        let scan = |((points, base), seen): (_, Result<Seen>)| Ok(HeightScan::new(points, base, seen?.heights));
        scanned.into_iter().zip(seen).map(scan).collect()
    }

    /// [Heights of the soft ground](Simulation::heights) in every world, each at its own points [m]; worlds that step together take one transfer for them.
    ///
    /// # Errors
    /// Those of [`Simulation::heights`].
    ///
    /// # Panics
    /// If there is not one list of points for each world.
    pub fn heights(&mut self, points: Vec<Vec<[f64; 2]>>) -> Result<Vec<Vec<Option<f64>>>> {
        let watch = |heights| Watch { heights, only_soft: true, ..Watch::default() };
        let seen = self.watch(&points.into_iter().map(watch).collect::<Vec<_>>());
        seen.into_iter().map(|seen| Ok(seen?.heights)).collect()
    }

    /// Sets a world back to its start, or to the start of another scene.
    ///
    /// # Errors
    /// Those of [`Simulation::new`], and on a backend that steps worlds together those of [`new`](Self::new); the world is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn reset(&mut self, world: usize, scene: Option<Scene>) -> Result<()> {
        let scene = scene.unwrap_or_else(|| self.scenes[world].clone());
        self.reset_all(vec![(world, scene)]).map_err(|(_, error)| error)
    }

    /// Sets several worlds to the starts of scenes.
    ///
    /// # Errors
    /// Those of [`reset`](Self::reset), with the number of the world. All worlds are as they were where a scene is refused by itself; what a backend that steps worlds
    /// together refuses, or a device that is lost, leaves the worlds before that one at their new starts.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn reset_all(&mut self, scenes: Vec<(usize, Scene)>) -> Result<(), (usize, Error)> {
        let (registry, options, known) = (&self.registry, &self.options, &mut self.scenes);
        // What may be refused is made before any world goes; of the rest there is no room for both. One that is alone has nobody to wait for.
        let is_alone = scenes.len() == 1;
        let is_changed = |(world, scene): &(usize, Scene)| {
            !is_alone && {
                let as_before = Scene { seed: known[*world].seed, ..scene.clone() };
                known[*world].difference(&as_before).is_some()
            }
        };
        let changed: Vec<bool> = scenes.iter().map(is_changed).collect();
        match &mut self.machine {
            Machine::Apart(simulations) => {
                let new = |(world, scene): &(usize, Scene)| {
                    Simulation::new(registry, scene, options).map_err(|error| (*world, error))
                };
                let made = ahead(&scenes, &changed, new)?;
                for (one, made) in scenes.into_iter().zip(made) {
                    simulations[one.0] = made.map_or_else(|| new(&one), Ok)?;
                    known[one.0] = one.1;
                }
            }
            Machine::Together(together) => {
                let plan = |(world, scene): &(usize, Scene)| {
                    Plan::assemble(registry, scene, options).map_err(|error| (*world, error))
                };
                let planned = ahead(&scenes, &changed, plan)?;
                for (one, planned) in scenes.into_iter().zip(planned) {
                    let planned = planned.map_or_else(|| plan(&one), Ok)?;
                    together.replace(one.0, planned).map_err(|error| (one.0, error))?;
                    known[one.0] = one.1;
                }
            }
        }
        Ok(())
    }

    /// Lets worlds go on from states of their scenes, bit for bit; nothing is planned or seeded. Worlds that step together are laid out anew once for all. A state of a scene that
    /// differs in its random seed alone brings that seed along; this costs as much as a [reset](Self::reset).
    ///
    /// # Errors
    /// Those of [`Simulation::restore`]. If one is no state of its world's scene, all worlds are as they were.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn restore(&mut self, states: &[(usize, &State)]) -> Result<()> {
        let (registry, options) = (&self.registry, &self.options);
        match &mut self.machine {
            Machine::Apart(simulations) => {
                // Of all of them, before the first one goes back.
                states.iter().try_for_each(|(world, state)| simulations[*world].check_state(state))?;
                states.iter().try_for_each(|(world, state)| simulations[*world].restore(registry, state, options))?;
            }
            Machine::Together(together) => self.pool.install(|| together.restore(states, registry, options))?,
        }
        states.iter().for_each(|(world, state)| self.scenes[*world].seed = state.scene().seed);
        Ok(())
    }

    /// Puts a copy of one world in the place of another, scene and all: it goes on as the first one does, bit for bit, under the same actions and with
    /// steps of the same length. Nothing is planned, seeded or written.
    ///
    /// Where worlds step together (`wgpu`), particles are copied on the device; a batch lays all of its worlds out anew for that, as it does
    /// for a [reset](Self::reset), so that its cost grows with the batch. On the processor the copy goes through memory, as a
    /// [`State`].
    ///
    /// # Errors
    /// If the first has been swapped to another engine and stepped beside its batch, or a device was lost. The other world is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn fork(&mut self, from: usize, to: usize) -> Result<()> {
        match &mut self.machine {
            Machine::Apart(simulations) if from != to => {
                let state = simulations[from].state()?;
                let own = &mut simulations[to];
                if own.is_of(&state) && own.backend() == self.options.backend {
                    own.set_state(&state)?;
                } else {
                    *own = Simulation::from_state(&self.registry, &state, &self.options)?;
                }
            }
            Machine::Apart(simulations) => assert!(from < simulations.len(), "there is no world {from}"),
            Machine::Together(together) => together.fork(from, to, &self.registry)?,
        }
        self.scenes[to] = self.scenes[from].clone();
        Ok(())
    }
}

/// Most worlds that are made of a number.
pub const MOST_WORLDS: usize = 1 << 16;

/// May there be so many worlds?
///
/// # Errors
/// [`Error::Capacity`] for more than [`MOST_WORLDS`].
pub fn check_count(worlds: usize) -> Result<()> {
    if worlds <= MOST_WORLDS {
        return Ok(());
    }
    let mend = "take fewer worlds, in several processes if need be";
    Err(Error::Capacity { what: "worlds", asked: worlds as u64, cap: MOST_WORLDS as u64, mend })
}

/// Does `work` on every item, one on each thread of a pool at a time, and returns what it gave in the items' order.
///
/// Each thread has one task, which takes up one item after the other. A thread of a pool that waits, for an engine's own thread or within a device's work, takes up the pool's
/// next task meanwhile: were every item one, worlds would be stepped inside the calls for others, and with hundreds of them the stack would be full.
fn side_by_side<T: Send, R: Send>(
    pool: &ThreadPool,
    items: impl IntoIterator<Item = T, IntoIter: Send>,
    work: impl Fn(T) -> R + Sync,
) -> Vec<R> {
    let items = items.into_iter();
    if pool.current_num_threads() == 1 || items.size_hint().1.is_some_and(|most| most <= 1) {
        return items.map(work).collect();
    }
    let items = Mutex::new(items.enumerate());
    // Locked for the item alone, not while it is worked on.
    let next = || items.lock().unwrap_or_else(PoisonError::into_inner).next();
    let share = || std::iter::from_fn(next).map(|(place, item)| (place, work(item))).collect::<Vec<_>>();
    let mut done: Vec<(usize, R)> = pool.broadcast(|_| share()).into_iter().flatten().collect();
    done.sort_unstable_by_key(|(place, _)| *place);
    done.into_iter().map(|(_, result)| result).collect()
}

/// What is made of those scenes that are `changed`, unless one is refused; nothing yet of the others.
fn ahead<T>(
    scenes: &[(usize, Scene)],
    changed: &[bool],
    make: impl Fn(&(usize, Scene)) -> Result<T, (usize, Error)>,
) -> Result<Vec<Option<T>>, (usize, Error)> {
    scenes.iter().zip(changed).map(|(one, changed)| changed.then(|| make(one)).transpose()).collect()
}

/// Most steps that a device is asked for at once.
const MOST_AT_ONCE: usize = 1 << 10;
/// Times that are nearer than this part of themselves are one.
const ROUNDING: f64 = 1e-12;

/// Steps of a world that is on its own.
fn approach_of(world: &mut Simulation, until: f64, begun: Instant, within: Duration) -> Result<bool> {
    while world.time() < until && begun.elapsed() < within {
        world.set_stop(until);
        world.steps(MOST_AT_ONCE, until)?;
    }
    Ok(world.time() >= until)
}

/// Up to `count` steps of a world that is on its own.
fn steps_of(world: &mut Simulation, count: usize) -> Result<Vec<StepReport>> {
    let mut reports = Vec::new();
    while reports.len() < count {
        match world.steps(count - reports.len(), f64::INFINITY) {
            Ok(more) => reports.extend(more),
            Err(error) if reports.is_empty() => return Err(error),
            Err(_) => break,
        }
    }
    Ok(reports)
}

/// Up to `count` steps of worlds that step together.
fn steps_together(together: &mut Together, count: usize) -> Vec<Result<Vec<StepReport>>> {
    let mut all: Vec<Result<Vec<StepReport>>> = together.worlds().iter().map(|_| Ok(Vec::new())).collect();
    let mut taken = 0;
    while taken < count {
        let more = together.steps(count - taken);
        // All that succeed take the same steps.
        let Some(steps) = more.iter().flatten().map(Vec::len).max() else {
            // What is wrong is found again when they are asked again.
            return if taken == 0 { more } else { all };
        };
        for (before, more) in all.iter_mut().zip(more) {
            match (&mut *before, more) {
                (Ok(before), Ok(more)) => before.extend(more),
                (Ok(reports), Err(error)) if reports.is_empty() => *before = Err(error),
                _ => {}
            }
        }
        taken += steps;
    }
    all
}
