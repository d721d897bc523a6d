//! Signed distance fields of the shapes that a scene can name.
//!
//! Distances are exact for spheres, boxes, capsules, cylinders and planes; sampled for meshes ([`crate::mesh::DistanceGrid`]);
//! exact to first order near the top of a height field (the vertical distance times the cosine of the slope). A union's
//! distance is that of its nearest part: exact outside, a bound inside.

mod slopes;

use crate::Refusal;
use crate::mesh::{DistanceGrid, TriangleMesh};
use crate::motion::{Pose, rotation_from};
use crate::terrain;
use barchan_core::coupling::Aabb;
use barchan_core::scene::Shape;
use barchan_core::{Result, Vec3};
use glam::{DMat3, DVec3};
use std::path::Path;
use std::sync::Arc;

/// Where a point is relative to a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Distance to the surface [m], negative inside.
    pub distance: f64,
    /// Unit vector along which the distance grows; none where it is undefined (a sphere's centre, a capsule's axis).
    pub normal: Option<DVec3>,
}

/// A shape in its own frame: one part, or the union of several.
#[derive(Clone, Debug)]
pub struct Sdf {
    parts: Vec<Part>,
}

/// A primitive at its place within a shape.
#[derive(Clone, Debug)]
pub struct Part {
    /// The primitive.
    pub primitive: Primitive,
    /// Where its origin is.
    pub pose: Pose,
    /// Half the thickness where the part is thinnest [m]; for a mesh, where it is thickest.
    pub half_thickness: f64,
    to_shape: DMat3,
    /// The primitive's own [rounded box](Primitive::rounded_box), kept since a mesh's takes a look at all of its corners.
    rounded_box: (DVec3, DVec3, f64),
}

/// A shape centred on its own origin.
#[derive(Clone, Debug)]
pub enum Primitive {
    /// A ball.
    Sphere {
        /// Radius [m].
        radius: f64,
    },
    /// A box.
    Box {
        /// Half the side lengths [m].
        half: DVec3,
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius [m].
        radius: f64,
        /// Half the height [m].
        half_height: f64,
    },
    /// All points within `radius` of a segment along z.
    Capsule {
        /// Radius [m].
        radius: f64,
        /// Half the segment's length [m].
        half_height: f64,
    },
    /// The half space z < 0.
    Plane,
    /// Everything between a bottom and a height that varies.
    HeightField(Arc<HeightField>),
    /// A closed triangle mesh.
    Mesh(Arc<MeshPart>),
}

/// A mesh and its sampled distance.
#[derive(Debug)]
pub struct MeshPart {
    /// The triangles.
    pub mesh: TriangleMesh,
    /// Their distance field.
    pub grid: DistanceGrid,
}

/// Heights over a rectangle, bilinear between samples.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightField {
    /// Least x and y [m].
    pub min: [f64; 2],
    /// Greatest x and y [m].
    pub max: [f64; 2],
    /// Lower end [m].
    pub bottom: f64,
    /// Row j at y_j, column i at x_i [m].
    pub heights: Vec<Vec<f64>>,
}

/// Up to four samples as devices read them.
pub(crate) fn four(samples: &[f64]) -> [f32; 4] {
    std::array::from_fn(|i| samples.get(i).map_or(0.0, |&sample| sample as f32))
}

/// Radius to which contact rounds the edges of boxes and cylinders [cells]. A sharper edge acts in steps: on a row of nodes, or not yet on
/// it. A plate pressed into elastic ground by half a cell, in a prototype, grew from 8 to 10 cells in tenths; its force grew by up to 1.7
/// times the mean step with this radius and with one cell, and sand through a slot by 1.7 times and twice. The plate of 9 cells bore 83 % of
/// what it bears on fine grids, 91 % with cells half as wide.
pub(crate) const ROUND: f64 = 1.5;

/// Least width of a face in cells from which on rounding its edges takes less than a quarter of the force on it, see [`Sdf::rounded_face`].
const FACE: f64 = 12.0;

/// Reach of a thin part's core on both sides of its middle, in cells.
const CORE: f64 = 0.75;

