//! `barchan bench accuracy`: what resolution buys, as errors against the finest uniform grid.
//!
//! All runs have one extent, one mass and one duration. The ladder of uniform grids is the yardstick: a run with nested levels is
//! worth as much as the uniform grid would take for the same error.

mod pareto;
mod write;

use crate::EngineArgs;
use crate::print::show;
use crate::run::Shown;
use barchan::accuracy::{Balance, Cost, Errors, Record, record, rung};
use barchan::scene::{Levels, Sampling};
use barchan::{Error, Precision, Registry, Result, Scene};
use clap::Args;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The cube drop's bed is as large for every number of levels: 0.96 m are 96 cells at n = 128, whole for up to 6 levels.
const CUBE_DROP: [&str; 3] = [
    "world.max=[0.96, 0.96, 0.8]",
    "body.bed.shape.box={ min = [0.0, 0.0, 0.0], max = [0.96, 0.96, 0.2] }",
    "tool.cube.position=[0.48, 0.48, 0.262]",
];
/// Share of its duration that each rung is run for before it is timed, so that the processor and the memory are warm.
const WARM_UP: f64 = 0.02;
/// The cube drop's n counts cells along this length, as in UBSoft's Table 1 [m].
const CUBE_DROP_LENGTH: f64 = 1.28;

#[derive(Args)]
pub(crate) struct Accuracy {
    /// A built-in scene or a TOML file.
    #[arg(default_value = "cube-drop")]
    scene: String,
    /// Changes a key of the scene on all rungs; may be given again.
    #[arg(long, value_name = "KEY.PATH=VALUE")]
    set: Vec<String>,
    /// Cells of the reference along the world's x (cube-drop: along 1.28 m).
    #[arg(long, default_value_t = 128, value_parser = super::at_least_one())]
    reference: u32,
    /// Cells of the uniform grids, likewise.
    #[arg(long, value_delimiter = ',', default_values_t = [16, 32, 64], value_parser = super::at_least_one())]
    ladder: Vec<u32>,
    /// Numbers of levels.
    #[arg(long, value_delimiter = ',', default_values_t = [2, 3])]
    levels: Vec<u32>,
    /// levels.half of the nested runs.
    #[arg(long, value_delimiter = ',', default_values_t = [8, 12, 16])]
    half: Vec<u32>,
    /// Whether nested runs subcycle: false, true, or both.
    #[arg(long, value_delimiter = ',', action = clap::ArgAction::Append, default_values_t = [false, true])]
    subcycle: Vec<bool>,
    /// Cells of the nested runs' finest level, likewise [default: the reference's, and the last of the ladder].
    #[arg(long, value_delimiter = ',', value_parser = super::at_least_one())]
    fine: Vec<u32>,
    /// Leave out other particle spacings, precisions and merge tolerances.
    #[arg(long)]
    no_variants: bool,
    /// Run the reference again with its particles moved at random in their lattice: differences below its errors mean nothing.
    #[arg(long)]
    noise: bool,
    /// Random starts of --noise, of whose errors the mean and the standard deviation are given.
    #[arg(long, default_value_t = 1, requires = "noise", value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// Simulated time [s] instead of the scene's.
    #[arg(long)]
    seconds: Option<f64>,
    /// Timed runs of each rung, of which the median wall time counts; a short one that is not timed goes before them.
    #[arg(long, default_value_t = 1, value_parser = super::at_least_one())]
    repetitions: u32,
    /// Backend of the reference and of --noise, such as one that can afford a finer grid [default: that of all runs].
    #[arg(long, value_name = "BACKEND")]
    reference_backend: Option<String>,
    /// Output folder [default: ./out/accuracy/<scene>].
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    engine: EngineArgs,
}

/// A run of the ladder.
#[derive(Clone, Debug, Serialize)]
struct Entry {
    label: String,
    /// Cells along the length, on the finest level.
    n: u32,
    cell_m: f64,
    levels: u32,
    half: u32,
    subcycle: bool,
    tolerance: f64,
    backend: String,
    /// Distance between particles in cells; absent: as the scene has it.
    spacing_cells: Option<f64>,
    precision: Precision,
    /// Seed of a start with grains moved at random in their lattice; absent: on the lattice.
    seed: Option<u64>,
}

/// What came out of it.
#[derive(Clone, Debug, Serialize)]
struct Row {
    #[serde(flatten)]
    entry: Entry,
    /// Why there are no figures.
    skipped: Option<String>,
    #[serde(flatten)]
    figures: Option<Figures>,
}

#[derive(Clone, Debug, Serialize)]
struct Figures {
    cost: Cost,
    /// Wall seconds of all repetitions.
    wall_all_s: Vec<f64>,
    /// From their first quartile to the third.
    wall_iqr_s: f64,
    balance: Balance,
    errors: Errors,
    /// Side of the smallest particle [m].
    spacing_m: f64,
    /// What the plan warned of.
    warnings: Vec<String>,
    /// Everything clamped, floored or lost; should be empty but for what describes the material.
    counts: BTreeMap<String, u64>,
    deleted_mass_kg: f64,
}

