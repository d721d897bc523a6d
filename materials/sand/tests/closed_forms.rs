//! Sand at one point: the cone, its tip, the volume correction, and the limits of its parameters.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Answer, Lame, Particle, Precision, Subject, abi, vtable};
use barchan_sand::Sand;
use std::f64::consts::PI;

fn sand() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<Sand>()) }.expect("a table of this version")
}

fn update(params: &[f64], particle: Particle) -> Answer {
    sand().update(Precision::F64, params, 1e-4, &[particle]).expect("a finite answer")[0]
}

/// A particle with left Cauchy–Green tensor xx yy zz xy xz yz and volume gap.
fn particle(b: [f64; 6], gap: f64) -> Particle {
    let mut particle = sand().particle_at_rest();
    particle.strain[..6].copy_from_slice(&b);
    particle.state[0] = gap;
    particle
}

/// b of the Hencky strain diag(x, y, z).
fn stretched([x, y, z]: [f64; 3]) -> [f64; 6] {
    [(2.0 * x).exp(), (2.0 * y).exp(), (2.0 * z).exp(), 0.0, 0.0, 0.0]
}

/// b of the Hencky strain with normal components `normal` and shear component xz `shear`.
fn sheared(normal: f64, shear: f64) -> [f64; 6] {
    let (volume, cosh, sinh) = ((2.0 * normal).exp(), (2.0 * shear).cosh(), (2.0 * shear).sinh());
    [volume * cosh, volume, volume * cosh, 0.0, volume * sinh, 0.0]
}

/// The particle after F ← (I + shear e_x e_zᵀ) diag(1, 1, s) F.
fn carried(answer: &Answer, shear: f64, s: f64) -> Particle {
    let [xx, yy, zz, xy, xz, yz, ..] = answer.strain;
    let (zz, xz, yz) = (s * s * zz, s * xz, s * yz);
    particle(
        [xx + 2.0 * shear * xz + shear * shear * zz, yy, zz, xy + shear * yz, xz + shear * zz, yz],
        answer.state[0],
    )
}

fn small(what: &str, error: f64, tolerance: f64) {
    println!("{what}: error {error:.1e}, tolerance {tolerance:.0e}");
    assert!(error.abs() <= tolerance, "{what}: {error:e}");
}

const LAME_E: f64 = 1e6;
const LAME_NU: f64 = 0.2;

fn lame() -> Lame<f64> {
    Lame::new(LAME_E, LAME_NU)
}

fn triple_bulk() -> f64 {
    lame().triple_bulk()
}

fn pressure(answer: &Answer) -> f64 {
    -(answer.kirchhoff[0] + answer.kirchhoff[1] + answer.kirchhoff[2]) / 3.0
}

/// Shear on an isotropically compressed particle. Physics: at yield τ_xz/τ_zz = 2√3 sin φ/(3 − sin φ) for the cone matched in
/// triaxial compression, tan φ for the one matched in simple shear, with all normal stresses equal.
#[test]
fn shear_strength_of_both_cones() {
    for degrees in [20.0, 25.0, 30.0, 35.0f64] {
        let phi = degrees.to_radians();
        let triaxial = 2.0 * 3f64.sqrt() * phi.sin() / (3.0 - phi.sin());
        for (cone, exact) in [(0.0, triaxial), (1.0, phi.tan())] {
            let params = sand().params_with(&[("friction_angle", phi), ("cone", cone)]);
            // One return from far outside the cone; near the identity (series) and far from it (eigen-decomposition).
            for (normal, shear) in [(-0.01, 0.05), (-0.2, 0.6)] {
                let k = update(&params, particle(sheared(normal, shear), 0.0)).kirchhoff;
                small(&format!("phi {degrees}, cone {cone}: ratio"), k[4].abs() / k[2].abs() / exact - 1.0, 1e-10);
                let spread = (k[0] - k[2]).abs().max((k[1] - k[2]).abs()) / k[2].abs();
                small("  normal stresses", spread, 1e-10);
            }
        }
    }
    // The figures to four digits, as derived independently.
    for (degrees, ratio) in [(20.0f64, 0.4457), (25.0, 0.5680), (30.0, 0.6928), (35.0, 0.8189)] {
        let params = sand().params_with(&[("friction_angle", degrees.to_radians())]);
        // Small elastic strains (1e-5), since their turning adds as much to the normal stresses.
        let mut answer = update(&params, particle(sheared(-1e-5, 0.0), 0.0));
        for _ in 0..10_000 {
            answer = update(&params, carried(&answer, 1e-6, 1.0));
        }
        let k = answer.kirchhoff;
        small(&format!("steady shear, phi {degrees}"), (k[4] / k[2]).abs() - ratio, 1e-4);
        small("  normal stresses", ((k[0] - k[2]) / k[2]).abs(), 1e-4);
    }
}

