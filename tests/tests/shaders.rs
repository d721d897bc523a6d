//! Every law in WGSL against its twin on the CPU, on whatever adapter there is: what `barchan conform --backend wgpu` does, at 2000 strains of
//! each kind, and at parameters that take every branch. And what the suite and the backend say of WGSL that is wrong.

#[path = "suite/libraries.rs"]
mod libraries;

use barchan::conformance::wgsl::{Gpu, Offer, open_with, survey_at};
use barchan::conformance::{Finding, Outcome, wgsl};
use barchan::{Material, Options, Registry, Simulation};
use barchan_material_kit::BARCHAN_CAP_HARDENS;
use barchan_tests::scenes::{options, scene};
use barchan_tests::sketch::{self, Head, block};
use libraries::{build_c, c_template, root, rust_library};
use std::path::Path;

/// Strains of each kind, for each law.
const COUNT: usize = 2000;

/// The poorest adapter must do.
fn poorest() -> Gpu {
    open_with(None, Offer::Least).unwrap()
}

/// The law's defaults with some parameters changed.
fn with(law: &Material, changes: &[(&str, f64)]) -> Vec<f64> {
    let of = |name: &str| changes.iter().find(|(changed, _)| *changed == name).map(|(_, value)| *value);
    law.parameters.iter().filter_map(|p| of(&p.name).or_else(|| p.default_number())).collect()
}

#[test]
fn every_law_gives_the_same_answer_on_a_gpu_as_on_the_cpu() {
    let mut registry: Registry = barchan::registry();
    registry.load(&c_template(false)).unwrap();
    registry.load(&rust_library("barchan-material-template")).unwrap();
    let gpu = poorest();
    println!("{}", gpu.adapter_info.name);
    let mut failures = Vec::new();
    for law in registry.materials() {
        // Where defaults leave a branch out, once more with it.
        let varied: &[&[(&str, f64)]] = match law.name.as_str() {
            "sand" => &[&[("cohesion", 2e4), ("cone", 1.0), ("friction_angle", 0.5)], &[("volume_correction", 0.0)]],
            "snow" => &[&[("critical_stretch", 0.1), ("critical_compression", 0.2)]],
            "von_mises" => &[&[("hardening_modulus", 1e5)]],
            "liquid" => &[&[("viscosity", 10.0), ("tait_exponent", 1.0)]],
            _ => &[],
        };
        let sets = std::iter::once(with(law, &[])).chain(varied.iter().map(|changes| with(law, changes)));
        let mut found: Vec<Finding> = Vec::new();
        for set in sets {
            found.extend(survey_at(&gpu, law, &[set], COUNT, &mut |_| ()).unwrap());
        }
        found.extend(wgsl::survey(&gpu, law, 8, COUNT / 4, &mut |_| ()).unwrap());
        for finding in &found {
            println!("{:<22}{finding}", law.name);
            if finding.is_failure() {
                failures.push(format!("{}: {finding}", law.name));
            }
        }
        // Laws whose bound follows the state have WGSL for it.
        assert_eq!(law.wgsl_stiffness.is_empty(), !law.has(BARCHAN_CAP_HARDENS), "{}", law.name);
    }
    assert!(
        failures.is_empty(),
        "{} failures, such as\n{}",
        failures.len(),
        failures[..failures.len().min(12)].join("\n")
    );
}

/// What the suite says of the C template with one thing in its WGSL replaced.
fn failures(gpu: &Gpu, folder: &Path, (name, from, to): (&str, &str, &str)) -> Vec<(&'static str, String)> {
    let source = std::fs::read_to_string(root().join("materials/template/c/neo_hookean.c")).unwrap();
    assert!(source.contains(from), "{from}");
    let file = folder.join(format!("{name}.c"));
    std::fs::write(&file, source.replace(from, to)).unwrap();
    let mut registry = Registry::new();
    registry.load(&build_c(&file, "sim-core/abi/include", name)).unwrap();
    let findings = wgsl::survey(gpu, registry.material("c_neo_hookean").unwrap(), 2, 100, &mut |_| ()).unwrap();
    let failed = findings.into_iter().filter_map(|finding| match finding.outcome {
        Outcome::Failed(what) => Some((finding.check, what)),
        _ => None,
    });
    failed.collect()
}

