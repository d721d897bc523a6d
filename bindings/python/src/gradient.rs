//! Gradients: the classes `Tape` and `Gradient`.

use crate::errors::OrRaise;
use crate::given::{Numbers, axes, check_finite, rows};
use crate::machine::SLICE;
use crate::records;
use barchan::gradient::{BodyCotangents, BodyGradient, Moment, RobotCotangents, RobotGradient};
use barchan::{Cotangents, Plan, Vec3};
use numpy::PyArray1;
use pyo3::IntoPyObjectExt;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::ops::ControlFlow;
use std::time::Instant;

/// Asks for signals now and then, and breaks off when there is one.
pub(crate) struct Signals {
    looked: Instant,
    raised: PyResult<()>,
}

impl Signals {
    pub(crate) fn new() -> Self {
        Self { looked: Instant::now(), raised: Ok(()) }
    }

    pub(crate) fn look(&mut self) -> ControlFlow<()> {
        if self.looked.elapsed() >= SLICE {
            self.raised = Python::attach(|py| py.check_signals());
            self.looked = Instant::now();
        }
        if self.raised.is_err() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    /// What has been raised, if anything.
    pub(crate) fn raised(self) -> PyResult<()> {
        self.raised
    }
}

/// Steps that gradients can go back through: what `Simulation.record` returns.
///
/// Particles are in the order of their numbers (`id`), at the start and at the end alike.
#[pyclass(module = "barchan", frozen)]
pub(crate) struct Tape {
    pub(crate) tape: barchan::Tape,
}

/// Adds the rows of a cotangent, if there are any.
fn cotangent(given: Option<&Numbers<'_>>, what: &str, to: &mut [Vec3]) -> PyResult<()> {
    let rows = rows::<3>(given, what, to.len(), "of their numbers")?.unwrap_or_default();
    given.map_or(Ok(()), |given| check_finite(given, what))?;
    to.iter_mut().zip(rows).for_each(|(to, row)| (0..3).for_each(|d| to[d] += row[d]));
    Ok(())
}

/// A dict of dicts of numbers, as it is given for `what`: names, and what each has.
fn named_dicts<'py>(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Vec<(String, Bound<'py, PyDict>)>> {
    let wrong = || PyTypeError::new_err(format!("{what}: give a dict by names, of dicts by what the loss owes to"));
    let given = given.cast::<PyDict>().map_err(|_| wrong())?;
    let one = |(name, owed): (Bound<'py, PyAny>, Bound<'py, PyAny>)| {
        let name: String = name.extract().map_err(|_| wrong())?;
        Ok((name, owed.cast_into::<PyDict>().map_err(|_| wrong())?))
    };
    given.iter().map(one).collect()
}

/// The number of what is called so among those that there are.
fn number_of<'a>(names: impl Iterator<Item = &'a str>, name: &str, what: &str) -> PyResult<usize> {
    let known: Vec<&str> = names.collect();
    known.iter().position(|one| *one == name).ok_or_else(|| {
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        PyValueError::new_err(format!("{what}: there is no '{name}'; there are: {known}"))
    })
}

/// What a loss owes to bodies, by their names: a dict for each, of three numbers by what it is by.
fn of_bodies(given: &Bound<'_, PyAny>, end: &Moment, to: &mut [BodyCotangents]) -> PyResult<()> {
    for (name, owed) in named_dicts(given, "bodies")? {
        let number = number_of(end.bodies.iter().map(|body| body.name.as_str()), &name, "bodies")?;
        let to = &mut to[number];
        for (what, numbers) in owed {
            let what: String = what.extract()?;
            let sum = match what.as_str() {
                "position" => &mut to.pose.position,
                "rotation" => &mut to.pose.rotation,
                "velocity" => &mut to.velocity,
                "angular_velocity" => &mut to.angular_velocity,
                "impulse" => &mut to.impulse.force,
                "angular_impulse" => &mut to.impulse.torque,
                _ => {
                    return Err(PyValueError::new_err(format!(
                        "bodies: '{name}' has no derivative by '{what}'; give position, rotation, velocity, angular_velocity, impulse or angular_impulse"
                    )));
                }
            };
            let numbers: Numbers<'_> = numbers.extract()?;
            let numbers = axes(Some(numbers.as_array().iter().copied().collect()), &format!("bodies: {name}: {what}"))?;
            (0..3).for_each(|d| sum[d] += numbers[d]);
        }
    }
    Ok(())
}

