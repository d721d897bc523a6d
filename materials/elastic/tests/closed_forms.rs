//! Homogeneous deformations whose stress is known in closed form, and the strains at which decompositions break.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_elastic::{FixedCorotated, HenckyElastic, NeoHookean};
use barchan_material_kit::random::Random;
use barchan_material_kit::{
    Dual, Lame, Mat3, MatIn, Material, Particle, Precision, Real, Strain, Subject, SymMat3, abi, vtable,
};

const YOUNG: f64 = 1e5;
const POISSON: f64 = 0.3;

fn subject<M: Material>() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<M>()) }.expect("a table of this version")
}

/// Kirchhoff stress at the deformation gradient `f`, for E = 10⁵ Pa, nu = 0.3.
fn stress<M: Material>(precision: Precision, f: Mat3<f64>) -> [f64; 6] {
    let subject = subject::<M>();
    let answer = subject.update(precision, &[YOUNG, POISSON], 0.0, &[particle(&subject, f)]);
    answer.expect("a finite stress")[0].kirchhoff
}

fn particle(subject: &Subject<'_>, f: Mat3<f64>) -> Particle {
    let mut particle = subject.particle_at_rest();
    particle.strain = if subject.is_left_cauchy_green() { f.times_transpose().into_planes() } else { f.components() };
    particle
}

fn diagonal([x, y, z]: [f64; 3]) -> Mat3<f64> {
    Mat3 { rows: [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]] }
}

/// Asserts agreement to `tolerance` of the greatest expected entry, and prints the error.
fn agree(what: &str, got: [f64; 6], expected: [f64; 6], tolerance: f64) {
    let scale = expected.iter().fold(0f64, |m, x| m.max(x.abs()));
    let error = got.iter().zip(expected).map(|(g, e)| (g - e).abs()).fold(0.0, f64::max) / scale;
    println!("{what}: error {error:.1e}, tolerance {tolerance:.0e}");
    assert!(error <= tolerance, "{what}: {got:?} instead of {expected:?}");
}

/// Principal Kirchhoff stresses of the three laws at principal stretches.
type Law = fn(Lame<f64>, [f64; 3]) -> [f64; 3];

fn neo_hookean(Lame { lambda, mu }: Lame<f64>, s: [f64; 3]) -> [f64; 3] {
    let ln_j = (s[0] * s[1] * s[2]).ln();
    s.map(|s| mu * (s * s - 1.0) + lambda * ln_j)
}

fn hencky(Lame { lambda, mu }: Lame<f64>, s: [f64; 3]) -> [f64; 3] {
    let ln_j = (s[0] * s[1] * s[2]).ln();
    s.map(|s| 2.0 * mu * s.ln() + lambda * ln_j)
}

fn fixed_corotated(Lame { lambda, mu }: Lame<f64>, s: [f64; 3]) -> [f64; 3] {
    let j = s[0] * s[1] * s[2];
    s.map(|s| 2.0 * mu * (s * s - s) + lambda * (j - 1.0) * j)
}

/// The law's stress at F = U diag(s) Vᵀ: turned by U alone.
fn expected(law: Law, s: [f64; 3], u: Mat3<f64>) -> [f64; 6] {
    let principal = law(Lame::new(YOUNG, POISSON), s);
    (u * diagonal(principal) * u.transpose()).symmetric_part().components()
}

fn turned_stretches_agree<M: Material>(law: Law) {
    let mut random = Random::new(1);
    for s in
        [[1.3, 1.0, 1.0], [0.7, 1.0, 1.0], [0.95, 1.02, 1.0], [1.1, 1.1, 0.8], [2.0, 0.5, 1.5], [0.999, 1.001, 1.0]]
    {
        let (u, v) = (random.rotation(), random.rotation());
        let f = u * diagonal(s) * v.transpose();
        agree(&format!("{} at {s:?}", M::NAME), stress::<M>(Precision::F64, f), expected(law, s, u), 1e-10);
    }
}

#[test]
fn principal_stresses_follow_their_closed_forms_in_any_frame() {
    turned_stretches_agree::<NeoHookean>(neo_hookean);
    turned_stretches_agree::<HenckyElastic>(hencky);
    turned_stretches_agree::<FixedCorotated>(fixed_corotated);
}

