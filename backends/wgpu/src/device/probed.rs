//! Where probes look, and what they find, as words of the device.

use crate::device::layout;
use barchan_core::nearest::bin_width;
use barchan_core::probe::{Apart, Closest, Crossed, Crossing, Filter, Sought, Sums};
use barchan_core::scene::{Region, Section};
use barchan_core::{Plan, Vec3};
use barchan_grid::bounds::Bounds;
use barchan_grid::wall::WallParts;
use std::ops::Range;

/// Words of a place at which probes look, of what has crossed a section, and of what a region is asked with; see `probed.wgsl`, `flux.wgsl`, `sums.wgsl`.
pub(crate) const PLACE: usize = 16;
pub(crate) const CROSSED: usize = 48;
pub(crate) const HEAD: usize = 16;
/// Numbers that are summed over a region.
pub(crate) const SUMMED: usize = 13;
/// Words of a particle that is sampled; see `sample.wgsl`.
pub(crate) const SAMPLED: usize = 12;

/// Words of a point of which the height is asked for; see `heights.wgsl`.
pub(crate) const POINT: usize = 8;
/// Words of a point of which the nearest particle is asked for; see `apart.wgsl` and `nearest.wgsl`.
pub(crate) const NEAREST: usize = 12;
/// What stands there if the device has not found it.
const UNKNOWN: u32 = u32::MAX;

/// Kinds of places; the third is an upright cylinder.
const SQUARE: u32 = 0;
const ROUND: u32 = 1;
const UPRIGHT: u32 = 2;
const NOWHERE: u32 = 3;
/// No material, or body, is left out.
const ANY: u32 = u32::MAX;

/// Which material, body and level count; a material that no body uses has a number that none has.
fn only(filter: Filter) -> [u32; 3] {
    let material = filter.material.map_or(ANY, |material| material.min(ANY - 1));
    [material, filter.body.map_or(ANY, u32::from), filter.level.unwrap_or(ANY)]
}

/// Exact sums, in units of 2^-80: particles, mass, rest volume and momentum that have crossed a section along its normal, then against it.
pub(crate) type Exact = [[i128; 6]; 2];

/// A place in cells `h` wide [m] of a level, in which so many cells lie from its middle to its ends.
fn place(middle: Vec3, half: Vec3, kind: u32, filter: Filter, normal: Vec3, (level, h): (u32, f64)) -> [u32; PLACE] {
    let cells = middle.map(|x| x / h);
    let first = cells.map(f64::floor);
    let offset = [0, 1, 2].map(|d| ((cells[d] - first[d]) as f32).to_bits());
    let bits = |v: Vec3| v.map(|x| (x as f32).to_bits());
    let kind = if filter.level.is_none_or(|own| own == level) { kind } else { NOWHERE };
    let (half, normal) = (bits(half.map(|x| x / h)), bits(normal));
    let cell = first.map(|x| x as i32 as u32);
    let [material, body, _] = only(filter);
    let [a, b, c] = [cell, offset, half];
    [a[0], a[1], a[2], kind, b[0], b[1], b[2], material, c[0], c[1], c[2], body, normal[0], normal[1], normal[2], 0]
}

/// The sections of a plan as a level has them.
pub(crate) fn sections(plan: &Plan, level: usize) -> Vec<u32> {
    let of_level = (level as u32, plan.cell_widths[level]);
    let words = |crossing: Crossing| {
        let (_, normal) = crossing.section.plane();
        match crossing.section {
            Section::Rectangle { min, max } => {
                let middle = std::array::from_fn(|d| 0.5 * (min[d] + max[d]));
                // Along the normal nothing is outside.
                let half =
                    [0, 1, 2].map(|d| if min[d] == max[d] { f64::from(f32::MAX) } else { 0.5 * (max[d] - min[d]) });
                place(middle, half, SQUARE, crossing.filter, normal, of_level)
            }
            Section::Disc { center, radius, .. } => {
                place(center, [radius; 3], ROUND, crossing.filter, normal, of_level)
            }
        }
    };
    Crossing::all(plan).into_iter().flat_map(words).collect()
}

