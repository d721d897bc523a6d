//! The report of an accuracy ladder: Markdown, JSON, charts.

use super::pareto::{Point, Time, order, time_to};
use super::{Figures, Report, Row};
use barchan::accuracy::{Chamfer, Norms};
use barchan::picture::{Chart, Series};
use barchan::{Error, Result};
use std::fs;
use std::io;
use std::path::Path;

/// UBSoft's Table 1 (CoRL 2024): its nested levels (finest 256) over its uniform grid 128, as Chamfer distance to the uniform
/// grid 256, time and particles.
const PAPER: [f64; 3] = [0.41, 0.74, 0.49];

/// An error that is drawn, with the file's stem and the axis.
type Metric = (&'static str, &'static str, fn(&Figures) -> f64);
const METRICS: [Metric; 3] = [
    ("height", "mean error of the surface's height near the tool [mm]", |f| f.errors.height_near.mean_mm),
    ("chamfer", "Chamfer distance near the tool, sum of both means [mm]", |f| f.errors.chamfer_near.sum_mm()),
    ("force", "error of the force on the tool, root mean square [N]", |f| f.errors.force_rms_n.unwrap_or(0.0)),
];
const COSTS: [Metric; 2] = [
    ("time", "wall time of the steps [s]", |f| f.cost.wall_s),
    ("memory", "memory of particles and grid [MB]", |f| 1e-6 * f.cost.memory_bytes as f64),
];

/// One run in a line.
pub(super) fn line(row: &Row) -> String {
    let label = &row.entry.label;
    match (&row.figures, &row.skipped) {
        (Some(f), _) => format!(
            "{label}: {:.0} particles, {} s, {} MB; near the tool the height is off by {} mm",
            f.cost.particles,
            digits(f.cost.wall_s),
            digits(1e-6 * f.cost.memory_bytes as f64),
            digits(f.errors.height_near.mean_mm)
        ),
        (None, why) => format!("{label}: skipped: {}", why.as_deref().unwrap_or("not run")),
    }
}

/// Writes everything into a folder.
pub(super) fn all(report: &Report, out: &Path) -> Result<()> {
    let error = |what: &'static str| move |source: io::Error| Error::Io { file: out.to_owned(), what, source };
    fs::create_dir_all(out).map_err(error("this output folder cannot be made (choose another with --out)"))?;
    let json = serde_json::to_string_pretty(report).expect("a report is plain numbers and text");
    fs::write(out.join("accuracy.json"), json + "\n").map_err(error("writing the figures"))?;
    fs::write(out.join("accuracy.md"), markdown(report)).map_err(error("writing the table"))?;
    for metric in METRICS {
        for cost in COSTS {
            let path = out.join(format!("{}-{}", metric.0, cost.0));
            chart(report, &metric, &cost).write(&path).map_err(error("writing a chart"))?;
        }
    }
    Ok(())
}

/// Rows with figures that differ from the reference in nothing but resolution, coarse to fine.
fn ladder(report: &Report) -> Vec<(&Row, &Figures)> {
    let mut rungs: Vec<(&Row, &Figures)> = ran(report).filter(|(row, _)| report.is_plain(row)).collect();
    rungs.sort_by_key(|(row, _)| row.entry.n);
    rungs
}

fn ran(report: &Report) -> impl Iterator<Item = (&Row, &Figures)> {
    report.rows.iter().filter_map(|row| Some((row, row.figures.as_ref()?)))
}

impl Report {
    fn is_plain(&self, row: &Row) -> bool {
        let (entry, reference) = (&row.entry, &self.reference.entry);
        entry.levels == 1 && entry.spacing_cells.is_none() && !entry.jitter && entry.precision == reference.precision
    }
}

