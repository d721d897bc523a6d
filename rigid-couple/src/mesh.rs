//! Closed triangle meshes: reading, checking, sampled distance, and as solids to seed soft bodies from.

use crate::Refusal;
use crate::sdf::{Surface, four};
use barchan_core::coupling::Aabb;
use barchan_core::solid::Solid;
use glam::{DMat3, DVec3};
use parry3d_f64::query::PointQuery;
use parry3d_f64::shape::{TriMesh, TriMeshFlags};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// A closed triangle mesh whose triangles wind anticlockwise seen from outside.
#[derive(Clone, Debug)]
pub struct TriangleMesh {
    vertices: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
}

/// Longest and shortest longest side that a mesh may have [m]: products of lengths stay numbers in between.
const LARGEST: f64 = 1e9;
const SMALLEST: f64 = 1e-9;
/// Vertices of a mesh that is not closed are joined if they are the same to so much of its longest side.
const ROUNDED: f64 = 1e-6;

impl TriangleMesh {
    /// Joins equal vertices, drops triangles that have two corners in common, and checks what is left. Where that is not closed, vertices that are the same to a millionth of
    /// the mesh's longest side are joined, too: what sweeps a full turn ends beside where it began.
    ///
    /// # Errors
    /// If the mesh is empty, not finite, not closed, inside out, or of a size that nothing on Earth has; the first offending edge is named.
    pub fn new(corners: impl IntoIterator<Item = [DVec3; 3]>) -> Result<Self, Refusal> {
        let corners: Vec<[DVec3; 3]> = corners.into_iter().collect();
        let all = || corners.iter().flatten();
        if let Some(bad) = all().find(|x| !x.is_finite()) {
            let what = format!("a vertex is at {bad}");
            return Err(Refusal::new(what, "repair the file: coordinates must be finite"));
        }
        let mut known = HashMap::new();
        let exact = Self::joined(&corners, |x, next, _| {
            // Adding zero turns -0 into 0, which is the same place with other bits.
            *known.entry((x + DVec3::ZERO).to_array().map(f64::to_bits)).or_insert(next)
        });
        let Err(refusal) = exact.check() else { return Ok(exact) };
        let ends = all().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), x| (low.min(*x), high.max(*x)));
        let near = ROUNDED * (ends.1 - ends.0).max_element();
        let mut cells: HashMap<[i64; 3], u32> = HashMap::new();
        let rounded = Self::joined(&corners, |x, next, vertices| {
            let cell = ((x - ends.0) / near).floor().to_array().map(|c| c as i64);
            let around = (0..27).map(|n: i64| [n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1]);
            let beside = around.filter_map(|by| cells.get(&std::array::from_fn(|d| cell[d] + by[d])));
            let found = beside.copied().find(|one| vertices[*one as usize].distance(x) <= near);
            found.unwrap_or_else(|| *cells.entry(cell).or_insert(next))
        });
        if rounded.check().is_ok() { Ok(rounded) } else { Err(refusal) }
    }

    /// `vertex_of` says which vertex a corner is, from where it is, the next new one's number, and those that there are.
    fn joined(corners: &[[DVec3; 3]], mut vertex_of: impl FnMut(DVec3, u32, &[DVec3]) -> u32) -> Self {
        let mut mesh = Self { vertices: Vec::new(), triangles: Vec::new() };
        for triangle in corners {
            let triangle = triangle.map(|x| {
                let next = mesh.vertices.len() as u32;
                let vertex = vertex_of(x, next, &mesh.vertices);
                if vertex == next {
                    mesh.vertices.push(x);
                }
                vertex
            });
            if triangle[0] != triangle[1] && triangle[1] != triangle[2] && triangle[2] != triangle[0] {
                mesh.triangles.push(triangle);
            }
        }
        mesh
    }

    /// Reads an OBJ, STL or DAE file; `scale` takes the file's unit to metres.
    ///
    /// # Errors
    /// If the file cannot be read, the scale is not positive, or [`Self::new`] refuses the mesh.
    pub fn read(file: &Path, scale: f64) -> Result<Self, Refusal> {
        if !(scale > 0.0 && scale.is_finite()) {
            let mend = "give a positive factor; a negative one would turn the mesh inside out";
            return Err(Refusal::new(format!("the mesh's scale is {scale}"), mend));
        }
        Triangles::read(file, DVec3::splat(scale))?.mesh()
    }

    fn check(&self) -> Result<(), Refusal> {
        if self.triangles.is_empty() {
            return Err(Refusal::new("the mesh has no triangles", "export it with its faces"));
        }
        let mut edges: BTreeMap<[u32; 2], u32> = BTreeMap::new();
        for t in &self.triangles {
            for edge in [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]] {
                *edges.entry(edge).or_default() += 1;
            }
        }
        let place = |&[a, b]: &[u32; 2]| format!("{} - {}", self.vertices[a as usize], self.vertices[b as usize]);
        if let Some((edge, _)) = edges.iter().find(|(_, count)| **count > 1) {
            let what =
                format!("the mesh is not a surface: two triangles run the same way along the edge {}", place(edge));
            return Err(Refusal::new(what, "make all faces wind alike and no two share one place, then export again"));
        }
        if let Some((edge, _)) = edges.iter().find(|([a, b], _)| !edges.contains_key(&[*b, *a])) {
            let what = format!("the mesh is not closed: the edge {} belongs to one triangle only", place(edge));
            return Err(Refusal::new(what, "close the hole, or join vertices that should be one, then export again"));
        }
        let (min, max) = self.bounds();
        let side = (max - min).max_element();
        if !(SMALLEST..=LARGEST).contains(&side) {
            return Err(Refusal::new(
                format!("the mesh's longest side is {side:e} m"),
                "export it in another unit, or set its scale, which takes the file's unit to metres",
            ));
        }
        if self.corners().map(|[a, b, c]| a.dot(b.cross(c))).sum::<f64>() <= 0.0 {
            let edge = [self.triangles[0][0], self.triangles[0][1]];
            let what = format!("the mesh is inside out: its triangles face inwards, from the edge {} on", place(&edge));
            return Err(Refusal::new(what, "flip the faces, then export again"));
        }
        Ok(())
    }

    /// The triangles' corners [m].
    pub fn corners(&self) -> impl Iterator<Item = [DVec3; 3]> {
        self.triangles.iter().map(|t| t.map(|i| self.vertices[i as usize]))
    }

    /// Vertices [m] and the triangles between them.
    pub fn parts(&self) -> (&[DVec3], &[[u32; 3]]) {
        (&self.vertices, &self.triangles)
    }

    /// Least and greatest corner of the box that holds the mesh [m].
    pub fn bounds(&self) -> (DVec3, DVec3) {
        self.vertices.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), x| (a.min(*x), b.max(*x)))
    }

    /// The mesh with what exact distance queries need.
    fn queries(&self) -> TriMesh {
        TriMesh::with_flags(self.vertices.clone(), self.triangles.clone(), TriMeshFlags::ORIENTED)
            .expect("a mesh that is not a closed surface is refused when it is made")
    }
}

