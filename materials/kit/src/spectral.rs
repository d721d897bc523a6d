//! Functions of symmetric tensors: logarithm, exponential and square root, by series near the identity and by
//! eigen-decomposition elsewhere.
//!
//! Which way a lane takes depends on its own values alone, and the results are selected lane by lane, so that a particle's
//! result is the same bits whatever its neighbours in the batch are.

use crate::tensor::{Mat3, SymMat3};
use barchan_lanes::{Mask, Real};

/// Least principal stretch squared that a logarithm is taken of: a stretch of 10⁻⁴.
pub const MIN_STRETCH_SQUARED: f64 = 1e-8;

/// Series serve where ‖b − I‖_F is below this.
const NEAR: f64 = 0.25;

/// ½ ln(1 + x) to 2⁻²⁵ (degree 11) and 2⁻⁵³ (degree 24) of the result for |x| < NEAR.
const HALF_LOG: [f64; 25] = half_log();
const HALF_LOG_DEGREE_F32: usize = 11;
/// √(1 + x) likewise.
const SQRT: [f64; 25] = square_root();
const SQRT_DEGREE_F32: usize = 11;
/// eˣ likewise, for |x| < -ln(1 - NEAR).
const EXP: [f64; 13] = exponential();
const EXP_DEGREE_F32: usize = 7;

const fn half_log() -> [f64; 25] {
    let mut a = [0.0; 25];
    let mut k = 1;
    while k < 25 {
        a[k] = if k % 2 == 1 { 0.5 } else { -0.5 } / k as f64;
        k += 1;
    }
    a
}

const fn square_root() -> [f64; 25] {
    let mut a = [1.0; 25];
    let mut k = 1;
    while k < 25 {
        a[k] = a[k - 1] * (1.5 - k as f64) / k as f64;
        k += 1;
    }
    a
}

const fn exponential() -> [f64; 13] {
    let mut a = [1.0; 13];
    let mut k = 1;
    while k < 13 {
        a[k] = a[k - 1] / k as f64;
        k += 1;
    }
    a
}

/// As much of a series as the precision of `T` can tell.
#[inline(always)]
fn series<T: Real, const N: usize>(coefficients: &'static [f64; N], degree_f32: usize) -> &'static [f64] {
    if T::EPSILON > 1e-10 { &coefficients[..=degree_f32] } else { coefficients }
}

/// Where series serve for functions of `b`: ‖b − I‖_F < 0.25.
#[inline(always)]
pub fn near_identity<T: Real>(b: SymMat3<T>) -> T::Mask {
    b.add_scalar(-T::one()).norm_squared().lt(T::splat(NEAR * NEAR))
}

/// Eigenvalues and eigenvectors of a symmetric tensor, in no particular order.
///
/// Of a tensor that varies, eigenvectors are those of its value alone: they turn without bound where two eigenvalues meet, while functions of the tensor
/// do not. What it has off its diagonal as these vectors see it is kept instead, a derivative without a value, and [`compose`](Self::compose) takes it up.
#[derive(Clone, Copy, Debug)]
pub struct Eigen<T> {
    /// The eigenvalues.
    pub values: [T; 3],
    /// `vectors[k]` belongs to `values[k]`; they are orthonormal.
    pub vectors: [[T; 3]; 3],
    /// Entries 01, 02 and 12 as the vectors see them.
    off: [T; 3],
}

/// The pairs of eigenvectors, as [`Eigen`] keeps what lies between them.
const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];

/// Eigenvalues that are closer than this, as a part of the greater one, count as equal in a divided difference: its error is a hundred-billionth either way.
const EQUAL: f64 = 1e-5;

impl<T: Real> Eigen<T> {
    /// Of a tensor with these eigenvalues and eigenvectors.
    #[inline(always)]
    pub fn new(values: [T; 3], vectors: [[T; 3]; 3]) -> Self {
        Self { values, vectors, off: [T::zero(); 3] }
    }

