//! The class `Simulation`.

use crate::change::Change;
use crate::errors::{OrRaise, exception, raised, warn};
use crate::given::{
    Numbers, axes, blows, check_count, check_world, chosen, corners, first_or_each, named, number, per_world,
    placements, points, points_per_world, precision, tell, whole_seed,
};
use crate::gradient::{Signals, Tape};
use crate::machine::{Machine, Shared};
use crate::state::State;
use crate::{arrays, known, records, scene};
use barchan::export::Fields as Columns;
use barchan::probe::Filter;
use barchan::scene::Probe;
use barchan::stress::pressure;
use barchan::{Aabb, Closest, Command, Fields, Options, Precision, Scene, Simulation as World, Spot};
use numpy::{PyArray1, PyArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard};

/// What is read of particles unless it is said what.
const USUAL: [&str; 7] = ["velocity", "mass", "volume0", "id", "body", "material", "level"];
/// What can be read without all the rest of the particles.
const READ: [&str; 8] = ["velocity", "affine", "mass", "volume0", "id", "body", "material", "level"];
/// Most heights that one map holds; they take 40 bytes each on the way.
const MOST_HEIGHTS: f64 = (1 << 24) as f64;

/// Fields of particles by their names, or which there are.
fn columns(world: &World, names: &[String]) -> Result<Columns, String> {
    let all = Columns::new(world.plan(), None).map_err(|error| error.to_string())?;
    let others = all.names().filter(|name| *name != "position" && !READ.contains(name));
    let known: Vec<&str> = READ.into_iter().chain(others).collect();
    match names.iter().find(|name| !known.contains(&name.as_str())) {
        Some(unknown) => Err(format!("particles have no '{unknown}' to be read; known are: {}", known.join(", "))),
        None => Columns::new(world.plan(), Some(names)).map_err(|error| error.to_string()),
    }
}

/// A scene that is put on a backend and stepped: one world, or many that are stepped together.
///
/// Parameters
/// ----------
/// scene
///     Name of a built-in scene (`barchan.scenes()`), path to a TOML file, or a dict that holds what such a file would.
/// backend
///     "cpu", or "wgpu" for GPUs.
/// precision
///     "f32", or "f64" on the processor.
/// worlds
///     How many independent worlds of the scene there are. Those of one batch step together: side by side on the processor, in the same passes on a GPU.
/// adapter
///     Name or number of the GPU (`barchan.adapters()`); the first, if none is given.
/// threads
///     Worker threads; 0: as many as the machine has. They change no bit of what is simulated.
/// seed
///     Random seed in place of the scene's: world w has seed + w. Or a list with a seed for each world.
/// overrides
///     What to change in the scene, by key path: `{"world.cell": 0.02, "tool.cube.motion.free.mass": 5}`. A list with such a dict for each world makes worlds that differ. On a GPU
///     those of a batch have cell width, extent, walls, gravity, laws, and the number and kinds of tools in common.
///
/// All is in SI units, z up; quaternions are (w, x, y, z). Methods that look at a world take `world`, its number. Every array is a copy: it stays as it is, and
/// to write into it changes nothing here.
#[pyclass(module = "barchan", frozen)]
pub(crate) struct Simulation {
    machine: Shared<Machine>,
    scene: Scene,
    /// Those of the present backend.
    options: Mutex<Options>,
}

impl Simulation {
    /// What runs, unless another thread is at it.
    fn machine<'a>(&'a self, py: Python<'_>) -> PyResult<MutexGuard<'a, Machine>> {
        self.machine.taken(py, "simulation", "wait for it, or take a fork() before the other begins")
    }

    fn options(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, Options>> {
        self.options
            .lock()
            .map_err(|_| exception(py, "BusyError", "a call of this simulation has broken down half way"))
    }

    /// One that goes on from a state.
    pub(crate) fn from_state(py: Python<'_>, state: &barchan::State, options: Options) -> PyResult<Self> {
        let registry = known(py)?;
        let one = py.detach(|| World::from_state(&registry, state, &options)).or_raise(py)?;
        let scene = state.scene().clone();
        Ok(Self { machine: Shared::new(Machine::One(Box::new(one))), scene, options: Mutex::new(options) })
    }

    /// Looks at a world without holding Python up.
    pub(crate) fn look<R: Send>(
        &self,
        py: Python<'_>,
        world: usize,
        ask: impl FnOnce(&World) -> R + Send,
    ) -> PyResult<R> {
        let mut machine = self.machine(py)?;
        check_world(world, machine.len())?;
        let machine = &mut *machine;
        // Moved, so that it is the only one who looks: a world is not to be looked at by two threads.
        Ok(py.detach(move || ask(machine.world(world))))
    }
}

#[pymethods]
impl Simulation {
    #[new]
    #[pyo3(signature = (scene, *, backend="cpu", precision="f32", worlds=1, adapter=None, threads=0, seed=None, overrides=None))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn new(
        py: Python<'_>,
        scene: &Bound<'_, PyAny>,
        backend: &str,
        precision: &str,
        #[pyo3(from_py_with = number)] worlds: usize,
        adapter: Option<&Bound<'_, PyAny>>,
        #[pyo3(from_py_with = number)] threads: usize,
        seed: Option<&Bound<'_, PyAny>>,
        overrides: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        check_count(py, worlds)?;
        let is_known = scene::is_built_in(scene);
        let mut scenes = scene::read_each(scene, overrides, worlds)?;
        let given = seed.map(|seed| first_or_each(seed, worlds)).transpose()?;
        let own = scene::own_seeds(overrides, worlds, given.is_some())?;
        for (world, scene) in scenes.iter_mut().enumerate() {
            scene.seed = match &given {
                Some(seeds) => seeds[world],
                None if own[world] => scene.seed,
                None => whole_seed(scene.seed + world as u64)?,
            };
        }
        let options = Options {
            backend: backend.to_owned(),
            precision: self::precision(precision)?,
            threads,
            adapter: adapter.map(named).transpose()?,
            ..Options::default()
        };
        let registry = known(py)?;
        let scene = scenes[0].clone();
        let machine = py.detach(|| Machine::new(&registry, scenes, &options)).or_raise(py)?;
        warn(py, machine.warnings().iter().filter(|_| !is_known))?;
        Ok(Self { machine: Shared::new(machine), scene, options: Mutex::new(options) })
    }

