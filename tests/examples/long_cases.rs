//! Runs the hard cases whose point is to last, whole, and writes docs/reports/long-cases.md.
//!
//! `cargo run --release -p barchan-tests --example long_cases -- NAME|all`; without `all` the report is printed only.

use barchan_tests::long_cases::{box_at_rest, cyclic_shear, dunes, first_letter, furrow, resets, rest};
use barchan_tests::report::{Case, run_cases};
use std::process::ExitCode;

const INTRO: &str = "# Long cases

Written by `cargo run --release -p barchan-tests --example long_cases -- all`.
";

const CASES: [Case; 8] = [
    ("rest", "B7, matter at rest without gravity, 1e5 steps", || rest(100_000)),
    ("shear", "B11, column on a shaken base, 1000 cycles", || cyclic_shear(1000)),
    ("resets", "B27, 1000 episodes", || resets(1000, true)),
    ("box", "B44, box on sand, 60 s", || box_at_rest(60.0)),
    ("furrow", "Furrow of 100 m in unbounded ground", || furrow(100.0)),
    ("kilometre", "Furrow of 1 km in unbounded ground", || furrow(1000.0)),
    ("dunes", "100 m of dunes under a quadruped", || dunes(100.0)),
    ("letters", "The S of letters when the D is written", first_letter),
];

fn main() -> ExitCode {
    run_cases(&CASES, "docs/reports/long-cases.md", INTRO)
}