    /// Cyclic Jacobi rotations, a fixed number of sweeps: errors below 10⁻⁶ (f32) and 10⁻¹⁴ (f64) of the largest entry.
    #[inline(always)]
    pub fn of(a: SymMat3<T>) -> Self {
        let sweeps = if T::EPSILON > 1e-10 { 3 } else { 5 };
        let [mut u0, mut u1, mut u2] = Mat3::identity().rows;
        let SymMat3 { mut xx, mut yy, mut zz, mut xy, mut xz, mut yz } = if T::VARIES { constant(a) } else { a };
        for _ in 0..sweeps {
            rotate(&mut xx, &mut yy, &mut xy, &mut xz, &mut yz, &mut u0, &mut u1);
            rotate(&mut xx, &mut zz, &mut xz, &mut xy, &mut yz, &mut u0, &mut u2);
            rotate(&mut yy, &mut zz, &mut yz, &mut xy, &mut xz, &mut u1, &mut u2);
        }
        let vectors = [u0, u1, u2];
        if !T::VARIES {
            return Self::new([xx, yy, zz], vectors);
        }
        Self {
            values: [seen_by(a, u0, u0), seen_by(a, u1, u1), seen_by(a, u2, u2)],
            vectors,
            off: [seen_by(a, u0, u1), seen_by(a, u0, u2), seen_by(a, u1, u2)],
        }
    }

    /// The tensor with these eigenvectors and the eigenvalues `values`, which are those of a function of the tensor; `slopes` are that function's derivatives
    /// by the eigenvalues, which are asked for only where the tensor varies.
    #[inline(always)]
    pub fn compose(&self, values: [T; 3], slopes: [T; 3]) -> SymMat3<T> {
        let [u, v, w] = self.vectors;
        let scaled = [scale(u, values[0]), scale(v, values[1]), scale(w, values[2])];
        let composed = SymMat3 {
            xx: self.entry(scaled, 0, 0),
            yy: self.entry(scaled, 1, 1),
            zz: self.entry(scaled, 2, 2),
            xy: self.entry(scaled, 0, 1),
            xz: self.entry(scaled, 0, 2),
            yz: self.entry(scaled, 1, 2),
        };
        if T::VARIES { composed + self.between(self.function(values, slopes).off) } else { composed }
    }

    /// Eigenvalues `values` of a function of the tensor with its eigenvectors, and what a tensor that varies then has between these: with divided
    /// differences, whose limit where eigenvalues are equal is the slope (Higham 2008, "Functions of matrices", theorem 3.11).
    #[inline(always)]
    fn function(&self, values: [T; 3], slopes: [T; 3]) -> Self {
        let mut off = self.off;
        if T::VARIES {
            for (off, (i, j)) in off.iter_mut().zip(PAIRS) {
                let [a, b] = [self.values[i].constant(), self.values[j].constant()];
                let equal = (a - b).abs().le(a.abs().max(b.abs()) * T::splat(EQUAL));
                let quotient = (values[i] - values[j]).constant() / T::select(equal, T::one(), a - b);
                let slope = T::splat(0.5) * (slopes[i] + slopes[j]).constant();
                *off *= T::select(equal, slope, quotient);
            }
        }
        Self { values, vectors: self.vectors, off }
    }

    /// The tensor that has these entries between the eigenvectors, and none on its diagonal.
    #[inline(always)]
    fn between(&self, off: [T; 3]) -> SymMat3<T> {
        let mut sum = SymMat3::scalar(T::zero());
        for (off, (i, j)) in off.into_iter().zip(PAIRS) {
            sum = sum + both(self.vectors[i], self.vectors[j]).scale(off);
        }
        sum
    }

    #[inline(always)]
    fn entry(&self, scaled: [[T; 3]; 3], i: usize, j: usize) -> T {
        let [u, v, w] = self.vectors;
        scaled[0][i].mul_add(u[j], scaled[1][i].mul_add(v[j], scaled[2][i] * w[j]))
    }
}

/// u · a v.
#[inline(always)]
fn seen_by<T: Real>(a: SymMat3<T>, u: [T; 3], v: [T; 3]) -> T {
    let rows = [[a.xx, a.xy, a.xz], [a.xy, a.yy, a.yz], [a.xz, a.yz, a.zz]];
    let mut sum = T::zero();
    for i in 0..3 {
        sum = u[i].mul_add(rows[i][0].mul_add(v[0], rows[i][1].mul_add(v[1], rows[i][2] * v[2])), sum);
    }
    sum
}

