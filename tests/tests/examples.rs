//! Every public type of the crate `barchan` stands in an example of its pages that runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let of = |path: PathBuf| match path.is_dir() {
        true => sources(&path),
        false => vec![path],
    };
    entries.flat_map(of).filter(|path| path.extension().is_some_and(|ending| ending == "rs")).collect()
}

/// Lines of the examples in doc comments that are compiled and run.
fn examples(text: &str) -> String {
    let (mut runs, mut inside, mut lines) = (false, false, String::new());
    for line in text.lines() {
        let line = line.trim_start();
        let Some(doc) = line.strip_prefix("///").or_else(|| line.strip_prefix("//!")) else { continue };
        match doc.trim_start().strip_prefix("```") {
            Some(kind) => {
                inside = !inside;
                runs = inside && (kind.is_empty() || kind == "rust");
            }
            None if runs => lines += &format!("{doc}\n"),
            None => {}
        }
    }
    lines
}

/// Words of a text that can be names.
fn words(text: &str) -> BTreeSet<&str> {
    text.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|word| !word.is_empty()).collect()
}

/// Names of types that a file declares or passes on from the core.
fn types(text: &str) -> BTreeSet<&str> {
    let code: Vec<&str> = text.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
    let declared = code.iter().filter_map(|line| {
        let rest =
            ["pub struct ", "pub enum ", "pub trait ", "pub type "].iter().find_map(|kind| line.strip_prefix(kind))?;
        rest.split(|c: char| !c.is_alphanumeric()).next()
    });
    let passed_on = text.split("pub use ").skip(1).filter_map(|rest| rest.split(';').next()).flat_map(words);
    let is_type = |name: &&str| name.starts_with(|c: char| c.is_ascii_uppercase());
    declared.chain(passed_on).filter(is_type).collect()
}

#[test]
fn every_public_type_of_the_facade_stands_in_an_example_that_runs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../bindings/rust/src");
    let texts: Vec<String> = sources(&root).iter().map(|path| std::fs::read_to_string(path).unwrap()).collect();
    let shown = texts.iter().map(|text| examples(text)).collect::<String>();
    let shown = words(&shown);
    let all: BTreeSet<&str> = texts.iter().flat_map(|text| types(text)).collect();
    assert!(all.len() > 50 && all.contains("Simulation") && all.contains("Worlds"), "{all:?}");
    let missing: Vec<_> = all.difference(&shown).collect();
    assert!(
        missing.is_empty(),
        "no example shows {missing:?}: give each one in the docs of its `pub use` or its module"
    );
}
