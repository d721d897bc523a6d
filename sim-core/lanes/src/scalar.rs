//! `f32` and `f64` as [`Real`].

use crate::{Base, Float, Mask, Real};

impl Mask for bool {
    #[inline(always)]
    fn splat(value: bool) -> Self {
        value
    }
    #[inline(always)]
    fn any(self) -> bool {
        self
    }
    #[inline(always)]
    fn all(self) -> bool {
        self
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        u16::from(self)
    }
}

macro_rules! scalar {
    ($t:ident, $bits:ident, $int:ident, $mantissa:expr, $bias:expr, $threshold:expr) => {
        impl Real for $t {
            type Mask = bool;
            const EPSILON: f64 = $t::EPSILON as f64;
            const TINY: f64 = $t::MIN_POSITIVE as f64;

            #[inline(always)]
            fn splat(x: f64) -> Self {
                x as $t
            }
            // Not f32::mul_add: without the FMA instruction that is a slow library call.
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                self * a + b
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $t::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                $t::abs(self)
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                if self < other { self } else { other }
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
            #[inline(always)]
            fn lt(self, other: Self) -> bool {
                self < other
            }
            #[inline(always)]
            fn le(self, other: Self) -> bool {
                self <= other
            }
            #[inline(always)]
            fn select(mask: bool, a: Self, b: Self) -> Self {
                if mask { a } else { b }
            }
            #[inline(always)]
            fn split_exponent(self) -> (Self, Self) {
                // Shifting the bits by those of 0.75 puts the break between exponents at 0.75 instead of 1.
                let bits = self.to_bits();
                let e = (bits.wrapping_sub($threshold) as $int) >> $mantissa;
                let m = $t::from_bits(bits.wrapping_sub((e << $mantissa) as $bits));
                (m, e as $t)
            }
            #[inline(always)]
            fn scale_exponent(self, k: Self) -> Self {
                self * $t::from_bits(((k as $int + $bias) as $bits) << $mantissa)
            }
            #[inline(always)]
            fn round(self) -> Self {
                $t::round_ties_even(self)
            }
        }
    };
}
scalar!(f32, u32, i32, 23, 127, 0x3f40_0000);
scalar!(f64, u64, i64, 52, 1023, 0x3fe8_0000_0000_0000);

impl Float for f32 {
    type Offset = u32;
    type Base = Base<f32>;
    #[cfg(target_arch = "x86_64")]
    type Avx2 = crate::Avx2F32;
    #[cfg(target_arch = "x86_64")]
    type Avx512 = crate::Avx512F32;
    const NAME: &'static str = "f32";

    #[inline(always)]
    fn from_f64(x: f64) -> Self {
        x as f32
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn offset_to_f64(offset: u32) -> f64 {
        f64::from(offset) / 4_294_967_296.0
    }
    #[inline(always)]
    fn offset_from_f64(fraction: f64) -> Option<u32> {
        let counts = (fraction * 4_294_967_296.0).round();
        (counts < 4_294_967_296.0).then_some(counts as u32)
    }
}

impl Float for f64 {
    type Offset = f64;
    type Base = Base<f64>;
    #[cfg(target_arch = "x86_64")]
    type Avx2 = crate::Avx2F64;
    #[cfg(target_arch = "x86_64")]
    type Avx512 = crate::Avx512F64;
    const NAME: &'static str = "f64";

    #[inline(always)]
    fn from_f64(x: f64) -> Self {
        x
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn offset_to_f64(offset: f64) -> f64 {
        offset
    }
    #[inline(always)]
    fn offset_from_f64(fraction: f64) -> Option<f64> {
        (fraction < 1.0).then_some(fraction)
    }
}