/// u vᵀ + v uᵀ.
#[inline(always)]
fn both<T: Real>(u: [T; 3], v: [T; 3]) -> SymMat3<T> {
    SymMat3 {
        xx: u[0].mul_add(v[0], u[0] * v[0]),
        yy: u[1].mul_add(v[1], u[1] * v[1]),
        zz: u[2].mul_add(v[2], u[2] * v[2]),
        xy: u[0].mul_add(v[1], u[1] * v[0]),
        xz: u[0].mul_add(v[2], u[2] * v[0]),
        yz: u[1].mul_add(v[2], u[2] * v[1]),
    }
}

/// The tensor without its derivatives.
#[inline(always)]
fn constant<T: Real>(a: SymMat3<T>) -> SymMat3<T> {
    SymMat3 {
        xx: a.xx.constant(),
        yy: a.yy.constant(),
        zz: a.zz.constant(),
        xy: a.xy.constant(),
        xz: a.xz.constant(),
        yz: a.yz.constant(),
    }
}

// Helpers are functions, never closures: a closure cannot be told to be inlined always, and one that is not is compiled
// without the vector instructions.

#[inline(always)]
fn scale<T: Real>([x, y, z]: [T; 3], s: T) -> [T; 3] {
    [x * s, y * s, z * s]
}

/// Derivative of ½ ln max(x, `least`).
#[inline(always)]
fn slope_of_log<T: Real>(x: T, least: T) -> T {
    T::select(x.lt(least), T::zero(), T::splat(0.5) / x.max(least))
}

/// Derivatives of square roots by what they are the roots of: none at 0, where there is none.
#[inline(always)]
fn slopes_of_root<T: Real>(roots: [T; 3]) -> [T; 3] {
    let mut slopes = [T::zero(); 3];
    for (slope, root) in slopes.iter_mut().zip(roots) {
        let some = root.abs().gt(T::splat(T::TINY));
        *slope = T::select(some, T::splat(0.5) / T::select(some, root, T::one()), T::zero());
    }
    slopes
}

#[inline(always)]
fn positive_root<T: Real>(x: T) -> T {
    x.max(T::zero()).sqrt()
}

/// One Jacobi rotation, which makes a_pq zero. Two square roots and one division: with d = a_qq − a_pp, r = √(d² + 4 a_pq²)
/// and w = |d| + r, cosine and sine are w and ±2 a_pq over √(w² + 4 a_pq²), and the diagonal moves by (r − |d|)/2.
#[inline(always)]
fn rotate<T: Real>(
    a_pp: &mut T,
    a_qq: &mut T,
    a_pq: &mut T,
    a_rp: &mut T,
    a_rq: &mut T,
    u_p: &mut [T; 3],
    u_q: &mut [T; 3],
) {
    // Keeps 0/0 out where d = a_pq = 0; its square is still a normal f32.
    let guard = T::splat(1e-18);
    let d = *a_qq - *a_pp;
    let swap = d.lt(T::zero());
    let twice = *a_pq + *a_pq;
    let twice_squared = twice * twice;
    let r = d.mul_add(d, twice_squared).sqrt();
    let w = d.abs() + r + guard;
    let inverse = w.mul_add(w, twice_squared).sqrt().recip();
    let c = w * inverse;
    let s = T::select(swap, -twice, twice) * inverse;
    let shift = T::splat(0.5) * (r - d.abs());
    let shift = T::select(swap, -shift, shift);
    *a_pp -= shift;
    *a_qq += shift;
    *a_pq = T::zero();
    (*a_rp, *a_rq) = (c.mul_add(*a_rp, -(s * *a_rq)), s.mul_add(*a_rp, c * *a_rq));
    for (p, q) in u_p.iter_mut().zip(u_q) {
        (*p, *q) = (c.mul_add(*p, -(s * *q)), s.mul_add(*p, c * *q));
    }
}

