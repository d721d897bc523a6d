//! A chunk as a plain array: what every machine has, and what the compiler vectorises as far as it may.

use crate::{CHUNK, Float, Lanes, Mask, Real, Row};
use core::array::from_fn;
use core::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, MulAssign, Neg, Not, Sub, SubAssign};

/// 16 scalars without any instruction-set extension.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub struct Base<T>([T; CHUNK]);

/// Truth values of [`Base`].
#[derive(Clone, Copy, Debug)]
pub struct BaseMask([bool; CHUNK]);

impl BitAnd for BaseMask {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, o: Self) -> Self {
        Self(from_fn(|i| self.0[i] & o.0[i]))
    }
}
impl BitOr for BaseMask {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, o: Self) -> Self {
        Self(from_fn(|i| self.0[i] | o.0[i]))
    }
}
impl Not for BaseMask {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(from_fn(|i| !self.0[i]))
    }
}
impl Mask for BaseMask {
    #[inline(always)]
    fn splat(value: bool) -> Self {
        Self([value; CHUNK])
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.0.iter().any(|&b| b)
    }
    #[inline(always)]
    fn all(self) -> bool {
        self.0.iter().all(|&b| b)
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        (0..CHUNK).fold(0, |bits, i| bits | (u16::from(self.0[i]) << i))
    }
}

macro_rules! operator {
    ($trait:ident, $f:ident, $assign:ident, $fa:ident) => {
        impl<T: Float> $trait for Base<T> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                Self(from_fn(|i| self.0[i].$f(o.0[i])))
            }
        }
        impl<T: Float> $assign for Base<T> {
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
impl<T: Float> Div for Base<T> {
    type Output = Self;
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        Self(from_fn(|i| self.0[i] / o.0[i]))
    }
}
impl<T: Float> Neg for Base<T> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(from_fn(|i| -self.0[i]))
    }
}

impl<T: Float> Real for Base<T> {
    type Mask = BaseMask;
    const EPSILON: f64 = T::EPSILON;
    const TINY: f64 = T::TINY;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self([T::splat(x); CHUNK])
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self(from_fn(|i| self.0[i].mul_add(a.0[i], b.0[i])))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(T::sqrt))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(T::abs))
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        Self(from_fn(|i| self.0[i].min(o.0[i])))
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        Self(from_fn(|i| self.0[i].max(o.0[i])))
    }
    #[inline(always)]
    fn lt(self, o: Self) -> BaseMask {
        BaseMask(from_fn(|i| self.0[i] < o.0[i]))
    }
    #[inline(always)]
    fn le(self, o: Self) -> BaseMask {
        BaseMask(from_fn(|i| self.0[i] <= o.0[i]))
    }
    #[inline(always)]
    fn select(mask: BaseMask, a: Self, b: Self) -> Self {
        Self(from_fn(|i| if mask.0[i] { a.0[i] } else { b.0[i] }))
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let parts = self.0.map(T::split_exponent);
        (Self(parts.map(|p| p.0)), Self(parts.map(|p| p.1)))
    }
    #[inline(always)]
    fn scale_exponent(self, k: Self) -> Self {
        Self(from_fn(|i| self.0[i].scale_exponent(k.0[i])))
    }
    #[inline(always)]
    fn round(self) -> Self {
        Self(self.0.map(T::round))
    }
}

/// Moves one coordinate.
pub(crate) trait Advance: Float {
    /// See [`Lanes::advance`].
    fn advance_one(offset: &mut Self::Offset, cell: &mut i32, delta: Self);
}
impl Advance for f32 {
    #[inline(always)]
    fn advance_one(offset: &mut u32, cell: &mut i32, delta: f32) {
        let counts = (delta * 4_294_967_296.0).round_ties_even() as i32;
        let (moved, carry) = offset.overflowing_add_signed(counts);
        *offset = moved;
        *cell += if carry { counts.signum() } else { 0 };
    }
}
impl Advance for f64 {
    #[inline(always)]
    fn advance_one(offset: &mut f64, cell: &mut i32, delta: f64) {
        let moved = *offset + delta;
        let whole = moved.floor();
        let fraction = moved - whole;
        // A tiny negative move from 0 rounds to fraction 1: that is the next cell's 0.
        let rounds_up = fraction >= 1.0;
        *offset = if rounds_up { 0.0 } else { fraction };
        *cell += whole as i32 + i32::from(rounds_up);
    }
}

impl<T: Float> Row for Base<T> {
    type Scalar = T;
    const NODES: usize = CHUNK / 4;

    #[inline(always)]
    unsafe fn load(from: *const T) -> Self {
        // SAFETY: the caller vouches for 16 readable scalars.
        Self(unsafe { from.cast::<[T; CHUNK]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut T) {
        // SAFETY: the caller vouches for 16 writable scalars.
        unsafe { to.cast::<[T; CHUNK]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    fn fill(x: T) -> Self {
        Self([x; CHUNK])
    }
    #[inline(always)]
    unsafe fn repeat4(from: *const T) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars.
        let four = unsafe { from.cast::<[T; 4]>().read_unaligned() };
        Self(from_fn(|i| four[i % 4]))
    }
    #[inline(always)]
    unsafe fn spread(from: *const T) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars.
        let four = unsafe { from.cast::<[T; 4]>().read_unaligned() };
        Self(from_fn(|i| four[i / 4]))
    }
    #[inline(always)]
    fn add_product(&mut self, a: Self, b: Self) {
        *self = a.mul_add(b, *self);
    }
}

impl<T: Float + Advance> Lanes for Base<T> {
    type Near = Self;
    type Far = Self;

    #[inline(always)]
    unsafe fn fold(rows: *const T, stride: usize) -> (Self, Self) {
        // SAFETY: the caller vouches for 16 readable scalars in each of four rows.
        let rows: [[T; CHUNK]; 4] = from_fn(|g| unsafe { Self::load(rows.add(g * stride)) }.0);
        let of = |i: usize, g: usize| rows[i / 4][4 * g + i % 4];
        let sum = Self(from_fn(|i| of(i, 0) + of(i, 2) + of(i, 1)));
        (sum, Self(from_fn(|i| of(i, 2) - of(i, 0))))
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        Self(from_fn(|i| self.0[i | 3]))
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        let old = *rows;
        for (c, row) in rows.iter_mut().enumerate() {
            *row = Self(from_fn(|i| old[i % 4].0[i / 4 * 4 + c]));
        }
    }
    #[inline(always)]
    fn sum(self) -> T {
        self.0.iter().fold(T::zero(), |s, &x| s + x)
    }
    #[inline(always)]
    fn max_lane(self) -> T {
        self.0.iter().fold(self.0[0], |m, &x| m.max(x))
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const T::Offset) -> Self {
        // SAFETY: the caller vouches for 16 readable offsets.
        let offsets = unsafe { from.cast::<[T::Offset; CHUNK]>().read_unaligned() };
        Self(offsets.map(|o| T::from_f64(T::offset_to_f64(o))))
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut T::Offset, cell: *mut i32, delta: Self) {
        for i in 0..CHUNK {
            // SAFETY: the caller vouches for 16 readable and writable entries of each.
            unsafe { T::advance_one(&mut *offset.add(i), &mut *cell.add(i), delta.0[i]) }
        }
    }
}
