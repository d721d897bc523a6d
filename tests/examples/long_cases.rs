//! Runs the hard cases whose point is to last, whole, and writes docs/reports/long-cases.md.
//!
//! `cargo run --release -p barchan-tests --example long_cases -- NAME|all`; without `all` the report is printed only.

use barchan_tests::long_cases::{Outcome, box_at_rest, cyclic_shear, first_letter, furrow, resets, rest};
use std::fmt::Write;
use std::path::Path;
use std::process::ExitCode;

const COMMAND: &str = "cargo run --release -p barchan-tests --example long_cases -- all";

type Case = (&'static str, &'static str, fn() -> Outcome);

const CASES: [Case; 6] = [
    ("rest", "B7, matter at rest without gravity, 1e5 steps", || rest(100_000)),
    ("shear", "B11, column on a shaken base, 1000 cycles", || cyclic_shear(1000)),
    ("resets", "B27, 1000 episodes", || resets(1000, true)),
    ("box", "B44, box on sand, 60 s", || box_at_rest(60.0)),
    ("furrow", "Furrow of 100 m in unbounded ground", || furrow(100.0)),
    ("letters", "The S of letters when the D is written", first_letter),
];

fn main() -> ExitCode {
    let wanted = std::env::args().nth(1).unwrap_or_default();
    let cases: Vec<&Case> = CASES.iter().filter(|(name, ..)| wanted == "all" || wanted == *name).collect();
    if cases.is_empty() {
        let names: Vec<_> = CASES.iter().map(|(name, ..)| *name).collect();
        eprintln!("give one of {}, or all", names.join(", "));
        return ExitCode::FAILURE;
    }
    let mut report = format!(
        "# Long cases\n\nWritten by `{COMMAND}`.\n\n| case | steps | figure | measured | tolerance | pass |\n|---|---|---|---|---|---|\n"
    );
    let mut passes = true;
    for (_, title, run) in cases {
        eprintln!("{title} ...");
        let outcome = run();
        for figure in &outcome.figures {
            passes &= figure.passes();
            let verdict = if figure.passes() { "yes" } else { "**no**" };
            let row = format!(
                "| {title} | {} | {} | {:.3e} | {:.1e} | {verdict} |",
                outcome.steps, figure.what, figure.measured, figure.tolerance
            );
            println!("{row}");
            writeln!(report, "{row}").expect("writing to a string does not fail");
        }
    }
    if wanted == "all" {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/reports/long-cases.md");
        let written = std::fs::create_dir_all(file.parent().expect("the file is in a folder"))
            .and_then(|()| std::fs::write(&file, report));
        if let Err(error) = written {
            eprintln!("{}: {error}", file.display());
            return ExitCode::FAILURE;
        }
    }
    if passes { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
