//! The command line from outside: what it writes, how it stops, what it refuses.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A bed of nearly 1000 particles and a stirrer: a step takes a fraction of a millisecond.
const SMALL: &str = r#"
name = "small"
[world]
cell = 0.02
min = [0.0, 0.0, 0.0]
max = [0.1, 0.1, 0.2]
walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }
[time]
end = 0.2
step = 1e-4
[output]
interval = 0.01
picture = { pixels = 240 }
[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = { young_modulus = 1e5, friction_angle_deg = 30.0 }
[[body]]
material = "sand"
shape = { box = { min = [0.0, 0.0, 0.0], max = [0.1, 0.1, 0.1] } }
[[tool]]
name = "rod"
shape = { sphere = { radius = 0.02 } }
position = [0.03, 0.05, 0.1]
motion = { velocity = { linear = [0.2, 0.0, 0.0] } }
"#;

fn barchan(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_barchan"));
    command.current_dir(folder);
    command
}

fn run(folder: &Path, args: &[&str]) -> Output {
    barchan(folder).args(args).output().unwrap()
}

/// Runs, wants success, and returns what was printed.
fn succeed(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Runs, wants failure, and returns the error.
fn fail(folder: &Path, args: &[&str]) -> String {
    let output = run(folder, args);
    assert_eq!(output.status.code(), Some(1), "{args:?} did not fail");
    String::from_utf8(output.stderr).unwrap()
}

fn folder_with_scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("small.toml"), SMALL).unwrap();
    folder
}

fn frames(out: &Path) -> Vec<String> {
    let entries = fs::read_dir(out.join("frames")).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_run_leaves_everything_in_its_folder() {
    let folder = folder_with_scene();
    let text = succeed(folder.path(), &["run", "small.toml", "--seconds", "0.05", "--export", "ply"]);
    for figure in ["P2G", "material sand", "G2P", "output", "real-time factor", "particle-steps/s", "mass [kg]"] {
        assert!(text.contains(figure), "'{figure}' is not in\n{text}");
    }
    assert!(text.contains("output in out/small-001"), "{text}");
    let out = folder.path().join("out/small-001");
    assert_eq!(frames(&out).len(), 6, "frames at 0, 10, … 50 ms");
    for file in ["contact-sheet.png", "animation.gif", "snapshot.barchan", "particles/00005.ply"] {
        assert!(fs::metadata(out.join(file)).unwrap().len() > 100, "{file} is empty");
    }
    let trace = fs::read_to_string(out.join("trace.csv")).unwrap();
    let rows: Vec<Vec<&str>> = trace.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 1 + 500);
    assert_eq!((rows[0][3], rows[0].len()), ("rod x [m]", 3 + 19));
    let number = |row: &[&str], column: &str| -> f64 {
        row[rows[0].iter().position(|c| *c == column).unwrap()].parse().unwrap()
    };
    assert!((number(&rows[500], "rod x [m]") - 0.04).abs() < 1e-9, "0.2 m/s for 50 ms");
    assert!(rows[1..].iter().all(|row| row.len() == 22));
    assert!(number(&rows[500], "rod fx [N]") < 0.0, "sand holds the rod back");
    let summary: serde_json::Value = serde_json::from_slice(&fs::read(out.join("summary.json")).unwrap()).unwrap();
    assert_eq!((&summary["steps"], &summary["interrupted"]), (&500.into(), &false.into()));
    assert!(summary["particle_steps_per_s"].as_f64().unwrap() > 0.0);
    assert_eq!(summary["ledger_end"]["mass"], summary["ledger_start"]["mass"]);
}

#[test]
fn a_resumed_run_is_the_whole_run_bit_for_bit() {
    resumes_as_the_whole_run(&[]);
}

/// Symptom: the row of a trace with an interval that was open when a run stopped had the mean force of what came behind the stop alone.
#[test]
fn means_of_a_resumed_trace_are_those_of_the_whole_run() {
    let trace = resumes_as_the_whole_run(&["--set", "output.trace.interval=0.007"]);
    let forces: Vec<&str> = trace.lines().map(|line| line.rsplit(',').nth(3).unwrap()).collect();
    assert!(forces.len() > 4 && forces[2..].iter().all(|force| force.parse::<f64>().unwrap() != 0.0), "{forces:?}");
}

/// Symptom: a run of so many steps took others than the whole one, where steps are chosen so as to land on its end, and went on as another run.
#[test]
fn a_run_that_stops_early_takes_the_steps_of_the_whole_one() {
    let folder = folder_with_scene();
    let auto = SMALL.replace("end = 0.2\nstep = 1e-4", "end = 0.05");
    fs::write(folder.path().join("auto.toml"), auto).unwrap();
    let run =
        |more: &[&str]| succeed(folder.path(), &[&["run", "auto.toml", "--quiet", "--no-pictures"], more].concat());
    let trace = |out: &str| fs::read_to_string(folder.path().join(out).join("trace.csv")).unwrap();
    run(&["--out", "whole"]);
    run(&["--out", "part", "--steps", "20"]);
    let (whole, part) = (trace("whole"), trace("part"));
    assert_eq!(part.lines().count(), 21);
    assert!(whole.lines().count() > 30 && whole.starts_with(&part), "{part}");
    run(&["--out", "part", "--resume"]);
    assert!(trace("part") == whole, "it goes on as another run");
}

/// A run in two parts leaves what one in one part does, to the last bit; returns its trace.
fn resumes_as_the_whole_run(more: &[&str]) -> String {
    let folder = folder_with_scene();
    let run = |out: &str, steps: &str| {
        let args = ["run", "small.toml", "--out", out, "--quiet", "--steps", steps];
        succeed(folder.path(), &[&args[..], more].concat());
    };
    run("whole", "400");
    run("parts", "230");
    // What an interrupted run wrote after its last snapshot is written anew.
    let trace = folder.path().join("parts/trace.csv");
    fs::write(&trace, fs::read_to_string(&trace).unwrap() + "0.5,9999,1e-4,1\n0.5,100").unwrap();
    succeed(folder.path(), &["run", "small.toml", "--out", "parts", "--quiet", "--steps", "400", "--resume"]);
    let [whole, parts] = ["whole", "parts"].map(|out| folder.path().join(out));
    assert!(fs::read(whole.join("trace.csv")).unwrap() == fs::read(parts.join("trace.csv")).unwrap());
    // Before the particles stands the ledger, whose sums over time are summed in two parts here and round differently.
    let state = |out: &Path| {
        let snapshot = fs::read(out.join("snapshot.barchan")).unwrap();
        let start = snapshot.windows(4).position(|w| w == b"LIST").unwrap();
        snapshot[start..].to_vec()
    };
    assert!(state(&whole) == state(&parts), "particles or bodies differ");
    assert_eq!(frames(&whole), frames(&parts));
    fs::read_to_string(whole.join("trace.csv")).unwrap()
}

