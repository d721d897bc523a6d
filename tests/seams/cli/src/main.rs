//! Barchan's command line with more plugins than come with it: a coupling, a backend, an observer and a task of other crates.

use barchan::{Registry, Result};
use std::process::ExitCode;

fn main() -> ExitCode {
    let mut registry = barchan::registry();
    register(&mut registry).expect("nobody else has taken their names");
    barchan_cli::main_with(registry)
}

fn register(registry: &mut Registry) -> Result<()> {
    barchan_seam_coupling::register(registry)?;
    barchan_seam_backend::register(registry)?;
    barchan_seam_observer::register(registry)?;
    barchan_seam_task::register(registry)
}
