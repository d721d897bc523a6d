//! Runs a simulation with output into a folder: pictures, trace, summary, snapshots.
//!
//! | file | holds |
//! |---|---|
//! | `frames/00000.png`, … | a picture every `output.interval` |
//! | `contact-sheet.png`, `animation.gif` | the run at a glance |
//! | `particles/00000.ply`, … | particles every `output.interval`, if asked for |
//! | `surface/00000.ply`, … | the ground's surface as a mesh every `output.surface.interval`, if asked for |
//! | `height/00000.npz`, `.png`, … | the ground's height every `output.height_map.interval`, if asked for |
//! | `observed/NAME/…` | what the [observer](Observer) of that name writes |
//! | `trace.csv` | every step, or once an interval (`output.trace`): time, step size, pose, velocity and wrench of every body |
//! | `trace-since.json` | what has gone since the last row of a trace with an interval, when the snapshot was taken |
//! | `probes.csv` | what the scene's probes find, each at its own interval |
//! | `trace.npz` | the same as arrays, if `output.trace.npz` asks for it |
//! | `trace.parquet` | the same as a Parquet file, if `output.trace.parquet` asks for it and the feature `parquet` is on |
//! | `summary.json` | every figure of the run |
//! | `snapshot.barchan` | the state at the end, on interruption or before an error: the run continues from it bit for bit |
//! | `files.txt` | what the run has written: nothing else is ever removed or overwritten |
//!
//! Pictures are drawn and written while the run goes on; one that cannot be written ends it a few pictures later at most.
//!
//! All but the summary is written by observers, the run's own and those that it is [given](run_with).
//! Output never changes the physics: steps are those of a run without output (only the end is met exactly), and a picture
//! shows the first step at or past its time.

//!
//! ```
//! use barchan::run::{EffectTime, Existing, ProbeFigures, Progress, Request, Summary, Swap, Until, run};
//! use barchan::scene::{Probe, Region};
//! use barchan::{Options, Precision, Simulation};
//! use std::ops::ControlFlow;
//!
//! let registry = barchan::registry();
//! let mut scene = barchan::example();
//! let all = Region::Box { min: scene.world.min, max: scene.world.max };
//! scene.probe.push(Probe { name: "all".into(), within: Some(all), ..Probe::default() });
//! let mut simulation = Simulation::new(&registry, &scene, &Options::default())?;
//! let out = std::env::temp_dir().join(format!("barchan-run-{}", std::process::id()));
//! // In the middle, f64 takes over.
//! let options = Options { precision: Precision::F64, ..Options::default() };
//! let request = Request {
//!     out: out.clone(),
//!     until: Until::Step(6),
//!     pictures: false,
//!     export: None,
//!     existing: Existing::Overwrite,
//!     swap: Some(Swap { step: 3, registry, options }),
//! };
//! let mut watch = |progress: &Progress| {
//!     println!("{:.0} %", 100.0 * progress.done);
//!     ControlFlow::Continue(())
//! };
//! let summary: Summary = run(&mut simulation, &request, &mut watch)?;
//! assert_eq!((summary.step, summary.precision), (6, Precision::F64));
//! let effects: &[EffectTime] = &summary.effects;
//! assert!(effects.iter().any(|effect| effect.effect == "P2G"));
//! let mass: &ProbeFigures = &summary.probes["all"]["mass [kg]"];
//! assert!(mass.last > 0.0);
//! assert!(out.join("trace.csv").is_file());
//! # let _ = std::fs::remove_dir_all(out);
//! # Ok::<(), barchan::Error>(())
//! ```

mod folder;
#[cfg_attr(not(feature = "pictures"), path = "run/no_pictures.rs")]
mod pictures;
mod probes;
mod recorder;
mod trace;

pub use folder::{Existing, check as check_folder, last as last_folder, next as next_folder};
pub use recorder::check_output;