fn chart(report: &Report, metric: &Metric, cost: &Metric) -> Chart {
    let point = |(row, f): (&Row, &Figures)| (cost.2(f), metric.2(f), row.entry.label.clone());
    let uniform = Series {
        name: "uniform grids".to_owned(),
        points: ladder(report).into_iter().map(point).collect(),
        joined: true,
    };
    let nested = |name: &str, subcycle: bool| Series {
        name: name.to_owned(),
        points: ran(report)
            .filter(|(row, _)| row.entry.levels > 1 && row.entry.subcycle == subcycle)
            .map(point)
            .collect(),
        joined: false,
    };
    let others = Series {
        name: "uniform, varied".to_owned(),
        points: ran(report).filter(|(row, _)| row.entry.levels == 1 && !report.is_plain(row)).map(point).collect(),
        joined: false,
    };
    let series = [uniform, nested("nested levels", false), nested("nested, subcycled", true), others];
    Chart {
        title: format!(
            "{}: {} s against a uniform grid of n = {}",
            report.scene, report.seconds, report.reference.entry.n
        ),
        x: cost.1.to_owned(),
        y: metric.1.to_owned(),
        series: series.into_iter().filter(|one| !one.points.is_empty()).collect(),
    }
}

/// The whole report as text.
pub(super) fn markdown(report: &Report) -> String {
    let reference = &report.reference.entry;
    let mut out = format!(
        "# Accuracy: {}\n\n\
         {} s on equal extent, against a uniform grid of n = {} cells along {} m ({} mm a cell). \"Near\" is within {} m of where the \
         tool was lowest, seen from above. Barchan {}, backend {}, {} threads of {} cores, {}; wall time is that of the steps alone, \
         the median if there are several runs. L2 k8 are 2 levels with `levels.half = 8` and the reference's cell as the \
         finest, n 64 at its end another; sub: subcycled; s: particle spacing in cells; tol: `levels.tolerance`.\n\n",
        report.scene,
        report.seconds,
        reference.n,
        report.length_m,
        digits(1e3 * reference.cell_m),
        report.near_m,
        report.version,
        report.backend,
        if report.threads == 0 { "all".to_owned() } else { report.threads.to_string() },
        report.cores,
        reference.precision,
    );
    costs(report, &mut out);
    errors(report, &mut out);
    chamfers(report, &mut out);
    times(report, &mut out);
    paper(report, &mut out);
    out
}

/// Writes a table; rows that end early are filled up. The columns' widths are left to the reader's program.
fn table(out: &mut String, title: &str, head: &[&str], rows: impl Iterator<Item = Vec<String>>) {
    let rule = vec!["---:"; head.len() - 1].join(" | ");
    out.push_str(&format!("## {title}\n\n| {} |\n| --- | {rule} |\n", head.join(" | ")));
    for mut row in rows {
        assert!(row.len() <= head.len(), "a row of '{title}' has more cells than the head");
        row.resize(head.len(), String::new());
        out.push_str(&format!("| {} |\n", row.join(" | ")));
    }
    out.push('\n');
}

fn costs(report: &Report, out: &mut String) {
    let head = [
        "run",
        "cell [mm]",
        "particles",
        "mass [kg]",
        "steps",
        "wall [s]",
        "start-up [s]",
        "memory [MB]",
        "energy change [J]",
    ];
    let rows = std::iter::once(&report.reference).chain(&report.rows).map(|row| {
        let Some(Figures { cost, .. }) = &row.figures else {
            return vec![row.entry.label.clone(), format!("skipped: {}", row.skipped.as_deref().unwrap_or("not run"))];
        };
        vec![
            row.entry.label.clone(),
            digits(1e3 * row.entry.cell_m),
            format!("{:.0}", cost.particles),
            format!("{:.4}", cost.mass_kg),
            cost.steps.to_string(),
            digits(cost.wall_s),
            digits(cost.start_up_s),
            digits(1e-6 * cost.memory_bytes as f64),
            digits(cost.energy_change_j),
        ]
    });
    table(out, "Cost", &head, rows);
}

