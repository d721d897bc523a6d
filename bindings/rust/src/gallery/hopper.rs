//! A15: sand that runs out of a silo.

use super::{Outcome, exponent, line, run_to, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};

/// Cell of the scene, half the width of the silo, and where the floor begins and ends [m].
const CELL: f64 = 0.01;
const HALF: f64 = 0.26;
const FLOOR: [f64; 2] = [0.08, 0.12];
/// Head above the floor [m].
const HEAD: f64 = 0.3;
/// Widths of the opening [m]: 16 to 24 cells.
const WIDTHS: [f64; 3] = [0.16, 0.2, 0.24];
/// When the flow is steady [s].
const STEADY: [f64; 2] = [0.25, 0.5];

/// How much sand runs out of a silo that is filled to a height above its floor [m], by an opening of a width [m]: kg/s out of all four quarters.
///
/// # Errors
/// Those of a simulation.
pub fn discharge(width: f64, head: f64) -> Result<f64> {
    let edge = 0.5 * width;
    let plate =
        |x: f64, y: f64| format!("{{ shape = {{ box = {{ min = [{x:?}, {y:?}, -0.02], max = [0.4, 0.4, 0.02] }} }} }}");
    let changes = [
        format!("body.filling.shape.box.max=[{HALF}, {HALF}, {:?}]", FLOOR[1] + head),
        format!("world.max=[{HALF}, {HALF}, {:?}]", FLOOR[1] + head + 2.0 * CELL),
        format!("tool.floor.shape.union=[{}, {}]", plate(edge, -0.1), plate(-0.1, edge)),
    ];
    let mut silo = simulation("hopper-discharge", &changes, Precision::F32)?;
    let mut out = Vec::new();
    for i in 0..=25 {
        let time = STEADY[0] + (STEADY[1] - STEADY[0]) * f64::from(i) / 25.0;
        run_to(&mut silo, time)?;
        let [up, down] = silo.crossed()?[0].mass;
        out.push([silo.time(), 4.0 * (down - up)]);
    }
    Ok(line(&out)[0])
}

/// How wide an opening is between the layers of contact at its edges, which let nothing through [m].
fn free(width: f64) -> f64 {
    width - 2.0 * CELL
}

/// The exponent is that of the width between the layers of contact, a cell at either edge, as Beverloo takes a layer of grains away.
pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let rates = WIDTHS.iter().map(|&width| Ok([width, discharge(width, HEAD)?])).collect::<Result<Vec<_>>>()?;
    let higher = discharge(WIDTHS[0], 1.5 * HEAD)?;
    let between: Vec<[f64; 2]> = rates.iter().map(|&[width, rate]| [free(width), rate]).collect();
    outcome.add("exponent of the free width", exponent(&between), 2.5, 0.15);
    outcome.add("rate under a head half as high again, over rate", higher / rates[0][1], 1.0, 0.05);
    let [width, rate] = rates[1];
    let law = |x: f64| {
        let times = free(x) / free(width);
        [rate * times.powf(2.5), rate * times.powf(2.5) * 0.15 * times.ln().abs()]
    };
    let mut all = vec![
        series("measured", rates.iter().copied(), Style::Points),
        series("under a head half as high again", [[WIDTHS[0], higher]], Style::Points),
    ];
    all.extend(theory(&spread(0.14, 0.26, 60), &[&law]));
    outcome.chart = Chart {
        title: "Discharge of a silo".to_owned(),
        x: "width of the opening [m]".to_owned(),
        y: "rate [kg/s]".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}
