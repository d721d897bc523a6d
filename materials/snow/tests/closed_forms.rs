//! Snow at one point: packing, tearing, hardening and its bounds.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Answer, Lame, Particle, Precision, Subject, abi, vtable};
use barchan_snow::Snow;

fn snow() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<Snow>()) }.expect("a table of this version")
}

/// A particle with the principal stretches `s` and plastic volume `volume`.
fn particle(s: [f64; 3], volume: f64) -> Particle {
    let mut particle = snow().particle_at_rest();
    particle.strain[..3].copy_from_slice(&s.map(|s| s * s));
    particle.state[0] = volume;
    particle
}

fn update(particle: Particle) -> Answer {
    snow().update(Precision::F64, &snow().default_params(), 1e-4, &[particle]).expect("a finite answer")[0]
}

fn small(what: &str, error: f64, tolerance: f64) {
    println!("{what}: error {error:.1e}, tolerance {tolerance:.0e}");
    assert!(error.abs() <= tolerance, "{what}: {error:e}");
}

/// Uniaxial compression to Λ, in one step and in many. Physics: s = max(Λ, 1 − θ_c), J_p = Λ/s,
/// τ_zz = e^{ξ (1 − J_p)} (2μ + λ) (s − 1) s, and the figures that this gives for the published parameters.
#[test]
fn oedometer() {
    let Lame { lambda, mu } = Lame::new(1.4e5, 0.2);
    for (total, printed) in
        [(0.99f64, -1540.0), (0.975, -3791.7), (0.95, -4899.9), (0.9, -8182.8), (0.8, -22820.9), (0.7, -63644.9)]
    {
        let s = total.max(0.975);
        let plastic_volume = total / s;
        let exact = (10.0 * (1.0 - plastic_volume)).exp() * (2.0 * mu + lambda) * (s - 1.0) * s;
        small(&format!("{total}: printed"), exact / printed - 1.0, 1e-4);
        for steps in [1, 10, 300] {
            let factor = total.powf(1.0 / f64::from(steps));
            let mut answer = update(particle([1.0; 3], 1.0));
            for _ in 0..steps {
                let mut next = Particle { strain: answer.strain, state: answer.state, ..particle([1.0; 3], 1.0) };
                next.strain[2] *= factor * factor;
                answer = update(next);
            }
            small(&format!("{total} in {steps} steps"), answer.kirchhoff[2] / exact - 1.0, 1e-10);
            small("  plastic volume", answer.state[0] / plastic_volume - 1.0, 1e-12);
        }
    }
}

/// Symptom: a jump in stress where the stretches reach their bounds, which is where the series hands over to the eigen-
/// decomposition. Physics: the stress is continuous in the strain.
#[test]
fn stress_is_continuous_where_flow_begins() {
    let mut worst = 0f64;
    for bound in [0.975, 1.0075] {
        for s in [[bound, 1.0, 1.0], [bound; 3], [bound, 1.003, 0.99]] {
            let [inside, outside] = [-1e-9, 1e-9].map(|d| {
                let towards = |s: f64| if s == bound { s + d * (bound - 1.0f64).signum() } else { s };
                update(particle(s.map(towards), 1.0)).kirchhoff
            });
            worst = inside.iter().zip(outside).map(|(a, b)| (a - b).abs() / 1.4e5).fold(worst, f64::max);
        }
    }
    small("jump", worst, 1e-8);
}

/// Symptom: stiffness, and with it the wave speed, growing without bound as snow is packed. Physics: h = e^{ξ (1 − J_p)}, so
/// e⁴ = 54.6 at J_p = 0.6; beyond `hardening_max` it is cut, and the ledger counts the particle.
#[test]
fn hardening_is_reported_and_bounded() {
    let params = snow().default_params();
    let at = |volume: f64| {
        let particles = [particle([1.0; 3], volume)];
        let moduli = snow().tangent_moduli(&params, &particles).expect("moduli").expect("moduli")[0];
        let counts = snow().counts(&params, &particles).expect("counts").expect("counts");
        (moduli[0] / Lame::new(1.4e5, 0.2).tangent_moduli().p_wave, counts[abi::BARCHAN_COUNT_CLAMPED])
    };
    let (factor, clamped) = at(0.6);
    small("factor at 0.6", factor / 4f64.exp() - 1.0, 1e-5);
    assert_eq!(clamped, 0);
    let (factor, clamped) = at(0.4);
    small("factor at 0.4", factor / 55.0 - 1.0, 1e-5);
    assert_eq!(clamped, 1);
    assert!(at(1.3).0 < 0.06, "torn snow is soft");
}

/// Physics: stretched beyond θ_s snow tears: the elastic stretch stays at 1 + θ_s while J_p grows and softens it.
#[test]
fn tearing() {
    let answer = update(particle([1.2, 1.0, 1.0], 1.0));
    let Lame { lambda, mu } = Lame::new(1.4e5, 0.2);
    let (s, volume) = (1.0075, 1.2 / 1.0075);
    let exact = (10.0 * (1.0f64 - volume)).exp() * (2.0 * mu + lambda) * (s - 1.0) * s;
    small("stress", answer.kirchhoff[0] / exact - 1.0, 1e-10);
    small("plastic volume", answer.state[0] / volume - 1.0, 1e-12);
    small("elastic stretch", answer.strain[0].sqrt() / s - 1.0, 1e-12);
}

/// Symptom: NaN from a particle crushed flat in one step, or an infinite J_p from one that expands for ever. Both stay finite, and
/// the ledger counts them.
#[test]
fn crushed_and_scattered_particles_stay_finite() {
    for precision in [Precision::F32, Precision::F64] {
        for p in [particle([1.0, 1.0, 0.0], 1.0), particle([0.0; 3], 1.0), particle([100.0; 3], 15.0)] {
            let answer = snow().update(precision, &snow().default_params(), 1e-4, &[p]).expect("a finite answer")[0];
            assert!((0.05..=20.0).contains(&answer.state[0]), "{answer:?}");
        }
    }
    let counts = snow()
        .counts(&snow().default_params(), &[particle([1.0, 1.0, 0.0], 1.0), particle([100.0; 3], 15.0)])
        .expect("counts")
        .expect("counts");
    assert_eq!(counts[abi::BARCHAN_COUNT_FLOORED], 1);
    assert_eq!(counts[abi::BARCHAN_COUNT_CLAMPED], 2);
    assert_eq!(counts[abi::BARCHAN_COUNT_YIELDING], 2);
}