fn errors(report: &Report, out: &mut String) {
    let head = [
        "run",
        "height near L1 [mm]",
        "L∞ [mm]",
        "height everywhere L1 [mm]",
        "L∞ [mm]",
        "crater depth [mm]",
        "its error [mm]",
        "tool's final z [mm]",
        "its z(t), RMS [mm]",
        "force, RMS over 5 ms means [N]",
        "energy [J]",
    ];
    let of = |norms: Norms| [digits(norms.mean_mm), digits(norms.max_mm)];
    let rows = ran(report).map(|(row, Figures { errors: e, .. })| {
        let mut cells = vec![row.entry.label.clone()];
        cells.extend(of(e.height_near));
        cells.extend(of(e.height));
        cells.extend([e.crater_depth_mm, e.crater_error_mm].map(digits));
        cells.extend([e.final_z_mm, e.z_rms_mm, e.force_rms_n].map(|v| v.map_or("–".to_owned(), digits)));
        cells.push(digits(e.energy_error_j));
        cells
    });
    table(out, "Errors against the reference", &head, rows);
    if let Some((row, Figures { errors: e, .. })) = ran(report).find(|(row, _)| row.entry.jitter) {
        let parts = [("mm in the tool's z(t)", e.z_rms_mm), ("N in the force", e.force_rms_n)];
        let parts = parts.into_iter().filter_map(|(unit, v)| Some(format!("its {} {unit}", digits(v?))));
        out.push_str(&format!(
            "Noise: {} differs from the reference only in where its grains lie at the start, and its surface is rough by {} mm. Differences \
             below {} mean nothing.\n\n",
            row.entry.label,
            digits(e.height_near.mean_mm),
            parts.collect::<Vec<_>>().join(" and ")
        ));
    }
    let rungs = ladder(report);
    let [.., coarse, fine] = &rungs[..] else { return };
    let at = |(row, f): &(&Row, &Figures)| (row.entry.cell_m, f.errors.height_near.mean_mm);
    let text = match order(at(coarse), at(fine), report.reference.entry.cell_m) {
        Some((q, own)) => format!(
            "From the two finest rungs the height near the tool converges with order {q:.2} (Richardson), and the reference itself \
             is off by about {} mm: smaller differences mean nothing.\n\n",
            digits(own)
        ),
        None => "The two finest rungs show no order of convergence from 0.1 to 4 for the height near the tool.\n\n"
            .to_owned(),
    };
    out.push_str(&text);
}

fn chamfers(report: &Report, out: &mut String) {
    let head = [
        "run",
        "near, to reference [mm]",
        "near, from reference [mm]",
        "near, both at rest [mm]",
        "all, to reference [mm]",
        "all, from reference [mm]",
        "all, both at rest [mm]",
        "all, greatest [mm]",
    ];
    let means = |c: &Chamfer| [digits(c.to_reference.mean_mm), digits(c.from_reference.mean_mm)];
    let rest = |c: &Chamfer| means(c).join(" and ");
    let rows = ran(report).map(|(row, Figures { errors: e, .. })| {
        let mut cells = vec![row.entry.label.clone()];
        cells.extend(means(&e.chamfer_near));
        cells.push(rest(&e.chamfer_near_floor));
        cells.extend(means(&e.chamfer));
        cells.push(rest(&e.chamfer_floor));
        cells.push(digits(e.chamfer.to_reference.max_mm.max(e.chamfer.from_reference.max_mm)));
        cells
    });
    table(out, "Chamfer distance: mean distance of each particle to the nearest of the other run", &head, rows);
    let spacing = report.reference.figures.as_ref().map_or(0.0, |f| 1e3 * f.spacing_m);
    out.push_str(&format!(
        "\"At rest\" is the same distance before anything has moved: what two lattices make. Particles strewn at random are {} mm from the \
         nearest of the reference's lattice (0.4803 of its {} mm), so that less means that grains still lie where the lattices match.\n\n",
        digits(0.4803 * spacing),
        digits(spacing)
    ));
}

