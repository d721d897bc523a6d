//! Where a picture in perspective is taken from.

use barchan_core::Vec3;
use barchan_core::glam::{self, DVec3};
use serde::{Deserialize, Serialize};

/// A camera: where it stands, what it looks at, and how wide.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Camera {
    /// Where it stands [m].
    pub position: Vec3,
    /// What is in the middle of its picture [m].
    pub target: Vec3,
    /// Angle between the left and the right side of the picture [rad].
    pub fov: f64,
}

/// The share of a picture that what it is taken of may fill.
const FILLED: f64 = 0.94;

impl Camera {
    /// One that sees a box, from a direction, as near as it can be; `aspect` is the picture's width over its height.
    pub(super) fn around(min: Vec3, max: Vec3, from: Vec3, fov: f64, aspect: f64) -> Self {
        let back = DVec3::from_array(from).normalize();
        let [right, up] = across(back);
        let (wide, high) = (FILLED * (0.5 * fov).tan(), FILLED * (0.5 * fov).tan() / aspect);
        let corner =
            |bits: usize| DVec3::from_array(std::array::from_fn(|d| if bits >> d & 1 == 1 { max[d] } else { min[d] }));
        let corners: Vec<DVec3> = (0..8).map(corner).collect();
        let mut target = 0.5 * (corners[0] + corners[7]);
        let mut distance = 0.0;
        // What is nearer looks larger, so that the middle of the picture is not the box's.
        for _ in 0..8 {
            let seen: Vec<[f64; 3]> =
                corners.iter().map(|c| [right, up, back].map(|axis| axis.dot(*c - target))).collect();
            let least = |[x, y, z]: &[f64; 3]| (x.abs() / wide).max(y.abs() / high) + z;
            distance = seen.iter().map(least).fold(0.0, f64::max);
            let middle = |d: usize| {
                let ends = seen.iter().map(|c| c[d] / (distance - c[2]));
                let (low, high) = ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
                0.5 * (low + high) * distance
            };
            target += middle(0) * right + middle(1) * up;
        }
        Self { position: (target + distance * back).to_array(), target: target.to_array(), fov }
    }

    /// The same somewhere else.
    #[must_use]
    pub(super) fn moved(self, by: Vec3) -> Self {
        let moved = |place: Vec3| std::array::from_fn(|d| place[d] + by[d]);
        Self { position: moved(self.position), target: moved(self.target), ..self }
    }

    /// As a picture of so many pixels sees the world from `origin` on.
    pub(super) fn lens(&self, origin: Vec3, width: usize, height: usize) -> Lens {
        let (position, target) = (DVec3::from_array(self.position), DVec3::from_array(self.target));
        let back = (position - target).try_normalize().unwrap_or(DVec3::Z);
        let [right, up] = across(back);
        Lens {
            eye: (position - DVec3::from_array(origin)).as_vec3(),
            right: right.as_vec3(),
            up: up.as_vec3(),
            ahead: -back.as_vec3(),
            focal: (0.5 * width as f64 / (0.5 * self.fov).tan()) as f32,
            middle: [0.5 * width as f32, 0.5 * height as f32],
        }
    }
}

/// To the right and up in the picture of a camera that looks against `back`.
fn across(back: DVec3) -> [DVec3; 2] {
    // From straight above, y is up.
    let right = DVec3::Z.cross(back).try_normalize().unwrap_or(DVec3::X);
    [right, back.cross(right)]
}

/// From places to pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    /// Where the camera is.
    pub eye: glam::Vec3,
    right: glam::Vec3,
    up: glam::Vec3,
    /// Where it looks.
    pub ahead: glam::Vec3,
    /// Pixels to the tangent of an angle.
    pub focal: f32,
    middle: [f32; 2],
}

impl Lens {
    /// How far ahead of the camera a place is [m].
    pub(super) fn depth(&self, place: glam::Vec3) -> f32 {
        self.ahead.dot(place - self.eye)
    }

    /// Is a place in the picture, or no further from what is than `margin` [m] along its sides and back?
    pub(super) fn is_near(&self, place: glam::Vec3, margin: f32) -> bool {
        let arm = place - self.eye;
        let depth = self.ahead.dot(arm);
        let across = [self.right.dot(arm), self.up.dot(arm)];
        let is_within = |d: usize| across[d].abs() <= self.middle[d] / self.focal * depth.max(0.0) + margin;
        depth >= -margin && is_within(0) && is_within(1)
    }

