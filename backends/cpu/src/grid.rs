//! The sparse grid: blocks around particles, their tiles and nodes, and who borders on whom.

use crate::memory::advise_large_pages;
use barchan_core::Regions;
use barchan_core::levels::{CellBox, Cover};
use barchan_grid::block::{self, CELLS, NODES, NONE, SIDE, TILE};
use barchan_grid::bounds::Bounds;
use barchan_grid::ring::{self, Carried, PARENT_CELLS};
use barchan_lanes::Float;
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::ops::Range;

/// Multiplies keys apart: they are already distinct integers, so a stronger hash would only cost time.
#[derive(Default)]
pub(crate) struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.write_u64(u64::from(b));
        }
    }
    fn write_u64(&mut self, key: u64) {
        let mixed = (self.0 ^ key).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ (mixed >> 29);
    }
}

pub(crate) type KeyMap = HashMap<u64, u32, BuildHasherDefault<KeyHasher>>;

/// A node before a wall that lets go, and its image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    pub(crate) node: u32,
    pub(crate) image: u32,
    pub(crate) separation: u32,
    pub(crate) presses: bool,
    /// Mass that was folded from the image [kg].
    pub(crate) image_mass: f64,
}

/// A block with nodes at the rim of a level's region, and their parents on the next coarser level.
pub(crate) struct Ring {
    /// The node block.
    pub(crate) block: u32,
    /// Its rim nodes, as bits.
    pub(crate) slaves: u64,
    /// Nodes of the coarser grid that hold the 4³ parents; `NONE` where none is needed.
    pub(crate) parents: [u32; CELLS],
    /// Where in `carried` the sums of the 4³ parent cells around it are; `NONE` where there are none, or nobody asks.
    pub(crate) cells: [u32; CELLS],
    /// Which of these, and of the parents, are images behind a mirror: components of velocity that change their sign, and from the
    /// fourth bit axes that are turned round.
    pub(crate) mirrored: [u8; CELLS],
}

/// What a finer level's rim hands to one node.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Link {
    /// Ring of the finer level, and place among its parents: ring * 64 + place.
    pub(crate) from: u32,
    /// Node in the block.
    pub(crate) node: u8,
    /// Components that change their sign, as bits.
    pub(crate) flips: u8,
    /// Axes that are turned round, likewise.
    pub(crate) turned: u8,
}

impl Link {
    /// What walls give as it hands something on [N s].
    pub(crate) fn impulse<T: Float>(&self, handed: &[[T; NODES]]) -> [f64; 3] {
        let from = &handed.as_flattened()[4 * self.from as usize..][..4];
        std::array::from_fn(|d| if self.flips >> d & 1 == 1 { -2.0 * from[d].to_f64() } else { 0.0 })
    }
}

/// A node that a finer level's rim hands something to, while the finer level takes several steps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SharedNode<T> {
    pub(crate) node: u32,
    /// Its links: first, and one past the last.
    pub(crate) links: (u32, u32),
    /// Momentum and mass of its own level's particles.
    pub(crate) own: [T; 4],
    /// Momentum that their forces add in one step of the finer level.
    pub(crate) gain: [T; 3],
}

