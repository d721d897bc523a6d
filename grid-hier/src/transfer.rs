//! The two transfers, one block at a time: particles to grid with the material update inside, and grid to particles.
//!
//! MLS-MPM with APIC: p_i = sum_p w_ip [ m (v + dt g) + (m C - dt V0 (4/h²) tau) (x_i - x_p) ], m_i = sum_p w_ip m, and back
//! v = sum_i w_ip u_i, C = (4/h²) sum_i w_ip u_i (x_i - x_p)ᵀ, x += dt v.
//!
//! Particles are sorted by cell, so consecutive ones mostly touch the same 27 nodes. Those are kept in nine vectors, each a row
//! of three nodes along z times (p_x, p_y, p_z, m), and written when the cell changes. Everything that is per particle alone
//! (weights, strain, stress, affine momentum) is computed with particles in lanes and then transposed.
//!
//! # Source
//! Hu et al. 2018 (MLS-MPM), eq. 16; Jiang et al. 2015 (APIC). Gravity is scattered with the momentum, so that mirror walls
//! reflect it too.
#![expect(non_snake_case, reason = "symbols follow Hu et al. 2018")]

use crate::block::{TILE, TILE_SIDE};
use crate::particles::{MASS, MOTION, Particles, Run, STRAIN, VOLUME};
use crate::ring::{Carried, PARENT_CELLS};
use crate::spline::{first_distance, weights};
use barchan_abi as abi;
use barchan_lanes::{Float, Kernel, LANES, Lanes, Mask, Real, prefetch, tabulate};
use core::mem::MaybeUninit;
use std::time::Instant;

/// Particles handed to a material at a time.
pub const BATCH: usize = 64;
/// Most history variables that a material may have.
pub const MAX_STATE: usize = 16;

const X: usize = TILE_SIDE * TILE_SIDE * 4;
const Y: usize = TILE_SIDE * 4;
/// Which of the three z-nodes a lane of a row belongs to, as a factor.
const NODE_OF_LANE: [f64; LANES] = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 0., 0., 0., 0.];

/// A scalar that materials can be called with.
pub trait Scalar: Float {
    /// Strains below this mean nothing next to 1. They are set to zero, since their products would be denormal numbers, which
    /// take some processors a hundred times as long: a bed at rest would halve the speed.
    const NEGLIGIBLE: f64;
    /// The material's update in this precision, if it has one.
    ///
    /// # Safety
    /// The pointers of `batch` must be as the ABI asks.
    unsafe fn update(
        table: &abi::BarchanMaterial,
        batch: &Batch<Self>,
        error: *mut abi::BarchanError,
    ) -> abi::BarchanStatus;
}

/// A batch of particles as the ABI sees it, in either precision.
#[derive(Clone, Copy, Debug)]
pub struct Batch<T> {
    /// Particles.
    pub n: usize,
    /// Distance between planes.
    pub stride: usize,
    /// Step over which the velocity gradient acted [s].
    pub dt: T,
    /// Parameters.
    pub params: *const T,
    /// Trial strain.
    pub strain_trial: *const T,
    /// Velocity gradient, or null.
    pub vel_grad: *const T,
    /// History before.
    pub state_in: *const T,
    /// Strain after.
    pub strain: *mut T,
    /// Kirchhoff stress [Pa].
    pub kirchhoff: *mut T,
    /// History after.
    pub state_out: *mut T,
}

macro_rules! scalar {
    ($t:ident, $negligible:literal, $batch:ident, $slot:ident $(, $reserved:ident)?) => {
        impl Scalar for $t {
            const NEGLIGIBLE: f64 = $negligible;
            #[inline]
            unsafe fn update(
                table: &abi::BarchanMaterial,
                b: &Batch<$t>,
                error: *mut abi::BarchanError,
            ) -> abi::BarchanStatus {
                let raw = abi::$batch {
                    struct_size: size_of::<abi::$batch>(),
                    n: b.n,
                    stride: b.stride,
                    dt: b.dt,
                    $($reserved: 0,)?
                    params: b.params,
                    strain_trial: b.strain_trial,
                    vel_grad: b.vel_grad,
                    state_in: b.state_in,
                    strain: b.strain,
                    kirchhoff: b.kirchhoff,
                    state_out: b.state_out,
                };
                match table.$slot {
                    // SAFETY: the caller vouches for the pointers.
                    Some(update) => unsafe { update(&raw, error) },
                    None => abi::BARCHAN_E_OTHER,
                }
            }
        }
    };
}
scalar!(f32, 1e-12, BarchanBatchF32, update_f32, reserved);
scalar!(f64, 1e-100, BarchanBatchF64, update_f64);