/// Symptom: meshes of a package were not found where the program runs in the URDF's folder, since the folders around were those of the path as it was given.
#[test]
fn meshes_of_a_package_are_found_from_any_folder() {
    let folder = tempfile::tempdir().unwrap();
    let at = |path: &str| folder.path().join(path);
    for path in ["pkg/urdf", "pkg/meshes"] {
        fs::create_dir_all(at(path)).unwrap();
    }
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    fs::write(at("pkg/meshes/b.obj"), corners).unwrap();
    let urdf = "<robot name=\"r\"><link name=\"a\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" iyy=\"1\" izz=\"1\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>\
        <collision><geometry><mesh filename=\"package://pkg/meshes/b.obj\"/></geometry></collision></link></robot>";
    fs::write(at("pkg/urdf/r.urdf"), urdf).unwrap();
    for (from, urdf) in
        [("pkg/urdf", "r.urdf"), ("pkg/urdf", "./r.urdf"), ("pkg", "urdf/r.urdf"), ("", "pkg/urdf/r.urdf")]
    {
        succeed(&at(from), &["robot", "check", urdf]);
    }
    fs::remove_file(at("pkg/meshes/b.obj")).unwrap();
    let error = fail(&at("pkg/urdf"), &["robot", "check", "r.urdf"]);
    assert!(error.contains("no folder around") && error.contains("pkg/urdf;"), "{error}");
}

#[test]
fn pictures_do_not_change_the_physics() {
    let folder = folder_with_scene();
    succeed(folder.path(), &["run", "small.toml", "--out", "with", "--quiet", "--steps", "150"]);
    succeed(folder.path(), &["run", "small.toml", "--out", "without", "--quiet", "--steps", "150", "--no-pictures"]);
    let [with, without] = ["with", "without"].map(|out| fs::read(folder.path().join(out).join("snapshot.barchan")));
    assert!(with.unwrap() == without.unwrap());
    assert!(!folder.path().join("without/frames").exists());
}

/// Waits until a run has come so far that a file is there.
fn wait_for(file: &Path) {
    let start = Instant::now();
    while !file.exists() && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(file.exists(), "{} does not come", file.display());
}

/// A command whose process begins with an action for a signal, and whose errors are kept.
#[cfg(unix)]
fn with_action(command: &mut Command, signal: i32, action: libc::sighandler_t) -> &mut Command {
    use std::os::unix::process::CommandExt;
    // SAFETY: between fork and exec, setting an action is allowed.
    unsafe {
        command.pre_exec(move || {
            libc::signal(signal, action);
            Ok(())
        });
    }
    command.stdout(Stdio::null()).stderr(Stdio::piped())
}

#[cfg(unix)]
fn signal(child: &Child, signal: &str) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

/// What asks a run to end, a batch system or a terminal that is gone, must not cost what has been simulated.
#[cfg(unix)]
#[test]
fn signals_that_ask_a_run_to_end_save_it_and_tell_how_to_go_on() {
    let folder = folder_with_scene();
    for (name, number, status) in
        [("-INT", libc::SIGINT, 130), ("-TERM", libc::SIGTERM, 143), ("-HUP", libc::SIGHUP, 129)]
    {
        let out = format!("out/a b{name}");
        let args = ["run", "small.toml", "--out", &out, "--set", "time.end=1000"];
        let mut command = barchan(folder.path());
        // Whoever runs the tests may have them ignored.
        let child = with_action(command.args(args), number, libc::SIG_DFL).spawn().unwrap();
        wait_for(&folder.path().join(&out).join("frames/00001.png"));
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(status), "{name}: {error}");
        assert!(error.contains(&format!("barchan run small.toml --out '{out}' --resume")), "{name}: {error}");
        let summary = fs::read_to_string(folder.path().join(&out).join("summary.json")).unwrap();
        assert!(summary.contains("\"interrupted\": true"), "{name}");
        let more = ["run", "--out", &out, "--seconds", "0", "--resume"];
        let text = succeed(folder.path(), &more);
        assert!(text.contains("goes on with 'small' --set time.end=1000 of "), "{text}");
    }
}

/// Symptom: a run under `timeout` was lost, since `timeout` signals the process and then its group, and a second signal ends a run at once.
#[cfg(unix)]
#[test]
fn signals_that_come_at_once_are_one() {
    let folder = folder_with_scene();
    let mut command = barchan(folder.path());
    let args = ["run", "small.toml", "--out", "on", "--set", "time.end=1000"];
    let command = with_action(command.args(args), libc::SIGTERM, libc::SIG_DFL);
    let child = with_action(command, libc::SIGHUP, libc::SIG_DFL).spawn().unwrap();
    wait_for(&folder.path().join("on/frames/00001.png"));
    // While it is stopped, they gather: both are there when it goes on. Two of one kind would be one already.
    for name in ["-STOP", "-TERM", "-HUP", "-CONT"] {
        signal(&child, name);
    }
    let output = child.wait_with_output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(matches!(output.status.code(), Some(129 | 143)), "{:?}: {error}", output.status);
    assert!(error.contains("saving what has been simulated") && error.contains("--resume"), "{error}");
}

/// A run that is to outlive its terminal does.
#[cfg(unix)]
#[test]
fn a_run_under_nohup_hears_no_hang_up() {
    let folder = folder_with_scene();
    let mut command = barchan(folder.path());
    command.args(["run", "small.toml", "--out", "on", "--quiet", "--set", "time.end=1000"]);
    let child = with_action(&mut command, libc::SIGHUP, libc::SIG_IGN).spawn().unwrap();
    wait_for(&folder.path().join("on/frames/00001.png"));
    signal(&child, "-HUP");
    let frames = frames(&folder.path().join("on")).len();
    wait_for(&folder.path().join(format!("on/frames/{:05}.png", frames + 2)));
    signal(&child, "-TERM");
    assert_eq!(child.wait_with_output().unwrap().status.code(), Some(143));
}

/// Symptom: `barchan run … | head -1` panics at the next line of progress, and so does a run whose log's disk is full.
#[cfg(unix)]
#[test]
fn a_standard_output_that_closes_or_fills_ends_no_run() {
    let folder = folder_with_scene();
    let run = ["run", "small.toml", "--seconds", "0.05", "--no-pictures"];
    let mut child = barchan(folder.path()).args(run).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let closed = child.wait_with_output().unwrap();
    assert!(closed.status.success() && closed.stderr.is_empty(), "{}", String::from_utf8_lossy(&closed.stderr));
    let full = || fs::File::options().write(true).open("/dev/full").unwrap();
    let filled = barchan(folder.path()).args(run).stdout(full()).output().unwrap();
    let error = String::from_utf8_lossy(&filled.stderr);
    assert!(filled.status.success() && error.lines().count() == 1, "said once: {error}");
    assert!(error.contains("standard output: "), "{error}");
    for out in ["out/small-001", "out/small-002"] {
        let summary = fs::read_to_string(folder.path().join(out).join("summary.json")).unwrap();
        assert!(summary.contains("\"interrupted\": false"), "{out}");
    }
    // Where what is shown is all there is, losing it is an error; and nobody has to hear of it.
    let lost = barchan(folder.path()).arg("schema").stdout(full()).stderr(full()).status().unwrap();
    assert_eq!(lost.code(), Some(1));
}

