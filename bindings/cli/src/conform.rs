//! `barchan conform`.

use crate::print::{show, tell};
use barchan::conformance::{self, Finding, Outcome};
use barchan::{Error, Material, Registry, Result};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// Strains of each kind that an adapter is asked.
const STRAINS: usize = 1000;

#[derive(Args)]
pub(crate) struct ConformArgs {
    /// A library with materials, in Rust, C or C++; or, if there is no such file, the name of a material that is built in.
    library: String,
    /// cpu, or wgpu: then each law's WGSL is run on an adapter as well and held against its f64 form on the processor, or its f32 form if it has
    /// no other.
    #[arg(long, default_value = "cpu", value_parser = ["cpu", "wgpu"])]
    backend: String,
    /// Name or number of the adapter (see `adapters`) [default: the first].
    #[arg(long, value_name = "NAME|INDEX")]
    adapter: Option<String>,
    /// Sets of parameters to draw from their declared ranges, besides the defaults; the same in each run.
    #[arg(long, default_value_t = 8, value_name = "NUMBER")]
    samples: usize,
}

/// Runs the suite on every material that is asked for. Fails if one of them does.
pub(crate) fn run(args: &ConformArgs, registry: &Registry) -> Result<ExitCode> {
    let materials = found(&args.library, registry)?;
    let device = Device::open(args, registry)?;
    let mut failures = Vec::new();
    for material in &materials {
        show(format!("\n{}\n", heading(material, args)));
        let findings = survey(material, args, &device)?;
        show(table(&findings));
        let failed = findings.iter().filter(|finding| finding.is_failure()).count();
        if failed > 0 {
            failures.push(format!("'{}' fails {failed} of {} checks", material.name, findings.len()));
        }
    }
    if failures.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    tell(format!("error: material {}; each is told below its line", failures.join(", ")));
    Ok(ExitCode::FAILURE)
}

/// The materials of a library, or the one of the registry by that name; says which of the two it is.
fn found(name: &str, registry: &Registry) -> Result<Vec<Material>> {
    let path = Path::new(name);
    if !path.exists() && registry.material(name).is_ok() {
        let material = registry.material(name)?.clone();
        show(format!("{name}: no file of this name, but a material ({})\n", material.origin));
        return Ok(vec![material]);
    }
    if !path.exists() && path.components().count() == 1 && path.extension().is_none() {
        return Err(Error::Unknown {
            path: format!("conform: there is no file '{name}'"),
            kind: "material",
            name: name.to_owned(),
            known: registry.materials().map(|material| material.name.clone()).collect(),
        });
    }
    // Alone: its materials may have the names of others.
    let mut alone = Registry::new();
    let names = alone.load(path)?;
    alone.warnings().iter().for_each(|warning| tell(format!("warning: {warning}")));
    let plural = if names.len() == 1 { "" } else { "s" };
    show(format!("{name}: a library of {} material{plural}: {}\n", names.len(), names.join(", ")));
    names.iter().map(|name| alone.material(name).cloned()).collect()
}

/// What laws are run on besides the processor.
struct Device(Option<conformance::wgsl::Gpu>);

impl Device {
    fn open(args: &ConformArgs, registry: &Registry) -> Result<Self> {
        if registry.backend(&args.backend)?.adapters().is_none() {
            return match &args.adapter {
                None => Ok(Self(None)),
                Some(adapter) => Err(Error::Unknown {
                    path: format!("--adapter: the backend {} runs on the processor alone", args.backend),
                    kind: "adapter",
                    name: adapter.clone(),
                    known: Vec::new(),
                }),
            };
        }
        let gpu = conformance::wgsl::open(args.adapter.as_deref())?;
        show(format!("WGSL runs on {}\n", gpu.adapter_info.name));
        Ok(Self(Some(gpu)))
    }
}

fn heading(material: &Material, args: &ConformArgs) -> String {
    let Material { name, version, origin, parameters, .. } = material;
    let sets = match (args.samples, parameters.len()) {
        (0, _) | (_, 0) => "at its defaults".to_owned(),
        (samples, _) => format!("at its defaults and at {samples} sets of parameters drawn from their ranges"),
    };
    format!("material {name} {version} ({origin}), {sets}")
}

