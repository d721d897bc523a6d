//! Without the feature `pictures`: a run that asks for some is refused before anything is written.

use super::Folder;
use barchan_core::{Error, Result, Simulation};
use std::path::{Path, PathBuf};

/// Refuses pictures.
pub(super) fn check() -> Result<()> {
    Err(missing())
}

fn missing() -> Error {
    Error::Missing {
        kind: "crate",
        name: env!("CARGO_PKG_NAME").to_owned(),
        origin: "built without the feature 'pictures'".to_owned(),
        what: "pictures".to_owned(),
        why: "the run is to make some".to_owned(),
        mend: "build it with that feature, or set Request::pictures to false".to_owned(),
    }
}

/// Pictures that nobody can have.
pub(super) enum Pictures {}

impl Pictures {
    pub(super) fn new(_: &Simulation, _: Option<&Path>) -> Result<Self> {
        Err(missing())
    }
    pub(super) fn take(&mut self, _: &Simulation, _: impl FnOnce() -> Result<PathBuf>) -> Result<()> {
        match *self {}
    }
    pub(super) fn wait(&mut self) -> Result<()> {
        match *self {}
    }
    pub(super) fn overview(&self, _: &mut Folder, _: f64) -> Result<()> {
        match *self {}
    }
}