/// The triangles of a file in metres, which need not be closed.
#[derive(Debug)]
pub(crate) struct Triangles<'a> {
    file: &'a Path,
    corners: Vec<[DVec3; 3]>,
}

impl<'a> Triangles<'a> {
    /// Reads an OBJ, STL or DAE file; `scale` takes the file's unit to metres along each axis. What it mirrors is turned so that triangles face outwards again.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub(crate) fn read(file: &'a Path, scale: DVec3) -> Result<Self, Refusal> {
        let mirrored = scale.x * scale.y * scale.z < 0.0;
        let all = coloured_corners(file)?.into_iter().flat_map(|(_, corners)| corners);
        let corners = all.map(|corners| {
            let [a, b, c] = corners.map(|x| x * scale);
            if mirrored { [a, c, b] } else { [a, b, c] }
        });
        Ok(Self { file, corners: corners.collect() })
    }

    /// The mesh that they are.
    ///
    /// # Errors
    /// If [`TriangleMesh::new`] refuses it.
    pub(crate) fn mesh(&self) -> Result<TriangleMesh, Refusal> {
        TriangleMesh::new(self.corners.iter().copied()).map_err(|refusal| self.of_file("", refusal))
    }

    /// Their convex hull.
    ///
    /// # Errors
    /// If their points lie in a plane.
    pub(crate) fn hull(&self) -> Result<TriangleMesh, Refusal> {
        let points = self.corners.as_flattened();
        let flat = |what: &str| self.of_file("", Refusal::new(what, "give a mesh with a volume"));
        if points.len() < 4 || !points.iter().all(|x| x.is_finite()) {
            return Err(flat("it has fewer than four points, or some that are not finite"));
        }
        // Parry panics where points have no hull.
        let hull = std::panic::catch_unwind(|| parry3d_f64::transformation::convex_hull(points));
        let (vertices, triangles) = hull.map_err(|_| flat("its points have no convex hull"))?;
        TriangleMesh::new(triangles.into_iter().map(|t| t.map(|i| vertices[i as usize])))
            .map_err(|refusal| self.of_file("its convex hull: ", refusal))
    }

    fn of_file(&self, part: &str, refusal: Refusal) -> Refusal {
        Refusal { what: format!("{}: {part}{}", self.file.display(), refusal.what), ..refusal }
    }
}

