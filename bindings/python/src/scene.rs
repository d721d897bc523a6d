//! Scenes as Python gives them: the name of a built-in one, a file, or a dict.

use crate::errors::{OrRaise, exception};
use barchan::Scene;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use std::path::{Path, PathBuf};
use toml::Value;

/// What errors call the file of a scene that was a dict.
pub(crate) const DICT: &str = "scene";

/// Reads a scene.
///
/// 1. A text is the name of a built-in scene if there is one, or if it has no ending and there is no such file; else it is a file's.
/// 2. A dict is what a scene file would hold. Relative paths in it start from the folder that the program runs in.
/// 3. Overrides change it before it is checked.
fn read(scene: &Bound<'_, PyAny>, overrides: Option<&Bound<'_, PyDict>>) -> PyResult<Scene> {
    let py = scene.py();
    let set = overrides.map_or(Ok(Vec::new()), set)?;
    if scene.cast::<PyDict>().is_ok() {
        let text = toml::to_string(&to_toml(scene, "")?);
        let text = text.map_err(|e| exception(py, "SceneError", &format!("{DICT}: {e}")))?;
        return Scene::from_str_with(&text, DICT, "", &set).or_raise(py);
    }
    if let Ok(name) = scene.extract::<String>() {
        let path = Path::new(&name);
        if is_built_in(scene) || (path.extension().is_none() && !path.exists()) {
            return barchan::tasks::scene(&name, &set).or_raise(py);
        }
    }
    let Ok(path) = scene.extract::<PathBuf>() else {
        let kind = scene.get_type().name()?;
        return Err(PyTypeError::new_err(format!(
            "scene: it is of type {kind}; give the name of a built-in scene, a path to a TOML file, or a dict"
        )));
    };
    Scene::from_file_with(path, &set).or_raise(py)
}

/// Is it the name of a scene that comes with Barchan?
pub(crate) fn is_built_in(scene: &Bound<'_, PyAny>) -> bool {
    scene.extract::<String>().is_ok_and(|name| barchan::tasks::names().any(|known| known == name))
}

/// Reads a scene for each of so many worlds, as [`each`] has their overrides.
pub(crate) fn read_each(
    scene: &Bound<'_, PyAny>,
    overrides: Option<&Bound<'_, PyAny>>,
    worlds: usize,
) -> PyResult<Vec<Scene>> {
    match overrides.map(|given| given.cast::<PyDict>()) {
        None => Ok(vec![read(scene, None)?; worlds]),
        Some(Ok(one)) => Ok(vec![read(scene, Some(one))?; worlds]),
        Some(Err(_)) => each(overrides, worlds)?.iter().map(|one| read(scene, one.as_ref())).collect(),
    }
}

/// Which of so many worlds have a random seed by overrides of their own. None may, if seeds are `given` besides.
pub(crate) fn own_seeds(overrides: Option<&Bound<'_, PyAny>>, worlds: usize, given: bool) -> PyResult<Vec<bool>> {
    let gives = |one: &Option<Bound<'_, PyDict>>| one.as_ref().map_or(Ok(false), |one| one.contains("seed"));
    let gives = each(overrides, worlds)?.iter().map(gives).collect::<PyResult<Vec<bool>>>()?;
    if let Some(world) = gives.iter().position(|gives| given && *gives) {
        let what = format!("seed: the overrides of world {world} give it one, too; leave out one of them");
        return Err(PyValueError::new_err(what));
    }
    // One dict is for all worlds: they count from its seed.
    let is_for_all = overrides.is_some_and(|given| given.is_instance_of::<PyDict>());
    Ok(gives.into_iter().map(|gives| gives && !is_for_all).collect())
}

