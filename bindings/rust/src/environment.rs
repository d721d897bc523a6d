//! Worlds of a benchmark task, stepped together under actions: what learners roll out.
//!
//! ```
//! use barchan::environment::{Environment, Recording};
//! use barchan::parameter::Table;
//!
//! let registry = barchan::registry();
//! let task = registry.task("SmoothSurface-lite", &Table::new())?;
//! let mut environment = Environment::new(&registry, task, &[7, 8], &barchan::Options::default())?;
//! let action = environment.heuristic(0).expect("every task that comes with Barchan has a hand-written agent");
//! let still = vec![0.0; action.len()];
//! // What is done in a world can be kept, written and played again.
//! let mut recording = Recording { task: environment.task().name().to_owned(), seed: 7, ..Recording::default() };
//! let steps = environment.step(&[action.clone(), still])?.into_iter().collect::<barchan::Result<Vec<_>>>()?;
//! recording.add(action, &steps[0]);
//! assert_eq!(recording.total(), steps[0].reward);
//! # Ok::<(), barchan::Error>(())
//! ```

mod recording;

pub use recording::Recording;

use crate::worlds::Worlds;
use barchan_core::parameter::Table;
use barchan_core::task::{Episode, Limits, Outcome, Seen, Watch};
use barchan_core::{Error, Options, Registry, Result, Scene, Simulation, State, Task};
use std::fmt;
use std::time::{Duration, Instant};

/// A fresh task: of that name, in its own scene; or that which a scene of one's own asks for, if `name` is the path of a `.toml` file, with `parameters` in place of
/// those of its `[task]`.
///
/// # Errors
/// Those of [`Registry::task`], or of [`Scene::from_file`] and [`Registry::task_of`].
pub fn task(registry: &Registry, name: &str, parameters: &Table) -> Result<Box<dyn Task>> {
    if !name.ends_with(".toml") {
        return registry.task(name, parameters);
    }
    let mut scene = Scene::from_file(name)?;
    if let Some(spec) = &mut scene.task {
        spec.parameters.extend(parameters.clone());
    }
    registry.task_of(&scene)
}

/// Worlds of one task.
///
/// All take control steps of the same length. World w is the same as it would be alone, bit for bit, as far as its backend says so
/// ([`Worlds`]).
pub struct Environment {
    task: Box<dyn Task>,
    limits: Vec<Limits>,
    worlds: Worlds,
    players: Vec<Player>,
    /// Worlds at the start of scenes that have come more than once.
    starts: Vec<State>,
    /// How long the task took to say what came of the last step, summed over worlds.
    observing: Duration,
}

/// What is known of a world since its episode began.
struct Player {
    episode: Box<dyn Episode>,
    seed: u64,
    /// Control steps taken.
    steps: u64,
    /// Numbers of actions that lay beyond their limits.
    clipped: u64,
    /// What was seen last.
    seen: Outcome,
}

/// What came of a control step in a world.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// What the task says of it.
    pub outcome: Outcome,
    /// The episode has reached its horizon.
    pub truncated: bool,
}

impl std::ops::Deref for Step {
    type Target = Outcome;
    fn deref(&self) -> &Outcome {
        &self.outcome
    }
}

impl fmt::Debug for Environment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Environment").field("task", &self.task).field("worlds", &self.worlds).finish_non_exhaustive()
    }
}

impl Environment {
    /// One world for each seed, at the start of its first episode.
    ///
    /// # Errors
    /// The task's own, those of [`Worlds::new`], and [`Error::Body`] if there are no seeds.
    pub fn new(registry: &Registry, task: Box<dyn Task>, seeds: &[u64], options: &Options) -> Result<Self> {
        if seeds.is_empty() {
            return Err(Error::Body {
                path: format!("task '{}'", task.name()),
                what: "there is no world to play it in".to_owned(),
                mend: "give a seed for each world, one at least".to_owned(),
            });
        }
        let scenes = seeds.iter().map(|seed| task.scene(*seed)).collect::<Result<Vec<_>>>()?;
        let worlds = Worlds::new(registry, scenes, options)?;
        let start = |(world, &seed): (&Simulation, &u64)| {
            Ok(Player { episode: task.reset(world, seed)?, seed, steps: 0, clipped: 0, seen: Outcome::default() })
        };
        let players = worlds.iter().zip(seeds).map(start).collect::<Result<Vec<_>>>()?;
        let mut all =
            Self { limits: task.actions(), task, worlds, players, starts: Vec::new(), observing: Duration::ZERO };
        all.look(&(0..seeds.len()).collect::<Vec<_>>())?;
        Ok(all)
    }

