//! The two transfers, one block at a time: particles to grid with the material update inside, and grid to particles.
//!
//! MLS-MPM with APIC: p_i = sum_p w_ip [ m (v + dt g) + (m C - dt V0 (4/h²) tau) (x_i - x_p) ], m_i = sum_p w_ip m, and back
//! v = sum_i w_ip u_i, C = (4/h²) sum_i w_ip u_i (x_i - x_p)ᵀ, x += dt v.
//!
//! Particles come in batches. Everything that is per particle alone (weights, strain, stress, affine momentum) is computed with
//! particles in lanes and then transposed. They are sorted by cell, so consecutive ones mostly touch the same 27 nodes: for each run
//! of them these are kept in nine registers, each a row of three nodes along z times (p_x, p_y, p_z, m). Where a register does not
//! hold a row, the run is gone through once for each part of it (see [`Row`]).
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
use barchan_core::stiffness::Damping;
use barchan_lanes::{CHUNK, Float, Kernel, Lanes, Mask, Real, Row, prefetch, tabulate};
use core::marker::PhantomData;
use core::mem::MaybeUninit;
use core::ops::Range;
use std::time::Instant;

/// Particles worked on at a time: those handed to a material.
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
    /// Where what damping dissipates is added [J], in the order of the particles.
    pub damped: &'a mut f64,
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

