//! `barchan bench scale`: the ground grows, the tool and the finest cell do not.

use super::{Effort, Subject, Timed};
use crate::EngineArgs;
use crate::print::show;
use barchan::picture::{Axes, Chart, Series, Style};
use barchan::{Error, Plan, Registry, Result, Scene};
use clap::Args;
use serde::Serialize;
use serde_json::json;
use std::collections::BTreeSet;
use std::path::PathBuf;

/// Depth of the bed [m].
const DEPTH: f64 = 0.25;

#[derive(Args)]
pub(crate) struct Scale {
    /// Sides of the bed [m].
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 2.0, 4.0, 8.0])]
    extents: Vec<f64>,
    /// Finest cells in a metre.
    #[arg(long, default_value_t = 64)]
    cells: u32,
    /// Numbers of levels beside the uniform grid.
    #[arg(long, value_delimiter = ',', default_values_t = [3, 5])]
    levels: Vec<u32>,
    /// Sides of the worlds in which only the ground around the tool is live [m].
    #[arg(long, value_delimiter = ',', default_values_t = [10.0, 20.0, 40.0, 80.0])]
    worlds: Vec<f64>,
    /// levels.reach in those worlds.
    #[arg(long, default_value_t = 8)]
    reach: u32,
    /// levels.half of the nested runs.
    #[arg(long, default_value_t = 16)]
    half: u32,
    /// Subcycle the nested runs.
    #[arg(long)]
    subcycle: bool,
    /// Runs with more particles are left out.
    #[arg(long, default_value_t = 10_000_000)]
    cap: usize,
    /// Output folder [default: ./out/scale].
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    effort: Effort,
    #[command(flatten)]
    engine: EngineArgs,
}

/// A bed and what it costs.
#[derive(Clone, Debug, Serialize)]
struct Row {
    extent_m: f64,
    levels: u32,
    /// Coarsest cells around the tool that are live; 0: all of the bed.
    reach: u32,
    particles: usize,
    /// Why there are no figures.
    skipped: Option<String>,
    /// What the plan warned of.
    warnings: Vec<String>,
    ms_per_step: Option<f64>,
    /// Simulated time of a step [ms].
    step_ms: Option<f64>,
    /// Bytes of particles and grid.
    memory_bytes: Option<u64>,
}

/// A bed, and its simulation if it is to be timed.
type Bed = (Row, Option<Timed>);
/// What is drawn of a row.
type Figure = fn(&Row) -> Option<f64>;

/// A bed of sand `extent` wide, and a ball half sunk in its middle that is drawn along x.
fn bed(args: &Scale, extent: f64, levels: u32, reach: u32) -> Result<Scene> {
    let (cell, half, subcycle) = (1.0 / f64::from(args.cells), args.half, args.subcycle);
    let middle = 0.5 * extent;
    let text = format!(
        r#"
name = "scale"
[world]
cell = {cell}
min = [0.0, 0.0, 0.0]
max = [{extent}, {extent}, 1.0]
walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }}
[levels]
count = {levels}
half = {half}
reach = {reach}
subcycle = {subcycle}
[time]
end = 10.0
[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = {{ young_modulus = 1e6, friction_angle_deg = 35.0 }}
[[body]]
name = "bed"
material = "sand"
shape = {{ box = {{ min = [0.0, 0.0, 0.0], max = [{extent}, {extent}, {DEPTH}] }} }}
settled = true
[[tool]]
name = "ball"
shape = {{ sphere = {{ radius = 0.06 }} }}
position = [{middle}, {middle}, {DEPTH}]
motion = {{ velocity = {{ linear = [0.3, 0.0, 0.0] }} }}
"#
    );
    Scene::from_str(&text, "the bed of bench scale", "")
}