    /// Column and row of a place ahead of the camera, from the upper left corner, and one over its depth [1/m].
    pub(super) fn project(&self, place: glam::Vec3) -> glam::Vec3 {
        let arm = place - self.eye;
        let near = 1.0 / self.ahead.dot(arm);
        let scale = self.focal * near;
        glam::Vec3::new(self.middle[0] + scale * self.right.dot(arm), self.middle[1] - scale * self.up.dot(arm), near)
    }

    /// The direction in which a column and row look; one metre ahead for each length.
    pub(super) fn ray(&self, column: f32, row: f32) -> glam::Vec3 {
        let (x, y) = ((column - self.middle[0]) / self.focal, (self.middle[1] - row) / self.focal);
        self.ahead + x * self.right + y * self.up
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_near_a_picture_is_in_it_or_beside_it() {
        // A right angle wide, half as high.
        let camera = Camera { position: [0.0, -2.0, 0.0], target: [0.0; 3], fov: std::f64::consts::FRAC_PI_2 };
        let lens = camera.lens([0.0; 3], 200, 100);
        let near = |x: f32, y: f32, z: f32| lens.is_near(glam::Vec3::new(x, y, z), 0.5);
        assert!(near(1.9, 0.0, 0.0) && near(2.4, 0.0, 0.0) && !near(2.6, 0.0, 0.0));
        assert!(near(0.0, 0.0, 1.4) && !near(0.0, 0.0, -1.6) && near(50.0, 60.0, 0.0));
        assert!(near(0.0, -2.4, 0.0) && !near(0.0, -2.6, 0.0));
    }

    #[test]
    fn known_points_are_where_they_should_be() {
        // From the south, 2 m away, a right angle wide: a metre to the east is half-way to the right edge.
        let camera = Camera { position: [0.0, -2.0, 0.0], target: [0.0; 3], fov: std::f64::consts::FRAC_PI_2 };
        let lens = camera.lens([0.0; 3], 800, 400);
        let cases = [
            ([0.0, 0.0, 0.0], [400.0, 200.0, 0.5]),
            ([1.0, 0.0, 0.0], [600.0, 200.0, 0.5]),
            ([2.0, 0.0, 1.0], [800.0, 0.0, 0.5]),
            ([1.0, 2.0, -1.0], [500.0, 300.0, 0.25]),
        ];
        for (place, expected) in cases {
            let found = lens.project(glam::Vec3::from_array(place)).to_array();
            assert!((0..3).all(|d| (found[d] - expected[d]).abs() < 1e-3), "{place:?} at {found:?}, not {expected:?}");
            let there = lens.eye + lens.ray(found[0], found[1]) / found[2];
            assert!(there.distance(glam::Vec3::from_array(place)) < 1e-4, "{place:?} came back as {there}");
        }
        // An origin changes nothing but the numbers.
        let far = Camera { position: [1e6, -2.0, 0.0], target: [1e6, 0.0, 0.0], ..camera };
        let found = far.lens([1e6, 0.0, 0.0], 800, 400).project(glam::Vec3::X);
        assert!((found.x - 600.0).abs() < 1e-3, "{found}");
    }

    #[test]
    fn a_box_fills_the_picture_and_lies_in_its_middle() {
        let (min, max) = ([0.0, -1.0, 0.0], [3.0, 1.0, 0.4]);
        for from in [[0.5, -1.0, 0.6], [0.0, 0.0, 1.0], [-1.0, 0.2, 0.1]] {
            let lens = Camera::around(min, max, from, 0.6, 1.5).lens([0.0; 3], 600, 400);
            let corner = |b: usize| glam::Vec3::new([0.0, 3.0][b & 1], [-1.0, 1.0][b >> 1 & 1], [0.0, 0.4][b >> 2]);
            let seen: Vec<glam::Vec3> = (0..8).map(|b| lens.project(corner(b))).collect();
            let ends = |d: usize| {
                let all = seen.iter().map(|p| p[d]);
                all.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)))
            };
            let ((left, right), (top, bottom)) = (ends(0), ends(1));
            assert!((left + right - 600.0).abs() < 3.0 && (top + bottom - 400.0).abs() < 3.0, "{seen:?}");
            let filled = ((right - left) / 600.0).max((bottom - top) / 400.0);
            assert!((0.92..=0.95).contains(&filled), "{filled} of the picture from {from:?}");
        }
    }
}
