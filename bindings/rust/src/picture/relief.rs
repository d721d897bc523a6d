//! The surface from above: a height map of the topmost particles, lit by a low sun and an open sky.

use super::colour::{Ground, encode};
use super::image::Image;
use rayon::prelude::*;

/// Sine and cosine of the sun's height above the horizon (40°): slopes of loose ground, up to about 35°, just stay lit.
const SUN: (f32, f32) = (0.643, 0.766);
/// The sun stands in the upper left, as map readers expect: towards it in x (right) and y (up).
const SUN_DIRECTION: [f32; 2] = [-0.777, 0.629];
/// Directions and distances, in nodes, at which the horizon is looked up for the sky's light.
const SKY_DIRECTIONS: usize = 8;
const SKY_STEPS: [f32; 5] = [1.0, 2.0, 4.0, 8.0, 14.0];
/// Distances, in nodes, at which something may stand before the sun.
const SUN_STEPS: [f32; 8] = [1.0, 2.0, 3.0, 4.5, 6.0, 8.5, 12.0, 17.0];

/// A particle as the picture needs it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Dot {
    /// Position [m].
    pub position: [f32; 3],
    /// Index of its ground in the palette.
    pub ground: u8,
    /// Quantity that colours the vertical cut.
    pub value: f32,
    /// Side of the cube that the particle stands for [m].
    pub side: f32,
}

/// A height map on nodes half the finest particle spacing apart.
pub(super) struct Surface {
    columns: usize,
    rows: usize,
    pitch: f32,
    min: [f32; 2],
    /// Height [m]; where nothing lies, the floor's.
    height: Vec<f32>,
    /// 1 where ground lies, 0 where the floor shows, between at the edge.
    cover: Vec<f32>,
    ground: Vec<u8>,
    /// Share of the sky, and of the sun, that reaches the node.
    sky: Vec<f32>,
    sun: Vec<f32>,
}

impl Surface {
    /// The surface of particles, the finest `spacing` apart, within a rectangle, above a floor.
    pub(super) fn new(dots: &[Dot], spacing: f32, min: [f32; 2], max: [f32; 2], floor: f32) -> Self {
        let pitch = 0.5 * spacing;
        let count = |d: usize| ((max[d] - min[d]) / pitch).ceil() as usize + 1;
        let (columns, rows) = (count(0), count(1));
        let Caps { height, ground, side } = caps(dots, spacing, min, pitch, columns, rows);
        let mut surface = Self {
            columns,
            rows,
            pitch,
            min,
            cover: height.iter().map(|h| f32::from(h.is_finite())).collect(),
            height,
            ground,
            sky: Vec::new(),
            sun: Vec::new(),
        };
        surface.smooth(floor);
        surface.smooth_coarse(&side, spacing);
        surface.light();
        surface
    }

    /// Fills pinholes and takes out the roughness of single particles: a Gaussian of one spacing, weighted with cover.
    fn smooth(&mut self, floor: f32) {
        let mut weighted: Vec<f32> = self.height.iter().map(|&h| if h.is_finite() { h - floor } else { 0.0 }).collect();
        // Five binomial passes (1 2 1) have a standard deviation of 1.6 nodes, 0.8 spacings.
        for _ in 0..5 {
            self.binomial(&mut weighted, 1);
            let mut cover = std::mem::take(&mut self.cover);
            self.binomial(&mut cover, 1);
            self.cover = cover;
        }
        for ((height, cover), weighted) in self.height.iter_mut().zip(&mut self.cover).zip(weighted) {
            let whole = weighted / cover.max(1e-6);
            *cover = smoothstep(0.3, 0.6, *cover);
            // Ground ends in a slope down to the floor, which is flat beyond.
            *height = floor + *cover * whole;
        }
    }

    /// Where coarser particles lie on top, takes out their roughness in the same way, each by its own size.
    fn smooth_coarse(&mut self, side: &[f32], spacing: f32) {
        let coarsest = side.iter().fold(spacing, |a, &b| a.max(b));
        let mut stride = 2;
        while spacing * stride as f32 <= 1.2 * coarsest {
            let mut smoothed = self.height.clone();
            for _ in 0..5 {
                self.binomial(&mut smoothed, stride);
            }
            for ((height, smooth), side) in self.height.iter_mut().zip(smoothed).zip(side) {
                if 1.4 * side >= spacing * stride as f32 {
                    *height = smooth;
                }
            }
            stride *= 2;
        }
    }

