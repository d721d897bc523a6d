//! `barchan bench`: speed, what each effect costs, and what resolution buys.

mod accuracy;
mod scale;
mod throughput;

use crate::EngineArgs;
use crate::print::show;
use barchan::backend::Timing;
use barchan::picture::Chart;
use barchan::scene::{MaterialSpec, Motion, OverBound, Robot};
use barchan::worlds::Worlds;
use barchan::{Error, Registry, Result, Scene, Simulation};
use clap::builder::{PossibleValuesParser, RangedI64ValueParser, TypedValueParser};
use clap::{Args, Subcommand};
use serde::Serialize;
use serde_json::json;
use std::path::Path;
use std::time::Instant;
use std::{fs, io};

#[derive(Subcommand)]
pub(crate) enum Bench {
    /// Particle-steps per second in the cube drop of UBSoft's Table 1, sorting included; with `--all`, of every law on every backend.
    Throughput(throughput::Throughput),
    /// What each effect adds to a step, and what it costs when it is declared but not used.
    Effects(Effects),
    /// Errors against a run of the finest uniform grid, over time and memory: uniform grids and nested levels.
    Accuracy(accuracy::Accuracy),
    /// Time of a step and memory as the ground around a tool grows: a uniform grid and nested levels.
    Scale(scale::Scale),
}

/// How long to measure.
#[derive(Args)]
struct Effort {
    /// Steps in a repetition.
    #[arg(long, default_value_t = 20, value_parser = at_least_one())]
    steps: u32,
    /// Repetitions, of which the median counts.
    #[arg(long, default_value_t = 5, value_parser = at_least_one())]
    repetitions: u32,
    /// Steps before the first repetition.
    #[arg(long, default_value_t = 10)]
    warm_up: u32,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
pub(crate) struct Effects {
    /// Cells along 1.28 m.
    #[arg(long, default_value = "64", value_parser = grids(&["32", "64", "128", "256"]))]
    grid: u32,
    #[command(flatten)]
    effort: Effort,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Reads a number that is at least 1.
fn at_least_one() -> RangedI64ValueParser<u32> {
    clap::value_parser!(u32).range(1..)
}

/// Reads one of these grids of the cube drop.
fn grids(known: &'static [&'static str]) -> impl TypedValueParser<Value = u32> {
    PossibleValuesParser::new(known).try_map(|grid| grid.parse::<u32>())
}

pub(crate) fn run(bench: &Bench, registry: Registry) -> Result<()> {
    match bench {
        Bench::Throughput(args) => throughput::run(args, registry),
        Bench::Effects(args) => effects(args, registry),
        Bench::Accuracy(args) => accuracy::run(args, registry),
        Bench::Scale(args) => scale::run(args, registry),
    }
}

/// The cube drop with a bed of `law`: E 1 MPa, ν 0.2, ρ 1000 kg/m³, friction 45°, as far as the law knows them; fixed step;
/// the cube falls at 1 m/s from 5 mm above the bed. Nothing settles or sleeps, so that every step is on all particles and any law will do.
fn bed(registry: &Registry, law: &str, grid: u32) -> Result<Scene> {
    // The finest is that of 256 with cells half as wide.
    let halves = if grid == 512 { 2 } else { 1 };
    let name = if grid == 64 { "cube-drop".to_owned() } else { format!("cube-drop-{}", grid / halves) };
    let mut scene = barchan::tasks::scene(&name, &[] as &[&str])?;
    scene.world.cell /= f64::from(halves);
    for spacing in scene.body.iter_mut().filter_map(|body| body.spacing.as_mut()) {
        *spacing /= f64::from(halves);
    }
    scene.material = vec![material(registry, law, "sand")?];
    scene.sleep.on = Some(false);
    scene.body.iter_mut().for_each(|body| body.settled = false);
    scene.time.step = Some(if grid > 128 { 5e-5 / f64::from(halves) } else { 1e-4 });
    for tool in &mut scene.tool {
        tool.position[2] = 0.255;
        if let Motion::Free { linear, .. } = &mut tool.motion {
            *linear = [0.0, 0.0, -1.0];
        }
    }
    Ok(scene)
}

fn material(registry: &Registry, law: &str, name: &str) -> Result<MaterialSpec> {
    let values = [("young_modulus", 1e6), ("poisson_ratio", 0.2), ("friction_angle", std::f64::consts::FRAC_PI_4)];
    let known = &registry.material(law)?.parameters;
    let parameters = values.into_iter().filter(|(key, _)| known.iter().any(|p| p.name == *key));
    Ok(MaterialSpec {
        name: name.to_owned(),
        law: law.to_owned(),
        density: 1000.0,
        damping: 0.0,
        parameters: parameters.map(|(key, value)| (key.to_owned(), value)).collect(),
    })
}

/// What is timed: a simulation, or worlds.
enum Subject {
    One(Box<Simulation>),
    Worlds(Box<Worlds>),
}

impl Subject {
    /// So many worlds of a scene; one has all threads.
    fn new(registry: &Registry, scene: &Scene, engine: &EngineArgs, worlds: usize) -> Result<Self> {
        if worlds == 1 {
            return Ok(Self::One(Box::new(Simulation::new(registry, scene, &engine.options())?)));
        }
        Ok(Self::Worlds(Box::new(Worlds::of(registry, scene, worlds, scene.seed, &engine.options())?)))
    }

