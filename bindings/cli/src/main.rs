//! The command line `barchan`, with the plugins that come with it.

use std::process::ExitCode;

fn main() -> ExitCode {
    barchan_cli::main_with(barchan::registry())
}
