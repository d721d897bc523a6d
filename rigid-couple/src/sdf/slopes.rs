//! How distance and normal of a surface change with the place, for gradients.

use super::{HeightField, Part, Primitive, Sdf};
use crate::mass::outer;
use crate::mesh::DistanceGrid;
use glam::{DMat3, DVec3};

/// Derivatives of a [`Surface`](super::Surface) by the place.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Slopes {
    /// Of the distance: the normal, but beside sampled surfaces.
    pub distance: DVec3,
    /// Of the normal, a row for each of its components [1/m].
    pub normal: DMat3,
}

/// How the direction of `v` changes, where `v` changes as the rows say.
fn direction_slopes(v: DVec3, rows: DMat3) -> DMat3 {
    let (length, along) = (v.length(), v.normalize_or_zero());
    if length > 0.0 { (rows - outer(along, along) * rows) * (1.0 / length) } else { DMat3::ZERO }
}

impl Slopes {
    /// Of the distance from a flat face.
    fn flat(normal: DVec3) -> Self {
        Self { distance: normal, normal: DMat3::ZERO }
    }

    /// Of the distance from a point, line or plane, from which `arm` leads to the place: it changes along these axes only.
    fn round(arm: DVec3, axes: DVec3) -> Self {
        Self { distance: arm.normalize_or_zero(), normal: direction_slopes(arm, DMat3::from_diagonal(axes)) }
    }
}

impl Primitive {
    /// Those of the [surface with rounded edges](Self::rounded), in the primitive's frame.
    fn slopes(&self, x: DVec3, edge: f64) -> Slopes {
        match self {
            Self::Sphere { .. } => Slopes::round(x, DVec3::ONE),
            Self::Box { half } => box_slopes(x, *half - edge),
            Self::Cylinder { radius, half_height } => cylinder_slopes(x, radius - edge, half_height - edge),
            Self::Capsule { half_height, .. } => {
                let beyond = if x.z.abs() > *half_height { 1.0 } else { 0.0 };
                let arm = x - DVec3::Z * x.z.clamp(-half_height, *half_height);
                Slopes::round(arm, DVec3::new(1.0, 1.0, beyond))
            }
            Self::Plane => Slopes::flat(DVec3::Z),
            Self::HeightField(field) => field.slopes(x),
            Self::Mesh(mesh) => mesh.grid.slopes(x),
        }
    }
}

fn box_slopes(x: DVec3, half: DVec3) -> Slopes {
    let q = x.abs() - half;
    if q.max_element() <= 0.0 {
        let axis = q.max_position();
        return Slopes::flat(DVec3::AXES[axis] * x[axis].signum());
    }
    let beyond = DVec3::from_array(q.to_array().map(|q| if q > 0.0 { 1.0 } else { 0.0 }));
    Slopes::round(q.max(DVec3::ZERO) * x.signum(), beyond)
}

fn cylinder_slopes(x: DVec3, radius: f64, half_height: f64) -> Slopes {
    let radial = DVec3::new(x.x, x.y, 0.0);
    let (rho, across) = (radial.length(), DVec3::new(1.0, 1.0, 0.0));
    let (a, b) = (rho - radius, x.z.abs() - half_height);
    if a > 0.0 && b > 0.0 {
        // From the rim's circle: a along the radius, which turns with the place, and b along the axis.
        let side = Slopes::round(radial, across);
        let arm = a * side.distance + b * x.z.signum() * DVec3::Z;
        let rows = outer(side.distance, side.distance) + side.normal * a + DMat3::from_diagonal(DVec3::Z);
        return Slopes { distance: arm.normalize_or_zero(), normal: direction_slopes(arm, rows) };
    }
    if a > b { Slopes::round(radial, across) } else { Slopes::flat(DVec3::Z * x.z.signum()) }
}

impl HeightField {
    fn slopes(&self, x: DVec3) -> Slopes {
        let normal = self.surface(x).normal.unwrap_or_default();
        // All faces but the top are flat and along an axis.
        let (h, hx, hy) = self.height(x.x, x.y);
        let slope = DVec3::new(-hx, -hy, 1.0);
        let length = slope.length();
        if normal != slope / length {
            return Slopes::flat(normal);
        }
        // Beside the rectangle, heights are the border's.
        let within = |d: usize| if (self.min[d]..=self.max[d]).contains(&x[d]) { 1.0 } else { 0.0 };
        let (across, along, twist) = (within(0), within(1), self.twist(x.x, x.y));
        let rows =
            DMat3::from_cols(DVec3::new(0.0, -twist * across, 0.0), DVec3::new(-twist * along, 0.0, 0.0), DVec3::ZERO);
        let of_length = rows.transpose() * normal;
        let distance = DVec3::new(across, along, 1.0) * normal - (x.z - h) / (length * length) * of_length;
        Slopes { distance, normal: direction_slopes(slope, rows) }
    }
}

