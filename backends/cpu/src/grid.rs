//! The sparse grid: blocks around particles, their tiles and nodes, and who borders on whom.

use crate::memory::advise_large_pages;
use barchan_core::Plan;
use barchan_core::scene::Wall;
use barchan_grid::block::{self, NODES, NONE, SIDE, TILE};
use barchan_grid::wall::{Mirror, Mirrors, Separation};
use barchan_lanes::Float;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

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

/// Where the world ends, in cells of one level.
#[derive(Clone, Debug)]
pub(crate) struct Bounds {
    /// First cell inside.
    pub(crate) min: [i32; 3],
    /// One past the last cell inside.
    pub(crate) max: [i32; 3],
    /// Axes whose ends are joined.
    pub(crate) periodic: [bool; 3],
    /// Slip and stick walls.
    pub(crate) mirrors: Mirrors,
    /// Walls that let go, with the sum of the node numbers of each mirrored pair along their axis.
    pub(crate) separations: Vec<(Separation, i32)>,
}

impl Bounds {
    pub(crate) fn new(plan: &Plan) -> Self {
        let walls = &plan.scene.world.walls;
        let ends = [[walls.x_min, walls.x_max], [walls.y_min, walls.y_max], [walls.z_min, walls.z_max]];
        let (min, max) = (plan.cell_min, plan.cell_max);
        let kind = ends.map(|axis| {
            axis.map(|wall| match wall {
                Wall::Slip => Mirror::Slip,
                Wall::Stick => Mirror::Stick,
                Wall::Open | Wall::Periodic | Wall::Separate { .. } => Mirror::Open,
            })
        });
        let mut separations = Vec::new();
        for (axis, wall_ends) in ends.iter().enumerate() {
            for (end, wall) in wall_ends.iter().enumerate() {
                if let Wall::Separate { friction } = *wall {
                    let (inward, face) = if end == 0 { (1.0, min[axis]) } else { (-1.0, max[axis]) };
                    separations.push((Separation { axis, inward, friction }, 2 * face - 1));
                }
            }
        }
        Self {
            min,
            max,
            periodic: ends.map(|axis| axis[0] == Wall::Periodic),
            mirrors: Mirrors { kind, min, max },
            separations,
        }
    }

    /// A block's coordinates brought into the world along periodic axes.
    pub(crate) fn wrap(&self, mut block: [i32; 3]) -> [i32; 3] {
        for d in 0..3 {
            if self.periodic[d] {
                let (first, count) = (self.min[d] / SIDE, (self.max[d] - self.min[d]) / SIDE);
                block[d] = first + (block[d] - first).rem_euclid(count);
            }
        }
        block
    }

    /// Does the block lie wholly behind a mirror, where nothing is ever stored?
    fn is_behind_mirror(&self, block: [i32; 3]) -> bool {
        (0..3).any(|d| {
            let [low, high] = self.mirrors.kind[d];
            (low != Mirror::Open && (block[d] + 1) * SIDE <= self.min[d])
                || (high != Mirror::Open && block[d] * SIDE >= self.max[d])
        })
    }
}

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
            tiles: Vec::new(),
            nodes: Vec::new(),
        }
    }
}

impl<T: Float> Grid<T> {
    /// Cell of the first node of a block's tile.
    pub(crate) fn origin(&self, occupied: usize) -> [i32; 3] {
        block::of_key(self.occupied[occupied]).map(|b| b * SIDE - 2)
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> u64 {
        (self.tiles.capacity() * size_of::<[T; TILE]>()
            + self.nodes.capacity() * size_of::<[T; NODES]>()
            + (self.nodes_around.capacity() + self.tiles_around.capacity()) * 27 * 4
            + (self.occupied.capacity() + self.keys.capacity()) * 8) as u64
    }

    /// Takes up a new set of occupied blocks. Does nothing if it is the old one.
    pub(crate) fn rebuild(&mut self, occupied: Vec<u64>, bounds: &Bounds) {
        if occupied == self.occupied && !self.keys.is_empty() {
            return;
        }
        let around = |key: u64, sign: i32| {
            let at = block::of_key(key);
            std::array::from_fn::<_, 27, _>(|n| {
                let offset = block::offset(n);
                bounds.wrap(std::array::from_fn(|d| at[d] + sign * offset[d]))
            })
        };
        let mut keys: Vec<u64> = occupied
            .iter()
            .flat_map(|&key| around(key, 1))
            .filter(|&b| !bounds.is_behind_mirror(b))
            .filter_map(block::key)
            .collect();
        keys.sort_unstable();
        keys.dedup();
        let index = |keys: &[u64]| -> KeyMap { keys.iter().zip(0..).map(|(&key, i)| (key, i)).collect() };
        let (node_index, tile_index) = (index(&keys), index(&occupied));
        let find = |map: &KeyMap, b: [i32; 3]| block::key(b).and_then(|key| map.get(&key).copied()).unwrap_or(NONE);
        self.nodes_around = occupied.iter().map(|&key| around(key, 1).map(|b| find(&node_index, b))).collect();
        self.tiles_around = keys.iter().map(|&key| around(key, -1).map(|b| find(&tile_index, b))).collect();
        self.mirrored =
            occupied.iter().map(|&key| bounds.mirrors.meet(block::of_key(key).map(|b| b * SIDE - 2))).collect();
        self.images.resize(occupied.len(), Vec::new());
        self.pairs = self.pair_up(&keys, &node_index, bounds);
        (self.occupied, self.keys) = (occupied, keys);
        grow(&mut self.tiles, self.occupied.len(), [T::default(); TILE]);
        grow(&mut self.nodes, self.keys.len(), [T::default(); NODES]);
    }

    /// Finds the mirrored pairs of nodes within two cells of walls that let go.
    fn pair_up(&self, keys: &[u64], node_index: &KeyMap, bounds: &Bounds) -> [Vec<Pair>; 3] {
        let mut pairs = [const { Vec::new() }; 3];
        for (s, (separation, sum)) in bounds.separations.iter().enumerate() {
            let axis = separation.axis;
            for (b, &key) in keys.iter().enumerate() {
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