    /// One pass (1 2 1) over nodes `stride` apart.
    fn binomial(&self, field: &mut [f32], stride: usize) {
        let (columns, rows) = (self.columns, self.rows);
        let mean = |before: f32, here: f32, after: f32| 0.25 * (before + after) + 0.5 * here;
        let mut across = vec![0.0; field.len()];
        across.par_chunks_mut(columns).zip(field.par_chunks(columns)).for_each(|(out, row)| {
            let rim = stride.min(columns);
            for x in (0..rim).chain(columns - rim..columns) {
                out[x] = mean(row[x.saturating_sub(stride)], row[x], row[(x + stride).min(columns - 1)]);
            }
            // Zipped, so that the compiler makes lanes of it.
            let inner = out.iter_mut().skip(stride).zip(row).zip(row.iter().skip(stride));
            for (((out, before), here), after) in inner.zip(row.iter().skip(2 * stride)) {
                *out = mean(*before, *here, *after);
            }
        });
        let row = |y: usize| &across[y * columns..][..columns];
        field.par_chunks_mut(columns).enumerate().for_each(|(y, out)| {
            let (above, here, below) = (row(y.saturating_sub(stride)), row(y), row((y + stride).min(rows - 1)));
            for (((out, above), here), below) in out.iter_mut().zip(above).zip(here).zip(below) {
                *out = mean(*above, *here, *below);
            }
        });
    }

    /// How much of the sky and of the sun each node sees, from the horizons around it.
    fn light(&mut self) {
        let (columns, rows) = (self.columns, self.rows);
        // Rows carried on at both ends: looking about from a row is then a pass over whole slices.
        let far = SUN_STEPS.iter().chain(&SKY_STEPS).fold(0.0f32, |far, &steps| far.max(steps)) as usize;
        let wide: Vec<f32> = self
            .height
            .chunks(columns)
            .flat_map(|row| {
                let end = |value: f32| std::iter::repeat_n(value, far);
                end(row[0]).chain(row.iter().copied()).chain(end(row[columns - 1]))
            })
            .collect();
        // The steepest way up from each node of a row in one direction.
        let look = |y: usize, direction: [f32; 2], distances: &[f32], steepest: &mut [f32]| {
            steepest.fill(0.0);
            let here = &self.height[y * columns..][..columns];
            for &steps in distances {
                let [dx, dy] = direction.map(|towards| (towards * steps).round() as i64);
                let there = (y as i64 + dy).clamp(0, rows as i64 - 1) as usize * (columns + 2 * far);
                let there = &wide[there + (far as i64 + dx) as usize..][..columns];
                let per_metre = 1.0 / (steps * self.pitch);
                for ((steepest, here), there) in steepest.iter_mut().zip(here).zip(there) {
                    let rise = (there - here) * per_metre;
                    // A bare comparison: f32::max looks for NaN too, which takes three times as long.
                    *steepest = if rise > *steepest { rise } else { *steepest };
                }
            }
        };
        let directions: [[f32; 2]; SKY_DIRECTIONS] = std::array::from_fn(|i| {
            let angle = (i as f32 + 0.5) * std::f32::consts::TAU / SKY_DIRECTIONS as f32;
            [angle.cos(), angle.sin()]
        });
        let (mut sky, mut sun) = (vec![0.0; columns * rows], vec![0.0; columns * rows]);
        sky.par_chunks_mut(columns).zip(sun.par_chunks_mut(columns)).enumerate().for_each(|(y, (sky, sun))| {
            let mut steepest = vec![0.0; columns];
            for direction in directions {
                look(y, direction, &SKY_STEPS, &mut steepest);
                for (sky, s) in sky.iter_mut().zip(&steepest) {
                    *sky += (1.0 - s / (1.0 + s * s).sqrt()) / SKY_DIRECTIONS as f32;
                }
            }
            // The sun's disc is taken wide, so that shadows have soft edges.
            look(y, SUN_DIRECTION, &SUN_STEPS, &mut steepest);
            for (sun, s) in sun.iter_mut().zip(&steepest) {
                *sun = 1.0 - smoothstep(0.7, 1.3, s * SUN.1 / SUN.0);
            }
        });
        self.binomial(&mut sky, 1);
        self.binomial(&mut sun, 1);
        (self.sky, self.sun) = (sky, sun);
    }