/// Symptom: a run replaced the one before it in the same folder, and removed pictures that a user had put there.
#[test]
fn a_folder_that_holds_a_run_is_not_written_over() {
    let folder = folder_with_scene();
    let run = ["run", "small.toml", "--out", "kept", "--quiet", "--seconds", "0.02", "--export", "ply"];
    succeed(folder.path(), &run);
    let out = folder.path().join("kept");
    let before = fs::read(out.join("trace.csv")).unwrap();
    let error = fail(folder.path(), &run);
    assert!(error.contains("kept: ") && error.contains("--resume") && error.contains("--overwrite"), "{error}");
    assert!(fs::read(out.join("trace.csv")).unwrap() == before);

    // What a user has put there stays, whatever it is called; under a name that the run would use it stops the run.
    let own =
        ["frames/0001.jpg", "frames/00000.txt", "frames/notes.png", "particles/00001.csv", "readme", ".mine.7.part"];
    own.iter().for_each(|name| fs::write(out.join(name), "mine").unwrap());
    let overwrite = [&run[..5], &["--seconds", "0.01", "--overwrite"]].concat();
    succeed(folder.path(), &overwrite);
    own.iter().for_each(|name| assert_eq!(fs::read_to_string(out.join(name)).unwrap(), "mine", "{name}"));
    assert!(
        !out.join("particles/00000.ply").exists() && !out.join("frames/00002.png").exists(),
        "the older run's are gone"
    );
    assert_eq!(frames(&out), ["00000.png", "00000.txt", "00001.png", "0001.jpg", "notes.png"]);

    fs::write(out.join("frames/00007.png"), "mine").unwrap();
    let error = fail(folder.path(), &overwrite);
    assert!(error.contains("holds frames/00007.png, which no run"), "{error}");
    assert_eq!(fs::read_to_string(out.join("frames/00007.png")).unwrap(), "mine");
    let foreign = folder.path().join("foreign");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("trace.csv"), "mine").unwrap();
    for more in [&[][..], &["--overwrite"]] {
        let error = fail(folder.path(), &[&["run", "small.toml", "--out", "foreign"], more].concat());
        assert!(error.contains("foreign: ") && error.contains("trace.csv"), "{error}");
    }
    assert_eq!(fs::read_to_string(foreign.join("trace.csv")).unwrap(), "mine");
    assert_eq!(fs::read_dir(&foreign).unwrap().count(), 1, "something was left behind");
}

/// Symptom: a user's own `files.txt` passed for the list of a run, so that `--overwrite` removed the files that it names. Only what a run writes can stand
/// in its list, and a list that a full disk cut off within a line goes on with a new one.
#[test]
fn a_list_of_files_that_is_somebody_elses_is_left_alone() {
    let folder = folder_with_scene();
    let out = folder.path().join("own");
    fs::create_dir(&out).unwrap();
    fs::write(out.join("data.csv"), "mine").unwrap();
    for text in ["data.csv\n", "trace.csv\n../small.toml\n", "my notes", "frames/00001.png\n\u{1b}"] {
        fs::write(out.join("files.txt"), text).unwrap();
        for more in [&[][..], &["--overwrite"]] {
            let error = fail(folder.path(), &[&["run", "small.toml", "--out", "own", "--quiet"], more].concat());
            assert!(error.contains("own: ") && error.contains("holds files.txt, which no run has written"), "{error}");
        }
        assert_eq!(fs::read_to_string(out.join("files.txt")).unwrap(), text);
    }
    fs::write(out.join("files.txt"), "frames/000").unwrap();
    let run = ["run", "small.toml", "--out", "own", "--quiet", "--steps", "3", "--no-pictures"];
    succeed(folder.path(), &run);
    assert_eq!(
        fs::read_to_string(out.join("files.txt")).unwrap(),
        "trace.csv\nsnapshot.barchan\nsummary.json\n",
        "each name on its own line"
    );
    succeed(folder.path(), &[&run[..], &["--overwrite"]].concat());
    assert_eq!(fs::read_to_string(out.join("data.csv")).unwrap(), "mine");
    #[cfg(unix)]
    {
        let linked = folder.path().join("linked");
        fs::create_dir(&linked).unwrap();
        std::os::unix::fs::symlink(out.join("data.csv"), linked.join("files.txt")).unwrap();
        let error = fail(folder.path(), &["run", "small.toml", "--out", "linked", "--quiet"]);
        assert!(error.contains("holds files.txt, which is no file of a run"), "{error}");
        assert_eq!(fs::read_to_string(out.join("data.csv")).unwrap(), "mine");
    }
}

#[test]
fn runs_without_a_folder_are_numbered_and_the_last_is_gone_on_with() {
    let folder = folder_with_scene();
    for number in 1..=2 {
        let text = succeed(folder.path(), &["run", "small.toml", "--steps", "20", "--no-pictures"]);
        assert!(text.contains(&format!("output in out/small-00{number}")), "{text}");
    }
    let text = succeed(folder.path(), &["run", "small.toml", "--steps", "30", "--no-pictures", "--resume"]);
    assert!(
        text.contains("goes on with 'small' of out/small-002/snapshot.barchan, from step 20 at 0.0020 s"),
        "{text}"
    );
    let lines = |out: &str| fs::read_to_string(folder.path().join(out).join("trace.csv")).unwrap().lines().count();
    assert_eq!((lines("out/small-001"), lines("out/small-002")), (21, 31));
    assert!(!text.contains("at its end already"), "{text}");
    let text = succeed(folder.path(), &["run", "--steps", "30", "--no-pictures", "--resume", "small.toml"]);
    assert!(text.contains("it is at its end already; --seconds"), "{text}");
    // Also from within.
    let inside = folder.path().join("out/small-002");
    let text = succeed(&inside, &["run", "--resume=snapshot.barchan", "--steps", "40", "--no-pictures"]);
    assert!(text.contains("output goes to .\n"), "{text}");
    assert_eq!((lines("out/small-001"), lines("out/small-002")), (21, 41));
    let error = fail(folder.path(), &["run", "letters", "--resume"]);
    assert!(error.contains("no run of 'letters' has left a snapshot.barchan in out"), "{error}");
    // What is refused leaves no folder behind.
    fail(folder.path(), &["run", "small.toml", "--set", "time.step=1"]);
    assert!(!folder.path().join("out/small-003").exists());
}