    /// Goes on from a file that `save` or a run of the command line has written, as one world. Precision is the file's. For several worlds, make a simulation of the same
    /// scene and `restore` the loaded one's `state()` there.
    ///
    /// Raises `SnapshotError` or `FileError` if the file cannot be used.
    #[staticmethod]
    #[pyo3(signature = (path, *, backend="cpu", adapter=None, threads=0))]
    fn load(
        py: Python<'_>,
        path: PathBuf,
        backend: &str,
        adapter: Option<&Bound<'_, PyAny>>,
        #[pyo3(from_py_with = number)] threads: usize,
    ) -> PyResult<Self> {
        let adapter = adapter.map(named).transpose()?;
        let registry = known(py)?;
        let precision = barchan::snapshot::about(&path).or_raise(py)?.precision;
        let options = Options { backend: backend.to_owned(), precision, threads, adapter, ..Options::default() };
        let world = py.detach(|| World::resume(&registry, &path, &options)).or_raise(py)?;
        let scene = world.plan().scene.clone();
        Ok(Self { machine: Shared::new(Machine::One(Box::new(world))), scene, options: Mutex::new(options) })
    }

    /// Takes `count` steps in every world.
    ///
    /// Other threads of Python go on meanwhile. Ctrl-C ends it between two steps, with `KeyboardInterrupt`; the simulation can go on from there.
    ///
    /// Raises `SimulationError` if the scene cannot go on; that world is as it was before the step that failed.
    #[pyo3(signature = (count=1))]
    fn step(&self, py: Python<'_>, #[pyo3(from_py_with = number)] count: usize) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let machine = &mut *machine;
        let mut left = count;
        while left > 0 {
            left -= py.detach(|| machine.steps(left)).map_err(|(error, world)| raised(py, error, world))?;
            py.check_signals()?;
        }
        Ok(())
    }

