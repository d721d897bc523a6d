//! What can go wrong, and what the user is told.
//!
//! Every message says what is wrong, where (file and line, key path, plugin, particle), and how to mend it.

use crate::Vec3;
use crate::scene::World;
use std::path::PathBuf;

/// Shorthand for results of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error that a user can act upon.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A scene file, a `--set` or a parameter of a backend that cannot be used.
    #[error(
        "{file}{}: {path}: {what}{}",
        if *line > 0 { format!(":{line}") } else { String::new() },
        allowed.as_ref().map(|a| format!("; {a}")).unwrap_or_default()
    )]
    Scene {
        /// File, "--set" or "--backend-parameter".
        file: String,
        /// Line, from 1; 0 if there is none.
        line: usize,
        /// Key path, such as `body[0].shape.box.min`.
        path: String,
        /// What is wrong.
        what: String,
        /// What is allowed, or what would mend it.
        allowed: Option<String>,
    },
    /// A name that the registry does not know.
    #[error(
        "{path}: no {kind} is called '{name}'; {}",
        if known.is_empty() { format!("no {kind} is registered") } else { format!("known are: {}", known.join(", ")) }
    )]
    Unknown {
        /// Where the name stands.
        path: String,
        /// "material", "coupling", "backend", "adapter", "task", "solid" or "scene".
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// The known names.
        known: Vec<String>,
    },
    /// An instruction set that this machine lacks.
    #[error(transparent)]
    Isa(barchan_lanes::UnknownIsa),
    /// Two plugins of one kind and name.
    #[error("{kind} '{name}' is registered twice, by {first} and by {second}; rename one of them")]
    Duplicate {
        /// Kind of plugin.
        kind: &'static str,
        /// Its name.
        name: String,
        /// Where the first one comes from.
        first: String,
        /// Where the second one comes from.
        second: String,
    },
    /// Something a plugin lacks that the scene calls for.
    #[error("{kind} '{name}' ({origin}) has no {what}; needed because {why}; {mend}")]
    Missing {
        /// Kind of plugin.
        kind: &'static str,
        /// Its name.
        name: String,
        /// Library or crate it comes from.
        origin: String,
        /// What it lacks.
        what: String,
        /// Why the scene needs it.
        why: String,
        /// What would mend it.
        mend: String,
    },
    /// A device that a backend runs on failed.
    #[error("backend '{backend}' on {device}: {what}; {mend}")]
    Device {
        /// The backend.
        backend: String,
        /// Name of the adapter.
        device: String,
        /// What happened.
        what: String,
        /// What would mend it.
        mend: String,
    },
    /// A library that cannot be loaded as a plugin, or a plugin that cannot be registered.
    #[error("plugin {}: {what}; {mend}", library.display())]
    Plugin {
        /// The file; of a plugin that a program registers itself, its kind and name.
        library: PathBuf,
        /// What is wrong with it.
        what: String,
        /// What would mend it.
        mend: String,
    },
    /// A material's callback failed.
    #[error(
        "material '{material}' ({origin}) failed in {callback}{}: {message}",
        particle.map(|p| format!(" at particle {p}")).unwrap_or_default()
    )]
    MaterialFailed {
        /// The material.
        material: String,
        /// Library or crate it comes from.
        origin: String,
        /// Which callback.
        callback: &'static str,
        /// Its message.
        message: String,
        /// Particle id, if it named one.
        particle: Option<u64>,
    },
    /// The time step is above what is stable.
    #[error(
        "time step {dt:.3e} s at step {step} is {}",
        if dt > bound {
            format!("above the bound {bound:.3e} s set by {by}; lower time.step, {}, or set time.over_bound = \"substep\"", raises_bound(by))
        } else if *step == 0 {
            format!("too short for time to go on: the bound is {bound:.3e} s by {by}; {}", raises_bound(by))
        } else {
            format!("too short for time to go on: the bound is {bound:.3e} s by {by}, which has grown without end; go on from a snapshot before that")
        }
    )]
    TimeStep {
        /// Step number.
        step: u64,
        /// Step asked for [s].
        dt: f64,
        /// Greatest stable step [s].
        bound: f64,
        /// What sets the bound.
        by: String,
    },
    /// NaN or infinity in the state.
    #[error(
        "{field} of particle {particle} ({list}) is {value} at step {step}, time {time:.6} s; {count} particles are concerned; the last snapshot is intact"
    )]
    NonFinite {
        /// Step number.
        step: u64,
        /// Time [s].
        time: f64,
        /// Which field.
        field: &'static str,
        /// First particle concerned.
        particle: u64,
        /// Its material.
        list: String,
        /// The value.
        value: f64,
        /// How many particles are concerned.
        count: u64,
    },
    /// Energy grows without a cause.
    #[error(
        "energy of the ground grew from {before:.3e} J to {after:.3e} J within {steps} steps (step {step}), more than work done on it explains; particle {particle} moves fastest; lower time.step or time.safety"
    )]
    Unstable {
        /// Step number.
        step: u64,
        /// Energy then [J].
        before: f64,
        /// Energy now [J].
        after: f64,
        /// Steps between.
        steps: u64,
        /// The fastest particle.
        particle: u64,
    },
    /// A particle left the world and the scene says that this is an error.
    #[error("particle {particle} left the world at ({:.4}, {:.4}, {:.4}) m, step {step}{}", position[0], position[1], position[2], way_out(*wall))]
    LeftWorld {
        /// Step number.
        step: u64,
        /// Particle id.
        particle: u64,
        /// Where it is [m].
        position: Vec3,
        /// The wall through which it was pressed, by its key; `None` if that side is open.
        wall: Option<&'static str>,
    },
    /// A rigid body or tool that cannot be used.
    #[error("{path}: {what}; {mend}")]
    Body {
        /// Key path, or the body's name.
        path: String,
        /// What is wrong.
        what: String,
        /// What would mend it.
        mend: String,
    },
    /// A snapshot that cannot be read or does not fit.
    #[error("snapshot {}: {what}; {mend}", file.display())]
    Snapshot {
        /// The file.
        file: PathBuf,
        /// What is wrong.
        what: String,
        /// What would mend it.
        mend: String,
    },
    /// An output folder that a run may not write into.
    #[error("{}: this output folder {what}; {mend}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What is wrong.
        what: String,
        /// What would mend it.
        mend: String,
    },
    /// A file that cannot be read or written.
    #[error("{}: {what}: {source}", file.display())]
    Io {
        /// The file or folder.
        file: PathBuf,
        /// What was being done.
        what: &'static str,
        /// The system's reason.
        source: std::io::Error,
    },
    /// More memory or particles than allowed.
    #[error("{what}: {asked} is above the cap {cap}; {mend}")]
    Capacity {
        /// What ran out.
        what: &'static str,
        /// How much was asked.
        asked: u64,
        /// The limit.
        cap: u64,
        /// What would mend it.
        mend: &'static str,
    },
}