/// What a loss owes to robots' joints, by the robots' names: a dict for each, of a number for each joint.
fn of_robots(given: &Bound<'_, PyAny>, end: &Moment, to: &mut [RobotCotangents]) -> PyResult<()> {
    for (name, owed) in named_dicts(given, "robots")? {
        let number = number_of(end.robots.iter().map(|robot| robot.name.as_str()), &name, "robots")?;
        let (to, joints) = (&mut to[number], end.robots[number].positions.len());
        for (what, numbers) in owed {
            let what: String = what.extract()?;
            let sums = match what.as_str() {
                "positions" => &mut to.positions,
                "rates" => &mut to.rates,
                _ => {
                    return Err(PyValueError::new_err(format!(
                        "robots: '{name}' has no derivative by '{what}'; give positions or rates, and its base and links in bodies"
                    )));
                }
            };
            let numbers: Numbers<'_> = numbers.extract()?;
            let numbers = numbers.as_array();
            let shape = numbers.shape();
            if shape != [joints] {
                return Err(PyValueError::new_err(format!(
                    "robots: {name}: {what}: the shape is {shape:?}; give a number for each of its {joints} joints"
                )));
            }
            sums.resize(joints, 0.0);
            sums.iter_mut().zip(&numbers).for_each(|(sum, number)| *sum += number);
        }
    }
    Ok(())
}

fn moment<'py>(py: Python<'py>, moment: &Moment) -> PyResult<Bound<'py, PyAny>> {
    let fields = [
        ("id", records::vector(py, moment.id.clone())),
        ("body", records::vector(py, moment.body.clone())),
        ("material", records::vector(py, moment.material.clone())),
        ("mass", records::vector(py, moment.mass.clone())),
        ("position", records::rows(py, moment.position.clone())?),
        ("velocity", records::rows(py, moment.velocity.clone())?),
        ("affine", records::rows(py, moment.affine.clone())?),
    ];
    records::record(py, "Particles", &fields)
}

