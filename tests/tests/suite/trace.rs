//! What a run writes into `trace.csv`.

use barchan::run::{Existing, Request, Until, run};
use barchan::scene;
use barchan::{Options, Simulation};
use barchan_tests::scenes::scene;
use barchan_tests::stops::struck;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

/// Runs a scene with such a trace up to a time, from the start or from where the folder's run ended, and reads it: columns by name.
fn traced(backend: &str, trace: scene::Trace, out: &Path, until: Until) -> barchan::Result<BTreeMap<String, Vec<f64>>> {
    // A device tells walls not apart.
    let floor = if backend == "cpu" { "[[probe]]\nname = \"floor\"\nwall = { side = \"z_min\" }\n" } else { "" };
    let mut scene = scene(&(struck("neo_hookean") + floor));
    scene.output.trace = trace;
    let options = Options { threads: 1, backend: backend.to_owned(), ..Options::default() };
    let snapshot = out.join("snapshot.barchan");
    let (existing, mut simulation) = if snapshot.is_file() {
        (Existing::Resume, Simulation::resume(&barchan::registry(), &snapshot, &options)?)
    } else {
        (Existing::Refuse, Simulation::new(&barchan::registry(), &scene, &options)?)
    };
    let out = out.to_owned();
    let file = out.join("trace.csv");
    let request = Request { out, until, pictures: false, export: None, existing, swap: None };
    run(&mut simulation, &request, &mut |_| ControlFlow::Continue(()))?;
    let mut lines = csv_of(&std::fs::read_to_string(file).unwrap()).into_iter();
    let names = lines.next().expect("a trace has a header");
    let mut columns: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for line in lines {
        assert_eq!(line.len(), names.len(), "a row has other columns than the header");
        for (name, value) in names.iter().zip(line) {
            columns.entry(name.clone()).or_default().push(value.parse().unwrap_or(f64::NAN));
        }
    }
    Ok(columns)
}

fn csv_of(text: &str) -> Vec<Vec<String>> {
    text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect()
}

fn every(interval: f64, columns: Option<&[&str]>) -> scene::Trace {
    let columns = columns.map(|columns| columns.iter().map(|&column| column.to_owned()).collect());
    scene::Trace { interval: Some(interval), columns, ..scene::Trace::default() }
}

fn sum(values: impl Iterator<Item = f64>) -> f64 {
    values.sum()
}

/// Rows an interval apart hold what the tool felt in between: mean forces times the time between rows are the impulse that the rows of each step add up to. Mass stays,
/// and momentum is what the tool and the walls gave, less gravity's. So on each backend, where a device takes many steps at once.
#[test]
fn rows_an_interval_apart_hold_the_impulse_between_them() {
    for backend in ["cpu", "wgpu"] {
        let folder = tempfile::tempdir().unwrap();
        let (end, interval) = (0.06, 0.01);
        let each = traced(backend, scene::Trace::default(), &folder.path().join("each"), Until::Time(end)).unwrap();
        let some = traced(backend, every(interval, None), &folder.path().join("some"), Until::Time(end)).unwrap();
        let times = &some["time [s]"];
        assert_eq!(times.len(), 7, "{backend}: a row at the start, and one an interval: {times:?}");
        let longest = each["dt [s]"].iter().copied().fold(0.0, f64::max);
        for (n, time) in times.iter().enumerate() {
            let off = time - n as f64 * interval;
            assert!((-1e-9..longest).contains(&off), "{backend}: row {n} is at {time} s");
        }
        assert!(each.keys().all(|name| some.contains_key(name)));
        let tool = each.keys().find_map(|name| name.strip_suffix(" fz [N]")).expect("the scene has a tool").to_owned();
        let of_steps = sum(each[&format!("{tool} fz [N]")].iter().zip(&each["dt [s]"]).map(|(force, dt)| force * dt));
        let means = some[&format!("{tool} mean fz [N]")].iter().skip(1);
        let of_means = sum(means.zip(times.windows(2)).map(|(force, times)| force * (times[1] - times[0])));
        assert!(of_steps.abs() > 1e-3, "{backend}: nothing was felt");
        assert!((of_means - of_steps).abs() < 1e-6 * of_steps.abs(), "{backend}: {of_means} and {of_steps} N s");
        let mass = &some["mass [kg]"];
        assert!(mass.iter().all(|m| (m - mass[0]).abs() < 1e-9 * mass[0]) && mass[0] > 0.0);
        assert!(some["kinetic energy [J]"].iter().all(|e| e.is_finite()));
        if backend == "cpu" {
            // The scene has one wall: what the ground gives to it is what walls do not give.
            let [floor, walls] = ["floor impulse z [N s]", "wall impulse z [N s]"].map(|name| &some[name]);
            assert!(walls[6] > 1e-2, "the floor was not met: {walls:?} N s");
            assert!(
                floor.iter().zip(walls).all(|(a, b)| (a + b).abs() < 1e-9 * walls[6]),
                "{floor:?} and {walls:?} N s"
            );
        }
    }
}

/// A trace holds the columns that are asked for, and time and step.
#[test]
fn columns_are_chosen_by_patterns() {
    let folder = tempfile::tempdir().unwrap();
    let names = |trace, out: &str| {
        traced("cpu", trace, &folder.path().join(out), Until::Time(0.01)).map(|t| t.into_keys().collect::<Vec<_>>())
    };
    let chosen = names(every(0.005, Some(&["mass", "* mean f*", "p? [N s]"])), "wrong");
    let error = chosen.unwrap_err().to_string();
    assert!(
        error.contains("output.trace.columns") && error.contains("'p? [N s]'") && error.contains("px [N s]"),
        "{error}"
    );
    assert!(!folder.path().join("wrong").exists(), "what is refused leaves no folder");
    let chosen = names(every(0.005, Some(&["mass", "* mean f*", "pz [N s]"])), "right").unwrap();
    let tools = chosen.iter().filter(|name| name.contains("mean f")).count();
    assert!(tools >= 3 && chosen.len() == 3 + 2 + tools, "{chosen:?}");
}

/// A run that goes on writes the rows that it would have written, where it was cut at one of them.
#[test]
fn a_trace_goes_on_without_a_gap() {
    let folder = tempfile::tempdir().unwrap();
    let go = |out: &str, step: f64| {
        traced("cpu", every(0.01, None), &folder.path().join(out), Until::Step(step as u64)).unwrap()
    };
    let whole = go("whole", 40.0);
    // The step of a row.
    go("parts", whole["step"][2]);
    let parts = go("parts", 40.0);
    assert_eq!(whole["time [s]"].len(), parts["time [s]"].len());
    for (name, column) in &whole {
        for (a, b) in column.iter().zip(&parts[name]) {
            assert!(a == b || (a.is_nan() && b.is_nan()), "{name}: {a} and {b}");
        }
    }
}
