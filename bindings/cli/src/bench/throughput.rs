//! `barchan bench throughput`: particle-steps per second, of one law or of all on every backend.

use super::{Effort, Subject, Timed, bed};
use crate::EngineArgs;
use crate::print::show;
use barchan::scene::{OverBound, Sampling, Shape};
use barchan::{Registry, Result, Scene};
use clap::Args;
use serde::Serialize;
use serde_json::json;

#[derive(Args)]
pub(crate) struct Throughput {
    /// Law of the bed.
    #[arg(long, default_value = "sand")]
    material: String,
    /// Every law, at rest and moving, on every backend that has something to run on here, or on the one that `--backend` names.
    #[arg(long, conflicts_with = "material")]
    all: bool,
    /// Cells along 1.28 m: at 512 93 million particles, 40 GB on a GPU.
    #[arg(long, default_value = "64", value_parser = super::grids(&["32", "64", "128", "256", "512"]))]
    grid: u32,
    /// What the bed does [default: struck; with --all: resting, and moving].
    #[arg(long, value_enum)]
    ground: Option<Ground>,
    /// Side of the bed [m], as deep as it is, instead of all of it: a multiple of the cell width.
    #[arg(long, value_name = "METRES")]
    side: Option<f64>,
    /// Worlds of it, which differ in their random seeds, stepped together.
    #[arg(long, default_value_t = 1)]
    worlds: usize,
    #[command(flatten)]
    effort: Effort,
    #[command(flatten)]
    engine: EngineArgs,
}

/// What the bed does while it is timed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
enum Ground {
    /// The cube falls on it.
    Struck,
    /// It rests: a lattice, eight particles a cell, without the cube.
    Resting,
    /// Its particles, jittered, move at 1.2 m/s and pile up on a wall, without the cube.
    Moving,
}

impl Ground {
    const fn name(self) -> &'static str {
        match self {
            Self::Struck => "struck",
            Self::Resting => "resting",
            Self::Moving => "moving",
        }
    }
}

pub(super) fn run(args: &Throughput, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    if args.all { all(args, &registry) } else { one(args, &registry) }
}

/// The bed of a law, as the command line wants it.
fn scene(args: &Throughput, registry: &Registry, law: &str, ground: Ground) -> Result<Scene> {
    let mut scene = bed(registry, law, args.grid)?;
    if let Some(side) = args.side {
        cut(&mut scene, side);
    }
    if ground != Ground::Struck {
        scene.tool.clear();
        // Ground asleep takes no time: all of it is to be moved.
        scene.sleep.on = Some(false);
    }
    if ground == Ground::Moving {
        for body in &mut scene.body {
            body.sampling = Sampling::Jitter;
            body.velocity = [1.2, 0.0, 0.0];
        }
        scene.time.over_bound = OverBound::Substep;
    }
    Ok(scene)
}

/// Leaves of the bed a square, with its world, and the tools above its middle.
fn cut(scene: &mut Scene, side: f64) {
    for axis in 0..2 {
        scene.world.max[axis] = scene.world.min[axis] + side;
        for body in &mut scene.body {
            if let Shape::Box { min: Some(min), max: Some(max), .. } = &mut body.shape {
                (min[axis], max[axis]) = (scene.world.min[axis], scene.world.max[axis]);
            }
        }
        scene.tool.iter_mut().for_each(|tool| tool.position[axis] = scene.world.min[axis] + 0.5 * side);
    }
}

/// Warms a scene up and times it.
fn timed(args: &Throughput, registry: &Registry, scene: &Scene, engine: &EngineArgs) -> Result<Timed> {
    let mut timed = Timed::new(Subject::new(registry, scene, engine, args.worlds.max(1))?, &args.effort)?;
    (0..args.effort.repetitions).try_for_each(|_| timed.repeat())?;
    Ok(timed)
}

/// Particle-steps per second: in the middle of the repetitions, and in the best one.
fn rates(timed: &Timed) -> (f64, f64) {
    let least = timed.seconds.iter().copied().fold(f64::INFINITY, f64::min);
    (timed.particles() / timed.step(), timed.particles() * f64::from(timed.steps) / least)
}