/// Blocks of one level, their memory and their neighbours.
pub(crate) struct Grid<T> {
    /// Keys of the blocks that hold particles, rising.
    pub(crate) occupied: Vec<u64>,
    /// Keys of the blocks whose nodes those particles reach, rising.
    pub(crate) keys: Vec<u64>,
    /// For each occupied block: the node blocks around it.
    pub(crate) nodes_around: Vec<[u32; 27]>,
    /// For each node block: the occupied blocks whose tiles reach it, by the offset from tile to nodes.
    pub(crate) tiles_around: Vec<[u32; 27]>,
    /// For each occupied block: does a mirror cross its tile?
    pub(crate) mirrored: Vec<bool>,
    /// For each occupied block that a mirror crosses: the masses folded back in this step.
    pub(crate) images: Vec<Vec<T>>,
    /// Pairs at walls that let go, grouped by axis, x first.
    pub(crate) pairs: [Vec<Pair>; 3],
    /// Nodes of each block at the rim of the level's region, as bits, as far as they are known.
    slaves: Vec<Option<u64>>,
    /// Blocks that have any.
    pub(crate) rings: Vec<Ring>,
    /// For each node block: its ring, or `NONE`.
    pub(crate) ring_of: Vec<u32>,
    /// What each ring hands to its parents: momentum and mass.
    pub(crate) handed: Vec<[T; NODES]>,
    /// For each occupied block: its place in `carried`, or `NONE` if no rim wants to know of its parent cells.
    pub(crate) edge_of: Vec<u32>,
    /// Mass and m C of the parent cells of each of those.
    pub(crate) carried: Vec<[Carried<T>; PARENT_CELLS]>,
    /// What the rim of the next finer level hands to each node block: `links[starts[g]..starts[g + 1]]`.
    pub(crate) links: Vec<Link>,
    pub(crate) link_starts: Vec<u32>,
    /// Does any link, or any of the own rim's, change a sign?
    pub(crate) links_reflect: bool,
    pub(crate) rim_reflects: bool,
    /// The nodes that links lead to; those of node block g are `shared[shared_starts[g]..shared_starts[g + 1]]`.
    pub(crate) shared: Vec<SharedNode<T>>,
    pub(crate) shared_starts: Vec<u32>,
    /// Occupied blocks whose tiles hold any of them, and those with any in the blocks around.
    pub(crate) give_to_shared: Vec<u32>,
    pub(crate) near_shared: Vec<u32>,
    /// Nodes that ground out of reach holds: the block, and its nodes as bits.
    pub(crate) held: Vec<(u32, u64)>,
    /// Keys of blocks that hold parents of the next finer level's rim, rising.
    parent_keys: Vec<u64>,
    /// Keys of the coarser blocks that hold parents of the own rim, rising.
    rim_parents: Vec<u64>,
    /// Tiles of the occupied blocks.
    pub(crate) tiles: Vec<[T; TILE]>,
    /// Nodes: momentum and mass, then velocity and mass.
    pub(crate) nodes: Vec<[T; NODES]>,
}

impl<T: Float> Default for Grid<T> {
    fn default() -> Self {
        Self {
            occupied: Vec::new(),
            keys: Vec::new(),
            nodes_around: Vec::new(),
            tiles_around: Vec::new(),
            mirrored: Vec::new(),
            images: Vec::new(),
            pairs: [const { Vec::new() }; 3],
            slaves: Vec::new(),
            rings: Vec::new(),
            ring_of: Vec::new(),
            handed: Vec::new(),
            edge_of: Vec::new(),
            carried: Vec::new(),
            links: Vec::new(),
            link_starts: Vec::new(),
            links_reflect: false,
            rim_reflects: false,
            shared: Vec::new(),
            shared_starts: Vec::new(),
            give_to_shared: Vec::new(),
            near_shared: Vec::new(),
            held: Vec::new(),
            parent_keys: Vec::new(),
            rim_parents: Vec::new(),
            tiles: Vec::new(),
            nodes: Vec::new(),
        }
    }
}

impl<T: Float> Grid<T> {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> u64 {
        (self.tiles.capacity() * size_of::<[T; TILE]>()
            + self.nodes.capacity() * size_of::<[T; NODES]>()
            + (self.nodes_around.capacity() + self.tiles_around.capacity()) * 27 * 4
            + (self.occupied.capacity() + self.keys.capacity()) * 8
            + self.rings.capacity() * size_of::<Ring>()
            + self.links.capacity() * size_of::<Link>()
            + self.handed.capacity() * size_of::<[T; NODES]>()
            + self.carried.capacity() * size_of::<[Carried<T>; PARENT_CELLS]>()) as u64
    }