/// What the particles of a batch give to nodes: momentum and mass as seen from the first node, the columns of A with zeros, the
/// weights along z and a zero; for a rim the columns of m C with the mass. And the products of weights along x and y.
#[repr(C, align(64))]
struct Gifts<T> {
    quads: Quads<T, 8>,
    weights: [[T; BATCH]; 9],
    /// Start in the tile of each particle's first node.
    nodes: [u32; BATCH],
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
        let mut gifts = MaybeUninit::<Gifts<T>>::uninit();
        let gifts = gifts.as_mut_ptr();
        // A copy, so that the compiler knows it constant.
        let step = *self.step;
        // Where nothing has moved and no force is asked for, matter is left alone.
        let parts = if step.dt == 0.0 && step.strain_dt == 0.0 { 0 } else { step.strain_parts };
        for from in (0..self.run.count).step_by(BATCH) {
            let count = (self.run.count - from).min(BATCH);
            let first = self.run.first + from / CHUNK;
            // SAFETY: the run's chunks exist, the scratch and the gifts are this call's own; `deform` writes the stresses of these
            // particles, if there are any forces, and `prepare` what they give.
            unsafe {
                for part in 0..parts {
                    self.deform::<V>(&step, scratch, first, count, part)?;
                }
                self.prepare::<V, EDGE>(&step, scratch, gifts, first, count)?;
                let nodes: &[u32; BATCH] = &(*gifts).nodes;
                for run in (Runs { nodes: &nodes[..count], from: 0 }) {
                    let node = nodes[run.start] as usize;
                    let tile = self.tile.as_mut_ptr().add(node);
                    self.scatter::<V, V::Near>(tile, gifts, first, run.clone(), 0);
                    let mut z = V::Near::NODES;
                    while z < 3 {
                        self.scatter::<V, V::Far>(tile, gifts, first, run.clone(), z);
                        z += V::Far::NODES;
                    }
                    if let Some(cells) = self.parent_cells.as_deref_mut().filter(|_| EDGE) {
                        carry::<V>(&mut cells[parent_cell(node)], gifts, run);
                    }
                }
            }
        }
        Ok(())
    }

    /// Trial strain, material update, strain and history back, for up to [`BATCH`] particles from a chunk on. Stresses stay in the
    /// scratch.
    #[inline(always)]
    unsafe fn deform<V: Lanes<Scalar = T>>(
        &mut self,
        step: &Step,
        scratch: *mut Scratch<T>,
        first: usize,
        count: usize,
        part: u32,
    ) -> Result<(), Fault> {
        let planes = self.law.strain_planes();
        let n_state = self.law.table.n_state;
        let dt = step.strain_dt / f64::from(step.strain_parts);
        let wants_gradient = self.law.table.capabilities & abi::BARCHAN_CAP_VEL_GRAD != 0;
        let s = &self.particles;
        // SAFETY: for the whole body, the caller vouches for the chunks; scratch planes are BATCH long.
        unsafe {
            for (at, chunk, lane) in Batches::<V>::parts(first, count) {
                let mut C = [V::zero(); 9];
                for (c, C) in C.iter_mut().enumerate() {
                    *C = V::load(s.motion(chunk, 3 + c).add(lane));
                    if wants_gradient {
                        C.store(&raw mut (*scratch).vel_grad[c][at]);
                    }
                }
                let C = tabulate!(9, |c| without_dust(C[c] * V::splat(dt)));
                if planes == 9 {
                    let mut F = [V::zero(); 9];
                    for (p, F) in F.iter_mut().enumerate() {
                        *F = V::load(s.rest(chunk, STRAIN + p).add(lane));
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
                        *b = V::load(s.rest(chunk, STRAIN + p).add(lane));
                    }
                    for (p, trial) in push_forward(&C, &b).into_iter().enumerate() {
                        trial.store(&raw mut (*scratch).trial[p][at]);
                    }
                }
                for q in 0..n_state {
                    let state = V::load(s.rest(chunk, STRAIN + planes + q).add(lane));
                    state.store(&raw mut (*scratch).state_in[q][at]);
                }
            }
            let batch = Batch {
                n: count.next_multiple_of(V::COUNT),
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
            // Without a step nothing tells what of the rate of strain is elastic.
            if let Some(damping) = self.law.damping.filter(|_| dt > 0.0) {
                *self.damped += dt * self.damp::<V>(damping, dt, scratch, first, count);
            }
            for (at, chunk, lane) in Batches::<V>::parts(first, if step.frozen { 0 } else { count }) {
                // Nothing is written back that is not a number. Stress that is not one shows in the momentum that it gives.
                let mut sum = V::zero();
                for p in 0..planes {
                    sum += V::load(&raw const (*scratch).strain[p][at]);
                }
                for q in 0..n_state {
                    sum += V::load(&raw const (*scratch).state_out[q][at]);
                }
                let finite = sum.is_finite();
                if !finite.all() {
                    return Err(Fault::Unsound { chunk, lane: lane + (!finite.bits()).trailing_zeros() as usize });
                }
                for p in 0..planes {
                    let strain = V::load(&raw const (*scratch).strain[p][at]);
                    // Of b_e and F, what lies off the diagonal.
                    let off = if planes == 6 { p >= 3 } else { p % 4 != 0 };
                    let strain = if off { without_dust(strain) } else { strain };
                    strain.store(s.rest(chunk, STRAIN + p).add(lane));
                }
                for q in 0..n_state {
                    let state = V::load(&raw const (*scratch).state_out[q][at]);
                    state.store(s.rest(chunk, STRAIN + planes + q).add(lane));
                }
            }
        }
        Ok(())
    }

    /// Adds to the stresses of up to [`BATCH`] particles from a chunk on what damping gives for a strain that grew over `dt`. Returns the power
    /// that it dissipates [W].
    ///
    /// The elastic part of the rate of strain is 2 dt D = G + Gᵀ + G Gᵀ - (b* - b) / m, G = dt C: what the motion does to b = I, less what plastic flow
    /// takes from the trial strain b* to b; for isotropic laws that is 2 dt b times the rate of flow, and m = tr b / 3 stands for that b. So flow is
    /// resisted by no more than its part in the deviator of b, and not at all where there is no stress, however fast it is.
    #[inline(always)]
    unsafe fn damp<V: Lanes<Scalar = T>>(
        &self,
        damping: Damping,
        dt: f64,
        scratch: *mut Scratch<T>,
        first: usize,
        count: usize,
    ) -> f64 {
        let planes = self.law.strain_planes();
        let s = &self.particles;
        let (lambda, twice_mu) = (V::splat(damping.lambda), V::splat(2.0 * damping.mu));
        let per_strain = V::splat(0.5 / dt);
        let mut all = 0.0;
        // SAFETY: for the whole body, the caller vouches for the chunks and that the material has written its strains and stresses.
        unsafe {
            for (at, chunk, lane) in Batches::<V>::parts(first, count) {
                let G: [V; 9] =
                    tabulate!(9, |c| without_dust(V::load(s.motion(chunk, 3 + c).add(lane)) * V::splat(dt)));
                let trial = left_cauchy_green::<V>(&raw const (*scratch).trial, at, planes);
                let b = left_cauchy_green::<V>(&raw const (*scratch).strain, at, planes);
                let flow = V::splat(3.0) / (b[0] + b[1] + b[2]);
                let D: [V; 6] = tabulate!(6, |e| {
                    let (i, j) = ENTRIES[e];
                    let square = G[3 * i].mul_add(
                        G[3 * j],
                        G[3 * i + 1]
                            .mul_add(G[3 * j + 1], G[3 * i + 2].mul_add(G[3 * j + 2], G[3 * i + j] + G[3 * j + i])),
                    );
                    per_strain * (b[e] - trial[e]).mul_add(flow, square)
                });
                let swelling = D[0] + D[1] + D[2];
                let mut power = lambda * swelling * swelling;
                for (e, D) in D.into_iter().enumerate() {
                    let (pressure, twice) = if e < 3 { (lambda * swelling, D) } else { (V::zero(), D + D) };
                    let tau = twice_mu.mul_add(D, pressure);
                    power = (twice_mu * D).mul_add(twice, power);
                    let kirchhoff = &raw mut (*scratch).kirchhoff[e][at];
                    (V::load(kirchhoff) + tau).store(kirchhoff.cast());
                }
                // Lanes without a particle have no volume.
                let power = power * V::load(s.rest(chunk, VOLUME).add(lane));
                all += power.sum().to_f64();
            }
        }
        all
    }

    /// What up to [`BATCH`] particles from a chunk on give, and where.
    #[inline(always)]
    unsafe fn prepare<V: Lanes<Scalar = T>, const EDGE: bool>(
        &self,
        step: &Step,
        scratch: *const Scratch<T>,
        gifts: *mut Gifts<T>,
        first: usize,
        count: usize,
    ) -> Result<(), Fault> {
        let s = &self.particles;
        let (h, dt, gravity) = (step.h, step.dt, step.gravity);
        // SAFETY: for the whole body, the caller vouches for the chunks and that the scratch holds their stresses.
        unsafe {
            for (at, chunk, lane) in Batches::<V>::parts(first, count) {
                for p in (at..at + V::COUNT).step_by(4) {
                    ahead(s.offset(first, 0), 3, p);
                    ahead(s.cell(first, 0), 3, p);
                }
                let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d).add(lane)));
                let w = [weights(f[0]), weights(f[1]), weights(f[2])];
                for i in 0..3 {
                    for j in 0..3 {
                        (w[0][i] * w[1][j]).store(&raw mut (*gifts).weights[3 * i + j][at]);
                    }
                }
                let quads = &raw mut (*gifts).quads.0;
                let zero = V::zero();
                Batches::write_quads(&raw mut (*quads)[4], at, [w[2][0], w[2][1], w[2][2], zero]);

                let d0 = tabulate!(3, |d| first_distance(f[d]));
                let m = V::load(s.rest(chunk, MASS).add(lane));
                let stress = V::load(s.rest(chunk, VOLUME).add(lane)) * V::splat(-4.0 * dt / h);
                let mut tau = [V::zero(); 6];
                if dt != 0.0 {
                    tau = tabulate!(6, |c| V::load(&raw const (*scratch).kirchhoff[c][at]));
                }
                let tau = [tau[0], tau[3], tau[4], tau[3], tau[1], tau[5], tau[4], tau[5], tau[2]];
                let affine_mass = m * V::splat(h);
                // A: momentum per cell of distance; B: momentum and mass as seen from the first node.
                let A: [V; 9] =
                    tabulate!(9, |c| affine_mass.mul_add(V::load(s.motion(chunk, 3 + c).add(lane)), stress * tau[c]));
                let mut B = [m; 4];
                for i in 0..3 {
                    let v = V::load(s.motion(chunk, i).add(lane)) + V::splat(dt * gravity[i]);
                    let p = A[3 * i].mul_add(d0[0], A[3 * i + 1].mul_add(d0[1], A[3 * i + 2] * d0[2]));
                    B[i] = m.mul_add(v, p);
                }
                let finite = (B[0] + B[1] + B[2] + m).is_finite();
                if !finite.all() {
                    let sound = (tau[0] + tau[1] + tau[2] + tau[4] + tau[5] + tau[8]).is_finite();
                    let first_of = |lanes: V::Mask| lane + lanes.bits().trailing_zeros() as usize;
                    let by_law = !finite & !sound;
                    return Err(if by_law.any() {
                        Fault::Unsound { chunk, lane: first_of(by_law) }
                    } else {
                        Fault::NonFinite { chunk, lane: first_of(!finite) }
                    });
                }
                Batches::write_quads(&raw mut (*quads)[0], at, B);
                for j in 0..3 {
                    Batches::write_quads(&raw mut (*quads)[1 + j], at, [A[j], A[3 + j], A[6 + j], zero]);
                }
                if EDGE {
                    for j in 0..3 {
                        let mut column = [m; 4];
                        for i in 0..3 {
                            column[i] = affine_mass * V::load(s.motion(chunk, 3 + 3 * i + j).add(lane));
                        }
                        Batches::write_quads(&raw mut (*quads)[5 + j], at, column);
                    }
                }
                if first_nodes::<V>(s, chunk, lane, self.origin, &raw mut (*gifts).nodes[at]) {
                    return Err(Fault::Strayed { chunk });
                }
            }
        }
        Ok(())
    }

    /// Mass and momentum of a run of particles, added to the nodes from `z` on of each row around their cell, as many as fit into `R`.
    #[inline(always)]
    unsafe fn scatter<V: Lanes<Scalar = T>, R: Row<Scalar = T>>(
        &self,
        tile: *mut T,
        gifts: *const Gifts<T>,
        first: usize,
        run: Range<usize>,
        z: usize,
    ) {
        let s = &self.particles;
        // SAFETY: the caller vouches that the gifts are there. `first_nodes` has checked that the node's 3 x 3 x 3 neighbours lie in
        // the tile; a fourth group of lanes is zero and may touch the next row or the room behind the last one.
        unsafe {
            let lane_node = R::load(NODE_OF_LANE.map(T::from_f64).as_ptr().add(4 * z));
            let weights: *const T = (&raw const (*gifts).weights).cast();
            let quads: *const T = (&raw const (*gifts).quads).cast();
            let (motion, rest) = (s.motion(first, 0), s.rest(first, 0));
            let mut rows = [R::fill(T::default()); 9];
            for p in run {
                if z == 0 {
                    ahead(motion, MOTION, p);
                    ahead(rest, s.rest_planes, p);
                }
                let quad = quads.add(*Batches::<V>::QUAD.get_unchecked(p));
                let weight_z = R::spread(quad.add(4 * 4 * BATCH + z));
                let x_step = R::repeat4(quad.add(4 * BATCH)) * weight_z;
                let y_step = R::repeat4(quad.add(2 * 4 * BATCH)) * weight_z;
                let mut row = R::repeat4(quad);
                row.add_product(R::repeat4(quad.add(3 * 4 * BATCH)), lane_node);
                row = row * weight_z;
                let weight = weights.add(p);
                for i in 0..3 {
                    // In place: with one register more a sum would go through memory for each particle.
                    let mut node = row;
                    rows[3 * i].add_product(R::fill(*weight.add(3 * i * BATCH)), node);
                    node += y_step;
                    rows[3 * i + 1].add_product(R::fill(*weight.add((3 * i + 1) * BATCH)), node);
                    node += y_step;
                    rows[3 * i + 2].add_product(R::fill(*weight.add((3 * i + 2) * BATCH)), node);
                    row += x_step;
                }
            }
            for i in 0..3 {
                for j in 0..3 {
                    let at = tile.add(i * X + j * Y + 4 * z);
                    (R::load(at) + rows[3 * i + j]).store(at);
                }
            }
        }
    }
}

