//! Ground at rest sleeps: a block whose particles, and those of all blocks around it, have been slow for [`RESTED`] steps is left
//! out of every pass. Its mass and stress go on to act through its tile, which is kept; so its neighbours feel what they would feel.
//! It wakes in the step after a particle of a neighbouring block has been faster than slow, or once a tool comes near. Blocks awake
//! thus lie at least four cells deep between what moves and what sleeps: what sleeps has never felt more than slow motion.
//!
//! Blocks at the rim of a level, and those that share nodes with a finer one, stay awake.

use crate::grid::Grid;
use crate::level::{FillTile, Level};
use crate::store::List;
use barchan_core::Coupling;
use barchan_core::account::kinetic;
use barchan_grid::block::{self, NONE, TILE};
use barchan_grid::particles::MASS;
use barchan_grid::rest::{self, ASLEEP, RESTED, near_tool};
use barchan_grid::transfer::{Scalar, Step};
use barchan_lanes::Isa;
use rayon::prelude::*;

/// Steps that differ by less than this part of them are one step to tiles: those that land evenly on a stop differ in their last
/// digits.
const SAME_STEP: f64 = 1e-9;

/// Who is awake on one level.
pub(crate) struct Watch {
    /// Speed along an axis up to which a particle is slow [m/s]; 0: nothing ever sleeps.
    slow: f64,
    /// Gravity in the step under way, times the steps in which it makes fast what falls [m/s²]; 0: speed alone says who is slow. And whether gravity grows.
    pub(crate) fall: f64,
    pub(crate) gravity_grows: bool,
    /// Blocks awake, rising.
    pub(crate) awake: Vec<u32>,
    /// Blocks that have fallen asleep and whose tiles still are of when they were awake.
    pub(crate) stale: Vec<u32>,
    /// Node blocks that anyone awake touches, or that other levels do, rising.
    pub(crate) nodes: Vec<u32>,
    /// Blocks asleep with nodes that anyone awake touches, rising.
    border: Vec<u32>,
    /// Mass of the blocks asleep [kg].
    pub(crate) mass: f64,
    /// Step and gravity that the tiles of those asleep are for [s, m/s²].
    pub(crate) tiles_for: Option<(f64, [f64; 3])>,
    /// Are the tiles of all asleep but the stale ones filled?
    filled: bool,
}

/// What falling asleep took, and what those asleep took from others.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SleepSums {
    /// Blocks that fell asleep.
    pub(crate) blocks: u64,
    /// Kinetic energy [J].
    pub(crate) kinetic: f64,
    /// Momentum [kg m/s].
    pub(crate) momentum: [f64; 3],
}

impl Watch {
    pub(crate) fn new(slow: f64) -> Self {
        Self {
            slow,
            fall: 0.0,
            gravity_grows: false,
            awake: Vec::new(),
            stale: Vec::new(),
            nodes: Vec::new(),
            border: Vec::new(),
            mass: 0.0,
            tiles_for: None,
            filled: false,
        }
    }

    /// Nobody is known yet.
    pub(crate) fn forget(&mut self) {
        *self = Self::new(self.slow);
    }

    /// The count of a block whose particles have moved at up to this speed [m/s] in a step of `dt` [s].
    pub(crate) fn count(&self, rest: u16, speed: f64, dt: f64) -> u16 {
        rest::count(rest, speed, rest::slow_in(self.slow, self.fall * dt), self.gravity_grows)
    }
}

impl<T: Scalar> Level<T> {
    /// Decides who sleeps in the next step: wakes those next to what moves or near a tool, and lets those sleep around whom all has
    /// been slow for long. Returns whether anything can sleep here at all.
    pub(crate) fn keep_watch(&mut self, couplings: &[Box<dyn Coupling>], slept: &mut SleepSums) -> bool {
        if self.watch.slow == 0.0 {
            return false;
        }
        let woken = self.wake(couplings);
        if self.put_to_sleep(slept) || woken {
            self.list_watch(false);
        }
        true
    }