/// Uniaxial compression from rest. Physics: K0 = max(nu/(1 − nu), (1 − sin φ)/(1 + sin φ)), since the cone is matched on this
/// very path.
#[test]
fn earth_pressure_at_rest() {
    for (degrees, nu, printed) in
        [(20.0f64, 0.2, 0.4903), (30.0, 0.2, 0.3333), (30.0, 0.3, 0.4286), (35.0, 0.2, 0.2710), (45.0, 0.2, 0.2500)]
    {
        let phi = degrees.to_radians();
        let params = sand().params_with(&[("friction_angle", phi), ("poisson_ratio", nu)]);
        let exact = (nu / (1.0 - nu)).max((1.0 - phi.sin()) / (1.0 + phi.sin()));
        let mut answer = update(&params, particle(stretched([0.0; 3]), 0.0));
        for _ in 0..100 {
            answer = update(&params, carried(&answer, 0.0, 0.999));
        }
        let k = answer.kirchhoff;
        small(&format!("phi {degrees}, nu {nu}: K0"), k[0] / k[2] / exact - 1.0, 1e-10);
        small("  printed", exact - printed, 5e-5);
    }
}

/// After the return the stress lies on the cone, cohesion included.
#[test]
fn the_return_map_ends_on_the_cone() {
    let (phi, c) = (0.6f64, 2e3);
    let factor = (2.0f64 / 3.0).sqrt() * 6.0 / (3.0 - phi.sin());
    for (cone, slope, k) in
        [(0.0, factor * phi.sin(), factor * c * phi.cos()), (1.0, 2f64.sqrt() * phi.tan(), 2f64.sqrt() * c)]
    {
        let params = sand().params_with(&[("friction_angle", phi), ("cohesion", c), ("cone", cone)]);
        for strain in [[-0.02, 0.01, -0.01], [-0.3, 0.1, 0.05], [0.002, -0.003, 0.0015]] {
            let answer = update(&params, particle(stretched(strain), 0.0));
            let p = pressure(&answer);
            let deviator = [0, 1, 2].map(|i| answer.kirchhoff[i] + p);
            let norm = deviator.iter().map(|x| x * x).sum::<f64>().sqrt();
            small(&format!("cone {cone} at {strain:?}"), norm / (slope * p + k) - 1.0, 1e-10);
        }
    }
}