pub(crate) fn run(args: &Scale, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("out/scale"));
    let mut rows = Vec::new();
    let whole = std::iter::once(1).chain(args.levels.iter().copied()).map(|levels| (levels, 0, &args.extents));
    let reached = args.levels.iter().map(|&levels| (levels, args.reach, &args.worlds));
    for (levels, reach, extents) in whole.chain(reached) {
        let beds = measure(args, &registry, extents, levels, reach)?;
        if !args.effort.json {
            beds.iter().for_each(|row| show(format!("{}\n", line(row))));
        }
        rows.extend(beds);
    }
    let statement = [statement(&rows), statement_of_reach(&rows)].join("\n");
    let report = json!({
        "version": env!("CARGO_PKG_VERSION"), "cell_m": 1.0 / f64::from(args.cells), "half": args.half, "reach": args.reach, "subcycle": args.subcycle,
        "backend": args.engine.backend(), "precision": args.engine.precision, "threads": args.engine.threads,
        "rows": rows, "statement": statement,
    });
    let table = markdown(args, &rows, &statement);
    super::write_texts(&out, &[("scale.json", format!("{report:#}\n")), ("scale.md", table)])?;
    let drawn: [(&str, &str, Figure); 2] = [
        ("scale-time", "wall time of a simulated second [s]", |row| Some(row.ms_per_step? / row.step_ms?)),
        ("scale-memory", "memory of particles and grid [MB]", |row| Some(1e-6 * row.memory_bytes? as f64)),
    ];
    for (name, y, value) in drawn {
        super::write_chart(&chart(args, &rows, y, value), &out.join(name))?;
    }
    if args.effort.json {
        show(format!("{report:#}\n"));
    } else {
        show(format!("\n{statement}\noutput in {}\n", out.display()));
    }
    Ok(())
}

/// Times beds of one kind, unless they have too many particles or the backend cannot run them. They take turns, so that all of them
/// meet the machine's slow and fast minutes alike.
fn measure(args: &Scale, registry: &Registry, extents: &[f64], levels: u32, reach: u32) -> Result<Vec<Row>> {
    let beds = extents.iter().map(|&extent| prepare(args, registry, extent, levels, reach));
    let mut beds = beds.collect::<Result<Vec<_>>>()?;
    let clock = |timed: &Timed| (timed.simulation().time(), timed.simulation().step_count());
    let begins: Vec<_> = beds.iter().map(|(_, timed)| timed.as_ref().map(clock)).collect();
    for _ in 0..args.effort.repetitions {
        beds.iter_mut().filter_map(|(_, timed)| timed.as_mut()).try_for_each(Timed::repeat)?;
    }
    let finish = |((row, timed), begin): (Bed, Option<(f64, u64)>)| {
        let Some((timed, (time, steps))) = timed.zip(begin) else { return row };
        let (in_particles, in_grid) = timed.simulation().memory();
        let steps = (timed.simulation().step_count() - steps) as f64;
        Row {
            particles: timed.simulation().particle_count(),
            ms_per_step: Some(1e3 * timed.step()),
            step_ms: Some(1e3 * (timed.simulation().time() - time) / steps),
            memory_bytes: Some(in_particles + in_grid),
            ..row
        }
    };
    Ok(beds.into_iter().zip(begins).map(finish).collect())
}

/// A bed after its warm-up, or why it is left out.
fn prepare(args: &Scale, registry: &Registry, extent: f64, levels: u32, reach: u32) -> Result<(Row, Option<Timed>)> {
    let scene = bed(args, extent, levels, reach)?;
    let spacing = 0.5 / f64::from(args.cells);
    let mut row = Row {
        extent_m: extent,
        levels,
        reach,
        particles: (extent * extent * DEPTH / spacing.powi(3)).round() as usize,
        skipped: None,
        warnings: Vec::new(),
        ms_per_step: None,
        step_ms: None,
        memory_bytes: None,
    };
    // Nested levels are counted by placing their particles, a uniform grid's are known before.
    if levels > 1 {
        let plan = Plan::assemble(registry, &scene, &args.engine.options())?.0;
        (row.particles, row.warnings) = (plan.particle_count, plan.warnings);
    }
    if row.particles > args.cap {
        return Ok((Row { skipped: Some(format!("more than {} particles", args.cap)), ..row }, None));
    }
    let timed = Subject::new(registry, &scene, &args.engine, 1).and_then(|subject| Timed::new(subject, &args.effort));
    match timed {
        Ok(timed) => Ok((row, Some(timed))),
        Err(error @ Error::Missing { .. }) => Ok((Row { skipped: Some(error.to_string()), ..row }, None)),
        Err(error) => Err(error),
    }
}

