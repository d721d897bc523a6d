//! Aligned planes, and slices that several threads write, each parts of its own.
#![expect(
    unsafe_code,
    reason = "threads write parts of one slice, planes are seen as plain numbers, and the system is asked for large pages"
)]

use barchan_lanes::{CHUNK, Plain};
use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Sixteen values on a cache line's boundary: one plane of one chunk.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(crate) struct Line<W>(pub(crate) [W; CHUNK]);

impl<W: Plain> Line<W> {
    /// The values of some lines, one after the other.
    pub(crate) fn flat(lines: &mut [Self]) -> &mut [W] {
        const { assert!(size_of::<Self>() == size_of::<[W; CHUNK]>(), "a line has no padding") };
        // SAFETY: a line is 16 values and nothing else.
        unsafe { std::slice::from_raw_parts_mut(lines.as_mut_ptr().cast(), lines.len() * CHUNK) }
    }
}

/// A plane's storage for 16 lanes of plain numbers.
///
/// # Safety
/// It must consist of its values and nothing else.
pub(crate) unsafe trait Plane: Copy + Send + Sync {
    type Word: Plain;
    fn values(&self) -> &[Self::Word; CHUNK];
    fn values_mut(&mut self) -> &mut [Self::Word; CHUNK];
}
// SAFETY: see `Line::flat`.
unsafe impl<W: Plain> Plane for Line<W> {
    type Word = W;
    fn values(&self) -> &[W; CHUNK] {
        &self.0
    }
    fn values_mut(&mut self) -> &mut [W; CHUNK] {
        &mut self.0
    }
}
// SAFETY: it is its values.
unsafe impl<W: Plain> Plane for [W; CHUNK] {
    type Word = W;
    fn values(&self) -> &[W; CHUNK] {
        self
    }
    fn values_mut(&mut self) -> &mut [W; CHUNK] {
        self
    }
}

/// The first `count` planes of one kind that have room where there are lines of another.
pub(crate) fn room<P: Plane, W: Plain>(lines: &mut [Line<W>], count: usize) -> &mut [P] {
    const { assert!(align_of::<P>() <= align_of::<Line<W>>(), "lines are aligned for every plane") };
    assert!(count * size_of::<P>() <= size_of_val(lines), "the scratch has room for {count} planes");
    // SAFETY: there is room, aligned; plain numbers have no bits that are not a number, neither these nor, afterwards, those.
    unsafe { std::slice::from_raw_parts_mut(lines.as_mut_ptr().cast(), count) }
}

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

/// A slice, or several side by side, of which several threads write parts. Each row is handed out once at most, to whoever asks first,
/// so no two threads ever hold the same one, whatever they ask for.
///
/// A bit for each row says whether it has been: a pass costs one atomic operation for each block and table, some nanoseconds where the
/// block's work takes microseconds.
pub(crate) struct Parts<R> {
    rows: R,
    taken: Vec<AtomicU64>,
}

impl<R: Table> Parts<R> {
    pub(crate) fn new(rows: R) -> Self {
        let taken = (0..rows.count().div_ceil(64)).map(|_| AtomicU64::new(0)).collect();
        Self { rows, taken }
    }

    /// Some rows.
    ///
    /// # Panics
    /// If any of them does not exist, or has been handed out before.
    #[inline]
    pub(crate) fn take(&self, rows: Range<usize>) -> R::Part {
        assert!(rows.start <= rows.end && rows.end <= self.rows.count(), "{rows:?} of {} rows", self.rows.count());
        let mut row = rows.start;
        while row < rows.end {
            let count = (rows.end - row).min(64 - row % 64);
            let bits = (u64::MAX >> (64 - count)) << (row % 64);
            // No memory hangs on the order of these: a row never passes from one thread to another while this lives.
            let before = self.taken[row / 64].fetch_or(bits, Ordering::Relaxed);
            assert!(before & bits == 0, "of the rows {rows:?} some have been handed out before");
            row += count;
        }
        // SAFETY: the rows exist, and whoever sets a row's bit is alone in having found it unset.
        unsafe { self.rows.part(rows) }
    }
}

