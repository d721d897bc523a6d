//! `barchan gallery`.

use crate::bench::{write_chart, write_texts};
use crate::print::{show, tell};
use barchan::gallery::{Experiment, experiments};
use barchan::{Error, Result};
use clap::Args;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

#[derive(Args)]
pub(crate) struct GalleryArgs {
    /// Which experiments [default: all]: column-collapse, poured-heap, hopper-discharge, sphere-impact, plate-in-sand, block-on-incline,
    /// oedometer, shear-box, standing-wave.
    names: Vec<String>,
    /// Folder for the plots (PNG and SVG) and the table, which are overwritten.
    #[arg(long, value_name = "FOLDER", default_value = "out/gallery")]
    out: PathBuf,
}

/// Runs experiments; the exit status is 1 if a figure is beyond its tolerance.
pub(crate) fn run(args: &GalleryArgs) -> Result<ExitCode> {
    let chosen = chosen(&args.names)?;
    let head = "| experiment | figure | measured | theory | tolerance | holds |\n|---|---|---|---|---|---|\n";
    show(head);
    let mut table = head.to_owned();
    let mut all_hold = true;
    for experiment in chosen {
        let begin = Instant::now();
        let outcome = experiment.run()?;
        let mut rows = String::new();
        for figure in &outcome.figures {
            all_hold &= figure.holds();
            rows += &format!(
                "| {} ({}) | {} | {:.4} | {:.4} | ± {:.4} | {} |\n",
                experiment.name,
                experiment.case,
                figure.what,
                figure.measured,
                figure.theory,
                figure.tolerance,
                if figure.holds() { "yes" } else { "**no**" }
            );
        }
        show(&rows);
        tell(format!("{}: {:.0} s", experiment.name, begin.elapsed().as_secs_f64()));
        table += &rows;
        write_texts(&args.out, &[("table.md", table.clone())])?;
        write_chart(&outcome.chart, &args.out.join(experiment.name))?;
    }
    Ok(if all_hold { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The experiments of some names, in their order; all without names.
fn chosen(names: &[String]) -> Result<Vec<&'static Experiment>> {
    let known = || experiments().iter().map(|experiment| experiment.name);
    if let Some(name) = names.iter().find(|name| known().all(|known| known != **name)) {
        return Err(Error::Unknown {
            path: "gallery".to_owned(),
            kind: "experiment",
            name: name.clone(),
            known: known().map(str::to_owned).collect(),
        });
    }
    Ok(experiments().iter().filter(|one| names.is_empty() || names.iter().any(|name| name == one.name)).collect())
}
