//! What a scene must satisfy beyond types, and what the user should be warned of.

mod camera;
mod flow;
mod levels;
mod output;
mod robot;
mod terrain;
mod tool;
mod walls;
mod zone;

use super::{Body, LevelAgent, Motion, Placed, Scene, Shape, Terrain, Tool, Wall, Walls, World};
use crate::coupling::Aabb;
use crate::levels::NESTING;
use crate::{Error, Result, Vec3};
use std::collections::BTreeMap;

/// How far a bound may be from a whole cell and still mean it, in cells.
pub const WHOLE_CELL: f64 = 1e-6;
/// Cells along one side of a block, in which particles are sorted.
const BLOCK: i64 = 4;
/// Cells are counted in 32 bits; half of their range leaves room for neighbours.
const MOST_CELLS: f64 = (1 << 30) as f64;
pub(super) const AXES: [&str; 3] = ["x", "y", "z"];
/// Distances between particles, in cells.
const SPACINGS: std::ops::RangeInclusive<f64> = 0.2..=1.0;
/// No ground is pressed sideways that much more than by its weight.
const MOST_K0: f64 = 10.0;
/// More would make the coarsest cells 256 times as wide as the finest.
const MOST_LEVELS: u32 = 8;
/// Coarsest cells around the boxes that may be live: beyond, a world is no smaller for having a reach.
const MOST_REACH: u32 = 1024;

impl Wall {
    /// Whether something stands there: the side is neither open nor periodic.
    pub fn is_wall(self) -> bool {
        !matches!(self, Self::Open | Self::Periodic)
    }
}

impl Walls {
    /// The walls of an axis: least side, greatest side.
    pub fn pair(&self, axis: usize) -> [Wall; 2] {
        [[self.x_min, self.x_max], [self.y_min, self.y_max], [self.z_min, self.z_max]][axis]
    }
    /// Whether any wall lets go of the ground.
    pub fn let_go(&self) -> bool {
        (0..3).flat_map(|axis| self.pair(axis)).any(|wall| matches!(wall, Wall::Separate { .. }))
    }
}

impl World {
    /// The key of the wall beyond which a point lies [m]; `None` if it lies beyond none.
    pub(crate) fn wall_passed(&self, point: Vec3) -> Option<&'static str> {
        const SIDES: [[&str; 2]; 3] = [["x_min", "x_max"], ["y_min", "y_max"], ["z_min", "z_max"]];
        (0..3).find_map(|d| {
            let beyond = [point[d] < self.min[d], point[d] >= self.max[d]];
            let side = (0..2).find(|&side| beyond[side] && self.walls.pair(d)[side].is_wall())?;
            Some(SIDES[d][side])
        })
    }
}

impl Shape {
    /// A box that holds the shape in its own frame; `None` for planes, meshes and height fields in files.
    pub fn bounds(&self) -> Option<Aabb> {
        let around = |center: Vec3, half: Vec3| Aabb {
            min: std::array::from_fn(|d| center[d] - half[d]),
            max: std::array::from_fn(|d| center[d] + half[d]),
        };
        match self {
            Self::Box { min: Some(min), max: Some(max), .. } => Some(Aabb { min: *min, max: *max }),
            Self::Box { half, center, .. } => half.map(|half| around(center.unwrap_or_default(), half)),
            Self::Sphere { center, radius } => Some(around(*center, [*radius; 3])),
            Self::Cylinder { center, radius, half_height } => Some(around(*center, [*radius, *radius, *half_height])),
            Self::Capsule { center, radius, half_height } => {
                Some(around(*center, [*radius, *radius, half_height + radius]))
            }
            Self::HeightField { min, max, bottom, heights, .. } => {
                let top = heights.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
                (!heights.is_empty())
                    .then_some(Aabb { min: [min[0], min[1], *bottom], max: [max[0], max[1], top.max(*bottom)] })
            }
            Self::Terrain(terrain) => {
                let (Terrain { min, max, bottom, .. }, [_, top]) =
                    (terrain, terrain.heights().within(terrain.min, terrain.max));
                Some(Aabb { min: [min[0], min[1], *bottom], max: [max[0], max[1], top.max(*bottom)] })
            }
            Self::Union(parts) => parts.iter().map(Placed::bounds).reduce(|a, b| Some(a?.union(&b?))).flatten(),
            Self::Difference(parts) => parts.first()?.bounds(),
            Self::Intersection(parts) => {
                parts.iter().map(Placed::bounds).reduce(|a, b| Some(a?.intersection(&b?))).flatten()
            }
            Self::Plane { .. } | Self::Mesh { .. } => None,
        }
    }

