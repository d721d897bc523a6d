//! One level: its particles, its grid, and the passes over them.
#![expect(unsafe_code, reason = "kernels load and store registers")]

use crate::grid::{Grid, Link, Ring, SharedNode, bits, cell_of_node, entries, origin};
use crate::memory::Parts;
use crate::near::Near;
use crate::sleep::Watch;
use crate::store::{List, Store};
use barchan_core::Plan;
use barchan_core::material::ErrorBuffer;
use barchan_grid::block::{self, CELLS, NODES, NONE, TILE};
use barchan_grid::bounds::Bounds;
use barchan_grid::limits::{FULL_SPEED, greater};
use barchan_grid::ring::{self, Carried};
use barchan_grid::transfer::{Fault, GridToParticles, ParticlesToGrid, Rates, Scalar, Step, Survey};
use barchan_grid::wall::{Mirror, WallParts, Witness as _};
use barchan_lanes::{CHUNK, Float, Isa, Kernel, Lanes};
use rayon::prelude::*;
use std::time::Instant;

/// Every so manieth block measures how much of P2G its materials take.
const TIMED_BLOCKS: usize = 16;

/// Shared nodes that are solved as one task.
const SHARED_AT_ONCE: usize = 256;

/// Nanoseconds in each material's callback and in P2G as a whole, over the blocks that measure.
#[derive(Clone, Default)]
pub(crate) struct Shares {
    pub(crate) materials: Vec<u64>,
    pub(crate) sampled: u64,
}

/// What stopped P2G: where, the fault, the material's words.
pub(crate) struct Stopped {
    pub(crate) block: usize,
    pub(crate) list: usize,
    pub(crate) fault: Fault,
    pub(crate) message: ErrorBuffer,
}

/// One level of one world.
pub(crate) struct Level<T: Scalar> {
    pub(crate) store: Store<T>,
    pub(crate) grid: Grid<T>,
    pub(crate) bounds: Bounds,
    /// Upper bound of any particle's move since the last sort, in cells.
    pub(crate) drift: f64,
    /// Are particles so near to an open side that they may be beyond it before the next sort?
    pub(crate) near_open: bool,
    /// Step over which C has carried the particles but not yet their strain [s].
    pub(crate) strain_dt: f64,
    /// Greatest Frobenius norm of C [1/s].
    pub(crate) deformation_rate: f64,
    /// Greatest node speed of the last step, along an axis [m/s].
    pub(crate) max_speed: f64,
    /// Greatest speed of any particle along an axis [m/s]. Bounds the next step: unlike the nodes', it is part of a snapshot.
    pub(crate) particle_speed: f64,
    /// Impulse that walls have given in the step under way [N s].
    pub(crate) wall_impulse: [f64; 3],
    /// The parts of walls that probes ask about, and what these have taken in that step [N s].
    parts: WallParts,
    pub(crate) pressed: Vec<[f64; 3]>,
    /// What damping has dissipated and nobody has taken note of [J].
    pub(crate) damped: f64,
    /// Who sleeps.
    pub(crate) watch: Watch,
    /// The nodes that were gathered last. For each node block: its place among those with any of them, or `NONE`; of each of these, which node
    /// of the batch each node is.
    pub(crate) batch_nodes: Vec<u32>,
    pub(crate) batch_block_of: Vec<u32>,
    pub(crate) batch_blocks: Vec<[u32; CELLS]>,
    /// What was found of each block that was near bodies last.
    pub(crate) near: Vec<Near>,
}

impl<T: Scalar> Level<T> {
    pub(crate) fn new(plan: &Plan, index: usize) -> Self {
        let bounds = Bounds::new(plan, index);
        let parts = WallParts::new(plan, index, &bounds);
        Self {
            store: Store::new(&plan.materials, plan.cell_widths[index]),
            grid: Grid::default(),
            bounds,
            drift: 0.0,
            near_open: false,
            strain_dt: 0.0,
            deformation_rate: 0.0,
            max_speed: 0.0,
            particle_speed: 0.0,
            wall_impulse: [0.0; 3],
            pressed: vec![[0.0; 3]; parts.len()],
            parts,
            damped: 0.0,
            watch: Watch::new(plan.slow),
            batch_nodes: Vec::new(),
            batch_block_of: Vec::new(),
            batch_blocks: Vec::new(),
            near: Vec::new(),
        }
    }

    /// Cell width [m].
    pub(crate) fn h(&self) -> f64 {
        self.store.cell_width
    }