    /// Draws the surface, north up, `scale` pixels to the metre. Colour goes by height above `level`, `range` [m] at the
    /// palette's end; `floor` is the colour of bare floor.
    pub(super) fn draw(
        &self,
        image: &mut Image,
        scale: f32,
        palette: &[Ground],
        level: f32,
        range: f32,
        floor: [f32; 3],
    ) {
        let (width, height) = (image.width(), image.height());
        // Where each column of pixels reads the nodes: place, taps, weights.
        let at = |column: usize| {
            let u = (column as f32 + 0.5) / scale / self.pitch;
            (u, taps(u, self.columns), spline(u.fract()))
        };
        let across: Vec<(f32, [usize; 4], [[f32; 2]; 4])> = (0..width).map(at).collect();
        image.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(row, pixels)| {
            let v = (height as f32 - row as f32 - 0.5) / scale / self.pitch;
            let wy = spline(v.fract());
            let y = taps(v, self.rows);
            // Four rows of nodes are blended into one first: height, its slope along y, cover, sky, sun.
            let mut blended = vec![[0.0f32; 5]; self.columns];
            for (j, [weight, slope]) in wy.into_iter().enumerate() {
                let row = y[j] * self.columns..(y[j] + 1) * self.columns;
                let (height, cover) = (&self.height[row.clone()], &self.cover[row.clone()]);
                let lights = self.sky[row.clone()].iter().zip(&self.sun[row]);
                for (((sum, h), cover), (sky, sun)) in blended.iter_mut().zip(height).zip(cover).zip(lights) {
                    let terms = [weight * h, slope * h, weight * cover, weight * sky, weight * sun];
                    (0..5).for_each(|f| sum[f] += terms[f]);
                }
            }
            let ground = &self.ground[((v + 0.5) as usize).min(self.rows - 1) * self.columns..][..self.columns];
            for ((column, pixel), (u, x, wx)) in pixels.iter_mut().enumerate().zip(&across) {
                // Height and slopes by cubic B-splines: smooth to the second derivative, so no facets show.
                let (mut sums, mut hx) = ([0.0; 5], 0.0);
                for (node, [weight, slope]) in x.iter().zip(wx) {
                    let values = &blended[*node];
                    (0..5).for_each(|f| sums[f] += weight * values[f]);
                    hx += slope * values[0];
                }
                let [h, hy, cover, sky, sun] = sums;
                let (hx, hy) = (hx / self.pitch, hy / self.pitch);
                // Rough ground is brighter at a slant than Lambert's law says.
                let direct = rough(incidence(hx, hy)) * sun;
                // The sky is bluer than the sun; what faces away from the sun is lit by the ground behind it.
                let fill = 0.16 * (hx * SUN_DIRECTION[0] + hy * SUN_DIRECTION[1]).clamp(0.0, 1.0);
                let sky = sky + fill;
                let light = [1.18 * direct + 0.40 * sky, 1.14 * direct + 0.42 * sky, 1.06 * direct + 0.47 * sky];
                let nearest = ground[((u + 0.5) as usize).min(self.columns - 1)];
                // Without soft bodies there is floor alone.
                let ground = palette
                    .get(usize::from(nearest))
                    .map_or(floor, |ground| ground.at(0.5 + 0.5 * (h - level) / range));
                let grain = 1.0 + 0.05 * speckle(column as u32, row as u32);
                let bare = sky.powi(2) * 0.9;
                *pixel = std::array::from_fn(|c| {
                    encode((ground[c] * light[c] * grain - floor[c] * bare) * cover + floor[c] * bare)
                });
            }
        });
    }

    /// Height of the surface at a point [m], from the nearest node.
    pub(super) fn height_at(&self, x: f32, y: f32) -> f32 {
        let index = |value: f32, d: usize, count: usize| {
            (((value - self.min[d]) / self.pitch).round().max(0.0) as usize).min(count - 1)
        };
        self.height[index(y, 1, self.rows) * self.columns + index(x, 0, self.columns)]
    }

    /// Middle height of all that is covered [m], or `None` if nothing is.
    pub(super) fn median(&self) -> Option<f32> {
        let mut heights: Vec<f32> =
            self.height.iter().zip(&self.cover).filter(|&(_, &c)| c > 0.5).map(|(&h, _)| h).collect();
        let middle = heights.len() / 2;
        (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// What lies on top of each node: greatest height, −∞ where nothing lies, its ground, and its particle's side.
struct Caps {
    height: Vec<f32>,
    ground: Vec<u8>,
    side: Vec<f32>,
}

/// Parts that dots are drawn in at the same time, for any number of threads: later ones win only where they are higher, so that
/// the result is that of one after the other.
const PARTS: usize = 2;

/// The topmost particles as overlapping caps.
fn caps(dots: &[Dot], spacing: f32, min: [f32; 2], pitch: f32, columns: usize, rows: usize) -> Caps {
    let (bin_columns, bin_rows) = (columns.div_ceil(2) + 1, rows.div_ceil(2) + 1);
    let bin = |p: [f32; 3]| {
        let [u, v] = [0, 1].map(|d| (p[d] - min[d]) / spacing);
        let inside = u >= 0.0 && v >= 0.0 && u < bin_columns as f32 && v < bin_rows as f32;
        inside.then(|| v as usize * bin_columns + u as usize)
    };
    let parts = || dots.par_chunks(dots.len().div_ceil(PARTS).max(1));
    let tops = parts().map(|dots| {
        let mut top = vec![f32::NEG_INFINITY; bin_columns * bin_rows];
        for dot in dots {
            if let Some(bin) = bin(dot.position) {
                top[bin] = top[bin].max(dot.position[2]);
            }
        }
        top
    });
    let top = tops.reduce_with(|mut a, b| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a = a.max(b));
        a
    });
    let Some(top) = top else { return Caps::none(columns * rows) };
    let drawn = parts().map(|dots| {
        let mut caps = Caps::none(columns * rows);
        for dot in dots {
            // Only particles within one radius of their bin's top can be seen: one in ten, in a bed.
            if bin(dot.position).is_some_and(|bin| dot.position[2] >= top[bin] - RADIUS * dot.side) {
                caps.draw(dot, min, pitch, columns, rows);
            }
        }
        caps
    });
    drawn.reduce_with(Caps::under).unwrap_or_else(|| Caps::none(columns * rows))
}

