//! Runs the large cases of the backend wgpu on the first adapter, and writes docs/reports/wgpu-large.md.
//!
//! `cargo run --release -p barchan-tests --example large_gpu -- NAME|all`; without `all` the report is printed only. Meant for a GPU: a
//! software adapter takes hours.

use barchan_tests::large_cases::{cube, flight, heap, jelly, laws, levels, worlds};
use barchan_tests::report::{Case, run_cases};
use std::process::ExitCode;

const CASES: [Case; 8] = [
    ("jelly", "Jelly in a corner", jelly),
    ("laws", "Blocks of all laws fall upon each other", laws),
    ("heap", "A column of sand collapses", heap),
    ("flight", "Flight round a periodic world", flight),
    ("cube", "A cube falls onto sand", cube),
    ("levels", "Three levels follow a blade", || levels(false)),
    ("subcycled", "Three subcycled levels follow a blade", || levels(true)),
    ("worlds", "64 worlds in one batch", worlds),
];

fn main() -> ExitCode {
    let adapters = barchan_wgpu::device::adapters();
    let adapter = adapters.first().map_or("no adapter", |adapter| adapter.name.as_str());
    let intro = format!(
        "# Large cases of the backend wgpu\n\nWritten by `cargo run --release -p barchan-tests --example large_gpu -- all` on {adapter}; references \
         are the CPU in f64.\n"
    );
    run_cases(&CASES, "docs/reports/wgpu-large.md", &intro)
}
