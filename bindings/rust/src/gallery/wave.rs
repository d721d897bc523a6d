//! A2: a standing wave in a bar.

use super::{Outcome, alter, places, series, simulation, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};
use std::f64::consts::TAU;

/// Greatest velocity of the wave, in lengths of the bar a period: small, so that every elastic law agrees.
const V0: f64 = 1e-4;

/// The greatest L2 error of displacement over a period, in amplitudes of the wave, on so many cells a wavelength.
///
/// # Errors
/// Those of a simulation.
pub fn standing_wave(cells: u32) -> Result<f64> {
    let h = 1.0 / f64::from(cells);
    let side = 4.0 * h;
    let changes = [
        format!("world.cell={h:?}"),
        format!("world.max=[1.0, {side:?}, {side:?}]"),
        format!("body.bar.shape.box.max=[1.0, {side:?}, {side:?}]"),
        format!("time.step={:?}", 0.2 * h),
    ];
    let mut bar = simulation("standing-wave", &changes, Precision::F64)?;
    alter(&mut bar, |list, i| {
        let phase = TAU * list.position(i)[0];
        list.velocity[i][0] = V0 * phase.sin();
        list.affine[i][0] = V0 * TAU * phase.cos();
    })?;
    let start = places(&bar);
    let mut worst = 0f64;
    while bar.time() < 1.0 {
        bar.step()?;
        let amplitude = V0 / TAU * (TAU * bar.time()).sin();
        let off = start.iter().zip(places(&bar)).map(|(a, b)| b[0] - a[0] - amplitude * (TAU * a[0]).sin());
        worst = worst.max((off.map(|x| x * x).sum::<f64>() / start.len() as f64).sqrt() / (V0 / TAU));
    }
    Ok(worst)
}

pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let cells = [8, 16, 32, 64];
    let errors = cells.iter().map(|&n| standing_wave(n)).collect::<Result<Vec<_>>>()?;
    outcome.add("order between 16 and 32 cells", (errors[1] / errors[2]).log2(), 2.0, 0.1);
    outcome.add("order between 32 and 64 cells", (errors[2] / errors[3]).log2(), 2.0, 0.1);
    outcome.add("error on 64 cells, in amplitudes", errors[3], 0.0, 0.01);
    let points = cells.iter().zip(&errors).map(|(&n, &error)| [f64::from(n), error]);
    let mut all = vec![series("measured", points, Style::Points)];
    let last = errors[3];
    // Second order through the finest, and a tenth of an order off it.
    let of = |n: f64| last * (64.0 / n).powi(2);
    all.extend(theory(&cells.map(f64::from), &[&|n| [of(n), of(n) * ((64.0 / n).powf(0.1) - 1.0)]]));
    outcome.chart = Chart {
        title: "Error of a standing wave over a period, and second order".to_owned(),
        x: "cells a wavelength".to_owned(),
        y: "error of displacement, in amplitudes".to_owned(),
        series: all,
        axes: Axes::Logarithmic,
    };
    Ok(outcome)
}
