//! ARCHITECTURE.md is true: the paths of its stage table exist, and crates depend on each other as it says. So is `docs/cases.md`: the tests that it names
//! exist. And what can end a program says why it cannot happen.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests lie one folder below the root").to_owned()
}

/// Cells of the table below a heading, without its head.
fn table(text: &str, heading: &str) -> Vec<Vec<String>> {
    let section = text.split(heading).nth(1).unwrap_or_else(|| panic!("no section '{heading}'"));
    let rows = section.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    let cells = |line: &str| line.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect();
    rows.skip(2).map(cells).collect()
}

/// What stands between backticks.
fn quoted(cell: &str) -> impl Iterator<Item = &str> {
    cell.split('`').skip(1).step_by(2)
}

#[test]
fn every_path_of_the_stage_table_exists() {
    let text = std::fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let stages = table(&text, "## Stages");
    assert!(stages.len() >= 6, "the stage table has {} rows", stages.len());
    for row in &stages {
        let [stage, _, _, forward, adjoint, shader, test] = &row[..] else { panic!("{row:?} has not seven cells") };
        for cell in [forward, adjoint, shader, test] {
            assert!(cell == "–" || quoted(cell).count() > 0, "{stage}: '{cell}' is neither a path nor a dash");
            for path in quoted(cell) {
                assert!(root().join(path).is_file(), "{stage}: {path} does not exist");
            }
        }
        for path in quoted(test) {
            let code = std::fs::read_to_string(root().join(path)).unwrap();
            assert!(code.contains("#[test]") || code.contains("assert"), "{stage}: {path} tests nothing");
        }
    }
    for path in quoted(text.split("## Seams").nth(1).expect("a section on seams")).filter(|path| path.contains('/')) {
        assert!(root().join(path).is_file(), "{path} does not exist");
    }
}

/// The tests that `docs/cases.md` names, each behind its file: "`FILE`: `TEST`, `TEST`".
fn tests_of_cases(text: &str) -> Vec<(String, &str)> {
    let full = |path: &str| match path.split_once('/') {
        Some(("suite" | "gpu", _)) => format!("tests/tests/{path}"),
        _ => path.to_owned(),
    };
    let (mut tests, mut file, mut between) = (Vec::new(), None, "");
    for (i, piece) in text.split('`').enumerate() {
        match (i % 2, &file) {
            (0, _) => between = piece.trim(),
            _ if piece.ends_with(".rs") => file = Some(full(piece)),
            (_, Some(path)) if [":", ","].contains(&between) => tests.push((String::clone(path), piece)),
            _ => file = None,
        }
    }
    tests
}

/// Symptom guarded against: a test is renamed, moved or deleted, and the case that it held is held by nobody.
#[test]
fn every_test_that_a_case_names_exists() {
    let text = std::fs::read_to_string(root().join("docs/cases.md")).unwrap();
    let tests = tests_of_cases(text.split("\n## A.").nth(1).expect("a section of known answers"));
    assert!(tests.len() > 160, "{} tests were read", tests.len());
    for (file, test) in tests {
        let code = std::fs::read_to_string(root().join(&file)).unwrap_or_else(|e| panic!("{file}: {e}"));
        let before = code.split(&format!("fn {test}(")).next().filter(|before| before.len() < code.len());
        let before = before.unwrap_or_else(|| panic!("{file} has no {test}"));
        assert!(before.trim_end().ends_with("#[test]"), "{test} in {file} is no test");
    }
}

