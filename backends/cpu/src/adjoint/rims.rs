//! Rims backwards: what a level's outermost nodes hand to the next coarser level, and what they read from it.
//!
//! A rim node ("slave") hands its mass m, its momentum p and its affine momentum M = m Σ W (m C) / Σ W m to its parents, where W weighs sums over the parent cells about it. Its velocity is theirs.

use super::CpuAdjoint;
use super::nodes::{Block, ByBlock, Nodes};
use crate::grid::slaves_of;
use barchan_core::{ParticleList, ParticleState, Regions, SortPhase};
use barchan_grid::block::{self, CELLS, NONE, SIDE};
use barchan_grid::ring::{self, PARENT_CELLS, each_mean, each_parent, first_parent, parent_cells};
use rayon::prelude::*;
use std::ops::Range;

/// Of the particles in a parent cell: mass, then the three columns of m h C.
type Carried = [f64; 10];

/// A node of the coarser level, or a parent cell, that a block's slaves see.
#[derive(Clone, Copy)]
struct Seen {
    /// Its number; `NONE` where nobody asks.
    at: u32,
    /// Components of velocity that a mirror between them changes the sign of, and axes that it turns round, as bits.
    flips: u8,
    turns: u8,
}

impl Seen {
    const NOTHING: Self = Self { at: NONE, flips: 0, turns: 0 };

    fn number(&self) -> Option<usize> {
        (self.at != NONE).then_some(self.at as usize)
    }
    /// The sign that component `i` of a vector gets.
    fn flip(&self, i: usize) -> f64 {
        if self.flips >> i & 1 == 1 { -1.0 } else { 1.0 }
    }
    /// The sign that entry `e` of the columns of a matrix gets.
    fn turn(&self, e: usize) -> f64 {
        self.flip(e % 3) * if self.turns >> (e / 3) & 1 == 1 { -1.0 } else { 1.0 }
    }
}

/// What a slave held before it handed it on, and the mean about it.
struct Held {
    /// Its place in the block.
    n: usize,
    node: [f64; 4],
    mean: Carried,
}

/// A block with slaves.
struct Ring {
    /// Its first node, and its slaves as bits.
    first: usize,
    slaves: u64,
    /// The 4³ parents and parent cells around it.
    parents: [Seen; CELLS],
    cells: [Seen; CELLS],
    held: Vec<Held>,
}

/// A ring whose parents, and parent cells, are numbered within blocks of its own.
struct Draft {
    ring: Ring,
    parents: Vec<[i32; 3]>,
    cells: Vec<[i32; 3]>,
}

/// The rim of a level in a step.
pub(super) struct Rim {
    rings: Vec<Ring>,
    /// Where sums over the parent cells in each block begin.
    places: ByBlock<usize>,
}

/// Particles of a list, one behind the other, that count in one block.
pub(super) struct Run {
    block: [i32; 3],
    particles: Range<usize>,
}

/// The blocks in which the particles of each list count: where they were sorted, or where they are.
pub(super) fn runs_of(particles: &ParticleState, sort: Option<&SortPhase>, sorted: &[bool]) -> Vec<Vec<Run>> {
    let materials = particles.lists.iter().filter(|list| list.level == 0).count();
    let of_list = |(l, list): (usize, &ParticleList)| {
        let level = list.level as usize;
        let mut end = 0;
        let mut run = |block: [i32; 3], count: usize| {
            end += count;
            Run { block, particles: end - count..end }
        };
        match sort {
            Some(sort) if !sorted.get(level).copied().unwrap_or(false) => {
                let here = sort.blocks.iter().filter(|(at, _)| at[1] == level as i32);
                // A device counts cell by cell.
                let own = |counts: &[u32]| counts.iter().skip(l % materials).step_by(materials).sum::<u32>() as usize;
                here.map(|([_, _, x, y, z], counts)| run([*x, *y, *z], own(counts))).collect()
            }
            _ => {
                let same = list.cell.chunk_by(|a, b| block::of_cell(*a) == block::of_cell(*b));
                same.map(|cells| run(block::of_cell(cells[0]), cells.len())).collect()
            }
        }
    };
    particles.lists.par_iter().enumerate().map(of_list).collect()
}

/// The number that a block has among some, behind which it is put if it is not among them.
fn number_of(block: [i32; 3], blocks: &mut Vec<[i32; 3]>) -> usize {
    blocks.iter().position(|one| *one == block).unwrap_or_else(|| {
        blocks.push(block);
        blocks.len() - 1
    })
}

