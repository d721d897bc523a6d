//! Fills soft bodies with particles.

mod changed;
mod lattice;

use crate::coupling::Aabb;
use crate::levels::{Regions, SPLIT_AHEAD};
use crate::plan::{PlannedMaterial, Precision};
use crate::runout::{self, Runout};
use crate::scene::{Body, Sampling, Scene, Shape, World, cross};
use crate::solid::Solid;
use crate::zoned::{Zoned, Zones};
use crate::{Coupling, Error, LevelPhase, ParticleList, ParticleState, Registry, Result, Vec3, settle, solid};
use lattice::{Axis, Site, stagger};
pub(crate) use lattice::{on_level, uniform};
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

/// A scene's soft bodies as functions of position: where their particles are, and which weight they carry.
pub struct Terrain {
    scene: Scene,
    materials: Vec<PlannedMaterial>,
    precision: Precision,
    plots: Vec<Plot>,
    reaches: Vec<Aabb>,
}

/// What of one body is of one material, ready to be filled.
struct Plot {
    /// Index of the body in the scene.
    index: usize,
    /// Index of the material in the plan.
    material: usize,
    solid: Box<dyn Solid>,
    /// The lattice that its particles stand on.
    axes: [Axis; 3],
    places: Places,
}

/// Where particles stand in the cells of a lattice.
#[derive(Clone, Copy, PartialEq)]
enum Places {
    /// In the middle.
    Lattice,
    /// Moved along x, along y: rows by rows along the first of them, layer by layer along the other.
    Stagger([bool; 2]),
    /// Anywhere.
    Jitter,
}

impl Terrain {
    /// Reads the shapes of all bodies.
    ///
    /// # Errors
    /// [`Error::Scene`] for a body too small for a particle, and what reading a mesh or a height field may give.
    pub(crate) fn new(
        scene: &Scene,
        registry: &Registry,
        materials: &[PlannedMaterial],
        precision: Precision,
    ) -> Result<Self> {
        let mut plots = Vec::new();
        for (index, body) in scene.body.iter().enumerate() {
            let index_of = |name: &str| materials.iter().position(|m| m.name == name);
            let Some(own) = index_of(&body.material) else { continue };
            let path = format!("body[{index}]");
            let solid = solid::in_world(&body.shape, scene, registry, &format!("{path}.shape"))?;
            let bounds = solid.bounds();
            scene.check_inside(&path, bounds)?;
            let (cell, spacing) = (scene.world.cell, scene.spacing(body));
            let axes: [Axis; 3] = std::array::from_fn(|d| {
                let from_bottom = d == 2 && matches!(body.shape, Shape::HeightField { .. } | Shape::Terrain(_));
                Axis::new(bounds.min[d], bounds.max[d], spacing, cell, from_bottom)
            });
            let least = axes.iter().map(|axis| axis.extent).fold(f64::INFINITY, f64::min);
            if axes.iter().any(|axis| axis.count == 0) {
                let (why, mend) = if least > 0.0 {
                    let why = format!("its least side, {least} m, is below half the spacing of {spacing} m");
                    (why, "enlarge it, or lower spacing or world.cell")
                } else if matches!(body.shape, Shape::Intersection(_)) {
                    (
                        "its shapes have nothing in common in the world".to_owned(),
                        "move them together, or into the world",
                    )
                } else {
                    ("nothing of it lies in the world".to_owned(), "move it, or widen world.min and world.max")
                };
                return Err(is_empty(scene, index, &body.material, why, mend));
            }
            let places = Places::Lattice;
            if body.zone.is_empty() {
                plots.push(Plot { index, material: own, solid, axes, places });
                continue;
            }
            let zones = Arc::new(Zones::new(solid, scene, index, own, index_of)?);
            for material in body.materials().into_iter().filter_map(index_of) {
                let solid = Box::new(Zoned { zones: zones.clone(), material });
                plots.push(Plot { index, material, solid, axes: axes.clone(), places });
            }
        }
        Ok(Self { scene: scene.clone(), materials: materials.to_vec(), precision, plots, reaches: Vec::new() }.placed())
    }

