//! Solids that soft bodies are seeded from.

use crate::coupling::Aabb;
use crate::scene::{Heights, Placed, Shape, posed_bounds, turn};
use crate::{Error, Registry, Result, Scene, Vec3};
use std::path::Path;

/// A region of space.
pub trait Solid: Send + Sync {
    /// A box that holds it.
    fn bounds(&self) -> Aabb;
    /// Is the point inside?
    fn contains(&self, x: Vec3) -> bool;
    /// Whether all points of a box are inside (`Some(true)`), or none (`Some(false)`). `None`: unknown, so points have
    /// to be tried.
    fn cover(&self, region: &Aabb) -> Option<bool> {
        if region.meets(&self.bounds()) { None } else { Some(false) }
    }
    /// Lower and upper end of the solid above a point of the ground plan [m]. `None`: nothing is there, or it is not in
    /// one piece.
    fn column(&self, _x: f64, _y: f64) -> Option<[f64; 2]> {
        None
    }
    /// The same where it may be in several pieces.
    fn columns(&self, x: f64, y: f64) -> Vec<[f64; 2]> {
        self.column(x, y).into_iter().collect()
    }
    /// Heights between which the upper ends of [`column`](Self::column) lie over a rectangle [m]. `None`: unknown.
    fn surface(&self, _min: [f64; 2], _max: [f64; 2]) -> Option<[f64; 2]> {
        None
    }
}

/// [`Solid::cover`] of all in a box that lies below a surface.
fn layer_cover(solid: &impl Solid, region: &Aabb) -> Option<bool> {
    let (bounds, Aabb { min, max }) = (solid.bounds(), region);
    if !region.meets(&bounds) {
        return Some(false);
    }
    let [low, high] = solid.surface([min[0], min[1]], [max[0], max[1]])?;
    if high < min[2] {
        return Some(false);
    }
    (max[2] <= low && bounds.contains(*min) && bounds.contains(*max)).then_some(true)
}

/// [`Solid::cover`] of a convex solid: it holds a box if it holds its corners.
fn cover_convex(solid: &dyn Solid, region: &Aabb) -> Option<bool> {
    let corner = |i: usize| std::array::from_fn(|d| if i >> d & 1 == 0 { region.min[d] } else { region.max[d] });
    if !region.meets(&solid.bounds()) {
        return Some(false);
    }
    (0..8).all(|i| solid.contains(corner(i))).then_some(true)
}

/// The solid of a soft body's shape, world frame; `path` is the shape's key path.
///
/// # Errors
/// If the shape cannot be filled, a file cannot be read, or the shape is a mesh and no reader of meshes is registered.
pub fn of_shape(shape: &Shape, scene: &Scene, registry: &Registry, path: &str) -> Result<Box<dyn Solid>> {
    let bounds = shape.bounds();
    Ok(match (shape, bounds) {
        (Shape::Box { .. }, Some(bounds)) => Box::new(Cuboid(bounds)),
        (Shape::Sphere { center, radius }, Some(bounds)) => {
            Box::new(Round { bounds, center: *center, radius: *radius, half: 0.0, capped: true })
        }
        (Shape::Cylinder { center, radius, half_height }, Some(bounds)) => {
            Box::new(Round { bounds, center: *center, radius: *radius, half: *half_height, capped: false })
        }
        (Shape::Capsule { center, radius, half_height }, Some(bounds)) => {
            Box::new(Round { bounds, center: *center, radius: *radius, half: *half_height, capped: true })
        }
        (Shape::HeightField { min, max, bottom, heights, file }, _) => {
            let heights = match file {
                None => heights.clone(),
                Some(file) => {
                    let heights = read_heights(&scene.folder.join(file))?;
                    scene.check_heights(&format!("{path}.height_field.file"), &heights, *bottom)?;
                    heights
                }
            };
            let top = heights.iter().flatten().copied().fold(*bottom, f64::max);
            Box::new(HeightField { min: *min, max: *max, bottom: *bottom, top, heights })
        }
        (Shape::Terrain(terrain), Some(bounds)) => Box::new(Landscape { bounds, heights: terrain.heights() }),
        (Shape::Mesh { file, scale, center, rotation }, _) => {
            let reader = registry.mesh_reader().ok_or_else(|| {
                scene.fault(path, "nothing registered reads meshes", "register a crate that does, or use another shape")
            })?;
            let solid = reader(&scene.folder.join(file), *scale).map_err(|error| match error {
                Error::Body { what, mend, .. } => scene.fault(&format!("{path}.mesh"), what, mend),
                other => other,
            })?;
            Box::new(Posed { solid, position: *center, rotation: *rotation })
        }
        (Shape::Union(parts), _) => Box::new(Combined::new(How::Union, parts, scene, registry, path)?),
        (Shape::Difference(parts), _) => Box::new(Combined::new(How::Difference, parts, scene, registry, path)?),
        (Shape::Intersection(parts), _) => Box::new(Combined::new(How::Intersection, parts, scene, registry, path)?),
        _ => return Err(scene.fault(path, "cannot be filled with particles", "planes are for tools")),
    })
}

