//! Rigid tools in pictures: traced from above, cut through from the side, by their signed distance alone.

use super::image::{Colour, Image};
use super::relief::{Surface, smoothstep};
use barchan_core::Vec3;
use barchan_core::coupling::Aabb;

const STEEL: [f32; 3] = [118.0, 128.0, 142.0];
const EDGE: Colour = [38, 42, 50];
/// Most distances asked for in one picture of one body: wide bodies are sampled more coarsely.
const SAMPLES: f64 = 40_000.0;

/// The tools of a moment, as far as a picture shows them.
#[derive(Debug, Default)]
pub(super) struct Tools {
    above: Vec<Traced>,
    cut: Vec<Sampled>,
}

/// A body seen from above: where rays hit it (−∞ if nowhere), and how near they come [m], −1 pixel for a hit and at most 1 pixel.
#[derive(Debug)]
struct Traced {
    mesh: Mesh,
    top: Vec<f64>,
    nearest: Vec<f64>,
}

/// Signed distances from a body's surface in the plane of the cut [m].
#[derive(Debug)]
struct Sampled {
    mesh: Mesh,
    distance: Vec<f64>,
}

/// Width and height of a panel in pixels.
type Size = (usize, usize);
/// Signed distance to the nearest body's surface at each point [m], negative inside.
type Distance<'a> = &'a dyn Fn(&[Vec3]) -> Vec<f64>;

/// Where a picture's pixels lie in the world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    /// World coordinates of the lower left corner: x, and y or z [m].
    pub origin: [f64; 2],
    /// Pixels per metre.
    pub scale: f64,
}

/// Samples on a coarse mesh of pixels, read bilinearly.
#[derive(Debug)]
struct Mesh {
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
    stride: usize,
}

impl Mesh {
    /// The pixels of a panel under a box's face, or `None` if there are none.
    fn new((across, down): Size, frame: Frame, min: [f64; 2], max: [f64; 2]) -> Option<Self> {
        let clip = |v: f64, count: usize| v.clamp(0.0, count as f64) as usize;
        let left = clip((min[0] - frame.origin[0]) * frame.scale - 2.0, across);
        let right = clip((max[0] - frame.origin[0]) * frame.scale + 3.0, across);
        let height = down as f64;
        let top = clip(height - (max[1] - frame.origin[1]) * frame.scale - 2.0, down);
        let bottom = clip(height - (min[1] - frame.origin[1]) * frame.scale + 3.0, down);
        let (width, height) = (right.saturating_sub(left), bottom.saturating_sub(top));
        if width == 0 || height == 0 {
            return None;
        }
        let stride = ((width * height) as f64 / SAMPLES).sqrt().ceil().max(1.0) as usize;
        Some(Self { left, top, columns: width.div_ceil(stride) + 1, rows: height.div_ceil(stride) + 1, stride })
    }
    /// World coordinates of the samples, row by row, in a panel so many pixels high.
    fn points(&self, height: usize, frame: Frame) -> Vec<[f64; 2]> {
        let at = |i: usize, first: usize| (first + i * self.stride) as f64 + 0.5;
        (0..self.rows)
            .flat_map(|j| (0..self.columns).map(move |i| (i, j)))
            .map(|(i, j)| {
                let x = frame.origin[0] + at(i, self.left) / frame.scale;
                let y = frame.origin[1] + (height as f64 - at(j, self.top)) / frame.scale;
                [x, y]
            })
            .collect()
    }
    /// Calls `f` with each pixel and the bilinear weights of its four samples.
    fn pixels(&self, image: &Image, mut f: impl FnMut(usize, usize, [(usize, f64); 4])) {
        for y in self.top..(self.top + (self.rows - 1) * self.stride).min(image.height()) {
            for x in self.left..(self.left + (self.columns - 1) * self.stride).min(image.width()) {
                let (i, j) = ((x - self.left) / self.stride, (y - self.top) / self.stride);
                let u = ((x - self.left) % self.stride) as f64 / self.stride as f64;
                let v = ((y - self.top) % self.stride) as f64 / self.stride as f64;
                let node = j * self.columns + i;
                let (right, below) = (node + 1, node + self.columns);
                let upper = [(node, (1.0 - u) * (1.0 - v)), (right, u * (1.0 - v))];
                let lower = [(below, (1.0 - u) * v), (below + 1, u * v)];
                f(x, y, [upper[0], upper[1], lower[0], lower[1]]);
            }
        }
    }
}

impl Tools {
    /// Of bodies in boxes: from above in a panel of some size and frame, and in the plane y = `cut_y` in another one.
    pub(super) fn new(
        boxes: &[Aabb],
        distance: Distance<'_>,
        above: (Size, Frame),
        cut: (Size, Frame),
        cut_y: f64,
    ) -> Self {
        let seen = |body: &Aabb| {
            let (size, frame) = above;
            let mesh = Mesh::new(size, frame, [body.min[0], body.min[1]], [body.max[0], body.max[1]])?;
            let (top, nearest) = trace(&mesh.points(size.1, frame), body, 1.0 / frame.scale, distance);
            Some(Traced { mesh, top, nearest })
        };
        let sampled = |body: &Aabb| {
            let (size, frame) = cut;
            let mesh = Mesh::new(size, frame, [body.min[0], body.min[2]], [body.max[0], body.max[2]])?;
            let at: Vec<Vec3> = mesh.points(size.1, frame).into_iter().map(|[x, z]| [x, cut_y, z]).collect();
            Some(Sampled { mesh, distance: distance(&at) })
        };
        let is_cut = |body: &&Aabb| body.min[1] <= cut_y && cut_y <= body.max[1];
        Self {
            above: boxes.iter().filter_map(seen).collect(),
            cut: boxes.iter().filter(is_cut).filter_map(sampled).collect(),
        }
    }

