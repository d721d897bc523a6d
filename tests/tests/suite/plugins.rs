//! Loaded materials in a scene: equal to the built-in of the same law, and, when they fail, an error that names them.
//!
//! What is wrong with a library itself (symbol, version, sizes, names, text) is refused by the loader; `sim-core/tests/loader.rs`
//! holds each of those refusals. What a callback may do at run time is here.

use crate::libraries::{build_c, c_template, root, rust_library};
use barchan::{Error, Precision, Registry, Scene, Simulation};
use barchan_tests::scenes::{options, rows, scene};
use barchan_tests::sketch::Head;
use std::path::PathBuf;
use std::sync::OnceLock;

const H: f64 = 0.05;
const WALLS: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";

/// A jittered, spinning cube of a law that is thrown onto a floor; its material has one name whatever the law is.
fn thrown(law: &str, parameters: &str, time: &str) -> Scene {
    let material =
        format!("[[material]]\nname = \"m\"\nlaw = \"{law}\"\ndensity = 1000.0\nparameters = {{ {parameters} }}\n");
    let body = "[[body]]\nmaterial = \"m\"\nshape = { box = { min = [0.2, 0.2, 0.05], max = [0.4, 0.4, 0.25] } }\n\
                sampling = \"jitter\"\nvelocity = [0.3, -0.2, -1.5]\nangular_velocity = [2, 3, -4]\n";
    scene(&Head::cells(H, [12, 12, 12], WALLS).time(time).with(&[material, body.to_owned()]))
}

fn start(registry: &Registry, scene: &Scene, precision: Precision) -> Result<Simulation, Error> {
    Simulation::new(registry, scene, &options(precision))
}

/// Positions after 200 steps, by id.
fn after_200(registry: &Registry, law: &str, precision: Precision) -> Vec<[f64; 3]> {
    let parameters = "young_modulus = 2e4, poisson_ratio = 0.35";
    let mut s = start(registry, &thrown(law, parameters, "step = 2e-3"), precision).unwrap_or_else(|e| panic!("{e}"));
    for _ in 0..200 {
        s.step().unwrap_or_else(|e| panic!("{law}: {e}"));
    }
    rows(&s).into_iter().map(|row| row.x).collect()
}

/// The engine cannot tell a loaded law from a built-in one. The templates hold the built-in neo-Hookean law; in Rust it is the
/// same code, in C and C++ another logarithm and another order of sums, so that only rounding may differ: 1e-5 cells in f32, 1e-12 in
/// f64, after a landing at 1.5 m/s. A plane swapped or a stride mistaken anywhere on the way would differ in the first digit.
#[test]
fn a_loaded_law_runs_like_the_built_in_one() {
    let mut registry = barchan::registry();
    assert_eq!(registry.load(&c_template(false)).unwrap(), ["c_neo_hookean"]);
    let cpp = build_c(&root().join("materials/template/cpp/neo_hookean.cpp"), "sim-core/abi/include", "cpp_template");
    assert_eq!(registry.load(&cpp).unwrap(), ["cpp_neo_hookean"]);
    assert_eq!(registry.load(&rust_library("barchan-material-template")).unwrap(), ["template_neo_hookean"]);
    assert!(registry.warnings().is_empty(), "{:?}", registry.warnings());
    // What was built against the header of version 1.0 must load for as long as the major version is 1.
    let mut old = barchan::registry();
    assert_eq!(old.load(&c_template(true)).unwrap(), ["c_neo_hookean"]);
    for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::F64, 1e-12)] {
        let built_in = after_200(&registry, "neo_hookean", precision);
        let start = rows(&start(&registry, &thrown("neo_hookean", "", ""), precision).unwrap());
        let moved = built_in.iter().zip(&start).map(|(x, s)| (x[2] - s.x[2]).abs()).fold(0.0, f64::max);
        assert!(moved > 0.5 * H, "the test must see a landing: {moved} m");
        for (name, registry, law) in [
            ("C", &registry, "c_neo_hookean"),
            ("C against the header of 1.0", &old, "c_neo_hookean"),
            ("C++", &registry, "cpp_neo_hookean"),
            ("Rust", &registry, "template_neo_hookean"),
        ] {
            let loaded = after_200(registry, law, precision);
            let apart =
                built_in.iter().flatten().zip(loaded.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            println!(
                "{precision}, {name}: {:.1e} cells from the built-in after 200 steps, tolerance {tolerance:.0e}",
                apart / H
            );
            assert!(apart / H < tolerance, "{precision}, {name}: {:e} cells", apart / H);
        }
    }
}

