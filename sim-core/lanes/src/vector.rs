//! Lanes that fill one register of an instruction set; [`Register`] is the little that differs between sets.

use crate::{Float, Mask, Real, Row};
use core::fmt::Debug;
use core::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, MulAssign, Neg, Not, Sub, SubAssign};

/// What a row of nodes needs of a register. Every method must be inlined into code compiled for the instruction set.
pub trait Plain: Copy + Debug + 'static {
    /// Its scalar.
    type Scalar: Float;
    /// Scalars in it.
    const WIDTH: usize;

    fn fill(x: Self::Scalar) -> Self;
    fn add(self, o: Self) -> Self;
    fn mul(self, o: Self) -> Self;
    fn fma(self, a: Self, b: Self) -> Self;
    fn neg(self) -> Self;
    /// See [`Row::repeat4`].
    unsafe fn repeat4(from: *const Self::Scalar) -> Self;
    /// See [`Row::spread`].
    unsafe fn spread(from: *const Self::Scalar) -> Self;
}

/// What arithmetic needs of it. Every method must be inlined likewise.
pub trait Register: Plain {
    /// Truth values of a comparison, as the instruction set likes them.
    type Bits: Copy + Debug + 'static;

    fn sub(self, o: Self) -> Self;
    fn div(self, o: Self) -> Self;
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

/// The lanes of one register.
#[derive(Clone, Copy, Debug)]
pub struct Wide<R>(pub(crate) R);

/// Truth values of [`Wide`].
#[derive(Clone, Copy, Debug)]
pub struct WideMask<R: Register>(R::Bits);

impl<R: Register> BitAnd for WideMask<R> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, o: Self) -> Self {
        Self(R::and(self.0, o.0))
    }
}
impl<R: Register> BitOr for WideMask<R> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, o: Self) -> Self {
        Self(R::or(self.0, o.0))
    }
}
impl<R: Register> Not for WideMask<R> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(R::not(self.0))
    }
}
impl<R: Register> Mask for WideMask<R> {
    #[inline(always)]
    fn splat(value: bool) -> Self {
        Self(R::truth(value))
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
    #[inline(always)]
    fn all(self) -> bool {
        self.bits() == u16::MAX >> (16 - R::WIDTH)
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        R::bits(self.0)
    }
}

macro_rules! operator {
    ($needs:ident, $trait:ident, $f:ident, $assign:ident, $fa:ident) => {
        impl<R: $needs> $trait for Wide<R> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                Self(self.0.$f(o.0))
            }
        }
        impl<R: $needs> $assign for Wide<R> {
            #[inline(always)]
            fn $fa(&mut self, o: Self) {
                *self = self.$f(o);
            }
        }
    };
}
operator!(Plain, Add, add, AddAssign, add_assign);
operator!(Register, Sub, sub, SubAssign, sub_assign);
operator!(Plain, Mul, mul, MulAssign, mul_assign);
impl<R: Register> Div for Wide<R> {
    type Output = Self;
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        Self(self.0.div(o.0))
    }
}
impl<R: Plain> Neg for Wide<R> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(self.0.neg())
    }
}

impl<R: Plain> Row for Wide<R> {
    type Scalar = R::Scalar;
    const NODES: usize = R::WIDTH / 4;

    #[inline(always)]
    unsafe fn load(from: *const R::Scalar) -> Self {
        // SAFETY: the caller vouches for the scalars; a register is plain bits.
        unsafe { from.cast::<Self>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut R::Scalar) {
        // SAFETY: the caller vouches for the room.
        unsafe { to.cast::<Self>().write_unaligned(self) }
    }
    #[inline(always)]
    fn fill(x: R::Scalar) -> Self {
        Self(R::fill(x))
    }
    #[inline(always)]
    unsafe fn repeat4(from: *const R::Scalar) -> Self {
        // SAFETY: as asked for.
        Self(unsafe { R::repeat4(from) })
    }
    #[inline(always)]
    unsafe fn spread(from: *const R::Scalar) -> Self {
        // SAFETY: as asked for.
        Self(unsafe { R::spread(from) })
    }
    #[inline(always)]
    fn add_product(&mut self, a: Self, b: Self) {
        self.0 = a.0.fma(b.0, self.0);
    }
}

impl<R: Register> Real for Wide<R> {
    type Mask = WideMask<R>;
    const EPSILON: f64 = R::Scalar::EPSILON;
    const TINY: f64 = R::Scalar::TINY;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self(R::fill(R::Scalar::splat(x)))
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self(self.0.fma(a.0, b.0))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.sqrt())
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.abs())
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        Self(self.0.min(o.0))
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        Self(self.0.max(o.0))
    }
    #[inline(always)]
    fn lt(self, o: Self) -> Self::Mask {
        WideMask(self.0.lt(o.0))
    }
    #[inline(always)]
    fn le(self, o: Self) -> Self::Mask {
        WideMask(self.0.le(o.0))
    }
    #[inline(always)]
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
        Self(R::select(mask.0, a.0, b.0))
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let (mantissa, exponent) = self.0.split_exponent();
        (Self(mantissa), Self(exponent))
    }
    #[inline(always)]
    fn scale_exponent(self, k: Self) -> Self {
        Self(self.0.scale_exponent(k.0))
    }
    #[inline(always)]
    fn round(self) -> Self {
        Self(self.0.round())
    }
}

/// The [`crate::Lanes`] methods that go through memory on all registers: none of them is asked for often.
macro_rules! sums_through_memory {
    ($scalar:ident) => {
        #[inline(always)]
        fn sum(self) -> $scalar {
            let mut lanes = [0.0; Self::COUNT];
            // SAFETY: the array holds as many scalars as there are lanes.
            unsafe { self.store(lanes.as_mut_ptr()) };
            lanes.iter().fold(0.0, |s, &x| s + x)
        }
        #[inline(always)]
        fn max_lane(self) -> $scalar {
            let mut lanes = [0.0; Self::COUNT];
            // SAFETY: the array holds as many scalars as there are lanes.
            unsafe { self.store(lanes.as_mut_ptr()) };
            lanes.iter().fold(lanes[0], |m, &x| Real::max(m, x))
        }
    };
}
pub(crate) use sums_through_memory;
