//! What Python gives: numbers, worlds and seeds, and commands to bodies.

use crate::errors::{OrRaise, raised};
use barchan::{Command, Placement, Precision};
use numpy::ndarray::Dimension;
use numpy::{AllowTypeChange, PyArrayLikeDyn};
use pyo3::exceptions::{PyIndexError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBool;

/// Numbers of any shape: an array, or lists of them. Shapes are checked where it is known what they should be.
pub(crate) type Numbers<'py> = PyArrayLikeDyn<'py, f64, AllowTypeChange>;

/// A whole number from 0 on; pyo3 tells the argument's name besides what is wrong with it. Python's bools are numbers, too, but count nothing.
pub(crate) fn number(given: &Bound<'_, PyAny>) -> PyResult<usize> {
    let number = if given.is_instance_of::<PyBool>() { None } else { given.extract().ok() };
    number.ok_or_else(|| PyTypeError::new_err(format!("{given} is no whole number from 0 on")))
}

pub(crate) fn check_world(world: usize, count: usize) -> PyResult<()> {
    if world < count {
        return Ok(());
    }
    Err(PyIndexError::new_err(format!("there is no world {world}; they are counted from 0, and there are {count}")))
}

pub(crate) fn precision(text: &str) -> PyResult<Precision> {
    text.parse().map_err(PyValueError::new_err)
}

/// May there be so many worlds?
pub(crate) fn check_count(py: Python<'_>, worlds: usize) -> PyResult<()> {
    if worlds == 0 {
        return Err(PyValueError::new_err("worlds: there must be one at least"));
    }
    barchan::worlds::check_count(worlds).or_raise(py)
}

/// A seed, if scenes may have it: theirs are numbers of TOML.
pub(crate) fn whole_seed(seed: u64) -> PyResult<u64> {
    if i64::try_from(seed).is_ok() { Ok(seed) } else { Err(PyValueError::new_err(SEEDS)) }
}

/// What seeds are.
const SEEDS: &str = "seeds are whole numbers from 0 to 2^63 - 1";

/// A seed. Python's bools are numbers, too, but no seeds.
pub(crate) fn one_seed(given: &Bound<'_, PyAny>) -> PyResult<u64> {
    if given.is_instance_of::<PyBool>() {
        return Err(PyTypeError::new_err(SEEDS));
    }
    whole_seed(given.extract().map_err(|_| PyTypeError::new_err(SEEDS))?)
}

/// A seed for each of so many worlds: a number, from which they count, or each its own.
pub(crate) fn first_or_each(given: &Bound<'_, PyAny>, worlds: usize) -> PyResult<Vec<u64>> {
    let Ok(several) = given.extract::<Vec<Bound<'_, PyAny>>>() else {
        let first = one_seed(given)?;
        return (first..).take(worlds).map(whole_seed).collect();
    };
    let each = several.iter().map(one_seed).collect::<PyResult<Vec<_>>>()?;
    if each.len() != worlds {
        return Err(PyValueError::new_err(format!("seeds: there are {} of them for {worlds} worlds", each.len())));
    }
    Ok(each)
}

/// Name of an adapter, or its number.
pub(crate) fn named(adapter: &Bound<'_, PyAny>) -> PyResult<String> {
    Ok(adapter.str()?.to_string())
}

/// The number of a world, several, or all of them.
pub(crate) fn chosen(worlds: Option<&Bound<'_, PyAny>>, count: usize) -> PyResult<Vec<usize>> {
    let Some(worlds) = worlds else { return Ok((0..count).collect()) };
    // Python's bools are numbers, too.
    let is_bool = |one: &Bound<'_, PyAny>| one.is_instance_of::<PyBool>();
    let is_mask =
        is_bool(worlds) || worlds.extract::<Vec<Bound<'_, PyAny>>>().is_ok_and(|several| several.iter().any(is_bool));
    if is_mask {
        return Err(PyTypeError::new_err(
            "worlds: these are bools; give numbers of worlds, such as numpy.flatnonzero makes of a mask",
        ));
    }
    let chosen = worlds.extract::<usize>().map(|one| vec![one]).or_else(|_| worlds.extract::<Vec<usize>>());
    let chosen = chosen
        .map_err(|_| PyTypeError::new_err("worlds: give the number of a world, a list of them, or None for all"))?;
    chosen.iter().try_for_each(|world| check_world(*world, count))?;
    let mut is_there = vec![false; count];
    match chosen.iter().find(|world| std::mem::replace(&mut is_there[**world], true)) {
        Some(twice) => Err(PyValueError::new_err(format!("worlds: world {twice} is there twice"))),
        None => Ok(chosen),
    }
}