/// Radius of a particle's cap in its sides.
const RADIUS: f32 = 1.25;

impl Caps {
    fn none(nodes: usize) -> Self {
        Self { height: vec![f32::NEG_INFINITY; nodes], ground: vec![0; nodes], side: vec![0.0; nodes] }
    }

    /// Puts others on top where they are higher.
    fn under(mut self, other: Self) -> Self {
        for (node, height) in other.height.into_iter().enumerate() {
            if height > self.height[node] {
                (self.height[node], self.ground[node], self.side[node]) =
                    (height, other.ground[node], other.side[node]);
            }
        }
        self
    }

    /// Draws a particle's cap: a paraboloid touching its top, whose rim hangs half a side lower.
    fn draw(&mut self, dot: &Dot, min: [f32; 2], pitch: f32, columns: usize, rows: usize) {
        let [px, py, pz] = dot.position;
        let (u, v, r) = ((px - min[0]) / pitch, (py - min[1]) / pitch, RADIUS * dot.side / pitch);
        let range = |at: f32, count: usize| {
            ((at - r).ceil().max(0.0) as usize)..((at + r).floor().max(-1.0) as i64 + 1).clamp(0, count as i64) as usize
        };
        let per_square = 1.0 / (r * r);
        for y in range(v, rows) {
            let dy2 = (y as f32 - v).powi(2);
            for x in range(u, columns) {
                let d2 = ((x as f32 - u).powi(2) + dy2) * per_square;
                let z = pz + 0.5 * dot.side * (1.0 - d2);
                let node = y * columns + x;
                if d2 < 1.0 && z > self.height[node] {
                    (self.height[node], self.ground[node], self.side[node]) = (z, dot.ground, dot.side);
                }
            }
        }
    }
}

