//! AVX2 and FMA registers.

use crate::base::Advance;
use crate::vector::{Register, Wide, advance_f64, lanes_through_memory, transpose_through_memory};
use crate::{LANES, Lanes, Real};
use core::arch::x86_64::*;

/// 16 lanes of f32 in two registers.
pub type Avx2F32 = Wide<__m256, 2>;
/// 16 lanes of f64 in four registers.
pub type Avx2F64 = Wide<__m256d, 4>;

macro_rules! register {
    ($reg:ident, $scalar:ident, $width:expr, $set1:ident, $zero:ident, $add:ident, $sub:ident, $mul:ident, $div:ident, $fma:ident,
     $sqrt:ident, $min:ident, $max:ident, $round:ident, $cmp:ident, $blend:ident, $and:ident, $andnot:ident, $or:ident, $xor:ident,
     $movemask:ident, $split:ident, $scale:ident) => {
        // SAFETY of every block below: values of this type exist only in code that `Isa::run` entered after asking the
        // machine for AVX2 and FMA.
        impl Register for $reg {
            type Scalar = $scalar;
            type Bits = $reg;
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
                unsafe { $andnot($set1(-0.0), self) }
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
            fn scale_exponent(self, k: Self) -> Self {
                // SAFETY: see above.
                unsafe { $scale(self, k) }
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
    f32,
    8,
    _mm256_set1_ps,
    _mm256_setzero_ps,
    _mm256_add_ps,
    _mm256_sub_ps,
    _mm256_mul_ps,
    _mm256_div_ps,
    _mm256_fmadd_ps,
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
    f64,
    4,
    _mm256_set1_pd,
    _mm256_setzero_pd,
    _mm256_add_pd,
    _mm256_sub_pd,
    _mm256_mul_pd,
    _mm256_div_pd,
    _mm256_fmadd_pd,
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

impl Lanes for Avx2F32 {
    lanes_through_memory!(f32);
    transpose_through_memory!(f32);

    #[inline(always)]
    unsafe fn repeat4(from: *const f32) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX2.
        unsafe { Wide([_mm256_broadcast_ps(&from.cast::<__m128>().read_unaligned()); 2]) }
    }
    #[inline(always)]
    unsafe fn spread3(from: *const f32) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX2.
        unsafe {
            let four = _mm256_castps128_ps256(_mm_loadu_ps(from));
            let low = _mm256_permutevar8x32_ps(four, _mm256_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1));
            let high = _mm256_permutevar8x32_ps(four, _mm256_setr_epi32(2, 2, 2, 2, 2, 2, 2, 2));
            Wide([low, _mm256_blend_ps::<0x0f>(_mm256_setzero_ps(), high)])
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        // SAFETY: the machine has AVX2.
        unsafe { Wide([_mm256_permute_ps::<0xff>(self.0[0]), _mm256_permute_ps::<0xff>(self.0[1])]) }
    }
    #[inline(always)]
    unsafe fn fold4(rows: [*const f32; 4]) -> (Self, Self) {
        // SAFETY: the caller vouches for 16 readable scalars a row; the machine has AVX2.
        unsafe {
            let [a, b, c, d] =
                [Self::load(rows[0]).0, Self::load(rows[1]).0, Self::load(rows[2]).0, Self::load(rows[3]).0];
            let (mut sum, mut difference) = (Self::zero(), Self::zero());
            for (half, (a, b)) in [(a, b), (c, d)].into_iter().enumerate() {
                let (sum_a, sum_b) = (_mm256_add_ps(a[0], a[1]), _mm256_add_ps(b[0], b[1]));
                let (even, odd) =
                    (_mm256_permute2f128_ps::<0x20>(sum_a, sum_b), _mm256_permute2f128_ps::<0x31>(sum_a, sum_b));
                sum.0[half] = _mm256_add_ps(even, odd);
                difference.0[half] =
                    _mm256_permute2f128_ps::<0x20>(_mm256_sub_ps(a[1], a[0]), _mm256_sub_ps(b[1], b[0]));
            }
            (sum, difference)
        }
    }
    #[inline(always)]
    unsafe fn load_offset(from: *const u32) -> Self {
        let mut fractions = [0.0f32; LANES];
        for (i, f) in fractions.iter_mut().enumerate() {
            // SAFETY: the caller vouches for 16 readable offsets.
            *f = unsafe { *from.add(i) } as f32 * (1.0 / 4_294_967_296.0);
        }
        // SAFETY: the array holds 16 scalars.
        unsafe { Self::load(fractions.as_ptr()) }
    }
    #[inline(always)]
    unsafe fn advance(offset: *mut u32, cell: *mut i32, delta: Self) {
        let mut moves = [0.0f32; LANES];
        // SAFETY: the array holds 16 scalars.
        unsafe { delta.store(moves.as_mut_ptr()) };
        for (i, &by) in moves.iter().enumerate() {
            // SAFETY: the caller vouches for 16 readable and writable entries of each.
            unsafe { f32::advance_one(&mut *offset.add(i), &mut *cell.add(i), by) }
        }
    }
}

impl Lanes for Avx2F64 {
    lanes_through_memory!(f64);
    transpose_through_memory!(f64);
    advance_f64!();

    #[inline(always)]
    unsafe fn repeat4(from: *const f64) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX2.
        unsafe { Wide([_mm256_loadu_pd(from); 4]) }
    }
    #[inline(always)]
    unsafe fn spread3(from: *const f64) -> Self {
        // SAFETY: the caller vouches for 4 readable scalars; the machine has AVX2.
        unsafe {
            Wide([
                _mm256_set1_pd(*from),
                _mm256_set1_pd(*from.add(1)),
                _mm256_set1_pd(*from.add(2)),
                _mm256_setzero_pd(),
            ])
        }
    }
    #[inline(always)]
    fn fourth(self) -> Self {
        let mut out = self;
        for register in &mut out.0 {
            // SAFETY: the machine has AVX2.
            *register = unsafe { _mm256_permute4x64_pd::<0xff>(*register) };
        }
        out
    }
    #[inline(always)]
    unsafe fn fold4(rows: [*const f64; 4]) -> (Self, Self) {
        let (mut sum, mut difference) = (Self::zero(), Self::zero());
        for (g, row) in rows.into_iter().enumerate() {
            // SAFETY: the caller vouches for 16 readable scalars; the machine has AVX2.
            unsafe {
                let row = Self::load(row).0;
                sum.0[g] = _mm256_add_pd(_mm256_add_pd(row[0], row[2]), _mm256_add_pd(row[1], row[3]));
                difference.0[g] = _mm256_sub_pd(row[2], row[0]);
            }
        }
        (sum, difference)
    }
}