    /// Takes up a new set of occupied blocks, and of blocks that hold parents of a finer level. Does nothing if they are the
    /// old ones and regions have not `changed`; returns whether it did.
    pub(crate) fn rebuild(&mut self, occupied: &[u64], parent_keys: Vec<u64>, bounds: &Bounds, changed: bool) -> bool {
        if !changed && occupied == self.occupied && parent_keys == self.parent_keys && !self.keys.is_empty() {
            return false;
        }
        let around = |key: u64, sign: i32| {
            let at = block::of_key(key);
            std::array::from_fn::<_, 27, _>(|n| {
                let offset = block::offset(n);
                bounds.wrap(std::array::from_fn(|d| at[d] + sign * offset[d]))
            })
        };
        let reached = |&key: &u64| around(key, 1).into_iter().filter(|&b| !bounds.is_behind_mirror(b));
        let mut keys: Vec<u64> = occupied.par_iter().flat_map_iter(reached).filter_map(block::key).collect();
        keys.extend(&parent_keys);
        keys.par_sort_unstable();
        keys.dedup();
        let (node_index, tile_index) = (index(&keys), index(occupied));
        self.nodes_around = occupied.par_iter().map(|&key| around(key, 1).map(|b| find(&node_index, b))).collect();
        self.tiles_around = keys.par_iter().map(|&key| around(key, -1).map(|b| find(&tile_index, b))).collect();
        self.mirrored = occupied.iter().map(|&key| bounds.mirrors.meet(origin(key))).collect();
        self.images.resize(occupied.len(), Vec::new());
        // As long as regions stay, so do their rims.
        let known =
            |key: &u64| self.keys.binary_search(key).ok().and_then(|g| *self.slaves.get(g)?).filter(|_| !changed);
        self.slaves = keys.par_iter().map(known).collect();
        (self.occupied, self.keys, self.parent_keys) = (occupied.to_vec(), keys, parent_keys);
        grow(&mut self.tiles, self.occupied.len(), [T::default(); TILE]);
        grow(&mut self.nodes, self.keys.len(), [T::default(); NODES]);
        self.ring_of.clear();
        self.ring_of.resize(self.keys.len(), NONE);
        self.rings.clear();
        self.links.clear();
        self.link_starts.clear();
        self.link_starts.resize(self.keys.len() + 1, 0);
        self.shared.clear();
        self.shared_starts.clear();
        self.shared_starts.resize(self.keys.len() + 1, 0);
        self.give_to_shared.clear();
        self.near_shared.clear();
        self.pairs = self.pair_up(&node_index, bounds);
        true
    }