    /// Looks whether any block lies at an open side.
    pub(crate) fn find_open(&mut self) {
        let bounds = &self.bounds;
        self.near_open = self.store.blocks.iter().any(|&key| bounds.is_at_open_side(block::of_key(key)));
    }

    fn book(&mut self, impulses: impl IntoIterator<Item = [f64; 3]>) {
        for impulse in impulses {
            for d in 0..3 {
                self.wall_impulse[d] += impulse[d];
            }
        }
    }

    /// Likewise of the parts of walls, for each of them in turn, and again.
    fn book_parts(&mut self, pressed: &[[f64; 3]]) {
        for impulses in pressed.chunks(self.parts.len().max(1)) {
            for (sum, impulse) in self.pressed.iter_mut().zip(impulses) {
                (0..3).for_each(|d| sum[d] += impulse[d]);
            }
        }
    }

    /// Forgets what walls have given in the step under way.
    pub(crate) fn forget_walls(&mut self) {
        self.wall_impulse = [0.0; 3];
        self.pressed.fill([0.0; 3]);
    }

    fn has_mirrors(&self) -> bool {
        self.bounds.mirrors.kind.iter().flatten().any(|&kind| kind != Mirror::Open)
    }

    /// Mass, momentum and stress of every block's particles into the block's tile. Strain is up to date afterwards.
    /// Tiles of blocks asleep are filled when they are not yet what the step needs; a step that carries strain alone needs no tiles. Returns how
    /// much of the time went to each of so many materials.
    pub(crate) fn particles_to_grid(&mut self, isa: Isa, step: &Step, n_materials: usize) -> Result<Shares, Stopped> {
        let gives = !step.carries_strain_alone();
        let (stale, frozen) = if gives { self.stale_tiles(step) } else { (Vec::new(), *step) };
        let walls = gives && self.has_mirrors();
        let mirrors = &self.bounds.mirrors;
        let Grid { occupied, edge_of, mirrored, tiles, carried, images, .. } = &mut self.grid;
        let lists: Vec<_> = self.store.lists.iter_mut().map(List::open).collect();
        // Each block has a tile of its own, and, if it has any at all, parent cells, images, and an entry of what walls and damping take.
        let (tiles, carried, images) = (Parts::of(tiles), Parts::of(carried), Parts::of(images));
        let mut impulses = vec![[0.0; 3]; if walls { occupied.len() } else { 0 }];
        let (parts, n_parts) = (&self.parts, self.parts.len());
        let mut pressed = vec![[0.0; 3]; n_parts * impulses.len()];
        let impulse_of = Parts::of(&mut impulses);
        let pressed_by = Parts::of(&mut pressed);
        let is_damped = lists.iter().any(|list| list.law.damping.is_some());
        let mut damped = vec![0.0; if is_damped { occupied.len() } else { 0 }];
        let damped_in = Parts::of(&mut damped);
        let blocks = self.watch.awake.par_iter().map(|&b| (b as usize, step));
        let (fault, measured) = blocks
            .chain(stale.par_iter().map(|&b| (b as usize, &frozen)))
            .map(|(b, step)| {
                let (tile, origin) = (tiles.one(b), origin(occupied[b]));
                let edge = edge_of.get(b).copied().filter(|&edge| edge != NONE && gives);
                let mut parent_cells = edge.map(|edge| carried.one(edge as usize));
                let mut spent = 0;
                let timed = b % TIMED_BLOCKS == 0;
                let begun = timed.then(Instant::now);
                let mut materials = if timed { vec![0; n_materials] } else { Vec::new() };
                let (mut fault, mut damped) = (None, 0.0);
                if gives {
                    isa.run::<T, _>(Clear(tile));
                }
                if let Some(cells) = &mut parent_cells {
                    cells.fill(Carried::default());
                }
                for (l, list) in lists.iter().enumerate() {
                    if list.runs[b].count == 0 {
                        continue;
                    }
                    let mut message = ErrorBuffer::default();
                    let outcome = isa.run::<T, _>(ParticlesToGrid {
                        particles: list.of_block(b),
                        origin,
                        law: list.law,
                        step,
                        tile,
                        parent_cells: parent_cells.as_deref_mut(),
                        damped: &mut damped,
                        error: message.as_raw(),
                        material_time: timed.then_some(&mut spent),
                    });
                    if let Err(f) = outcome {
                        fault = fault.or(Some((b, Stopped { block: b, list: l, fault: f, message })));
                    }
                    if timed {
                        materials[list.material] += std::mem::take(&mut spent);
                    }
                }
                if is_damped {
                    *damped_in.one(b) = damped;
                }
                if walls && mirrored[b] {
                    let images = images.one(b);
                    let impulse = match n_parts == 0 || step.frozen {
                        true => mirrors.fold(tile, origin, images, &mut ()),
                        false => {
                            let pressed = pressed_by.take(b * n_parts..(b + 1) * n_parts);
                            mirrors.fold(tile, origin, images, &mut parts.witness(pressed))
                        }
                    };
                    if !step.frozen {
                        *impulse_of.one(b) = impulse;
                    }
                }
                (fault, Shares { materials, sampled: begun.map_or(0, |t| t.elapsed().as_nanos() as u64) })
            })
            .reduce(
                || (None, Shares::default()),
                |a, b| {
                    let first = match (a.0, b.0) {
                        (Some(x), Some(y)) => Some(if x.0 <= y.0 { x } else { y }),
                        (x, y) => x.or(y),
                    };
                    (first, a.1.plus(b.1))
                },
            );
        // Strain has been carried along, so a repetition of this pass must not carry it again.
        self.strain_dt = 0.0;
        if let Some((_, stopped)) = fault {
            return Err(stopped);
        }
        self.book(impulses);
        self.book_parts(&pressed);
        // In the order of blocks, whoever worked on them.
        self.damped += damped.iter().sum::<f64>();
        Ok(measured)
    }

