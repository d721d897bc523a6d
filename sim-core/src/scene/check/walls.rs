//! What a scene's walls call for.

use super::{AXES, WHOLE_CELL};
use crate::scene::{Body, Scene};

impl Scene {
    /// Says of a body where it ends less than a cell before a wall: it feels the wall, or does not, as nodes happen to lie. What is left of a cell by whole
    /// numbers of particles is less than a quarter.
    pub(super) fn nearly_at_walls(&self, i: usize, body: &Body) -> Vec<String> {
        let Some(bounds) = body.shape.bounds() else { return Vec::new() };
        let mut warnings = Vec::new();
        for (d, axis) in AXES.into_iter().enumerate() {
            let gaps = [bounds.min[d] - self.world.min[d], self.world.max[d] - bounds.max[d]];
            for ((wall, gap), side) in self.world.walls.pair(d).into_iter().zip(gaps).zip(["min", "max"]) {
                let cells = gap / self.world.cell;
                if wall.is_wall() && (0.25 + WHOLE_CELL..1.0 - WHOLE_CELL).contains(&cells) {
                    warnings.push(format!(
                        "body[{i}] ends {cells:.2} cells before the wall {axis}_{side} and yet feels it: let it end at the wall, or a cell before it"
                    ));
                }
            }
        }
        warnings
    }
}