#[cfg(unix)]
#[test]
fn a_second_run_is_kept_out_of_a_folder_as_long_as_the_first_one_writes() {
    let folder = folder_with_scene();
    let set = ["--set", "time.end=1000", "--set", "output.snapshot_interval=5e-3"];
    let args = [&["run", "small.toml", "--out", "one", "--quiet"], &set[..]].concat();
    let mut child = barchan(folder.path()).args(args).stderr(Stdio::null()).spawn().unwrap();
    wait_for(&folder.path().join("one/snapshot.barchan"));
    for more in [&["small.toml", "--overwrite"][..], &["--resume"]] {
        let error = fail(folder.path(), &[&["run", "--out", "one"], more].concat());
        assert!(error.contains("one: this output folder is being written into by another run"), "{error}");
    }
    // However it ends, it holds the folder no longer.
    child.kill().unwrap();
    child.wait().unwrap();
    succeed(folder.path(), &["run", "small.toml", "--out", "one", "--overwrite", "--steps", "3", "--quiet"]);
}

/// Symptom: the trace lay in memory when a run was killed, so that the resumed run's had a hole from the last picture to the snapshot. What
/// was half written stayed for ever.
#[cfg(unix)]
#[test]
fn what_a_killed_run_leaves_goes_on_without_a_gap() {
    let folder = folder_with_scene();
    let set = ["--set", "time.end=1000", "--set", "output={interval=100, snapshot_interval=5e-3, picture={on=false}}"];
    let args = [&["run", "small.toml", "--out", "killed", "--quiet"], &set[..]].concat();
    let mut child = barchan(folder.path()).args(args).stderr(Stdio::null()).spawn().unwrap();
    let out = folder.path().join("killed");
    wait_for(&out.join("snapshot.barchan"));
    child.kill().unwrap();
    child.wait().unwrap();
    for left in [".snapshot.barchan.4000000.part", ".probe.4000000.part"] {
        fs::write(out.join(left), "half").unwrap();
    }
    succeed(folder.path(), &["run", "--out", "killed", "--quiet", "--seconds", "0.02", "--resume"]);
    let trace = fs::read_to_string(out.join("trace.csv")).unwrap();
    let steps: Vec<u64> = trace.lines().skip(1).map(|line| line.split(',').nth(1).unwrap().parse().unwrap()).collect();
    assert!(steps.iter().copied().eq(1..=200), "{} lines from {:?} to {:?}", steps.len(), steps.first(), steps.last());
    let names = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.collect();
    names.sort();
    assert_eq!(names, ["files.txt", "snapshot.barchan", "summary.json", "trace.csv"]);
}

/// A closed tetrahedron around the origin.
fn tetrahedron(size: f64) -> String {
    format!(
        "v {size} {size} {size}\nv {size} -{size} -{size}\nv -{size} {size} -{size}\nv -{size} -{size} {size}\n\
         f 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
    )
}