/// A C material whose parameter `fault` says what its callbacks do wrong.
const FAULTY: &str = r#"
#include "barchan_abi.h"
#include <string.h>
#include <math.h>
#define TEXT(s) { (const uint8_t *)(s), sizeof(s) - 1 }
#ifndef STATES
#define STATES 1
#endif
/* 1 fails with a text longer than the buffer, and says so; 2 an unknown status and an absurd particle, without a text;
 * 3 NaN stress, called fine; 4 NaN strain, called fine; 5 moduli fail with an absurd particle; 6 NaN moduli, called fine;
 * 7 negative moduli, called fine */
static int is(const float *params, int fault) { return (int)params[1] == fault; }

static BarchanStatus update(const BarchanBatchF32 *b, BarchanError *error) {
  const float young = b->params[0];
  if (is(b->params, 1)) {
    for (size_t i = 0; i < error->capacity; i++) error->message[i] = i % 2 ? 0xa4 : 0xc3;
    if (error->capacity > 0) error->message[error->capacity - 1] = 0xc3;
    error->len = error->capacity * 10;
    error->particle = 3;
    return BARCHAN_E_OTHER;
  }
  if (is(b->params, 2)) {
    error->particle = (uint64_t)1 << 40;
    return 77;
  }
  for (size_t i = 0; i < b->n; i++) {
    float most = 0;
    for (size_t c = 0; c < 6; c++) {
      const float trial = b->strain_trial[c * b->stride + i], excess = trial - (c < 3);
      most = fmaxf(most, fabsf(excess));
      b->strain[c * b->stride + i] = trial;
      b->kirchhoff[c * b->stride + i] = young * excess;
    }
    for (size_t s = 0; s < STATES; s++) b->state_out[s * b->stride + i] = b->state_in[s * b->stride + i];
    if (most > 1e-3f && is(b->params, 3)) b->kirchhoff[i] = NAN;
    if (most > 1e-3f && is(b->params, 4)) b->strain[3 * b->stride + i] = NAN;
  }
  return BARCHAN_OK;
}
static BarchanStatus moduli(const BarchanBatchF32 *b, float *out, BarchanError *error) {
  /* The plan asks for one particle, and is told the truth. */
  if (b->n > 1 && is(b->params, 5)) {
    const char *text = "no moduli today";
    error->len = strlen(text);
    memcpy(error->message, text, error->len);
    error->particle = (uint64_t)1 << 40;
    return BARCHAN_E_OTHER;
  }
  for (size_t i = 0; i < b->n; i++) {
    const float value = b->n > 1 && is(b->params, 6) ? NAN : b->n > 1 && is(b->params, 7) ? -1.0f : 2 * b->params[0];
    out[i] = value;
    out[b->stride + i] = value;
  }
  return BARCHAN_OK;
}
static const BarchanParam params[] = {
  { .name = TEXT("young_modulus"), .unit = TEXT("Pa"), .doc = TEXT("E."), .default_value = 2e4, .min_value = 1, .max_value = 1e9 },
  { .name = TEXT("fault"), .unit = TEXT("1"), .doc = TEXT("What fails."), .default_value = 0, .min_value = 0, .max_value = 9 },
};
#define STATE(n) { .name = TEXT("s_" #n), .unit = TEXT("1"), .doc = TEXT("History."), .initial_value = 1 }
static const BarchanStateVar states[] = { STATE(0), STATE(1), STATE(2), STATE(3), STATE(4), STATE(5), STATE(6), STATE(7),
  STATE(8), STATE(9), STATE(10), STATE(11), STATE(12), STATE(13), STATE(14), STATE(15), STATE(16) };
