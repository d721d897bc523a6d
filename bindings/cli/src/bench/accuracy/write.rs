//! The report of an accuracy ladder: Markdown, JSON, charts.

use super::super::{write_chart, write_texts};
use super::pareto::{Point, Time, order, time_to};
use super::{Figures, Report, Row};
use barchan::Result;
use barchan::accuracy::{Chamfer, Errors, FORCE_WINDOW, Norms};
use barchan::picture::{Axes, Chart, Series, Style};
use std::collections::BTreeMap;
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
    let json = serde_json::to_string_pretty(report).expect("a report is plain numbers and text");
    write_texts(out, &[("accuracy.json", json + "\n"), ("accuracy.md", markdown(report))])?;
    for metric in METRICS {
        for cost in COSTS {
            write_chart(&chart(report, &metric, &cost), &out.join(format!("{}-{}", metric.0, cost.0)))?;
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
        entry.levels == 1
            && entry.spacing_cells.is_none()
            && entry.seed.is_none()
            && entry.precision == reference.precision
    }
}

fn chart(report: &Report, metric: &Metric, cost: &Metric) -> Chart {
    let point = |(row, f): (&Row, &Figures)| (cost.2(f), metric.2(f), row.entry.label.clone());
    let uniform = Series {
        name: "uniform grids".to_owned(),
        points: ladder(report).into_iter().map(point).collect(),
        style: Style::Joined,
    };
    let nested = |name: &str, subcycle: bool| Series {
        name: name.to_owned(),
        points: ran(report)
            .filter(|(row, _)| row.entry.levels > 1 && row.entry.subcycle == subcycle)
            .map(point)
            .collect(),
        style: Style::Points,
    };
    let others = Series {
        name: "uniform, varied".to_owned(),
        points: ran(report).filter(|(row, _)| row.entry.levels == 1 && !report.is_plain(row)).map(point).collect(),
        style: Style::Points,
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
        axes: Axes::Logarithmic,
    }
}

/// The whole report as text.
pub(super) fn markdown(report: &Report) -> String {
    let reference = &report.reference.entry;
    let runs = report.reference.figures.as_ref().map_or(1, |f| f.wall_all_s.len());
    let mut out = format!(
        "# Accuracy: {}\n\n\
         {} s of one scene on equal extent and mass, run at many resolutions and held against the finest uniform grid, the reference: n = \
         {} cells along {} m ({} mm a cell). Barchan {}, backend {}{}, {} threads of {} cores, {}.\n\n\
         How to read the names:\n\n\
         - `n 64`: a uniform grid of 64 cells along {} m.\n\
         - `L2 k8`: 2 nested levels with `levels.half = 8`, their finest cell as wide as the reference's; with `n 64` at the end, as \
         wide as that grid's. `sub`: coarser levels take longer steps.\n\
         - `s 1/3`: particles a third of a cell apart instead of half. `f32`, `f64`: other precision. `tol`: `levels.tolerance`. \
         `jitter`: particles moved at random in their lattice at the start, with a seed.\n\
         - \"Near\" is within {} m of where the tool was lowest, seen from above. \"Off by\" is the run's value less the reference's.\n\
         - Wall time is that of the steps alone, after a short warm-up: {}.\n\n",
        report.scene,
        report.seconds,
        reference.n,
        report.length_m,
        digits(1e3 * reference.cell_m),
        report.version,
        report.backend,
        if reference.backend == report.backend {
            String::new()
        } else {
            format!(" (reference: {})", reference.backend)
        },
        if report.threads == 0 { "all".to_owned() } else { report.threads.to_string() },
        report.cores,
        reference.precision,
        report.length_m,
        report.near_m,
        if runs > 1 {
            format!("median of {runs} runs, IQR is from their first quartile to the third")
        } else {
            "one run".to_owned()
        },
    );
    costs(report, &mut out);
    surfaces(report, &mut out);
    forces(report, &mut out);
    balances(report, &mut out);
    noise(report, &mut out);
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

/// The reference and all others that ran.
fn with_reference(report: &Report) -> impl Iterator<Item = (&Row, &Figures)> {
    let reference = &report.reference;
    reference.figures.iter().map(move |figures| (reference, figures)).chain(ran(report))
}

/// A number that there may be, to three digits.
fn maybe(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), digits)
}

