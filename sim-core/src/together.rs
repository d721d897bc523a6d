//! Worlds that a backend steps together.

use crate::backend::{Batch, Look, NewWorld};
use crate::plan::Assembly;
use crate::simulation::{WantedSteps, find_backend, no_step};
use crate::task::{Seen, Watch};
use crate::{Coupling, Error, Options, Plan, Registry, Result, Scene, Simulation, State, StepReport};
use std::fmt;
use std::sync::Arc;

/// Simulations whose engines are the worlds of one batch.
///
/// Each is a simulation like any other, with its own time, bodies and ledger, but their steps are taken together and are of the same length:
/// the least that any of them would take alone.
pub struct Together {
    batch: Box<dyn Batch>,
    backend: String,
    worlds: Vec<Simulation>,
}

impl fmt::Debug for Together {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Together").field("backend", &self.backend).field("worlds", &self.worlds).finish_non_exhaustive()
    }
}

impl Together {
    /// Assembles and compiles one world for each scene; `None` if there are none, or if the backend does not step worlds together.
    ///
    /// # Errors
    /// Those of [`Simulation::new`] for the first world that cannot be assembled, and of [`crate::Backend::compile_batch`].
    pub fn new(registry: &Registry, scenes: &[Scene], options: &Options) -> Result<Option<Self>> {
        let backend = find_backend(registry, options)?;
        if scenes.is_empty() || !backend.has_batches() {
            return Ok(None);
        }
        let assembled =
            scenes.iter().map(|scene| Plan::assemble(registry, scene, options)).collect::<Result<Vec<_>>>()?;
        let (mut plans, mut states) = (Vec::new(), Vec::new());
        for (plan, particles, couplings) in assembled {
            plans.push((plan, couplings));
            states.push(particles);
        }
        let new =
            plans.iter().zip(states).map(|((plan, couplings), particles)| NewWorld { plan, particles, couplings });
        let batch = backend.compile_batch(new.collect())?;
        let worlds = plans.into_iter().enumerate().map(|(world, (plan, couplings))| {
            Simulation::in_batch(plan, backend.name(), batch.engine(world), couplings)
        });
        let worlds = worlds.collect();
        Ok(Some(Self { batch, backend: backend.name().to_owned(), worlds }))
    }

    /// The worlds in their order.
    pub fn worlds(&self) -> &[Simulation] {
        &self.worlds
    }

    /// The worlds, to act on. One that is stepped here goes alone, and one that is [swapped](Simulation::swap) to another engine goes
    /// on beside the batch.
    pub fn worlds_mut(&mut self) -> &mut [Simulation] {
        &mut self.worlds
    }

    /// Up to `most` steps of every world, the same number and of the same length for all that succeed. A world that fails stays as it was and
    /// says why; the others have taken their steps.
    pub fn steps(&mut self, most: usize) -> Vec<Result<Vec<StepReport>>> {
        self.steps_of(most, |_| true)
    }

    /// [`steps`](Self::steps) of the worlds that go on. The others stay as they are, have no reports, and do not shorten the others' steps.
    pub fn steps_of(&mut self, most: usize, goes_on: impl Fn(usize) -> bool) -> Vec<Result<Vec<StepReport>>> {
        let mut results: Vec<Option<Result<Vec<StepReport>>>> = Vec::new();
        let mut all_wanted = Vec::new();
        for (w, world) in self.worlds.iter_mut().enumerate() {
            if !goes_on(w) {
                results.push(Some(Ok(Vec::new())));
                continue;
            }
            let wanted = if world.is_in_batch() { world.wanted(most, f64::INFINITY).map(Some) } else { Ok(None) };
            results.push(match wanted {
                Ok(Some(wanted)) => {
                    all_wanted.push((w, wanted));
                    None
                }
                Ok(None) => Some(world.step().map(|report| vec![report])),
                Err(error) => Some(Err(error)),
            });
        }
        for (w, result) in self.take(&all_wanted) {
            results[w] = Some(result);
        }
        results
            .into_iter()
            .map(|result| {
                result.expect("a world that wants no steps has its result, and `take` gives one for each other")
            })
            .collect()
    }

    /// Takes the steps that all worlds want.
    fn take(&mut self, all_wanted: &[(usize, WantedSteps)]) -> Vec<(usize, Result<Vec<StepReport>>)> {
        let dt = all_wanted.iter().fold(f64::INFINITY, |least, (_, wanted)| least.min(wanted.dt));
        let count = all_wanted.iter().fold(usize::MAX, |least, (_, wanted)| least.min(wanted.count));
        // A stop is reached by steps of the length that was chosen for it.
        let common = |wanted: &WantedSteps| WantedSteps {
            dt,
            to_stop: if wanted.dt == dt { wanted.to_stop } else { usize::MAX },
            ..*wanted
        };
        let before: Vec<_> = all_wanted.iter().map(|(w, wanted)| self.worlds[*w].begin(wanted)).collect();
        let going = |w: usize| all_wanted.iter().any(|wanted| wanted.0 == w);
        let worlds = self.worlds.iter_mut().enumerate().filter(|(w, _)| going(*w));
        let mut world_steps: Vec<_> = worlds.map(|(w, world)| world.world_step(w)).collect();
        if world_steps.is_empty() {
            return Vec::new();
        }
        let results = self
            .batch
            .steps(dt, count, &mut world_steps)
            .unwrap_or_else(|error| all_failed(&self.backend, error, all_wanted.len()));
        let results = results.into_iter().chain(std::iter::repeat_with(|| Err(no_step(&self.backend))));
        let taken = all_wanted.iter().zip(before).zip(results);
        taken
            .map(|(((w, wanted), before), result)| (*w, self.worlds[*w].finish(&common(wanted), before, result)))
            .collect()
    }