/// A material with its parameters, ready to be called.
#[derive(Clone, Debug)]
pub struct Law<T> {
    /// Its table.
    pub table: abi::BarchanMaterial,
    /// Parameters in the table's order.
    pub params: Vec<T>,
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
        /// Chunk of the first particle of the batch.
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

/// What all blocks of a step share.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Cell width [m].
    pub h: f64,
    /// Time step [s].
    pub dt: f64,
    /// Step over which C has carried the particles but not yet their strain [s].
    pub strain_dt: f64,
    /// In how many parts that strain is applied, so that each deforms by less than half.
    pub strain_parts: u32,
    /// Gravity [m/s²].
    pub gravity: [f64; 3],
    /// Does ground stay as it is? Strain and history are then read but not written.
    pub frozen: bool,
}

/// Particles to grid for one run of chunks: strain, stress, then mass and momentum into the tile.
pub struct ParticlesToGrid<'a, T: Scalar> {
    /// The list.
    pub particles: Particles<T>,
    /// Its chunks in the block.
    pub run: Run,
    /// Cell of the tile's first node.
    pub origin: [i32; 3],
    /// The list's material.
    pub law: &'a Law<T>,
    /// The step.
    pub step: &'a Step,
    /// Where mass and momentum are added.
    pub tile: &'a mut [T; TILE],
    /// Where mass and m C [kg m/s a cell] of each parent cell are added, if the rim of a level wants them (see [`crate::ring`]).
    /// What has left the block counts where it left.
    pub parent_cells: Option<&'a mut [Carried<T>; PARENT_CELLS]>,
    /// Where the material writes its message.
    pub error: *mut abi::BarchanError,
    /// Counts nanoseconds spent in the material, if wanted.
    pub material_time: Option<&'a mut u64>,
}

/// Planes that a material reads and writes, in L1.
#[repr(C, align(64))]
struct Scratch<T> {
    trial: [[T; BATCH]; 9],
    vel_grad: [[T; BATCH]; 9],
    strain: [[T; BATCH]; 9],
    kirchhoff: [[T; BATCH]; 6],
    state_in: [[T; BATCH]; MAX_STATE],
    state_out: [[T; BATCH]; MAX_STATE],
}

/// One plane for each of `N` quantities of a chunk's particles.
#[repr(C, align(64))]
pub(crate) struct Planes<T, const N: usize>(pub(crate) [[T; LANES]; N]);

/// Each particle's four values of `N` quantities, side by side so that one load repeats them over a row. Values of a quantity
/// lie `4 * LANES` behind those of the one before, and start for each particle at [`QUAD`].
///
/// Four lines a quantity, particle p = 4 g + k at group g of line k: planes come here by transposing within groups of four
/// lanes only, which is half the work of transposing 16 x 16.
#[repr(C, align(64))]
pub(crate) struct Quads<T, const N: usize>(pub(crate) [[[T; LANES]; 4]; N]);

/// Where each particle's values start in [`Quads`]: a table, because to look it up is less work than to compute it.
pub(crate) const QUAD: [usize; LANES] = {
    let mut table = [0; LANES];
    let mut p = 0;
    while p < LANES {
        table[p] = p % 4 * LANES + p / 4 * 4;
        p += 1;
    }
    table
};

/// Writes one quantity of [`Quads`] from its four planes.
///
/// # Safety
/// `lines` must be valid for writing.
#[inline(always)]
pub(crate) unsafe fn write_quads<V: Lanes>(lines: *mut [[V::Scalar; LANES]; 4], mut planes: [V; 4]) {
    V::transpose4(&mut planes);
    for (k, plane) in planes.iter().enumerate() {
        // SAFETY: the caller vouches for the lines.
        unsafe { plane.store((&raw mut (*lines)[k]).cast()) };
    }
}

