//! Loading plugins: C libraries built here with one thing wrong each.

use barchan_core::parameter::Kind;
use barchan_core::{Error, Registry};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A plugin with two materials. Every macro can be set from the command line to break something.
const SOURCE: &str = r#"
#include "barchan_abi.h"
#define TEXT(s) { (const uint8_t *)(s), sizeof(s) - 1 }
#ifndef ENTRY
#define ENTRY barchan_plugin_v1
#endif
#ifndef PLUGIN
#define PLUGIN
#endif
#ifndef MATERIAL
#define MATERIAL
#endif
#ifndef PARAM
#define PARAM
#endif
#ifndef STATE
#define STATE
#endif
#ifndef RESULT
#define RESULT &plugin
#endif
#ifndef SECOND
#define SECOND &second
#endif

static BarchanStatus update(const struct BarchanBatchF32 *batch, struct BarchanError *error) {
  (void)batch; (void)error;
  return BARCHAN_OK;
}
static BarchanStatus moduli(const struct BarchanBatchF32 *batch, float *out, struct BarchanError *error) {
  (void)error;
  for (size_t i = 0; i < batch->n; i++) { out[i] = 2.0f; out[batch->stride + i] = 3.0f; }
  return BARCHAN_OK;
}
/* Entries of a later minor version are longer: the step between them is the plugin's. */
struct LongParam { struct BarchanParam known; double added; };
static const struct LongParam params[] = {
  { { .name = TEXT("stiffness"), .unit = TEXT("Pa"), .doc = TEXT("How stiff."), .default_value = 5, .min_value = 0,
      .max_value = 10, .flags = BARCHAN_PARAM_MIN_OPEN, PARAM }, 1 },
  { { .name = TEXT("angle"), .unit = TEXT("rad"), .doc = TEXT("An angle."), .default_value = 0.5, .min_value = 0,
      .max_value = 1 }, 1 },
};
static const struct BarchanStateVar states[] = {
  { .name = TEXT("age"), .unit = TEXT("s"), .doc = TEXT("Age."), .initial_value = 0.25, STATE },
};
#define COMMON \
  .struct_size = sizeof(struct BarchanMaterial), .abi_major = 1, .abi_minor = 7, .strain_kind = 1, \
  .version = TEXT("1.2"), .doc = TEXT("Soft \xc2\xb5."), .reference = TEXT("none"), \
  .params = &params[0].known, .n_params = 2, .param_size = sizeof(struct LongParam), \
  .states = states, .n_state = 1, .state_size = sizeof states[0], \
  .update_f32 = update, .tangent_moduli_f32 = moduli
static const struct BarchanMaterial first = { COMMON, .name = TEXT("first") };
static const struct BarchanMaterial second = { COMMON, .name = TEXT("second"), MATERIAL };
static const struct BarchanMaterial *const materials[] = { &first, SECOND };
static const struct BarchanPlugin plugin = {
  .struct_size = sizeof plugin, .abi_major = 1, .abi_minor = 7, .materials = materials, .n_materials = 2, PLUGIN
};
const struct BarchanPlugin *ENTRY(void) { return RESULT; }
"#;

/// Builds the plugin with macros set.
fn build(folder: &Path, name: &str, macros: &[&str]) -> PathBuf {
    let source = folder.join("plugin.c");
    std::fs::write(&source, SOURCE).unwrap();
    let library = folder.join(format!("lib{name}.so"));
    let output = Command::new("cc")
        .args(["-std=c11", "-Wall", "-Wextra", "-Wno-override-init", "-shared", "-fPIC", "-o"])
        .args([&library, &source])
        .arg(concat!("-I", env!("CARGO_MANIFEST_DIR"), "/abi/include"))
        .args(macros.iter().map(|m| format!("-D{m}")))
        .output()
        .expect("these tests need a C compiler called cc");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    library
}

