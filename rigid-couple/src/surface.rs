//! Shapes as triangles, for pictures.

use crate::motion::Pose;
use crate::sdf::{HeightField, Primitive, Sdf};
use barchan_core::coupling::Aabb;
use barchan_core::surface::{Mesh, Surface};
use glam::DVec3;
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// Sides of what is round.
const SIDES: usize = 32;

type Triangle = [DVec3; 3];

/// The surface of a shape in its own frame, but for planes, which have no end.
pub(crate) fn mesh_of(shape: &Sdf) -> Arc<Mesh> {
    let mut triangles = Vec::new();
    for part in shape.parts() {
        triangles.extend(primitive(&part.primitive).into_iter().map(|t| t.map(|x| part.pose.apply(x))));
    }
    mesh(triangles)
}

/// Triangles as pictures take them.
pub(crate) fn mesh(triangles: Vec<Triangle>) -> Arc<Mesh> {
    Arc::new(Mesh::new(triangles.into_iter().map(|t| t.map(|x| x.as_vec3().to_array())).collect()))
}

/// A mesh at a place.
pub(crate) fn placed(mesh: &Arc<Mesh>, pose: &Pose, colour: Option<[f32; 3]>) -> Surface {
    Surface { mesh: Arc::clone(mesh), position: pose.position.to_array(), rotation: pose.quaternion(), colour }
}

/// What a world's box holds of the planes of a shape at `pose`.
pub(crate) fn planes_of(shape: &Sdf, pose: &Pose, world: &Aabb) -> Option<Surface> {
    let planes = shape.parts().iter().filter(|part| matches!(part.primitive, Primitive::Plane));
    let triangles: Vec<Triangle> = planes.flat_map(|part| patch(&pose.then(&part.pose), world)).collect();
    (!triangles.is_empty()).then(|| placed(&mesh(triangles), &Pose::IDENTITY, None))
}

/// A plane z = 0 at `pose`, as far as it lies in a box.
fn patch(pose: &Pose, world: &Aabb) -> Vec<Triangle> {
    let (min, max) = (DVec3::from_array(world.min), DVec3::from_array(world.max));
    let (middle, wide) = (0.5 * (min + max), (max - min).length());
    let near = pose.rotation.conjugate() * (middle - pose.position);
    let corner = |x: f64, y: f64| pose.apply(DVec3::new(near.x + x * wide, near.y + y * wide, 0.0));
    let mut polygon = vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
    for d in 0..3 {
        polygon = clipped(&polygon, |x| x[d] - min[d]);
        polygon = clipped(&polygon, |x| max[d] - x[d]);
    }
    (2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]).collect()
}

/// The part of a polygon where `inside` is not negative.
fn clipped(polygon: &[DVec3], inside: impl Fn(DVec3) -> f64) -> Vec<DVec3> {
    let mut kept = Vec::new();
    for (i, &b) in polygon.iter().enumerate() {
        let a = polygon[(i + polygon.len() - 1) % polygon.len()];
        let (u, v) = (inside(a), inside(b));
        if (u < 0.0) != (v < 0.0) {
            kept.push(a + (b - a) * (u / (u - v)));
        }
        if v >= 0.0 {
            kept.push(b);
        }
    }
    kept
}

/// A primitive's surface; nothing of a plane.
pub(crate) fn primitive(primitive: &Primitive) -> Vec<Triangle> {
    match primitive {
        Primitive::Sphere { radius } => turned(&arc(*radius, 0.0)),
        Primitive::Capsule { radius, half_height } => turned(&arc(*radius, *half_height)),
        Primitive::Cylinder { radius, half_height } => {
            let (r, h) = (*radius, *half_height);
            turned(&[[0.0, -h], [r, -h], [r, h], [0.0, h]])
        }
        Primitive::Box { half } => faces(*half),
        Primitive::Plane => Vec::new(),
        Primitive::HeightField(field) => block(field),
        Primitive::Mesh(mesh) => mesh.mesh.corners().collect(),
    }
}

/// Half a circle from the lower pole to the upper one, as distances from the axis and heights, its halves moved apart.
fn arc(radius: f64, apart: f64) -> Vec<[f64; 2]> {
    let point = |i: usize, shift: f64| {
        let angle = PI * (i as f64 / (SIDES / 2) as f64 - 0.5);
        [radius * angle.cos(), radius * angle.sin() + shift]
    };
    (0..=SIDES / 4).map(|i| point(i, -apart)).chain((SIDES / 4..=SIDES / 2).map(|i| point(i, apart))).collect()
}