/// The nine products of weights along x and y.
#[inline(always)]
pub(crate) fn products<'a, V: Lanes>(
    to: &'a mut MaybeUninit<Planes<V::Scalar, 9>>,
    w: &[[V; 3]; 3],
) -> &'a Planes<V::Scalar, 9> {
    for i in 0..3 {
        for j in 0..3 {
            // SAFETY: a plane holds 16 scalars.
            unsafe { (w[0][i] * w[1][j]).store((&raw mut (*to.as_mut_ptr()).0[3 * i + j]).cast()) };
        }
    }
    // SAFETY: all nine planes are written.
    unsafe { to.assume_init_ref() }
}

impl<T: Scalar> Kernel<T> for ParticlesToGrid<'_, T> {
    type Output = Result<(), Fault>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Result<(), Fault> {
        if self.parent_cells.is_some() { self.sum::<V, true>() } else { self.sum::<V, false>() }
    }
}

impl<T: Scalar> ParticlesToGrid<'_, T> {
    /// The whole transfer; `EDGE`: with the affine momentum for a rim.
    #[inline(always)]
    fn sum<V: Lanes<Scalar = T>, const EDGE: bool>(mut self) -> Result<(), Fault> {
        let mut scratch = MaybeUninit::<Scratch<T>>::uninit();
        let scratch = scratch.as_mut_ptr();
        let chunks = self.run.chunks();
        // A copy, so that the compiler knows it constant.
        let step = *self.step;
        let mut row_sums = RowSums::<V>::new(self.tile.as_mut_ptr());
        let mut edge_sums = self.parent_cells.take().map(EdgeSums::<V>::new);
        // Where nothing has moved and no force is asked for, matter is left alone.
        let parts = if step.dt == 0.0 && step.strain_dt == 0.0 { 0 } else { step.strain_parts };
        // The sums stay in memory between chunks: rows that live across the call of the material cost a register too many, and
        // then one of them goes through memory for each particle.
        core::hint::black_box(&mut row_sums);
        for first in (0..chunks).step_by(BATCH / LANES) {
            let chunks_here = (chunks - first).min(BATCH / LANES);
            let first = self.run.first + first;
            for part in 0..parts {
                // SAFETY: the run's chunks exist, and the scratch is this call's own.
                unsafe { self.deform::<V>(&step, scratch, first, chunks_here, part) }?;
            }
            for k in 0..chunks_here {
                let chunk = first + k;
                let count = (self.run.count - (chunk - self.run.first) * LANES).min(LANES);
                // SAFETY: as above; `deform` has written the stresses of this chunk, if there are any forces.
                unsafe {
                    self.scatter::<V, EDGE>(
                        &step,
                        (&mut row_sums, edge_sums.as_mut()),
                        scratch,
                        chunk,
                        k * LANES,
                        count,
                    )
                }?;
            }
        }
        if let Some(mut edge_sums) = edge_sums {
            edge_sums.flush(row_sums.current);
        }
        row_sums.flushed();
        Ok(())
    }

    /// Trial strain, material update, strain and history back, for up to [`BATCH`] particles. Stresses stay in the scratch.
    #[inline(always)]
    unsafe fn deform<V: Lanes<Scalar = T>>(
        &mut self,
        step: &Step,
        scratch: *mut Scratch<T>,
        first: usize,
        chunks: usize,
        part: u32,
    ) -> Result<(), Fault> {
        let planes = self.law.strain_planes();
        let n_state = self.law.table.n_state;
        let dt = step.strain_dt / f64::from(step.strain_parts);
        let wants_gradient = self.law.table.capabilities & abi::BARCHAN_CAP_VEL_GRAD != 0;
        let s = &self.particles;
        // SAFETY: for the whole body, the caller vouches for the chunks; scratch planes are BATCH long and k < BATCH / LANES.
        unsafe {
            for k in 0..chunks {
                let chunk = first + k;
                let at = k * LANES;
                let mut C = [V::zero(); 9];
                for (c, C) in C.iter_mut().enumerate() {
                    *C = V::load(s.motion(chunk, 3 + c));
                    if wants_gradient {
                        C.store(&raw mut (*scratch).vel_grad[c][at]);
                    }
                }
                let C = tabulate!(9, |c| without_dust(C[c] * V::splat(dt)));
                if planes == 9 {
                    let mut F = [V::zero(); 9];
                    for (p, F) in F.iter_mut().enumerate() {
                        *F = V::load(s.rest(chunk, STRAIN + p));
                    }
                    for i in 0..3 {
                        for j in 0..3 {
                            let trial = C[3 * i].mul_add(
                                F[j],
                                C[3 * i + 1].mul_add(F[3 + j], C[3 * i + 2].mul_add(F[6 + j], F[3 * i + j])),
                            );
                            trial.store(&raw mut (*scratch).trial[3 * i + j][at]);
                        }
                    }
                } else {
                    let mut b = [V::zero(); 6];
                    for (p, b) in b.iter_mut().enumerate() {
                        *b = V::load(s.rest(chunk, STRAIN + p));
                    }
                    for (p, trial) in push_forward(&C, &b).into_iter().enumerate() {
                        trial.store(&raw mut (*scratch).trial[p][at]);
                    }
                }
                for q in 0..n_state {
                    V::load(s.rest(chunk, STRAIN + planes + q)).store(&raw mut (*scratch).state_in[q][at]);
                }
            }
            let batch = Batch {
                n: chunks * LANES,
                stride: BATCH,
                dt: T::from_f64(dt),
                params: self.law.params.as_ptr(),
                strain_trial: (&raw const (*scratch).trial).cast(),
                vel_grad: if wants_gradient { (&raw const (*scratch).vel_grad).cast() } else { core::ptr::null() },
                state_in: if n_state > 0 { (&raw const (*scratch).state_in).cast() } else { core::ptr::null() },
                strain: (&raw mut (*scratch).strain).cast(),
                kirchhoff: (&raw mut (*scratch).kirchhoff).cast(),
                state_out: if n_state > 0 { (&raw mut (*scratch).state_out).cast() } else { core::ptr::null_mut() },
            };
            let clock = self.material_time.is_some().then(Instant::now);
            let status = T::update(&self.law.table, &batch, self.error);
            if let (Some(clock), Some(time)) = (clock, self.material_time.as_deref_mut()) {
                *time += clock.elapsed().as_nanos() as u64;
            }
            if status != abi::BARCHAN_OK {
                // At the first part nothing of this batch has been written back: its strain is what it was.
                debug_assert!(part < step.strain_parts);
                return Err(Fault::Material { status, chunk: first });
            }
            for k in 0..chunks {
                let at = k * LANES;
                // Nothing of a chunk is written back that is not a number, nor felt by a node.
                let mut sum = V::zero();
                for p in 0..planes {
                    sum += V::load(&raw const (*scratch).strain[p][at]);
                }
                for c in 0..6 {
                    sum += V::load(&raw const (*scratch).kirchhoff[c][at]);
                }
                for q in 0..n_state {
                    sum += V::load(&raw const (*scratch).state_out[q][at]);
                }
                let finite = sum.is_finite();
                if !finite.all() {
                    return Err(Fault::Unsound { chunk: first + k, lane: (!finite.bits()).trailing_zeros() as usize });
                }
            }
            for k in 0..if step.frozen { 0 } else { chunks } {
                let at = k * LANES;
                for p in 0..planes {
                    let strain = V::load(&raw const (*scratch).strain[p][at]);
                    // Of b_e and F, what lies off the diagonal.
                    let off = if planes == 6 { p >= 3 } else { p % 4 != 0 };
                    let strain = if off { without_dust(strain) } else { strain };
                    strain.store(s.rest(first + k, STRAIN + p));
                }
                for q in 0..n_state {
                    V::load(&raw const (*scratch).state_out[q][at]).store(s.rest(first + k, STRAIN + planes + q));
                }
            }
        }
        Ok(())
    }

    /// Mass and momentum of one chunk, added to the rows of the cells its particles are in.
    #[inline(always)]
    unsafe fn scatter<V: Lanes<Scalar = T>, const EDGE: bool>(
        &self,
        step: &Step,
        (sums, mut edge): (&mut RowSums<V>, Option<&mut EdgeSums<'_, V>>),
        scratch: *const Scratch<T>,
        chunk: usize,
        at: usize,
        count: usize,
    ) -> Result<(), Fault> {
        let s = &self.particles;
        let (h, dt, gravity) = (step.h, step.dt, step.gravity);
        // SAFETY: for the whole body, the caller vouches for the chunk and that the scratch holds its stresses.
        unsafe {
            for axis in 0..3 {
                ahead(s.offset, 3, chunk, axis);
                ahead(s.cell, 3, chunk, axis);
            }
            let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d)));
            let w = [weights(f[0]), weights(f[1]), weights(f[2])];
            let d0 = tabulate!(3, |d| first_distance(f[d]));
            let m = V::load(s.rest(chunk, MASS));
            let stress = V::load(s.rest(chunk, VOLUME)) * V::splat(-4.0 * dt / h);
            let mut tau = [V::zero(); 6];
            if dt != 0.0 {
                tau = tabulate!(6, |c| V::load(&raw const (*scratch).kirchhoff[c][at]));
            }
            let tau = [tau[0], tau[3], tau[4], tau[3], tau[1], tau[5], tau[4], tau[5], tau[2]];
            let affine_mass = m * V::splat(h);
            // A: momentum per cell of distance; B: momentum and mass as seen from the first node.
            let A: [V; 9] = tabulate!(9, |c| affine_mass.mul_add(V::load(s.motion(chunk, 3 + c)), stress * tau[c]));
            let mut B = [m; 4];
            for i in 0..3 {
                let v = V::load(s.motion(chunk, i)) + V::splat(dt * gravity[i]);
                let p = A[3 * i].mul_add(d0[0], A[3 * i + 1].mul_add(d0[1], A[3 * i + 2] * d0[2]));
                B[i] = m.mul_add(v, p);
            }
            let finite = (B[0] + B[1] + B[2] + m).is_finite();
            if !finite.all() {
                return Err(Fault::NonFinite { chunk, lane: (!finite.bits()).trailing_zeros() as usize });
            }
            let zero = V::zero();
            let mut quads = MaybeUninit::<Quads<T, 8>>::uninit();
            let lines = &raw mut (*quads.as_mut_ptr()).0;
            if EDGE {
                for j in 0..3 {
                    let column: [V; 3] = tabulate!(3, |i| affine_mass * V::load(s.motion(chunk, 3 + 3 * i + j)));
                    write_quads(&raw mut (*lines)[5 + j], [column[0], column[1], column[2], m]);
                }
            }
            write_quads(&raw mut (*lines)[0], B);
            for j in 0..3 {
                write_quads(&raw mut (*lines)[1 + j], [A[j], A[3 + j], A[6 + j], zero]);
            }
            write_quads(&raw mut (*lines)[4], [w[2][0], w[2][1], w[2][2], zero]);
            let quads = quads.as_ptr().cast::<T>();
            let mut weight = MaybeUninit::uninit();
            let weight = products(&mut weight, &w);

            let (node, strayed) = first_nodes::<V>(s, chunk, self.origin);
            if strayed {
                return Err(Fault::Strayed { chunk });
            }
            let lane_node = V::load(NODE_OF_LANE.map(T::from_f64).as_ptr());
            // A copy, not a reference: the nine rows must stay in registers over the whole loop.
            let mut rows = sums.rows;
            let mut current = sums.current;
            for (p, &node) in node[..count].iter().enumerate() {
                if node as usize != current {
                    if let Some(edge) = edge.as_deref_mut().filter(|_| EDGE) {
                        edge.flush(current);
                    }
                    rows = RowSums { rows, current, ..*sums }.flushed();
                    current = node as usize;
                }
                ahead(s.motion, MOTION, chunk, p);
                ahead(s.rest, s.rest_planes, chunk, p);
                let quad = quads.add(QUAD[p]);
                if let Some(edge) = edge.as_deref_mut().filter(|_| EDGE) {
                    for (j, column) in edge.columns.iter_mut().enumerate() {
                        *column += V::repeat4(quad.add((5 + j) * 4 * LANES));
                    }
                }
                let [b, x, y, z, weights_z] = [0, 1, 2, 3, 4].map(|q| quad.add(q * 4 * LANES));
                let weight_z = V::spread3(weights_z);
                let x_step = V::repeat4(x) * weight_z;
                let y_step = V::repeat4(y) * weight_z;
                let mut row = V::repeat4(z).mul_add(lane_node, V::repeat4(b)) * weight_z;
                for i in 0..3 {
                    let next = row + y_step;
                    let last = next + y_step;
                    rows[3 * i] = V::fill(weight.0[3 * i][p]).mul_add(row, rows[3 * i]);
                    rows[3 * i + 1] = V::fill(weight.0[3 * i + 1][p]).mul_add(next, rows[3 * i + 1]);
                    rows[3 * i + 2] = V::fill(weight.0[3 * i + 2][p]).mul_add(last, rows[3 * i + 2]);
                    row += x_step;
                }
            }
            (sums.rows, sums.current) = (rows, current);
        }
        Ok(())
    }
}

