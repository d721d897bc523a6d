//! AVX2 and FMA registers.

use crate::vector::{Plain, Register, Wide, sums_through_memory};
use crate::{Lanes, Real, Row};
use core::arch::x86_64::*;

/// Eight lanes of f32.
pub type Avx2F32 = Wide<__m256>;
/// Four lanes of f64.
pub type Avx2F64 = Wide<__m256d>;

// SAFETY of every block of this file: values of these types exist only in code that `Isa::run` entered after asking the machine
// for AVX2 and FMA; that pointers are valid, callers vouch for.

/// Methods of a register that are an instruction each.
macro_rules! instructions {
    ($($name:ident($($operand:ident),*) = $instruction:ident),*) => {
        $(
            #[inline(always)]
            fn $name(self $(, $operand: Self)*) -> Self {
                // SAFETY: see above.
                unsafe { $instruction(self $(, $operand)*) }
            }
        )*
    };
}
pub(crate) use instructions;

macro_rules! plain {
    ($reg:ident, $scalar:ident, $width:expr, $set1:ident, $add:ident, $mul:ident, $fma:ident, $xor:ident, |$from:ident| $repeat4:expr, $spread:expr) => {
        impl Plain for $reg {
            type Scalar = $scalar;
            const WIDTH: usize = $width;
            #[inline(always)]
            fn fill(x: $scalar) -> Self {
                // SAFETY: see above.
                unsafe { $set1(x) }
            }
            instructions!(add(o) = $add, mul(o) = $mul, fma(a, b) = $fma);
            #[inline(always)]
            fn neg(self) -> Self {
                // SAFETY: see above.
                unsafe { $xor(self, $set1(-0.0)) }
            }
            #[inline(always)]
            unsafe fn repeat4($from: *const $scalar) -> Self {
                // SAFETY: see above.
                unsafe { $repeat4 }
            }
            #[inline(always)]
            unsafe fn spread($from: *const $scalar) -> Self {
                // SAFETY: see above.
                unsafe { $spread }
            }
        }
    };
}
pub(crate) use plain;
plain!(
    __m256,
    f32,
    8,
    _mm256_set1_ps,
    _mm256_add_ps,
    _mm256_mul_ps,
    _mm256_fmadd_ps,
    _mm256_xor_ps,
    |from| _mm256_broadcast_ps(&from.cast::<__m128>().read_unaligned()),
    _mm256_blend_ps::<0xf0>(_mm256_set1_ps(*from), _mm256_set1_ps(*from.add(1)))
);
plain!(
    __m128,
    f32,
    4,
    _mm_set1_ps,
    _mm_add_ps,
    _mm_mul_ps,
    _mm_fmadd_ps,
    _mm_xor_ps,
    |from| _mm_loadu_ps(from),
    _mm_set1_ps(*from)
);
plain!(
    __m256d,
    f64,
    4,
    _mm256_set1_pd,
    _mm256_add_pd,
    _mm256_mul_pd,
    _mm256_fmadd_pd,
    _mm256_xor_pd,
    |from| _mm256_loadu_pd(from),
    _mm256_set1_pd(*from)
);

