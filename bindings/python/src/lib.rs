//! The module `barchan._core`: the facade, as Python sees it. What users import, and how it is typed, stands in `python/barchan`.
//!
//! - Names, shapes and units are those of the Rust interface; records with arrays are made of classes in `barchan/records.py`.
//! - Long calls release the GIL, and look for Ctrl-C every [`SLICE`](machine::SLICE).
//! - Errors of Rust become exceptions of `barchan/errors.py`, with the same words.

mod arrays;
mod change;
mod environment;
mod errors;
mod given;
mod gradient;
mod machine;
mod material;
mod picture;
mod records;
mod scene;
mod simulation;
mod state;

use barchan::Registry;
use barchan::parameter::{Parameter, Value as Given};
use errors::{OrRaise, exception};
use pyo3::prelude::*;
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use std::sync::{LazyLock, Mutex};

/// Everything registered in this process; plugins are added to it.
static REGISTRY: LazyLock<Mutex<Registry>> = LazyLock::new(|| Mutex::new(barchan::registry()));

/// A copy of the registry as it is now.
fn known(py: Python<'_>) -> PyResult<Registry> {
    let registry =
        REGISTRY.lock().map_err(|_| exception(py, "BarchanError", "loading a plugin has failed half way"))?;
    Ok(registry.clone())
}

/// Loads a library of materials, and returns their names: scenes may use them from now on.
///
/// Loading is running its code: only load what you trust. The library stays loaded until the process ends.
///
/// Raises `PluginError` saying what is wrong with the library, or if a name is taken.
#[pyfunction]
fn load_plugin(py: Python<'_>, path: PathBuf) -> PyResult<Vec<String>> {
    let registry = REGISTRY.lock();
    let mut registry = registry.map_err(|_| exception(py, "BarchanError", "loading a plugin has failed half way"))?;
    registry.load(&path).or_raise(py)
}

/// What scenes may name: a dict for each of "materials", "couplings", "backends" and "tasks", from name to "doc" and "parameters". A parameter says its "unit", "doc",
/// "kind" and, unless it is required, its "default".
#[pyfunction]
fn registry(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
    let registry = known(py)?;
    let parameters = |all: &[Parameter]| -> Value {
        let one = |p: &Parameter| {
            let mut said = json!({ "unit": p.unit, "doc": p.doc, "kind": p.kind.name() });
            if let Some(default) = p.default.as_ref().and_then(plain) {
                said["default"] = default;
            }
            (p.name.clone(), said)
        };
        Value::Object(all.iter().map(one).collect())
    };
    let entry = |doc: &str, all: &[Parameter]| json!({ "doc": doc, "parameters": parameters(all) });
    let materials: Map<String, Value> =
        registry.materials().map(|m| (m.name.clone(), entry(&m.doc, &m.parameters))).collect();
    let couplings: Map<String, Value> =
        registry.couplings().map(|(name, kind)| (name.to_owned(), entry(&kind.doc, &kind.parameters))).collect();
    let backends: Map<String, Value> =
        registry.backends().map(|one| (one.name().to_owned(), entry(one.doc(), &one.parameters()))).collect();
    let tasks: Map<String, Value> =
        registry.tasks().map(|(name, kind)| (name.to_owned(), entry(&kind.doc, &kind.parameters))).collect();
    let all = json!({ "materials": materials, "couplings": couplings, "backends": backends, "tasks": tasks });
    records::json(py, &all)
}

/// A parameter's value, if it is one that JSON has.
fn plain(value: &Given) -> Option<Value> {
    match value {
        Given::Number(number) => Some(json!(number)),
        Given::Switch(switch) => Some(json!(switch)),
        Given::Text(text) => Some(json!(text)),
        Given::Path { given, .. } => Some(json!(given)),
        Given::Array(items) => items.iter().map(plain).collect(),
        Given::Table(_) => None,
    }
}

/// Names of the built-in scenes.
#[pyfunction]
fn scenes() -> Vec<&'static str> {
    barchan::tasks::names().collect()
}

/// Names of the adapters that a backend can run on, best first; their place in the list is their number. Empty for the processor.
///
/// Raises `UnknownNameError` if there is no such backend.
#[pyfunction]
#[pyo3(signature = (backend="wgpu"))]
fn adapters(py: Python<'_>, backend: &str) -> PyResult<Vec<String>> {
    let registry = known(py)?;
    let backend = registry.backend(backend).or_raise(py)?;
    let adapters = py.detach(|| backend.adapters());
    Ok(adapters.into_iter().flatten().map(|adapter| adapter.name).collect())
}

/// What the package `barchan` is made of.
#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<simulation::Simulation>()?;
    module.add_class::<state::State>()?;
    module.add_class::<gradient::Tape>()?;
    module.add_class::<gradient::Gradient>()?;
    module.add_class::<environment::Environment>()?;
    module.add_class::<picture::View>()?;
    module.add_function(wrap_pyfunction!(load_plugin, module)?)?;
    module.add_function(wrap_pyfunction!(material::add_material, module)?)?;
    module.add_function(wrap_pyfunction!(registry, module)?)?;
    module.add_function(wrap_pyfunction!(scenes, module)?)?;
    module.add_function(wrap_pyfunction!(environment::task, module)?)?;
    module.add_function(wrap_pyfunction!(adapters, module)?)?;
    module.add_function(wrap_pyfunction!(picture::write_png, module)?)?;
    module.add_function(wrap_pyfunction!(picture::write_gif, module)?)?;
    Ok(())
}
