//! Grid to particles, and advection.

use super::{BATCH, Batches, Quads, ROW, Runs, Scalar, Step, X, Y, ahead, first_nodes};
use crate::block::TILE;
use crate::particles::{MOTION, Particles};
use crate::spline::weights;
use barchan_lanes::{CHUNK, Kernel, Lanes, Row, tabulate};

use core::mem::MaybeUninit;
use core::ops::Range;

/// Grid to particles for one list in one block: velocity, affine matrix, and the move.
pub struct GridToParticles<'a, T: Scalar> {
    /// The particles.
    pub particles: Particles<'a, T>,
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

/// The rates of one list in one block as they are: those that [`GridToParticles`] gave.
pub struct Survey<'a, T: Scalar> {
    /// The particles.
    pub particles: Particles<'a, T>,
}

impl<T: Scalar> Kernel<T> for Survey<'_, T> {
    type Output = Rates<T>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Rates<T> {
        let mut greatest = Greatest::<V>::new();
        for (_, chunk, lane) in Batches::<V>::parts(0, self.particles.count()) {
            // SAFETY: the chunks of so many particles exist.
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
        let all = self.particles.count();
        for from in (0..all).step_by(BATCH) {
            let (count, first) = ((all - from).min(BATCH), from / CHUNK);
            // SAFETY: the chunks of so many particles exist, and what is read is this call's own; nodes were checked by the scatter of this step, and
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
                assert!(
                    !strayed,
                    "P2G has refused the step if a particle is off its block's tile, and none has moved since"
                );
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
