//! Surfaces that are to be drawn: a bed with grooves along lines, and how far another surface is from it.

use crate::tooling::points;
use barchan_core::nearest::Nearest;
use barchan_core::{Result, Simulation, Vec3};

/// A surface that is to be drawn in a bed.
pub(crate) struct Target {
    /// Where surfaces are looked at [m].
    pub(crate) points: Vec<[f64; 2]>,
    /// Height of the bed [m].
    pub(crate) level: f64,
    /// The surface, by those points, and the same to be asked for the nearest.
    cloud: Vec<Vec3>,
    nearest: Nearest,
    /// Chamfer distance of the untouched bed [m].
    start: f64,
    /// Height of the floor, where there is no ground [m].
    floor: f64,
}

impl Target {
    /// The world's bed as it is, with this added to its mean height [m], looked at in the middles of so many by so
    /// many parts of the world.
    ///
    /// # Errors
    /// If the simulation cannot be read.
    pub(crate) fn new(world: &Simulation, counts: [usize; 2], added: impl Fn([f64; 2]) -> f64) -> Result<Self> {
        let bounds = world.plan().scene.world_box();
        let points = points([bounds.min[0], bounds.min[1]], [bounds.max[0], bounds.max[1]], counts);
        let floor = bounds.min[2];
        let bed = filled(&world.heights(&points)?, floor);
        let level = bed.iter().sum::<f64>() / bed.len().max(1) as f64;
        let surface = cloud(&points, &points.iter().map(|point| level + added(*point)).collect::<Vec<_>>());
        let mut new = Self { points, level, nearest: Nearest::new(surface.clone()), cloud: surface, start: 1.0, floor };
        new.start = new.from(&bed).max(f64::MIN_POSITIVE);
        Ok(new)
    }

    /// Chamfer distance of a surface with these heights at the points [m], and its share of that of the untouched bed.
    pub(crate) fn away(&self, heights: &[Option<f64>]) -> [f64; 2] {
        let away = self.from(&filled(heights, self.floor));
        [away, away / self.start]
    }

    fn from(&self, heights: &[f64]) -> f64 {
        let surface = cloud(&self.points, heights);
        mean_distance(&surface, &self.nearest) + mean_distance(&self.cloud, &Nearest::new(surface.clone()))
    }
}

fn filled(heights: &[Option<f64>], floor: f64) -> Vec<f64> {
    heights.iter().map(|height| height.unwrap_or(floor)).collect()
}

/// Distance of a point from a line with corners [m].
pub(crate) fn from_line(line: &[[f64; 2]], point: [f64; 2]) -> f64 {
    let to_part = |part: &[[f64; 2]]| {
        let (a, b) = (part[0], part[1]);
        let (along, off) = ([b[0] - a[0], b[1] - a[1]], [point[0] - a[0], point[1] - a[1]]);
        let length = (along[0] * along[0] + along[1] * along[1]).max(f64::MIN_POSITIVE);
        let way = ((along[0] * off[0] + along[1] * off[1]) / length).clamp(0.0, 1.0);
        (off[0] - way * along[0]).hypot(off[1] - way * along[1])
    };
    line.windows(2).map(to_part).fold(f64::INFINITY, f64::min)
}

/// A profile by its corners: straight between them, 0 beyond.
pub(crate) fn height_at(profile: &[[f64; 2]], at: f64) -> f64 {
    let next = profile.iter().position(|[x, _]| *x > at).unwrap_or(0);
    if next == 0 {
        return 0.0;
    }
    let ([from, low], [to, high]) = (profile[next - 1], profile[next]);
    low + (high - low) * (at - from) / (to - from)
}

/// A surface by points of it.
fn cloud(points: &[[f64; 2]], heights: &[f64]) -> Vec<Vec3> {
    points.iter().zip(heights).map(|([x, y], z)| [*x, *y, *z]).collect()
}

/// Mean distance of points from the nearest of a cloud [m]. Both ways together are the chamfer distance.
fn mean_distance(points: &[Vec3], to: &Nearest) -> f64 {
    points.iter().map(|point| to.distance(*point)).sum::<f64>() / points.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chamfer_distance_adds_both_ways() {
        // A hill of 3 in the middle of three places 10 apart: its top is 3 from the flat, and the flat 3 from the top there.
        let points = [-10.0, 0.0, 10.0].map(|x| [x, 0.0]).to_vec();
        let surface = cloud(&points, &[0.0; 3]);
        let target = Target {
            points,
            level: 0.0,
            nearest: Nearest::new(surface.clone()),
            cloud: surface,
            start: 4.0,
            floor: 0.0,
        };
        assert_eq!(target.away(&[Some(0.0), Some(3.0), None]), [2.0, 0.5]);
        assert_eq!(target.away(&[Some(0.0); 3]), [0.0, 0.0]);
    }

    #[test]
    fn a_line_is_as_near_as_its_nearest_part() {
        let line = [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]];
        for (point, away) in [([0.5, 0.3], 0.3), ([1.2, 1.0], 0.2), ([-0.3, -0.4], 0.5), ([1.0, 2.5], 0.5)] {
            assert!((from_line(&line, point) - away).abs() < 1e-12, "{point:?}");
        }
    }

    #[test]
    fn a_profile_is_straight_between_its_corners() {
        let profile = [[-1.0, 0.0], [0.0, -2.0], [2.0, 0.0]];
        for (at, height) in [(-3.0, 0.0), (-0.5, -1.0), (0.0, -2.0), (1.0, -1.0), (5.0, 0.0)] {
            assert_eq!(height_at(&profile, at), height, "at {at}");
        }
    }
}
