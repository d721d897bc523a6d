//! Particles as they are exchanged between backends, snapshots and users.

use crate::Vec3;
use crate::archive::Tile;
use crate::levels::CellBox;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// All particles of a simulation.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleState {
    /// One list per (world, level, material), in the plan's order.
    pub lists: Vec<ParticleList>,
    /// Length of the step by which `affine` has moved the particles, but not yet changed their strain [s].
    pub strain_dt: f64,
    /// How the backend holds the particles, if that must be reproduced; `None` asks for a fresh sort.
    pub sort: Option<SortPhase>,
    /// What the backend keeps of each particle besides, such as stress, and would find again to rounding only: for each list, the same number of words
    /// for each particle in its order. In a [`State`](crate::State) alone, since it is worth nothing once a particle has been changed.
    pub kept: Option<Vec<Vec<u32>>>,
    /// Where the levels are, if there are several; `None` places them anew around their agents.
    pub levels: Option<LevelPhase>,
    /// Ground out of reach that agents have changed, by tile.
    pub archive: BTreeMap<[i32; 2], Tile>,
}

/// Where nested levels are, and what is needed to go on splitting and merging their particles.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LevelPhase {
    /// Boxes of each level but the coarsest, in cells of the level.
    pub boxes: Vec<Vec<CellBox>>,
    /// Number of the next new particle.
    pub next_id: u64,
    /// Number of rounds of split and merge so far.
    pub rounds: u64,
    /// The last round in which merging was tried.
    pub tried: u64,
    /// Live tiles, if only the ground within reach is live.
    #[serde(default)]
    pub live: BTreeSet<[i32; 2]>,
}

/// Particles of one material on one level of one world. Structure of arrays, all of length [`len`](Self::len).
///
/// Values are f64 here whatever the run's precision; the widening is exact.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleList {
    /// Independent world, from 0.
    pub world: u32,
    /// Level, 0 is finest.
    pub level: u32,
    /// Index into the plan's materials.
    pub material: u32,
    /// Cell width of the level [m].
    pub cell_width: f64,
    /// Unique number of each particle within its world.
    pub id: Vec<u64>,
    /// Index of the body in the scene that the particle was seeded for.
    pub body: Vec<u16>,
    /// Integer cell on the level.
    pub cell: Vec<[i32; 3]>,
    /// Position inside the cell, in cells, [0, 1).
    pub offset: Vec<Vec3>,
    /// Velocity [m/s].
    pub velocity: Vec<Vec3>,
    /// APIC affine matrix C, row-major [1/s].
    pub affine: Vec<[f64; 9]>,
    /// Mass [kg].
    pub mass: Vec<f64>,
    /// Rest volume [m³].
    pub volume0: Vec<f64>,
    /// Strain planes of the material's kind, one vector a plane [1].
    pub strain: Vec<Vec<f64>>,
    /// History planes, one vector a variable.
    pub state: Vec<Vec<f64>>,
}

impl ParticleList {
    /// A list without particles, with all the planes of a material.
    pub fn empty(level: usize, material: usize, cell_width: f64, strain_planes: usize, states: usize) -> Self {
        Self {
            level: level as u32,
            material: material as u32,
            cell_width,
            strain: vec![Vec::new(); strain_planes],
            state: vec![Vec::new(); states],
            ..Self::default()
        }
    }
    /// Number of particles.
    pub fn len(&self) -> usize {
        self.id.len()
    }
    /// Is it empty?
    pub fn is_empty(&self) -> bool {
        self.id.is_empty()
    }
    /// World position of particle `i` [m]: cells are counted from the world's origin.
    pub fn position(&self, i: usize) -> Vec3 {
        std::array::from_fn(|d| (f64::from(self.cell[i][d]) + self.offset[i][d]) * self.cell_width)
    }
    /// Where particle `i` is and how large.
    pub fn spot(&self, i: usize) -> Spot {
        Spot { position: self.position(i), volume0: self.volume0[i], material: self.material }
    }
    /// Adds the particles of another list of the same level and material.
    pub fn append(&mut self, mut other: Self) {
        self.id.append(&mut other.id);
        self.body.append(&mut other.body);
        self.cell.append(&mut other.cell);
        self.offset.append(&mut other.offset);
        self.velocity.append(&mut other.velocity);
        self.affine.append(&mut other.affine);
        let planes = [&mut self.mass, &mut self.volume0].into_iter().chain(&mut self.strain).chain(&mut self.state);
        let others = [&mut other.mass, &mut other.volume0].into_iter().chain(&mut other.strain).chain(&mut other.state);
        planes.zip(others).for_each(|(plane, other)| plane.append(other));
    }
    /// Keeps the particles for which `wanted` holds, in their order.
    pub fn retain(&mut self, wanted: impl Fn(&Spot) -> bool) {
        let kept: Vec<bool> = (0..self.len()).map(|i| wanted(&self.spot(i))).collect();
        self.keep(&kept);
    }
    /// Keeps the particles that are marked, one mark each, in their order.
    pub fn keep(&mut self, kept: &[bool]) {
        fn keep<T>(plane: &mut Vec<T>, kept: &[bool]) {
            let mut kept = kept.iter();
            plane.retain(|_| kept.next().is_some_and(|k| *k));
        }
        keep(&mut self.id, kept);
        keep(&mut self.body, kept);
        keep(&mut self.cell, kept);
        keep(&mut self.offset, kept);
        keep(&mut self.velocity, kept);
        keep(&mut self.affine, kept);
        let planes = [&mut self.mass, &mut self.volume0].into_iter().chain(&mut self.strain).chain(&mut self.state);
        planes.for_each(|plane| keep(plane, kept));
    }
}

/// Where a particle is and how large: what pictures and height maps ask of all particles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// World position [m].
    pub position: Vec3,
    /// Rest volume [m³].
    pub volume0: f64,
    /// Index into the plan's materials.
    pub material: u32,
}

impl Spot {
    /// Side of the cube that the particle stands for [m].
    pub fn side(&self) -> f64 {
        self.volume0.cbrt()
    }
}

/// How a backend had its particles sorted: enough to rebuild chunks and order, and to sort again at the same step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SortPhase {
    /// Steps since the last sort.
    pub age: u32,
    /// Upper bound of any particle's move since then on each level, in cells.
    pub drift: Vec<f64>,
    /// What the backend has measured of these particles, and uses in its next steps.
    pub measured: Measured,
    /// Blocks in order: (world, level, block x, y, z), and for each list of that world and level the number of
    /// particles in the block.
    pub blocks: Vec<([i32; 5], Vec<u32>)>,
    /// For how many steps each block's particles have been slow; [`u16::MAX`] if it sleeps.
    pub rest: Vec<u16>,
    /// For each level, the step [s] and gravity [m/s²] for which the stored tiles of ground asleep are valid.
    pub kept_for: Vec<Option<(f64, Vec3)>>,
}

/// Measurements that are not repeated at every step. Without them, a resumed run would choose other time steps, or sum
/// in another order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Greatest step that the materials' stiffness allowed when it was measured last [s].
    pub stiffness_bound: f64,
    /// Steps since then.
    pub stiffness_age: u32,
    /// Mass of all particles, summed when they entered the backend and kept since [kg].
    pub mass: f64,
    /// Nodes up to this mass carry nothing that a particle could feel [kg].
    pub least_mass: f64,
}