/// Adds what a run of particles carries for a rim to the parent of their cell: the columns of m C, and their mass with the first.
#[inline(always)]
unsafe fn carry<V: Lanes>(parent: &mut Carried<V::Scalar>, gifts: *const Gifts<V::Scalar>, run: Range<usize>) {
    let mut columns = [[V::Scalar::zero(); 4]; 3];
    for p in run {
        for (j, column) in columns.iter_mut().enumerate() {
            for (i, sum) in column.iter_mut().enumerate() {
                // SAFETY: the caller vouches that the gifts are there.
                *sum += unsafe { (*gifts).quads.0[5 + j][Batches::<V>::QUAD[p] + i] };
            }
        }
    }
    parent.0[Carried::<V::Scalar>::MASS] += columns[0][3];
    for (j, column) in columns.iter().enumerate() {
        for i in 0..3 {
            parent.0[Carried::<V::Scalar>::column(j) + i] += column[i];
        }
    }
}

/// Which of a block's parent cells holds the cell whose first node starts at a place in the tile.
#[inline(always)]
fn parent_cell(node: usize) -> usize {
    // The first node of the block's third cell along an axis is the tile's fourth.
    let node = [node / X, node % X / Y, node % Y / 4];
    node.iter().fold(0, |parent, n| 2 * parent + usize::from(*n >= 3))
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

/// The strain, or zero where it is negligible.
#[inline(always)]
fn without_dust<V: Lanes>(strain: V) -> V
where
    V::Scalar: Scalar,
{
    // NaN is below nothing, and stays to be found.
    V::select(V::fill(V::Scalar::from_f64(V::Scalar::NEGLIGIBLE)).gt(strain.abs()), V::zero(), strain)
}

/// Row and column of each plane of a symmetric tensor.
const ENTRIES: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];

