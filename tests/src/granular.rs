//! What sand does to plates and spheres, beside theories and measurements of others. The suite runs them short, `examples/sand_forces.rs`
//! whole; both run the same code.

use crate::report::Outcome;
use barchan::gallery::{Bed, impact as fall};
use barchan::gallery::{Plate, Push, flat_plate, line, over_depth, series, stress_after, uehara};
use barchan::picture::{Chart, Series, Style};
use barchan::{Options, Simulation};
use std::fs;
use std::path::Path;

/// Mean stress over depth of those that are chosen [Pa/m].
fn mean_over_depth(pushes: &[Push], axis: usize, is_chosen: impl Fn(&Push) -> bool) -> f64 {
    let chosen: Vec<f64> = pushes.iter().filter(|p| is_chosen(p)).map(|p| p.stress[axis] / p.depth).collect();
    chosen.iter().sum::<f64>() / chosen.len() as f64
}

/// Adds how far a figure is off what theory says, with both.
fn beside(outcome: &mut Outcome, what: &str, measured: f64, theory: f64, tolerance: f64) {
    outcome.add(format!("{what}: {measured:.3}, theory {theory:.3}, off by"), (measured - theory).abs(), tolerance);
}

/// Writes a chart into docs/reports/plots, as SVG.
fn draw(chart: &Chart, name: &str) {
    let written = tempfile::tempdir().and_then(|folder| {
        let file = folder.path().join(name);
        chart.write(&file)?;
        let to = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/reports/plots").join(name);
        fs::copy(file.with_extension("svg"), to.with_extension("svg"))
    });
    written.unwrap_or_else(|e| panic!("{name}: {e}"));
}

/// Depth of an impact; see [`fall`].
///
/// # Panics
/// If a step fails.
fn impact(density: f64, height: f64, cells: u32) -> f64 {
    fall(density, height, cells).unwrap_or_else(|e| panic!("{e}"))
}

/// What a plate felt on its way.
///
/// # Panics
/// If a step fails.
fn pushed(plate: Plate) -> Vec<Push> {
    plate.pushed().unwrap_or_else(|e| panic!("{e}"))
}

/// Depths between which the force on a plate is held to a line [m].
const DEPTHS: [f64; 2] = [0.01, 0.06];

/// A6, short: a flat plate is pushed down, and a standing one is dragged.
///
/// Symptom of a contact or a cone that is wrong: sand bears a foot with another force than it should. Physics: the force goes linearly with depth,
/// by the slope that the friction alone gives, and sideways it is 0.37 of it.
pub fn plates_short() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate { travel: 0.05, ..Plate::coarse() };
    let down = pushed(flat);
    let [slope, _, linear] = over_depth(&down, [0.01, 0.05], 2);
    outcome.add(format!("force over depth, 1 to 5 cm: R² {linear:.4}, short of 1 by"), 1.0 - linear, 0.03);
    beside(&mut outcome, "slope over xi_n", slope / flat_plate(&flat.bed), 1.0, 0.3);
    let drag = pushed(Plate { angles: [90.0, 0.0], depth: 0.045, travel: 0.03, ..flat });
    beside(&mut outcome, "alpha_x(90, 0) over alpha_z(0, 90)", -stress_after(&drag, 0.02, 0) / slope, 0.375, 0.12);
    outcome
}

