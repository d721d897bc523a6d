//! AVX-512 registers.

use crate::avx2::{instructions, places_of_eight, plain};
use crate::vector::{Plain, Register, Wide, sums_through_memory};
use crate::{Lanes, Real, Row};
use core::arch::x86_64::*;

/// 16 lanes of f32.
pub type Avx512F32 = Wide<__m512>;
/// Eight lanes of f64.
pub type Avx512F64 = Wide<__m512d>;

const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

// SAFETY of every block of this file: values of these types exist only in code that `Isa::run` entered after asking the machine
// for AVX-512 F, DQ and VL; that pointers are valid, callers vouch for.

plain!(
    __m512,
    f32,
    16,
    _mm512_set1_ps,
    _mm512_add_ps,
    _mm512_mul_ps,
    _mm512_fmadd_ps,
    _mm512_xor_ps,
    |from| _mm512_broadcast_f32x4(_mm_loadu_ps(from)),
    {
        let four = _mm512_castps128_ps512(_mm_loadu_ps(from));
        _mm512_permutexvar_ps(_mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3), four)
    }
);
plain!(
    __m512d,
    f64,
    8,
    _mm512_set1_pd,
    _mm512_add_pd,
    _mm512_mul_pd,
    _mm512_fmadd_pd,
    _mm512_xor_pd,
    |from| _mm512_broadcast_f64x4(_mm256_loadu_pd(from)),
    {
        let two = _mm512_castpd128_pd512(_mm_loadu_pd(from));
        _mm512_permutexvar_pd(_mm512_setr_epi64(0, 0, 0, 0, 1, 1, 1, 1), two)
    }
);

macro_rules! register {
    ($reg:ident, $mask:ident, $set1:ident, $add:ident, $sub:ident, $div:ident, $abs:ident, $sqrt:ident, $min:ident, $max:ident,
     $round:ident, $cmp:ident, $blend:ident, $getmant:ident, $getexp:ident, $scalef:ident) => {
        impl Register for $reg {
            type Bits = $mask;
            instructions!(
                sub(o) = $sub,
                div(o) = $div,
                abs() = $abs,
                sqrt() = $sqrt,
                min(o) = $min,
                max(o) = $max,
                scale_exponent(k) = $scalef
            );
            #[inline(always)]
            fn round(self) -> Self {
                // SAFETY: see above.
                unsafe { $round::<NEAREST>(self) }
            }
            #[inline(always)]
            fn lt(self, o: Self) -> $mask {
                // SAFETY: see above.
                unsafe { $cmp::<_CMP_LT_OQ>(self, o) }
            }
            #[inline(always)]
            fn le(self, o: Self) -> $mask {
                // SAFETY: see above.
                unsafe { $cmp::<_CMP_LE_OQ>(self, o) }
            }
            #[inline(always)]
            fn select(mask: $mask, a: Self, b: Self) -> Self {
                // SAFETY: see above.
                unsafe { $blend(mask, b, a) }
            }
            #[inline(always)]
            fn split_exponent(self) -> (Self, Self) {
                // SAFETY: see above.
                unsafe {
                    let m = $getmant::<_MM_MANT_NORM_P75_1P5, _MM_MANT_SIGN_SRC>(self);
                    // A mantissa of [1.5, 2) is brought to [0.75, 1), and its exponent one up.
                    let e = $getexp(self);
                    let halved = $cmp::<_CMP_LT_OQ>(m, $set1(1.0));
                    (m, $blend(halved, e, $add(e, $set1(1.0))))
                }
            }
            #[inline(always)]
            fn and(a: $mask, b: $mask) -> $mask {
                a & b
            }
            #[inline(always)]
            fn or(a: $mask, b: $mask) -> $mask {
                a | b
            }
            #[inline(always)]
            fn not(a: $mask) -> $mask {
                !a
            }
            #[inline(always)]
            fn bits(a: $mask) -> u16 {
                u16::from(a)
            }
            #[inline(always)]
            fn truth(value: bool) -> $mask {
                if value { $mask::MAX } else { 0 }
            }
        }
    };
}
register!(
    __m512,
    __mmask16,
    _mm512_set1_ps,
    _mm512_add_ps,
    _mm512_sub_ps,
    _mm512_div_ps,
    _mm512_abs_ps,
    _mm512_sqrt_ps,
    _mm512_min_ps,
    _mm512_max_ps,
    _mm512_roundscale_ps,
    _mm512_cmp_ps_mask,
    _mm512_mask_blend_ps,
    _mm512_getmant_ps,
    _mm512_getexp_ps,
    _mm512_scalef_ps
);
register!(
    __m512d,
    __mmask8,
    _mm512_set1_pd,
    _mm512_add_pd,
    _mm512_sub_pd,
    _mm512_div_pd,
    _mm512_abs_pd,
    _mm512_sqrt_pd,
    _mm512_min_pd,
    _mm512_max_pd,
    _mm512_roundscale_pd,
    _mm512_cmp_pd_mask,
    _mm512_mask_blend_pd,
    _mm512_getmant_pd,
    _mm512_getexp_pd,
    _mm512_scalef_pd
);

