//! 3 × 3 tensors over any [`Real`].

use barchan_lanes::Real;
use core::ops::{Add, Mul, Sub};

/// A symmetric tensor.
#[derive(Clone, Copy, Debug)]
pub struct SymMat3<T> {
    /// Component xx.
    pub xx: T,
    /// Component yy.
    pub yy: T,
    /// Component zz.
    pub zz: T,
    /// Component xy.
    pub xy: T,
    /// Component xz.
    pub xz: T,
    /// Component yz.
    pub yz: T,
}

macro_rules! componentwise {
    ($trait:ident, $f:ident) => {
        impl<T: Real> $trait for SymMat3<T> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                Self {
                    xx: self.xx.$f(o.xx),
                    yy: self.yy.$f(o.yy),
                    zz: self.zz.$f(o.zz),
                    xy: self.xy.$f(o.xy),
                    xz: self.xz.$f(o.xz),
                    yz: self.yz.$f(o.yz),
                }
            }
        }
    };
}
componentwise!(Add, add);
componentwise!(Sub, sub);

impl<T: Real> SymMat3<T> {
    /// `s` I.
    #[inline(always)]
    pub fn scalar(s: T) -> Self {
        let zero = T::zero();
        Self { xx: s, yy: s, zz: s, xy: zero, xz: zero, yz: zero }
    }

    /// I.
    #[inline(always)]
    pub fn identity() -> Self {
        Self::scalar(T::one())
    }

    /// `s` times the tensor.
    #[inline(always)]
    pub fn scale(self, s: T) -> Self {
        Self { xx: s * self.xx, yy: s * self.yy, zz: s * self.zz, xy: s * self.xy, xz: s * self.xz, yz: s * self.yz }
    }

    /// The tensor plus `s` I.
    #[inline(always)]
    pub fn add_scalar(self, s: T) -> Self {
        Self { xx: self.xx + s, yy: self.yy + s, zz: self.zz + s, ..self }
    }

    /// Sum of the diagonal.
    #[inline(always)]
    pub fn trace(self) -> T {
        self.xx + self.yy + self.zz
    }

    /// The traceless part.
    #[inline(always)]
    pub fn deviator(self) -> Self {
        self.add_scalar(self.trace() * T::splat(-1.0 / 3.0))
    }

    /// Squared Frobenius norm.
    #[inline(always)]
    pub fn norm_squared(self) -> T {
        let shear = self.xy.mul_add(self.xy, self.xz.mul_add(self.xz, self.yz * self.yz));
        let normal = self.xx.mul_add(self.xx, self.yy.mul_add(self.yy, self.zz * self.zz));
        shear.mul_add(T::splat(2.0), normal)
    }

    /// Determinant.
    #[inline(always)]
    pub fn determinant(self) -> T {
        let minor_xx = self.yy.mul_add(self.zz, -(self.yz * self.yz));
        let minor_xy = self.xy.mul_add(self.zz, -(self.xz * self.yz));
        let minor_xz = self.xy.mul_add(self.yz, -(self.xz * self.yy));
        self.xx.mul_add(minor_xx, (-self.xy).mul_add(minor_xy, self.xz * minor_xz))
    }

    /// Sum of the principal minors of second order.
    #[inline(always)]
    pub fn second_invariant(self) -> T {
        let normal = self.xx.mul_add(self.yy, self.xx.mul_add(self.zz, self.yy * self.zz));
        let shear = self.xy.mul_add(self.xy, self.xz.mul_add(self.xz, self.yz * self.yz));
        normal - shear
    }

    /// The tensor times itself.
    #[inline(always)]
    pub fn square(self) -> Self {
        let Self { xx, yy, zz, xy, xz, yz } = self;
        let (xy2, xz2, yz2) = (xy * xy, xz * xz, yz * yz);
        Self {
            xx: xx.mul_add(xx, xy2 + xz2),
            yy: yy.mul_add(yy, xy2 + yz2),
            zz: zz.mul_add(zz, xz2 + yz2),
            xy: xy.mul_add(xx + yy, xz * yz),
            xz: xz.mul_add(xx + zz, xy * yz),
            yz: yz.mul_add(yy + zz, xy * xz),
        }
    }

    /// Σ `coefficients[k]` Aᵏ, at least three of them.
    ///
    /// By the theorem of Cayley and Hamilton every power of A is a sum of I, A and A², so Horner's scheme runs on three
    /// scalars: three multiplications a term instead of a product of tensors.
    #[inline(always)]
    pub fn polynomial(self, coefficients: &[f64]) -> Self {
        let (i1, i2, i3) = (self.trace(), self.second_invariant(), self.determinant());
        let (low, high) = coefficients.split_at(coefficients.len() - 3);
        let mut c = [T::splat(high[0]), T::splat(high[1]), T::splat(high[2])];
        for &a in low.iter().rev() {
            c = [c[2].mul_add(i3, T::splat(a)), (-c[2]).mul_add(i2, c[0]), c[2].mul_add(i1, c[1])];
        }
        (self.scale(c[1]) + self.square().scale(c[2])).add_scalar(c[0])
    }

    /// `a` where the mask is true, `b` elsewhere.
    #[inline(always)]
    pub fn select(mask: T::Mask, a: Self, b: Self) -> Self {
        Self {
            xx: T::select(mask, a.xx, b.xx),
            yy: T::select(mask, a.yy, b.yy),
            zz: T::select(mask, a.zz, b.zz),
            xy: T::select(mask, a.xy, b.xy),
            xz: T::select(mask, a.xz, b.xz),
            yz: T::select(mask, a.yz, b.yz),
        }
    }

