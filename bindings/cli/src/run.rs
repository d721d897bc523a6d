//! `barchan run`.

use crate::{SceneArgs, report};
use barchan::run::{Progress, Request, SNAPSHOT, Swap, Until};
use barchan::scene::Export;
use barchan::{Options, Plan, Precision, Registry, Result, Simulation};
use clap::{Args, Parser, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Exit status after Ctrl-C, as shells have it: 128 + SIGINT.
const INTERRUPTED: u8 = 130;

#[derive(Args)]
pub(crate) struct RunArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,
    /// Output folder [default: ./out/<scene>].
    #[arg(long)]
    out: Option<PathBuf>,
    /// Stop at this step, counted from the scene's start.
    #[arg(long, conflicts_with = "seconds")]
    steps: Option<u64>,
    /// Stop at this simulated time [s] instead of the scene's time.end.
    #[arg(long)]
    seconds: Option<f64>,
    /// Go on from a snapshot [default: the one in the output folder]; the folder's output is kept up to there.
    #[arg(long, value_name = "SNAPSHOT", require_equals = true, num_args = 0..=1)]
    resume: Option<Option<PathBuf>>,
    /// Write particles beside the pictures.
    #[arg(long)]
    export: Option<Format>,
    /// Let another backend, or the same in another number format, take over after a step.
    #[arg(long, value_name = "STEP:BACKEND[:PRECISION]")]
    swap_at: Option<SwapAt>,
    /// Make no pictures.
    #[arg(long)]
    no_pictures: bool,
    /// Print nothing but errors.
    #[arg(long, short)]
    quiet: bool,
}

/// `STEP:BACKEND[:PRECISION]`.
#[derive(Clone, Debug, PartialEq)]
struct SwapAt {
    step: u64,
    backend: String,
    /// Absent: that of the run.
    precision: Option<Precision>,
}

impl FromStr for SwapAt {
    type Err = String;
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let mut parts = text.split(':');
        let step = parts.next().and_then(|step| step.parse().ok());
        let (Some(step), Some(backend), precision, None) = (step, parts.next(), parts.next(), parts.next()) else {
            return Err(format!("'{text}' is not STEP:BACKEND or STEP:BACKEND:PRECISION, such as 200:cpu:f64"));
        };
        Ok(Self { step, backend: backend.to_owned(), precision: precision.map(str::parse).transpose()? })
    }
}

impl SwapAt {
    /// The adapter goes with the backend that runs on one.
    fn swap(&self, registry: &Registry, before: &mut Options) -> Result<Swap> {
        let takes_adapter = registry.backend(&self.backend)?.adapters().is_some();
        let adapter = if takes_adapter { before.adapter.clone() } else { None };
        if registry.backend(&before.backend)?.adapters().is_none() && takes_adapter {
            before.adapter = None;
        }
        let precision = self.precision.unwrap_or(before.precision);
        let options = Options { backend: self.backend.clone(), precision, adapter, ..before.clone() };
        Ok(Swap { step: self.step, registry: registry.clone(), options })
    }
}

/// A particle file format.
#[derive(Clone, Copy, ValueEnum)]
enum Format {
    Ply,
    Npz,
    Vtk,
}

impl From<Format> for Export {
    fn from(format: Format) -> Self {
        match format {
            Format::Ply => Self::Ply,
            Format::Npz => Self::Npz,
            Format::Vtk => Self::Vtk,
        }
    }
}

/// The arguments of `run` alone.
#[derive(Parser)]
struct Alone {
    #[command(flatten)]
    run: RunArgs,
}

impl RunArgs {
    /// `run letters`.
    pub(crate) fn letters() -> Self {
        Alone::parse_from(["run", "letters"]).run
    }
}