use barchan_core::scene::Export;
use barchan_core::{Error, Ledger, Observer, Options, Precision, Registry, Result, Simulation};
use folder::Folder;
use recorder::Recorder;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Name of the snapshot within an output folder.
pub const SNAPSHOT: &str = "snapshot.barchan";
const TRACE: &str = "trace.csv";
const PROBES: &str = "probes.csv";
const TRACE_SINCE: &str = "trace-since.json";
const TRACE_ARRAYS: &str = "trace.npz";
const TRACE_PARQUET: &str = "trace.parquet";
const SUMMARY: &str = "summary.json";
const CONTACT_SHEET: &str = "contact-sheet.png";
const ANIMATION: &str = "animation.gif";
const FRAMES: &str = "frames";
const PARTICLES: &str = "particles";
const SURFACE: &str = "surface";
const HEIGHT: &str = "height";

/// How far to run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Until {
    /// To a simulated time [s].
    Time(f64),
    /// To a step, counted from the scene's start.
    Step(u64),
}

/// What to run and where its output goes.
#[derive(Clone, Debug)]
pub struct Request {
    /// Folder for all output; made if it is missing.
    pub out: PathBuf,
    /// How far to run.
    pub until: Until,
    /// Whether pictures are made, if the scene asks for them.
    pub pictures: bool,
    /// Particle files; absent: as the scene says.
    pub export: Option<Export>,
    /// What becomes of a run that the folder holds.
    pub existing: Existing,
    /// Another backend that takes over in the middle.
    pub swap: Option<Swap>,
}

/// A backend that takes over from another; see [`Simulation::swap`].
#[derive(Clone, Debug)]
pub struct Swap {
    /// After this step, counted from the scene's start.
    pub step: u64,
    /// Where the backend is found.
    pub registry: Registry,
    /// The backend and the number format.
    pub options: Options,
}

/// Where a run stands.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Share done, 0 to 1.
    pub done: f64,
    /// Simulated time [s].
    pub time: f64,
    /// Steps taken since the scene's start.
    pub step: u64,
    /// The last step [s].
    pub dt: f64,
    /// Wall seconds since the run's start.
    pub elapsed: f64,
}

/// Share of an effect in a run's time.
#[derive(Clone, Debug, Serialize)]
pub struct EffectTime {
    /// Such as "P2G" or "material sand".
    pub effect: String,
    /// Wall seconds.
    pub seconds: f64,
    /// Share of the whole run, 0 to 1.
    pub share: f64,
    /// Passes run.
    pub passes: u64,
}

/// What a column of a probe held over time, since the scene's start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProbeFigures {
    /// Last value.
    pub last: f64,
    /// Mean of all values.
    pub mean: f64,
    /// Least value.
    pub least: f64,
    /// Greatest value.
    pub greatest: f64,
}

/// Every figure of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Version of Barchan.
    pub version: String,
    /// Name of the scene.
    pub scene: String,
    /// Number format.
    pub precision: Precision,
    /// The run was stopped before its end.
    pub interrupted: bool,
    /// What stopped it, if that was an error.
    pub error: Option<String>,
    /// Simulated time at the end [s].
    pub time: f64,
    /// Steps since the scene's start.
    pub step: u64,
    /// Simulated seconds of this run.
    pub simulated: f64,
    /// Steps of this run.
    pub steps: u64,
    /// Least, mean and greatest step of this run [s].
    pub dt: [f64; 3],
    /// Particles at the end.
    pub particles: usize,
    /// Particles moved by one step, summed over this run.
    pub particle_steps: u64,
    /// Wall seconds of this run, output included.
    pub wall: f64,
    /// Wall seconds of the steps alone.
    pub wall_steps: f64,
    /// Simulated seconds per wall second.
    pub real_time_factor: f64,
    /// Particle-steps per second of the steps alone.
    pub particle_steps_per_s: f64,
    /// Time by effect.
    pub effects: Vec<EffectTime>,
    /// Peak resident memory of the process [bytes], where the system tells.
    pub peak_memory: Option<u64>,
    /// Resident bytes of particles and of the grid.
    pub memory: (u64, u64),
    /// Totals at the start of this run.
    pub ledger_start: Ledger,
    /// Totals at its end.
    pub ledger_end: Ledger,
    /// What its probes found, by probe and column.
    pub probes: BTreeMap<String, BTreeMap<String, ProbeFigures>>,
    /// What the user should know.
    pub warnings: Vec<String>,
}