impl CpuAdjoint {
    /// The rim of level `l` takes what it holds from `sums`, and hands it to those of the next coarser level.
    pub(super) fn hand_over(
        &self,
        l: usize,
        regions: &Regions,
        [sums, coarser_sums]: [&mut Nodes; 2],
        (particles, runs): (&ParticleState, &[Vec<Run>]),
    ) -> Rim {
        let bounds = &self.grids[l].bounds;
        let drafts: Vec<Draft> = (0..sums.keys.len())
            .into_par_iter()
            .filter(|b| sums.values[*b].iter().any(|node| node[3] > 0.0))
            .filter_map(|b| match slaves_of(regions, l, bounds, sums.keys[b]) {
                0 => None,
                slaves => Some(self.draft(l, (b, sums.keys[b]), slaves)),
            })
            .collect();
        let mut rim = Rim { rings: Vec::with_capacity(drafts.len()), places: ByBlock::default() };
        for Draft { mut ring, parents, cells } in drafts {
            let parents: Vec<usize> = parents.into_iter().map(|key| coarser_sums.block(key)).collect();
            let place = |key: [i32; 3]| {
                let next = rim.places.len() * PARENT_CELLS;
                *rim.places.entry(Block(key)).or_insert(next)
            };
            let cells: Vec<usize> = cells.into_iter().map(place).collect();
            for n in 0..CELLS {
                if let Some(at) = ring.parents[n].number() {
                    ring.parents[n].at = (parents[at / CELLS] * CELLS + at % CELLS) as u32;
                }
                if let Some(at) = ring.cells[n].number() {
                    ring.cells[n].at = (cells[at / PARENT_CELLS] + at % PARENT_CELLS) as u32;
                }
            }
            rim.rings.push(ring);
        }
        let mut carried = vec![[0.0; 10]; rim.places.len() * PARENT_CELLS];
        let of_runs = self.of_carriers(l, &rim, (particles, runs), |k, run, first| {
            let list = &particles.lists[k];
            let mut sums = [[0.0; 10]; PARENT_CELLS];
            for i in run.particles.clone() {
                let (mass, sum) = (list.mass[i], &mut sums[run.octant(list, i)]);
                sum[0] += mass;
                for (entry, c) in list.affine[i].iter().enumerate() {
                    sum[1 + 3 * (entry % 3) + entry / 3] += mass * list.cell_width * c;
                }
            }
            (first, sums)
        });
        for (first, sums) in of_runs {
            let here = carried[first..][..PARENT_CELLS].as_flattened_mut().iter_mut();
            here.zip(sums.as_flattened()).for_each(|(sum, own)| *sum += own);
        }
        let given: Vec<_> = rim.rings.par_iter_mut().map(|ring| ring.hand_over(sums, &carried)).collect();
        for (ring, tile) in rim.rings.iter().zip(given) {
            ring.held.iter().for_each(|held| *sums.get_mut(ring.first + held.n) = [0.0; 4]);
            ring.add_to_parents(&tile, coarser_sums);
        }
        rim
    }

    /// A block's slaves, and who their parents are.
    fn draft(&self, l: usize, (b, key): (usize, [i32; 3]), slaves: u64) -> Draft {
        let (bounds, coarser) = (&self.grids[l].bounds, &self.grids[l + 1].bounds);
        let (first, means, parents) = (first_parent(key), parent_cells(slaves), ring::parents(slaves));
        let nothing = [Seen::NOTHING; CELLS];
        let ring = Ring { first: b * CELLS, slaves, parents: nothing, cells: nothing, held: Vec::new() };
        let mut draft = Draft { ring, parents: Vec::new(), cells: Vec::new() };
        for n in 0..CELLS {
            let image = [first[0] + (n / 16) as i32, first[1] + (n / 4 % 4) as i32, first[2] + (n % 4) as i32];
            let (cell, flipped) = coarser.mirrors.reflected(image);
            let flips = (0..3).fold(0, |bits, d| bits | u8::from(flipped[d]) << d);
            let turns = (0..3).fold(0, |bits, d| bits | u8::from(cell[d] != image[d]) << d);
            if parents >> n & 1 == 1 {
                let parent = number_of(coarser.wrap(block::of_cell(cell)), &mut draft.parents);
                let at = (parent * CELLS + block::place(cell)) as u32;
                draft.ring.parents[n] = Seen { at, flips, turns };
            }
            if means >> n & 1 == 1 {
                let block = number_of(bounds.wrap(cell.map(|c| c >> 1)), &mut draft.cells);
                let at = (block * PARENT_CELLS + octant(cell.map(|c| c & 1 == 1))) as u32;
                draft.ring.cells[n] = Seen { at, flips, turns };
            }
        }
        draft
    }

