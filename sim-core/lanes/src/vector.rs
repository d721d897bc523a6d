//! 16 lanes as N registers of one instruction set; [`Register`] is the little that differs between sets.
//!
//! Loops, not closures: a closure is compiled on its own, without the instruction set, and what it calls is then not inlined.

use crate::{LANES, Mask, Real};
use core::fmt::Debug;
use core::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, MulAssign, Neg, Not, Sub, SubAssign};

/// One vector register. Every method must be inlined into code compiled for the instruction set.
pub trait Register: Copy + Debug + 'static {
    /// Its scalar.
    type Scalar: Real;
    /// Truth values of a comparison, as the instruction set likes them.
    type Bits: Copy + Debug + 'static;
    /// Scalars in it.
    const WIDTH: usize;

    fn fill(x: Self::Scalar) -> Self;
    fn add(self, o: Self) -> Self;
    fn sub(self, o: Self) -> Self;
    fn mul(self, o: Self) -> Self;
    fn div(self, o: Self) -> Self;
    fn fma(self, a: Self, b: Self) -> Self;
    fn neg(self) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    fn min(self, o: Self) -> Self;
    fn max(self, o: Self) -> Self;
    fn round(self) -> Self;
    fn lt(self, o: Self) -> Self::Bits;
    fn le(self, o: Self) -> Self::Bits;
    fn select(mask: Self::Bits, a: Self, b: Self) -> Self;
    fn split_exponent(self) -> (Self, Self);
    fn scale_exponent(self, k: Self) -> Self;

    fn and(a: Self::Bits, b: Self::Bits) -> Self::Bits;
    fn or(a: Self::Bits, b: Self::Bits) -> Self::Bits;
    fn not(a: Self::Bits) -> Self::Bits;
    fn bits(a: Self::Bits) -> u16;
    fn truth(value: bool) -> Self::Bits;
}

/// 16 lanes in N registers.
#[derive(Clone, Copy, Debug)]
pub struct Wide<R, const N: usize>(pub(crate) [R; N]);

/// Truth values of [`Wide`].
#[derive(Clone, Copy, Debug)]
pub struct WideMask<R: Register, const N: usize>([R::Bits; N]);

impl<R: Register, const N: usize> BitAnd for WideMask<R, N> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, o: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::and(self.0[i], o.0[i]);
        }
        out
    }
}
impl<R: Register, const N: usize> BitOr for WideMask<R, N> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, o: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::or(self.0[i], o.0[i]);
        }
        out
    }
}
impl<R: Register, const N: usize> Not for WideMask<R, N> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::not(self.0[i]);
        }
        out
    }
}
impl<R: Register, const N: usize> Mask for WideMask<R, N> {
    #[inline(always)]
    fn splat(value: bool) -> Self {
        Self([R::truth(value); N])
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
    #[inline(always)]
    fn all(self) -> bool {
        self.bits() == u16::MAX
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        const { assert!(R::WIDTH * N == LANES) };
        let mut bits = 0;
        for i in 0..N {
            bits |= R::bits(self.0[i]) << (i * R::WIDTH);
        }
        bits
    }
}

macro_rules! operator {
    ($trait:ident, $f:ident, $assign:ident, $fa:ident) => {
        impl<R: Register, const N: usize> $trait for Wide<R, N> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                let mut out = self;
                for i in 0..N {
                    out.0[i] = R::$f(self.0[i], o.0[i]);
                }
                out
            }
        }
        impl<R: Register, const N: usize> $assign for Wide<R, N> {
            #[inline(always)]
            fn $fa(&mut self, o: Self) {
                *self = self.$f(o);
            }
        }
    };
}
operator!(Add, add, AddAssign, add_assign);
operator!(Sub, sub, SubAssign, sub_assign);
operator!(Mul, mul, MulAssign, mul_assign);
impl<R: Register, const N: usize> Div for Wide<R, N> {
    type Output = Self;
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::div(self.0[i], o.0[i]);
        }
        out
    }
}
impl<R: Register, const N: usize> Neg for Wide<R, N> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::neg(self.0[i]);
        }
        out
    }
}

