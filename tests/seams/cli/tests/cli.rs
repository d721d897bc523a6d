//! The command line that a crate outside Barchan makes has everything that its registry holds, wherever a plugin can be named.
//!
//! That `barchan` itself refuses the same scene is a test of `bindings/cli`, which has that binary.

use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// The scene that calls for a current.
const SCENE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/current.toml");
/// The scene that calls for a task and for three couplings, two of them of one kind.
const PUSH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/push.toml");

fn run(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_barchan-seam-cli")).args(args).current_dir(folder).output().unwrap()
}

/// Runs, wants success, and returns what was printed.
fn succeed(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Runs, wants it to be refused, and returns what was said.
fn fail(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert!(!output.status.success(), "{args:?} succeeded");
    String::from_utf8(output.stderr).unwrap()
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
    assert_eq!(names(&plugins, "couplings"), ["brakes", "current", "dumbbell", "rigid", "robots", "rollers"]);
    assert_eq!(names(&plugins, "backends"), ["cpu", "dust", "wgpu"]);
    let tasks = names(&plugins, "tasks");
    assert!(["push", "SmoothSurface"].iter().all(|task| tasks.contains(&(*task).to_owned())), "{tasks:?}");
    assert_eq!(names(&plugins, "observers"), ["drift"]);
    assert!(names(&plugins, "materials").contains(&"sand".to_owned()));
    let text = succeed(folder.path(), &["plugins"]);
    for doc in
        ["A current that drags", "Particles fly without touching", "How fast the ground drifts", "Push ground along x"]
    {
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

/// What plugins can be told is listed, whatever their kind.
#[test]
fn parameters_of_every_kind_are_listed() {
    let folder = tempfile::tempdir().unwrap();
    let plugins: Value = serde_json::from_str(&succeed(folder.path(), &["plugins", "--json"])).unwrap();
    let parameter = |kind: &str, plugin: &str, name: &str| -> Value {
        let named = |list: &Value, name: &str| list.as_array().unwrap().iter().find(|x| x["name"] == name).cloned();
        let plugin = named(&plugins[kind], plugin).unwrap();
        named(&plugin["parameters"], name).unwrap_or_else(|| panic!("no {name} in {plugin}"))
    };
    let rate = parameter("couplings", "current", "rate");
    assert_eq!((&rate["type"], &rate["default"], &rate["range"]), (&"number".into(), &Value::Null, &"(0, inf)".into()));
    let field = parameter("couplings", "current", "field");
    assert_eq!((&field["default"], &field["choices"][1]), (&"uniform".into(), &"whirl".into()));
    assert_eq!(parameter("couplings", "current", "horizontal")["default"], false);
    assert_eq!(parameter("couplings", "current", "record")["type"], "path");
    assert_eq!(parameter("couplings", "current", "velocity")["of"]["type"], "number");
    let zone = parameter("couplings", "brakes", "zone");
    assert_eq!((&zone["of"]["keys"][2]["name"], &zone["max_count"]), (&"half".into(), &64.into()));
    assert_eq!(parameter("tasks", "push", "goal")["default"], 0.1);
    assert_eq!(parameter("backends", "dust", "drag")["unit"], "1/s");
    let text = succeed(folder.path(), &["plugins"]);
    for line in [
        "      rate                  required 1/s    (0, inf)          How fast the ground takes up the velocity.",
        "      field                 \"uniform\"       uniform | whirl   The same everywhere",
        "      horizontal            false           switch            Is vertical motion left alone?",
        "      record                none            path              CSV with rows",
        "      zone                  required        1-64 x table      The boxes.",
        "        half                required m      3 x (0, inf)      Half its extents.",
        "      tool                  \"plate\"         text              The tool that pushes",
        "      drag                  0 1/s           [0, inf)          How fast particles lose",
    ] {
        assert!(text.contains(line), "no '{line}' in {text}");
    }
}

/// All that a scene file says of other crates' plugins reaches them: the task, two currents of one kind, brakes with a table for each body; a run of it
/// tells them apart, and goes on where it was stopped.
#[test]
fn a_scene_file_calls_for_couplings_and_a_task() {
    let folder = tempfile::tempdir().unwrap();
    let plan = succeed(folder.path(), &["plan", PUSH]);
    for effect in ["coupling whirl", "coupling wind", "coupling brakes", "task push"] {
        assert!(plan.contains(effect), "no '{effect}' in {plan}");
    }
    let end = |out: &str| fs::read(folder.path().join(out).join("trace.csv")).unwrap();
    let quiet = ["--precision", "f64", "--no-pictures", "--quiet"];
    succeed(folder.path(), &[&["run", PUSH, "--out", "whole", "--steps", "40"] as &[&str], &quiet].concat());
    succeed(folder.path(), &[&["run", PUSH, "--out", "cut", "--steps", "25"] as &[&str], &quiet].concat());
    succeed(folder.path(), &[&["run", "--out", "cut", "--resume", "--steps", "40"] as &[&str], &quiet].concat());
    assert!(end("whole") == end("cut"), "a run that is gone on with is another one");
    let trace = String::from_utf8(end("whole")).unwrap();
    let column = |name: &str| -> Vec<f64> {
        let place = trace.lines().next().unwrap().split(',').position(|column| column == name);
        let place = place.unwrap_or_else(|| panic!("no '{name}' in {trace}"));
        trace.lines().skip(1).map(|row| row.split(',').nth(place).unwrap().parse().unwrap()).collect()
    };
    // The wind is turned around, so that it pushes the ground along -x and the pump along x, and its record begins at rest.
    let wind = column("wind fx [N]");
    assert!(wind[0].abs() < 1e-12 && wind[30..].iter().all(|force| *force > 0.1), "{wind:?}");
    assert!(column("whirl fx [N]").iter().all(|force| force.abs() < 0.2), "a whirl about the block's middle");
    assert!(column("near fx [N]").iter().chain(&column("far fx [N]")).all(|force| *force == 0.0), "nothing is there");
    assert_eq!(column("blade x [m]")[0], -0.4);
}

/// A run that is gone on with keeps the columns that observers add to its trace, wherever it was stopped: between two looks and after one. With other
/// observers it is refused, by the columns, and its folder is left as it was.
#[test]
fn columns_of_observers_stay_when_a_run_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let quiet = ["--precision", "f64", "--quiet", "--no-pictures"];
    let run = |out: &str, steps: &str| {
        succeed(folder.path(), &[&["run", PUSH, "--out", out, "--steps", steps] as &[&str], &quiet].concat())
    };
    let go_on = ["run", "--resume", "--steps", "40", "--precision", "f64", "--quiet", "--no-pictures", "--out"];
    let trace = |out: &str| fs::read_to_string(folder.path().join(out).join("trace.csv")).unwrap();
    run("whole", "40");
    for cut in ["23", "25"] {
        run(cut, cut);
        succeed(folder.path(), &[&go_on as &[&str], &[cut]].concat());
        assert!(trace("whole") == trace(cut), "cut after step {cut}, the trace is another one");
    }
    let text = trace("whole");
    assert!(text.lines().next().unwrap().ends_with(",\"drift vx, mean [m/s]\",drift kinetic [J]"), "{text}");
    for (step, row) in text.lines().enumerate().skip(1) {
        let seen: Vec<&str> = row.rsplit(',').take(2).collect();
        // Looks are 5 steps apart.
        assert_eq!(seen.iter().all(|value| value.parse::<f64>().is_ok()), step % 5 == 0, "row {step}: {row}");
        assert_eq!(seen.iter().all(|value| value.is_empty()), step % 5 != 0, "row {step}: {row}");
    }

    // They may be chosen among the others, which a check knows before any run.
    succeed(folder.path(), &["check", PUSH, "--set", "output.trace.columns=[\"drift *\"]"]);

    run("other", "25");
    let path = folder.path().join("other/trace.csv");
    fs::write(&path, trace("other").replace("drift kinetic [J]", "glide depth [m]")).unwrap();
    let content = || -> Vec<_> {
        let mut files: Vec<_> =
            fs::read_dir(path.parent().unwrap()).unwrap().map(|file| file.unwrap().path()).collect();
        files.sort();
        files.into_iter().map(|file| (fs::read(&file).unwrap(), file)).collect()
    };
    let before = content();
    let error = fail(folder.path(), &[&go_on as &[&str], &["other"]].concat());
    for says in
        ["has 'glide depth [m]'", "lacks 'drift kinetic [J]'", "go on with the probes and observers that the run had"]
    {
        assert!(error.contains(says), "'{says}' is not in: {error}");
    }
    assert!(before == content(), "a run that was refused has changed the folder");
}

/// What is wrong in a scene file is said with file, line and key, and a key of one of two couplings is set by the coupling's name.
#[test]
fn parameters_are_refused_with_file_line_and_key() {
    let folder = tempfile::tempdir().unwrap();
    for (set, says) in [
        ("coupling.wind.parameters.rate=0", "--set: coupling[1].parameters.rate: is 0; must be in (0, inf) 1/s"),
        (
            "coupling.whirl.parameters.fields=1",
            "coupling[0].parameters.fields: coupling 'current' has no parameter `fields`",
        ),
        ("coupling.wind.name=whirl", "coupling[1].name: 'whirl' is already the name of coupling[0]"),
        (
            "coupling[2].parameters.zone.near.name=blade",
            "coupling[2]: its body 'blade' bears the name of one of the coupling 'rigid'",
        ),
        ("coupling.wind.parameters.record=gone.csv", "coupling[1].parameters.record: there is no file \"gone.csv\""),
        ("task.name=pull", "--set: task.name: no task is called 'pull'; known are: "),
        ("task.parameters.goal=far", "--set: task.parameters.goal: is the text \"far\"; give a number in (0, inf) m"),
        (
            "task.parameters.tool=spade",
            "--set: task.parameters.tool: no tool 'spade' of the scene is driven by velocity",
        ),
    ] {
        let error = fail(folder.path(), &["check", PUSH, "--set", set]);
        assert!(error.contains(says), "'{says}' is not in: {error}");
    }
    let text = fs::read_to_string(PUSH).unwrap();
    let path = folder.path().join("wrong.toml");
    fs::write(&path, text.replace("heading_deg = 180", "heading_deg = \"back\"")).unwrap();
    fs::copy(Path::new(PUSH).with_file_name("wind.csv"), folder.path().join("wind.csv")).unwrap();
    let error = fail(folder.path(), &["check", "wrong.toml"]);
    let line = text.lines().position(|line| line.contains("heading_deg")).unwrap() + 1;
    let says = format!("wrong.toml:{line}: coupling[1].parameters.heading_deg: is the text \"back\"; give a number");
    assert!(error.contains(&says), "'{says}' is not in: {error}");
}

/// A backend is asked on the command line for what it offers: under drag of rate k a block falls by v' = (v + g dt) / (1 + k dt). What is meant for
/// one backend is not handed to another that takes over.
#[test]
fn a_backend_is_asked_for_what_it_offers() {
    let folder = tempfile::tempdir().unwrap();
    let fall = ["--set", "coupling=[]", "--set", "gravity=[0, 0, -9.81]", "--no-pictures", "--quiet"];
    let dust = ["run", SCENE, "--backend", "dust", "--backend-parameter", "drag=2"];
    succeed(folder.path(), &[&dust as &[&str], &fall, &["--out", "out"]].concat());
    let speed = (0..100).fold(0.0, |v: f64, _| (v - 9.81 * 2e-3) / (1.0 + 2.0 * 2e-3));
    let off = (mean_velocity(&folder.path().join("out"))[2] - speed).abs();
    println!("velocity off by {off:.1e} m/s, tolerance 1e-12");
    assert!(off < 1e-12);
    succeed(folder.path(), &[&dust as &[&str], &fall, &["--swap-at", "50:cpu", "--out", "swapped"]].concat());
    for (parameter, says) in [
        (
            "drug=2",
            "--backend-parameter: drug: backend 'dust' has no parameter `drug`; it has drag; did you mean `drag`?",
        ),
        ("drag=-2", "--backend-parameter: drag: is -2; must be in [0, inf) 1/s"),
        ("drag", "has no `=`: write KEY=VALUE"),
    ] {
        let error = fail(folder.path(), &["check", SCENE, "--backend", "dust", "--backend-parameter", parameter]);
        assert!(error.contains(says), "'{says}' is not in: {error}");
    }
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
    assert_eq!(names(&plugins, "couplings"), ["brakes", "current", "dumbbell", "rigid", "robots", "rollers"]);
    let law = ["--load", library, "--set", "material.jelly.law=c_neo_hookean"];
    let plan = succeed(folder.path(), &[&["plan", SCENE] as &[&str], &law].concat());
    assert!(plan.contains("c_neo_hookean") && plan.contains("coupling current"), "{plan}");
}