    /// Sums tiles into nodes, takes up what the rim of the finer level hands over, hands the own rim's share on, lets walls
    /// that let go decide, and turns momentum into velocity.
    ///
    /// With `keep_shared`, nodes that the finer level's rim hands something to keep their momentum for
    /// [`solve_shared`](Self::solve_shared) and show nothing here.
    pub(crate) fn update_grid(&mut self, isa: Isa, least: f64, finer: Option<&Grid<T>>, keep_shared: bool) {
        let least = T::from_f64(least);
        let separate = !self.bounds.separations.is_empty();
        let grid = &mut self.grid;
        let reflects = grid.links_reflect && finer.is_some();
        let mut impulses = vec![[0.0; 3]; if reflects { grid.keys.len() } else { 0 }];
        let (parts, n_parts) = (&self.parts, self.parts.len());
        let mut pressed = vec![[0.0; 3]; n_parts * impulses.len()];
        let pressed_by = Parts::of(&mut pressed);
        // Each node block is one's own, with its ring, its impulse and its shared nodes.
        let (nodes, handed, shared) =
            (Parts::of(&mut grid.nodes), Parts::of(&mut grid.handed), Parts::of(&mut grid.shared));
        let (impulse_of, carried) = (Parts::of(&mut impulses), grid.carried.as_flattened());
        let speed = self
            .watch
            .nodes
            .par_iter()
            .map(|&g| {
                let g = g as usize;
                let nodes = nodes.one(g);
                isa.run::<T, _>(SumTiles { nodes, tiles: &grid.tiles, around: &grid.tiles_around[g] });
                if let Some(finer) = finer {
                    let links = &grid.links[entries(&grid.link_starts, g)];
                    let impulse = take_up(links, &finer.handed, nodes);
                    if reflects {
                        *impulse_of.one(g) = impulse;
                        if n_parts > 0 {
                            let pressed = pressed_by.take(g * n_parts..(g + 1) * n_parts);
                            for link in links.iter().filter(|link| link.turned != 0) {
                                let given = link.impulse(&finer.handed);
                                let cell = cell_of_node(grid.keys[g], usize::from(link.node));
                                parts.see_image(cell, bits(link.turned), given, pressed);
                            }
                        }
                    }
                }
                if keep_shared {
                    for shared in shared.take(entries(&grid.shared_starts, g)) {
                        let node = &mut nodes[4 * (shared.node as usize % CELLS)..][..4];
                        shared.own.copy_from_slice(node);
                        node.fill(T::default());
                    }
                }
                if let Some(ring) = grid.rings.get(grid.ring_of[g] as usize) {
                    let handed = handed.one(grid.ring_of[g] as usize);
                    isa.run::<T, _>(HandOver { ring, carried, nodes, handed });
                }
                if separate { T::default() } else { isa.run::<T, _>(Velocities { nodes, least }) }
            })
            .reduce(T::default, greater);
        self.max_speed = speed.to_f64();
        self.book(impulses);
        self.book_parts(&pressed);
        if separate {
            self.separate(isa, least);
        }
        self.hold();
    }

