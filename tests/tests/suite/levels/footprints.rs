//! What a tool leaves behind stays when the fine box moves on.

use barchan::accuracy::{Grain, HeightMap};
use barchan::{Options, Simulation};
use barchan_tests::scenes::{rows, run_to};

/// Where the rod is lifted from the first stroke, and where it ends the second [s].
const FIRST: f64 = 0.62;
const LAST: f64 = 1.3;
/// The first stroke runs along y here [m].
const STROKE_X: f64 = 0.15;
const STROKE_Y: [f64; 2] = [0.11, 0.19];
/// Height of the bed's surface at the start [m].
const SURFACE: f64 = 0.112;

/// `letters` with a shorter bed, on which the rod draws two strokes 0.5 m apart.
fn strokes() -> Simulation {
    // The rod's middle is 40 mm above the ground where it draws.
    let (up, down) = (SURFACE + 0.112, SURFACE + 0.04);
    let frame = |time: f64, x: f64, y: f64, z: f64| format!("{{ time = {time}, position = [{x}, {y}, {z}] }}");
    let frames = [
        frame(0.0, STROKE_X, 0.23, up),
        frame(0.16, STROKE_X, 0.23, down),
        frame(0.48, STROKE_X, 0.07, down),
        frame(FIRST, STROKE_X, 0.07, up),
        frame(0.94, 0.65, 0.10, up),
        frame(1.1, 0.65, 0.10, down),
        frame(LAST, 0.65, 0.20, down),
    ];
    let set = [
        "world.max=[0.812, 0.308, 0.42]".to_owned(),
        format!("body.bed.shape.box={{ min = [0.0, 0.0, 0.0], max = [0.812, 0.308, {SURFACE}] }}"),
        format!("tool.stirrer.position=[{STROKE_X}, 0.23, {up}]"),
        format!("tool.stirrer.motion.keyframes.frames=[{}]", frames.join(", ")),
    ];
    let scene = barchan::tasks::scene("letters", &set).unwrap();
    Simulation::new(&barchan::registry(), &scene, &Options::default()).unwrap()
}

/// Mean depth of the first stroke below the bed's surface at the start [m], and the share of its grains on the coarsest level.
fn furrow(simulation: &Simulation) -> (f64, f64) {
    let grains: Vec<Grain> = simulation.spots().iter().map(Grain::of).collect();
    let plan = simulation.plan();
    let map = HeightMap::new(&grains, &plan.scene.world, plan.cell_widths[1]);
    let along = |x: f64, y: f64| (x - STROKE_X).abs() < plan.cell_widths[1] && (STROKE_Y[0]..STROKE_Y[1]).contains(&y);
    let heights = map.heights().iter().enumerate().filter(|(i, _)| along(map.at(*i)[0], map.at(*i)[1]));
    let depths: Vec<f64> = heights.map(|(_, height)| SURFACE - height).collect();
    let near: Vec<_> = rows(simulation).into_iter().filter(|row| along(row.x[0], row.x[1])).collect();
    let coarsest = near.iter().filter(|row| row.level as usize + 1 == plan.cell_widths.len()).count();
    (depths.iter().sum::<f64>() / depths.len() as f64, coarsest as f64 / near.len() as f64)
}

/// A robot that looks back must see its track: once the boxes have gone and the coarsest level has the place, its grains merged
/// where that does not move the surface, the furrow is still at least 0.7 as deep as right after it was drawn. (All of `letters`:
/// `long_cases letters`.)
#[test]
fn a_furrow_stays_when_the_fine_boxes_go() {
    let mut simulation = strokes();
    run_to(&mut simulation, FIRST);
    let (fresh, fine) = furrow(&simulation);
    run_to(&mut simulation, LAST);
    let (kept, coarse) = furrow(&simulation);
    println!("furrow {:.1} mm deep, {:.1} mm when merged: {:.3}", 1e3 * fresh, 1e3 * kept, kept / fresh);
    assert!(fine < 0.1 && coarse > 0.9, "{fine} of the grains are on the coarsest level at first, {coarse} at last");
    assert!(fresh > 0.015, "the rod is sunk 34 mm and leaves {} mm", 1e3 * fresh);
    assert!(kept >= 0.7 * fresh, "{} mm are left of {} mm", 1e3 * kept, 1e3 * fresh);
}