/// Runs a simulation and writes its output; `watch` is called after every step and may stop the run, which then ends as
/// if it had come so far only: everything is saved.
///
/// # Errors
/// If the output folder cannot be used or another run is writing into it, which is found out before the first step. If a step fails: what was
/// simulated until then is saved first. If the disk fills up: files written before stay. If the run ends before the step at which another
/// backend was to take over.
pub fn run(
    simulation: &mut Simulation,
    request: &Request,
    watch: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
) -> Result<Summary> {
    run_with(simulation, request, &mut [], watch)
}

/// As [`run`], with [observers](Observer) that look at the simulation at intervals of their own. What they write lies in `observed/NAME` in the run's folder, and
/// their columns stand last in the trace, headed `NAME COLUMN`; they are empty in rows of steps after which they have not looked.
///
/// # Errors
/// As [`run`], those of the observers, and [`Error::Body`] if one has no name for a folder, or no interval.
pub fn run_with(
    simulation: &mut Simulation,
    request: &Request,
    observers: &mut [&mut dyn Observer],
    watch: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
) -> Result<Summary> {
    let start = Instant::now();
    if let (Some(Swap { step, .. }), Until::Step(end)) = (&request.swap, request.until)
        && *step >= end
    {
        return Err(too_late(*step, end));
    }
    let mut recorder = Recorder::new(simulation, request, observers)?;
    let first = Start { time: simulation.time(), step: simulation.step_count(), ledger: simulation.ledger() };
    let mut tally = Tally::default();
    recorder.begin(simulation)?;
    let result = steps(simulation, request, &first, &mut recorder, &mut tally, start, watch);
    // An error of the physics leaves the state before the step: it is saved like any other end.
    let snapshot = recorder.files.borrow_mut().save(simulation);
    let interrupted = !matches!(result, Ok(true));
    let error = result.as_ref().err().map(ToString::to_string);
    let summary = summary(simulation, &mut recorder, (&first, &tally), interrupted, error, start);
    result?;
    snapshot?;
    let summary = summary?;
    match &request.swap {
        Some(Swap { step, .. }) if !interrupted && summary.step < *step => Err(too_late(*step, summary.step)),
        _ => Ok(summary),
    }
}

/// The error for a swap that never comes.
fn too_late(swap: u64, end: u64) -> Error {
    Error::Body {
        path: "--swap-at".to_owned(),
        what: format!("step {swap} never comes: the run ends at step {end}"),
        mend: "name an earlier step, or run further".to_owned(),
    }
}

/// Where a run began.
struct Start {
    time: f64,
    step: u64,
    ledger: Ledger,
}

/// Steps after which progress is shown at the latest. Not a time: sums of the ledger may be cut as submissions are, and a run is the same each time.
const MOST_STEPS: u64 = 128;

/// What is summed up step by step.
#[derive(Default)]
struct Tally {
    steps: u64,
    particle_steps: u64,
    wall: f64,
    least: Option<f64>,
    greatest: f64,
}