    /// Takes steps, as many at once as the backend likes.
    fn advance(&mut self, steps: u32) -> Result<()> {
        let mut left = steps as usize;
        match self {
            Self::One(simulation) => {
                while left > 0 {
                    left -= simulation.steps(left, f64::INFINITY)?.len();
                }
                Ok(())
            }
            Self::Worlds(worlds) => worlds.steps(left).into_iter().try_for_each(|reports| reports.map(drop)),
        }
    }

    fn all(&self) -> Vec<&Simulation> {
        match self {
            Self::One(simulation) => vec![&**simulation],
            Self::Worlds(worlds) => worlds.iter().collect(),
        }
    }

    /// Time by effect: of all worlds, or of the batch that they are.
    fn timings(&self) -> Vec<Timing> {
        let together = matches!(self, Self::Worlds(worlds) if worlds.are_together());
        let mut sums: Vec<Timing> = Vec::new();
        for timing in self.all().into_iter().take(if together { 1 } else { usize::MAX }).flat_map(Simulation::timings) {
            match sums.iter_mut().find(|sum| sum.effect == timing.effect) {
                Some(sum) => {
                    sum.seconds += timing.seconds;
                    sum.passes += timing.passes;
                }
                None => sums.push(timing),
            }
        }
        sums
    }

    fn particles(&self) -> usize {
        self.all().iter().map(|world| world.particle_count()).sum()
    }

