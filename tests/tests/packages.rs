//! What others get of Barchan is whole: published packages say what they are and hold all that they include, and the template of a material
//! builds outside this repository.

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the tests lie one folder below the root")
}

fn cargo(folder: &Path, args: &[&str]) -> String {
    let output = Command::new(env!("CARGO")).args(args).current_dir(folder).output().expect("cargo runs");
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("cargo prints UTF-8")
}

/// Packages of the workspace, and whether they are published.
fn packages() -> Vec<(Value, bool)> {
    let text = cargo(root(), &["metadata", "--no-deps", "--offline", "--format-version", "1"]);
    let mut metadata: Value = serde_json::from_str(&text).unwrap();
    let packages = metadata["packages"].as_array_mut().map(std::mem::take).unwrap();
    let with_published = |package: Value| {
        // Null: anywhere. An empty list: nowhere.
        let published = package["publish"].is_null();
        (package, published)
    };
    packages.into_iter().map(with_published).collect()
}

fn folder(package: &Value) -> PathBuf {
    Path::new(package["manifest_path"].as_str().unwrap()).parent().unwrap().to_owned()
}

/// Rust sources of a folder.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
    entries
        .flat_map(|path| match path.extension() {
            _ if path.is_dir() => sources(&path),
            Some(extension) if extension == "rs" => vec![path],
            _ => Vec::new(),
        })
        .collect()
}

#[test]
fn tests_and_templates_are_not_published_and_all_else_is() {
    for (package, published) in packages() {
        let folder = folder(&package);
        let inner = folder.strip_prefix(root()).unwrap();
        // The Python package goes to PyPI, as a wheel.
        let ours = ["tests", "materials/template", "bindings/python"].iter().any(|folder| inner.starts_with(folder));
        assert_eq!(published, !ours, "{}: publish in {}", package["name"], inner.display());
    }
}

#[test]
fn published_packages_say_what_they_are() {
    for (package, _) in packages().into_iter().filter(|(_, published)| *published) {
        let name = package["name"].as_str().unwrap();
        for key in ["description", "license", "repository", "readme", "rust_version"] {
            assert!(package[key].as_str().is_some_and(|text| !text.is_empty()), "{name} has no {key}");
        }
        for key in ["keywords", "categories"] {
            // What the registry takes.
            assert!((1..=5).contains(&package[key].as_array().unwrap().len()), "{name}: {key}");
        }
        for licence in ["LICENSE-MIT", "LICENSE-APACHE"] {
            let held = fs::read_to_string(folder(&package).join(licence));
            let held = held.unwrap_or_else(|error| panic!("{name}: {licence}: {error}"));
            assert_eq!(held, fs::read_to_string(root().join(licence)).unwrap(), "{name}: {licence} is another one");
        }
        for dependency in package["dependencies"].as_array().unwrap() {
            // A path leads nowhere for others; of what only tests need it is left out.
            let (needed, version) = (dependency["kind"] != "dev", dependency["req"].as_str().unwrap());
            assert!(!needed || version != "*", "{name}: {} has no version", dependency["name"]);
        }
    }
}

/// A file beyond the package's folder is there when it is built here, and missing when it is built from what was published.
#[test]
fn published_packages_include_only_what_is_in_them() {
    let mut included = 0;
    for (package, _) in packages().into_iter().filter(|(_, published)| *published) {
        let folder = folder(&package).canonicalize().unwrap();
        for source in sources(&folder.join("src")) {
            let code = fs::read_to_string(&source).unwrap();
            for call in ["include_str!(\"", "include_bytes!(\"", "include!(\""] {
                for rest in code.split(call).skip(1) {
                    let file = source.parent().unwrap().join(rest.split('"').next().unwrap());
                    let found = file.canonicalize().unwrap_or_else(|error| panic!("{}: {error}", file.display()));
                    assert!(found.starts_with(&folder), "{} includes {}", source.display(), found.display());
                    included += 1;
                }
            }
        }
    }
    assert!(included > 100, "{included} files are included: those of wgpu alone are more");
}

/// The template, as its README has it copied: a library with Barchan's entry.
#[test]
fn the_template_builds_outside_this_repository() {
    let outside = tempfile::tempdir().unwrap();
    let template = root().join("materials/template/rust");
    for file in ["Cargo.toml", "src/lib.rs", "src/template_neo_hookean.wgsl", "src/template_neo_hookean_stiffness.wgsl"]
    {
        let to = outside.path().join(file);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::copy(template.join(file), to).unwrap();
    }
    let manifest = outside.path().join("Cargo.toml");
    let text = fs::read_to_string(&manifest).unwrap();
    let kit = root().join("materials/kit");
    let text = text.replace("barchan-material-template", "my-clay").replace("../../kit", kit.to_str().unwrap());
    assert!(text.contains("my-clay") && text.contains(kit.to_str().unwrap()), "{text}");
    fs::write(&manifest, text).unwrap();
    cargo(outside.path(), &["build", "--offline", "--target-dir", "target"]);
    let library = format!("{}my_clay{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    let mut registry = barchan::registry();
    let names = registry.load(&outside.path().join("target/debug").join(library)).unwrap();
    assert_eq!(names, ["template_neo_hookean"]);
}