    /// The six components in the order of the ABI's planes: xx yy zz xy xz yz.
    #[inline(always)]
    pub fn components(self) -> [T; 6] {
        [self.xx, self.yy, self.zz, self.xy, self.xz, self.yz]
    }

    /// From six components in the order of the ABI's planes.
    #[inline(always)]
    pub fn from_components([xx, yy, zz, xy, xz, yz]: [T; 6]) -> Self {
        Self { xx, yy, zz, xy, xz, yz }
    }
}

#[inline(always)]
fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// A general tensor.
#[derive(Clone, Copy, Debug)]
pub struct Mat3<T> {
    /// `rows[i][j]` is component ij.
    pub rows: [[T; 3]; 3],
}

impl<T: Real> Mat3<T> {
    /// I.
    #[inline(always)]
    pub fn identity() -> Self {
        let (one, zero) = (T::one(), T::zero());
        Self { rows: [[one, zero, zero], [zero, one, zero], [zero, zero, one]] }
    }

    /// Determinant.
    #[inline(always)]
    pub fn determinant(self) -> T {
        let [a, b, c] = self.rows;
        let minor_x = b[1].mul_add(c[2], -(b[2] * c[1]));
        let minor_y = b[0].mul_add(c[2], -(b[2] * c[0]));
        let minor_z = b[0].mul_add(c[1], -(b[1] * c[0]));
        a[0].mul_add(minor_x, (-a[1]).mul_add(minor_y, a[2] * minor_z))
    }

    /// A Aᵀ; of the deformation gradient F, the left Cauchy–Green tensor b.
    #[inline(always)]
    pub fn times_transpose(self) -> SymMat3<T> {
        let [x, y, z] = self.rows;
        SymMat3 { xx: dot(x, x), yy: dot(y, y), zz: dot(z, z), xy: dot(x, y), xz: dot(x, z), yz: dot(y, z) }
    }

    /// ½ (A + Aᵀ); of the velocity gradient, the rate of deformation.
    #[inline(always)]
    pub fn symmetric_part(self) -> SymMat3<T> {
        let [x, y, z] = self.rows;
        let half = T::splat(0.5);
        SymMat3 {
            xx: x[0],
            yy: y[1],
            zz: z[2],
            xy: half * (x[1] + y[0]),
            xz: half * (x[2] + z[0]),
            yz: half * (y[2] + z[1]),
        }
    }

    /// The transpose.
    #[inline(always)]
    pub fn transpose(self) -> Self {
        let [x, y, z] = self.rows;
        Self { rows: [[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]] }
    }

    /// The nine components, row by row.
    #[inline(always)]
    pub fn components(self) -> [T; 9] {
        let [x, y, z] = self.rows;
        [x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]]
    }

    /// From nine components, row by row.
    #[inline(always)]
    pub fn from_components(c: [T; 9]) -> Self {
        Self { rows: [[c[0], c[1], c[2]], [c[3], c[4], c[5]], [c[6], c[7], c[8]]] }
    }
}

impl<T: Real> Mul for Mat3<T> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        let [a, b, c] = self.rows;
        let [x, y, z] = o.transpose().rows;
        Self {
            rows: [
                [dot(a, x), dot(a, y), dot(a, z)],
                [dot(b, x), dot(b, y), dot(b, z)],
                [dot(c, x), dot(c, y), dot(c, z)],
            ],
        }
    }
}

impl<T: Real> From<SymMat3<T>> for Mat3<T> {
    #[inline(always)]
    fn from(s: SymMat3<T>) -> Self {
        Self { rows: [[s.xx, s.xy, s.xz], [s.xy, s.yy, s.yz], [s.xz, s.yz, s.zz]] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> SymMat3<f64> {
        SymMat3 { xx: 1.3, yy: -0.7, zz: 0.4, xy: 0.2, xz: -0.5, yz: 0.9 }
    }

    #[test]
    fn invariants_and_products_agree_with_the_general_tensor() {
        let a = sample();
        let m = Mat3::from(a);
        let square = (m * m).components();
        for (x, y) in Mat3::from(a.square()).components().iter().zip(square) {
            assert!((x - y).abs() < 1e-15);
        }
        assert!((a.determinant() - m.determinant()).abs() < 1e-15);
        let trace_of_square = square[0] + square[4] + square[8];
        assert!((a.second_invariant() - 0.5 * (a.trace() * a.trace() - trace_of_square)).abs() < 1e-15);
        assert!((a.norm_squared() - trace_of_square).abs() < 1e-15);
        assert!(a.deviator().trace().abs() < 1e-15);
    }

    #[test]
    fn a_polynomial_equals_the_sum_of_its_powers() {
        let a = sample();
        let m = Mat3::from(a);
        let coefficients = [0.5, -1.0, 0.25, 2.0, -0.125, 0.7];
        let mut power = Mat3::identity();
        let mut sum = [0.0; 9];
        for c in coefficients {
            for (s, p) in sum.iter_mut().zip(power.components()) {
                *s += c * p;
            }
            power = power * m;
        }
        for (x, y) in Mat3::from(a.polynomial(&coefficients)).components().iter().zip(sum) {
            assert!((x - y).abs() < 1e-13, "{x} {y}");
        }
    }
}
