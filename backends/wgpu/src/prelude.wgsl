// What every material's WGSL may use: pure functions, no bindings.
//
// A material called foo defines
//
//   fn foo_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut
//
// a pure function of one particle. Its parameters are barchan_param(base, 0u), barchan_param(base, 1u), ... in the order of their
// declaration, [SI]; (*q)[0], (*q)[1], ... are its state variables before and after. Every name at module scope starts with foo_.
//
// and, if its stiffness changes with its state (BARCHAN_CAP_HARDENS),
//
//   fn foo_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness
//
// which bounds the time step; without it, particles are copied to the host every few steps to ask there.
//
// Strains are held minus I, here and in memory: f32 then keeps seven digits of a strain of a millionth. The host's
// planes are row-major and WGSL's matrices are lists of columns; F - I is given as the matrix it is: component ij is m[j][i].
// `log`, `exp`, `sin` and `cos` of WGSL are only good to 2^-11 to 2^-21 near where laws need them: use those below.

// Symmetric tensor: d = (xx, yy, zz), o = (xy, xz, yz).
struct Sym { d: vec3<f32>, o: vec3<f32> }

// Trial strain minus I (F, or b_e, by the material's strain_kind), velocity gradient [1/s] (zero unless the material has
// BARCHAN_CAP_VEL_GRAD), step [s].
struct MatIn { strain: mat3x3<f32>, vel_grad: mat3x3<f32>, dt: f32 }

// Strain after the return map, minus I, and Kirchhoff stress [Pa].
struct MatOut { strain: mat3x3<f32>, kirchhoff: mat3x3<f32> }

// Tangent moduli lambda + 2 mu and 3 lambda + 2 mu [Pa], and viscosity [Pa s].
struct Stiffness { p_wave: f32, triple_bulk: f32, viscosity: f32 }

// Least principal stretch squared that a logarithm is taken of, and least determinant of b.
const BARCHAN_MIN_STRETCH_SQUARED: f32 = 1e-8;
const BARCHAN_MIN_DETERMINANT: f32 = 1e-24;

fn barchan_sym(m: mat3x3<f32>) -> Sym {
    return Sym(vec3<f32>(m[0][0], m[1][1], m[2][2]), vec3<f32>(m[1][0], m[2][0], m[2][1]));
}

fn barchan_mat(s: Sym) -> mat3x3<f32> {
    return mat3x3<f32>(
        vec3<f32>(s.d.x, s.o.x, s.o.y), vec3<f32>(s.o.x, s.d.y, s.o.z), vec3<f32>(s.o.y, s.o.z, s.d.z));
}

// c s + t I.
fn barchan_affine(c: f32, s: Sym, t: f32) -> Sym {
    return Sym(c * s.d + vec3<f32>(t), c * s.o);
}

fn barchan_trace(s: Sym) -> f32 {
    return s.d.x + s.d.y + s.d.z;
}

fn barchan_deviator(s: Sym) -> Sym {
    return barchan_affine(1.0, s, barchan_trace(s) * (-1.0 / 3.0));
}

// Squared Frobenius norm.
fn barchan_norm2(s: Sym) -> f32 {
    return dot(s.d, s.d) + 2.0 * dot(s.o, s.o);
}

fn barchan_determinant(s: Sym) -> f32 {
    return s.d.x * (s.d.y * s.d.z - s.o.z * s.o.z) - s.o.x * (s.o.x * s.d.z - s.o.y * s.o.z)
        + s.o.y * (s.o.x * s.o.z - s.o.y * s.d.y);
}

// det(I + s) - 1.
fn barchan_det1p(s: Sym) -> f32 {
    let minors = s.d.x * s.d.y + s.d.x * s.d.z + s.d.y * s.d.z - dot(s.o, s.o);
    return barchan_trace(s) + minors + barchan_determinant(s);
}

// det(I + m) - 1 of any matrix.
fn barchan_det1p_mat(m: mat3x3<f32>) -> f32 {
    let minors = m[0][0] * m[1][1] - m[1][0] * m[0][1] + m[0][0] * m[2][2] - m[2][0] * m[0][2]
        + m[1][1] * m[2][2] - m[2][1] * m[1][2];
    return m[0][0] + m[1][1] + m[2][2] + minors + determinant(m);
}

// b - I of F - I: F F^T - I = H + H^T + H H^T.
fn barchan_left_cauchy_green(h: mat3x3<f32>) -> Sym {
    let s = barchan_sym(h * transpose(h));
    return Sym(s.d + 2.0 * vec3<f32>(h[0][0], h[1][1], h[2][2]),
        s.o + vec3<f32>(h[1][0] + h[0][1], h[2][0] + h[0][2], h[2][1] + h[1][2]));
}