/// Triangles by their corners, and their colour if the file says one: sRGB from 0 to 1.
type Coloured = (Option<[f32; 3]>, Vec<[DVec3; 3]>);

/// The corners of a file's triangles, in its own unit, by colour. They need not be closed.
pub(crate) fn coloured_corners(file: &Path) -> Result<Vec<Coloured>, Refusal> {
    let unreadable = |e: &dyn std::fmt::Display| {
        Refusal::new(format!("{}: {e}", file.display()), "give the path of an OBJ, STL or DAE file")
    };
    let kind = file.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match kind.as_str() {
        "obj" => read_obj(file).map(|corners| vec![(None, corners)]).map_err(|e| unreadable(&e)),
        "stl" => read_stl(file).map(|corners| vec![(None, corners)]).map_err(|e| unreadable(&e)),
        "dae" => read_dae(file).map_err(|e| unreadable(&e)),
        _ => Err(unreadable(&"the file's name ends in none of .obj, .stl and .dae")),
    }
}

/// A COLLADA file, in metres and with z up.
fn read_dae(file: &Path) -> std::io::Result<Vec<Coloured>> {
    let scene = mesh_loader::Loader::default().load(file)?;
    let parts = scene.meshes.iter().enumerate().map(|(i, mesh)| {
        let at = |i: u32| glam::Vec3::from_array(mesh.vertices[i as usize]).as_dvec3();
        // The reader gives a material for each mesh.
        let colour = scene.materials.get(i).and_then(|material| material.color.diffuse);
        let rgb = colour.map(|[r, g, b, _]| [r, g, b].map(|c| c.clamp(0.0, 1.0)));
        (rgb, mesh.faces.iter().map(|face| face.map(at)).collect())
    });
    Ok(parts.collect())
}

fn read_obj(file: &Path) -> Result<Vec<[DVec3; 3]>, tobj::LoadError> {
    let options =
        tobj::LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    // Materials do not matter here, so a missing .mtl file is none of our business.
    let (models, _) = tobj::load_obj(file, &options)?;
    let corners = models.iter().flat_map(|model| {
        let at = |i: u32| DVec3::from_slice(&model.mesh.positions[3 * i as usize..]);
        model.mesh.indices.chunks_exact(3).map(move |t| [at(t[0]), at(t[1]), at(t[2])])
    });
    Ok(corners.collect())
}