/// The normal along `v`, if `v` has a direction: `scale` is the length that counts as one.
fn direction(v: DVec3, scale: f64) -> Option<DVec3> {
    let length = v.length();
    (length > 1e-12 * scale).then(|| v / length)
}

/// The unit vector of axis `axis` that points to the side of `coordinate`; exactly in the middle either side would do.
fn outward(axis: usize, coordinate: f64) -> Option<DVec3> {
    Some(DVec3::AXES[axis] * coordinate.signum())
}

impl Surface {
    /// The surface further out by so much.
    fn offset(self, by: f64) -> Self {
        Self { distance: self.distance - by, ..self }
    }
}

fn box_surface(x: DVec3, half: DVec3) -> Surface {
    let q = x.abs() - half;
    let out = q.max(DVec3::ZERO);
    if out == DVec3::ZERO {
        let axis = q.max_position();
        Surface { distance: q[axis], normal: outward(axis, x[axis]) }
    } else {
        let distance = out.length();
        Surface { distance, normal: Some(out / distance * x.signum()) }
    }
}

fn cylinder_surface(x: DVec3, radius: f64, half_height: f64) -> Surface {
    let radial = DVec3::new(x.x, x.y, 0.0);
    let rho = radial.length();
    let (a, b) = (rho - radius, x.z.abs() - half_height);
    if a > 0.0 && b > 0.0 {
        let distance = a.hypot(b);
        let normal = (radial * (a / rho) + DVec3::Z * (b * x.z.signum())) / distance;
        Surface { distance, normal: Some(normal) }
    } else if a > b {
        Surface { distance: a, normal: direction(radial, radius) }
    } else {
        Surface { distance: b, normal: outward(2, x.z) }
    }
}

impl Primitive {
    /// Distance and normal at `x`, in the primitive's frame.
    pub fn surface(&self, x: DVec3) -> Surface {
        self.rounded(x, 0.0)
    }

    /// The same with the edges of boxes and cylinders rounded to the radius `edge`, at most half the thickness. The others have no edges,
    /// or, sampled, none that are sharper than their samples.
    fn rounded(&self, x: DVec3, edge: f64) -> Surface {
        match self {
            Self::Sphere { radius } => Surface { distance: x.length() - radius, normal: direction(x, *radius) },
            Self::Box { half } => box_surface(x, *half - edge).offset(edge),
            Self::Cylinder { radius, half_height } => {
                cylinder_surface(x, *radius - edge, *half_height - edge).offset(edge)
            }
            Self::Capsule { radius, half_height } => {
                let arm = x - DVec3::Z * x.z.clamp(-half_height, *half_height);
                Surface { distance: arm.length() - radius, normal: direction(arm, *radius) }
            }
            Self::Plane => Surface { distance: x.z, normal: Some(DVec3::Z) },
            Self::HeightField(field) => field.surface(x),
            Self::Mesh(mesh) => mesh.grid.surface(x),
        }
    }

