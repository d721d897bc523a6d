//! Fills soft bodies with particles.

use crate::plan::{PlannedMaterial, Precision};
use crate::scene::{Body, Sampling, Scene, Shape, WHOLE_CELL, cross};
use crate::{Coupling, Error, ParticleList, ParticleState, Registry, Result, Vec3, solid};

/// Particles that fixed-point offsets can tell from a cell's face, in cells: half of the last place.
const SNAP: f64 = 1.0 / (1_u64 << 33) as f64;
/// Last place of a fixed-point offset: one cell is this many.
const FIXED: f64 = (1_u64 << 32) as f64;

/// Seeds all bodies of a scene, one list per planned material.
///
/// Particles stand on a cubic lattice, centred in the shape's bounds (from the bottom up in height fields), so that a
/// box of n spacings holds n particles along that side, the first half a spacing from the face. A particle's rest
/// volume is the cube of the spacing. Coordinates are computed relative to the cell of the shape's corner, so a scene
/// moved by whole cells has the same offsets, bit for bit.
///
/// # Errors
/// [`Error::Scene`] for a body without particles, [`Error::Capacity`] if they would take more than `max_bytes`, and
/// what reading a mesh or a height field may give.
pub(crate) fn seed(
    scene: &Scene,
    registry: &Registry,
    materials: &[PlannedMaterial],
    couplings: &[Box<dyn Coupling>],
    precision: Precision,
    max_bytes: u64,
) -> Result<ParticleState> {
    let mut lists: Vec<_> = (0..materials.len()).map(|m| empty_list(m, &materials[m], scene.world.cell)).collect();
    let mut seeder = Seeder { scene, registry, couplings, precision, next_id: 0, bytes: 0.0, max_bytes };
    for (i, body) in scene.body.iter().enumerate() {
        if let Some(m) = materials.iter().position(|m| m.name == body.material) {
            seeder.fill(i, body, &materials[m], &mut lists[m])?;
        }
    }
    Ok(ParticleState { lists, strain_dt: 0.0, sort: None })
}

/// A list without particles but with all of its planes.
fn empty_list(index: usize, planned: &PlannedMaterial, cell_width: f64) -> ParticleList {
    ParticleList {
        material: index as u32,
        cell_width,
        strain: vec![Vec::new(); planned.material.strain_planes()],
        state: vec![Vec::new(); planned.material.states.len()],
        ..ParticleList::default()
    }
}

struct Seeder<'a> {
    scene: &'a Scene,
    registry: &'a Registry,
    couplings: &'a [Box<dyn Coupling>],
    precision: Precision,
    next_id: u64,
    /// Bytes asked for so far.
    bytes: f64,
    max_bytes: u64,
}

