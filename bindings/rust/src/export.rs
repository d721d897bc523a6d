//! Files that other programs compute with: particles, the surface of the ground, and its height.
//!
//! [`Fields`] says which quantities a particle file holds; [`particles`] writes one. [`Surface`] is a triangle mesh around the ground,
//! [`height_map`] its height in columns. `docs/formats.md` describes the files and how to read them.
//!
//! ```
//! use barchan::export::{Column, Fields, HeightFile, Surface, Values, height_map, particles};
//! use barchan::scene::Export;
//! use barchan::{Options, Simulation};
//!
//! let simulation = Simulation::new(&barchan::registry(), &barchan::example(), &Options::default())?;
//! let folder = std::env::temp_dir().join(format!("barchan-export-{}", std::process::id()));
//! std::fs::create_dir_all(&folder).unwrap();
//! let fields = Fields::new(simulation.plan(), Some(&["velocity".to_owned(), "stress".to_owned()]))?;
//! let columns: Vec<Column> = fields.of(simulation.plan(), &simulation.ground())?;
//! assert_eq!(columns[2].components, 6, "position, velocity, and the six parts of stress");
//! assert!(matches!(columns[2].values, Values::F32(_)));
//! particles(&simulation, &fields, folder.join("particles.npz"), Export::Npz)?;
//! let surface = Surface::new(&simulation.spots(), 0.05)?;
//! surface.write_ply(folder.join("surface.ply"), &simulation)?;
//! let map: HeightFile = height_map(&simulation, 0.05);
//! map.write_npz(folder.join("height.npz"))?;
//! assert!(surface.volume() > 0.0);
//! # let _ = std::fs::remove_dir_all(folder);
//! # Ok::<(), barchan::Error>(())
//! ```

mod height;
pub(crate) mod npz;
#[cfg(feature = "parquet")]
pub(crate) mod parquet;
mod ply;
mod surface;
mod vtu;

pub use height::{HeightFile, height_map};
pub use surface::Surface;

use crate::stress::kirchhoff;
use barchan_core::file::write_whole;
use barchan_core::scene::{Export, fits, plain};
use barchan_core::{Error, ParticleList, ParticleState, Plan, Precision, Result, Simulation};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Components of vectors, of symmetric tensors, and of other tensors row by row.
const VECTOR: [&str; 3] = ["x", "y", "z"];
const SYMMETRIC: [&str; 6] = ["xx", "yy", "zz", "xy", "xz", "yz"];
const TENSOR: [&str; 9] = ["xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"];

/// Which quantity a field is.
#[derive(Clone, Debug, PartialEq)]
enum Quantity {
    Position,
    Velocity,
    Mass,
    Volume0,
    Density,
    Affine,
    Strain,
    DefGrad,
    Stress,
    /// A history variable of a law: its planes' number in each material, if it is of that law.
    History(Vec<Option<usize>>),
    Level,
    Material,
    Body,
    Id,
}

/// A quantity of particles, as it is named in files.
#[derive(Clone, Debug)]
struct Field {
    name: String,
    unit: String,
    components: &'static [&'static str],
    quantity: Quantity,
}

/// Numbers of particles, components side by side.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Positions, and all that is no whole number in runs of f64.
    F64(Vec<f64>),
    /// What is no whole number in runs of f32.
    F32(Vec<f32>),
    /// Numbers of particles.
    U64(Vec<u64>),
    /// Numbers of materials, bodies and levels.
    U16(Vec<u16>),
}

/// A field of some particles.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// What files call it.
    pub name: String,
    /// How many numbers a particle has.
    pub components: usize,
    /// All of them.
    pub values: Values,
}

/// How a kind of number is called in NumPy, PLY and VTK, and its bytes.
struct Kind {
    numpy: &'static str,
    ply: &'static str,
    vtk: &'static str,
}

impl Values {
    fn kind(&self) -> Kind {
        let [numpy, ply, vtk] = match self {
            Self::F64(_) => ["<f8", "double", "Float64"],
            Self::F32(_) => ["<f4", "float", "Float32"],
            // PLY has no 64-bit integers.
            Self::U64(_) => ["<u8", "uint", "UInt64"],
            // meshio knows PLY's short integers by another name only.
            Self::U16(_) => ["<u2", "uint", "UInt16"],
        };
        Kind { numpy, ply, vtk }
    }