    /// Steps every world until `seconds` later, or those in `worlds` (a number or a list) while the others wait; the last step ends there exactly.
    ///
    /// With `progress=True`, what has been reached is shown on stderr. If a world cannot go on, the others do, and what it says is raised then: its `times` lag behind. The rest
    /// is as for `step`.
    #[pyo3(signature = (seconds, *, progress=false, worlds=None))]
    fn advance(&self, py: Python<'_>, seconds: f64, progress: bool, worlds: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        if !(seconds >= 0.0 && seconds.is_finite()) {
            return Err(PyValueError::new_err(format!("seconds: {seconds} is no time to advance by")));
        }
        let mut machine = self.machine(py)?;
        let machine = &mut *machine;
        // Worlds that wait are where they are to go.
        let mut until = vec![f64::NEG_INFINITY; machine.len()];
        for world in chosen(worlds, machine.len())? {
            until[world] = machine.world(world).time() + seconds;
        }
        let Some(shown) = until.iter().position(|until| until.is_finite()) else { return Ok(()) };
        let (end, mut failure) = (until[shown], None);
        let show = |time: f64, line: &str| -> PyResult<()> {
            if progress {
                let stderr = py.import("sys")?.getattr("stderr")?;
                stderr.call_method1("write", (format!("\r{}: {time:.3} of {end:.3} s{line}", self.scene.name),))?;
                stderr.call_method0("flush")?;
            }
            Ok(())
        };
        loop {
            let there = py.detach(|| machine.approach(&mut until, &mut failure));
            show(machine.world(shown).time(), if there { "\n" } else { "" })?;
            if there {
                return failure.map_or(Ok(()), |(error, world)| Err(raised(py, error, world)));
            }
            py.check_signals()?;
        }
    }

    /// Steps a world until `seconds` later and remembers the steps: a `Tape`, through which gradients go back. The others wait.
    ///
    /// Gradients go through every law, walls, tools, robots, nested levels and unbounded ground; `precision="f64"` makes them as exact as they can be. Ctrl-C ends it, without a tape.
    ///
    /// The world has moved on, whether there is a tape or not: take a `state` before, to go back to.
    ///
    /// Raises `PluginError` for what has no adjoint yet, by name (sleep, fields), `BodyError` for `levels.subcycle`, tools that appear or vanish, sources and sinks, and if particles left the world on the way;
    /// else as `step`.
    #[pyo3(signature = (seconds, *, world=0))]
    fn record(&self, py: Python<'_>, seconds: f64, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Tape> {
        if !(seconds > 0.0 && seconds.is_finite()) {
            return Err(PyValueError::new_err(format!("seconds: {seconds} is no time to record")));
        }
        let mut machine = self.machine(py)?;
        check_world(world, machine.len())?;
        let (registry, mut signals) = (known(py)?, Signals::new());
        let machine = &mut *machine;
        let now = machine.world(world).time();
        if now + seconds == now {
            let what = format!("seconds: {seconds:e} is too short to be told from the time, {now} s; give more");
            return Err(PyValueError::new_err(what));
        }
        let record = || {
            let one = machine.world_mut(world);
            one.record_while(&registry, one.time() + seconds, |_| signals.look())
        };
        let tape = py.detach(record).map_err(|error| raised(py, error, None))?;
        signals.raised()?;
        let tape = tape.expect("only a signal breaks it off");
        Ok(Tape { tape })
    }

    /// Simulated time of world 0 [s].
    #[getter]
    fn time(&self, py: Python<'_>) -> PyResult<f64> {
        Ok(self.machine(py)?.world(0).time())
    }
    /// Simulated time of each world [s], float64 of shape (worlds,).
    #[getter]
    fn times<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let machine = self.machine(py)?;
        Ok(PyArray1::from_vec(py, (0..machine.len()).map(|world| machine.world(world).time()).collect()))
    }
    /// Steps that world 0 has taken.
    #[getter]
    fn step_count(&self, py: Python<'_>) -> PyResult<u64> {
        Ok(self.machine(py)?.world(0).step_count())
    }
    /// Number of worlds.
    #[getter]
    fn worlds(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.machine(py)?.len())
    }
    /// Name of the scene of world 0.
    #[getter]
    fn name(&self, py: Python<'_>) -> PyResult<String> {
        self.look(py, 0, |one| one.plan().scene.name.clone())
    }
    /// Name of the backend that runs.
    #[getter]
    fn backend(&self, py: Python<'_>) -> PyResult<String> {
        Ok(self.options(py)?.backend.clone())
    }
    /// "f32" or "f64".
    #[getter]
    fn precision(&self, py: Python<'_>) -> PyResult<String> {
        Ok(self.options(py)?.precision.to_string())
    }
    /// Number of particles of world 0.
    #[getter]
    fn particle_count(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.machine(py)?.world(0).particle_count())
    }
    /// When the scene of world 0 ends by its own account, `time.end` [s].
    #[getter]
    fn end(&self, py: Python<'_>) -> PyResult<f64> {
        self.look(py, 0, |one| one.plan().scene.time.end)
    }
    /// The scene as TOML, overrides included.
    #[pyo3(signature = (*, world=0))]
    fn scene(&self, py: Python<'_>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<String> {
        self.look(py, world, |one| one.plan().scene.to_toml())?.or_raise(py)
    }

    /// Reads particles, as a `Particles` record of arrays in one order. In f32 runs only what is asked for is read, and brought from a GPU.
    ///
    /// `fields` are names of what is read besides `position`: "velocity", "affine", "mass", "volume0", "id", "body", "material", "level"; without names, all
    /// but "affine". Others that files of particles have cost reading all of them: "density", "strain", "def_grad", "stress", and "history_LAW_NAME" for what a law remembers. Numbers
    /// are float64 in an f64 run, else float32. `region` is a box, ((x, y, z), (x, y, z)) [m]: particles outside are left out.
    #[pyo3(signature = (*fields, region=None, world=0))]
    fn particles<'py>(
        &self,
        py: Python<'py>,
        fields: &Bound<'py, PyTuple>,
        region: Option<Numbers<'py>>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let asked: Vec<String> = fields.extract()?;
        let names = if asked.is_empty() { USUAL.map(str::to_owned).to_vec() } else { asked };
        let region = region.map(|region| corners(&region, "((x, y, z), (x, y, z))")).transpose()?;
        let region = region.map(|[min, max]| Aabb { min, max });
        let is_read = |name: &String| READ.contains(&name.as_str());
        if self.options(py)?.precision == Precision::F64 || !names.iter().all(is_read) {
            let columns = |one: &World| {
                let fields = columns(one, &names)?;
                let is_wanted = |spot: &Spot| region.is_none_or(|region| region.contains(spot.position));
                Ok(fields.of(one.plan(), &one.ground_where(&is_wanted)))
            };
            let found: Result<_, String> = self.look(py, world, columns)?;
            let columns = found.map_err(PyValueError::new_err)?.or_raise(py)?;
            return records::columns(py, columns, None);
        }
        let has = |name: &str| names.iter().any(|one| one == name);
        let fields = Fields {
            exact: true,
            velocity: has("velocity"),
            affine: has("affine"),
            mass: has("mass"),
            volume0: has("volume0"),
            id: has("id"),
            body: has("body"),
            material: has("material"),
            level: has("level"),
        };
        let reading = self.look(py, world, |one| one.read(region, fields))?.or_raise(py)?;
        records::particles(py, reading)
    }

    /// The particles cut by a vertical plane, those less than half their width away from it, with their `pressure` [Pa]: a `Particles` record.
    ///
    /// `axis` is "y" for the plane y = at [m], or "x".
    ///
    /// Raises `PluginError` if a material does not tell its stress.
    #[pyo3(signature = (at, *, axis="y", world=0))]
    fn cut<'py>(
        &self,
        py: Python<'py>,
        at: f64,
        axis: &str,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let axis = match axis {
            "x" => 0,
            "y" => 1,
            _ => {
                return Err(PyValueError::new_err(format!(
                    "axis: '{axis}' is none for a vertical cut; use \"x\" or \"y\""
                )));
            }
        };
        if !at.is_finite() {
            return Err(PyValueError::new_err(format!("at: {at} is no place of a plane; give metres")));
        }
        let read = |one: &World| {
            // Within one of their sides.
            let near = one.ground_where(&|spot| (2.0 * (spot.position[axis] - at)).abs().powi(3) <= spot.volume0);
            let mut pressures = Vec::new();
            for list in &near.lists {
                let all: Vec<usize> = (0..list.len()).collect();
                pressures.extend(pressure(&one.plan().materials[list.material as usize], list, &all)?);
            }
            let fields = Columns::new(one.plan(), Some(&USUAL.map(str::to_owned)))?;
            Ok((fields.of(one.plan(), &near)?, pressures))
        };
        let (columns, pressures) = self.look(py, world, read)?.or_raise(py)?;
        records::columns(py, columns, Some(("pressure", records::vector(py, pressures))))
    }

    /// Heights of the surface of the soft ground at points, float64 of shape (n,) [m]; `points` has the shape (n, 2) [m].
    ///
    /// The surface is where, seen from above, particles first fill half of space. Where there is no ground, it is the world's floor; NaN if that is open. Tools
    /// and robots are not seen. Beyond the world's sides it is as high as beside them, or as at the other end of a periodic axis.
    #[pyo3(signature = (points, *, world=0))]
    fn height_scan<'py>(
        &self,
        py: Python<'py>,
        points: Numbers<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let points = self::points::<2>(&points)?;
        let heights = self.look(py, world, |one| one.heights(&points))?.or_raise(py)?;
        Ok(records::vector(py, heights.into_iter().map(|z| z.unwrap_or(f64::NAN)).collect()))
    }

    /// The same in all worlds, or in those in `worlds` (a number or a list), float64 of shape (worlds, n) [m]. `points` has the shape (n, 2) [m], or (worlds, n, 2) where
    /// each world has its own. On a GPU all worlds take one transfer.
    #[pyo3(signature = (points, *, worlds=None))]
    fn height_arrays<'py>(
        &self,
        py: Python<'py>,
        points: Numbers<'py>,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let mut machine = self.machine(py)?;
        let chosen = chosen(worlds, machine.len())?;
        let points = points_per_world(&points, chosen.len())?;
        let machine = &mut *machine;
        let heights = py.detach(|| machine.heights(points, &chosen)).or_raise(py)?;
        arrays::heights(py, &heights)
    }

    /// How far the particles and a cloud of points are from one another: a `Chamfer` record. `points` has the shape (n, 3) [m]. On a GPU it is found there.
    ///
    /// `material`, `body` (names of the scene's) and `level` (0 is the finest) let only some particles count.
    ///
    /// Raises `UnknownNameError` for a name that the scene does not have.
    #[pyo3(signature = (points, *, material=None, body=None, level=None, world=0))]
    fn chamfer<'py>(
        &self,
        py: Python<'py>,
        points: Numbers<'py>,
        material: Option<String>,
        body: Option<String>,
        level: Option<u32>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let points = self::points::<3>(&points)?;
        let [materials, bodies] = self.look(py, world, |one| {
            let scene = &one.plan().scene;
            let materials = scene.material.iter().map(|one| one.name.clone()).collect::<Vec<_>>();
            [materials, scene.body.iter().map(|one| one.name.clone()).collect()]
        })?;
        let known_names = [("material", &material, materials), ("body", &body, bodies)];
        for (kind, name, known) in known_names {
            let known: Vec<String> = known.into_iter().filter(|name| !name.is_empty()).collect();
            if let Some(name) = name.clone().filter(|name| !known.contains(name)) {
                return Err(raised(py, barchan::Error::Unknown { path: kind.to_owned(), kind, name, known }, None));
            }
        }
        let probe = Probe { material, body, level, ..Probe::default() };
        let ask = |one: &World| one.apart(&points, Filter::of(one.plan(), &probe));
        let apart = self.look(py, world, ask)?.or_raise(py)?;
        let distance =
            |(closest, point): (&Option<Closest>, &[f64; 3])| closest.map_or(f64::NAN, |c| c.distance(*point));
        let distances: Vec<f64> = apart.nearest.iter().zip(&points).map(distance).collect();
        let ids: Vec<u64> = apart.nearest.iter().map(|closest| closest.map_or(u64::MAX, |c| c.id)).collect();
        let [to_points, from_points] = apart.means(&points).unwrap_or([f64::NAN; 2]);
        let fields = [
            ("to_points", to_points.into_pyobject(py)?.into_any()),
            ("from_points", from_points.into_pyobject(py)?.into_any()),
            ("distances", records::vector(py, distances)),
            ("ids", records::vector(py, ids)),
        ];
        records::record(py, "Chamfer", &fields)
    }

    /// Heights of the surface over a rectangle, as `height_scan` gives them: a `HeightMap` record.
    ///
    /// `region` is ((x, y), (x, y)) [m], the world if it is not given; `cell` the distance of points [m], the finest cell width if it is not given. Points are at the centres of
    /// whole cells, from the least corner on.
    #[pyo3(signature = (region=None, cell=None, *, world=0))]
    fn height_map<'py>(
        &self,
        py: Python<'py>,
        region: Option<Numbers<'py>>,
        cell: Option<f64>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let bounds = self.look(py, world, |one| one.plan().scene.world.clone())?;
        let [min, max] = match &region {
            None => [bounds.min, bounds.max].map(|[x, y, _]| [x, y]),
            Some(region) => corners(region, "((x, y), (x, y))")?,
        };
        let cell = cell.unwrap_or(bounds.cell);
        let count = [0, 1].map(|d| ((max[d] - min[d]) / cell + 1e-6).floor());
        if !(cell > 0.0 && count.iter().all(|n| (1.0..=65_536.0).contains(n)) && count[0] * count[1] <= MOST_HEIGHTS) {
            return Err(PyValueError::new_err(format!(
                "region and cell: from {min:?} to {max:?} there are {count:?} cells of {cell} m; 1 to 65536 along each axis are possible, \
                 and {MOST_HEIGHTS} in all: give a smaller region or a wider cell"
            )));
        }
        let [x, y]: [Vec<f64>; 2] =
            [0, 1].map(|d| (0..count[d] as usize).map(|i| min[d] + cell * (i as f64 + 0.5)).collect());
        let points: Vec<[f64; 2]> = x.iter().flat_map(|&x| y.iter().map(move |&y| [x, y])).collect();
        let heights = self.look(py, world, |one| one.heights(&points))?.or_raise(py)?;
        let heights: Vec<f64> = heights.into_iter().map(|z| z.unwrap_or(f64::NAN)).collect();
        let heights = PyArray1::from_vec(py, heights).reshape([x.len(), y.len()])?.into_any();
        let fields = [("heights", heights), ("x", records::vector(py, x)), ("y", records::vector(py, y))];
        records::record(py, "HeightMap", &fields)
    }

    /// Tools, free bodies and links of robots by name, in the scene's order: `Body` records.
    #[pyo3(signature = (*, world=0))]
    fn bodies<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for body in self.look(py, world, World::bodies)? {
            all.set_item(body.name.clone(), records::body(py, body)?)?;
        }
        Ok(all)
    }

    /// Mean force and torque of the soft ground on each of `bodies` over the last step, by name: `Wrench` records.
    #[pyo3(signature = (*, world=0))]
    fn wrenches<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (bodies, wrenches) = self.look(py, world, |one| (one.bodies(), one.wrenches()))?;
        let all = PyDict::new(py);
        for (body, wrench) in bodies.iter().zip(&wrenches) {
            all.set_item(&body.name, records::wrench(py, wrench)?)?;
        }
        Ok(all)
    }

    /// Robots by name, with their joints, their links and what they sense: `Robot` records.
    #[pyo3(signature = (*, world=0))]
    fn robots<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (robots, joints) = self.look(py, world, |one| (one.robots(), one.joints()))?;
        let all = PyDict::new(py);
        for robot in robots {
            all.set_item(robot.name.clone(), records::robot(py, robot, &joints)?)?;
        }
        Ok(all)
    }

    /// What a robot does and feels in all worlds, or in those in `worlds` (a number or a list): a `RobotArrays` record, with a row for each of them.
    ///
    /// With `scan=True` it holds the `heights` of the ground around, too, as `scan` gives them; on a GPU all worlds take one transfer for it.
    ///
    /// Raises `BodyError` if there is no such robot, or its entry has no `scan`.
    #[pyo3(signature = (robot, *, scan=false, worlds=None))]
    fn robot_arrays<'py>(
        &self,
        py: Python<'py>,
        robot: &str,
        scan: bool,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let mut machine = self.machine(py)?;
        let chosen = chosen(worlds, machine.len())?;
        let machine = &mut *machine;
        let ask = || {
            let of_world = |&world: &usize| {
                let one = machine.world(world);
                let joints = one.joints().into_iter().filter(|joint| joint.body == robot);
                Ok((one.robot(robot)?, joints.collect::<Vec<_>>()))
            };
            let all = chosen.iter().map(of_world).collect::<barchan::Result<Vec<_>>>()?;
            let scans = if scan { Some(machine.scans(robot, &chosen)?) } else { None };
            Ok((all, scans))
        };
        let (all, scans) = py.detach(ask).or_raise(py)?;
        arrays::robots(py, &all, scans.as_deref())
    }

    /// What a tool, a free body or a link of a robot does in all worlds, or in those in `worlds` (a number or a list), and the wrench of the soft ground on it: a `BodyArrays`
    /// record, with a row for each of them.
    ///
    /// Raises `BodyError` if there is no such body.
    #[pyo3(signature = (body, *, worlds=None))]
    fn body_arrays<'py>(
        &self,
        py: Python<'py>,
        body: &str,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let mut machine = self.machine(py)?;
        let chosen = chosen(worlds, machine.len())?;
        let machine = &mut *machine;
        // Moved, as in `look`.
        let ask =
            move || chosen.iter().map(|&world| machine.world(world).body(body)).collect::<barchan::Result<Vec<_>>>();
        arrays::bodies(py, &py.detach(ask).or_raise(py)?)
    }

    /// Where a robot's links are touched by the ground or by what is rigid, as `Patch` records by their names; links that feel no force above `least` [N] are left out.
    ///
    /// Raises `BodyError` if there is no such robot.
    #[pyo3(signature = (robot, *, least=1.0, world=0))]
    fn patches<'py>(
        &self,
        py: Python<'py>,
        robot: &str,
        least: f64,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let ask = |one: &World| Ok((one.robot(robot)?.links, one.patches(robot, least)?));
        let (links, patches) = self.look(py, world, ask)?.or_raise(py)?;
        records::patches(py, &links, patches)
    }

    /// Heights of the ground at the points around a robot that its `scan` in the scene gives, below its base: a `HeightScan` record. The points turn with the
    /// base about the vertical, but stay level. Tools that stay where they are count as ground.
    ///
    /// Raises `BodyError` if there is no such robot, or its entry has no `scan`.
    #[pyo3(signature = (robot, *, world=0))]
    fn scan<'py>(
        &self,
        py: Python<'py>,
        robot: &str,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let scan = self.look(py, world, |one| one.scan(robot))?.or_raise(py)?;
        let heights = scan.heights.into_iter().map(|z| z.unwrap_or(f64::NAN)).collect();
        let fields = [("points", records::rows(py, scan.points)?), ("heights", records::vector(py, heights))];
        records::record(py, "HeightScan", &fields)
    }

    /// Tells a body what to do from now on: a driven tool to move at `linear` [m/s] and turn at `angular` [rad/s], both (3,) in world axes and 0 if not
    /// given; a robot to bring its joints to `joint_targets` [rad or m], or to act on them with `joint_torques` [N m or N], both (joints,).
    ///
    /// With `joint_rates` [rad/s or m/s], (joints,), or with both targets and torques, motors give kp (target - position) + kd (rate - the joint's) + torque: wheels turn by rates alone
    /// if their motors have kd and no kp. With torques alone kp and kd do not act.
    ///
    /// Every world is told the same, those in `worlds` only (a number or a list), or each its own if arrays have a row for each of them.
    ///
    /// Raises `BodyError` if there is no such body, it takes no such command, or numbers are not finite. Of several worlds, those before the one that refuses
    /// have been told then.
    #[pyo3(signature = (body, *, linear=None, angular=None, joint_targets=None, joint_rates=None, joint_torques=None, worlds=None))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn act(
        &self,
        py: Python<'_>,
        body: &str,
        linear: Option<Numbers<'_>>,
        angular: Option<Numbers<'_>>,
        joint_targets: Option<Numbers<'_>>,
        joint_rates: Option<Numbers<'_>>,
        joint_torques: Option<Numbers<'_>>,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let worlds = chosen(worlds, machine.len())?;
        let moves_joints = joint_targets.is_some() || joint_rates.is_some() || joint_torques.is_some();
        if moves_joints == (linear.is_some() || angular.is_some()) {
            let what = "give one command: linear and angular, or joint_targets, joint_rates and joint_torques";
            return Err(PyTypeError::new_err(what));
        }
        let rows = |values: &Option<_>, what| per_world(values.as_ref(), what, worlds.len());
        let all = rows(&linear, "linear")?.into_iter().zip(rows(&angular, "angular")?);
        let joints = rows(&joint_targets, "joint_targets")?.into_iter().zip(rows(&joint_rates, "joint_rates")?);
        let joints = joints.zip(rows(&joint_torques, "joint_torques")?);
        let command = |((linear, angular), ((targets, rates), torques))| {
            Ok(match (targets, rates, torques) {
                (None, None, None) => {
                    Command::Twist { linear: axes(linear, "linear")?, angular: axes(angular, "angular")? }
                }
                (None, None, Some(torques)) => Command::JointTorques(torques),
                (targets, rates, torques) => Command::JointMotion { targets, rates, torques },
            })
        };
        let commands = all.zip(joints).map(command).collect::<PyResult<Vec<_>>>()?;
        tell(py, machine.len(), worlds, commands, |world, command| machine.world_mut(world).act(body, command))
    }

    /// Gives a robot, a link of one, or a free tool a blow, once: an `impulse` [N s] through its centre of mass and an `angular` impulse [N m s], both (3,) in world axes. A
    /// robot takes it at its base. What it is told besides goes on.
    ///
    /// Every world gets the same, those in `worlds` only (a number or a list), or each its own if arrays have a row for each of them.
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
        let mut machine = self.machine(py)?;
        let worlds = chosen(worlds, machine.len())?;
        let blows = blows(&impulse, angular.as_ref(), worlds.len())?;
        tell(py, machine.len(), worlds, blows, |world, command| machine.world_mut(world).act(body, command))
    }

    /// Puts a robot, a free tool, or a tool that is driven by velocity elsewhere, at once. What is left out stays as it is, and what it is told besides goes on.
    ///
    /// Parameters
    /// ----------
    /// body
    ///     Its name; a robot's links go with it.
    /// position
    ///     Origin of a robot's base frame; a free tool's centre of mass; a driven tool's origin [m], (3,).
    /// rotation
    ///     Orientation quaternion (w, x, y, z), (4,).
    /// velocity, angular_velocity
    ///     Of that point [m/s] and [rad/s], (3,), along the world's axes.
    /// joints, joint_rates
    ///     Of a robot, in the order of its joint_names [rad or m] and [rad/s or m/s], (joints,).
    /// worlds
    ///     A number or a list; all, if left out. Arrays with a row for each of them give each its own.
    ///
    /// Ground stays where it is, also what comes to be within the body: a body at rest does not push it out. Put bodies above the ground. Motors go on to what they were told last, at first to where joints are at the start of the scene.
    ///
    /// Raises `BodyError` if there is no such body, it cannot be there or move that way, or numbers do not fit. Of several worlds, others may have been changed then.
    #[pyo3(signature = (
        body, *, position=None, rotation=None, velocity=None, angular_velocity=None, joints=None, joint_rates=None, worlds=None
    ))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn place(
        &self,
        py: Python<'_>,
        body: &str,
        position: Option<Numbers<'_>>,
        rotation: Option<Numbers<'_>>,
        velocity: Option<Numbers<'_>>,
        angular_velocity: Option<Numbers<'_>>,
        joints: Option<Numbers<'_>>,
        joint_rates: Option<Numbers<'_>>,
        worlds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let worlds = chosen(worlds, machine.len())?;
        let given = [position, rotation, velocity, angular_velocity, joints, joint_rates];
        let placements = placements(given, worlds.len())?;
        tell(py, machine.len(), worlds, placements, |world, command| machine.world_mut(world).act(body, command))
    }

    /// Gives some particles of a world other places [m], velocities [m/s] or affine matrices C, row by row [1/s]: those whose numbers are `id`, (n,), as `Particles.id` and
    /// `Tape.start.id` tell them, a row each. What is left out stays, and so do strain and mass.
    ///
    /// Raises `BodyError` for a number that no particle has or that comes twice, for places outside the world, for what is not finite, and for places on several levels. Then none is
    /// changed.
    #[pyo3(signature = (id, *, position=None, velocity=None, affine=None, world=0))]
    fn set_particles(
        &self,
        py: Python<'_>,
        id: Vec<u64>,
        position: Option<Numbers<'_>>,
        velocity: Option<Numbers<'_>>,
        affine: Option<Numbers<'_>>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        check_world(world, machine.len())?;
        let change = Change::new(id, [position, velocity, affine])?;
        let machine = &mut *machine;
        py.detach(|| change.apply(machine.world_mut(world))).or_raise(py)
    }

    /// Sets worlds back to their start: all, or those in `worlds` (a number or a list). With `seeds`, a number from which they count or
    /// one for each of them, they start from these random seeds instead of those that they have. With `overrides`, a dict or a list with one for each of them, their scenes change from there on.
    #[pyo3(signature = (worlds=None, seeds=None, *, overrides=None))]
    fn reset(
        &self,
        py: Python<'_>,
        worlds: Option<&Bound<'_, PyAny>>,
        seeds: Option<&Bound<'_, PyAny>>,
        overrides: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let chosen = chosen(worlds, machine.len())?;
        let seeds = seeds.map(|seeds| first_or_each(seeds, chosen.len())).transpose()?;
        let overrides = scene::each(overrides, chosen.len())?;
        let (registry, options) = (known(py)?, self.options(py)?.clone());
        let machine = &mut *machine;
        // Before any of them begins anew.
        let scene = |(i, &world): (usize, &usize)| {
            let now = &machine.world(world).plan().scene;
            let scene = overrides[i].as_ref().map_or_else(|| Ok(now.clone()), |one| scene::changed(now, one))?;
            let seed = seeds.as_ref().map_or(scene.seed, |seeds| seeds[i]);
            Ok((world, Scene { seed, ..scene }))
        };
        let scenes = chosen.iter().enumerate().map(scene).collect::<PyResult<Vec<_>>>()?;
        let set = || match machine {
            Machine::One(simulation) => scenes.into_iter().try_for_each(|(_, scene)| {
                World::new(&registry, &scene, &options).map(|new| **simulation = new).map_err(|error| (None, error))
            }),
            Machine::Many(worlds) => worlds.reset_all(scenes).map_err(|(world, error)| (Some(world), error)),
        };
        py.detach(set).map_err(|(world, error)| raised(py, error, world))
    }

    /// Takes a copy of a world in memory, to `restore` it later.
    #[pyo3(signature = (*, world=0))]
    fn state(&self, py: Python<'_>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<State> {
        Ok(State { state: self.look(py, world, World::state)?.or_raise(py)? })
    }

    /// Goes back to a state: what follows is bit for bit what followed then. It is set in all worlds, or in those in `worlds` (a number or a list). A world takes over the
    /// state's random seed. What is drawn and written of the scene may differ, as may its name and end.
    ///
    /// Raises `BodyError` if it is a state of another scene or precision. No world has gone back then.
    #[pyo3(signature = (state, *, worlds=None))]
    fn restore(&self, py: Python<'_>, state: &State, worlds: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let chosen = chosen(worlds, machine.len())?;
        let (registry, options, state) = (known(py)?, self.options(py)?.clone(), &state.state);
        let machine = &mut *machine;
        let restore = || match machine {
            Machine::One(simulation) => simulation.restore(&registry, state, &options),
            Machine::Many(worlds) => worlds.restore(&chosen.iter().map(|&world| (world, state)).collect::<Vec<_>>()),
        };
        py.detach(restore).or_raise(py)
    }

    /// Another simulation that goes on from a world as it is now, on its own: one world, on the same backend.
    #[pyo3(signature = (*, world=0))]
    fn fork(&self, py: Python<'_>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Self> {
        let state = self.look(py, world, World::state)?.or_raise(py)?;
        let options = self.options(py)?.clone();
        Self::from_state(py, &state, options)
    }

    /// Makes worlds copies of world `source`, which then go on as it does: those in `targets` (a number or a list). On a GPU nothing leaves it. They take over its random
    /// seed, too, and so the start to which `reset` brings them.
    fn copy_world(
        &self,
        py: Python<'_>,
        #[pyo3(from_py_with = number)] source: usize,
        targets: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        check_world(source, machine.len())?;
        let targets = chosen(Some(targets), machine.len())?;
        if let Machine::Many(worlds) = &mut *machine {
            py.detach(|| targets.into_iter().try_for_each(|target| worlds.fork(source, target))).or_raise(py)?;
        }
        Ok(())
    }

    /// Writes a world to a file, from which `Simulation.load` and the command line's `--resume` go on bit for bit.
    ///
    /// Raises `FileError` if it cannot be written; an older file of that name is intact then.
    #[pyo3(signature = (path, *, world=0))]
    fn save(&self, py: Python<'_>, path: PathBuf, #[pyo3(from_py_with = number)] world: usize) -> PyResult<()> {
        self.look(py, world, |one| one.save(&path))?.or_raise(py)
    }

    /// Goes on with another backend or precision from the next step on. Particles, bodies, time and ledger are kept.
    ///
    /// Raises `UnknownNameError` or `PluginError` if the backend is not there or lacks something that the scene calls for, and `ValueError` for more than one world.
    #[pyo3(signature = (backend, *, precision=None, adapter=None))]
    fn swap(
        &self,
        py: Python<'_>,
        backend: &str,
        precision: Option<&str>,
        adapter: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut machine = self.machine(py)?;
        let Machine::One(simulation) = &mut *machine else {
            return Err(PyValueError::new_err(
                "swap: worlds of a batch stay on their backend; swap a fork(world=...) of one of them",
            ));
        };
        let mut options = self.options(py)?.clone();
        (options.backend, options.adapter) = (backend.to_owned(), adapter.map(named).transpose()?);
        if let Some(text) = precision {
            options.precision = self::precision(text)?;
        }
        let registry = known(py)?;
        py.detach(|| simulation.swap(&registry, &options)).or_raise(py)?;
        *self.options(py)? = options;
        Ok(())
    }

    /// What the scene calls for and why, and what a step does: a `Plan` record; print it.
    #[pyo3(signature = (*, world=0))]
    fn plan<'py>(&self, py: Python<'py>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Bound<'py, PyAny>> {
        let plan = self.look(py, world, |one| one.plan().clone())?;
        records::plan(py, &plan)
    }

    /// Totals of mass [kg], momentum [kg m/s], energy [J] and others, and "counts" of everything that was clamped, floored, cut or lost since the start: a
    /// dict. "elastic" is None if a material does not tell its energy.
    #[pyo3(signature = (*, world=0))]
    fn ledger<'py>(&self, py: Python<'py>, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Bound<'py, PyAny>> {
        let ledger = self.look(py, world, World::ledger)?;
        let value =
            serde_json::to_value(&ledger).map_err(|e| exception(py, "BarchanError", &format!("ledger: {e}")))?;
        records::json(py, &value)
    }

    /// What tools, free bodies and robots look like now: a list of `Surface` records, triangles and where they are.
    #[pyo3(signature = (*, world=0))]
    fn surfaces<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let seen = |one: &World| -> Vec<_> { one.couplings().iter().flat_map(|one| one.surfaces()).collect() };
        self.look(py, world, seen)?.into_iter().map(|surface| records::surface(py, &surface)).collect()
    }

    /// Where the levels of the grid are but the coarsest, which has the rest, finest first: for each an array of the least and the greatest corners of its boxes [m], float64 of shape (boxes, 2, 3).
    #[pyo3(signature = (*, world=0))]
    fn level_boxes<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let seen = |one: &World| (one.ground_where(&|_| false).levels, one.plan().cell_widths.clone());
        let (phase, widths) = self.look(py, world, seen)?;
        let all = phase.iter().flat_map(|phase| phase.boxes.iter().zip(&widths));
        all.map(|(boxes, width)| {
            let corners: Vec<[f64; 3]> = boxes
                .iter()
                .flat_map(|one| [one.min, one.max])
                .map(|cell| cell.map(|c| f64::from(c) * width))
                .collect();
            let flat = PyArray1::from_vec(py, corners.into_flattened());
            Ok(flat.reshape([boxes.len(), 2, 3])?.into_any())
        })
        .collect()
    }

    /// What the scene's probes find in a world now: by name of the probe, a dict from column, with its unit, to value. NaN where there is nothing to measure.
    ///
    /// Raises `PluginError` if a material does not tell the stress that a probe asks for.
    #[pyo3(signature = (*, world=0))]
    fn probes<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for probed in self.look(py, world, |one| one.probes(|_| true))?.or_raise(py)? {
            let columns = PyDict::new(py);
            for (column, value) in probed.values {
                columns.set_item(column, value.unwrap_or(f64::NAN))?;
            }
            all.set_item(probed.name, columns)?;
        }
        Ok(all)
    }

    /// Wall time that every effect has taken in a world since it was made [s], by name.
    #[pyo3(signature = (*, world=0))]
    fn timing<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for timing in self.look(py, world, World::timings)? {
            all.set_item(timing.effect, timing.seconds)?;
        }
        Ok(all)
    }

    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err(
            "a Simulation cannot be pickled; make it in the process that needs it, or save() it and load() it there",
        ))
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let Ok(machine) = self.machine(py) else {
            return Ok(format!("<barchan.Simulation of '{}', busy>", self.scene.name));
        };
        let options = self.options(py)?;
        let worlds = if machine.len() == 1 { String::new() } else { format!("{} worlds of ", machine.len()) };
        let world = machine.world(0);
        Ok(format!(
            "<barchan.Simulation of '{}': {worlds}{} particles, t = {:.6} s, step {}, {} {}>",
            self.scene.name,
            world.particle_count(),
            world.time(),
            world.step_count(),
            options.backend,
            options.precision
        ))
    }
}