/// Hencky strain ε = ½ ln b of a left Cauchy–Green tensor, kept with what is needed to go back to b.
#[derive(Clone, Copy, Debug)]
pub struct Hencky<T: Real> {
    /// ε [1].
    pub strain: SymMat3<T>,
    /// Where a principal stretch was below 10⁻⁴ and was raised to that before the logarithm.
    pub floored: T::Mask,
    near: T::Mask,
    /// Eigenvectors of b and eigenvalues of ε, if any lane is far from the identity.
    far: Option<Eigen<T>>,
}

impl<T: Real> Hencky<T> {
    /// ½ ln `b`.
    #[inline(always)]
    pub fn of(b: SymMat3<T>) -> Self {
        let near = near_identity(b);
        if near.all() {
            let strain = half_log_near_identity(b);
            return Self { strain, floored: T::Mask::splat(false), near, far: None };
        }
        let least = T::splat(MIN_STRETCH_SQUARED);
        let eigen = Eigen::of(b);
        let [x, y, z] = eigen.values;
        let floored = (x.lt(least) | y.lt(least) | z.lt(least)) & !near;
        let half = T::splat(0.5);
        let logs = [half * x.max(least).ln(), half * y.max(least).ln(), half * z.max(least).ln()];
        let slopes = [slope_of_log(x, least), slope_of_log(y, least), slope_of_log(z, least)];
        let mut strain = eigen.compose(logs, slopes);
        let eigen = eigen.function(logs, slopes);
        if near.any() {
            strain = SymMat3::select(near, half_log_near_identity(b), strain);
        }
        Self { strain, floored, near, far: Some(eigen) }
    }

    /// The left Cauchy–Green tensor of the strain whose deviator is `scale` dev ε and whose trace is `trace`:
    /// exp(2 `scale` dev ε + ⅔ `trace` I). `scale` must lie in [0, 1].
    #[inline(always)]
    pub fn rescaled(&self, scale: T, trace: T) -> SymMat3<T> {
        let volume = (T::splat(2.0 / 3.0) * trace).exp();
        let twice = scale + scale;
        let twice_deviator = self.strain.deviator().scale(twice);
        let shape = match &self.far {
            None => exp_near_zero(twice_deviator),
            Some(eigen) => {
                let [x, y, z] = eigen.values;
                let mean = (x + y + z) * T::splat(1.0 / 3.0);
                let stretches = [(twice * (x - mean)).exp(), (twice * (y - mean)).exp(), (twice * (z - mean)).exp()];
                let slopes = [twice * stretches[0], twice * stretches[1], twice * stretches[2]];
                let mut shape = eigen.compose(stretches, slopes);
                if self.near.any() {
                    shape = SymMat3::select(self.near, exp_near_zero(twice_deviator), shape);
                }
                shape
            }
        };
        shape.scale(volume)
    }
}

/// Left stretch V = R Fᵀ of the polar decomposition F = V R with a proper rotation R.
///
/// V V = F Fᵀ. Where det F < 0 the principal stretch of least magnitude is negative, which lets an inverted particle turn
/// back through the nearest flat state (Irving, Teran and Fedkiw 2004, "Invertible finite elements"). The least stretch is det F over
/// the other two, so it keeps full precision, sign included, down to a flat particle.
#[inline(always)]
pub fn left_stretch<T: Real>(f: Mat3<T>) -> SymMat3<T> {
    let b = f.times_transpose();
    let j = f.determinant();
    let near = near_identity(b) & j.gt(T::zero());
    let stretch = sqrt_near_identity(b);
    if near.all() {
        return stretch;
    }
    let eigen = Eigen::of(b);
    let [x, y, z] = eigen.values;
    let x_is_least = x.le(y) & x.le(z);
    let y_is_least = !x_is_least & y.le(z);
    let z_is_least = !x_is_least & !y_is_least;
    let others = T::select(x_is_least, y * z, T::select(y_is_least, x * z, x * y));
    // The product of the other two is as small as this only where j is smaller still.
    let least = j / positive_root(others).max(T::splat(1e-12));
    let stretches = [
        T::select(x_is_least, least, positive_root(x)),
        T::select(y_is_least, least, positive_root(y)),
        T::select(z_is_least, least, positive_root(z)),
    ];
    let far = eigen.compose(stretches, slopes_of_root(stretches));
    SymMat3::select(near, stretch, far)
}