/// "Time to reach error e": what the uniform ladder takes for each nested run's error.
fn times(report: &Report, out: &mut String) {
    let points: Vec<Point> =
        ladder(report).iter().map(|(_, f)| (f.cost.wall_s, f.errors.height_near.mean_mm)).collect();
    let most = report.reference.figures.as_ref().map_or(f64::INFINITY, |f| f.cost.wall_s);
    let head = ["run", "height near L1 [mm]", "its time [s]", "uniform grids need [s]", "ratio", "how known"];
    let rows = ran(report).filter(|(row, _)| row.entry.levels > 1).map(|(row, f)| {
        let (error, wall) = (f.errors.height_near.mean_mm, f.cost.wall_s);
        let (seconds, how) = match time_to(&points, error) {
            Time::Between(seconds) => (Some(seconds), "between two rungs".to_owned()),
            Time::Beyond(seconds) if seconds > most => {
                (Some(most), "beyond the finest rung: at most the reference's own time".to_owned())
            }
            Time::Beyond(seconds) => (Some(seconds), "beyond the ladder, its line carried on".to_owned()),
            Time::Unknown => (None, "the ladder's error does not fall that far".to_owned()),
        };
        let mut cells = vec![row.entry.label.clone(), digits(error), digits(wall)];
        cells.extend([seconds, seconds.map(|s| s / wall)].map(|v| v.map_or("–".to_owned(), digits)));
        cells.push(how);
        cells
    });
    table(out, "Time to reach the same error near the tool", &head, rows);
    out.push_str(
        "A ratio above 1: nested levels are that many times faster than a uniform grid of the same error.\n\n",
    );
}

/// Our ratios beside the paper's.
fn paper(report: &Report, out: &mut String) {
    let reference = &report.reference.entry;
    let half = ladder(report).into_iter().find(|(row, _)| 2 * row.entry.n == reference.n);
    let Some((base, uniform)) = half else {
        return out.push_str(&format!(
            "UBSoft's claim is about a uniform grid of half the reference's cells: add {} to --ladder to compare.\n",
            reference.n / 2
        ));
    };
    let ratio = |f: &Figures, of: fn(&Figures) -> f64| of(f) / of(uniform);
    let head = [
        "run",
        "Chamfer near",
        "the same at rest",
        "Chamfer everywhere",
        "height near",
        "force",
        "time",
        "particles",
        "beside the paper",
    ];
    let as_fine = |(row, _): &(&Row, &Figures)| row.entry.levels > 1 && row.entry.n == reference.n;
    let rows = ran(report).filter(as_fine).map(|(row, f)| {
        let error = ratio(f, |f| f.errors.chamfer_near.sum_mm());
        let rest = ratio(f, |f| f.errors.chamfer_near_floor.sum_mm());
        let everywhere = ratio(f, |f| f.errors.chamfer.sum_mm());
        let height = ratio(f, |f| f.errors.height_near.mean_mm);
        let force = ratio(f, |f| f.errors.force_rms_n.unwrap_or(f64::NAN));
        let [time, particles] = [ratio(f, |f| f.cost.wall_s), ratio(f, |f| f.cost.particles)];
        let verdicts = [("error", error), ("time", time), ("particles", particles)].into_iter().zip(PAPER);
        let verdict = |((what, ours), theirs): ((&str, f64), f64)| {
            format!("{what} {}", if ours <= theirs { "better" } else { "worse" })
        };
        let mut cells = vec![row.entry.label.clone()];
        cells.extend([error, rest, everywhere, height, force, time, particles].map(digits));
        cells.push(verdicts.map(verdict).collect::<Vec<_>>().join(", "));
        cells
    });
    table(
        out,
        &format!("Beside UBSoft's Table 1: nested levels over the uniform grid {}", base.entry.label),
        &head,
        rows,
    );
    let [error, time, particles] = PAPER;
    out.push_str(&format!(
        "UBSoft (CoRL 2024) prints {error} of the uniform grid's Chamfer distance at {time} of its time and {particles} of its particles, \
         against a grid of 256, without a definition of that distance. \"Better\" and \"worse\" compare our ratios, with the distance near the \
         tool, to these. Grains of the finest level start where the reference's do: what the ratio is at rest is no merit of the \
         physics. Height and force know nothing of lattices.\n",
    ));
}

/// Three significant digits.
fn digits(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let places = (2 - value.abs().log10().floor() as i32).max(0) as usize;
    format!("{value:.places$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        assert_eq!([1234.6, 12.345, 0.012_345, -3.0, 0.0].map(digits), ["1235", "12.3", "0.0123", "-3.00", "0"]);
    }

    #[test]
    fn tables_are_markdown() {
        let mut out = String::new();
        table(&mut out, "T", &["a", "b"], [vec!["1".to_owned(), "2".to_owned()], vec!["3".to_owned()]].into_iter());
        assert_eq!(out, "## T\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n| 3 |  |\n\n");
    }
}
