//! Logarithm and exponential, generic over the number type.

use crate::{Mask, Real};

/// ln(m 2^e) = e ln 2 + 2 atanh((m - 1)/(m + 1)), the series in odd powers.
#[inline(always)]
pub(crate) fn ln<T: Real>(x: T) -> T {
    let (m, e) = x.split_exponent();
    let f = m - T::one();
    let s = f / (m + T::one());
    let z = s * s;
    // |s| <= 0.2, so the first omitted term is below 2^-26 (f32) and 2^-55 (f64) of the sum.
    let terms: &[f64] = if T::EPSILON > 1e-10 {
        &[2.0 / 11.0, 2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0]
    } else {
        &[
            2.0 / 23.0,
            2.0 / 21.0,
            2.0 / 19.0,
            2.0 / 17.0,
            2.0 / 15.0,
            2.0 / 13.0,
            2.0 / 11.0,
            2.0 / 9.0,
            2.0 / 7.0,
            2.0 / 5.0,
            2.0 / 3.0,
        ]
    };
    let mut p = T::splat(terms[0]);
    for &c in &terms[1..] {
        p = p.mul_add(z, T::splat(c));
    }
    // f - s f = 2 s exactly in the reals; written so, the leading term keeps f's full precision near x = 1.
    let log1p = f - s * (f - z * p);
    // ln 2 in two parts: the high one has trailing zeros, so e * high is exact.
    let (high, low) = LN2_PARTS[usize::from(T::EPSILON < 1e-10)];
    e.mul_add(T::splat(high), e.mul_add(T::splat(low), log1p))
}

/// exp(k ln 2 + r) = 2^k e^r with |r| <= ln 2 / 2.
#[inline(always)]
pub(crate) fn exp<T: Real>(x: T) -> T {
    let double = T::EPSILON < 1e-10;
    let (least, greatest) = if double { (-708.0, 709.0) } else { (-87.0, 88.0) };
    // NaN must stay NaN through the clamp.
    let finite = x.is_finite();
    let clamped = x.max(T::splat(least)).min(T::splat(greatest));
    let k = (clamped * T::splat(core::f64::consts::LOG2_E)).round();
    let (high, low) = LN2_PARTS[usize::from(double)];
    let r = (-k).mul_add(T::splat(low), (-k).mul_add(T::splat(high), clamped));
    // Taylor's series; the first omitted term is below 2^-28 (f32) and 2^-57 (f64).
    let terms = &INVERSE_FACTORIALS[if double { 0 } else { 6 }..];
    let mut p = T::splat(terms[0]);
    for &c in &terms[1..] {
        p = p.mul_add(r, T::splat(c));
    }
    let y = p.scale_exponent(k);
    if finite.all() { y } else { T::select(finite | x.gt(T::zero()) | x.lt(T::zero()), y, x) }
}

/// (high, low) parts of ln 2 for f32 and f64.
const LN2_PARTS: [(f64, f64); 2] =
    [(0.693_145_751_953_125, 1.428_606_765_330_187e-6), (0.693_147_180_369_123_8, 1.908_214_929_270_587_7e-10)];

/// 1/13!, 1/12!, ... 1/0!.
const INVERSE_FACTORIALS: [f64; 14] = {
    let mut terms = [1.0; 14];
    let mut k = 1;
    while k < 14 {
        terms[13 - k] = terms[14 - k] / k as f64;
        k += 1;
    }
    terms
};