/// Symptom: sand that gains volume, and pressure, with each cycle of opening and closing. Physics: after stretching by e^{0.1}
/// and compressing by e^{−0.1} the density is that at rest, so there is no pressure; it builds up from there.
#[test]
fn the_volume_gained_beyond_the_tip_is_given_back() {
    let cycle = |params: &[f64], amount: f64| {
        let opened = update(params, particle(stretched([amount; 3]), 0.0));
        assert_eq!(opened.kirchhoff, [0.0; 6]);
        let factor = (-2.0 * amount).exp();
        let closed = opened.strain.map(|b| b * factor);
        update(params, Particle { strain: closed, state: opened.state, ..particle([0.0; 6], 0.0) })
    };
    let with = sand().default_params();
    let without = sand().params_with(&[("volume_correction", 0.0)]);

    let answer = cycle(&with, 0.1);
    small("pressure after the cycle", pressure(&answer) / LAME_E, 1e-12);
    small("gap after the cycle", answer.state[0], 1e-12);
    let leftover = pressure(&cycle(&without, 0.1));
    small("pressure left without correction", leftover / (0.1 * triple_bulk()) - 1.0, 1e-10);

    let further = update(
        &with,
        particle(
            answer.strain[..6].try_into().map(|b: [f64; 6]| b.map(|x| x * (-0.02f64).exp())).expect("six"),
            answer.state[0],
        ),
    );
    small("pressure on further compression", pressure(&further) / (0.01 * triple_bulk()) - 1.0, 1e-10);

    // A thousand cycles leave nothing either.
    let mut particle_now = particle(stretched([0.0; 3]), 0.0);
    let mut answer = update(&with, particle_now);
    for _ in 0..1000 {
        for factor in [0.05f64, -0.05] {
            particle_now.strain = answer.strain.map(|b| b * (2.0 * factor).exp());
            particle_now.state = answer.state;
            answer = update(&with, particle_now);
        }
    }
    small("pressure after 1000 cycles", pressure(&answer) / LAME_E, 1e-10);
}

/// Symptom: a deviator that is not traceless, because the gap was subtracted from the mean strain and not added to each
/// entry. Physics: with gap v the stress is 2μ dev ε + K (tr ε + v) I.
#[test]
fn the_gap_changes_pressure_only() {
    let params = sand().params_with(&[("friction_angle", 1.2)]);
    let (strain, gap) = ([-0.10, -0.11, -0.12], 0.1);
    let answer = update(&params, particle(stretched(strain), gap));
    let trace: f64 = strain.iter().sum();
    let mu = lame().mu;
    for (stress, strain) in answer.kirchhoff.iter().zip(strain) {
        let exact = 2.0 * mu * (strain - trace / 3.0) + triple_bulk() / 3.0 * (trace + gap);
        small("stress", stress / exact - 1.0, 1e-12);
    }
    assert_eq!(answer.state[0], 0.0);
    let logs: f64 = answer.strain[..3].iter().map(|b| 0.5 * b.ln()).sum();
    small("trace of the strain kept", logs - (trace + gap), 1e-12);
}

/// Symptom: a clod that flew for seconds lands and bears nothing for ever, since its gap grew all the way. Physics: beyond a
/// density of e^{−1/2} of that at rest, grains no longer know of each other; the gap stops there, and the ledger says so.
#[test]
fn the_gap_is_bounded_in_free_flight() {
    let params = sand().default_params();
    let mut answer = update(&params, particle(stretched([0.0; 3]), 0.0));
    let mut last = particle(stretched([0.0; 3]), 0.0);
    for _ in 0..100_000 {
        last = particle(stretched([1e-3; 3]), answer.state[0]);
        answer = update(&params, last);
    }
    assert_eq!(answer.state[0], 0.5);
    let counts = sand().counts(&params, &[last]).expect("counts").expect("counts");
    assert_eq!((counts[abi::BARCHAN_COUNT_APEX], counts[abi::BARCHAN_COUNT_CLAMPED]), (1, 1));
    // Landing: after closing the gap by ln J = -0.5 it bears load as it did at rest.
    let landed = update(&params, particle(stretched([(-0.5 - 0.03) / 3.0; 3]), answer.state[0]));
    small("pressure on landing", pressure(&landed) / (0.01 * triple_bulk()) - 1.0, 1e-10);
}