    /// Finds the nodes at the rim of the level's region, and the blocks whose particles touch them, and the
    /// coarser blocks that hold their parents.
    pub(crate) fn find_rim(&mut self, regions: &Regions, level: usize, bounds: &Bounds, coarser: &Bounds) {
        self.rings.clear();
        self.ring_of.fill(NONE);
        self.keys.par_iter().zip(&mut self.slaves).for_each(|(&key, slaves)| {
            slaves.get_or_insert_with(|| slaves_of(regions, level, bounds, block::of_key(key)));
        });
        for (g, slaves) in self.slaves.iter().flatten().copied().enumerate() {
            if slaves != 0 {
                self.ring_of[g] = self.rings.len() as u32;
                self.rings.push(Ring {
                    block: g as u32,
                    slaves,
                    parents: [NONE; CELLS],
                    cells: [NONE; CELLS],
                    mirrored: [0; CELLS],
                });
            }
        }
        grow(&mut self.handed, self.rings.len(), [T::default(); NODES]);

        // The blocks whose parent cells have to do with any of these nodes.
        let (keys, tiles_around) = (&self.keys, &self.tiles_around);
        let ask = |ring: &mut Ring| {
            let at = block::of_key(keys[ring.block as usize]);
            let (first, used) = (ring::first_parent(at), ring::parent_cells(ring.slaves));
            for n in (0..CELLS).filter(|n| used >> n & 1 == 1) {
                let image = place(first, n);
                let (cell, flipped) = coarser.mirrors.reflected(image);
                let away: [i32; 3] = std::array::from_fn(|d| at[d] - (cell[d] >> 1));
                let turned: [bool; 3] = std::array::from_fn(|d| cell[d] != image[d]);
                let bits = flipped.into_iter().chain(turned).enumerate();
                ring.mirrored[n] = bits.fold(0, |bits, (k, set)| bits | u8::from(set) << k);
                let b = tiles_around[ring.block as usize][block::neighbour(away)];
                if b != NONE {
                    let within = cell.iter().fold(0, |within, c| 2 * within + (c & 1) as u32);
                    ring.cells[n] = b * PARENT_CELLS as u32 + within;
                }
            }
        };
        self.rings.par_iter_mut().for_each(ask);
        self.edge_of.clear();
        self.edge_of.resize(self.occupied.len(), NONE);
        let asked = |cell: &&mut u32| **cell != NONE;
        let mut edges = 0;
        for cell in self.rings.iter_mut().flat_map(|ring| &mut ring.cells).filter(asked) {
            let edge = &mut self.edge_of[*cell as usize / PARENT_CELLS];
            if *edge == NONE {
                *edge = edges;
                edges += 1;
            }
            *cell = *edge * PARENT_CELLS as u32 + *cell % PARENT_CELLS as u32;
        }
        grow(&mut self.carried, edges as usize, [Carried::default(); PARENT_CELLS]);
        // Pairs at a wall that lets go are the coarser level's business at the rim.
        for pairs in &mut self.pairs {
            pairs.retain(|pair| {
                let (g, n) = (pair.node as usize / CELLS, pair.node as usize % CELLS);
                self.rings.get(self.ring_of[g] as usize).is_none_or(|ring| ring.slaves >> n & 1 == 0)
            });
        }

        self.rim_parents = self
            .rings
            .par_iter()
            .flat_map_iter(|ring| {
                let first = ring::first_parent(block::of_key(self.keys[ring.block as usize]));
                let used = ring::parents(ring.slaves);
                (0..CELLS).filter(move |n| used >> n & 1 == 1).map(move |n| place(first, n))
            })
            .filter_map(|cell| block::key(coarser.wrap(block::of_cell(coarser.mirrors.reflected(cell).0))))
            .collect();
        self.rim_parents.sort_unstable();
        self.rim_parents.dedup();
    }

    /// Keys of the coarser blocks that hold parents of the rim, rising.
    pub(crate) fn parents_of_rim(&self) -> &[u64] {
        &self.rim_parents
    }