    /// Splits what shared nodes keep after a step's P2G, p + dt f, into p + ½ dt f and ½ dt f. A `step` of no length gives p.
    pub(crate) fn halve(&mut self, isa: Isa, step: &Step) -> Result<(), Stopped> {
        let (mirrors, grid) = (&self.bounds.mirrors, &mut self.grid);
        let lists: Vec<_> = self.store.lists.iter_mut().map(List::open).collect();
        // Each block has a tile of its own, whose sums have been taken.
        let tiles = Parts::of(&mut grid.tiles);
        let fault = grid
            .give_to_shared
            .par_iter()
            .map(|&b| {
                let (b, mut fault) = (b as usize, None);
                let (tile, origin) = (tiles.one(b), origin(grid.occupied[b]));
                isa.run::<T, _>(Clear(tile));
                for (l, list) in lists.iter().enumerate() {
                    if list.runs[b].count == 0 {
                        continue;
                    }
                    let mut message = ErrorBuffer::default();
                    let scatter = ParticlesToGrid {
                        particles: list.of_block(b),
                        origin,
                        law: list.law,
                        step,
                        tile,
                        parent_cells: None,
                        damped: &mut 0.0,
                        error: message.as_raw(),
                        material_time: None,
                    };
                    if let Err(f) = isa.run::<T, _>(scatter) {
                        fault = fault.or(Some(Stopped { block: b, list: l, fault: f, message }));
                    }
                }
                if grid.mirrored[b] {
                    // Its impulse has been booked, and its masses noted, when the whole step's was folded.
                    mirrors.fold(tile, origin, &mut Vec::new(), &mut ());
                }
                fault
            })
            .reduce(|| None, |a, b| a.or(b));
        if let Some(stopped) = fault {
            return Err(stopped);
        }
        let Grid { tiles, tiles_around, shared, shared_starts, .. } = grid;
        let shared = Parts::of(shared);
        (0..tiles_around.len()).into_par_iter().filter(|&g| !entries(shared_starts, g).is_empty()).for_each(|g| {
            let mut nodes = [T::default(); NODES];
            isa.run::<T, _>(SumTiles { nodes: &mut nodes, tiles, around: &tiles_around[g] });
            for shared in shared.take(entries(shared_starts, g)) {
                let carried = &nodes[4 * (shared.node as usize % CELLS)..][..4];
                for d in 0..3 {
                    shared.gain[d] = T::from_f64(0.5) * (shared.own[d] - carried[d]);
                    shared.own[d] = carried[d] + shared.gain[d];
                }
            }
        });
        Ok(())
    }

    /// The shared nodes' velocity over one step of the finer level, which hands over `handed`; their own momentum is then what
    /// they have at that velocity, and what the forces of the next such step add.
    pub(crate) fn solve_shared(&mut self, handed: &[[T; NODES]], least: f64) {
        let Grid { nodes, shared, links, keys, .. } = &mut self.grid;
        let nodes = Parts::of(nodes.as_flattened_mut().as_chunks_mut::<4>().0);
        let (links, keys, parts) = (&*links, &*keys, &self.parts);
        let solve = |shared: &mut SharedNode<T>, pressed: &mut [[f64; 3]]| {
            let (mut sum, mut impulse) = (shared.own, [0.0; 3]);
            for link in &links[shared.links.0 as usize..shared.links.1 as usize] {
                let from = &handed.as_flattened()[4 * link.from as usize..][..4];
                for d in 0..3 {
                    if link.flips >> d & 1 == 1 {
                        sum[d] += -from[d];
                        impulse[d] -= 2.0 * from[d].to_f64();
                    } else {
                        sum[d] += from[d];
                    }
                }
                sum[3] += from[3];
                if link.turned != 0 && !parts.is_empty() {
                    let (g, n) = (shared.node as usize / CELLS, shared.node as usize % CELLS);
                    parts.see_image(cell_of_node(keys[g], n), bits(link.turned), link.impulse(handed), pressed);
                }
            }
            // No two shared nodes are one node of the grid.
            let node = nodes.one(shared.node as usize);
            let felt = T::from_f64((sum[3].to_f64() / (least * FULL_SPEED)).min(1.0));
            let mut speed = T::default();
            for d in 0..3 {
                node[d] = if sum[3] > T::default() { sum[d] / sum[3] } else { T::default() };
                shared.own[d] = shared.own[3] * node[d] + shared.gain[d];
                speed = greater(speed, felt * node[d].abs());
            }
            node[3] = sum[3];
            (speed, impulse)
        };
        // Impulses are summed in the order of nodes, whoever finds them.
        let some = |shared: &mut [SharedNode<T>]| {
            let mut pressed = vec![[0.0; 3]; parts.len()];
            let solved = shared.iter_mut().map(|shared| solve(shared, &mut pressed));
            let (speed, impulse) = solved.fold((T::default(), [0.0; 3]), |(most, sum), (speed, impulse)| {
                (greater(most, speed), std::array::from_fn(|d| sum[d] + impulse[d]))
            });
            (speed, impulse, pressed)
        };
        let found: Vec<(T, [f64; 3], Vec<[f64; 3]>)> = shared.par_chunks_mut(SHARED_AT_ONCE).map(some).collect();
        let speed = found.iter().fold(T::default(), |most, (speed, ..)| greater(most, *speed));
        self.max_speed = greater(self.max_speed, speed.to_f64());
        self.book(found.iter().map(|(_, impulse, _)| *impulse));
        found.iter().for_each(|(.., pressed)| self.book_parts(pressed));
    }

