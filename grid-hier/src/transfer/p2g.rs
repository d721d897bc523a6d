//! Particles to grid, the material update inside.
#![expect(non_snake_case, reason = "symbols follow Hu et al. 2018")]

use super::{
    BATCH, Batches, ENTRIES, Fault, Law, MAX_STATE, NODE_OF_LANE, Quads, Runs, Scalar, Step, X, Y, ahead, first_nodes,
    push_forward,
};
use crate::block::TILE;
use crate::particles::{MASS, MOTION, Particles, STRAIN, VOLUME};
use crate::ring::{Carried, PARENT_CELLS};
use crate::spline::{first_distance, weights};
use barchan_abi as abi;
use barchan_abi::batch::{Batch, Pointers};
use barchan_core::stiffness::Damping;
use barchan_lanes::{CHUNK, Float, Kernel, Lanes, Mask, Real, Row, tabulate};
use core::mem::MaybeUninit;
use core::ops::Range;
use std::time::Instant;

/// Particles to grid for one list in one block: strain, stress, then mass and momentum into the tile.
pub struct ParticlesToGrid<'a, T: Scalar> {
    /// The particles.
    pub particles: Particles<'a, T>,
    /// Cell of the tile's first node.
    pub origin: [i32; 3],
    /// The list's material.
    pub law: &'a Law<T>,
    /// The step.
    pub step: &'a Step,
    /// Where mass and momentum are added.
    pub tile: &'a mut [T; TILE],
    /// Where mass and m C [kg m/s a cell] of each parent cell are added, if the rim of a level needs them (see
    /// [`crate::ring`]). Particles that have left the block count where they left it.
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
        // Where nothing has moved and no force is asked for, matter is left alone; where strain alone is carried along, nodes are.
        let parts = if step.dt == 0.0 && step.strain_dt == 0.0 { 0 } else { step.strain_parts };
        let gives = !step.carries_strain_alone();
        let (all, values) = (self.particles.count(), self.law.strain_planes() + self.law.table.n_state);
        assert!(
            self.law.table.n_state <= MAX_STATE && self.particles.rest_planes() == STRAIN + values,
            "lists are made with planes for all that their law keeps, and laws with too much history are refused by the plan"
        );
        for from in (0..all).step_by(BATCH) {
            let (count, first) = ((all - from).min(BATCH), from / CHUNK);
            // SAFETY: the chunks of so many particles exist, with a plane for each of the law's values; the scratch and the gifts are this call's own; `deform` writes the stresses of these
            // particles, if there are any forces, and `prepare` what they give.
            unsafe {
                for part in 0..parts {
                    self.deform::<V>(&step, scratch, first, count, part)?;
                }
                self.prepare::<V, EDGE>(&step, scratch, gifts, first, count)?;
                let nodes: &[u32; BATCH] = &(*gifts).nodes;
                for run in (Runs { nodes: &nodes[..if gives { count } else { 0 }], from: 0 }) {
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
            let batch = Batch::from_pointers(Pointers {
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
            });
            let clock = self.material_time.is_some().then(Instant::now);
            let update = T::update_of(&self.law.table);
            let status = update.map_or(abi::BARCHAN_E_OTHER, |update| update(batch.as_raw(), self.error));
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
                    ahead(rest, s.rest_planes(), p);
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

/// The strain, or zero where it is negligible.
#[inline(always)]
fn without_dust<V: Lanes>(strain: V) -> V
where
    V::Scalar: Scalar,
{
    // NaN is below nothing, and stays to be found.
    V::select(V::fill(V::Scalar::from_f64(V::Scalar::NEGLIGIBLE)).gt(strain.abs()), V::zero(), strain)
}

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