fn costs(report: &Report, out: &mut String) {
    let head = ["run", "cell [mm]", "particles", "steps", "wall [s]", "IQR [s]", "start-up [s]", "memory [MB]"];
    let rows = std::iter::once(&report.reference).chain(&report.rows).map(|row| {
        let Some(Figures { cost, wall_all_s, wall_iqr_s, .. }) = &row.figures else {
            return vec![row.entry.label.clone(), format!("skipped: {}", row.skipped.as_deref().unwrap_or("not run"))];
        };
        vec![
            row.entry.label.clone(),
            digits(1e3 * row.entry.cell_m),
            format!("{:.0}", cost.particles),
            cost.steps.to_string(),
            digits(cost.wall_s),
            maybe((wall_all_s.len() > 1).then_some(*wall_iqr_s)),
            digits(cost.start_up_s),
            digits(1e-6 * cost.memory_bytes as f64),
        ]
    });
    table(out, "Cost", &head, rows);
    let mut all: Vec<(&str, String)> = Vec::new();
    let mut warned: BTreeMap<&String, Vec<usize>> = BTreeMap::new();
    for (row, figures) in with_reference(report) {
        figures.warnings.iter().for_each(|what| warned.entry(what).or_default().push(all.len()));
        all.push((&row.entry.label, digits(1e3 * row.entry.cell_m)));
    }
    for (what, runs) in &warned {
        out.push_str(&format!("- Warning for {}: {what}.\n", named(&all, runs)));
    }
    if !warned.is_empty() {
        out.push('\n');
    }
}