    /// The grid update at walls that let go of the ground.
    fn separate(&mut self, isa: Isa, least: T) {
        let nodes = self.grid.nodes.as_flattened_mut().as_chunks_mut::<4>().0;
        let (separations, keys) = (&self.bounds.separations, &self.grid.keys);
        for pairs in &mut self.grid.pairs {
            for pair in pairs {
                let [node, image] = nodes
                    .get_disjoint_mut([pair.node as usize, pair.image as usize])
                    .expect("a node before a wall and its image behind it are two of the grid's");
                pair.image_mass = image[3].to_f64();
                let (presses, impulse) = separations[pair.separation as usize].0.fold(node, image);
                pair.presses = presses;
                for d in 0..3 {
                    self.wall_impulse[d] += impulse[d];
                }
                if !self.parts.is_empty() {
                    let cell = cell_of_node(keys[pair.node as usize / CELLS], pair.node as usize % CELLS);
                    let wall = separations[pair.separation as usize].0.wall();
                    self.parts.witness(&mut self.pressed).see(wall, cell, impulse);
                }
            }
        }
        let of_block = |nodes: &mut [T; NODES]| isa.run::<T, _>(Velocities { nodes, least });
        self.max_speed = self.grid.nodes.par_iter_mut().map(of_block).reduce(T::default, greater).to_f64();
    }

    /// Gives rim nodes the velocity of the coarser level. Returns the impulse that walls gave in doing so, where the parent is
    /// behind a mirror.
    pub(crate) fn prolong(&mut self, isa: Isa, coarser: &Self) {
        let Grid { nodes, handed, rings, rim_reflects, .. } = &mut self.grid;
        let (reflects, parts, n_parts) = (*rim_reflects, &coarser.parts, coarser.parts.len());
        let coarser = &coarser.grid;
        let mut pressed = vec![[0.0; 3]; if reflects { n_parts * rings.len() } else { 0 }];
        // Each ring has a node block of its own.
        let (nodes, pressed_by) = (Parts::of(nodes), Parts::of(&mut pressed));
        let one = |(r, ring): (usize, &Ring)| {
            let (mut parents, mut impulse) = ([T::default(); NODES], [0.0; 3]);
            // Nobody reads the velocity of nodes that weigh nothing.
            if handed[r].as_chunks::<4>().0.iter().all(|node| node[3] == T::default()) {
                return impulse;
            }
            let values = coarser.nodes.as_flattened();
            let pressed: &mut [_] = if reflects { pressed_by.take(r * n_parts..(r + 1) * n_parts) } else { &mut [] };
            for n in (0..CELLS).filter(|&n| ring.parents[n] != NONE) {
                let node = &values[4 * ring.parents[n] as usize..][..4];
                let mut given = [0.0; 3];
                for d in 0..3 {
                    let flipped = ring.mirrored[n] >> d & 1 == 1;
                    parents[4 * n + d] = if flipped { -node[d] } else { node[d] };
                    if flipped {
                        // What particles read is not what they would have read from the node itself.
                        given[d] = -2.0 * node[d].to_f64() * handed[r][4 * n + 3].to_f64();
                        impulse[d] += given[d];
                    }
                }
                if !pressed.is_empty() && given != [0.0; 3] {
                    let (g, n_there) = (ring.parents[n] as usize / CELLS, ring.parents[n] as usize % CELLS);
                    let cell = cell_of_node(coarser.keys[g], n_there);
                    parts.see_image(cell, bits(ring.mirrored[n] >> 3), given, pressed);
                }
            }
            let nodes = nodes.one(ring.block as usize);
            isa.run::<T, _>(TakeBack { slaves: ring.slaves, parents: &parents, nodes });
            impulse
        };
        let impulses: Vec<[f64; 3]> = rings.par_iter().enumerate().map(one).collect();
        if reflects {
            self.book(impulses);
            self.book_parts(&pressed);
        }
    }

