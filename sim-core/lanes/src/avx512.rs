//! AVX-512 registers.

use crate::base::Advance;
use crate::vector::{Register, Wide, advance_f64, lanes_through_memory, transpose_through_memory};
use crate::{LANES, Lanes, Real};
use core::arch::x86_64::*;

/// 16 lanes of f32 in one register.
pub type Avx512F32 = Wide<__m512, 1>;
/// 16 lanes of f64 in two registers.
pub type Avx512F64 = Wide<__m512d, 2>;

const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

macro_rules! register {
    ($reg:ident, $scalar:ident, $mask:ident, $width:expr, $set1:ident, $add:ident, $sub:ident, $mul:ident, $div:ident, $fma:ident,
     $abs:ident, $sqrt:ident, $min:ident, $max:ident, $round:ident, $cmp:ident, $blend:ident, $getmant:ident, $getexp:ident, $scalef:ident,
     $xor:ident) => {
        // SAFETY of every block below: values of this type exist only in code that `Isa::run` entered after asking the
        // machine for AVX-512 F, DQ and VL.
        impl Register for $reg {
            type Scalar = $scalar;
            type Bits = $mask;
            const WIDTH: usize = $width;
            #[inline(always)]
            fn fill(x: $scalar) -> Self {
                // SAFETY: see above.
                unsafe { $set1(x) }
            }
            #[inline(always)]
            fn add(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $add(self, o) }
            }
            #[inline(always)]
            fn sub(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $sub(self, o) }
            }
            #[inline(always)]
            fn mul(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $mul(self, o) }
            }
            #[inline(always)]
            fn div(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $div(self, o) }
            }
            #[inline(always)]
            fn fma(self, a: Self, b: Self) -> Self {
                // SAFETY: see above.
                unsafe { $fma(self, a, b) }
            }
            #[inline(always)]
            fn neg(self) -> Self {
                // SAFETY: see above.
                unsafe { $xor(self, $set1(-0.0)) }
            }
            #[inline(always)]
            fn abs(self) -> Self {
                // SAFETY: see above.
                unsafe { $abs(self) }
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                // SAFETY: see above.
                unsafe { $sqrt(self) }
            }
            #[inline(always)]
            fn min(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $min(self, o) }
            }
            #[inline(always)]
            fn max(self, o: Self) -> Self {
                // SAFETY: see above.
                unsafe { $max(self, o) }
            }
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
            fn scale_exponent(self, k: Self) -> Self {
                // SAFETY: see above.
                unsafe { $scalef(self, k) }
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
    f32,
    __mmask16,
    16,
    _mm512_set1_ps,
    _mm512_add_ps,
    _mm512_sub_ps,
    _mm512_mul_ps,
    _mm512_div_ps,
    _mm512_fmadd_ps,
    _mm512_abs_ps,
    _mm512_sqrt_ps,
    _mm512_min_ps,
    _mm512_max_ps,
    _mm512_roundscale_ps,
    _mm512_cmp_ps_mask,
    _mm512_mask_blend_ps,
    _mm512_getmant_ps,
    _mm512_getexp_ps,
    _mm512_scalef_ps,
    _mm512_xor_ps
);
register!(
    __m512d,
    f64,
    __mmask8,
    8,
    _mm512_set1_pd,
    _mm512_add_pd,
    _mm512_sub_pd,
    _mm512_mul_pd,
    _mm512_div_pd,
    _mm512_fmadd_pd,
    _mm512_abs_pd,
    _mm512_sqrt_pd,
    _mm512_min_pd,
    _mm512_max_pd,
    _mm512_roundscale_pd,
    _mm512_cmp_pd_mask,
    _mm512_mask_blend_pd,
    _mm512_getmant_pd,
    _mm512_getexp_pd,
    _mm512_scalef_pd,
    _mm512_xor_pd
);

/// [`Lanes::places`] for both widths.
#[inline]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn places_avx512(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32) -> ([u32; LANES], bool) {
    let limit = _mm512_set1_epi32(most.cast_signed());
    let mut place = _mm512_setzero_si512();
    let mut outside = 0;
    for d in 0..3 {
        // SAFETY: the caller vouches for 16 readable entries.
        let cell = unsafe { _mm512_loadu_si512(cells[d].cast()) };
        let from_first = _mm512_sub_epi32(cell, _mm512_set1_epi32(first[d]));
        outside |= _mm512_cmpgt_epu32_mask(from_first, limit);
        place = _mm512_add_epi32(place, _mm512_mullo_epi32(from_first, _mm512_set1_epi32(stride[d])));
    }
    let mut places = [0u32; LANES];
    // SAFETY: the array holds 16 entries.
    unsafe { _mm512_storeu_si512(places.as_mut_ptr().cast(), place) };
    (places, outside != 0)
}