/// Chunks between the one at work and the one asked for: far enough for memory to answer, and for the particles of the next
/// batch to be there when the material wants them.
const AHEAD: usize = BATCH / LANES;

/// Asks for plane `plane`, if there is one, of a chunk further on, which may lie behind the last. One plane at a time, between
/// the sums of two particles: a whole chunk at once is more than the memory takes, and the core would wait for it.
#[inline(always)]
fn ahead<W>(start: *const W, planes: usize, chunk: usize, plane: usize) {
    if plane < planes {
        let at = start.wrapping_add(((chunk + AHEAD) * planes + plane) * LANES).cast::<u8>();
        for byte in (0..size_of::<[W; LANES]>()).step_by(64) {
            prefetch(at.wrapping_add(byte));
        }
    }
}

/// The strain, or zero where it is negligible.
#[inline(always)]
fn without_dust<V: Lanes>(strain: V) -> V
where
    V::Scalar: Scalar,
{
    // NaN is below nothing, and stays to be found.
    V::select(V::fill(V::Scalar::from_f64(V::Scalar::NEGLIGIBLE)).gt(strain.abs()), V::zero(), strain)
}

/// b* = (I + G) b (I + G)ᵀ for symmetric b (xx yy zz xy xz yz) and G = dt C row by row.
#[inline(always)]
fn push_forward<V: Real>(G: &[V; 9], b: &[V; 6]) -> [V; 6] {
    let full = [b[0], b[3], b[4], b[3], b[1], b[5], b[4], b[5], b[2]];
    // Half = (I + G) b.
    let half: [V; 9] = tabulate!(9, |e| {
        let (i, j) = (e / 3, e % 3);
        G[3 * i].mul_add(full[j], G[3 * i + 1].mul_add(full[3 + j], G[3 * i + 2].mul_add(full[6 + j], full[e])))
    });
    const ENTRIES: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
    tabulate!(6, |e| {
        let (i, j) = ENTRIES[e];
        half[3 * i].mul_add(
            G[3 * j],
            half[3 * i + 1].mul_add(G[3 * j + 1], half[3 * i + 2].mul_add(G[3 * j + 2], half[3 * i + j])),
        )
    })
}