    /// Particles asleep.
    pub(crate) fn asleep(&self) -> u64 {
        let asleep = |list: &List<T>| -> usize {
            let runs = list.runs.iter().zip(&self.store.rest);
            runs.filter(|(_, rest)| **rest == ASLEEP).map(|(run, _)| run.count).sum()
        };
        self.store.lists.iter().map(asleep).sum::<usize>() as u64
    }

    /// Blocks asleep whose tiles have to be filled for a step, and the step that they are filled for.
    pub(crate) fn stale_tiles(&mut self, step: &Step) -> (Vec<u32>, Step) {
        let frozen = Step { strain_dt: 0.0, strain_parts: 1, frozen: true, ..*step };
        let is_same =
            |&(dt, gravity): &(f64, [f64; 3])| (dt - step.dt).abs() <= SAME_STEP * step.dt && gravity == step.gravity;
        let (filled, tiles_for) = match self.watch.tiles_for.filter(is_same) {
            Some(old) => (self.watch.filled, old),
            None => (false, (step.dt, step.gravity)),
        };
        let asleep = |b: &u32| self.store.rest[*b as usize] == ASLEEP;
        let stale: Vec<u32> = if filled {
            self.watch.stale.drain(..).filter(asleep).collect()
        } else {
            self.watch.stale.clear();
            (0..self.grid.occupied.len() as u32).filter(asleep).collect()
        };
        (self.watch.tiles_for, self.watch.filled) = (Some(tiles_for), true);
        (stale, Step { dt: tiles_for.0, ..frozen })
    }

    /// Wakes blocks next to one that moves, and those near a tool. Returns whether any slept.
    fn wake(&mut self, couplings: &[Box<dyn Coupling>]) -> bool {
        let (rest, grid) = (&mut self.store.rest, &self.grid);
        let mut woken = false;
        let mut stir = |rest: &mut Vec<u16>, b: u32| {
            woken |= rest[b as usize] == ASLEEP;
            rest[b as usize] = rest[b as usize].min(1);
        };
        for &b in &self.watch.awake {
            if rest[b as usize] == 0 {
                grid.neighbours(b as usize).for_each(|b| stir(rest, b));
            }
        }
        let h = self.store.cell_width;
        for tool in couplings.iter().flat_map(|coupling| coupling.bounds()).filter(|one| !one.is_nothing()) {
            let [first, last] = near_tool(&tool, h);
            for by in self.bounds.images(first, last) {
                let moved = |block: [i32; 3]| std::array::from_fn(|d| block[d] - by[d]);
                grid.within(moved(first), moved(last)).for_each(|b| stir(rest, b));
            }
        }
        woken
    }

    /// Puts blocks to sleep that have been slow for long, as all around them. Returns whether there were any.
    fn put_to_sleep(&mut self, slept: &mut SleepSums) -> bool {
        let (rest, grid) = (&self.store.rest, &self.grid);
        let has_rested = |b: u32| rest[b as usize] >= RESTED;
        let may_sleep = |b: &u32| has_rested(*b) && grid.neighbours(*b as usize).all(has_rested) && !grid.is_tied(*b);
        let tired: Vec<u32> = self.watch.awake.iter().copied().filter(may_sleep).collect();
        for &b in &tired {
            self.store.rest[b as usize] = ASLEEP;
            slept.blocks += 1;
            for list in &mut self.store.lists {
                let run = list.runs[b as usize];
                for (chunk, lane) in run.places() {
                    let (m, motion) = (list.mass_of(chunk, lane), list.motion_of(chunk, lane));
                    slept.kinetic += kinetic(m, &motion[..3], &motion[3..], self.store.cell_width);
                    for d in 0..3 {
                        slept.momentum[d] += m * motion[d];
                    }
                }
                list.stop(run);
            }
        }
        self.watch.stale.extend(&tired);
        !tired.is_empty()
    }

