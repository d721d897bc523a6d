//! The conformance suite on the C template, compiled here and loaded as a plugin is, and on what it was at version 1.0 of the ABI, with the
//! header of then: old plugins must keep working.
#![expect(unsafe_code, reason = "loading a library runs its code")]

use barchan_material_kit::abi::{BarchanMaterial, BarchanPlugin};
use barchan_material_kit::{Subject, conformance};
use std::path::Path;
use std::process::Command;

fn conforms(source: &str, include: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let library = folder.path().join("libneo_hookean.so");
    let output = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()))
        .args(["-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-I"])
        .arg(root.join(include))
        .arg(root.join(source).join("neo_hookean.c"))
        .arg("-o")
        .arg(&library)
        .arg("-lm")
        .output()
        .expect("a C compiler: install cc or set CC");
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
    assert_eq!(subject.name(), "c_neo_hookean");
    match conformance::run_all(&subject, &subject.default_params()) {
        Ok(measured) => measured.iter().for_each(|m| println!("{m}")),
        Err(violation) => panic!("{violation}"),
    }
}

#[test]
fn the_c_template_conforms() {
    conforms("materials/template/c", "sim-core/abi/include");
}

#[test]
fn the_c_template_of_version_1_0_still_conforms() {
    conforms("tests/golden/abi_v1_0", "tests/golden/abi_v1_0");
}
