//! What the camera of pictures must hold.

use crate::scene::{Camera, PictureView, Scene};
use crate::{Error, Result};

impl Scene {
    pub(super) fn check_camera(&self, camera: &Camera) -> Result<()> {
        let path = "output.picture.camera";
        self.require(
            self.picture_view() == PictureView::Perspective,
            path,
            "is given, and output.picture.view is \"top\"",
            "leave one of them out: from the top all of the scene is seen, without a camera",
        )?;
        for (key, place) in [("position", camera.position), ("target", camera.target)] {
            let place = place.unwrap_or_default();
            self.require(
                place.iter().all(|x| x.is_finite()),
                &format!("{path}.{key}"),
                format!("is {place:?}"),
                "must be three finite numbers",
            )?;
        }
        if let (Some(position), Some(target)) = (camera.position, camera.target) {
            let apart = (0..3).map(|d| (position[d] - target[d]).abs()).fold(0.0, f64::max);
            self.require(
                apart > 1e-3 * self.world.cell,
                &format!("{path}.target"),
                format!("is {target:?}, where the camera stands"),
                "must be another place than camera.position",
            )?;
        }
        self.require(
            (1.0..=150.0).contains(&camera.fov_deg),
            &format!("{path}.fov_deg"),
            format!("is {}", camera.fov_deg),
            "must be from 1 to 150",
        )?;
        let Some(name) = &camera.follow else { return Ok(()) };
        let robot = name.split('/').next().unwrap_or_default();
        let names = self.tool.iter().map(|tool| &tool.name).chain(self.robot.iter().map(|robot| &robot.name));
        // Bodies of other couplings have names that are not known before they are made.
        if !self.coupling.is_empty() || names.clone().any(|known| known == name || known == robot) {
            return Ok(());
        }
        Err(Error::Unknown {
            path: self.place(&format!("{path}.follow")),
            kind: "tool or robot of this scene",
            name: name.clone(),
            known: names.cloned().collect(),
        })
    }
}