/// Symptom: NaN at phi = 0, from a cone of no opening. Physics: no friction is an inviscid fluid, with pressure and no shear;
/// and friction angles for which plane strain never fails (42.3° and above) are legal, if strong.
#[test]
fn every_friction_angle_is_finite() {
    let fluid = sand().params_with(&[("friction_angle", 0.0)]);
    for b in [sheared(-0.01, 0.05), sheared(-0.3, 0.2), sheared(0.0, 0.1)] {
        let k = update(&fluid, particle(b, 0.0)).kirchhoff;
        let scale = LAME_E;
        small("shear stress", (k[4].abs() + (k[0] - k[2]).abs() + (k[0] - k[1]).abs()) / scale, 1e-12);
    }
    small(
        "fluid's pressure",
        update(&fluid, particle(sheared(-0.01, 0.05), 0.0)).kirchhoff[0] / (-0.01 * triple_bulk()) - 1.0,
        1e-10,
    );
    assert_eq!(update(&fluid, particle(sheared(0.01, 0.05), 0.0)).kirchhoff, [0.0; 6], "a fluid bears no tension");

    for degrees in [0.0, 1e-9, 42.3, 60.0, 89.0, 89.999f64] {
        for cone in [0.0, 1.0] {
            for cohesion in [0.0, 1e3] {
                let params = sand().params_with(&[
                    ("friction_angle", degrees.to_radians()),
                    ("cone", cone),
                    ("cohesion", cohesion),
                ]);
                sand().check_params(&params).expect("legal parameters");
                for b in [sheared(-0.01, 0.05), sheared(0.01, 0.3), sheared(0.5, 0.0), stretched([-3.0, 2.0, 0.5])] {
                    for precision in [Precision::F32, Precision::F64] {
                        let answer = sand().update(precision, &params, 1e-4, &[particle(b, 0.2)]);
                        assert!(answer.is_ok(), "phi {degrees}, cone {cone}, cohesion {cohesion}: {answer:?}");
                    }
                }
            }
        }
    }
    assert!(PI / 2.0 <= sand().params().nth(2).expect("friction_angle").max_value);
}

/// Symptom: a dry heap that hangs together. Physics: without cohesion sand in tension has exactly zero stress; with it, it
/// bears isotropic tension up to c cot φ and no more.
#[test]
fn tension_is_borne_by_cohesion_alone() {
    for precision in [Precision::F32, Precision::F64] {
        for strain in [[0.01; 3], [1e-5; 3], [0.3, 0.2, 0.4], [0.01, -0.002, 0.0]] {
            let dry = sand().update(precision, &sand().default_params(), 1e-4, &[particle(stretched(strain), 0.0)]);
            assert_eq!(dry.expect("finite")[0].kirchhoff, [0.0; 6], "{precision:?} {strain:?}");
        }
    }
    let (phi, c) = (0.5f64, 1e3);
    for cone in [0.0, 1.0] {
        let params = sand().params_with(&[("friction_angle", phi), ("cohesion", c), ("cone", cone)]);
        let answer = update(&params, particle(stretched([0.05; 3]), 0.0));
        small("greatest tension", -pressure(&answer) * phi.tan() / c - 1.0, 1e-10);
        let held = update(&params, particle(stretched([1e-4; 3]), 0.0));
        small("tension below it", -pressure(&held) / (1e-4 * triple_bulk()) - 1.0, 1e-9);
    }
}

/// Symptom: −inf or NaN from a particle crushed or inverted in one step. The logarithm is floored at a stretch of 10⁻⁴ and counted.
#[test]
fn a_crushed_particle_is_floored_and_counted() {
    let params = sand().default_params();
    for b in
        [[1.0, 1.0, 1e-12, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.3, 0.9, 0.0, 0.0], [0.0; 6]]
    {
        for precision in [Precision::F32, Precision::F64] {
            let answer = sand().update(precision, &params, 1e-4, &[particle(b, 0.0)]).expect("a finite answer")[0];
            assert!(pressure(&answer) > 0.0, "{b:?}: {answer:?}");
        }
        let counts = sand().counts(&params, &[particle(b, 0.0)]).expect("counts").expect("counts");
        assert_eq!(counts[abi::BARCHAN_COUNT_FLOORED], 1, "{b:?}");
    }
}

/// Symptom: a particle at rest that drifts. Physics: nothing moves it, so no bit may change.
#[test]
fn a_particle_at_rest_stays_bit_by_bit() {
    let rest = sand().particle_at_rest();
    for precision in [Precision::F32, Precision::F64] {
        let answer = sand().update(precision, &sand().default_params(), 1e-4, &[rest]).expect("finite")[0];
        assert_eq!((answer.strain, answer.kirchhoff, answer.state), (rest.strain, [0.0; 6], rest.state));
    }
}
