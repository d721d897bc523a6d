//! The class `Environment`: worlds of a task.

use crate::errors::{OrRaise, raised, warn};
use crate::given::{
    Numbers, blows, check_count, check_world, chosen, first_or_each, named, number, placements, precision, tell,
};
use crate::machine::Shared;
use crate::picture::{array, check_part};
use crate::simulation::Simulation;
use crate::{known, records, scene};
use barchan::environment::{Environment as Worlds, Recording, Step};
use barchan::parameter::Table;
use barchan::picture::View;
use barchan::{Options, Task};
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use std::sync::MutexGuard;
use std::time::{Duration, Instant};

/// What a task asks for, what an action and an observation hold: a `Task` record. Nothing is simulated for it. A task has a name, or is what a scene of one's own (a `.toml` file)
/// asks for.
///
/// Raises `UnknownNameError` if there is no such task, and `BodyError` if it has no such parameter.
#[pyfunction]
#[pyo3(signature = (name, parameters=None))]
pub(crate) fn task<'py>(
    py: Python<'py>,
    name: PathBuf,
    parameters: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let name = &name.display().to_string();
    records::task(py, &*barchan::environment::task(&known(py)?, name, &table(parameters)?).or_raise(py)?)
}

/// A task's parameters.
fn table(parameters: Option<&Bound<'_, PyDict>>) -> PyResult<Table> {
    let Some(parameters) = parameters else { return Ok(Table::new()) };
    match scene::to_toml(parameters.as_any(), "parameters")? {
        toml::Value::Table(table) => Ok(table),
        _ => Ok(Table::new()),
    }
}

/// Worlds of a benchmark task, stepped together under actions: one simulation, whatever their number.
///
/// Parameters
/// ----------
/// task
///     Name of a task (`barchan.registry()["tasks"]`), or path to a scene of one's own (a `.toml` file) whose `[task]` names one.
/// worlds
///     How many there are.
/// seed
///     Seed of the first world's episode; world w has seed + w. Or a list with a seed for each world.
/// backend, precision, adapter, threads
///     As for `Simulation`.
/// parameters
///     The task's parameters, a dict such as {"randomise": 1.0}.
/// failures
///     What happens if a world cannot go on: "raise" an exception, or "end" its episode, with a reward of 0 and info["failed"].
///
/// An observation is float32 of shape (worlds, numbers), an action float64 of shape (worlds, numbers) in the units of `task.action_names`; what lies beyond the
/// limits is cut off and counted in info["clipped"]. World w is the same as it would be alone, bit for bit. `barchan.envs` wraps this for Gymnasium.
#[pyclass(module = "barchan", frozen)]
pub(crate) struct Environment {
    inner: Shared<Inner>,
    name: String,
    worlds: usize,
    options: Options,
    ends: bool,
}

struct Inner {
    environment: Worlds,
    /// What has been done in each world since its episode began, until it ended.
    recordings: Vec<Recording>,
    ended: Vec<bool>,
    views: Vec<Option<View>>,
    /// How long the worlds have been stepped, without Python.
    stepping: Duration,
    /// A control step was left half way.
    torn: bool,
    /// Why each world could not go on, if so.
    failures: Vec<Option<String>>,
}

impl Environment {
    fn inner<'a>(&'a self, py: Python<'_>) -> PyResult<MutexGuard<'a, Inner>> {
        self.inner.taken(py, "environment", "wait for it, or make one for each thread")
    }

    /// A row for each world.
    fn rows<'py>(&self, py: Python<'py>, given: &Numbers<'py>, task: &dyn Task) -> PyResult<Vec<Vec<f64>>> {
        let limits = task.actions();
        let actions = given.as_array();
        if actions.shape() != [self.worlds, limits.len()] {
            let names: Vec<&str> = limits.iter().map(|limit| limit.name.as_str()).collect();
            return Err(PyValueError::new_err(format!(
                "actions: their shape is {:?}; give ({}, {}), a row for each world: {}",
                actions.shape(),
                self.worlds,
                limits.len(),
                names.join(", ")
            )));
        }
        py.check_signals()?;
        Ok(actions.rows().into_iter().map(|row| row.to_vec()).collect())
    }
}