    /// What it is put together from, if it is.
    pub(crate) fn parts(&self) -> &[Placed] {
        match self {
            Self::Union(parts) | Self::Difference(parts) | Self::Intersection(parts) => parts,
            _ => &[],
        }
    }

    /// Does it hold a shape of which that is true, or is it one?
    pub(super) fn any(&self, is: fn(&Self) -> bool) -> bool {
        is(self) || self.parts().iter().any(|part| part.shape.any(is))
    }

    /// Is it ground that has no mass: a plane or a terrain, or a union with one?
    pub(super) fn is_ground(&self) -> bool {
        self.any(|shape| matches!(shape, Self::Plane { .. } | Self::Terrain(_)))
    }

    /// Has it one surface above each point of its ground plan, so that it is known how deep a point lies?
    pub fn is_layer(&self) -> bool {
        matches!(self, Self::Box { .. } | Self::HeightField { .. } | Self::Terrain(_))
    }
}

impl Placed {
    /// A box that holds it; `None` as for its shape.
    fn bounds(&self) -> Option<Aabb> {
        self.shape.bounds().map(|bounds| posed_bounds(bounds, self.position, self.rotation))
    }
}

/// A vector turned by a unit quaternion (w, x, y, z).
pub(crate) fn turn(q: [f64; 4], v: Vec3) -> Vec3 {
    let [w, u @ ..] = q;
    let t = cross(u, v).map(|c| 2.0 * c);
    let s = cross(u, t);
    std::array::from_fn(|d| v[d] + w * t[d] + s[d])
}

pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A box that holds `bounds` turned about the origin and moved to `position`.
pub(crate) fn posed_bounds(bounds: Aabb, position: Vec3, rotation: [f64; 4]) -> Aabb {
    let corner = |i: usize| {
        let x = std::array::from_fn(|d| if i >> d & 1 == 0 { bounds.min[d] } else { bounds.max[d] });
        let x = turn(rotation, x);
        let x: Vec3 = std::array::from_fn(|d| x[d] + position[d]);
        Aabb { min: x, max: x }
    };
    (1..8).map(corner).fold(corner(0), |all, one| all.union(&one))
}

/// Divides a quaternion by its norm; one that is already of unit length keeps its bits.
fn normalise(q: &mut [f64; 4]) {
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if (norm - 1.0).abs() > 1e-15 {
        *q = q.map(|c| c / norm);
    }
}

impl Scene {
    /// Checks everything about the scene that its types cannot express, and normalises its quaternions. Scenes that
    /// were read have been checked; call this on scenes put together in code.
    ///
    /// # Errors
    /// [`Error::Scene`] with file, line and key path.
    pub fn check(&mut self) -> Result<()> {
        self.check_names()?;
        self.check_finite()?;
        self.set_thickness()?;
        self.check_world()?;
        self.check_levels()?;
        self.check_sleep()?;
        self.check_time_and_output()?;
        self.not_negative("gravity_ramp", self.gravity_ramp)?;
        for (i, material) in self.material.iter().enumerate() {
            self.positive(&format!("material[{i}].density"), material.density)?;
            self.not_negative(&format!("material[{i}].damping"), material.damping)?;
        }
        for (i, body) in self.body.iter().enumerate() {
            self.check_body(&format!("body[{i}]"), body)?;
        }
        self.check_flows()?;
        for (i, tool) in self.tool.iter().enumerate() {
            self.check_tool(&format!("tool[{i}]"), tool)?;
        }
        for (i, robot) in self.robot.iter().enumerate() {
            self.check_robot(&format!("robot[{i}]"), robot)?;
        }
        for (i, probe) in self.probe.iter().enumerate() {
            self.check_probe(&format!("probe[{i}]"), probe)?;
        }
        self.normalise_rotations();
        self.check_overlaps()?;
        for (i, tool) in self.tool.iter().enumerate() {
            self.check_tool_place(&format!("tool[{i}]"), tool)?;
        }
        Ok(())
    }

    /// What messages call a soft body: by its name, or by its number if it has none.
    pub(crate) fn name_of_body(&self, i: usize) -> String {
        let name = &self.body[i].name;
        if name.is_empty() { format!("body[{i}]") } else { format!("body '{name}'") }
    }