    /// Gives images behind walls that let go the velocity of their nodes.
    pub(crate) fn mirror_separated(&mut self) {
        let keys = &self.grid.keys;
        let nodes = self.grid.nodes.as_flattened_mut().as_chunks_mut::<4>().0;
        for pair in self.grid.pairs.iter().rev().flatten() {
            let separation = &self.bounds.separations[pair.separation as usize].0;
            let (image, impulse) = separation.unfold(&nodes[pair.node as usize], pair.presses, pair.image_mass);
            nodes[pair.image as usize] = image;
            for d in 0..3 {
                self.wall_impulse[d] += impulse[d];
            }
            if !self.parts.is_empty() {
                let cell = cell_of_node(keys[pair.node as usize / CELLS], pair.node as usize % CELLS);
                self.parts.witness(&mut self.pressed).see(separation.wall(), cell, impulse);
            }
        }
    }

    /// Finds the greatest speed of nodes as they are now.
    pub(crate) fn find_speed(&mut self, least: f64) {
        let felt = |mass: f64| (mass / (least * FULL_SPEED)).min(1.0);
        let of_node =
            |node: &[T]| felt(node[3].to_f64()) * node[..3].iter().map(|u| u.to_f64().abs()).fold(0.0, greater);
        let of_block = |&g: &u32| self.grid.nodes[g as usize].chunks_exact(4).map(of_node).fold(0.0, greater);
        self.max_speed = self.watch.nodes.par_iter().map(of_block).reduce(|| 0.0, greater);
    }

    /// New velocities and affine matrices, and the move.
    pub(crate) fn grid_to_particles(&mut self, isa: Isa, dt: f64) {
        let step = Step { h: self.h(), dt, strain_dt: 0.0, strain_parts: 1, gravity: [0.0; 3], frozen: false };
        let walls = self.has_mirrors();
        let (grid, mirrors, watch) = (&self.grid, &self.bounds.mirrors, &self.watch);
        let lists: Vec<_> = self.store.lists.iter_mut().map(List::open).collect();
        // Each block has entries of its own.
        let mut impulses = vec![[0.0; 3]; if walls { grid.occupied.len() } else { 0 }];
        let (parts, n_parts) = (&self.parts, self.parts.len());
        let mut pressed = vec![[0.0; 3]; n_parts * impulses.len()];
        let (impulse_of, rest) = (Parts::of(&mut impulses), Parts::of(&mut self.store.rest));
        let pressed_by = Parts::of(&mut pressed);
        let fetch = |tile: &mut [T; TILE], b: usize| {
            isa.run::<T, _>(FillTile { tile, nodes: &grid.nodes, around: &grid.nodes_around[b] });
            let origin = origin(grid.occupied[b]);
            if grid.mirrored[b] {
                *impulse_of.one(b) = match n_parts {
                    0 => mirrors.unfold(tile, origin, &grid.images[b], &mut ()),
                    _ => {
                        let pressed = pressed_by.take(b * n_parts..(b + 1) * n_parts);
                        mirrors.unfold(tile, origin, &grid.images[b], &mut parts.witness(pressed))
                    }
                };
            }
            let rates = lists.iter().filter(|list| list.runs[b].count > 0).fold(Rates::default(), |greatest, list| {
                let particles = list.of_block(b);
                faster(greatest, isa.run::<T, _>(GridToParticles { particles, origin, step: &step, tile }))
            });
            let rest = rest.one(b);
            *rest = watch.count(*rest, rates.speed.to_f64(), dt);
            rates
        };
        // One tile serves all blocks of a task: it stays in cache, where the blocks' own would be fetched and written back.
        let blocks = watch.awake.par_iter().map(|&b| b as usize);
        let greatest = blocks.map_init(|| [T::default(); TILE], fetch).reduce(Rates::default, faster);
        self.book(impulses);
        self.book_parts(&pressed);
        self.take_rates(greatest);
        self.strain_dt = dt;
        self.drift += self.particle_speed * dt / self.h();
    }