/// Steps to the end; `true` if it was reached, `false` if `watch` stopped it.
fn steps(
    simulation: &mut Simulation,
    request: &Request,
    first: &Start,
    recorder: &mut Recorder<'_>,
    tally: &mut Tally,
    start: Instant,
    watch: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
) -> Result<bool> {
    let done = |simulation: &Simulation| match request.until {
        Until::Time(end) if end > first.time => (simulation.time() - first.time) / (end - first.time),
        Until::Step(end) if end > first.step => {
            (simulation.step_count() - first.step) as f64 / (end - first.step) as f64
        }
        _ => 1.0,
    };
    // A run of so many steps takes those of the whole one.
    simulation.set_stop(match request.until {
        Until::Time(end) => end,
        Until::Step(_) => simulation.plan().scene.time.end,
    });
    // The trace may have a row for each step.
    let has_each = simulation.plan().scene.output.trace.interval.is_none();
    simulation.report_bodies(has_each);
    let mut progress = done(simulation);
    let mut swap = request.swap.as_ref();
    while progress < 1.0 {
        if let Some(Swap { registry, options, .. }) = swap.take_if(|swap| simulation.step_count() >= swap.step) {
            simulation.swap(registry, options)?;
        }
        let (before, from) = (Instant::now(), (simulation.time(), simulation.step_count()));
        // Nobody looks in before the next output, the swap or the end.
        let end = if let Until::Step(end) = request.until { end } else { u64::MAX };
        let end = swap.map_or(end, |swap| end.min(swap.step));
        let most = end.saturating_sub(from.1).min(if recorder.looks_always() { 1 } else { MOST_STEPS });
        let reports = simulation.steps(most as usize, recorder.next())?;
        tally.wall += before.elapsed().as_secs_f64();
        for report in &reports {
            tally.steps += 1;
            tally.particle_steps += simulation.particle_count() as u64;
            tally.least = Some(tally.least.map_or(report.dt, |least| least.min(report.dt)));
            tally.greatest = tally.greatest.max(report.dt);
        }
        recorder.stepped(simulation, from, &reports)?;
        progress = done(simulation);
        let Some(report) = reports.last() else { continue };
        let now = Progress {
            done: progress.min(1.0),
            time: simulation.time(),
            step: simulation.step_count(),
            dt: report.dt,
            elapsed: start.elapsed().as_secs_f64(),
        };
        if watch(&now).is_break() {
            return Ok(progress >= 1.0);
        }
    }
    Ok(true)
}

/// The figures of a run that has ended, written as the summary.
fn summary(
    simulation: &Simulation,
    recorder: &mut Recorder<'_>,
    (first, tally): (&Start, &Tally),
    interrupted: bool,
    error: Option<String>,
    start: Instant,
) -> Result<Summary> {
    // Asked before the animation, which is no part of the simulation.
    let peak_memory = peak_memory();
    // After an error, the rest is written all the same.
    match recorder.finish(simulation) {
        Err(e) if error.is_none() => return Err(e),
        _ => {}
    }
    let wall = start.elapsed().as_secs_f64();
    let mut timings = simulation.timings();
    timings.extend(recorder.timings());
    let simulated = simulation.time() - first.time;
    let effects = timings.into_iter().map(|t| EffectTime {
        effect: t.effect,
        seconds: t.seconds,
        share: t.seconds / wall,
        passes: t.passes,
    });
    let plan = simulation.plan();
    let summary = Summary {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        scene: plan.scene.name.clone(),
        precision: plan.precision,
        interrupted,
        error,
        time: simulation.time(),
        step: simulation.step_count(),
        simulated,
        steps: tally.steps,
        dt: [tally.least.unwrap_or(0.0), simulated / tally.steps.max(1) as f64, tally.greatest],
        particles: simulation.particle_count(),
        particle_steps: tally.particle_steps,
        wall,
        wall_steps: tally.wall,
        real_time_factor: simulated / wall,
        particle_steps_per_s: tally.particle_steps as f64 / tally.wall.max(f64::MIN_POSITIVE),
        effects: effects.collect(),
        peak_memory,
        memory: simulation.memory(),
        ledger_start: first.ledger.clone(),
        ledger_end: simulation.ledger(),
        probes: match plan.scene.probe.is_empty() {
            true => BTreeMap::new(),
            false => probes::figures(&recorder.files.borrow().folder.join(PROBES), &plan.scene),
        },
        warnings: plan.warnings.clone(),
    };
    let json = serde_json::to_string_pretty(&summary).map_err(io::Error::other);
    let folder = &mut recorder.files.borrow_mut().folder;
    folder.write(SUMMARY, "writing the summary", |out| out.write_all(json?.as_bytes()))?;
    Ok(summary)
}

fn io_error(path: &Path, what: &'static str, source: io::Error) -> Error {
    Error::Io { file: path.to_owned(), what, source }
}

/// Peak resident memory of this process [bytes], where the system tells (Linux).
pub fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().trim_end_matches("kB").trim().parse::<u64>().ok().map(|kib| kib * 1024)
}
