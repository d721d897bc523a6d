//! Parquet files of numbers.

use parquet::basic::{Repetition, Type as Kind};
use parquet::data_type::DoubleType;
use parquet::errors::{ParquetError, Result};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};
use std::io::{self, Write};
use std::sync::Arc;

/// Writes columns of equal length, one for each name, with null for NaN.
pub(crate) fn write_columns<W: Write + Send>(out: W, names: &[String], columns: &[Vec<f64>]) -> io::Result<()> {
    written(out, names, columns).map_err(|error| match error {
        ParquetError::External(error) => match error.downcast::<io::Error>() {
            Ok(error) => *error,
            Err(error) => io::Error::other(error),
        },
        error => io::Error::other(error),
    })
}

fn written<W: Write + Send>(out: W, names: &[String], columns: &[Vec<f64>]) -> Result<()> {
    let field = |name: &String| -> Result<TypePtr> {
        let real = Type::primitive_type_builder(name, Kind::DOUBLE).with_repetition(Repetition::OPTIONAL);
        Ok(Arc::new(real.build()?))
    };
    let fields = names.iter().map(field).collect::<Result<_>>()?;
    let table = Type::group_type_builder("trace").with_fields(fields).build()?;
    let mut file = SerializedFileWriter::new(out, Arc::new(table), Arc::default())?;
    let mut group = file.next_row_group()?;
    for column in columns {
        let Some(mut writer) = group.next_column()? else { break };
        let is_known: Vec<i16> = column.iter().map(|x| i16::from(!x.is_nan())).collect();
        let known: Vec<f64> = column.iter().copied().filter(|x| !x.is_nan()).collect();
        writer.typed::<DoubleType>().write_batch(&known, Some(&is_known), None)?;
        writer.close()?;
    }
    group.close()?;
    file.close()?;
    Ok(())
}
