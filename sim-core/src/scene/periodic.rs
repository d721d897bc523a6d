//! Worlds whose ends meet: what is beyond a side is an image of what is at the other end.

use super::{Wall, World};
use crate::coupling::nearest;
use crate::{Aabb, Vec3};

impl World {
    /// Do its ends meet along an axis?
    pub fn is_periodic(&self, axis: usize) -> bool {
        self.walls.pair(axis)[0] == Wall::Periodic
    }

    /// How far apart images are along an axis whose ends meet [m].
    pub fn period(&self, axis: usize) -> Option<f64> {
        self.is_periodic(axis).then(|| self.max[axis] - self.min[axis])
    }

    /// The image of a point that is nearest to another one [m], along periodic axes: there bodies that have gone over a side meet the ground.
    pub fn image_near(&self, point: Vec3, to: Vec3) -> Vec3 {
        std::array::from_fn(|d| self.nearest(d, point[d], to[d]))
    }

    /// What stands in the world for a point seen from above [m]: along periodic axes its image there, along others, for one that is outside, the nearest place half a cell
    /// from the side.
    pub(crate) fn inside(&self, point: [f64; 2]) -> [f64; 2] {
        std::array::from_fn(|d| {
            let (min, max, inner) = (self.min[d], self.max[d], 0.5 * self.cell);
            match point[d] {
                x if self.is_periodic(d) => self.nearest(d, x, 0.5 * (min + max)),
                x if x < min => min + inner,
                x if x > max => max - inner,
                x => x,
            }
        })
    }

    /// How far those images of the world are from it that a box reaches into [m]; along axes that are not periodic there is but one.
    pub(crate) fn images(&self, bounds: &Aabb) -> Vec<Vec3> {
        let mut images = vec![[0.0; 3]];
        for (d, period) in (0..3).filter_map(|d| Some((d, self.period(d)?))) {
            let number = |x: f64| ((x - self.min[d]) / period).floor();
            let (first, last) = (number(bounds.min[d]), number(bounds.max[d]));
            // What is wider than the world is in all of it.
            let last = last.min(first + 1.0);
            if !(first.is_finite() && last.is_finite()) {
                continue;
            }
            let along = [first, last].map(|number| number * period);
            images = images
                .iter()
                .flat_map(|image| along.map(|by| std::array::from_fn(|e| if e == d { by } else { image[e] })))
                .collect();
            images.dedup();
        }
        images
    }

    fn nearest(&self, axis: usize, x: f64, to: f64) -> f64 {
        nearest(x, to, self.period(axis).unwrap_or(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Walls;

    #[test]
    fn boxes_reach_into_images_beyond_periodic_sides() {
        let both = Wall::Periodic;
        let walls = Walls { x_min: both, x_max: both, ..Walls::default() };
        let (min, max) = ([-1.0, 0.0, 0.0], [1.0; 3]);
        let world = World { cell: 0.5, min, max, walls, leaving: Default::default(), plane_strain: None };
        let of = |from: f64, to: f64| world.images(&Aabb { min: [from, 0.0, 0.0], max: [to, 9.0, 0.1] });
        assert_eq!(of(-0.5, 0.5), [[0.0; 3]]);
        assert_eq!(of(0.5, 1.5), [[0.0; 3], [2.0, 0.0, 0.0]]);
        assert_eq!(of(-4.9, -4.8), [[-4.0, 0.0, 0.0]]);
        assert_eq!(world.image_near([0.75, 3.0, 0.0], [-5.0, 0.0, 0.0]), [-5.25, 3.0, 0.0]);
        assert_eq!(world.inside([3.5, 0.5]), [-0.5, 0.5]);
        assert_eq!([world.inside([0.0, 3.0]), world.inside([0.0, -0.01])], [[0.0, 0.75], [0.0, 0.25]]);
    }
}
