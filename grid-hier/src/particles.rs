//! Layout of particles in memory for the transfers: planes of chunks of 16.

use barchan_lanes::{CHUNK, Float};
use core::marker::PhantomData;

/// Planes of motion: velocity (3), then the affine matrix C row by row (9).
pub const MOTION: usize = 12;
/// Plane of mass within the rest; rest volume is next, then strain, then history.
pub const MASS: usize = 0;
/// Plane of rest volume within the rest.
pub const VOLUME: usize = 1;
/// First plane of strain within the rest.
pub const STRAIN: usize = 2;

/// The particles of one list in one block, for one thread to read and write. Plane p of chunk c is the 16 values at `(c * planes + p) * 16`,
/// where chunks count from the block's first.
///
/// Padding lanes at the last chunk's end have mass and volume 0, a valid cell, no motion and the strain identity.
#[derive(Debug)]
pub struct Particles<'a, T: Float> {
    count: usize,
    cell: *mut i32,
    offset: *mut T::Offset,
    motion: *mut T,
    rest: *mut T,
    rest_planes: usize,
    planes: PhantomData<&'a mut [T]>,
}

impl<'a, T: Float> Particles<'a, T> {
    /// So many particles, in whole chunks: integer cells (3 planes), offsets in the cell (3 planes), velocity [m/s] and affine matrix [1/s]
    /// ([`MOTION`] planes), and the rest: mass [kg], rest volume [m³], strain, history (`rest_planes` planes).
    ///
    /// # Panics
    /// If a slice does not hold just these planes.
    #[inline]
    pub fn new(
        count: usize,
        cell: &'a mut [i32],
        offset: &'a mut [T::Offset],
        motion: &'a mut [T],
        (rest, rest_planes): (&'a mut [T], usize),
    ) -> Self {
        let plane = count.div_ceil(CHUNK) * CHUNK;
        let held = [cell.len(), offset.len(), motion.len(), rest.len()];
        assert!(
            held == [3 * plane, 3 * plane, MOTION * plane, rest_planes * plane],
            "{held:?} values of {count} particles"
        );
        let (cell, offset) = (cell.as_mut_ptr(), offset.as_mut_ptr());
        let (motion, rest) = (motion.as_mut_ptr(), rest.as_mut_ptr());
        Self { count, cell, offset, motion, rest, rest_planes, planes: PhantomData }
    }

    /// How many there are.
    #[inline(always)]
    pub fn count(&self) -> usize {
        self.count
    }
    /// Planes of mass, rest volume, strain and history.
    #[inline(always)]
    pub(crate) fn rest_planes(&self) -> usize {
        self.rest_planes
    }
    /// Integer cells of a chunk along an axis.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub(crate) unsafe fn cell(&self, chunk: usize, axis: usize) -> *mut i32 {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.cell.add((chunk * 3 + axis) * CHUNK) }
    }
    /// Offsets of a chunk along an axis.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub(crate) unsafe fn offset(&self, chunk: usize, axis: usize) -> *mut T::Offset {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.offset.add((chunk * 3 + axis) * CHUNK) }
    }
    /// A plane of motion of a chunk.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub(crate) unsafe fn motion(&self, chunk: usize, plane: usize) -> *mut T {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.motion.add((chunk * MOTION + plane) * CHUNK) }
    }
    /// A plane of the rest of a chunk.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub(crate) unsafe fn rest(&self, chunk: usize, plane: usize) -> *mut T {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.rest.add((chunk * self.rest_planes + plane) * CHUNK) }
    }
}

/// The chunks of one list in one block.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// First chunk.
    pub first: usize,
    /// Number of particles; they fill whole chunks except for the last.
    pub count: usize,
}

impl Run {
    /// Number of chunks.
    #[inline(always)]
    pub fn chunks(self) -> usize {
        self.count.div_ceil(CHUNK)
    }
    /// (chunk, lane) of every particle.
    pub fn places(self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.count).map(move |i| (self.first + i / CHUNK, i % CHUNK))
    }
}
