//! What is near bodies whose law runs on the host: blocks of nodes with their particles, and the law on them.

use crate::device::kernel::Role;
use crate::device::layout::Periods;
use crate::device::memory::NEAR_BLOCK;
use crate::schedule::submission::Behind;
use crate::worlds::world::{Level, World};
use barchan_core::backend::WorldStep;
use barchan_core::contact::{Act, Contact};
use barchan_core::{Aabb, Coupling, NearParticle, NodeBatch, Result};
use barchan_grid::block::{self, CELLS, SIDE};
use barchan_grid::limits::{FULL_SPEED, greater};
use barchan_grid::near::{Cubes, gather_block, is_near_block};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};
use std::ops::Range;

/// A block of nodes on the host: velocities and masses.
pub(crate) struct Block {
    number: u32,
    /// Its first cell.
    first: [i32; 3],
    nodes: Vec<[f32; 4]>,
    pub(crate) changed: bool,
}

impl Block {
    /// As `gather.wgsl` writes it.
    pub(crate) fn of(words: &[[u32; 4]]) -> Self {
        let [x, y, z, number] = words[0];
        let nodes = words[1..].iter().map(|node| node.map(f32::from_bits)).collect();
        Self { number, first: [x, y, z].map(|c| c as i32), nodes, changed: false }
    }

    /// As `scatter_near.wgsl` reads it.
    pub(crate) fn words(&self) -> impl Iterator<Item = [u32; 4]> {
        let [x, y, z] = self.first.map(|c| c as u32);
        std::iter::once([x, y, z, self.number]).chain(self.nodes.iter().map(|node| node.map(f32::to_bits)))
    }
}

/// A particle near bodies, as `gather_particles.wgsl` writes it, in the order of layers, then of blocks, then of cells.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Particle {
    /// Layer, block and cell in one number, as there are many to be sorted.
    key: u128,
    /// Place in its cell, in units of 2^-24.
    place: [u32; 3],
    material: u32,
    /// Bits of its mass [kg].
    mass: u32,
}

/// Bits of a block's number along an axis, and of a cell's within its block; the layer's are above those of three blocks and a cell.
const OF_BLOCK: u32 = 30;
const OF_CELL: u32 = 6;
const LAYER_FROM: u32 = 3 * OF_BLOCK + OF_CELL;

impl Particle {
    pub(crate) fn of(layer: u32, [at, place]: [[u32; 4]; 2]) -> Self {
        let [x, y, z, material] = at;
        let [u, v, w, mass] = place;
        let cell = [x, y, z].map(|c| c as i32);
        // From the least block that there can be.
        let block = |c: i32| (i64::from(c.div_euclid(SIDE)) + (1 << (OF_BLOCK - 1))) as u128;
        let of_blocks = cell.iter().fold(u128::from(layer), |key, c| key << OF_BLOCK | block(*c));
        let in_block = cell.iter().fold(0, |n, c| SIDE * n + c.rem_euclid(SIDE));
        Self { key: of_blocks << OF_CELL | in_block as u128, place: [u, v, w], material, mass }
    }
    fn layer(&self) -> u32 {
        (self.key >> LAYER_FROM) as u32
    }
    /// Are both in one block?
    fn is_beside(&self, other: &Self) -> bool {
        self.key >> OF_CELL == other.key >> OF_CELL
    }
    /// The first cell of its block, and its own, counted from that.
    fn cell(&self) -> ([i32; 3], [i32; 3]) {
        let along = |d: u32| (self.key >> (OF_CELL + (2 - d) * OF_BLOCK)) as i64 & ((1 << OF_BLOCK) - 1);
        let first = [0, 1, 2].map(|d| (along(d) - (1 << (OF_BLOCK - 1))) as i32 * SIDE);
        let n = (self.key & ((1 << OF_CELL) - 1)) as i32;
        (first, [n / (SIDE * SIDE), n / SIDE % SIDE, n % SIDE])
    }
}

/// What a gathering has found of one world.
#[derive(Default)]
pub(crate) struct Found {
    blocks: Vec<Block>,
    particles: Vec<Particle>,
}

