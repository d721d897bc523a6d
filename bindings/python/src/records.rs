//! What simulations say, as the records of `barchan/records.py`. Every array is a copy.

use barchan::export::{Column, Values};
use barchan::surface::Surface;
use barchan::{BodyState, JointState, LinkState, Patch, Plan, Reading, RobotState, Task, Vec3, Wrench};
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::IntoPyObjectExt;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::Value;

/// A field of a record.
type Field<'py> = (&'static str, Bound<'py, PyAny>);

/// An array of one dimension.
pub(crate) fn vector<T: Element>(py: Python<'_>, values: Vec<T>) -> Bound<'_, PyAny> {
    PyArray1::from_vec(py, values).into_any()
}

/// An array of rows.
pub(crate) fn rows<T: Element, const N: usize>(py: Python<'_>, rows: Vec<[T; N]>) -> PyResult<Bound<'_, PyAny>> {
    let count = rows.len();
    Ok(PyArray1::from_vec(py, rows.into_flattened()).reshape([count, N])?.into_any())
}

pub(crate) fn triple(py: Python<'_>, values: Vec3) -> Bound<'_, PyAny> {
    vector(py, values.to_vec())
}

/// A record of a class of `barchan.records`.
pub(crate) fn record<'py>(py: Python<'py>, class: &str, fields: &[Field<'py>]) -> PyResult<Bound<'py, PyAny>> {
    let keywords = PyDict::new(py);
    for (name, value) in fields {
        keywords.set_item(name, value)?;
    }
    py.import("barchan.records")?.getattr(class)?.call((), Some(&keywords))
}

/// What was read of particles: the fields that were asked for.
pub(crate) fn particles(py: Python<'_>, reading: Reading) -> PyResult<Bound<'_, PyAny>> {
    let asked = reading.fields;
    let mut fields = vec![("position", rows(py, reading.exact)?)];
    let mut add = |name, wanted: bool, array| {
        if wanted {
            fields.push((name, array));
        }
    };
    add("velocity", asked.velocity, rows(py, reading.velocity)?);
    add("affine", asked.affine, rows(py, reading.affine)?);
    add("mass", asked.mass, vector(py, reading.mass));
    add("volume0", asked.volume0, vector(py, reading.volume0));
    add("id", asked.id, vector(py, reading.id));
    add("body", asked.body, vector(py, reading.body));
    add("material", asked.material, vector(py, reading.material));
    add("level", asked.level, vector(py, reading.level));
    record(py, "Particles", &fields)
}

/// The same from columns as files have them, and others, such as pressure.
pub(crate) fn columns<'py>(
    py: Python<'py>,
    columns: Vec<Column>,
    more: Option<Field<'py>>,
) -> PyResult<Bound<'py, PyAny>> {
    fn shaped<T: Element>(py: Python<'_>, values: Vec<T>, components: usize) -> PyResult<Bound<'_, PyAny>> {
        let count = values.len() / components;
        let array = PyArray1::from_vec(py, values);
        Ok(if components == 1 { array.into_any() } else { array.reshape([count, components])?.into_any() })
    }
    let keywords = PyDict::new(py);
    for Column { name, components, values } in columns {
        let array = match values {
            Values::F64(values) => shaped(py, values, components)?,
            Values::F32(values) => shaped(py, values, components)?,
            Values::U64(values) => shaped(py, values, components)?,
            // As they are read alone.
            Values::U16(values) if name == "level" => vector(py, values.iter().map(|&level| level as u8).collect()),
            Values::U16(values) => shaped(py, values, components)?,
        };
        keywords.set_item(name, array)?;
    }
    if let Some((name, array)) = more {
        keywords.set_item(name, array)?;
    }
    py.import("barchan.records")?.getattr("Particles")?.call((), Some(&keywords))
}

pub(crate) fn body(py: Python<'_>, body: BodyState) -> PyResult<Bound<'_, PyAny>> {
    let fields = [
        ("name", body.name.into_bound_py_any(py)?),
        ("position", triple(py, body.position)),
        ("rotation", vector(py, body.rotation.to_vec())),
        ("velocity", triple(py, body.velocity)),
        ("angular_velocity", triple(py, body.angular_velocity)),
        ("mass", body.mass.into_bound_py_any(py)?),
    ];
    record(py, "Body", &fields)
}

pub(crate) fn wrench<'py>(py: Python<'py>, wrench: &Wrench) -> PyResult<Bound<'py, PyAny>> {
    record(py, "Wrench", &[("force", triple(py, wrench.force)), ("torque", triple(py, wrench.torque))])
}

fn link(py: Python<'_>, link: LinkState) -> PyResult<Bound<'_, PyAny>> {
    let felt = link.felt();
    let (points, forces) = link.rigid.iter().map(|point| (point.position, point.force)).unzip();
    let fields = [
        ("name", link.name.into_bound_py_any(py)?),
        ("position", triple(py, link.centre)),
        ("rotation", vector(py, link.rotation.to_vec())),
        ("velocity", triple(py, link.velocity)),
        ("angular_velocity", triple(py, link.angular_velocity)),
        ("ground", wrench(py, &link.ground)?),
        ("felt", wrench(py, &felt)?),
        ("contact_points", rows(py, points)?),
        ("contact_forces", rows(py, forces)?),
    ];
    record(py, "Link", &fields)
}

/// Where links are touched: `Patch` records by the names of those that are.
pub(crate) fn patches<'py>(
    py: Python<'py>,
    links: &[LinkState],
    patches: Vec<Option<Patch>>,
) -> PyResult<Bound<'py, PyDict>> {
    let all = PyDict::new(py);
    for (link, patch) in links.iter().zip(patches) {
        let Some(patch) = patch else { continue };
        let fields = [
            ("points", patch.points.into_bound_py_any(py)?),
            ("low", triple(py, patch.bounds.min)),
            ("high", triple(py, patch.bounds.max)),
            ("centre_of_pressure", triple(py, patch.centre_of_pressure)),
        ];
        all.set_item(&link.name, record(py, "Patch", &fields)?)?;
    }
    Ok(all)
}

/// A robot with its joints, which come in the order of commands to it.
pub(crate) fn robot<'py>(py: Python<'py>, robot: RobotState, joints: &[JointState]) -> PyResult<Bound<'py, PyAny>> {
    let links = PyDict::new(py);
    for one in robot.links {
        links.set_item(one.name.clone(), link(py, one)?)?;
    }
    let own: Vec<&JointState> = joints.iter().filter(|joint| joint.body == robot.name).collect();
    let numbers = |of: fn(&JointState) -> f64| vector(py, own.iter().map(|joint| of(joint)).collect());
    let fields = [
        ("joint_names", own.iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().into_bound_py_any(py)?),
        ("joint_position", numbers(|joint| joint.position)),
        ("joint_rate", numbers(|joint| joint.rate)),
        ("joint_torque", numbers(|joint| joint.torque)),
        ("name", robot.name.into_bound_py_any(py)?),
        ("position", triple(py, robot.position)),
        ("rotation", vector(py, robot.rotation.to_vec())),
        ("velocity", triple(py, robot.velocity)),
        ("angular_velocity", triple(py, robot.angular_velocity)),
        ("specific_force", triple(py, robot.specific_force)),
        ("projected_gravity", triple(py, robot.projected_gravity)),
        ("links", links.into_any()),
    ];
    record(py, "Robot", &fields)
}