impl Lanes for Avx512F32 {
    lanes_through_memory!(f32);

    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32) -> ([u32; LANES], bool) {
        // SAFETY: the caller vouches for the entries; the machine has AVX-512.
        unsafe { places_avx512(cells, first, stride, most) }
    }

    #[inline(always)]
    unsafe fn repeat4(from: *const f32) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX-512.
        unsafe { Wide([_mm512_broadcast_f32x4(_mm_loadu_ps(from))]) }
    }
    #[inline(always)]
    unsafe fn spread3(from: *const f32) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX-512.
        unsafe {
            let four = _mm512_castps128_ps512(_mm_loadu_ps(from));
            let pick = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
            Wide([_mm512_maskz_permutexvar_ps(0x0fff, pick, four)])
        }
    }
    #[inline(always)]
    unsafe fn fold4([a, b, c, d]: [*const f32; 4]) -> (Self, Self) {
        // Halves of two rows side by side. Put together while they are loaded, they do not queue for the one port that shuffles.
        #[inline(always)]
        unsafe fn halves(low: *const f32, high: *const f32) -> __m512 {
            // SAFETY: the caller vouches for 8 readable scalars; the machine has AVX-512.
            unsafe { _mm512_insertf32x8::<1>(_mm512_castps256_ps512(_mm256_loadu_ps(low)), _mm256_loadu_ps(high)) }
        }
        // SAFETY: the caller vouches for 16 readable scalars a row; the machine has AVX-512.
        unsafe {
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
            (Wide([sum]), Wide([difference]))
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: the machine has AVX-512.
        unsafe { Wide([_mm512_permute_ps::<0xff>(self.0[0])]) }
    }
    #[inline(always)]
    fn transpose4(rows: &mut [Self; 4]) {
        // SAFETY: the machine has AVX-512.
        unsafe {
            let [a, b, c, d] = [rows[0].0[0], rows[1].0[0], rows[2].0[0], rows[3].0[0]];
            let (ab, cd) = (_mm512_unpacklo_ps(a, b), _mm512_unpacklo_ps(c, d));
            let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
            rows[0].0[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
            rows[1].0[0] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
            let (ab, cd) = (_mm512_unpackhi_ps(a, b), _mm512_unpackhi_ps(c, d));
            let (ab, cd) = (_mm512_castps_pd(ab), _mm512_castps_pd(cd));
            rows[2].0[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd));
            rows[3].0[0] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd));
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const u32) -> Self {
        // SAFETY: the caller vouches for 16 readable offsets; the machine has AVX-512.
        unsafe {
            let counts = _mm512_cvtepu32_ps(_mm512_loadu_si512(from.cast()));
            Wide([_mm512_mul_ps(counts, _mm512_set1_ps(1.0 / 4_294_967_296.0))])
        }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut u32, cell: *mut i32, delta: Self) {
        // SAFETY: the caller vouches for 16 readable and writable entries of each; the machine has AVX-512.
        unsafe {
            let exact = _mm512_mul_ps(delta.0[0], _mm512_set1_ps(4_294_967_296.0));
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
    lanes_through_memory!(f64);

    #[inline(always)]
    unsafe fn places(cells: [*const i32; 3], first: [i32; 3], stride: [i32; 3], most: u32) -> ([u32; LANES], bool) {
        // SAFETY: the caller vouches for the entries; the machine has AVX-512.
        unsafe { places_avx512(cells, first, stride, most) }
    }
    transpose_through_memory!(f64);
    advance_f64!();

    #[inline(always)]
    unsafe fn repeat4(from: *const f64) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX-512.
        unsafe { Wide([_mm512_broadcast_f64x4(_mm256_loadu_pd(from)); 2]) }
    }
    #[inline(always)]
    unsafe fn spread3(from: *const f64) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX-512.
        unsafe {
            let four = _mm512_castpd256_pd512(_mm256_loadu_pd(from));
            let low = _mm512_permutexvar_pd(_mm512_setr_epi64(0, 0, 0, 0, 1, 1, 1, 1), four);
            let high = _mm512_maskz_permutexvar_pd(0x0f, _mm512_setr_epi64(2, 2, 2, 2, 3, 3, 3, 3), four);
            Wide([low, high])
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: the machine has AVX-512.
        unsafe { Wide([_mm512_permutex_pd::<0xff>(self.0[0]), _mm512_permutex_pd::<0xff>(self.0[1])]) }
    }
    #[inline(always)]
    unsafe fn fold4(rows: [*const f64; 4]) -> (Self, Self) {
        // SAFETY: the caller vouches for 16 readable scalars a row; the machine has AVX-512.
        unsafe {
            let [a, b, c, d] =
                [Self::load(rows[0]).0, Self::load(rows[1]).0, Self::load(rows[2]).0, Self::load(rows[3]).0];
            let (mut sum, mut difference) = (Self::zero(), Self::zero());
            for (half, (a, b)) in [(a, b), (c, d)].into_iter().enumerate() {
                let (sum_a, sum_b) = (_mm512_add_pd(a[0], a[1]), _mm512_add_pd(b[0], b[1]));
                let (even, odd) =
                    (_mm512_shuffle_f64x2::<0x44>(sum_a, sum_b), _mm512_shuffle_f64x2::<0xee>(sum_a, sum_b));
                sum.0[half] = _mm512_add_pd(even, odd);
                difference.0[half] = _mm512_shuffle_f64x2::<0x44>(_mm512_sub_pd(a[1], a[0]), _mm512_sub_pd(b[1], b[0]));
            }
            (sum, difference)
        }
    }
}
