//! Triangles, and which of them is seen in each sample of a picture.

use barchan_core::glam::Vec3;
use rayon::prelude::*;

/// Triangles, each of one paint, with what is interpolated between their corners.
#[derive(Clone, Debug, Default)]
pub(super) struct Soup {
    /// Corners [m].
    pub points: Vec<Vec3>,
    /// Normals there.
    pub normals: Vec<Vec3>,
    /// The share of the sky that is seen from there.
    pub sky: Vec<f32>,
    /// The corners of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// What each triangle is painted with.
    pub paints: Vec<u16>,
}

impl Soup {
    /// Adds a corner and gives its number.
    pub(super) fn corner(&mut self, point: Vec3, normal: Vec3, sky: f32) -> u32 {
        self.points.push(point);
        self.normals.push(normal);
        self.sky.push(sky);
        self.points.len() as u32 - 1
    }

    /// Adds a triangle.
    pub(super) fn triangle(&mut self, corners: [u32; 3], paint: u16) {
        self.triangles.push(corners);
        self.paints.push(paint);
    }

    /// Cuts off what is not beyond a depth, which `depth` gives for a place.
    pub(super) fn clip(&mut self, depth: impl Fn(Vec3) -> f32, least: f32) {
        let over: Vec<f32> = self.points.iter().map(|&p| depth(p) - least).collect();
        if over.iter().all(|&o| o > 0.0) {
            return;
        }
        let (triangles, paints) = (std::mem::take(&mut self.triangles), std::mem::take(&mut self.paints));
        for (triangle, paint) in triangles.into_iter().zip(paints) {
            let ahead = triangle.map(|i| over[i as usize] > 0.0);
            if ahead == [true; 3] {
                self.triangle(triangle, paint);
                continue;
            }
            let mut kept = Vec::new();
            for i in 0..3 {
                let (a, b) = (triangle[i] as usize, triangle[(i + 1) % 3] as usize);
                if ahead[i] {
                    kept.push(a as u32);
                }
                if ahead[i] != ahead[(i + 1) % 3] {
                    let t = over[a] / (over[a] - over[b]);
                    let point = self.points[a].lerp(self.points[b], t);
                    let normal = self.normals[a].lerp(self.normals[b], t);
                    let sky = self.sky[a] + t * (self.sky[b] - self.sky[a]);
                    kept.push(self.corner(point, normal, sky));
                }
            }
            (2..kept.len()).for_each(|i| self.triangle([kept[0], kept[i - 1], kept[i]], paint));
        }
    }
}

/// No triangle.
pub(super) const NOTHING: u32 = u32::MAX;

/// What is nearest in each sample.
#[derive(Debug)]
pub(super) struct Buffer {
    /// Columns.
    pub width: usize,
    /// How near it is: greater is nearer, 0 where there is nothing.
    pub near: Vec<f32>,
    /// Which triangle it is, or [`NOTHING`].
    pub which: Vec<u32>,
}

impl Buffer {
    /// Draws triangles whose corners are at columns and rows, and so near. Corners behind the camera, where that is not above 0, are
    /// to be clipped before.
    pub(super) fn new(width: usize, height: usize, at: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let mut buffer = Self { width, near: vec![0.0; width * height], which: vec![NOTHING; width * height] };
        let rows = height.div_ceil(2 * rayon::current_num_threads()).max(1);
        let bands = buffer.near.par_chunks_mut(rows * width).zip(buffer.which.par_chunks_mut(rows * width));
        bands.enumerate().for_each(|(band, (near, which))| {
            let first = band * rows;
            let end = (first + rows).min(height);
            for (number, triangle) in triangles.iter().enumerate() {
                let corners = triangle.map(|i| at[i as usize]);
                span(corners, width, first..end, |row, columns, start, slope| {
                    let row = (row - first) * width;
                    let mut here = start;
                    let samples = row + columns.start..row + columns.end;
                    for (near, which) in near[samples.clone()].iter_mut().zip(&mut which[samples]) {
                        if here > *near {
                            (*near, *which) = (here, number as u32);
                        }
                        here += slope;
                    }
                });
            }
        });
        buffer
    }
}

