//! Exact distance to the nearest of many points, by a grid of bins.

/// Points in bins, to be asked for the nearest.
pub struct Nearest {
    /// Points, bin by bin.
    points: Vec<[f32; 3]>,
    /// Where each bin's points start, and the end.
    starts: Vec<u32>,
    min: [f64; 3],
    width: f64,
    count: [i64; 3],
}

impl Nearest {
    /// Sorts points into bins that hold about two each.
    pub fn new(points: Vec<[f32; 3]>) -> Self {
        let end = |d: usize, best: fn(f32, f32) -> f32| points.iter().map(|p| p[d]).reduce(best).map_or(0.0, f64::from);
        let min: [f64; 3] = std::array::from_fn(|d| end(d, f32::min));
        let extent: [f64; 3] = std::array::from_fn(|d| (end(d, f32::max) - min[d]).max(1e-6));
        // So wide that two points come to a bin, along as many axes as the cloud is thicker than that: with fewer it would be narrower.
        let mut longest = extent;
        longest.sort_by(|a, b| b.total_cmp(a));
        let along = |axes: i32| {
            let size: f64 = longest.iter().take(axes as usize).product();
            (2.0 * size / points.len().max(1) as f64).powf(1.0 / f64::from(axes))
        };
        let width = (1..=3).map(along).fold(0.0, f64::max);
        let count = extent.map(|e| (e / width) as i64 + 1);
        let mut nearest = Self { points: Vec::new(), starts: Vec::new(), min, width, count };
        let mut keyed: Vec<(u32, [f32; 3])> = points.into_iter().map(|p| (nearest.key(nearest.bin(p)), p)).collect();
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

    fn bin(&self, x: [f32; 3]) -> [i64; 3] {
        std::array::from_fn(|d| (((f64::from(x[d]) - self.min[d]) / self.width) as i64).clamp(0, self.count[d] - 1))
    }

    fn key(&self, bin: [i64; 3]) -> u32 {
        ((bin[2] * self.count[1] + bin[1]) * self.count[0] + bin[0]) as u32
    }

    /// Distance to the nearest point [m]; infinite if there is none.
    ///
    /// 1. Bins are searched in shells about the point's own.
    /// 2. The search ends when nothing outside the shells can be nearer, or they hold everything.
    pub fn distance(&self, x: [f32; 3]) -> f64 {
        let (own, x) = (self.bin(x), x.map(f64::from));
        let mut best = f64::INFINITY;
        for shell in 0.. {
            self.search(own, shell, x, &mut best);
            let inside = (0..3).fold(f64::INFINITY, |inside, d| {
                let low = self.min[d] + (own[d] - shell) as f64 * self.width;
                let high = low + (2 * shell + 1) as f64 * self.width;
                inside.min(x[d] - low).min(high - x[d])
            });
            let all = (0..3).all(|d| own[d] <= shell && self.count[d] - 1 - own[d] <= shell);
            if all || (inside > 0.0 && best <= inside * inside) {
                break;
            }
        }
        best.sqrt()
    }

    /// Takes up nearer points from the bins that are `shell` bins from `own` along some axis.
    fn search(&self, own: [i64; 3], shell: i64, x: [f64; 3], best: &mut f64) {
        let range = |d: usize| (own[d] - shell).max(0)..=(own[d] + shell).min(self.count[d] - 1);
        for k in range(2) {
            for j in range(1) {
                let rim = (k - own[2]).abs() == shell || (j - own[1]).abs() == shell;
                let whole = rim.then(|| range(0)).into_iter().flatten();
                let ends = [own[0] - shell, own[0] + shell];
                let ends = ends.into_iter().filter(|i| !rim && (0..self.count[0]).contains(i));
                for i in whole.chain(ends) {
                    let key = self.key([i, j, k]) as usize;
                    for p in &self.points[self.starts[key] as usize..self.starts[key + 1] as usize] {
                        let square: f64 = (0..3).map(|d| (f64::from(p[d]) - x[d]).powi(2)).sum();
                        *best = best.min(square);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in [0, 1) that look random: fractions of multiples of irrational numbers.
    fn scattered(n: usize, shift: f64) -> Vec<[f32; 3]> {
        let at = |i: usize, by: f64| ((i as f64 + shift) * by).fract() as f32;
        (0..n).map(|i| [at(i, 0.618_033_988), 0.3 * at(i, 0.414_213_562), 2.0 * at(i, 0.732_050_807)]).collect()
    }

    #[test]
    fn the_nearest_is_that_of_trying_all() {
        let (points, asked) = (scattered(700, 0.0), scattered(300, 0.37));
        let nearest = Nearest::new(points.clone());
        let outside = [[-3.0, 0.1, 0.1], [5.0, 5.0, 5.0]];
        for x in asked.into_iter().chain(outside) {
            let square = |p: &[f32; 3]| (0..3).map(|d| (f64::from(p[d]) - f64::from(x[d])).powi(2)).sum::<f64>().sqrt();
            let all = points.iter().map(square).fold(f64::INFINITY, f64::min);
            assert_eq!(nearest.distance(x), all);
        }
    }

    /// The mean distance of a random place to a cubic lattice is 0.4803 of its spacing.
    #[test]
    fn random_places_are_half_a_spacing_from_a_lattice() {
        let lattice = (0..20 * 20 * 20).map(|i| [i % 20, i / 20 % 20, i / 400].map(|x| x as f32 / 19.0)).collect();
        let nearest = Nearest::new(lattice);
        let asked: Vec<[f32; 3]> = scattered(4000, 0.0).into_iter().map(|[x, y, z]| [x, y / 0.3, z / 2.0]).collect();
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
    fn nothing_is_infinitely_far() {
        assert_eq!(Nearest::new(Vec::new()).distance([0.0; 3]), f64::INFINITY);
    }
}
