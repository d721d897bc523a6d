//! Materials written in Python, to try laws: their `update` is called through the interface that libraries have.
#![expect(unsafe_code, reason = "the interface of materials is C's")]

use crate::errors::{OrRaise, exception};
use crate::{REGISTRY, records};
use barchan_abi as abi;
use numpy::{Element, PyArray1, PyArray2, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple, PyType};
use std::slice::from_raw_parts;
use std::sync::{Mutex, OnceLock};

/// How many there may be: a callback of the interface knows no object, so there is one for each.
const MOST: usize = 16;

/// The laws, by the number of their callback.
static LAWS: [OnceLock<Law>; MOST] = [const { OnceLock::new() }; MOST];

/// A law of Python.
struct Law {
    object: Py<PyAny>,
    parameters: Vec<String>,
    strains: usize,
    states: usize,
}

/// What the interface hands to a callback, in f32 or f64.
struct Planes<T> {
    count: usize,
    stride: usize,
    dt: f64,
    params: *const T,
    strain_trial: *const T,
    state_in: *const T,
    strain: *mut T,
    kirchhoff: *mut T,
    state_out: *mut T,
}

/// The callbacks of law `SLOT`.
macro_rules! callback {
    ($name:ident, $batch:ty) => {
        unsafe extern "C" fn $name<const SLOT: usize>(
            batch: *const $batch,
            error: *mut abi::BarchanError,
        ) -> abi::BarchanStatus {
            // SAFETY: the host hands a batch and an error that live until the callback returns, by the ABI.
            let (batch, error) = unsafe { (&*batch, error.as_mut()) };
            let planes = Planes {
                count: batch.n,
                stride: batch.stride,
                dt: batch.dt.into(),
                params: batch.params,
                strain_trial: batch.strain_trial,
                state_in: batch.state_in,
                strain: batch.strain,
                kirchhoff: batch.kirchhoff,
                state_out: batch.state_out,
            };
            // SAFETY: they are the host's, of the lengths that the ABI says.
            unsafe { update(SLOT, &planes, error) }
        }
    };
}

callback!(update_f32, abi::BarchanBatchF32);
callback!(update_f64, abi::BarchanBatchF64);

/// The callbacks of each number.
macro_rules! callbacks {
    ($($slot:literal)*) => { [$((Some(update_f32::<$slot>), Some(update_f64::<$slot>), Some(moduli::<$slot>))),*] };
}

const CALLBACKS: [(abi::BarchanUpdateF32, abi::BarchanUpdateF64, abi::BarchanModuliF32); MOST] =
    callbacks!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15);

/// Lets a law update a batch. Inputs are copied to arrays of NumPy, and what the law has made of the outputs is copied back.
///
/// # Safety
/// The planes are as the ABI describes them for this law.
unsafe fn update<T: Element + Copy + Into<f64>>(
    slot: usize,
    planes: &Planes<T>,
    error: Option<&mut abi::BarchanError>,
) -> abi::BarchanStatus {
    let Some(law) = LAWS[slot].get() else { return abi::BARCHAN_E_OTHER };
    let done = Python::attach(|py| {
        // SAFETY: the caller's promise.
        let batch = unsafe { batch(py, law, planes) }?;
        law.object.bind(py).call_method1("update", (&batch,))?;
        // SAFETY: there are so many planes of so many numbers, by the caller's promise.
        unsafe {
            write(&batch.getattr("strain")?, "batch.strain", planes.strain, law.strains, planes)?;
            write(&batch.getattr("kirchhoff")?, "batch.kirchhoff", planes.kirchhoff, 6, planes)?;
            if law.states > 0 {
                write(&batch.getattr("state_out")?, "batch.state_out", planes.state_out, law.states, planes)?;
            }
        }
        Ok(())
    });
    status(done, error)
}

/// Asks a law for its tangent moduli.
///
/// # Safety
/// As the ABI describes the callback.
unsafe extern "C" fn moduli<const SLOT: usize>(
    given: *const abi::BarchanBatchF32,
    moduli: *mut f32,
    error: *mut abi::BarchanError,
) -> abi::BarchanStatus {
    // SAFETY: the host hands a batch and an error that live until the callback returns, by the ABI.
    let (given, error) = unsafe { (&*given, error.as_mut()) };
    let planes = Planes {
        count: given.n,
        stride: given.stride,
        dt: given.dt.into(),
        params: given.params,
        strain_trial: given.strain_trial,
        state_in: given.state_in,
        strain: given.strain,
        kirchhoff: given.kirchhoff,
        state_out: given.state_out,
    };
    let Some(law) = LAWS[SLOT].get() else { return abi::BARCHAN_E_OTHER };
    let done = Python::attach(|py| {
        // SAFETY: inputs are as for an update, and there are two planes for what is asked, by the ABI.
        unsafe {
            let batch = batch(py, law, &planes)?;
            let given = law.object.bind(py).call_method1("tangent_moduli", (batch,))?;
            write(&given, "what tangent_moduli returns", moduli, 2, &planes)
        }
    });
    status(done, error)
}