/// A6, whole: plates at several tilts and directions, how linear the forces are, and what speed, stiffness, cells and the bed's size make of them.
pub fn plates() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate::coarse();
    let (bed, xi) = (flat.bed, flat_plate(&flat.bed));
    let down = pushed(flat);
    let [slope, offset, linear] = over_depth(&down, DEPTHS, 2);
    outcome.add(format!("force over depth, 1 to 6 cm: R² {linear:.4}, short of 1 by"), 1.0 - linear, 0.01);
    beside(&mut outcome, "slope over xi_n", slope / xi, 1.0, 0.3);
    let secant = |pushes: &[Push]| mean_over_depth(pushes, 2, |p| (0.02..0.06).contains(&p.depth));
    beside(&mut outcome, "mean stress over depth, 2 to 6 cm, over xi_n", secant(&down) / xi, 1.0, 0.3);
    println!("the line meets no depth at {:.1} kPa", 1e-3 * offset);
    let ratio = |outcome: &mut Outcome, what: &str, value: f64, theory: f64| {
        beside(outcome, &format!("{what} over alpha_z(0, 90)"), value / slope, theory, 0.12);
    };
    let out = pushed(Plate { angles: [0.0, -90.0], depth: 0.08, travel: 0.065, ..flat });
    ratio(&mut outcome, "pull-out, alpha_z(0, -90)", over_depth(&out, [0.02, 0.06], 2)[0], -0.25);
    let drag = pushed(Plate { angles: [90.0, 0.0], depth: 0.045, travel: 0.06, ..flat });
    ratio(&mut outcome, "sideways, alpha_x(90, 0)", -stress_after(&drag, 0.03, 0), 0.375);
    ratio(&mut outcome, "its lift, alpha_z(90, 0)", stress_after(&drag, 0.03, 2), 0.037);
    let tilt = pushed(Plate { angles: [45.0, 90.0], depth: -0.02, travel: 0.085, ..flat });
    let along = |axis: usize| over_depth(&tilt, [0.025, 0.06], axis)[0];
    ratio(&mut outcome, "at 45 degrees, alpha_z(45, 90)", along(2), 0.564);
    ratio(&mut outcome, "at 45 degrees, alpha_x(45, 90)", along(0).abs(), 0.219);
    let fast = pushed(Plate { speed: 0.2, ..flat });
    let change = secant(&fast) / secant(&down) - 1.0;
    outcome.add(
        format!("20 instead of 10 cm/s: {:+.1} % of the mean stress, size", 100.0 * change),
        change.abs(),
        0.05,
    );
    let (mut curves, third) = (
        vec![series("6 cells", down.iter().map(|p| [100.0 * p.depth, 1e-3 * p.stress[2]]), Style::Points)],
        bed.cell * 2.0 / 3.0,
    );
    for (what, other) in [
        ("E 8 MPa", Bed { young: 4.0 * bed.young, ..bed }),
        ("9 cells", Bed { cell: third, extent: [40.0 * third, bed.extent[1]], ..bed }),
        ("wide bed", Bed { extent: [0.4, 0.2], ..bed }),
    ] {
        let pushes = pushed(Plate { bed: other, ..flat });
        let change = secant(&pushes) / secant(&down) - 1.0;
        outcome.add(
            format!(
                "{what}: {:+.1} % of the mean stress, R² {:.4}, size",
                100.0 * change,
                over_depth(&pushes, DEPTHS, 2)[2]
            ),
            change.abs(),
            0.3,
        );
        curves.push(series(what, pushes.iter().map(|p| [100.0 * p.depth, 1e-3 * p.stress[2]]), Style::Points));
    }
    curves.push(series("theory", [0.5, 6.5].map(|z| [z, 1e-5 * xi * z]), Style::Line));
    draw(
        &Chart {
            title: "A plate of 6 x 6 cm pushed into sand".to_owned(),
            x: "depth [cm]".to_owned(),
            y: "force over area [kPa]".to_owned(),
            series: curves,
            ..Chart::default()
        },
        "plate-force",
    );
    outcome
}