impl Inner {
    /// Begins episodes, of which nothing is recorded yet.
    fn begin(
        &mut self,
        py: Python<'_>,
        episodes: &[(usize, u64)],
        begin: impl FnOnce(&mut Worlds) -> barchan::Result<()> + Send,
    ) -> PyResult<()> {
        let Self { environment, recordings, ended, .. } = self;
        py.detach(|| begin(environment)).map_err(|error| raised(py, error, None))?;
        for &(world, seed) in episodes {
            let recording = &mut recordings[world];
            recording.actions.clear();
            recording.rewards.clear();
            (recording.seed, recording.success) = (seed, false);
            ended[world] = false;
        }
        Ok(())
    }

    /// What every world sees.
    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let worlds = self.recordings.len();
        let seen = (0..worlds).flat_map(|world| self.environment.observation(world)).map(|value| *value as f32);
        let all: Vec<f32> = seen.collect();
        let count = all.len() / worlds;
        PyArray1::from_vec(py, all).reshape([worlds, count])
    }
}

/// Numbers of each world.
fn column<'py>(py: Python<'py>, values: impl Iterator<Item = f64>) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_vec(py, values.collect())
}

/// Yes or no of each world.
fn flags<'py>(py: Python<'py>, values: impl Iterator<Item = bool>) -> Bound<'py, PyArray1<bool>> {
    PyArray1::from_vec(py, values.collect())
}