/// As [`of_shape`], cut at the world's sides if the scene [clips](Scene::clip) or is in plane strain.
///
/// # Errors
/// As [`of_shape`].
pub fn in_world(shape: &Shape, scene: &Scene, registry: &Registry, path: &str) -> Result<Box<dyn Solid>> {
    let solid = of_shape(shape, scene, registry, path)?;
    let (world, bounds) = (scene.world_box(), solid.bounds());
    let cuts = scene.clip || scene.world.plane_strain.is_some();
    if !cuts || world.contains(bounds.min) && world.contains(bounds.max) {
        return Ok(solid);
    }
    scene.check_inside(path.trim_end_matches(".shape"), bounds)?;
    Ok(Box::new(Combined { how: How::Intersection, parts: vec![solid, Box::new(Cuboid(world))] }))
}

/// How solids are put together.
#[derive(Clone, Copy)]
enum How {
    Union,
    /// The first without the others.
    Difference,
    Intersection,
}

/// Solids put together: at least one.
struct Combined {
    how: How,
    parts: Vec<Box<dyn Solid>>,
}

impl Combined {
    fn new(how: How, parts: &[Placed], scene: &Scene, registry: &Registry, path: &str) -> Result<Self> {
        let key = match how {
            How::Union => "union",
            How::Difference => "difference",
            How::Intersection => "intersection",
        };
        let part = |(i, part): (usize, &Placed)| -> Result<Box<dyn Solid>> {
            let solid = of_shape(&part.shape, scene, registry, &format!("{path}.{key}[{i}].shape"))?;
            Ok(Box::new(Posed { solid, position: part.position, rotation: part.rotation }))
        };
        Ok(Self { how, parts: parts.iter().enumerate().map(part).collect::<Result<_>>()? })
    }
}

impl Solid for Combined {
    fn bounds(&self) -> Aabb {
        let first = self.parts[0].bounds();
        let others = self.parts[1..].iter().map(|part| part.bounds());
        match self.how {
            How::Union => others.fold(first, |all, one| all.union(&one)),
            How::Difference => first,
            How::Intersection => others.fold(first, |all, one| all.intersection(&one)),
        }
    }
    fn contains(&self, x: Vec3) -> bool {
        let mut parts = self.parts.iter().map(|part| part.contains(x));
        match self.how {
            How::Union => parts.any(|inside| inside),
            How::Difference => parts.next() == Some(true) && !parts.any(|inside| inside),
            How::Intersection => parts.all(|inside| inside),
        }
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        let mut covers: Vec<Option<bool>> = self.parts.iter().map(|part| part.cover(region)).collect();
        if let How::Difference = self.how {
            covers[1..].iter_mut().for_each(|cover| *cover = cover.map(|all| !all));
        }
        // One part decides a union if it holds all of the region, and the others if it holds nothing.
        let decides = matches!(self.how, How::Union);
        if covers.contains(&Some(decides)) {
            return Some(decides);
        }
        covers.iter().all(|cover| *cover == Some(!decides)).then_some(!decides)
    }
    fn columns(&self, x: f64, y: f64) -> Vec<[f64; 2]> {
        // What is cut at the world's sides stays a layer; other intersections need not be in one piece.
        match self.how {
            How::Intersection => {
                let cut = |[a, b]: [f64; 2], [c, d]: [f64; 2]| [a.max(c), b.min(d)];
                let pieces = self.parts.iter().map(|part| part.column(x, y)).reduce(|a, b| Some(cut(a?, b?)));
                pieces.flatten().filter(|[bottom, top]| bottom < top).into_iter().collect()
            }
            _ => Vec::new(),
        }
    }
    fn column(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        self.columns(x, y).first().copied()
    }
}

struct Cuboid(Aabb);

impl Solid for Cuboid {
    fn bounds(&self) -> Aabb {
        self.0
    }
    fn contains(&self, x: Vec3) -> bool {
        self.0.contains(x)
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        cover_convex(self, region)
    }
    fn column(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let Aabb { min, max } = self.0;
        (min[0] <= x && x <= max[0] && min[1] <= y && y <= max[1]).then_some([min[2], max[2]])
    }
    fn surface(&self, _min: [f64; 2], _max: [f64; 2]) -> Option<[f64; 2]> {
        Some([self.0.max[2]; 2])
    }
}

/// Sphere, cylinder or capsule along z.
struct Round {
    bounds: Aabb,
    center: Vec3,
    radius: f64,
    half: f64,
    /// Ends are half spheres, not flat.
    capped: bool,
}

impl Solid for Round {
    fn bounds(&self) -> Aabb {
        self.bounds
    }
    fn contains(&self, x: Vec3) -> bool {
        let [dx, dy, dz]: Vec3 = std::array::from_fn(|d| x[d] - self.center[d]);
        let beyond = (dz.abs() - self.half).max(0.0);
        dx * dx + dy * dy + beyond * beyond <= self.radius * self.radius && (self.capped || beyond == 0.0)
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        cover_convex(self, region)
    }
}