/// Overrides for each of so many worlds: one dict for all, or a list with one for each.
pub(crate) fn each<'py>(
    overrides: Option<&Bound<'py, PyAny>>,
    worlds: usize,
) -> PyResult<Vec<Option<Bound<'py, PyDict>>>> {
    let Some(given) = overrides else { return Ok(vec![None; worlds]) };
    if let Ok(one) = given.cast::<PyDict>() {
        return Ok(vec![Some(one.clone()); worlds]);
    }
    let list = given.extract::<Vec<Bound<'_, PyDict>>>();
    let list =
        list.map_err(|_| PyTypeError::new_err("overrides: give a dict, or a list with a dict for each world"))?;
    if list.len() != worlds {
        return Err(PyValueError::new_err(format!("overrides: there are {} for {worlds} worlds", list.len())));
    }
    Ok(list.into_iter().map(Some).collect())
}

/// A scene that has been read, with overrides.
pub(crate) fn changed(scene: &Scene, overrides: &Bound<'_, PyDict>) -> PyResult<Scene> {
    let text = scene.to_toml().or_raise(overrides.py())?;
    Scene::from_str_with(&text, DICT, &scene.folder, &set(overrides)?).or_raise(overrides.py())
}

/// Overrides as the command line's `--set` has them.
fn set(overrides: &Bound<'_, PyDict>) -> PyResult<Vec<String>> {
    let one = |(key, value): (Bound<'_, PyAny>, Bound<'_, PyAny>)| {
        let path: String = key.extract()?;
        Ok(format!("{path}={}", to_toml(&value, &path)?))
    };
    overrides.iter().map(one).collect()
}

/// A value as TOML. Arrays and scalars of NumPy come as lists and numbers.
pub(crate) fn to_toml(value: &Bound<'_, PyAny>, path: &str) -> PyResult<Value> {
    nested(value, path, 0)
}

/// Lists and dicts in one another, at most.
const DEEPEST: usize = 32;

fn nested(value: &Bound<'_, PyAny>, path: &str, depth: usize) -> PyResult<Value> {
    if depth > DEEPEST {
        let what =
            format!("{path}: lists and dicts are more than {DEEPEST} deep in one another; does one hold itself?");
        return Err(exception(value.py(), "SceneError", &what));
    }
    if value.is_none() {
        return Err(PyTypeError::new_err(format!("{path}: None is no value of a scene; leave the key out")));
    }
    let inner = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    let items = |items: Vec<Bound<'_, PyAny>>| -> PyResult<Value> {
        let one = |(i, item): (usize, &Bound<'_, PyAny>)| nested(item, &format!("{path}[{i}]"), depth + 1);
        Ok(Value::Array(items.iter().enumerate().map(one).collect::<PyResult<_>>()?))
    };
    Ok(if let Ok(table) = value.cast::<PyDict>() {
        let mut all = toml::Table::new();
        for (key, value) in table.iter() {
            let Ok(key) = key.extract::<String>() else {
                return Err(PyTypeError::new_err(format!("{path}: a key of a scene is a text, not {}", key.repr()?)));
            };
            let value = nested(&value, &inner(&key), depth + 1)?;
            all.insert(key, value);
        }
        Value::Table(all)
    } else if value.is_instance_of::<PyBool>() {
        Value::Boolean(value.extract()?)
    } else if value.is_instance_of::<PyInt>() {
        let whole = value.extract::<i64>();
        Value::Integer(whole.map_err(|_| {
            exception(value.py(), "SceneError", &format!("{path}: {value} does not fit 64 bits with a sign"))
        })?)
    } else if value.is_instance_of::<PyFloat>() {
        Value::Float(value.extract()?)
    } else if value.is_instance_of::<PyString>() {
        Value::String(value.extract()?)
    } else if let Ok(list) = value.cast::<PyList>() {
        return items(list.iter().collect());
    } else if let Ok(tuple) = value.cast::<PyTuple>() {
        return items(tuple.iter().collect());
    } else if value.hasattr("tolist")? {
        return nested(&value.call_method0("tolist")?, path, depth + 1);
    } else if let Ok(file) = value.extract::<PathBuf>() {
        Value::String(file.display().to_string())
    } else {
        let kind = value.get_type().name()?;
        let allowed = "numbers, texts, lists, dicts, paths and NumPy arrays";
        return Err(PyTypeError::new_err(format!("{path}: a scene has no value of type {kind}; it takes {allowed}")));
    })
}