/// Points [m], of shape (n, N).
pub(crate) fn points<const N: usize>(points: &Numbers<'_>) -> PyResult<Vec<[f64; N]>> {
    check_finite(points, "points")?;
    match points.as_array().shape() {
        &[_, along] if along == N => Ok(in_rows(points)),
        shape => Err(PyValueError::new_err(format!("points: their shape is {shape:?}; it should be (n, {N})"))),
    }
}

/// Points of the ground plan [m] for each of so many worlds: (n, 2) for all of them, or (worlds, n, 2), each world its own.
pub(crate) fn points_per_world(points: &Numbers<'_>, worlds: usize) -> PyResult<Vec<Vec<[f64; 2]>>> {
    check_finite(points, "points")?;
    match points.as_array().shape() {
        &[_, 2] => Ok(vec![in_rows(points); worlds]),
        &[of, count, 2] if of == worlds => {
            let mut all = in_rows(points).into_iter();
            Ok((0..worlds).map(|_| all.by_ref().take(count).collect()).collect())
        }
        shape => Err(PyValueError::new_err(format!(
            "points: their shape is {shape:?}; it should be (n, 2) for all worlds or ({worlds}, n, 2)"
        ))),
    }
}

/// Is every one a number?
pub(crate) fn check_finite(given: &Numbers<'_>, what: &str) -> PyResult<()> {
    match given.as_array().indexed_iter().find(|(_, x)| !x.is_finite()) {
        Some((place, x)) => {
            let place = place.slice();
            Err(PyValueError::new_err(format!("{what}: the number at {place:?} is {x}; give finite numbers")))
        }
        None => Ok(()),
    }
}

/// The least and the greatest corner of a box, or of a rectangle: N numbers each.
pub(crate) fn corners<const N: usize>(region: &Numbers<'_>, form: &str) -> PyResult<[[f64; N]; 2]> {
    let given = region.as_array();
    if given.shape() != [2, N] {
        let shape = given.shape();
        return Err(PyValueError::new_err(format!(
            "region: its shape is {shape:?}; give its least and greatest corner, {form}"
        )));
    }
    let [min, max] = [0, 1].map(|row| std::array::from_fn(|d| given[[row, d]]));
    if !(0..N).all(|d| min[d] <= max[d]) {
        let what = format!("region: it goes from {min:?} to {max:?}");
        return Err(PyValueError::new_err(format!(
            "{what}; give its least corner first, and its greatest then, {form}"
        )));
    }
    Ok([min, max])
}

/// Numbers in rows of N.
fn in_rows<const N: usize>(given: &Numbers<'_>) -> Vec<[f64; N]> {
    let all: Vec<f64> = given.as_array().iter().copied().collect();
    all.chunks_exact(N).map(|row| std::array::from_fn(|d| row[d])).collect()
}

/// Rows of a command for so many worlds: one row for all of them, or one for each.
pub(crate) fn per_world(values: Option<&Numbers<'_>>, what: &str, worlds: usize) -> PyResult<Vec<Option<Vec<f64>>>> {
    let Some(values) = values else { return Ok(vec![None; worlds]) };
    let values = values.as_array();
    match values.shape() {
        [_] => Ok(vec![Some(values.iter().copied().collect()); worlds]),
        &[rows, _] if rows == worlds => {
            Ok(values.rows().into_iter().map(|row| Some(row.iter().copied().collect())).collect())
        }
        shape => Err(PyValueError::new_err(format!(
            "{what}: its shape is {shape:?}; give one row of numbers for all worlds, or a row for each of {worlds}"
        ))),
    }
}