    /// Seeds all bodies, one list per level and planned material.
    ///
    /// Particles form a cubic lattice, or one that has been moved as [`Sampling`] says, centred in the shape's bounds (from the bottom up in height fields and terrains). So a box of
    /// n spacings holds n particles along that side, the first half a spacing from the face. A particle's rest volume
    /// is the cube of the spacing. Coordinates are computed relative to the cell of the shape's corner, so a scene
    /// moved by whole cells has the same offsets, bit for bit.
    ///
    /// With several levels the lattice is that of the finest one. Where only coarser levels reach, whole cubes of 2, 4,
    /// 8, … points along each side become one particle in their middle. So mass and shape are those of the finest
    /// lattice.
    ///
    /// # Errors
    /// [`Error::Scene`] for a body without particles; [`Error::Capacity`] if they would take more than `max_bytes`; an
    /// error for settled ground that its material cannot carry.
    pub(crate) fn seed(
        &self,
        couplings: &[Box<dyn Coupling>],
        regions: &Regions,
        max_bytes: u64,
    ) -> Result<ParticleState> {
        let live = if regions.unbounded() { regions.reached(&BTreeSet::new()) } else { BTreeSet::new() };
        let tiles: Vec<_> = live.iter().copied().collect();
        let within = regions.unbounded().then_some(tiles.as_slice());
        let tools = Tools::new(&self.scene.world, couplings);
        let mut seeder = Seeder { terrain: self, tools, regions, within, next_id: 0, bytes: 0.0, max_bytes };
        let lists = seeder.lists()?;
        let levels = (regions.levels() > 1).then(|| LevelPhase {
            boxes: regions.boxes().to_vec(),
            next_id: seeder.next_id,
            rounds: 0,
            tried: 0,
            live,
        });
        Ok(ParticleState { lists, levels, ..ParticleState::default() })
    }

    /// Seeds some tiles as they were at the start, in the resolution of the present regions. Numbers of particles start
    /// at `next_id`. One list per level and planned material.
    ///
    /// # Errors
    /// Settled ground that its material cannot carry.
    pub fn seed_tiles(
        &self,
        tiles: &[[i32; 2]],
        couplings: &[Box<dyn Coupling>],
        regions: &Regions,
        next_id: &mut u64,
    ) -> Result<Vec<ParticleList>> {
        let (within, max_bytes) = (Some(tiles), u64::MAX);
        let tools = Tools::new(&self.scene.world, couplings);
        let mut seeder = Seeder { terrain: self, tools, regions, within, next_id: *next_id, bytes: 0.0, max_bytes };
        let lists = seeder.lists()?;
        *next_id = seeder.next_id;
        Ok(lists)
    }

    /// Estimate of how many particles a single level is seeded with, from a few thousand points of each body. 0 on
    /// several levels, where the number depends on where the levels are.
    pub(crate) fn about_how_many(&self) -> f64 {
        if self.scene.levels.count > 1 { 0.0 } else { self.plots.iter().map(|plot| self.about_how_many_of(plot)).sum() }
    }

    /// About how many points of its lattice are in a plot.
    fn about_how_many_of(&self, plot: &Plot) -> f64 {
        const SAMPLES: u64 = 16;
        let taken = plot.axes.each_ref().map(|axis| axis.count.min(SAMPLES));
        let site = |d: usize, i: u64| {
            let axis = &plot.axes[d];
            axis.site((i * axis.count + axis.count / 2) as f64 / taken[d] as f64).position
        };
        let row =
            |i, j| (0..taken[2]).filter(move |&k| plot.solid.contains([site(0, i), site(1, j), site(2, k)])).count();
        let inside: usize =
            (0..taken[0]).flat_map(|i| (0..taken[1]).map(move |j| (i, j))).map(|(i, j)| row(i, j)).sum();
        let each = |d: usize| plot.axes[d].count as f64 / taken[d] as f64;
        inside as f64 * each(0) * each(1) * each(2)
    }

    /// Pairs of bodies that overlap, with the volume that both fill [m³], from some ten thousand of the lattice points of the first that are in the other. Surfaces that
    /// touch do not count, nor do those that cross: nearly all of a particle has to be in both.
    pub(crate) fn overlaps(&self) -> Vec<([usize; 2], f64)> {
        const SAMPLES: u64 = 32;
        let of_body = |body: usize| {
            let plots: Vec<&Plot> = self.plots.iter().filter(|plot| plot.index == body).collect();
            (!plots.is_empty()).then(|| (body, plots, self.bounds_of(body)))
        };
        let bodies: Vec<(usize, Vec<&Plot>, Aabb)> = (0..self.scene.body.len()).filter_map(of_body).collect();
        let fills = |plots: &[&Plot], x: Vec3| plots.iter().any(|plot| plot.solid.contains(x));
        let mut overlaps = Vec::new();
        for (n, (one, own, bounds)) in bodies.iter().enumerate() {
            let spacing = self.scene.spacing(&self.scene.body[*one]);
            let ends = |x: Vec3| {
                (0..6).map(move |n| {
                    let mut end = x;
                    end[n / 2] += if n % 2 == 0 { 0.45 } else { -0.45 } * spacing;
                    end
                })
            };
            for (other, others, other_bounds) in &bodies[n + 1..] {
                let both = bounds.intersection(other_bounds);
                if (0..3).any(|d| both.min[d] >= both.max[d]) {
                    continue;
                }
                // The lattice points in the box that the two have in common, along each axis every one or one of several.
                let sites = |d: usize| {
                    let axis = &own[0].axes[d];
                    let (first, end) = (axis.first_from(both.min[d]), axis.first_from(both.max[d]));
                    let stride = end.saturating_sub(first).div_ceil(SAMPLES).max(1);
                    let place = |i: u64| axis.site(i as f64).position;
                    (stride, (first..end).step_by(stride as usize).map(place).collect::<Vec<f64>>())
                };
                let [(a, xs), (b, ys), (c, zs)] = [sites(0), sites(1), sites(2)];
                let columns = xs.iter().flat_map(|&x| ys.iter().map(move |&y| (x, y)));
                let places = columns.flat_map(|(x, y)| zs.iter().map(move |&z| [x, y, z]));
                let in_both = |x: Vec3| fills(others, x) && fills(own, x);
                let shared: Vec<Vec3> = places.filter(|x| in_both(*x)).collect();
                if shared.iter().any(|x| ends(*x).all(in_both)) {
                    let points = shared.len() as u64 * a * b * c;
                    overlaps.push(([*one, *other], points as f64 * spacing.powi(3)));
                }
            }
        }
        overlaps
    }

