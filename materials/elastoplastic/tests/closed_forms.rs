//! Von Mises plasticity at one point: plateau, hardening, and the limits of no strength and of infinite strength.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_elastoplastic::VonMises;
use barchan_material_kit::{Answer, Hencky, Lame, Particle, Precision, Subject, SymMat3, abi, vtable};

const YOUNG: f64 = 1e6;
const POISSON: f64 = 0.3;

fn solid() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<VonMises>()) }.expect("a table of this version")
}

fn params(yield_stress: f64, hardening: f64) -> Vec<f64> {
    solid().params_with(&[("yield_stress", yield_stress), ("hardening_modulus", hardening)])
}

fn particle(b: [f64; 6], plastic: f64) -> Particle {
    let mut particle = solid().particle_at_rest();
    particle.strain[..6].copy_from_slice(&b);
    particle.state[0] = plastic;
    particle
}

fn update(params: &[f64], particle: Particle) -> Answer {
    solid().update(Precision::F64, params, 1e-4, &[particle]).expect("a finite answer")[0]
}

/// b of the Hencky strain with normal components `normal` and shear component xz `shear`.
fn sheared(normal: f64, shear: f64) -> [f64; 6] {
    let (volume, cosh, sinh) = ((2.0 * normal).exp(), (2.0 * shear).cosh(), (2.0 * shear).sinh());
    [volume * cosh, volume, volume * cosh, 0.0, volume * sinh, 0.0]
}

fn small(what: &str, error: f64, tolerance: f64) {
    println!("{what}: error {error:.1e}, tolerance {tolerance:.0e}");
    assert!(error.abs() <= tolerance, "{what}: {error:e}");
}

fn pressure(answer: &Answer) -> f64 {
    -(answer.kirchhoff[0] + answer.kirchhoff[1] + answer.kirchhoff[2]) / 3.0
}

/// Physics: in shear the stress rises as 2μ ε_xz to the plateau σ_y/√3, whatever the pressure.
#[test]
fn shear_plateau() {
    let yield_stress = 1e4;
    let params = params(yield_stress, 0.0);
    let mu = Lame::new(YOUNG, POISSON).mu;
    let plateau = yield_stress / 3f64.sqrt();
    for normal in [-0.2, -0.01, 0.0, 0.01, 0.2] {
        for shear in [0.005, 0.05, 0.5] {
            let answer = update(&params, particle(sheared(normal, shear), 0.0));
            let exact = (2.0 * mu * shear).min(plateau);
            small(&format!("at {normal}, {shear}"), answer.kirchhoff[4] / exact - 1.0, 1e-10);
            let volume = 3.0 * normal * Lame::new(YOUNG, POISSON).triple_bulk() / 3.0;
            small("  pressure", (pressure(&answer) + volume) / YOUNG, 1e-10);
        }
    }
    // The same in simple shear by small steps; elastic strains are 1 %, and so is the normal stress that their turning adds.
    let mut answer = update(&params, particle(sheared(0.0, 0.0), 0.0));
    for _ in 0..2000 {
        let [xx, yy, zz, xy, xz, yz, ..] = answer.strain;
        let d = 1e-4;
        let b = [xx + 2.0 * d * xz + d * d * zz, yy, zz, xy + d * yz, xz + d * zz, yz];
        answer = update(&params, particle(b, answer.state[0]));
    }
    small("plateau in simple shear", answer.kirchhoff[4] / plateau - 1.0, 1e-3);
}

/// Physics: with linear hardening √3 τ_xz = σ_y + H κ after each return, and κ = (2/√3)(ε_xz − τ_xz/2μ) is the strain that the
/// stress did not take.
#[test]
fn linear_hardening() {
    let (yield_stress, hardening) = (1e4, 2e5);
    let params = params(yield_stress, hardening);
    let mu = Lame::new(YOUNG, POISSON).mu;
    for shear in [0.02, 0.1, 0.4] {
        let answer = update(&params, particle(sheared(-0.01, shear), 0.0));
        let (stress, plastic) = (answer.kirchhoff[4], answer.state[0]);
        small(
            &format!("at {shear}: yield stress"),
            3f64.sqrt() * stress / (yield_stress + hardening * plastic) - 1.0,
            1e-10,
        );
        small("  plastic strain", plastic / (2.0 / 3f64.sqrt() * (shear - stress / (2.0 * mu))) - 1.0, 1e-10);
        // The state is kept: the same strain again flows no further.
        let again = update(&params, Particle { strain: answer.strain, state: answer.state, ..particle([0.0; 6], 0.0) });
        small("  again", again.state[0] - plastic, 1e-12);
    }
}

/// Symptom: NaN, or a residue of strength, at the ends of the range of yield stresses. Physics: none is a fluid with pressure alone; an
/// infinite one is Hencky's elastic solid, exactly.
#[test]
fn no_strength_is_a_fluid_and_infinite_strength_an_elastic_solid() {
    let lame = Lame::new(YOUNG, POISSON);
    for (normal, shear) in [(-0.1, 0.3), (0.01, 0.02), (0.0, 0.0), (0.2, -0.5)] {
        let b = sheared(normal, shear);
        let fluid = update(&params(0.0, 0.0), particle(b, 0.0));
        let p = pressure(&fluid);
        let deviator = [0, 1, 2].map(|i| (fluid.kirchhoff[i] + p).abs()).iter().sum::<f64>();
        small(&format!("fluid at {normal}, {shear}: shear"), (deviator + fluid.kirchhoff[4].abs()) / YOUNG, 1e-12);
        small("  pressure", (p + normal * lame.triple_bulk()) / YOUNG, 1e-12);

        let elastic = update(&params(f64::INFINITY, 0.0), particle(b, 0.0));
        let exact = lame.stress(Hencky::of(SymMat3::from_components(b)).strain).components();
        let error = elastic.kirchhoff.iter().zip(exact).map(|(a, e)| (a - e).abs()).fold(0.0, f64::max) / YOUNG;
        small("  elastic", error, 1e-14);
        assert_eq!((&elastic.strain[..6], elastic.state[0]), (&b[..], 0.0));
    }
    for yield_stress in [0.0, f64::INFINITY] {
        let answer =
            solid().update(Precision::F32, &params(yield_stress, 0.0), 1e-4, &[particle(sheared(-0.1, 0.3), 0.0)]);
        assert!(answer.is_ok(), "{answer:?}");
        solid().check_params(&params(yield_stress, 0.0)).expect("legal parameters");
    }
    let bounds = solid().params().nth(2).expect("yield_stress");
    assert_eq!((bounds.min_value, bounds.max_value), (0.0, f64::INFINITY));
}

/// Symptom: −inf or NaN from a particle crushed flat in one step. It is floored, and the ledger counts what flows and what is floored.
#[test]
fn the_ledger_counts() {
    let particles = [
        particle([1.0, 1.0, 0.0, 0.0, 0.0, 0.0], 0.0),
        particle(sheared(0.0, 0.001), 0.0),
        particle(sheared(0.0, 0.1), 0.0),
    ];
    let counts = solid().counts(&params(1e4, 0.0), &particles).expect("counts").expect("counts");
    assert_eq!((counts[abi::BARCHAN_COUNT_FLOORED], counts[abi::BARCHAN_COUNT_YIELDING]), (1, 2));
    for precision in [Precision::F32, Precision::F64] {
        assert!(solid().update(precision, &params(1e4, 0.0), 1e-4, &particles).is_ok());
    }
}
