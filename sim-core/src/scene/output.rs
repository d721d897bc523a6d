//! What a run writes of its ground for other programs: [`SurfaceOutput`], [`HeightOutput`].

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A triangle mesh of the surface of all soft ground and bodies, as PLY.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SurfaceOutput {
    /// Simulated seconds between meshes.
    pub interval: f64,
    /// Width of the cells that the mesh is made on [m]; absent: the finest cell of the world.
    #[serde(default)]
    pub spacing: Option<f64>,
}

/// The height of the ground in square columns of the whole world, as NPZ.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HeightOutput {
    /// Simulated seconds between maps.
    pub interval: f64,
    /// Width of a column [m]; absent: the finest cell of the world.
    #[serde(default)]
    pub spacing: Option<f64>,
    /// Write each as a grey picture of 16 bits too.
    #[serde(default)]
    pub png: bool,
}
