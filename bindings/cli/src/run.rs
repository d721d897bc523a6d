//! `barchan run`.

use crate::print::{show, tell};
use crate::signals::Signals;
use crate::{SceneArgs, report};
use barchan::run::{self, Existing, Progress, Request, SNAPSHOT, Swap, Until};
use barchan::scene::{Export, plain};
use barchan::snapshot::About;
use barchan::{Error, Options, Plan, Precision, Registry, Result, Scene, Simulation};
use clap::{Args, Parser, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;
use std::time::{Duration, Instant};

/// Where output goes, scene by scene and run by run, unless a folder is named.
const OUT: &str = "out";

#[derive(Args)]
pub(crate) struct RunArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,
    /// Output folder [default: the next of ./out/<scene>-001, ./out/<scene>-002, …]. One that holds a run is refused.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Replace the run that the output folder holds: the files that it wrote are removed, and no others.
    #[arg(long, conflicts_with = "resume")]
    overwrite: bool,
    /// Stop at this step, counted from the scene's start.
    #[arg(long, conflicts_with = "seconds")]
    steps: Option<u64>,
    /// Stop at this simulated time [s] instead of the scene's time.end.
    #[arg(long, value_parser = seconds)]
    seconds: Option<f64>,
    /// Go on from a snapshot [default: the one in the output folder, or that of the last run of the scene]; the folder's output is kept up to
    /// there. The scene is the one that the run began with, --set included.
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

/// A simulated time.
fn seconds(text: &str) -> std::result::Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| seconds.is_finite() && *seconds >= 0.0);
    seconds.ok_or_else(|| "must be a finite number of seconds, 0 or above".to_owned())
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
        let options = Options { precision, adapter, ..crate::moved(before.clone(), &self.backend) };
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

/// Where a run goes on from, and as what.
struct Resumed {
    snapshot: PathBuf,
    about: About,
}

impl RunArgs {
    /// The run that is to be gone on with: the snapshot that is named, or that of the output folder, or of the last one of the scene.
    ///
    /// # Errors
    /// If there is none, or if the command line asks for anything else than the run was.
    fn resumed(&self) -> Result<Option<Resumed>> {
        let Some(snapshot) = &self.resume else { return Ok(None) };
        let refuse = |what: String, mend: String| Error::Body { path: "--resume".to_owned(), what, mend };
        let snapshot = match (snapshot, &self.out) {
            (Some(snapshot), _) => snapshot.clone(),
            (None, Some(out)) => out.join(SNAPSHOT),
            (None, None) => {
                let name = self.scene.scene()?.name;
                let folder = run::last_folder(Path::new(OUT), &name);
                let folder = folder.ok_or_else(|| {
                    refuse(
                        format!("no run of '{name}' has left a {SNAPSHOT} in {OUT}"),
                        "name one, --resume=SNAPSHOT, or its folder with --out".to_owned(),
                    )
                })?;
                folder.join(SNAPSHOT)
            }
        };
        let about = barchan::snapshot::about(&snapshot)?;
        if !self.scene.set.is_empty() {
            let then = match about.set.as_slice() {
                [] => "without any".to_owned(),
                set => format!("with --set {}", set.join(" --set ")),
            };
            let what =
                format!("a run goes on as it began, {then}, and --set {} is given", self.scene.set.join(" --set "));
            return Err(refuse(what, "leave --set out, or start a new run".to_owned()));
        }
        let then = Scene::from_str(&about.scene, &snapshot.display().to_string(), &about.folder)?;
        if let Some(given) = &self.scene.scene {
            let now = crate::scene(given, &about.set)?;
            if now.name != then.name {
                return Err(refuse(
                    format!("{} continues the scene '{}', and '{}' is given", snapshot.display(), then.name, now.name),
                    "leave the scene out, or name the snapshot of a run of it".to_owned(),
                ));
            }
            if let Some((key, [then, now])) = then.difference(&now) {
                return Err(refuse(
                    format!("the scene has changed since the run began: {key} was {then} and is {now}"),
                    "leave the scene out to go on with what it was, or start a new run".to_owned(),
                ));
            }
        }
        Ok(Some(Resumed { snapshot, about }))
    }

    /// The output folder: the one that is named, or that of the run that is gone on with, or a new one.
    fn folder(&self, name: &str, resumed: Option<&Resumed>) -> Result<PathBuf> {
        match (&self.out, resumed) {
            (Some(out), _) => Ok(out.clone()),
            (None, Some(Resumed { snapshot, .. })) if snapshot.ends_with(SNAPSHOT) => {
                let folder = snapshot.parent().filter(|folder| *folder != Path::new(""));
                Ok(folder.unwrap_or(Path::new(".")).to_owned())
            }
            (None, _) => run::next_folder(Path::new(OUT), name),
        }
    }
}