    /// All of them, little-endian.
    fn bytes(&self) -> Vec<u8> {
        match self {
            Self::F64(values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Self::F32(values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Self::U64(values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            Self::U16(values) => values.iter().flat_map(|x| x.to_le_bytes()).collect(),
        }
    }
}

/// The fields of a scene's particle files.
#[derive(Clone, Debug)]
pub struct Fields(Vec<Field>);

impl Fields {
    /// Those whose names fit one of the patterns, in which * stands for any text, and the position; without patterns, all.
    ///
    /// # Errors
    /// [`Error::Body`] if a pattern fits no field.
    pub fn new(plan: &Plan, patterns: Option<&[String]>) -> Result<Self> {
        let mut fields = all(plan);
        let Some(patterns) = patterns else { return Ok(Self(fields)) };
        if let Some(pattern) = patterns.iter().find(|pattern| !fields.iter().any(|field| fits(pattern, &field.name))) {
            let names: Vec<&str> = fields.iter().map(|field| field.name.as_str()).collect();
            return Err(Error::Body {
                path: "output.export_fields".to_owned(),
                what: format!("no field of particles fits '{}'", plain(pattern)),
                mend: format!("take names, with * for any text, of: {}", names.join(", ")),
            });
        }
        fields.retain(|field| {
            field.quantity == Quantity::Position || patterns.iter().any(|pattern| fits(pattern, &field.name))
        });
        Ok(Self(fields))
    }

    /// What particles have of them, such as those of [`Simulation::ground`], in the order of the lists.
    ///
    /// # Errors
    /// [`Error::Missing`] if stress is wanted of a law without an f64 update.
    pub fn of(&self, plan: &Plan, particles: &ParticleState) -> Result<Vec<Column>> {
        let column = |field: &Field| {
            let components = field.components.len().max(1);
            Ok(Column { name: field.name.clone(), components, values: field.values(plan, particles)? })
        };
        self.0.iter().map(column).collect()
    }

    /// Their names, in the order in which files hold them.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|field| field.name.as_str())
    }
}

/// Every field that particles of a plan have.
fn all(plan: &Plan) -> Vec<Field> {
    let field = |name: &str, unit: &str, components: &'static [&'static str], quantity: Quantity| Field {
        name: name.to_owned(),
        unit: unit.to_owned(),
        components,
        quantity,
    };
    let mut fields = vec![
        field("position", "m", &VECTOR, Quantity::Position),
        field("velocity", "m/s", &VECTOR, Quantity::Velocity),
        field("mass", "kg", &[], Quantity::Mass),
        field("volume0", "m^3", &[], Quantity::Volume0),
        field("density", "kg/m^3", &[], Quantity::Density),
        field("affine", "1/s", &TENSOR, Quantity::Affine),
        field("strain", "1", &SYMMETRIC, Quantity::Strain),
    ];
    if plan.materials.iter().any(|material| material.material.strain_planes() == 9) {
        fields.push(field("def_grad", "1", &TENSOR, Quantity::DefGrad));
    }
    fields.push(field("stress", "Pa", &SYMMETRIC, Quantity::Stress));
    let mut history: BTreeMap<String, (String, Vec<Option<usize>>)> = BTreeMap::new();
    for (m, planned) in plan.materials.iter().enumerate() {
        for (s, state) in planned.material.states.iter().enumerate() {
            let name = format!("history_{}_{}", planned.material.name, state.name);
            let none = || (state.unit.clone(), vec![None; plan.materials.len()]);
            history.entry(name).or_insert_with(none).1[m] = Some(s);
        }
    }
    fields
        .extend(history.into_iter().map(|(name, (unit, planes))| field(&name, &unit, &[], Quantity::History(planes))));
    fields.extend([
        field("level", "1", &[], Quantity::Level),
        field("material", "1", &[], Quantity::Material),
        field("body", "1", &[], Quantity::Body),
        field("id", "1", &[], Quantity::Id),
    ]);
    fields
}

impl Field {
    /// Its values, list after list.
    fn values(&self, plan: &Plan, state: &ParticleState) -> Result<Values> {
        let lists = || state.lists.iter().filter(|list| !list.is_empty());
        let real = |of: &dyn Fn(&ParticleList, &mut Vec<f64>)| {
            let mut values = Vec::new();
            lists().for_each(|list| of(list, &mut values));
            values
        };
        let small = |of: &dyn Fn(&ParticleList, usize) -> u16| {
            Values::U16(lists().flat_map(|list| (0..list.len()).map(move |i| of(list, i))).collect())
        };
        let values = match &self.quantity {
            // The step of a f32 is a tenth of a cell at 10 km.
            Quantity::Position => {
                return Ok(Values::F64(real(&|list, out| {
                    (0..list.len()).for_each(|i| out.extend(list.position(i)));
                })));
            }
            Quantity::Level => return Ok(small(&|list, _| list.level as u16)),
            Quantity::Material => return Ok(small(&|list, _| list.material as u16)),
            Quantity::Body => return Ok(small(&|list, i| list.body[i])),
            Quantity::Id => return Ok(Values::U64(lists().flat_map(|list| &list.id).copied().collect())),
            Quantity::Velocity => real(&|list, out| out.extend(list.velocity.as_flattened())),
            Quantity::Affine => real(&|list, out| out.extend(list.affine.as_flattened())),
            Quantity::Mass => real(&|list, out| out.extend(&list.mass)),
            Quantity::Volume0 => real(&|list, out| out.extend(&list.volume0)),
            Quantity::Density => real(&|list, out| {
                out.extend((0..list.len()).map(|i| list.mass[i] / (list.volume0[i] * volume_ratio(list, i))));
            }),
            Quantity::Strain => real(&|list, out| (0..list.len()).for_each(|i| out.extend(left_cauchy_green(list, i)))),
            Quantity::DefGrad => real(&|list, out| {
                for i in 0..list.len() {
                    out.extend((0..9).map(|c| if list.strain.len() == 9 { list.strain[c][i] } else { f64::NAN }));
                }
            }),
            Quantity::History(planes) => real(&|list, out| match planes[list.material as usize] {
                Some(plane) => out.extend(&list.state[plane]),
                None => out.extend(std::iter::repeat_n(f64::NAN, list.len())),
            }),
            Quantity::Stress => {
                let mut values = Vec::new();
                for list in lists() {
                    let which: Vec<usize> = (0..list.len()).collect();
                    let tau = kirchhoff(&plan.materials[list.material as usize], list, &which)?;
                    values.extend(tau.iter().enumerate().flat_map(|(i, tau)| tau.map(|t| t / volume_ratio(list, i))));
                }
                values
            }
        };
        Ok(match plan.precision {
            Precision::F32 => Values::F32(values.into_iter().map(|x| x as f32).collect()),
            Precision::F64 => Values::F64(values),
        })
    }
}

/// The left Cauchy-Green strain b of a particle, F F^T where its law keeps F: xx, yy, zz, xy, xz, yz.
fn left_cauchy_green(list: &ParticleList, i: usize) -> [f64; 6] {
    if list.strain.len() == 6 {
        return std::array::from_fn(|c| list.strain[c][i]);
    }
    let product = |a: usize, b: usize| (0..3).map(|d| list.strain[3 * a + d][i] * list.strain[3 * b + d][i]).sum();
    [product(0, 0), product(1, 1), product(2, 2), product(0, 1), product(0, 2), product(1, 2)]
}

/// Present over rest volume of a particle, by its elastic strain: J = sqrt(det b).
fn volume_ratio(list: &ParticleList, i: usize) -> f64 {
    let [xx, yy, zz, xy, xz, yz] = left_cauchy_green(list, i);
    (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)).max(0.0).sqrt()
}