    /// Ties the rim to the nodes of the next coarser grid, and these to the rim.
    pub(crate) fn link(&mut self, coarser: &mut Self, bounds: &Bounds) {
        let node_index = index(&coarser.keys);
        let tie = |(r, ring): (usize, &mut Ring)| {
            let mut links: Vec<(u32, Link)> = Vec::new();
            let first = ring::first_parent(block::of_key(self.keys[ring.block as usize]));
            let used = ring::parents(ring.slaves);
            for n in (0..CELLS).filter(|n| used >> n & 1 == 1) {
                let image = place(first, n);
                let (cell, flipped) = bounds.mirrors.reflected(image);
                let block = find(&node_index, bounds.wrap(block::of_cell(cell)));
                if block == NONE {
                    continue;
                }
                let node = (ring::node_in_block(cell) / 4) as u8;
                let flips = (0..3).fold(0, |bits, d| bits | u8::from(flipped[d]) << d);
                let turned = (0..3).fold(0, |bits, d| bits | u8::from(cell[d] != image[d]) << d);
                ring.parents[n] = block * CELLS as u32 + u32::from(node);
                links.push((block, Link { from: (r * CELLS + n) as u32, node, flips, turned }));
            }
            links
        };
        let links: Vec<_> = self.rings.par_iter_mut().enumerate().flat_map_iter(tie).collect();
        self.rim_reflects = links.iter().any(|(_, link)| link.flips != 0);
        coarser.links_reflect = self.rim_reflects;
        // By node, those of a node in the order of rings.
        let node_of = |(block, link): &(u32, Link)| *block as usize * CELLS + usize::from(link.node);
        let mut starts = vec![0; coarser.keys.len() * CELLS + 1];
        links.iter().for_each(|link| starts[node_of(link) + 1] += 1);
        (1..starts.len()).for_each(|node| starts[node] += starts[node - 1]);
        let mut next = starts.clone();
        coarser.links.resize(links.len(), Link { from: 0, node: 0, flips: 0, turned: 0 });
        for link in &links {
            let at = &mut next[node_of(link)];
            coarser.links[*at as usize] = link.1;
            *at += 1;
        }
        coarser.link_starts = starts.iter().copied().step_by(CELLS).collect();

        coarser.shared.clear();
        coarser.shared_starts.clear();
        for (g, starts) in starts.windows(CELLS + 1).step_by(CELLS).enumerate() {
            coarser.shared_starts.push(coarser.shared.len() as u32);
            if starts[0] == starts[CELLS] {
                continue;
            }
            // What is at the rim itself hands on at once.
            let slaves = coarser.rings.get(coarser.ring_of[g] as usize).map_or(0, |ring| ring.slaves);
            for n in (0..CELLS).filter(|&n| starts[n] < starts[n + 1] && slaves >> n & 1 == 0) {
                let (node, links) = ((g * CELLS + n) as u32, (starts[n], starts[n + 1]));
                coarser.shared.push(SharedNode { node, links, own: [T::default(); 4], gain: [T::default(); 3] });
            }
        }
        coarser.shared_starts.push(coarser.shared.len() as u32);
        let starts = &coarser.shared_starts;
        let mut gives = vec![false; coarser.occupied.len()];
        for shared in &coarser.shared {
            let (g, n) = (shared.node as usize / CELLS, shared.node as usize % CELLS);
            let [x, y, z] = [n / 16, n / 4 % 4, n % 4].map(|n| block::holders(n).map(|(offset, _)| offset));
            for offset in (0..8).map(|k| [x[k & 1], y[k >> 1 & 1], z[k >> 2]]) {
                let b = coarser.tiles_around[g][block::neighbour(offset)];
                if b != NONE {
                    gives[b as usize] = true;
                }
            }
        }
        coarser.give_to_shared = (0..coarser.occupied.len() as u32).filter(|&b| gives[b as usize]).collect();
        let holds = |g: u32| g != NONE && starts[g as usize] < starts[g as usize + 1];
        let near = |around: &[u32; 27]| around.iter().any(|&g| holds(g));
        coarser.near_shared =
            (0..coarser.occupied.len() as u32).filter(|&b| near(&coarser.nodes_around[b as usize])).collect();
    }

    /// Finds the mirrored pairs of nodes within two cells of walls that let go.
    fn pair_up(&self, node_index: &KeyMap, bounds: &Bounds) -> [Vec<Pair>; 3] {
        let mut pairs = [const { Vec::new() }; 3];
        for (s, (separation, sum)) in bounds.separations.iter().enumerate() {
            let axis = separation.axis;
            for (b, &key) in self.keys.iter().enumerate() {
                let at = block::of_key(key);
                for n in 0..block::CELLS {
                    let local = [n / 16, n / 4 % 4, n % 4];
                    let cell: [i32; 3] = std::array::from_fn(|d| at[d] * SIDE + local[d] as i32);
                    let mut image = cell;
                    image[axis] = sum - cell[axis];
                    // Twice the distance to the wall is 1 or 3 for the two nodes that the spline can mirror.
                    let depth = f64::from(cell[axis] - image[axis]) * separation.inward;
                    if !(0.0..4.0).contains(&depth) {
                        continue;
                    }
                    let Some(&other) = block::key(block::of_cell(image)).and_then(|key| node_index.get(&key)) else {
                        continue;
                    };
                    let inner: [i32; 3] = image.map(|c| c & 3);
                    let place = (inner[0] * 16 + inner[1] * 4 + inner[2]) as u32;
                    pairs[axis].push(Pair {
                        node: (b * block::CELLS + n) as u32,
                        image: other * block::CELLS as u32 + place,
                        separation: s as u32,
                        presses: false,
                        image_mass: 0.0,
                    });
                }
            }
        }
        pairs
    }
}

