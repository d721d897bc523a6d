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
pub struct Dot {
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
pub struct Surface {
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
    pub fn new(dots: &[Dot], spacing: f32, min: [f32; 2], max: [f32; 2], floor: f32) -> Self {
        let pitch = 0.5 * spacing;
        let count = |d: usize| ((max[d] - min[d]) / pitch).ceil() as usize + 1;
        let (columns, rows) = (count(0), count(1));
        let (height, ground, side) = caps(dots, spacing, min, pitch, columns, rows);
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
        let mut across = vec![0.0; field.len()];
        across.par_chunks_mut(columns).enumerate().for_each(|(y, out)| {
            let row = &field[y * columns..][..columns];
            for x in 0..columns {
                out[x] = 0.25 * (row[x.saturating_sub(stride)] + row[(x + stride).min(columns - 1)]) + 0.5 * row[x];
            }
        });
        field.par_chunks_mut(columns).enumerate().for_each(|(y, out)| {
            let above = &across[y.saturating_sub(stride) * columns..][..columns];
            let here = &across[y * columns..][..columns];
            let below = &across[(y + stride).min(rows - 1) * columns..][..columns];
            for x in 0..columns {
                out[x] = 0.25 * (above[x] + below[x]) + 0.5 * here[x];
            }
        });
    }

    /// How much of the sky and of the sun each node sees, from the horizons around it.
    fn light(&mut self) {
        let node = |x: f32, y: f32| {
            let x = (x.round().max(0.0) as usize).min(self.columns - 1);
            let y = (y.round().max(0.0) as usize).min(self.rows - 1);
            self.height[y * self.columns + x]
        };
        let directions: [[f32; 2]; SKY_DIRECTIONS] = std::array::from_fn(|i| {
            let angle = (i as f32 + 0.5) * std::f32::consts::TAU / SKY_DIRECTIONS as f32;
            [angle.cos(), angle.sin()]
        });
        let lit = |x: usize, y: usize| {
            let here = self.height[y * self.columns + x];
            let slope = |direction: [f32; 2], steps: f32| {
                let far = node(x as f32 + direction[0] * steps, y as f32 + direction[1] * steps);
                (far - here) / (steps * self.pitch)
            };
            let open: f32 = directions
                .iter()
                .map(|&direction| {
                    let steepest = SKY_STEPS.iter().fold(0.0f32, |s, &steps| s.max(slope(direction, steps)));
                    1.0 - steepest / (1.0 + steepest * steepest).sqrt()
                })
                .sum();
            // The sun's disc is taken wide, so that shadows have soft edges.
            let steepest = SUN_STEPS.iter().fold(0.0f32, |s, &steps| s.max(slope(SUN_DIRECTION, steps)));
            let sun = 1.0 - smoothstep(0.7, 1.3, steepest * SUN.1 / SUN.0);
            (open / SKY_DIRECTIONS as f32, sun)
        };
        let (mut sky, mut sun): (Vec<f32>, Vec<f32>) =
            (0..self.height.len()).into_par_iter().map(|i| lit(i % self.columns, i / self.columns)).unzip();
        self.binomial(&mut sky, 1);
        self.binomial(&mut sun, 1);
        (self.sky, self.sun) = (sky, sun);
    }

    /// Draws the surface, north up, `scale` pixels to the metre. Colour goes by height above `level`, `range` [m] at the
    /// palette's end; `floor` is the colour of bare floor.
    pub fn draw(&self, image: &mut Image, scale: f32, palette: &[Ground], level: f32, range: f32, floor: [f32; 3]) {
        let (width, height) = (image.width(), image.height());
        image.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(row, pixels)| {
            let v = (height as f32 - row as f32 - 0.5) / scale / self.pitch;
            let wy = spline(v - v.floor());
            let y = self.taps(v, self.rows);
            for (column, pixel) in pixels.iter_mut().enumerate() {
                let u = (column as f32 + 0.5) / scale / self.pitch;
                let wx = spline(u - u.floor());
                let x = self.taps(u, self.columns);
                // Height and slopes by cubic B-splines: smooth to the second derivative, so no facets show.
                let (mut h, mut hx, mut hy, mut cover, mut sky, mut sun) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
                for j in 0..4 {
                    let base = y[j] * self.columns;
                    for i in 0..4 {
                        let node = base + x[i];
                        let (value, weight) = (self.height[node], wx[i][0] * wy[j][0]);
                        h += weight * value;
                        hx += wx[i][1] * wy[j][0] * value;
                        hy += wx[i][0] * wy[j][1] * value;
                        cover += weight * self.cover[node];
                        sky += weight * self.sky[node];
                        sun += weight * self.sun[node];
                    }
                }
                let (hx, hy) = (hx / self.pitch, hy / self.pitch);
                // Rough ground is brighter at a slant than Lambert's law says.
                let direct = incidence(hx, hy).powf(0.9) * sun;
                // The sky is bluer than the sun; what faces away from the sun is lit by the ground behind it.
                let fill = 0.16 * (hx * SUN_DIRECTION[0] + hy * SUN_DIRECTION[1]).clamp(0.0, 1.0);
                let sky = sky + fill;
                let light = [1.18 * direct + 0.40 * sky, 1.14 * direct + 0.42 * sky, 1.06 * direct + 0.47 * sky];
                let nearest = self.ground[(v.round() as usize).min(self.rows - 1) * self.columns
                    + (u.round() as usize).min(self.columns - 1)];
                let ground = palette[usize::from(nearest)].at(0.5 + 0.5 * (h - level) / range);
                let grain = 1.0 + 0.05 * speckle(column as u32, row as u32);
                let bare = sky.powi(2) * 0.9;
                *pixel = std::array::from_fn(|c| {
                    encode((ground[c] * light[c] * grain - floor[c] * bare) * cover + floor[c] * bare)
                });
            }
        });
    }