/// A law that is right in C and wrong in WGSL, by as little as a modulus a ten-thousandth off, would run well on the CPU and wrongly on a GPU.
#[test]
fn wgsl_that_differs_from_the_law_is_found_by_what_is_wrong_with_it() {
    let (gpu, folder) = (poorest(), tempfile::tempdir().unwrap());
    let of = |replaced| failures(&gpu, folder.path(), replaced);
    assert_eq!(of(("c_right", "return MatOut", "return MatOut")), []);

    let stress = of(("c_stress", "barchan_affine(law.mu, strain", "barchan_affine(1.0001 * law.mu, strain"));
    assert_eq!(stress.len(), 1, "{stress:?}");
    assert_eq!(stress[0].0, "WGSL gives the stress");
    assert!(stress[0].1.contains("strain - I") && stress[0].1.contains("young_modulus ="), "{}", stress[0].1);

    let strain = of(("c_strain", "MatOut(x.strain,", "MatOut(1.001 * x.strain,"));
    assert!(strain.iter().any(|(check, _)| *check == "WGSL gives strain and state"), "{strain:?}");

    let skew = of((
        "c_skew",
        "barchan_mat(kirchhoff));",
        "barchan_mat(kirchhoff) + law.mu * mat3x3<f32>(vec3(0.0), vec3(1e-5 * x.strain[0][0], 0.0, 0.0), vec3(0.0)));",
    ));
    assert!(skew.iter().any(|(check, _)| *check == "WGSL gives symmetric tensors"), "{skew:?}");

    let stiffness = of(("c_stiffness", "law.mu * bound));", "law.mu));"));
    assert_eq!(stiffness.iter().map(|(check, _)| *check).collect::<Vec<_>>(), ["WGSL gives moduli and viscosity"]);

    let endless = of(("c_endless", "barchan_log_volume(strain));", "log(1.0 + barchan_det1p(strain)) * 0.5);"));
    assert!(endless.iter().any(|(check, _)| *check == "WGSL is finite where f32 tells no more"), "{endless:?}");

    let mistaken = of(("c_mistaken_too", "barchan_sym(x", "barchan_symm(x"));
    assert_eq!(mistaken.len(), 1, "{mistaken:?}");
    assert!(mistaken[0].1.contains("WGSL line 3"), "{mistaken:?}");
}

/// A library's author learns what is wrong, in which material of which library, and on which line of the WGSL, when a scene that uses it is
/// assembled for a GPU; on the CPU the same library runs.
#[test]
fn a_library_without_wgsl_or_with_a_mistake_in_it_is_refused_by_name_and_line() {
    let source = std::fs::read_to_string(root().join("materials/template/c/neo_hookean.c")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (name, from, to, said) in [
        ("c_without_wgsl", "sizeof(WGSL) - 1}", "0}", "libc_without_wgsl.so) has no WGSL"),
        (
            "c_mistaken",
            "barchan_sym(x",
            "barchan_symm(x",
            "material 'c_neo_hookean': WGSL line 3: no definition in scope",
        ),
        (
            "c_misnamed",
            "fn c_neo_hookean_update",
            "fn update",
            "WGSL line 1: 'update' does not start with 'c_neo_hookean_'",
        ),
    ] {
        assert!(source.contains(from));
        let file = folder.path().join(format!("{name}.c"));
        std::fs::write(&file, source.replace(from, to)).unwrap();
        let mut registry = barchan::registry();
        registry.load(&build_c(&file, "sim-core/abi/include", name)).unwrap();
        let text = Head::space(0.1).with(&[
            sketch::material("c_neo_hookean", 1000.0, "young_modulus = 1e4"),
            block("c_neo_hookean", [-0.2; 3], [0.2; 3], ""),
        ]);
        let cpu = options(barchan::Precision::F32);
        let gpu = Options { backend: "wgpu".to_owned(), ..cpu.clone() };
        let error = Simulation::new(&registry, &scene(&text), &gpu).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains(said) && error.contains(name), "{error}");
        Simulation::new(&registry, &scene(&text), &cpu).unwrap().step().unwrap();
    }
}
