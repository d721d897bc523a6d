//! `barchan task`.

use crate::EngineArgs;
use crate::print::show;
use barchan::environment::{Environment, Recording, Step};
use barchan::parameter::{Given, Table, parse};
use barchan::picture::{Axes, Chart, Image, Series, Style, View, contact_sheet, gif};
use barchan::run::next_folder;
use barchan::{Error, Registry, Result};
use clap::{Args, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Plays benchmark tasks.
#[derive(Subcommand)]
pub(crate) enum TaskCommand {
    /// Lists the tasks: what is to be done, what an action and an observation hold.
    List,
    /// Plays an episode, and writes it, its rewards and its pictures into a folder.
    Run(RunArgs),
    /// Plays the actions of an episode's file again, on any backend, and says how far its rewards are from those in the file.
    Replay(ReplayArgs),
    /// Plays an episode's file again and draws it.
    Render(RenderArgs),
}

/// Who acts.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Agent {
    /// The agent that somebody has written by hand for the task.
    Heuristic,
    /// Anything within the limits.
    Random,
    /// Nobody: all actions are zero.
    Still,
}

#[derive(Args)]
pub(crate) struct RunArgs {
    /// A task; see `task list`. Or a TOML file: a scene whose [task] names one.
    name: String,
    /// Who acts.
    #[arg(long, value_enum, default_value_t = Agent::Heuristic)]
    agent: Agent,
    /// Seed of the episode.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Sets a parameter of the task (see `plugins`), such as randomise=1; may be given again.
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse)]
    set: Vec<(String, Given)>,
    /// Control steps at most [default: the task's horizon].
    #[arg(long)]
    steps: Option<u64>,
    #[command(flatten)]
    output: Output,
    #[command(flatten)]
    engine: EngineArgs,
}

#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// The file, such as out/SmoothSurface-001/episode.json.
    episode: PathBuf,
    #[command(flatten)]
    engine: EngineArgs,
}

#[derive(Args)]
pub(crate) struct RenderArgs {
    /// The file, such as out/SmoothSurface-001/episode.json.
    episode: PathBuf,
    #[command(flatten)]
    output: Output,
    #[command(flatten)]
    engine: EngineArgs,
}

/// What is written, and where.
#[derive(Args, Clone)]
struct Output {
    /// Folder; what an earlier episode has written there is replaced [default: the next number of out/NAME-001].
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Pictures over the episode; 0: none.
    #[arg(long, default_value_t = 60)]
    pictures: u64,
}

/// Names of the files.
const EPISODE: &str = "episode.json";
const CONTACT_SHEET: &str = "contact-sheet.png";
const ANIMATION: &str = "animation.gif";
const REWARDS: &str = "rewards";
/// Pictures on the contact sheet, the width of each, and that of the animation [pixels].
const SHEET: usize = 9;
const SHEET_WIDTH: usize = 480;
const ANIMATION_WIDTH: usize = 540;
/// Most that an animation may take up [bytes], and how long it takes [s].
const ANIMATION_BYTES: usize = 4 << 20;
const ANIMATION_SECONDS: f64 = 6.0;

pub(crate) fn run(command: &TaskCommand, registry: Registry) -> Result<()> {
    match command {
        TaskCommand::List => list(&registry),
        TaskCommand::Run(args) => play(args, registry),
        TaskCommand::Replay(args) => replay(args, registry),
        TaskCommand::Render(args) => {
            let mut recording = Recording::read(&args.episode)?;
            let actions = std::mem::take(&mut recording.actions);
            recording.rewards.clear();
            let registry = args.engine.load_into(registry)?;
            let environment = recording.environment(&registry, &args.engine.options())?;
            let mut given = actions.into_iter();
            episode(environment, recording, &args.output, u64::MAX, |_| given.next())
        }
    }
}

