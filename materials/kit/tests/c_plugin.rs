//! The conformance suite on the templates in C and C++, compiled here and loaded as a plugin is, and on what the C one was at version 1.0 of
//! the ABI, with the header of then: old plugins must keep working.
#![expect(unsafe_code, reason = "loading a library runs its code")]

use barchan_material_kit::abi::{BarchanMaterial, BarchanPlugin, BarchanStr};
use barchan_material_kit::{Subject, conformance};
use std::path::Path;
use std::process::Command;

/// Compiler: the variable that names another one, its usual name, what it is told.
type Compiler = (&'static str, &'static str, &'static [&'static str]);
const C: Compiler = ("CC", "cc", &["-std=c11"]);
const CXX: Compiler = ("CXX", "c++", &["-std=c++17", "-Wpedantic"]);

/// Holds the one law of a source to the suite, and returns its WGSL, the update's and the stiffness'.
fn conforms((variable, usual, told): Compiler, source: &str, include: &str, name: &str) -> [String; 2] {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let library = folder.path().join("libneo_hookean.so");
    let output = Command::new(std::env::var_os(variable).unwrap_or_else(|| usual.into()))
        .args(told)
        .args(["-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-I"])
        .arg(root.join(include))
        .arg(root.join(source))
        .arg("-o")
        .arg(&library)
        .arg("-lm")
        .output()
        .unwrap_or_else(|error| panic!("{error}: install {usual} or set {variable}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    // SAFETY: the library is ours; its entry has this type, and its table obeys the ABI (that is what the suite checks).
    let plugin = unsafe {
        let library = libloading::Library::new(&library).expect("a library that loads");
        let entry = library
            .get::<unsafe extern "C" fn() -> *const BarchanPlugin>(b"barchan_plugin_v1")
            .expect("the plugin's entry");
        let plugin = *entry();
        // Its tables are used until the end.
        std::mem::forget(library);
        plugin
    };
    assert_eq!(plugin.n_materials, 1);
    // As a host reads it: what a table of an older version lacks is zero.
    let mut table = std::mem::MaybeUninit::<BarchanMaterial>::zeroed();
    // SAFETY: as above; a table begins with its size, and all of this version's may be zero.
    let table = unsafe {
        let from = *plugin.materials;
        let size = (*from.cast::<usize>()).min(size_of::<BarchanMaterial>());
        std::ptr::copy_nonoverlapping(from.cast::<u8>(), table.as_mut_ptr().cast::<u8>(), size);
        BarchanMaterial { struct_size: size_of::<BarchanMaterial>(), ..table.assume_init() }
    };
    // SAFETY: as above.
    let subject = unsafe { Subject::new(&table) }.expect("a table of this version");
    assert_eq!(subject.name(), name);
    match conformance::run_all(&subject, &subject.default_params()) {
        Ok(measured) => measured.iter().for_each(|m| println!("{m}")),
        Err(violation) => panic!("{violation}"),
    }
    [table.wgsl, table.wgsl_stiffness].map(text)
}

/// A text of a loaded table.
fn text(text: BarchanStr) -> String {
    if text.len == 0 {
        return String::new();
    }
    // SAFETY: a text of a table lives as long as its library, which is never unloaded.
    let bytes = unsafe { std::slice::from_raw_parts(text.ptr, text.len) };
    String::from_utf8(bytes.to_vec()).expect("a text is UTF-8")
}

/// Both hold one law. That its WGSL does what its C does is tested on GPUs (`tests/tests/shaders.rs`); that in C++ is the same.
#[test]
fn the_templates_in_c_and_cpp_conform() {
    let include = "sim-core/abi/include";
    let c = conforms(C, "materials/template/c/neo_hookean.c", include, "c_neo_hookean");
    let cpp = conforms(CXX, "materials/template/cpp/neo_hookean.cpp", include, "cpp_neo_hookean");
    for (c, cpp) in c.iter().zip(&cpp) {
        assert!(!c.is_empty(), "the template has a form for GPUs");
        assert_eq!(cpp.replace("cpp_neo_hookean", "c_neo_hookean").trim(), c.trim());
    }
}

#[test]
fn the_c_template_of_version_1_0_still_conforms() {
    let [_, stiffness] = conforms(C, "tests/golden/abi_v1_0/neo_hookean.c", "tests/golden/abi_v1_0", "c_neo_hookean");
    assert_eq!(stiffness, "", "version 1.0 had none");
}