/// As many numbers as `names` says, if there are any.
fn numbers<const N: usize>(values: Option<Vec<f64>>, what: &str, names: &str) -> PyResult<Option<[f64; N]>> {
    let some = |values: Vec<f64>| {
        let count = values.len();
        values.try_into().map_err(|_| PyValueError::new_err(format!("{what}: {count} numbers; it takes {names}")))
    };
    values.map(some).transpose()
}

/// Numbers along x, y and z; zeros if there are none.
pub(crate) fn axes(values: Option<Vec<f64>>, what: &str) -> PyResult<[f64; 3]> {
    Ok(numbers(values, what, "x, y and z")?.unwrap_or_default())
}

/// Rows of so many particles, N numbers each, in the order that the message names.
pub(crate) fn rows<const N: usize>(
    given: Option<&Numbers<'_>>,
    what: &str,
    count: usize,
    order: &str,
) -> PyResult<Option<Vec<[f64; N]>>> {
    let Some(given) = given else { return Ok(None) };
    let given = given.as_array();
    if given.shape() != [count, N] {
        return Err(PyValueError::new_err(format!(
            "{what}: its shape is {:?}; it should be ({count}, {N}), a row for each particle in the order {order}",
            given.shape()
        )));
    }
    Ok(Some(given.rows().into_iter().map(|row| std::array::from_fn(|d| row[d])).collect()))
}

/// Blows for so many worlds.
pub(crate) fn blows(impulse: &Numbers<'_>, angular: Option<&Numbers<'_>>, worlds: usize) -> PyResult<Vec<Command>> {
    let all = per_world(Some(impulse), "impulse", worlds)?.into_iter();
    let blow = |(linear, angular)| {
        Ok(Command::Impulse { linear: axes(linear, "impulse")?, angular: axes(angular, "angular")? })
    };
    all.zip(per_world(angular, "angular", worlds)?).map(blow).collect()
}

/// What can be said of another place.
const PLACE: [&str; 6] = ["position", "rotation", "velocity", "angular_velocity", "joints", "joint_rates"];

/// Places for so many worlds, from what is given of [`PLACE`]: a row for all of them, or one for each.
pub(crate) fn placements(given: [Option<Numbers<'_>>; 6], worlds: usize) -> PyResult<Vec<Command>> {
    if given.iter().all(Option::is_none) {
        let known = PLACE.join(", ");
        return Err(PyTypeError::new_err(format!("it is not said where to put it; give one of {known}")));
    }
    let mut columns = Vec::new();
    for (what, values) in PLACE.iter().zip(&given) {
        columns.push(per_world(values.as_ref(), what, worlds)?.into_iter());
    }
    let place = |_| {
        let mut next = |i: usize| (columns[i].next().flatten(), PLACE[i]);
        let axes = |(values, what)| numbers(values, what, "x, y and z");
        let (position, (rotation, what)) = (axes(next(0))?, next(1));
        Ok(Command::Place(Placement {
            position,
            rotation: numbers(rotation, what, "w, x, y and z")?,
            velocity: axes(next(2))?,
            angular_velocity: axes(next(3))?,
            joints: next(4).0,
            joint_rates: next(5).0,
        }))
    };
    (0..worlds).map(place).collect()
}

/// Gives worlds of `count` a command each.
pub(crate) fn tell(
    py: Python<'_>,
    count: usize,
    worlds: Vec<usize>,
    commands: Vec<Command>,
    mut act: impl FnMut(usize, &Command) -> barchan::Result<()>,
) -> PyResult<()> {
    // What is no number, or the greatest, goes first: if a command is refused for how large it is, it is that one, and no world has taken any.
    let mut told: Vec<(usize, Command)> = worlds.into_iter().zip(commands).collect();
    told.sort_by(|(_, a), (_, b)| b.greatest().total_cmp(&a.greatest()));
    for (world, command) in told {
        act(world, &command).map_err(|error| raised(py, error, (count > 1).then_some(world)))?;
    }
    Ok(())
}
