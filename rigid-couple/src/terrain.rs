//! Rigid ground: a terrain as primitives.

use crate::Refusal;
use crate::motion::Pose;
use crate::sdf::{HeightField, Primitive};
use barchan_core::scene::{Surface, Terrain};
use glam::DVec3;
use std::sync::Arc;

/// Samples in a wavelength: dunes' crests are that much blunter than those of soft ground.
const SAMPLES: f64 = 32.0;
/// Most samples of one terrain: 8 MB, and a tree of triangles of 200 MB where robots walk on it.
const MOST_SAMPLES: f64 = 1e6;
/// How far stairs may be off an axis and still lead along it [degrees].
const ALONG_AXIS: f64 = 1e-9;

/// The primitives of a terrain and their places: one box for each step of stairs and one for what lies before them, and a height field for
/// everything else.
pub(crate) fn primitives(terrain: &Terrain) -> Result<Vec<(Primitive, Pose)>, Refusal> {
    match terrain.surface {
        Surface::Stairs { run, rise, count, direction_deg } => steps(terrain, run, rise, count, direction_deg),
        Surface::Dunes { wavelength, .. } | Surface::Bumps { wavelength, .. } => sampled(terrain, wavelength / SAMPLES),
        Surface::Flat | Surface::Slope { .. } => sampled(terrain, f64::INFINITY),
    }
}

/// Bilinear between samples no further apart than `spacing`, which are 2 along each side at least.
fn sampled(terrain: &Terrain, spacing: f64) -> Result<Vec<(Primitive, Pose)>, Refusal> {
    let Terrain { min, max, bottom, .. } = *terrain;
    let spans = [0, 1].map(|d| ((max[d] - min[d]) / spacing).ceil().max(1.0));
    let samples = (spans[0] + 1.0) * (spans[1] + 1.0);
    if samples > MOST_SAMPLES {
        return Err(Refusal::new(
            format!("rigid ground so wide and of so short a wavelength takes {samples:.0} samples"),
            format!(
                "bring min and max nearer, or raise wavelength: at most {MOST_SAMPLES:.0} samples, {SAMPLES} a wavelength"
            ),
        ));
    }
    let heights = terrain.heights();
    let along = |d: usize, i: u32| min[d] + (max[d] - min[d]) * f64::from(i) / spans[d];
    let row = |j: u32| (0..=spans[0] as u32).map(|i| heights.at(along(0, i), along(1, j))).collect();
    let field = HeightField { min, max, bottom, heights: (0..=spans[1] as u32).map(row).collect() };
    field.check()?;
    Ok(vec![(Primitive::HeightField(Arc::new(field)), Pose::IDENTITY)])
}

/// Each box goes on under or behind the higher ones, so that only edges of steps are edges of boxes.
fn steps(
    terrain: &Terrain,
    run: f64,
    rise: f64,
    count: u32,
    direction_deg: f64,
) -> Result<Vec<(Primitive, Pose)>, Refusal> {
    let quarter = (direction_deg / 90.0).round();
    if (direction_deg - 90.0 * quarter).abs() > ALONG_AXIS {
        return Err(Refusal::new(
            format!("rigid stairs lead along x or y, and direction_deg is {direction_deg}"),
            "use 0, 90, 180 or 270, and turn the tool by its rotation",
        ));
    }
    let turns = quarter.rem_euclid(4.0) as usize;
    let (axis, back) = (turns % 2, turns >= 2);
    let Terrain { min, max, bottom, origin, .. } = *terrain;
    let boxes = (0..=count).filter_map(|k| {
        let (mut low, mut high) = (min, max);
        // Upwards a step begins with its riser, and downwards it ends with the next; the lowest has no end.
        let up = rise > 0.0;
        let (riser, is_lowest) = if up { (f64::from(k) - 1.0, k == 0) } else { (f64::from(k), k == count) };
        let at = origin[axis] + if back { -run * riser } else { run * riser };
        if !is_lowest && up != back {
            low[axis] = low[axis].max(at);
        } else if !is_lowest {
            high[axis] = high[axis].min(at);
        }
        let top = origin[2] + rise * f64::from(k);
        (low[axis] < high[axis]).then_some((low, high, top))
    });
    boxes
        .map(|(low, high, top)| {
            if top <= bottom {
                return Err(Refusal::new(
                    format!("a step is at {top}, with the bottom at {bottom}"),
                    "lower the bottom",
                ));
            }
            let (low, high) = (DVec3::new(low[0], low[1], bottom), DVec3::new(high[0], high[1], top));
            let place = Pose { position: 0.5 * (low + high), ..Pose::IDENTITY };
            Ok((Primitive::Box { half: 0.5 * (high - low) }, place))
        })
        .collect()
}