/// Symptom: `run other.toml --resume` went on with the old scene and said nothing, and a mesh that had been edited meanwhile was the body's
/// from then on.
#[test]
fn a_run_goes_on_as_the_scene_that_it_began_with() {
    let folder = folder_with_scene();
    let here = folder.path();
    let meshed = SMALL
        .replace("name = \"small\"", "name = \"meshed\"")
        .replace("sphere = { radius = 0.02 }", "mesh = { file = \"rod.obj\", scale = 0.02 }");
    fs::write(here.join("meshed.toml"), meshed).unwrap();
    fs::write(here.join("rod.obj"), tetrahedron(1.0)).unwrap();
    let resume =
        |more: &[&'static str]| [&["run"], more, &["--out", "one", "--quiet", "--steps", "40", "--resume"]].concat();
    let set = ["--set", "gravity=[0, 0, -5]"];
    succeed(here, &[&["run", "meshed.toml", "--out", "one", "--quiet", "--steps", "20"], &set[..]].concat());
    for (more, says) in [
        (&["small.toml"][..], &["continues the scene 'meshed', and 'small' is given"][..]),
        (&["letters"], &["'meshed'", "'letters'"]),
        (&["meshed.toml", "--set", "gravity=[0, 0, -5]"], &["began, with --set gravity=[0, 0, -5], and --set"]),
        (&["--set", "time.end=3"], &["--resume", "--set time.end=3"]),
    ] {
        let error = fail(here, &resume(more));
        says.iter().for_each(|part| assert!(error.contains(part), "{more:?}: '{part}' is not in: {error}"));
    }
    let text = fs::read_to_string(here.join("meshed.toml")).unwrap();
    fs::write(here.join("meshed.toml"), text.replace("density = 1600.0", "density = 1700.0")).unwrap();
    let error = fail(here, &resume(&["meshed.toml"]));
    assert!(error.contains("material[0].density was 1600") && error.contains("is 1700"), "{error}");
    // Without a scene it is the one that the run began with.
    succeed(here, &resume(&[]));
    fs::write(here.join("rod.obj"), tetrahedron(0.9)).unwrap();
    let error = fail(here, &resume(&[]));
    assert!(error.contains("rod.obj has changed since the run began"), "{error}");
    fs::write(here.join("rod.obj"), tetrahedron(1.0)).unwrap();
    succeed(here, &resume(&[]));
    assert_eq!(fs::read_to_string(here.join("one/trace.csv")).unwrap().lines().count(), 41);
    // So it is with the meshes of a robot, wherever the program runs.
    let bob = r#"<robot name="bob"><link name="bob">
        <inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><geometry><mesh filename="bob.obj" scale="0.02 0.02 0.02"/></geometry></collision></link></robot>"#;
    fs::create_dir(here.join("in")).unwrap();
    fs::write(here.join("in/bob.urdf"), bob).unwrap();
    fs::write(here.join("in/bob.obj"), tetrahedron(1.0)).unwrap();
    let robot = "[[robot]]\nname = \"bob\"\nurdf = \"bob.urdf\"\nposition = [0.05, 0.05, 0.15]\n";
    fs::write(here.join("in/bob.toml"), SMALL.to_owned() + robot).unwrap();
    let run = ["run", "in/bob.toml", "--out", "bob", "--quiet", "--no-pictures"];
    succeed(here, &[&run[..], &["--steps", "5"]].concat());
    succeed(here, &[&run[..], &["--steps", "9", "--resume"]].concat());
    fs::write(here.join("in/bob.obj"), tetrahedron(0.9)).unwrap();
    let error = fail(here, &[&run[..], &["--steps", "12", "--resume"]].concat());
    assert!(error.contains("bob.obj has changed since the run began"), "{error}");
}

/// Names come from files that others may have written.
#[test]
fn names_cannot_break_a_table_nor_act_on_a_terminal() {
    let folder = folder_with_scene();
    let (escape, name) = ('\u{1b}', r#"a "rod", x\u001b[31m\nerror: y"#);
    let text =
        SMALL.replace("name = \"rod\"", &format!("name = {:?}", "NAME")).replace("NAME", &name.replace('"', "\\\""));
    let text = text
        .replace("name = \"sand\"\nlaw", "name = \"sa\\u001bnd\"\nlaw")
        .replace("material = \"sand\"", "material = \"sa\\u001bnd\"");
    fs::write(folder.path().join("odd.toml"), text).unwrap();
    let output = run(folder.path(), &["run", "odd.toml", "--out", "odd", "--steps", "5"]);
    let shown = String::from_utf8(output.stdout).unwrap() + std::str::from_utf8(&output.stderr).unwrap();
    assert!(output.status.success(), "{shown}");
    assert!(shown.contains("[31m") && !shown.contains(escape), "{shown}");
    assert!(!shown.lines().any(|line| line.starts_with("error:")), "{shown}");
    let trace = fs::read_to_string(folder.path().join("odd/trace.csv")).unwrap();
    let head = trace.lines().next().unwrap();
    assert!(head.starts_with(r#"time [s],step,dt [s],"a ""rod"", x[31merror: y x [m]","#), "{head}");
    assert_eq!(trace.lines().count(), 6, "{trace}");
    let error = fail(folder.path(), &["check", "odd.toml", "--set", "body[0].material=\"x\\u001b[2J\""]);
    assert!(error.contains("x[2J") && !error.contains(escape), "{error}");
}

#[cfg(unix)]
#[test]
fn a_full_disk_is_found_before_the_first_step() {
    // A limit on the size of files stands in for a full disk: writing fails in the same place.
    let folder = folder_with_scene();
    let script = format!("trap '' XFSZ; ulimit -f 8; exec '{}' run small.toml", env!("CARGO_BIN_EXE_barchan"));
    let output = Command::new("bash").args(["-c", &script]).current_dir(folder.path()).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("out/small-001: this output folder cannot be used") && error.contains("--out"), "{error}");
    assert_eq!(fs::read_dir(folder.path().join("out")).unwrap().count(), 0, "something was left behind");
}

#[cfg(unix)]
#[test]
fn a_disk_that_fills_up_ends_the_run_and_keeps_what_there_is() {
    // The trace is the file that grows: 192 KiB are enough for all others, and for some 700 steps.
    let folder = folder_with_scene();
    let script =
        format!("trap '' XFSZ; ulimit -f 192; exec '{}' run small.toml --no-pictures", env!("CARGO_BIN_EXE_barchan"));
    let output = Command::new("bash").args(["-c", &script]).current_dir(folder.path()).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("trace.csv: writing the trace"), "{error}");
    let out = folder.path().join("out/small-001");
    let trace = fs::read_to_string(out.join("trace.csv")).unwrap();
    assert!(trace.lines().count() > 300, "{} lines were kept", trace.lines().count());
    let summary = fs::read_to_string(out.join("summary.json")).unwrap();
    assert!(summary.contains("writing the trace"), "the summary does not say what stopped the run");
    assert!(out.join("snapshot.barchan").exists());
}

#[test]
fn what_cannot_be_run_is_refused_with_place_and_mend() {
    let folder = folder_with_scene();
    let here = folder.path();
    for (args, says) in [
        (&["run", "leters"][..], &["'leters'", "known are: letters"][..]),
        (&["check", "missing.toml"], &["missing.toml", "reading the scene"]),
        (&["check", "small.toml", "--set", "world.cel=1"], &["--set: world.cel", "did you mean `cell`?"]),
        (&["check", "small.toml", "--backend", "gpu"], &["'gpu'", "known are: cpu"]),
        (&["check", "small.toml", "--set", "time.step=1"], &["time step", "above the bound", "lower time.step"]),
        (&["run", "small.toml", "--out", "small.toml/x"], &["small.toml/x", "--out"]),
        (&["run", "small.toml", "--resume"], &["--resume", "snapshot.barchan"]),
        (&["run", "small.toml", "--out", "none", "--resume"], &["none/snapshot.barchan"]),
        (
            &["check", "small.toml", "--set", "world.walls.x_max=\"separate\""],
            &["--set: world.walls.x_max", "keys of its own", "{ NAME = { KEY = … } }"],
        ),
        (&["check", "small.toml", "--set", "gravity_ramp=-1"], &["--set: gravity_ramp: is -1", "0 or above"]),
        (
            &["check", "small.toml", "--set", "body.0.spacing=0.01"],
            &["--set: body.0.spacing", "write body[0].spacing=0.01"],
        ),
        (
            &["check", "small.toml", "--set", "body[0]spacing=0.01"],
            &["--set: body[0]spacing", "write body[0].spacing=0.01"],
        ),
        (
            &["check", "small.toml", "--set", "body[1].spacing=0.01"],
            &["--set: body[1].spacing", "write body[0].spacing=0.01"],
        ),
        (
            &["check", "small.toml", "--set", "bdoy[0].spacing=0.01"],
            &["--set: bdoy[0].spacing", "write body[0].spacing=0.01"],
        ),
        (
            &["check", "small.toml", "--set", "tool.rad.position=[0,0,0]"],
            &["--set: tool.rad", "write tool[0].", "name one of rod"],
        ),
        (&["check", "small.toml", "--set", "gravity[2]=-1"], &["--set: gravity[2]", "write all of it, gravity=[…]"]),
        (
            &["check", "small.toml", "--set", "body[0].shape.sphere.radius=1"],
            &["body[0].shape: ", "(with --set body[0].shape.sphere.radius); give exactly one"],
        ),
        (
            &["check", "small.toml", "--set", "coupling=[{ kind = \"rigid\", parameters = { mass = 1 } }]"],
            &["--set: coupling[0].parameters.mass: coupling 'rigid' has no parameter `mass`; it has none"],
        ),
        (
            &["run", "small.toml", "--steps", "10", "--swap-at", "10:cpu:f64"],
            &["--swap-at: step 10 never comes", "at step 10"],
        ),
        (&["run", "small.toml", "--seconds", "1e-3", "--swap-at", "99:cpu:f64"], &["--swap-at: step 99 never comes"]),
        (&["plugins", "--load", "small.toml"], &["small.toml"]),
    ] {
        let error = fail(here, args);
        for part in says {
            assert!(error.contains(part), "{args:?}: '{part}' is not in: {error}");
        }
    }
    // What could not be meant is refused by whoever reads the command line.
    let meant = ["--seconds=nan", "--seconds=inf", "--seconds=-1", "--threads=100000000", "--threads=1.5"];
    for option in meant {
        let output = run(here, &["run", "small.toml", option]);
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{option}: {error}");
        assert!(error.contains(option.split('=').next().unwrap()) && error.contains("must be"), "{error}");
    }
    let twice = SMALL.to_owned()
        + "[[body]]\nmaterial = \"sand\"\nshape = { box = { half = [0.05, 0.05, 0.05], center = [0.05, 0.05, 0.05] } }\n";
    fs::write(here.join("twice.toml"), twice).unwrap();
    let error = fail(here, &["check", "twice.toml"]);
    assert!(error.contains("twice.toml:") && error.contains("body[1].shape: is exactly where body[0] is"), "{error}");
    // The limits themselves are allowed, however they are rounded.
    for (cell, spacing) in
        [("0.001", "0.0002"), ("0.03", "0.006"), ("0.007", "0.0014"), ("0.3", "0.06"), ("0.1", "0.1")]
    {
        let max = format!("world.max=[{0}, {0}, {0}]", 40.0 * cell.parse::<f64>().unwrap());
        let sets = [format!("world.cell={cell}"), max, format!("body[0].spacing={spacing}")];
        let side = cell.parse::<f64>().unwrap();
        let body = format!("body[0].shape.box.max=[{side}, {side}, {side}]");
        let tool = "tool=[]".to_owned();
        let step = "time.step=1e-9".to_owned();
        let sets: Vec<String> = sets.into_iter().chain([body, tool, step]).collect();
        let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
        succeed(here, &[&["check", "small.toml"], &sets[..]].concat());
    }
    fs::write(here.join("bad.toml"), SMALL.replace("density = 1600.0", "density = -1.0")).unwrap();
    let line = SMALL.lines().position(|line| line.starts_with("density")).unwrap() + 1;
    let error = fail(here, &["check", "bad.toml"]);
    assert!(error.contains(&format!("bad.toml:{line}: material[0].density")), "{error}");
}

/// Whoever reads only the first lines, as `head` does, closes the pipe: that is no error.
#[test]
fn nobody_has_to_read_all_that_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    for arguments in [&["schema"][..], &["plugins", "--json"], &["plan", "letters"]] {
        let mut command = barchan(folder.path());
        let mut child = command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let Output { status, stderr, .. } = child.wait_with_output().unwrap();
        assert!(status.success() && stderr.is_empty(), "{arguments:?}: {}", String::from_utf8_lossy(&stderr));
    }
}

#[test]
fn plans_plugins_and_the_schema_are_printed() {
    let folder = folder_with_scene();
    let plan = succeed(folder.path(), &["plan", "small.toml"]);
    assert!(plan.contains("material sand") && plan.contains("contact with tool rod"), "{plan}");
    assert!(succeed(folder.path(), &["check", "small.toml"]).starts_with("small: ok, "));
    let plugins: serde_json::Value = serde_json::from_str(&succeed(folder.path(), &["plugins", "--json"])).unwrap();
    assert!(plugins["materials"].as_array().unwrap().iter().any(|m| m["name"] == "sand"));
    let schema: serde_json::Value = serde_json::from_str(&succeed(folder.path(), &["schema"])).unwrap();
    assert!(schema["properties"]["world"].is_object());
}

#[test]
fn the_scenes_in_the_readme_run() {
    let folder = tempfile::tempdir().unwrap();
    let readme = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md")).unwrap();
    let scenes: Vec<&str> = readme.split("```toml\n").skip(1).filter_map(|rest| rest.split("```").next()).collect();
    assert_eq!(scenes.len(), 2, "{scenes:?}");
    for (scene, file) in scenes.into_iter().zip(["press.toml", "dog.toml"]) {
        fs::write(folder.path().join(file), scene).unwrap();
        succeed(folder.path(), &["run", file, "--steps", "20", "--quiet"]);
    }
}

/// Commands of the command line.
const COMMANDS: [&str; 13] = [
    "run",
    "plan",
    "check",
    "conform",
    "plugins",
    "adapters",
    "robot",
    "gallery",
    "task",
    "bench",
    "schema",
    "completions",
    "man",
];

#[test]
fn completions_name_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let help = succeed(folder.path(), &["--help"]);
    let listed: Vec<&str> = help.split("Commands:").nth(1).expect("a list of commands").split("Options:").collect();
    let listed = listed[0].lines().filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help");
    assert_eq!(listed.collect::<Vec<_>>(), COMMANDS);
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = succeed(folder.path(), &["completions", shell]);
        for word in COMMANDS.iter().chain(&["throughput", "swap-at", "barchan"]) {
            assert!(script.contains(word), "{shell} is not told of {word}");
        }
    }
    // And bash takes what it is given.
    fs::write(folder.path().join("barchan.bash"), succeed(folder.path(), &["completions", "bash"])).unwrap();
    let ask =
        "source barchan.bash; COMP_WORDS=(barchan ru); COMP_CWORD=1; _barchan barchan ru barchan; echo ${COMPREPLY[@]}";
    let reply = Command::new("bash").args(["-c", ask]).current_dir(folder.path()).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&reply.stdout).trim(), "run", "{}", String::from_utf8_lossy(&reply.stderr));
    let unknown = run(folder.path(), &["completions", "abacus"]);
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("bash, elvish, fish, powershell, zsh"));
}