/// The parts of walls of a plan as a level has them; see `wall_parts.wgsl`.
pub(crate) fn wall_parts(plan: &Plan, level: usize) -> Vec<u32> {
    let parts = WallParts::new(plan, level, &Bounds::new(plan, level));
    let words = parts.each().flat_map(|((axis, end), [first, past])| {
        let cell = |cell: [i32; 3]| cell.map(|x| x as u32);
        let mut words = [0; PLACE];
        words[..3].copy_from_slice(&cell(first));
        words[3] = (2 * axis + end) as u32;
        words[4..7].copy_from_slice(&cell(past));
        words
    });
    words.collect()
}

/// What a part of a wall has taken, as of a section's momentum along its normal [N s].
pub(crate) fn pressed_of(exact: &Exact) -> Vec3 {
    let [along, _] = exact;
    [3, 4, 5].map(|k| along[k] as f64 / ONE)
}

/// And back.
pub(crate) fn pressed(impulse: &Vec3) -> Exact {
    let mut exact = Exact::default();
    impulse.iter().zip(&mut exact[0][3..]).for_each(|(x, sum)| *sum = (x * ONE) as i128);
    exact
}

/// Regions as a level has them, `count` of them: where nothing is sought, nothing is found.
pub(crate) fn regions(sought: &[Sought], count: usize, level: usize, h: f64) -> Vec<u32> {
    let words = |one: &Sought| {
        let (middle, half) = one.region.middle();
        let kind = match one.region {
            Region::Box { .. } => SQUARE,
            Region::Sphere { .. } => ROUND,
            Region::Cylinder { .. } => UPRIGHT,
        };
        place(middle, half, kind, one.filter, [0.0; 3], (level as u32, h))
    };
    let mut words: Vec<u32> = sought.iter().flat_map(words).collect();
    let nothing = place([0.0; 3], [0.0; 3], NOWHERE, Filter::default(), [0.0; 3], (level as u32, h));
    words.extend(std::iter::repeat_n(nothing, count - sought.len()).flatten());
    words
}

/// What four words of the device are: an exact sum.
fn exact(digits: &[u32]) -> i128 {
    digits.iter().rev().fold(0, |sum, digit| sum << 32 | i128::from(*digit))
}

/// One in these units.
const ONE: f64 = (1_u128 << 80) as f64;

/// The two sums of a section.
pub(crate) fn crossed_of(words: &[u32]) -> Exact {
    let sum = |way: usize| std::array::from_fn(|k| exact(&words[24 * way + 4 * k..][..4]));
    [sum(0), sum(1)]
}

/// As others know them. What f64 does not hold of a sum is kept beside it, so that whoever goes on has the same bits.
pub(crate) fn crossed(exact: &Exact) -> Crossed {
    let mut crossed = Crossed::default();
    for (way, sums) in exact.iter().enumerate() {
        let number = |k: usize| sums[k] as f64 / ONE;
        crossed.count[way] = number(0) as u64;
        (crossed.mass[way], crossed.volume0[way]) = (number(1), number(2));
        crossed.momentum[way] = [number(3), number(4), number(5)];
        crossed.rest[way] = [1, 2, 3, 4, 5].map(|k| (sums[k] - (number(k) * ONE) as i128) as f64 / ONE);
    }
    crossed
}

/// And back.
pub(crate) fn exactly(crossed: &Crossed) -> Exact {
    let of_way = |way: usize| {
        let [x, y, z] = crossed.momentum[way];
        let numbers = [crossed.mass[way], crossed.volume0[way], x, y, z];
        let mut sums = [0; 6];
        sums[0] = i128::from(crossed.count[way]) << 80;
        for (k, number) in numbers.into_iter().enumerate() {
            sums[1 + k] = (number * ONE) as i128 + (crossed.rest[way][k] * ONE) as i128;
        }
        sums
    };
    [of_way(0), of_way(1)]
}

/// The sums over a region.
pub(crate) fn sums_of(words: &[u32]) -> Sums {
    let number = |k: usize| exact(&words[4 * k..][..4]) as f64 / ONE;
    Sums {
        count: number(0) as u64,
        mass: number(1),
        volume0: number(2),
        volume: number(3),
        momentum: [number(4), number(5), number(6)],
        stress: std::array::from_fn(|c| number(7 + c)),
    }
}

