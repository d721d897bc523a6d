//! Surfaces of particles: the share of space that they fill, on a grid, and the net of faces where that passes a level.
//!
//! # Source
//! Surface nets: Gibson 1998, Constrained elastic surface nets. A corner for each cell that is passed, in the mean of where its edges are.

use barchan_core::glam::Vec3;
use rayon::prelude::*;

/// A field on nodes in the middles of cells.
#[derive(Debug)]
pub(crate) struct Field {
    /// Corner of the first cell [m].
    pub(crate) min: Vec3,
    /// Width of its cells [m].
    pub(crate) cell: f32,
    /// Cells along each axis.
    pub(crate) count: [usize; 3],
    /// Values, along x first.
    pub(crate) values: Vec<f32>,
}

impl Field {
    /// Zero everywhere.
    pub(crate) fn new(min: Vec3, cell: f32, count: [usize; 3]) -> Self {
        Self { min, cell, count, values: vec![0.0; count.iter().product()] }
    }

    /// Where the value of a cell stands.
    pub(crate) fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.count[1] + j) * self.count[0] + i
    }

    /// The value at a place, linear between nodes; beyond them, that of the nearest.
    #[cfg(feature = "pictures")]
    pub(crate) fn at(&self, place: Vec3) -> f32 {
        let place = ((place - self.min) / self.cell - 0.5).to_array();
        let mut first = [0; 3];
        let mut part = [0.0; 3];
        for d in 0..3 {
            let x = place[d].clamp(0.0, (self.count[d] - 1) as f32);
            first[d] = (x as usize).min(self.count[d].saturating_sub(2));
            part[d] = x - first[d] as f32;
        }
        let more: [usize; 3] = std::array::from_fn(|d| usize::from(self.count[d] > 1));
        let value = |bits: [usize; 3]| self.values[self.index(std::array::from_fn(|d| first[d] + bits[d] * more[d]))];
        let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
        let row = |j, k| mix(value([0, j, k]), value([1, j, k]), part[0]);
        let layer = |k| mix(row(0, k), row(1, k), part[1]);
        mix(layer(0), layer(1), part[2])
    }

    /// Fills the cells that a cube of some side covers.
    pub(crate) fn fill(&mut self, place: Vec3, side: f32, mut at: impl FnMut(usize)) {
        /// Cells across the largest particle; the coarsest level's are 128 times as wide as the finest's.
        const MOST: usize = 160;
        let mut shares = [[0.0; MOST]; 3];
        let mut first = [0; 3];
        let mut count = [0; 3];
        for d in 0..3 {
            let middle = (place[d] - self.min[d]) / self.cell;
            let half = 0.5 * side / self.cell;
            let (low, high) = ((middle - half).max(0.0), (middle + half).min(self.count[d] as f32));
            if low >= high {
                return;
            }
            first[d] = low as usize;
            count[d] = (high.ceil() as usize).min(self.count[d]).saturating_sub(first[d]).min(MOST);
            for (i, share) in shares[d][..count[d]].iter_mut().enumerate() {
                let cell = (first[d] + i) as f32;
                *share = high.min(cell + 1.0) - low.max(cell);
            }
        }
        for (k, z) in shares[2][..count[2]].iter().enumerate() {
            for (j, y) in shares[1][..count[1]].iter().enumerate() {
                let row = self.index([first[0], first[1] + j, first[2] + k]);
                for (i, x) in shares[0][..count[0]].iter().enumerate() {
                    self.values[row + i] += x * y * z;
                    at(row + i);
                }
            }
        }
    }

    /// One pass (1 2 1) along each axis. Beyond its ends the field goes on as it is there.
    pub(crate) fn smooth(&mut self) {
        let [nx, ny, _] = self.count;
        let mean = |a: f32, b: f32, c: f32| 0.25 * (a + c) + 0.5 * b;
        self.values.par_chunks_mut(nx).for_each(|row| {
            let mut before = row[0];
            for i in 0..nx {
                let here = row[i];
                row[i] = mean(before, here, row[(i + 1).min(nx - 1)]);
                before = here;
            }
        });
        // Along y within each layer, along z between layers, a whole row at a time.
        let along = |from: &[f32], stride: usize, rows: usize, to: &mut [f32]| {
            for j in 0..rows {
                let row = |j: usize| &from[j * stride..][..stride];
                let (above, here, below) = (row(j.saturating_sub(1)), row(j), row((j + 1).min(rows - 1)));
                let out = to[j * stride..][..stride].iter_mut();
                for (((out, a), b), c) in out.zip(above).zip(here).zip(below) {
                    *out = mean(*a, *b, *c);
                }
            }
        };
        let mut next = vec![0.0; self.values.len()];
        let layers = next.par_chunks_mut(nx * ny).zip(self.values.par_chunks(nx * ny));
        layers.for_each(|(to, from)| along(from, nx, ny, to));
        let layer = |k: usize| &next[k * nx * ny..][..nx * ny];
        let last = self.count[2] - 1;
        self.values.par_chunks_mut(nx * ny).enumerate().for_each(|(k, out)| {
            let (below, here, above) = (layer(k.saturating_sub(1)), layer(k), layer((k + 1).min(last)));
            for (((out, a), b), c) in out.iter_mut().zip(below).zip(here).zip(above) {
                *out = mean(*a, *b, *c);
            }
        });
    }
}