impl DistanceGrid {
    fn slopes(&self, x: DVec3) -> Slopes {
        let (at, within) = self.nearest(x);
        let normal = self.surface(at).normal.unwrap_or_default();
        let (value, gradient, second) = self.derivatives(at);
        // On the grid's border the place within it moves along some axes only.
        let free = DMat3::from_diagonal(within);
        let turn = direction_slopes(gradient, second) * if normal == DVec3::ZERO { 0.0 } else { 1.0 };
        let beyond = x - at;
        if within == DVec3::ONE || beyond == DVec3::ZERO {
            return Slopes { distance: gradient, normal: turn };
        }
        let along = free * gradient;
        let rows = DMat3::IDENTITY - free + outer(normal, along) + turn * free * value;
        Slopes { distance: along + beyond.normalize_or_zero(), normal: direction_slopes(beyond + value * normal, rows) }
    }
}

impl Part {
    /// Those of the surface that contact sees, in the shape's frame.
    fn contact_slopes(&self, x: DVec3, cell: f64) -> Slopes {
        let Slopes { distance, normal } = self.primitive.slopes(self.local(x), self.edge(cell));
        let turn = self.to_shape;
        Slopes { distance: turn * distance, normal: turn * normal * turn.transpose() }
    }
}

impl Sdf {
    /// How the [surface that contact sees](Self::contact_surface) changes with the place, in the shape's frame.
    pub(crate) fn contact_slopes(&self, x: DVec3, cell: f64) -> Slopes {
        let nearest = self.nearest(|part| part.contact_surface(x, cell, f64::INFINITY));
        nearest.map_or_else(Slopes::default, |(_, part)| part.contact_slopes(x, cell))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriangleMesh;
    use crate::motion::Pose;
    use crate::sdf::MeshPart;
    use glam::DQuat;
    use std::sync::Arc;

    /// A wedge, as a closed mesh.
    fn wedge() -> TriangleMesh {
        let [a, b, c] = [[-0.4, -0.3], [0.5, -0.2], [0.1, 0.45]].map(|[x, y]: [f64; 2]| DVec3::new(x, y, -0.35));
        let up = |x: DVec3| DVec3::new(0.8 * x.x, x.y, 0.3);
        let [d, e, f] = [a, b, c].map(up);
        let side = |a: DVec3, b: DVec3| [[a, b, up(b)], [a, up(b), up(a)]];
        let corners = [[a, c, b], [d, e, f]].into_iter().chain(side(a, b)).chain(side(b, c)).chain(side(c, a));
        TriangleMesh::new(corners).unwrap_or_else(|refusal| panic!("{}", refusal.what))
    }

    /// Physics: of every shape, turned and moved, inside, outside and beyond what is sampled, the slopes are the differences of what contact sees: distance and normal.
    #[test]
    fn slopes_are_those_of_the_surface() {
        let mesh = wedge();
        let grid = DistanceGrid::sample(&mesh);
        let heights = vec![vec![0.1, 0.25, -0.05], vec![0.3, 0.1, 0.2], vec![-0.1, 0.15, 0.05]];
        let primitives = [
            Primitive::Sphere { radius: 0.4 },
            Primitive::Box { half: DVec3::new(0.3, 0.5, 0.4) },
            Primitive::Box { half: DVec3::new(0.3, 0.5, 0.02) },
            Primitive::Cylinder { radius: 0.4, half_height: 0.3 },
            Primitive::Capsule { radius: 0.2, half_height: 0.3 },
            Primitive::Plane,
            Primitive::HeightField(Arc::new(HeightField { min: [-0.6; 2], max: [0.6; 2], bottom: -0.7, heights })),
            Primitive::Mesh(Arc::new(MeshPart { mesh, grid })),
        ];
        let pose = Pose {
            position: DVec3::new(0.05, -0.1, 0.08),
            rotation: DQuat::from_scaled_axis(DVec3::new(0.3, -0.5, 0.7)),
        };
        let (cell, step) = (0.07, 1e-7);
        for primitive in primitives {
            let shape = Sdf::new(vec![Part::new(primitive.clone(), pose)]);
            let (mut compared, mut far) = (0, 0);
            for n in 0..600 {
                // Points of a sequence that fills a box evenly.
                let share = |a: f64| (a * f64::from(n)).fract() - 0.5;
                let x = 1.6 * DVec3::new(share(0.819_172_5), share(0.671_043_6), share(0.549_700_5));
                let surface = shape.contact_surface(x, cell).0;
                let Some(normal) = surface.normal.filter(|_| surface.distance.abs() < 3.0 * cell) else { continue };
                let slopes = shape.contact_slopes(x, cell);
                let mut worst: f64 = 0.0;
                for axis in DVec3::AXES {
                    let [ahead, behind] = [1.0, -1.0].map(|sign| shape.contact_surface(x + sign * step * axis, cell).0);
                    let difference = (ahead.distance - behind.distance) / (2.0 * step);
                    worst = worst.max((difference - slopes.distance.dot(axis)).abs());
                    let normals = [ahead, behind].map(|surface| surface.normal.unwrap_or(normal));
                    let difference = (normals[0] - normals[1]) / (2.0 * step);
                    worst = worst.max((difference - slopes.normal * axis).length() * cell);
                }
                compared += 1;
                far += usize::from(worst > 1e-5);
            }
            // Beside the seams between pieces of a surface differences jump.
            assert!(compared > 50 && far * 100 <= compared, "{primitive:?}: {far} of {compared} differ");
        }
    }
}
