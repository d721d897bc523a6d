//! What cases come to, and reports of them.

use std::fmt::Write;
use std::path::Path;
use std::process::ExitCode;

/// A measured figure beside what it must not exceed.
#[derive(Clone, Debug)]
pub struct Figure {
    /// What was measured, with its unit.
    pub what: String,
    /// How much it is.
    pub measured: f64,
    /// How much it may be.
    pub tolerance: f64,
}

impl Figure {
    /// Is it within its tolerance?
    pub fn passes(&self) -> bool {
        self.measured <= self.tolerance
    }
}

/// What a case came to.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// Steps taken.
    pub steps: u64,
    /// What was measured.
    pub figures: Vec<Figure>,
}

impl Outcome {
    /// Adds a figure.
    pub fn add(&mut self, what: impl Into<String>, measured: f64, tolerance: f64) {
        self.figures.push(Figure { what: what.into(), measured, tolerance });
    }

    /// Prints all figures and asserts that they pass.
    ///
    /// # Panics
    /// If one does not.
    pub fn check(&self, case: &str) {
        for Figure { what, measured, tolerance } in &self.figures {
            println!("{case}: {what} {measured:.3e}, tolerance {tolerance:.1e}, {} steps", self.steps);
        }
        for figure in &self.figures {
            assert!(
                figure.passes(),
                "{case}: {} is {:e}, allowed {:e}",
                figure.what,
                figure.measured,
                figure.tolerance
            );
        }
    }
}

/// A case: its name on the command line, its title, and the case.
pub type Case = (&'static str, &'static str, fn() -> Outcome);

/// Runs the case that the command line names, or all of them, which writes `report`, a file of the repository with this text at
/// its start. Fails if a figure is beyond its tolerance.
///
/// # Panics
/// If a case does.
pub fn run_cases(cases: &[Case], report: &str, intro: &str) -> ExitCode {
    let wanted = std::env::args().nth(1).unwrap_or_default();
    let chosen: Vec<&Case> = cases.iter().filter(|(name, ..)| wanted == "all" || wanted == *name).collect();
    if chosen.is_empty() {
        let names: Vec<_> = cases.iter().map(|(name, ..)| *name).collect();
        eprintln!("give one of {}, or all", names.join(", "));
        return ExitCode::FAILURE;
    }
    let mut text =
        format!("{intro}\n| case | steps | figure | measured | tolerance | pass |\n|---|---|---|---|---|---|\n");
    let mut passes = true;
    for (_, title, run) in chosen {
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
            writeln!(text, "{row}").expect("writing to a string does not fail");
        }
    }
    if wanted == "all" {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(report);
        let written = std::fs::create_dir_all(file.parent().expect("the file is in a folder"))
            .and_then(|()| std::fs::write(&file, text));
        if let Err(error) = written {
            eprintln!("{}: {error}", file.display());
            return ExitCode::FAILURE;
        }
    }
    if passes { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
