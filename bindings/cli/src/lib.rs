//! Barchan's command line: runs, plans and checks scenes, holds materials to the conformance suite, lists plugins, measures.
//!
//! [`main_with`] is all of it for a registry of your own, with your couplings, backends, materials and tasks in it. The binary
//! `barchan` is `main_with(barchan::registry())`, and yours is as short:
//!
//! ```no_run
//! # mod my_coupling {
//! #     pub fn register(_: &mut barchan::Registry) -> barchan::Result<()> { Ok(()) }
//! # }
//! fn main() -> std::process::ExitCode {
//!     let mut registry = barchan::registry();
//!     my_coupling::register(&mut registry).expect("nobody else has taken its name");
//!     barchan_cli::main_with(registry)
//! }
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "they panic where the terminal is gone: see `print`")]

mod bench;
mod conform;
mod gallery;
mod manual;
mod plugins;
mod print;
mod report;
mod robot;
mod run;
mod signals;
mod task;

use barchan::parameter::{Given, Table};
use barchan::{Error, Plan, Precision, Registry, Result, Scene};
use clap::{Args, Parser, Subcommand};
use print::{show, tell};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Simulates robots on and in soft ground.
///
/// Without a command: `run letters`.
#[derive(Parser)]
#[command(name = "barchan", version, arg_required_else_help = false, after_help = ENVIRONMENT)]
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
    /// Holds the materials of a library, or one that is built in, to the conformance suite: a table of checks, and what is wrong where.
    ///
    /// Stress and energy, frames and rates, moduli that bound the time step, strain paths and cycles, both precisions, faults that must be reported; at
    /// the defaults and at parameters drawn from their declared ranges. What a law need not do follows from what it declares. The exit status is
    /// 1 if a check fails.
    Conform(conform::ConformArgs),
    /// Lists materials, couplings, backends and tasks with their parameters, and scenes.
    Plugins(plugins::PluginArgs),
    /// Lists what the backends can run on besides the processor: GPUs, and software in their place.
    Adapters,
    /// Looks at robots.
    #[command(subcommand)]
    Robot(robot::Robot),
    /// Runs classic experiments, each beside its law: a table of figures, and a plot for each. The exit status is 1 if a figure is beyond its tolerance.
    Gallery(gallery::GalleryArgs),
    /// Plays benchmark tasks.
    #[command(subcommand)]
    Task(task::TaskCommand),
    /// Measures.
    #[command(subcommand)]
    Bench(bench::Bench),
    /// Prints the JSON Schema of scene files, for editors.
    Schema,
    /// Prints a script that lets a shell complete commands and options.
    Completions(manual::CompletionArgs),
    /// Prints the manual page, as `man` reads it, or writes those of all commands.
    Man(manual::ManArgs),
}

/// Which scene, and how it is to be run.
#[derive(Args)]
struct SceneArgs {
    /// A built-in scene (see `plugins`) or a TOML file [default: letters].
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
    /// Asks the backend for something that it offers (see `plugins`), such as drag=0.5; may be given again.
    #[arg(long, value_name = "KEY=VALUE", value_parser = barchan::parameter::parse)]
    backend_parameter: Vec<(String, Given)>,
    /// Number format: f32 or f64.
    #[arg(long, default_value = "f32")]
    precision: Precision,
    /// Worker threads; 0: as many as the machine has.
    #[arg(long, default_value_t = 0, value_parser = threads)]
    threads: usize,
    /// Name or number of the adapter to run on (see `adapters`) [default: the first].
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
    /// `registry`, and the libraries that the command line names.
    fn load_into(&self, registry: Registry) -> Result<Registry> {
        load(registry, &self.load)
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
            backend_parameters: self.backend_parameter.iter().cloned().collect(),
            ..barchan::Options::default()
        }
    }
}

/// The same for another backend: what is asked of one backend does not go to others.
fn moved(options: barchan::Options, backend: &str) -> barchan::Options {
    let keeps = options.backend == backend;
    let backend_parameters = if keeps { options.backend_parameters } else { Table::new() };
    barchan::Options { backend: backend.to_owned(), backend_parameters, ..options }
}

/// The plugins of a registry and those of libraries; warnings go to stderr.
fn load(mut registry: Registry, libraries: &[PathBuf]) -> Result<Registry> {
    libraries.iter().try_for_each(|library| registry.load(library).map(drop))?;
    registry.warnings().iter().for_each(|warning| tell(format!("warning: {warning}")));
    Ok(registry)
}

/// The plan of a scene, for a backend that is there.
fn assemble(args: &SceneArgs, registry: &Registry) -> Result<Plan> {
    let options = args.engine.options();
    let backend = registry.backend(&options.backend)?;
    let (plan, _, couplings) = Plan::assemble(registry, &args.scene()?, &options)?;
    backend.check(&plan)?;
    barchan::run::check_output(&plan, &couplings, &registry.make_observers(&plan.scene)?)?;
    Ok(plan)
}

fn plan(args: &SceneArgs, registry: Registry) -> Result<()> {
    let registry = args.engine.load_into(registry)?;
    let plan = assemble(args, &registry)?;
    let passes = registry.backend(args.engine.backend())?.passes(&plan);
    let lines: String = passes.iter().map(|pass| format!("  {pass}\n")).collect();
    let heading = format!("\nPasses of the backend {}, in their order\n", args.engine.backend());
    show(format!("{plan}\n{}{lines}", if passes.is_empty() { "" } else { &heading }));
    Ok(())
}

fn check(args: &SceneArgs, registry: Registry) -> Result<()> {
    let plan = assemble(args, &args.engine.load_into(registry)?)?;
    plan.warnings.iter().for_each(|warning| tell(format!("warning: {warning}")));
    show(format!("{}: ok, {} particles, steps of {:.3e} s\n", plan.scene.name, plan.particle_count, plan.dt));
    Ok(())
}

/// The whole command line, with the plugins of `registry`: what the words that the process was started with ask for, and the exit
/// status. Libraries that they load (`--load`) come on top.
///
/// Ends the process itself if the words are wrong, or ask for help or the version.
pub fn main_with(registry: Registry) -> ExitCode {
    let command = Cli::parse().command.unwrap_or_else(|| Command::Run(run::RunArgs::letters()));
    let done = match &command {
        Command::Run(args) => run::run(args, registry),
        Command::Plan(args) => plan(args, registry).map(|()| ExitCode::SUCCESS),
        Command::Check(args) => check(args, registry).map(|()| ExitCode::SUCCESS),
        Command::Conform(args) => conform::run(args, &registry),
        Command::Plugins(args) => plugins::list(args, registry).map(|()| ExitCode::SUCCESS),
        Command::Adapters => {
            show(plugins::adapters(&registry));
            Ok(ExitCode::SUCCESS)
        }
        Command::Robot(args) => robot::run(args).map(|()| ExitCode::SUCCESS),
        Command::Gallery(args) => gallery::run(args),
        Command::Task(command) => task::run(command, registry).map(|()| ExitCode::SUCCESS),
        Command::Bench(args) => bench::run(args, registry).map(|()| ExitCode::SUCCESS),
        Command::Schema => {
            show(format!("{:#}\n", Scene::schema()));
            Ok(ExitCode::SUCCESS)
        }
        Command::Completions(args) => {
            manual::completions(args);
            Ok(ExitCode::SUCCESS)
        }
        Command::Man(args) => manual::man(args).map(|()| ExitCode::SUCCESS),
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
