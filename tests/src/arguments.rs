//! Options of the examples.

use std::collections::BTreeMap;
use std::process::ExitCode;

/// Reads options, each with a value: `--name value`.
///
/// # Errors
/// If there is another one, or a value is missing.
pub fn options<'a>(arguments: &'a [String], known: &[&str]) -> Result<BTreeMap<&'a str, &'a str>, String> {
    let one = |pair: &'a [String]| match pair {
        [name, value] if known.contains(&name.as_str()) => Ok((name.as_str(), value.as_str())),
        _ => Err(format!("'{}' is no option with a value; there are {}", pair[0], known.join(", "))),
    };
    arguments.chunks(2).map(one).collect()
}

/// Runs an example with its arguments. What it says in an error is printed, and ends it with 2.
pub fn run(example: impl FnOnce(&[String]) -> Result<(), String>) -> ExitCode {
    match example(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            println!("{message}");
            ExitCode::from(2)
        }
    }
}