fn name(levels: u32, reach: u32) -> String {
    match (levels, reach) {
        (1, _) => "uniform grid".to_owned(),
        (_, 0) => format!("{levels} levels"),
        _ => format!("{levels} levels, reach {reach}"),
    }
}

fn line(row: &Row) -> String {
    let start = format!("{}, {} m: {} particles", name(row.levels, row.reach), row.extent_m, row.particles);
    match (row.ms_per_step, row.memory_bytes) {
        (Some(ms), Some(bytes)) => format!("{start}, {ms:.3} ms a step, {:.1} MB", 1e-6 * bytes as f64),
        _ => format!("{start}, skipped: {}", row.skipped.as_deref().unwrap_or("not run")),
    }
}

/// How much nested levels save on the largest bed that both ran on, and how they grow beyond it.
fn statement(rows: &[Row]) -> String {
    let of = |levels: u32| {
        rows.iter().filter(move |row| row.levels == levels && row.reach == 0 && row.ms_per_step.is_some())
    };
    let Some(uniform) = of(1).max_by(|a, b| a.extent_m.total_cmp(&b.extent_m)) else {
        return "No uniform grid was below the cap: there is nothing to compare with.".to_owned();
    };
    let mut counts: Vec<u32> = rows.iter().map(|row| row.levels).filter(|levels| *levels > 1).collect();
    counts.sort_unstable();
    counts.dedup();
    let sentences = counts.into_iter().filter_map(|levels| {
        let nested = of(levels).find(|row| row.extent_m == uniform.extent_m)?;
        let (first, last) = (of(levels).next()?, of(levels).next_back()?);
        let ratio = |a: &Row, b: &Row, get: Figure| Some(get(a)? / get(b)?);
        let time: Figure = |row| Some(row.ms_per_step? / row.step_ms?);
        let memory: Figure = |row| row.memory_bytes.map(|bytes| bytes as f64);
        Some(format!(
            "{levels} levels at {} m take {:.2} of the uniform grid's wall time for the same simulated time and {:.2} of its memory; from {} m to \
             {} m, {:.0} times the area, their time grows {:.2}-fold and their memory {:.2}-fold.",
            uniform.extent_m,
            ratio(nested, uniform, time)?,
            ratio(nested, uniform, memory)?,
            first.extent_m,
            last.extent_m,
            (last.extent_m / first.extent_m).powi(2),
            ratio(last, first, time)?,
            ratio(last, first, memory)?
        ))
    });
    sentences.collect::<Vec<_>>().join("\n")
}

/// What the size of the world costs where only the ground around the tool is live.
fn statement_of_reach(rows: &[Row]) -> String {
    let of = rows.iter().filter(|row| row.reach > 0 && row.ms_per_step.is_some()).collect::<Vec<_>>();
    let sentences = of.chunk_by(|a, b| a.levels == b.levels).filter_map(|worlds| {
        let (first, last) = (worlds.first()?, worlds.last()?);
        let spread = |get: Figure| {
            let values = worlds.iter().map(|row| get(row)).collect::<Option<Vec<f64>>>()?;
            let least = values.iter().copied().fold(f64::INFINITY, f64::min);
            Some(100.0 * (values.iter().copied().fold(0.0, f64::max) / least - 1.0))
        };
        Some(format!(
            "{} levels of which {} cells around the boxes are live, in worlds from {} m to {} m: wall times of a step differ by at most {:.1} %, \
             memory by {:.1} %, particles by {:.1} %.",
            first.levels,
            first.reach,
            first.extent_m,
            last.extent_m,
            spread(|row| row.ms_per_step)?,
            spread(|row| row.memory_bytes.map(|bytes| bytes as f64))?,
            spread(|row| Some(row.particles as f64))?
        ))
    });
    sentences.collect::<Vec<_>>().join("\n")
}

