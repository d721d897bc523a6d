//! What all worlds of a batch say of one robot or body, as arrays with a row for each world.

use crate::records::{record, vector};
use barchan::{BodyState, HeightScan, JointState, LinkState, RobotState, Wrench};
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::IntoPyObjectExt;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Numbers of each world, one world behind the other, as an array whose first axis counts worlds and whose last ones are `shape`.
fn stacked<'py, T: Element>(
    py: Python<'py>,
    worlds: usize,
    shape: &[usize],
    values: impl Iterator<Item = T>,
) -> PyResult<Bound<'py, PyAny>> {
    let shape: Vec<usize> = std::iter::once(worlds).chain(shape.iter().copied()).collect();
    Ok(PyArray1::from_iter(py, values).reshape(shape)?.into_any())
}

/// Heights [m] at as many points of each world; NaN where there is neither ground nor floor.
pub(crate) fn heights<'py>(py: Python<'py>, all: &[impl AsRef<[Option<f64>]>]) -> PyResult<Bound<'py, PyAny>> {
    let points = all.first().map_or(0, |one| one.as_ref().len());
    let values = all.iter().flat_map(|one| one.as_ref()).map(|z| z.unwrap_or(f64::NAN));
    stacked(py, all.len(), &[points], values)
}

/// A robot in each world, with its joints, and the heights around it, if they were asked for: a `RobotArrays` record.
pub(crate) fn robots<'py>(
    py: Python<'py>,
    all: &[(RobotState, Vec<JointState>)],
    scans: Option<&[HeightScan]>,
) -> PyResult<Bound<'py, PyAny>> {
    let worlds = all.len();
    let sizes = |(robot, joints): &(RobotState, Vec<JointState>)| [robot.links.len(), joints.len()];
    let [links, joints] = all.first().map_or([0; 2], sizes);
    if let Some([others, other]) = all.iter().map(sizes).find(|own| *own != [links, joints]) {
        return Err(PyValueError::new_err(format!(
            "the robot has {links} links and {joints} joints in one world and {others} and {other} in another; ask for worlds where it has as many"
        )));
    }
    let of_joints =
        |of: fn(&JointState) -> f64| stacked(py, worlds, &[joints], all.iter().flat_map(|(_, joints)| joints).map(of));
    let of_base =
        |of: fn(&RobotState) -> [f64; 3]| stacked(py, worlds, &[3], all.iter().flat_map(move |(robot, _)| of(robot)));
    let all_links = || all.iter().flat_map(|(robot, _)| &robot.links);
    let felt: Vec<Wrench> = all_links().map(LinkState::felt).collect();
    let of_felt = |of: fn(&Wrench) -> [f64; 3]| stacked(py, worlds, &[links, 3], felt.iter().flat_map(of));
    let of_links = |of: fn(&LinkState) -> [f64; 3]| stacked(py, worlds, &[links, 3], all_links().flat_map(of));
    let first = || all.iter().take(1);
    let joint_names: Vec<&str> = first().flat_map(|(_, joints)| joints).map(|joint| &*joint.name).collect();
    let link_names: Vec<&str> = first().flat_map(|(robot, _)| &robot.links).map(|link| &*link.name).collect();
    let heights = scans.map(|scans| heights(py, &scans.iter().map(|scan| &scan.heights).collect::<Vec<_>>()));
    let fields = [
        ("joint_names", joint_names.into_bound_py_any(py)?),
        ("link_names", link_names.into_bound_py_any(py)?),
        ("position", of_base(|robot| robot.position)?),
        ("rotation", stacked(py, worlds, &[4], all.iter().flat_map(|(robot, _)| robot.rotation))?),
        ("velocity", of_base(|robot| robot.velocity)?),
        ("angular_velocity", of_base(|robot| robot.angular_velocity)?),
        ("specific_force", of_base(|robot| robot.specific_force)?),
        ("projected_gravity", of_base(|robot| robot.projected_gravity)?),
        ("joint_position", of_joints(|joint| joint.position)?),
        ("joint_rate", of_joints(|joint| joint.rate)?),
        ("joint_torque", of_joints(|joint| joint.torque)?),
        ("link_position", of_links(|link| link.centre)?),
        ("link_rotation", stacked(py, worlds, &[links, 4], all_links().flat_map(|link| link.rotation))?),
        ("link_velocity", of_links(|link| link.velocity)?),
        ("link_angular_velocity", of_links(|link| link.angular_velocity)?),
        ("ground_force", of_links(|link| link.ground.force)?),
        ("ground_torque", of_links(|link| link.ground.torque)?),
        ("felt_force", of_felt(|wrench| wrench.force)?),
        ("felt_torque", of_felt(|wrench| wrench.torque)?),
        ("heights", heights.transpose()?.into_bound_py_any(py)?),
    ];
    record(py, "RobotArrays", &fields)
}

/// A body in each world, and the wrench on it: a `BodyArrays` record.
pub(crate) fn bodies<'py>(py: Python<'py>, all: &[(BodyState, Wrench)]) -> PyResult<Bound<'py, PyAny>> {
    let worlds = all.len();
    let of = |of: fn(&(BodyState, Wrench)) -> [f64; 3]| stacked(py, worlds, &[3], all.iter().flat_map(of));
    let fields = [
        ("position", of(|(body, _)| body.position)?),
        ("rotation", stacked(py, worlds, &[4], all.iter().flat_map(|(body, _)| body.rotation))?),
        ("velocity", of(|(body, _)| body.velocity)?),
        ("angular_velocity", of(|(body, _)| body.angular_velocity)?),
        ("mass", vector(py, all.iter().map(|(body, _)| body.mass).collect())),
        ("force", of(|(_, wrench)| wrench.force)?),
        ("torque", of(|(_, wrench)| wrench.torque)?),
    ];
    record(py, "BodyArrays", &fields)
}
