//! Forces on plates and depths of impacts in sand, short; `examples/sand_forces.rs` runs them whole.

use barchan::Precision;
use barchan::gallery::{discharge, mobilised, poured, run_out};
use barchan_tests::granular::{impacts, plates_short};
use barchan_tests::scenes::{run_to, simulation, within};
use barchan_tests::sketch::{Head, block, material};

/// A6: forces on a plate that is pushed into sand, and on one that is dragged through it.
#[test]
fn plates_feel_what_resistive_force_theory_says() {
    plates_short().check("A6");
}

/// A7: a sphere of glass falls into sand from two heights.
#[test]
fn a_sphere_goes_as_deep_as_measured() {
    impacts(&[2200.0], &[0.05, 0.2], 36).check("A7");
}

/// A8: columns of sand collapse, one low and one tall.
///
/// Symptom of a floor or a cone that is wrong: sand runs out as a liquid does, or stands. Physics: a low column runs out by 1.2 of its height, a tall one by 1.9 a^(2/3) of its width.
#[test]
fn columns_run_out_as_far_as_measured() {
    for (aspect, law) in [(1.0f64, 1.2), (3.0, 1.9 * 3f64.powf(2.0 / 3.0))] {
        let ratio = run_out(aspect).unwrap() / law;
        within(&format!("A8, a = {aspect}: run-out over the law {ratio:.3}, off by"), (ratio - 1.0).abs(), 0.3);
    }
}

/// Symptom: what flows far from a lattice comes to rest as a comb of upright sheets, since particles that began above one another stay so. Physics: loose sand rests
/// as a heap, which rises to its top and falls from there.
#[test]
fn a_slender_column_comes_to_rest_as_a_heap() {
    let hollow = |more: &str| {
        let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
        let sand = material("sand", 1600.0, "young_modulus = 2e5, poisson_ratio = 0.3, friction_angle_deg = 30.0");
        let column = block("sand", [0.55, 0.0, 0.0], [0.65, 0.12, 0.3], more);
        let mut sim = simulation(&Head::cells(0.02, [60, 6, 20], walls).with(&[sand, column]), Precision::F32);
        run_to(&mut sim, 1.6);
        let points: Vec<[f64; 2]> = (0..120).map(|i| [0.005 + 0.01 * f64::from(i), 0.06]).collect();
        let heights: Vec<f64> = sim.heights(&points).unwrap().into_iter().flatten().collect();
        let highest = |part: &[f64]| part.iter().copied().fold(0.0, f64::max);
        let depth = |i: usize| highest(&heights[..i]).min(highest(&heights[i + 1..])) - heights[i];
        (0..heights.len()).map(depth).fold(0.0, f64::max) / 0.02
    };
    for more in ["", "settled = true"] {
        within(&format!("deepest hollow between higher ground, '{more}' [cells]"), hollow(more), 0.75);
    }
    let comb = hollow("sampling = \"lattice\"");
    println!("from a lattice: {comb:.2} cells");
    assert!(comb > 1.5, "the lattice shows what this test looks for: {comb}");
}

/// A14: a heap that is poured is as steep as its cone's friction in simple shear, on both sides, and rests.
///
/// Symptom of a source that fills what is full, or of sand that has lost its friction while it was loose: heaps flatten without end, or stand as towers.
#[test]
fn a_poured_heap_has_the_slope_of_its_friction() {
    let heap = poured(24.28, 0.005).unwrap();
    let law = mobilised(24.28).atan().to_degrees();
    for slope in heap.slopes {
        within(&format!("A14: slope of {slope:.1} degrees, law {law:.1}, off by"), (slope - law).abs(), 3.0);
    }
    within("A14: speed at rest [m/s]", heap.speed, 0.01);
    assert!(heap.height > 0.08, "the heap is {} m high", heap.height);
}

/// A15: what runs out of a silo does not know how much stands above, unlike water: half as much again would be 22 % more.
#[test]
fn a_silo_runs_at_a_rate_that_is_not_of_its_head() {
    let [low, high] = [0.2, 0.3].map(|head| discharge(0.16, head).unwrap());
    within(&format!("A15: {low:.3} and {high:.3} kg/s, off by"), (high / low - 1.0).abs(), 0.05);
}
