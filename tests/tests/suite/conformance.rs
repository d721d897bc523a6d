//! Every law that a scene can name keeps to the contract of materials, whoever wrote it and in whatever language.
//!
//! Each material's crate runs the same suite at its defaults; here it runs on what the registry holds after loading, so that no
//! law is forgotten, and at other parameters.

#![expect(unsafe_code, reason = "the registry's tables are trusted to obey the ABI")]

use crate::libraries::{build_c, c_template, root, rust_library};
use barchan::Material;
use barchan::parameter::Parameter;
use barchan_material_kit::{Subject, conformance};
use std::collections::BTreeMap;

/// Parameters in the law's order: soft and stiff, auxetic and nearly incompressible, flat and steep cones.
///
/// The suite measures stiffness at rest in a uniaxial compression, which must be elastic: so a cone is not flatter than its
/// sand's pressure at rest, and only laws without a yield surface are tried with a negative Poisson's ratio.
fn settings(law: &Material) -> Vec<(String, Vec<f64>)> {
    const VARIED: [(&str, f64); 8] = [
        ("young_modulus", 1e3),
        ("young_modulus", 1e9),
        ("bulk_modulus", 1e3),
        ("poisson_ratio", 0.45),
        ("friction_angle", 0.7),
        ("friction_angle", 1.0),
        ("cone", 1.0),
        ("poisson_ratio", -0.3),
    ];
    let elastic = law.states.is_empty();
    let defaults: Vec<f64> = law.parameters.iter().filter_map(Parameter::default_number).collect();
    let mut all = vec![("defaults".to_owned(), defaults.clone())];
    for (name, value) in VARIED {
        let position = law.parameters.iter().position(|p| p.name == name).filter(|_| value > 0.0 || elastic);
        if let Some(i) = position {
            let mut changed = defaults.clone();
            if law.parameters[i].unit == "Pa" {
                // Strength goes with stiffness: a stiff law of the default's strength would yield at every strain tried.
                let pressures = law.parameters.iter().zip(&mut changed).filter(|(p, _)| p.unit == "Pa");
                pressures.for_each(|(_, x)| *x *= value / defaults[i]);
            }
            changed[i] = value;
            all.push((format!("{name} = {value:e}"), changed));
        }
    }
    all
}

/// A law that answers a neighbour's question, keeps a hidden stress at rest or loses a NaN ruins a run far from its cause. The
/// contract is the ABI's: no stress at the identity, a particle's result its own bit by bit, dt = 0 idempotent, stress the
/// derivative of the energy, frames and rates, honest moduli, strain paths and cycles, NaN reported with its particle; in f32 and in f64, and at
/// parameters drawn from their declared ranges.
#[test]
fn every_law_keeps_the_contract_at_all_kinds_of_parameters() {
    let mut registry = barchan::registry();
    registry.load(&c_template(false)).unwrap();
    let cpp = build_c(&root().join("materials/template/cpp/neo_hookean.cpp"), "sim-core/abi/include", "cpp_template");
    registry.load(&cpp).unwrap();
    registry.load(&rust_library("barchan-material-template")).unwrap();
    let laws: Vec<_> = registry.materials().collect();
    let names: Vec<_> = laws.iter().map(|law| law.name.as_str()).collect();
    for known in [
        "neo_hookean",
        "fixed_corotated",
        "hencky",
        "sand",
        "snow",
        "von_mises",
        "liquid",
        "c_neo_hookean",
        "cpp_neo_hookean",
        "template_neo_hookean",
    ] {
        assert!(names.contains(&known), "{known} is not registered: {names:?}");
    }
    let mut worst: BTreeMap<&str, (f64, f64, String)> = BTreeMap::new();
    let mut runs = 0;
    for law in laws {
        // SAFETY: the table was read from a static one, whose pointers it keeps.
        let subject = unsafe { Subject::new(&law.table) }.expect("a table of this version");
        let drawn = conformance::samples(&subject, 16, 2).into_iter().map(|set| ("drawn".to_owned(), set));
        for (setting, parameters) in settings(law).into_iter().chain(drawn) {
            let measured = conformance::run_all(&subject, &parameters)
                .unwrap_or_else(|violation| panic!("{} with {setting} ({parameters:?}): {violation}", law.name));
            runs += 1;
            for m in measured {
                let entry = worst.entry(m.check).or_insert((-1.0, m.tolerance, String::new()));
                if m.error > entry.0 {
                    *entry = (m.error, m.tolerance, format!("{}, {setting}", law.name));
                }
            }
        }
    }
    println!("{} laws, {runs} sets of parameters, f32 and f64", names.len());
    for (check, (error, tolerance, by)) in worst {
        println!("{check}: error {error:.1e} ({by}), tolerance {tolerance:.1e}");
    }
}