fn list(registry: &Registry) -> Result<()> {
    let mut text = String::new();
    for (name, kind) in registry.tasks() {
        text += &format!("{name}\n  {}\n", kind.doc);
        // One that needs parameters says so.
        let Ok(task) = registry.task(name, &Table::new()) else { continue };
        let actions: Vec<String> =
            task.actions().iter().map(|limit| format!("{} from {} to {}", limit.name, limit.low, limit.high)).collect();
        let seen: Vec<String> =
            task.observations().iter().map(|part| format!("{} × {}", part.size, part.name)).collect();
        text += &format!("  action: {}\n  observation: {}\n", actions.join("; "), seen.join("; "));
        text += &format!("  {} control steps of {} s\n", task.horizon(), task.interval());
        let ranges: Vec<String> = {
            let all = Table::from_iter([("randomise".to_owned(), Given::Float(1.0))]);
            let ranges = registry.task(name, &all).map(|task| task.ranges()).unwrap_or_default();
            ranges.iter().map(|limit| format!("{} from {} to {}", limit.name, limit.low, limit.high)).collect()
        };
        if !ranges.is_empty() {
            text += &format!("  randomise: {}\n", ranges.join("; "));
        }
        text += "\n";
    }
    show(text);
    Ok(())
}

fn play(args: &RunArgs, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    let options = args.engine.options();
    let recording = Recording {
        task: args.name.clone(),
        parameters: args.set.iter().cloned().collect(),
        seed: args.seed,
        agent: format!("{:?}", args.agent).to_lowercase(),
        played_on: format!("{} {}", options.backend, options.precision),
        ..Recording::default()
    };
    let environment = recording.environment(&registry, &options)?;
    let limits = environment.task().actions();
    let mut random = Random(args.seed);
    let agent = args.agent;
    let act = |environment: &mut Environment| match agent {
        Agent::Heuristic => environment.heuristic(0),
        Agent::Random => {
            Some(limits.iter().map(|limit| limit.low + random.next() * (limit.high - limit.low)).collect())
        }
        Agent::Still => Some(vec![0.0; limits.len()]),
    };
    episode(environment, recording, &args.output, args.steps.unwrap_or(u64::MAX), act)
}