/// What a law gets of a batch: copies.
///
/// # Safety
/// The planes are as the ABI describes them for this law.
unsafe fn batch<'py, T: Element + Copy + Into<f64>>(
    py: Python<'py>,
    law: &Law,
    planes: &Planes<T>,
) -> PyResult<Bound<'py, PyAny>> {
    let read = |from: *const T, rows: usize| {
        let mut all: Vec<T> = Vec::with_capacity(rows * planes.count);
        for row in 0..rows {
            // SAFETY: there are so many planes of so many numbers, by the caller's promise.
            all.extend_from_slice(unsafe { from_raw_parts(from.add(row * planes.stride), planes.count) });
        }
        PyArray1::from_vec(py, all).reshape([rows, planes.count])
    };
    let parameters = PyDict::new(py);
    for (i, name) in law.parameters.iter().enumerate() {
        // SAFETY: there is a number for each parameter.
        let value: f64 = unsafe { *planes.params.add(i) }.into();
        parameters.set_item(name, value)?;
    }
    let fields = [
        ("dt", planes.dt.into_pyobject(py)?.into_any()),
        ("parameters", parameters.into_any()),
        ("strain_trial", read(planes.strain_trial, law.strains)?.into_any()),
        ("state_in", read(planes.state_in, law.states)?.into_any()),
    ];
    records::record(py, "Batch", &fields)
}

/// Copies what a law has made to planes.
///
/// # Safety
/// There are `rows` planes from `to` on, as long as those of the batch.
unsafe fn write<T: Element + Copy>(
    made: &Bound<'_, PyAny>,
    name: &str,
    to: *mut T,
    rows: usize,
    planes: &Planes<T>,
) -> PyResult<()> {
    let py = made.py();
    let array = py.import("numpy")?.getattr("asarray")?.call1((made, numpy::dtype::<T>(py)))?;
    let array = array.cast_into::<PyArray2<T>>().ok().filter(|array| array.shape() == [rows, planes.count]);
    let array = array
        .ok_or_else(|| PyValueError::new_err(format!("{name} has another shape than ({rows}, {})", planes.count)))?;
    for (row, values) in array.readonly().as_array().rows().into_iter().enumerate() {
        for (i, value) in values.iter().enumerate() {
            // SAFETY: there are so many planes of so many numbers, by the caller's promise.
            unsafe { *to.add(row * planes.stride + i) = *value };
        }
    }
    Ok(())
}

/// What a law raised last, until somebody is told: the interface has no room for more than its words.
static RAISED: Mutex<Option<PyErr>> = Mutex::new(None);

/// What a law raised, once.
pub(crate) fn take_raised() -> Option<PyErr> {
    RAISED.lock().ok()?.take()
}

/// What a callback returns, with the words of an exception.
fn status(done: PyResult<()>, error: Option<&mut abi::BarchanError>) -> abi::BarchanStatus {
    let Err(raised) = done else { return abi::BARCHAN_OK };
    if let Some(error) = error {
        let text = raised.to_string();
        let mut len = text.len().min(error.capacity);
        while !text.is_char_boundary(len) {
            len -= 1;
        }
        // SAFETY: the buffer has `capacity` bytes, by the ABI.
        unsafe { std::ptr::copy_nonoverlapping(text.as_ptr(), error.message, len) };
        error.len = len;
    }
    if let Ok(mut last) = RAISED.lock() {
        *last = Some(raised);
    }
    abi::BARCHAN_E_OTHER
}

/// Text of a table: kept until the process ends, as that of libraries is.
fn text(text: String) -> abi::BarchanStr {
    abi::BarchanStr::new(Box::leak(text.into_boxed_str()))
}