    /// The box of all that a body fills.
    fn bounds_of(&self, body: usize) -> Aabb {
        let bounds = self.plots.iter().filter(|plot| plot.index == body).map(|plot| plot.solid.bounds());
        bounds.reduce(|a, b| a.union(&b)).unwrap_or(Aabb::NOTHING)
    }

    /// The tile to which a particle of a body at `x` belongs: that of the coarsest cube of the body's lattice in which
    /// it lies. So a particle that is seeded with a tile belongs to it, wherever the lattice's corner is.
    pub fn tile_of(&self, body: u16, x: Vec3, regions: &Regions) -> [i32; 2] {
        let plot = self.plots.iter().find(|plot| plot.index == usize::from(body));
        let side = f64::from(1 << (regions.levels() - 1));
        let cell = [0, 1].map(|d| match plot {
            Some(Plot { axes, .. }) => {
                let axis = &axes[d];
                let cube = ((x[d] - axis.site(-0.5).position) / (side * axis.step * axis.width)).floor();
                axis.site(side * (cube + 0.5) - 0.5).cell
            }
            None => (x[d] / self.scene.world.cell).floor() as i32,
        });
        regions.tile_of([cell[0], cell[1], 0])
    }

    /// Boxes that bodies may come to fill which flow apart or fly, inside the world [m].
    pub(crate) fn reaches(&self) -> &[Aabb] {
        &self.reaches
    }

    /// Bodies whose particles stand staggered.
    pub(crate) fn staggered(&self) -> Vec<usize> {
        let is_staggered = |body: &usize| {
            self.plots.iter().any(|plot| plot.index == *body && matches!(plot.places, Places::Stagger(_)))
        };
        (0..self.scene.body.len()).filter(is_staggered).collect()
    }

    /// With particles where the bodies' sampling has them, which depends on what holds the bodies and on what moves.
    fn placed(mut self) -> Self {
        let runouts: Vec<Runout> =
            self.scene.body.iter().enumerate().map(|(index, body)| self.runout(index, body)).collect();
        let scene = &self.scene;
        let (is_stirred, in_slice) = (runout::is_stirred(scene, &runouts), scene.world.plane_strain.is_some());
        for ((index, body), runout) in scene.body.iter().enumerate().zip(runouts) {
            self.reaches.extend(runout.reaches);
            let mixes = |d: usize| runout.mixes && is_stirred && !scene.world.is_periodic(d) && !(d == 1 && in_slice);
            let along = [0, 1].map(|d| runout.along[d] || mixes(d));
            let places = match body.sampling {
                Sampling::Lattice => Places::Lattice,
                Sampling::Stagger => Places::Stagger([true, !in_slice]),
                Sampling::Jitter => Places::Jitter,
                // Ground that comes and goes is compared with its lattice.
                Sampling::Auto if scene.levels.reach > 0 || along == [false; 2] => Places::Lattice,
                Sampling::Auto => Places::Stagger(along),
            };
            self.plots.iter_mut().filter(|plot| plot.index == index).for_each(|plot| plot.places = places);
        }
        self
    }

    /// Where a body may get.
    fn runout(&self, index: usize, body: &Body) -> Runout {
        let (own, bounds) = (|| self.plots.iter().filter(|plot| plot.index == index), self.bounds_of(index));
        let spacing = self.scene.spacing(body);
        let volume = || own().map(|plot| self.about_how_many_of(plot)).sum::<f64>() * spacing.powi(3);
        let materials = own().map(|plot| &self.materials[plot.material]);
        runout::of_body(&self.scene, body, &bounds, || self.ends(index, &bounds), volume, materials)
    }