/// What would let steps be longer that something bounds.
fn raises_bound(by: &str) -> &'static str {
    let of_causes = [
        ("stiffness", "lower the stiffness"),
        ("damping", "lower material.damping"),
        ("viscosity", "lower the viscosity"),
        ("speed", "move slower"),
    ];
    of_causes.into_iter().find(|(cause, _)| by.contains(cause)).map_or("lower what bounds it", |(_, mend)| mend)
}

/// What would keep a particle in the world that has left it on an open side, or through a wall.
fn way_out(wall: Option<&'static str>) -> String {
    match wall {
        None => "; widen world.min/max, add walls, or set world.leaving to \"clamp\" or \"delete\"".to_owned(),
        Some(side) => format!(
            " through the wall world.walls.{side}, against which the ground is pressed harder than its cells can hold; press it less, give it a stiffer material, \
             or set world.leaving to \"clamp\" or \"delete\""
        ),
    }
}

impl Error {
    /// That a particle left the world there [m], on an open side or through a wall.
    pub fn left_world(world: &World, step: u64, particle: u64, position: Vec3) -> Self {
        Self::LeftWorld { step, particle, position, wall: world.wall_passed(position) }
    }

    /// Says where an unknown name stands, such as `material[0].law`.
    #[must_use]
    pub fn at(self, place: &str) -> Self {
        match self {
            Self::Unknown { kind, name, known, .. } => Self::Unknown { path: place.to_owned(), kind, name, known },
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Error;
    use crate::scene::{Wall, Walls, World};

    /// Symptom: ground that was pressed through a wall was told to add walls.
    #[test]
    fn whoever_leaves_through_a_wall_is_told_of_it() {
        let walls = Walls { z_min: Wall::Stick, y_min: Wall::Periodic, y_max: Wall::Periodic, ..Walls::default() };
        let world = World::new(0.1, [0.0; 3], [1.0; 3]).with_walls(walls);
        let said = |position| Error::left_world(&world, 7, 3, position).to_string();
        let through = said([0.5, 0.5, -0.01]);
        assert!(
            through
                .contains("left the world at (0.5000, 0.5000, -0.0100) m, step 7 through the wall world.walls.z_min"),
            "{through}"
        );
        assert!(!through.contains("add walls"), "{through}");
        // Beyond an open side, one that has no end, and nowhere that is known.
        for position in [[0.5, 0.5, 1.0], [-0.1, 0.5, 0.5], [0.5, 1.5, 0.5], [f64::NAN; 3]] {
            let open = said(position);
            assert!(open.contains("step 7; widen world.min/max, add walls") && !open.contains("through"), "{open}");
        }
    }

    /// Symptom: where a step was too short for time to go on, the error said that it was above a bound that was greater than it.
    #[test]
    fn a_step_in_which_time_stands_still_is_not_above_its_bound() {
        let said =
            |dt: f64| Error::TimeStep { step: 7, dt, bound: 2e-15, by: "speed of a tool".to_owned() }.to_string();
        let (short, long) = (said(1e-15), said(3e-15));
        assert!(short.contains("1.000e-15 s at step 7 is too short for time to go on"), "{short}");
        assert!(short.contains("2.000e-15 s by speed of a tool") && !short.contains("above the bound"), "{short}");
        assert!(
            long.contains("is above the bound 2.000e-15 s set by speed of a tool; lower time.step, move slower"),
            "{long}"
        );
    }

    /// Symptom: a step above the bound that damping sets was to be mended by lower stiffness, and a first one that damping leaves no time for by an earlier snapshot.
    #[test]
    fn what_bounds_a_step_is_what_is_to_be_lowered() {
        let said = |dt: f64, bound: f64| {
            Error::TimeStep { step: 0, dt, bound, by: "damping of material 'mud'".to_owned() }.to_string()
        };
        let (long, none) = (said(1e-3, 1e-4), said(0.0, 0.0));
        assert!(long.contains("lower time.step, lower material.damping, or set"), "{long}");
        assert!(none.contains("the bound is 0.000e0 s by damping of material 'mud'; lower material.damping"), "{none}");
    }
}