/// Plays an episode to its end, or until nobody acts, and writes it.
fn episode(
    mut environment: Environment,
    mut recording: Recording,
    output: &Output,
    most: u64,
    mut act: impl FnMut(&mut Environment) -> Option<Vec<f64>>,
) -> Result<()> {
    let out = match &output.out {
        Some(out) => {
            std::fs::create_dir_all(out).map_err(|source| Error::Io {
                file: out.clone(),
                what: "making the output folder",
                source,
            })?;
            out.clone()
        }
        None => next_folder(Path::new("out"), environment.task().name())?,
    };
    let steps = most.min(environment.task().horizon());
    let mut pictures = Pictures::new(&environment, output.pictures.min(steps));
    let bar = ProgressBar::new(steps).with_style(
        ProgressStyle::with_template("{wide_bar} {pos}/{len} control steps, {eta} left, {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let begin = std::time::Instant::now();
    pictures.take(&environment)?;
    let mut last: Option<Step> = None;
    while environment.steps_taken(0) < steps {
        let Some(action) = act(&mut environment) else {
            if last.is_none() {
                return Err(Error::Body {
                    path: format!("task '{}'", recording.task),
                    what: "nobody acts in it: it has no hand-written agent, or the episode no actions".to_owned(),
                    mend: "choose --agent random or still".to_owned(),
                });
            }
            break;
        };
        let step = environment.step(std::slice::from_ref(&action))?.remove(0)?;
        recording.add(action, &step);
        bar.inc(1);
        bar.set_message(format!("reward {:.1}", recording.total()));
        let ends = step.terminated || step.truncated;
        if pictures.is_due(environment.steps_taken(0), steps) || ends {
            pictures.take(&environment)?;
        }
        last = Some(step);
        if ends {
            break;
        }
    }
    bar.finish_and_clear();
    recording.write(&out.join(EPISODE))?;
    rewards(&recording, &out)?;
    pictures.write(&out)?;
    let (taken, wall) = (environment.steps_taken(0), begin.elapsed().as_secs_f64());
    let success = if recording.success { "success" } else { "no success" };
    let mut text = format!("{}: reward {:.1}, {success}, {taken} control steps\n", recording.task, recording.total());
    for (name, value) in last.iter().flat_map(|step| &step.info) {
        text += &format!("  {name}: {value:.4}\n");
    }
    let simulated = taken as f64 * environment.task().interval();
    text += &format!(
        "  {:.1} control steps/s, {:.3} × real time, pictures included\n",
        taken as f64 / wall,
        simulated / wall
    );
    if environment.clipped(0) > 0 {
        text += &format!("  {} numbers of actions lay beyond their limits\n", environment.clipped(0));
    }
    show(format!("{text}wrote {}\n", out.display()));
    Ok(())
}

fn replay(args: &ReplayArgs, registry: Registry) -> Result<()> {
    let recording = Recording::read(&args.episode)?;
    let registry = args.engine.load_into(registry)?;
    let mut environment = recording.environment(&registry, &args.engine.options())?;
    let mut again = Recording { actions: Vec::new(), rewards: Vec::new(), ..recording.clone() };
    for action in &recording.actions {
        let step = environment.step(std::slice::from_ref(action))?.remove(0)?;
        again.add(action.clone(), &step);
    }
    let off = again.rewards.iter().zip(&recording.rewards).map(|(new, old)| (new - old).abs()).fold(0.0, f64::max);
    let success = if again.success { "success" } else { "no success" };
    show(format!(
        "{}: reward {:.3} ({:.3} in the file), {success}; rewards of control steps differ by {off:.3e} at most\n",
        recording.task,
        again.total(),
        recording.total()
    ));
    Ok(())
}

/// A chart of the rewards' sum.
fn rewards(recording: &Recording, out: &Path) -> Result<()> {
    let mut sum = 0.0;
    let point = |(i, reward): (usize, &f64)| {
        sum += reward;
        ((i + 1) as f64, sum, String::new())
    };
    let points = recording.rewards.iter().enumerate().map(point).collect();
    let chart = Chart {
        title: format!("{}: {}", recording.task, recording.agent),
        x: "control step".to_owned(),
        y: "reward so far".to_owned(),
        series: vec![Series { name: recording.agent.clone(), points, style: Style::Line }],
        axes: Axes::Linear,
    };
    let path = out.join(REWARDS);
    chart.write(&path).map_err(|source| Error::Io { file: path, what: "writing the chart", source })
}

/// Pictures of an episode.
struct Pictures {
    view: Option<View>,
    wanted: u64,
    taken: Vec<(Image, String)>,
}

impl Pictures {
    fn new(environment: &Environment, wanted: u64) -> Self {
        let view = (wanted > 0).then(|| View::new(environment.worlds().world(0)));
        Self { view, wanted, taken: Vec::new() }
    }

    /// Is there one to be taken after so many of the steps?
    fn is_due(&self, step: u64, steps: u64) -> bool {
        step * self.wanted / steps != (step - 1) * self.wanted / steps
    }

    fn take(&mut self, environment: &Environment) -> Result<()> {
        let world = environment.worlds().world(0);
        if let Some(view) = &mut self.view {
            self.taken.push((view.draw(world)?, format!("t = {:.2} s", world.time())));
        }
        Ok(())
    }

    fn write(&self, out: &Path) -> Result<()> {
        let Some(view) = self.view.as_ref().filter(|_| !self.taken.is_empty()) else { return Ok(()) };
        let io = |name: &str, source| Error::Io { file: out.join(name), what: "writing pictures", source };
        let count = SHEET.min(self.taken.len());
        let chosen: Vec<(Image, String)> = (0..count)
            .map(|k| &self.taken[k * (self.taken.len() - 1) / (count - 1).max(1)])
            .map(|(image, label)| (image.crop(view.relief_rect()), label.clone()))
            .collect();
        contact_sheet(&chosen, 3, SHEET_WIDTH)
            .write_png(&out.join(CONTACT_SHEET), &[])
            .map_err(|e| io(CONTACT_SHEET, e))?;
        let load = |i: usize| Ok(self.taken[i].0.shrunk(ANIMATION_WIDTH));
        let seconds = ANIMATION_SECONDS / self.taken.len() as f64;
        gif(self.taken.len(), load, seconds, ANIMATION_BYTES)
            .and_then(|bytes| std::fs::write(out.join(ANIMATION), bytes))
            .map_err(|e| io(ANIMATION, e))
    }
}

/// SplitMix64.
struct Random(u64);

impl Random {
    /// A number in [0, 1).
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
}