    /// Warnings about a scene that can be run.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (i, body) in self.body.iter().enumerate() {
            warnings.extend(self.nearly_at_walls(i, body));
            let cells = self.spacing(body) / self.world.cell;
            if !(0.33..=0.67).contains(&cells) {
                let name = self.name_of_body(i);
                warnings.push(format!(
                    "{name}: spacing is {cells:.2} cells, {:.1} particles a cell; outside 0.33 to 0.67 it costs more than it gains, or gaps open under stretch",
                    cells.powi(-3)
                ));
            }
            if let (Shape::Box { .. }, Some(b)) = (&body.shape, body.shape.bounds()) {
                let b = b.intersection(&self.world_box());
                let share = (0..3)
                    .map(|d| {
                        let n = (b.max[d] - b.min[d]) / self.spacing(body);
                        n.round() / n
                    })
                    .product::<f64>();
                if (share - 1.0).abs() > 0.01 {
                    warnings.push(format!(
                        "{}: its sides are no whole numbers of spacings, so its particles hold {:+.1} % of its volume",
                        self.name_of_body(i),
                        100.0 * (share - 1.0)
                    ));
                }
            }
        }
        warnings
    }

    /// Distance between neighbouring particles of a body [m].
    pub fn spacing(&self, body: &Body) -> f64 {
        body.spacing.unwrap_or(0.5 * self.world.cell)
    }

    /// The world as a box.
    pub fn world_box(&self) -> Aabb {
        Aabb { min: self.world.min, max: self.world.max }
    }

    /// The world as a box, without ends where it meets itself: beyond them is among images of the ground.
    pub fn reached_box(&self) -> Aabb {
        let mut reached = self.world_box();
        for d in (0..3).filter(|d| self.world.is_periodic(*d)) {
            (reached.min[d], reached.max[d]) = (f64::NEG_INFINITY, f64::INFINITY);
        }
        reached
    }

    pub(super) fn require(
        &self,
        holds: bool,
        path: &str,
        what: impl Into<String>,
        mend: impl Into<String>,
    ) -> Result<()> {
        if holds { Ok(()) } else { Err(self.fault(path, what, mend)) }
    }

    pub(super) fn positive(&self, path: &str, value: f64) -> Result<()> {
        self.require(value > 0.0, path, format!("is {value}"), "must be above 0")
    }

    pub(super) fn not_negative(&self, path: &str, value: f64) -> Result<()> {
        self.require(value >= 0.0, path, format!("is {value}"), "must be 0 or above")
    }

    /// A rectangle of ground must have an area.
    pub(super) fn check_rectangle(&self, path: &str, min: [f64; 2], max: [f64; 2]) -> Result<()> {
        let check = |d: usize| {
            let what = format!("{} goes from {} to {}", AXES[d], min[d], max[d]);
            self.require(min[d] < max[d], &format!("{path}.max"), what, "max must be above min")
        };
        (0..2).try_for_each(check)
    }

    pub(super) fn rises(&self, path: &str, before: f64, time: f64) -> Result<()> {
        self.require(time > before, path, format!("is {time}, the one before is at {before}"), "times must rise")
    }

    fn check_names(&self) -> Result<()> {
        let good = !self.name.trim().is_empty()
            && !self.name.contains(|c: char| matches!(c, '/' | '\\') || c.is_control())
            && ![".", ".."].contains(&self.name.trim());
        let mend = "it becomes a folder: give a word without slashes and control characters, other than . and ..";
        self.require(good, "name", format!("is '{}'", super::plain(&self.name)), mend)?;
        self.require(
            i64::try_from(self.seed).is_ok(),
            "seed",
            format!("is {}", self.seed),
            format!("must be at most {}", i64::MAX),
        )?;
        self.require(
            self.body.len() + self.inflow.len() <= usize::from(u16::MAX),
            "body",
            format!("there are {} bodies and sources", self.body.len() + self.inflow.len()),
            format!("must be at most {}", u16::MAX),
        )?;
        self.unique("material", self.material.iter().map(|m| m.name.as_str()), true)?;
        self.unique("body", self.body.iter().map(|b| b.name.as_str()), false)?;
        self.unique("tool", self.tool.iter().map(|t| t.name.as_str()), true)?;
        self.unique("robot", self.robot.iter().map(|robot| robot.name.as_str()), true)?;
        self.unique("probe", self.probe.iter().map(|probe| probe.name.as_str()), true)?;
        let couplings = self.coupling_names();
        self.unique("coupling", couplings.iter().map(String::as_str), true)
    }

    fn unique<'a>(&self, list: &str, names: impl Iterator<Item = &'a str>, required: bool) -> Result<()> {
        let mut seen = BTreeMap::new();
        for (i, name) in names.enumerate() {
            let path = format!("{list}[{i}].name");
            self.require(!name.is_empty() || !required, &path, "is empty", "give it a name")?;
            if let Some(first) = seen.insert(name, i).filter(|_| !name.is_empty()) {
                return Err(self.fault(
                    &path,
                    format!("'{name}' is already the name of {list}[{first}]"),
                    "names must differ",
                ));
            }
        }
        Ok(())
    }

    /// No number is NaN or infinite. Parameters are held to their law's ranges instead, which may be infinite.
    fn check_finite(&self) -> Result<()> {
        fn bad(value: &toml::Value, path: String) -> Option<(String, f64)> {
            match value {
                toml::Value::Float(x) if !x.is_finite() => Some((path, *x)),
                toml::Value::Array(items) => {
                    items.iter().enumerate().find_map(|(i, item)| bad(item, format!("{path}[{i}]")))
                }
                toml::Value::Table(table) => table
                    .iter()
                    .filter(|(key, _)| *key != "parameters")
                    .find_map(|(key, v)| bad(v, if path.is_empty() { key.clone() } else { format!("{path}.{key}") })),
                _ => None,
            }
        }
        let value = toml::Value::try_from(self)
            .map_err(|e| self.fault("scene", e.to_string(), "use values that TOML can hold"))?;
        match bad(&value, String::new()) {
            Some((path, x)) => Err(self.fault(&path, format!("is {x}"), "give a finite number")),
            None => Ok(()),
        }
    }

    fn check_world(&self) -> Result<()> {
        let world = &self.world;
        self.positive("world.cell", world.cell)?;
        for (d, axis) in AXES.into_iter().enumerate() {
            self.require(
                world.min[d] < world.max[d],
                "world.max",
                format!("{axis} goes from {} to {}", world.min[d], world.max[d]),
                "world.max must be above world.min",
            )?;
            let walls = world.walls.pair(d);
            let periodic = walls.map(|wall| wall == Wall::Periodic);
            let key = |side: usize| format!("world.walls.{axis}_{}", ["min", "max"][side]);
            let mut whole = [0_i64; 2];
            for (side, x) in [world.min[d], world.max[d]].into_iter().enumerate() {
                let cells = x / world.cell;
                let path = ["world.min", "world.max"][side];
                self.require(
                    cells.abs() <= MOST_CELLS,
                    path,
                    format!("{axis} = {x} m is {:.0} cells from the origin", cells.abs()),
                    format!("must be at most {MOST_CELLS:.0}: use larger cells or move the scene"),
                )?;
                // An open side may lie anywhere.
                let off = (cells - cells.round()).abs();
                self.require(
                    walls[side] == Wall::Open || off <= WHOLE_CELL,
                    path,
                    format!("{axis} = {x} m is {cells:.6} cells, and the wall there must lie on a cell's face"),
                    format!("the nearest are {} and {}", cells.floor() * world.cell, cells.ceil() * world.cell),
                )?;
                whole[side] = cells.round() as i64;
                if let Wall::Separate { friction } = walls[side] {
                    self.not_negative(&format!("{}.separate.friction", key(side)), friction)?;
                }
            }
            if periodic[0] != periodic[1] {
                let other = usize::from(periodic[0]);
                return Err(self.fault(
                    &key(1 - other),
                    format!("is periodic, but {} is not", key(other)),
                    "make both sides periodic or neither",
                ));
            }
            self.require(
                !periodic[0] || whole.iter().all(|cells| cells % BLOCK == 0),
                &key(0),
                format!(
                    "a periodic axis goes in blocks of {BLOCK} cells, and {axis} from cell {} to {}",
                    whole[0], whole[1]
                ),
                format!(
                    "use sides at multiples of {} m, such as {} and {}",
                    BLOCK as f64 * world.cell,
                    (whole[0].div_euclid(BLOCK) * BLOCK) as f64 * world.cell,
                    ((whole[1] + BLOCK - 1).div_euclid(BLOCK) * BLOCK) as f64 * world.cell
                ),
            )?;
        }
        Ok(())
    }

    fn check_sleep(&self) -> Result<()> {
        let (on, speed) = (self.sleep.on == Some(true), self.sleep.speed);
        self.require(
            speed.is_none_or(|speed| speed > 0.0 && speed.is_finite()),
            "sleep.speed",
            format!("is {}", speed.unwrap_or_default()),
            "must be above 0; to keep all ground awake, set sleep.on = false",
        )?;
        self.require(
            !on || speed.is_some() || self.gravity != [0.0; 3],
            "sleep.on",
            "is true without gravity, which sets what counts as slow".to_owned(),
            "give sleep.speed",
        )?;
        self.require(
            !on || !self.world.walls.let_go(),
            "sleep.on",
            "is true, and a wall that separates has to look at all nodes along it in each step".to_owned(),
            "use slip or stick walls, or leave sleep.on out",
        )
    }

    fn check_levels(&self) -> Result<()> {
        let levels = &self.levels;
        self.require(
            (1..=MOST_LEVELS).contains(&levels.count),
            "levels.count",
            format!("is {}", levels.count),
            format!("must be from 1 to {MOST_LEVELS}"),
        )?;
        self.check_half("levels.half", levels.half)?;
        self.require(
            levels.tolerance >= 0.0 && levels.tolerance <= 1.0,
            "levels.tolerance",
            format!("is {}", levels.tolerance),
            "must be from 0 to 1",
        )?;
        self.check_agents()?;
        self.require(
            levels.count == 1 || !levels.subcycle || !self.world.walls.let_go(),
            "levels.subcycle",
            "is set in a world with a wall that lets go of the ground",
            "use slip or stick walls, or leave subcycling out",
        )?;
        self.check_boxes()?;
        self.check_reach()?;
        // Walls are faces of the coarsest cells too, and periodic axes are whole blocks of them.
        let coarsest = 1_i64 << (levels.count - 1);
        for (d, axis) in AXES.into_iter().enumerate() {
            for (side, wall) in self.world.walls.pair(d).into_iter().enumerate() {
                let unit = match wall {
                    Wall::Open => continue,
                    Wall::Periodic => BLOCK * coarsest,
                    _ => coarsest,
                };
                let x = [self.world.min[d], self.world.max[d]][side];
                let cells = (x / self.world.cell).round() as i64;
                let width = unit as f64 * self.world.cell;
                self.require(
                    cells % unit == 0,
                    ["world.min", "world.max"][side],
                    format!(
                        "{axis} = {x} m is {cells} cells, and the {} levels need a multiple of {unit} there",
                        levels.count
                    ),
                    format!("the nearest are {} and {}", (x / width).floor() * width, (x / width).ceil() * width),
                )?;
            }
        }
        Ok(())
    }

    /// Ground that is seeded as agents come near: tools to follow, sides that need not be joined, and bodies whose shape and
    /// weight say at any time how they were at the start.
    fn check_reach(&self) -> Result<()> {
        let levels = &self.levels;
        if levels.reach == 0 {
            return Ok(());
        }
        let path = "levels.reach";
        self.require(
            (NESTING as u32..=MOST_REACH).contains(&levels.reach),
            path,
            format!("is {}", levels.reach),
            format!("must be from {NESTING} to {MOST_REACH} cells of the coarsest level, or 0 for the whole world"),
        )?;
        self.require(
            levels.count > 1,
            path,
            "needs levels to nest",
            "set levels.count to 2 or more, or leave reach out",
        )?;
        for (d, axis) in AXES.into_iter().enumerate().take(2) {
            self.require(
                self.world.walls.pair(d)[0] != Wall::Periodic,
                path,
                format!("ends somewhere, and {axis} is periodic"),
                "use other walls, or leave reach out",
            )?;
        }
        let moves = |tool: &Tool| !matches!(tool.motion, Motion::Fixed);
        let follows_body = |agent: &LevelAgent| self.body.iter().any(|body| body.name == agent.name);
        let any = self.tool.iter().any(moves) || !self.robot.is_empty() || !self.coupling.is_empty();
        self.require(
            levels.agents.as_ref().map_or(any, |names| !names.is_empty()),
            path,
            "follows agents, and there is none",
            "name tools in levels.agents, or add one that moves",
        )?;
        self.require(
            !levels.agents.iter().flatten().any(follows_body),
            path,
            "follows tools, and levels.agents names a body",
            "name tools only, or leave reach out",
        )?;
        for (i, body) in self.body.iter().enumerate() {
            self.require(
                body.shape.is_layer() && !body.moves(),
                path,
                format!("brings in ground piece by piece, and body[{i}] is no box, height_field or terrain at rest"),
                "change the body, or leave reach out",
            )?;
            self.require(
                body.settled || self.gravity == [0.0; 3],
                path,
                format!("brings in ground at rest, and body[{i}] would fall into itself"),
                format!("set body[{i}].settled = true"),
            )?;
        }
        Ok(())
    }

    fn check_time_and_output(&self) -> Result<()> {
        self.positive("time.end", self.time.end)?;
        if let Some(step) = self.time.step {
            self.positive("time.step", step)?;
        }
        let safety = self.time.safety;
        self.require(
            safety > 0.0 && safety <= 1.0,
            "time.safety",
            format!("is {safety}"),
            "must be above 0 and at most 1",
        )?;
        self.positive("output.interval", self.output.interval)?;
        if let Some(interval) = self.output.snapshot_interval {
            self.positive("output.snapshot_interval", interval)?;
        }
        if let Some(interval) = self.output.trace.interval {
            self.positive("output.trace.interval", interval)?;
        }
        self.check_ground_output()?;
        let picture = &self.output.picture;
        self.require(
            (16..=16_384).contains(&picture.pixels),
            "output.picture.pixels",
            format!("is {}", picture.pixels),
            "must be from 16 to 16384",
        )?;
        let y = picture.cut_y.unwrap_or(self.world.min[1]);
        self.require(
            self.world.min[1] <= y && y <= self.world.max[1],
            "output.picture.cut_y",
            format!("is {y}"),
            format!("must be inside the world, from {} to {}", self.world.min[1], self.world.max[1]),
        )?;
        picture.camera.as_ref().map_or(Ok(()), |camera| self.check_camera(camera))
    }

    fn check_body(&self, path: &str, body: &Body) -> Result<()> {
        self.check_material_name(&format!("{path}.material"), &body.material)?;
        self.check_spacing(&format!("{path}.spacing"), self.spacing(body))?;
        let shape = format!("{path}.shape");
        self.check_fillable(&shape, &body.shape)?;
        self.check_shape(&shape, &body.shape)?;
        self.check_settled(path, body)?;
        self.check_zones(path, body)?;
        match body.shape.bounds() {
            Some(bounds) => self.check_inside(path, bounds),
            None => Ok(()),
        }
    }

    fn check_spacing(&self, path: &str, spacing: f64) -> Result<()> {
        let cells = spacing / self.world.cell;
        // A quotient is off by rounding.
        let (least, most) = (SPACINGS.start() * (1.0 - WHOLE_CELL), SPACINGS.end() * (1.0 + WHOLE_CELL));
        self.require(
            (least..=most).contains(&cells),
            path,
            format!("is {spacing} m, {cells:.3} cells"),
            format!("must be from 0.2 to 1 cells, {} to {} m", 0.2 * self.world.cell, self.world.cell),
        )
    }

    /// Can particles fill the shape?
    fn check_fillable(&self, path: &str, shape: &Shape) -> Result<()> {
        self.require(
            !shape.any(|shape| matches!(shape, Shape::Plane { .. })),
            path,
            "planes are for tools",
            "use box, sphere, cylinder, capsule, height_field, terrain, mesh, or a union, a difference or an intersection of these",
        )
    }

    pub(super) fn check_material_name(&self, path: &str, name: &str) -> Result<()> {
        if self.material.iter().any(|material| material.name == name) {
            return Ok(());
        }
        Err(Error::Unknown {
            path: self.place(path),
            kind: "material of this scene",
            name: name.to_owned(),
            known: self.material.iter().map(|material| material.name.clone()).collect(),
        })
    }

    /// No two bodies have the same shape at the same place: matter would be there twice.
    fn check_overlaps(&self) -> Result<()> {
        let mut seen: BTreeMap<String, usize> = BTreeMap::new();
        for (i, body) in self.body.iter().enumerate() {
            // A box may be given by its corners or by its middle.
            let place = match (&body.shape, body.shape.bounds()) {
                (Shape::Box { .. }, Some(bounds)) => format!("box {:?} {:?}", bounds.min, bounds.max),
                (shape, _) => format!("{shape:?}"),
            };
            if let Some(first) = seen.insert(place, i) {
                return Err(self.fault(
                    &format!("body[{i}].shape"),
                    format!("is exactly where body[{first}] is: the two overlap in all of their volume"),
                    "move or cut one of them, or leave it out",
                ));
            }
        }
        Ok(())
    }

    /// Settled ground has a weight along -z from the start, and rests.
    fn check_settled(&self, path: &str, body: &Body) -> Result<()> {
        if let Some(k0) = body.k0 {
            let path = format!("{path}.k0");
            self.require(
                (0.0..=MOST_K0).contains(&k0),
                &path,
                format!("is {k0}"),
                format!("must be from 0 to {MOST_K0}"),
            )?;
            self.require(
                body.settled,
                &path,
                "is the share of the weight that presses sideways, and the body does not bear its weight from the start",
                "set settled = true, or leave k0 out",
            )?;
        }
        if !body.settled {
            return Ok(());
        }
        let path = format!("{path}.settled");
        let [x, y, z] = self.gravity;
        self.require(
            x == 0.0 && y == 0.0 && z <= 0.0,
            &path,
            format!("works in gravity along -z, and gravity is {:?}", self.gravity),
            "leave settled out, or turn the scene",
        )?;
        self.require(
            self.gravity_ramp == 0.0,
            &path,
            format!("asks for the whole weight from the start, and gravity_ramp is {} s", self.gravity_ramp),
            "set one of the two",
        )?;
        self.require(
            !body.moves(),
            &path,
            "asks for ground at rest, and the body has a velocity",
            "leave out settled or the velocity",
        )
    }

    /// A body must lie inside the world.
    pub(crate) fn check_inside(&self, path: &str, bounds: Aabb) -> Result<()> {
        let world = self.world_box().grown(WHOLE_CELL * self.world.cell);
        for (d, axis) in AXES.into_iter().enumerate() {
            let [low, high] = self.world.walls.pair(d).map(|wall| self.cuts(d) && wall == Wall::Slip);
            self.require(
                (low || world.min[d] <= bounds.min[d]) && (high || bounds.max[d] <= world.max[d]),
                &format!("{path}.shape"),
                format!(
                    "reaches out of the world: {axis} from {} to {}, the world from {} to {}",
                    bounds.min[d], bounds.max[d], self.world.min[d], self.world.max[d]
                ),
                "move or shrink it, or widen world.min and world.max",
            )?;
        }
        Ok(())
    }

    pub(super) fn check_shape(&self, path: &str, shape: &Shape) -> Result<()> {
        match shape {
            Shape::Box { min, max, half, center } => {
                let path = format!("{path}.box");
                match (min, max, half, center) {
                    (Some(min), Some(max), None, None) => {
                        for (d, axis) in AXES.into_iter().enumerate() {
                            self.require(
                                min[d] < max[d],
                                &format!("{path}.max"),
                                format!("{axis} goes from {} to {}: the box has no volume", min[d], max[d]),
                                "max must be above min",
                            )?;
                        }
                        Ok(())
                    }
                    (None, None, Some(half), _) => {
                        half.iter().try_for_each(|x| self.positive(&format!("{path}.half"), *x))
                    }
                    _ => Err(self.fault(
                        &path,
                        "is given by too much or too little",
                        "give min and max, or half (with center if it is not at the origin), and not both",
                    )),
                }
            }
            Shape::Sphere { radius, .. } => self.positive(&format!("{path}.sphere.radius"), *radius),
            Shape::Cylinder { radius, half_height, .. } => {
                self.positive(&format!("{path}.cylinder.radius"), *radius)?;
                self.positive(&format!("{path}.cylinder.half_height"), *half_height)
            }
            Shape::Capsule { radius, half_height, .. } => {
                self.positive(&format!("{path}.capsule.radius"), *radius)?;
                self.positive(&format!("{path}.capsule.half_height"), *half_height)
            }
            Shape::Plane { normal, .. } => self.require(
                normal.iter().any(|n| *n != 0.0),
                &format!("{path}.plane.normal"),
                "is zero",
                "give the direction out of the solid",
            ),
            Shape::HeightField { min, max, bottom, heights, file } => {
                let path = format!("{path}.height_field");
                self.check_rectangle(&path, *min, *max)?;
                self.require(
                    heights.is_empty() != file.is_none(),
                    &path,
                    "has both or neither of heights and file",
                    "give one of them",
                )?;
                if heights.is_empty() {
                    Ok(())
                } else {
                    self.check_heights(&format!("{path}.heights"), heights, *bottom)
                }
            }
            Shape::Terrain(terrain) => self.check_terrain(&format!("{path}.terrain"), terrain),
            Shape::Mesh { scale, rotation, .. } => {
                self.positive(&format!("{path}.mesh.scale"), *scale)?;
                self.check_rotation(&format!("{path}.mesh.rotation"), rotation)
            }
            Shape::Union(parts) => self.check_parts(&format!("{path}.union"), parts),
            Shape::Difference(parts) => self.check_parts(&format!("{path}.difference"), parts),
            Shape::Intersection(parts) => self.check_parts(&format!("{path}.intersection"), parts),
        }
    }

    fn check_parts(&self, path: &str, parts: &[Placed]) -> Result<()> {
        self.require(!parts.is_empty(), path, "is empty", "give at least one shape")?;
        for (i, Placed { shape, rotation, .. }) in parts.iter().enumerate() {
            self.check_rotation(&format!("{path}[{i}].rotation"), rotation)?;
            self.check_shape(&format!("{path}[{i}].shape"), shape)?;
        }
        Ok(())
    }

    /// Heights must form a grid of at least 2 x 2 and rise above the bottom somewhere.
    pub(crate) fn check_heights(&self, path: &str, heights: &[Vec<f64>], bottom: f64) -> Result<()> {
        let columns = heights.first().map_or(0, Vec::len);
        self.require(
            heights.len() >= 2 && columns >= 2,
            path,
            format!("has {} rows of {columns}", heights.len()),
            "give at least 2 rows of 2 heights",
        )?;
        for (j, row) in heights.iter().enumerate() {
            self.require(
                row.len() == columns,
                &format!("{path}[{j}]"),
                format!("has {} heights, the first row {columns}", row.len()),
                "rows must be equally long",
            )?;
            self.require(
                row.iter().all(|h| h.is_finite()),
                &format!("{path}[{j}]"),
                "holds NaN or infinity",
                "give finite heights",
            )?;
        }
        self.require(
            heights.iter().flatten().any(|h| *h > bottom),
            path,
            format!("nowhere rises above bottom = {bottom}"),
            "lower bottom or raise the heights",
        )
    }

    pub(super) fn check_rotation(&self, path: &str, q: &[f64; 4]) -> Result<()> {
        self.require(
            q.iter().map(|c| c * c).sum::<f64>() > 1e-12,
            path,
            "is the zero quaternion",
            "[1, 0, 0, 0] is no rotation",
        )
    }

    fn normalise_rotations(&mut self) {
        fn in_shape(shape: &mut Shape) {
            match shape {
                Shape::Mesh { rotation, .. } => normalise(rotation),
                Shape::Union(parts) | Shape::Difference(parts) | Shape::Intersection(parts) => {
                    parts.iter_mut().for_each(|part| {
                        normalise(&mut part.rotation);
                        in_shape(&mut part.shape);
                    })
                }
                _ => {}
            }
        }
        let bodies = self.body.iter_mut().map(|body| &mut body.shape);
        let sources = self.inflow.iter_mut().map(|source| &mut source.shape);
        let sinks = self.outflow.iter_mut().map(|sink| &mut sink.shape);
        bodies.chain(sources).chain(sinks).for_each(in_shape);
        self.robot.iter_mut().for_each(|robot| normalise(&mut robot.rotation));
        for tool in &mut self.tool {
            in_shape(&mut tool.shape);
            normalise(&mut tool.rotation);
            if let Motion::Keyframes { frames, .. } = &mut tool.motion {
                frames.iter_mut().filter_map(|f| f.rotation.as_mut()).for_each(normalise);
            }
        }
    }

    /// File, line and key path in one text, for errors that have only a path.
    pub(crate) fn place(&self, path: &str) -> String {
        match self.fault(path, "", "") {
            Error::Scene { file, line: 0, .. } => format!("{file}: {path}"),
            Error::Scene { file, line, .. } => format!("{file}:{line}: {path}"),
            _ => path.to_owned(),
        }
    }
}