#[pymethods]
impl Environment {
    #[new]
    #[pyo3(signature = (
        task, *, worlds=1, seed=None, backend="cpu", precision="f32", adapter=None, threads=0, parameters=None, failures="raise"
    ))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn new(
        py: Python<'_>,
        task: PathBuf,
        #[pyo3(from_py_with = number)] worlds: usize,
        seed: Option<&Bound<'_, PyAny>>,
        backend: &str,
        precision: &str,
        adapter: Option<&Bound<'_, PyAny>>,
        #[pyo3(from_py_with = number)] threads: usize,
        parameters: Option<&Bound<'_, PyDict>>,
        failures: &str,
    ) -> PyResult<Self> {
        let task = &task.display().to_string();
        check_count(py, worlds)?;
        if !["raise", "end"].contains(&failures) {
            return Err(PyValueError::new_err(format!("failures: '{failures}' is neither \"raise\" nor \"end\"")));
        }
        let seeds = match seed {
            None => (0..worlds as u64).collect(),
            Some(given) => first_or_each(given, worlds)?,
        };
        let options = Options {
            backend: backend.to_owned(),
            precision: self::precision(precision)?,
            threads,
            adapter: adapter.map(named).transpose()?,
            ..Options::default()
        };
        let (registry, parameters) = (known(py)?, table(parameters)?);
        let made = barchan::environment::task(&registry, task, &parameters).or_raise(py)?;
        let environment = py.detach(|| Worlds::new(&registry, made, &seeds, &options)).or_raise(py)?;
        // Those of the tasks that come with Barchan are known.
        if task.ends_with(".toml") {
            warn(py, environment.worlds().iter().flat_map(|world| &world.plan().warnings))?;
        }
        let played_on = format!("{} {}", options.backend, options.precision);
        let recording = |seed: &u64| Recording {
            task: task.to_owned(),
            parameters: parameters.clone(),
            seed: *seed,
            played_on: played_on.clone(),
            ..Recording::default()
        };
        let inner = Inner {
            environment,
            recordings: seeds.iter().map(recording).collect(),
            ended: vec![false; worlds],
            views: (0..worlds).map(|_| None).collect(),
            stepping: Duration::ZERO,
            torn: false,
            failures: vec![None; worlds],
        };
        let ends = failures == "end";
        Ok(Self { inner: Shared::new(inner), name: task.to_owned(), worlds, options, ends })
    }

    /// What the task asks for, and what an action and an observation hold: a `Task` record.
    #[getter]
    fn task<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::task(py, self.inner(py)?.environment.task())
    }
    /// Number of worlds.
    #[getter]
    fn worlds(&self) -> usize {
        self.worlds
    }
    /// Name of the backend.
    #[getter]
    fn backend(&self) -> &str {
        &self.options.backend
    }
    /// "f32" or "f64".
    #[getter]
    fn precision(&self) -> String {
        self.options.precision.to_string()
    }
    /// Seed of each world's episode, uint64 of shape (worlds,).
    #[getter]
    fn seeds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u64>>> {
        let inner = self.inner(py)?;
        Ok(PyArray1::from_vec(py, (0..self.worlds).map(|world| inner.environment.seed(world)).collect()))
    }
    /// Control steps that each world's episode has taken, uint64 of shape (worlds,).
    #[getter]
    fn steps_taken<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u64>>> {
        let inner = self.inner(py)?;
        Ok(PyArray1::from_vec(py, (0..self.worlds).map(|world| inner.environment.steps_taken(world)).collect()))
    }
    /// Number of particles of each world, uint64 of shape (worlds,).
    #[getter]
    fn particle_counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u64>>> {
        let inner = self.inner(py)?;
        let counts = inner.environment.worlds().iter().map(|world| world.particle_count() as u64).collect();
        Ok(PyArray1::from_vec(py, counts))
    }
    /// Why each world's last episode that failed did so, with failures="end": a list of texts, None where none has failed.
    #[getter]
    fn failures(&self, py: Python<'_>) -> PyResult<Vec<Option<String>>> {
        Ok(self.inner(py)?.failures.clone())
    }
    /// Wall time that steps have taken so far without Python [s].
    #[getter]
    fn stepping_seconds(&self, py: Python<'_>) -> PyResult<f64> {
        Ok(self.inner(py)?.stepping.as_secs_f64())
    }

    /// Gives a robot, a link of one, or a free tool a blow, as `Simulation.push` does: what episodes are disturbed by. An episode's file does not hold it.
    ///
    /// Raises `BodyError` if there is no such body, it cannot move that way, or numbers are not finite.
    #[pyo3(signature = (body, impulse, *, angular=None, worlds=None))]
    fn push(
        &self,
        py: Python<'_>,
        body: &str,
        impulse: Numbers<'_>,
        angular: Option<Numbers<'_>>,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut inner = self.inner(py)?;
        let worlds = chosen(worlds, self.worlds)?;
        let blows = blows(&impulse, angular.as_ref(), worlds.len())?;
        let all = inner.environment.worlds_mut();
        tell(py, self.worlds, worlds, blows, |world, command| all.world_mut(world).act(body, command))
    }

    /// Puts a body elsewhere, as `Simulation.place` does, and begins the episodes of these worlds anew from there, with the seeds that they have. Call it behind `reset`, to
    /// begin where no scene of the task does. An episode's file does not hold it.
    ///
    /// Returns the observations of all worlds, float32 of shape (worlds, numbers). Raises what `Simulation.place` raises; all these episodes begin anew then, too.
    #[pyo3(signature = (
        body, *, position=None, rotation=None, velocity=None, angular_velocity=None, joints=None, joint_rates=None, worlds=None
    ))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn place<'py>(
        &self,
        py: Python<'py>,
        body: &str,
        position: Option<Numbers<'_>>,
        rotation: Option<Numbers<'_>>,
        velocity: Option<Numbers<'_>>,
        angular_velocity: Option<Numbers<'_>>,
        joints: Option<Numbers<'_>>,
        joint_rates: Option<Numbers<'_>>,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let mut inner = self.inner(py)?;
        let chosen = chosen(worlds, self.worlds)?;
        let given = [position, rotation, velocity, angular_velocity, joints, joint_rates];
        let placements = placements(given, chosen.len())?;
        let all = inner.environment.worlds_mut();
        let told =
            tell(py, self.worlds, chosen.clone(), placements, |world, command| all.world_mut(world).act(body, command));
        // If a world refuses, those before it have been changed.
        let episodes: Vec<(usize, u64)> = chosen.iter().map(|&world| (world, inner.environment.seed(world))).collect();
        inner.begin(py, &episodes, |environment| environment.begin(&episodes))?;
        told?;
        inner.observations(py)
    }

    /// A simulation of its own that goes on from a world as it is now: its particles, sensors and ledger can be read, its scene says what was drawn, and the episode does not
    /// notice what is done to it. On the same backend.
    #[pyo3(signature = (world=0))]
    fn simulation(&self, py: Python<'_>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Simulation> {
        check_world(world, self.worlds)?;
        let mut inner = self.inner(py)?;
        let environment = &mut inner.environment;
        let state = py.detach(move || environment.worlds_mut().world_mut(world).state()).or_raise(py)?;
        Simulation::from_state(py, &state, self.options.clone())
    }

    /// Begins new episodes: in all worlds, or in those in `worlds` (a number or a list), with the same seeds as before or with `seeds`: a number from which they count, or one for each of them.
    /// A scene that comes back costs a copy, together for all worlds; a new one, by a seed that changes it, is seeded.
    ///
    /// Returns the observations of all worlds, float32 of shape (worlds, numbers).
    #[pyo3(signature = (worlds=None, seeds=None))]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        worlds: Option<&Bound<'_, PyAny>>,
        seeds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let mut inner = self.inner(py)?;
        let chosen = chosen(worlds, self.worlds)?;
        let seeds = seeds.map(|seeds| first_or_each(seeds, chosen.len())).transpose()?;
        let seed = |i: usize| seeds.as_ref().map_or_else(|| inner.environment.seed(chosen[i]), |seeds| seeds[i]);
        let episodes: Vec<(usize, u64)> = chosen.iter().enumerate().map(|(i, &world)| (world, seed(i))).collect();
        inner.begin(py, &episodes, |environment| environment.reset(&episodes))?;
        if chosen.len() == self.worlds {
            inner.torn = false;
        }
        inner.observations(py)
    }

    /// What the agent of every world sees now, float32 of shape (worlds, numbers): the parts of `task.observation_parts` one after the other.
    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        self.inner(py)?.observations(py)
    }

    /// A control step of every world under its action, of shape (worlds, numbers).
    ///
    /// Returns (observations, rewards, terminated, truncated, success, info): observations are float32 of shape (worlds, numbers), all others of shape
    /// (worlds,), float64 or bool. `info` has an array for each number that the task tells, by name, and "clipped", how many numbers of actions have been cut
    /// off at their limits in the episode; with failures="end" also "failed".
    ///
    /// `waiting`, bool of shape (worlds,), names worlds that stay as they are whatever their action: they tell again what they told last, with a reward of 0.
    ///
    /// Other threads of Python go on meanwhile. Ctrl-C ends it within the control step, with `KeyboardInterrupt`: reset all worlds then.
    ///
    /// Raises `BodyError` or `ValueError` if an action has another shape or is not a number, and no world has moved then; `SimulationError` if a world cannot go on: the
    /// others have taken their step then.
    #[pyo3(signature = (actions, *, waiting=None))]
    #[expect(clippy::type_complexity, reason = "Gymnasium's tuple")]
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: Numbers<'py>,
        waiting: Option<Vec<bool>>,
    ) -> PyResult<(
        Bound<'py, PyArray2<f32>>,
        Bound<'py, PyArray1<f64>>,
        Bound<'py, PyArray1<bool>>,
        Bound<'py, PyArray1<bool>>,
        Bound<'py, PyArray1<bool>>,
        Bound<'py, PyDict>,
    )> {
        let mut inner = self.inner(py)?;
        let Inner { environment, recordings, ended, stepping, torn, failures, .. } = &mut *inner;
        if *torn {
            return Err(PyValueError::new_err("a control step was interrupted half way; reset() all worlds first"));
        }
        let actions = self.rows(py, &actions, environment.task())?;
        let waiting = waiting.unwrap_or_else(|| vec![false; self.worlds]);
        if waiting.len() != self.worlds {
            let what = format!("waiting: there are {} of them for {} worlds", waiting.len(), self.worlds);
            return Err(PyValueError::new_err(what));
        }
        let mut signal = Ok(());
        let stepped = py.detach(|| {
            let begun = Instant::now();
            let goes_on = || {
                signal = Python::attach(|py| py.check_signals());
                signal.is_ok()
            };
            let stepped = environment.step_while(&actions, &waiting, goes_on);
            *stepping += begun.elapsed();
            stepped
        });
        *torn = signal.is_err();
        signal?;
        let mut steps: Vec<(Step, bool)> = Vec::new();
        let mut first_failure = None;
        for (world, (result, action)) in stepped.or_raise(py)?.unwrap_or_default().into_iter().zip(actions).enumerate()
        {
            match result {
                Ok(step) => {
                    if !(ended[world] || waiting[world]) {
                        recordings[world].add(action, &step);
                    }
                    ended[world] |= step.terminated || step.truncated;
                    steps.push((step, false));
                }
                Err(error) if self.ends => {
                    let outcome = barchan::task::Outcome { terminated: true, ..Default::default() };
                    steps.push((Step { outcome, truncated: false }, true));
                    failures[world] = Some(error.to_string());
                }
                Err(error) => first_failure = first_failure.or(Some((error, world))),
            }
        }
        if let Some((error, world)) = first_failure {
            return Err(raised(py, error, Some(world)));
        }
        let info = PyDict::new(py);
        let mut names: Vec<&'static str> = Vec::new();
        for (name, _) in steps.iter().flat_map(|(step, _)| &step.info) {
            if !names.contains(name) {
                names.push(name);
            }
        }
        for name in names {
            let of = |(step, _): &(Step, bool)| {
                step.info.iter().find(|(one, _)| *one == name).map_or(f64::NAN, |(_, value)| *value)
            };
            info.set_item(name, column(py, steps.iter().map(of)))?;
        }
        info.set_item("clipped", column(py, (0..self.worlds).map(|world| environment.clipped(world) as f64)))?;
        if self.ends {
            info.set_item("failed", flags(py, steps.iter().map(|(_, failed)| *failed)))?;
        }
        let (rewards, terminated, truncated, success) = (
            column(py, steps.iter().map(|(step, _)| step.reward)),
            flags(py, steps.iter().map(|(step, _)| step.terminated)),
            flags(py, steps.iter().map(|(step, _)| step.truncated)),
            flags(py, steps.iter().map(|(step, _)| step.success)),
        );
        Ok((inner.observations(py)?, rewards, terminated, truncated, success, info))
    }

    /// What the task's hand-written agent does now in every world, float64 of shape (worlds, numbers); None if there is none.
    fn heuristic<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        let mut inner = self.inner(py)?;
        let environment = &mut inner.environment;
        let count = environment.task().actions().len();
        let all: Option<Vec<Vec<f64>>> =
            py.detach(|| (0..self.worlds).map(|world| environment.heuristic(world)).collect());
        all.map(|all| PyArray1::from_vec(py, all.concat()).reshape([self.worlds, count])).transpose()
    }

    /// Draws a world as it is now: an array of shape (rows, columns, 3), uint8, RGB. Extent and colours stay those of the first picture.
    ///
    /// `part` is "page", the whole picture with title, scales and a vertical cut, or "ground", the ground and what is on it alone.
    #[pyo3(signature = (world=0, *, part="page"))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
        part: &str,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        check_world(world, self.worlds)?;
        check_part(part)?;
        let mut inner = self.inner(py)?;
        let Inner { environment, views, .. } = &mut *inner;
        let view = &mut views[world];
        let page = py.detach(move || {
            let world = environment.worlds_mut().world_mut(world);
            let view = view.get_or_insert_with(|| View::new(world));
            view.draw(world).map(|page| (page, view.relief_rect()))
        });
        let (page, ground) = page.or_raise(py)?;
        array(py, page, ground, part)
    }

    /// Writes what has been done in a world since its episode began, until it ended, as JSON, which `barchan task replay` plays again. `agent` says who acted, for people.
    ///
    /// Raises `FileError` if it cannot be written.
    #[pyo3(signature = (path, *, world=0, agent=""))]
    fn save_episode(
        &self,
        py: Python<'_>,
        path: PathBuf,
        #[pyo3(from_py_with = number)] world: usize,
        agent: &str,
    ) -> PyResult<()> {
        check_world(world, self.worlds)?;
        let recording = Recording { agent: agent.to_owned(), ..self.inner(py)?.recordings[world].clone() };
        recording.write(&path).or_raise(py)
    }

    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err("an Environment cannot be pickled; make it in the process that needs it"))
    }

    fn __repr__(&self) -> String {
        let Options { backend, precision, .. } = &self.options;
        let worlds = if self.worlds == 1 { "1 world".to_owned() } else { format!("{} worlds", self.worlds) };
        format!("<barchan.Environment of '{}': {worlds}, {backend} {precision}>", self.name)
    }
}
