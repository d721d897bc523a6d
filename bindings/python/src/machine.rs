//! One world or many, stepped for a short while at a time, so that Python can look after Ctrl-C in between.

use crate::errors::exception;
use barchan::worlds::Worlds;
use barchan::{Error, HeightScan, Options, Registry, Scene, Simulation};
use pyo3::prelude::*;
use std::sync::{Mutex, MutexGuard, TryLockError};
use std::time::{Duration, Instant};

/// How long steps are taken before signals are looked at.
pub(crate) const SLICE: Duration = Duration::from_millis(50);
/// Most steps that a device is asked for at once.
const MOST: usize = 1 << 10;

/// What one thread at a time may use, in the process that made it.
pub(crate) struct Shared<T> {
    value: Mutex<T>,
    process: u32,
}

impl<T> Shared<T> {
    pub(crate) fn new(value: T) -> Self {
        Self { value: Mutex::new(value), process: std::process::id() }
    }

    /// Takes it, unless another thread is at it; `mend` says what to do then.
    pub(crate) fn taken(&self, py: Python<'_>, what: &str, mend: &str) -> PyResult<MutexGuard<'_, T>> {
        if self.process != std::process::id() {
            // What runs has threads, which a fork has not: it would wait for them for ever.
            let why = format!("this {what} was made before the process was forked, and its threads are the parent's");
            let mend = "make a new one here, or start processes by multiprocessing's \"spawn\" or \"forkserver\"";
            return Err(exception(py, "BusyError", &format!("{why}; {mend}")));
        }
        self.value.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => {
                exception(py, "BusyError", &format!("another thread is at this {what}; {mend}"))
            }
            TryLockError::Poisoned(_) => {
                exception(py, "BusyError", &format!("a call of this {what} has broken down half way; make a new one"))
            }
        })
    }
}

/// What runs: one world with all threads, or worlds of one batch.
#[derive(Debug)]
pub(crate) enum Machine {
    One(Box<Simulation>),
    Many(Box<Worlds>),
}

/// What failed, and in which world.
pub(crate) type Failure = (Error, Option<usize>);

impl Machine {
    /// What the plans of its worlds warn of.
    pub(crate) fn warnings(&self) -> Vec<String> {
        (0..self.len()).flat_map(|world| self.world(world).plan().warnings.clone()).collect()
    }

    /// A world for each scene.
    pub(crate) fn new(registry: &Registry, scenes: Vec<Scene>, options: &Options) -> barchan::Result<Self> {
        Ok(match &scenes[..] {
            [scene] => Self::One(Box::new(Simulation::new(registry, scene, options)?)),
            _ => Self::Many(Box::new(Worlds::new(registry, scenes, options)?)),
        })
    }

    pub(crate) fn len(&self) -> usize {
        match self {
            Self::One(_) => 1,
            Self::Many(worlds) => worlds.len(),
        }
    }
    pub(crate) fn world(&self, world: usize) -> &Simulation {
        match self {
            Self::One(simulation) => simulation,
            Self::Many(worlds) => worlds.world(world),
        }
    }
    pub(crate) fn world_mut(&mut self, world: usize) -> &mut Simulation {
        match self {
            Self::One(simulation) => simulation,
            Self::Many(worlds) => worlds.world_mut(world),
        }
    }

    /// The heights around a robot in some worlds.
    pub(crate) fn scans(&mut self, robot: &str, chosen: &[usize]) -> barchan::Result<Vec<HeightScan>> {
        let all = match self {
            Self::One(simulation) => vec![simulation.scan(robot)?],
            Self::Many(worlds) => worlds.scans(robot)?,
        };
        Ok(chosen.iter().map(|&world| all[world].clone()).collect())
    }

    /// Heights of the soft ground in some worlds, at points of each.
    pub(crate) fn heights(
        &mut self,
        points: Vec<Vec<[f64; 2]>>,
        chosen: &[usize],
    ) -> barchan::Result<Vec<Vec<Option<f64>>>> {
        match self {
            Self::One(simulation) => points.iter().map(|points| simulation.heights(points)).collect(),
            Self::Many(worlds) => {
                let mut all = vec![Vec::new(); worlds.len()];
                chosen.iter().zip(points).for_each(|(&world, points)| all[world] = points);
                let mut found = worlds.heights(all)?;
                Ok(chosen.iter().map(|&world| std::mem::take(&mut found[world])).collect())
            }
        }
    }

    /// Up to `count` steps of every world, as many as go in a slice, and how many that were. Of a failure the first one is told, after all others
    /// have taken their steps.
    pub(crate) fn steps(&mut self, count: usize) -> Result<usize, Failure> {
        let begun = Instant::now();
        let mut taken = 0;
        let mut chunk = 1;
        while taken < count && begun.elapsed() < SLICE {
            match self {
                Self::One(simulation) => {
                    let most = (count - taken).min(MOST);
                    taken += simulation.steps(most, f64::INFINITY).map_err(|error| (error, None))?.len();
                }
                Self::Many(worlds) => {
                    let most = (count - taken).min(chunk);
                    let results = worlds.steps(most);
                    taken += most;
                    chunk = (2 * chunk).min(MOST);
                    for (world, result) in results.into_iter().enumerate() {
                        let told = |error| (error, Some(world));
                        // Asked again, a world that has not taken all of them says why.
                        for _ in result.map_err(told)?.len()..most {
                            worlds.world_mut(world).step().map_err(told)?;
                        }
                    }
                }
            }
        }
        Ok(taken)
    }

    /// Steps towards a time in every world [s], as many as go in a slice; are all there? A world that cannot go on waits for the others, and says why in `failure`, the first one
    /// of several.
    pub(crate) fn approach(&mut self, until: &mut [f64], failure: &mut Option<Failure>) -> bool {
        let results = match self {
            Self::One(simulation) => {
                let begun = Instant::now();
                let mut result = Ok(());
                while result.is_ok() && simulation.time() < until[0] && begun.elapsed() < SLICE {
                    simulation.set_stop(until[0]);
                    result = simulation.steps(MOST, until[0]).map(drop);
                }
                vec![result.map(|()| simulation.time() >= until[0])]
            }
            Self::Many(worlds) => worlds.approach(until, SLICE),
        };
        let several = results.len() > 1;
        let mut all = true;
        for (world, result) in results.into_iter().enumerate() {
            match result {
                Ok(there) => all &= there,
                Err(error) => {
                    failure.get_or_insert((error, several.then_some(world)));
                    until[world] = f64::NEG_INFINITY;
                }
            }
        }
        all
    }
}