    fn take_rates(&mut self, rates: Rates<T>) {
        self.deformation_rate = rates.deformation.to_f64().sqrt();
        self.particle_speed = rates.speed.to_f64();
    }

    /// What depends on the particles as they come in: greatest deformation rate and speed; returns their least mass.
    pub(crate) fn take_stock(&mut self, isa: Isa) -> f64 {
        let mut rates = Rates::default();
        let mut least = f64::INFINITY;
        for list in &mut self.store.lists {
            least = list.places().fold(least, |least, (chunk, lane)| least.min(list.mass_of(chunk, lane)));
            let list = list.open();
            for b in 0..list.runs.len() {
                rates = faster(rates, isa.run::<T, _>(Survey { particles: list.of_block(b) }));
            }
        }
        self.take_rates(rates);
        least
    }
}

impl Shares {
    pub(crate) fn plus(mut self, other: Self) -> Self {
        if self.materials.is_empty() {
            self.materials = other.materials;
        } else {
            for (sum, share) in self.materials.iter_mut().zip(&other.materials) {
                *sum += share;
            }
        }
        self.sampled += other.sampled;
        self
    }
}

/// Adds what the finer level's rim hands to a node block through its links. Returns the impulse that walls gave in doing so [N s].
fn take_up<T: Float>(links: &[Link], handed: &[[T; NODES]], nodes: &mut [T; NODES]) -> [f64; 3] {
    let mut impulse = [0.0; 3];
    for link in links {
        let from = &handed.as_flattened()[4 * link.from as usize..][..4];
        let to = &mut nodes[4 * usize::from(link.node)..][..4];
        for d in 0..3 {
            if link.flips >> d & 1 == 1 {
                to[d] += -from[d];
                impulse[d] -= 2.0 * from[d].to_f64();
            } else {
                to[d] += from[d];
            }
        }
        to[3] += from[3];
    }
    impulse
}

/// The greater of each.
fn faster<T: Float>(a: Rates<T>, b: Rates<T>) -> Rates<T> {
    Rates { deformation: greater(a.deformation, b.deformation), speed: greater(a.speed, b.speed) }
}

/// Zeroes a tile.
struct Clear<'a, T>(&'a mut [T; TILE]);

impl<T: Float> Kernel<T> for Clear<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        self.0.fill(T::default());
    }
}

/// The blocks around one, as a list has them; zeros for those that do not exist.
#[inline(always)]
fn those<'a, T: Float, const N: usize>(list: &'a [[T; N]], around: &[u32; 27]) -> [&'a [T; N]; 27] {
    #[repr(align(64))]
    struct Zeros(#[expect(dead_code, reason = "seen as scalars")] [u64; TILE]);
    static NOWHERE: Zeros = Zeros([0; TILE]);
    const { assert!(size_of::<[T; N]>() <= size_of::<Zeros>() && align_of::<[T; N]>() <= align_of::<Zeros>()) };
    // SAFETY: it is large enough, and zero in both precisions is no bits.
    let nowhere = unsafe { &*(&raw const NOWHERE).cast::<[T; N]>() };
    around.map(|at| list.get(at as usize).unwrap_or(nowhere))
}

/// Sums what the tiles around a node block hold for it.
struct SumTiles<'a, T> {
    nodes: &'a mut [T; NODES],
    tiles: &'a [[T; TILE]],
    around: &'a [u32; 27],
}

impl<T: Float> Kernel<T> for SumTiles<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        block::sum_tiles(self.nodes, those(self.tiles, self.around));
    }
}

/// Hands what a block's rim nodes hold to their parents.
struct HandOver<'a, T> {
    ring: &'a Ring,
    /// Mass and m C of parent cells.
    carried: &'a [Carried<T>],
    nodes: &'a mut [T; NODES],
    handed: &'a mut [T; NODES],
}

