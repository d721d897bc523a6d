//! A14: sand that is poured into a heap.

use super::{Outcome, by_id, line, mobilised, run_to, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result, Simulation};

/// When the heap is at rest [s].
const AT_REST: f64 = 4.6;
/// Between these parts of a heap's height its flanks are straight: it is round above, and its toe is thin.
const FLANK: [f64; 2] = [0.2, 0.7];

/// A heap of sand on a floor.
#[derive(Clone, Copy, Debug)]
pub struct Heap {
    /// Height of its top [m].
    pub height: f64,
    /// Slopes of its two flanks [degrees].
    pub slopes: [f64; 2],
    /// Root of the mean square of its particles' speeds [m/s].
    pub speed: f64,
}

/// Pours sand of a friction angle [degrees] onto a floor, on cells of a width [m], and measures the heap when it is at rest.
///
/// # Errors
/// Those of a simulation.
pub fn poured(angle: f64, cell: f64) -> Result<Heap> {
    let changes = [format!("material.sand.parameters.friction_angle_deg={angle:?}"), format!("world.cell={cell:?}")];
    let mut heap = simulation("poured-heap", &changes, Precision::F32)?;
    run_to(&mut heap, AT_REST)?;
    let (height, slopes) = flanks(&heap, cell)?;
    let squares = by_id(&heap, |list| list.velocity.iter().map(|v| v.iter().map(|v| v * v).sum::<f64>()).collect());
    Ok(Heap { height, slopes, speed: (squares.iter().sum::<f64>() / squares.len() as f64).sqrt() })
}

/// Height of a heap's top [m], and the slopes of its flanks [degrees]: of the lines through heights of the surface a cell apart.
fn flanks(heap: &Simulation, cell: f64) -> Result<(f64, [f64; 2])> {
    let half = (0.3 / cell).round() as i32;
    let x: Vec<f64> = (-half..=half).map(|i| f64::from(i) * cell).collect();
    let heights = heap.heights(&x.iter().map(|&x| [x, 0.0]).collect::<Vec<_>>())?;
    let surface: Vec<[f64; 2]> = x.into_iter().zip(heights).filter_map(|(x, z)| Some([x, z?])).collect();
    let top = surface.iter().fold(0.0, |top: f64, point| top.max(point[1]));
    let slope = |side: f64| {
        let is_flank = |p: &&[f64; 2]| p[0] * side > 0.0 && (FLANK[0] * top..FLANK[1] * top).contains(&p[1]);
        let flank: Vec<[f64; 2]> = surface.iter().filter(is_flank).copied().collect();
        (-side * line(&flank)[0]).atan().to_degrees()
    };
    Ok((top, [-1.0, 1.0].map(slope)))
}

/// Sand that flows down a flank is sheared along it, so the heap is as steep as the cone's friction in simple shear.
pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let law = |angle: f64| mobilised(angle).atan().to_degrees();
    let mut points = Vec::new();
    for angle in [18.09, 24.28, 29.0] {
        let heap = poured(angle, 0.005)?;
        let slope = 0.5 * (heap.slopes[0] + heap.slopes[1]);
        outcome.add(format!("phi {angle}: slope [degrees]"), slope, law(angle), 3.0);
        outcome.add(
            format!("phi {angle}: its flanks differ by [degrees]"),
            (heap.slopes[0] - heap.slopes[1]).abs(),
            0.0,
            3.0,
        );
        outcome.add(format!("phi {angle}: speed of its sand [m/s]"), heap.speed, 0.0, 0.01);
        points.extend(heap.slopes.map(|slope| [angle, slope]));
    }
    let mut all = vec![series("measured, both flanks", points, Style::Points)];
    all.extend(theory(&spread(16.0, 32.0, 40), &[&|angle| [law(angle), 3.0]]));
    outcome.chart = Chart {
        title: "Slope of a poured heap, in the plane".to_owned(),
        x: "friction angle of the cone [degrees]".to_owned(),
        y: "slope [degrees]".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}