    /// What holds a body: the world's ends, where a layer reaches them, and bodies beside and below its middle.
    fn ends(&self, index: usize, bounds: &Aabb) -> runout::Ends {
        let (scene, body) = (&self.scene, &self.scene.body[index]);
        let (near, world) = (0.5 * scene.spacing(body), scene.world_box());
        let middle: Vec3 = std::array::from_fn(|d| 0.5 * (bounds.min[d] + bounds.max[d]));
        let fills =
            |own: bool, x: Vec3| self.plots.iter().any(|plot| (plot.index == index) == own && plot.solid.contains(x));
        let is_free = |d: usize, side: usize| {
            let (sign, end, gap) = match side {
                0 => (-1.0, bounds.min[d], bounds.min[d] - world.min[d]),
                _ => (1.0, bounds.max[d], world.max[d] - bounds.max[d]),
            };
            let beside = |by: f64| {
                let mut x = middle;
                x[d] = end + sign * by * near;
                x
            };
            // At the world's end a body is held where it is as high as in its middle: a union may have a tower.
            let is_held =
                gap <= 0.5 * scene.world.cell && (d == 2 || body.shape.is_layer() || fills(true, beside(-1.0)));
            !is_held && !fills(false, beside(1.0)) && (d != 1 || scene.world.plane_strain.is_none())
        };
        runout::Ends { sides: [0, 1].map(|d| [0, 1].map(|side| is_free(d, side))), below: is_free(2, 0) }
    }

    /// Height of the highest body at a point of the ground plan, as the shapes have it [m]. None where there is none; bodies that are no
    /// [layers](Shape::is_layer) do not count.
    pub fn height(&self, [x, y]: [f64; 2]) -> Option<f64> {
        let tops = self.plots.iter().flat_map(|plot| plot.solid.columns(x, y)).map(|[_, top]| top);
        tops.reduce(f64::max)
    }

    /// Where a particle of 2^class lattice points along each side lies.
    fn cube_site(&self, plot: &Plot, origin: [u64; 3], class: usize) -> [Site; 3] {
        let side = f64::from(1_u32 << class);
        // Where in the cube, in shares of its side.
        let within: [f64; 3] = match plot.places {
            Places::Lattice => [0.5; 3],
            Places::Stagger(along) => {
                let counts = plot.axes.each_ref().map(|axis| axis.count >> class);
                let (seeds, in_slice) = ((self.scene.seed, plot.index as u64), self.scene.world.plane_strain.is_some());
                let by = stagger(seeds, along, in_slice, origin.map(|i| i >> class), counts);
                // What stands nearer to its body's face is moved less.
                let room = |d: usize| 2.0 * plot.axes[d].room;
                [0.5 + room(0) * by[0], 0.5 + room(1) * by[1], 0.5]
            }
            Places::Jitter => {
                let number = (origin[0] * plot.axes[1].count + origin[1]) * plot.axes[2].count + origin[2];
                std::array::from_fn(|d| uniform(self.scene.seed, plot.index as u64, number, d as u64))
            }
        };
        std::array::from_fn(|d| {
            plot.axes[d].site(origin[d] as f64 + 0.5 * (side - 1.0) + side * within[d] - 0.5 * side)
        })
    }

    /// Weight of all settled ground above each of some points, per area [Pa].
    fn loads(&self, points: impl Iterator<Item = Vec3>) -> Vec<f64> {
        let settled: Vec<&Plot> = self.plots.iter().filter(|plot| self.scene.body[plot.index].settled).collect();
        // Points of a row or column come one after the other; what is tried particle by particle is kept, column by column of its lattice.
        let (mut at, mut pieces) = ([f64::NAN; 2], Vec::new());
        let mut columns: HashMap<(usize, [u64; 2]), Vec<[f64; 2]>> = HashMap::new();
        let mut pieces_of = |number: usize, plot: &Plot, at: [f64; 2]| {
            if self.scene.body[plot.index].shape.is_layer() {
                return self.pieces(plot, at);
            }
            let [Some(i), Some(j)] = [0, 1].map(|d| plot.axes[d].nearest(at[d])) else { return Vec::new() };
            let middle = [plot.axes[0].site(i as f64).position, plot.axes[1].site(j as f64).position];
            columns.entry((number, [i, j])).or_insert_with(|| self.pieces(plot, middle)).clone()
        };
        let load = |x: Vec3| {
            if at != [x[0], x[1]] {
                at = [x[0], x[1]];
                pieces = settled.iter().enumerate().map(|(n, plot)| (*plot, pieces_of(n, plot, at))).collect();
            }
            let above = |[bottom, top]: &[f64; 2]| (top - x[2].max(*bottom)).max(0.0);
            let weight = |(plot, pieces): &(&Plot, Vec<[f64; 2]>)| {
                self.materials[plot.material].density * pieces.iter().map(above).sum::<f64>()
            };
            pieces.iter().map(weight).sum::<f64>() * -self.scene.gravity[2]
        };
        points.map(load).collect()
    }