#[test]
fn the_manual_names_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let page = succeed(folder.path(), &["man"]);
    assert!(page.contains(".TH barchan 1"), "{page}");
    succeed(folder.path(), &["man", "--out", "man1"]);
    for command in COMMANDS {
        assert!(page.contains(&format!("barchan\\-{command}(1)")), "the page does not name {command}: {page}");
        let own = fs::read_to_string(folder.path().join(format!("man1/barchan-{command}.1"))).unwrap();
        assert!(own.contains(&format!(".TH barchan-{command} 1")), "{own}");
    }
    let run = fs::read_to_string(folder.path().join("man1/barchan-run.1")).unwrap();
    assert!(run.contains("\\-\\-swap\\-at"), "{run}");
    fs::write(folder.path().join("file"), "").unwrap();
    let error = fail(folder.path(), &["man", "--out", "file"]);
    assert!(error.contains("file") && error.contains("choose another with --out"), "{error}");
}

/// What only another crate's command line has (tests/seams/cli, which runs this scene) is refused by name.
#[test]
fn plugins_of_other_crates_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/seams/cli/current.toml");
    let scene = scene.to_str().unwrap();
    for command in ["plan", "check", "run"] {
        let error = fail(folder.path(), &[command, scene]);
        assert!(error.contains("coupling[0].kind: no coupling is called 'current'; known are: rigid"), "{error}");
        let error = fail(folder.path(), &[command, scene, "--set", "coupling=[]", "--backend", "dust"]);
        assert!(error.contains("no backend is called 'dust'; known are: cpu, wgpu"), "{error}");
    }
}

#[test]
fn throughput_is_measured() {
    let folder = tempfile::tempdir().unwrap();
    let args =
        ["bench", "throughput", "--grid", "32", "--steps", "2", "--repetitions", "2", "--warm-up", "1", "--json"];
    let figures: serde_json::Value = serde_json::from_str(&succeed(folder.path(), &args)).unwrap();
    assert_eq!(figures["particles"], 16_810);
    assert!(figures["particle_steps_per_s"].as_f64().unwrap() > 1e3);
}