    /// Draws the tools as seen from above over a surface, lit as it is, a little transparent.
    pub(super) fn draw_above(&self, image: &mut Image, frame: Frame, surface: &Surface) {
        let pixel = 1.0 / frame.scale;
        for Traced { mesh, top, nearest } in &self.above {
            let step = mesh.stride as f64 * pixel;
            let mut out = Vec::new();
            mesh.pixels(image, |x, y, corners| {
                let near: f64 = corners.iter().map(|&(n, w)| w * nearest[n]).sum();
                let coverage = (0.5 - near / pixel).clamp(0.0, 1.0) as f32;
                if coverage == 0.0 {
                    return;
                }
                // Height and slope from the samples that hit, so that a rim does not mix with the ground beyond it.
                let hits = corners.iter().filter(|&&(n, _)| top[n].is_finite());
                let (sum, weight) = hits.fold((0.0, 0.0), |(s, t), &(n, w)| (s + w * top[n], t + w));
                let node = corners[0].0;
                let get = |n: usize| top.get(n).copied().unwrap_or(f64::NEG_INFINITY);
                let slope = |ahead: usize, behind: usize| match (get(ahead), get(behind)) {
                    (a, b) if a.is_finite() && b.is_finite() => ((a - b) / (2.0 * step)).clamp(-3.0, 3.0) as f32,
                    _ => 0.0,
                };
                let (right, left) = (node + 1, node.wrapping_sub(1));
                let (up, down) = (node.wrapping_sub(mesh.columns), node + mesh.columns);
                let (sx, sy) = (slope(right, left), slope(up, down));
                // A line is drawn where the body ends or falls away.
                let rim = [right, left, up, down].iter().any(|&n| get(n) < get(node) - 6.0 * step);
                let light = super::relief::incidence(sx, sy);
                let z = if weight > 0.0 { sum / weight } else { f64::INFINITY };
                let [wx, wy] = [x as f64 + 0.5, image.height() as f64 - y as f64 - 0.5].map(|p| p / frame.scale);
                let ground = surface.height_at((frame.origin[0] + wx) as f32, (frame.origin[1] + wy) as f32);
                let above = smoothstep(-1.0, 1.0, ((z - f64::from(ground)) / pixel).clamp(-2.0, 2.0) as f32);
                let shade = STEEL.map(|s| (s * (0.55 + 0.75 * light)).min(255.0) as u8);
                out.push((
                    x,
                    y,
                    super::image::mix(shade, EDGE, if rim { 0.8 } else { 0.0 }),
                    0.86 * coverage * above.max(0.12),
                ));
            });
            out.into_iter().for_each(|(x, y, colour, alpha)| image.blend(x as i64, y as i64, colour, alpha));
        }
    }

    /// Draws the tools as cut by the plane.
    pub(super) fn draw_cut(&self, image: &mut Image, frame: Frame) {
        for Sampled { mesh, distance } in &self.cut {
            let mut out = Vec::new();
            mesh.pixels(image, |x, y, corners| {
                let d = corners.iter().map(|&(n, w)| w * distance[n]).sum::<f64>() * frame.scale;
                let rim = smoothstep(-2.8, -1.2, d as f32);
                let colour = super::image::mix(STEEL.map(|s| (s * 1.15) as u8), EDGE, rim);
                out.push((x, y, colour, (0.5 - d).clamp(0.0, 1.0) as f32));
            });
            out.into_iter().for_each(|(x, y, colour, alpha)| image.blend(x as i64, y as i64, colour, alpha));
        }
    }
}

/// Follows rays straight down through a body's box: where they hit (−∞ if nowhere), and how near they come [m], −`pixel`
/// for a hit and at most `pixel`.
fn trace(points: &[[f64; 2]], body: &Aabb, pixel: f64, distance: Distance<'_>) -> (Vec<f64>, Vec<f64>) {
    let mut height = vec![f64::NEG_INFINITY; points.len()];
    let mut nearest = vec![pixel; points.len()];
    let mut rays: Vec<(usize, f64)> = (0..points.len()).map(|i| (i, body.max[2])).collect();
    for _ in 0..64 {
        if rays.is_empty() {
            break;
        }
        let at: Vec<Vec3> = rays.iter().map(|&(i, z)| [points[i][0], points[i][1], z]).collect();
        let distance = distance(&at);
        rays = rays
            .into_iter()
            .zip(distance)
            .filter_map(|((i, z), d)| {
                if d < 0.05 * pixel {
                    (height[i], nearest[i]) = (z, -pixel);
                    return None;
                }
                nearest[i] = nearest[i].min(d);
                (z - d > body.min[2]).then_some((i, z - d))
            })
            .collect();
    }
    (height, nearest)
}