/// Everything that is written.
#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    scene: String,
    seconds: f64,
    /// Length along which n counts cells [m].
    length_m: f64,
    backend: String,
    /// Worker threads; 0: as many as the machine has.
    threads: usize,
    cores: usize,
    near_m: f64,
    /// The uniform run that all others are held against; its own errors are 0.
    reference: Row,
    rows: Vec<Row>,
}

pub(crate) fn run(args: &Accuracy, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    let (scene, length) = base(args)?;
    let entries = entries(args, length);
    // The reference takes longest: no rung to hold against it is a mistake of the command line.
    let refused: Vec<Error> = entries.iter().filter_map(|entry| on_rung(&scene, entry).err()).collect();
    if refused.len() == entries.len()
        && let Some(error) = refused.into_iter().next()
    {
        return Err(match error {
            Error::Scene { line, path, what, allowed, .. } => {
                Error::Scene { file: entries[0].label.clone(), line, path, what, allowed }
            }
            other => other,
        });
    }
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("out/accuracy").join(&scene.name));
    show(format!(
        "{}: {} runs of {} s and a reference of n = {}\n",
        scene.name,
        entries.len(),
        scene.time.end,
        args.reference
    ));
    let entry = Entry { label: format!("reference n {}", args.reference), ..finest(args, length) };
    let (reference, walls) = measure(args, &registry, &scene, &entry)?;
    let row = |entry: Entry, run: &Record, walls: Vec<f64>| {
        let cost = Cost { wall_s: super::median(&walls), ..run.cost.clone() };
        let errors = Errors::of(run, &reference);
        let ledger = &run.ledger_end;
        let (counts, deleted_mass_kg) = (ledger.counts.clone(), ledger.deleted_mass);
        let spacing_m = run.start.iter().fold(f64::INFINITY, |least, grain| least.min(grain.side.into()));
        let wall_iqr_s = super::quartiles_apart(&walls);
        let (balance, warnings) = (run.balance(), run.warnings.clone());
        let figures = Figures {
            cost,
            wall_all_s: walls,
            wall_iqr_s,
            balance,
            errors,
            spacing_m,
            warnings,
            counts,
            deleted_mass_kg,
        };
        Row { entry, skipped: None, figures: Some(figures) }
    };
    let mut report = Report {
        version: env!("CARGO_PKG_VERSION"),
        scene: scene.name.clone(),
        seconds: scene.time.end,
        length_m: length,
        backend: args.engine.backend().to_owned(),
        threads: args.engine.threads,
        cores: std::thread::available_parallelism().map_or(0, Into::into),
        near_m: barchan::accuracy::NEAR,
        reference: row(entry, &reference, walls),
        rows: Vec::new(),
    };
    show(format!("  {}\n", write::line(&report.reference)));
    for entry in entries {
        let next = match measure(args, &registry, &scene, &entry) {
            Ok((run, walls)) => row(entry, &run, walls),
            // What cannot be run is a line of the table; the others are worth having all the same.
            Err(error) => Row { entry, skipped: Some(error.to_string()), figures: None },
        };
        show(format!("  {}\n", write::line(&next)));
        report.rows.push(next);
        // After every run, so that a ladder that is broken off leaves what it has.
        write::all(&report, &out)?;
    }
    show(format!("\n{}\n", write::markdown(&report)));
    show(format!("output in {}\n", out.display()));
    Ok(())
}

/// The scene that all rungs start from, and the length along which n counts cells [m].
fn base(args: &Accuracy) -> Result<(Scene, f64)> {
    let equal_extent = CUBE_DROP.into_iter().filter(|_| args.scene == "cube-drop").map(str::to_owned);
    let set: Vec<String> = equal_extent.chain(args.set.iter().cloned()).collect();
    let mut scene = crate::scene(&args.scene, &set)?;
    scene.time.end = args.seconds.unwrap_or(scene.time.end);
    let length = if args.scene == "cube-drop" { CUBE_DROP_LENGTH } else { scene.world.max[0] - scene.world.min[0] };
    Ok((scene, length))
}

fn uniform(args: &Accuracy, length: f64, n: u32) -> Entry {
    let Levels { half, tolerance, .. } = Levels::default();
    Entry {
        label: format!("n {n}"),
        n,
        cell_m: length / f64::from(n),
        levels: 1,
        half,
        subcycle: false,
        tolerance,
        backend: args.engine.backend().to_owned(),
        spacing_cells: None,
        precision: args.engine.precision,
        seed: None,
    }
}

/// The reference's grid, on its backend.
fn finest(args: &Accuracy, length: f64) -> Entry {
    let backend = args.reference_backend.as_deref().unwrap_or(args.engine.backend()).to_owned();
    Entry { backend, ..uniform(args, length, args.reference) }
}