fn one(args: &Throughput, registry: &Registry) -> Result<()> {
    let ground = args.ground.unwrap_or(Ground::Struck);
    let scene = scene(args, registry, &args.material, ground)?;
    let start = std::time::Instant::now();
    let timed = timed(args, registry, &scene, &args.engine)?;
    let start_up = start.elapsed().as_secs_f64() - timed.seconds.iter().sum::<f64>();
    let (rate, best) = rates(&timed);
    let timings = timed.subject.timings();
    let steps = timed.simulation().step_count() as f64;
    if args.effort.json {
        let effect = |t: &barchan::backend::Timing| json!({ "effect": t.effect, "ms_per_step": 1e3 * t.seconds / steps, "passes": t.passes });
        let figures = json!({
            "particle_steps_per_s": rate, "best": best, "ms_per_step": 1e3 * timed.step(), "material": args.material,
            "grid": args.grid, "side": args.side, "worlds": args.worlds, "particles": timed.subject.particles(), "precision": args.engine.precision,
            "threads": args.engine.threads, "steps": timed.steps, "repetitions_s": timed.seconds,
            "bytes_per_particle": timed.bytes_per_particle(), "peak_memory": barchan::run::peak_memory(),
            "start_and_warm_up_s": start_up, "effects": timings.iter().map(effect).collect::<Vec<_>>(),
        });
        show(format!("{figures:#}\n"));
        return Ok(());
    }
    show(format!(
        "{}, {}{} particles, {} threads, {}: {:.2} million particle_steps_per_s (best {:.2}), {:.3} ms a step, {:.0} bytes a particle\n",
        args.material,
        if args.worlds > 1 { format!("{} worlds, in all ", args.worlds) } else { String::new() },
        timed.subject.particles(),
        args.engine.threads,
        args.engine.precision,
        1e-6 * rate,
        1e-6 * best,
        1e3 * timed.step(),
        timed.bytes_per_particle()
    ));
    for t in timings {
        show(format!("  {:<28}{:>9.3} ms a step\n", t.effect, 1e3 * t.seconds / steps));
    }
    Ok(())
}

