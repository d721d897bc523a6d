//! Worlds whose ends meet: what is rigid meets images of what is at the other end.

use barchan_core::Aabb;
use barchan_core::scene::World;
use glam::DVec3;

/// How far apart images are along each axis [m]; 0 along those whose ends do not meet.
#[derive(Clone, Copy, Debug, Default)]
pub struct Images([f64; 3]);

impl Images {
    /// Of a world.
    pub fn of(world: &World) -> Self {
        Self(std::array::from_fn(|d| world.period(d).unwrap_or(0.0)))
    }

    /// How far those images of `other` are from it that lie next to `one`, on both sides of it [m]. What is as long as the world is next to more of them.
    pub fn beside(self, one: &Aabb, other: &Aabb) -> impl Iterator<Item = DVec3> + use<> {
        let along: [[f64; 2]; 3] = std::array::from_fn(|d| {
            let middle = |of: &Aabb| 0.5 * (of.min[d] + of.max[d]);
            let turns = ((middle(one) - middle(other)) / self.0[d]).floor();
            // A wall has no images.
            if self.0[d] > 0.0 && turns.is_finite() {
                [turns, turns + 1.0].map(|turns| turns * self.0[d])
            } else {
                [0.0; 2]
            }
        });
        let count = |d: usize| if along[d][0] < along[d][1] { 2 } else { 1 };
        let [nx, ny, nz] = [0, 1, 2].map(count);
        (0..nx * ny * nz).map(move |i| DVec3::new(along[0][i % nx], along[1][i / nx % ny], along[2][i / (nx * ny)]))
    }

    /// Those of them that meet it.
    pub fn meeting(self, one: &Aabb, other: &Aabb) -> impl Iterator<Item = DVec3> + use<> {
        let (one, other) = (*one, *other);
        self.beside(&one, &other).filter(move |by| other.moved(by.to_array()).meets(&one))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_at_the_other_end_is_next_to_what_is_here() {
        let images = Images([2.0, 0.0, 0.0]);
        let cube = |x: f64| Aabb { min: [x - 0.1, -0.1, -0.1], max: [x + 0.1, 0.1, 0.1] };
        let met = |one: f64, other: f64| images.meeting(&cube(one), &cube(other)).map(|by| by.x).collect::<Vec<_>>();
        assert_eq!(met(0.95, -0.95), [2.0]);
        assert_eq!(met(-0.95, 0.95), [-2.0]);
        assert_eq!(met(4.1, 0.0), [4.0]);
        assert_eq!(met(-6.05, -0.1), [-6.0]);
        assert!(met(1.0, 0.0).is_empty());
        let by: Vec<DVec3> = images.beside(&cube(0.5), &cube(0.0)).collect();
        assert_eq!(by, [DVec3::ZERO, DVec3::new(2.0, 0.0, 0.0)]);
        let floor = Aabb { max: [f64::INFINITY, f64::INFINITY, 0.0], ..Aabb::UNBOUND };
        assert_eq!(images.meeting(&cube(7.3), &floor).collect::<Vec<_>>(), [DVec3::ZERO]);
    }
}
