//! Numerical fracture, made visible: particles that hang on nothing.

use crate::grid::KeyHasher;
use crate::store::List;
use barchan_core::Regions;
use barchan_core::levels::{CellBox, SPLIT_AHEAD};
use barchan_grid::bounds::Bounds;
use barchan_grid::transfer::Scalar;
use std::collections::HashMap;
use std::hash::BuildHasherDefault;

/// Stencils are three nodes wide: two particles share a node if their cells lie at most so far apart along every axis.
const REACH: i32 = 2;

/// Number of particles with an isolated stencil: along some axis, all that share a node with the particle lie in its own layer of
/// cells, so that nothing holds it to what is before and behind. So it is with a single grain, with a sheet one cell thin, and
/// with each slice of a bar whose slices are three cells apart. The mirror image at a wall and what lies across a periodic side
/// hold a particle like any other. Near a rim, what holds a particle may be on another level: none is counted there.
///
/// Half as long again as the rest of the ledger (about 30 ns a particle): for when the ledger is read, not for every step.
pub(crate) fn count<T: Scalar>(lists: &[List<T>], bounds: &Bounds, regions: &Regions, level: usize) -> u64 {
    let mut particles: HashMap<[i32; 3], u64, BuildHasherDefault<KeyHasher>> = HashMap::default();
    for list in lists {
        for (chunk, lane) in list.places() {
            *particles.entry(wrapped(list.cell_of(chunk, lane), bounds)).or_default() += 1;
        }
    }
    let held = |cell: [i32; 3], axis: usize| {
        let to_wall = [cell[axis] - bounds.min[axis], bounds.max[axis] - 1 - cell[axis]];
        let image_near = (0..2).any(|end| bounds.walled[axis][end] && 2 * to_wall[end] < REACH);
        let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
        let layer_near = |away: i32| {
            (-REACH..=REACH).any(|i| {
                (-REACH..=REACH).any(|j| {
                    let mut near = cell;
                    near[axis] += away;
                    near[a] += i;
                    near[b] += j;
                    particles.contains_key(&wrapped(near, bounds))
                })
            })
        };
        image_near || (1..=REACH).any(|away| layer_near(away) || layer_near(-away))
    };
    // Particles may have drifted by a cell since they were put on their level.
    let alone_here = |cell: [i32; 3]| {
        let around = |by: i32| cell.map(|c| (c + by) << level);
        let cells = CellBox { min: around(-REACH - 1), max: around(REACH + 2) };
        regions.finest(cells, SPLIT_AHEAD) == Some(level)
    };
    let isolated = |cell: [i32; 3]| (0..3).any(|axis| !held(cell, axis)) && alone_here(cell);
    particles.iter().filter(|&(&cell, _)| isolated(cell)).map(|(_, n)| n).sum()
}

/// A cell brought into the world along periodic axes.
fn wrapped(mut cell: [i32; 3], bounds: &Bounds) -> [i32; 3] {
    for d in (0..3).filter(|&d| bounds.periodic[d]) {
        cell[d] = bounds.min[d] + (cell[d] - bounds.min[d]).rem_euclid(bounds.max[d] - bounds.min[d]);
    }
    cell
}