fn survey(material: &Material, args: &ConformArgs, device: &Device) -> Result<Vec<Finding>> {
    let mut shown = Shown::new(&material.name);
    let samples = if material.parameters.is_empty() { 0 } else { args.samples };
    let mut findings = conformance::survey(material, samples, &mut |set, check| {
        let at = if set == 0 { "defaults".to_owned() } else { format!("parameters {set} of {samples}") };
        shown.update(&format!("{check}, {at}"));
    })?;
    if let Device(Some(gpu)) = device {
        let on_check = &mut |check: &'static str| shown.update(check);
        findings.extend(conformance::wgsl::survey(gpu, material, samples, STRAINS, on_check)?);
    }
    shown.finish();
    Ok(findings)
}

/// A line a check, and what is wrong below those that fail.
fn table(findings: &[Finding]) -> String {
    let width = findings.iter().map(|finding| finding.check.chars().count()).max().unwrap_or(0);
    let mut text = format!("  {:<width$}  {:<10}{:>10}{:>10}\n", "check", "result", "worst", "allowed");
    for Finding { check, error, tolerance, outcome } in findings {
        let number = |value: f64| format!("{value:.1e}");
        // A contract to the bit, or without numbers, is kept or not.
        let exact = *tolerance <= 0.0;
        let worst = error.filter(|_| !exact).map_or_else(|| "-".to_owned(), number);
        let allowed = if exact { "-".to_owned() } else { number(*tolerance) };
        text += &match outcome {
            Outcome::Passed => format!("  {check:<width$}  {:<10}{worst:>10}{allowed:>10}\n", "passed"),
            Outcome::NotAsked(why) => format!("  {check:<width$}  {:<10}  {why}\n", "not asked"),
            Outcome::Failed(what) => {
                format!("  {check:<width$}  {:<10}{worst:>10}{allowed:>10}\n      {what}\n", "FAILED")
            }
        };
    }
    let count = |of: fn(&Outcome) -> bool| findings.iter().filter(|finding| of(&finding.outcome)).count();
    text + &format!(
        "  {} passed, {} failed, {} not asked\n",
        count(|o| *o == Outcome::Passed),
        count(|o| matches!(o, Outcome::Failed(_))),
        count(|o| matches!(o, Outcome::NotAsked(_)))
    )
}

/// What is under way: on a terminal at once, elsewhere every ten seconds.
enum Shown {
    Spinner(ProgressBar),
    Lines(String, Instant),
}

impl Shown {
    const PAUSE: Duration = Duration::from_secs(10);

    fn new(material: &str) -> Self {
        if !std::io::stderr().is_terminal() {
            return Self::Lines(material.to_owned(), Instant::now());
        }
        let style =
            ProgressStyle::with_template("{spinner} {elapsed}  {msg}").expect("the template is constant and sound");
        Self::Spinner(ProgressBar::new_spinner().with_style(style))
    }

    fn update(&mut self, what: &str) {
        match self {
            Self::Spinner(spinner) => {
                spinner.set_message(what.to_owned());
                spinner.tick();
            }
            Self::Lines(material, last) if last.elapsed() >= Self::PAUSE => {
                *last = Instant::now();
                tell(format!("{material}: {what}"));
            }
            Self::Lines(..) => {}
        }
    }

    fn finish(&self) {
        if let Self::Spinner(spinner) = self {
            spinner.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_says_of_each_check_how_it_came_out() {
        let finding = |outcome| Finding { check: "a check", error: Some(3e-9), tolerance: 1e-6, outcome };
        let text = table(&[
            finding(Outcome::Passed),
            Finding { error: None, ..finding(Outcome::Failed("it is wrong at x".to_owned())) },
            Finding { tolerance: 0.0, ..finding(Outcome::NotAsked("it has none")) },
        ]);
        let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(lines[1], ["a", "check", "passed", "3.0e-9", "1.0e-6"]);
        assert_eq!(lines[2], ["a", "check", "FAILED", "-", "1.0e-6"]);
        assert_eq!(lines[3], ["it", "is", "wrong", "at", "x"]);
        assert_eq!(lines[4], ["a", "check", "not", "asked", "it", "has", "none"]);
        assert_eq!(lines[5].join(" "), "1 passed, 1 failed, 1 not asked");
    }
}