impl<R: Register, const N: usize> Real for Wide<R, N> {
    type Mask = WideMask<R, N>;
    const EPSILON: f64 = R::Scalar::EPSILON;
    const TINY: f64 = R::Scalar::TINY;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self([R::fill(R::Scalar::splat(x)); N])
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::fma(self.0[i], a.0[i], b.0[i]);
        }
        out
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::sqrt(self.0[i]);
        }
        out
    }
    #[inline(always)]
    fn abs(self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::abs(self.0[i]);
        }
        out
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::min(self.0[i], o.0[i]);
        }
        out
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::max(self.0[i], o.0[i]);
        }
        out
    }
    #[inline(always)]
    fn lt(self, o: Self) -> Self::Mask {
        let mut out = WideMask([R::truth(false); N]);
        for i in 0..N {
            out.0[i] = R::lt(self.0[i], o.0[i]);
        }
        out
    }
    #[inline(always)]
    fn le(self, o: Self) -> Self::Mask {
        let mut out = WideMask([R::truth(false); N]);
        for i in 0..N {
            out.0[i] = R::le(self.0[i], o.0[i]);
        }
        out
    }
    #[inline(always)]
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
        let mut out = a;
        for i in 0..N {
            out.0[i] = R::select(mask.0[i], a.0[i], b.0[i]);
        }
        out
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let (mut mantissa, mut exponent) = (self, self);
        for i in 0..N {
            (mantissa.0[i], exponent.0[i]) = R::split_exponent(self.0[i]);
        }
        (mantissa, exponent)
    }
    #[inline(always)]
    fn scale_exponent(self, k: Self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::scale_exponent(self.0[i], k.0[i]);
        }
        out
    }
    #[inline(always)]
    fn round(self) -> Self {
        let mut out = self;
        for i in 0..N {
            out.0[i] = R::round(self.0[i]);
        }
        out
    }
}

/// The [`crate::Lanes`] methods that go through memory, for register types that have nothing faster.
macro_rules! lanes_through_memory {
    ($scalar:ident) => {
        type Scalar = $scalar;

        #[inline(always)]
        unsafe fn load(from: *const $scalar) -> Self {
            // SAFETY: the caller vouches for 16 readable scalars; the registers are plain bits.
            unsafe { from.cast::<Self>().read_unaligned() }
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut $scalar) {
            // SAFETY: the caller vouches for 16 writable scalars.
            unsafe { to.cast::<Self>().write_unaligned(self) }
        }
        #[inline(always)]
        fn fill(x: $scalar) -> Self {
            Self([Register::fill(x); _])
        }
        #[inline(always)]
        fn sum(self) -> $scalar {
            let mut lanes = [0.0; LANES];
            // SAFETY: the array holds 16 scalars.
            unsafe { self.store(lanes.as_mut_ptr()) };
            lanes.iter().fold(0.0, |s, &x| s + x)
        }
        #[inline(always)]
        fn max_lane(self) -> $scalar {
            let mut lanes = [0.0; LANES];
            // SAFETY: the array holds 16 scalars.
            unsafe { self.store(lanes.as_mut_ptr()) };
            lanes.iter().fold(lanes[0], |m, &x| Real::max(m, x))
        }
    };
}

/// Transposition through memory.
macro_rules! transpose_through_memory {
    ($scalar:ident) => {
        #[inline(always)]
        fn transpose4(rows: &mut [Self; 4]) {
            let mut from = [[0.0 as $scalar; LANES]; 4];
            for (row, line) in rows.iter().zip(&mut from) {
                // SAFETY: each line holds 16 scalars.
                unsafe { row.store(line.as_mut_ptr()) };
            }
            let mut to = [[0.0 as $scalar; LANES]; 4];
            for c in 0..4 {
                for i in 0..LANES {
                    to[c][i] = from[i % 4][i / 4 * 4 + c];
                }
            }
            for (row, line) in rows.iter_mut().zip(&to) {
                // SAFETY: each line holds 16 scalars.
                *row = unsafe { Self::load(line.as_ptr()) };
            }
        }
    };
}

/// Offsets and moves for f64, lane by lane.
macro_rules! advance_f64 {
    () => {
        #[inline(always)]
        unsafe fn load_offset(from: *const f64) -> Self {
            // SAFETY: the caller vouches for 16 readable offsets.
            unsafe { Self::load(from) }
        }
        #[inline(always)]
        unsafe fn advance(offset: *mut f64, cell: *mut i32, delta: Self) {
            let mut moves = [0.0; LANES];
            // SAFETY: the array holds 16 scalars.
            unsafe { delta.store(moves.as_mut_ptr()) };
            for i in 0..LANES {
                // SAFETY: the caller vouches for 16 readable and writable entries of each.
                unsafe { f64::advance_one(&mut *offset.add(i), &mut *cell.add(i), moves[i]) }
            }
        }
    };
}

pub(crate) use {advance_f64, lanes_through_memory, transpose_through_memory};