    /// The task.
    pub fn task(&self) -> &dyn Task {
        &*self.task
    }
    /// The worlds, to look at.
    pub fn worlds(&self) -> &Worlds {
        &self.worlds
    }
    /// The worlds, to act on besides the actions: the simulation of a world whose episode goes on.
    pub fn worlds_mut(&mut self) -> &mut Worlds {
        &mut self.worlds
    }
    /// What a world's agent sees now.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn observation(&self, world: usize) -> &[f64] {
        &self.players[world].seen.observation
    }
    /// Control steps that a world's episode has taken.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn steps_taken(&self, world: usize) -> u64 {
        self.players[world].steps
    }
    /// Seed of a world's episode.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn seed(&self, world: usize) -> u64 {
        self.players[world].seed
    }
    /// How many numbers of actions have been cut off at their limits in a world's episode.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn clipped(&self, world: usize) -> u64 {
        self.players[world].clipped
    }
    /// What the task's hand-written agent does now in a world; `None` if there is none.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn heuristic(&mut self, world: usize) -> Option<Vec<f64>> {
        self.players[world].episode.heuristic(self.worlds.world(world))
    }

    /// Begins new episodes in some worlds, each with its seed. A scene that comes again is not seeded again: from its second start on, its state is kept.
    ///
    /// # Errors
    /// The task's own, and those of [`Worlds::reset`] and [`Worlds::restore`].
    ///
    /// # Panics
    /// If there is no such world.
    pub fn reset(&mut self, episodes: &[(usize, u64)]) -> Result<()> {
        let mut from_kept = Vec::new();
        for &(world, seed) in episodes {
            let scene = self.task.scene(seed)?;
            let kept = self.starts.iter().position(|start| start.scene().difference(&scene).is_none());
            if let Some(kept) = kept {
                // Its world may have played in another scene before.
                if self.worlds.world(world).is_of(&self.starts[kept]) {
                    from_kept.push((world, kept));
                    continue;
                }
            }
            let is_again = self.worlds.world(world).plan().scene.difference(&scene).is_none();
            self.worlds.reset(world, Some(scene))?;
            if is_again && kept.is_none() && self.starts.len() < MOST_STARTS {
                self.starts.push(self.worlds.world(world).state()?);
            }
        }
        let states: Vec<_> = from_kept.iter().map(|&(world, kept)| (world, &self.starts[kept])).collect();
        self.worlds.restore(&states)?;
        self.begin(episodes)
    }

    /// Begins new episodes in some worlds as these are now, each with its seed: behind [`reset`](Self::reset), where something was put elsewhere
    /// ([`worlds_mut`](Self::worlds_mut), [`Command::Place`](barchan_core::Command::Place)).
    ///
    /// # Errors
    /// The task's own, and the backend's.
    ///
    /// # Panics
    /// If there is no such world.
    pub fn begin(&mut self, episodes: &[(usize, u64)]) -> Result<()> {
        for &(world, seed) in episodes {
            let player = &mut self.players[world];
            player.episode = self.task.reset(self.worlds.world(world), seed)?;
            (player.seed, player.steps, player.clipped) = (seed, 0, 0);
        }
        self.look(&episodes.iter().map(|(world, _)| *world).collect::<Vec<_>>())
    }

    /// Sees worlds at the start of their episodes.
    fn look(&mut self, fresh: &[usize]) -> Result<()> {
        let seen = self.watch(|w| fresh.contains(&w));
        for (w, seen) in seen.into_iter().enumerate().filter(|(w, _)| fresh.contains(w)) {
            let player = &mut self.players[w];
            player.seen = player.episode.observe(self.worlds.world(w), &seen?)?;
        }
        Ok(())
    }

    /// What the task wants to see of each world that is looked at; nothing of the others.
    fn watch(&mut self, is_seen: impl Fn(usize) -> bool) -> Vec<Result<Seen>> {
        let wanted = |(w, (world, player)): (usize, (&Simulation, &Player))| {
            if is_seen(w) { player.episode.watch(world) } else { Watch::default() }
        };
        let watches: Vec<Watch> = self.worlds.iter().zip(&self.players).enumerate().map(wanted).collect();
        self.worlds.watch(&watches)
    }

    /// A control step of every world under its action. A world that fails keeps its error; the others have taken their step.
    ///
    /// # Errors
    /// [`Error::Body`] if an action is missing, has another length, or is not a number: no world has moved then.
    pub fn step(&mut self, actions: &[Vec<f64>]) -> Result<Vec<Result<Step>>> {
        Ok(self.step_while(actions, &[], || true)?.unwrap_or_default())
    }

    /// [`step`](Self::step), unless somebody who is asked a few times a second says not to go on: then there is nothing, and the worlds are left somewhere
    /// within the control step. Reset them.
    ///
    /// Worlds that are `waiting`, of which the list may be empty, stay as they are, whatever their actions: what came of their last step is told again, without a reward.
    ///
    /// # Errors
    /// As [`step`](Self::step).
    pub fn step_while(
        &mut self,
        actions: &[Vec<f64>],
        waiting: &[bool],
        mut goes_on: impl FnMut() -> bool,
    ) -> Result<Option<Vec<Result<Step>>>> {
        self.check(actions)?;
        let acts = |world: usize| !waiting.get(world).is_some_and(|waits| *waits);
        let mut failed: Vec<Option<Error>> = Vec::new();
        for (world, (action, player)) in actions.iter().zip(&mut self.players).enumerate() {
            if !acts(world) {
                failed.push(None);
                continue;
            }
            let within = |(value, limit): (&f64, &Limits)| value.clamp(limit.low, limit.high);
            let cut: Vec<f64> = action.iter().zip(&self.limits).map(within).collect();
            player.clipped += cut.iter().zip(action).filter(|(cut, given)| cut != given).count() as u64;
            failed.push(player.episode.act(self.worlds.world_mut(world), &cut).err());
        }
        let interval = self.task.interval();
        let end = |(w, world): (usize, &Simulation)| world.time() + if acts(w) { interval } else { 0.0 };
        let mut until: Vec<f64> = self.worlds.iter().enumerate().map(end).collect();
        loop {
            let mut waits = false;
            for (w, result) in self.worlds.approach(&until, SLICE).into_iter().enumerate() {
                match result {
                    Ok(there) => waits |= !there && failed[w].is_none(),
                    Err(error) => {
                        failed[w].get_or_insert(error);
                        // It is not asked for more.
                        until[w] = self.worlds.world(w).time();
                    }
                }
            }
            if !waits {
                break;
            }
            if !goes_on() {
                return Ok(None);
            }
        }
        Ok(Some(self.outcomes(failed, acts)))
    }

    /// What came of the step in each world that has not failed; does it act, or wait?
    fn outcomes(&mut self, failed: Vec<Option<Error>>, acts: impl Fn(usize) -> bool) -> Vec<Result<Step>> {
        let seen = self.watch(|w| acts(w) && failed[w].is_none());
        let horizon = self.task.horizon();
        type Given<'a> = (Option<Error>, Result<Seen>, &'a mut Player, bool);
        let observe = |world: &Simulation, (failed, seen, player, acts): Given<'_>| {
            let clock = Instant::now();
            let see = || {
                failed.map_or(Ok(()), Err)?;
                if acts {
                    player.steps += 1;
                    player.seen = player.episode.observe(world, &seen?)?;
                } else {
                    player.seen.reward = 0.0;
                }
                Ok(Step { outcome: player.seen.clone(), truncated: player.steps >= horizon })
            };
            (see(), clock.elapsed())
        };
        let given = failed.into_iter().zip(seen).zip(&mut self.players).enumerate();
        let given = given.map(|(w, ((failed, seen), player))| (failed, seen, player, acts(w)));
        let all = if self.observing > WORTH_SHARING {
            self.worlds.each_with(given.collect(), observe)
        } else {
            self.worlds.iter().zip(given).map(|(world, given)| observe(world, given)).collect()
        };
        self.observing = all.iter().map(|(_, took)| *took).sum();
        all.into_iter().map(|(step, _)| step).collect()
    }

    fn check(&self, actions: &[Vec<f64>]) -> Result<()> {
        let fault = |path: String, what: String, mend: String| Err(Error::Body { path, what, mend });
        let name = self.task.name();
        if actions.len() != self.players.len() {
            let mend = format!("give one for each of {} worlds", self.players.len());
            return fault(format!("task '{name}'"), format!("there are {} actions", actions.len()), mend);
        }
        let names = || self.limits.iter().map(|limit| limit.name.as_str()).collect::<Vec<_>>().join(", ");
        for (world, action) in actions.iter().enumerate() {
            let path =
                || if actions.len() == 1 { format!("task '{name}'") } else { format!("task '{name}', world {world}") };
            if action.len() != self.limits.len() {
                let what = format!("the action has {} numbers", action.len());
                return fault(path(), what, format!("give {}: {}", self.limits.len(), names()));
            }
            if let Some((value, limit)) = action.iter().zip(&self.limits).find(|(value, _)| !value.is_finite()) {
                let what = format!("{} of the action is {value}", limit.name);
                return fault(path(), what, format!("give a number from {} to {}", limit.low, limit.high));
            }
        }
        Ok(())
    }
}

/// Most scenes whose start is kept: each takes about 300 bytes a particle.
const MOST_STARTS: usize = 64;
/// How long worlds are stepped before all are looked at.
const SLICE: Duration = Duration::from_millis(250);
/// Where it takes longer to say what came of a step, worlds are seen side by side: starting as many as a machine has takes about a tenth of this.
const WORTH_SHARING: Duration = Duration::from_millis(4);