impl Seeder<'_> {
    fn fill(&mut self, index: usize, body: &Body, planned: &PlannedMaterial, list: &mut ParticleList) -> Result<()> {
        let path = format!("body[{index}]");
        let solid = solid::of_shape(&body.shape, self.scene, self.registry, &format!("{path}.shape"))?;
        let bounds = solid.bounds();
        self.scene.check_inside(&path, bounds)?;
        let (cell, spacing) = (self.scene.world.cell, self.scene.spacing(body));
        let axes: [Axis; 3] = std::array::from_fn(|d| {
            let from_bottom = d == 2 && matches!(body.shape, Shape::HeightField { .. });
            Axis::new(bounds.min[d], bounds.max[d], spacing, cell, from_bottom)
        });
        let points: f64 = axes.iter().map(|axis| axis.count as f64).product();
        let least = axes.iter().map(|axis| axis.extent).fold(f64::INFINITY, f64::min);
        let empty = |why: String, mend: &str| {
            let name = if body.name.is_empty() { String::new() } else { format!(" '{}'", body.name) };
            Err(self.scene.fault(&path, format!("body{name} has no particles: {why}"), mend))
        };
        if points < 1.0 {
            return empty(
                format!("its least side, {least} m, is below half the spacing of {spacing} m"),
                "enlarge it, or lower spacing or world.cell",
            );
        }
        self.bytes += points * bytes_while_seeding(planned, self.precision) as f64;
        if self.bytes > self.max_bytes as f64 {
            return Err(Error::Capacity {
                what: "memory for particles [bytes]",
                asked: self.bytes as u64,
                cap: self.max_bytes,
                mend: "raise world.cell or spacing, shrink the bodies, or raise the cap",
            });
        }

        let start = list.len();
        let mut inside = 0_usize;
        let mut row = Row::default();
        let sites = axes.each_ref().map(Axis::sites);
        list.cell.reserve(points as usize);
        list.offset.reserve(points as usize);
        for (i, x) in sites[0].iter().enumerate() {
            for (j, y) in sites[1].iter().enumerate() {
                row.clear();
                for (k, z) in sites[2].iter().enumerate() {
                    let site = match body.sampling {
                        Sampling::Lattice => [*x, *y, *z],
                        Sampling::Jitter => {
                            let number = ((i * sites[1].len() + j) * sites[2].len() + k) as u64;
                            std::array::from_fn(|d| {
                                let random = uniform(self.scene.seed, index as u64, number, d as u64);
                                axes[d].site([i, j, k][d] as f64 + random - 0.5)
                            })
                        }
                    };
                    let position = site.map(|s: Site| s.position);
                    if solid.contains(position) {
                        row.push(site, position);
                    }
                }
                inside += row.position.len();
                if body.around_tools {
                    row.drop_inside(self.couplings);
                }
                for site in &row.site {
                    let fixed = site.map(|s| s.fixed(self.precision));
                    list.cell.push(fixed.map(|f| f.0));
                    list.offset.push(fixed.map(|f| f.1));
                }
            }
        }
        let end = list.cell.len();
        if start == end && inside == 0 {
            return empty(
                format!("no point of a lattice of {spacing} m lies inside its shape"),
                "enlarge it, or lower spacing or world.cell",
            );
        }
        if start == end {
            return empty(
                format!("all {inside} are inside tools"),
                "move the body or the tools, or set around_tools = false",
            );
        }
        self.fill_rest(index, body, planned, list, spacing);
        Ok(())
    }

    /// Everything but positions.
    fn fill_rest(
        &mut self,
        index: usize,
        body: &Body,
        planned: &PlannedMaterial,
        list: &mut ParticleList,
        spacing: f64,
    ) {
        let round = |x: f64| if self.precision == Precision::F32 { f64::from(x as f32) } else { x };
        let (start, end) = (list.id.len(), list.cell.len());
        list.id.extend(self.next_id..self.next_id + (end - start) as u64);
        self.next_id += (end - start) as u64;
        list.body.resize(end, index as u16);
        let volume0 = spacing.powi(3);
        list.volume0.resize(end, round(volume0));
        list.mass.resize(end, round(planned.density * volume0));
        for (plane, identity) in list.strain.iter_mut().zip(planned.material.strain_identity()) {
            plane.resize(end, *identity);
        }
        for (plane, variable) in list.state.iter_mut().zip(&planned.material.states) {
            plane.resize(end, round(variable.initial));
        }
        let [wx, wy, wz] = body.angular_velocity;
        let spin = [0.0, -wz, wy, wz, 0.0, -wx, -wy, wx, 0.0];
        list.affine.resize(end, spin.map(round));
        list.velocity.resize(end, body.velocity.map(round));
        if body.angular_velocity != [0.0; 3] {
            let center: Vec3 =
                std::array::from_fn(|d| (start..end).map(|i| list.position(i)[d]).sum::<f64>() / (end - start) as f64);
            for i in start..end {
                let x = list.position(i);
                let turning = cross(body.angular_velocity, std::array::from_fn(|d| x[d] - center[d]));
                list.velocity[i] = std::array::from_fn(|d| round(body.velocity[d] + turning[d]));
            }
        }
    }
}