static const BarchanMaterial material = {
  .struct_size = sizeof(BarchanMaterial), .abi_major = 1, .capabilities = BARCHAN_CAP_HARDENS, .strain_kind = 1,
  .name = TEXT("faulty"), .version = TEXT("1"), .doc = TEXT("Fails."), .reference = TEXT("none"),
  .params = params, .n_params = 2, .param_size = sizeof params[0],
  .states = states, .n_state = STATES, .state_size = sizeof states[0],
  .update_f32 = update, .tangent_moduli_f32 = moduli,
};
static const BarchanMaterial *const materials[] = { &material };
static const BarchanPlugin plugin = {
  .struct_size = sizeof plugin, .abi_major = 1, .materials = materials, .n_materials = 1
};
const BarchanPlugin *barchan_plugin_v1(void) { return &plugin; }
"#;

/// The faulty material with so many history variables.
fn faulty(states: usize) -> PathBuf {
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("faulty.c");
    std::fs::write(&source, format!("#define STATES {states}\n{FAULTY}")).unwrap();
    build_c(&source, "sim-core/abi/include", &format!("faulty_{states}"))
}

/// A registry with the C and the Rust material that fail on demand.
fn failing() -> Registry {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let mut registry = barchan::registry();
    registry.load(BUILT.get_or_init(|| faulty(1))).unwrap();
    registry.load(&rust_library("barchan-seam-material")).unwrap();
    registry
}

/// Steps until it fails; the particles must then be those before the step, all of them finite. Returns the error's text.
fn fails(law: &str, fault: u32, time: &str) -> String {
    let run = thrown(law, &format!("young_modulus = 2e4, fault = {fault}"), time);
    let mut s = match start(&failing(), &run, Precision::F32) {
        Ok(s) => s,
        Err(error) => return error.to_string(),
    };
    for _ in 0..100 {
        let (before, steps) = (rows(&s), s.step_count());
        if let Err(error) = s.step() {
            assert_eq!(s.step_count(), steps, "a failed step does not count");
            let after = rows(&s);
            let same = before.iter().zip(&after).all(|(a, b)| a.id == b.id && a.x == b.x && a.v == b.v);
            assert!(same, "{law}, fault {fault}: positions or velocities are not those before the step");
            let sound = after.iter().all(|row| row.strain.iter().chain(&row.state).all(|x| x.is_finite()));
            assert!(sound, "{law}, fault {fault}: what is left to be saved is not finite");
            return error.to_string();
        }
    }
    panic!("{law}, fault {fault}: 100 steps without an error");
}

/// Without a fault both run: the failures below are the fault's, not the law's.
#[test]
fn a_material_that_can_fail_does_not_by_itself() {
    for law in ["faulty", "failing"] {
        let mut s = start(&failing(), &thrown(law, "young_modulus = 2e4", "step = 2e-3"), Precision::F32).unwrap();
        for _ in 0..100 {
            s.step().unwrap_or_else(|e| panic!("{law}: {e}"));
        }
        let speed = rows(&s).iter().map(|r| r.v[2].abs()).fold(0.0, f64::max);
        println!("{law}: fastest particle {speed:.2} m/s after 100 steps, tolerance 5");
        assert!(speed < 5.0);
    }
}

/// A panic in a library must not cross into the host, which is undefined or ends the process; its text arrives, cut to the
/// buffer at a character, and names library and callback.
#[test]
fn a_panic_in_a_loaded_material_is_an_error_with_its_text() {
    let error = fails("failing", 1, "step = 2e-3");
    println!("{} bytes: {}…", error.len(), error.chars().take(200).collect::<String>());
    assert!(error.contains("material 'failing' (") && error.contains("libbarchan_seam_material"), "{error}");
    assert!(error.contains("failed in ") && error.contains("panic: ä"), "{error}");
    let text = error.split_once("panic: ").unwrap().1;
    assert!(
        text.chars().all(|c| "äö".contains(c)) && text.len() <= 512 && text.len() > 500,
        "{} bytes of text",
        text.len()
    );
}