// ln u for u > 0, given x = u - 1, which may be known better than u is. u = m 2^e with m in [2/3, 4/3) and the series of atanh in
// odd powers; relative error 2e-7, also of ln(1 + x) for the least x.
fn barchan_ln(u: f32, x: f32) -> f32 {
    let bits = bitcast<u32>(u);
    let whole = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u);
    let up = whole > 1.3333334;
    let e = i32(bits >> 23u) - 127 + select(0, 1, up);
    let f = select(select(whole, 0.5 * whole, up) - 1.0, x, e == 0);
    let s = f / (2.0 + f);
    let z = s * s;
    let p = 0.6666667 + z * (0.4 + z * (0.2857143 + z * (0.22222222 + z * 0.18181819)));
    let k = f32(e);
    // ln 2 in two parts, the first of which has trailing zeros.
    return k * 0.69314575 + (k * 1.4286068e-6 + (f - s * (f - z * p)));
}

// ln(1 + x) for x > -1.
fn barchan_log1p(x: f32) -> f32 {
    return barchan_ln(1.0 + x, x);
}

fn barchan_log(u: f32) -> f32 {
    return barchan_ln(u, u - 1.0);
}

// 2^k for whole k in [-126, 127].
fn barchan_power_of_two(k: f32) -> f32 {
    return bitcast<f32>(u32(i32(k) + 127) << 23u);
}

// 2^k and e^r - 1 with x = k ln 2 + r, |r| <= ln 2 / 2, for x clamped to [-87, 88].
fn barchan_exp_parts(x: f32) -> vec2<f32> {
    let bounded = clamp(x, -87.0, 88.0);
    let k = round(bounded * 1.442695);
    let r = (bounded - k * 0.69314575) - k * 1.4286068e-6;
    let p = r * (1.0 + r * (0.5 + r * (0.16666667 + r * (0.041666668 + r * (0.008333334 + r * (0.0013888889 + r * 1.984127e-4))))));
    return vec2<f32>(barchan_power_of_two(k), p);
}

// e^x - 1; relative error 2e-7, also for the least x.
fn barchan_expm1(x: f32) -> f32 {
    let e = barchan_exp_parts(x);
    return e.x * e.y + (e.x - 1.0);
}

fn barchan_exp(x: f32) -> f32 {
    let e = barchan_exp_parts(x);
    return e.x * (e.y + 1.0);
}

// (sin x, cos x) for x in [0, pi/2].
fn barchan_sin_cos(x: f32) -> vec2<f32> {
    let z = x * x;
    let sine = 1.0 - z / 6.0 * (1.0 - z / 20.0 * (1.0 - z / 42.0 * (1.0 - z / 72.0 * (1.0 - z / 110.0 * (1.0 - z / 156.0)))));
    let cosine = 1.0 - z / 2.0 * (1.0 - z / 12.0 * (1.0 - z / 30.0 * (1.0 - z / 56.0 * (1.0 - z / 90.0 * (1.0 - z / 132.0)))));
    return vec2<f32>(x * sine, cosine);
}

// Eigenvalues, and the eigenvectors of the first two; the third is their cross product.
struct Eigen { values: vec3<f32>, u: vec3<f32>, v: vec3<f32> }

