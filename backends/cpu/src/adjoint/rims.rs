//! Rims backwards: what a level's outermost nodes hand to the next coarser level, and what they read from it.
//!
//! A rim node ("slave") hands its mass m, its momentum p and its affine momentum M = m Σ W (m C) / Σ W m to its parents, where W weighs sums over the parent cells about it. Its velocity is theirs.

use super::{CpuAdjoint, Nodes};
use crate::grid::slaves_of;
use barchan_core::{ParticleList, ParticleState, Regions, SortPhase};
use barchan_grid::block::{self, CELLS, SIDE};
use barchan_grid::ring::{self, each_mean, each_parent, first_parent, parent_cells};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};

/// Of the particles in a parent cell: mass, then the three columns of m h C.
type Carried = [f64; 10];

/// A node of the coarser level, or a parent cell, that a block's slaves see.
#[derive(Clone, Copy)]
struct Seen {
    at: usize,
    /// Components of velocity that a mirror between them changes the sign of, and axes that it turns round.
    flips: [f64; 3],
    turns: [f64; 3],
}

/// A block with slaves.
struct Ring {
    /// Its first node, and its slaves as bits.
    first: usize,
    slaves: u64,
    /// Of the 4³ parents and parent cells around it, those that there are.
    parents: [Option<Seen>; CELLS],
    cells: [Option<Seen>; CELLS],
    /// What slaves held before they handed it on, and the means about them.
    held: Vec<(usize, [f64; 4], Carried)>,
}

/// The rim of a level in a step.
pub(super) struct Rim {
    rings: Vec<Ring>,
    /// Where each parent cell's sums stand.
    places: HashMap<[i32; 3], usize>,
}

/// The block in which each particle of each list counts: where it was sorted, or where it is.
pub(super) fn blocks_of(particles: &ParticleState, sort: Option<&SortPhase>, sorted: &[bool]) -> Vec<Vec<[i32; 3]>> {
    let materials = particles.lists.iter().filter(|list| list.level == 0).count();
    let of_list = |(l, list): (usize, &ParticleList)| {
        let level = list.level as usize;
        match sort {
            Some(sort) if !sorted.get(level).copied().unwrap_or(false) => {
                let here = sort.blocks.iter().filter(|(at, _)| at[1] == level as i32);
                // A device counts cell by cell.
                let own = |counts: &[u32]| counts.iter().skip(l % materials).step_by(materials).sum::<u32>() as usize;
                here.flat_map(|([_, _, x, y, z], counts)| std::iter::repeat_n([*x, *y, *z], own(counts))).collect()
            }
            _ => list.cell.iter().map(|cell| block::of_cell(*cell)).collect(),
        }
    };
    particles.lists.iter().enumerate().map(of_list).collect()
}

impl CpuAdjoint {
    /// The rim of level `l` takes what it holds from `sums`, and hands it to those of the next coarser level.
    pub(super) fn hand_over(
        &self,
        l: usize,
        regions: &Regions,
        [sums, coarser_sums]: [&mut Nodes; 2],
        (particles, blocks): (&ParticleState, &[Vec<[i32; 3]>]),
    ) -> Rim {
        let (bounds, coarser) = (&self.grids[l].bounds, &self.grids[l + 1].bounds);
        let weighs = |b: &usize| sums.values[*b].iter().any(|node| node[3] > 0.0);
        let with_slaves = (0..sums.keys.len()).into_par_iter().filter(weighs).filter_map(|b| {
            let slaves = slaves_of(regions, l, bounds, sums.keys[b]);
            (slaves != 0).then_some((b, slaves))
        });
        let with_slaves: Vec<(usize, u64)> = with_slaves.collect();
        let mut rim = Rim { rings: Vec::with_capacity(with_slaves.len()), places: HashMap::new() };
        for (b, slaves) in with_slaves {
            let (first, means) = (first_parent(sums.keys[b]), parent_cells(slaves));
            let parents = ring::parents(slaves);
            let mut ring =
                Ring { first: b * CELLS, slaves, parents: [None; CELLS], cells: [None; CELLS], held: Vec::new() };
            for n in 0..CELLS {
                let image = [first[0] + (n / 16) as i32, first[1] + (n / 4 % 4) as i32, first[2] + (n % 4) as i32];
                let (cell, flipped) = coarser.mirrors.reflected(image);
                let flips = flipped.map(|flipped| if flipped { -1.0 } else { 1.0 });
                let turns = std::array::from_fn(|d| if cell[d] == image[d] { 1.0 } else { -1.0 });
                if parents >> n & 1 == 1 {
                    let within = [0, 1, 2].map(|d| cell[d].rem_euclid(SIDE) as usize);
                    let at = coarser_sums.block(coarser.wrap(block::of_cell(cell))) * CELLS;
                    let at = at + (4 * within[0] + within[1]) * 4 + within[2];
                    ring.parents[n] = Some(Seen { at, flips, turns });
                }
                if means >> n & 1 == 1 {
                    let block = bounds.wrap(cell.map(|c| c >> 1));
                    let key = std::array::from_fn(|d| 2 * block[d] + (cell[d] & 1));
                    let next = rim.places.len();
                    let at = *rim.places.entry(key).or_insert(next);
                    ring.cells[n] = Some(Seen { at, flips, turns });
                }
            }
            rim.rings.push(ring);
        }
        let mut carried = vec![[0.0; 10]; rim.places.len()];
        self.each_carrier(l, &rim, particles, blocks, |list, i, at| {
            let list = &particles.lists[list];
            let (mass, sum) = (list.mass[i], &mut carried[at]);
            sum[0] += mass;
            for (entry, c) in list.affine[i].iter().enumerate() {
                sum[1 + 3 * (entry % 3) + entry / 3] += mass * list.cell_width * c;
            }
        });
        for ring in &mut rim.rings {
            for n in (0..CELLS).filter(|n| ring.slaves >> n & 1 == 1) {
                let node = std::mem::take(sums.get_mut(ring.first + n));
                if node[3] <= 0.0 {
                    continue;
                }
                let mut mean = [0.0; 10];
                each_mean(n, |cell, weight| {
                    if let Some(Seen { at, flips, turns }) = ring.cells[cell] {
                        mean[0] += weight * carried[at][0];
                        for e in 0..9 {
                            mean[1 + e] += weight * flips[e % 3] * turns[e / 3] * carried[at][1 + e];
                        }
                    }
                });
                let part = if mean[0] > 0.0 { node[3] / mean[0] } else { 0.0 };
                each_parent(n, |parent, weight, way| {
                    let Some(Seen { at, flips, .. }) = ring.parents[parent] else { return };
                    let to = coarser_sums.get_mut(at);
                    for i in 0..3 {
                        let lever: f64 = (0..3).map(|j| part * mean[1 + 3 * j + i] * way[j]).sum();
                        to[i] += weight * flips[i] * (node[i] + lever);
                    }
                    to[3] += weight * node[3];
                });
                ring.held.push((n, node, mean));
            }
        }
        rim
    }