    /// Lower and upper ends of what a plot has above a point of the ground plan [m]. They are those of its outermost particles.
    fn pieces(&self, plot: &Plot, [x, y]: [f64; 2]) -> Vec<[f64; 2]> {
        let [.., axis] = &plot.axes;
        let spacing = axis.step * axis.width;
        let first = axis.site(0.0).position - 0.5 * spacing;
        if self.scene.body[plot.index].shape.is_layer() {
            let end = |z: f64| first + ((z - first) / spacing).round() * spacing;
            return plot.solid.columns(x, y).into_iter().map(|piece| piece.map(end)).collect();
        }
        // What has no surface to ask for is tried particle by particle.
        let mut pieces: Vec<[f64; 2]> = Vec::new();
        for (k, site) in (0..).zip(axis.sites()) {
            if plot.solid.contains([x, y, site.position]) {
                let [bottom, top] = [k, k + 1].map(|k| first + f64::from(k) * spacing);
                match pieces.last_mut() {
                    Some(piece) if piece[1] == bottom => piece[1] = top,
                    _ => pieces.push([bottom, top]),
                }
            }
        }
        pieces
    }

    /// Gives a list's particles from `start` on the strain and history that carry the ground above them.
    fn settle(&self, plot: &Plot, list: &mut ParticleList, start: usize) -> Result<()> {
        let round = |x: f64| self.precision.round(x);
        let loads = self.loads((start..list.cell.len()).map(|i| list.position(i)));
        let k0 = self.scene.body[plot.index].k0;
        let settled = settle::under(&self.materials[plot.material], &loads, k0).map_err(|error| match error {
            settle::Unsettled::Error(error) => error,
            settle::Unsettled::Load(load) => self.scene.fault(
                &format!("body[{}].settled", plot.index),
                format!(
                    "material '{}' does not carry the {load:.4} Pa of the ground above it, not even pressed to {} of its height",
                    self.materials[plot.material].name,
                    settle::LEAST_STRETCH
                ),
                "raise its stiffness, or leave settled out",
            ),
            settle::Unsettled::Sides(load) => self.scene.fault(
                &format!("body[{}].k0", plot.index),
                format!(
                    "material '{}' does not bear {load:.4} Pa along z and {} of that along x and y",
                    self.materials[plot.material].name,
                    k0.unwrap_or_default()
                ),
                "bring k0 nearer to 1 (a fluid bears nothing else), raise its stiffness, or leave k0 out",
            ),
        })?;
        for (plane, values) in list.strain.iter_mut().chain(&mut list.state).zip(settled) {
            for (place, value) in plane[start..].iter_mut().zip(values) {
                *place = round(value);
            }
        }
        Ok(())
    }
}

impl std::fmt::Debug for Terrain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Terrain").field("bodies", &self.plots.len()).finish_non_exhaustive()
    }
}

/// The error for a body, or one of its materials, that no particle fits into.
fn is_empty(scene: &Scene, index: usize, material: &str, why: String, mend: &str) -> Error {
    let body = &scene.body[index];
    let name = if body.name.is_empty() { String::new() } else { format!(" '{}'", body.name) };
    let material = if body.zone.is_empty() { String::new() } else { format!(" of material '{material}'") };
    scene.fault(&format!("body[{index}]"), format!("body{name} has no particles{material}: {why}"), mend)
}

struct Seeder<'a> {
    terrain: &'a Terrain,
    tools: Tools<'a>,
    regions: &'a Regions,
    /// Tiles to be seeded; absent: everything.
    within: Option<&'a [[i32; 2]]>,
    next_id: u64,
    /// Bytes asked for so far.
    bytes: f64,
    max_bytes: u64,
}