/// A callback that says its text is ten times as long as the buffer must not make the host read beyond it, and a text cut in the
/// middle of a character must not be lost. The particle is named by its id, whatever place it has in the batch.
#[test]
fn an_error_text_longer_than_the_buffer_is_cut() {
    let error = fails("faulty", 1, "step = 2e-3");
    println!("{} bytes: {}…", error.len(), error.chars().take(160).collect::<String>());
    assert!(
        error.contains("material 'faulty' (") && error.contains("libfaulty_1.so) failed in update at particle "),
        "{error}"
    );
    let text = error.split_once("error: ").unwrap().1;
    assert!(text.starts_with("ääää") && text.len() <= 512 + 6, "{} bytes of text", text.len());
}

/// Integers across the boundary can be anything. A status that no version knows is an error, and a particle that is in no batch
/// is not looked up.
#[test]
fn unknown_statuses_and_absurd_particles_are_errors() {
    let error = fails("faulty", 2, "step = 2e-3");
    println!("{error}");
    assert!(
        error.contains("material 'faulty' (") && error.contains("failed in update: error (status 77), no message"),
        "{error}"
    );
    let error = fails("faulty", 5, "");
    println!("{error}");
    assert!(error.contains("failed in tangent_moduli: error: no moduli today"), "{error}");
}

/// NaN is caught before it reaches a particle, whoever made it: a law that reports it, or one that calls it fine. A NaN that is
/// let through spreads over the whole grid within a few steps, and where it came from is no longer known.
#[test]
fn nan_from_a_material_is_an_error_that_names_a_particle() {
    let error = fails("failing", 2, "step = 2e-3");
    println!("stress, reported: {error}");
    assert!(
        error.contains("material 'failing' (") && error.contains("at particle") && error.contains("NaN"),
        "{error}"
    );
    for (fault, what) in [(3, "stress"), (4, "strain")] {
        let error = fails("faulty", fault, "step = 2e-3");
        println!("{what}, called fine: {error}");
        assert!(
            error.contains("material 'faulty' (") && error.contains("libfaulty_1.so) failed in update at particle "),
            "{what}: {error}"
        );
    }
}

/// The time step hangs on the moduli: NaN or negative ones would lift the bound instead of lowering it.
#[test]
fn moduli_that_are_no_numbers_are_an_error() {
    for fault in [6, 7] {
        let error = fails("faulty", fault, "");
        println!("{error}");
        assert!(error.contains("material 'm' (") || error.contains("material 'faulty' ("), "{error}");
        assert!(error.contains("tangent_moduli") && error.contains("must be finite and above 0"), "{error}");
    }
}

/// A table may declare more history than a backend has room for; that is found when the scene is assembled, by name.
#[test]
fn more_history_than_the_backend_holds_is_refused() {
    let mut registry = barchan::registry();
    registry.load(&faulty(17)).unwrap();
    let error = start(&registry, &thrown("faulty", "", ""), Precision::F32).unwrap_err().to_string();
    println!("{error}");
    assert!(error.contains("17") && error.contains("16") && error.contains("faulty"), "{error}");
    let mut registry = barchan::registry();
    registry.load(&faulty(16)).unwrap();
    start(&registry, &thrown("faulty", "", ""), Precision::F32).unwrap().step().unwrap();
}

/// A plugin that lacks what a run needs is refused by name when the scene is assembled, not when it is first called.
#[test]
fn what_a_plugin_lacks_is_named_before_the_first_step() {
    let error = start(&failing(), &thrown("faulty", "", ""), Precision::F64).unwrap_err().to_string();
    println!("{error}");
    assert!(
        error.contains("material 'faulty' (") && error.contains("has no update_f64; needed because the run is in f64"),
        "{error}"
    );
    // And it is the frozen header's layout that old plugins have: the golden file is never edited, only added to.
    let golden = std::fs::read_to_string(root().join("tests/golden/abi_v1_0/barchan_abi.h")).unwrap();
    assert!(golden.contains("#define BARCHAN_ABI_MAJOR 1") && golden.contains("#define BARCHAN_ABI_MINOR 0"));
}
