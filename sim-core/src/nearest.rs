//! Exact distance to the nearest of many points, by a grid of bins.

use crate::Vec3;

/// Points in bins, to be asked for the nearest.
pub struct Nearest {
    /// Points with their numbers, bin by bin.
    points: Vec<(Vec3, u32)>,
    /// Where each bin's points start, and the end.
    starts: Vec<u32>,
    min: Vec3,
    width: f64,
    count: [i64; 3],
}

/// How wide bins are for points within such an extent that about two come to each [m]; along as many axes as the points are thicker than that: with fewer they would
/// be narrower.
pub fn bin_width(points: usize, extent: Vec3) -> f64 {
    let mut longest = extent;
    longest.sort_by(|a, b| b.total_cmp(a));
    let along = |axes: i32| {
        let size: f64 = longest.iter().take(axes as usize).product();
        (2.0 * size / points.max(1) as f64).powf(1.0 / f64::from(axes))
    };
    (1..=3).map(along).fold(0.0, f64::max)
}

impl Nearest {
    /// Sorts points into bins.
    pub fn new(points: Vec<Vec3>) -> Self {
        let end = |d: usize, best: fn(f64, f64) -> f64| points.iter().map(|p| p[d]).reduce(best).unwrap_or_default();
        let min: Vec3 = std::array::from_fn(|d| end(d, f64::min));
        let extent: Vec3 = std::array::from_fn(|d| (end(d, f64::max) - min[d]).max(1e-6));
        let width = bin_width(points.len(), extent);
        let count = extent.map(|e| (e / width) as i64 + 1);
        let mut nearest = Self { points: Vec::new(), starts: Vec::new(), min, width, count };
        let keyed = points.into_iter().zip(0..).map(|(p, number)| (nearest.key(nearest.bin(p)), (p, number)));
        let mut keyed: Vec<(u32, (Vec3, u32))> = keyed.collect();
        keyed.sort_by_key(|(key, _)| *key);
        let bins = count.iter().product::<i64>() as u32;
        let mut at = 0;
        for bin in 0..=bins {
            while at < keyed.len() && keyed[at].0 < bin {
                at += 1;
            }
            nearest.starts.push(at as u32);
        }
        nearest.points = keyed.into_iter().map(|(_, p)| p).collect();
        nearest
    }

    fn bin(&self, x: Vec3) -> [i64; 3] {
        std::array::from_fn(|d| (((x[d] - self.min[d]) / self.width) as i64).clamp(0, self.count[d] - 1))
    }

    fn key(&self, bin: [i64; 3]) -> u32 {
        ((bin[2] * self.count[1] + bin[1]) * self.count[0] + bin[0]) as u32
    }

    /// Distance to the nearest point [m]; infinite if there is none.
    pub fn distance(&self, x: Vec3) -> f64 {
        self.search(x).0.sqrt()
    }

    /// The number of the nearest point, in the order in which points were given; of several as near, the first.
    pub fn closest(&self, x: Vec3) -> Option<usize> {
        let (_, number) = self.search(x);
        (number != u32::MAX).then_some(number as usize)
    }

    /// Squared distance to the nearest point [m²] and its number.
    ///
    /// 1. Bins are searched in shells about the point's own, or the one nearest to it.
    /// 2. The search ends when nothing in bins outside the shells can be nearer, or there are none.
    fn search(&self, x: Vec3) -> (f64, u32) {
        let own = self.bin(x);
        let place: Vec3 = std::array::from_fn(|d| x[d] - self.min[d]);
        // How far all bins are, along each axis.
        let away: Vec3 =
            std::array::from_fn(|d| (-place[d]).max(place[d] - self.count[d] as f64 * self.width).max(0.0));
        let mut best = (f64::INFINITY, u32::MAX);
        for shell in 0.. {
            self.search_shell(own, shell, x, &mut best);
            let beyond = (0..3).flat_map(|d| {
                let low = place[d] - (own[d] - shell) as f64 * self.width;
                let high = (own[d] + shell + 1) as f64 * self.width - place[d];
                let beside: f64 = (0..3).filter(|e| *e != d).map(|e| away[e] * away[e]).sum();
                let sides = [(own[d] > shell, low), (own[d] + shell + 1 < self.count[d], high)];
                sides.into_iter().filter(|(is_there, _)| *is_there).map(move |(_, side)| side * side + beside)
            });
            // As near may be an earlier one there, too.
            if best.0 < beyond.fold(f64::INFINITY, f64::min) || (0..3).all(|d| shell >= self.count[d]) {
                break;
            }
        }
        best
    }