    /// A box that holds the primitive, in its own frame; infinite for a plane.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let half = match self {
            Self::Sphere { radius } => DVec3::splat(*radius),
            Self::Box { half } => *half,
            Self::Cylinder { radius, half_height } => DVec3::new(*radius, *radius, *half_height),
            Self::Capsule { radius, half_height } => DVec3::new(*radius, *radius, half_height + radius),
            Self::Plane => return (DVec3::NEG_INFINITY, DVec3::new(f64::INFINITY, f64::INFINITY, 0.0)),
            Self::HeightField(f) => {
                let top = f.heights.iter().flatten().fold(f64::NEG_INFINITY, |a, &h| a.max(h));
                return (DVec3::new(f.min[0], f.min[1], f.bottom), DVec3::new(f.max[0], f.max[1], top));
            }
            Self::Mesh(mesh) => return mesh.mesh.bounds(),
        };
        (-half, half)
    }

    /// The middle of a box along its axes that holds it, half the size of that, and a radius by which the box is grown on all sides, round its corners: a
    /// sphere's has no size, a capsule's only a height.
    fn rounded_box(&self) -> (DVec3, DVec3, f64) {
        match self {
            Self::Sphere { radius } => (DVec3::ZERO, DVec3::ZERO, *radius),
            Self::Capsule { radius, half_height } => (DVec3::ZERO, DVec3::new(0.0, 0.0, *half_height), *radius),
            _ => {
                let (min, max) = self.bounds();
                (0.5 * (min + max), 0.5 * (max - min), 0.0)
            }
        }
    }

    fn half_thickness(&self) -> f64 {
        match self {
            Self::Sphere { radius } | Self::Capsule { radius, .. } => *radius,
            Self::Box { half } => half.min_element(),
            Self::Cylinder { radius, half_height } => radius.min(*half_height),
            Self::Plane => f64::INFINITY,
            Self::HeightField(f) => {
                let lowest = f.heights.iter().flatten().fold(f64::INFINITY, |a, &h| a.min(h));
                0.5 * (lowest - f.bottom)
            }
            Self::Mesh(mesh) => mesh.grid.depth(),
        }
    }
}

impl HeightField {
    /// The four samples around (x, y), x fastest, the place between them, 0 to 1 along each axis, and how far apart they are [m].
    fn around(&self, x: f64, y: f64) -> ([f64; 4], [f64; 2], [f64; 2]) {
        let (rows, columns) = (self.heights.len(), self.heights[0].len());
        let locate = |x: f64, min: f64, max: f64, n: usize| {
            let spacing = (max - min) / (n - 1) as f64;
            let s = ((x - min) / spacing).clamp(0.0, (n - 1) as f64);
            let i = (s as usize).min(n - 2);
            (i, s - i as f64, spacing)
        };
        let (i, a, dx) = locate(x, self.min[0], self.max[0], columns);
        let (j, b, dy) = locate(y, self.min[1], self.max[1], rows);
        let [low, high] = [&self.heights[j], &self.heights[j + 1]];
        ([low[i], low[i + 1], high[i], high[i + 1]], [a, b], [dx, dy])
    }

    /// Height and slopes at (x, y), taken from the border outside the rectangle.
    fn height(&self, x: f64, y: f64) -> (f64, f64, f64) {
        let ([h00, h10, h01, h11], [a, b], [dx, dy]) = self.around(x, y);
        let h = (1.0 - b) * ((1.0 - a) * h00 + a * h10) + b * ((1.0 - a) * h01 + a * h11);
        let hx = ((1.0 - b) * (h10 - h00) + b * (h11 - h01)) / dx;
        let hy = ((1.0 - a) * (h01 - h00) + a * (h11 - h10)) / dy;
        (h, hx, hy)
    }

    /// How the slope along x changes along y at (x, y), and the other way round [1/m].
    fn twist(&self, x: f64, y: f64) -> f64 {
        let ([h00, h10, h01, h11], _, [dx, dy]) = self.around(x, y);
        (h11 - h01 - h10 + h00) / (dx * dy)
    }

    /// As `sampled.wgsl` reads it, heights from `middle` on.
    pub fn packed(&self, middle: f64) -> Vec<[f32; 4]> {
        let count = [self.heights[0].len(), self.heights.len()];
        let spacing = [0, 1].map(|d| ((self.max[d] - self.min[d]) / (count[d] - 1) as f64) as f32);
        let head = [count[0] as f32, count[1] as f32, spacing[0], spacing[1]];
        let heights: Vec<f64> = self.heights.iter().flatten().map(|h| h - middle).collect();
        std::iter::once(head).chain(heights.chunks(4).map(four)).collect()
    }

    fn surface(&self, x: DVec3) -> Surface {
        let (h, hx, hy) = self.height(x.x, x.y);
        let slope = DVec3::new(-hx, -hy, 1.0);
        let length = slope.length();
        let faces = [
            ((x.z - h) / length, slope / length),
            (self.bottom - x.z, DVec3::NEG_Z),
            (self.min[0] - x.x, DVec3::NEG_X),
            (x.x - self.max[0], DVec3::X),
            (self.min[1] - x.y, DVec3::NEG_Y),
            (x.y - self.max[1], DVec3::Y),
        ];
        let (distance, normal) =
            faces.into_iter().reduce(|a, b| if b.0 > a.0 { b } else { a }).expect("there are six faces, listed above");
        Surface { distance, normal: Some(normal) }
    }
}

