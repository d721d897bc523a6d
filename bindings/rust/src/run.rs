//! Runs a simulation with output into a folder: pictures, trace, summary, snapshots.
//!
//! | file | holds |
//! |---|---|
//! | `frames/00000.png`, … | a picture every `output.interval` |
//! | `contact-sheet.png`, `animation.gif` | the run at a glance |
//! | `particles/00000.ply`, … | particles every `output.interval`, if asked for |
//! | `trace.csv` | every step: time, step size, pose, velocity and wrench of every body |
//! | `summary.json` | every figure of the run |
//! | `snapshot.barchan` | the state at the end, on interruption or before an error: the run continues from it bit for bit |
//! | `files.txt` | what the run has written: nothing else is ever removed or overwritten |
//!
//! Pictures are drawn and written while the run goes on; one that cannot be written ends it a few pictures later at most.
//!
//! Output never changes the physics: steps are those of a run without output (only the end is met exactly), and a picture
//! shows the first step at or past its time.

mod folder;
#[cfg_attr(not(feature = "pictures"), path = "run/no_pictures.rs")]
mod pictures;

pub use folder::{Existing, check as check_folder, last as last_folder, next as next_folder};

use barchan_core::backend::Timing;
use barchan_core::export::export;
use barchan_core::scene::{Export, plain};
use barchan_core::{
    BodyState, Error, Ledger, Options, Precision, Registry, Result, Simulation, StepReport, Vec3, Wrench,
};
use folder::Folder;
use pictures::Pictures;
use serde::Serialize;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Name of the snapshot within an output folder.
pub const SNAPSHOT: &str = "snapshot.barchan";
const TRACE: &str = "trace.csv";
const SUMMARY: &str = "summary.json";
const CONTACT_SHEET: &str = "contact-sheet.png";
const ANIMATION: &str = "animation.gif";
const FRAMES: &str = "frames";
const PARTICLES: &str = "particles";

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
    let start = Instant::now();
    if let (Some(Swap { step, .. }), Until::Step(end)) = (&request.swap, request.until)
        && *step >= end
    {
        return Err(too_late(*step, end));
    }
    let mut recorder = Recorder::new(simulation, request)?;
    let first = Start { time: simulation.time(), step: simulation.step_count(), ledger: simulation.ledger() };
    let mut tally = Tally::default();
    recorder.record(simulation)?;
    let result = steps(simulation, request, &first, &mut recorder, &mut tally, start, watch);
    // An error of the physics leaves the state before the step: it is saved like any other end.
    let snapshot = recorder.save(simulation);
    let interrupted = !matches!(result, Ok(true));
    let error = result.as_ref().err().map(ToString::to_string);
    let summary = recorder.finish(simulation, &first, &tally, interrupted, error, start);
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
    recorder: &mut Recorder,
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
    if let Until::Time(end) = request.until {
        simulation.set_stop(end);
    }
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
        let reports = simulation.steps(end.saturating_sub(from.1).min(MOST_STEPS) as usize, recorder.next_output())?;
        tally.wall += before.elapsed().as_secs_f64();
        for report in &reports {
            tally.steps += 1;
            tally.particle_steps += simulation.particle_count() as u64;
            tally.least = Some(tally.least.map_or(report.dt, |least| least.min(report.dt)));
            tally.greatest = tally.greatest.max(report.dt);
        }
        recorder.trace(simulation, from, &reports)?;
        recorder.record(simulation)?;
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

/// Writes a run's files as it goes.
struct Recorder {
    folder: Folder,
    interval: f64,
    pictures: Option<Pictures>,
    export: Option<Export>,
    snapshot_interval: Option<f64>,
    next_frame: u64,
    next_snapshot: f64,
    trace: BufWriter<File>,
    seconds: f64,
}