#[pymethods]
impl Tape {
    /// The particles at its start: `id`, `body`, `material`, `mass` [kg], `position` [m], `velocity` [m/s] and `affine` [1/s] of a `Particles` record.
    #[getter]
    fn start<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        moment(py, self.tape.start())
    }

    /// The particles at its end, likewise.
    #[getter]
    fn end<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        moment(py, self.tape.end())
    }

    /// Lengths of its steps [s], (len,).
    #[getter]
    fn dt<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_vec(py, self.tape.lengths())
    }

    /// Impulse of the ground on each of the scene's tools over its steps [N s], and angular impulse about its position [N m s], by name: `Impulse` records.
    #[getter]
    fn impulses<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for (body, impulse) in self.tape.end().bodies.iter().zip(self.tape.impulses()) {
            let fields = [
                ("impulse", records::triple(py, impulse.force)),
                ("angular_impulse", records::triple(py, impulse.torque)),
            ];
            all.set_item(&body.name, records::record(py, "Impulse", &fields)?)?;
        }
        Ok(all)
    }

    /// What a loss owes to what was at the start and throughout: a `Gradient`. Its derivatives by the particles at the end are given, as arrays of the shape (n, 3), one row for
    /// each particle in the order of `end`: by `position` [1/m] and by `velocity` [s/m]. What is left out is zero. `bodies` has derivatives by tools: a dict by their names, of dicts of three numbers. At the end there are `position` [1/m], that of `Simulation.bodies`, `rotation`, as a small turn
    /// about the world's axes [1/rad], `velocity` [s/m] and `angular_velocity` [s/rad]; over the tape there are `impulse` [1/(N s)] and `angular_impulse`
    /// [1/(N m s)], as in `impulses`: of this tape alone, also where `then` is given. A robot's base and links are among the bodies; `robots` has derivatives by joints: a dict by robots' names, of dicts with
    /// `positions` [1/rad or 1/m] and `rates` [s/rad or s/m], a number for each joint. `then` is the gradient of the tape that follows on this one, if the loss looks
    /// further.
    ///
    /// It takes all steps twice again, and goes back through each, which takes some fifty times as long as a step. Ctrl-C ends it.
    ///
    /// Raises `BodyError` if a derivative is not finite, `SimulationError` if one of a law is not.
    #[pyo3(signature = (*, position=None, velocity=None, bodies=None, robots=None, then=None))]
    fn pull_back(
        &self,
        py: Python<'_>,
        position: Option<Numbers<'_>>,
        velocity: Option<Numbers<'_>>,
        bodies: Option<&Bound<'_, PyAny>>,
        robots: Option<&Bound<'_, PyAny>>,
        then: Option<&Bound<'_, Gradient>>,
    ) -> PyResult<Gradient> {
        let particles = self.tape.end().id.len();
        if position.is_none() && velocity.is_none() && bodies.is_none() && robots.is_none() && then.is_none() {
            return Err(PyTypeError::new_err(
                "it is not said what the loss owes to; give position, velocity, bodies, robots or then",
            ));
        }
        let mut cotangents = match then.map(Bound::get) {
            Some(then) if then.start != *self.tape.end() => {
                return Err(PyValueError::new_err(
                    "then: it does not begin where this tape ends, at the same time, with all particles and tools where they are and as fast; record one tape behind the other, and place, set and push nothing between them",
                ));
            }
            Some(then) => then.gradient.particles.clone(),
            None => Cotangents::zero(particles),
        };
        cotangent(position.as_ref(), "position", &mut cotangents.position)?;
        cotangent(velocity.as_ref(), "velocity", &mut cotangents.velocity)?;
        if let Some(bodies) = bodies {
            cotangents.bodies.resize_with(self.tape.end().bodies.len(), BodyCotangents::default);
            of_bodies(bodies, self.tape.end(), &mut cotangents.bodies)?;
        }
        if let Some(robots) = robots {
            cotangents.robots.resize_with(self.tape.end().robots.len(), RobotCotangents::default);
            of_robots(robots, self.tape.end(), &mut cotangents.robots)?;
        }
        let mut signals = Signals::new();
        let gradient = py.detach(|| self.tape.pull_back_while(cotangents, &mut |_| signals.look())).or_raise(py)?;
        signals.raised()?;
        let gradient = gradient.expect("only a signal breaks it off");
        let mut gradient = Gradient {
            parameters: named(self.tape.plan(), &gradient.parameters),
            start: self.tape.start().clone(),
            gradient,
        };
        if let Some(then) = then {
            gradient.add(then.get());
        }
        Ok(gradient)
    }

    fn __len__(&self) -> usize {
        self.tape.len()
    }
    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err("a Tape cannot be pickled; record the steps in the process that needs it"))
    }
    fn __repr__(&self) -> String {
        let (steps, particles) = (self.tape.len(), self.tape.end().id.len());
        format!("<barchan.Tape of '{}': {steps} steps of {particles} particles>", self.tape.plan().scene.name)
    }
}

/// Derivatives by parameters, with names of materials and parameters.
type Named = Vec<(String, Vec<(String, f64)>)>;

fn named(plan: &Plan, parameters: &[Vec<f64>]) -> Named {
    let of_one = |(planned, values): (&barchan::plan::PlannedMaterial, &Vec<f64>)| {
        let names = planned.material.parameters.iter().map(|parameter| parameter.name.clone());
        (planned.name.clone(), names.zip(values.iter().copied()).collect())
    };
    plan.materials.iter().zip(parameters).map(of_one).collect()
}

/// What a loss owes to what was at the start of a tape, and throughout: what `Tape.pull_back` returns. Where the tape is followed by another one (`then`), it is of both.
#[pyclass(module = "barchan", frozen)]
pub(crate) struct Gradient {
    gradient: barchan::Gradient,
    parameters: Named,
    /// What the particles were that it is by.
    start: Moment,
}

