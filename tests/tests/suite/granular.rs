//! Forces on plates and depths of impacts in sand, short; `examples/sand_forces.rs` runs them whole.

use barchan::gallery::run_out;
use barchan_tests::granular::{impacts, plates_short};
use barchan_tests::scenes::within;

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
