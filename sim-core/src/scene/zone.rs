//! Zones: where a soft body is of another material.

use super::Body;
use crate::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Where another material takes the place of the body's own. All that is given must hold; of several zones that hold at a point, the last counts.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Zone {
    /// Name of a material of the scene.
    pub material: String,
    /// Deeper than this below the body's surface, straight down [m]. For boxes, height fields and terrains.
    #[serde(default)]
    pub below: Option<f64>,
    /// Within a box.
    #[serde(default)]
    pub within: Option<Within>,
    /// Where a picture that lies over the ground has certain greys.
    #[serde(default)]
    pub picture: Option<ZonePicture>,
}

/// A greyscale picture over the ground, seen from above: x to the right, y up. Beyond its sides no zone holds.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ZonePicture {
    /// A PNG file without colours; needs the feature `pictures`.
    pub file: PathBuf,
    /// Least x and y that it covers [m].
    pub min: [f64; 2],
    /// Greatest x and y that it covers [m].
    pub max: [f64; 2],
    /// Least and greatest grey of the zone, 0 black and 1 white.
    pub grey: [f64; 2],
}

/// An axis-aligned box of the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Within {
    /// Least corner [m].
    pub min: Vec3,
    /// Greatest corner [m].
    pub max: Vec3,
}

impl Body {
    /// Does it start in motion?
    pub(crate) fn moves(&self) -> bool {
        self.velocity != [0.0; 3] || self.angular_velocity != [0.0; 3] || self.velocity_gradient != [0.0; 9]
    }

    /// Names of the materials that it may hold, each once: its own first, then those of its zones.
    pub fn materials(&self) -> Vec<&str> {
        let mut names = vec![self.material.as_str()];
        for zone in &self.zone {
            if !names.contains(&zone.material.as_str()) {
                names.push(&zone.material);
            }
        }
        names
    }
}