impl Lanes for Avx512F32 {
    type Near = Self;
    type Far = Self;
    sums_through_memory!(f32);

    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32, places: *mut u32) -> bool {
        // SAFETY: see above.
        unsafe {
            let limit = _mm512_set1_epi32(most.cast_signed());
            let (mut place, mut outside) = (_mm512_setzero_si512(), 0);
            for d in 0..3 {
                let from_first = _mm512_sub_epi32(_mm512_loadu_si512(cells[d].cast()), _mm512_set1_epi32(first[d]));
                outside |= _mm512_cmpgt_epu32_mask(from_first, limit);
                place = _mm512_add_epi32(place, _mm512_mullo_epi32(from_first, _mm512_set1_epi32(stride[d])));
            }
            _mm512_storeu_si512(places.cast(), place);
            outside != 0
        }
    }
    #[inline(always)]
    unsafe fn fold(rows: *const f32, stride: usize) -> (Self, Self) {
        // Halves of two rows side by side. Put together while they are loaded, they do not queue for the one port that shuffles.
        #[inline(always)]
        unsafe fn halves(low: *const f32, high: *const f32) -> __m512 {
            // SAFETY: see above.
            unsafe { _mm512_insertf32x8::<1>(_mm512_castps256_ps512(_mm256_loadu_ps(low)), _mm256_loadu_ps(high)) }
        }
        // SAFETY: see above.
        unsafe {
            let [a, b, c, d] = [rows, rows.add(stride), rows.add(2 * stride), rows.add(3 * stride)];
            let (ac, bd) = (halves(a, c), halves(b, d));
            let (ac_far, bd_far) = (halves(a.add(8), c.add(8)), halves(b.add(8), d.add(8)));
            let even = _mm512_setr_epi32(0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27);
            let odd = _mm512_setr_epi32(4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
            let (ac_sum, bd_sum) = (_mm512_add_ps(ac, ac_far), _mm512_add_ps(bd, bd_far));
            let sum = _mm512_add_ps(
                _mm512_permutex2var_ps(ac_sum, even, bd_sum),
                _mm512_permutex2var_ps(ac_sum, odd, bd_sum),
            );
            let difference = _mm512_permutex2var_ps(_mm512_sub_ps(ac_far, ac), even, _mm512_sub_ps(bd_far, bd));
            (Wide(sum), Wide(difference))
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: see above.
        unsafe { Wide(_mm512_permute_ps::<0xff>(self.0)) }
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        // SAFETY: see above.
        unsafe {
            let [a, b, c, d] = rows.map(|row| row.0);
            let (ab, cd) = (_mm512_unpacklo_ps(a, b), _mm512_unpacklo_ps(c, d));
            let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
            rows[0].0 = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
            rows[1].0 = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
            let (ab, cd) = (_mm512_unpackhi_ps(a, b), _mm512_unpackhi_ps(c, d));
            let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
            rows[2].0 = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
            rows[3].0 = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const u32) -> Self {
        // SAFETY: see above.
        unsafe {
            let counts = _mm512_cvtepu32_ps(_mm512_loadu_si512(from.cast()));
            Wide(_mm512_mul_ps(counts, _mm512_set1_ps(1.0 / 4_294_967_296.0)))
        }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut u32, cell: *mut i32, delta: Self) {
        // SAFETY: see above.
        unsafe {
            let exact = _mm512_mul_ps(delta.0, _mm512_set1_ps(4_294_967_296.0));
            // Half a cell forwards is one count more than fits, and the conversion would make half a cell backwards of it.
            let over = _mm512_cmp_ps_mask::<_CMP_GE_OQ>(exact, _mm512_set1_ps(2_147_483_648.0));
            let counts = _mm512_mask_mov_epi32(_mm512_cvtps_epi32(exact), over, _mm512_set1_epi32(i32::MAX));
            let old = _mm512_loadu_si512(offset.cast());
            let moved = _mm512_add_epi32(old, counts);
            let negative = _mm512_movepi32_mask(counts);
            let up = _mm512_mask_cmplt_epu32_mask(!negative, moved, old);
            let down = _mm512_mask_cmpgt_epu32_mask(negative, moved, old);
            let cells = _mm512_loadu_si512(cell.cast());
            let one = _mm512_set1_epi32(1);
            let cells = _mm512_mask_add_epi32(cells, up, cells, one);
            let cells = _mm512_mask_sub_epi32(cells, down, cells, one);
            _mm512_storeu_si512(offset.cast(), moved);
            _mm512_storeu_si512(cell.cast(), cells);
        }
    }
}

impl Lanes for Avx512F64 {
    type Near = Self;
    type Far = Wide<__m256d>;
    sums_through_memory!(f64);

    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32, places: *mut u32) -> bool {
        // SAFETY: see above.
        unsafe { places_of_eight(cells, first, stride, most, places) }
    }
    #[inline(always)]
    unsafe fn fold(rows: *const f64, stride: usize) -> (Self, Self) {
        // A node of both rows.
        #[inline(always)]
        unsafe fn both(low: *const f64, high: *const f64) -> __m512d {
            // SAFETY: see above.
            unsafe { _mm512_insertf64x4::<1>(_mm512_castpd256_pd512(_mm256_loadu_pd(low)), _mm256_loadu_pd(high)) }
        }
        // SAFETY: see above.
        unsafe {
            let (low, high) = (rows, rows.add(stride));
            let [a, b, c] = [both(low, high), both(low.add(4), high.add(4)), both(low.add(8), high.add(8))];
            (Wide(_mm512_add_pd(_mm512_add_pd(a, c), b)), Wide(_mm512_sub_pd(c, a)))
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: see above.
        unsafe { Wide(_mm512_permutex_pd::<0xff>(self.0)) }
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        // SAFETY: see above.
        unsafe {
            let [a, b, c, d] = rows.map(|row| row.0);
            let first = _mm512_setr_epi64(0, 1, 8, 9, 4, 5, 12, 13);
            let last = _mm512_setr_epi64(2, 3, 10, 11, 6, 7, 14, 15);
            let (ab, cd) = (_mm512_unpacklo_pd(a, b), _mm512_unpacklo_pd(c, d));
            rows[0].0 = _mm512_permutex2var_pd(ab, first, cd);
            rows[2].0 = _mm512_permutex2var_pd(ab, last, cd);
            let (ab, cd) = (_mm512_unpackhi_pd(a, b), _mm512_unpackhi_pd(c, d));
            rows[1].0 = _mm512_permutex2var_pd(ab, first, cd);
            rows[3].0 = _mm512_permutex2var_pd(ab, last, cd);
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const f64) -> Self {
        // SAFETY: see above.
        unsafe { Self::load(from) }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut f64, cell: *mut i32, delta: Self) {
        const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
        // SAFETY: see above.
        unsafe {
            let moved = _mm512_add_pd(_mm512_loadu_pd(offset), delta.0);
            let whole = _mm512_roundscale_pd::<DOWN>(moved);
            let fraction = _mm512_sub_pd(moved, whole);
            // A tiny negative move from 0 rounds to fraction 1: that is the next cell's 0.
            let one = _mm512_set1_pd(1.0);
            let stays = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(fraction, one);
            _mm512_storeu_pd(offset, _mm512_maskz_mov_pd(stays, fraction));
            let carry = _mm512_cvttpd_epi32(_mm512_mask_add_pd(whole, !stays, whole, one));
            _mm256_storeu_si256(cell.cast(), _mm256_add_epi32(_mm256_loadu_si256(cell.cast()), carry));
        }
    }
}
