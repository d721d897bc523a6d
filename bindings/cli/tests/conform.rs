//! `barchan conform` from outside: what it is given, what it says, how it ends.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

fn barchan(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_barchan"));
    // Where there is a driver, it must not be found by the test without one.
    let without = args.contains(&"nobody's");
    let args = args.iter().filter(|arg| **arg != "nobody's");
    if without {
        command.env("VK_DRIVER_FILES", "/dev/null").env("VK_ICD_FILENAMES", "/dev/null");
    }
    command.current_dir(folder).arg("conform").args(args).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Wants every check to pass, and returns what was printed.
fn passes(folder: &Path, args: &[&str]) -> String {
    let output = barchan(folder, args);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}\n{printed}", text(&output.stderr));
    assert!(printed.contains("0 failed") && !printed.contains("FAILED"), "{printed}");
    printed
}

/// Wants exit status 1, and returns what was printed, and the error.
fn fails(folder: &Path, args: &[&str]) -> [String; 2] {
    let output = barchan(folder, args);
    assert_eq!(output.status.code(), Some(1), "{args:?}");
    [text(&output.stdout), text(&output.stderr)]
}

/// Builds a source in C, or in C++ if it ends so, into the folder.
fn build(folder: &Path, source: &str, name: &str, language: &str) -> PathBuf {
    let (variable, usual, standard) =
        if language == "cpp" { ("CXX", "c++", "-std=c++17") } else { ("CC", "cc", "-std=c11") };
    let file = folder.join(format!("{name}.{language}"));
    std::fs::write(&file, source).unwrap();
    let library = folder.join(format!("lib{name}.so"));
    let output = Command::new(std::env::var_os(variable).unwrap_or_else(|| usual.into()))
        .args([standard, "-O2", "-shared", "-fPIC", "-I"])
        .arg(Path::new(ROOT).join("sim-core/abi/include"))
        .arg(&file)
        .arg("-o")
        .arg(&library)
        .arg("-lm")
        .output()
        .unwrap_or_else(|error| panic!("{error}: install {usual} or set {variable}"));
    assert!(output.status.success(), "{}", text(&output.stderr));
    library
}

fn template(language: &str) -> String {
    let file = format!("{ROOT}/materials/template/{language}/neo_hookean.{language}");
    std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{file}: {error}"))
}

#[test]
fn a_built_in_law_is_found_by_its_name_and_passes() {
    let folder = tempfile::tempdir().unwrap();
    let printed = passes(folder.path(), &["sand", "--samples", "2"]);
    assert!(printed.contains("sand: no file of this name, but a material (built-in)"), "{printed}");
    for row in ["stress turns with the frame while it spins", "no closed strain cycle makes energy", "1.0e-2"] {
        assert!(printed.contains(row), "{printed}");
    }
    let declared = "viscosity bounds the measured one";
    let line = printed.lines().find(|line| line.contains(declared)).unwrap();
    assert!(line.contains("not asked") && line.contains("BARCHAN_CAP_VEL_GRAD"), "{line}");
}

#[test]
fn libraries_in_c_and_cpp_pass_and_a_file_comes_before_a_name() {
    let folder = tempfile::tempdir().unwrap();
    for (language, name) in [("c", "c_neo_hookean"), ("cpp", "cpp_neo_hookean")] {
        build(folder.path(), &template(language), "neo", language);
        // A material of this name is built in; the file is what is meant.
        std::fs::rename(folder.path().join("libneo.so"), folder.path().join("hencky")).unwrap();
        let printed = passes(folder.path(), &["hencky", "--samples", "2"]);
        assert!(printed.contains(&format!("hencky: a library of 1 material: {name}")), "{printed}");
    }
}

#[test]
fn a_wrong_law_is_told_what_is_wrong_and_where() {
    let folder = tempfile::tempdir().unwrap();
    let right = "c < 3 ? mu * (strain - 1) + pressure : mu * strain";
    let source = template("c");
    assert!(source.contains(right));
    let wrong = source.replace(right, "c < 2 ? mu * (strain - 1) + pressure : mu * strain");
    let library = build(folder.path(), &wrong, "wrong", "c");
    let [printed, error] = fails(folder.path(), &[library.to_str().unwrap(), "--samples", "0"]);
    assert!(error.contains("'c_neo_hookean' fails"), "{error}");
    let mut lines = printed.lines().skip_while(|line| !line.contains("no stress at the identity"));
    let [row, what] = [lines.next().unwrap(), lines.next().unwrap()];
    assert!(row.contains("FAILED"), "{row}");
    assert!(what.contains("is beyond the tolerance 1.0e-6") && what.contains("stress ["), "{what}");
    // The others are run all the same.
    assert!(printed.contains("bad structs are refused"), "{printed}");
}

#[test]
fn what_is_no_material_is_an_error_that_says_so() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("text.so"), "not a library").unwrap();
    let none = "#include <barchan_abi.h>\nstatic const BarchanPlugin P = {sizeof(BarchanPlugin), BARCHAN_ABI_MAJOR, \
                BARCHAN_ABI_MINOR, 0, 0, 0};\nconst BarchanPlugin *barchan_plugin_v1(void) { return &P; }\n";
    build(folder.path(), none, "none", "c");
    build(folder.path(), "int answer(void) { return 42; }\n", "other", "c");
    for (args, said) in [
        (&["snad"][..], "there is no file 'snad': no material is called 'snad'; known are: fixed_corotated"),
        (&["lib/absent.so"], "cannot be opened: No such file"),
        (&["text.so"], "check that it is a shared library for this machine"),
        (&["."], "check that it is a shared library for this machine"),
        (&["libnone.so"], "its table lists 0 materials"),
        (&["libother.so"], "exports no symbol barchan_plugin_v1"),
        (&["hencky", "--adapter", "0"], "the backend cpu runs on the processor alone"),
        (&["hencky", "--backend", "wgpu", "--adapter", "abacus"], "no adapter is called 'abacus'"),
        (&["hencky", "--backend", "wgpu", "nobody's"], "apt-get install mesa-vulkan-drivers"),
    ] {
        let [printed, error] = fails(folder.path(), args);
        assert!(error.contains(said), "{args:?}: {error}{printed}");
    }
}

#[test]
fn on_an_adapter_the_wgsl_is_held_to_the_law() {
    let folder = tempfile::tempdir().unwrap();
    let printed = passes(folder.path(), &["neo_hookean", "--backend", "wgpu", "--samples", "1"]);
    for row in ["WGSL runs on", "WGSL gives the stress", "WGSL gives moduli and viscosity"] {
        assert!(printed.contains(row), "{printed}");
    }
    let right = "barchan_affine(law.mu, strain";
    let source = template("c");
    assert!(source.contains(right));
    let wrong = source.replace(right, "barchan_affine(1.001 * law.mu, strain");
    let library = build(folder.path(), &wrong, "wrong_wgsl", "c");
    let library = library.to_str().unwrap();
    passes(folder.path(), &[library, "--samples", "0"]);
    let [printed, error] = fails(folder.path(), &[library, "--backend", "wgpu", "--samples", "0"]);
    assert!(error.contains("'c_neo_hookean' fails 1 of"), "{error}");
    assert!(printed.contains("WGSL gives the stress") && printed.contains("the processor"), "{printed}");
}