pub(crate) fn run(args: &RunArgs) -> Result<ExitCode> {
    let registry = args.scene.engine.registry()?;
    let mut options = args.scene.engine.options();
    let swap = args.swap_at.as_ref().map(|at| at.swap(&registry, &mut options)).transpose()?;
    let scene = args.scene.scene()?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("out").join(&scene.name));
    let mut simulation = match &args.resume {
        Some(path) => {
            let path = path.clone().unwrap_or_else(|| out.join(SNAPSHOT));
            // Past the swap, the snapshot is one of the second backend.
            let options = match &swap {
                Some(swap) if barchan::snapshot::step(&path)? > swap.step => &swap.options,
                _ => &options,
            };
            Simulation::resume(&registry, &path, options)?
        }
        None => Simulation::new(&registry, &scene, &options)?,
    };
    let until = match (args.steps, args.seconds) {
        (Some(step), _) => Until::Step(step),
        (None, seconds) => Until::Time(seconds.unwrap_or(simulation.plan().scene.time.end)),
    };
    let request = Request {
        out: out.clone(),
        until,
        pictures: !args.no_pictures,
        export: args.export.map(Into::into),
        resumed: args.resume.is_some(),
        swap: swap.filter(|swap| simulation.step_count() <= swap.step),
    };
    if let Some(Swap { registry, options, .. }) = &request.swap {
        // What the second backend lacks is found out now, not in the middle.
        let plan = Plan { precision: options.precision, ..simulation.plan().clone() };
        registry.backend(&options.backend)?.check(&plan)?;
    }
    if !args.quiet {
        println!("{}", simulation.plan());
    }
    let stop = stop_flag();
    let mut shown = Shown::new(args.quiet);
    let summary = barchan::run::run(&mut simulation, &request, &mut |progress| {
        shown.update(progress);
        if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    shown.finish();
    let summary = summary?;
    if !args.quiet {
        report::print(&summary);
        if let Some(line) = report::accuracy(&simulation.plan().scene) {
            println!("\n  {line}");
        }
        println!("output in {}", out.display());
    }
    if summary.interrupted {
        eprintln!("stopped at {:.4} s; go on with\n    {}", summary.time, resume_line(std::env::args()));
        return Ok(ExitCode::from(INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

/// Set by Ctrl-C; a second one ends the process at once.
fn stop_flag() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    let handler = ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(INTERRUPTED.into());
        }
    });
    if let Err(error) = handler {
        eprintln!("warning: Ctrl-C will end the run without saving it: {error}");
    }
    stop
}

/// The command line that goes on with this run from its own snapshot.
fn resume_line(args: impl Iterator<Item = String>) -> String {
    let quoted = |arg: String| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=+:,".contains(c);
        if !arg.is_empty() && arg.chars().all(plain) { arg } else { format!("'{}'", arg.replace('\'', r"'\''")) }
    };
    let mut words: Vec<String> =
        args.filter(|arg| arg != "--resume" && !arg.starts_with("--resume=")).map(quoted).collect();
    if words.len() == 1 {
        words.push("run".to_owned());
    }
    words.push("--resume".to_owned());
    words.join(" ")
}

/// Progress: a bar with the time left on a terminal, otherwise a line for every twentieth.
pub(crate) enum Shown {
    Nothing,
    Bar(ProgressBar, Instant),
    Lines(u32),
}

impl Shown {
    pub(crate) fn new(quiet: bool) -> Self {
        if quiet {
            return Self::Nothing;
        }
        if !std::io::stderr().is_terminal() {
            return Self::Lines(0);
        }
        let style = ProgressStyle::with_template("{bar:40} {percent:>3} %  {msg}").expect("a constant template");
        Self::Bar(ProgressBar::new(1000).with_style(style), Instant::now() - Duration::from_secs(1))
    }
    pub(crate) fn update(&mut self, progress: &Progress) {
        let left = progress.elapsed * (1.0 - progress.done) / progress.done.max(1e-9);
        match self {
            Self::Nothing => {}
            Self::Bar(bar, last) => {
                if last.elapsed() > Duration::from_millis(100) {
                    *last = Instant::now();
                    bar.set_position((progress.done * 1000.0) as u64);
                    bar.set_message(format!("t = {:.3} s, {} left", progress.time, report::duration(left)));
                }
            }
            Self::Lines(twentieths) => {
                let now = (progress.done * 20.0) as u32;
                if now > *twentieths {
                    *twentieths = now;
                    println!(
                        "{:>3} %  t = {:.3} s  step {}  {} left",
                        now * 5,
                        progress.time,
                        progress.step,
                        report::duration(left)
                    );
                }
            }
        }
    }
    pub(crate) fn finish(&self) {
        if let Self::Bar(bar, _) = self {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_swap_is_a_step_a_backend_and_perhaps_a_precision() {
        let parsed: SwapAt = "200:cpu:f64".parse().unwrap();
        assert_eq!(parsed, SwapAt { step: 200, backend: "cpu".to_owned(), precision: Some(Precision::F64) });
        assert_eq!("0:wgpu".parse::<SwapAt>().unwrap().precision, None);
        for wrong in ["cpu", "200", "cpu:200", "1:cpu:f16", "1:cpu:f32:x", "-1:cpu"] {
            assert!(wrong.parse::<SwapAt>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_resume_line_repeats_the_command_once() {
        let line = |words: &[&str]| resume_line(words.iter().map(|w| (*w).to_owned()));
        assert_eq!(line(&["barchan"]), "barchan run --resume");
        assert_eq!(
            line(&["barchan", "run", "dig", "--set", "name=a b", "--resume=x"]),
            "barchan run dig --set 'name=a b' --resume"
        );
    }
}