/// 1. Uniform grids.
/// 2. Nested levels: every finest cell with every count and half, with and without subcycling.
/// 3. Variants of the last uniform and the first nested run: other spacing, precision, merge tolerance.
fn entries(args: &Accuracy, length: f64) -> Vec<Entry> {
    let mut entries: Vec<Entry> = args.ladder.iter().map(|n| uniform(args, length, *n)).collect();
    let default = std::iter::once(args.reference).chain(args.ladder.last().copied()).collect();
    let fine = if args.fine.is_empty() { default } else { args.fine.clone() };
    for n in fine {
        let finest = uniform(args, length, n);
        let end = if n == args.reference { String::new() } else { format!(" n {n}") };
        for &subcycle in &args.subcycle {
            for &levels in &args.levels {
                for &half in &args.half {
                    let label = format!("L{levels} k{half}{}{end}", if subcycle { " sub" } else { "" });
                    entries.push(Entry { label, levels, half, subcycle, ..finest.clone() });
                }
            }
        }
    }
    if !args.no_variants {
        let last = args.ladder.last().map(|n| uniform(args, length, *n));
        let nested = entries.iter().find(|entry| entry.levels > 1).cloned();
        let other = if args.engine.precision == Precision::F32 { Precision::F64 } else { Precision::F32 };
        for base in [last, nested.clone()].into_iter().flatten() {
            let label = |what: &str| format!("{} {what}", base.label);
            entries.push(Entry { label: label("s 1/3"), spacing_cells: Some(1.0 / 3.0), ..base.clone() });
            entries.push(Entry { label: label(&other.to_string()), precision: other, ..base.clone() });
        }
        for tolerance in [0.0, 0.5] {
            let of = |base: Entry| Entry { label: format!("{} tol {tolerance}", base.label), tolerance, ..base };
            entries.extend(nested.clone().map(of));
        }
    }
    if args.noise {
        let strewn = |seed: u64| {
            let label = format!("n {} jitter {seed}", args.reference);
            Entry { label, seed: Some(seed), ..finest(args, length) }
        };
        entries.extend((1..=args.seeds).map(strewn));
    }
    entries
}

/// The scene that an entry runs.
fn on_rung(scene: &Scene, entry: &Entry) -> Result<Scene> {
    let levels = Levels {
        count: entry.levels,
        half: entry.half,
        subcycle: entry.subcycle,
        tolerance: entry.tolerance,
        agents: scene.levels.agents.clone(),
        boxes: scene.levels.boxes.clone(),
        reach: scene.levels.reach,
    };
    let mut scene = rung(scene, entry.cell_m, &levels, entry.spacing_cells)?;
    if let Some(seed) = entry.seed {
        scene.seed = seed;
        scene.body.iter_mut().for_each(|body| body.sampling = Sampling::Jitter);
    }
    Ok(scene)
}

/// Runs an entry for a moment, then as often as asked: the last record, and the wall seconds of all.
fn measure(args: &Accuracy, registry: &Registry, scene: &Scene, entry: &Entry) -> Result<(Record, Vec<f64>)> {
    let options = crate::moved(args.engine.options(), &entry.backend);
    let options = barchan::Options { precision: entry.precision, ..options };
    let scene = on_rung(scene, entry)?;
    let one = |scene: &Scene, quiet: bool| -> Result<Record> {
        let mut shown = Shown::new(quiet);
        let run = record(registry, scene, &options, &mut |progress| shown.update(progress));
        shown.finish();
        run
    };
    let mut warm_up = scene.clone();
    warm_up.time.end *= WARM_UP;
    one(&warm_up, true)?;
    let mut run = one(&scene, false)?;
    let mut walls = vec![run.cost.wall_s];
    for _ in 1..args.repetitions {
        run = one(&scene, false)?;
        walls.push(run.cost.wall_s);
    }
    Ok((run, walls))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Alone {
        #[command(flatten)]
        args: Accuracy,
    }

    /// Every uniform or nested run of the default ladder of the cube drop can be put together on its rung with equal mass.
    #[test]
    fn the_default_ladder_is_one_scene_on_many_rungs() {
        let args = Alone::parse_from(["accuracy", "--noise", "--seeds", "3"]).args;
        let (scene, length) = base(&args).unwrap();
        let entries = entries(&args, length);
        let labels: std::collections::BTreeSet<&str> = entries.iter().map(|entry| entry.label.as_str()).collect();
        assert_eq!(labels.len(), entries.len(), "two entries share a label");
        for entry in &entries {
            let levels = Levels { count: entry.levels, half: entry.half, ..Levels::default() };
            rung(&scene, entry.cell_m, &levels, entry.spacing_cells).unwrap_or_else(|e| panic!("{}: {e}", entry.label));
        }
    }
}
