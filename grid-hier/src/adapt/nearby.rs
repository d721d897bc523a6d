//! What lies around particles: regions of levels, and the surface.

use super::{LevelStore, finest_cell};
use crate::block::{self, CELLS, SIDE, place};
use crate::bounds::Bounds;
use barchan_core::levels::CellBox;
use barchan_core::{ParticleList, Regions};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Part of a full cell below which a cell counts as empty: next to it is the surface.
const HALF: f64 = 0.5;

/// Cells along the side of a block with those next to it.
const WIDE: usize = SIDE as usize + 2;

/// The levels to which the cells of a block and those next to it belong.
pub(super) struct Nearby<'a> {
    regions: &'a Regions,
    margin: i32,
    /// Level of the block, and its first cell less 1: particles may have drifted out of it by a cell.
    level: usize,
    first: Option<[i32; 3]>,
    /// The level of all of them, if it is one.
    pub(super) all: Option<usize>,
    /// Levels of the cells that have been asked for.
    known: [u8; WIDE.pow(3)],
}

impl<'a> Nearby<'a> {
    const UNKNOWN: u8 = u8::MAX;

    pub(super) fn new(regions: &'a Regions, margin: i32, level: usize, block: Option<u64>) -> Self {
        let first = block.map(|key| block::of_key(key).map(|c| c * SIDE - 1));
        let all = first.and_then(|first| {
            let cells = CellBox { min: first.map(|c| c << level), max: first.map(|c| (c + SIDE + 2) << level) };
            regions.finest(cells, margin)
        });
        Self { regions, margin, level, first, all, known: [Self::UNKNOWN; WIDE.pow(3)] }
    }

    /// The level at an offset in a cell.
    pub(super) fn at(&mut self, (cell, offset): ([i32; 3], [f64; 3])) -> usize {
        if let Some(all) = self.all {
            return all;
        }
        let local = self.first.map(|first| std::array::from_fn::<i32, 3, _>(|d| cell[d] - first[d]));
        let Some(local) = local.filter(|local| local.iter().all(|c| (0..WIDE as i32).contains(c))) else {
            return self.regions.finest_at(finest_cell(cell, offset, self.level), self.margin);
        };
        let known = &mut self.known[((local[0] * WIDE as i32 + local[1]) * WIDE as i32 + local[2]) as usize];
        if *known == Self::UNKNOWN {
            let cells = CellBox { min: cell.map(|c| c << self.level), max: cell.map(|c| (c + 1) << self.level) };
            match self.regions.finest(cells, self.margin) {
                Some(level) => *known = level as u8,
                None => return self.regions.finest_at(finest_cell(cell, offset, self.level), self.margin),
            }
        }
        usize::from(*known)
    }
}

/// Cells of a level next to one that is less than half full, by block: keys, rising, and cells as bits.
pub(super) struct Surface {
    blocks: Vec<u64>,
    cells: Vec<u64>,
}

impl Surface {
    /// In the blocks of these cells, `h` wide [m], of a level with so many lists.
    pub(super) fn new<S: LevelStore>(
        level: &S,
        lists: usize,
        cells: impl Iterator<Item = [i32; 3]>,
        h: f64,
        bounds: &Bounds,
    ) -> Self {
        let mut blocks: Vec<u64> = cells.filter_map(|cell| block::key(block::of_cell(cell))).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let around = |&key: &u64| {
            let at = block::of_key(key);
            (0..27).filter_map(move |n| {
                let offset = block::offset(n);
                block::key(bounds.wrap(std::array::from_fn(|d| at[d] + offset[d])))
            })
        };
        let mut near: Vec<u64> = blocks.iter().flat_map(around).collect();
        near.sort_unstable();
        near.dedup();
        let filled = level.filled(lists, &near, h.powi(3));
        let cells = blocks.par_iter().map(|&key| near_empty(&near, &filled, block::of_key(key), bounds)).collect();
        Self { blocks, cells }
    }

    /// Is any cell around this one less than half full?
    pub(super) fn is_near(&self, cell: [i32; 3]) -> bool {
        let block = block::key(block::of_cell(cell)).and_then(|key| self.blocks.binary_search(&key).ok());
        block.is_none_or(|b| self.cells[b] >> place(cell) & 1 == 1)
    }
}