macro_rules! register {
    ($reg:ident, $set1:ident, $zero:ident, $sub:ident, $div:ident, $sqrt:ident, $min:ident, $max:ident, $round:ident, $cmp:ident,
     $blend:ident, $and:ident, $andnot:ident, $or:ident, $xor:ident, $movemask:ident, $split:ident, $scale:ident) => {
        impl Register for $reg {
            type Bits = $reg;
            instructions!(
                sub(o) = $sub,
                div(o) = $div,
                sqrt() = $sqrt,
                min(o) = $min,
                max(o) = $max,
                scale_exponent(k) = $scale
            );
            #[inline(always)]
            fn abs(self) -> Self {
                // SAFETY: see above.
                unsafe { $andnot($set1(-0.0), self) }
            }
            #[inline(always)]
            fn round(self) -> Self {
                // SAFETY: see above.
                unsafe { $round::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(self) }
            }
            #[inline(always)]
            fn lt(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $cmp::<_CMP_LT_OQ>(self, o) }
            }
            #[inline(always)]
            fn le(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $cmp::<_CMP_LE_OQ>(self, o) }
            }
            #[inline(always)]
            fn select(mask: Self, a: Self, b: Self) -> Self {
                // SAFETY: see above.
                unsafe { $blend(b, a, mask) }
            }
            #[inline(always)]
            fn split_exponent(self) -> (Self, Self) {
                // SAFETY: see above.
                unsafe { $split(self) }
            }
            #[inline(always)]
            fn and(a: Self, b: Self) -> Self {
                // SAFETY: see above.
                unsafe { $and(a, b) }
            }
            #[inline(always)]
            fn or(a: Self, b: Self) -> Self {
                // SAFETY: see above.
                unsafe { $or(a, b) }
            }
            #[inline(always)]
            fn not(a: Self) -> Self {
                // SAFETY: see above.
                unsafe { $xor(a, Self::truth(true)) }
            }
            #[inline(always)]
            fn bits(a: Self) -> u16 {
                // SAFETY: see above.
                unsafe { $movemask(a) as u16 }
            }
            #[inline(always)]
            fn truth(value: bool) -> Self {
                // SAFETY: see above.
                unsafe { if value { $cmp::<_CMP_EQ_OQ>($zero(), $zero()) } else { $zero() } }
            }
        }
    };
}
register!(
    __m256,
    _mm256_set1_ps,
    _mm256_setzero_ps,
    _mm256_sub_ps,
    _mm256_div_ps,
    _mm256_sqrt_ps,
    _mm256_min_ps,
    _mm256_max_ps,
    _mm256_round_ps,
    _mm256_cmp_ps,
    _mm256_blendv_ps,
    _mm256_and_ps,
    _mm256_andnot_ps,
    _mm256_or_ps,
    _mm256_xor_ps,
    _mm256_movemask_ps,
    split_f32,
    scale_f32
);
register!(
    __m256d,
    _mm256_set1_pd,
    _mm256_setzero_pd,
    _mm256_sub_pd,
    _mm256_div_pd,
    _mm256_sqrt_pd,
    _mm256_min_pd,
    _mm256_max_pd,
    _mm256_round_pd,
    _mm256_cmp_pd,
    _mm256_blendv_pd,
    _mm256_and_pd,
    _mm256_andnot_pd,
    _mm256_or_pd,
    _mm256_xor_pd,
    _mm256_movemask_pd,
    split_f64,
    scale_f64
);

/// Mantissa in [0.75, 1.5) and exponent: shifting the bits by those of 0.75 moves the break between exponents there.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn split_f32(x: __m256) -> (__m256, __m256) {
    let bits = _mm256_castps_si256(x);
    let e = _mm256_srai_epi32::<23>(_mm256_sub_epi32(bits, _mm256_set1_epi32(0x3f40_0000)));
    let m = _mm256_castsi256_ps(_mm256_sub_epi32(bits, _mm256_slli_epi32::<23>(e)));
    (m, _mm256_cvtepi32_ps(e))
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn scale_f32(x: __m256, k: __m256) -> __m256 {
    let biased = _mm256_add_epi32(_mm256_cvtps_epi32(k), _mm256_set1_epi32(127));
    _mm256_mul_ps(x, _mm256_castsi256_ps(_mm256_slli_epi32::<23>(biased)))
}

/// Adding 2^52 + 2^51 to a small whole number puts it, as an integer, into the low bits of the double.
const MAGIC: f64 = 6_755_399_441_055_744.0;

