//! What boxes of levels must hold.

use super::AXES;
use crate::Result;
use crate::coupling::Aabb;
use crate::scene::Scene;

impl Scene {
    pub(super) fn check_boxes(&self) -> Result<()> {
        for (i, one) in self.levels.boxes.iter().enumerate() {
            let path = format!("levels.box[{i}]");
            for (d, axis) in AXES.into_iter().enumerate() {
                self.require(
                    one.min[d] < one.max[d],
                    &format!("{path}.max"),
                    format!("{axis} goes from {} to {}", one.min[d], one.max[d]),
                    "max must be above min",
                )?;
            }
            self.require(
                self.levels.count > 1,
                &path,
                "asks for finer cells, and there is one level only",
                "set levels.count to 2 or more, or leave the box out",
            )?;
            self.require(
                Aabb { min: one.min, max: one.max }.meets(&self.world_box()),
                &path,
                format!("is outside the world, from {:?} to {:?}", self.world.min, self.world.max),
                "move the box, or widen world.min and world.max",
            )?;
        }
        Ok(())
    }
}