#[test]
fn a_good_plugin_loads_with_everything_it_declares() {
    let folder = tempfile::tempdir().unwrap();
    let library = build(folder.path(), "good", &["PLUGIN=.flags=0"]);
    let mut registry = Registry::new();
    assert_eq!(registry.load(&library).unwrap(), ["first", "second"]);
    let material = registry.material("second").unwrap();
    assert_eq!(material.doc, "Soft µ.");
    assert_eq!(Path::new(&material.origin), library.canonicalize().unwrap());
    assert_eq!(material.strain_planes(), 6);
    let names: Vec<_> =
        material.parameters.iter().map(|p| (p.name.as_str(), p.unit.as_str(), p.default_number().unwrap())).collect();
    assert_eq!(names, [("stiffness", "Pa", 5.0), ("angle", "rad", 0.5)]);
    let Kind::Number(range) = &material.parameters[0].kind else { panic!("a law has numbers only") };
    assert_eq!(range.to_string(), "(0, 10]");
    assert_eq!((material.states[0].name.as_str(), material.states[0].initial), ("age", 0.25));
    assert!(material.table.tangent_moduli_f32.is_some() && material.table.update_f64.is_none());
    assert!(registry.warnings().is_empty());
    let error = registry.material("third").unwrap_err().to_string();
    assert_eq!(error, "registry: no material is called 'third'; known are: first, second");
}

#[test]
fn a_table_of_an_older_minor_version_reads_as_zero_where_it_ends() {
    let folder = tempfile::tempdir().unwrap();
    let macros = ["MATERIAL=.struct_size=offsetof(struct BarchanMaterial,tangent_moduli_f32)"];
    let library = build(folder.path(), "older", &macros);
    let mut registry = Registry::new();
    registry.load(&library).unwrap();
    assert!(registry.material("first").unwrap().table.tangent_moduli_f32.is_some());
    assert!(registry.material("second").unwrap().table.tangent_moduli_f32.is_none());
}

#[test]
fn a_plugin_that_aborts_on_panic_warns() {
    let folder = tempfile::tempdir().unwrap();
    let library = build(folder.path(), "aborts", &["PLUGIN=.flags=BARCHAN_PLUGIN_PANIC_ABORT"]);
    let mut registry = Registry::new();
    registry.load(&library).unwrap();
    assert!(registry.warnings()[0].contains("was built with panic = \"abort\""), "{:?}", registry.warnings());
}