/// The nine rows of nodes around the current cell.
struct RowSums<V: Lanes> {
    rows: [V; 9],
    tile: *mut V::Scalar,
    /// Start of the cell's first node in the tile; `usize::MAX` before the first cell.
    current: usize,
}

impl<V: Lanes> RowSums<V> {
    #[inline(always)]
    fn new(tile: *mut V::Scalar) -> Self {
        Self { rows: [V::zero(); 9], tile, current: usize::MAX }
    }
    /// Adds the rows to the tile and gives back empty ones.
    #[inline(always)]
    fn flushed(self) -> [V; 9] {
        if self.current != usize::MAX {
            for i in 0..3 {
                for j in 0..3 {
                    // SAFETY: `first_nodes` has checked that the node's 3 x 3 x 3 neighbours lie in the tile; the fourth
                    // group of lanes is zero and may touch the next row or the room behind the last one.
                    unsafe {
                        let at = self.tile.add(self.current + i * X + j * Y);
                        (V::load(at) + self.rows[3 * i + j]).store(at);
                    }
                }
            }
        }
        [V::zero(); 9]
    }
}

/// What particles of the current cell carry for a rim: the columns of m C with their mass, the same in each group of lanes.
struct EdgeSums<'a, V: Lanes> {
    columns: [V; 3],
    parent_cells: &'a mut [Carried<V::Scalar>; PARENT_CELLS],
}