/// The cells of some blocks, of a volume [m³] each, that are at least half full, as bits; keys rise.
pub(super) fn filled<S: LevelStore>(level: &S, lists: usize, blocks: &[u64], volume: f64) -> Vec<u64> {
    // Most particles are in their block; the others are added afterwards, in order.
    let fill = |group: usize| {
        let home = level.blocks().get(group).copied();
        let (mut cells, mut strays) = ([0f32; CELLS], Vec::new());
        for list in 0..lists {
            for at in level.places(list, group) {
                let cell = level.cell(list, at);
                let part = (level.volume0(list, at) / volume) as f32;
                match block::key(block::of_cell(cell)) {
                    key if key.is_some() && key == home => cells[place(cell)] += part,
                    Some(key) => strays.push((key, place(cell), part)),
                    None => {}
                }
            }
        }
        (home, cells, strays)
    };
    let is_wanted = |&group: &usize| level.blocks().get(group).is_none_or(|key| blocks.binary_search(key).is_ok());
    let wanted: Vec<usize> = (0..level.groups()).filter(is_wanted).collect();
    let own: Vec<_> = wanted.into_par_iter().map(fill).collect();
    let mut parts = vec![[0f32; CELLS]; blocks.len()];
    for (home, cells, _) in &own {
        if let Some(b) = home.and_then(|key| blocks.binary_search(&key).ok()) {
            parts[b] = *cells;
        }
    }
    for (key, cell, part) in own.into_iter().flat_map(|(.., strays)| strays) {
        if let Ok(b) = blocks.binary_search(&key) {
            parts[b][cell] += part;
        }
    }
    let is_full = |part: f32| u64::from(f64::from(part) >= HALF);
    parts.iter().map(|parts| parts.iter().rev().fold(0, |bits, part| bits << 1 | is_full(*part))).collect()
}

/// Blocks of cells `h` wide [m], their keys rising, and their cells that are at least half full of particles' cubes, as bits.
pub(super) fn filled_by_cubes(lists: &[ParticleList], h: f64) -> Vec<(u64, u64)> {
    let mut parts: BTreeMap<[i32; 3], f64> = BTreeMap::new();
    for list in lists {
        for i in 0..list.len() {
            // A cube wider than a cell goes to all that it covers.
            let (x, side) = (list.position(i), list.volume0[i].cbrt());
            let pieces = (side / h).round().max(1.0);
            let along = |n: i32, d: usize| ((x[d] + side * ((f64::from(n) + 0.5) / pieces - 0.5)) / h).floor() as i32;
            let all = 0..pieces as i32;
            for (a, b) in all.clone().flat_map(|a| all.clone().map(move |b| (a, b))) {
                for c in all.clone() {
                    *parts.entry([along(a, 0), along(b, 1), along(c, 2)]).or_default() +=
                        list.volume0[i] / pieces.powi(3);
                }
            }
        }
    }
    let mut blocks: BTreeMap<u64, u64> = BTreeMap::new();
    for (cell, _) in parts.into_iter().filter(|(_, part)| *part >= HALF * h.powi(3)) {
        if let Some(key) = block::key(block::of_cell(cell)) {
            *blocks.entry(key).or_default() |= 1 << place(cell);
        }
    }
    blocks.into_iter().collect()
}

/// The cells of a block that have one around them that is less than half full, as bits. `filled` are the cells of blocks that are not.
fn near_empty(blocks: &[u64], filled: &[u64], at: [i32; 3], bounds: &Bounds) -> u64 {
    let is_empty = |n: usize| {
        let local = [n / WIDE / WIDE, n / WIDE % WIDE, n % WIDE];
        let cell: [i32; 3] = std::array::from_fn(|d| {
            let c = at[d] * SIDE + local[d] as i32 - 1;
            // Behind a wall the ground goes on.
            let c = if bounds.walled[d][0] { c.max(bounds.min[d]) } else { c };
            if bounds.walled[d][1] { c.min(bounds.max[d] - 1) } else { c }
        });
        let block = block::key(bounds.wrap(block::of_cell(cell))).and_then(|key| blocks.binary_search(&key).ok());
        block.is_none_or(|b| filled[b] >> place(cell) & 1 == 0)
    };
    let empty: [bool; WIDE.pow(3)] = std::array::from_fn(is_empty);
    let is_near = |n: &usize| {
        let corner = [n / 16, n / 4 % 4, n % 4];
        let around = |k: usize| [corner[0] + k / 9, corner[1] + k / 3 % 3, corner[2] + k % 3];
        (0..27).map(around).any(|[x, y, z]| empty[(x * WIDE + y) * WIDE + z])
    };
    (0..CELLS).filter(is_near).fold(0, |bits, n| bits | 1 << n)
}