/// b = F Fᵀ of as many particles as there are lanes, from the planes of F or from its own.
#[inline(always)]
unsafe fn left_cauchy_green<V: Lanes>(strain: *const [[V::Scalar; BATCH]; 9], at: usize, planes: usize) -> [V; 6] {
    // SAFETY: the caller vouches for so many planes.
    let plane = |p: usize| unsafe { V::load(&raw const (*strain)[p][at]) };
    if planes == 6 {
        return tabulate!(6, |p| plane(p));
    }
    let F: [V; 9] = tabulate!(9, |p| plane(p));
    tabulate!(6, |e| {
        let (i, j) = (3 * ENTRIES[e].0, 3 * ENTRIES[e].1);
        F[i].mul_add(F[j], F[i + 1].mul_add(F[j + 1], F[i + 2] * F[j + 2]))
    })
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
    tabulate!(6, |e| {
        let (i, j) = ENTRIES[e];
        half[3 * i].mul_add(
            G[3 * j],
            half[3 * i + 1].mul_add(G[3 * j + 1], half[3 * i + 2].mul_add(G[3 * j + 2], half[3 * i + j])),
        )
    })
}

/// Strain (F row by row, or b_e) after a motion by I + G, before the material has its say.
pub fn deformed<R: Real>(G: &[R; 9], strain: &[R]) -> [R; 9] {
    let mut trial = [R::zero(); 9];
    match strain.first_chunk::<9>() {
        Some(F) => {
            for e in 0..9 {
                let (i, j) = (e / 3, e % 3);
                trial[e] = (0..3).fold(F[e], |sum, k| G[3 * i + k].mul_add(F[3 * k + j], sum));
            }
        }
        None => {
            if let Some(b) = strain.first_chunk::<6>() {
                trial[..6].copy_from_slice(&push_forward(G, b));
            }
        }
    }
    trial
}