#[test]
fn crates_depend_on_each_other_along_the_arrows_only() {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(root())
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    let names: BTreeSet<&str> = packages.iter().map(|p| p["name"].as_str().unwrap()).collect();
    // What a crate is linked against: tests within it may use more.
    let arrows: BTreeMap<&str, BTreeSet<&str>> = packages
        .iter()
        .map(|p| {
            let linked = p["dependencies"].as_array().unwrap().iter().filter(|d| d["kind"] != "dev");
            let ours = linked.map(|d| d["name"].as_str().unwrap()).filter(|name| names.contains(name));
            (p["name"].as_str().unwrap(), ours.collect())
        })
        .collect();

    let lowest = ["barchan-abi", "barchan-lanes"];
    let with = |more: &[&'static str]| lowest.iter().chain(more).copied().collect::<BTreeSet<_>>();
    for (&name, linked) in &arrows {
        let package = packages.iter().find(|p| p["name"] == name).unwrap();
        let folder = Path::new(package["manifest_path"].as_str().unwrap()).parent().unwrap();
        let folder = folder.strip_prefix(root()).unwrap().to_str().unwrap();
        let allowed = match folder {
            "sim-core/abi" | "sim-core/lanes" => BTreeSet::new(),
            "sim-core" | "materials/kit" => with(&[]),
            "grid-hier" | "rigid-couple" => with(&["barchan-core"]),
            "tasks" => BTreeSet::from(["barchan-core"]),
            "bindings/cli" => BTreeSet::from(["barchan"]),
            // A material that is written in Python is one by the ABI.
            "bindings/python" => BTreeSet::from(["barchan", "barchan-abi"]),
            "tests" => names.clone(),
            "bindings/rust" => names
                .iter()
                .copied()
                .filter(|n| !matches!(*n, "barchan-cli" | "barchan-python" | "barchan-tests"))
                .collect(),
            _ if folder.starts_with("materials/") => with(&["barchan-material-kit"]),
            _ if folder.starts_with("backends/") => with(&["barchan-core", "barchan-grid"]),
            // What others build onto Barchan sees what others see.
            "tests/seams/material" => BTreeSet::from(["barchan-material-kit"]),
            "tests/seams/cli" => BTreeSet::from([
                "barchan",
                "barchan-cli",
                "barchan-seam-backend",
                "barchan-seam-coupling",
                "barchan-seam-observer",
                "barchan-seam-task",
            ]),
            _ if folder.starts_with("tests/seams/") => BTreeSet::from(["barchan"]),
            _ => panic!("{folder} is in no row of the arrows: add it here and to ARCHITECTURE.md"),
        };
        let beyond: Vec<_> = linked.difference(&allowed).collect();
        assert!(beyond.is_empty(), "{name} must not depend on {beyond:?}");
    }
    // The facade registers every plugin, and only it and the tests name them.
    let plugins: BTreeSet<&str> = packages
        .iter()
        .filter(|p| {
            let manifest = p["manifest_path"].as_str().unwrap();
            let built_in = ["materials/", "backends/", "rigid-couple/", "tasks/"];
            built_in.iter().any(|folder| manifest.contains(&format!("/{folder}")))
                && !["materials/kit/", "materials/template/"].iter().any(|folder| manifest.contains(folder))
        })
        .map(|p| p["name"].as_str().unwrap())
        .collect();
    assert!(plugins.len() >= 8 && plugins.is_subset(&arrows["barchan"]), "the facade lacks some of {plugins:?}");
}

/// Rust files below a folder that are neither tests, benches nor examples.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if path.is_dir() && !["tests", "benches", "examples", "target"].contains(&name) {
            sources(&path, found);
        } else if path.extension().is_some_and(|kind| kind == "rs") {
            found.push(path);
        }
    }
}