    /// Shows the particles of a level that are in parent cells of its rim, and where the sums of these stand.
    fn each_carrier(
        &self,
        l: usize,
        rim: &Rim,
        particles: &ParticleState,
        blocks: &[Vec<[i32; 3]>],
        mut see: impl FnMut(usize, usize, usize),
    ) {
        if rim.places.is_empty() {
            return;
        }
        let bounds = &self.grids[l].bounds;
        let near: HashSet<[i32; 3]> = rim.places.keys().map(|cell| cell.map(|c| c >> 1)).collect();
        let lists = particles.lists.iter().zip(blocks).enumerate();
        for (number, (list, blocks)) in lists.filter(|(_, (list, _))| list.level as usize == l) {
            let mut first = 0;
            // Particles lie block by block, as a rule, and most blocks are far from the rim.
            for same in blocks.chunk_by(|a, b| a == b) {
                let (block, wrapped) = (same[0], bounds.wrap(same[0]));
                let own = first..first + same.len();
                first = own.end;
                if !near.contains(&wrapped) {
                    continue;
                }
                for i in own {
                    let cell = list.cell[i];
                    let key = std::array::from_fn(|d| 2 * wrapped[d] + i32::from(cell[d] - SIDE * block[d] >= 2));
                    if let Some(at) = rim.places.get(&key) {
                        see(number, i, *at);
                    }
                }
            }
        }
    }

    /// The adjoint of [`hand_over`](Self::hand_over): from what is owed to the coarser level's sums to what is owed to the rim's, and to particles' C, which `of_affine` takes in by list and
    /// place there.
    pub(super) fn hand_over_back(
        &self,
        l: usize,
        rim: &Rim,
        [owed, coarser]: [&mut Nodes; 2],
        (particles, blocks): (&ParticleState, &[Vec<[i32; 3]>]),
        mut of_affine: impl FnMut(usize, usize, [f64; 9]),
    ) {
        let mut of_carried = vec![[0.0; 10]; rim.places.len()];
        for ring in &rim.rings {
            for (n, node, mean) in &ring.held {
                let part = if mean[0] > 0.0 { node[3] / mean[0] } else { 0.0 };
                let (mut of, mut of_columns) = ([0.0; 4], [0.0; 9]);
                each_parent(*n, |parent, weight, way| {
                    let Some(Seen { at, flips, .. }) = ring.parents[parent] else { return };
                    let from = coarser.get(at);
                    for i in 0..3 {
                        let owed = weight * flips[i] * from[i];
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
                        if let Some(Seen { at, flips, turns }) = ring.cells[cell] {
                            let to = &mut of_carried[at];
                            to[0] += weight * of_mean[0];
                            (0..9).for_each(|e| to[1 + e] += weight * flips[e % 3] * turns[e / 3] * of_mean[1 + e]);
                        }
                    });
                }
                *owed.get_mut(ring.first + n) = of;
            }
        }
        self.each_carrier(l, rim, particles, blocks, |list, i, at| {
            let scale = particles.lists[list].mass[i] * particles.lists[list].cell_width;
            of_affine(list, i, std::array::from_fn(|e| scale * of_carried[at][1 + 3 * (e % 3) + e / 3]));
        });
    }
}

impl Rim {
    /// Gives slaves the velocity of their parents.
    pub(super) fn prolong(&self, velocities: &mut Nodes, coarser: &Nodes) {
        for ring in &self.rings {
            for (n, ..) in &ring.held {
                let mut velocity = [0.0; 4];
                each_parent(*n, |parent, weight, _| {
                    let Some(Seen { at, flips, .. }) = ring.parents[parent] else { return };
                    let from = coarser.get(at);
                    (0..3).for_each(|i| velocity[i] += weight * flips[i] * from[i]);
                });
                *velocities.get_mut(ring.first + n) = velocity;
            }
        }
    }

    /// The adjoint of that.
    pub(super) fn prolong_back(&self, owed: &mut Nodes, coarser: &mut Nodes) {
        for ring in &self.rings {
            for (n, ..) in &ring.held {
                let from = std::mem::take(owed.get_mut(ring.first + n));
                each_parent(*n, |parent, weight, _| {
                    let Some(Seen { at, flips, .. }) = ring.parents[parent] else { return };
                    let to = coarser.get_mut(at);
                    (0..3).for_each(|i| to[i] += weight * flips[i] * from[i]);
                });
            }
        }
    }
}
