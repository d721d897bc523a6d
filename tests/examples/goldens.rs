//! Holds what small scenes leave to the hashes in `golden/states.txt`: `cargo run --release -p barchan-tests --example goldens`.
//!
//! All instruction sets of the machine are gone through, on the CPU and on `wgpu` where there is an adapter (`--backend cpu` or `wgpu` for one of them). Where
//! the file has no hashes for what is here, the commit that changed it last is built and run beside, which takes minutes. Ends with 1 where a hash differs.
//!
//! `--write` writes the file anew; hashes of other machines stay if none of this one's has changed. `--print` prints the hashes of
//! this process's instruction set and does nothing else.

use barchan_lanes::Isa;
use barchan_tests::goldens::{Hashes, adapters, compute, file, lines, read};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

const HEAD: &str = "# Hashes of what small scenes leave: what computes them, the scene, the hash. Written by the example `goldens` with --write.\n";

fn main() -> ExitCode {
    match run(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(message) => {
            println!("{message}");
            ExitCode::from(2)
        }
    }
}

/// Does everything agree?
fn run(arguments: &[String]) -> Result<bool, String> {
    let has = |name: &str| arguments.iter().any(|argument| argument == name);
    let asked = arguments.iter().position(|argument| argument == "--backend").and_then(|at| arguments.get(at + 1));
    let known = ["--print", "--write", "--backend", "cpu", "wgpu"];
    if let Some(other) = arguments.iter().find(|argument| !known.contains(&argument.as_str())) {
        return Err(format!("unknown argument '{other}'; known are --print, --write, --backend cpu, --backend wgpu"));
    }
    let backends: Vec<&str> = match asked {
        Some(one) => vec![one],
        None if !adapters("wgpu").map_err(|e| e.to_string())?.is_empty() => vec!["cpu", "wgpu"],
        None => vec!["cpu"],
    };
    if has("--print") {
        let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
        for backend in backends {
            print!("{}", lines(&compute(backend, folder.path())?));
        }
        return Ok(true);
    }
    let exe = std::env::current_exe().map_err(|e| e.to_string())?;
    let now = all_of(&backends, || Command::new(&exe))?;
    let kept = std::fs::read_to_string(file()).unwrap_or_default();
    if has("--write") {
        return write(&now, &read(&kept)).map(|()| true);
    }
    let mut wanted = read(&kept);
    let keys: BTreeSet<&String> = now.keys().map(|(key, _)| key).collect();
    let missing: Vec<_> = keys.iter().filter(|key| !wanted.keys().any(|(k, _)| k == **key)).collect();
    if !missing.is_empty() {
        let commit = last_change()?;
        println!("no hashes for {missing:?}: building commit {commit} to compare with");
        wanted.extend(of_commit(&commit, &backends)?);
    }
    let mut differ = 0;
    for (what, hash) in &now {
        let then = wanted.get(what);
        if then != Some(hash) {
            differ += 1;
            println!("{} | {}: {}", what.0, what.1, if then.is_some() { "differs" } else { "has no hash" });
        }
    }
    println!(
        "{} of {} states are as they were, on {}",
        now.len() - differ,
        now.len(),
        keys.into_iter().cloned().collect::<Vec<_>>().join("; ")
    );
    Ok(differ == 0)
}

/// Hashes of a build of this example, which prints them: on the CPU with each instruction set of the machine.
fn all_of(backends: &[&str], command: impl Fn() -> Command) -> Result<Hashes, String> {
    let best = Isa::current().map_err(|e| e.to_string())?;
    let mut all = Hashes::new();
    for backend in backends {
        for isa in Isa::available().filter(|isa| *backend == "cpu" || *isa == best) {
            let output = command().args(["--print", "--backend", backend]).env("BARCHAN_ISA", isa.name()).output();
            let output = output.map_err(|e| e.to_string())?;
            let text = String::from_utf8_lossy(&output.stdout);
            if !output.status.success() {
                return Err(format!("{backend}, {}: {text}{}", isa.name(), String::from_utf8_lossy(&output.stderr)));
            }
            all.extend(read(&text));
        }
    }
    Ok(all)
}

/// The commit whose states the file holds.
fn last_change() -> Result<String, String> {
    let mut git = Command::new("git");
    git.arg("-C").arg(env!("CARGO_MANIFEST_DIR")).args(["log", "-1", "--format=%H", "--"]).arg(file());
    let output = git.output().map_err(|e| format!("git log: {e}"))?;
    let commit = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    let none = "git knows of no commit that changed the file of hashes: run this in a clone with its history";
    if commit.is_empty() { Err(none.to_owned()) } else { Ok(commit) }
}

/// Builds a commit in a folder of its own and runs it.
fn of_commit(commit: &str, backends: &[&str]) -> Result<Hashes, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let tree: PathBuf = std::env::temp_dir().join(format!("barchan-goldens-{commit}"));
    let git = |arguments: &[&str]| {
        let done =
            Command::new("git").arg("-C").arg(&root).args(arguments).status().is_ok_and(|status| status.success());
        if done { Ok(()) } else { Err(format!("git {} failed", arguments.join(" "))) }
    };
    let path = tree.display().to_string();
    if !tree.exists() {
        git(&["worktree", "add", "--detach", &path, commit])?;
    }
    let run = || {
        let mut cargo = Command::new("cargo");
        cargo.current_dir(&tree).args([
            "run",
            "--release",
            "--quiet",
            "-p",
            "barchan-tests",
            "--example",
            "goldens",
            "--",
        ]);
        cargo.env("CARGO_TARGET_DIR", tree.join("target"));
        cargo
    };
    let hashes = all_of(backends, run);
    git(&["worktree", "remove", "--force", &path])?;
    hashes
}

fn write(now: &Hashes, kept: &Hashes) -> Result<(), String> {
    let changed = now.iter().filter(|(what, hash)| kept.get(*what).is_some_and(|then| then != *hash)).count();
    let mut all = now.clone();
    if changed == 0 {
        all.extend(kept.iter().map(|(what, hash)| (what.clone(), *hash)));
    }
    std::fs::write(file(), format!("{HEAD}{}", lines(&all))).map_err(|e| format!("{}: {e}", file().display()))?;
    println!("{} hashes written, {changed} of them changed", all.len());
    Ok(())
}
