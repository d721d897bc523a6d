//! Tools whose edges lie anywhere between nodes: what they hold, and what they let through, follows their size and not the grid.

use barchan::{Precision, Simulation};
use barchan_tests::scenes::{rows, run_to, simulation, within};
use barchan_tests::sketch::{Head, block, driven, half, material, tool};

/// Cell width [m].
const CELL: f64 = 0.01;
/// Cells across the scenes: a plane, but for four cells.
const ACROSS: u32 = 4;
const SLIPPERY: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"";
/// Underside and top of the lips of the slot [m].
const LIPS: [f64; 2] = [0.10, 0.14];

/// A viscous liquid over a slot in a floor, so many cells wide.
fn slot(cells: f64) -> Simulation {
    let (wide, thick) = (24.0 * CELL, f64::from(ACROSS) * CELL);
    let head =
        Head { world: "leaving = \"delete\"", ..Head::cells(CELL, [24, ACROSS, 34], SLIPPERY) }.time("safety = 0.5");
    // Each lip reaches 10 cells beyond the world.
    let long = 0.5 * (wide - cells * CELL) + 0.1;
    let lip = |name: &str, middle: f64| {
        let place = [middle, 0.5 * thick, 0.5 * (LIPS[0] + LIPS[1])];
        tool(name, place, &half([0.5 * long, 1.0, 0.5 * (LIPS[1] - LIPS[0])]), "\"slip\"", "\"fixed\"")
    };
    simulation(
        &head.with(&[
            material("liquid", 1000.0, "bulk_modulus = 1e5, viscosity = 10.0"),
            block("liquid", [0.0, 0.0, LIPS[1]], [wide, thick, LIPS[1] + 0.2], ""),
            lip("left", 0.5 * long - 0.1),
            lip("right", wide + 0.1 - 0.5 * long),
        ]),
        Precision::F32,
    )
}

/// Flow through the slot [cells of it a second], as the mean over its depth.
fn flow(mut s: Simulation) -> f64 {
    let all = rows(&s).len();
    let mut height = |time: f64| {
        run_to(&mut s, time);
        let rows = rows(&s);
        let inside: f64 = rows.iter().map(|r| r.x[2].clamp(LIPS[0], LIPS[1]) - LIPS[0]).sum();
        inside / (LIPS[1] - LIPS[0])
    };
    let (begin, end) = (0.05, 0.15);
    let passed = height(begin) - height(end);
    assert!(passed > 0.0 && passed < 0.6 * all as f64, "it flows, and has not run out: {passed} of {all} particles");
    passed / 8.0 / f64::from(ACROSS) / (end - begin)
}

/// A plate of so many cells, driven half a cell into elastic ground.
fn plate(cells: f64, time: &str) -> Simulation {
    let (wide, thick, deep) = (40.0 * CELL, f64::from(ACROSS) * CELL, 16.0 * CELL);
    let walls = format!("{SLIPPERY}\nz_min = \"stick\"");
    let high = 3.0 * CELL;
    simulation(
        &Head::cells(CELL, [40, ACROSS, 30], &walls).time(time).with(&[
            material("hencky", 1600.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
            block("hencky", [0.0; 3], [wide, thick, deep], "settled = true"),
            tool(
                "plate",
                [0.5 * wide, 0.5 * thick, deep + high],
                &half([0.5 * cells * CELL, 1.0, high]),
                "{ coulomb = { friction = 0.3 } }",
                &driven([0.0, 0.0, -0.05]),
            ),
        ]),
        Precision::F32,
    )
}

/// Force on the plate [N], as the mean over the last third of its way.
fn force(mut s: Simulation) -> f64 {
    let (begin, end) = (0.07, 0.1);
    run_to(&mut s, begin);
    let mut impulse = 0.0;
    while s.time() < end {
        s.set_stop(end);
        let dt = s.step().unwrap_or_else(|e| panic!("{e}")).dt;
        impulse += s.wrenches()[0].force[2] * dt;
    }
    impulse / (end - begin)
}

/// Measures for widths that grow by tenths of a cell, side by side.
fn by_tenths(first: f64, measure: impl Fn(f64) -> f64 + Sync) -> Vec<f64> {
    std::thread::scope(|scope| {
        let one = |i: u32| first + 0.1 * f64::from(i);
        let all: Vec<_> = (0..=10)
            .map(|i| {
                scope.spawn({
                    let measure = &measure;
                    move || measure(one(i))
                })
            })
            .collect();
        all.into_iter().map(|thread| thread.join().expect("a width")).collect()
    })
}

/// Holds figures to grow everywhere, and nowhere by more than twice the mean step.
#[track_caller]
fn grows_evenly(what: &str, figures: &[f64]) {
    println!("{what}: {figures:.4?}");
    let steps: Vec<f64> = figures.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mean = steps.iter().sum::<f64>() / steps.len() as f64;
    let least = steps.iter().fold(f64::INFINITY, |least, step| least.min(step / mean));
    let most = steps.iter().fold(0f64, |most, step| most.max(step / mean));
    println!("{what}: mean step {:.2} %, least {least:.2} of it", 100.0 * mean / figures[0]);
    assert!(mean > 0.0 && least > 0.0, "{what} grows at every tenth: {steps:?}");
    within(&format!("{what}: greatest step over the mean"), most, 2.0);
}

/// Symptom: a hopper's outlet can be set to whole cells only: from 10 to 12 cells flow grew once, by 13 to 37 %, as the lips passed a
/// layer of nodes. Physics: flow follows the width. A liquid, since sand flows in gushes.
#[test]
fn flow_through_a_slot_grows_by_tenths_of_a_cell() {
    grows_evenly("flow [cells/s]", &by_tenths(10.0, |cells| flow(slot(cells))));
}

/// Symptom: a foot sinks in as if it were a cell wider or narrower, by where it stands on the grid. Physics: a plate bears in
/// proportion to its width, and a little more for its rim.
#[test]
fn force_on_a_plate_grows_by_tenths_of_a_cell() {
    grows_evenly("force [N]", &by_tenths(8.0, |cells| force(plate(cells, "safety = 0.5"))));
}

/// Symptom: a plate bears more with shorter steps, since what contact takes in a step is not in proportion to the step. Physics: force
/// depends on time, not on how it is cut.
///
/// Flow through a slot is not held to this. It is a tenth less at a quarter of the step even where contact takes all of a node's approach:
/// that is what the transfers make of shear round a corner.
#[test]
fn force_on_a_plate_does_not_depend_on_the_step() {
    let [long, short] = ["step = 3e-4", "step = 7.5e-5"].map(|step| force(plate(8.3, step)));
    println!("force [N]: {long:.4} and {short:.4}");
    within("force at dt against dt / 4", (long / short - 1.0).abs(), 0.02);
}
