//! Aligned planes, and sharing them between threads that write disjoint parts.

use barchan_lanes::CHUNK;

/// Sixteen values on a cache line's boundary: one plane of one chunk.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(crate) struct Line<W>(pub(crate) [W; CHUNK]);

/// A vector of lines that asks the system for large pages: the transfers walk hundreds of megabytes, and with small pages a
/// good part of their time goes into address translation.
pub(crate) fn lines<W: Copy>(count: usize, value: W) -> Vec<Line<W>> {
    let mut lines = Vec::with_capacity(count);
    advise_large_pages(&lines);
    lines.resize(count, Line([value; CHUNK]));
    lines
}

/// Asks for large pages where the system knows them; a refusal changes nothing but speed.
pub(crate) fn advise_large_pages<W>(memory: &Vec<W>) {
    #[cfg(target_os = "linux")]
    {
        const LARGE: usize = 2 << 20;
        let start = (memory.as_ptr() as usize).next_multiple_of(4096);
        let end = memory.as_ptr() as usize + memory.capacity() * size_of::<W>();
        if end > start + LARGE {
            // SAFETY: advice on whole pages of a live allocation; it changes how they are backed, not what they hold.
            unsafe { libc::madvise(start as *mut libc::c_void, (end - start) & !4095, libc::MADV_HUGEPAGE) };
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = memory;
}

/// A pointer that several threads may write through, each to places of its own.
pub(crate) struct Shared<W>(pub(crate) *mut W);

impl<W> Clone for Shared<W> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<W> Copy for Shared<W> {}

// SAFETY: whoever dereferences vouches that no two threads touch the same place.
unsafe impl<W> Send for Shared<W> {}
// SAFETY: as above.
unsafe impl<W> Sync for Shared<W> {}

impl<W> Shared<W> {
    /// The place `index` values further on.
    ///
    /// # Safety
    /// It must lie in the allocation.
    #[inline(always)]
    pub(crate) unsafe fn at(self, index: usize) -> *mut W {
        // SAFETY: the caller vouches for the index.
        unsafe { self.0.add(index) }
    }
}