impl<'a, V: Lanes> EdgeSums<'a, V>
where
    V::Scalar: Scalar,
{
    fn new(parent_cells: &'a mut [Carried<V::Scalar>; PARENT_CELLS]) -> Self {
        Self { columns: [V::zero(); 3], parent_cells }
    }
    /// Adds them to the parent of the cell whose first node starts at `current`, and starts anew.
    #[inline(always)]
    fn flush(&mut self, current: usize) {
        // The lanes of what a cell carries that come from each column: the mass with the first.
        const FROM: [[f64; LANES]; 3] = [
            [0., 0., 0., 1., 1., 1., 1., 0., 0., 0., 0., 0., 0., 0., 0., 0.],
            [0., 0., 0., 0., 0., 0., 0., 0., 1., 1., 1., 0., 0., 0., 0., 0.],
            [0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 1., 1., 1., 0.],
        ];
        if current != usize::MAX {
            // The first node of the block's third cell along an axis is the tile's fourth.
            let node = [current / X, current % X / Y, current % Y / 4];
            let parent = &mut self.parent_cells[node.iter().fold(0, |parent, n| 2 * parent + usize::from(*n >= 3))];
            // SAFETY: a cell carries 16 scalars.
            unsafe {
                let mut sum = V::load(parent.0.as_ptr());
                for j in 0..3 {
                    sum = self.columns[j].mul_add(V::load(FROM[j].map(V::Scalar::from_f64).as_ptr()), sum);
                }
                sum.store(parent.0.as_mut_ptr());
            }
        }
        self.columns = [V::zero(); 3];
    }
}