/// What a line turned about the z axis sweeps.
fn turned(line: &[[f64; 2]]) -> Vec<Triangle> {
    // All triangles that share a corner must have it bit for bit.
    let at = |[r, z]: [f64; 2], i: usize| {
        let (s, c) = (TAU * (i % SIDES) as f64 / SIDES as f64).sin_cos();
        DVec3::new(r * c, r * s, z)
    };
    let quads = line.windows(2).flat_map(|ends| (0..SIDES).map(move |i| (ends[0], ends[1], i)));
    quads
        .flat_map(|(low, high, i)| {
            let [a, b, c, d] = [at(low, i), at(low, i + 1), at(high, i + 1), at(high, i)];
            [[a, b, c], [a, c, d]]
        })
        .collect()
}

fn faces(half: DVec3) -> Vec<Triangle> {
    let corner = |bits: usize| {
        let sign = |d: usize| if bits >> d & 1 == 1 { 1.0 } else { -1.0 };
        half * DVec3::new(sign(0), sign(1), sign(2))
    };
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]].map(|t| t.map(corner))).collect()
}

/// A height field's top and its sides.
fn block(field: &HeightField) -> Vec<Triangle> {
    let (rows, columns) = (field.heights.len(), field.heights[0].len());
    let along = |i: usize, n: usize, d: usize| field.min[d] + (field.max[d] - field.min[d]) * i as f64 / (n - 1) as f64;
    let top = |i: usize, j: usize| DVec3::new(along(i, columns, 0), along(j, rows, 1), field.heights[j][i]);
    let mut triangles = Vec::new();
    for (i, j) in (0..rows - 1).flat_map(|j| (0..columns - 1).map(move |i| (i, j))) {
        let [a, b, c, d] = [top(i, j), top(i + 1, j), top(i + 1, j + 1), top(i, j + 1)];
        triangles.extend([[a, b, c], [a, c, d]]);
    }
    let mut wall = |a: DVec3, b: DVec3| {
        let [low_a, low_b] = [a, b].map(|x| DVec3::new(x.x, x.y, field.bottom));
        triangles.extend([[low_a, low_b, b], [low_a, b, a]]);
    };
    for i in 0..columns - 1 {
        wall(top(i, 0), top(i + 1, 0));
        wall(top(i + 1, rows - 1), top(i, rows - 1));
    }
    for j in 0..rows - 1 {
        wall(top(0, j + 1), top(0, j));
        wall(top(columns - 1, j), top(columns - 1, j + 1));
    }
    triangles
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What closed triangles that wind anticlockwise seen from outside hold.
    fn volume(triangles: &[Triangle]) -> f64 {
        triangles.iter().map(|[a, b, c]| a.dot(b.cross(*c))).sum::<f64>() / 6.0
    }

    #[test]
    fn surfaces_hold_the_volumes_of_their_shapes() {
        let (r, h) = (0.3, 0.2);
        let ball = 4.0 / 3.0 * PI * r * r * r;
        let rod = PI * r * r * 2.0 * h;
        let cases = [
            (Primitive::Sphere { radius: r }, ball),
            (Primitive::Capsule { radius: r, half_height: h }, ball + rod),
            (Primitive::Cylinder { radius: r, half_height: h }, rod),
            (Primitive::Box { half: DVec3::new(0.1, 0.2, 0.3) }, 0.048),
        ];
        for (shape, expected) in cases {
            let found = volume(&primitive(&shape));
            assert!((found / expected - 1.0).abs() < 0.02, "{shape:?} holds {found}, not {expected}");
        }
        let heights = vec![vec![1.0, 2.0], vec![1.0, 2.0]];
        let field = HeightField { min: [0.0; 2], max: [2.0, 1.0], bottom: 0.5, heights };
        // Its bottom is left out; it lies at z = 0 after this.
        let raised: Vec<Triangle> = block(&field).into_iter().map(|t| t.map(|x| x - DVec3::Z * 0.5)).collect();
        assert!((volume(&raised) - 2.0).abs() < 1e-12, "{}", volume(&raised));
    }

    #[test]
    fn a_plane_ends_with_the_world() {
        let world = Aabb { min: [0.0; 3], max: [2.0, 1.0, 1.0] };
        let pose = Pose { position: DVec3::new(0.3, -4.0, 0.25), ..Pose::IDENTITY };
        let area: f64 = patch(&pose, &world).iter().map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).sum();
        assert!((area - 2.0).abs() < 1e-12, "{area}");
        let away = Pose { position: DVec3::Z * 3.0, ..Pose::IDENTITY };
        assert!(patch(&away, &world).is_empty());
    }
}
