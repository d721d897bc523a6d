//! A8: a column of sand that collapses.

use super::{Outcome, exponent, run_to, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};

/// Width of the half column [m]: 16 cells.
const WIDTH: f64 = 0.16;
/// Aspect ratios, low and tall, on either side of the law's gap.
const LOW: [f64; 3] = [0.5, 1.0, 1.5];
const TALL: [f64; 3] = [3.0, 4.5, 7.0];

/// How far the front of a column runs, over the column's width; `aspect` is its height over that width.
///
/// The front is where all but a hundredth of the particles lie behind, when the sand has come to rest: after seven times sqrt(h/g).
///
/// # Errors
/// Those of a simulation.
pub fn run_out(aspect: f64) -> Result<f64> {
    let height = aspect * WIDTH;
    let length = ((1.0 + 2.0 * law(aspect) + 0.5) * WIDTH / 0.01).ceil() * 0.01;
    let changes = [
        format!("body.column.shape.box.max=[{WIDTH}, 0.02, {height}]"),
        format!("world.max=[{length}, 0.02, {}]", ((height / 0.01).ceil() + 8.0) * 0.01),
    ];
    let mut column = simulation("column-collapse", &changes, Precision::F32)?;
    run_to(&mut column, 7.0 * (height / 9.81).sqrt())?;
    let mut places: Vec<f64> = column.spots().iter().map(|spot| spot.position[0]).collect();
    places.sort_by(f64::total_cmp);
    Ok(places[places.len() * 99 / 100] / WIDTH - 1.0)
}

/// What Lube et al. measured; between 1.8 and 2.8, straight from one to the other.
fn law(aspect: f64) -> f64 {
    let (low, tall) = (|a: f64| 1.2 * a, |a: f64| 1.9 * a.powf(2.0 / 3.0));
    match aspect {
        ..1.8 => low(aspect),
        2.8.. => tall(aspect),
        _ => low(1.8) + (aspect - 1.8) * (tall(2.8) - low(1.8)),
    }
}

pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let mut all = Vec::new();
    for (name, aspects, power) in [("low", LOW, 1.0), ("tall", TALL, 2.0 / 3.0)] {
        let points = aspects.iter().map(|&a| Ok([a, run_out(a)?])).collect::<Result<Vec<_>>>()?;
        outcome.add(format!("{name} columns: exponent of a"), exponent(&points), power, 0.1);
        let ratio = points.iter().map(|&[a, run]| (run / law(a)).ln()).sum::<f64>() / points.len() as f64;
        outcome.add(format!("{name} columns: run-out over the law, mean"), ratio.exp(), 1.0, 0.3);
        all.extend(points);
    }
    let [middle, tolerance] = theory(&spread(0.4, 8.0, 120), &[&|a| [law(a), 0.3 * law(a)]]);
    outcome.chart = Chart {
        title: "Run-out of a column of sand, in the plane".to_owned(),
        x: "height over width, a".to_owned(),
        y: "run-out over width".to_owned(),
        series: vec![series("measured", all, Style::Points), middle, tolerance],
        axes: Axes::Logarithmic,
    };
    Ok(outcome)
}
