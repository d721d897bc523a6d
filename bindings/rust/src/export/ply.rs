//! Stanford polygon files, binary.

use super::{Field, Header, Quantity, Values};
use std::io::{self, Write};

/// Writes a vertex for each particle. Comments hold the time and the units.
pub(super) fn write(
    out: &mut impl Write,
    about: &Header<'_>,
    fields: &[Field],
    count: usize,
    values: &mut dyn FnMut(&Field) -> io::Result<Values>,
) -> io::Result<()> {
    let all = fields.iter().map(values).collect::<io::Result<Vec<_>>>()?;
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment {}\ncomment time {} s", about.scene, about.time)?;
    for field in fields.iter().filter(|field| field.unit != "1") {
        writeln!(out, "comment unit of {}: {}", field.name, field.unit)?;
    }
    writeln!(out, "element vertex {count}")?;
    for (field, values) in fields.iter().zip(&all) {
        for name in properties(field) {
            writeln!(out, "property {} {name}", values.kind().ply)?;
        }
    }
    writeln!(out, "end_header")?;
    for i in 0..count {
        for (field, values) in fields.iter().zip(&all) {
            let n = field.components.len().max(1);
            let own = n * i..n * (i + 1);
            match values {
                Values::F64(values) => values[own].iter().try_for_each(|x| out.write_all(&x.to_le_bytes()))?,
                Values::F32(values) => values[own].iter().try_for_each(|x| out.write_all(&x.to_le_bytes()))?,
                Values::U64(values) => {
                    values[own].iter().try_for_each(|x| out.write_all(&(*x as u32).to_le_bytes()))?
                }
                Values::U16(values) => {
                    values[own].iter().try_for_each(|x| out.write_all(&u32::from(*x).to_le_bytes()))?
                }
            }
        }
    }
    Ok(())
}

/// Names as viewers of PLY files know them.
fn properties(field: &Field) -> Vec<String> {
    let named = |component: &&str| match field.quantity {
        Quantity::Position => (*component).to_owned(),
        Quantity::Velocity => format!("v{component}"),
        _ => format!("{}_{component}", field.name),
    };
    if field.components.is_empty() { vec![field.name.clone()] } else { field.components.iter().map(named).collect() }
}
