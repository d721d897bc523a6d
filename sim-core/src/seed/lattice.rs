//! Lattices that particles are seeded on, and how far they are moved from their points.

use crate::plan::Precision;
use crate::scene::WHOLE_CELL;

/// Particles that fixed-point offsets can tell from a cell's face, in cells: half of the last place.
const SNAP: f64 = 1.0 / (1_u64 << 33) as f64;
/// Last place of a fixed-point offset: one cell is this many.
const FIXED: f64 = (1_u64 << 32) as f64;

/// Lattice points along one axis.
#[derive(Clone)]
pub(super) struct Axis {
    pub(super) extent: f64,
    pub(super) count: u64,
    /// The cell that coordinates are relative to, and its width [m].
    base: i32,
    pub(super) width: f64,
    /// First point and distance, in cells from `base`.
    first: f64,
    pub(super) step: f64,
    /// Steps from the first point to the face of what is filled, half a step at most.
    pub(super) room: f64,
}

impl Axis {
    pub(super) fn new(min: f64, max: f64, spacing: f64, width: f64, from_bottom: bool) -> Self {
        let extent = max - min;
        let sides = extent / spacing;
        let count = if from_bottom { (sides - WHOLE_CELL).ceil() } else { sides.round() };
        let whole = (sides - count).abs() <= WHOLE_CELL * count;
        let gap = if whole || from_bottom { 0.0 } else { 0.5 * (sides - count) };
        let corner = min / width;
        let on_face = (corner - corner.round()).abs() <= WHOLE_CELL;
        let base = if on_face { corner.round() } else { corner.floor() };
        let step = spacing / width;
        let first = if on_face { 0.0 } else { corner - base } + (gap + 0.5) * step;
        let room = 0.5 + gap.min(0.0);
        Self { extent, count: count.max(0.0) as u64, base: base as i32, width, first, step, room }
    }
    /// How many steps from the first point `x` [m] lies.
    fn steps_to(&self, x: f64) -> f64 {
        (x / self.width - f64::from(self.base) - self.first) / self.step
    }
    /// Number of the point nearest to `x` [m]; none if it is further off than points are from one another, by half.
    pub(super) fn nearest(&self, x: f64) -> Option<u64> {
        let steps = self.steps_to(x).round();
        (steps >= 0.0 && steps < self.count as f64).then_some(steps as u64)
    }
    /// Number of the first point that lies at `x` [m] or beyond.
    pub(super) fn first_from(&self, x: f64) -> u64 {
        self.steps_to(x).ceil().clamp(0.0, self.count as f64) as u64
    }
    /// The point `number` steps from the first.
    pub(super) fn site(&self, number: f64) -> Site {
        let along = self.first + number * self.step;
        let cell = if (along - along.round()).abs() <= SNAP { along.round() } else { along.floor() };
        let offset = (along - cell).max(0.0);
        let cell = self.base + cell as i32;
        Site { cell, offset, position: (f64::from(cell) + offset) * self.width }
    }
    pub(super) fn sites(&self) -> Vec<Site> {
        (0..self.count).map(|i| self.site(i as f64)).collect()
    }
}

/// One coordinate of a particle.
#[derive(Clone, Copy)]
pub(super) struct Site {
    pub(super) cell: i32,
    pub(super) offset: f64,
    pub(super) position: f64,
}

impl Site {
    /// Cell and offset on a level, as the run's number format holds them.
    pub(super) fn on_level(self, level: usize, precision: Precision) -> (i32, f64) {
        let within = f64::from(self.cell & ((1 << level) - 1)) + self.offset;
        let offset = within / f64::from(1 << level);
        Self { cell: self.cell >> level, offset, position: self.position }.fixed(precision)
    }
    /// Cell and offset as the run's number format holds them. A point on a face belongs to the upper cell.
    pub(super) fn fixed(self, precision: Precision) -> (i32, f64) {
        if precision == Precision::F64 {
            return (self.cell, self.offset);
        }
        let counts = (self.offset * FIXED).round();
        if counts >= FIXED { (self.cell + 1, 0.0) } else { (self.cell, counts / FIXED) }
    }
}

/// Cell and offset of a coordinate `x` [m] on a level, in cells of `h` on the finest one, as a number format holds them.
pub(crate) fn on_level(x: f64, h: f64, level: usize, precision: Precision) -> (i32, f64) {
    let along = x / h;
    let cell = along.floor();
    Site { cell: cell as i32, offset: along - cell, position: x }.on_level(level, precision)
}

/// By how much of the spacing a point of a lattice of so many is moved, along x and along y where it is to be.
///
/// Rows along one of the axes are moved at random, each in itself, and layers along the other one. A node's mass stays what it is: its spline summed over a row of points half a
/// cell apart does not depend on where the row begins, nor does the sum over a layer's rows. Rows and layers go in pairs, one of which is moved as far as the other is moved
/// back: a box keeps its centre of mass.
pub(super) fn stagger(
    (seed, body): (u64, u64),
    along: [bool; 2],
    in_slice: bool,
    at: [u64; 3],
    counts: [u64; 3],
) -> [f64; 2] {
    let paired = |place: u64, count: u64, number: &dyn Fn(u64) -> u64, axis: u64| {
        // Of an odd number the first one stays.
        place.checked_sub(count % 2).map_or(0.0, |place| {
            let by = uniform(seed, body, number(place / 2), axis) - 0.5;
            if place.is_multiple_of(2) { by } else { -by }
        })
    };
    let of_layer = |axis: u64| paired(at[2], counts[2], &|pair| pair, axis);
    // In plane strain nothing varies along y: rows of a layer are moved alike.
    let of_row = |across: usize| {
        if in_slice {
            return of_layer(0);
        }
        paired(at[across], counts[across], &|pair| at[2] * counts[across] + pair, 0)
    };
    match along {
        [true, true] => [of_row(1), of_layer(1)],
        [true, false] => [of_row(1), 0.0],
        [false, true] => [0.0, of_row(0)],
        [false, false] => [0.0; 2],
    }
}

/// A number in [0, 1) that depends on its arguments alone: SplitMix64 over their mix.
pub(crate) fn uniform(seed: u64, body: u64, number: u64, axis: u64) -> f64 {
    let mix = |x: u64| {
        let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    };
    let stream = mix(seed.wrapping_add(0x9e37_79b9_7f4a_7c15)) ^ mix(body.wrapping_add(0x632b_e59b_d9b4_e019));
    let bits =
        mix(stream.wrapping_add(number.wrapping_mul(3).wrapping_add(axis + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}