/// A field's values with a rim of nothing around them. Cells lie between nodes, eight to a cell.
pub(crate) struct Rimmed {
    values: Vec<f32>,
    /// Nodes along each axis.
    count: [usize; 3],
    /// From a cell's first node to its eight.
    offsets: [usize; 8],
    /// From a node to the next along each axis.
    steps: [usize; 3],
}

impl Rimmed {
    pub(crate) fn new(field: &Field) -> Self {
        let [nx, ny, _] = field.count;
        let count @ [px, py, pz] = field.count.map(|n| n + 2);
        let mut values = vec![0.0f32; px * py * pz];
        for (k, layer) in field.values.chunks(nx * ny).enumerate() {
            for (j, row) in layer.chunks(nx).enumerate() {
                values[((k + 1) * py + j + 1) * px + 1..][..nx].copy_from_slice(row);
            }
        }
        let steps = [1, px, px * py];
        let offset = |corner: usize| (0..3).map(|d| (corner >> d & 1) * steps[d]).sum::<usize>();
        Self { values, count, offsets: std::array::from_fn(offset), steps }
    }

    /// The values at the corners of the cell that begins at a node.
    pub(crate) fn around(&self, node: usize) -> [f32; 8] {
        std::array::from_fn(|c| self.values[node + self.offsets[c]])
    }
}

/// A corner of a net, in a cell that the surface passes through.
#[cfg_attr(
    not(feature = "pictures"),
    expect(dead_code, reason = "a mesh needs the place alone, pictures the rest too")
)]
pub(crate) struct Corner {
    /// The cell, counted from the rim.
    pub(crate) cell: [usize; 3],
    /// Its first node.
    pub(crate) node: usize,
    /// Place in the cell, from 0 to 1.
    pub(crate) within: Vec3,
    /// Place [m].
    pub(crate) at: Vec3,
}

/// A face of a net, across an edge between two nodes.
pub(crate) struct Face {
    /// Numbers of its corners, counterclockwise where the node outside is behind the one inside.
    pub(crate) corners: [u32; 4],
    /// Axis of the edge.
    pub(crate) axis: usize,
    /// The node that is inside, counted from the rim.
    pub(crate) inside: [usize; 3],
    /// The node that is outside.
    pub(crate) outside: [usize; 3],
}

/// The net where a field passes a level. Beyond the field there is nothing.
pub(crate) struct Net {
    field: Rimmed,
    level: f32,
    numbers: Vec<u32>,
}

impl Net {
    /// Its corners, which `number` counts.
    pub(crate) fn new(field: &Field, level: f32, mut number: impl FnMut(Corner) -> u32) -> Self {
        let (min, width) = (field.min, field.cell);
        let field = Rimmed::new(field);
        let [px, py, pz] = field.count;
        let mut numbers = vec![u32::MAX; field.values.len()];
        for k in 0..pz - 1 {
            for j in 0..py - 1 {
                let first = (k * py + j) * px;
                for i in 0..px - 1 {
                    let node = first + i;
                    let values = field.around(node);
                    let inside = values.iter().filter(|&&v| v > level).count();
                    if inside == 0 || inside == 8 {
                        continue;
                    }
                    let within = crossing(&values, level);
                    let at = min + (Vec3::new(i as f32, j as f32, k as f32) + within - 0.5) * width;
                    numbers[node] = number(Corner { cell: [i, j, k], node, within, at });
                }
            }
        }
        Self { field, level, numbers }
    }

    /// Its faces: one for each edge between two nodes that is passed, with corners in the four cells around the edge.
    pub(crate) fn faces(&self, mut face: impl FnMut(Face)) {
        let Rimmed { values, count: [px, py, pz], steps, .. } = &self.field;
        for k in 0..pz - 1 {
            for j in 0..py - 1 {
                let first = (k * py + j) * px;
                for i in 0..px - 1 {
                    let node = first + i;
                    let here = values[node] > self.level;
                    for axis in 0..3 {
                        if here == (values[node + steps[axis]] > self.level) {
                            continue;
                        }
                        let place = [i, j, k];
                        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                        if place[u] == 0 || place[v] == 0 {
                            continue;
                        }
                        let around = [node, node - steps[u], node - steps[u] - steps[v], node - steps[v]];
                        let mut next = place;
                        next[axis] += 1;
                        let (inside, outside) = if here { (place, next) } else { (next, place) };
                        face(Face { corners: around.map(|cell| self.numbers[cell]), axis, inside, outside });
                    }
                }
            }
        }
    }
}

/// Where in a cell the field passes a level.
fn crossing(values: &[f32; 8], level: f32) -> Vec3 {
    let mut sum = Vec3::ZERO;
    let mut count = 0.0;
    for d in 0..3 {
        let (u, v) = ((d + 1) % 3, (d + 2) % 3);
        for bits in 0..4 {
            let from = (bits & 1) << u | (bits >> 1) << v;
            let (a, b) = (values[from], values[from | 1 << d]);
            if (a > level) != (b > level) {
                let mut at = Vec3::ZERO;
                at[d] = (level - a) / (b - a);
                at[u] = (bits & 1) as f32;
                at[v] = (bits >> 1) as f32;
                sum += at;
                count += 1.0;
            }
        }
    }
    sum / count
}
