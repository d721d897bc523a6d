//! Plane strain: worlds a few cells thick.

use super::{Scene, Wall};
use crate::Result;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use toml::Value;

/// Plane strain: the world lies about y = 0, so many of the finest cells thick, between slip walls, whatever `min` and `max` say of y. Soft bodies are cut there.
/// So `cell` alone sets the resolution.
///
/// Places and directions may be given as two numbers, x and z. Their y is 0; boxes without y reach through both walls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlaneStrain {
    /// Cells of the finest level from wall to wall; on levels, half of them must be whole cells of the coarsest.
    #[serde(default = "two")]
    pub thickness_cells: u32,
}

fn two() -> u32 {
    2
}

/// With fewer cells, nodes behind one wall would be images in the other.
const THICKNESS: RangeInclusive<u32> = 2..=1024;
/// How far boxes without y reach from y = 0 [thicknesses of the world].
const THROUGH: f64 = 4.0;
/// Tables in which two numbers are x and y.
const OF_PLANS: [&str; 3] = ["height_field", "terrain", "picture"];
/// Keys of places and directions that may be given without y.
const PLACES: [&str; 15] = [
    "gravity", "min", "max", "half", "center", "position", "velocity", "linear", "point", "normal", "axis", "nearest",
    "eye", "target", "offset",
];

/// Puts in what places and directions of a scene in plane strain leave out.
pub(super) fn complete(scene: &mut Value) {
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|i| i as f64));
    let world = scene.get("world");
    let Some(plane) = world.and_then(|world| world.get("plane_strain")) else { return };
    let cell = world.and_then(|world| world.get("cell")).and_then(number).unwrap_or(0.0);
    let cells = plane.get("thickness_cells").and_then(number).unwrap_or(f64::from(two()));
    complete_below(scene, THROUGH * cell * cells);
}

fn complete_below(value: &mut Value, through: f64) {
    match value {
        Value::Table(table) => {
            for (key, value) in table.iter_mut().filter(|(key, _)| !OF_PLANS.contains(&key.as_str())) {
                match value {
                    Value::Array(items) if items.len() == 2 && PLACES.contains(&key.as_str()) => {
                        if items.iter().all(|item| item.is_float() || item.is_integer()) {
                            let y = match key.as_str() {
                                "min" => -through,
                                "max" | "half" => through,
                                _ => 0.0,
                            };
                            items.insert(1, Value::Float(y));
                        }
                    }
                    other => complete_below(other, through),
                }
            }
        }
        Value::Array(items) => items.iter_mut().for_each(|item| complete_below(item, through)),
        _ => {}
    }
}

impl Scene {
    /// Sets the world's ends along y and its walls there, in plane strain.
    pub(super) fn set_thickness(&mut self) -> Result<()> {
        let Some(PlaneStrain { thickness_cells: cells }) = self.world.plane_strain else { return Ok(()) };
        self.require(
            THICKNESS.contains(&cells),
            "world.plane_strain.thickness_cells",
            format!("is {cells}"),
            format!("must be from {} to {}", THICKNESS.start(), THICKNESS.end()),
        )?;
        for (side, wall) in ["y_min", "y_max"].into_iter().zip(self.world.walls.pair(1)) {
            self.require(
                matches!(wall, Wall::Open | Wall::Slip),
                &format!("world.walls.{side}"),
                "is another wall than slip, and in plane strain ground slips along y",
                "leave it out, or leave out world.plane_strain",
            )?;
        }
        let below = f64::from(cells / 2);
        self.world.min[1] = -below * self.world.cell;
        self.world.max[1] = (f64::from(cells) - below) * self.world.cell;
        (self.world.walls.y_min, self.world.walls.y_max) = (Wall::Slip, Wall::Slip);
        Ok(())
    }

    /// Are bodies cut at the walls of an axis, if they slip there?
    pub(super) fn cuts(&self, axis: usize) -> bool {
        self.clip || axis == 1 && self.world.plane_strain.is_some()
    }
}
