//! What zones of a body must hold.

use super::AXES;
use crate::Result;
use crate::scene::{Body, Scene, Zone};

impl Scene {
    pub(super) fn check_zones(&self, path: &str, body: &Body) -> Result<()> {
        for (i, zone) in body.zone.iter().enumerate() {
            self.check_zone(&format!("{path}.zone[{i}]"), body, zone)?;
        }
        self.require(
            body.zone.is_empty() || body.angular_velocity == [0.0; 3] && body.velocity_gradient == [0.0; 9],
            &format!("{path}.angular_velocity"),
            "or velocity_gradient is given for a body with zones, and each of them would turn about its own centre of mass",
            "leave out the zones, or the angular velocity and the gradient",
        )
    }

    fn check_zone(&self, path: &str, body: &Body, zone: &Zone) -> Result<()> {
        self.check_material_name(&format!("{path}.material"), &zone.material)?;
        self.require(
            zone.below.is_some() || zone.within.is_some() || zone.picture.is_some(),
            path,
            "does not say where it is",
            "give below, within, picture or several of them; for the whole body, set the body's own material",
        )?;
        if let Some(below) = zone.below {
            let path = format!("{path}.below");
            self.not_negative(&path, below)?;
            self.require(
                body.shape.is_layer(),
                &path,
                "asks how deep a point lies, and this shape has no surface above each of its points",
                "use a box, a height_field or a terrain, or within instead",
            )?;
        }
        if let Some(within) = zone.within {
            for (d, axis) in AXES.into_iter().enumerate() {
                self.require(
                    within.min[d] < within.max[d],
                    &format!("{path}.within.max"),
                    format!("{axis} goes from {} to {}", within.min[d], within.max[d]),
                    "max must be above min",
                )?;
            }
        }
        let Some(picture) = &zone.picture else { return Ok(()) };
        for (d, axis) in AXES.into_iter().enumerate().take(2) {
            self.require(
                picture.min[d] < picture.max[d],
                &format!("{path}.picture.max"),
                format!("{axis} goes from {} to {}", picture.min[d], picture.max[d]),
                "max must be above min",
            )?;
        }
        let [least, greatest] = picture.grey;
        self.require(
            0.0 <= least && least <= greatest && greatest <= 1.0,
            &format!("{path}.picture.grey"),
            format!("is {:?}", picture.grey),
            "must rise, from 0 for black to 1 for white",
        )
    }
}
