//! Inflow and outflow: where particles come in, and where they are taken out.

use super::{Sampling, Scene, Shape};
use crate::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A source: layers of particles come out of its mouth, one after the other, as far apart as particles of a layer are.
///
/// The mouth is the cut through the middle of `shape`, at right angles to `velocity`. Where a cell is full of ground, or a tool is, no particle comes.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Inflow {
    /// Name for messages.
    #[serde(default)]
    pub name: String,
    /// Name of a material of the scene.
    pub material: String,
    /// What the mouth is cut from.
    pub shape: Shape,
    /// Velocity of what comes in [m/s]; not zero.
    pub velocity: Vec3,
    /// Mass that comes in [kg/s], at most what the mouth lets through at this velocity: then layers have gaps, at random places. Absent, and without
    /// `volume_rate`: as much as the mouth lets through.
    #[serde(default)]
    pub mass_rate: Option<f64>,
    /// Volume that comes in, at the material's density at rest [m³/s], instead of `mass_rate`.
    #[serde(default)]
    pub volume_rate: Option<f64>,
    /// When the first layer comes in [s].
    #[serde(default)]
    pub from: f64,
    /// When no layer comes in any more [s]; absent: never.
    #[serde(default)]
    pub until: Option<f64>,
    /// Mass after which nothing comes in any more [kg]; absent: there is no limit.
    #[serde(default)]
    pub limit: Option<f64>,
    /// Distance between neighbouring particles [m]; absent: half a cell.
    #[serde(default)]
    pub spacing: Option<f64>,
    /// How particles are placed.
    #[serde(default)]
    pub sampling: Sampling,
}

/// A sink: every 8 steps, what is inside its shape is taken out of the simulation.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Outflow {
    /// Name for messages.
    #[serde(default)]
    pub name: String,
    /// Where particles are taken out. At least 4 cells of the coarsest level thick, so that nothing passes through it unseen.
    pub shape: Shape,
    /// Name of the only material that it takes; absent: it takes all.
    #[serde(default)]
    pub material: Option<String>,
    /// When it begins [s].
    #[serde(default)]
    pub from: f64,
    /// When it ends [s]; absent: never.
    #[serde(default)]
    pub until: Option<f64>,
}

impl Scene {
    /// Distance between neighbouring particles of a source [m].
    pub fn inflow_spacing(&self, source: &Inflow) -> f64 {
        source.spacing.unwrap_or(0.5 * self.world.cell)
    }
}