impl Part {
    /// A primitive at a place.
    pub fn new(primitive: Primitive, pose: Pose) -> Self {
        let (half_thickness, rounded_box) = (primitive.half_thickness(), primitive.rounded_box());
        Self { primitive, pose, half_thickness, to_shape: DMat3::from_quat(pose.rotation), rounded_box }
    }

    /// Distance and normal at `x`, in the shape's frame.
    pub fn surface(&self, x: DVec3) -> Surface {
        self.rounded(x, 0.0)
    }

    fn rounded(&self, x: DVec3, edge: f64) -> Surface {
        self.rounded_at(self.local(x), edge)
    }

    /// A point of the shape in the part's own frame.
    fn local(&self, x: DVec3) -> DVec3 {
        self.to_shape.transpose() * (x - self.pose.position)
    }

    fn rounded_at(&self, local: DVec3, edge: f64) -> Surface {
        let Surface { distance, normal } = self.primitive.rounded(local, edge);
        Surface { distance, normal: normal.map(|n| self.to_shape * n) }
    }

    /// The surface as contact on a grid of width `cell` sees it: grown if it is thin, and with rounded edges. What is grown has round edges by that. `None` if it
    /// is found to be further away than `within` [m] without asking for more than the part's box.
    fn contact_surface(&self, x: DVec3, cell: f64, within: f64) -> Option<Surface> {
        let (local, padding) = (self.local(x), self.padding(cell));
        let (middle, half, radius) = self.rounded_box;
        // Sampled distances may be less than that to the box, and a plane has none.
        let has_box = !matches!(self.primitive, Primitive::HeightField(_) | Primitive::Mesh(_) | Primitive::Plane);
        if has_box && ((local - middle).abs() - half).max_element() > within + radius + padding {
            return None;
        }
        Some(self.rounded_at(local, self.edge(cell)).offset(padding))
    }

    /// The radius to which contact on a grid of width `cell` rounds its edges [m].
    fn edge(&self, cell: f64) -> f64 {
        (ROUND * cell - self.padding(cell)).clamp(0.0, self.half_thickness)
    }
}

impl Sdf {
    /// The union of parts.
    pub fn new(parts: Vec<Part>) -> Self {
        Self { parts }
    }

    /// The shape that a tool's entry describes. Files are looked for in `folder`; `path` is the key path for errors.
    ///
    /// # Errors
    /// If a size is not positive and finite, a file is missing or a mesh is not closed.
    pub fn from_shape(shape: &Shape, folder: &Path, path: &str) -> Result<Self> {
        let mut parts = Vec::new();
        collect(shape, &Pose::IDENTITY, folder, path, &mut parts)?;
        Ok(Self { parts })
    }

    /// The parts.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// Distance and normal at `x`, in the shape's frame.
    pub fn surface(&self, x: DVec3) -> Surface {
        self.nearest(|part| Some(part.surface(x))).expect("a shape without parts is refused when it is made").0
    }

    /// Distance and normal of the shape as contact sees it on a grid of width `cell`, and whether `x` lies in the core of a
    /// thin part, which nothing may cross.
    ///
    /// Edges of boxes and cylinders are rounded to a radius of a cell and a half. Parts thinner than two cells are grown to two, or else
    /// nodes would miss them; parts thinner than three have a core, up to 0.75 cells from their middle. A blade driven 10 cells through sand
    /// in a plane prototype let this share of the swept sand through: 92 % if 0.25 cells thick and taken as it is, 15 % if grown to two
    /// cells, at most 0.9 % with a core; 13 % at two cells without a core, 0.8 % with; at most 0.8 % at three.
    pub fn contact_surface(&self, x: DVec3, cell: f64) -> (Surface, bool) {
        self.contact_surface_within(x, cell, f64::INFINITY).expect("a shape has parts, and none is further than that")
    }

