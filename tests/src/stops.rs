//! Output must not change what is simulated: where a run stops to write, and how often.

use crate::scenes::{options, scene};
use crate::sketch::{Head, block, half, material, tool};
use barchan::run::{Existing, Request, Until, run};
use barchan::{BodyState, Options, ParticleState, Precision, Simulation};
use std::ops::ControlFlow;
use std::path::Path;

/// What a run leaves: particles with the phase of their sort, bodies, steps, and the bits of time.
pub type Left = (ParticleState, Vec<BodyState>, u64, u64);

/// Runs a scene to a time with output as often as `intervals` say (pictures, snapshots), into a folder.
///
/// # Panics
/// If it cannot be run.
pub fn left(text: &str, backend: &str, end: f64, intervals: [f64; 2], folder: &Path) -> Left {
    let mut scene = scene(text);
    (scene.output.interval, scene.output.snapshot_interval) = (intervals[0], Some(intervals[1]));
    let options = Options { backend: backend.to_owned(), ..options(Precision::F32) };
    let mut simulation = Simulation::new(&barchan::registry(), &scene, &options).unwrap_or_else(|e| panic!("{e}"));
    let request = Request {
        out: folder.join(format!("{backend}-{}-{}", intervals[0], intervals[1])),
        until: Until::Time(end),
        pictures: false,
        export: None,
        existing: Existing::Refuse,
        swap: None,
    };
    let summary = run(&mut simulation, &request, &mut |_| ControlFlow::Continue(()));
    let summary = summary.unwrap_or_else(|e| panic!("{e}"));
    let [least, mean, greatest] = summary.dt;
    println!(
        "{backend}, output every {intervals:?} s: {} steps of {least:.3e}, {mean:.3e}, {greatest:.3e} s",
        summary.steps
    );
    (simulation.particles(), simulation.bodies(), simulation.step_count(), simulation.time().to_bits())
}

/// Holds runs with output as often as may be to each other, bit for bit.
///
/// # Panics
/// If any bit differs.
pub fn hold(text: &str, backend: &str, end: f64) {
    let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
    let run = |intervals| left(text, backend, end, intervals, folder.path());
    let seldom = run([100.0 * end, 100.0 * end]);
    for share in [0.21, 0.031, 0.0047] {
        let often = run([share * end, 2.3 * share * end]);
        assert!(often == seldom, "{backend}: output every {} s changes bits", share * end);
    }
}

/// Jelly that is thrown onto a floor while a paddle on a path strikes it, all with steps that the scene leaves open.
pub fn struck(law: &str) -> String {
    let path = "{ keyframes = { frames = [{ time = 0, position = [0.2, 0.4, 0.2] }, { time = 0.04, position = [0.45, 0.4, 0.2] }, \
                { time = 0.07, position = [0.45, 0.4, 0.2], rotation = [0.7, 0, 0, 0.7] }] } }";
    Head::cells(0.05, [24, 16, 12], "z_min = \"stick\"").with(&[
        material(law, 900.0, "young_modulus = 5e4"),
        block(law, [0.35, 0.25, 0.05], [0.6, 0.5, 0.25], "velocity = [0, 0.5, -2]\nsampling = \"jitter\""),
        tool("paddle", [0.2, 0.4, 0.2], &half([0.06, 0.12, 0.12]), "{ coulomb = { friction = 0.4 } }", path),
    ])
}

/// The same without the paddle.
pub fn thrown(law: &str) -> String {
    let text = struck(law);
    text.split("[[tool]]").next().unwrap_or_default().to_owned()
}