/// A plan: what people read, and what programs ask.
pub(crate) fn plan<'py>(py: Python<'py>, plan: &Plan) -> PyResult<Bound<'py, PyAny>> {
    let effects = PyDict::new(py);
    for effect in &plan.effects {
        effects.set_item(&effect.name, &effect.because)?;
    }
    let fields = [
        ("text", plan.to_string().into_bound_py_any(py)?),
        ("effects", effects.into_any()),
        ("stages", plan.schedule.to_string().into_bound_py_any(py)?),
        ("particle_count", plan.particle_count.into_bound_py_any(py)?),
        ("cell_widths", plan.cell_widths.clone().into_bound_py_any(py)?),
        ("time_step", plan.dt.into_bound_py_any(py)?),
        ("warnings", plan.warnings.clone().into_bound_py_any(py)?),
    ];
    record(py, "Plan", &fields)
}

/// JSON as Python's own values.
pub(crate) fn json<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    py.import("json")?.call_method1("loads", (value.to_string(),))
}

/// What a task asks for, as a `Task` record.
pub(crate) fn task<'py>(py: Python<'py>, task: &dyn Task) -> PyResult<Bound<'py, PyAny>> {
    let actions = task.actions();
    let names: Vec<&str> = actions.iter().map(|limit| limit.name.as_str()).collect();
    let parts: Vec<(String, usize)> = task.observations().into_iter().map(|part| (part.name, part.size)).collect();
    let ranges: Vec<(String, (f64, f64))> =
        task.ranges().into_iter().map(|limit| (limit.name, (limit.low, limit.high))).collect();
    let fields = [
        ("name", task.name().into_bound_py_any(py)?),
        ("doc", task.doc().into_bound_py_any(py)?),
        ("action_names", names.into_bound_py_any(py)?),
        ("action_low", vector(py, actions.iter().map(|limit| limit.low).collect::<Vec<f64>>())),
        ("action_high", vector(py, actions.iter().map(|limit| limit.high).collect::<Vec<f64>>())),
        ("observation_parts", parts.into_bound_py_any(py)?),
        ("interval", task.interval().into_bound_py_any(py)?),
        ("horizon", task.horizon().into_bound_py_any(py)?),
        ("ranges", ranges.into_bound_py_any(py)?),
    ];
    record(py, "Task", &fields)
}

/// A part of what a body looks like, as a `Surface` record.
pub(crate) fn surface<'py>(py: Python<'py>, surface: &Surface) -> PyResult<Bound<'py, PyAny>> {
    let corners = &surface.mesh.corners;
    let flat: Vec<f32> = corners.as_flattened().as_flattened().to_vec();
    let fields = [
        ("triangles", PyArray1::from_vec(py, flat).reshape([corners.len(), 3, 3])?.into_any()),
        ("position", triple(py, surface.position)),
        ("rotation", vector(py, surface.rotation.to_vec())),
        ("colour", surface.colour.map(|[r, g, b]| (r, g, b)).into_bound_py_any(py)?),
    ];
    record(py, "Surface", &fields)
}