fn markdown(args: &Scale, rows: &[Row], statement: &str) -> String {
    let mut out = format!(
        "# Scale\n\nA ball drawn through a bed of sand {DEPTH} m deep, finest cell 1/{} m, `levels.half = {}`{}; backend {}, {}. Median of {} \
         repetitions of {} steps, beds of a kind in turns.\n\n| run | bed [m] | particles | step [ms] | wall time of a step [ms] | memory [MB] |\n\
         | --- | ---: | ---: | ---: | ---: | ---: |\n",
        args.cells,
        args.half,
        if args.subcycle { ", subcycled" } else { "" },
        args.engine.backend(),
        args.engine.precision,
        args.effort.repetitions,
        args.effort.steps
    );
    for row in rows {
        let number = |value: Option<f64>| value.map_or("–".to_owned(), |v| format!("{v:.3}"));
        let time = row.skipped.clone().map_or_else(|| number(row.ms_per_step), |why| format!("skipped: {why}"));
        let memory = row.memory_bytes.map(|bytes| 1e-6 * bytes as f64);
        out.push_str(&format!(
            "| {} | {} | {} | {} | {time} | {} |\n",
            name(row.levels, row.reach),
            row.extent_m,
            row.particles,
            number(row.step_ms),
            number(memory)
        ));
    }
    let warnings: BTreeSet<_> =
        rows.iter().flat_map(|row| row.warnings.iter().map(move |what| (name(row.levels, row.reach), what))).collect();
    out.push_str(&format!("\n{statement}\n"));
    warnings.into_iter().for_each(|(name, what)| out.push_str(&format!("\nWarning of {name}: {what}\n")));
    out
}

fn chart(args: &Scale, rows: &[Row], y: &str, value: Figure) -> Chart {
    let whole = std::iter::once(1).chain(args.levels.iter().copied()).map(|levels| (levels, 0));
    let reached = args.levels.iter().map(|&levels| (levels, args.reach));
    let series = whole.chain(reached).map(|(levels, reach)| {
        let of = rows.iter().filter(|row| (row.levels, row.reach) == (levels, reach));
        let points = of.filter_map(|row| Some((row.extent_m, value(row)?, particles(row.particles)))).collect();
        Series { name: name(levels, reach), points, style: Style::Joined }
    });
    Chart {
        title: format!("Ground around one tool, finest cell 1/{} m; labels: particles", args.cells),
        x: "side of the bed [m]".to_owned(),
        y: y.to_owned(),
        series: series.collect(),
        axes: Axes::Logarithmic,
    }
}

/// A number of particles for people.
fn particles(count: usize) -> String {
    match count {
        0..10_000 => count.to_string(),
        10_000..1_000_000 => format!("{} k", count / 1000),
        _ => format!("{:.1} M", 1e-6 * count as f64),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(levels: u32, extent_m: f64, ms: Option<f64>) -> Row {
        let memory_bytes = ms.map(|ms| (1e6 * ms) as u64);
        Row {
            extent_m,
            levels,
            reach: 0,
            particles: 1,
            skipped: None,
            warnings: Vec::new(),
            ms_per_step: ms,
            step_ms: ms.map(|_| 0.5),
            memory_bytes,
        }
    }

    #[test]
    fn the_statement_compares_at_the_largest_common_extent() {
        let rows = [row(1, 1.0, Some(10.0)), row(1, 2.0, None), row(3, 1.0, Some(5.0)), row(3, 2.0, Some(6.0))];
        let text = statement(&rows);
        assert!(text.contains("3 levels at 1 m take 0.50 of"), "{text}");
        assert!(text.contains("from 1 m to 2 m, 4 times the area, their time grows 1.20-fold"), "{text}");
        assert!(statement(&rows[1..2]).contains("nothing to compare"));
    }

    #[test]
    fn the_statement_of_reach_gives_the_spread_over_worlds() {
        let world = |extent_m: f64, ms: f64| Row { reach: 8, ..row(3, extent_m, Some(ms)) };
        let text = statement_of_reach(&[row(3, 8.0, Some(90.0)), world(10.0, 5.0), world(80.0, 5.25)]);
        assert!(
            text.contains("from 10 m to 80 m: wall times of a step differ by at most 5.0 %, memory by 5.0 %"),
            "{text}"
        );
    }
}