    /// Takes up nearer points from the bins that are `shell` bins from `own` along some axis.
    fn search_shell(&self, own: [i64; 3], shell: i64, x: Vec3, best: &mut (f64, u32)) {
        let range = |d: usize| (own[d] - shell).max(0)..=(own[d] + shell).min(self.count[d] - 1);
        let mut among = |first: [i64; 3], last: [i64; 3]| {
            let (first, last) = (self.key(first) as usize, self.key(last) as usize);
            for (p, number) in &self.points[self.starts[first] as usize..self.starts[last + 1] as usize] {
                let square: f64 = (0..3).map(|d| (p[d] - x[d]).powi(2)).sum();
                if (square, *number) < *best {
                    *best = (square, *number);
                }
            }
        };
        for k in range(2) {
            for j in range(1) {
                if (k - own[2]).abs() == shell || (j - own[1]).abs() == shell {
                    // The bins of a row follow one another.
                    among([*range(0).start(), j, k], [*range(0).end(), j, k]);
                } else {
                    let ends = [own[0] - shell, own[0] + shell];
                    ends.into_iter().filter(|i| range(0).contains(i)).for_each(|i| among([i, j, k], [i, j, k]));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in [0, 1) that look random: fractions of multiples of irrational numbers.
    fn scattered(n: usize, shift: f64) -> Vec<Vec3> {
        let at = |i: usize, by: f64| ((i as f64 + shift) * by).fract();
        (0..n).map(|i| [at(i, 0.618_033_988), 0.3 * at(i, 0.414_213_562), 2.0 * at(i, 0.732_050_807)]).collect()
    }

    #[test]
    fn the_nearest_is_that_of_trying_all() {
        let (points, asked) = (scattered(700, 0.0), scattered(300, 0.37));
        let nearest = Nearest::new(points.clone());
        let outside = [[-3.0, 0.1, 0.1], [5.0, 5.0, 5.0], [0.5, -40.0, 1.0], [0.3, 0.1, 9.0]];
        for x in asked.into_iter().chain(outside) {
            let square = |p: &Vec3| (0..3).map(|d| (p[d] - x[d]).powi(2)).sum::<f64>().sqrt();
            let all = points.iter().map(square).fold(f64::INFINITY, f64::min);
            assert_eq!(nearest.distance(x), all);
            assert_eq!(square(&points[nearest.closest(x).unwrap()]), all);
        }
    }

    /// The mean distance of a random place to a cubic lattice is 0.4803 of its spacing.
    #[test]
    fn random_places_are_half_a_spacing_from_a_lattice() {
        let lattice = (0..20 * 20 * 20).map(|i| [i % 20, i / 20 % 20, i / 400].map(|x| f64::from(x) / 19.0)).collect();
        let nearest = Nearest::new(lattice);
        let asked: Vec<Vec3> = scattered(4000, 0.0).into_iter().map(|[x, y, z]| [x, y / 0.3, z / 2.0]).collect();
        let mean = asked.iter().map(|x| nearest.distance(*x)).sum::<f64>() / asked.len() as f64;
        assert!((mean * 19.0 - 0.4803).abs() < 0.01, "{}", mean * 19.0);
    }

    #[test]
    fn flat_and_long_clouds_have_few_bins() {
        let flat = scattered(700, 0.0).into_iter().map(|[x, _, z]| [x, 0.1, z]).collect();
        let long = scattered(700, 0.0).into_iter().map(|[x, _, _]| [x, 0.1, 0.2]).collect();
        for points in [scattered(700, 0.0), flat, long] {
            assert!(Nearest::new(points).starts.len() < 700);
        }
    }

    #[test]
    fn of_points_as_near_the_first_is_found() {
        let corners: Vec<Vec3> = (0..64).rev().map(|i| [i % 4, i / 4 % 4, i / 16].map(f64::from)).collect();
        let nearest = Nearest::new(corners.clone());
        let first = |x: Vec3| corners.iter().position(|p| (0..3).all(|d| (p[d] - x[d]).abs() == 0.5));
        for x in [[0.5, 0.5, 0.5], [1.5, 0.5, 2.5], [2.5, 2.5, 1.5]] {
            assert_eq!(nearest.closest(x), first(x));
        }
    }

    #[test]
    fn nothing_is_infinitely_far() {
        assert_eq!(Nearest::new(Vec::new()).distance([0.0; 3]), f64::INFINITY);
        assert_eq!(Nearest::new(Vec::new()).closest([0.0; 3]), None);
    }
}