/// Bytes of one particle in a [`ParticleList`] and in a backend, which coexist when a run starts.
fn bytes_while_seeding(planned: &PlannedMaterial, precision: Precision) -> u64 {
    let planes = planned.material.strain_planes() + planned.material.states.len();
    (8 + 2 + 12 + 8 * (3 + 3 + 9 + 2 + planes)) as u64 + planned.particle_bytes(precision)
}

/// A row of candidates.
#[derive(Default)]
struct Row {
    site: Vec<[Site; 3]>,
    position: Vec<Vec3>,
}

impl Row {
    fn clear(&mut self) {
        self.site.clear();
        self.position.clear();
    }
    fn push(&mut self, site: [Site; 3], position: Vec3) {
        self.site.push(site);
        self.position.push(position);
    }
    /// Drops the candidates that lie inside a tool.
    fn drop_inside(&mut self, couplings: &[Box<dyn Coupling>]) {
        for coupling in couplings {
            if self.position.is_empty() {
                return;
            }
            let distance = coupling.distance(&self.position);
            let mut outside = distance.iter().map(|d| *d >= 0.0);
            self.site.retain(|_| outside.next().unwrap_or(true));
            let mut outside = distance.iter().map(|d| *d >= 0.0);
            self.position.retain(|_| outside.next().unwrap_or(true));
        }
    }
}

/// Lattice points along one axis.
struct Axis {
    extent: f64,
    count: u64,
    /// The cell that coordinates are relative to, and its width [m].
    base: i32,
    width: f64,
    /// First point and distance, in cells from `base`.
    first: f64,
    step: f64,
}

impl Axis {
    fn new(min: f64, max: f64, spacing: f64, width: f64, from_bottom: bool) -> Self {
        let extent = max - min;
        let sides = extent / spacing;
        let count = if from_bottom { (sides - WHOLE_CELL).ceil() } else { sides.round() };
        let whole = (sides - count).abs() <= WHOLE_CELL * count;
        let gap = if whole || from_bottom { 0.0 } else { 0.5 * (sides - count) };
        let corner = min / width;
        let on_face = (corner - corner.round()).abs() <= WHOLE_CELL;
        let base = if on_face { corner.round() } else { corner.floor() };
        let step = spacing / width;
        let first = if on_face { 0.0 } else { corner - base } + (gap + 0.5) * step;
        Self { extent, count: count.max(0.0) as u64, base: base as i32, width, first, step }
    }
    /// The point `number` steps from the first.
    fn site(&self, number: f64) -> Site {
        let along = self.first + number * self.step;
        let cell = if (along - along.round()).abs() <= SNAP { along.round() } else { along.floor() };
        let offset = (along - cell).max(0.0);
        let cell = self.base + cell as i32;
        Site { cell, offset, position: (f64::from(cell) + offset) * self.width }
    }
    fn sites(&self) -> Vec<Site> {
        (0..self.count).map(|i| self.site(i as f64)).collect()
    }
}

/// One coordinate of a particle.
#[derive(Clone, Copy)]
struct Site {
    cell: i32,
    offset: f64,
    position: f64,
}

impl Site {
    /// Cell and offset as the run's number format holds them. A point on a face belongs to the upper cell.
    fn fixed(self, precision: Precision) -> (i32, f64) {
        if precision == Precision::F64 {
            return (self.cell, self.offset);
        }
        let counts = (self.offset * FIXED).round();
        if counts >= FIXED { (self.cell + 1, 0.0) } else { (self.cell, counts / FIXED) }
    }
}

/// A number in [0, 1) that depends on its arguments alone: SplitMix64 over their mix.
fn uniform(seed: u64, body: u64, number: u64, axis: u64) -> f64 {
    let mix = |x: u64| {
        let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    };
    let stream = mix(seed.wrapping_add(0x9e37_79b9_7f4a_7c15)) ^ mix(body.wrapping_add(0x632b_e59b_d9b4_e019));
    let bits =
        mix(stream.wrapping_add(number.wrapping_mul(3).wrapping_add(axis + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}