pub(crate) fn run(args: &RunArgs, registry: Registry) -> Result<ExitCode> {
    let resumed = args.resumed()?;
    let existing = match (&resumed, args.overwrite) {
        (Some(_), _) => Existing::Resume,
        (None, true) => Existing::Overwrite,
        (None, false) => Existing::Refuse,
    };
    // Before anything is seeded.
    args.out.as_ref().map_or(Ok(()), |out| run::check_folder(out, existing))?;
    let registry = args.scene.engine.load_into(registry)?;
    let mut options = args.scene.engine.options();
    let swap = args.swap_at.as_ref().map(|at| at.swap(&registry, &mut options)).transpose()?;
    let mut simulation = match &resumed {
        Some(Resumed { snapshot, about }) => {
            // Past the swap, the snapshot is one of the second backend.
            let options = match &swap {
                Some(swap) if about.step > swap.step => &swap.options,
                _ => &options,
            };
            Simulation::resume(&registry, snapshot, options)?
        }
        None => Simulation::new(&registry, &args.scene.scene()?, &options)?,
    };
    let until = match (args.steps, args.seconds) {
        (Some(step), _) => Until::Step(step),
        (None, seconds) => Until::Time(seconds.unwrap_or(simulation.plan().scene.time.end)),
    };
    if let Some(Swap { registry, options, .. }) = &swap {
        // What the second backend lacks is found out now, not in the middle.
        let backend = registry.backend(&options.backend)?;
        let backend_parameters = options.parameters_of(&**backend)?;
        let plan = Plan { precision: options.precision, backend_parameters, ..simulation.plan().clone() };
        backend.check(&plan)?;
    }
    let out = args.folder(&simulation.plan().scene.name, resumed.as_ref())?;
    let request = Request {
        out: out.clone(),
        until,
        pictures: !args.no_pictures,
        export: args.export.map(Into::into),
        existing,
        swap: swap.filter(|swap| simulation.step_count() <= swap.step),
    };
    if !args.quiet {
        show(format!("{}\n", simulation.plan()));
        if let Some(Resumed { snapshot, about }) = &resumed {
            let set = about.set.iter().fold(String::new(), |set, one| set + " --set " + one);
            show(format!(
                "goes on with '{}'{set} of {}, from step {} at {:.4} s\n",
                plain(&simulation.plan().scene.name),
                snapshot.display(),
                about.step,
                about.time
            ));
            let is_there = match until {
                Until::Step(step) => about.step >= step,
                Until::Time(time) => about.time >= time,
            };
            if is_there {
                show("it is at its end already; --seconds and --steps say how far to go on\n");
            }
        }
        show(format!("output goes to {}\n", out.display()));
    }
    let stop = Signals::new();
    let mut shown = Shown::new(args.quiet);
    let mut observers = registry.make_observers(&simulation.plan().scene)?;
    let mut observers: Vec<&mut dyn barchan::Observer> =
        observers.iter_mut().map(|observer| &mut **observer as &mut dyn barchan::Observer).collect();
    let summary = run::run_with(&mut simulation, &request, &mut observers, &mut |progress| {
        shown.update(progress);
        if stop.caught().is_none() {
            return ControlFlow::Continue(());
        }
        shown.finish();
        tell("saving what has been simulated; a signal more ends the run without that");
        ControlFlow::Break(())
    });
    shown.finish();
    if args.out.is_none() {
        // One that was made for nothing is empty, and only then goes.
        let _ = std::fs::remove_dir(&out);
    }
    let summary = summary?;
    if !args.quiet {
        report::print(&summary);
        if let Some(line) = report::accuracy(&simulation.plan().scene) {
            show(format!("\n  {line}\n"));
        }
        show(format!("output in {}\n", out.display()));
    }
    match stop.caught() {
        Some(signal) if summary.interrupted => {
            let line = resume_line(std::env::args(), &out);
            tell(format!("stopped at {:.4} s; go on with\n{line}", summary.time));
            Ok(ExitCode::from(signal.status()))
        }
        _ => Ok(ExitCode::SUCCESS),
    }
}

/// The command line that goes on with this run from its own snapshot. What the scene was set to is in there.
fn resume_line(args: impl Iterator<Item = String>, out: &Path) -> String {
    let quoted = |arg: String| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=+:,".contains(c);
        if !arg.is_empty() && arg.chars().all(plain) { arg } else { format!("'{}'", arg.replace('\'', r"'\''")) }
    };
    let mut words = Vec::new();
    let mut value_follows = false;
    for arg in args {
        let left_out = ["--resume", "--overwrite", "--set", "--out"]
            .iter()
            .any(|name| arg == *name || arg.strip_prefix(name).is_some_and(|rest| rest.starts_with('=')));
        if !left_out && !value_follows {
            words.push(quoted(arg.clone()));
        }
        value_follows = arg == "--set" || arg == "--out";
    }
    if words.len() == 1 {
        words.push("run".to_owned());
    }
    words.extend(["--out".to_owned(), quoted(out.display().to_string()), "--resume".to_owned()]);
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
        let style = ProgressStyle::with_template("{bar:40} {percent:>3} %  {msg}").expect("the template is a constant");
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
                    show(format!(
                        "{:>3} %  t = {:.3} s  step {}  {} left\n",
                        now * 5,
                        progress.time,
                        progress.step,
                        report::duration(left)
                    ));
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
        let line = |words: &[&str]| resume_line(words.iter().map(|w| (*w).to_owned()), Path::new("out/a b"));
        assert_eq!(line(&["barchan"]), "barchan run --out 'out/a b' --resume");
        assert_eq!(
            line(&["barchan", "run", "dig", "--set", "name=a b", "--out=x", "--steps", "9", "--resume=x", "--set=a=1"]),
            "barchan run dig --steps 9 --out 'out/a b' --resume"
        );
        assert_eq!(
            line(&["barchan", "run", "dig", "--overwrite", "--out", "y", "-q"]),
            "barchan run dig -q --out 'out/a b' --resume"
        );
    }
}
