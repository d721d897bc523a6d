//! Tasks: a scene, what an agent may do in it, what it sees, and what counts as success.

use crate::{Result, Scene, Simulation};

/// Outcome of one action.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaskStep {
    /// What the agent sees, of the task's observation size.
    pub observation: Vec<f64>,
    /// Reward of this action.
    pub reward: f64,
    /// The task has ended by success or failure.
    pub terminated: bool,
    /// The task has ended by its time limit.
    pub truncated: bool,
}

/// A benchmark task.
pub trait Task: Send {
    /// Name as registered.
    fn name(&self) -> &str;
    /// One paragraph.
    fn doc(&self) -> &str;
    /// The scene it is played in: the one that it was [made for](crate::registry::TaskSetup::scene), or its own.
    ///
    /// # Errors
    /// If the scene cannot be made.
    fn scene(&self) -> Result<Scene>;
    /// Length of an action.
    fn action_size(&self) -> usize;
    /// Length of an observation.
    fn observation_size(&self) -> usize;
    /// Starts an episode on a fresh simulation and returns the first observation.
    ///
    /// # Errors
    /// If the simulation cannot be read or stepped.
    fn reset(&mut self, simulation: &mut Simulation, seed: u64) -> Result<Vec<f64>>;
    /// Applies one action and advances the simulation by one control interval.
    ///
    /// # Errors
    /// If the action is not finite or the simulation fails.
    fn step(&mut self, simulation: &mut Simulation, action: &[f64]) -> Result<TaskStep>;
}