/// ln J = ½ ln det b of a left Cauchy–Green tensor, and where det b was below 10⁻²⁴ and was raised to that.
#[inline(always)]
pub fn log_volume<T: Real>(b: SymMat3<T>) -> (T, T::Mask) {
    let least = T::splat(MIN_STRETCH_SQUARED * MIN_STRETCH_SQUARED * MIN_STRETCH_SQUARED);
    let det = b.determinant();
    (T::splat(0.5) * det.max(least).ln(), det.lt(least))
}

/// ½ ln b by series, for tensors where [`near_identity`] holds.
#[inline(always)]
fn half_log_near_identity<T: Real>(b: SymMat3<T>) -> SymMat3<T> {
    b.add_scalar(-T::one()).polynomial(series::<T, 25>(&HALF_LOG, HALF_LOG_DEGREE_F32))
}

/// exp(a) by series, for the logarithms of tensors where [`near_identity`] holds.
#[inline(always)]
fn exp_near_zero<T: Real>(a: SymMat3<T>) -> SymMat3<T> {
    a.polynomial(series::<T, 13>(&EXP, EXP_DEGREE_F32))
}

/// √b by series, for tensors where [`near_identity`] holds.
#[inline(always)]
pub fn sqrt_near_identity<T: Real>(b: SymMat3<T>) -> SymMat3<T> {
    b.add_scalar(-T::one()).polynomial(series::<T, 25>(&SQRT, SQRT_DEGREE_F32))
}