/// Every law on every backend that there is, or on one of them.
#[test]
fn throughput_of_all_laws_is_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let all = ["bench", "throughput", "--all", "--grid", "32", "--side", "0.16", "--steps", "1", "--repetitions", "1"];
    let text = succeed(folder.path(), &[&all[..], &["--json"]].concat());
    let figures: serde_json::Value = serde_json::from_str(&text).unwrap();
    let plugins: serde_json::Value = serde_json::from_str(&succeed(folder.path(), &["plugins", "--json"])).unwrap();
    let names = |kind: &str| -> Vec<&str> {
        plugins[kind].as_array().unwrap().iter().map(|plugin| plugin["name"].as_str().unwrap()).collect()
    };
    let entries = figures["throughput"].as_array().unwrap();
    assert_eq!(entries.len(), 2 * names("materials").len() * names("backends").len(), "{text}");
    for law in names("materials") {
        for backend in names("backends") {
            for ground in ["resting", "moving"] {
                let found =
                    entries.iter().find(|e| e["law"] == law && e["backend"] == backend && e["ground"] == ground);
                let entry = found.unwrap_or_else(|| panic!("{law} on {backend}, {ground}, is not in {text}"));
                assert!(entry["particle_steps_per_s"].as_f64().is_some_and(|rate| rate > 1e2), "{entry}");
                assert!(entry["particles"].as_u64().is_some_and(|count| count > 100), "{entry}");
            }
        }
    }
    let isa = figures["isa"].as_str().unwrap();
    assert!(["baseline", "avx2", "avx512"].contains(&isa), "{isa}");

    let one = [&all[..], &["--backend", "cpu", "--ground", "resting"]].concat();
    let table = succeed(folder.path(), &one);
    assert!(table.contains("cpu, resting") && !table.contains("moving") && !table.contains("wgpu"), "{table}");
    assert!(table.lines().any(|line| line.starts_with("| neo_hookean ")), "{table}");
    let error = fail(folder.path(), &["bench", "throughput", "--all", "--backend", "abacus"]);
    assert!(error.contains("no backend is called 'abacus'"), "{error}");
}

/// Symptom: pictures of tall and narrow ground, whose scale bar is a few pixels wide, ended the run with a panic.
#[test]
fn narrow_ground_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    for (world, body) in [
        ("0.04, 0.04, 1.0", "0.04, 0.04, 0.8"),
        ("0.04, 0.04, 1.0", "0.02, 0.02, 0.4"),
        ("0.1, 0.1, 0.2", "0.02, 0.02, 0.02"),
    ] {
        let text =
            SMALL.replace("[0.1, 0.1, 0.2]", &format!("[{world}]")).replace("[0.1, 0.1, 0.1]", &format!("[{body}]"));
        fs::write(folder.path().join("narrow.toml"), text).unwrap();
        succeed(folder.path(), &["run", "narrow.toml", "--steps", "1", "--out", "out", "--overwrite"]);
        let picture = fs::read(folder.path().join("out/frames/00000.png")).unwrap();
        assert!(picture.starts_with(b"\x89PNG"), "[{body}]: no picture");
    }
}

/// What no benchmark can be made of is refused before anything runs, and the message names what can.
#[test]
fn benchmarks_that_cannot_be_are_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |args: &str, says: &[&str]| {
        let args: Vec<&str> = ["bench"].into_iter().chain(args.split(' ')).collect();
        let output = run(folder.path(), &args);
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "{args:?} did not fail");
        says.iter().for_each(|part| assert!(error.contains(part), "{args:?}: no '{part}' in {error}"));
    };
    refused("effects --grid 33", &["33", "32, 64, 128, 256"]);
    refused("throughput --grid 33", &["33", "32, 64, 128, 256, 512"]);
    refused("throughput --steps 0", &["--steps", "1.."]);
    refused("scale --repetitions 0", &["--repetitions", "1.."]);
    refused("accuracy --ladder 0", &["--ladder", "1.."]);
    // No rung of this ladder can be, so that the reference is not worth its time.
    refused(
        "accuracy --ladder 7 --no-variants --half 7 --out none",
        &["n 7: world.max", "5.25", "must lie on a cell's face"],
    );
    assert!(!folder.path().join("none").exists());
}

/// A tiny ladder of a falling cube: errors are finite and fall with the cell, a nested run lies near its finest cell's uniform
/// grid, and what cannot be run is a line of the table.
#[test]
fn the_accuracy_ladder_falls_and_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        &[
            "bench",
            "accuracy",
            "--reference",
            "64",
            "--ladder",
            "8,16,32",
            "--levels",
            "2",
            "--half",
            "8",
            "--fine",
            "64",
        ][..],
        &["--no-variants", "--seconds", "0.15", "--out", "ladder"],
    ];
    let text = succeed(folder.path(), &args.concat());
    assert!(text.contains("n 8: skipped") && text.contains("particles along z"), "{text}");
    let out = folder.path().join("ladder");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(out.join("accuracy.json")).unwrap()).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let of = |label: &str| rows.iter().find(|row| row["label"] == label).unwrap_or_else(|| panic!("no row '{label}'"));
    let number = |row: &serde_json::Value, path: &str| {
        let value = row.pointer(path).and_then(serde_json::Value::as_f64);
        value.unwrap_or_else(|| panic!("{}: {path} is not a finite number", row["label"]))
    };
    for path in ["/errors/height_near/mean_mm", "/errors/z_rms_mm", "/errors/force_rms_n"] {
        let [coarse, fine, nested] = ["n 16", "n 32", "L2 k8"].map(|label| number(of(label), path));
        assert!(coarse > fine && fine > nested && nested >= 0.0, "{path}: {coarse}, {fine}, nested {nested}");
    }
    for label in ["n 16", "n 32", "L2 k8"] {
        let mass = number(of(label), "/cost/mass_kg") / number(&report["reference"], "/cost/mass_kg");
        assert!((mass - 1.0).abs() < 1e-6, "{label} has {mass} of the reference's mass");
        assert!(number(of(label), "/errors/chamfer_near/to_reference/mean_mm") < 20.0);
    }
    assert_eq!(number(&report["reference"], "/errors/height/max_mm"), 0.0);
    let table = fs::read_to_string(out.join("accuracy.md")).unwrap();
    for part in ["## Cost", "height near, mean error [mm]", "## Time to reach the same error", "UBSoft", "| L2 k8 |"] {
        assert!(table.contains(part), "'{part}' is not in\n{table}");
    }
    for stem in ["height-time", "height-memory", "chamfer-time", "force-memory"] {
        let png = fs::read(out.join(stem).with_extension("png")).unwrap();
        assert!(png.starts_with(b"\x89PNG") && png.len() > 2000, "{stem}.png");
        assert!(fs::read_to_string(out.join(stem).with_extension("svg")).unwrap().ends_with("</svg>\n"), "{stem}.svg");
    }
}