/// Start in the tile of each particle's first node, and whether any of them lies outside.
#[inline(always)]
pub(crate) unsafe fn first_nodes<V: Lanes>(
    s: &Particles<V::Scalar>,
    chunk: usize,
    origin: [i32; 3],
) -> ([u32; LANES], bool)
where
    V::Scalar: Scalar,
{
    // The first node is one before the particle's cell.
    let first = [origin[0] + 1, origin[1] + 1, origin[2] + 1];
    let most = TILE_SIDE as u32 - 3;
    // SAFETY: the caller vouches for the chunk.
    unsafe {
        let cells = [s.cell(chunk, 0).cast_const(), s.cell(chunk, 1).cast_const(), s.cell(chunk, 2).cast_const()];
        V::places(cells, first, [X as i32, Y as i32, 4], most)
    }
}

/// Grid to particles for one run of chunks: velocity, affine matrix, and the move.
pub struct GridToParticles<'a, T: Scalar> {
    /// The list.
    pub particles: Particles<T>,
    /// Its chunks in the block.
    pub run: Run,
    /// Cell of the tile's first node.
    pub origin: [i32; 3],
    /// The step.
    pub step: &'a Step,
    /// Node velocities.
    pub tile: &'a [T; TILE],
}

/// The greatest rates among particles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rates<T> {
    /// Squared Frobenius norm of C [1/s²].
    pub deformation: T,
    /// Velocity along an axis [m/s].
    pub speed: T,
}

/// Rates of the particles seen so far, in lanes.
struct Greatest<V> {
    deformation: V,
    speed: V,
}

impl<V: Lanes> Greatest<V> {
    #[inline(always)]
    fn new() -> Self {
        Self { deformation: V::zero(), speed: V::zero() }
    }
    /// Takes in one chunk; in one order of operations, so that the same particles always give the same bits.
    #[inline(always)]
    fn see(&mut self, v: &[V; 3], c: &[V; 9]) {
        let mut norm = V::zero();
        for c in c {
            norm = c.mul_add(*c, norm);
        }
        self.deformation = self.deformation.max(norm);
        self.speed = self.speed.max(v[0].abs().max(v[1].abs()).max(v[2].abs()));
    }
    #[inline(always)]
    fn rates(self) -> Rates<V::Scalar> {
        Rates { deformation: self.deformation.max_lane(), speed: self.speed.max_lane() }
    }
}

/// The rates of one run of chunks as they are: those that [`GridToParticles`] gave.
pub struct Survey<T: Scalar> {
    /// The list.
    pub particles: Particles<T>,
    /// Its chunks in the block.
    pub run: Run,
}

impl<T: Scalar> Kernel<T> for Survey<T> {
    type Output = Rates<T>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Rates<T> {
        let mut greatest = Greatest::<V>::new();
        for chunk in self.run.first..self.run.first + self.run.chunks() {
            // SAFETY: the run's chunks exist.
            unsafe {
                let v = tabulate!(3, |d| V::load(self.particles.motion(chunk, d)));
                let c = tabulate!(9, |e| V::load(self.particles.motion(chunk, 3 + e)));
                greatest.see(&v, &c);
            }
        }
        greatest.rates()
    }
}