/// Registers a material written in Python, and returns its name: scenes may use it from now on, on the processor.
///
/// It is an object with
///
/// - `name`: in snake_case,
/// - `parameters`: a dict from name to default, or to (default, unit),
/// - `states`, if it has any: a dict from the name of each history variable to its value at the start,
/// - `strain`: "left_cauchy_green", 6 rows xx yy zz xy xz yz of an isotropic law, which is the default, or "def_grad", 9 rows of F,
/// - `update(batch)`: sets `batch.kirchhoff`, and `batch.strain` and `batch.state_out` if they change; see `barchan.records.Batch`,
/// - `tangent_moduli(batch)`, if it has it: an array of two rows [Pa], lambda + 2 mu and 3 lambda + 2 mu of the present tangent. Without it nothing checks
///   that `time.step` is stable, and tools do not know how stiff the ground is that they press.
///
/// To try laws with: every batch goes through Python, one after the other, which is tens of times slower than a law of a library (`load_plugin`).
///
/// Raises `PluginError` if the name is taken or not in snake_case, or there are 16 of them already.
#[pyfunction]
pub(crate) fn add_material(py: Python<'_>, law: Bound<'_, PyAny>) -> PyResult<String> {
    if law.is_instance_of::<PyType>() {
        let class = law.getattr("__name__")?;
        return Err(PyTypeError::new_err(format!("add_material: {class} is a class; give an object of it, {class}()")));
    }
    let name: String = law.getattr("name")?.extract()?;
    let dict = |name: &str| -> PyResult<Bound<'_, PyDict>> {
        match law.getattr_opt(name)? {
            Some(dict) => dict.cast_into().map_err(|_| PyTypeError::new_err(format!("{name}: give a dict"))),
            None => Ok(PyDict::new(py)),
        }
    };
    if !law.getattr("update")?.is_callable() {
        return Err(PyTypeError::new_err("update: it is no method"));
    }
    let strain_kind = match law.getattr_opt("strain")?.map(|kind| kind.extract::<String>()).transpose()?.as_deref() {
        None | Some("left_cauchy_green") => abi::BARCHAN_STRAIN_LEFT_CAUCHY_GREEN,
        Some("def_grad") => abi::BARCHAN_STRAIN_DEF_GRAD,
        Some(other) => {
            let what = format!("strain: '{other}' is neither \"left_cauchy_green\" nor \"def_grad\"");
            return Err(PyValueError::new_err(what));
        }
    };
    let (mut parameters, mut names) = (Vec::new(), Vec::new());
    for (key, value) in dict("parameters")?.iter() {
        let (default, unit) = match value.cast::<PyTuple>() {
            Ok(pair) => pair.extract::<(f64, String)>()?,
            Err(_) => (value.extract()?, "1".to_owned()),
        };
        names.push(key.extract::<String>()?);
        parameters.push(abi::BarchanParam {
            name: text(key.extract()?),
            unit: text(unit),
            doc: text(format!("Parameter of a material written in Python: {}.", key.extract::<String>()?)),
            default_value: default,
            min_value: f64::MIN,
            max_value: f64::MAX,
            flags: 0,
        });
    }
    let mut states = Vec::new();
    for (key, value) in dict("states")?.iter() {
        states.push(abi::BarchanStateVar {
            name: text(key.extract()?),
            unit: text("1".to_owned()),
            doc: text(format!("History of a material written in Python: {}.", key.extract::<String>()?)),
            initial_value: value.extract()?,
            merge: abi::BARCHAN_MERGE_MEAN,
            reserved: 0,
        });
    }
    let doc = law.getattr("__doc__")?.extract::<Option<String>>()?.unwrap_or_default();
    let mut registry =
        REGISTRY.lock().map_err(|_| exception(py, "BarchanError", "loading a plugin has failed half way"))?;
    let Some(slot) = (0..MOST).find(|slot| LAWS[*slot].get().is_none()) else {
        let what = format!("material '{name}': there are {MOST} materials written in Python, and no more can be");
        return Err(exception(py, "PluginError", &what));
    };
    let (update_f32, update_f64, moduli) = CALLBACKS[slot];
    let has_moduli = law.hasattr("tangent_moduli")?;
    // SAFETY: zeros are absent callbacks, null pointers and empty strings.
    let table = abi::BarchanMaterial {
        struct_size: size_of::<abi::BarchanMaterial>(),
        abi_major: abi::BARCHAN_ABI_MAJOR,
        abi_minor: abi::BARCHAN_ABI_MINOR,
        strain_kind,
        name: text(name.clone()),
        version: text("0".to_owned()),
        doc: text(if doc.trim().is_empty() { "A material written in Python.".to_owned() } else { doc }),
        n_params: parameters.len(),
        params: parameters.leak().as_ptr(),
        param_size: size_of::<abi::BarchanParam>(),
        n_state: states.len(),
        states: states.leak().as_ptr(),
        state_size: size_of::<abi::BarchanStateVar>(),
        update_f32,
        update_f64,
        tangent_moduli_f32: moduli.filter(|_| has_moduli),
        capabilities: if has_moduli { abi::BARCHAN_CAP_HARDENS } else { 0 },
        ..unsafe { std::mem::zeroed() }
    };
    let law = Law {
        object: law.unbind(),
        parameters: names,
        strains: if strain_kind == abi::BARCHAN_STRAIN_DEF_GRAD { 9 } else { 6 },
        states: table.n_state,
    };
    registry.add_material(Box::leak(Box::new(table)), "Python").or_raise(py)?;
    LAWS[slot].set(law).map_err(|_| exception(py, "BarchanError", "a material was registered twice"))?;
    Ok(name)
}