impl Found {
    pub(crate) fn of(gathered: &[Gathered<'_>]) -> Self {
        let mut found = Self::default();
        for block in gathered {
            let [count, layer, _, number] = block[0];
            if number == PARTICLES {
                let (pairs, _) = block[1..].as_chunks::<2>();
                found.particles.extend(pairs[..count as usize].iter().map(|pair| Particle::of(layer, *pair)));
            } else {
                found.blocks.push(Block::of(block));
            }
        }
        found
    }
}

/// A block of nodes, or particles of one layer, as `gather.wgsl` and `gather_particles.wgsl` write them.
pub(crate) type Gathered<'a> = &'a [[u32; 4]];

/// In place of a block's number: these are particles.
const PARTICLES: u32 = u32::MAX;

/// What has been gathered, by the world whose it is.
pub(crate) fn by_world<'a>(words: &'a [[u32; 4]], worlds: &[World]) -> Vec<Vec<Gathered<'a>>> {
    let levels = worlds[0].levels.len();
    let mut owners = Vec::new();
    for (w, world) in worlds.iter().enumerate() {
        let numbers = world.levels.iter().map(|level| level.node_blocks.clone());
        owners.extend(numbers.filter(|numbers| !numbers.is_empty()).map(|numbers| (numbers, w)));
    }
    owners.sort_unstable_by_key(|(numbers, _)| numbers.start);
    let mut all = vec![Vec::new(); worlds.len()];
    for block in words.chunks_exact(NEAR_BLOCK) {
        let [_, layer, _, number] = block[0];
        let world = if number == PARTICLES {
            Some(layer as usize / levels)
        } else {
            let behind = owners.partition_point(|(numbers, _)| numbers.start <= number as usize);
            owners[..behind].last().filter(|(numbers, _)| numbers.contains(&(number as usize))).map(|(_, world)| *world)
        };
        if let Some(world) = world {
            all[world].push(block);
        }
    }
    all
}

/// A level as bodies meet it.
pub(crate) struct Met {
    /// Cell width [m].
    h: f64,
    /// Numbers of its blocks of nodes.
    blocks: Range<usize>,
    layer: u32,
    periods: Periods,
}

/// A world's nodes and particles near its bodies.
pub(crate) struct Near {
    /// In the order of their numbers.
    pub(crate) blocks: Vec<Block>,
    particles: Vec<Particle>,
    levels: Vec<Met>,
    /// Of each material, stiffness against being pushed into [Pa], and volume over mass [m³/kg].
    materials: Vec<[f32; 4]>,
    /// Nodes lighter than this carry nothing [kg].
    least_mass: f64,
}

impl Near {
    /// A world's nodes, none of which has come yet; its first layer has this number.
    pub(crate) fn new(world: &World, first_layer: usize) -> Self {
        let met = |(layer, level): (usize, &Level)| Met {
            h: level.h,
            blocks: level.node_blocks.clone(),
            layer: layer as u32,
            periods: level.periods,
        };
        Self {
            blocks: Vec::new(),
            particles: Vec::new(),
            levels: (first_layer..).zip(&world.levels).map(met).collect(),
            materials: world.contact_materials.clone(),
            least_mass: world.least_mass,
        }
    }

    /// Takes what it does not have yet. The device finds all in any order.
    pub(crate) fn take(&mut self, found: Found) {
        let is_here = |block: &Block| self.blocks.binary_search_by_key(&block.number, |here| here.number).is_ok();
        let new: Vec<_> = found.blocks.into_iter().filter(|block| !is_here(block)).collect();
        self.blocks.extend(new);
        self.blocks.sort_unstable_by_key(|block| block.number);
        // Of a level that was asked for, all have come.
        let come: FxHashSet<u32> = found.particles.iter().map(Particle::layer).collect();
        self.particles.retain(|here| !come.contains(&here.layer()));
        self.particles.extend(found.particles);
        self.particles.par_sort_unstable();
    }

