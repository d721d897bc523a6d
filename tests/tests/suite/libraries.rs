//! Material plugins built as their authors would build them: C and C++ by one call of a compiler, Rust by cargo.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Folder of the repository.
pub(crate) fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Where this binary's libraries lie, below the target folder.
fn folder() -> &'static Path {
    let folder = Path::new(concat!(env!("CARGO_TARGET_TMPDIR"), "/plugins"));
    std::fs::create_dir_all(folder).expect("a folder below the target folder");
    folder
}

/// Builds a source in C, or in C++ if it ends so, against the header in `include`, a folder of the repository.
pub(crate) fn build_c(source: &Path, include: &str, name: &str) -> PathBuf {
    let library = folder().join(format!("lib{name}.so"));
    let cpp = source.extension().is_some_and(|extension| extension == "cpp");
    let (variable, usual, standard) = if cpp { ("CXX", "c++", "-std=c++17") } else { ("CC", "cc", "-std=c11") };
    let output = Command::new(std::env::var_os(variable).unwrap_or_else(|| usual.into()))
        .args([standard, "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-I"])
        .arg(root().join(include))
        .arg(source)
        .arg("-o")
        .arg(&library)
        .arg("-lm")
        .output()
        .unwrap_or_else(|error| panic!("{error}: install {usual} or set {variable}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    library
}

/// The C template built against the present header, or as it was at version 1.0 of the ABI against the header of then.
pub(crate) fn c_template(frozen: bool) -> PathBuf {
    static BUILT: [OnceLock<PathBuf>; 2] = [OnceLock::new(), OnceLock::new()];
    let (source, include, name) = match frozen {
        false => ("materials/template/c", "sim-core/abi/include", "c_template"),
        true => ("tests/golden/abi_v1_0", "tests/golden/abi_v1_0", "c_template_v1_0"),
    };
    let build = || build_c(&root().join(source).join("neo_hookean.c"), include, name);
    BUILT[usize::from(frozen)].get_or_init(build).clone()
}

/// A cdylib of this workspace by its package's name, out of one cargo run that builds all of them. The run has a target folder
/// of its own, so that it neither waits for the cargo that runs this test nor disturbs what that one has built.
pub(crate) fn rust_library(package: &str) -> PathBuf {
    const PACKAGES: [&str; 2] = ["barchan-material-template", "barchan-seam-material"];
    static BUILT: OnceLock<Vec<(String, PathBuf)>> = OnceLock::new();
    let built = BUILT.get_or_init(|| {
        let output = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
            .args(["build", "--release", "--offline", "--message-format", "json-render-diagnostics", "--target-dir"])
            .arg(folder().join("target"))
            .args(PACKAGES.iter().flat_map(|p| ["--package", p]))
            .current_dir(root())
            .output()
            .expect("cargo runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout)
            .lines()
            .filter_map(|line| {
                let message: serde_json::Value = serde_json::from_str(line).ok()?;
                let is_library = message["target"]["crate_types"].as_array()?.iter().any(|t| t == "cdylib");
                let file = message["filenames"].as_array()?.first()?.as_str().filter(|_| is_library)?;
                Some((message["target"]["name"].as_str()?.replace('_', "-"), file.into()))
            })
            .collect()
    });
    let found = built.iter().find(|(name, _)| name == package);
    found.unwrap_or_else(|| panic!("cargo built no {package}, but {built:?}")).1.clone()
}