    /// The same, but `None` where the surface is further away than `within` [m]: that is told sooner. It may be told where it is a little further, too.
    pub fn contact_surface_within(&self, x: DVec3, cell: f64, within: f64) -> Option<(Surface, bool)> {
        let (surface, part) = self.nearest(|part| part.contact_surface(x, cell, within))?;
        let half = part.half_thickness;
        Some((surface, half < 1.5 * cell && -surface.distance > half.max(cell) - CORE * cell))
    }

    /// How much contact on a grid of width `cell` thickens the shape at most [m].
    pub fn padding(&self, cell: f64) -> f64 {
        self.parts.iter().map(|part| part.padding(cell)).fold(0.0, f64::max)
    }

    fn nearest(&self, surface: impl Fn(&Part) -> Option<Surface>) -> Option<(Surface, &Part)> {
        let all = self.parts.iter().filter_map(|part| Some((surface(part)?, part)));
        all.reduce(|a, b| if b.0.distance < a.0.distance { b } else { a })
    }

    /// A box that holds the shape at `pose`, grown where contact on a grid of width `cell` thickens it.
    pub fn bounds(&self, pose: &Pose, cell: f64) -> Aabb {
        let boxes = self.parts.iter().map(|part| {
            let (middle, half, radius) = part.rounded_box;
            if !half.is_finite() {
                return half_space_bounds(&pose.then(&part.pose));
            }
            let place = pose.then(&part.pose);
            let rotation = DMat3::from_quat(place.rotation);
            let reach =
                rotation.x_axis.abs() * half.x + rotation.y_axis.abs() * half.y + rotation.z_axis.abs() * half.z;
            let centre = place.apply(middle);
            let reach = reach + radius + part.padding(cell);
            Aabb { min: (centre - reach).to_array(), max: (centre + reach).to_array() }
        });
        boxes.reduce(|a, b| a.union(&b)).expect("a shape without parts is refused when it is made")
    }

    /// Greatest distance of a point of the shape's box from its origin [m].
    pub fn extent(&self) -> f64 {
        let bounds = self.bounds(&Pose::IDENTITY, 0.0);
        DVec3::from_array(bounds.min).abs().max(DVec3::from_array(bounds.max).abs()).length()
    }

    /// How far the ends of its [bounds](Self::bounds) move at most for each radian that it turns about its origin [m]: not at all for a sphere about it.
    pub fn swing(&self) -> f64 {
        let of_part = |part: &Part| {
            let (middle, half, _) = part.rounded_box;
            if half.is_finite() { part.pose.apply(middle).length() + half.length() } else { f64::INFINITY }
        };
        self.parts.iter().map(of_part).fold(0.0, f64::max)
    }

    /// Half the thickness of the thinnest part [m].
    pub fn half_thickness(&self) -> f64 {
        self.parts.iter().fold(f64::INFINITY, |t, part| t.min(part.half_thickness))
    }

    /// The narrower side of a part's widest face in cells [m], the least of all parts with sharp edges, if rounding these takes more than a quarter of the force on it.
    pub(crate) fn rounded_face(&self, cell: f64) -> Option<f64> {
        let face = |part: &Part| match part.primitive {
            Primitive::Box { half } => {
                let mut half = half.to_array();
                half.sort_by(f64::total_cmp);
                Some(2.0 * half[1])
            }
            Primitive::Cylinder { radius, half_height } => Some(2.0 * radius.min(half_height)),
            _ => None,
        };
        self.parts.iter().filter_map(face).reduce(f64::min).map(|width| width / cell).filter(|width| *width < FACE)
    }

    /// The same shape in a frame whose origin is at `origin`.
    #[must_use]
    pub fn seen_from(mut self, origin: DVec3) -> Self {
        for part in &mut self.parts {
            part.pose.position -= origin;
        }
        self
    }
}