/// A point whose height is asked for, counted from a bottom [m] on; finest cells are `h` wide [m].
pub(crate) fn point([x, y]: [f64; 2], bottom: f64, h: f64, blocks: Range<usize>) -> [u32; POINT] {
    let cells = [x, y, bottom].map(|x| x / h);
    let first = cells.map(f64::floor);
    let [x, y, z] = first.map(|x| x as i32 as u32);
    let offset = [0, 1].map(|d| ((cells[d] - first[d]) as f32).to_bits());
    [x, y, z, offset[0], offset[1], blocks.start as u32, blocks.end as u32, 0]
}

/// The heights that the device has found [m], none where there is no ground; `None` if it has not found all.
pub(crate) fn heights_of(words: &[u32], bottom: f64, h: f64) -> Option<Vec<Option<f64>>> {
    let from = (bottom / h).floor();
    let height = |point: &[u32]| match point[0] {
        UNKNOWN => None,
        0 => Some(None),
        bits => Some(Some((from + f64::from(f32::from_bits(bits))) * h)),
    };
    words.chunks_exact(POINT).map(height).collect()
}

/// Points in bins, as `apart.wgsl` has them.
pub(crate) struct Cloud {
    /// All of it, with room for what is found.
    pub(crate) words: Vec<u32>,
    /// The number of each point, in the order in which they stand there.
    pub(crate) order: Vec<usize>,
    /// Where the sums stand.
    pub(crate) sums: usize,
}

/// A cloud of points in finest cells, which are `h` wide [m], and which particles count.
pub(crate) fn cloud(points: &[Vec3], filter: Filter, h: f64, blocks: Range<usize>) -> Cloud {
    let cells: Vec<[i32; 3]> = points.iter().map(|x| x.map(|x| (x / h).floor() as i32)).collect();
    let end = |d: usize, best: fn(i32, i32) -> i32| cells.iter().map(|cell| cell[d]).reduce(best).unwrap_or_default();
    let first: [i32; 3] = std::array::from_fn(|d| end(d, i32::min));
    let extent: [i32; 3] = std::array::from_fn(|d| end(d, i32::max) - first[d] + 1);
    let width = bin_width(points.len(), extent.map(f64::from)).ceil() as i32;
    let count = extent.map(|cells| (cells - 1) / width + 1);
    let bin = |i: &usize| {
        let [x, y, z]: [i32; 3] = std::array::from_fn(|d| (cells[*i][d] - first[d]) / width);
        ((z * count[1] + y) * count[0] + x) as usize
    };
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by_key(bin);
    let starts = HEAD + NEAREST * points.len();
    let bins = count.iter().map(|count| *count as usize).product::<usize>();
    let sums = starts + bins + 1;
    let [material, body, level] = only(filter);
    let mut words = vec![blocks.start as u32, blocks.end as u32, material, body, level];
    words.extend(count.into_iter().chain(first).chain([width]).map(|x| x as u32));
    words.extend([points.len() as u32, starts as u32, sums as u32, 0]);
    for &i in &order {
        let offset: [f32; 3] = std::array::from_fn(|d| (points[i][d] / h - f64::from(cells[i][d])) as f32);
        words.extend(cells[i].map(|x| x as u32).into_iter().chain(offset.map(f32::to_bits)));
        words.resize(words.len() + NEAREST - 6, 0);
    }
    words.extend((0..=bins).map(|bin_number| order.partition_point(|i| bin(i) < bin_number) as u32));
    words.resize(sums + 8, 0);
    Cloud { words, order, sums }
}

impl Cloud {
    /// What the device has found, of levels whose cells are so wide [m].
    pub(crate) fn apart(&self, words: &[u32], widths: &[f64]) -> Apart {
        let mut apart = Apart { nearest: vec![None; self.order.len()], ..Apart::default() };
        let [count, distance] = [0, 4].map(|k| exact(&words[self.sums + k..][..4]) as f64 / ONE);
        (apart.count, apart.distance) = (count as u64, distance * widths[0]);
        for (words, &i) in words[HEAD..].chunks_exact(NEAREST).zip(&self.order) {
            let (place, block) = ([0, 1, 2, 3].map(|k| words[k]), [4, 5, 6].map(|k| words[k] as i32));
            let position = || layout::position(place, block, widths[words[7] as usize]);
            apart.nearest[i] = (words[9] > 0).then(|| Closest { id: u64::from(words[8]), position: position() });
        }
        apart
    }
}
