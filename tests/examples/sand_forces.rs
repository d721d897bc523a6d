//! Holds forces and depths in sand against theory and measurements of others, whole, and writes docs/reports/sand-forces.md.
//!
//! `cargo run --release -p barchan-tests --example sand_forces -- NAME|all`; without `all` the table is printed only.

use barchan_tests::granular::{impacts, plates, sinkage};
use barchan_tests::report::{Case, run_cases};
use std::process::ExitCode;

const INTRO: &str = "# Forces of sand on plates and spheres

Written by `cargo run --release -p barchan-tests --example sand_forces -- all`.
";

const CASES: [Case; 3] = [
    ("plates", "A6, plates", plates),
    ("impacts", "A7, sphere of 2.5 cm", || impacts(&[700.0, 2200.0, 7800.0], &[0.05, 0.1, 0.2], 36)),
    ("sinkage", "Plate of 7.3 kPa put on sand", sinkage),
];

fn main() -> ExitCode {
    run_cases(&CASES, "docs/reports/sand-forces.md", INTRO)
}