    fn bytes(&self) -> u64 {
        self.all().iter().map(|world| world.memory().0).sum()
    }
}

/// A subject that is timed in repetitions of some steps.
struct Timed {
    subject: Subject,
    /// Wall seconds of each repetition, in order.
    seconds: Vec<f64>,
    steps: u32,
    passes: f64,
}

impl Timed {
    fn new(mut subject: Subject, effort: &Effort) -> Result<Self> {
        subject.advance(effort.warm_up)?;
        Ok(Self { subject, seconds: Vec::new(), steps: effort.steps, passes: 0.0 })
    }
    fn repeat(&mut self) -> Result<()> {
        let passes = |s: &Subject| s.timings().iter().map(|t| t.passes).sum::<u64>();
        let before = passes(&self.subject);
        let start = Instant::now();
        self.subject.advance(self.steps)?;
        self.seconds.push(start.elapsed().as_secs_f64());
        self.passes = (passes(&self.subject) - before) as f64 / f64::from(self.steps);
        Ok(())
    }
    /// The first world, or the only one.
    fn simulation(&self) -> &Simulation {
        self.subject.all()[0]
    }
    /// Median seconds of a step.
    fn step(&self) -> f64 {
        median(&self.seconds) / f64::from(self.steps)
    }
    fn particles(&self) -> f64 {
        self.subject.particles() as f64
    }
    fn bytes_per_particle(&self) -> f64 {
        self.subject.bytes() as f64 / self.particles()
    }
}

/// What the system says about a file, as an error of ours.
fn io_error(file: &Path, what: &'static str) -> impl FnOnce(io::Error) -> Error {
    let file = file.to_owned();
    move |source| Error::Io { file, what, source }
}

/// Makes an output folder and writes texts into it, by name.
pub(crate) fn write_texts(out: &Path, texts: &[(&str, String)]) -> Result<()> {
    fs::create_dir_all(out).map_err(io_error(out, "this output folder cannot be made (choose another with --out)"))?;
    texts.iter().try_for_each(|(name, text)| {
        let file = out.join(name);
        fs::write(&file, text).map_err(io_error(&file, "writing the report"))
    })
}

/// Writes a chart as PNG and SVG.
pub(crate) fn write_chart(chart: &Chart, file: &Path) -> Result<()> {
    chart.write(file).map_err(io_error(file, "writing a chart"))
}

fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// From the first quartile to the third.
fn quartiles_apart(values: &[f64]) -> f64 {
    quantile(values, 0.75) - quantile(values, 0.25)
}

/// The value below which a share of the values lies, straight between the two nearest.
fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = share * (sorted.len() - 1) as f64;
    let (low, high) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    low + place.fract() * (high - low)
}

/// A row of the ablation table: the scene with the effect, and the base with the effect declared but out of use.
struct Row {
    effect: &'static str,
    with: Scene,
    unused: Option<Scene>,
}

/// The effects there are, each on the same bed.
fn rows(registry: &Registry, grid: u32) -> Result<Vec<Row>> {
    let without_tool = |law: &str| {
        let mut scene = bed(registry, law, grid)?;
        scene.tool.clear();
        // Snow stiffens as it is pressed: the steps of all rows are those of the fixed step, cut if they must be.
        scene.time.over_bound = OverBound::Substep;
        Ok(scene)
    };
    let base = without_tool("neo_hookean")?;
    let declared = |law: &str| -> Result<Scene> {
        let mut scene = base.clone();
        scene.material.push(material(registry, law, "unused")?);
        Ok(scene)
    };
    let with_tool = |scene: &Scene, motion: Option<Motion>, above: f64| -> Result<Scene> {
        let mut tool = bed(registry, "sand", grid)?.tool.remove(0);
        tool.position[2] += above;
        if let Some(motion) = motion {
            tool.motion = motion;
        }
        let mut scene = scene.clone();
        scene.tool.push(tool);
        Ok(scene)
    };
    let driven = Motion::Velocity { linear: [0.0, 0.0, -1.0], angular: [0.0; 3] };
    let sand = without_tool("sand")?;
    Ok(vec![
        Row { effect: "base: neo_hookean", with: base.clone(), unused: None },
        Row { effect: "sand instead", with: sand.clone(), unused: Some(declared("sand")?) },
        Row { effect: "snow instead", with: without_tool("snow")?, unused: Some(declared("snow")?) },
        Row {
            effect: "sand, driven tool",
            with: with_tool(&sand, Some(driven), 0.0)?,
            unused: Some(with_tool(&base, Some(Motion::Fixed), 0.4)?),
        },
        Row { effect: "sand, free body (two-way)", with: with_tool(&sand, None, 0.0)?, unused: None },
        Row { effect: "sand, standing robot", with: with_robot(&sand, 0.0), unused: Some(with_robot(&base, 0.2)) },
    ])
}

/// A scene with a quadruped whose feet are so far above the bed [m].
fn with_robot(scene: &Scene, above: f64) -> Scene {
    let mut scene = scene.clone();
    let [x, y] = [0, 1].map(|d| 0.5 * (scene.world.min[d] + scene.world.max[d]));
    // Its trunk's height as it stands, above the bed's 0.2 m.
    let mut robot = Robot::built_in("dog", "quadruped").at([x, y, 0.2 + 0.325 + above]).with_motors(250.0, 5.0);
    robot.joints = [("*_thigh_joint".to_owned(), 0.8), ("*_calf_joint".to_owned(), -1.6)].into();
    scene.robot.push(robot);
    scene
}