fn read_stl(file: &Path) -> std::io::Result<Vec<[DVec3; 3]>> {
    let mut reader = std::io::BufReader::new(std::fs::File::open(file)?);
    let triangles = stl_io::create_stl_reader(&mut reader).map_err(std::io::Error::other)?;
    triangles
        .map(|t| t.map(|t| t.vertices.map(|x| glam::Vec3::from_array(x.0).as_dvec3())).map_err(std::io::Error::other))
        .collect()
}

fn lerp(a: f64, b: f64, t: f64) -> f64 {
    a + t * (b - a)
}

/// Signed distance sampled on a grid around a mesh, trilinear between.
#[derive(Clone, Debug)]
pub struct DistanceGrid {
    origin: DVec3,
    spacing: f64,
    size: [usize; 3],
    values: Vec<f64>,
}

/// Samples along the mesh's longest side. The error is second order in their spacing, and none beside flat faces.
const SAMPLES: f64 = 64.0;
/// Samples beyond the mesh on each side.
const MARGIN: f64 = 2.0;

impl DistanceGrid {
    /// Samples the exact distance of `mesh` at about 64 points along its longest side.
    pub fn sample(mesh: &TriangleMesh) -> Self {
        let (min, max) = mesh.bounds();
        let spacing = (max - min).max_element() / SAMPLES;
        let origin = min - MARGIN * spacing;
        let size = ((max - min) / spacing + 2.0 * MARGIN).to_array().map(|n| n.ceil() as usize + 1);
        let queries = mesh.queries();
        let mut grid = Self { origin, spacing, size, values: vec![0.0; size.iter().product()] };
        let slab = size[0] * size[1];
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let slabs_each = size[2].div_ceil(threads);
        std::thread::scope(|scope| {
            for (part, values) in grid.values.chunks_mut(slab * slabs_each).enumerate() {
                let queries = &queries;
                scope.spawn(move || {
                    for (n, value) in values.iter_mut().enumerate() {
                        let n = n + part * slab * slabs_each;
                        let cell = [n % size[0], n / size[0] % size[1], n / slab].map(|i| i as f64);
                        let x = origin + spacing * DVec3::from_array(cell);
                        let projection = queries.project_local_point(x, false);
                        let distance = projection.point.distance(x);
                        *value = if projection.is_inside { -distance } else { distance };
                    }
                });
            }
        });
        grid
    }

    /// The place within the grid that is nearest to `x`, and 1 along each axis along which that is `x` itself, else 0.
    pub(crate) fn nearest(&self, x: DVec3) -> (DVec3, DVec3) {
        let end = self.origin + self.spacing * DVec3::from_array(self.size.map(|n| (n - 1) as f64));
        let at = x.clamp(self.origin, end);
        (at, DVec3::from_array(std::array::from_fn(|d| if at[d] == x[d] { 1.0 } else { 0.0 })))
    }

    /// The eight samples around a place, and the place between them, 0 to 1 along each axis; of one outside the grid, of the nearest place within it.
    fn around(&self, x: DVec3) -> ([[[f64; 2]; 2]; 2], DVec3, DVec3) {
        let last = DVec3::from_array(self.size.map(|n| (n - 1) as f64));
        let s = ((x - self.origin) / self.spacing).clamp(DVec3::ZERO, last);
        let cell: [usize; 3] = std::array::from_fn(|d| (s[d] as usize).min(self.size[d] - 2));
        let f = s - DVec3::from_array(cell.map(|i| i as f64));
        let (stride_y, stride_z) = (self.size[0], self.size[0] * self.size[1]);
        let corner = cell[0] + cell[1] * stride_y + cell[2] * stride_z;
        let value = |i: usize, j: usize, k: usize| self.values[corner + i + j * stride_y + k * stride_z];
        let values = [0, 1].map(|k| [0, 1].map(|j| [0, 1].map(|i| value(i, j, k))));
        (values, f, s)
    }