    /// Lets worlds go on from states, as [`Simulation::restore`] does one of them. Those of their own scenes are laid out anew once for all; one with another seed is put
    /// in its place behind them.
    ///
    /// # Errors
    /// Those of [`Simulation::restore`], and of [`Batch::replace`]; the world is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn restore(&mut self, states: &[(usize, &State)], registry: &Registry, options: &Options) -> Result<()> {
        let (others, own): (Vec<_>, Vec<_>) =
            states.iter().copied().partition(|(world, state)| self.worlds[*world].is_seeded_otherwise(state));
        self.set_states(&own)?;
        others.into_iter().try_for_each(|(world, state)| self.replace_by(world, registry, state, options))
    }

    /// Lets worlds go on from states of their scenes; on an error all worlds of the batch are as they were.
    fn set_states(&mut self, states: &[(usize, &State)]) -> Result<()> {
        let mut before = Vec::new();
        let mut particles = Vec::new();
        let mut taken = Ok(());
        for &(w, state) in states {
            let world = &mut self.worlds[w];
            match world.take_couplings(state) {
                Ok(saved) => before.push((w, saved)),
                Err(error) => {
                    taken = Err(error);
                    break;
                }
            }
            if world.is_in_batch() {
                particles.push((w, world.particles_of(state)));
            }
        }
        if let Err(error) = taken.and_then(|()| self.batch.upload(particles)) {
            before.iter().try_for_each(|(w, saved)| self.worlds[*w].put_back(saved))?;
            return Err(error);
        }
        for &(w, state) in states {
            let world = &mut self.worlds[w];
            if world.is_in_batch() { world.take_rest(state) } else { world.set_state(state)? }
        }
        Ok(())
    }

    /// Looks at every world for what is wanted of it.
    ///
    /// # Panics
    /// If there is not one for each world.
    pub fn watch(&mut self, watches: &[Watch]) -> Vec<Result<Seen>> {
        assert_eq!(watches.len(), self.worlds.len(), "there is one for each world");
        if !self.worlds.iter().all(Simulation::is_in_batch) {
            return self.worlds.iter().zip(watches).map(|(world, watch)| world.watch(watch)).collect();
        }
        let pairs = self.worlds.iter().zip(watches);
        let looks: Vec<Look<'_>> = pairs.map(|(world, watch)| Look::new(world.plan(), watch)).collect();
        match self.batch.look(&looks) {
            Ok(looked) => {
                let each = looked.into_iter().zip(self.worlds.iter().zip(watches));
                each.map(|(looked, (world, watch))| world.seen(watch, looked)).collect()
            }
            Err(error) => all_failed(&self.backend, error, watches.len()),
        }
    }

    /// Puts a world at the start of a scene, in the place of another.
    ///
    /// # Errors
    /// Those of [`Batch::replace`]; the world is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn replace(&mut self, world: usize, new: Assembly) -> Result<()> {
        let (plan, particles, couplings) = new;
        self.batch.replace(world, NewWorld { plan: &plan, particles, couplings: &couplings })?;
        self.put(world, plan, couplings);
        Ok(())
    }

    /// Puts a world that goes on from a state in the place of another, scene and all, as [`Simulation::from_state`] makes one.
    fn replace_by(&mut self, world: usize, registry: &Registry, state: &State, options: &Options) -> Result<()> {
        let own = Some(&self.worlds[world].plan().scene);
        let (plan, couplings) = state.prepared(registry, find_backend(registry, options)?, options, own)?;
        let particles = state.particles_for(&self.backend);
        self.batch.replace(world, NewWorld { plan: &plan, particles, couplings: &couplings })?;
        self.put(world, Arc::unwrap_or_clone(plan), couplings);
        self.worlds[world].take_rest(state);
        Ok(())
    }

    /// A new simulation for a world of the batch.
    fn put(&mut self, world: usize, plan: Plan, couplings: Vec<Box<dyn Coupling>>) {
        let mut new = Simulation::in_batch(plan, &self.backend, self.batch.engine(world), couplings);
        new.report_bodies(self.worlds[world].reports_bodies());
        self.worlds[world] = new;
    }

    /// Puts a copy of one world in the place of another, scene and all: it goes on as the first one does.
    ///
    /// # Errors
    /// [`Error::Body`] if the first has been swapped to another engine, and those of [`Batch::copy`]; the other is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn fork(&mut self, from: usize, to: usize, registry: &Registry) -> Result<()> {
        let source = &self.worlds[from];
        if !source.is_in_batch() {
            return Err(Error::Body {
                path: format!("world {from}"),
                what: format!("it has been swapped to '{}' and steps beside the batch", source.backend()),
                mend: "copy it by Simulation::state and Simulation::from_state".to_owned(),
            });
        }
        if from == to {
            return Ok(());
        }
        let copy = source.copy(registry, self.batch.engine(to))?;
        self.batch.copy(from, to, source.plan())?;
        self.worlds[to] = copy;
        Ok(())
    }
}

/// An error of all worlds.
fn all_failed<T>(backend: &str, error: Error, count: usize) -> Vec<Result<T>> {
    let text = error.to_string();
    let same = |_| {
        Err(Error::Device {
            backend: backend.to_owned(),
            device: "the device that worlds share".to_owned(),
            what: text.clone(),
            mend: "resume from the last snapshots".to_owned(),
        })
    };
    let others: Vec<_> = (1..count).map(same).collect();
    std::iter::once(Err(error)).chain(others).collect()
}