impl Recorder {
    fn new(simulation: &Simulation, request: &Request) -> Result<Self> {
        let begin = Instant::now();
        let output = &simulation.plan().scene.output;
        let pictures = request.pictures && output.picture.on;
        if pictures {
            pictures::check()?;
        }
        let mut folder = Folder::open(&request.out, request.existing, simulation.plan().memory.0)?;
        let (time, resumed) = (simulation.time(), request.existing == Existing::Resume);
        // Pictures up to now are kept when a run goes on.
        let past = if resumed { (time / output.interval + 1e-9).floor() as u64 + 1 } else { 0 };
        let frames = folder.numbered(FRAMES, past)?;
        folder.numbered(PARTICLES, past)?;
        let pictures = pictures.then(|| Pictures::new(simulation, frames.last().map(PathBuf::as_path))).transpose()?;
        Ok(Self {
            trace: open_trace(&folder.claim(TRACE)?, simulation, resumed)?,
            folder,
            interval: output.interval,
            snapshot_interval: output.snapshot_interval,
            next_snapshot: output.snapshot_interval.map_or(f64::INFINITY, |interval| time + interval),
            next_frame: past,
            pictures,
            export: request.export.or(output.export),
            seconds: begin.elapsed().as_secs_f64(),
        })
    }

    /// A snapshot of the simulation as it is, and of the trace as far as it has come: so the trace of a run that goes on from it has no gap.
    fn save(&mut self, simulation: &Simulation) -> Result<()> {
        let flushed = self.flush_trace();
        let saved = self.folder.claim(SNAPSHOT).and_then(|path| simulation.save(path));
        flushed.and(saved)
    }

    fn flush_trace(&mut self) -> Result<()> {
        self.trace.flush().map_err(|e| io_error(&self.folder.join(TRACE), "writing the trace", e))
    }

    /// A line of the trace for each step since `from` (time, step).
    fn trace(&mut self, simulation: &Simulation, from: (f64, u64), reports: &[StepReport]) -> Result<()> {
        let begin = Instant::now();
        let (mut time, mut step) = from;
        let mut line = String::new();
        for (i, StepReport { dt, bodies, wrenches, .. }) in reports.iter().enumerate() {
            (time, step) = (time + dt, step + 1);
            // The last step may land on a stop.
            let time = if i + 1 == reports.len() { simulation.time() } else { time };
            line += &format!("{time},{step},{dt}");
            let bodies = bodies.clone().unwrap_or_else(|| simulation.bodies());
            let wrenches = wrenches.clone().unwrap_or_else(|| simulation.wrenches());
            for (body, wrench) in bodies.iter().zip(&wrenches) {
                line.push_str(&row(body, wrench));
            }
            line.push('\n');
        }
        let written = self.trace.write_all(line.as_bytes());
        written.map_err(|e| io_error(&self.folder.join(TRACE), "writing the trace", e))?;
        self.seconds += begin.elapsed().as_secs_f64();
        Ok(())
    }

    /// When something is due next [s].
    fn next_output(&self) -> f64 {
        (self.next_frame as f64 * self.interval - 1e-9 * self.interval).min(self.next_snapshot)
    }

    /// Pictures, particle files and snapshots that are due.
    fn record(&mut self, simulation: &Simulation) -> Result<()> {
        let begin = Instant::now();
        let time = simulation.time();
        if time >= self.next_frame as f64 * self.interval - 1e-9 * self.interval {
            let number = self.next_frame;
            // A step longer than the interval skips pictures rather than repeat one.
            self.next_frame = (time / self.interval + 1e-9).floor() as u64 + 1;
            if let Some(pictures) = &mut self.pictures {
                pictures.take(simulation, || self.folder.claim(&format!("{FRAMES}/{number:05}.png")))?;
            }
            if let Some(format) = self.export {
                let path = self.folder.claim(&format!("{PARTICLES}/{number:05}.{}", format.extension()))?;
                export(&simulation.ground(), simulation.plan(), path, format)?;
            }
            self.flush_trace()?;
        }
        if let Some(interval) = self.snapshot_interval.filter(|_| time >= self.next_snapshot) {
            self.save(simulation)?;
            self.next_snapshot = ((time / interval + 1e-9).floor() + 1.0) * interval;
        }
        self.seconds += begin.elapsed().as_secs_f64();
        Ok(())
    }