    /// All couplings act on the nodes of some levels, one level after the other. Returns the greatest speed that particles
    /// may feel [m/s].
    pub(crate) fn touch(&mut self, levels: Range<usize>, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<f64> {
        let mut speed = 0.0;
        for level in levels {
            Contact::default().act(couplings, [dt, self.levels[level].h], |[of_nodes, of_particles], act| {
                speed = greater(speed, self.apply(level, of_nodes, !of_particles.is_empty(), act)?);
                Ok(())
            })?;
        }
        Ok(speed)
    }

    /// Hands over a level's nodes in some boxes, and the particles there, and takes back the nodes' velocities.
    fn apply(&mut self, level: usize, boxes: &[Aabb], wants_particles: bool, act: &mut Act<'_>) -> Result<f64> {
        let Met { h, blocks: ref own, layer, periods } = self.levels[level];
        // Along periodic axes a block has many places.
        let home = |first: [i32; 3]| periods.wrap(first.map(|cell| cell / SIDE));
        let periods = periods.count.map(|blocks| blocks * SIDE);
        let lengths = periods.map(|cells| f64::from(cells) * h);
        let mut batch = NodeBatch { cell_width: h, periods: lengths, ..NodeBatch::default() };
        let mut places = Vec::new();
        // The number in the batch of each node of the blocks, by where these are.
        let mut numbers: FxHashMap<[i32; 3], [u32; CELLS]> = FxHashMap::default();
        for (b, block) in self.blocks.iter().enumerate().filter(|(_, block)| own.contains(&(block.number as usize))) {
            let node = |n: usize| {
                let [u, v, w, mass] = block.nodes[n].map(f64::from);
                ([u, v, w], mass)
            };
            let mut own = Cubes::ABSENT;
            gather_block(&mut batch, boxes, block.first, periods, self.least_mass, node, |n, _, number| {
                own[n] = number;
                places.push((b, n));
            });
            numbers.insert(home(block.first), own);
        }
        if batch.is_empty() {
            return Ok(0.0);
        }
        if wants_particles {
            // Cells that particles reach nodes from, and half of one.
            let wider: Vec<Aabb> = boxes.iter().map(|one| one.grown(1.5 * h)).collect();
            let from = self.particles.partition_point(|particle| particle.layer() < layer);
            let to = self.particles.partition_point(|particle| particle.layer() <= layer);
            for of_block in self.particles[from..to].chunk_by(Particle::is_beside) {
                let (first, _) = of_block[0].cell();
                if !is_near_block(&wider, first, h, 0.0, periods) {
                    continue;
                }
                let beside = |n: usize| {
                    let offset = block::offset(n);
                    numbers.get(&home(std::array::from_fn(|d| first[d] + SIDE * offset[d]))).unwrap_or(&Cubes::ABSENT)
                };
                let mut around = Cubes::of(std::array::from_fn(beside));
                for particle in of_block {
                    let (_, local) = particle.cell();
                    let in_cell = particle.place.map(|x| f64::from(x) / f64::from(1 << 24));
                    let (to_first, place) = NearParticle::between_nodes(in_cell);
                    let node = std::array::from_fn(|d| local[d] + to_first[d]);
                    let cube = around.number(node, &mut batch.cubes);
                    if batch.cubes[cube as usize].iter().any(|&node| node != NodeBatch::NONE) {
                        let [modulus, specific_volume, ..] = self.materials[particle.material as usize].map(f64::from);
                        batch.particles.push(NearParticle {
                            cube,
                            position: std::array::from_fn(|d| (f64::from(first[d] + local[d]) + in_cell[d]) * h),
                            place,
                            volume: f64::from(f32::from_bits(particle.mass)) * specific_volume,
                            modulus,
                        });
                    }
                }
            }
        }
        act(&mut batch)?;
        let mut fastest = 0.0f64;
        for ((&(b, n), u), mass) in places.iter().zip(&batch.velocity).zip(&batch.mass) {
            let felt = (mass / (self.least_mass * FULL_SPEED)).min(1.0);
            let block = &mut self.blocks[b];
            block.changed = true;
            for d in 0..3 {
                block.nodes[n][d] = u[d] as f32;
                fastest = greater(fastest, felt * u[d].abs());
            }
        }
        Ok(fastest)
    }
}

/// A box around a body, and how far beyond it this acts [cells of a level].
pub(crate) struct Around {
    pub(crate) bounds: Aabb,
    pub(crate) reach: f64,
}

/// A world's boxes around its bodies, grown by a margin [m].
pub(crate) fn boxes_of(world_step: &WorldStep<'_>, margin: f64) -> Vec<Around> {
    let mut all = Vec::new();
    for coupling in world_step.couplings.iter() {
        let around = |bounds: Aabb| Around { bounds: bounds.grown(margin), reach: coupling.reach() };
        all.extend(coupling.bounds().into_iter().map(around));
    }
    all
}

/// Is each box in the one that was asked for?
pub(crate) fn are_within(boxes: &[Around], asked: &[Around]) -> bool {
    let is_within = |(one, asked): (&Around, &Around)| one.bounds.union(&asked.bounds) == asked.bounds;
    boxes.len() == asked.len() && boxes.iter().zip(asked).all(is_within)
}

/// So many blocks of nodes near bodies, to be brought back.
pub(crate) fn behind(blocks: usize) -> Option<Behind> {
    Some(Behind::of(Role::Near, 0, (16 * NEAR_BLOCK * blocks) as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Particles come in any order. Sorted, those of a block stand together, cell by cell, level by level, however far on either side of the origin they are.
    #[test]
    fn particles_stand_block_by_block() {
        let cells = [[-5, 0, 7], [-1, -1, -1], [3, 0, 0], [0, 0, 0], [i32::MIN, i32::MAX, 2], [0, 3, 3], [4, 0, 0]];
        let of = |layer, [x, y, z]: [i32; 3], place| {
            Particle::of(layer, [[x as u32, y as u32, z as u32, 1], [place, 0, 0, 2]])
        };
        let mut all: Vec<Particle> =
            cells.iter().flat_map(|&cell| [of(1, cell, 9), of(0, cell, 9), of(0, cell, 3)]).collect();
        all.sort_unstable();
        let told: Vec<_> = all.iter().map(|one| (one.layer(), one.cell(), one.place[0])).collect();
        assert!(told.is_sorted(), "{told:?}");
        let whole = |(first, local): ([i32; 3], [i32; 3])| -> [i32; 3] { std::array::from_fn(|d| first[d] + local[d]) };
        let mut here: Vec<_> = told.iter().map(|(_, cell, _)| whole(*cell)).collect();
        here.sort_unstable();
        here.dedup();
        let mut wanted = cells;
        wanted.sort_unstable();
        assert_eq!(here, wanted);
        let blocks = all.chunk_by(Particle::is_beside).map(<[Particle]>::len).collect::<Vec<_>>();
        // On either level five blocks; the one at the origin has three of the cells.
        assert_eq!((blocks.iter().max(), blocks.len()), (Some(&6), 10));
    }
}