/// A cell of the table of laws and backends.
#[derive(Serialize)]
struct Entry {
    law: String,
    backend: String,
    ground: Ground,
    #[serde(flatten)]
    outcome: Outcome,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Outcome {
    Measured { particle_steps_per_s: f64, best: f64, ms_per_step: f64, particles: usize, bytes_per_particle: f64 },
    Refused { error: String },
}

/// The table of laws and backends, one measurement after the other.
fn all(args: &Throughput, registry: &Registry) -> Result<()> {
    let engines = engines(args, registry)?;
    let grounds = args.ground.map_or_else(|| vec![Ground::Resting, Ground::Moving], |ground| vec![ground]);
    let (mut entries, mut isa, mut first_refusal) = (Vec::new(), "", None);
    for law in registry.materials().map(|law| law.name.clone()) {
        for engine in &engines {
            for &ground in &grounds {
                let scene = scene(args, registry, &law, ground)?;
                // What one backend lacks, others may have: that is what the table is to show.
                let outcome = match timed(args, registry, &scene, engine) {
                    Ok(timed) => {
                        let (particle_steps_per_s, best) = rates(&timed);
                        isa = timed.simulation().plan().isa.name();
                        Outcome::Measured {
                            particle_steps_per_s,
                            best,
                            ms_per_step: 1e3 * timed.step(),
                            particles: timed.subject.particles(),
                            bytes_per_particle: timed.bytes_per_particle(),
                        }
                    }
                    Err(error) => {
                        let refused = Outcome::Refused { error: error.to_string() };
                        first_refusal.get_or_insert(error);
                        refused
                    }
                };
                let law = law.clone();
                entries.push(Entry { law, backend: engine.backend().to_owned(), ground, outcome });
            }
        }
    }
    if let Some(error) = first_refusal.filter(|_| isa.is_empty()) {
        // Nothing was measured.
        return Err(error);
    }
    if args.effort.json {
        let figures = json!({
            "grid": args.grid, "side": args.side, "worlds": args.worlds, "precision": args.engine.precision, "threads": args.engine.threads,
            "isa": isa, "steps": args.effort.steps, "repetitions": args.effort.repetitions, "throughput": entries,
        });
        show(format!("{figures:#}\n"));
        return Ok(());
    }
    show(format!(
        "Million particle-steps per second, the middle and the best of {} repetitions of {} steps: grid {}, {}, {} threads and {isa} on the processor\n\n",
        args.effort.repetitions, args.effort.steps, args.grid, args.engine.precision, args.engine.threads
    ));
    show(table(&entries));
    Ok(())
}

/// What the table is measured on.
fn engines(args: &Throughput, registry: &Registry) -> Result<Vec<EngineArgs>> {
    registry.backend(args.engine.backend())?;
    if args.engine.backend.is_some() {
        return Ok(vec![args.engine.clone()]);
    }
    let there = registry.backends().filter(|backend| backend.adapters().is_none_or(|those| !those.is_empty()));
    let on = |backend: &dyn barchan::Backend| EngineArgs {
        backend: Some(backend.name().to_owned()),
        // An adapter goes with the backends that run on one.
        adapter: args.engine.adapter.clone().filter(|_| backend.adapters().is_some()),
        // And parameters with the one that they are given for.
        backend_parameter: match backend.name() == args.engine.backend() {
            true => args.engine.backend_parameter.clone(),
            false => Vec::new(),
        },
        ..args.engine.clone()
    };
    Ok(there.map(on).collect())
}

/// A row for each law, a column for each backend and ground, as Markdown; below it why cells are empty.
fn table(entries: &[Entry]) -> String {
    let column = |entry: &Entry| format!("{}, {}", entry.backend, entry.ground.name());
    let columns = entries.iter().take_while(|entry| entry.law == entries[0].law).count().max(1);
    let row = |first: &str, cells: &[String]| {
        let cells: String = cells.iter().map(|cell| format!(" {cell:>16} |")).collect();
        format!("| {first:<16} |{cells}\n")
    };
    let headings: Vec<String> = entries.iter().take(columns).map(column).collect();
    let mut text = row("law", &headings);
    text += &format!("|{}\n", "---|".repeat(columns + 1));
    let mut refused = String::new();
    for law in entries.chunks(columns) {
        let cell = |entry: &Entry| match &entry.outcome {
            Outcome::Measured { particle_steps_per_s, best, .. } => {
                format!("{:.1} ({:.1})", 1e-6 * particle_steps_per_s, 1e-6 * best)
            }
            Outcome::Refused { .. } => "–".to_owned(),
        };
        text += &row(&law[0].law, &law.iter().map(cell).collect::<Vec<_>>());
        for entry in law {
            if let Outcome::Refused { error } = &entry.outcome {
                refused += &format!("\n{} on {}: {error}\n", entry.law, column(entry));
            }
        }
    }
    text + &refused
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laws_are_rows_and_what_is_refused_says_why() {
        let entry = |law: &str, backend: &str, outcome| Entry {
            law: law.to_owned(),
            backend: backend.to_owned(),
            ground: Ground::Resting,
            outcome,
        };
        let measured = |rate: f64| Outcome::Measured {
            particle_steps_per_s: rate,
            best: 1.1 * rate,
            ms_per_step: 1.0,
            particles: 1,
            bytes_per_particle: 1.0,
        };
        let refused = Outcome::Refused { error: "no WGSL".to_owned() };
        let text = table(&[
            entry("sand", "cpu", measured(2e7)),
            entry("sand", "wgpu", measured(7e9)),
            entry("clay", "cpu", measured(1e7)),
            entry("clay", "wgpu", refused),
        ]);
        let cells = |line: usize| -> Vec<&str> { text.lines().nth(line).unwrap().split('|').map(str::trim).collect() };
        assert_eq!(cells(0), ["", "law", "cpu, resting", "wgpu, resting", ""]);
        assert_eq!(cells(2), ["", "sand", "20.0 (22.0)", "7000.0 (7700.0)", ""]);
        assert_eq!(cells(3), ["", "clay", "10.0 (11.0)", "–", ""]);
        assert!(text.ends_with("\nclay on wgpu, resting: no WGSL\n"), "{text}");
    }
}
