//! NumPy archives: a zip file of arrays, stored as they are.

use super::{Field, Header, Values};
use std::io::{self, Seek, Write};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// An archive that is being written.
pub(crate) struct Npz<W: Write + Seek>(ZipWriter<W>);

impl<W: Write + Seek> Npz<W> {
    pub(crate) fn new(out: W) -> Self {
        Self(ZipWriter::new(out))
    }

    /// Adds an array of a NumPy kind such as `<f8`, in C order.
    pub(crate) fn array(&mut self, name: &str, kind: &str, shape: &[usize], data: &[u8]) -> io::Result<()> {
        // Sizes are 64-bit (zip64): arrays may be larger than 4 GiB.
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored).large_file(true);
        self.0.start_file(format!("{name}.npy"), options)?;
        self.0.write_all(&header(kind, shape))?;
        self.0.write_all(data)
    }

    /// Adds an array of f64.
    pub(crate) fn reals(&mut self, name: &str, shape: &[usize], values: &[f64]) -> io::Result<()> {
        let data: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.array(name, "<f8", shape, &data)
    }

    pub(crate) fn finish(self) -> io::Result<()> {
        self.0.finish()?.flush()
    }
}

/// What an array begins with in NumPy's format 1.0.
fn header(kind: &str, shape: &[usize]) -> Vec<u8> {
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let mut text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({}), }}", shape.trim_end());
    // Data starts at a multiple of 64 bytes; magic, version and length take 10.
    while (10 + text.len() + 1) % 64 != 0 {
        text.push(' ');
    }
    text.push('\n');
    let mut out = b"\x93NUMPY\x01\0".to_vec();
    out.extend_from_slice(&(text.len() as u16).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
    out
}

/// Writes an array for each field, the time, and what is said about them as JSON.
pub(super) fn write(
    out: impl Write + Seek,
    about: &Header<'_>,
    fields: &[Field],
    count: usize,
    values: &mut dyn FnMut(&Field) -> io::Result<Values>,
) -> io::Result<()> {
    let mut archive = Npz::new(out);
    let text = serde_json::to_vec(about)?;
    archive.array("header", "|u1", &[text.len()], &text)?;
    archive.reals("time", &[], &[about.time])?;
    for field in fields {
        let values = values(field)?;
        let shape = if field.components.is_empty() { vec![count] } else { vec![count, field.components.len()] };
        archive.array(&field.name, values.kind().numpy, &shape, &values.bytes())?;
    }
    archive.finish()
}
