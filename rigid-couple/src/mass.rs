//! Volume, centre and inertia of evenly filled shapes.

use crate::Refusal;
use crate::mesh::TriangleMesh;
use crate::motion::Pose;
use crate::sdf::{Part, Primitive, Sdf};
use glam::{DMat3, DVec3};
use std::f64::consts::PI;

/// A shape filled with density 1 kg/m³.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Filling {
    /// Volume [m³].
    pub volume: f64,
    /// Centre of mass, in the shape's frame [m].
    pub centre: DVec3,
    /// Inertia about the centre of mass for density 1 [m⁵].
    pub inertia: DMat3,
}

/// Volume elements along the longest side of a union. Its mass properties are good to about 1e-3 with it.
const ELEMENTS: f64 = 96.0;

/// a bᵀ.
pub(crate) fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// The inertia whose second moments ∫ x xᵀ are `moments`.
fn inertia_of(moments: DMat3) -> DMat3 {
    let trace = moments.x_axis.x + moments.y_axis.y + moments.z_axis.z;
    DMat3::from_diagonal(DVec3::splat(trace)) - moments
}

impl Filling {
    /// Of a shape: in closed form for primitives and meshes, by summation over small elements for unions.
    ///
    /// # Errors
    /// If the shape is or holds a plane or a height field, which are ground and cannot be free bodies.
    pub fn of(shape: &Sdf) -> Result<Self, Refusal> {
        match shape.parts() {
            [part] => Self::of_part(part),
            parts => {
                for part in parts {
                    Self::of_part(part)?;
                }
                Ok(Self::of_union(shape))
            }
        }
    }

    fn of_part(part: &Part) -> Result<Self, Refusal> {
        let (volume, centre, inertia) = match &part.primitive {
            Primitive::Sphere { radius: r } => {
                let volume = 4.0 / 3.0 * PI * r.powi(3);
                (volume, DVec3::ZERO, DVec3::splat(0.4 * volume * r * r))
            }
            Primitive::Box { half } => {
                let volume = 8.0 * half.element_product();
                let square = *half * *half;
                (volume, DVec3::ZERO, volume / 3.0 * (DVec3::splat(square.element_sum()) - square))
            }
            Primitive::Cylinder { radius: r, half_height: h } => {
                let volume = 2.0 * PI * r * r * h;
                let across = volume * (0.25 * r * r + h * h / 3.0);
                (volume, DVec3::ZERO, DVec3::new(across, across, 0.5 * volume * r * r))
            }
            Primitive::Capsule { radius: r, half_height: h } => {
                let (tube, ball) = (2.0 * PI * r * r * h, 4.0 / 3.0 * PI * r.powi(3));
                let across = tube * (0.25 * r * r + h * h / 3.0) + ball * (0.4 * r * r + h * h + 0.75 * h * r);
                let along = 0.5 * tube * r * r + 0.4 * ball * r * r;
                (tube + ball, DVec3::ZERO, DVec3::new(across, across, along))
            }
            Primitive::Mesh(mesh) => return Ok(Self::of_mesh(&mesh.mesh).placed(&part.pose)),
            Primitive::Plane => return Err(not_a_body("a plane")),
            Primitive::HeightField(_) => return Err(not_a_body("a height field")),
        };
        Ok(Self { volume, centre, inertia: DMat3::from_diagonal(inertia) }.placed(&part.pose))
    }

    /// Of a closed mesh: exact sums over the tetrahedra between the triangles and a point.
    pub fn of_mesh(mesh: &TriangleMesh) -> Self {
        // A point amid the mesh: about a far one the sums would cancel.
        let (min, max) = mesh.bounds();
        let origin = 0.5 * (min + max);
        let (mut volume, mut first, mut second) = (0.0, DVec3::ZERO, DMat3::ZERO);
        for triangle in mesh.corners() {
            let [a, b, c] = triangle.map(|x| x - origin);
            let part = a.dot(b.cross(c)) / 6.0;
            let sum = a + b + c;
            volume += part;
            first += part / 4.0 * sum;
            second += (outer(a, a) + outer(b, b) + outer(c, c) + outer(sum, sum)) * (part / 20.0);
        }
        let centre = first / volume;
        Self { volume, centre: origin + centre, inertia: inertia_of(second - outer(centre, centre) * volume) }
    }

    fn of_union(shape: &Sdf) -> Self {
        let bounds = shape.bounds(&Pose::IDENTITY, 0.0);
        let (min, max) = (DVec3::from_array(bounds.min), DVec3::from_array(bounds.max));
        let count = ((max - min) / (max - min).max_element() * ELEMENTS).ceil();
        let width = (max - min) / count;
        let origin = 0.5 * (min + max);
        let (mut volume, mut first, mut second) = (0.0, DVec3::ZERO, DMat3::ZERO);
        let [nx, ny, nz] = count.to_array().map(|n| n as usize);
        for k in 0..nz {
            for j in 0..ny {
                for i in 0..nx {
                    let x = min + width * (DVec3::new(i as f64, j as f64, k as f64) + 0.5);
                    // An element that the surface cuts counts by the share inside, as if the cut were square.
                    let part = (0.5 - shape.surface(x).distance / width.min_element()).clamp(0.0, 1.0);
                    let x = x - origin;
                    volume += part;
                    first += part * x;
                    second += outer(x, x) * part;
                }
            }
        }
        let element = width.element_product();
        let centre = first / volume;
        let own = DMat3::from_diagonal(width * width / 12.0) * volume;
        let moments = (second - outer(centre, centre) * volume + own) * element;
        Self { volume: volume * element, centre: origin + centre, inertia: inertia_of(moments) }
    }

    /// The same filling seen from the frame in which its own frame is at `pose`.
    fn placed(self, pose: &Pose) -> Self {
        let rotation = DMat3::from_quat(pose.rotation);
        let inertia = rotation * self.inertia * rotation.transpose();
        Self { centre: pose.apply(self.centre), inertia, ..self }
    }
}

fn not_a_body(what: &str) -> Refusal {
    Refusal::new(format!("{what} has no mass and cannot be free"), "choose another motion, or a shape of finite size")
}
