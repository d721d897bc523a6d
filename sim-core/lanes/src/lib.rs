//! Numbers for Barchan's kernels.
//!
//! A kernel is written once, generic over [`Real`] (constitutive laws) or [`Lanes`] (transfers), and runs as
//! - a plain `f32` or `f64`, for reference and for single particles;
//! - [`Dual`], carrying a directional derivative;
//! - as many lanes of `f32` or `f64` as a register of the machine's instruction set holds, chosen at run time by
//!   [`Isa::run`], so that one binary is fast everywhere.
//!
//! There is no branching on values: comparisons give a [`Mask`], and [`Real::select`] picks per lane. `mul_add` is fused
//! where the instruction set fuses, so results are the same bits for one [`Isa`], and agree to rounding between two.
//! Logarithm and exponential are our own; their errors are stated at [`Real::ln`] and [`Real::exp`].
#![expect(unsafe_code, reason = "vector registers are reached through intrinsics and raw loads and stores")]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod base;
mod dual;
mod isa;
mod math;
mod scalar;
#[cfg(target_arch = "x86_64")]
mod vector;

pub use base::Base;
pub use dual::Dual;
pub use isa::{Isa, Kernel, UnknownIsa};
#[cfg(target_arch = "x86_64")]
pub use {
    avx2::{Avx2F32, Avx2F64},
    avx512::{Avx512F32, Avx512F64},
};

use core::fmt::Debug;
use core::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, MulAssign, Neg, Not, Sub, SubAssign};

/// Particles in a chunk, which lanes of every type divide: no register holds more.
pub const CHUNK: usize = 16;

/// An array of numbers, entry by entry: `tabulate!(3, |d| x[d] * y[d])`.
///
/// What `core::array::from_fn` does, but without a closure: a closure is compiled on its own, without the instruction set that
/// [`Isa::run`] chose, and the register operations in it are then calls.
#[macro_export]
macro_rules! tabulate {
    ($n:expr, |$i:ident| $entry:expr) => {{
        let mut out = [$crate::Real::zero(); $n];
        let mut $i = 0;
        while $i < $n {
            out[$i] = $entry;
            $i += 1;
        }
        out
    }};
}

/// Asks for the cache line at `at` ahead of its use. Any address may be given; nothing is read.
#[inline(always)]
pub fn prefetch<T>(at: *const T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint that faults at no address; SSE is part of x86-64.
    unsafe {
        core::arch::x86_64::_mm_prefetch::<{ core::arch::x86_64::_MM_HINT_T0 }>(at.cast())
    };
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}

/// The outcome of a comparison, one truth value a lane.
pub trait Mask: Copy + Debug + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self> {
    /// All lanes equal to `value`.
    fn splat(value: bool) -> Self;
    /// Is it true in any lane?
    fn any(self) -> bool;
    /// Is it true in every lane?
    fn all(self) -> bool;
    /// Bit i is lane i.
    fn bits(self) -> u16;
}

