//! What all tasks have in common: two sizes, the scene, and what a seed changes.

use barchan_core::parameter::{Parameter, Range};
use barchan_core::registry::{TaskMaker, TaskSetup};
use barchan_core::scene::{OverBound, Time};
use barchan_core::task::{Limits, draw};
use barchan_core::{Error, Registry, Result, Scene, Task};
use std::sync::Arc;

/// How large a task is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Size {
    /// The paper's.
    Full,
    /// One that a laptop steps many times a second.
    Lite,
}

impl Size {
    /// What belongs to it.
    pub(crate) fn of<T>(self, full: T, lite: T) -> T {
        match self {
            Self::Full => full,
            Self::Lite => lite,
        }
    }
}

/// Registers a task in both sizes: by its name, and by that and `-lite`.
///
/// # Errors
/// If a name is taken.
pub(crate) fn register<T: Task + 'static>(
    registry: &mut Registry,
    name: &str,
    doc: &str,
    mut parameters: Vec<Parameter>,
    make: fn(&TaskSetup<'_>, Size) -> Result<T>,
) -> Result<()> {
    let doc_of_it =
        "How much of what a seed may change it does change: 0 nothing, 1 anything within the task's ranges.";
    parameters.push(Parameter::number("randomise", "1", Range::new(0.0, 1.0), doc_of_it).or(0.0));
    for (size, name) in [(Size::Full, name.to_owned()), (Size::Lite, format!("{name}-lite"))] {
        let maker: TaskMaker = Arc::new(move |setup: &TaskSetup<'_>| Ok(Box::new(make(setup, size)?) as Box<dyn Task>));
        registry.add_task(&name, doc, parameters.clone(), maker)?;
    }
    Ok(())
}

/// What a task is made of, whatever it asks for.
#[derive(Clone, Debug)]
pub(crate) struct Base {
    /// Name as registered.
    pub(crate) name: String,
    /// The scene it is played in, as it was given or as the file has it.
    pub(crate) scene: Scene,
    randomise: f64,
    ranges: Vec<Limits>,
}

/// Refuses a parameter that changes the task's own scene, where another scene is given: `what` says what holds there instead.
///
/// # Errors
/// If a scene is given.
pub(crate) fn check_own(setup: &TaskSetup<'_>, parameter: &str, what: &str) -> Result<()> {
    if setup.scene.is_none() {
        return Ok(());
    }
    Err(Error::Body {
        path: format!("task.parameters.{parameter}"),
        what: format!("in a scene of one's own {what}"),
        mend: "leave it out, and let the scene say it; or play the task in its own scene".to_owned(),
    })
}

impl Base {
    /// The given scene, which stays as it is, or else the task's own: a file with changes, in which a seed draws from these ranges.
    ///
    /// # Errors
    /// If the changes do not fit the file, or a seed is to draw in a scene that was given.
    pub(crate) fn new(setup: &TaskSetup<'_>, file: &str, changes: &[&str], ranges: Vec<Limits>) -> Result<Self> {
        let (name, randomise) = (setup.name.to_owned(), setup.parameters.number("randomise"));
        if randomise > 0.0 {
            check_own(setup, "randomise", "a seed draws nothing")?;
        }
        let own = || {
            let scene = Scene::from_str_with(file, &format!("task '{name}'"), "", changes)?;
            // Whatever an agent that learns may try, a limb too fast for the step is followed in shorter ones: it ends no episode.
            let time = Time { over_bound: OverBound::Substep, ..scene.time };
            Ok(Scene { name: name.clone(), time, ..scene })
        };
        Ok(Self {
            scene: setup.scene.map_or_else(own, |scene| Ok(scene.clone()))?,
            randomise,
            ranges: if setup.scene.is_none() { ranges } else { Vec::new() },
            name,
        })
    }

    /// What a seed changes.
    pub(crate) fn ranges(&self) -> Vec<Limits> {
        if self.randomise > 0.0 { self.ranges.clone() } else { Vec::new() }
    }

    /// What a seed has drawn, a number for each range: the middles, unless the task is asked to draw. Nothing for a scene that was given.
    pub(crate) fn drawn(&self, seed: u64) -> Vec<f64> {
        draw(&self.ranges, self.randomise, seed)
    }

    /// The scene of a seed, before anything that was drawn is put in: the same for all, unless the task is asked to draw.
    pub(crate) fn scene(&self, seed: u64) -> Scene {
        let seed = if self.randomise > 0.0 { seed } else { self.scene.seed };
        Scene { seed, ..self.scene.clone() }
    }

    /// Simulated seconds of so many of the scene's steps [s].
    pub(crate) fn seconds_of(&self, steps: f64) -> f64 {
        steps * self.scene.time.step.unwrap_or(1e-3)
    }
}
