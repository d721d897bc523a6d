//! A10: a block on a slope.

use super::{Outcome, places, run_to, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};

/// Tangent and sine of the slope are those of 30 degrees; gravity grows over this time [s].
const RAMP: f64 = 0.2;
const END: f64 = 0.5;
/// Two with which it slides, and one with which it stays.
const FRICTIONS: [f64; 3] = [0.1, 0.3, 0.7];

/// Where a block of a friction is along the slope: time [s] and way from its start [m].
///
/// # Errors
/// Those of a simulation.
pub fn slide(friction: f64) -> Result<Vec<[f64; 2]>> {
    let mut block =
        simulation("block-on-incline", &[format!("tool.plane.contact.coulomb.friction={friction:?}")], Precision::F64)?;
    let mean = |places: Vec<[f64; 3]>| places.iter().map(|p| p[0]).sum::<f64>() / places.len() as f64;
    let start = mean(places(&block));
    let mut path = vec![[0.0, 0.0]];
    for i in 1..=25 {
        run_to(&mut block, END * f64::from(i) / 25.0)?;
        path.push([block.time(), mean(places(&block)) - start]);
    }
    Ok(path)
}

/// The acceleration once gravity has grown [m/s²].
fn coulomb(friction: f64) -> f64 {
    let slope = f64::to_radians(30.0);
    (9.81 * (slope.sin() - friction * slope.cos())).max(0.0)
}

/// The way by then: gravity grows evenly, then stays [m].
fn way(friction: f64, time: f64) -> f64 {
    let (grown, after) = (time.min(RAMP), (time - RAMP).max(0.0));
    coulomb(friction) * (grown.powi(3) / (6.0 * RAMP) + 0.5 * RAMP * after + 0.5 * after * after)
}

pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let mut all = Vec::new();
    for friction in FRICTIONS {
        let path = slide(friction)?;
        // The second difference over the time after the ramp.
        let at = |time: f64| path[(time / END * 25.0).round() as usize][1];
        let measured = (at(0.5) - 2.0 * at(0.38) + at(0.26)) / (0.12 * 0.12);
        let theory = coulomb(friction);
        outcome.add(format!("mu {friction}: acceleration [m/s²]"), measured, theory, 0.015 * theory.max(1.0));
        if theory == 0.0 {
            // A thousandth of a cell of 2 cm a second.
            outcome.add(format!("mu {friction}: creep [m/s]"), (at(0.5) - at(0.3)) / 0.2, 0.0, 2e-5);
        }
        all.push(series(&format!("mu {friction}"), path, Style::Points));
    }
    let law = |friction: f64| move |time: f64| [way(friction, time), 0.015 * way(friction, time)];
    let [weak, some, strong] = FRICTIONS.map(law);
    all.extend(theory(&spread(0.0, END, 60), &[&weak, &some, &strong]));
    outcome.chart = Chart {
        title: "A block on a slope of 30 degrees".to_owned(),
        x: "time [s]".to_owned(),
        y: "way along the slope [m]".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}