/// What a scene costs.
#[derive(Serialize)]
struct Cost {
    ms_per_step: f64,
    ns_per_particle_step: f64,
    passes_per_step: f64,
    bytes_per_particle: f64,
}

impl Cost {
    fn of(timed: &Timed) -> Self {
        Self {
            ms_per_step: 1e3 * timed.step(),
            ns_per_particle_step: 1e9 * timed.step() / timed.particles(),
            passes_per_step: timed.passes,
            bytes_per_particle: timed.bytes_per_particle(),
        }
    }
}

/// What something declared but not used adds to the base.
#[derive(Serialize)]
struct Unused {
    /// Share of the base's time.
    time: f64,
    passes_per_step: f64,
    bytes_per_particle: f64,
}

/// A line of the ablation table.
#[derive(Serialize)]
struct Line {
    effect: &'static str,
    #[serde(flatten)]
    cost: Cost,
    unused: Option<Unused>,
}

fn effects(args: &Effects, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    let rows = rows(&registry, args.grid)?;
    let timed = |scene: &Scene| Timed::new(Subject::new(&registry, scene, &args.engine, 1)?, &args.effort);
    let repetitions = args.effort.repetitions;
    let mut table = Vec::new();
    for row in &rows {
        let mut with = timed(&row.with)?;
        (0..repetitions).try_for_each(|_| with.repeat())?;
        // What is not used is told apart from the base by taking turns with it, so that both see the same machine.
        let compare = |scene: &Scene| -> Result<Unused> {
            let (mut base, mut unused) = (timed(&rows[0].with)?, timed(scene)?);
            (0..repetitions).try_for_each(|_| base.repeat().and_then(|()| unused.repeat()))?;
            Ok(Unused {
                time: unused.step() / base.step() - 1.0,
                passes_per_step: unused.passes - base.passes,
                bytes_per_particle: unused.bytes_per_particle() - base.bytes_per_particle(),
            })
        };
        let unused = row.unused.as_ref().map(compare).transpose()?;
        table.push(Line { effect: row.effect, cost: Cost::of(&with), unused });
    }
    if args.effort.json {
        let figures = json!({
            "grid": args.grid, "precision": args.engine.precision, "threads": args.engine.threads, "effects": table,
        });
        show(format!("{figures:#}\n"));
        return Ok(());
    }
    show(format!("{:<74}   declared but not used\n", ""));
    show(format!(
        "{:<28}{:>10}{:>14}{:>10}{:>12}   {:>10}{:>9}{:>9}\n",
        "effect", "ms/step", "ns/particle", "passes", "B/particle", "time", "passes", "bytes"
    ));
    for Line { effect, cost, unused } in table {
        let unused = unused.map_or_else(String::new, |u| {
            format!("{:>+8.1} %{:>+9.1}{:>+9.1}", 100.0 * u.time, u.passes_per_step, u.bytes_per_particle)
        });
        show(format!(
            "{effect:<28}{:>10.3}{:>14.2}{:>10.1}{:>12.0}   {unused}\n",
            cost.ms_per_step, cost.ns_per_particle_step, cost.passes_per_step, cost.bytes_per_particle
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_is_a_scene_that_can_be_assembled() {
        let registry = barchan::registry();
        for row in rows(&registry, 32).unwrap() {
            for scene in [Some(&row.with), row.unused.as_ref()].into_iter().flatten() {
                let planned = barchan::Plan::assemble(&registry, scene, &barchan::Options::default());
                planned.unwrap_or_else(|e| panic!("{}: {e}", row.effect));
            }
        }
    }

    #[test]
    fn the_median_is_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0]), 2.5);
        assert_eq!(quartiles_apart(&[1.0, 5.0, 3.0, 2.0, 4.0]), 2.0);
        assert_eq!(quartiles_apart(&[7.0]), 0.0);
    }
}
