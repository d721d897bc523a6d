//! Forces on plates and depths of impacts in sand, short; `examples/sand_forces.rs` runs them whole.

use barchan_tests::granular::{impacts, plates_short};

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
