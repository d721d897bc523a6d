//! A picture of a robot alone, on flat ground.

use super::Image;
use super::camera::Camera;
use super::ground::Bed;
use super::perspective::{self, Scenery};
use barchan_core::glam::{DMat3, DQuat, DVec3};
use barchan_core::surface::Surface;
use barchan_rigid::motion::Pose;
use barchan_rigid::robot::RobotModel;
use barchan_rigid::robot::dynamics::places;

/// From the robot towards the camera: in front of it, on its right, 20° high.
const FROM: [f64; 3] = [0.72, -0.55, 0.33];
/// The width of the picture over its height, and the angle that it is wide [rad].
const ASPECT: f64 = 4.0 / 3.0;
const FOV: f64 = 0.6;
/// Ground around it, as a share of its size.
const AROUND: f64 = 0.08;

/// Draws a robot as its `<visual>` elements show it, so many pixels wide, standing with its lowest point on flat ground: in perspective, with its shadow. Its joints
/// are at 0, or at the stop nearest to it.
pub fn draw_robot(model: &RobotModel, pixels: usize) -> Image {
    let positions: Vec<f64> =
        model.drives.iter().map(|drive| 0.0_f64.clamp(drive.limits[0], drive.limits[1])).collect();
    let surfaces = model.surfaces(&places(model, false, &Pose::IDENTITY, &positions));
    let (low, high) = surfaces
        .iter()
        .flat_map(corners)
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    let (low, high) = if low.is_finite() { (low, high) } else { (DVec3::ZERO, DVec3::ONE) };
    let around = AROUND * (high - low).max_element() * DVec3::new(1.0, 1.0, 0.0);
    let (min, max) = (low - around, high + around);
    let camera = Camera::around(min.to_array(), max.to_array(), FROM, FOV, ASPECT);
    let mut image = Image::new(pixels, (pixels as f64 / ASPECT).round() as usize, [0; 3]);
    let lens = camera.lens([0.0; 3], image.width(), image.height());
    let target = DVec3::from_array(camera.target).as_vec3();
    let scenery = Scenery {
        lens,
        target,
        distance: lens.eye.distance(target),
        dots: &[],
        spacing: 0.01 * (max - min).max_element() as f32,
        bed: Bed { min: min.as_vec3(), max: max.as_vec3(), walls: [false, false, false, false, true] },
        heights: None,
        grounds: &[],
        surfaces: &surfaces,
        origin: [0.0; 3],
    };
    perspective::draw(&mut image, &scenery);
    image
}

/// Corners of a surface's triangles [m].
fn corners(surface: &Surface) -> impl Iterator<Item = DVec3> {
    let [w, x, y, z] = surface.rotation;
    let (turn, at) = (DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)), DVec3::from_array(surface.position));
    surface.mesh.corners.iter().flatten().map(move |x| at + turn * DVec3::from_array(x.map(f64::from)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_core::scene::Robot;

    #[test]
    fn a_robot_stands_in_the_middle_of_its_picture() {
        for name in ["quadruped", "humanoid", "arm-shovel"] {
            let model = RobotModel::of(&Robot::built_in("robot", name), std::path::Path::new("")).unwrap();
            let image = draw_robot(&model, 320);
            assert_eq!((image.width(), image.height()), (320, 240));
            // All of them have dark and orange parts, which neither floor nor sky have.
            let is_robot = |[r, g, b]: [u8; 3]| r.max(g).max(b) < 70 || r > b.saturating_add(90);
            let seen: Vec<[f64; 2]> = (0..320 * 240)
                .filter(|&i| is_robot(image.pixels()[i]))
                .map(|i| [(i % 320) as f64, (i / 320) as f64])
                .collect();
            let mean = |d: usize| seen.iter().map(|at| at[d]).sum::<f64>() / seen.len() as f64;
            println!("{name}: {} pixels about ({:.0}, {:.0})", seen.len(), mean(0), mean(1));
            assert!(seen.len() > 200, "{name}: {} pixels", seen.len());
            assert!(
                (mean(0) - 160.0).abs() < 50.0 && (mean(1) - 120.0).abs() < 60.0,
                "{name}: {:?}",
                [mean(0), mean(1)]
            );
        }
    }
}
