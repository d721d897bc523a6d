//! `barchan completions` and `barchan man`: the command line as shells and `man` want it told.

use crate::Cli;
use crate::print::show;
use barchan::{Error, Result};
use clap::{Args, CommandFactory};
use clap_complete::Shell;
use clap_mangen::Man;
use std::fs;
use std::path::{Path, PathBuf};

#[derive(Args)]
pub(crate) struct CompletionArgs {
    /// The shell.
    shell: Shell,
}

#[derive(Args)]
pub(crate) struct ManArgs {
    /// Write a page for each command into this folder, such as ~/.local/share/man/man1.
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Prints a script for a shell.
pub(crate) fn completions(args: &CompletionArgs) {
    show(script(args.shell, &program()));
}

/// Prints the page of the program, or writes those of all commands into a folder.
///
/// # Errors
/// If the folder cannot be written to.
pub(crate) fn man(args: &ManArgs) -> Result<()> {
    let program = program();
    let command = Cli::command().disable_help_subcommand(true).display_name(program.clone()).bin_name(program);
    let Some(out) = &args.out else {
        let mut page = Vec::new();
        Man::new(command).render(&mut page).expect("memory takes what is written");
        show(String::from_utf8_lossy(&page));
        return Ok(());
    };
    let io_error = |what| move |source| Error::Io { file: out.clone(), what, source };
    fs::create_dir_all(out).map_err(io_error("this folder cannot be made (choose another with --out)"))?;
    clap_mangen::generate_to(command, out).map_err(io_error("writing the manual"))
}

/// Completions of the command line for a program of that name.
fn script(shell: Shell, program: &str) -> String {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), program, &mut script);
    String::from_utf8_lossy(&script).into_owned()
}

/// The name that this program was started by: another crate's command line is not called barchan.
fn program() -> String {
    let path = std::env::args_os().next();
    let name =
        path.as_ref().and_then(|path| Path::new(path).file_stem()).map(|name| name.to_string_lossy().into_owned());
    name.unwrap_or_else(|| "barchan".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum;

    /// What goes to the terminal loses its control characters: a script must have none to lose.
    #[test]
    fn scripts_are_printed_whole() {
        for shell in Shell::value_variants() {
            let script = script(*shell, "barchan");
            assert!(!script.contains(|c: char| c.is_control() && c != '\n'), "{shell}");
        }
    }
}
