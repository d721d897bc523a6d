//! Many independent worlds, stepped together: what learners roll out.
//!
//! Each world has its own scene (so its own tools, parameters and random seed), its own time, actions and resets. World w of a batch is the
//! same world alone, bit for bit: worlds share nothing but the machine.

use barchan_core::{Options, Registry, Result, Scene, Simulation, StepReport};
use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// Worlds on the processor: each is stepped by one thread, as many at a time as there are threads.
///
/// One world cut over all threads waits for its slowest block at every pass; whole worlds side by side never wait. A backend on a GPU
/// runs them too, but not batched: each has a device to itself.
#[derive(Debug)]
pub struct Worlds {
    registry: Registry,
    options: Options,
    scenes: Vec<Scene>,
    simulations: Vec<Simulation>,
    pool: ThreadPool,
}

impl Worlds {
    /// One world for each scene. `options.threads` is the number of worlds stepped at a time; 0: as many as the machine has threads.
    ///
    /// # Errors
    /// Those of [`Simulation::new`] for the first world that cannot be assembled.
    ///
    /// # Panics
    /// If the system gives no threads.
    pub fn new(registry: &Registry, scenes: Vec<Scene>, options: &Options) -> Result<Self> {
        let pool = ThreadPoolBuilder::new().num_threads(options.threads).build().expect("worker threads start");
        // How many threads a world has changes no bit of it.
        let options = Options { threads: 1, ..options.clone() };
        let make = |scene: &Scene| Simulation::new(registry, scene, &options);
        let simulations = pool.install(|| scenes.par_iter().map(make).collect::<Result<Vec<_>>>())?;
        Ok(Self { registry: registry.clone(), options, scenes, simulations, pool })
    }

    /// `count` worlds of one scene that differ in their random seeds: `seed`, `seed + 1`, …
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn of(registry: &Registry, scene: &Scene, count: usize, seed: u64, options: &Options) -> Result<Self> {
        let scenes = (0..count as u64).map(|world| Scene { seed: seed + world, ..scene.clone() }).collect();
        Self::new(registry, scenes, options)
    }

    /// Number of worlds.
    pub fn len(&self) -> usize {
        self.simulations.len()
    }
    /// Are there none?
    pub fn is_empty(&self) -> bool {
        self.simulations.is_empty()
    }
    /// A world, to look at.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn world(&self, world: usize) -> &Simulation {
        &self.simulations[world]
    }
    /// A world, to act on: its bodies are driven through it.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn world_mut(&mut self, world: usize) -> &mut Simulation {
        &mut self.simulations[world]
    }
    /// All worlds in their order.
    pub fn iter(&self) -> impl Iterator<Item = &Simulation> {
        self.simulations.iter()
    }

    /// One step of every world. A world that fails stays as it was and keeps its error; the others have taken their step.
    pub fn step(&mut self) -> Vec<Result<StepReport>> {
        self.each(Simulation::step)
    }

    /// Runs `action` on every world, worlds side by side, and returns what it gave in the worlds' order.
    pub fn each<R: Send>(&mut self, action: impl Fn(&mut Simulation) -> R + Send + Sync) -> Vec<R> {
        let simulations = &mut self.simulations;
        self.pool.install(|| simulations.par_iter_mut().map(action).collect())
    }

    /// Sets a world back to its start, or to the start of another scene.
    ///
    /// # Errors
    /// Those of [`Simulation::new`]; the world is as it was then.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn reset(&mut self, world: usize, scene: Option<Scene>) -> Result<()> {
        let scene = scene.unwrap_or_else(|| self.scenes[world].clone());
        self.simulations[world] = Simulation::new(&self.registry, &scene, &self.options)?;
        self.scenes[world] = scene;
        Ok(())
    }
}