/// Simple shear γ of the neo-Hookean solid: τ_xy = μ γ, τ_xx = μ γ², all others 0.
#[test]
fn simple_shear_of_the_neo_hookean_solid() {
    let mu = YOUNG / (2.0 * (1.0 + POISSON));
    for shear in [0.01, 0.3, 2.0] {
        let f = Mat3 { rows: [[1.0, shear, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] };
        let exact = [mu * shear * shear, 0.0, 0.0, mu * shear, 0.0, 0.0];
        agree(&format!("shear {shear}"), stress::<NeoHookean>(Precision::F64, f), exact, 1e-10);
    }
}

/// Symptom guarded against: NaN or a jump where principal stretches are equal or nearly so, F = I above all, which is
/// every scene's first state. Physics: the stress is a smooth function of F there.
#[test]
fn equal_and_nearly_equal_stretches_are_harmless_in_f32() {
    fn check<M: Material>(law: Law) {
        let mut random = Random::new(2);
        assert_eq!(stress::<M>(Precision::F32, Mat3::identity()), [0.0; 6], "{}", M::NAME);
        for s in [[0.7; 3], [1.2; 3], [0.8, 0.8, 1.1], [0.8, 0.8 + 1e-7, 1.1], [1.3, 1.3 + 1e-7, 1.3 - 1e-7], [0.95; 3]]
        {
            let (u, v) = (random.rotation(), random.rotation());
            let f = u * diagonal(s) * v.transpose();
            // 1e-6 of λ + 2μ or of the stress, whichever is greater: f32 holds a stretch to 6e-8 only.
            let exact = expected(law, s, u);
            let got = stress::<M>(Precision::F32, f);
            let modulus = Lame::new(YOUNG, POISSON).tangent_moduli().p_wave;
            let scale = exact.iter().fold(modulus, |m, x| m.max(x.abs()));
            let error = got.iter().zip(exact).map(|(g, e)| (g - e).abs()).fold(0.0, f64::max) / scale;
            println!("{} at {s:?}: error {error:.1e}, tolerance 1e-6", M::NAME);
            assert!(error < 1e-6, "{} at {s:?}: {error:e}", M::NAME);
        }
    }
    check::<NeoHookean>(neo_hookean);
    check::<HenckyElastic>(hencky);
    check::<FixedCorotated>(fixed_corotated);
}

/// Symptom guarded against: a derivative that is 37 to 67 % wrong at F = I, from a clamped 0/0 in the derivative of a singular
/// value decomposition. Physics: at rest every law is linear elasticity, dτ = 2μ dε + λ tr(dε) I.
#[test]
fn the_derivative_at_rest_is_linear_elasticity() {
    fn check<M: Material, T: Real<Mask = bool> + Into<f64>>(offset: f64, tolerance: f64) {
        let mut random = Random::new(3);
        for _ in 0..10 {
            let df = random.matrix();
            let planes = |value: [f64; 9], derivative: [f64; 9]| {
                std::array::from_fn(|i| Dual::new(T::splat(value[i]), [T::splat(derivative[i])]))
            };
            let f = diagonal([1.0 + offset, 1.0, 1.0 - offset]);
            let f_planes: [Dual<T, 1>; 9] = planes(f.components(), df.components());
            let strain = if M::Strain::<f64>::PLANES == 9 {
                f_planes
            } else {
                Mat3::from_components(f_planes).times_transpose().into_planes()
            };
            let law = M::law(&[Dual::fixed(T::splat(YOUNG)), Dual::fixed(T::splat(POISSON))]);
            let zero = Dual::fixed(T::zero());
            let x =
                MatIn { strain: M::Strain::from_planes(strain), vel_grad: Mat3::from_components([zero; 9]), dt: zero };
            let stress = M::update(&law, x, &mut []).kirchhoff;
            let got = stress.components().map(|c| c.derivatives[0].into());
            let strain = df.symmetric_part();
            let exact: SymMat3<f64> = Lame::new(YOUNG, POISSON).stress(strain);
            agree(&format!("{} at I + {offset:e}", M::NAME), got, exact.components(), tolerance);
        }
    }
    for (offset, tolerance) in [(0.0, 1e-12), (1e-10, 1e-8)] {
        check::<NeoHookean, f64>(offset, tolerance);
        check::<HenckyElastic, f64>(offset, tolerance);
        check::<FixedCorotated, f64>(offset, tolerance);
    }
    check::<NeoHookean, f32>(0.0, 1e-6);
    check::<HenckyElastic, f32>(0.0, 1e-6);
    check::<FixedCorotated, f32>(0.0, 1e-6);
}

/// Symptom guarded against: −inf or NaN from the logarithm of a particle crushed flat in one step, and silence about it. The
/// logarithm is floored at a stretch of 10⁻⁴, the stress is huge and finite, and the ledger counts the particle.
#[test]
fn a_crushed_particle_has_finite_stress_and_is_counted() {
    fn check<M: Material>() {
        let subject = subject::<M>();
        for least in [1e-3, 1e-4, 1e-9, 0.0] {
            let crushed = particle(&subject, diagonal([1.0, 1.0, least]));
            for precision in [Precision::F32, Precision::F64] {
                let answer = subject.update(precision, &[YOUNG, POISSON], 0.0, &[crushed]).expect("a finite stress");
                assert!(answer[0].kirchhoff[2] < -YOUNG || M::Strain::<f64>::PLANES == 9);
            }
        }
        let flat = particle(&subject, diagonal([1.0, 1.0, 0.0]));
        let counts = subject.counts(&[YOUNG, POISSON], &[flat, subject.particle_at_rest(), flat]);
        let floored = counts.expect("counts").expect("counts")[abi::BARCHAN_COUNT_FLOORED];
        assert_eq!(floored, if M::Strain::<f64>::PLANES == 9 { 0 } else { 2 }, "{}", M::NAME);
    }
    check::<NeoHookean>();
    check::<HenckyElastic>();
    check::<FixedCorotated>();
}

/// Symptom guarded against: a particle that is turned inside out and stays so, because its stretches are taken without
/// their sign. Physics: the fixed corotated energy has its minimum at F = R only, and is smooth through det F = 0.
#[test]
fn an_inverted_particle_is_pushed_back() {
    let mut random = Random::new(4);
    for s in [[1.0, 1.0, -0.4], [1.1, 0.9, -0.01], [1.0, 0.8, 0.0]] {
        let (u, v) = (random.rotation(), random.rotation());
        let f = u * diagonal(s) * v.transpose();
        agree(
            &format!("at {s:?}"),
            stress::<FixedCorotated>(Precision::F64, f),
            expected(fixed_corotated, s, u),
            1e-10,
        );
        // P = τ F⁻ᵀ along the inverted axis is negative: it pulls the stretch up, towards 1.
        if s[2] < 0.0 {
            assert!(fixed_corotated(Lame::new(YOUNG, POISSON), s)[2] / s[2] < 0.0);
        }
    }
}

/// The tangent's bound must hold where the solid is stiffer than at rest, or the time step chosen from it is unstable.
#[test]
fn the_moduli_bound_the_stiffness_of_stretched_solids() {
    fn check<M: Material>(law: Law) {
        let subject = subject::<M>();
        let lame = Lame::new(YOUNG, POISSON);
        for s in [[2.0, 1.0, 1.0], [0.5, 1.5, 1.0], [0.7; 3], [1.5; 3]] {
            let step = 1e-6;
            for axis in 0..3 {
                let mut varied = s;
                varied[axis] *= 1.0 + step;
                let slope = (law(lame, varied)[axis] - law(lame, s)[axis]) / step;
                let moduli = subject.tangent_moduli(&[YOUNG, POISSON], &[particle(&subject, diagonal(s))]);
                let bound = moduli.expect("moduli").expect("moduli")[0][0];
                assert!(slope < bound * (1.0 + 1e-5), "{} at {s:?}: slope {slope}, bound {bound}", M::NAME);
            }
        }
    }
    check::<NeoHookean>(neo_hookean);
    check::<HenckyElastic>(hencky);
    check::<FixedCorotated>(fixed_corotated);
}