#[inline]
#[target_feature(enable = "avx2,fma")]
fn split_f64(x: __m256d) -> (__m256d, __m256d) {
    let bits = _mm256_castpd_si256(x);
    // AVX2 has no arithmetic shift of 64-bit integers: a bias of 2048 keeps the difference positive.
    let shifted = _mm256_sub_epi64(bits, _mm256_set1_epi64x(0x3fe8_0000_0000_0000));
    let biased = _mm256_add_epi64(shifted, _mm256_set1_epi64x(0x4000_0000_0000_0000));
    let e = _mm256_sub_epi64(_mm256_srli_epi64::<52>(biased), _mm256_set1_epi64x(0x400));
    let m = _mm256_castsi256_pd(_mm256_sub_epi64(bits, _mm256_slli_epi64::<52>(e)));
    let magic = _mm256_set1_pd(MAGIC);
    let whole = _mm256_castsi256_pd(_mm256_add_epi64(e, _mm256_castpd_si256(magic)));
    (m, _mm256_sub_pd(whole, magic))
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn scale_f64(x: __m256d, k: __m256d) -> __m256d {
    let whole = _mm256_castpd_si256(_mm256_add_pd(k, _mm256_set1_pd(MAGIC)));
    let biased = _mm256_add_epi64(whole, _mm256_set1_epi64x(1023));
    _mm256_mul_pd(x, _mm256_castsi256_pd(_mm256_slli_epi64::<52>(biased)))
}

/// Places of eight cells: [`Lanes::places`].
#[inline]
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn places_of_eight(
    cells: [*const i32; 3],
    first: [i32; 3],
    stride: [i32; 3],
    most: u32,
    places: *mut u32,
) -> bool {
    let limit = _mm256_set1_epi32(most.cast_signed());
    let (mut place, mut beyond) = (_mm256_setzero_si256(), _mm256_setzero_si256());
    for d in 0..3 {
        // SAFETY: the caller vouches for eight readable entries.
        let cell = unsafe { _mm256_loadu_si256(cells[d].cast()) };
        let from_first = _mm256_sub_epi32(cell, _mm256_set1_epi32(first[d]));
        // As unsigned numbers: what is not beyond the limit leaves it the greater one.
        beyond = _mm256_or_si256(beyond, _mm256_xor_si256(_mm256_max_epu32(from_first, limit), limit));
        place = _mm256_add_epi32(place, _mm256_mullo_epi32(from_first, _mm256_set1_epi32(stride[d])));
    }
    // SAFETY: the caller vouches for eight writable entries.
    unsafe { _mm256_storeu_si256(places.cast(), place) };
    _mm256_testz_si256(beyond, beyond) == 0
}

impl Lanes for Avx2F32 {
    type Near = Self;
    type Far = Wide<__m128>;
    sums_through_memory!(f32);

    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32, places: *mut u32) -> bool {
        // SAFETY: see above.
        unsafe { places_of_eight(cells, first, stride, most, places) }
    }
    #[inline(always)]
    unsafe fn fold(rows: *const f32, stride: usize) -> (Self, Self) {
        // A node of both rows. Put together while they are loaded, they do not queue for the port that shuffles.
        #[inline(always)]
        unsafe fn both(low: *const f32, high: *const f32) -> __m256 {
            // SAFETY: see above.
            unsafe { _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high)) }
        }
        // SAFETY: see above.
        unsafe {
            let (low, high) = (rows, rows.add(stride));
            let [a, b, c] = [both(low, high), both(low.add(4), high.add(4)), both(low.add(8), high.add(8))];
            (Wide(_mm256_add_ps(_mm256_add_ps(a, c), b)), Wide(_mm256_sub_ps(c, a)))
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: see above.
        unsafe { Wide(_mm256_permute_ps::<0xff>(self.0)) }
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        // SAFETY: see above.
        unsafe {
            let [a, b, c, d] = rows.map(|row| row.0);
            let (ab, cd) = (_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d));
            let (ab, cd) = (_mm256_castps_pd(ab), _mm256_castps_pd(cd));
            rows[0].0 = _mm256_castpd_ps(_mm256_unpacklo_pd(ab, cd));
            rows[1].0 = _mm256_castpd_ps(_mm256_unpackhi_pd(ab, cd));
            let (ab, cd) = (_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d));
            let (ab, cd) = (_mm256_castps_pd(ab), _mm256_castps_pd(cd));
            rows[2].0 = _mm256_castpd_ps(_mm256_unpacklo_pd(ab, cd));
            rows[3].0 = _mm256_castpd_ps(_mm256_unpackhi_pd(ab, cd));
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const u32) -> Self {
        // There is no conversion of unsigned numbers. Both halves of one are exact, so that their sum is rounded as it would be.
        // SAFETY: see above.
        unsafe {
            let counts = _mm256_loadu_si256(from.cast());
            let high = _mm256_cvtepi32_ps(_mm256_srli_epi32::<16>(counts));
            let low = _mm256_cvtepi32_ps(_mm256_and_si256(counts, _mm256_set1_epi32(0xffff)));
            let low = _mm256_mul_ps(low, _mm256_set1_ps(1.0 / 4_294_967_296.0));
            Wide(_mm256_fmadd_ps(high, _mm256_set1_ps(1.0 / 65_536.0), low))
        }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut u32, cell: *mut i32, delta: Self) {
        // SAFETY: see above.
        unsafe {
            let exact = _mm256_mul_ps(delta.0, _mm256_set1_ps(4_294_967_296.0));
            // Half a cell forwards is one count more than fits: the conversion makes i32::MIN of it, whose bits turned round are
            // i32::MAX.
            let over = _mm256_castps_si256(_mm256_cmp_ps::<_CMP_GE_OQ>(exact, _mm256_set1_ps(2_147_483_648.0)));
            let counts = _mm256_xor_si256(_mm256_cvtps_epi32(exact), over);
            let old = _mm256_loadu_si256(offset.cast());
            let moved = _mm256_add_epi32(old, counts);
            // Less than before, as unsigned numbers: it has wrapped round. Forwards that is a carry; backwards it is a carry if it has
            // not.
            let sign = _mm256_set1_epi32(i32::MIN);
            let wrapped = _mm256_cmpgt_epi32(_mm256_xor_si256(old, sign), _mm256_xor_si256(moved, sign));
            let carry = _mm256_sub_epi32(_mm256_srai_epi32::<31>(counts), wrapped);
            let cells = _mm256_add_epi32(_mm256_loadu_si256(cell.cast()), carry);
            _mm256_storeu_si256(offset.cast(), moved);
            _mm256_storeu_si256(cell.cast(), cells);
        }
    }
}

