//! Options of the examples.

use std::collections::BTreeMap;

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
