//! Dual numbers: a value and its derivatives along some directions.

use crate::Real;
use core::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// `value + Σ epsilonₖ · derivatives[k]`, where products of epsilons are 0. Comparisons and selections look at the value alone, so a derivative
/// taken on a kink is the one-sided derivative of the branch that the value takes.
///
/// The value is worked out once for all directions.
#[derive(Clone, Copy, Debug)]
pub struct Dual<T, const N: usize> {
    /// The number.
    pub value: T,
    /// Its derivatives, direction by direction.
    pub derivatives: [T; N],
}

impl<T: Real, const N: usize> Dual<T, N> {
    /// A number with these derivatives.
    #[inline(always)]
    pub fn new(value: T, derivatives: [T; N]) -> Self {
        Self { value, derivatives }
    }
    /// A number that does not vary.
    #[inline(always)]
    pub fn fixed(value: T) -> Self {
        Self { value, derivatives: [T::zero(); N] }
    }
    /// Of a function of this number, its value and its slope there.
    #[inline(always)]
    fn chain(self, value: T, slope: T) -> Self {
        let mut result = Self::new(value, self.derivatives);
        for derivative in &mut result.derivatives {
            *derivative *= slope;
        }
        result
    }
}

// Loops, never closures: a closure cannot be told to be inlined always, and one that is not is compiled without the vector instructions.

impl<T: Real, const N: usize> Add for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn add(mut self, o: Self) -> Self {
        for (own, other) in self.derivatives.iter_mut().zip(&o.derivatives) {
            *own += *other;
        }
        Self::new(self.value + o.value, self.derivatives)
    }
}
impl<T: Real, const N: usize> Sub for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn sub(mut self, o: Self) -> Self {
        for (own, other) in self.derivatives.iter_mut().zip(&o.derivatives) {
            *own -= *other;
        }
        Self::new(self.value - o.value, self.derivatives)
    }
}
impl<T: Real, const N: usize> Mul for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn mul(mut self, o: Self) -> Self {
        for (own, other) in self.derivatives.iter_mut().zip(&o.derivatives) {
            *own = own.mul_add(o.value, self.value * *other);
        }
        Self::new(self.value * o.value, self.derivatives)
    }
}
impl<T: Real, const N: usize> Div for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn div(mut self, o: Self) -> Self {
        let (quotient, part) = (self.value / o.value, o.value.recip());
        for (own, other) in self.derivatives.iter_mut().zip(&o.derivatives) {
            *own = (*own - quotient * *other) * part;
        }
        Self::new(quotient, self.derivatives)
    }
}
impl<T: Real, const N: usize> Neg for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn neg(mut self) -> Self {
        for derivative in &mut self.derivatives {
            *derivative = -*derivative;
        }
        Self::new(-self.value, self.derivatives)
    }
}
impl<T: Real, const N: usize> AddAssign for Dual<T, N> {
    #[inline(always)]
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}
impl<T: Real, const N: usize> SubAssign for Dual<T, N> {
    #[inline(always)]
    fn sub_assign(&mut self, o: Self) {
        *self = *self - o;
    }
}
impl<T: Real, const N: usize> MulAssign for Dual<T, N> {
    #[inline(always)]
    fn mul_assign(&mut self, o: Self) {
        *self = *self * o;
    }
}

impl<T: Real, const N: usize> Real for Dual<T, N> {
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
    fn mul_add(mut self, a: Self, b: Self) -> Self {
        for (own, (by, plus)) in self.derivatives.iter_mut().zip(a.derivatives.iter().zip(&b.derivatives)) {
            *own = own.mul_add(a.value, self.value.mul_add(*by, *plus));
        }
        Self::new(self.value.mul_add(a.value, b.value), self.derivatives)
    }
    /// The derivative of the root at 0 is taken as 0.
    #[inline(always)]
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        let positive = root.gt(T::zero());
        let slope = T::select(positive, T::splat(0.5) / T::select(positive, root, T::one()), T::zero());
        self.chain(root, slope)
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
    fn select(mask: T::Mask, mut a: Self, b: Self) -> Self {
        for (own, other) in a.derivatives.iter_mut().zip(&b.derivatives) {
            *own = T::select(mask, *own, *other);
        }
        Self::new(T::select(mask, a.value, b.value), a.derivatives)
    }
    #[inline(always)]
    fn split_exponent(mut self) -> (Self, Self) {
        let (m, e) = self.value.split_exponent();
        // The exponent is a constant between powers of two, so the mantissa takes all of the derivative.
        for derivative in &mut self.derivatives {
            *derivative = derivative.scale_exponent(-e);
        }
        (Self::new(m, self.derivatives), Self::fixed(e))
    }
    #[inline(always)]
    fn scale_exponent(mut self, k: Self) -> Self {
        for derivative in &mut self.derivatives {
            *derivative = derivative.scale_exponent(k.value);
        }
        Self::new(self.value.scale_exponent(k.value), self.derivatives)
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
        self.chain(self.value.ln(), self.value.recip())
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let e = self.value.exp();
        self.chain(e, e)
    }
}
