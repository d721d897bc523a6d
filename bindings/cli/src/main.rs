//! Barchan's command line: runs, plans and checks scenes, lists plugins, measures.

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "they panic where the terminal is gone: see `print`")]

mod bench;
mod plugins;
mod print;
mod report;
mod run;
mod signals;

use barchan::{Error, Plan, Precision, Registry, Result, Scene};
use clap::{Args, Parser, Subcommand};
use print::{show, tell};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Simulates robots on and in soft ground.
///
/// Without a command: `run letters`.
#[derive(Parser)]
#[command(version, arg_required_else_help = false, after_help = ENVIRONMENT)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

const ENVIRONMENT: &str = "Environment:
  BARCHAN_ISA  instruction set of what runs on the processor: baseline, avx2 or avx512 [default: the last that is there]";

#[derive(Subcommand)]
enum Command {
    /// Runs a scene and writes pictures, trace, summary and snapshot into a folder.
    Run(run::RunArgs),
    /// Prints the effects that a scene calls for and why, the passes, the step and what bounds it, the memory.
    Plan(SceneArgs),
    /// Checks a scene: prints one line if it can be run, or what is wrong, where, and what would mend it.
    Check(SceneArgs),
    /// Lists materials with their parameters, couplings, backends, tasks and scenes.
    Plugins(plugins::PluginArgs),
    /// Lists what the backends can run on besides the processor: GPUs, and software in their place.
    Adapters,
    /// Measures.
    #[command(subcommand)]
    Bench(bench::Bench),
    /// Prints the JSON Schema of scene files, for editors.
    Schema,
}

/// Which scene, and how it is to be run.
#[derive(Args)]
struct SceneArgs {
    /// A built-in scene (see `barchan plugins`) or a TOML file [default: letters].
    scene: Option<String>,
    /// Changes a key of the scene, such as world.cell=0.02 or tool.cube.motion.free.mass=5; may be given again.
    #[arg(long, value_name = "KEY.PATH=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    engine: EngineArgs,
}

/// What runs the scene.
#[derive(Args, Clone)]
struct EngineArgs {
    /// Backend [default: cpu].
    #[arg(long)]
    backend: Option<String>,
    /// Number format: f32 or f64.
    #[arg(long, default_value = "f32")]
    precision: Precision,
    /// Worker threads; 0: as many as the machine has.
    #[arg(long, default_value_t = 0, value_parser = threads)]
    threads: usize,
    /// Name or number of the adapter to run on (see `barchan adapters`) [default: the first].
    #[arg(long, value_name = "NAME|INDEX")]
    adapter: Option<String>,
    /// A library with materials to load; may be given again.
    #[arg(long, value_name = "LIBRARY")]
    load: Vec<PathBuf>,
}

impl SceneArgs {
    fn scene(&self) -> Result<Scene> {
        scene(self.scene.as_deref().unwrap_or("letters"), &self.set)
    }
}

/// A number of threads that a machine may have.
fn threads(text: &str) -> std::result::Result<usize, String> {
    let most = barchan::Options::MOST_THREADS;
    match text.parse() {
        Ok(count) if count <= most => Ok(count),
        _ => Err(format!("must be a whole number from 0 to {most}")),
    }
}

/// A built-in scene by its name, or else a file, with keys set.
fn scene(name: &str, set: &[String]) -> Result<Scene> {
    let path = Path::new(name);
    let built_in = barchan::tasks::names().any(|known| known == name);
    // What is neither gets the error that lists the built-in ones, which helps most.
    if built_in || (path.extension().is_none() && !path.exists()) {
        barchan::tasks::scene(name, set)
    } else {
        Scene::from_file_with(path, set)
    }
}

impl EngineArgs {
    fn registry(&self) -> Result<Registry> {
        registry(&self.load)
    }
    fn backend(&self) -> &str {
        self.backend.as_deref().unwrap_or("cpu")
    }
    fn options(&self) -> barchan::Options {
        barchan::Options {
            backend: self.backend().to_owned(),
            precision: self.precision,
            threads: self.threads,
            adapter: self.adapter.clone(),
            ..barchan::Options::default()
        }
    }
}

/// All built-in plugins and those of the libraries; warnings go to stderr.
fn registry(load: &[PathBuf]) -> Result<Registry> {
    let mut registry = barchan::registry();
    load.iter().try_for_each(|library| registry.load(library).map(drop))?;
    registry.warnings().iter().for_each(|warning| tell(format!("warning: {warning}")));
    Ok(registry)
}

/// The plan of a scene, for a backend that is there.
fn assemble(args: &SceneArgs) -> Result<Plan> {
    let registry = args.engine.registry()?;
    let options = args.engine.options();
    let backend = registry.backend(&options.backend)?;
    let (plan, ..) = Plan::assemble(&registry, &args.scene()?, &options)?;
    backend.check(&plan)?;
    Ok(plan)
}

fn plan(args: &SceneArgs) -> Result<()> {
    let plan = assemble(args)?;
    let passes = args.engine.registry()?.backend(args.engine.backend())?.passes(&plan);
    let lines: String = passes.iter().map(|pass| format!("  {pass}\n")).collect();
    let heading = format!("\nPasses of the backend {}, in their order\n", args.engine.backend());
    show(format!("{plan}\n{}{lines}", if passes.is_empty() { "" } else { &heading }));
    Ok(())
}

fn check(args: &SceneArgs) -> Result<()> {
    let plan = assemble(args)?;
    plan.warnings.iter().for_each(|warning| tell(format!("warning: {warning}")));
    show(format!("{}: ok, {} particles, steps of {:.3e} s\n", plan.scene.name, plan.particle_count, plan.dt));
    Ok(())
}

fn main() -> ExitCode {
    let command = Cli::parse().command.unwrap_or_else(|| Command::Run(run::RunArgs::letters()));
    let done = match &command {
        Command::Run(args) => run::run(args),
        Command::Plan(args) => plan(args).map(|()| ExitCode::SUCCESS),
        Command::Check(args) => check(args).map(|()| ExitCode::SUCCESS),
        Command::Plugins(args) => plugins::list(args).map(|()| ExitCode::SUCCESS),
        Command::Adapters => {
            show(plugins::adapters(&barchan::registry()));
            Ok(ExitCode::SUCCESS)
        }
        Command::Bench(args) => bench::run(args).map(|()| ExitCode::SUCCESS),
        Command::Schema => {
            show(format!("{:#}\n", Scene::schema()));
            Ok(ExitCode::SUCCESS)
        }
    };
    match done {
        // A run leaves files; of the others nothing is left but what they have shown.
        Ok(_) if print::failed() && !matches!(command, Command::Run(_)) => ExitCode::FAILURE,
        Ok(code) => code,
        Err(error) => {
            let error: Error = error;
            tell(format!("error: {error}"));
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn no_argument_means_letters() {
        assert!(Cli::parse_from(["barchan"]).command.is_none());
        assert_eq!(run::RunArgs::letters().scene.scene().unwrap().name, "letters");
    }
}