impl Seeder<'_> {
    /// All bodies' particles, one list per level and material.
    fn lists(&mut self) -> Result<Vec<ParticleList>> {
        let Terrain { scene, materials, plots, .. } = self.terrain;
        let mut lists: Vec<_> = (0..self.regions.levels())
            .flat_map(|level| materials.iter().enumerate().map(move |(m, planned)| (level, m, &planned.material)))
            .map(|(level, m, law)| {
                let width = scene.world.cell * f64::from(1 << level);
                ParticleList::empty(level, m, width, law.strain_planes(), law.states.len())
            })
            .collect();
        for plot in plots {
            self.fill(plot, lists.iter_mut().skip(plot.material).step_by(materials.len()).collect())?;
        }
        Ok(lists)
    }

    /// Asks for so many more bytes.
    fn ask(&mut self, bytes: f64, mend: &'static str) -> Result<()> {
        self.bytes += bytes;
        if self.bytes <= self.max_bytes as f64 {
            return Ok(());
        }
        Err(Error::Capacity {
            what: "memory for particles [bytes]",
            asked: self.bytes as u64,
            cap: self.max_bytes,
            mend,
        })
    }

    /// Fills one body; `lists` are those of its material, finest level first.
    fn fill(&mut self, plot: &Plot, mut lists: Vec<&mut ParticleList>) -> Result<()> {
        let (scene, precision) = (&self.terrain.scene, self.terrain.precision);
        let (body, planned) = (&scene.body[plot.index], &self.terrain.materials[plot.material]);
        let (spacing, axes) = (scene.spacing(body), &plot.axes);
        if lists.len() > 1 {
            return self.fill_levels(plot, &mut lists);
        }
        let points: f64 = axes.iter().map(|axis| axis.count as f64).product();
        let list = &mut *lists[0];
        let mend = "raise world.cell or spacing, shrink the bodies, or raise the cap";
        self.ask(points * bytes_while_seeding(planned, precision) as f64, mend)?;

        let start = list.len();
        let mut inside = 0_usize;
        let mut row = Row::default();
        list.cell.reserve(points as usize);
        list.offset.reserve(points as usize);
        let (is_moved, sites) = (plot.places != Places::Lattice, axes.each_ref().map(Axis::sites));
        for (i, x) in (0..).zip(&sites[0]) {
            for (j, y) in (0..).zip(&sites[1]) {
                row.clear();
                for (k, z) in (0..).zip(&sites[2]) {
                    let site = if is_moved { self.terrain.cube_site(plot, [i, j, k], 0) } else { [*x, *y, *z] };
                    let position = site.map(|s| s.position);
                    if plot.solid.contains(position) {
                        row.push(site, position);
                    }
                }
                inside += row.position.len();
                if body.around_tools {
                    row.drop_inside(&self.tools);
                }
                for site in &row.site {
                    let fixed = site.map(|s| s.fixed(precision));
                    list.cell.push(fixed.map(|f| f.0));
                    list.offset.push(fixed.map(|f| f.1));
                }
            }
        }
        let end = list.cell.len();
        if start == end && inside == 0 {
            return Err(is_empty(
                scene,
                plot.index,
                &self.terrain.materials[plot.material].name,
                format!("no point of a lattice of {spacing} m lies inside its shape"),
                "enlarge it, or lower spacing or world.cell",
            ));
        }
        if start == end {
            return Err(is_empty(
                scene,
                plot.index,
                &self.terrain.materials[plot.material].name,
                format!("all {inside} are inside tools"),
                "move the body or the tools, or set around_tools = false",
            ));
        }
        self.fill_rest(plot, &mut lists, &[Vec::new()])
    }

    /// Fills one body on several levels.
    fn fill_levels(&mut self, plot: &Plot, lists: &mut [&mut ParticleList]) -> Result<()> {
        let (scene, precision) = (&self.terrain.scene, self.terrain.precision);
        let cubes = Cubes { plot, body: &scene.body[plot.index], tools: self.tools.bounds() };
        let coarsest = lists.len() - 1;
        let mut classes = vec![Vec::new(); lists.len()];
        let each = bytes_while_seeding(&self.terrain.materials[plot.material], precision) as f64;
        let mut found = Vec::new();
        let side = 1 << coarsest;
        // Numbers of the coarsest cubes along x and y, and along z.
        let all = [0, 1].map(|d| (0..plot.axes[d].count.div_ceil(side)).collect::<Vec<_>>());
        let columns = match self.within {
            None => vec![all],
            Some(tiles) => tiles.iter().map(|&tile| self.cubes_of_tile(plot, tile, side)).collect(),
        };
        for (i, j) in columns.iter().flat_map(|[x, y]| x.iter().flat_map(move |i| y.iter().map(move |j| (i, j)))) {
            for k in (0..plot.axes[2].count).step_by(side as usize) {
                self.find_cubes(&cubes, [i * side, j * side, k], coarsest, &mut found);
            }
            let mend = "add a level, raise world.cell or spacing, shrink the bodies, or raise the cap";
            self.ask(found.len() as f64 * each, mend)?;
            for (origin, class) in found.drain(..) {
                let site = self.terrain.cube_site(plot, origin, class);
                let level = self.regions.finest_at(site.map(|s| s.cell), SPLIT_AHEAD);
                let fixed = site.map(|s| s.on_level(level, precision));
                lists[level].cell.push(fixed.map(|f| f.0));
                lists[level].offset.push(fixed.map(|f| f.1));
                classes[level].push(class as u32);
            }
        }
        if self.within.is_none() && classes.iter().all(Vec::is_empty) {
            return Err(is_empty(
                scene,
                plot.index,
                &self.terrain.materials[plot.material].name,
                format!(
                    "no point of a lattice of {} m lies inside its shape and outside tools",
                    scene.spacing(cubes.body)
                ),
                "enlarge it, lower spacing or world.cell, move the tools, or set around_tools = false",
            ));
        }
        self.fill_rest(plot, lists, &classes)
    }

    /// Numbers along x and y of the cubes of `side` lattice points whose middle lies in a tile.
    fn cubes_of_tile(&self, plot: &Plot, tile: [i32; 2], side: u64) -> [Vec<u64>; 2] {
        let cells = self.regions.cells_of_tile(tile);
        std::array::from_fn(|d| {
            let (axis, [first, end]) = (&plot.axes[d], cells[d]);
            let middle = |cube: u64| axis.site(side as f64 * (cube as f64 + 0.5) - 0.5).cell;
            let count = axis.count.div_ceil(side);
            let cubes: Vec<u64> = (0..count).collect();
            let [from, to] = [first, end].map(|face| cubes.partition_point(|&cube| middle(cube) < face));
            cubes[from..to].to_vec()
        })
    }

    /// Finds the largest particles that fill the cube of 2^class lattice points along each side. Is it one single particle?
    fn find_cubes(&self, cubes: &Cubes, origin: [u64; 3], class: usize, found: &mut Vec<([u64; 3], usize)>) -> bool {
        if (0..3).any(|d| origin[d] >= cubes.plot.axes[d].count) {
            return false;
        }
        let last: [u64; 3] = std::array::from_fn(|d| (origin[d] + (1 << class) - 1).min(cubes.plot.axes[d].count - 1));
        let whole = (0..3).all(|d| last[d] - origin[d] == (1 << class) - 1);
        let points = Aabb {
            min: std::array::from_fn(|d| cubes.plot.axes[d].site(origin[d] as f64).position),
            max: std::array::from_fn(|d| cubes.plot.axes[d].site(last[d] as f64).position),
        };
        // Particles that are moved lie up to half a spacing off their lattice points.
        let is_moved = cubes.plot.places != Places::Lattice;
        let reach = if is_moved { 0.5 * self.terrain.scene.spacing(cubes.body) } else { 0.0 };
        let points = points.grown(reach);
        let cover = cubes.plot.solid.cover(&points);
        if cover == Some(false) {
            return false;
        }
        let clear = !cubes.body.around_tools || !cubes.tools.iter().any(|tool| tool.meets(&points));
        if class == 0 {
            let place = self.terrain.cube_site(cubes.plot, origin, 0).map(|s| s.position);
            let free = clear || self.tools.are_clear_of(&[place])[0];
            if !free || !cubes.plot.solid.contains(place) {
                return false;
            }
            found.push((origin, 0));
            return true;
        }
        let site = self.terrain.cube_site(cubes.plot, origin, class);
        let reached = class <= self.regions.finest_at(site.map(|s| s.cell), SPLIT_AHEAD);
        let start = found.len();
        if !(whole && reached && clear && cover == Some(true)) {
            let mut all = true;
            for child in 0..8_u64 {
                let at = std::array::from_fn(|d| origin[d] + (child >> d & 1) * (1 << (class - 1)));
                all &= self.find_cubes(cubes, at, class - 1, found);
            }
            if !(whole && reached && all) {
                return false;
            }
            found.truncate(start);
        }
        found.push((origin, class));
        true
    }

    /// Everything but positions, for the particles that have been placed in the lists of one material. `classes` says how
    /// many lattice points each stands for along a side, as a power of two; where it is empty, one.
    fn fill_rest(&mut self, plot: &Plot, lists: &mut [&mut ParticleList], classes: &[Vec<u32>]) -> Result<()> {
        let Terrain { scene, materials, precision, .. } = self.terrain;
        let (body, planned) = (&scene.body[plot.index], &materials[plot.material]);
        let round = |x: f64| precision.round(x);
        let spacing = scene.spacing(body);
        let [wx, wy, wz] = body.angular_velocity;
        let spin = [0.0, -wz, wy, wz, 0.0, -wx, -wy, wx, 0.0];
        let strains = body.velocity_gradient != [0.0; 9];
        let affine = if strains { std::array::from_fn(|i| spin[i] + body.velocity_gradient[i]) } else { spin };
        let starts: Vec<usize> = lists.iter().map(|list| list.id.len()).collect();
        for ((list, &start), classes) in lists.iter_mut().zip(&starts).zip(classes) {
            let end = list.cell.len();
            list.id.extend(self.next_id..self.next_id + (end - start) as u64);
            self.next_id += (end - start) as u64;
            list.body.resize(end, plot.index as u16);
            for i in 0..end - start {
                let class = classes.get(i).copied().unwrap_or(0);
                let volume0 = (spacing * f64::from(1_u32 << class)).powi(3);
                list.volume0.push(round(volume0));
                list.mass.push(round(planned.density * volume0));
            }
            for (plane, identity) in list.strain.iter_mut().zip(planned.material.strain_identity()) {
                plane.resize(end, *identity);
            }
            for (plane, variable) in list.state.iter_mut().zip(&planned.material.states) {
                plane.resize(end, round(variable.initial));
            }
            list.affine.resize(end, affine.map(round));
            list.velocity.resize(end, body.velocity.map(round));
            if body.settled {
                self.terrain.settle(plot, list, start)?;
            }
        }
        if affine != [0.0; 9] {
            let (mut moment, mut weight) = ([0.0; 3], 0.0);
            for ((list, &start), classes) in lists.iter().zip(&starts).zip(classes) {
                for i in start..list.cell.len() {
                    let points = f64::from(8_u32.pow(classes.get(i - start).copied().unwrap_or(0)));
                    let x = list.position(i);
                    (0..3).for_each(|d| moment[d] += points * x[d]);
                    weight += points;
                }
            }
            let center: Vec3 = moment.map(|m| m / weight);
            for (list, &start) in lists.iter_mut().zip(&starts) {
                for i in start..list.cell.len() {
                    let x = list.position(i);
                    let away: Vec3 = std::array::from_fn(|d| x[d] - center[d]);
                    let turning = cross(body.angular_velocity, away);
                    let strained = |d: usize| (0..3).map(|e| body.velocity_gradient[3 * d + e] * away[e]).sum::<f64>();
                    let along = |d: usize| if strains { turning[d] + strained(d) } else { turning[d] };
                    list.velocity[i] = std::array::from_fn(|d| round(body.velocity[d] + along(d)));
                }
            }
        }
        Ok(())
    }
}