#[test]
fn growing_ground_is_measured_until_the_cap() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        &["bench", "scale", "--cells", "16", "--extents", "1,2,4", "--levels", "2", "--half", "8", "--cap", "40000"][..],
        &["--steps", "2", "--repetitions", "1", "--warm-up", "1", "--out", "scale"],
    ];
    let text = succeed(folder.path(), &args.concat());
    assert!(text.contains("uniform grid, 4 m: 131072 particles, skipped"), "{text}");
    assert!(text.contains("2 levels at 2 m take"), "{text}");
    let out = folder.path().join("scale");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(out.join("scale.json")).unwrap()).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let particles = |levels: u32, extent: f64| {
        let row = rows.iter().find(|row| row["levels"] == levels && row["extent_m"] == extent).unwrap();
        assert!(row["ms_per_step"].is_f64() && row["memory_bytes"].is_u64(), "{row}");
        row["particles"].as_u64().unwrap()
    };
    assert!(particles(2, 2.0) < particles(1, 2.0) / 2);
    assert!(particles(2, 4.0) < 40_000);
    for file in ["scale.md", "scale-time.png", "scale-time.svg", "scale-memory.png", "scale-memory.svg"] {
        assert!(fs::metadata(out.join(file)).unwrap().len() > 500, "{file} is empty");
    }
}

/// The second half of the run is another number format's: the same files as any run, a trace without a gap, and a body where the run
/// without a swap has it.
#[test]
fn a_swap_in_the_middle_leaves_one_run() {
    let folder = folder_with_scene();
    succeed(folder.path(), &["run", "small.toml", "--out", "whole", "--quiet", "--steps", "80", "--precision", "f64"]);
    let swap = ["run", "small.toml", "--out", "swapped", "--quiet", "--swap-at", "50:cpu:f64"];
    succeed(folder.path(), &[&swap[..], &["--steps", "60"]].concat());
    // Past the swap, the snapshot is the second backend's.
    succeed(folder.path(), &[&swap[..], &["--steps", "80", "--resume"]].concat());
    let last = |out: &str| -> Vec<f64> {
        let trace = fs::read_to_string(folder.path().join(out).join("trace.csv")).unwrap();
        assert_eq!(trace.lines().count(), 1 + 80, "{out}");
        trace.lines().last().unwrap().split(',').map(|number| number.parse().unwrap()).collect()
    };
    let (whole, swapped) = (last("whole"), last("swapped"));
    assert_eq!(whole[..6], swapped[..6], "time, step and the driven rod's place");
    let force = |row: &[f64]| row[16..19].iter().map(|f| f * f).sum::<f64>().sqrt();
    assert!((force(&whole) / force(&swapped) - 1.0).abs() < 0.01, "{whole:?}\n{swapped:?}");
    let summary = |out: &str| fs::read_to_string(folder.path().join(out).join("summary.json")).unwrap();
    assert!(summary("swapped").contains("\"precision\": \"f64\""));

    // A GPU takes over, by the name of its adapter's number, which the CPU before it is not asked about.
    let gpu =
        ["run", "small.toml", "--out", "gpu", "--quiet", "--steps", "80", "--swap-at", "50:wgpu", "--adapter", "0"];
    succeed(folder.path(), &gpu);
    let swapped = last("gpu");
    assert_eq!(whole[..6], swapped[..6], "time, step and the driven rod's place");
    assert!((force(&whole) / force(&swapped) - 1.0).abs() < 0.01, "{whole:?}\n{swapped:?}");
    let error = fail(folder.path(), &["run", "small.toml", "--swap-at", "50:wgpu:f64", "--quiet"]);
    assert!(error.contains("has no 64-bit floats"), "{error}");

    let error = fail(folder.path(), &["run", "small.toml", "--swap-at", "50:abacus", "--quiet"]);
    assert!(error.contains("no backend is called 'abacus'"), "{error}");
    assert!(!folder.path().join("out").exists(), "refused before the first step");
}

#[test]
fn adapters_are_listed_and_refused_where_there_are_none() {
    let folder = folder_with_scene();
    let text = succeed(folder.path(), &["adapters"]);
    assert!(text.starts_with("wgpu\n  0  "), "{text}");
    let unknown = fail(folder.path(), &["run", "small.toml", "--backend", "wgpu", "--adapter", "abacus", "--quiet"]);
    assert!(unknown.contains("--adapter: no adapter is called 'abacus'; known are: 0: "), "{unknown}");
    let error = fail(folder.path(), &["run", "small.toml", "--adapter", "0", "--quiet"]);
    assert!(error.contains("backend 'cpu'") && error.contains("has no adapters"), "{error}");
}

/// Output that a run would refuse is refused by `check` and `plan`, too.
#[test]
fn a_scene_is_checked_with_what_it_writes() {
    let folder = folder_with_scene();
    for (set, told) in [
        ("output.trace.columns=[\"nothing\"]", "output.trace.columns"),
        ("output.export_fields=[\"bogus\"]", "output.export_fields"),
    ] {
        for command in ["check", "plan", "run"] {
            let error = fail(folder.path(), &[command, "small.toml", "--set", set, "--set", "output.export='npz'"]);
            assert!(error.contains(told) && error.contains("rod") | error.contains("position"), "{command}: {error}");
        }
    }
    succeed(folder.path(), &["check", "small.toml", "--set", "output.trace.columns=[\"rod*\"]"]);
    let error = fail(folder.path(), &["check", "small.toml", "--set", "name=\"a\\u001b[31m\""]);
    assert!(!error.contains('\u{1b}') && error.contains("control characters"), "{error:?}");
}

/// A misspelt instruction set was passed over in silence, and the run took another one. Now it is refused, and the plan says which it is.
#[test]
fn an_instruction_set_is_taken_or_refused() {
    let folder = folder_with_scene();
    let with = |isa: &str, args: &[&str]| barchan(folder.path()).env("BARCHAN_ISA", isa).args(args).output().unwrap();
    let plan = with("baseline", &["plan", "small.toml"]);
    let text = String::from_utf8(plan.stdout).unwrap();
    assert!(plan.status.success() && text.contains("isa       baseline, by BARCHAN_ISA one of baseline"), "{text}");
    let all = ["bench", "throughput", "--all", "--grid", "32"];
    for args in [&["plan", "small.toml"] as &[&str], &["check", "small.toml"], &["run", "small.toml"], &all] {
        let refused = with("avx1024", args);
        let error = String::from_utf8(refused.stderr).unwrap();
        assert_eq!(refused.status.code(), Some(1), "{args:?}");
        assert!(error.contains("BARCHAN_ISA: instruction set 'avx1024'") && error.contains("baseline"), "{error}");
    }
}
