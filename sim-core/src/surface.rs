//! What bodies look like: triangle meshes for pictures.

use crate::Vec3;
use std::collections::HashMap;
use std::sync::Arc;

/// A part of a body's surface.
#[derive(Clone, Debug)]
pub struct Surface {
    /// Its triangles, in a frame of the body's. Those that never change are shared from picture to picture.
    pub mesh: Arc<Mesh>,
    /// Where the origin of that frame is [m].
    pub position: Vec3,
    /// Orientation quaternion of that frame (w, x, y, z).
    pub rotation: [f64; 4],
    /// Its colour, sRGB from 0 to 1; none: a tool's.
    pub colour: Option<[f32; 3]>,
}

/// Triangles with a normal at each corner. They need not be closed, nor wind alike.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Corners [m].
    pub corners: Vec<[[f32; 3]; 3]>,
    /// Unit normals at these corners.
    pub normals: Vec<[[f32; 3]; 3]>,
}

/// Cosine of the angle between two triangles up to which the edge between them is smooth (40°).
const CREASE: f32 = 0.766;

impl Mesh {
    /// Triangles by their corners [m]. Where neighbours meet at less than 40°, their normals are blended.
    pub fn new(corners: Vec<[[f32; 3]; 3]>) -> Self {
        let corners: Vec<_> = corners.into_iter().filter(|t| dot(area(t), area(t)) > 0.0).collect();
        let areas: Vec<[f32; 3]> = corners.iter().map(area).collect();
        let units: Vec<[f32; 3]> = areas.iter().map(|&a| unit(a)).collect();
        let key = |p: [f32; 3]| p.map(|x| (x + 0.0).to_bits());
        let mut around: HashMap<[u32; 3], Vec<u32>> = HashMap::new();
        for (i, triangle) in corners.iter().enumerate() {
            triangle.iter().for_each(|&p| around.entry(key(p)).or_default().push(i as u32));
        }
        let normal = |i: usize, p: [f32; 3]| {
            let near = around[&key(p)].iter().map(|&j| j as usize).filter(|&j| dot(units[i], units[j]) > CREASE);
            unit(near.fold([0.0; 3], |sum, j| std::array::from_fn(|d| sum[d] + areas[j][d])))
        };
        let normals = corners.iter().enumerate().map(|(i, t)| t.map(|p| normal(i, p))).collect();
        Self { corners, normals }
    }
}

/// Normal of a triangle, as long as twice its area.
fn area([a, b, c]: &[[f32; 3]; 3]) -> [f32; 3] {
    let [u, v]: [[f32; 3]; 2] = [b, c].map(|end| std::array::from_fn(|d| end[d] - a[d]));
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    // Small triangles in metres have areas that f32 loses when squared.
    let most = v.iter().fold(f32::MIN_POSITIVE, |most, x| most.max(x.abs()));
    let v = v.map(|x| x / most);
    let length = dot(v, v).sqrt().max(f32::MIN_POSITIVE);
    v.map(|x| x / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A roof of two triangles that meet at some angle along the x axis.
    fn roof(angle: f32) -> Mesh {
        let (s, c) = (0.5 * angle).sin_cos();
        let (a, b) = ([0.0; 3], [1.0, 0.0, 0.0]);
        Mesh::new(vec![[a, b, [0.0, c, -s]], [b, a, [0.0, -c, -s]]])
    }

    #[test]
    fn flat_edges_are_smooth_and_sharp_ones_stay() {
        let gentle = roof(0.5);
        assert!((gentle.normals[0][0][2] - 1.0).abs() < 1e-6, "{:?}", gentle.normals);
        let steep = roof(1.5);
        assert!((steep.normals[0][0][2] - 0.75f32.cos()).abs() < 1e-6, "{:?}", steep.normals);
    }

    #[test]
    fn triangles_without_area_are_dropped_and_small_ones_kept() {
        let small = [[0.0; 3], [1e-5, 0.0, 0.0], [0.0, 1e-5, 0.0]];
        let mesh = Mesh::new(vec![[[1.0; 3]; 3], small]);
        assert_eq!(mesh.corners, [small]);
        assert_eq!(mesh.normals, [[[0.0, 0.0, 1.0]; 3]]);
    }
}
