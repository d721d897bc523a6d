//! An episode as a file: what was asked for and done, so that it can be played again.

use super::{Environment, Step};
use barchan_core::parameter::Table;
use barchan_core::{Error, Options, Registry, Result, file};
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::Path;

/// An episode of a task in one world.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recording {
    /// The task: its name, or the path of a scene that asks for it.
    pub task: String,
    /// Its parameters; defaults are left out.
    #[serde(default)]
    pub parameters: Table,
    /// Seed of the episode.
    #[serde(default)]
    pub seed: u64,
    /// Who acted, for people.
    #[serde(default)]
    pub agent: String,
    /// The action of each control step.
    pub actions: Vec<Vec<f64>>,
    /// The reward of each control step, if it has been played.
    #[serde(default)]
    pub rewards: Vec<f64>,
    /// Was what the task asks for reached at the end?
    #[serde(default)]
    pub success: bool,
    /// Backend and precision that it was played on, for people.
    #[serde(default)]
    pub played_on: String,
}

impl Recording {
    /// Reads one.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be read, or holds something else.
    pub fn read(path: &Path) -> Result<Self> {
        let io = |source| Error::Io { file: path.to_owned(), what: "reading an episode (JSON)", source };
        let text = std::fs::read_to_string(path).map_err(io)?;
        serde_json::from_str(&text).map_err(|error| io(error.into()))
    }

    /// Writes it; an older file of that name is intact if it fails.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let what = "writing an episode (JSON)";
        let text = serde_json::to_string(self).map_err(|error| Error::Io {
            file: path.to_owned(),
            what,
            source: error.into(),
        })?;
        file::write_whole(path, what, |out| out.write_all(text.as_bytes()))
    }

    /// Sum of the rewards.
    pub fn total(&self) -> f64 {
        self.rewards.iter().sum()
    }

    /// An environment at the start of the episode.
    ///
    /// # Errors
    /// Those of [`task`](super::task) and [`Environment::new`].
    pub fn environment(&self, registry: &Registry, options: &Options) -> Result<Environment> {
        Environment::new(registry, super::task(registry, &self.task, &self.parameters)?, &[self.seed], options)
    }

    /// Takes down a control step.
    pub fn add(&mut self, action: Vec<f64>, step: &Step) {
        self.actions.push(action);
        self.rewards.push(step.reward);
        self.success = step.success;
    }
}