    fn taps(&self, at: f32, count: usize) -> [usize; 4] {
        let first = at.floor() as i64 - 1;
        std::array::from_fn(|i| (first + i as i64).clamp(0, count as i64 - 1) as usize)
    }

    /// Height of the surface at a point [m], from the nearest node.
    pub fn height_at(&self, x: f32, y: f32) -> f32 {
        let index = |value: f32, d: usize, count: usize| {
            (((value - self.min[d]) / self.pitch).round().max(0.0) as usize).min(count - 1)
        };
        self.height[index(y, 1, self.rows) * self.columns + index(x, 0, self.columns)]
    }

    /// Middle height of all that is covered [m], or `None` if nothing is.
    pub fn median(&self) -> Option<f32> {
        let mut heights: Vec<f32> =
            self.height.iter().zip(&self.cover).filter(|&(_, &c)| c > 0.5).map(|(&h, _)| h).collect();
        let middle = heights.len() / 2;
        (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// The topmost particles as overlapping caps: greatest height at each node, its ground, and its particle's side; −∞ where none
/// lies.
fn caps(
    dots: &[Dot],
    spacing: f32,
    min: [f32; 2],
    pitch: f32,
    columns: usize,
    rows: usize,
) -> (Vec<f32>, Vec<u8>, Vec<f32>) {
    let (bin_columns, bin_rows) = (columns.div_ceil(2) + 1, rows.div_ceil(2) + 1);
    let bin = |p: [f32; 3]| {
        let index = |d: usize, count: usize| {
            let i = ((p[d] - min[d]) / spacing).floor();
            (i >= 0.0 && i < count as f32).then_some(i as usize)
        };
        Some(index(1, bin_rows)? * bin_columns + index(0, bin_columns)?)
    };
    let mut top = vec![f32::NEG_INFINITY; bin_columns * bin_rows];
    for dot in dots {
        if let Some(bin) = bin(dot.position) {
            top[bin] = top[bin].max(dot.position[2]);
        }
    }
    let mut height = vec![f32::NEG_INFINITY; columns * rows];
    let mut ground = vec![0; columns * rows];
    let mut side = vec![0.0; columns * rows];
    for dot in dots {
        let [px, py, pz] = dot.position;
        // Only particles within one radius of their bin's top can be seen: one in ten, in a bed.
        let radius = 1.25 * dot.side;
        if bin(dot.position).is_none_or(|bin| pz < top[bin] - radius) {
            continue;
        }
        let (u, v, r) = ((px - min[0]) / pitch, (py - min[1]) / pitch, radius / pitch);
        let range = |at: f32, count: usize| {
            ((at - r).ceil().max(0.0) as usize)..((at + r).floor().max(-1.0) as i64 + 1).clamp(0, count as i64) as usize
        };
        for y in range(v, rows) {
            for x in range(u, columns) {
                let d2 = ((x as f32 - u).powi(2) + (y as f32 - v).powi(2)) / (r * r);
                if d2 < 1.0 {
                    // A paraboloid touching the particle's top; its rim hangs half a side lower.
                    let z = pz + 0.5 * dot.side * (1.0 - d2);
                    let node = y * columns + x;
                    if z > height[node] {
                        (height[node], ground[node], side[node]) = (z, dot.ground, dot.side);
                    }
                }
            }
        }
    }
    (height, ground, side)
}

/// Cosine of the angle between the sun and the normal of a slope, 0 where it faces away.
pub(super) fn incidence(slope_x: f32, slope_y: f32) -> f32 {
    let (high, flat) = SUN;
    let towards = high - flat * (slope_x * SUN_DIRECTION[0] + slope_y * SUN_DIRECTION[1]);
    (towards / (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt()).max(0.0)
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
