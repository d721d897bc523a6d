//! Dual numbers: a value and its derivative along one direction.

use crate::Real;
use core::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// `value + epsilon · derivative`, epsilon² = 0. Comparisons and selections look at the value alone, so a derivative
/// taken on a kink is the one-sided derivative of the branch that the value takes.
#[derive(Clone, Copy, Debug)]
pub struct Dual<T> {
    /// The number.
    pub value: T,
    /// Its derivative along the seeded direction.
    pub derivative: T,
}

impl<T: Real> Dual<T> {
    /// A number with derivative `derivative`.
    #[inline(always)]
    pub fn new(value: T, derivative: T) -> Self {
        Self { value, derivative }
    }
    /// A number that does not vary.
    #[inline(always)]
    pub fn fixed(value: T) -> Self {
        Self { value, derivative: T::zero() }
    }
}

impl<T: Real> Add for Dual<T> {
    type Output = Self;
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        Self::new(self.value + o.value, self.derivative + o.derivative)
    }
}
impl<T: Real> Sub for Dual<T> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        Self::new(self.value - o.value, self.derivative - o.derivative)
    }
}
impl<T: Real> Mul for Dual<T> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        Self::new(self.value * o.value, self.derivative.mul_add(o.value, self.value * o.derivative))
    }
}
impl<T: Real> Div for Dual<T> {
    type Output = Self;
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        let quotient = self.value / o.value;
        Self::new(quotient, (self.derivative - quotient * o.derivative) / o.value)
    }
}
impl<T: Real> Neg for Dual<T> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self::new(-self.value, -self.derivative)
    }
}
impl<T: Real> AddAssign for Dual<T> {
    #[inline(always)]
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}
impl<T: Real> SubAssign for Dual<T> {
    #[inline(always)]
    fn sub_assign(&mut self, o: Self) {
        *self = *self - o;
    }
}
impl<T: Real> MulAssign for Dual<T> {
    #[inline(always)]
    fn mul_assign(&mut self, o: Self) {
        *self = *self * o;
    }
}

impl<T: Real> Real for Dual<T> {
    type Mask = T::Mask;
    const EPSILON: f64 = T::EPSILON;
    const TINY: f64 = T::TINY;
    const VARIES: bool = true;

    #[inline(always)]
    fn constant(self) -> Self {
        Self::fixed(self.value)
    }

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self::fixed(T::splat(x))
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self::new(
            self.value.mul_add(a.value, b.value),
            self.derivative.mul_add(a.value, self.value.mul_add(a.derivative, b.derivative)),
        )
    }
    /// The derivative of the root at 0 is taken as 0.
    #[inline(always)]
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        let positive = root.gt(T::zero());
        let slope = T::select(positive, T::splat(0.5) / T::select(positive, root, T::one()), T::zero());
        Self::new(root, slope * self.derivative)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::select(self.value.lt(T::zero()), -self, self)
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        Self::select(self.value.lt(o.value), self, o)
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        Self::select(self.value.gt(o.value), self, o)
    }
    #[inline(always)]
    fn lt(self, o: Self) -> T::Mask {
        self.value.lt(o.value)
    }
    #[inline(always)]
    fn le(self, o: Self) -> T::Mask {
        self.value.le(o.value)
    }
    #[inline(always)]
    fn select(mask: T::Mask, a: Self, b: Self) -> Self {
        Self::new(T::select(mask, a.value, b.value), T::select(mask, a.derivative, b.derivative))
    }
    #[inline(always)]
    fn split_exponent(self) -> (Self, Self) {
        let (m, e) = self.value.split_exponent();
        // The exponent is a constant between powers of two, so the mantissa takes all of the derivative.
        (Self::new(m, self.derivative.scale_exponent(-e)), Self::fixed(e))
    }
    #[inline(always)]
    fn scale_exponent(self, k: Self) -> Self {
        Self::new(self.value.scale_exponent(k.value), self.derivative.scale_exponent(k.value))
    }
    #[inline(always)]
    fn round(self) -> Self {
        Self::fixed(self.value.round())
    }
    #[inline(always)]
    fn is_finite(self) -> T::Mask {
        self.value.is_finite()
    }
    #[inline(always)]
    fn ln(self) -> Self {
        Self::new(self.value.ln(), self.derivative / self.value)
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let e = self.value.exp();
        Self::new(e, e * self.derivative)
    }
}
