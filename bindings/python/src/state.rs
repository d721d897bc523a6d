//! States of worlds.

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;

/// Everything that a world goes on from, bit for bit: a copy in memory.
///
/// `Simulation.state` takes it and `Simulation.restore` goes back to it. It takes about 300 bytes a particle.
#[pyclass(module = "barchan", frozen)]
pub(crate) struct State {
    pub(crate) state: barchan::State,
}

#[pymethods]
impl State {
    /// Simulated time [s].
    #[getter]
    fn time(&self) -> f64 {
        self.state.time()
    }
    /// Steps taken.
    #[getter]
    fn step_count(&self) -> u64 {
        self.state.step_count()
    }
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }
    /// Nothing changes a state: a copy is the state itself.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<'_, PyAny>) -> Py<Self> {
        slf
    }
    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err(
            "a State cannot be pickled; restore() it and save() that simulation, and load() the file in the process that needs it",
        ))
    }
    fn __repr__(&self) -> String {
        let state = &self.state;
        format!("<barchan.State of '{}' at t = {:.6} s, step {}>", state.scene().name, state.time(), state.step_count())
    }
}