/// Start in the tile of the first node of as many particles as there are lanes. Returns whether any of them lies outside.
#[inline(always)]
unsafe fn first_nodes<V: Lanes>(
    s: &Particles<V::Scalar>,
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

/// Sums of particles' rows over their nodes, and what the third node has more than the first, with particles in lanes. Rows of the
/// same sum are three apart.
#[inline(always)]
unsafe fn folded<V: Lanes>(rows: *const V::Scalar) -> ([V; 4], [V; 4]) {
    let (mut sum, mut difference) = ([V::zero(); 4], [V::zero(); 4]);
    for k in 0..4 {
        // SAFETY: the caller vouches for the rows. Of particles k, 4 + k, ...
        (sum[k], difference[k]) = unsafe { V::fold(rows.add(k * 3 * ROW), 4 * 3 * ROW) };
    }
    V::transpose4(&mut sum);
    V::transpose4(&mut difference);
    (sum, difference)
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
        for (_, chunk, lane) in Batches::<V>::parts(self.run.first, self.run.count) {
            // SAFETY: the run's chunks exist.
            unsafe {
                let v = tabulate!(3, |d| V::load(self.particles.motion(chunk, d).add(lane)));
                let c = tabulate!(9, |e| V::load(self.particles.motion(chunk, 3 + e).add(lane)));
                greatest.see(&v, &c);
            }
        }
        greatest.rates()
    }
}

