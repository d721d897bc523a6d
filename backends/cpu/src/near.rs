//! What bodies meet of a level: the nodes and particles near them, and the nodes' velocities back.

use crate::grid::entries;
use crate::level::Level;
use barchan_core::{Aabb, NearParticle, NodeBatch, Vec3};
use barchan_grid::block::{self, CELLS, NONE, SIDE};
use barchan_grid::limits::{FULL_SPEED, greater};
use barchan_grid::near::{Cubes, boxes_near_block, gather_block, is_near_block};
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;
use rayon::prelude::*;

/// The particles of a block that are near bodies, and the cubes of nodes around them.
#[derive(Default)]
pub(crate) struct Near {
    cubes: Vec<[u32; 8]>,
    particles: Vec<NearParticle>,
}

impl<T: Scalar> Level<T> {
    /// Collects the nodes inside any of the boxes or their images, in the grid's order. If levels take steps of their own (`subcycled`), a node that the
    /// finer level shares weighs what this level's own particles weigh there: the finer ones have moved, and take nothing of what
    /// bodies give to it.
    pub(crate) fn gather(&mut self, boxes: &[Aabb], least: f64, subcycled: bool, batch: &mut NodeBatch) {
        batch.clear();
        self.batch_nodes.clear();
        self.batch_block_of.clear();
        self.batch_block_of.resize(self.grid.keys.len(), NONE);
        self.batch_blocks.clear();
        batch.cell_width = self.store.cell_width;
        // Most blocks are far from all boxes: they are left out side by side.
        let (h, periods) = (batch.cell_width, self.bounds.periods());
        batch.periods = periods.map(|cells| f64::from(cells) * h);
        let first_of = |key: u64| block::of_key(key).map(|b| b * SIDE);
        let keys = self.grid.keys.par_iter().with_min_len(1 << 10).map(|key| first_of(*key));
        let is_near = |(_, first): &(usize, [i32; 3])| is_near_block(boxes, *first, h, 0.0, periods);
        let near: Vec<_> = keys.enumerate().filter(is_near).collect();
        for (g, first) in near {
            let nodes = &self.grid.nodes[g];
            let mut numbers = [NodeBatch::NONE; CELLS];
            let so_far = batch.len();
            let mut shared =
                self.grid.shared[entries(&self.grid.shared_starts, g)].iter().filter(|_| subcycled).peekable();
            let node = |n: usize| {
                let [u, v, w, mass] = [0, 1, 2, 3].map(|k| nodes[4 * n + k]);
                let own = shared.next_if(|shared| shared.node as usize % CELLS == n).map(|shared| shared.own[3]);
                ([u, v, w].map(T::to_f64), own.unwrap_or(mass).to_f64())
            };
            gather_block(batch, boxes, first, periods, least, node, |n, _, number| {
                numbers[n] = number;
                self.batch_nodes.push((g * CELLS + n) as u32);
            });
            if batch.len() > so_far {
                self.batch_block_of[g] = self.batch_blocks.len() as u32;
                self.batch_blocks.push(numbers);
            }
        }
    }

    /// Collects the particles inside any of the boxes, block by block, and their cells among the nodes that were gathered last; `moduli` are
    /// the materials' stiffness [Pa].
    pub(crate) fn gather_particles(&mut self, boxes: &[Aabb], moduli: &[f64], batch: &mut NodeBatch) {
        // Particles may have left their block by a cell since they were sorted, and nodes are at the middle of cells.
        let (h, periods) = (self.h(), self.bounds.periods());
        let wider: Vec<Aabb> = boxes.iter().map(|one| one.grown(1.5 * h)).collect();
        let first = |b: usize| block::of_key(self.grid.occupied[b]).map(|c| c * SIDE);
        let is_near = |b: &usize| is_near_block(&wider, first(*b), h, 0.0, periods);
        let blocks: Vec<usize> = (0..self.grid.occupied.len()).filter(is_near).collect();
        // What each finds lies in memory of its own, kept from step to step: threads that ask for memory at once wait for one another.
        let mut found = std::mem::take(&mut self.near);
        found.resize_with(found.len().max(blocks.len()), Near::default);
        let of_block = |(&b, found): (&usize, &mut Near)| {
            self.near_particles(b, &boxes_near_block(boxes, first(b), h, 1.5 * h, periods), moduli, found);
        };
        blocks.par_iter().zip(&mut found).for_each(of_block);
        for Near { cubes, particles } in &found[..blocks.len()] {
            let first = batch.cubes.len() as u32;
            batch.cubes.extend_from_slice(cubes);
            batch.particles.extend(particles.iter().map(|one| NearParticle { cube: first + one.cube, ..*one }));
        }
        self.near = found;
    }

    /// Finds a block's particles inside any of the boxes, and the cubes of nodes around them.
    fn near_particles(&self, b: usize, boxes: &[Aabb], moduli: &[f64], found: &mut Near) {
        let h = self.h();
        let first = block::of_key(self.grid.occupied[b]).map(|c| c * SIDE);
        let in_batch = |g: u32| self.batch_block_of.get(g as usize).filter(|&&i| i != NONE);
        let numbers = |g| in_batch(g).map_or(&Cubes::ABSENT, |&i| &self.batch_blocks[i as usize]);
        let mut around = Cubes::of(self.grid.nodes_around[b].map(numbers));
        let cells = |x: Vec3| std::array::from_fn(|d| (x[d] / h).floor() as i32);
        let ranges: Vec<[[i32; 3]; 2]> = boxes.iter().map(|one| [one.min, one.max].map(cells)).collect();
        let Near { cubes, particles } = found;
        cubes.clear();
        particles.clear();
        for list in &self.store.lists {
            let run = list.runs[b];
            let lanes_of = |k: usize| {
                let within = ranges.iter().fold(0, |lanes, range| lanes | list.lanes_within(run.first + k, range));
                (0..(run.count - k * CHUNK).min(CHUNK)).filter(move |lane| within >> lane & 1 == 1)
            };
            for (k, lane) in (0..run.chunks()).flat_map(|k| lanes_of(k).map(move |lane| (k, lane))) {
                let chunk = run.first + k;
                let position = list.position_of(chunk, lane, h);
                if !boxes.iter().any(|one| one.contains(position)) {
                    continue;
                }
                let cell = list.cell_of(chunk, lane);
                let (to_first, place) = NearParticle::between_nodes(list.offset_of(chunk, lane));
                let local: [i32; 3] = std::array::from_fn(|d| cell[d] - first[d] + to_first[d]);
                let cube = around.number(local, cubes);
                // At rims some nodes are the coarser level's, and those in boxes may all be.
                if cubes[cube as usize].iter().any(|&node| node != NodeBatch::NONE) {
                    particles.push(NearParticle {
                        cube,
                        position,
                        place,
                        volume: list.volume0_of(chunk, lane),
                        modulus: moduli[list.material],
                    });
                }
            }
        }
    }

    /// Takes back the velocities of the nodes that were gathered last.
    pub(crate) fn scatter(&mut self, batch: &NodeBatch, least: f64) {
        let nodes = self.grid.nodes.as_flattened_mut();
        for ((&at, u), mass) in self.batch_nodes.iter().zip(&batch.velocity).zip(&batch.mass) {
            let felt = (mass / (least * FULL_SPEED)).min(1.0);
            for d in 0..3 {
                nodes[4 * at as usize + d] = T::from_f64(u[d]);
                self.max_speed = greater(self.max_speed, felt * u[d].abs());
            }
        }
    }
}