/// The lattice of one body, whose whole cubes become particles of coarser levels.
struct Cubes<'a> {
    plot: &'a Plot,
    body: &'a Body,
    /// Boxes around tools: in there, points are tried one by one.
    tools: Vec<Aabb>,
}

/// Bytes of one particle in a [`ParticleList`] and in a backend, which coexist when a run starts.
fn bytes_while_seeding(planned: &PlannedMaterial, precision: Precision) -> u64 {
    (8 + 2 + 12 + 8 * (3 + 3 + 9 + 2 + planned.material.values())) as u64 + planned.particle_bytes(precision)
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
    fn drop_inside(&mut self, tools: &Tools<'_>) {
        let clear = tools.are_clear_of(&self.position);
        let mut kept = clear.iter();
        self.site.retain(|_| *kept.next().unwrap_or(&true));
        let mut kept = clear.iter();
        self.position.retain(|_| *kept.next().unwrap_or(&true));
    }
}

/// What ground is not to be seeded in.
struct Tools<'a> {
    couplings: &'a [Box<dyn Coupling>],
    /// How far those images of the ground are from it that tools may lie in [m]: in a periodic world they may be beyond its sides.
    images: Vec<Vec3>,
}

impl<'a> Tools<'a> {
    fn new(world: &World, couplings: &'a [Box<dyn Coupling>]) -> Self {
        let mut images = vec![[0.0; 3]];
        for bounds in couplings.iter().flat_map(|coupling| coupling.bounds()) {
            for image in world.images(&bounds) {
                if !images.contains(&image) {
                    images.push(image);
                }
            }
        }
        Self { couplings, images }
    }

    /// Boxes around tools, where the ground itself is.
    fn bounds(&self) -> Vec<Aabb> {
        let of_one = |bounds: Aabb| {
            self.images.iter().map(move |by| Aabb {
                min: std::array::from_fn(|d| bounds.min[d] - by[d]),
                max: std::array::from_fn(|d| bounds.max[d] - by[d]),
            })
        };
        self.couplings.iter().flat_map(|coupling| coupling.bounds()).flat_map(of_one).collect()
    }

    /// Which points lie outside all of them.
    fn are_clear_of(&self, points: &[Vec3]) -> Vec<bool> {
        let mut clear = vec![true; points.len()];
        for by in &self.images {
            let there: Vec<Vec3> = points.iter().map(|point| std::array::from_fn(|d| point[d] + by[d])).collect();
            for coupling in self.couplings.iter().filter(|_| !points.is_empty()) {
                for (clear, distance) in clear.iter_mut().zip(coupling.distance(&there)) {
                    *clear &= distance >= 0.0;
                }
            }
        }
        clear
    }
}