impl Lanes for Avx2F64 {
    type Near = Self;
    type Far = Self;
    sums_through_memory!(f64);

    #[inline(always)]
    unsafe fn fold(rows: *const f64, _stride: usize) -> (Self, Self) {
        // SAFETY: see above.
        unsafe {
            let [a, b, c] = [_mm256_loadu_pd(rows), _mm256_loadu_pd(rows.add(4)), _mm256_loadu_pd(rows.add(8))];
            (Wide(_mm256_add_pd(_mm256_add_pd(a, c), b)), Wide(_mm256_sub_pd(c, a)))
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: see above.
        unsafe { Wide(_mm256_permute4x64_pd::<0xff>(self.0)) }
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        // SAFETY: see above.
        unsafe {
            let [a, b, c, d] = rows.map(|row| row.0);
            let (ab, cd) = (_mm256_unpacklo_pd(a, b), _mm256_unpacklo_pd(c, d));
            rows[0].0 = _mm256_permute2f128_pd::<0x20>(ab, cd);
            rows[2].0 = _mm256_permute2f128_pd::<0x31>(ab, cd);
            let (ab, cd) = (_mm256_unpackhi_pd(a, b), _mm256_unpackhi_pd(c, d));
            rows[1].0 = _mm256_permute2f128_pd::<0x20>(ab, cd);
            rows[3].0 = _mm256_permute2f128_pd::<0x31>(ab, cd);
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const f64) -> Self {
        // SAFETY: see above.
        unsafe { Self::load(from) }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut f64, cell: *mut i32, delta: Self) {
        // SAFETY: see above.
        unsafe {
            let moved = _mm256_add_pd(_mm256_loadu_pd(offset), delta.0);
            let whole = _mm256_floor_pd(moved);
            let fraction = _mm256_sub_pd(moved, whole);
            // A tiny negative move from 0 rounds to fraction 1: that is the next cell's 0.
            let one = _mm256_set1_pd(1.0);
            let rounds_up = _mm256_cmp_pd::<_CMP_GE_OQ>(fraction, one);
            _mm256_storeu_pd(offset, _mm256_andnot_pd(rounds_up, fraction));
            let carry = _mm256_cvttpd_epi32(_mm256_add_pd(whole, _mm256_and_pd(rounds_up, one)));
            _mm_storeu_si128(cell.cast(), _mm_add_epi32(_mm_loadu_si128(cell.cast()), carry));
        }
    }
}
