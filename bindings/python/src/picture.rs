//! Pictures as arrays.

use crate::errors::{OrRaise, exception};
use crate::given::number;
use crate::simulation::Simulation;
use barchan::picture::{Image, Rect, View as Drawn};
use numpy::{PyArray1, PyArray3, PyArrayMethods, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::PathBuf;

/// A fixed view of a scene: the same extent, colours of heights and layout in every picture, so that pictures can be compared and animated.
///
/// What it shows is the scene's to say: `output.picture.view` is "top" or "perspective", `output.picture.pixels` its width.
#[pyclass(module = "barchan.view")]
pub(crate) struct View {
    drawn: Drawn,
}

#[pymethods]
impl View {
    /// A view that holds all particles of a world as they are now.
    #[new]
    #[pyo3(signature = (simulation, *, world=0))]
    fn new(py: Python<'_>, simulation: &Simulation, #[pyo3(from_py_with = number)] world: usize) -> PyResult<Self> {
        Ok(Self { drawn: simulation.look(py, world, Drawn::new)? })
    }

    /// Draws a world as it is now: an array of shape (rows, columns, 3), uint8, RGB.
    ///
    /// `part` is "page", the whole picture with title, scales and a vertical cut, or "ground", the ground and what is on it alone.
    ///
    /// Raises `SimulationError` or `PluginError` if a material fails to give the stress that colours the cut.
    #[pyo3(signature = (simulation, *, part="page", world=0))]
    fn draw<'py>(
        &mut self,
        py: Python<'py>,
        simulation: &Simulation,
        part: &str,
        #[pyo3(from_py_with = number)] world: usize,
    ) -> PyResult<Bound<'py, PyArray3<u8>>> {
        check_part(part)?;
        let drawn = &mut self.drawn;
        let page = simulation.look(py, world, |one| drawn.draw(one))?.or_raise(py)?;
        array(py, page, self.drawn.relief_rect(), part)
    }

    fn __repr__(&self) -> String {
        let rect = self.drawn.relief_rect();
        format!("<barchan.view.View of {} x {} pixels>", rect.width, rect.height)
    }
}

/// Is there such a part of a picture?
pub(crate) fn check_part(part: &str) -> PyResult<()> {
    if ["page", "ground"].contains(&part) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("part: '{part}' is none of a picture; it is \"page\" or \"ground\"")))
}

/// A part of a picture as an array.
pub(crate) fn array<'py>(py: Python<'py>, page: Image, ground: Rect, part: &str) -> PyResult<Bound<'py, PyArray3<u8>>> {
    let image = if part == "page" { page } else { page.crop(ground) };
    let (rows, columns) = (image.height(), image.width());
    PyArray1::from_vec(py, image.pixels().as_flattened().to_vec()).reshape([rows, columns, 3])
}

/// The picture that an array holds.
fn image(pixels: &PyReadonlyArray3<'_, u8>) -> PyResult<Image> {
    let &[rows, columns, 3] = pixels.shape() else {
        let shape = pixels.shape();
        return Err(PyValueError::new_err(format!("a picture has the shape (rows, columns, 3), not {shape:?}")));
    };
    let mut image = Image::new(columns, rows, [0; 3]);
    let values = pixels.as_array();
    image.pixels_mut().as_flattened_mut().iter_mut().zip(values.iter()).for_each(|(to, from)| *to = *from);
    Ok(image)
}

fn unwritten(py: Python<'_>, file: &std::path::Path, error: &std::io::Error) -> PyErr {
    exception(py, "FileError", &format!("{}: writing a picture: {error}", file.display()))
}

/// Writes a picture, uint8 of shape (rows, columns, 3), as a PNG file.
#[pyfunction]
pub(crate) fn write_png(py: Python<'_>, path: PathBuf, picture: PyReadonlyArray3<'_, u8>) -> PyResult<()> {
    image(&picture)?.write_png(&path, &[]).map_err(|error| unwritten(py, &path, &error))
}

/// Writes pictures of one size as an endless GIF animation, each shown for `seconds`. If the file got larger than `most_bytes`, every second picture is
/// left out, again and again.
#[pyfunction]
#[pyo3(signature = (path, pictures, *, seconds=0.04, most_bytes=8_000_000))]
pub(crate) fn write_gif(
    py: Python<'_>,
    path: PathBuf,
    pictures: Vec<PyReadonlyArray3<'_, u8>>,
    seconds: f64,
    most_bytes: usize,
) -> PyResult<()> {
    if !(0.0..=655.0).contains(&seconds) {
        let what = format!("seconds: {seconds}; give how long a picture is shown, up to 655 s");
        return Err(PyValueError::new_err(what));
    }
    let images: Vec<Image> = pictures.iter().map(image).collect::<PyResult<_>>()?;
    let written = py.detach(|| {
        let load = |i: usize| Ok(images[i].clone());
        std::fs::write(&path, barchan::picture::gif(images.len(), load, seconds, most_bytes)?)
    });
    written.map_err(|error| unwritten(py, &path, &error))
}