/// A program that ends in a panic loses what it has simulated, and tells a user nothing to act upon. Input never leads to one: what is left
/// says in words why it cannot happen.
#[test]
fn what_can_panic_says_why_it_does_not() {
    let mut files = Vec::new();
    for folder in ["sim-core", "grid-hier", "rigid-couple", "backends", "tasks", "bindings"] {
        sources(&root().join(folder), &mut files);
    }
    assert!(files.len() > 100, "{} files", files.len());
    let mut bare = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let code = text.split("#[cfg(test)]").next().unwrap_or_default();
        let lines = code.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
        for (i, line) in lines {
            let said = |call: &str| line.split(call).skip(1).map(str::to_owned).collect::<Vec<_>>();
            // A reason is a literal of a few words, on the line or behind it, or a constant.
            let is_reason = |rest: &String| {
                let next = code.lines().nth(i + 1).unwrap_or_default().trim();
                let rest = if rest.trim().is_empty() { next } else { rest };
                match rest.strip_prefix('"') {
                    Some(words) => words.split('"').next().unwrap_or_default().split_whitespace().count() >= 4,
                    None => rest.starts_with(|c: char| c.is_ascii_uppercase()),
                }
            };
            let calls = [".expect(", "panic!(", "unreachable!("].iter().flat_map(|call| said(call));
            if line.contains(".unwrap()")
                || line.contains(".unwrap_err()")
                || !calls.collect::<Vec<_>>().iter().all(is_reason)
            {
                bare.push(format!("{}:{}: {}", file.display(), i + 1, line.trim()));
            }
        }
    }
    assert!(bare.is_empty(), "give an error, or say in at least four words why it cannot happen:\n{}", bare.join("\n"));
}

/// Folders of the GPU backend, lowest first. Each may use itself and those before it; what lies beside them may use all.
const GPU_FOLDERS: [&str; 5] = ["device", "passes", "worlds", "readback", "schedule"];

/// Lines on which a file of one of these folders names what is not below it: numbers from 1, and what they name.
fn arrows_up(folder: usize, text: &str) -> Vec<(usize, String)> {
    let code = text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"));
    code.flat_map(|(i, line)| {
        let word = |rest: &str| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or("").to_owned();
        // A list of paths behind `crate::` has no first word, so that it is refused, too.
        let paths = line.split("crate::").skip(1).map(word).filter(|to| !GPU_FOLDERS[..=folder].contains(&to.as_str()));
        // A module's own tests take all of it; other paths are written from the root, where they can be seen.
        let beside = (line.contains("super::") && line.trim() != "use super::*;").then(|| "super".to_owned());
        paths.chain(beside).map(move |to| (i + 1, to)).collect::<Vec<_>>()
    })
    .collect()
}

#[test]
fn folders_of_the_gpu_backend_use_only_what_is_below_them() {
    let source = root().join("backends/wgpu/src");
    let mut up = Vec::new();
    for (folder, name) in GPU_FOLDERS.iter().enumerate() {
        let mut files = Vec::new();
        sources(&source.join(name), &mut files);
        assert!(files.len() > 2, "{name} holds {} files", files.len());
        for file in files {
            let text = std::fs::read_to_string(&file).unwrap();
            let file = file.strip_prefix(&source).unwrap().display().to_string();
            up.extend(arrows_up(folder, &text).into_iter().map(|(line, to)| format!("{file}:{line} uses {to}")));
        }
    }
    assert!(up.is_empty(), "the order is {}:\n{}", GPU_FOLDERS.join(", "), up.join("\n"));
    // Every folder has its place in the order.
    let folders = std::fs::read_dir(&source).unwrap().map(Result::unwrap).filter(|entry| entry.path().is_dir());
    let names: BTreeSet<_> = folders.map(|entry| entry.file_name().into_string().unwrap()).collect();
    let known: BTreeSet<_> = GPU_FOLDERS.into_iter().chain(["wgsl"]).map(str::to_owned).collect();
    assert_eq!(names, known);

    let text = "use crate::device::Gpu;\n/// As crate::schedule says.\nuse crate::{schedule, worlds};\n\
                fn f() { crate::engine::go(super::x()) }\nuse super::*;\n";
    let found = arrows_up(1, text);
    let found: Vec<_> = found.iter().map(|(line, to)| (*line, to.as_str())).collect();
    assert_eq!(found, [(3, ""), (4, "engine"), (4, "super")]);
}