    /// Contact sheet, animation and summary.
    fn finish(
        mut self,
        simulation: &Simulation,
        first: &Start,
        tally: &Tally,
        interrupted: bool,
        error: Option<String>,
        start: Instant,
    ) -> Result<Summary> {
        // Asked before the animation, which is no part of the simulation.
        let peak_memory = peak_memory();
        let begin = Instant::now();
        // After an error, the rest is written all the same.
        let drawn = self.pictures.as_mut().map_or(Ok(()), Pictures::wait);
        match drawn.and(self.flush_trace()) {
            Err(e) if error.is_none() => return Err(e),
            _ => {}
        }
        if let Some(pictures) = &self.pictures {
            pictures.overview(&mut self.folder, self.interval)?;
        }
        self.seconds += begin.elapsed().as_secs_f64();

        let wall = start.elapsed().as_secs_f64();
        let mut timings = simulation.timings();
        timings.push(Timing { effect: "output".to_owned(), seconds: self.seconds, passes: self.next_frame });
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
            warnings: plan.warnings.clone(),
        };
        let json = serde_json::to_string_pretty(&summary).map_err(io::Error::other);
        self.folder.write(SUMMARY, "writing the summary", |out| out.write_all(json?.as_bytes()))?;
        Ok(summary)
    }
}

fn io_error(path: &Path, what: &'static str, source: io::Error) -> Error {
    Error::Io { file: path.to_owned(), what, source }
}

/// Opens the trace; one that goes on is cut after the present step.
fn open_trace(path: &Path, simulation: &Simulation, resumed: bool) -> Result<BufWriter<File>> {
    let open = || -> io::Result<BufWriter<File>> {
        let mut file = File::options().read(true).write(true).create(true).truncate(!resumed).open(path)?;
        let mut text = String::new();
        file.read_to_string(&mut text)?;
        let step = |line: &str| line.split(',').nth(1).and_then(|s| s.parse::<u64>().ok());
        let kept = text
            .split_inclusive('\n')
            .take_while(|line| line.ends_with('\n') && step(line).is_none_or(|step| step <= simulation.step_count()));
        let length: usize = kept.map(str::len).sum();
        file.set_len(length as u64)?;
        file.seek(SeekFrom::End(0))?;
        let mut writer = BufWriter::new(file);
        if length == 0 {
            writeln!(writer, "{}", header(&simulation.bodies()))?;
        }
        Ok(writer)
    };
    open().map_err(|e| io_error(path, "opening the trace", e))
}

/// Quantities of a body in the trace, with units.
const COLUMNS: [&str; 19] = [
    "x [m]",
    "y [m]",
    "z [m]",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx [m/s]",
    "vy [m/s]",
    "vz [m/s]",
    "wx [rad/s]",
    "wy [rad/s]",
    "wz [rad/s]",
    "fx [N]",
    "fy [N]",
    "fz [N]",
    "tx [N m]",
    "ty [N m]",
    "tz [N m]",
];

fn header(bodies: &[BodyState]) -> String {
    let columns = bodies.iter().flat_map(|body| COLUMNS.map(|column| quoted(&format!("{} {column}", body.name))));
    ["time [s]", "step", "dt [s]"].map(str::to_owned).into_iter().chain(columns).collect::<Vec<_>>().join(",")
}

/// A field of a CSV file (RFC 4180), on one line.
fn quoted(field: &str) -> String {
    let field = plain(field);
    if field.contains(['"', ',']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field }
}

fn row(body: &BodyState, wrench: &Wrench) -> String {
    let vectors: [&Vec3; 4] = [&body.velocity, &body.angular_velocity, &wrench.force, &wrench.torque];
    let numbers = body.position.iter().chain(&body.rotation).chain(vectors.into_iter().flatten());
    numbers.fold(String::new(), |row, number| format!("{row},{number}"))
}

/// Peak resident memory of this process [bytes], where the system tells (Linux).
pub fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().trim_end_matches("kB").trim().parse::<u64>().ok().map(|kib| kib * 1024)
}