/// A real number, or several side by side.
pub trait Real:
    Copy
    + Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + 'static
{
    /// Truth values of comparisons.
    type Mask: Mask;
    /// Relative spacing of numbers near 1 in this precision.
    const EPSILON: f64;
    /// Least positive normal number in this precision.
    const TINY: f64;
    /// Does it carry derivatives? What need not be found without them is left out then.
    const VARIES: bool = false;

    /// The number without its derivatives.
    #[inline(always)]
    fn constant(self) -> Self {
        self
    }
    /// The number in every lane.
    fn splat(x: f64) -> Self;
    /// `self * a + b`, fused where the instruction set fuses.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Magnitude.
    fn abs(self) -> Self;
    /// The lesser; the second operand if either is NaN.
    fn min(self, other: Self) -> Self;
    /// The greater; the second operand if either is NaN.
    fn max(self, other: Self) -> Self;
    /// self < other.
    fn lt(self, other: Self) -> Self::Mask;
    /// self <= other.
    fn le(self, other: Self) -> Self::Mask;
    /// `a` where the mask is true, `b` elsewhere.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// Splits into m and e with self = m 2^e and m in [0.75, 1.5). Positive normal numbers only.
    fn split_exponent(self) -> (Self, Self);
    /// self · 2^k for a whole k within the exponent range of normal numbers.
    fn scale_exponent(self, k: Self) -> Self;
    /// Nearest whole number.
    fn round(self) -> Self;

    /// self > other.
    #[inline(always)]
    fn gt(self, other: Self) -> Self::Mask {
        other.lt(self)
    }
    /// self >= other.
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        other.le(self)
    }
    /// Zero.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }
    /// One.
    #[inline(always)]
    fn one() -> Self {
        Self::splat(1.0)
    }
    /// 1 / self.
    #[inline(always)]
    fn recip(self) -> Self {
        Self::one() / self
    }
    /// True where the number is neither NaN nor infinite.
    #[inline(always)]
    fn is_finite(self) -> Self::Mask {
        // 0 x is 0 exactly when x is finite, and NaN otherwise.
        (self * Self::zero()).abs().le(Self::zero())
    }
    /// Natural logarithm of a positive normal number; anything else gives an unspecified value.
    ///
    /// Relative error below 2.5 ulp of the type, also next to 1, where the series runs in (x - 1)/(x + 1).
    #[inline(always)]
    fn ln(self) -> Self {
        math::ln(self)
    }
    /// Exponential; the argument is clamped to where the result is a normal number. Relative error below 2 ulp.
    #[inline(always)]
    fn exp(self) -> Self {
        math::exp(self)
    }
}

/// A plain number.
///
/// # Safety
/// Whatever its bits are, they must be a number of the type, and none of them may be padding.
pub unsafe trait Plain: Copy + Default + Debug + PartialEq + Send + Sync + 'static {}
// SAFETY: integers and floats are that.
unsafe impl Plain for u16 {}
// SAFETY: as above.
unsafe impl Plain for u32 {}
// SAFETY: as above.
unsafe impl Plain for i32 {}
// SAFETY: as above.
unsafe impl Plain for f32 {}
// SAFETY: as above.
unsafe impl Plain for f64 {}

/// A scalar that state is stored in: `f32` or `f64`.
pub trait Float: Real<Mask = bool> + PartialOrd + Plain {
    /// How a position inside its cell is stored: `u32` counts of 2^-32 cell for f32, the fraction itself for f64.
    type Offset: Plain;
    /// Lanes without any instruction-set extension.
    type Base: Lanes<Scalar = Self>;
    /// Lanes on AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    type Avx2: Lanes<Scalar = Self>;
    /// Lanes on AVX-512.
    #[cfg(target_arch = "x86_64")]
    type Avx512: Lanes<Scalar = Self>;
    /// "f32" or "f64".
    const NAME: &'static str;

    /// Rounds to this precision.
    fn from_f64(x: f64) -> Self;
    /// Widens; exact.
    fn to_f64(self) -> f64;
    /// The fraction of a cell that an offset stands for; exact.
    fn offset_to_f64(offset: Self::Offset) -> f64;
    /// The offset nearest to a fraction in [0, 1); `None` if it rounds up to a whole cell.
    fn offset_from_f64(fraction: f64) -> Option<Self::Offset>;
}

/// Nodes of a row along z in a register, each with four scalars: momentum (or velocity) and mass.
///
/// A row that particles touch has three nodes. Where a register holds fewer it is cut in parts, of [`Lanes::Near`] and [`Lanes::Far`].
pub trait Row: Copy + Add<Output = Self> + Mul<Output = Self> + Neg<Output = Self> + AddAssign {
    /// The scalar in each lane.
    type Scalar: Float;
    /// Nodes in it: a quarter of its lanes.
    const NODES: usize;

