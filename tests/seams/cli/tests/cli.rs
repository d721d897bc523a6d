//! The command line that a crate outside Barchan makes has everything that its registry holds, wherever a plugin can be named.
//!
//! That `barchan` itself refuses the same scene is a test of `bindings/cli`, which has that binary.

use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// The scene that calls for a current.
const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/current.toml");

fn run(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_barchan-seam-cli")).args(args).current_dir(folder).output().unwrap()
}

/// Runs, wants success, and returns what was printed.
fn succeed(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Names of a kind of plugins.
fn names(plugins: &Value, kind: &str) -> Vec<String> {
    let name = |plugin: &Value| plugin["name"].as_str().unwrap().to_owned();
    plugins[kind].as_array().unwrap().iter().map(name).collect()
}

/// Mean velocity at the end of a run [m/s].
fn mean_velocity(out: &Path) -> [f64; 3] {
    let summary: Value = serde_json::from_str(&fs::read_to_string(out.join("summary.json")).unwrap()).unwrap();
    let end = &summary["ledger_end"];
    std::array::from_fn(|d| end["momentum"][d].as_f64().unwrap() / end["mass"].as_f64().unwrap())
}

#[test]
fn the_registry_given_is_listed_beside_what_comes_with_barchan() {
    let folder = tempfile::tempdir().unwrap();
    let plugins: Value = serde_json::from_str(&succeed(folder.path(), &["plugins", "--json"])).unwrap();
    assert_eq!(names(&plugins, "couplings"), ["current", "rigid"]);
    assert_eq!(names(&plugins, "backends"), ["cpu", "dust", "wgpu"]);
    assert_eq!(names(&plugins, "tasks"), ["push"]);
    assert!(names(&plugins, "materials").contains(&"sand".to_owned()));
    let text = succeed(folder.path(), &["plugins"]);
    for doc in ["A current that drags", "Particles fly without touching", "Push a cube of jelly"] {
        assert!(text.contains(doc), "no '{doc}' in {text}");
    }
}

/// A current of rate k and velocity w drags a block in free space along: its velocity is w (1 - (1 + k dt)^-n) after n steps.
#[test]
fn a_scene_with_the_coupling_is_planned_and_run() {
    let folder = tempfile::tempdir().unwrap();
    let plan = succeed(folder.path(), &["plan", SCENE]);
    assert!(plan.contains("coupling current"), "{plan}");
    succeed(folder.path(), &["run", SCENE, "--precision", "f64", "--no-pictures", "--quiet", "--out", "out"]);
    let share = 1.0 - (1.0 + 5.0 * 2e-3_f64).powi(-100);
    let velocity = mean_velocity(&folder.path().join("out"));
    let off = velocity.iter().zip([1.0, -0.5, 0.0]).map(|(v, w)| (v - share * w).abs()).fold(0.0, f64::max);
    println!("velocity off by {off:.1e} m/s, tolerance 1e-12");
    assert!(off < 1e-12);
}

/// The backend is found by name by `run` and by `bench`; under it a block falls freely.
#[test]
fn the_backend_runs_a_scene_and_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    let fall = ["--set", "coupling=[]", "--set", "gravity=[0, 0, -9.81]", "--no-pictures", "--quiet", "--out", "out"];
    succeed(folder.path(), &[&["run", SCENE, "--backend", "dust"] as &[&str], &fall].concat());
    let off = (mean_velocity(&folder.path().join("out"))[2] + 9.81 * 0.2).abs();
    println!("velocity off by {off:.1e} m/s, tolerance 1e-12");
    assert!(off < 1e-12);

    let once = ["--grid", "32", "--steps", "1", "--repetitions", "1", "--warm-up", "0", "--json"];
    let bench = ["bench", "throughput", "--backend", "dust", "--ground", "moving"];
    let figures: Value = serde_json::from_str(&succeed(folder.path(), &[&bench as &[&str], &once].concat())).unwrap();
    assert_eq!(figures["effects"][0]["effect"], "flight");
}

/// Shells and `man` hear of it by its own name.
#[test]
fn completions_and_the_manual_are_of_this_program() {
    let folder = tempfile::tempdir().unwrap();
    let page = succeed(folder.path(), &["man"]);
    for text in [".TH barchan-seam-cli 1", "\\fBbarchan\\-seam\\-cli\\fR [", "barchan\\-seam\\-cli\\-run(1)"] {
        assert!(page.contains(text), "no '{text}' in {page}");
    }
    let script = succeed(folder.path(), &["completions", "fish"]);
    assert!(script.contains("complete -c barchan-seam-cli "), "{script}");
}

/// Libraries come on top of the registry.
#[test]
fn a_library_is_loaded_beside_them() {
    let folder = tempfile::tempdir().unwrap();
    let library = folder.path().join("libtemplate.so");
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
    let built = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()))
        .args(["-std=c11", "-O2", "-shared", "-fPIC", "-I"])
        .arg(root.join("sim-core/abi/include"))
        .arg(root.join("materials/template/c/neo_hookean.c"))
        .arg("-o")
        .args([library.as_os_str(), "-lm".as_ref()])
        .output()
        .expect("a C compiler: install cc or set CC");
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let library = library.to_str().unwrap();
    let text = succeed(folder.path(), &["plugins", "--json", "--load", library]);
    let plugins: Value = serde_json::from_str(&text).unwrap();
    assert!(names(&plugins, "materials").contains(&"c_neo_hookean".to_owned()));
    assert_eq!(names(&plugins, "couplings"), ["current", "rigid"]);
    let law = ["--load", library, "--set", "material.jelly.law=c_neo_hookean"];
    let plan = succeed(folder.path(), &[&["plan", SCENE] as &[&str], &law].concat());
    assert!(plan.contains("c_neo_hookean") && plan.contains("coupling current"), "{plan}");
}
