//! Speeds of two builds of `barchan`, run in turns: `cargo run --release -p barchan-tests --example in_turns -- OLD NEW`.
//!
//! Prints for every law, at rest and moving, and for the steps of two scenes, the median time of a step with either and the median of the rounds' ratios, new over old.
//! Options: `--rounds 9`, `--backend cpu` or `wgpu`, `--threads 2`, `--grid 64`, `--steps 100`.

use barchan_tests::arguments;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, ExitCode};

/// Scenes, and what is set in them so that a run takes seconds.
const SCENES: [(&str, &[&str]); 2] = [("cube-drop", &["time.end=0.2"]), ("letters", &["time.end=0.6"])];

/// Milliseconds a step by row.
type Times = BTreeMap<String, f64>;

fn main() -> ExitCode {
    arguments::run(run)
}

fn run(arguments: &[String]) -> Result<(), String> {
    let [old, new, rest @ ..] = arguments else {
        return Err("give two builds of barchan: in_turns OLD NEW [--rounds 9] [--backend cpu] [--threads 2] [--grid 64] [--steps 100]".into());
    };
    let mut options: BTreeMap<&str, &str> =
        [("--rounds", "9"), ("--backend", "cpu"), ("--threads", "2"), ("--grid", "64"), ("--steps", "100")].into();
    let known: Vec<&str> = options.keys().copied().collect();
    options.extend(arguments::options(rest, &known)?);
    let rounds: usize = options["--rounds"].parse().map_err(|_| "--rounds wants a whole number")?;
    let mut found: [BTreeMap<String, Vec<f64>>; 2] = Default::default();
    for round in 0..rounds {
        eprintln!("round {} of {rounds}", round + 1);
        // Who goes first changes, since a machine warms up.
        for which in if round % 2 == 0 { [0, 1] } else { [1, 0] } {
            for (row, time) in times([old, new][which], &options)? {
                found[which].entry(row).or_default().push(time);
            }
        }
    }
    println!("| row, {} | old [ms a step] | new | new over old |\n|---|---|---|---|", options["--backend"]);
    let mut worst = 0f64;
    for (row, before) in &found[0] {
        let Some(after) = found[1].get(row) else { continue };
        let ratio = median(before.iter().zip(after).map(|(before, after)| after / before));
        worst = worst.max(ratio);
        let [before, after] = [before, after].map(|times| median(times.iter().copied()));
        println!("| {row} | {before:.3} | {after:.3} | {ratio:.3} |");
    }
    println!("slowest row: {worst:.3} of the old time");
    Ok(())
}

/// One run of everything with a build.
fn times(barchan: &str, options: &BTreeMap<&str, &str>) -> Result<Times, String> {
    let mut all = Times::new();
    let (backend, threads) = (options["--backend"], options["--threads"]);
    let bench = ["bench", "throughput", "--all", "--json", "--repetitions", "1", "--warm-up", "20"];
    let mut command = Command::new(barchan);
    command.args(bench).args(["--backend", backend, "--threads", threads]);
    command.args(["--grid", options["--grid"], "--steps", options["--steps"]]);
    let table = json(&output(&mut command)?)?;
    for row in table["throughput"].as_array().into_iter().flatten() {
        let name = format!("{}, {}", row["law"].as_str().unwrap_or("?"), row["ground"].as_str().unwrap_or("?"));
        all.insert(name, row["ms_per_step"].as_f64().ok_or("a row of the table has no time")?);
    }
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    for (scene, changes) in SCENES {
        let out = folder.path().join(scene);
        let mut command = Command::new(barchan);
        command.args(["run", scene, "--backend", backend, "--threads", threads, "--out"]).arg(&out);
        for change in changes.iter().chain(&["output.picture.on=false"]) {
            command.args(["--set", change]);
        }
        output(&mut command)?;
        let summary = read(&out.join("summary.json"))?;
        let [wall, steps] = ["wall_steps", "steps"].map(|name| summary[name].as_f64().unwrap_or(f64::NAN));
        all.insert(format!("scene {scene}"), 1e3 * wall / steps);
    }
    Ok(all)
}

fn output(command: &mut Command) -> Result<String, String> {
    let done = command.output().map_err(|e| format!("{}: {e}", command.get_program().display()))?;
    if !done.status.success() {
        return Err(format!("{command:?} failed:\n{}", String::from_utf8_lossy(&done.stderr)));
    }
    Ok(String::from_utf8_lossy(&done.stdout).into_owned())
}

fn read(path: &Path) -> Result<Value, String> {
    json(&std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?)
}

fn json(text: &str) -> Result<Value, String> {
    serde_json::from_str(text).map_err(|e| format!("no JSON: {e}"))
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    if values.len() % 2 == 1 { values[middle] } else { 0.5 * (values[middle - 1] + values[middle]) }
}
