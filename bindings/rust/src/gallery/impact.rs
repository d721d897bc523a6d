//! A7: a sphere that falls into sand.

use super::{Bed, Outcome, line, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};

const DIAMETER: f64 = 0.025;
/// Friction of the sand, and its density [kg/m³].
const FRICTION: f64 = 0.3;
const GROUND: f64 = 1510.0;
const DENSITIES: [f64; 3] = [700.0, 2200.0, 7800.0];
const HEIGHTS: [f64; 3] = [0.05, 0.1, 0.2];
/// Cells along the bed.
const CELLS: u32 = 36;

/// How deep a sphere of a density [kg/m³] that falls from a height [m] is when it stops [m], on so many cells along 15 cm.
///
/// # Errors
/// Those of a simulation.
pub fn impact(density: f64, height: f64, cells: u32) -> Result<f64> {
    let cell = 0.15 / f64::from(cells);
    let bed = Bed { cell, extent: [0.15, 0.1], density: GROUND, young: 5e5, friction: FRICTION };
    let (mass, gap) = (density * std::f64::consts::PI / 6.0 * DIAMETER.powi(3), 1.5 * cell);
    let mut changes = bed.changes();
    changes.extend([
        format!("tool.tool.position=[0.075, 0.075, {:?}]", 0.1 + 0.5 * DIAMETER + gap),
        format!("tool.tool.motion.free.mass={mass:?}"),
        format!("tool.tool.motion.free.linear=[0.0, 0.0, {:?}]", -(2.0 * 9.81 * (height - gap)).sqrt()),
    ]);
    let mut s = simulation("sphere-impact", &changes, Precision::F32)?;
    let first = s.bodies()[0].position[2];
    while s.time() < 0.3 && s.bodies()[0].velocity[2] < 0.0 {
        s.step()?;
    }
    Ok(first - s.bodies()[0].position[2] - gap)
}

/// Depth of an impact from a total drop, height and depth together [m].
///
/// # Source
/// Uehara et al. 2003, Low-speed impact craters in loose granular media.
pub fn uehara(density: f64, drop: f64) -> f64 {
    0.14 / FRICTION * (density / GROUND).sqrt() * DIAMETER.powf(2.0 / 3.0) * drop.cbrt()
}

/// Contact acts from a cell off a body's surface on. Where a sphere stops a few cells deep, this layer counts: figures are of the sphere with its layer, which
/// is what the sand feels, and the depth of the sphere itself is told besides.
pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let layer = 0.15 / f64::from(CELLS);
    let mut rows = Vec::new();
    for density in DENSITIES {
        for height in HEIGHTS {
            let depth = impact(density, height, CELLS)? + layer;
            rows.push([density, height + depth, depth]);
        }
    }
    let slope = |density: &f64| {
        let of = rows.iter().filter(|r| r[0] == *density).map(|r| [r[1].ln(), r[2].ln()]);
        line(&of.collect::<Vec<_>>())[0]
    };
    let drop = DENSITIES.iter().map(slope).sum::<f64>() / DENSITIES.len() as f64;
    outcome.add("exponent of the total drop", drop, 1.0 / 3.0, 0.08);
    let points: Vec<[f64; 2]> = rows.iter().map(|r| [r[0].ln(), r[2].ln() - r[1].ln() / 3.0]).collect();
    outcome.add("exponent of the density", line(&points)[0], 0.5, 0.1);
    let mean = |off: f64| {
        let ratio = |r: &[f64; 3]| ((r[2] - off) / uehara(r[0], r[1] - off)).ln();
        (rows.iter().map(ratio).sum::<f64>() / rows.len() as f64).exp()
    };
    outcome.add("depth over the formula, mean", mean(0.0), 1.0, 0.3);
    outcome.add("the same without the layer of contact", mean(layer), 1.0, 0.3);
    let of = |r: &[f64; 3]| [1e3 * uehara(r[0], r[1]), 1e3 * r[2]];
    let measured = |density: f64| {
        series(&format!("{density} kg/m³"), rows.iter().filter(move |r| r[0] == density).map(of), Style::Points)
    };
    let mut all: Vec<_> = DENSITIES.map(measured).into();
    all.extend(theory(&spread(9.0, 70.0, 60), &[&|x| [x, 0.3 * x]]));
    outcome.chart = Chart {
        title: "A sphere of 2.5 cm falls into sand from 5, 10 and 20 cm".to_owned(),
        x: "depth by Uehara et al. [mm]".to_owned(),
        y: "depth, with the layer of contact [mm]".to_owned(),
        series: all,
        axes: Axes::Logarithmic,
    };
    Ok(outcome)
}