impl<T: Float> Kernel<T> for HandOver<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        let Self { ring, nodes, .. } = self;
        // Many rims reach into the air.
        if !(0..CELLS).any(|n| ring.slaves >> n & 1 == 1 && nodes[4 * n + 3] > T::default()) {
            self.handed.fill(T::default());
            return;
        }
        let mut all = [Carried([T::default(); CHUNK]); CELLS];
        for n in 0..CELLS {
            if ring.cells[n] != NONE {
                all[n] = self.carried[ring.cells[n] as usize];
                if ring.mirrored[n] != 0 {
                    let signs = mirrored::<T>(ring.mirrored[n]);
                    all[n].0.iter_mut().zip(signs).for_each(|(value, sign)| *value *= sign);
                }
            }
        }
        ring::spread::<V>(&mut all);
        for n in 0..CELLS {
            let (node, near) = (&mut nodes[4 * n..4 * n + 4], all[n].0[Carried::<T>::MASS]);
            let is_slave = ring.slaves >> n & 1 == 1;
            let part = if is_slave && near > T::default() { node[3] / near } else { T::default() };
            all[n].0.iter_mut().for_each(|value| *value *= part);
            if is_slave {
                all[n].0[..4].copy_from_slice(node);
                node.fill(T::default());
            }
        }
        ring::restrict::<V>(&mut all, self.handed);
    }
}

/// What a mirror makes of an affine momentum, as factors: M becomes S M R, with the signs S of velocities and R, which turns axes round.
#[inline(always)]
fn mirrored<T: Float>(bits: u8) -> [T; CHUNK] {
    let sign = |bit: usize| if bits >> bit & 1 == 1 { -1.0 } else { 1.0 };
    let mut signs = [T::default(); CHUNK];
    signs[Carried::<T>::MASS] = T::from_f64(1.0);
    for j in 0..3 {
        for i in 0..3 {
            signs[Carried::<T>::column(j) + i] = T::from_f64(sign(i) * sign(3 + j));
        }
    }
    signs
}

/// Gives a block's rim nodes the velocity of their parents.
struct TakeBack<'a, T> {
    slaves: u64,
    parents: &'a [T; NODES],
    nodes: &'a mut [T; NODES],
}

impl<T: Float> Kernel<T> for TakeBack<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        ring::prolong(self.slaves, self.parents, self.nodes);
    }
}

/// Momentum to velocity. Returns the greatest velocity component that a particle may feel, or NaN if any is not finite.
struct Velocities<'a, T> {
    nodes: &'a mut [T; NODES],
    least: T,
}

impl<T: Scalar> Kernel<T> for Velocities<'_, T> {
    type Output = T;
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> T {
        // The same in each node's four lanes.
        const MASS_LANE: [f64; CHUNK] = [0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1.];
        // SAFETY: no lanes are more than a chunk's.
        let is_mass = unsafe { V::load(MASS_LANE.map(T::from_f64).as_ptr()) }.gt(V::zero());
        let dust = V::fill(T::from_f64(T::NEGLIGIBLE * 1e-6));
        let per_mass = V::fill(if self.least > T::default() {
            T::from_f64(1.0 / (self.least.to_f64() * FULL_SPEED))
        } else {
            T::default()
        });
        let all = per_mass.gt(V::zero());
        let (mut greatest, mut bad) = (V::zero(), V::zero());
        for part in self.nodes.chunks_exact_mut(V::COUNT) {
            // SAFETY: it has as many scalars as there are lanes, some whole nodes.
            unsafe {
                let node = V::load(part.as_ptr());
                let mass = node.fourth();
                let carries = mass.gt(V::fill(self.least));
                let u = V::select(carries, node / mass, V::zero());
                // Too slow to deform anything in any time step; its products would be denormal.
                let u = V::select(dust.gt(u.abs()), V::zero(), u);
                let speed = V::select(is_mass, V::zero(), u).abs();
                let felt = V::select(all, (mass * per_mass).min(V::fill(T::from_f64(1.0))), V::fill(T::from_f64(1.0)));
                greatest = greatest.max(speed * felt);
                // 0 for finite numbers, NaN for others; the maximum might lose a NaN.
                bad += speed * V::zero();
                V::select(is_mass, node, u).store(part.as_mut_ptr());
            }
        }
        greatest.max_lane() + bad.sum()
    }
}

/// Collects the velocities that a block's particles read.
pub(crate) struct FillTile<'a, T> {
    pub(crate) tile: &'a mut [T; TILE],
    pub(crate) nodes: &'a [[T; NODES]],
    pub(crate) around: &'a [u32; 27],
}

impl<T: Float> Kernel<T> for FillTile<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        block::fill_tile(self.tile, those(self.nodes, self.around));
    }
}