// Closed form, any symmetric tensor; give it b - I, not b, so that strains keep their digits. Errors are 1e-6 of the greatest eigenvalue's
// distance from the mean.
//
// With s = m I + p B, ||B||^2 = 6, the eigenvalue of B furthest from the others is +-2 cos(acos(|r|)/3), r = det(B)/2, by a polynomial
// (8e-8); its vector is the longest cross product of two rows of B - beta I; one Jacobi rotation gives the other two.
fn barchan_eigen(s: Sym) -> Eigen {
    let mean = barchan_trace(s) * (1.0 / 3.0);
    let deviator = barchan_affine(1.0, s, -mean);
    let p2 = barchan_norm2(deviator) * (1.0 / 6.0);
    // Keeps 0/0 out of a spherical tensor.
    let inverse = inverseSqrt(p2 + 1e-30);
    let p = p2 * inverse;
    let d = deviator.d * inverse;
    let o = deviator.o * inverse;

    let r = 0.5 * barchan_determinant(Sym(d, o));
    let a = min(abs(r), 1.0);
    let g = 0.86602548 + a * (0.16665857 + a * (-0.04797367 + a * (0.02376997 + a * (-0.01251054 + a * (0.00505423 - 0.00102411 * a)))));
    let beta = select(-2.0 * g, 2.0 * g, r >= 0.0);

    let e = d - vec3<f32>(beta);
    let c0 = vec3<f32>(o.x * o.z - o.y * e.y, o.y * o.x - e.x * o.z, e.x * e.y - o.x * o.x);
    let c1 = vec3<f32>(o.x * e.z - o.y * o.z, o.y * o.y - e.x * e.z, e.x * o.z - o.x * o.y);
    let c2 = vec3<f32>(e.y * e.z - o.z * o.z, o.z * o.y - o.x * e.z, o.x * o.z - e.y * o.y);
    let n0 = dot(c0, c0);
    let n1 = dot(c1, c1);
    let n2 = dot(c2, c2);
    var w = c0;
    var norm2 = n0;
    if n1 > norm2 { norm2 = n1; w = c1; }
    if n2 > norm2 { norm2 = n2; w = c2; }
    if norm2 < 1e-10 { norm2 = 1.0; w = vec3<f32>(1.0, 0.0, 0.0); }
    w = w * inverseSqrt(norm2);

    var t: vec3<f32>;
    if abs(w.x) > abs(w.y) {
        t = vec3<f32>(-w.z, 0.0, w.x) * inverseSqrt(w.x * w.x + w.z * w.z);
    } else {
        t = vec3<f32>(0.0, w.z, -w.y) * inverseSqrt(w.y * w.y + w.z * w.z);
    }
    let n = cross(w, t);
    let bt = vec3<f32>(d.x * t.x + o.x * t.y + o.y * t.z, o.x * t.x + d.y * t.y + o.z * t.z, o.y * t.x + o.z * t.y + d.z * t.z);
    let bn = vec3<f32>(d.x * n.x + o.x * n.y + o.y * n.z, o.x * n.x + d.y * n.y + o.z * n.z, o.y * n.x + o.z * n.y + d.z * n.z);
    let tt = dot(t, bt);
    let nn = dot(n, bn);
    let twice = 2.0 * dot(n, bt);
    let difference = nn - tt;
    let root2 = difference * difference + twice * twice;
    // Keeps 0/0 out of equal eigenvalues.
    let tangent = abs(twice) / (abs(difference) + root2 * inverseSqrt(root2 + 1e-37) + 1e-25) * select(-1.0, 1.0, difference * twice >= 0.0);
    let cosine = inverseSqrt(1.0 + tangent * tangent);
    let u = cosine * (t - tangent * n);
    let shift = 0.5 * tangent * twice;
    return Eigen(vec3<f32>(mean) + p * vec3<f32>(beta, tt - shift, nn + shift), w, u);
}

// The tensor with these eigenvectors and the eigenvalues `values`.
fn barchan_compose(e: Eigen, values: vec3<f32>) -> Sym {
    let a = values.x - values.z;
    let b = values.y - values.z;
    return Sym(vec3<f32>(values.z) + a * e.u * e.u + b * e.v * e.v, a * e.u.xxy * e.u.yzz + b * e.v.xxy * e.v.yzz);
}

// Principal Hencky strains of b, given the eigenvalues of b - I; principal stretches below 1e-4 count as that.
fn barchan_principal_hencky(x: vec3<f32>) -> vec3<f32> {
    let u = max(x + vec3<f32>(1.0), vec3<f32>(BARCHAN_MIN_STRETCH_SQUARED));
    return 0.5 * vec3<f32>(barchan_ln(u.x, x.x), barchan_ln(u.y, x.y), barchan_ln(u.z, x.z));
}

// Eigenvalues of b - I, given principal Hencky strains.
fn barchan_principal_strain(hencky: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(barchan_expm1(2.0 * hencky.x), barchan_expm1(2.0 * hencky.y), barchan_expm1(2.0 * hencky.z));
}

// ln J = ln det(b) / 2, given b - I; a determinant below 1e-24 counts as that.
fn barchan_log_volume(s: Sym) -> f32 {
    let d = barchan_det1p(s);
    // Of a squashed particle, 1 + d has lost its digits.
    let squashed = max(barchan_determinant(barchan_affine(1.0, s, 1.0)), BARCHAN_MIN_DETERMINANT);
    return 0.5 * barchan_ln(select(1.0 + d, squashed, d < -0.5), d);
}

// Lame's constants [Pa].
struct Lame { lambda: f32, mu: f32 }

// From Young's modulus [Pa] and Poisson's ratio.
fn barchan_lame(young_modulus: f32, poisson_ratio: f32) -> Lame {
    let twice_mu = young_modulus / (1.0 + poisson_ratio);
    return Lame(twice_mu * poisson_ratio / (1.0 - poisson_ratio - poisson_ratio), 0.5 * twice_mu);
}

// Tangent moduli of the linear law, without viscosity.
fn barchan_stiffness(law: Lame) -> Stiffness {
    return Stiffness(law.lambda + 2.0 * law.mu, 3.0 * law.lambda + 2.0 * law.mu, 0.0);
}

// Principal Kirchhoff stresses of Hencky's law: 2 mu e + lambda tr(e).
fn barchan_hencky_stress(law: Lame, strain: vec3<f32>) -> vec3<f32> {
    return 2.0 * law.mu * strain + vec3<f32>(law.lambda * (strain.x + strain.y + strain.z));
}