/// Distance of each point to a shape at a pose [m], as contact on cells of width `cell` [m] sees it.
pub(crate) fn contact_distances(shape: &Sdf, pose: &Pose, cell: f64, points: &[Vec3]) -> Vec<f64> {
    let to_body = pose.rotation.conjugate();
    let distance = |x: &Vec3| shape.contact_surface(to_body * (DVec3::from_array(*x) - pose.position), cell).0.distance;
    points.iter().map(distance).collect()
}

/// Distance of each point to the nearest of some shapes, each at a pose [m]; infinite if there is none.
pub(crate) fn distances(shapes: &[(&Sdf, Pose)], points: &[Vec3]) -> Vec<f64> {
    let nearest = |x: &Vec3| {
        let distances = shapes.iter().map(|(shape, pose)| {
            shape.surface(pose.rotation.conjugate() * (DVec3::from_array(*x) - pose.position)).distance
        });
        distances.fold(f64::INFINITY, f64::min)
    };
    points.iter().map(nearest).collect()
}

impl Part {
    /// How much contact grows this part on every side [m].
    fn padding(&self, cell: f64) -> f64 {
        (cell - self.half_thickness).max(0.0)
    }
}

/// Bounds of the half space below a plane: infinite, but for the side that an axis-aligned normal points to.
fn half_space_bounds(plane: &Pose) -> Aabb {
    let normal = plane.rotation * DVec3::Z;
    let mut bounds = Aabb { min: [f64::NEG_INFINITY; 3], max: [f64::INFINITY; 3] };
    for d in 0..3 {
        if normal[d] > 1.0 - 1e-12 {
            bounds.max[d] = plane.position[d];
        } else if normal[d] < 1e-12 - 1.0 {
            bounds.min[d] = plane.position[d];
        }
    }
    bounds
}

fn positive(value: f64, key: &str) -> Result<f64, Refusal> {
    if value > 0.0 && value.is_finite() {
        Ok(value)
    } else {
        Err(Refusal::new(format!("{key} is {value}"), "give a positive length"))
    }
}

fn finite(value: [f64; 3], key: &str) -> Result<DVec3, Refusal> {
    let v = DVec3::from_array(value);
    if v.is_finite() { Ok(v) } else { Err(Refusal::new(format!("{key} is {value:?}"), "give three finite numbers")) }
}

/// Appends the parts of `shape`, whose frame is at `frame`.
fn collect(shape: &Shape, frame: &Pose, folder: &Path, path: &str, parts: &mut Vec<Part>) -> Result<()> {
    if let Shape::Union(placed) = shape {
        if placed.is_empty() {
            return Err(Refusal::new("the union is empty", "give at least one shape").at(path));
        }
        for (i, part) in placed.iter().enumerate() {
            let path = format!("{path}.union[{i}]");
            let place = placement(part.position, part.rotation).map_err(|refusal| refusal.at(&path))?;
            collect(&part.shape, &frame.then(&place), folder, &format!("{path}.shape"), parts)?;
        }
        return Ok(());
    }
    let made = match shape {
        Shape::Terrain(ground) => terrain::primitives(ground),
        _ => primitive(shape, folder).map(|one| vec![one]),
    };
    let made = made.map_err(|refusal| refusal.at(path))?;
    parts.extend(made.into_iter().map(|(primitive, place)| Part::new(primitive, frame.then(&place))));
    Ok(())
}

fn placement(position: [f64; 3], rotation: [f64; 4]) -> Result<Pose, Refusal> {
    Ok(Pose { position: finite(position, "position")?, rotation: rotation_from(rotation)? })
}