struct HeightField {
    min: [f64; 2],
    max: [f64; 2],
    bottom: f64,
    /// The greatest height.
    top: f64,
    heights: Vec<Vec<f64>>,
}

impl HeightField {
    /// Bilinear height at a point inside `min` to `max` [m].
    fn height(&self, x: f64, y: f64) -> f64 {
        let at = |value: f64, d: usize, count: usize| {
            let u = (value - self.min[d]) / (self.max[d] - self.min[d]) * (count - 1) as f64;
            let i = (u as usize).min(count - 2);
            (i, u - i as f64)
        };
        let (i, s) = at(x, 0, self.heights[0].len());
        let (j, t) = at(y, 1, self.heights.len());
        let row = |j: usize| self.heights[j][i] * (1.0 - s) + self.heights[j][i + 1] * s;
        row(j) * (1.0 - t) + row(j + 1) * t
    }
}

impl Solid for HeightField {
    fn bounds(&self) -> Aabb {
        Aabb { min: [self.min[0], self.min[1], self.bottom], max: [self.max[0], self.max[1], self.top] }
    }
    fn contains(&self, x: Vec3) -> bool {
        self.column(x[0], x[1]).is_some_and(|[bottom, top]| bottom <= x[2] && x[2] <= top)
    }
    fn column(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let [min, max] = [self.min, self.max];
        (min[0] <= x && x <= max[0] && min[1] <= y && y <= max[1]).then(|| [self.bottom, self.height(x, y)])
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        layer_cover(self, region)
    }
    fn surface(&self, min: [f64; 2], max: [f64; 2]) -> Option<[f64; 2]> {
        // Bilinear heights over a rectangle lie between those of the grid points around it.
        let counts = [self.heights[0].len(), self.heights.len()];
        let range: [(usize, usize); 2] = std::array::from_fn(|d| {
            let at = |x: f64| (x - self.min[d]) / (self.max[d] - self.min[d]) * (counts[d] - 1) as f64;
            let last = counts[d] - 1;
            ((at(min[d]).max(0.0) as usize).min(last), (at(max[d]).ceil() as usize).min(last))
        });
        let rows = self.heights[range[1].0..=range[1].1].iter();
        let around = rows.flat_map(|row| &row[range[0].0..=range[0].1]);
        Some(around.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], z| [low.min(*z), high.max(*z)]))
    }
}

/// Everything in a box that lies below a surface.
struct Landscape {
    bounds: Aabb,
    heights: Heights,
}

impl Solid for Landscape {
    fn bounds(&self) -> Aabb {
        self.bounds
    }
    fn contains(&self, x: Vec3) -> bool {
        self.bounds.contains(x) && x[2] <= self.heights.at(x[0], x[1])
    }
    fn column(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let Aabb { min, max } = self.bounds;
        let inside = min[0] <= x && x <= max[0] && min[1] <= y && y <= max[1];
        inside.then(|| [min[2], self.heights.at(x, y)]).filter(|[bottom, top]| bottom < top)
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        layer_cover(self, region)
    }
    fn surface(&self, min: [f64; 2], max: [f64; 2]) -> Option<[f64; 2]> {
        Some(self.heights.within(min, max))
    }
}

/// A solid turned about its origin, then moved.
struct Posed {
    solid: Box<dyn Solid>,
    position: Vec3,
    rotation: [f64; 4],
}

impl Solid for Posed {
    fn bounds(&self) -> Aabb {
        posed_bounds(self.solid.bounds(), self.position, self.rotation)
    }
    fn contains(&self, x: Vec3) -> bool {
        let [w, i, j, k] = self.rotation;
        self.solid.contains(turn([w, -i, -j, -k], std::array::from_fn(|d| x[d] - self.position[d])))
    }
}

/// Reads rows of numbers separated by commas, semicolons or blanks; `#` starts a comment.
fn read_heights(file: &Path) -> Result<Vec<Vec<f64>>> {
    let text = std::fs::read_to_string(file).map_err(|source| Error::Io {
        file: file.to_owned(),
        what: "reading heights",
        source,
    })?;
    let mut rows = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let data = line.split('#').next().unwrap_or_default();
        let fields = data.split([',', ';', ' ', '\t']).filter(|field| !field.is_empty());
        let row = fields
            .map(|field| {
                field.parse().map_err(|_| Error::Scene {
                    file: file.display().to_string(),
                    line: i + 1,
                    path: "heights".to_owned(),
                    what: format!("`{field}` is no number"),
                    allowed: Some("write rows of heights in metres, separated by commas".to_owned()),
                })
            })
            .collect::<Result<Vec<f64>>>()?;
        if !row.is_empty() {
            rows.push(row);
        }
    }
    Ok(rows)
}