    /// Lists who is awake, after particles have been sorted too, and blocks perhaps `renumbered`.
    pub(crate) fn list_watch(&mut self, renumbered: bool) {
        let (watch, rest, grid) = (&mut self.watch, &self.store.rest, &self.grid);
        if renumbered {
            watch.filled = false;
        }
        watch.awake = (0..grid.occupied.len() as u32).filter(|&b| rest[b as usize] != ASLEEP).collect();
        let mut touched: Vec<bool> = (0..grid.keys.len()).map(|g| grid.is_shared(g)).collect();
        for &b in &watch.awake {
            for g in grid.nodes_around[b as usize].into_iter().filter(|&g| g != NONE) {
                touched[g as usize] = true;
            }
        }
        watch.nodes = (0..grid.keys.len() as u32).filter(|&g| touched[g as usize]).collect();
        (watch.mass, watch.border) = (0.0, Vec::new());
        if watch.awake.len() == grid.occupied.len() {
            return;
        }
        for list in &self.store.lists {
            for (run, _) in list.runs.iter().zip(rest).filter(|(_, rest)| **rest == ASLEEP) {
                // Padding weighs nothing.
                let chunks = run.first..run.first + run.chunks();
                watch.mass += chunks.flat_map(|chunk| list.rest_plane(chunk, MASS)).map(|m| m.to_f64()).sum::<f64>();
            }
        }
        let is_touched = |g: &u32| *g != NONE && touched[*g as usize];
        let is_border = |b: &u32| rest[*b as usize] == ASLEEP && grid.nodes_around[*b as usize].iter().any(is_touched);
        watch.border = (0..grid.occupied.len() as u32).filter(is_border).collect();
    }

    /// Momentum that ground asleep has taken in a step from nodes that it shares with ground awake [kg m/s]: what it has at their velocity, less what it gave
    /// to them. It stays at rest, so that is gone.
    pub(crate) fn taken_by_those_asleep(&self, isa: Isa) -> [f64; 3] {
        let grid = &self.grid;
        let of_block = |&b: &u32| {
            let mut nodes = [T::default(); TILE];
            let awake = |g: u32| if self.watch.nodes.binary_search(&g).is_ok() { g } else { NONE };
            let around = grid.nodes_around[b as usize].map(awake);
            isa.run::<T, _>(FillTile { tile: &mut nodes, nodes: &grid.nodes, around: &around });
            let gave = grid.tiles[b as usize].as_chunks::<4>().0;
            nodes.as_chunks::<4>().0.iter().zip(gave).filter(|(node, _)| node[3] > T::default()).fold(
                [0.0; 3],
                |sum: [f64; 3], (node, gave)| {
                    std::array::from_fn(|d| sum[d] + gave[3].to_f64() * node[d].to_f64() - gave[d].to_f64())
                },
            )
        };
        let taken: Vec<[f64; 3]> = self.watch.border.par_iter().map(of_block).collect();
        taken.iter().fold([0.0; 3], |sum, taken| std::array::from_fn(|d| sum[d] + taken[d]))
    }
}

impl<T> Grid<T> {
    /// The blocks with particles next to one, and itself.
    fn neighbours(&self, b: usize) -> impl Iterator<Item = u32> {
        let nodes = self.nodes_around[b].into_iter().filter(|&g| g != NONE);
        nodes.map(|g| self.tiles_around[g as usize][block::neighbour([0; 3])]).filter(|&b| b != NONE)
    }

    /// Blocks with particles from one block's coordinates to another's, both included.
    fn within(&self, first: [i32; 3], last: [i32; 3]) -> impl Iterator<Item = u32> {
        let inside = move |key: u64| {
            let at = block::of_key(key);
            (0..3).all(|d| first[d] <= at[d] && at[d] <= last[d])
        };
        // Keys rise with x first.
        let from = self.occupied.partition_point(|&key| block::of_key(key)[0] < first[0]);
        let to = self.occupied.partition_point(|&key| block::of_key(key)[0] <= last[0]);
        (from..to.max(from)).filter(move |&b| inside(self.occupied[b])).map(|b| b as u32)
    }

    /// Does the block take part in what levels exchange?
    fn is_tied(&self, b: u32) -> bool {
        self.edge_of.get(b as usize).is_some_and(|&edge| edge != NONE) || self.near_shared.binary_search(&b).is_ok()
    }

    /// Do nodes of the block take part in it?
    fn is_shared(&self, g: usize) -> bool {
        self.ring_of[g] != NONE || self.link_starts[g] < self.link_starts[g + 1]
    }
}