/// Calls `draw` for each row of samples whose middles a triangle covers: the row, columns, how near it is in the first, and how that
/// grows from column to column.
fn span(
    [a, b, c]: [Vec3; 3],
    width: usize,
    rows: std::ops::Range<usize>,
    mut draw: impl FnMut(usize, std::ops::Range<usize>, f32, f32),
) {
    let low = a.y.min(b.y).min(c.y);
    let high = a.y.max(b.y).max(c.y);
    // Numbers that are not finite fail here.
    if !(high > rows.start as f32 && low < rows.end as f32) {
        return;
    }
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if !(area.abs() > 1e-9 && area.is_finite()) {
        return;
    }
    // Weights of the corners, each linear in column and row.
    let edge = |p: Vec3, q: Vec3| {
        let (across, down) = ((p.y - q.y) / area, (q.x - p.x) / area);
        [across, down, -(across * p.x + down * p.y)]
    };
    let weights = [edge(b, c), edge(c, a), edge(a, b)];
    let plane: [f32; 3] = std::array::from_fn(|i| a.z * weights[0][i] + b.z * weights[1][i] + c.z * weights[2][i]);
    let (left, right) = (a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x));
    let first = (low - 0.5).ceil().max(rows.start as f32) as usize;
    let last = ((high - 0.5).floor() + 1.0).min(rows.end as f32).max(0.0) as usize;
    for row in first..last {
        let y = row as f32 + 0.5;
        let (mut from, mut to) = (left, right);
        for [across, down, start] in weights {
            let here = start + down * y;
            let end = -here / across;
            if across > 0.0 {
                from = from.max(end);
            } else if across < 0.0 {
                to = to.min(end);
            } else if here < 0.0 {
                to = f32::NEG_INFINITY;
            }
        }
        let start = (from - 0.5).ceil().clamp(0.0, width as f32) as usize;
        let end = ((to - 0.5).floor() + 1.0).clamp(0.0, width as f32) as usize;
        if start < end {
            draw(row, start..end, plane[0] * (start as f32 + 0.5) + plane[1] * y + plane[2], plane[0]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_leave_no_gap_and_the_nearer_one_hides_the_other() {
        // A square cut in four at a point that is no sample, nearer towards its right.
        let at = [[2.0, 3.0, 1.0], [12.0, 3.0, 2.0], [12.0, 9.0, 2.0], [2.0, 9.0, 1.0], [5.3, 6.1, 1.33]];
        let mut at: Vec<Vec3> = at.map(Vec3::from_array).to_vec();
        let mut triangles = vec![[0, 1, 4], [2, 1, 4], [2, 3, 4], [3, 0, 4]];
        let covered = |buffer: &Buffer| buffer.which.iter().filter(|&&n| n != NOTHING).count();
        let buffer = Buffer::new(16, 12, &at, &triangles);
        assert_eq!(covered(&buffer), 60);
        assert!((buffer.near[5 * 16 + 11] - 1.95).abs() < 0.05, "{}", buffer.near[5 * 16 + 11]);
        at.extend([[0.0, 0.0, 1.5], [40.0, 0.0, 1.5], [0.0, 40.0, 1.5]].map(Vec3::from_array));
        triangles.push([5, 6, 7]);
        let buffer = Buffer::new(16, 12, &at, &triangles);
        assert_eq!(covered(&buffer), 16 * 12);
        assert_eq!(buffer.which[5 * 16 + 3], 4);
        assert_eq!(buffer.which[5 * 16 + 11], 1);
    }

    #[test]
    fn what_is_behind_is_cut_off() {
        let mut soup = Soup::default();
        for x in [-1.0, 1.0, 3.0] {
            soup.corner(Vec3::new(x, x * x, 0.0), Vec3::Z, x);
        }
        soup.triangle([0, 1, 2], 7);
        soup.clip(|p| p.x, 0.5);
        assert_eq!(soup.triangles.len(), 2);
        let used = || soup.triangles.iter().flatten().map(|&i| i as usize);
        assert!(used().all(|i| soup.points[i].x > 0.4999 && (soup.sky[i] - soup.points[i].x).abs() < 1e-5));
        assert_eq!(soup.paints, [7, 7]);
    }
}
