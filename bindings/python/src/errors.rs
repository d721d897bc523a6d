//! Errors of Barchan as Python's exceptions, with the same words. The classes are in `barchan/errors.py`.

use crate::scene::DICT;
use barchan::Error;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use std::collections::BTreeSet;
use std::ffi::CString;

/// An exception of a class of `barchan.errors`.
pub(crate) fn exception(py: Python<'_>, class: &str, message: &str) -> PyErr {
    let made = py.import("barchan.errors").and_then(|module| module.getattr(class)).and_then(|c| c.call1((message,)));
    made.map_or_else(|error| error, PyErr::from_value)
}

/// The class that stands for an error.
fn class(error: &Error) -> &'static str {
    match error {
        Error::Scene { .. } => "SceneError",
        Error::Unknown { .. } => "UnknownNameError",
        Error::Duplicate { .. } | Error::Missing { .. } | Error::Plugin { .. } => "PluginError",
        Error::TimeStep { .. }
        | Error::NonFinite { .. }
        | Error::Unstable { .. }
        | Error::LeftWorld { .. }
        | Error::MaterialFailed { .. } => "SimulationError",
        Error::Body { .. } => "BodyError",
        Error::Device { .. } => "DeviceError",
        Error::Snapshot { .. } => "SnapshotError",
        Error::Folder { .. } | Error::Io { .. } => "FileError",
        Error::Capacity { .. } => "CapacityError",
        _ => "BarchanError",
    }
}

/// Warns of what plans say, once of each.
pub(crate) fn warn<'a>(py: Python<'_>, warnings: impl IntoIterator<Item = &'a String>) -> PyResult<()> {
    let mut said = BTreeSet::new();
    let category = py.import("barchan.errors")?.getattr("BarchanWarning")?;
    for warning in warnings.into_iter().filter(|warning| said.insert(*warning)) {
        let text =
            CString::new(warning.as_str()).map_err(|_| exception(py, "BarchanError", "a warning holds a zero"))?;
        PyErr::warn(py, &category, &text, 1)?;
    }
    Ok(())
}

/// Where an unknown name stands, in a user's words of Python: of a dict lines are nobody's, and options are keywords.
fn place(path: &str) -> String {
    let of_dict = path.strip_prefix(DICT).and_then(|rest| rest.strip_prefix(':')?.split_once(": "));
    match of_dict {
        Some((line, rest)) if line.bytes().all(|c| c.is_ascii_digit()) => format!("{DICT}: {rest}"),
        _ => path.replacen("--set: ", "overrides: ", 1).replacen("--adapter", "adapter", 1),
    }
}

/// The exception for an error; of a world of several, it says which.
pub(crate) fn raised(py: Python<'_>, mut error: Error, world: Option<usize>) -> PyErr {
    match &mut error {
        // The lines of a scene that was a dict are nobody's.
        Error::Scene { file, line, .. } if file == DICT => *line = 0,
        // Here options are keywords.
        Error::Scene { file, .. } if file == "--set" => *file = "overrides".to_owned(),
        Error::Unknown { path, .. } => *path = place(path),
        _ => {}
    }
    let message = match world {
        Some(world) => format!("world {world}: {error}"),
        None => error.to_string(),
    };
    let exception = exception(py, class(&error), &message);
    // Of a law written in Python, with its traceback; what ends the program does so.
    match crate::material::take_raised().filter(|_| matches!(error, Error::MaterialFailed { .. })) {
        Some(raised) if !raised.is_instance_of::<PyException>(py) => return raised,
        raised => exception.set_cause(py, raised),
    }
    let value = exception.value(py);
    let noted = match &error {
        Error::Scene { file, line, path, .. } => value
            .setattr("file", file)
            .and_then(|()| value.setattr("line", (*line > 0).then_some(*line)))
            .and_then(|()| value.setattr("path", path)),
        Error::Unknown { known, .. } => value.setattr("known", known),
        _ => Ok(()),
    };
    match noted.and_then(|()| value.setattr("world", world)) {
        Ok(()) => exception,
        Err(error) => error,
    }
}

/// What turns Barchan's results into Python's.
pub(crate) trait OrRaise<T> {
    /// The value, or the exception.
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for barchan::Result<T> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| raised(py, error, None))
    }
}