    /// What is found of each run of particles of a level that are in blocks with parent cells of its rim: `find` is given the list's number, and where sums over the block's parent cells begin.
    fn of_carriers<T: Send>(
        &self,
        l: usize,
        rim: &Rim,
        (particles, runs): (&ParticleState, &[Vec<Run>]),
        find: impl Fn(usize, &Run, usize) -> T + Sync,
    ) -> Vec<T> {
        let bounds = &self.grids[l].bounds;
        let own = runs.iter().enumerate().filter(|(k, _)| particles.lists[*k].level as usize == l);
        let all: Vec<(usize, &Run)> = own.flat_map(|(k, runs)| runs.iter().map(move |run| (k, run))).collect();
        let first = |run: &Run| rim.places.get(&Block(bounds.wrap(run.block))).copied();
        all.into_par_iter().filter_map(|(k, run)| Some(find(k, run, first(run)?))).collect()
    }

    /// The adjoint of [`hand_over`](Self::hand_over): from what is owed to the coarser level's sums to what is owed to the rim's, and to particles' C, which is returned by list and place there.
    pub(super) fn hand_over_back(
        &self,
        l: usize,
        rim: &Rim,
        [owed, coarser]: [&mut Nodes; 2],
        (particles, runs): (&ParticleState, &[Vec<Run>]),
    ) -> Vec<(usize, usize, [f64; 9])> {
        let mut of_carried = vec![[0.0; 10]; rim.places.len() * PARENT_CELLS];
        let of_rings: Vec<_> = rim.rings.par_iter().map(|ring| ring.hand_over_back(coarser)).collect();
        for (ring, (of_held, of_cells)) in rim.rings.iter().zip(of_rings) {
            ring.held.iter().zip(of_held).for_each(|(held, of)| *owed.get_mut(ring.first + held.n) = of);
            for (seen, of) in ring.cells.iter().zip(of_cells) {
                if let Some(at) = seen.number() {
                    of_carried[at].iter_mut().zip(of).for_each(|(sum, own)| *sum += own);
                }
            }
        }
        let of_runs = self.of_carriers(l, rim, (particles, runs), |k, run, first| {
            let list = &particles.lists[k];
            let of = |i: usize| {
                // Some cells of a block nobody has asked.
                let (of, scale) = (&of_carried[first + run.octant(list, i)], list.mass[i] * list.cell_width);
                (*of != [0.0; 10]).then(|| (k, i, std::array::from_fn(|e| scale * of[1 + 3 * (e % 3) + e / 3])))
            };
            run.particles.clone().filter_map(of).collect::<Vec<_>>()
        });
        of_runs.into_iter().flatten().collect()
    }
}

impl Run {
    /// The parent cell that a particle counts in, among those of the block.
    fn octant(&self, list: &ParticleList, i: usize) -> usize {
        octant([0, 1, 2].map(|d| list.cell[i][d] - SIDE * self.block[d] >= SIDE / 2))
    }
}

/// A parent cell's place in its block, by the half of it in which it is along each axis.
fn octant([x, y, z]: [bool; 3]) -> usize {
    4 * usize::from(x) + 2 * usize::from(y) + usize::from(z)
}

impl Ring {
    /// What slaves hand to parents, and the means about them, which are kept.
    fn hand_over(&mut self, sums: &Nodes, carried: &[Carried]) -> [[f64; 4]; CELLS] {
        let mut tile = [[0.0; 4]; CELLS];
        for n in (0..CELLS).filter(|n| self.slaves >> n & 1 == 1) {
            let node = sums.get(self.first + n);
            if node[3] <= 0.0 {
                continue;
            }
            let mut mean = [0.0; 10];
            each_mean(n, |cell, weight| {
                let seen = self.cells[cell];
                if let Some(at) = seen.number() {
                    mean[0] += weight * carried[at][0];
                    (0..9).for_each(|e| mean[1 + e] += weight * seen.turn(e) * carried[at][1 + e]);
                }
            });
            let part = if mean[0] > 0.0 { node[3] / mean[0] } else { 0.0 };
            each_parent(n, |parent, weight, way| {
                let seen = self.parents[parent];
                for i in 0..3 {
                    let lever: f64 = (0..3).map(|j| part * mean[1 + 3 * j + i] * way[j]).sum();
                    tile[parent][i] += weight * seen.flip(i) * (node[i] + lever);
                }
                tile[parent][3] += weight * node[3];
            });
            self.held.push(Held { n, node, mean });
        }
        tile
    }

