//! Particle files that other programs read.

use crate::file::write_whole;
use crate::scene::Export;
use crate::{ParticleState, Plan, Result, Vec3};
use std::io::{self, Write};
use std::path::Path;

/// One particle as it is exported.
struct Row {
    position: Vec3,
    velocity: Vec3,
    id: u64,
    body: u16,
}

/// Writes all particles to a file: position x, y, z [m] in f64, velocity vx, vy, vz [m/s] in f32, id and body.
///
/// Files are complete or absent: they are written under a temporary name, then renamed. PLY has no 64-bit integers, so
/// ids are 32-bit there.
///
/// # Errors
/// [`crate::Error::Io`] if it cannot be written.
pub fn export(state: &ParticleState, plan: &Plan, path: impl AsRef<Path>, format: Export) -> Result<()> {
    let rows: Vec<Row> = state
        .lists
        .iter()
        .flat_map(|list| {
            (0..list.len()).map(|i| Row {
                position: list.position(i),
                velocity: list.velocity[i],
                id: list.id[i],
                body: list.body[i],
            })
        })
        .collect();
    let title = plan.scene.name.replace(['\n', '\r'], " ");
    write_whole(path.as_ref(), "writing particles", |out| match format {
        Export::Ply => write_ply(out, &rows, &title),
        Export::Npz => write_npz(out, &rows),
        Export::Vtk => write_vtu(out, &rows),
    })
}

fn positions(rows: &[Row]) -> Vec<u8> {
    rows.iter().flat_map(|r| r.position).flat_map(f64::to_le_bytes).collect()
}
fn velocities(rows: &[Row]) -> Vec<u8> {
    rows.iter().flat_map(|r| r.velocity).flat_map(|v| (v as f32).to_le_bytes()).collect()
}
fn ids(rows: &[Row]) -> Vec<u8> {
    rows.iter().flat_map(|r| r.id.to_le_bytes()).collect()
}
fn bodies(rows: &[Row]) -> Vec<u8> {
    rows.iter().flat_map(|r| r.body.to_le_bytes()).collect()
}

fn write_ply(out: &mut impl Write, rows: &[Row], title: &str) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment {title}\nelement vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         property float vx\nproperty float vy\nproperty float vz\n\
         property uint id\nproperty ushort body\nend_header\n",
        rows.len()
    )?;
    for row in rows {
        for x in row.position {
            out.write_all(&x.to_le_bytes())?;
        }
        for v in row.velocity {
            out.write_all(&(v as f32).to_le_bytes())?;
        }
        out.write_all(&(row.id as u32).to_le_bytes())?;
        out.write_all(&row.body.to_le_bytes())?;
    }
    Ok(())
}

/// A zip archive whose members are stored, not compressed; sizes are 32-bit as the format has them.
fn write_npz(out: &mut impl Write, rows: &[Row]) -> io::Result<()> {
    let n = rows.len();
    let members = [
        ("position.npy", npy("<f8", &format!("({n}, 3)"), positions(rows))),
        ("velocity.npy", npy("<f4", &format!("({n}, 3)"), velocities(rows))),
        ("id.npy", npy("<u8", &format!("({n},)"), ids(rows))),
        ("body.npy", npy("<u2", &format!("({n},)"), bodies(rows))),
    ];
    let mut directory = Vec::new();
    let mut at = 0_u64;
    let small = |size: u64| {
        u32::try_from(size).map_err(|_| io::Error::new(io::ErrorKind::FileTooLarge, "an npz file holds at most 4 GiB"))
    };
    for (name, data) in &members {
        // From "version needed" to "length of extra field": the same in both headers.
        let mut common = Vec::new();
        for half in [20_u16, 0, 0, 0, 0x21] {
            common.extend_from_slice(&half.to_le_bytes());
        }
        let size = small(data.len() as u64)?;
        for word in [crc32fast::hash(data), size, size] {
            common.extend_from_slice(&word.to_le_bytes());
        }
        common.extend_from_slice(&(name.len() as u16).to_le_bytes());
        common.extend_from_slice(&0_u16.to_le_bytes());

        directory.extend_from_slice(b"PK\x01\x02\x14\0");
        directory.extend_from_slice(&common);
        directory.extend_from_slice(&[0; 10]);
        directory.extend_from_slice(&small(at)?.to_le_bytes());
        directory.extend_from_slice(name.as_bytes());

        out.write_all(b"PK\x03\x04")?;
        out.write_all(&common)?;
        out.write_all(name.as_bytes())?;
        out.write_all(data)?;
        at += (4 + common.len() + name.len() + data.len()) as u64;
    }
    let count = members.len() as u16;
    out.write_all(&directory)?;
    out.write_all(b"PK\x05\x06\0\0\0\0")?;
    out.write_all(&count.to_le_bytes())?;
    out.write_all(&count.to_le_bytes())?;
    out.write_all(&(directory.len() as u32).to_le_bytes())?;
    out.write_all(&small(at)?.to_le_bytes())?;
    out.write_all(&0_u16.to_le_bytes())
}

/// One array in NumPy's format 1.0.
fn npy(kind: &str, shape: &str, data: Vec<u8>) -> Vec<u8> {
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    // Data starts at a multiple of 64 bytes; magic, version and length take 10.
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\0".to_vec();
    out.extend_from_slice(&(header.len() as u16).to_le_bytes());
    out.extend_from_slice(header.as_bytes());
    out.extend(data);
    out
}

/// VTK's unstructured grid with one vertex cell a particle, data appended raw.
fn write_vtu(out: &mut impl Write, rows: &[Row]) -> io::Result<()> {
    let n = rows.len() as u64;
    let arrays = [
        ("Points", "points", "Float64", 3, positions(rows)),
        ("PointData", "velocity", "Float32", 3, velocities(rows)),
        ("PointData", "id", "UInt64", 1, ids(rows)),
        ("PointData", "body", "UInt16", 1, bodies(rows)),
        ("Cells", "connectivity", "Int64", 1, (0..n).flat_map(u64::to_le_bytes).collect::<Vec<_>>()),
        ("Cells", "offsets", "Int64", 1, (1..=n).flat_map(u64::to_le_bytes).collect()),
        ("Cells", "types", "UInt8", 1, vec![1; rows.len()]),
    ];
    write!(
        out,
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n\
         <UnstructuredGrid><Piece NumberOfPoints=\"{n}\" NumberOfCells=\"{n}\">\n"
    )?;
    let mut offset = 0;
    for (i, (group, name, kind, components, data)) in arrays.iter().enumerate() {
        if i == 0 || arrays[i - 1].0 != *group {
            writeln!(out, "<{group}>")?;
        }
        writeln!(
            out,
            "<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\" format=\"appended\" offset=\"{offset}\"/>"
        )?;
        if arrays.get(i + 1).is_none_or(|next| next.0 != *group) {
            writeln!(out, "</{group}>")?;
        }
        offset += 8 + data.len();
    }
    write!(out, "</Piece></UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_")?;
    for (.., data) in &arrays {
        out.write_all(&(data.len() as u64).to_le_bytes())?;
        out.write_all(data)?;
    }
    out.write_all(b"\n</AppendedData>\n</VTKFile>\n")
}
