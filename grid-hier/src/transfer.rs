//! The two transfers, one block at a time: particles to grid with the material update inside, and grid to particles.
//!
//! MLS-MPM with APIC: p_i = sum_p w_ip [ m (v + dt g) + (m C - dt V0 (4/h²) tau) (x_i - x_p) ], m_i = sum_p w_ip m, and back
//! v = sum_i w_ip u_i, C = (4/h²) sum_i w_ip u_i (x_i - x_p)ᵀ, x += dt v.
//!
//! Particles are processed in batches. Everything that belongs to one particle alone (weights, strain, stress, affine
//! momentum) is computed with particles in lanes and then transposed. Particles are sorted by cell, so consecutive ones
//! mostly touch the same 27 nodes. For each run of such particles these nodes are kept in nine registers, each a row of
//! three nodes along z times (p_x, p_y, p_z, m). Where a register does not hold a row, the run is processed once for
//! each part of it (see [`Row`]).
//!
//! # Source
//! Hu et al. 2018 (MLS-MPM), eq. 16; Jiang et al. 2015 (APIC). Gravity is scattered with the momentum, so that mirror walls
//! reflect it too.
#![expect(non_snake_case, reason = "symbols follow Hu et al. 2018")]

pub mod adjoint;
mod g2p;
mod p2g;

use crate::block::TILE_SIDE;
use crate::particles::Particles;
use barchan_abi as abi;
use barchan_abi::batch::Number;
use barchan_core::stiffness::Damping;
use barchan_lanes::{CHUNK, Float, Lanes, Real, prefetch, tabulate};
use core::marker::PhantomData;
use core::ops::Range;
pub use g2p::{GridToParticles, Rates, Survey};
pub use p2g::ParticlesToGrid;

/// Particles processed at a time, in one call of a material.
pub const BATCH: usize = 64;
/// Most history variables that a material may have.
pub const MAX_STATE: usize = 16;

const X: usize = TILE_SIDE * TILE_SIDE * 4;
const Y: usize = TILE_SIDE * 4;
/// Scalars in the longest row that a register holds: three nodes, and room for a fourth.
const ROW: usize = 16;
/// Which of the three z-nodes a lane of a row belongs to, as a factor.
const NODE_OF_LANE: [f64; ROW] = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 0., 0., 0., 0.];

/// A scalar that materials can be called with.
pub trait Scalar: Float + Number {
    /// Strains below this mean nothing next to 1. They are set to zero, since their products would be denormal numbers, which
    /// take some processors a hundred times as long: a bed at rest would halve the speed.
    const NEGLIGIBLE: f64;
}

impl Scalar for f32 {
    const NEGLIGIBLE: f64 = 1e-12;
}

impl Scalar for f64 {
    const NEGLIGIBLE: f64 = 1e-100;
}

/// A material with its parameters, ready to be called.
#[derive(Clone, Debug)]
pub struct Law<T> {
    /// Its table.
    pub table: abi::BarchanMaterial,
    /// Parameters in the table's order.
    pub params: Vec<T>,
    /// Damping, if the scene asks for any.
    pub damping: Option<Damping>,
}

impl<T> Law<T> {
    /// Planes of strain.
    #[inline(always)]
    pub fn strain_planes(&self) -> usize {
        if self.table.strain_kind == abi::BARCHAN_STRAIN_DEF_GRAD { 9 } else { 6 }
    }
}

/// Why a transfer stopped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The material returned a status; `error` holds its text.
    Material {
        /// Its status.
        status: abi::BarchanStatus,
        /// Chunk of the first particle of the batch, as all chunks here counted from the block's first.
        chunk: usize,
    },
    /// A particle's momentum is NaN or infinite.
    NonFinite {
        /// Its chunk.
        chunk: usize,
        /// Its lane.
        lane: usize,
    },
    /// What the material gives for a particle is NaN or infinite.
    Unsound {
        /// Its chunk.
        chunk: usize,
        /// Its lane.
        lane: usize,
    },
    /// A particle is further from its block than the halo reaches.
    Strayed {
        /// Its chunk.
        chunk: usize,
    },
}

/// What is common to all blocks of a step.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Cell width [m].
    pub h: f64,
    /// Time step [s].
    pub dt: f64,
    /// Length of the step by which C has moved the particles, but not yet changed their strain [s].
    pub strain_dt: f64,
    /// Number of parts in which that strain is applied, so that each deforms by less than half.
    pub strain_parts: u32,
    /// Gravity [m/s²].
    pub gravity: [f64; 3],
    /// Whether ground stays as it is. If so, strain and history are read but not written.
    pub frozen: bool,
}

impl Step {
    /// Does it bring strain up to date, and no more? Then nodes are given nothing.
    #[must_use]
    pub fn carries_strain_alone(&self) -> bool {
        self.dt == 0.0 && self.strain_dt != 0.0
    }
}

/// Each particle's four values of `N` quantities, side by side so that one load repeats them over a row. Values of a quantity
/// start for each particle at [`Batches::QUAD`].
///
/// As many particles as there are lanes, then the next ones: four registers, the k-th with particles k, 4 + k, ... of them. So planes
/// come here by transposing within groups of four lanes only, which is half the work of transposing all.
#[repr(C, align(64))]
struct Quads<T, const N: usize>([[T; 4 * BATCH]; N]);

/// How a batch lies in the registers of `V`.
struct Batches<V>(PhantomData<V>);