/// Cosine of the angle between the sun and the normal of a slope, 0 where it faces away.
pub(super) fn incidence(slope_x: f32, slope_y: f32) -> f32 {
    let (high, flat) = SUN;
    let towards = high - flat * (slope_x * SUN_DIRECTION[0] + slope_y * SUN_DIRECTION[1]);
    (towards / (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt()).max(0.0)
}

/// The four nodes about a place that is not negative, one of `count` each.
fn taps(at: f32, count: usize) -> [usize; 4] {
    let first = at as i64 - 1;
    std::array::from_fn(|i| (first + i as i64).clamp(0, count as i64 - 1) as usize)
}

/// Weights of a uniform cubic B-spline and their slopes, for the four nodes around a point `f` past the second.
fn spline(f: f32) -> [[f32; 2]; 4] {
    let g = 1.0 - f;
    [
        [g * g * g / 6.0, -0.5 * g * g],
        [2.0 / 3.0 - f * f * (1.0 - 0.5 * f), f * (1.5 * f - 2.0)],
        [2.0 / 3.0 - g * g * (1.0 - 0.5 * g), -g * (1.5 * g - 2.0)],
        [f * f * f / 6.0, 0.5 * f * f],
    ]
}

/// Brightness of rough ground at a cosine of the sun's incidence, cos^0.9, by a table: a picture asks once a pixel.
pub(super) fn rough(cosine: f32) -> f32 {
    const SIZE: usize = 4096;
    static TABLE: std::sync::OnceLock<Vec<f32>> = std::sync::OnceLock::new();
    let table = TABLE.get_or_init(|| (0..=SIZE).map(|i| (i as f32 / SIZE as f32).powf(0.9)).collect());
    table[((cosine * SIZE as f32) as usize).min(SIZE)]
}

/// 0 below `a`, 1 above `b`, smooth between.
pub(super) fn smoothstep(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A fixed grain for each pixel, −1 to 1: ground is never evenly coloured.
fn speckle(x: u32, y: u32) -> f32 {
    let mut hash = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b);
    hash = (hash ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d);
    hash = (hash ^ (hash >> 12)).wrapping_mul(0x297a_2d39);
    ((hash ^ (hash >> 15)) >> 8) as f32 / 8_388_608.0 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bed 0.1 m deep with a furrow four columns wide and two layers (10 mm) deep along y, on a 5 mm lattice.
    fn furrowed() -> Vec<Dot> {
        let mut dots = Vec::new();
        for (i, j, k) in (0..60).flat_map(|i| (0..40).flat_map(move |j| (0..20).map(move |k| (i, j, k)))) {
            let p = [i, j, k].map(|n| (n as f32 + 0.5) * 5e-3);
            if (p[0] - 0.15).abs() > 8e-3 || p[2] < 0.092 {
                dots.push(Dot { position: p, ground: 0, value: 0.0, side: 5e-3 });
            }
        }
        dots
    }

    #[test]
    fn a_lattice_is_flat_and_a_furrow_two_cells_wide_stays() {
        let surface = Surface::new(&furrowed(), 5e-3, [0.0; 2], [0.3, 0.2], 0.0);
        let median = surface.median().unwrap();
        assert!((median - 0.1).abs() < 2e-3, "{median}");
        let flat: Vec<f32> = (20..=40).map(|i| surface.height_at(0.002 * i as f32, 0.1)).collect();
        let ripple = flat.iter().fold(0.0f32, |a, &h| a.max((h - median).abs()));
        assert!(ripple < 2e-4, "lattice noise of {ripple} m");
        let depth = median - surface.height_at(0.15, 0.1);
        assert!((8e-3..1.01e-2).contains(&depth), "furrow of {depth} m");
        assert!(surface.sky.iter().all(|s| (0.0..=1.0).contains(s)));
    }

    #[test]
    fn spline_weights_are_a_partition_of_unity() {
        for f in [0.0, 0.3, 0.99] {
            let w = spline(f);
            assert!((w.iter().map(|w| w[0]).sum::<f32>() - 1.0).abs() < 1e-6);
            assert!(w.iter().map(|w| w[1]).sum::<f32>().abs() < 1e-6);
            // Slope of a straight line with slope 1.
            let slope: f32 = w.iter().enumerate().map(|(i, w)| i as f32 * w[1]).sum();
            assert!((slope - 1.0).abs() < 1e-5);
        }
    }
}