    /// Reads a scalar for each lane.
    ///
    /// # Safety
    /// `from` must be valid for reading as many scalars; no alignment is asked for.
    unsafe fn load(from: *const Self::Scalar) -> Self;
    /// Writes the scalar of each lane.
    ///
    /// # Safety
    /// `to` must be valid for writing as many scalars; no alignment is asked for.
    unsafe fn store(self, to: *mut Self::Scalar);
    /// The same scalar in every lane.
    fn fill(x: Self::Scalar) -> Self;
    /// Reads four scalars and repeats them for each node.
    ///
    /// # Safety
    /// `from` must be valid for reading 4 scalars.
    unsafe fn repeat4(from: *const Self::Scalar) -> Self;
    /// Reads a scalar for each node: lane 4 g + c becomes the scalar `from[g]`.
    ///
    /// # Safety
    /// `from` must be valid for reading as many scalars as there are nodes.
    unsafe fn spread(from: *const Self::Scalar) -> Self;
    /// Adds `a * b`, fused where the instruction set fuses.
    fn add_product(&mut self, a: Self, b: Self);
}

/// Reals that fill a register, with the moves that the transfers between particles and grid need.
pub trait Lanes: Real + Row {
    /// Lanes in it; they divide a chunk.
    const COUNT: usize = 4 * Self::NODES;
    /// The first nodes of a row: all three, or as many as fit.
    type Near: Row<Scalar = Self::Scalar>;
    /// The others, if there are any: as many as fit, again and again.
    type Far: Row<Scalar = Self::Scalar>;

    /// Folds rows of three nodes with as many zeros behind them as make four, `stride` scalars apart: group g of the first result is the
    /// sum of the g-th row's nodes, group g of the second its third node less its first.
    ///
    /// # Safety
    /// `rows` must be valid for reading 16 scalars of each of [`Row::NODES`] rows; the zeros may be missing where
    /// [`Lanes::Near`] is no longer than three nodes.
    unsafe fn fold(rows: *const Self::Scalar, stride: usize) -> (Self, Self);
    /// Reads a scalar for each lane from the beginning of `from`.
    ///
    /// # Panics
    /// If there are fewer.
    #[inline(always)]
    fn read(from: &[Self::Scalar]) -> Self {
        // SAFETY: there is a scalar for each lane.
        unsafe { Self::load(from[..Self::COUNT].as_ptr()) }
    }
    /// Writes the scalar of each lane to the beginning of `to`.
    ///
    /// # Panics
    /// If there is no room for them.
    #[inline(always)]
    fn write(self, to: &mut [Self::Scalar]) {
        // SAFETY: there is room for the scalar of each lane.
        unsafe { self.store(to[..Self::COUNT].as_mut_ptr()) }
    }
    /// The last lane of each group of four, in all lanes of the group.
    fn fourth(self) -> Self;
    /// Transposes within each group of four lanes: lane 4 g + c of row k and lane 4 g + k of row c change places.
    fn transpose4(rows: &mut [Self; 4]);
    /// Sum of the lanes, in a fixed order.
    fn sum(self) -> Self::Scalar;
    /// Greatest lane.
    fn max_lane(self) -> Self::Scalar;

    /// Places of cells in an array, one a lane: the sum over axes of (cell − first) · stride. Returns whether any cell − first is
    /// outside 0..=most.
    ///
    /// # Safety
    /// Each of `cells` must be valid for reading an entry for each lane, `places` for writing them.
    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32, places: *mut u32) -> bool {
        let mut outside = false;
        for lane in 0..Self::COUNT {
            let mut place = 0u32;
            for d in 0..3 {
                // SAFETY: the caller vouches for the entries.
                let from_first = unsafe { *cells[d].add(lane) }.wrapping_sub(first[d]);
                outside |= from_first as u32 > most;
                place = place.wrapping_add(from_first.wrapping_mul(stride[d]) as u32);
            }
            // SAFETY: as above.
            unsafe { *places.add(lane) = place };
        }
        outside
    }

    /// Reads offsets, one a lane, as fractions of a cell.
    ///
    /// # Safety
    /// `from` must be valid for reading as many offsets.
    unsafe fn load_offset(from: *const <Self::Scalar as Float>::Offset) -> Self;
    /// Moves particles, one a lane, along one axis by `delta` cells, |delta| <= 0.5, carrying into the integer cell.
    ///
    /// # Safety
    /// Both pointers must be valid for reading and writing as many entries.
    unsafe fn advance(offset: *mut <Self::Scalar as Float>::Offset, cell: *mut i32, delta: Self);
}