/// What files say about their numbers.
#[derive(Serialize)]
struct Header<'a> {
    barchan: &'static str,
    scene: String,
    /// Simulated time [s].
    time: f64,
    step: u64,
    fields: BTreeMap<&'a str, About<'a>>,
    /// Names, by the numbers in the fields `material` and `body`.
    materials: Vec<&'a str>,
    bodies: Vec<&'a str>,
}

/// Unit and components of a field.
#[derive(Serialize)]
struct About<'a> {
    unit: &'a str,
    components: &'a [&'static str],
}

impl<'a> Header<'a> {
    fn new(simulation: &'a Simulation, fields: &'a Fields) -> Self {
        let plan = simulation.plan();
        let about = |field: &'a Field| (field.name.as_str(), About { unit: &field.unit, components: field.components });
        Self {
            barchan: env!("CARGO_PKG_VERSION"),
            scene: plain(&plan.scene.name),
            time: simulation.time(),
            step: simulation.step_count(),
            fields: fields.0.iter().map(about).collect(),
            materials: plan.materials.iter().map(|material| material.name.as_str()).collect(),
            bodies: plan.scene.body.iter().map(|body| body.name.as_str()).collect(),
        }
    }
}

/// Writes all particles of a simulation to a file, with those in the archive of ground out of reach.
///
/// Positions are f64; other numbers are f32 in runs of f32, which loses nothing but in density and stress, and f64 in runs of f64. PLY has no 64-bit integers, so
/// ids are 32-bit there. Files are complete or absent: they are written under a temporary name, then renamed.
///
/// # Errors
/// [`Error::Io`] if it cannot be written; [`Error::Missing`] if stress is wanted of a law without an f64 update.
pub fn particles(simulation: &Simulation, fields: &Fields, path: impl AsRef<Path>, format: Export) -> Result<()> {
    let (plan, state) = (simulation.plan(), simulation.ground());
    let count = state.lists.iter().map(ParticleList::len).sum();
    let header = Header::new(simulation, fields);
    let path = path.as_ref();
    // What a law says to a question about its stress is no error of the file.
    let mut failed = None;
    let written = write_whole(path, "writing particles", |out| {
        let mut values = |field: &Field| {
            field.values(plan, &state).map_err(|error| {
                failed = Some(error);
                std::io::Error::other("a field is missing")
            })
        };
        match format {
            Export::Ply => ply::write(out, &header, &fields.0, count, &mut values),
            Export::Npz => npz::write(out, &header, &fields.0, count, &mut values),
            Export::Vtk => vtu::write(out, &header, &fields.0, count, &mut values),
        }
    });
    failed.map_or(written, Err)
}