    /// Distance and normal at `x`. Outside the grid: the distance to the grid plus the value there.
    pub fn surface(&self, x: DVec3) -> Surface {
        let (v, f, s) = self.around(x);
        // Values and x-slopes on the four edges along x, then across y, then across z.
        let edge = |j: usize, k: usize| lerp(v[k][j][0], v[k][j][1], f.x);
        let rise = |j: usize, k: usize| v[k][j][1] - v[k][j][0];
        let face = |k| lerp(edge(0, k), edge(1, k), f.y);
        let at_grid = lerp(face(0), face(1), f.z);
        let gradient = DVec3::new(
            lerp(lerp(rise(0, 0), rise(1, 0), f.y), lerp(rise(0, 1), rise(1, 1), f.y), f.z),
            lerp(edge(1, 0) - edge(0, 0), edge(1, 1) - edge(0, 1), f.z),
            face(1) - face(0),
        ) / self.spacing;
        // Where branches of the distance meet, the interpolated slope falls short of one and its direction means little.
        let slope = gradient.length();
        let normal = (slope > 0.3).then(|| gradient / slope);
        let beyond = x - (self.origin + self.spacing * s);
        let gap = beyond.length();
        if gap > 1e-9 * self.spacing {
            let normal = (beyond + at_grid * normal.unwrap_or_default()).try_normalize();
            return Surface { distance: at_grid + gap, normal };
        }
        Surface { distance: at_grid, normal }
    }

    /// The distance at a place within the grid [m], its gradient, and how that changes, a row for each of its components [1/m].
    pub(crate) fn derivatives(&self, x: DVec3) -> (f64, DVec3, DMat3) {
        let (v, f, _) = self.around(x);
        // Sums over the corners of the weight along each axis that is kept, and of the sign along each that is differentiated.
        let sum = |along: [bool; 3]| {
            let factor = |d: usize, end: usize| match (along[d], end) {
                (true, 0) => -1.0 / self.spacing,
                (true, _) => 1.0 / self.spacing,
                (false, 0) => 1.0 - f[d],
                (false, _) => f[d],
            };
            let corner = |n: usize| {
                let [i, j, k] = [n % 2, n / 2 % 2, n / 4];
                factor(0, i) * factor(1, j) * factor(2, k) * v[k][j][i]
            };
            (0..8).map(corner).sum::<f64>()
        };
        let axes = |a: usize, b: usize| std::array::from_fn(|d| d == a || d == b);
        let gradient = DVec3::from_array(std::array::from_fn(|d| sum(axes(d, d))));
        let [xy, xz, yz] = [sum(axes(0, 1)), sum(axes(0, 2)), sum(axes(1, 2))];
        let second = DMat3::from_cols_array_2d(&[[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]]);
        (sum([false; 3]), gradient, second)
    }

    /// As `sampled.wgsl` reads it, from the point `centre` on.
    pub fn packed(&self, centre: DVec3) -> Vec<[f32; 4]> {
        let origin = (self.origin - centre).as_vec3();
        let size = self.size.map(|n| n as f32);
        let head = [[origin.x, origin.y, origin.z, self.spacing as f32], [size[0], size[1], size[2], 0.0]];
        head.into_iter().chain(self.values.chunks(4).map(four)).collect()
    }

    /// Greatest depth inside [m]: the radius of the largest ball that fits.
    pub fn depth(&self) -> f64 {
        -self.values.iter().fold(f64::INFINITY, |a, &b| a.min(b))
    }
}

/// A mesh as a region of space, by exact point queries.
pub struct MeshSolid {
    queries: TriMesh,
    bounds: Aabb,
}

impl MeshSolid {
    /// The inside of `mesh`.
    pub fn new(mesh: &TriangleMesh) -> Self {
        let (min, max) = mesh.bounds();
        Self { queries: mesh.queries(), bounds: Aabb { min: min.to_array(), max: max.to_array() } }
    }
}

impl Solid for MeshSolid {
    fn bounds(&self) -> Aabb {
        self.bounds
    }
    fn contains(&self, x: barchan_core::Vec3) -> bool {
        self.bounds.contains(x) && self.queries.project_local_point(DVec3::from_array(x), false).is_inside
    }
}
