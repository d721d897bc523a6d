//! The surface of the ground on a grid of columns, so that runs of different resolution can be compared.

use super::Grain;
use barchan_core::scene::World;

/// Height of the surface in square columns.
#[derive(Clone, Debug)]
pub struct HeightMap {
    min: [f64; 2],
    column: f64,
    count: [usize; 2],
    heights: Vec<f64>,
}

impl HeightMap {
    /// The surface of grains in columns `column` [m] wide. Each grain fills the cube of its rest volume, blurred sideways by a
    /// column's width: cubes that tile space, also of several sizes, still fill it evenly then. A column's surface lies where its topmost bin that is at least half full ends, with what
    /// the bin above holds put on top: exact for compact ground, and blind to single grains in the air. Columns without
    /// ground have the height of the world's floor.
    pub fn new(grains: &[Grain], world: &World, column: f64) -> Self {
        let (min, h) = (world.min, column);
        let top = grains.iter().map(|g| f64::from(g.position[2] + g.side)).fold(min[2] + h, f64::max);
        let count = [0, 1].map(|d| ((world.max[d] - min[d]) / h - 1e-6).ceil().max(1.0) as usize);
        let bins = ((top.min(world.max[2]) - min[2]) / h).ceil() as usize + 1;
        let mut filled = vec![0f32; count[0] * count[1] * bins];
        for grain in grains {
            let side = f64::from(grain.side);
            let share = (side / h).powi(3);
            let [x, y, z] = [(0, 1.0, count[0]), (1, 1.0, count[1]), (2, 0.0, bins)].map(|(d, blur, count)| {
                Overlap::new((f64::from(grain.position[d]) - min[d]) / h, side / h, blur, count)
            });
            for (i, wx) in x.clone() {
                for (j, wy) in y.clone() {
                    for (k, wz) in z.clone() {
                        filled[(j * count[0] + i) * bins + k] += (share * wx * wy * wz) as f32;
                    }
                }
            }
        }
        let height = |bins: &[f32]| match bins.iter().rposition(|f| *f >= 0.5) {
            Some(k) => {
                let above = bins.get(k + 1).copied().unwrap_or(0.0);
                min[2] + h * (k as f64 + f64::from(bins[k].min(1.0) + above))
            }
            None => min[2],
        };
        Self { min: [min[0], min[1]], column, count, heights: filled.chunks(bins).map(height).collect() }
    }

    /// Puts in heights [m] that are known otherwise, of columns about such middles [m].
    pub(crate) fn put_in(&mut self, known: impl FnOnce(&[[f64; 2]]) -> Vec<Option<f64>>) {
        let columns: Vec<[f64; 2]> = (0..self.heights.len()).map(|index| self.at(index)).collect();
        self.heights.iter_mut().zip(known(&columns)).for_each(|(height, known)| *height = known.unwrap_or(*height));
    }

    /// Height of each column [m], rows along x.
    pub fn heights(&self) -> &[f64] {
        &self.heights
    }

    /// Columns along x and y.
    pub fn count(&self) -> [usize; 2] {
        self.count
    }

    /// Middle of a column [m].
    pub fn at(&self, index: usize) -> [f64; 2] {
        let cell = [index % self.count[0], index / self.count[0]];
        std::array::from_fn(|d| self.min[d] + (cell[d] as f64 + 0.5) * self.column)
    }

    /// Middle height [m].
    pub fn median(&self) -> f64 {
        let mut sorted = self.heights.clone();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    }
}

/// Bins that a blurred interval overlaps, and its share in each. What lies outside counts for the outermost bins.
#[derive(Clone)]
struct Overlap {
    centre: f64,
    width: f64,
    blur: f64,
    bin: i64,
    count: usize,
}

impl Overlap {
    /// The interval about `centre`, `width` wide, blurred by a box `blur` wide; all in bins.
    fn new(centre: f64, width: f64, blur: f64, count: usize) -> Self {
        Self { centre, width, blur, bin: (centre - 0.5 * (width + blur)).floor() as i64, count }
    }

    /// Share below a place: the sum of two even distributions, integrated.
    fn below(&self, place: f64) -> f64 {
        let x = place - self.centre;
        if self.blur == 0.0 {
            return (x / self.width + 0.5).clamp(0.0, 1.0);
        }
        let ramp = |shift: f64| (x + 0.5 * shift).max(0.0).powi(2);
        let (sum, difference) = (self.width + self.blur, self.width - self.blur);
        (ramp(sum) - ramp(difference) - ramp(-difference) + ramp(-sum)) / (2.0 * self.width * self.blur)
    }
}

impl Iterator for Overlap {
    type Item = (usize, f64);

    fn next(&mut self) -> Option<(usize, f64)> {
        let low = self.bin as f64;
        if low >= self.centre + 0.5 * (self.width + self.blur) {
            return None;
        }
        let bin = self.bin.clamp(0, self.count as i64 - 1) as usize;
        self.bin += 1;
        Some((bin, self.below(low + 1.0) - self.below(low)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world() -> World {
        let scene = barchan_tasks::scene("cube-drop", &[] as &[&str]).unwrap();
        World { max: [0.4, 0.4, 0.8], ..scene.world }
    }

    fn bed(spacing: f64, height: f64) -> Vec<Grain> {
        let along = (0.4 / spacing).round() as usize;
        let layers = (height / spacing).round() as usize;
        let at = |i: usize| ((i as f64 + 0.5) * spacing) as f32;
        let places = (0..along * along * layers).map(|n| [n % along, n / along % along, n / along / along]);
        places.map(|p| Grain { position: p.map(at), side: spacing as f32 }).collect()
    }

    /// Beds of one height have that height at any spacing, in every column, at walls too.
    #[test]
    fn beds_are_flat_at_any_spacing() {
        for spacing in [0.005, 0.01, 0.02, 0.04] {
            let map = HeightMap::new(&bed(spacing, 0.12), &world(), 0.01);
            let worst = map.heights().iter().fold(0f64, |worst, h| worst.max((h - 0.12).abs()));
            assert!(worst < 1e-6, "{worst} m at {spacing} m");
            assert_eq!(map.heights().len(), 1600);
        }
    }

    /// Where grains of two sizes meet, the surface goes on evenly.
    #[test]
    fn levels_leave_no_step() {
        let left = bed(0.005, 0.12).into_iter().filter(|g| g.position[0] < 0.2);
        let right = bed(0.01, 0.12).into_iter().filter(|g| g.position[0] > 0.2);
        let map = HeightMap::new(&left.chain(right).collect::<Vec<_>>(), &world(), 0.01);
        let worst = map.heights().iter().fold(0f64, |worst, h| worst.max((h - 0.12).abs()));
        assert!(worst < 1e-6, "{worst} m");
    }

    #[test]
    fn surfaces_between_bins_and_single_grains() {
        let mut grains = bed(0.005, 0.125);
        grains.push(Grain { position: [0.2, 0.2, 0.3], side: 0.005 });
        let map = HeightMap::new(&grains, &world(), 0.01);
        let worst = map.heights().iter().fold(0f64, |worst, h| worst.max((h - 0.125).abs()));
        assert!(worst < 1e-6, "{worst} m");
        let empty = HeightMap::new(&[], &world(), 0.01);
        assert!(empty.heights().iter().all(|h| *h == 0.0));
    }
}