impl<T: Scalar> Kernel<T> for GridToParticles<'_, T> {
    type Output = Rates<T>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Rates<T> {
        let s = &self.particles;
        let Step { h, dt, .. } = *self.step;
        let mut greatest = Greatest::<V>::new();
        let mut rows = [V::zero(); 9];
        let mut current = usize::MAX;
        for k in 0..self.run.chunks() {
            let chunk = self.run.first + k;
            let count = (self.run.count - k * LANES).min(LANES);
            // SAFETY: for the whole body, the run's chunks exist; nodes were checked by the scatter of this step, and are
            // checked again here because reading outside the tile must be impossible.
            unsafe {
                let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d)));
                let mut quads = MaybeUninit::<Quads<T, 1>>::uninit();
                for axis in 0..3 {
                    ahead(s.offset, 3, chunk, axis);
                    ahead(s.cell, 3, chunk, axis);
                }
                let [z0, z1, z2] = weights(f[2]);
                write_quads(&raw mut (*quads.as_mut_ptr()).0[0], [z0, z1, z2, V::zero()]);
                let quads = quads.as_ptr().cast::<T>();
                let mut weight = MaybeUninit::<Planes<T, 6>>::uninit();
                for d in 0..2 {
                    for (i, w) in weights(f[d]).into_iter().enumerate() {
                        w.store((&raw mut (*weight.as_mut_ptr()).0[3 * d + i]).cast());
                    }
                }
                let weight = weight.assume_init_ref();
                let (node, strayed) = first_nodes::<V>(s, chunk, self.origin);
                assert!(!strayed, "a particle strayed between the transfers of one step");

                // Sums over x and y of w u, and of w u times the node's distance from the middle one along x or y. Nodes along
                // z are still apart.
                let mut sums = MaybeUninit::<Planes<[T; 3], LANES>>::uninit();
                let sums = sums.as_mut_ptr().cast::<T>();
                let sum = |q: usize, p: usize| sums.add((3 * p + q) * LANES);
                for (p, &node) in node[..count].iter().enumerate() {
                    if node as usize != current {
                        current = node as usize;
                        for i in 0..3 {
                            for j in 0..3 {
                                rows[3 * i + j] = V::load(self.tile.as_ptr().add(current + i * X + j * Y));
                            }
                        }
                    }
                    ahead(s.motion, MOTION, chunk, p);
                    let [x0, x1, x2, y0, y1, y2] = tabulate!(6, |i| V::fill(weight.0[i][p]));
                    let mut plain = [V::zero(); 3];
                    let mut by_y = [V::zero(); 3];
                    for i in 0..3 {
                        let first = y0 * rows[3 * i];
                        by_y[i] = y2.mul_add(rows[3 * i + 2], -first);
                        plain[i] = y2.mul_add(rows[3 * i + 2], y1.mul_add(rows[3 * i + 1], first));
                    }
                    let first = x0 * plain[0];
                    let z = V::spread3(quads.add(QUAD[p]));
                    (x2.mul_add(plain[2], x1.mul_add(plain[1], first)) * z).store(sum(0, p));
                    (x2.mul_add(plain[2], -first) * z).store(sum(1, p));
                    (x2.mul_add(by_y[2], x1.mul_add(by_y[1], x0 * by_y[0])) * z).store(sum(2, p));
                }
                for p in count..LANES {
                    for q in 0..3 {
                        V::zero().store(sum(q, p));
                    }
                }
                // Sums over z too, with particles in lanes: velocity, and its moments along x, y and z.
                let mut moments = [[V::zero(); 4]; 4];
                for k in 0..4 {
                    let rows =
                        |q: usize| [sum(q, k), sum(q, 4 + k), sum(q, 8 + k), sum(q, 12 + k)].map(<*mut T>::cast_const);
                    (moments[0][k], moments[3][k]) = V::fold4(rows(0));
                    (moments[1][k], _) = V::fold4(rows(1));
                    (moments[2][k], _) = V::fold4(rows(2));
                }
                for moment in &mut moments {
                    V::transpose4(moment);
                }
                let [v, by_node @ ..] = moments;

                let per_cell = V::splat(4.0 / h);
                let mut c = [V::zero(); 9];
                for i in 0..3 {
                    v[i].store(s.motion(chunk, i));
                    for j in 0..3 {
                        // From the distance of each node from the middle one to that from the particle.
                        c[3 * i + j] = (V::splat(0.5) - f[j]).mul_add(v[i], by_node[j][i]) * per_cell;
                        c[3 * i + j].store(s.motion(chunk, 3 + 3 * i + j));
                    }
                    V::advance(s.offset(chunk, i), s.cell(chunk, i), v[i] * V::splat(dt / h));
                }
                greatest.see(&[v[0], v[1], v[2]], &c);
            }
        }
        greatest.rates()
    }
}