impl Gradient {
    /// Adds what a tape that follows owes to what is the same throughout.
    fn add(&mut self, then: &Self) {
        (0..3).for_each(|d| self.gradient.gravity[d] += then.gradient.gravity[d]);
        for ((_, own), (_, other)) in self.parameters.iter_mut().zip(&then.parameters) {
            own.iter_mut().zip(other).for_each(|((_, sum), (_, more))| *sum += more);
        }
        for (own, other) in self.gradient.bodies.iter_mut().zip(&then.gradient.bodies) {
            let both = own.keyframes.as_flattened_mut().iter_mut().zip(other.keyframes.as_flattened());
            both.for_each(|(sum, more)| *sum += more);
            own.friction += other.friction;
            own.mass += other.mass;
            own.force += other.force;
        }
        for (own, other) in self.gradient.robots.iter_mut().zip(&then.gradient.robots) {
            let gains = [(&mut own.kp, &other.kp), (&mut own.kd, &other.kd)];
            gains.into_iter().for_each(|(own, other)| own.iter_mut().zip(other).for_each(|(sum, more)| *sum += more));
        }
    }
}

#[pymethods]
impl Gradient {
    /// By the positions of the particles at the start [1/m], (n, 3), in the order of their numbers.
    #[getter]
    fn position<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::rows(py, self.gradient.particles.position.clone())
    }

    /// By their velocities [s/m], (n, 3).
    #[getter]
    fn velocity<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::rows(py, self.gradient.particles.velocity.clone())
    }

    /// By their affine matrices C, row by row [s], (n, 9): a body that spins starts with one, besides the velocities.
    #[getter]
    fn affine<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        records::rows(py, self.gradient.particles.affine.clone())
    }

    /// By the scene's gravity [s²/m], (3,).
    #[getter]
    fn gravity<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.gradient.gravity)
    }

    /// By the parameters of materials, in SI units: a dict by the material's name, of dicts by the parameter's. It is 0 for those that are not differentiable. Materials
    /// that no particle had on the way are left out.
    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for (material, values) in &self.parameters {
            let of_one = PyDict::new(py);
            values.iter().try_for_each(|(name, value)| of_one.set_item(name, value))?;
            all.set_item(material, of_one)?;
        }
        Ok(all)
    }

    /// By the scene's tools, robots and their links, by name: `BodyGradient` records. The velocities that a tool was told are this tape's alone; its keyframes, friction, mass and force are of all that follow (`then`) as well.
    #[getter]
    fn bodies<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        let both = self.gradient.particles.bodies.iter().zip(&self.gradient.bodies);
        for (body, (BodyCotangents { pose, velocity, angular_velocity, .. }, told)) in
            self.start.bodies.iter().zip(both)
        {
            let BodyGradient { linear, angular, keyframes, friction, mass, force } = told;
            let fields = [
                ("position", records::triple(py, pose.position)),
                ("rotation", records::triple(py, pose.rotation)),
                ("velocity", records::triple(py, *velocity)),
                ("angular_velocity", records::triple(py, *angular_velocity)),
                ("linear", records::triple(py, *linear)),
                ("angular", records::triple(py, *angular)),
                ("keyframes", records::rows(py, keyframes.clone())?),
                ("friction", friction.into_bound_py_any(py)?),
                ("mass", mass.into_bound_py_any(py)?),
                ("force", force.into_bound_py_any(py)?),
            ];
            all.set_item(&body.name, records::record(py, "BodyGradient", &fields)?)?;
        }
        Ok(all)
    }

    /// By the scene's robots, by name: `RobotGradient` records. What motors were told is this tape's alone; the gains are of all that follow (`then`) as well.
    #[getter]
    fn robots<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        let both = self.gradient.particles.robots.iter().zip(&self.gradient.robots);
        for (robot, (RobotCotangents { positions, rates, .. }, told)) in self.start.robots.iter().zip(both) {
            let RobotGradient { targets, rates: target_rates, torques, kp, kd } = told;
            let own = [
                ("positions", positions),
                ("rates", rates),
                ("targets", targets),
                ("target_rates", target_rates),
                ("torques", torques),
                ("kp", kp),
                ("kd", kd),
            ];
            let fields = own.map(|(name, numbers)| (name, records::vector(py, numbers.clone())));
            all.set_item(&robot.name, records::record(py, "RobotGradient", &fields)?)?;
        }
        Ok(all)
    }

    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err("a Gradient cannot be pickled; its arrays can"))
    }
    fn __repr__(&self) -> String {
        format!("<barchan.Gradient by {} particles>", self.gradient.particles.len())
    }
}
