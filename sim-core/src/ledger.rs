//! The ledger: what a simulation holds, and everything that was clamped, floored, clipped or lost.

use crate::{Crossed, Vec3};
use std::collections::BTreeMap;

/// Totals over all particles and free bodies, world frame. Ground out of reach counts only in the mass.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Ledger {
    /// Particles, without those in the archive.
    pub particles: u64,
    /// Mass of particles, those in the archive included [kg].
    pub mass: f64,
    /// Mass of archived particles: changed ground that is out of reach [kg].
    #[serde(default)]
    pub archived_mass: f64,
    /// Mass of the ground that came within reach since the start, minus that which went out of reach unchanged [kg].
    #[serde(default)]
    pub seeded_mass: f64,
    /// Kinetic energy that ground had when it went out of reach, and which is removed from it [J].
    #[serde(default)]
    pub archived_kinetic: f64,
    /// Momentum of particles [kg m/s].
    pub momentum: Vec3,
    /// Angular momentum about the world's origin, the affine part included [kg m²/s].
    pub angular_momentum: Vec3,
    /// Kinetic energy of particles, the affine part included [J].
    pub kinetic: f64,
    /// Elastic energy [J]; NaN if a material gives none.
    pub elastic: f64,
    /// Potential energy in gravity relative to the world's origin [J].
    pub potential: f64,
    /// Kinetic energy of free bodies [J].
    pub body_kinetic: f64,
    /// Potential energy of free bodies [J].
    pub body_potential: f64,
    /// Momentum of free bodies [kg m/s].
    pub body_momentum: Vec3,
    /// Angular momentum of free bodies about the world's origin [kg m²/s].
    pub body_angular_momentum: Vec3,
    /// Impulse from walls, and from ground out of reach, on particles since the start; ground asleep is left out [N s].
    pub wall_impulse: Vec3,
    /// Impulse of gravity on particles since the start; ground asleep is left out [N s].
    pub gravity_impulse: Vec3,
    /// Mass of particles that were deleted on leaving the world [kg].
    pub deleted_mass: f64,
    /// Change of kinetic energy by merging particles since the start, computed with the particles' own inertia [J].
    #[serde(default)]
    pub resampled_kinetic: f64,
    /// Change of angular momentum by merging particles since the start, computed likewise [kg m²/s].
    #[serde(default)]
    pub resampled_angular_momentum: Vec3,
    /// Kinetic energy that ground had when it fell asleep, and which is removed from it; sum since the start [J].
    #[serde(default)]
    pub slept_kinetic: f64,
    /// Momentum removed likewise, and momentum that ground awake gave to ground asleep beside it [kg m/s].
    #[serde(default)]
    pub slept_momentum: Vec3,
    /// Energy that the damping of materials has dissipated since the start [J].
    #[serde(default)]
    pub damped: f64,
    /// What sources have brought in since the start.
    #[serde(default)]
    pub sources: Passed,
    /// What sinks have taken out since the start.
    #[serde(default)]
    pub sinks: Passed,
    /// What has crossed the sections of the scene's probes since the start, in their order.
    #[serde(default)]
    pub crossed: Vec<Crossed>,
    /// Impulse of the ground on the parts of walls of the scene's probes since the start, in their order [N s].
    #[serde(default)]
    pub pressed: Vec<Vec3>,
    /// Named counts: yielding, at the apex, stretch floored, state clamped, positions clamped, steps shortened, …
    pub counts: BTreeMap<String, u64>,
}

/// What sources bring in, or sinks take out.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Passed {
    /// Particles.
    pub particles: u64,
    /// Mass [kg].
    pub mass: f64,
    /// Momentum [kg m/s].
    pub momentum: Vec3,
    /// Angular momentum about the world's origin, the affine part included [kg m²/s].
    pub angular_momentum: Vec3,
    /// Kinetic, elastic and potential energy [J], all of the same time.
    pub energy: f64,
}

impl Ledger {
    /// Kinetic, elastic and potential energy of particles and bodies together [J].
    pub fn energy(&self) -> f64 {
        self.kinetic + self.elastic + self.potential + self.body_kinetic + self.body_potential
    }
    /// Adds to a named count.
    pub fn count(&mut self, name: &str, by: u64) {
        if by > 0 {
            *self.counts.entry(name.to_owned()).or_default() += by;
        }
    }
}