/// What particles of a batch need of nodes, and get.
#[repr(C, align(64))]
struct Reads<T> {
    /// Weights along x, and along y.
    weights: [[T; BATCH]; 6],
    /// Weights along z and a zero.
    z: Quads<T, 1>,
    /// Start in the tile of each particle's first node.
    nodes: [u32; BATCH],
    /// Sums over x and y of w u, and of w u times the node's distance from the middle one along x or y. Nodes along z are still apart.
    sums: [[[T; ROW]; 3]; BATCH],
}

impl<T: Scalar> Kernel<T> for GridToParticles<'_, T> {
    type Output = Rates<T>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Rates<T> {
        let mut greatest = Greatest::<V>::new();
        let mut reads = MaybeUninit::<Reads<T>>::uninit();
        let reads = reads.as_mut_ptr();
        for from in (0..self.run.count).step_by(BATCH) {
            let count = (self.run.count - from).min(BATCH);
            let first = self.run.first + from / CHUNK;
            // SAFETY: the run's chunks exist, and what is read is this call's own; nodes were checked by the scatter of this step, and
            // are checked again because reading outside the tile must be impossible.
            unsafe {
                self.weigh::<V>(reads, first, count);
                let nodes: &[u32; BATCH] = &(*reads).nodes;
                for run in (Runs { nodes: &nodes[..count], from: 0 }) {
                    let tile = self.tile.as_ptr().add(nodes[run.start] as usize);
                    let mut z = V::Near::NODES;
                    while z < 3 {
                        self.gather::<V, V::Far>(tile, reads, first, run.clone(), z);
                        z += V::Far::NODES;
                    }
                    self.gather::<V, V::Near>(tile, reads, first, run, 0);
                }
                // Padding gets no motion.
                for p in count..count.next_multiple_of(V::COUNT) {
                    (*reads).sums[p] = [[T::zero(); ROW]; 3];
                }
                self.finish::<V>(reads, first, count, &mut greatest);
            }
        }
        greatest.rates()
    }
}

