//! Liquid at one point: equation of state, forgotten shear, viscosity.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_liquid::Liquid;
use barchan_material_kit::{Answer, Particle, Precision, Subject, abi, conformance, vtable};

fn liquid() -> Subject<'static> {
    // SAFETY: the table comes from `vtable`.
    unsafe { Subject::new(vtable::<Liquid>()) }.expect("a table of this version")
}

fn particle(b: [f64; 6]) -> Particle {
    let mut particle = liquid().particle_at_rest();
    particle.strain[..6].copy_from_slice(&b);
    particle
}

fn update(params: &[f64], particle: Particle) -> Answer {
    liquid().update(Precision::F64, params, 1e-4, &[particle]).expect("a finite answer")[0]
}

fn small(what: &str, error: f64, tolerance: f64) {
    println!("{what}: error {error:.1e}, tolerance {tolerance:.0e}");
    assert!(error.abs() <= tolerance, "{what}: {error:e}");
}

/// Physics: τ = −J p I with p = (K/γ)(J^{−γ} − 1), whatever the shear, and only J is remembered.
#[test]
fn taits_equation_of_state() {
    for exponent in [1.0, 3.0, 7.0] {
        let params = liquid().params_with(&[("bulk_modulus", 2e5), ("tait_exponent", exponent)]);
        for (stretches, shear) in [([0.99, 1.0, 1.0], 0.0), ([0.9, 1.2, 0.8], 0.3), ([1.05; 3], 0.1), ([0.5; 3], 0.0)] {
            let [x, y, z]: [f64; 3] = stretches;
            let j: f64 = x * y * z;
            // F = (I + shear e_x e_yᵀ) diag(x, y, z).
            let b = [x * x + shear * shear * y * y, y * y, z * z, shear * y * y, 0.0, 0.0];
            let answer = update(&params, particle(b));
            let exact = -j * 2e5 / exponent * (j.powf(-exponent) - 1.0);
            for c in 0..3 {
                small(&format!("exponent {exponent}, J {j:.3}"), answer.kirchhoff[c] / exact - 1.0, 1e-10);
                small("  strain", answer.strain[c] / j.powf(2.0 / 3.0) - 1.0, 1e-12);
            }
            assert_eq!((&answer.kirchhoff[3..], &answer.strain[3..6]), (&[0.0; 3][..], &[0.0; 3][..]));
        }
    }
}

/// Physics: τ_xy = J η (∂v_x/∂y + ∂v_y/∂x), and a volume change adds no viscous stress.
#[test]
fn newtonian_viscosity() {
    let params = liquid().params_with(&[("viscosity", 3.0)]);
    let mut sheared = particle([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    sheared.vel_grad = [2.0, 5.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 2.0];
    let k = update(&params, sheared).kirchhoff;
    small("shear stress", k[3] / 18.0 - 1.0, 1e-10);
    small("normal stress", k[0].abs() + k[1].abs() + k[2].abs(), 1e-10);
}

/// γ = 1, where the energy's formula is 0/0, conforms as every other exponent does.
#[test]
fn conforms_for_every_exponent() {
    for exponent in [1.0, 1.0 + 1e-9, 2.0, 20.0] {
        let params = liquid().params_with(&[("tait_exponent", exponent)]);
        if let Err(violation) = conformance::run_all(&liquid(), &params) {
            panic!("exponent {exponent}: {violation}");
        }
    }
}

/// Symptom: NaN from a particle crushed flat in one step. Its volume is floored, and the ledger counts it.
#[test]
fn a_crushed_particle_is_counted() {
    let params = liquid().params_with(&[("tait_exponent", 1.0)]);
    let flat = particle([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    for precision in [Precision::F32, Precision::F64] {
        let answer = liquid().update(precision, &params, 1e-4, &[flat]).expect("a finite answer")[0];
        small("pressure", answer.kirchhoff[0] / -2e5 - 1.0, 1e-6);
    }
    let counts = liquid().counts(&params, &[flat]).expect("counts").expect("counts");
    assert_eq!(counts[abi::BARCHAN_COUNT_FLOORED], 1);
}