#[test]
fn each_fault_is_refused_by_name_and_nothing_is_registered() {
    /// (name, macro, part of the message, part of what would mend it)
    const FAULTS: &[(&str, &str, &str, &str)] = &[
        ("symbol", "ENTRY=other_entry", "exports no symbol barchan_plugin_v1", "barchan_plugin_v1(void)`"),
        (
            "entry_v2",
            "ENTRY=barchan_plugin_v2",
            "built for plugin ABI 2, this program has 1.1",
            "rebuild it against major version 1",
        ),
        ("null_table", "RESULT=0", "its BarchanPlugin pointer is 0x0", "static table"),
        ("major", "PLUGIN=.abi_major=2", "the library was built for plugin ABI 2.7, this program has 1.1", "rebuild"),
        (
            "short",
            "PLUGIN=.struct_size=16",
            "its BarchanPlugin has struct_size 16; version 1 has at least 40",
            "sizeof(BarchanPlugin)",
        ),
        ("absurd", "PLUGIN=.struct_size=1u<<30", "struct_size 1073741824", "sizeof(BarchanPlugin)"),
        ("none", "PLUGIN=.n_materials=0", "lists 0 materials", "at least one"),
        ("no_list", "PLUGIN=.materials=0", "lists 2 materials at 0x0", "`materials`"),
        ("null_entry", "SECOND=0", "material 1 of 2: its BarchanMaterial pointer is 0x0", "static table"),
        (
            "material_major",
            "MATERIAL=.abi_major=3",
            "material 1 of 2: the material was built for plugin ABI 3.7",
            "rebuild",
        ),
        (
            "material_short",
            "MATERIAL=.struct_size=72",
            "its BarchanMaterial has struct_size 72; version 1 has at least",
            "sizeof(BarchanMaterial)",
        ),
        ("null_update", "MATERIAL=.update_f32=0", "material 'second': its update_f32 is NULL", "supply it"),
        ("strain", "MATERIAL=.strain_kind=5", "its strain_kind is 5", "BARCHAN_STRAIN_DEF_GRAD (0)"),
        ("utf8", "MATERIAL=.name=TEXT(\"caf\\xe9\")", "its name is not UTF-8 (byte 3 of 4)", "UTF-8"),
        ("doc_utf8", "MATERIAL=.doc=TEXT(\"\\xff\")", "material 'second': its doc is not UTF-8", "UTF-8"),
        ("wgsl_utf8", "MATERIAL=.wgsl=TEXT(\"fn \\xff\")", "material 'second': its wgsl is not UTF-8", "UTF-8"),
        (
            "wgsl_adj_utf8",
            "MATERIAL=.wgsl_adj=TEXT(\"\\xc3\")",
            "material 'second': its wgsl_adj is not UTF-8",
            "UTF-8",
        ),
        ("wgsl_null", "MATERIAL=.wgsl={0,7}", "its wgsl has 7 bytes at 0x0", "static UTF-8 text"),
        ("name", "MATERIAL=.name=TEXT(\"My.Sand\")", "its name is 'My.Sand'", "snake_case"),
        ("no_name", "MATERIAL=.name={0,0}", "its name is ''", "snake_case"),
        ("null_text", "MATERIAL=.version={0,3}", "its version has 3 bytes at 0x0", "static UTF-8 text"),
        (
            "long_text",
            "MATERIAL=.version={(const uint8_t*)\"a\",1u<<30}",
            "its version has 1073741824 bytes",
            "length in bytes",
        ),
        ("params", "MATERIAL=.params=0", "lists 2 BarchanParam entries of 88 bytes at 0x0", "sizeof(BarchanParam)"),
        ("param_size", "MATERIAL=.param_size=8", "entries of 8 bytes", "sizeof(BarchanParam)"),
        (
            "misaligned",
            "MATERIAL=.params=(const struct BarchanParam*)((const char*)params+1)",
            "lists 2 BarchanParam entries",
            "set the pointer",
        ),
        ("n_state", "MATERIAL=.n_state=1u<<30", "lists 1073741824 BarchanStateVar entries", "count"),
        (
            "default",
            "PARAM=.default_value=0",
            "the default 0 of parameter 'stiffness' is outside its range (0, 10]",
            "correct",
        ),
        ("nan", "PARAM=.min_value=0.0/0.0", "parameter 'stiffness' is outside its range (NaN, 10]", "correct"),
        ("twice", "PARAM=.name=TEXT(\"angle\")", "it declares parameter 'angle' twice", "rename"),
        ("merge", "STATE=.merge=9", "state variable 'age' has initial value 0.25 and merge rule 9", "BARCHAN_MERGE_"),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (name, setting, what, mend) in FAULTS {
        let library = build(folder.path(), name, &[setting]);
        let mut registry = Registry::new();
        let error = registry.load(&library).expect_err(name);
        let Error::Plugin { library: named, what: found, mend: advice } = &error else { panic!("{name}: {error}") };
        assert_eq!(*named, library.canonicalize().unwrap());
        assert!(found.contains(what), "{name}: {error}");
        assert!(advice.contains(mend), "{name}: {error}");
        assert_eq!(registry.materials().count(), 0, "{name}");
    }
}

#[test]
fn duplicate_names_are_refused_and_nothing_is_registered() {
    let folder = tempfile::tempdir().unwrap();
    let twin = build(folder.path(), "twin", &["MATERIAL=.name=TEXT(\"first\")"]);
    let mut registry = Registry::new();
    assert!(matches!(registry.load(&twin), Err(Error::Duplicate { kind: "material", name, .. }) if name == "first"));
    assert_eq!(registry.materials().count(), 0);

    let one = build(folder.path(), "one", &["PLUGIN=.n_materials=2"]);
    let other = build(folder.path(), "other", &["MATERIAL=.name=TEXT(\"third\")"]);
    registry.load(&one).unwrap();
    let error = registry.load(&other).unwrap_err().to_string();
    assert!(error.contains("libone.so") && error.contains("libother.so"), "{error}");
    assert!(registry.material("third").is_err(), "a library is registered whole or not at all");
}

#[test]
fn what_is_no_library_is_refused_with_the_systems_reason() {
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("notes.so");
    std::fs::write(&text, "not a library").unwrap();
    let error = Registry::new().load(&text).unwrap_err().to_string();
    // The reason is the operating system's; libloading's own text does not hold it.
    assert!(error.contains("invalid ELF header") || error.contains("file too short"), "{error}");
    let error = Registry::new().load(&folder.path().join("absent.so")).unwrap_err().to_string();
    assert!(error.contains("absent.so: cannot be opened: No such file"), "{error}");
}