impl<'a, W: Send> Parts<Rows<'a, W>> {
    /// Parts of a slice, each of so many values.
    pub(crate) fn of(all: &'a mut [W]) -> Self {
        Self::new(Rows::new(all, 1))
    }

    /// One row of one value.
    ///
    /// # Panics
    /// As [`take`](Self::take).
    #[inline]
    pub(crate) fn one(&self, row: usize) -> &'a mut W {
        &mut self.take(row..row + 1)[0]
    }
}

/// What consists of rows.
pub(crate) trait Table {
    /// Some of them.
    type Part;
    /// How many there are.
    fn count(&self) -> usize;
    /// Some rows.
    ///
    /// # Safety
    /// They must exist, and none of them may ever be asked for again.
    unsafe fn part(&self, rows: Range<usize>) -> Self::Part;
}

/// Rows of so many values.
pub(crate) struct Rows<'a, W> {
    first: *mut W,
    width: usize,
    count: usize,
    all: PhantomData<&'a mut [W]>,
}

// SAFETY: it stands for the slice that it was made from, and gives out no value twice.
unsafe impl<W: Send> Send for Rows<'_, W> {}
// SAFETY: as above; shared, it gives out what may be sent.
unsafe impl<W: Send> Sync for Rows<'_, W> {}

impl<'a, W> Rows<'a, W> {
    /// Those of a slice that holds whole rows.
    pub(crate) fn new(all: &'a mut [W], width: usize) -> Self {
        assert!(all.len().is_multiple_of(width), "rows are whole");
        Self { first: all.as_mut_ptr(), width, count: all.len() / width, all: PhantomData }
    }
}

impl<'a, W> Table for Rows<'a, W> {
    type Part = &'a mut [W];
    #[inline]
    fn count(&self) -> usize {
        self.count
    }
    #[inline]
    unsafe fn part(&self, rows: Range<usize>) -> &'a mut [W] {
        // SAFETY: the slice is borrowed for 'a; the caller vouches that the rows exist and that nobody else has them.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(rows.start * self.width), rows.len() * self.width) }
    }
}

/// Two tables with as many rows, side by side.
impl<A: Table, B: Table> Table for (A, B) {
    type Part = (A::Part, B::Part);
    #[inline]
    fn count(&self) -> usize {
        self.0.count().min(self.1.count())
    }
    #[inline]
    unsafe fn part(&self, rows: Range<usize>) -> Self::Part {
        // SAFETY: the caller vouches for the rows, and there are no fewer in either.
        unsafe { (self.0.part(rows.clone()), self.1.part(rows)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_get_every_row_once() {
        let mut values = vec![0u32; 3 * 1000];
        let parts = Parts::new(Rows::new(&mut values, 3));
        std::thread::scope(|scope| {
            for thread in 0..4 {
                let parts = &parts;
                scope.spawn(move || {
                    for first in (thread * 10..1000).step_by(40) {
                        parts.take(first..first + 10).iter_mut().for_each(|value| *value += 1);
                    }
                });
            }
        });
        drop(parts);
        assert!(values.iter().all(|value| *value == 1));
    }

    #[test]
    #[should_panic(expected = "handed out before")]
    fn overlapping_rows_are_refused() {
        let mut values = [0; 300];
        let parts = Parts::of(&mut values);
        parts.take(10..150);
        parts.take(150..151);
        parts.take(149..200);
    }

    #[test]
    #[should_panic(expected = "290..301 of 300 rows")]
    fn rows_that_do_not_exist_are_refused() {
        Parts::of(&mut [0; 300]).take(290..301);
    }

    #[test]
    fn an_empty_part_takes_nothing() {
        let mut values = [0; 64];
        let parts = Parts::of(&mut values);
        assert!(parts.take(64..64).is_empty() && parts.take(3..3).is_empty());
        assert_eq!(parts.take(0..64).len(), 64);
    }

    #[test]
    fn side_by_side_there_are_as_many_rows_as_in_the_shorter() {
        let (mut left, mut right) = ([0; 4], [0; 6]);
        let parts = Parts::new((Rows::new(&mut left, 1), Rows::new(&mut right, 2)));
        let (a, b) = parts.take(1..3);
        assert_eq!((a.len(), b.len()), (2, 4));
        assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| parts.take(3..4))).is_err());
    }
}
