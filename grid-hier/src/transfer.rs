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
    ($t:ident, $batch:ident, $slot:ident $(, $reserved:ident)?) => {
        impl Scalar for $t {
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
scalar!(f32, BarchanBatchF32, update_f32, reserved);
scalar!(f64, BarchanBatchF64, update_f64);

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

/// 16 particles' rows after transposition: one line a particle.
#[repr(C, align(64))]
pub(crate) struct Rows<T>(pub(crate) [[T; LANES]; LANES]);

impl<T: Scalar> Kernel<T> for ParticlesToGrid<'_, T> {
    type Output = Result<(), Fault>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(mut self) -> Result<(), Fault> {
        let mut scratch = MaybeUninit::<Scratch<T>>::uninit();
        let scratch = scratch.as_mut_ptr();
        let chunks = self.run.chunks();
        let mut row_sums = RowSums::<V>::new(self.tile.as_mut_ptr());
        for first in (0..chunks).step_by(BATCH / LANES) {
            let chunks_here = (chunks - first).min(BATCH / LANES);
            let first = self.run.first + first;
            for part in 0..self.step.strain_parts {
                // SAFETY: the run's chunks exist, and the scratch is this call's own.
                unsafe { self.deform::<V>(scratch, first, chunks_here, part) }?;
            }
            for k in 0..chunks_here {
                let chunk = first + k;
                let count = (self.run.count - (chunk - self.run.first) * LANES).min(LANES);
                // SAFETY: as above; `deform` has written the stresses of this chunk.
                unsafe { self.scatter::<V>(&mut row_sums, scratch, chunk, k * LANES, count) }?;
            }
        }
        row_sums.flushed();
        Ok(())
    }
}

impl<T: Scalar> ParticlesToGrid<'_, T> {
    /// Trial strain, material update, strain and history back, for up to [`BATCH`] particles. Stresses stay in the scratch.
    #[inline(always)]
    unsafe fn deform<V: Lanes<Scalar = T>>(
        &mut self,
        scratch: *mut Scratch<T>,
        first: usize,
        chunks: usize,
        part: u32,
    ) -> Result<(), Fault> {
        let planes = self.law.strain_planes();
        let n_state = self.law.table.n_state;
        let dt = self.step.strain_dt / f64::from(self.step.strain_parts);
        let step = V::splat(dt);
        let wants_gradient = self.law.table.capabilities & abi::BARCHAN_CAP_VEL_GRAD != 0;
        let s = &self.particles;
        // SAFETY: for the whole body, the caller vouches for the chunks; scratch planes are BATCH long and k < BATCH / LANES.
        unsafe {
            for k in 0..chunks {
                let chunk = first + k;
                let at = k * LANES;
                ahead(s, chunk);
                let mut C = [V::zero(); 9];
                for (c, C) in C.iter_mut().enumerate() {
                    *C = V::load(s.motion(chunk, 3 + c));
                    if wants_gradient {
                        C.store(&raw mut (*scratch).vel_grad[c][at]);
                    }
                }
                let C = tabulate!(9, |c| C[c] * step);
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
                debug_assert!(part < self.step.strain_parts);
                return Err(Fault::Material { status, chunk: first });
            }
            for k in 0..chunks {
                let at = k * LANES;
                for p in 0..planes {
                    V::load(&raw const (*scratch).strain[p][at]).store(s.rest(first + k, STRAIN + p));
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
    unsafe fn scatter<V: Lanes<Scalar = T>>(
        &self,
        sums: &mut RowSums<V>,
        scratch: *const Scratch<T>,
        chunk: usize,
        at: usize,
        count: usize,
    ) -> Result<(), Fault> {
        let s = &self.particles;
        let (h, dt, gravity) = (self.step.h, self.step.dt, self.step.gravity);
        // SAFETY: for the whole body, the caller vouches for the chunk and that the scratch holds its stresses.
        unsafe {
            let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d)));
            let w = [weights(f[0]), weights(f[1]), weights(f[2])];
            let d0 = tabulate!(3, |d| first_distance(f[d]));
            let m = V::load(s.rest(chunk, MASS));
            let stress = V::load(s.rest(chunk, VOLUME)) * V::splat(-4.0 * dt / h);
            let tau: [V; 6] = tabulate!(6, |c| V::load(&raw const (*scratch).kirchhoff[c][at]));
            let tau = [tau[0], tau[3], tau[4], tau[3], tau[1], tau[5], tau[4], tau[5], tau[2]];
            let affine_mass = m * V::splat(h);
            // A: momentum per cell of distance; B: momentum and mass as seen from the first node.
            let A: [V; 9] = tabulate!(9, |c| affine_mass.mul_add(V::load(s.motion(chunk, 3 + c)), stress * tau[c]));
            let mut rows = [V::zero(); LANES];
            for i in 0..3 {
                let v = V::load(s.motion(chunk, i)) + V::splat(dt * gravity[i]);
                let p = A[3 * i].mul_add(d0[0], A[3 * i + 1].mul_add(d0[1], A[3 * i + 2] * d0[2]));
                rows[i] = m.mul_add(v, p);
                rows[4 + i] = A[3 * i];
                rows[8 + i] = A[3 * i + 1];
                rows[12 + i] = A[3 * i + 2];
            }
            rows[3] = m;
            let finite = (rows[0] + rows[1] + rows[2] + m).is_finite();
            if !finite.all() {
                return Err(Fault::NonFinite { chunk, lane: (!finite.bits()).trailing_zeros() as usize });
            }
            V::transpose(&mut rows);
            let mut momentum = MaybeUninit::<Rows<T>>::uninit();
            let momentum = store_rows(&mut momentum, &rows);

            let mut rows = [V::zero(); LANES];
            for i in 0..3 {
                for j in 0..3 {
                    rows[3 * i + j] = w[0][i] * w[1][j];
                }
                rows[9 + i] = w[2][i];
            }
            V::transpose(&mut rows);
            let mut weight = MaybeUninit::<Rows<T>>::uninit();
            let weight = store_rows(&mut weight, &rows);

            let (node, strayed) = first_nodes::<V>(s, chunk, self.origin);
            if strayed {
                return Err(Fault::Strayed { chunk });
            }
            spread(sums, momentum, weight, &node[..count]);
        }
        Ok(())
    }
}

/// Adds particles to the rows of nodes of their cells. A line of `momentum` holds what a particle gives to its first node, and
/// by how much that changes from node to node along x, y and z; a line of `weight` the nine products of its weights along x
/// and y, then those along z.
///
/// # Safety
/// `node` holds starts of nodes in the tile, as [`first_nodes`] has found them.
#[inline(always)]
pub(crate) unsafe fn spread<V: Lanes>(
    sums: &mut RowSums<V>,
    momentum: &Rows<V::Scalar>,
    weight: &Rows<V::Scalar>,
    node: &[u32],
) where
    V::Scalar: Scalar,
{
    // SAFETY: lines hold 16 scalars.
    unsafe {
        let lane_node = V::load(NODE_OF_LANE.map(V::Scalar::from_f64).as_ptr());
        // A copy, not a reference: the nine rows must stay in registers over the whole loop.
        let mut rows = sums.rows;
        let mut current = sums.current;
        for (p, &node) in node.iter().enumerate() {
            if node as usize != current {
                rows = RowSums { rows, current, ..*sums }.flushed();
                current = node as usize;
            }
            let (momentum, weight) = (&momentum.0[p], &weight.0[p]);
            let z = V::spread3(&raw const weight[9]);
            let x_step = V::repeat4(&raw const momentum[4]) * z;
            let y_step = V::repeat4(&raw const momentum[8]) * z;
            let z_step = V::repeat4(&raw const momentum[12]);
            let mut row = z_step.mul_add(lane_node, V::repeat4(momentum.as_ptr())) * z;
            for i in 0..3 {
                let next = row + y_step;
                let last = next + y_step;
                rows[3 * i] = V::fill(weight[3 * i]).mul_add(row, rows[3 * i]);
                rows[3 * i + 1] = V::fill(weight[3 * i + 1]).mul_add(next, rows[3 * i + 1]);
                rows[3 * i + 2] = V::fill(weight[3 * i + 2]).mul_add(last, rows[3 * i + 2]);
                row += x_step;
            }
        }
        (sums.rows, sums.current) = (rows, current);
    }
}

/// Chunks between the one at work and the one asked for: far enough for memory to answer.
const AHEAD: usize = 3;

/// Asks for the planes of a chunk further on. The address may lie behind the last chunk.
#[inline(always)]
fn ahead<T: Scalar>(s: &Particles<T>, chunk: usize) {
    let line = size_of::<[T; LANES]>();
    for (start, planes) in [(s.motion, MOTION), (s.rest, s.rest_planes)] {
        let at = start.wrapping_add((chunk + AHEAD) * planes * LANES).cast::<u8>();
        for byte in (0..planes * line).step_by(64) {
            prefetch(at.wrapping_add(byte));
        }
    }
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
pub(crate) struct RowSums<V: Lanes> {
    pub(crate) rows: [V; 9],
    tile: *mut V::Scalar,
    /// Start of the cell's first node in the tile; `usize::MAX` before the first cell.
    current: usize,
}

impl<V: Lanes> RowSums<V> {
    #[inline(always)]
    pub(crate) fn new(tile: *mut V::Scalar) -> Self {
        Self { rows: [V::zero(); 9], tile, current: usize::MAX }
    }
    /// Goes on to the cell whose first node is at `node`.
    #[inline(always)]
    pub(crate) fn go_to(&mut self, node: u32) {
        if node as usize != self.current {
            self.rows = Self { rows: self.rows, ..*self }.flushed();
            self.current = node as usize;
        }
    }
    /// Adds the rows to the tile and gives back empty ones.
    #[inline(always)]
    pub(crate) fn flushed(self) -> [V; 9] {
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

#[inline(always)]
pub(crate) fn store_rows<'a, V: Lanes>(
    to: &'a mut MaybeUninit<Rows<V::Scalar>>,
    rows: &[V; LANES],
) -> &'a Rows<V::Scalar> {
    let lines = to.as_mut_ptr().cast::<V::Scalar>();
    for (i, row) in rows.iter().enumerate() {
        // SAFETY: line i of the 16 x 16 scalars.
        unsafe { row.store(lines.add(i * LANES)) };
    }
    // SAFETY: all 16 lines are written.
    unsafe { to.assume_init_ref() }
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
        let (h, dt) = (self.step.h, self.step.dt);
        // SAFETY: the array holds 16 scalars.
        let lane_node = unsafe { V::load(NODE_OF_LANE.map(T::from_f64).as_ptr()) };
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
                let motion = s.motion.wrapping_add((chunk + AHEAD) * MOTION * LANES);
                for plane in 0..MOTION {
                    prefetch(motion.wrapping_add(plane * LANES));
                }
                let mut lines = [V::zero(); LANES];
                for (d, f) in f.iter().enumerate() {
                    let w = weights(*f);
                    lines[4 * d] = w[0];
                    lines[4 * d + 1] = w[1];
                    lines[4 * d + 2] = w[2];
                }
                V::transpose(&mut lines);
                let mut weight = MaybeUninit::<Rows<T>>::uninit();
                let weight = store_rows(&mut weight, &lines);
                let (node, strayed) = first_nodes::<V>(s, chunk, self.origin);
                assert!(!strayed, "a particle strayed between the transfers of one step");

                let mut sums = MaybeUninit::<Rows<T>>::uninit();
                let line = sums.as_mut_ptr().cast::<T>();
                for (p, &node) in node[..count].iter().enumerate() {
                    if node as usize != current {
                        current = node as usize;
                        for i in 0..3 {
                            for j in 0..3 {
                                rows[3 * i + j] = V::load(self.tile.as_ptr().add(current + i * X + j * Y));
                            }
                        }
                    }
                    let w = &weight.0[p];
                    // Sums over y for each x: of u, and of u times the node's index along y.
                    let (y0, y1, y2, y2_twice) = (V::fill(w[4]), V::fill(w[5]), V::fill(w[6]), V::fill(w[6] + w[6]));
                    let mut plain = [V::zero(); 3];
                    let mut by_y = [V::zero(); 3];
                    for i in 0..3 {
                        let middle = y1 * rows[3 * i + 1];
                        by_y[i] = y2_twice.mul_add(rows[3 * i + 2], middle);
                        plain[i] = y2.mul_add(rows[3 * i + 2], y0.mul_add(rows[3 * i], middle));
                    }
                    let (x0, x1, x2) = (V::fill(w[0]), V::fill(w[1]), V::fill(w[2]));
                    let middle = x1 * plain[1];
                    let z = V::spread3(&raw const w[8]);
                    let u = x2.mul_add(plain[2], x0.mul_add(plain[0], middle)) * z;
                    let u_x = V::fill(w[2] + w[2]).mul_add(plain[2], middle) * z;
                    let u_y = x2.mul_add(by_y[2], x1.mul_add(by_y[1], x0 * by_y[0])) * z;
                    V::fold4(u, u_x, u_y, u * lane_node).store(line.add(p * LANES));
                }
                for p in count..LANES {
                    V::zero().store(line.add(p * LANES));
                }
                for (p, line_p) in lines.iter_mut().enumerate() {
                    *line_p = V::load(line.add(p * LANES));
                }
                V::transpose(&mut lines);

                let per_cell = V::splat(4.0 / h);
                let mut c = [V::zero(); 9];
                for i in 0..3 {
                    lines[i].store(s.motion(chunk, i));
                    for j in 0..3 {
                        // sum w u (index - 1/2 - f): the node's distance from the particle.
                        c[3 * i + j] = first_distance(f[j]).mul_add(lines[i], lines[4 + 4 * j + i]) * per_cell;
                        c[3 * i + j].store(s.motion(chunk, 3 + 3 * i + j));
                    }
                    V::advance(s.offset(chunk, i), s.cell(chunk, i), lines[i] * V::splat(dt / h));
                }
                greatest.see(&[lines[0], lines[1], lines[2]], &c);
            }
        }
        greatest.rates()
    }
}