    /// What is owed to slaves, and to the sums over parent cells, from what is owed to the parents.
    fn hand_over_back(&self, coarser: &Nodes) -> (Vec<[f64; 4]>, [Carried; CELLS]) {
        let mut of_cells = [[0.0; 10]; CELLS];
        let of_slave = |Held { n, node, mean }: &Held| {
            let part = if mean[0] > 0.0 { node[3] / mean[0] } else { 0.0 };
            let (mut of, mut of_columns) = ([0.0; 4], [0.0; 9]);
            each_parent(*n, |parent, weight, way| {
                let seen = self.parents[parent];
                let Some(from) = seen.number().map(|at| coarser.get(at)) else { return };
                for i in 0..3 {
                    let owed = weight * seen.flip(i) * from[i];
                    of[i] += owed;
                    (0..3).for_each(|j| of_columns[3 * j + i] += owed * way[j]);
                }
                of[3] += weight * from[3];
            });
            if mean[0] > 0.0 {
                let along: f64 = (0..9).map(|e| of_columns[e] * mean[1 + e]).sum::<f64>() / mean[0];
                of[3] += along;
                let mut of_mean = [-part * along; 10];
                (0..9).for_each(|e| of_mean[1 + e] = part * of_columns[e]);
                each_mean(*n, |cell, weight| {
                    let seen = self.cells[cell];
                    of_cells[cell][0] += weight * of_mean[0];
                    (0..9).for_each(|e| of_cells[cell][1 + e] += weight * seen.turn(e) * of_mean[1 + e]);
                });
            }
            of
        };
        let of_held = self.held.iter().map(of_slave).collect();
        (of_held, of_cells)
    }

    /// Adds what belongs to parents to theirs.
    fn add_to_parents(&self, tile: &[[f64; 4]; CELLS], coarser: &mut Nodes) {
        for (seen, own) in self.parents.iter().zip(tile) {
            if let Some(at) = seen.number() {
                coarser.get_mut(at).iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
            }
        }
    }
}

impl Rim {
    /// Gives slaves the velocity of their parents.
    pub(super) fn prolong(&self, velocities: &mut Nodes, coarser: &Nodes) {
        let of_slave = |ring: &Ring, n: usize| {
            let mut velocity = [0.0; 4];
            each_parent(n, |parent, weight, _| {
                let seen = ring.parents[parent];
                let Some(from) = seen.number().map(|at| coarser.get(at)) else { return };
                (0..3).for_each(|i| velocity[i] += weight * seen.flip(i) * from[i]);
            });
            velocity
        };
        let of_ring = |ring: &Ring| ring.held.iter().map(|held| of_slave(ring, held.n)).collect();
        let found: Vec<Vec<[f64; 4]>> = self.rings.par_iter().map(of_ring).collect();
        for (ring, found) in self.rings.iter().zip(found) {
            ring.held.iter().zip(found).for_each(|(held, found)| *velocities.get_mut(ring.first + held.n) = found);
        }
    }

    /// The adjoint of that.
    pub(super) fn prolong_back(&self, owed: &mut Nodes, coarser: &mut Nodes) {
        let of_ring = |ring: &Ring| {
            let mut tile = [[0.0; 4]; CELLS];
            for held in &ring.held {
                let from = owed.get(ring.first + held.n);
                each_parent(held.n, |parent, weight, _| {
                    let seen = ring.parents[parent];
                    (0..3).for_each(|i| tile[parent][i] += weight * seen.flip(i) * from[i]);
                });
            }
            tile
        };
        let tiles: Vec<_> = self.rings.par_iter().map(of_ring).collect();
        for (ring, tile) in self.rings.iter().zip(tiles) {
            ring.held.iter().for_each(|held| *owed.get_mut(ring.first + held.n) = [0.0; 4]);
            ring.add_to_parents(&tile, coarser);
        }
    }
}