/// How some of all runs, each with its label and its cells [mm], are called together: by their cells where none of several with such cells is left out.
fn named(all: &[(&str, String)], some: &[usize]) -> String {
    let with = |cell: &str| all.iter().filter(|(_, other)| other == cell).count();
    let are_all = |cell: &str| with(cell) > 2 && some.iter().filter(|&&i| all[i].1 == cell).count() == with(cell);
    if some.len() == all.len() {
        return "all runs".to_owned();
    }
    let mut names: Vec<String> = Vec::new();
    for &i in some {
        let (label, cell) = &all[i];
        let name = if are_all(cell) { format!("all runs on cells of {cell} mm") } else { (*label).to_owned() };
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names.join(", ")
}

fn surfaces(report: &Report, out: &mut String) {
    let head = [
        "run",
        "height near, mean error [mm]",
        "greatest [mm]",
        "height everywhere, mean error [mm]",
        "greatest [mm]",
        "crater depth [mm]",
        "off by [mm]",
        "rim height [mm]",
        "off by [mm]",
        "crater volume [cm³]",
        "off by [cm³]",
    ];
    let of = |norms: Norms| [norms.mean_mm, norms.max_mm];
    let rows = with_reference(report).map(|(row, Figures { errors: e, .. })| {
        let (crater, off) = (e.crater, e.crater_error);
        let pairs = [
            of(e.height_near),
            of(e.height),
            [crater.depth_mm, off.depth_mm],
            [crater.rim_mm, off.rim_mm],
            [crater.volume_cm3, off.volume_cm3],
        ];
        std::iter::once(row.entry.label.clone()).chain(pairs.into_iter().flatten().map(digits)).collect()
    });
    table(out, "Surface of the ground at the end", &head, rows);
    let rungs = ladder(report);
    let [.., coarse, fine] = &rungs[..] else { return };
    let at = |(row, f): &(&Row, &Figures)| (row.entry.cell_m, f.errors.height_near.mean_mm);
    let text = match order(at(coarse), at(fine), report.reference.entry.cell_m) {
        Some((q, own)) => format!(
            "From the two finest rungs the height near the tool converges with order {q:.2} (Richardson), and the reference itself \
             is off by about {} mm: smaller differences mean nothing.\n\n",
            digits(own)
        ),
        None => "The two finest rungs show no order of convergence from 0.5 to 4 for the height near the tool.\n\n"
            .to_owned(),
    };
    out.push_str(&text);
}

fn forces(report: &Report, out: &mut String) {
    let head = [
        "run",
        "tool's final z, off by [mm]",
        "its z(t), RMS error [mm]",
        "its way, off by [mm]",
        "force on it, RMS error [N]",
        "peak [N]",
        "off by [N]",
        "impulse [N s]",
        "off by [N s]",
    ];
    let rows = with_reference(report).map(|(row, Figures { errors: e, .. })| {
        let both = [e.contact, e.contact_error];
        let (peak, impulse) = (both.map(|c| Some(c?.peak_n)), both.map(|c| Some(c?.impulse_ns)));
        let cells = [e.final_z_mm, e.z_rms_mm, e.way_mm, e.force_rms_n].into_iter().chain(peak).chain(impulse);
        std::iter::once(row.entry.label.clone()).chain(cells.map(maybe)).collect()
    });
    table(out, "The first tool, or robot", &head, rows);
    out.push_str(&format!(
        "Forces are means over {} ms, so that the ringing of single cells does not count; the impulse is that of the whole run.\n\n",
        1e3 * FORCE_WINDOW
    ));
}

fn balances(report: &Report, out: &mut String) {
    let head = [
        "run",
        "mass [kg]",
        "energy change [J]",
        "off by [J]",
        "momentum unexplained [N s]",
        "angular momentum change [kg m²/s]",
        "by merging [kg m²/s]",
    ];
    let rows = with_reference(report).map(|(row, Figures { cost, balance, errors, .. })| {
        let numbers = [
            balance.energy_change_j,
            errors.energy_error_j,
            balance.momentum_drift_ns,
            balance.angular_momentum_change,
            balance.resampled_angular_momentum,
        ];
        let cells = [row.entry.label.clone(), format!("{:.4}", cost.mass_kg)];
        cells.into_iter().chain(numbers.map(digits)).collect()
    });
    table(out, "What should be kept", &head, rows);
    out.push_str(
        "Momentum unexplained is what gravity, walls, tools and ground that fell asleep do not account for. Angular momentum is that of ground and free bodies \
         about where the tool was lowest: 0 where the scene is symmetric about it.\n\n",
    );
}

/// An error that varies with the start, with its name.
type Varying = (&'static str, fn(&Errors) -> Option<f64>);
const VARYING: [Varying; 11] = [
    ("height near, mean error [mm]", |e| Some(e.height_near.mean_mm)),
    ("height near, greatest error [mm]", |e| Some(e.height_near.max_mm)),
    ("crater depth, off by [mm]", |e| Some(e.crater_error.depth_mm)),
    ("rim height, off by [mm]", |e| Some(e.crater_error.rim_mm)),
    ("crater volume, off by [cm³]", |e| Some(e.crater_error.volume_cm3)),
    ("tool's final z, off by [mm]", |e| e.final_z_mm),
    ("tool's z(t), RMS error [mm]", |e| e.z_rms_mm),
    ("tool's way, off by [mm]", |e| e.way_mm),
    ("force on the tool, RMS error [N]", |e| e.force_rms_n),
    ("peak force, off by [N]", |e| e.contact_error.map(|c| c.peak_n)),
    ("Chamfer distance near, sum of both means [mm]", |e| Some(e.chamfer_near.sum_mm())),
];

/// What random starts alone make.
fn noise(report: &Report, out: &mut String) {
    let starts: Vec<&Errors> =
        ran(report).filter(|(row, _)| row.entry.seed.is_some()).map(|(_, f)| &f.errors).collect();
    if starts.is_empty() {
        return;
    }
    let rows = VARYING.iter().filter_map(|(name, of)| {
        let values: Vec<f64> = starts.iter().filter_map(|errors| of(errors)).collect();
        let (mean, deviation) = mean_and_deviation(&values)?;
        Some(vec![(*name).to_owned(), digits(mean), maybe(deviation)])
    });
    table(out, "Noise: the reference from random starts", &["error", "mean", "standard deviation"], rows);
    out.push_str(&format!(
        "Starts of the reference with its grains moved at random in their lattice: {}. Differences between runs below these errors mean \
         nothing.\n\n",
        starts.len()
    ));
}

/// Mean, and standard deviation of a sample of two or more; `None` of nothing.
fn mean_and_deviation(values: &[f64]) -> Option<(f64, Option<f64>)> {
    let count = values.len() as f64;
    let mean = (count > 0.0).then(|| values.iter().sum::<f64>() / count)?;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    Some((mean, (count > 1.0).then(|| (squares / (count - 1.0)).sqrt())))
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
    // Another machine's time says nothing about this one's.
    let same = report.reference.entry.backend == report.backend;
    let most = report.reference.figures.as_ref().filter(|_| same).map_or(f64::INFINITY, |f| f.cost.wall_s);
    let head = ["run", "height near, mean error [mm]", "its time [s]", "uniform grids need [s]", "ratio", "how known"];
    let rows = ran(report).filter(|(row, _)| row.entry.levels > 1).map(|(row, f)| {
        let (error, wall) = (f.errors.height_near.mean_mm, f.cost.wall_s);
        let (seconds, above, how) = match time_to(&points, error) {
            Time::Between(seconds) => (Some(seconds), "", "between two rungs"),
            Time::Beyond(seconds) | Time::MoreThan(seconds) if seconds > most => {
                (Some(most), "", "beyond the finest rung: at most the reference's own time")
            }
            Time::Beyond(seconds) => (Some(seconds), "", "beyond the ladder, its line carried on"),
            Time::MoreThan(seconds) => (Some(seconds), "> ", "more than one rung beyond the ladder"),
            Time::Unknown => (None, "", "the ladder's error does not fall that far"),
        };
        let mut cells = vec![row.entry.label.clone(), digits(error), digits(wall)];
        let figure = |value: f64| format!("{above}{}", digits(value));
        cells.extend([seconds, seconds.map(|s| s / wall)].map(|v| v.map_or("–".to_owned(), figure)));
        cells.push(how.to_owned());
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
    fn deviations_are_of_a_sample() {
        assert_eq!(mean_and_deviation(&[1.0, 3.0]), Some((2.0, Some(2f64.sqrt()))));
        assert_eq!(mean_and_deviation(&[4.0]), Some((4.0, None)));
        assert_eq!(mean_and_deviation(&[]), None);
    }

    #[test]
    fn runs_on_the_same_cells_are_named_together() {
        let cells = |width: &str, labels: &[&'static str]| -> Vec<_> {
            labels.iter().map(|l| (*l, width.to_owned())).collect()
        };
        let all = [cells("16", &["n 64", "L2", "L3"]), cells("31", &["n 32", "L2 n 32"])].concat();
        let of = |some: &[usize]| named(&all, some);
        assert_eq!(of(&[0, 1, 2, 3, 4]), "all runs");
        assert_eq!(of(&[0, 1, 2, 4]), "all runs on cells of 16 mm, L2 n 32");
        assert_eq!(of(&[0, 2]), "n 64, L3");
        // Two are as quickly named.
        assert_eq!(of(&[3, 4]), "n 32, L2 n 32");
    }

    #[test]
    fn tables_are_markdown() {
        let mut out = String::new();
        table(&mut out, "T", &["a", "b"], [vec!["1".to_owned(), "2".to_owned()], vec!["3".to_owned()]].into_iter());
        assert_eq!(out, "## T\n\n| a | b |\n| --- | ---: |\n| 1 | 2 |\n| 3 |  |\n\n");
    }
}