/// Nodes of a block at the rim of a level's region, as bits.
pub(crate) fn slaves_of(regions: &Regions, level: usize, bounds: &Bounds, at: [i32; 3]) -> u64 {
    let first = at.map(|b| b * SIDE);
    let cells = |first: [i32; 3], side: i32| CellBox { min: first, max: first.map(|c| c + side) };
    let support = |cell: [i32; 3], side: i32| cells(cell, side).grown(1);
    let whole = regions.cover(level, support(first, SIDE));
    if whole == Cover::All || regions.touched(level, cells(first, SIDE)) == Cover::None {
        return 0;
    }
    let mut slaves = 0;
    for n in 0..CELLS {
        let local = [n / 16, n / 4 % 4, n % 4];
        let cell: [i32; 3] = std::array::from_fn(|d| first[d] + local[d] as i32);
        let inside = match if whole == Cover::None { whole } else { regions.cover(level, support(cell, 1)) } {
            Cover::All => true,
            Cover::None => false,
            // Several boxes may hold the support together.
            Cover::Part => (0..27).all(|s| {
                let offset = block::offset(s);
                regions.contains(level, std::array::from_fn(|d| cell[d] + offset[d]))
            }),
        };
        let is_touched = || regions.touched(level, cells(cell, 1)) == Cover::All;
        if !inside && is_touched() && !bounds.mirrors.is_behind(cell) {
            slaves |= 1 << n;
        }
    }
    slaves
}

/// Cell of the first node of the tile of the block with a key.
pub(crate) fn origin(key: u64) -> [i32; 3] {
    block::of_key(key).map(|b| b * SIDE - 2)
}

/// The cell of a node, by its block's key and its number there.
pub(crate) fn cell_of_node(key: u64, n: usize) -> [i32; 3] {
    let (at, local) = (block::of_key(key), [n / 16, n / 4 % 4, n % 4]);
    std::array::from_fn(|d| at[d] * SIDE + local[d] as i32)
}

/// The first three bits.
pub(crate) fn bits(of: u8) -> [bool; 3] {
    [0, 1, 2].map(|d| of >> d & 1 == 1)
}

/// Which entries of a list belong to a node block, given where those of each start in it.
pub(crate) fn entries(starts: &[u32], g: usize) -> Range<usize> {
    starts[g] as usize..starts[g + 1] as usize
}

/// Where each key stands.
fn index(keys: &[u64]) -> KeyMap {
    keys.iter().zip(0..).map(|(&key, i)| (key, i)).collect()
}

fn find(map: &KeyMap, b: [i32; 3]) -> u32 {
    block::key(b).and_then(|key| map.get(&key).copied()).unwrap_or(NONE)
}

/// The n-th of the 4³ cells from `first` on.
fn place(first: [i32; 3], n: usize) -> [i32; 3] {
    [first[0] + (n / 16) as i32, first[1] + (n / 4 % 4) as i32, first[2] + (n % 4) as i32]
}

/// Makes `memory` hold `count` entries, with some room so that a slowly growing scene does not reallocate at every sort.
fn grow<W: Copy>(memory: &mut Vec<W>, count: usize, value: W) {
    if count > memory.capacity() {
        let room = count + count / 8;
        memory.clear();
        memory.reserve_exact(room);
        advise_large_pages(memory);
    }
    memory.resize(count, value);
}