fn primitive(shape: &Shape, folder: &Path) -> Result<(Primitive, Pose), Refusal> {
    let at = |centre: DVec3| Pose { position: centre, ..Pose::IDENTITY };
    Ok(match shape {
        Shape::Box { min, max, half, center } => {
            let (centre, half) = match (min, max, half) {
                (None, None, Some(half)) => (finite(center.unwrap_or_default(), "center")?, finite(*half, "half")?),
                (Some(min), Some(max), None) if center.is_none() => {
                    let (min, max) = (finite(*min, "min")?, finite(*max, "max")?);
                    (0.5 * (min + max), 0.5 * (max - min))
                }
                _ => {
                    return Err(Refusal::new(
                        "the box's size is unclear",
                        "give either half (and center), or min and max",
                    ));
                }
            };
            for d in 0..3 {
                positive(half[d], "half the box's side")?;
            }
            (Primitive::Box { half }, at(centre))
        }
        Shape::Sphere { center, radius } => {
            (Primitive::Sphere { radius: positive(*radius, "radius")? }, at(finite(*center, "center")?))
        }
        Shape::Cylinder { center, radius, half_height } => {
            let (radius, half_height) = (positive(*radius, "radius")?, positive(*half_height, "half_height")?);
            (Primitive::Cylinder { radius, half_height }, at(finite(*center, "center")?))
        }
        Shape::Capsule { center, radius, half_height } => {
            let (radius, half_height) = (positive(*radius, "radius")?, positive(*half_height, "half_height")?);
            (Primitive::Capsule { radius, half_height }, at(finite(*center, "center")?))
        }
        Shape::Plane { point, normal } => {
            let normal = finite(*normal, "normal")?
                .try_normalize()
                .ok_or_else(|| Refusal::new("the plane's normal is zero", "give a vector with a direction"))?;
            let rotation = glam::DQuat::from_rotation_arc(DVec3::Z, normal);
            (Primitive::Plane, Pose { position: finite(*point, "point")?, rotation })
        }
        Shape::HeightField { min, max, bottom, heights, file } => {
            let heights = match file {
                Some(file) => read_heights(&folder.join(file))?,
                None => heights.clone(),
            };
            let field = HeightField { min: *min, max: *max, bottom: *bottom, heights };
            field.check()?;
            (Primitive::HeightField(Arc::new(field)), Pose::IDENTITY)
        }
        Shape::Mesh { file, scale, center, rotation } => {
            let mesh = TriangleMesh::read(&folder.join(file), *scale)?;
            let grid = DistanceGrid::sample(&mesh);
            (Primitive::Mesh(Arc::new(MeshPart { mesh, grid })), placement(*center, *rotation)?)
        }
        Shape::Difference(_) | Shape::Intersection(_) => {
            return Err(Refusal::new(
                "differences and intersections are for soft bodies",
                "use a union of shapes or a mesh",
            ));
        }
        Shape::Union(_) | Shape::Terrain(_) => {
            unreachable!("`collect`, the only caller, takes unions and terrains apart before")
        }
    })
}

impl HeightField {
    pub(crate) fn check(&self) -> Result<(), Refusal> {
        let columns = self.heights.first().map_or(0, Vec::len);
        if self.heights.len() < 2 || columns < 2 || self.heights.iter().any(|row| row.len() != columns) {
            return Err(Refusal::new(
                "the height field's rows are too few or unlike",
                "give at least 2 rows of equal length, 2 or more",
            ));
        }
        if !(0..2).all(|d| self.min[d] < self.max[d] && (self.max[d] - self.min[d]).is_finite()) {
            return Err(Refusal::new("the height field has no area", "give min below max"));
        }
        match self.heights.iter().flatten().find(|h| !(h.is_finite() && **h > self.bottom)) {
            Some(h) => {
                Err(Refusal::new(format!("a height is {h}, with the bottom at {}", self.bottom), "lower the bottom"))
            }
            None => Ok(()),
        }
    }
}

fn read_heights(file: &Path) -> Result<Vec<Vec<f64>>, Refusal> {
    let text = std::fs::read_to_string(file).map_err(|e| {
        Refusal::new(format!("{}: {e}", file.display()), "give a CSV file with one row of heights per line")
    })?;
    let rows = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()).map(|(i, line)| {
        line.split(',').map(|number| number.trim().parse()).collect::<Result<Vec<f64>, _>>().map_err(|e| {
            Refusal::new(format!("{}:{}: {e}", file.display(), i + 1), "write numbers with commas between")
        })
    });
    rows.collect()
}
