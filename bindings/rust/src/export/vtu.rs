//! VTK's unstructured grids, with one vertex cell a particle and raw data appended.

use super::{Field, Header, Quantity, Values};
use std::io::{self, Write};

/// An array of a file.
struct Array {
    group: &'static str,
    /// Attributes of its element, and what stands in it.
    attributes: String,
    inner: String,
    data: Vec<u8>,
}

/// Writes the header, then all arrays.
pub(super) fn write(
    out: &mut impl Write,
    about: &Header<'_>,
    fields: &[Field],
    count: usize,
    values: &mut dyn FnMut(&Field) -> io::Result<Values>,
) -> io::Result<()> {
    let n = count as u64;
    let mut arrays = Vec::new();
    for field in fields {
        let own = values(field)?;
        let labels = field.components.iter().enumerate().map(|(i, label)| format!(" ComponentName{i}=\"{label}\""));
        let (kind, components) = (own.kind().vtk, field.components.len().max(1));
        let unit = format!(
            "<InformationKey name=\"UNITS_LABEL\" location=\"vtkDataArray\">{}</InformationKey>",
            xml(&field.unit)
        );
        arrays.push(Array {
            group: if field.quantity == Quantity::Position { "Points" } else { "PointData" },
            attributes: format!(
                "type=\"{kind}\" Name=\"{}\" NumberOfComponents=\"{components}\"{}",
                xml(&field.name),
                labels.collect::<String>()
            ),
            inner: if field.unit == "1" { String::new() } else { unit },
            data: own.bytes(),
        });
    }
    let cells = [
        ("connectivity", "Int64", (0..n).flat_map(u64::to_le_bytes).collect::<Vec<_>>()),
        ("offsets", "Int64", (1..=n).flat_map(u64::to_le_bytes).collect()),
        // VTK's number for a vertex.
        ("types", "UInt8", vec![1; count]),
    ];
    arrays.extend(cells.map(|(name, kind, data)| Array {
        group: "Cells",
        attributes: format!("type=\"{kind}\" Name=\"{name}\""),
        inner: String::new(),
        data,
    }));
    write!(
        out,
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n\
         <UnstructuredGrid>\n<FieldData>\n<DataArray type=\"Float64\" Name=\"TimeValue\" NumberOfTuples=\"1\" format=\"ascii\">{}</DataArray>\n\
         </FieldData>\n<Piece NumberOfPoints=\"{n}\" NumberOfCells=\"{n}\">\n",
        about.time
    )?;
    let mut offset = 0;
    for group in ["Points", "PointData", "Cells"] {
        writeln!(out, "<{group}>")?;
        for Array { attributes, inner, data, .. } in arrays.iter().filter(|array| array.group == group) {
            writeln!(out, "<DataArray {attributes} format=\"appended\" offset=\"{offset}\">{inner}</DataArray>")?;
            offset += 8 + data.len();
        }
        writeln!(out, "</{group}>")?;
    }
    write!(out, "</Piece></UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_")?;
    // The fields stand in the order of their groups: the position is the first.
    for Array { data, .. } in &arrays {
        out.write_all(&(data.len() as u64).to_le_bytes())?;
        out.write_all(data)?;
    }
    out.write_all(b"\n</AppendedData>\n</VTKFile>\n")
}

/// Text as an attribute or in an element.
fn xml(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}