impl<T: Scalar> GridToParticles<'_, T> {
    /// Weights and nodes of up to [`BATCH`] particles from a chunk on.
    #[inline(always)]
    unsafe fn weigh<V: Lanes<Scalar = T>>(&self, reads: *mut Reads<T>, first: usize, count: usize) {
        let s = &self.particles;
        for (at, chunk, lane) in Batches::<V>::parts(first, count) {
            // SAFETY: the caller vouches for the chunks.
            unsafe {
                for p in (at..at + V::COUNT).step_by(4) {
                    ahead(s.offset(first, 0), 3, p);
                    ahead(s.cell(first, 0), 3, p);
                }
                let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d).add(lane)));
                for d in 0..2 {
                    for (i, w) in weights(f[d]).into_iter().enumerate() {
                        w.store(&raw mut (*reads).weights[3 * d + i][at]);
                    }
                }
                let [z0, z1, z2] = weights(f[2]);
                Batches::write_quads(&raw mut (*reads).z.0[0], at, [z0, z1, z2, V::zero()]);
                let strayed = first_nodes::<V>(s, chunk, lane, self.origin, &raw mut (*reads).nodes[at]);
                assert!(!strayed, "a particle strayed between the transfers of one step");
            }
        }
    }

    /// Sums over x and y for a run of particles, of the nodes from `z` on of each row around their cell, as many as fit into `R`.
    #[inline(always)]
    unsafe fn gather<V: Lanes<Scalar = T>, R: Row<Scalar = T>>(
        &self,
        tile: *const T,
        reads: *mut Reads<T>,
        first: usize,
        run: Range<usize>,
        z: usize,
    ) {
        // SAFETY: the caller vouches for the weights, and that the node's 3 x 3 x 3 neighbours lie in the tile; a fourth group of
        // lanes may read the next row or the room behind the last one, and has no weight.
        unsafe {
            let mut rows = [R::fill(T::default()); 9];
            for i in 0..3 {
                for j in 0..3 {
                    rows[3 * i + j] = R::load(tile.add(i * X + j * Y + 4 * z));
                }
            }
            let weights: *const T = (&raw const (*reads).weights).cast();
            let motion = self.particles.motion(first, 0);
            for p in run {
                if z == 0 {
                    ahead(motion, MOTION, p);
                }
                let weight = weights.add(p);
                let [y0, y1, y2] =
                    [R::fill(*weight.add(3 * BATCH)), R::fill(*weight.add(4 * BATCH)), R::fill(*weight.add(5 * BATCH))];
                let zero = R::fill(T::default());
                let (mut plain, mut by_x, mut by_y) = (zero, zero, zero);
                for i in 0..3 {
                    let x = R::fill(*weight.add(i * BATCH));
                    let mut row = y0 * rows[3 * i];
                    let mut across = -row;
                    across.add_product(y2, rows[3 * i + 2]);
                    row.add_product(y1, rows[3 * i + 1]);
                    row.add_product(y2, rows[3 * i + 2]);
                    match i {
                        0 => {
                            plain = x * row;
                            by_x = -plain;
                            by_y = x * across;
                        }
                        1 => {
                            plain.add_product(x, row);
                            by_y.add_product(x, across);
                        }
                        _ => {
                            plain.add_product(x, row);
                            by_x.add_product(x, row);
                            by_y.add_product(x, across);
                        }
                    }
                }
                let weight_z =
                    R::spread((&raw const (*reads).z).cast::<T>().add(*Batches::<V>::QUAD.get_unchecked(p) + z));
                let sums: *mut T = (&raw mut (*reads).sums[p]).cast();
                (plain * weight_z).store(sums.add(4 * z));
                (by_x * weight_z).store(sums.add(ROW + 4 * z));
                (by_y * weight_z).store(sums.add(2 * ROW + 4 * z));
            }
        }
    }

    /// Sums over z too, with particles in lanes: velocity, and its moments along x, y and z; then the affine matrix, and the move.
    #[inline(always)]
    unsafe fn finish<V: Lanes<Scalar = T>>(
        &self,
        reads: *const Reads<T>,
        first: usize,
        count: usize,
        greatest: &mut Greatest<V>,
    ) {
        let s = &self.particles;
        let Step { h, dt, .. } = *self.step;
        let per_cell = V::splat(4.0 / h);
        for (at, chunk, lane) in Batches::<V>::parts(first, count) {
            // SAFETY: the caller vouches for the chunks and the sums.
            unsafe {
                let f: [V; 3] = tabulate!(3, |d| V::load_offset(s.offset(chunk, d).add(lane)));
                let sums: *const T = (&raw const (*reads).sums[at]).cast();
                let (v, along_z) = folded::<V>(sums);
                let mut c = [V::zero(); 9];
                // One axis after the other: all of them at once are more than the registers hold.
                for j in [2, 0, 1] {
                    let by_node = if j == 2 { along_z } else { folded::<V>(sums.add((1 + j) * ROW)).0 };
                    for i in 0..3 {
                        // From the distance of each node from the middle one to that from the particle.
                        c[3 * i + j] = (V::splat(0.5) - f[j]).mul_add(v[i], by_node[i]) * per_cell;
                        c[3 * i + j].store(s.motion(chunk, 3 + 3 * i + j).add(lane));
                    }
                }
                for i in 0..3 {
                    v[i].store(s.motion(chunk, i).add(lane));
                    V::advance(s.offset(chunk, i).add(lane), s.cell(chunk, i).add(lane), v[i] * V::splat(dt / h));
                }
                greatest.see(&[v[0], v[1], v[2]], &c);
            }
        }
    }
}
