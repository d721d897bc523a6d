//! Layout of particles in memory for the transfers: planes of chunks of 16.

use barchan_lanes::{CHUNK, Float};

/// Planes of motion: velocity (3), then the affine matrix C row by row (9).
pub const MOTION: usize = 12;
/// Plane of mass within the rest; rest volume is next, then strain, then history.
pub const MASS: usize = 0;
/// Plane of rest volume within the rest.
pub const VOLUME: usize = 1;
/// First plane of strain within the rest.
pub const STRAIN: usize = 2;

/// Particles of one list, seen through raw pointers. Plane p of chunk c is the 16 values at `(c * planes + p) * 16`.
///
/// Padding lanes at a chunk's end have mass and volume 0, a valid cell, no motion and the strain identity.
#[derive(Clone, Copy, Debug)]
pub struct Particles<T: Float> {
    /// Integer cells, 3 planes.
    pub cell: *mut i32,
    /// Offsets in the cell, 3 planes.
    pub offset: *mut T::Offset,
    /// Velocity [m/s] and affine matrix [1/s], [`MOTION`] planes.
    pub motion: *mut T,
    /// Mass [kg], rest volume [m³], strain, history.
    pub rest: *mut T,
    /// Planes of `rest`.
    pub rest_planes: usize,
}

// SAFETY: a view is only data; who shares one between threads gives each thread chunks of its own.
unsafe impl<T: Float> Send for Particles<T> {}
// SAFETY: as above.
unsafe impl<T: Float> Sync for Particles<T> {}

impl<T: Float> Particles<T> {
    /// Integer cells of a chunk along an axis.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub unsafe fn cell(&self, chunk: usize, axis: usize) -> *mut i32 {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.cell.add((chunk * 3 + axis) * CHUNK) }
    }
    /// Offsets of a chunk along an axis.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub unsafe fn offset(&self, chunk: usize, axis: usize) -> *mut T::Offset {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.offset.add((chunk * 3 + axis) * CHUNK) }
    }
    /// A plane of motion of a chunk.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub unsafe fn motion(&self, chunk: usize, plane: usize) -> *mut T {
        // SAFETY: the caller vouches for the chunk.
        unsafe { self.motion.add((chunk * MOTION + plane) * CHUNK) }
    }
    /// A plane of the rest of a chunk.
    ///
    /// # Safety
    /// The chunk must exist.
    #[inline(always)]
    pub unsafe fn rest(&self, chunk: usize, plane: usize) -> *mut T {
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