/// √b of a left Cauchy–Green tensor: its left stretch. Negative eigenvalues count as 0.
#[inline(always)]
pub fn sqrt<T: Real>(b: SymMat3<T>) -> SymMat3<T> {
    let near = near_identity(b);
    let root = sqrt_near_identity(b);
    if near.all() {
        return root;
    }
    let eigen = Eigen::of(b);
    let [x, y, z] = eigen.values;
    let roots = [positive_root(x), positive_root(y), positive_root(z)];
    let far = eigen.compose(roots, slopes_of_root(roots));
    SymMat3::select(near, root, far)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use barchan_lanes::Float;

    /// Greatest entry of the difference of two tensors.
    fn distance<T: Float>(a: SymMat3<T>, b: SymMat3<f64>) -> f64 {
        a.components().iter().zip(b.components()).map(|(x, y)| (x.to_f64() - y).abs()).fold(0.0, f64::max)
    }

    fn rounded<T: Float>(a: SymMat3<f64>) -> SymMat3<T> {
        SymMat3::from_components(a.components().map(T::from_f64))
    }

    /// Tensors with the eigenvalues that break eigen-solvers: equal, nearly equal, small, large, and random ones.
    fn hard_tensors() -> Vec<SymMat3<f64>> {
        let mut random = Random::new(1);
        let mut spectra = vec![
            [1.0, 1.0, 1.0],
            [2.0, 2.0, 2.0],
            [1.0, 1.0, 2.0],
            [1.0, 1.0 + 1e-7, 2.0],
            [1.5, 1.5 + 1e-7, 1.5 - 1e-7],
            [1.0, 1e-4, 1e-6],
            [4.0, 4.0, 1e-3],
        ];
        spectra.extend((0..2000).map(|_| [0; 3].map(|_| (2.0 * random.unit() - 1.0).exp2().powi(2))));
        spectra
            .into_iter()
            .map(|values| {
                let rotation = random.rotation();
                Eigen::new(values, rotation.transpose().rows).compose(values, [1.0; 3])
            })
            .collect()
    }

    fn eigen_errors<T: Float>() -> (f64, f64) {
        let (mut residual, mut orthogonality) = (0f64, 0f64);
        for a in hard_tensors() {
            let a = rounded::<T>(a);
            let exact = SymMat3::from_components(a.components().map(T::to_f64));
            let eigen = Eigen::of(a);
            let scale = exact.norm_squared().sqrt();
            residual = residual.max(distance(eigen.compose(eigen.values, [T::one(); 3]), exact) / scale);
            orthogonality =
                orthogonality.max(distance(eigen.compose([T::one(); 3], [T::zero(); 3]), SymMat3::identity()));
        }
        (residual, orthogonality)
    }

    #[test]
    fn eigen_decomposition_meets_its_stated_error_in_both_precisions() {
        for (name, (residual, orthogonality), tolerance) in
            [("f32", eigen_errors::<f32>(), 1e-6), ("f64", eigen_errors::<f64>(), 1e-14)]
        {
            println!("{name}: residual {residual:.1e}, orthogonality {orthogonality:.1e}, tolerance {tolerance:.0e}");
            assert!(residual < tolerance && orthogonality < tolerance, "{name}: {residual:e} {orthogonality:e}");
        }
    }

    /// Symptom guarded against: a jump in stress where the series hands over to the eigen-decomposition.
    #[test]
    fn logarithm_and_exponential_are_inverse_and_seamless_between_series_and_eigen_path() {
        let mut random = Random::new(2);
        let (mut seam, mut inverse, mut root) = (0f64, 0f64, 0f64);
        for i in 0..2000 {
            let norm = if i % 2 == 0 { NEAR * (1.0 - 1e-9) } else { 0.6 * random.unit() };
            let a = random.symmetric();
            let b = a.scale(norm / a.norm_squared().sqrt()).add_scalar(1.0);
            let log = Hencky::of(b);
            let eigen = Eigen::of(b);
            let exact = eigen.compose(eigen.values.map(|v| 0.5 * v.ln()), eigen.values.map(|v| 0.5 / v));
            seam = seam.max(distance(log.strain, exact));
            inverse = inverse.max(distance(log.rescaled(1.0, log.strain.trace()), b));
            root = root.max(
                distance(
                    sqrt_near_identity(b),
                    eigen.compose(eigen.values.map(f64::sqrt), eigen.values.map(|v| 0.5 / v.sqrt())),
                ) * f64::from(u8::from(norm < NEAR)),
            );
        }
        println!("logarithm {seam:.1e}, exponential {inverse:.1e}, square root {root:.1e}, tolerance 1e-14");
        assert!(seam < 1e-14 && inverse < 1e-14 && root < 1e-14, "{seam:e} {inverse:e} {root:e}");
    }

    #[test]
    fn single_precision_logarithm_keeps_six_digits_of_the_strain() {
        let mut random = Random::new(3);
        let mut worst = 0f64;
        for _ in 0..2000 {
            let a = random.symmetric();
            let b = rounded::<f32>(a.scale(0.8 * random.unit() / a.norm_squared().sqrt()).add_scalar(1.0));
            let exact = Hencky::of(SymMat3::from_components(b.components().map(f64::from))).strain;
            worst = worst.max(distance(Hencky::of(b).strain, exact));
        }
        println!("error {worst:.1e}, tolerance 1e-6");
        assert!(worst < 1e-6, "{worst:e}");
    }

    /// Symptom guarded against: an inverted particle that is silently turned right side out. det F changes sign with the
    /// least principal stretch, and V must follow it continuously through the flat state.
    #[test]
    fn left_stretch_keeps_the_sign_of_the_determinant() {
        let mut random = Random::new(4);
        let mut worst = 0f64;
        for stretches in [[1.2, 0.9, -0.3], [1.0, 1.0, -0.9], [1.1, 0.7, 0.0], [1.0, 1.0, 1e-9], [1.0, 1.0, 1.0]] {
            let (u, v) = (random.rotation(), random.rotation());
            let exact = Eigen::new(stretches, u.transpose().rows).compose(stretches, [1.0; 3]);
            let f = Mat3::from(exact) * v;
            worst = worst.max(distance(left_stretch(f), exact));
        }
        println!("error {worst:.1e}, tolerance 1e-14");
        assert!(worst < 1e-14, "{worst:e}");
    }
}