impl<V: Lanes> Batches<V> {
    /// Where each particle's values start in [`Quads`]: a table, because to look it up is less work than to compute it.
    const QUAD: [usize; BATCH] = {
        let mut table = [0; BATCH];
        let mut p = 0;
        while p < BATCH {
            table[p] = p / V::COUNT * 4 * V::COUNT + p % 4 * V::COUNT + p % V::COUNT / 4 * 4;
            p += 1;
        }
        table
    };

    /// As many particles of a batch at a time as there are lanes: where they start in the batch, their chunk and their first lane.
    #[inline(always)]
    fn parts(first: usize, count: usize) -> impl Iterator<Item = (usize, usize, usize)> {
        (0..count).step_by(V::COUNT).map(move |at| (at, first + at / CHUNK, at % CHUNK))
    }

    /// Writes one quantity of [`Quads`], of the particles from `at` on, from its four planes.
    ///
    /// # Safety
    /// `quads` must be valid for writing.
    #[inline(always)]
    unsafe fn write_quads(quads: *mut [V::Scalar; 4 * BATCH], at: usize, mut planes: [V; 4]) {
        V::transpose4(&mut planes);
        for (k, plane) in planes.iter().enumerate() {
            // SAFETY: the caller vouches for the quads.
            unsafe { plane.store(quads.cast::<V::Scalar>().add(4 * at + k * V::COUNT)) };
        }
    }
}

/// Runs of neighbours with the same node.
struct Runs<'a> {
    nodes: &'a [u32],
    from: usize,
}

impl Iterator for Runs<'_> {
    type Item = Range<usize>;
    #[inline(always)]
    fn next(&mut self) -> Option<Range<usize>> {
        let from = self.from;
        let node = *self.nodes.get(from)?;
        let mut to = from + 1;
        while to < self.nodes.len() && self.nodes[to] == node {
            to += 1;
        }
        self.from = to;
        Some(from..to)
    }
}

/// Asks for what stands in for particle `p` of a batch in the next one, which may lie behind the last: far enough ahead for memory to
/// answer, and a little at a time, between the sums of two particles. A whole chunk at once is more than the memory takes, and the core
/// would wait for it. The batch at work starts at `start` and has so many planes.
#[inline(always)]
fn ahead<W>(start: *const W, planes: usize, p: usize) {
    // Each particle stands for as many bytes as it has, wherever they are: a line of 64 or two.
    let at = start.wrapping_add((BATCH + p) * planes).cast::<u8>();
    for byte in (0..size_of::<[W; CHUNK]>()).step_by(64) {
        prefetch(at.wrapping_add(byte));
    }
}

/// Row and column of each plane of a symmetric tensor.
pub const ENTRIES: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];

/// b* = (I + G) b (I + G)ᵀ for symmetric b (xx yy zz xy xz yz) and G = dt C row by row.
#[inline(always)]
fn push_forward<V: Real>(G: &[V; 9], b: &[V; 6]) -> [V; 6] {
    let full = [b[0], b[3], b[4], b[3], b[1], b[5], b[4], b[5], b[2]];
    // Half = (I + G) b.
    let half: [V; 9] = tabulate!(9, |e| {
        let (i, j) = (e / 3, e % 3);
        G[3 * i].mul_add(full[j], G[3 * i + 1].mul_add(full[3 + j], G[3 * i + 2].mul_add(full[6 + j], full[e])))
    });
    tabulate!(6, |e| {
        let (i, j) = ENTRIES[e];
        half[3 * i].mul_add(
            G[3 * j],
            half[3 * i + 1].mul_add(G[3 * j + 1], half[3 * i + 2].mul_add(G[3 * j + 2], half[3 * i + j])),
        )
    })
}

/// Strain (F row by row, or b_e) after a motion by I + G, before the material's update.
#[inline(always)]
pub fn deformed<R: Real>(G: &[R; 9], strain: &[R]) -> [R; 9] {
    let mut trial = [R::zero(); 9];
    if let Some(F) = strain.first_chunk::<9>() {
        for (e, trial) in trial.iter_mut().enumerate() {
            let (i, j) = (e / 3 * 3, e % 3);
            *trial = G[i + 2].mul_add(F[6 + j], G[i + 1].mul_add(F[3 + j], G[i].mul_add(F[j], F[e])));
        }
    } else if let Some(b) = strain.first_chunk::<6>() {
        trial[..6].copy_from_slice(&push_forward(G, b));
    }
    trial
}

/// Start in the tile of the first node of as many particles as there are lanes. Returns whether any of them lies outside.
#[inline(always)]
unsafe fn first_nodes<V: Lanes>(
    s: &Particles<'_, V::Scalar>,
    chunk: usize,
    lane: usize,
    origin: [i32; 3],
    nodes: *mut u32,
) -> bool {
    // The first node is one before the particle's cell.
    let first = [origin[0] + 1, origin[1] + 1, origin[2] + 1];
    let most = TILE_SIDE as u32 - 3;
    // SAFETY: the caller vouches for the chunk and the room for nodes.
    unsafe {
        let cell = [s.cell(chunk, 0).add(lane), s.cell(chunk, 1).add(lane), s.cell(chunk, 2).add(lane)];
        V::places(cell.map(<*mut i32>::cast_const), first, [X as i32, Y as i32, 4], most, nodes)
    }
}