/// A7: spheres of several densities fall from several heights; exponents of total drop and density, and the prefactor. By measurements depth goes with
/// the cube root of the drop and the square root of the density.
///
/// Contact acts from a cell off a body's surface on. Where a sphere stops a few cells deep, this layer counts: the figures that may fail are of the sphere
/// itself, the others of the sphere and its layer, which are what the sand feels.
pub fn impacts(densities: &[f64], heights: &[f64], cells: u32) -> Outcome {
    let mut outcome = Outcome::default();
    let layer = 0.15 / f64::from(cells);
    let mut rows = Vec::new();
    for &density in densities {
        for &height in heights {
            let depth = impact(density, height, cells);
            let theory = uehara(density, height + depth);
            println!(
                "{density} kg/m³ from {height} m: {:.1} mm deep, by the formula {:.1} mm",
                1e3 * depth,
                1e3 * theory
            );
            rows.push([density, height + depth, depth]);
        }
    }
    for (what, layer) in [("with its layer", layer), ("sphere itself", 0.0)] {
        // The suite holds what does not hang on the cell.
        if layer == 0.0 && densities.len() < 3 {
            continue;
        }
        let rows: Vec<[f64; 3]> = rows.iter().map(|r| [r[0], r[1] + layer, r[2] + layer]).collect();
        let slope = |density: &f64| {
            let of = rows.iter().filter(|r| r[0] == *density).map(|r| [r[1].ln(), r[2].ln()]);
            line(&of.collect::<Vec<_>>())[0]
        };
        let mean = densities.iter().map(slope).sum::<f64>() / densities.len() as f64;
        beside(&mut outcome, &format!("{what}: exponent of the total drop"), mean, 1.0 / 3.0, 0.08);
        if densities.len() > 1 {
            let points: Vec<[f64; 2]> = rows.iter().map(|r| [r[0].ln(), r[2].ln() - r[1].ln() / 3.0]).collect();
            beside(&mut outcome, &format!("{what}: exponent of the density"), line(&points)[0], 0.5, 0.1);
        }
        let ratio = rows.iter().map(|r| (r[2] / uehara(r[0], r[1])).ln()).sum::<f64>() / rows.len() as f64;
        beside(&mut outcome, &format!("{what}: depth over the formula, mean"), ratio.exp(), 1.0, 0.3);
    }
    if densities.len() > 2 {
        // A periodic side is of whole blocks of four cells.
        let finer = (cells * 3 / 2).next_multiple_of(4);
        let change = impact(2200.0, 0.1, finer) / impact(2200.0, 0.1, cells) - 1.0;
        outcome.add(
            format!("{finer} cells instead of {cells}: {:+.1} % of the depth, size", 100.0 * change),
            change.abs(),
            0.3,
        );
    }
    if densities.len() > 2 {
        let of = |r: &[f64; 3]| [1e3 * uehara(r[0], r[1]), 1e3 * r[2]];
        let mut curves: Vec<Series> = densities
            .iter()
            .map(|density| {
                series(&format!("{density} kg/m³"), rows.iter().filter(|r| r[0] == *density).map(of), Style::Points)
            })
            .collect();
        curves.push(series("equal", [[8.0, 8.0], [80.0, 80.0]], Style::Line));
        draw(
            &Chart {
                title: "A sphere of 2.5 cm dropped into sand".to_owned(),
                x: "depth by Uehara et al. 2003 [mm]".to_owned(),
                y: "depth [mm]".to_owned(),
                series: curves,
                ..Chart::default()
            },
            "impact-depth",
        );
    }
    outcome
}

/// A plate that is put on sand sinks until the sand's work is its own: by the force on a driven plate.
///
/// By theory the force goes linearly with depth, so a weight that is put on at once sinks twice as deep as one that is let down slowly, which stops at its pressure over the slope.
pub fn sinkage() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate::coarse();
    let driven = pushed(flat);
    let xi = flat_plate(&flat.bed);
    let static_depth = 0.015;
    let pressure = xi * static_depth;
    // Work a unit of area, of the sand and of the weight.
    let (mut work, mut last, mut depth) = (0.0, 0.0, f64::NAN);
    for push in &driven {
        work += push.stress[2] * (push.depth - last);
        if depth.is_nan() && work > pressure * push.depth {
            depth = push.depth;
        }
        last = push.depth;
    }
    let at_rest = driven.iter().find(|push| push.stress[2] >= pressure).map_or(f64::NAN, |push| push.depth);
    let [width, depth_of_bed] = flat.bed.extent;
    let mut changes = flat.bed.changes();
    changes.extend([
        format!("tool.tool.position=[{:?}, {:?}, {:?}]", 0.5 * width, 0.5 * width, depth_of_bed + flat.bed.cell),
        format!("tool.tool.motion={{ free = {{ mass = {:?} }} }}", pressure * flat.side * flat.side / 9.81),
    ]);
    let options = Options { threads: 2, ..Options::default() };
    let mut s = barchan::tasks::scene("plate-in-sand", &changes)
        .and_then(|scene| Simulation::new(&barchan::registry(), &scene, &options))
        .unwrap_or_else(|e| panic!("{e}"));
    let start = s.bodies()[0].position[2];
    while s.time() < 0.6 {
        s.step().unwrap_or_else(|e| panic!("{e}"));
    }
    let sunk = start - s.bodies()[0].position[2];
    println!(
        "{:.2} kPa: sunk {:.1} mm; the driven plate bears it at {:.1} mm",
        1e-3 * pressure,
        1e3 * sunk,
        1e3 * at_rest
    );
    let relative =
        |outcome: &mut Outcome, what: &str, ratio: f64, tolerance: f64| beside(outcome, what, ratio, 1.0, tolerance);
    relative(
        &mut outcome,
        "depth at which a driven plate bears the pressure, over pressure over xi_n",
        at_rest / static_depth,
        0.3,
    );
    relative(
        &mut outcome,
        "sinkage of a weight put on at once, over that by the driven plate's work",
        sunk / depth,
        0.15,
    );
    relative(&mut outcome, "the same, over twice the pressure over xi_n", sunk / (2.0 * static_depth), 0.3);
    outcome
}
