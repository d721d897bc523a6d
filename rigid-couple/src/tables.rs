//! Shapes as `grip.wgsl` and `sampled.wgsl` read them.

use crate::sdf::{Part, Primitive};
use barchan_core::scene::Contact;
use glam::{DMat3, DVec3};
use std::ops::Range;

/// Where nothing is sampled, devices should not carry the text of `sampled.wgsl`.
const NO_SAMPLES: &str = "
fn rigid_mesh(first: u32, x: vec3<f32>) -> RigidSurface { return RigidSurface(1e30, vec3<f32>(0.0), false); }
fn rigid_heights(first: u32, half: vec3<f32>, x: vec3<f32>) -> RigidSurface { return RigidSurface(1e30, vec3<f32>(0.0), false); }
";

/// A vector of a table.
pub(crate) type Row = [f32; 4];

/// A body for the tables: its shape, how it grips, and what stands behind its parts.
pub(crate) struct Listed<'a> {
    pub parts: &'a [Part],
    pub contact: Contact,
    pub behind: Vec<Row>,
}

/// What devices read of a coupling's bodies.
pub(crate) struct Tables {
    pub table: Vec<Row>,
    pub samples: Vec<Row>,
}

/// What is sampled of shapes, each shape once: links of a robot often have the same.
#[derive(Default)]
struct Samples {
    all: Vec<Row>,
    of_shapes: Vec<Range<usize>>,
}

impl Samples {
    /// Where a shape's samples begin.
    fn add(&mut self, samples: Vec<Row>) -> usize {
        let known = self.of_shapes.iter().find(|range| self.all[range.start..range.end] == samples);
        known.map(|range| range.start).unwrap_or_else(|| {
            let begin = self.all.len();
            self.all.extend(samples);
            self.of_shapes.push(begin..self.all.len());
            begin
        })
    }
}

/// A vector, and a number behind it.
pub(crate) fn row(v: DVec3, last: f64) -> Row {
    [v.x, v.y, v.z, last].map(|x| x as f32)
}

/// The rows of a matrix.
pub(crate) fn rows(matrix: &DMat3) -> [Row; 3] {
    [0, 1, 2].map(|i| row(matrix.row(i), 0.0))
}

impl Tables {
    /// Of these bodies; `None` if there are too many samples to number.
    pub(crate) fn of(bodies: &[Listed<'_>]) -> Option<Self> {
        let (mut table, mut samples) = (Vec::new(), Samples::default());
        let mut first = bodies.len();
        for Listed { parts, contact, behind } in bodies {
            let (kind, friction) = match contact {
                Contact::Stick => (0.0, 0.0),
                Contact::Slip => (1.0, 0.0),
                Contact::Coulomb { friction } => (1.0, *friction),
            };
            table.push([first as f32, parts.len() as f32, kind, friction as f32]);
            first += 6 * parts.len() + behind.len();
        }
        for Listed { parts, behind, .. } in bodies {
            for part in *parts {
                let (min, max) = part.primitive.bounds();
                let (middle, half) = (0.5 * (min + max), 0.5 * (max - min));
                let (kind, size, begin) = match &part.primitive {
                    Primitive::Sphere { radius } => (0.0, DVec3::new(*radius, 0.0, 0.0), None),
                    Primitive::Box { half } => (1.0, *half, None),
                    Primitive::Cylinder { radius, half_height } => (2.0, DVec3::new(*radius, *half_height, 0.0), None),
                    Primitive::Capsule { radius, half_height } => (3.0, DVec3::new(*radius, *half_height, 0.0), None),
                    Primitive::Plane => (4.0, DVec3::ZERO, None),
                    Primitive::Mesh(mesh) => (5.0, half, Some(samples.add(mesh.grid.packed(middle)))),
                    Primitive::HeightField(field) => (6.0, half, Some(samples.add(field.packed(middle.z)))),
                };
                let rotation = DMat3::from_quat(part.pose.rotation);
                let offset = if begin.is_some() { rotation * middle } else { DVec3::ZERO };
                table.push([kind, part.half_thickness.min(1e30) as f32, begin.unwrap_or_default() as f32, 0.0]);
                table.push(row(size, 0.0));
                table.push(row(part.pose.position + offset, 0.0));
                table.extend(rows(&rotation));
            }
            table.extend(behind);
        }
        // Numbers up to here are exact in the table.
        (samples.all.len() < 1 << 24).then_some(Self { table, samples: samples.all })
    }

    /// How bodies grip, in WGSL.
    pub(crate) fn wgsl(&self) -> String {
        let sampled = if self.samples.is_empty() { NO_SAMPLES } else { include_str!("sampled.wgsl") };
        include_str!("grip.wgsl").to_owned() + sampled
    }
}
