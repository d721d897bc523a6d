//! Scenes: what a user writes.
//!
//! A scene is a TOML file, checked key by key. The structs here are the file's format; doc comments become the JSON Schema's
//! descriptions. Lengths in metres, angles in radians unless the key ends in `_deg`, z up.

use crate::parameter::{Giver, Parameter, Parameters, Table};
use crate::{Result, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod agents;
mod check;
mod flow;
mod make;
mod output;
mod periodic;
mod plane;
mod probe;
mod read;
mod robot;
mod terrain;
mod zone;

pub use agents::{AgentPart, LevelAgent};
pub use check::WHOLE_CELL;
pub(crate) use check::{cross, posed_bounds, turn};
pub use flow::{Inflow, Outflow};
pub use make::Part;
pub use output::{Camera, CutColour, Export, HeightOutput, Output, Picture, PictureView, SurfaceOutput, Trace};
pub use plane::PlaneStrain;
pub use probe::{Probe, Region, Section, Side, SurfaceProbe, WallPart};
pub use read::Source;
pub(crate) use read::{nearest, parse_value};
pub use robot::{Balance, CollisionMeshes, Gait, JointFrame, JointMotion, Lean, LinkPath, Motor, Robot, Scan};
pub use terrain::{Heights, Surface, Terrain};
pub use zone::{Within, Zone, ZonePicture};

/// A scene.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Name; also the default output folder.
    pub name: String,
    /// One sentence for people.
    #[serde(default)]
    pub doc: String,
    /// Seed of everything random.
    #[serde(default)]
    pub seed: u64,
    /// Gravity [m/s²].
    #[serde(default = "default_gravity")]
    pub gravity: Vec3,
    /// Seconds over which gravity grows evenly from zero to its value, so that ground settles without a shock.
    #[serde(default)]
    pub gravity_ramp: f64,
    /// Extent, resolution and walls.
    pub world: World,
    /// Cut soft bodies and mouths of sources at slip walls, instead of refusing those that reach out of the world: half of a symmetric scene is that scene.
    /// Tools reach through walls anyway.
    #[serde(default)]
    pub clip: bool,
    /// Nested levels of resolution.
    #[serde(default)]
    pub levels: Levels,
    /// Ground at rest, left out until something stirs it.
    #[serde(default)]
    pub sleep: Sleep,
    /// Duration and time step.
    pub time: Time,
    /// What is written, and how often.
    #[serde(default)]
    pub output: Output,
    /// Materials, by the name that bodies use.
    #[serde(default)]
    pub material: Vec<MaterialSpec>,
    /// Soft bodies.
    #[serde(default)]
    pub body: Vec<Body>,
    /// Sources: where particles come in.
    #[serde(default, rename = "source")]
    pub inflow: Vec<Inflow>,
    /// Sinks: where particles are taken out.
    #[serde(default, rename = "sink")]
    pub outflow: Vec<Outflow>,
    /// Rigid tools and bodies.
    #[serde(default)]
    pub tool: Vec<Tool>,
    /// Robots of links and joints.
    #[serde(default)]
    pub robot: Vec<Robot>,
    /// Couplings other than rigid tools, from plugins: one for each entry.
    #[serde(default)]
    pub coupling: Vec<CouplingSpec>,
    /// What the run measures while it goes on.
    #[serde(default)]
    pub probe: Vec<Probe>,
    /// What an agent is to do in it, from a plugin.
    #[serde(default)]
    pub task: Option<TaskSpec>,
    /// Folder that relative paths in the scene start from.
    #[serde(skip)]
    pub folder: PathBuf,
    /// Where its keys stand in the file, for messages.
    #[serde(skip)]
    pub source: Arc<Source>,
}

impl Scene {
    /// Is a tool solved in one system with all that is rigid and the ground, as robots are? Those that answer what they feel are, where there is more for them to touch
    /// than walls: robots, or beside a free tool any other one.
    pub fn goes_with_robots(&self, tool: &Tool) -> bool {
        let may_touch =
            || self.tool.len() > 1 && self.tool.iter().any(|tool| matches!(tool.motion, Motion::Free { .. }));
        tool.answers() && (!self.robot.is_empty() || may_touch())
    }

    /// Is anything solved as robots are?
    pub fn has_robots(&self) -> bool {
        !self.robot.is_empty() || self.tool.iter().any(|tool| self.goes_with_robots(tool))
    }

    /// The tools that move by themselves, with their numbers: all but those that [go with robots](Self::goes_with_robots).
    pub fn tools_apart(&self) -> impl Iterator<Item = (usize, &Tool)> {
        self.tool.iter().enumerate().filter(|(_, tool)| !self.goes_with_robots(tool))
    }

    /// The files that its shapes are read from, as it names them, each once. Those that plugins' parameters name are found when it is planned.
    pub fn files(&self) -> BTreeSet<&Path> {
        fn add<'a>(shape: &'a Shape, files: &mut BTreeSet<&'a Path>) {
            match shape {
                Shape::Mesh { file, .. } | Shape::HeightField { file: Some(file), .. } => {
                    files.insert(file);
                }
                _ => shape.parts().iter().for_each(|part| add(&part.shape, files)),
            }
        }
        let mut files = BTreeSet::new();
        let shapes = self.body.iter().map(|body| &body.shape).chain(self.tool.iter().map(|tool| &tool.shape));
        let flows = self.inflow.iter().map(|source| &source.shape).chain(self.outflow.iter().map(|sink| &sink.shape));
        shapes.chain(flows).for_each(|shape| add(shape, &mut files));
        files.extend(self.probe.iter().filter_map(|probe| probe.chamfer.as_deref()));
        let pictures = self.body.iter().flat_map(|body| &body.zone).filter_map(|zone| zone.picture.as_ref());
        files.extend(pictures.map(|picture| picture.file.as_path()));
        for robot in &self.robot {
            files.extend(
                robot
                    .urdf
                    .iter()
                    .chain(robot.motion.iter().filter_map(|motion| motion.file.as_ref()))
                    .map(PathBuf::as_path),
            );
        }
        files
    }

    /// Names of the couplings of its entries, in their order.
    pub fn coupling_names(&self) -> Vec<String> {
        let mut unnamed: BTreeMap<&str, usize> = BTreeMap::new();
        let mut names = Vec::new();
        for spec in &self.coupling {
            names.push(match &spec.name {
                Some(name) => name.clone(),
                None => {
                    let count = unnamed.entry(&spec.kind).or_default();
                    *count += 1;
                    if *count == 1 { spec.kind.clone() } else { format!("{}-{count}", spec.kind) }
                }
            });
        }
        names
    }

    /// Holds what one of its tables gives to what a plugin declares; `path` is the table's key path.
    ///
    /// # Errors
    /// [`Error::Scene`] with the line and key of what is wrong.
    pub(crate) fn resolve(
        &self,
        whose: String,
        declared: &[Parameter],
        given: &Table,
        path: &str,
    ) -> Result<Parameters> {
        let fault = |path: &str, what: String, mend: String| self.fault(path, what, mend);
        Giver { whose, folder: &self.folder, fault: &fault }.resolve(declared, given, path)
    }

    /// Mean gravity over a step that starts at `time` [m/s²].
    pub fn gravity_at(&self, time: f64) -> Vec3 {
        let grown = self.grown_gravity(time);
        self.gravity.map(|g| g * grown)
    }

    /// How much of gravity is there in that step.
    pub fn grown_gravity(&self, time: f64) -> f64 {
        if self.gravity_grows(time) { time / self.gravity_ramp } else { 1.0 }
    }

    /// Is a time [s] before that at which all of gravity is there?
    pub fn gravity_grows(&self, time: f64) -> bool {
        time < self.gravity_ramp
    }
}

/// Text of a scene or a plugin, on one line and without control characters: what it says cannot act on a terminal or pass for another line.
pub fn plain(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).collect()
}

/// Names by what is to be said of them, so that one sentence says it of all: in the order of the first of each, with quotes and commas, and whether there are
/// several.
pub fn named_together<N: Display, K: PartialEq>(all: impl IntoIterator<Item = (N, K)>) -> Vec<(String, bool, K)> {
    let mut groups: Vec<(String, bool, K)> = Vec::new();
    for (name, said) in all {
        match groups.iter_mut().find(|group| group.2 == said) {
            Some((names, several, _)) => {
                *names += &format!(", '{name}'");
                *several = true;
            }
            None => groups.push((format!("'{name}'"), false, said)),
        }
    }
    groups
}

/// Does a text fit a pattern, in which * stands for any text?
pub fn fits(pattern: &str, text: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let Some(mut rest) = text.strip_prefix(first) else { return false };
    let Some(last) = parts.next_back() else { return rest.is_empty() };
    for part in parts {
        match rest.find(part) {
            Some(at) => rest = &rest[at + part.len()..],
            None => return false,
        }
    }
    rest.ends_with(last)
}

fn yes() -> bool {
    true
}

fn default_gravity() -> Vec3 {
    [0.0, 0.0, -9.81]
}

/// Extent, resolution and walls.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Width of the finest cell [m].
    pub cell: f64,
    /// Least corner [m]; a whole number of cells from the origin. Sides without a wall may lie anywhere.
    pub min: Vec3,
    /// Greatest corner [m].
    pub max: Vec3,
    /// Walls on the six sides.
    #[serde(default)]
    pub walls: Walls,
    /// What happens to a particle that crosses an open side or a wall.
    #[serde(default)]
    pub leaving: Leaving,
    /// A world a few cells thick, in which nothing varies along y.
    #[serde(default)]
    pub plane_strain: Option<PlaneStrain>,
}

/// Nested levels of resolution: fine around agents, coarser further away.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Levels {
    /// Number of levels; cells of each are twice as wide as those of the next finer one. With 1 there is nothing to nest.
    #[serde(default = "one_level")]
    pub count: u32,
    /// Cells of a level from the middle of its box around an agent to each of its sides: boxes are twice as many cells wide, and wider where the agent
    /// is. Even, from 8 to 512. Ground that a tool presses should be fine for 6 cells below the tool's lowest point, and a box follows its agent only once
    /// that is 4 cells off its middle: so 10 more than half the tool's height. With less, the coarse ground beyond the box's bottom, its rim, makes the tool
    /// feel more (a sphere 7.5 % with 8, 0.1 % with 12), and the plan warns. The coarsest level is the whole world, or what is within `reach`.
    #[serde(default = "default_half")]
    pub half: u32,
    /// The tools, bodies and links of robots that the boxes follow: names, or tables such as `{ name = "dog", half = 8, offset = [0.0, 0.0, -0.1],
    /// at = "lowest" }`. Absent: all tools that move, and the links at the ends of robots.
    #[serde(default)]
    pub agents: Option<Vec<LevelAgent>>,
    /// Boxes that stay where they are, and in which ground is as fine as around agents: the finest level reaches 4 cells further, and no less than `half`
    /// cells from a box's middle to each side.
    #[serde(default, rename = "box")]
    pub boxes: Vec<Within>,
    /// Steps twice as long on each coarser level.
    #[serde(default)]
    pub subcycle: bool,
    /// Cells of the coarsest level around the agents' boxes in which ground is live. What lies further away stays what the bodies'
    /// shapes say until it comes within reach, and what agents have changed is kept when it falls out of reach. 0: the whole
    /// world is live.
    #[serde(default)]
    pub reach: u32,
    /// Particles at the surface are not merged where that would move the surface by more than this, in sides of the merged
    /// particle; and particles are not merged if their history differs by more. For ground that falls out of `reach` three
    /// times as much holds.
    #[serde(default = "default_tolerance")]
    pub tolerance: f64,
}

fn one_level() -> u32 {
    1
}
fn default_half() -> u32 {
    32
}
fn default_tolerance() -> f64 {
    0.1
}

impl Levels {
    /// Steps of the finest level in one step of the simulation.
    pub fn substeps(&self) -> u32 {
        if self.subcycle { 1 << (self.count - 1) } else { 1 }
    }
}

impl Default for Levels {
    fn default() -> Self {
        Self {
            count: one_level(),
            half: default_half(),
            agents: None,
            boxes: Vec::new(),
            subcycle: false,
            reach: 0,
            tolerance: default_tolerance(),
        }
    }
}

/// Ground at rest: where nothing has moved for 50 steps, nothing is computed until something stirs it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sleep {
    /// May ground sleep? Absent: yes, if there is gravity, no law feels the rate of deformation and no wall lets go; on the backend
    /// wgpu, where watching over it costs more, only if a speed is given.
    #[serde(default)]
    pub on: Option<bool>,
    /// Speed along an axis up to which ground counts as being at rest [m/s]; absent: 1e-4 of sqrt(g h), for the finest cell h, and in
    /// steps so short that what falls would be slow for 50 of them, less.
    #[serde(default)]
    pub speed: Option<f64>,
}

/// Walls on the six sides of the world.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Walls {
    /// Side of least x.
    #[serde(default)]
    pub x_min: Wall,
    /// Side of greatest x.
    #[serde(default)]
    pub x_max: Wall,
    /// Side of least y.
    #[serde(default)]
    pub y_min: Wall,
    /// Side of greatest y.
    #[serde(default)]
    pub y_max: Wall,
    /// Floor.
    #[serde(default)]
    pub z_min: Wall,
    /// Ceiling.
    #[serde(default)]
    pub z_max: Wall,
}

/// What a side of the world does to the ground.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Wall {
    /// No wall.
    #[default]
    Open,
    /// No motion through it, free motion along it.
    Slip,
    /// No motion at it.
    Stick,
    /// No motion through it but free motion away from it, with Coulomb friction along it.
    Separate {
        /// Coefficient of friction.
        #[serde(default)]
        friction: f64,
    },
    /// What leaves here enters at the opposite side, which must be periodic too; both must lie at multiples of 4 cells.
    Periodic,
}

/// What happens to a particle that leaves the world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Leaving {
    /// The run stops with an error.
    #[default]
    Error,
    /// The particle is put back to the side it crossed, its outward velocity is taken, and the impulse is booked.
    Clamp,
    /// The particle is deleted and its mass is booked.
    Delete,
}

/// Duration and time step.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Time {
    /// Simulated seconds.
    pub end: f64,
    /// Time step of the finest level [s]; absent: as large as `safety` allows. With `levels.subcycle` coarser levels take longer ones, and what is counted as a
    /// step, in plans and traces too, is one of the coarsest level: 2 to the power of `levels.count` - 1 of these.
    #[serde(default)]
    pub step: Option<f64>,
    /// Fraction of the stability bound that an automatic step uses.
    #[serde(default = "default_safety")]
    pub safety: f64,
    /// What happens when `step` is above the stability bound.
    #[serde(default)]
    pub over_bound: OverBound,
}

fn default_safety() -> f64 {
    0.6
}

/// What happens when the scene's step is above the stability bound.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OverBound {
    /// The run is refused, or stops.
    #[default]
    Refuse,
    /// Each step is cut into as many as needed, and the summary says how many.
    Substep,
    /// The step is taken all the same; energy growth is watched and stops the run.
    Allow,
}

/// A material of the scene.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MaterialSpec {
    /// Name that bodies use.
    pub name: String,
    /// Name of the law in the registry; see `barchan plugins`.
    pub law: String,
    /// Density at rest [kg/m³].
    pub density: f64,
    /// Damping of elastic strain, a time β [s]; 0: none. To the stress comes β times what the linear law, with the stiffness at rest, gives for the elastic
    /// part of the rate of strain; flow is not slowed. A wave of angular frequency ω dies away as exp(-½ β ω² t), by the ratio ζ = ½ β ω to critical damping:
    /// so β = 2 ζ/ω with ω of the slowest wave, which for a bed of depth H and speed of sound c is π c/(2 H). A step that could be dt long without it may be
    /// sqrt(β² + dt²) - β.
    #[serde(default)]
    pub damping: f64,
    /// Parameters of the law; those absent keep their defaults. An angle may be given in degrees as `<name>_deg`.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
}

/// A soft body.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Name for messages.
    #[serde(default)]
    pub name: String,
    /// Name of a material of the scene.
    pub material: String,
    /// Where it is of other materials: layers by depth, boxes, and what a picture shows.
    #[serde(default)]
    pub zone: Vec<Zone>,
    /// Where it is.
    pub shape: Shape,
    /// Distance between neighbouring particles [m]; absent: half a cell.
    #[serde(default)]
    pub spacing: Option<f64>,
    /// How particles are placed.
    #[serde(default)]
    pub sampling: Sampling,
    /// Velocity [m/s].
    #[serde(default)]
    pub velocity: Vec3,
    /// Angular velocity about the body's centre of mass [rad/s].
    #[serde(default)]
    pub angular_velocity: Vec3,
    /// Gradient of the velocity, row by row [1/s]: to `velocity` comes this times the way from the body's centre of mass.
    #[serde(default)]
    pub velocity_gradient: [f64; 9],
    /// Leave out particles inside rigid tools, so that a tool can start partly buried.
    #[serde(default = "yes")]
    pub around_tools: bool,
    /// Start at rest under gravity: each particle is pressed by the weight of the settled ground straight above it, as if it had been
    /// filled up layer by layer between walls. In gravity along -z.
    #[serde(default)]
    pub settled: bool,
    /// With `settled`: the pressure along x and y over that along z. Absent: as walls press that keep the ground from going sideways, ν/(1 - ν) of an
    /// elastic law. 0 for a column that stands by itself.
    #[serde(default)]
    pub k0: Option<f64>,
}

/// How particles are placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// `stagger` along those of x and y in which a body stands free, if its material does not hold up a face of the body's height, for sources of such a
    /// material, and for fluids that walls hold while something stirs them; else `lattice`.
    #[default]
    Auto,
    /// A cubic lattice. What flows far apart from it comes to rest as upright sheets, one or two cells wide.
    Lattice,
    /// A cubic lattice whose rows along x and whose layers along y are moved at random, each by a part of the spacing. Nodes inside have the same mass as with
    /// `lattice`.
    Stagger,
    /// A cubic lattice, each particle moved at random within its own lattice cell.
    Jitter,
}

/// A region of space. One of its keys is given.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Shape {
    /// An axis-aligned box by two corners (soft bodies), or by half extents about the tool's origin (tools).
    Box {
        /// Least corner [m].
        #[serde(default)]
        min: Option<Vec3>,
        /// Greatest corner [m].
        #[serde(default)]
        max: Option<Vec3>,
        /// Half extents about `center` [m], instead of the corners.
        #[serde(default)]
        half: Option<Vec3>,
        /// Centre [m], with `half`.
        #[serde(default)]
        center: Option<Vec3>,
    },
    /// A sphere.
    Sphere {
        /// Centre [m].
        #[serde(default)]
        center: Vec3,
        /// Radius [m].
        radius: f64,
    },
    /// A cylinder along z.
    Cylinder {
        /// Centre [m].
        #[serde(default)]
        center: Vec3,
        /// Radius [m].
        radius: f64,
        /// Half the height [m].
        half_height: f64,
    },
    /// A capsule along z: all points within `radius` of a segment.
    Capsule {
        /// Centre [m].
        #[serde(default)]
        center: Vec3,
        /// Radius [m].
        radius: f64,
        /// Half the length of the segment [m].
        half_height: f64,
    },
    /// The half space below a plane (tools only).
    Plane {
        /// A point of the plane [m].
        #[serde(default)]
        point: Vec3,
        /// Normal pointing out of the solid.
        normal: Vec3,
    },
    /// Everything between `bottom` and a height that varies over x and y.
    HeightField {
        /// Least x and y [m].
        min: [f64; 2],
        /// Greatest x and y [m].
        max: [f64; 2],
        /// Lower end [m].
        bottom: f64,
        /// Rows of heights [m]: row j at y_j, column i at x_i, spread evenly from `min` to `max`, bilinear between.
        #[serde(default)]
        heights: Vec<Vec<f64>>,
        /// A CSV file with the rows, instead of `heights`.
        #[serde(default)]
        file: Option<PathBuf>,
    },
    /// Everything between a lower end and a surface that is a function of place: a plane, dunes, bumps or stairs.
    Terrain(Terrain),
    /// A closed triangle mesh (OBJ, STL or DAE).
    Mesh {
        /// The file.
        file: PathBuf,
        /// Factor from the file's unit to metres; a negative factor would turn the mesh inside out and is refused.
        #[serde(default = "one")]
        scale: f64,
        /// Where the file's origin goes [m].
        #[serde(default)]
        center: Vec3,
        /// Orientation quaternion (w, x, y, z).
        #[serde(default = "no_rotation")]
        rotation: [f64; 4],
    },
    /// All of several shapes together, such as a blade with a handle.
    Union(Vec<Placed>),
    /// The first of several shapes without the others (not for tools), such as a block with a hole.
    Difference(Vec<Placed>),
    /// What several shapes have in common (not for tools).
    Intersection(Vec<Placed>),
}

/// A shape at a place within a union, a difference or an intersection.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Placed {
    /// The shape.
    pub shape: Shape,
    /// Where its origin goes [m].
    #[serde(default)]
    pub position: Vec3,
    /// Orientation quaternion (w, x, y, z).
    #[serde(default = "no_rotation")]
    pub rotation: [f64; 4],
}

fn one() -> f64 {
    1.0
}
fn no_rotation() -> [f64; 4] {
    [1.0, 0.0, 0.0, 0.0]
}

/// A rigid tool or body. Its shape is given in its own frame.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// Name in traces and messages.
    pub name: String,
    /// Shape in the tool's own frame.
    pub shape: Shape,
    /// Where the frame's origin starts [m].
    #[serde(default)]
    pub position: Vec3,
    /// Starting orientation, quaternion (w, x, y, z).
    #[serde(default = "no_rotation")]
    pub rotation: [f64; 4],
    /// Contact with the ground.
    #[serde(default)]
    pub contact: Contact,
    /// How it moves.
    #[serde(default)]
    pub motion: Motion,
    /// When it appears [s]: it is there from the first step on that begins then. Not where particles are then; not for free tools and servos.
    #[serde(default)]
    pub from: f64,
    /// When it vanishes [s]: it is not there any more from the first step on that begins then; absent: never. Not for free tools and servos.
    #[serde(default)]
    pub until: Option<f64>,
}

/// What summed-up times may be off [s].
pub const INSTANT: f64 = 1e-9;

impl Tool {
    /// Is it there in a step that begins at `time` [s]?
    pub fn is_present(&self, time: f64) -> bool {
        let now = time + INSTANT;
        self.from <= now && now < self.until.unwrap_or(f64::INFINITY)
    }

    /// The area that faces along an axis [m²], of a box that is not turned: in plane strain that between the walls.
    pub fn face(&self, axis: Vec3, world: &World) -> Option<f64> {
        let [bounds, along] = [self.shape.bounds()?, posed_bounds(self.shape.bounds()?, self.position, self.rotation)];
        let of = axis.iter().filter(|x| **x != 0.0).count();
        let extent = |d: usize| {
            let whole = bounds.max[d] - bounds.min[d];
            let seen = along.max[d].min(world.max[d]) - along.min[d].max(world.min[d]);
            if d == 1 && world.plane_strain.is_some() { whole.min(seen) } else { whole }
        };
        let is_plain = matches!(self.shape, Shape::Box { .. }) && of == 1 && self.rotation == no_rotation();
        is_plain.then(|| (0..3).filter(|d| axis[*d] == 0.0).map(extent).product())
    }

    /// The same tool, with the force that its servo's pressure comes to.
    #[must_use]
    pub fn in_world(&self, world: &World) -> Self {
        let mut tool = self.clone();
        if let Motion::Servo(Servo { axis, force: force @ None, pressure, area, .. }) = &mut tool.motion {
            *force = Some(pressure.unwrap_or(0.0) * area.or_else(|| self.face(*axis, world)).unwrap_or(0.0));
        }
        tool
    }

    /// Does it move by what it feels of the ground?
    pub fn answers(&self) -> bool {
        matches!(self.motion, Motion::Free { .. } | Motion::Servo(_))
    }
}

/// Contact law of a tool.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Contact {
    /// The ground may separate; Coulomb friction along the surface.
    Coulomb {
        /// Coefficient of friction.
        friction: f64,
    },
    /// The ground may separate; no friction.
    Slip,
    /// The ground sticks to the surface and never separates.
    Stick,
}

impl Default for Contact {
    fn default() -> Self {
        Self::Coulomb { friction: 0.5 }
    }
}

/// How a tool moves.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Motion {
    /// It stays.
    #[default]
    Fixed,
    /// It passes through poses at given times.
    Keyframes {
        /// Poses, with rising times.
        frames: Vec<Keyframe>,
        /// How it moves between them.
        #[serde(default)]
        interpolation: Interpolation,
    },
    /// It moves with a given velocity; an agent may change it at every step.
    Velocity {
        /// Velocity of its origin [m/s].
        #[serde(default)]
        linear: Vec3,
        /// Angular velocity about its origin [rad/s].
        #[serde(default)]
        angular: Vec3,
    },
    /// It is a free rigid body, moved by gravity, the ground and other bodies: free ones, robots, and tools that move as they are told.
    Free {
        /// Mass [kg]; its inertia is that of the shape filled evenly.
        mass: f64,
        /// Initial velocity of its centre of mass [m/s].
        #[serde(default)]
        linear: Vec3,
        /// Initial angular velocity [rad/s].
        #[serde(default)]
        angular: Vec3,
        /// Coefficient of restitution against other rigid bodies.
        #[serde(default)]
        restitution: f64,
    },
    /// A given force pushes it along an axis against the ground, as a weight pushes a plate; a guide lets it neither turn nor move otherwise.
    Servo(Servo),
}

/// A force that pushes a tool along an axis. Gravity does not move it. Free bodies and robots give way to it and push it back. It passes
/// through walls and through tools that do not give way.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Servo {
    /// Direction in which the force acts; of any length.
    pub axis: Vec3,
    /// The force along it [N]; negative: against it.
    #[serde(default)]
    pub force: Option<f64>,
    /// The force over `area` [Pa], instead of `force`.
    #[serde(default)]
    pub pressure: Option<f64>,
    /// Area that `pressure` acts on [m²]; absent: the face of a box that is not turned, between the walls if the world is in plane strain.
    #[serde(default)]
    pub area: Option<f64>,
    /// Seconds over which the force grows evenly from zero to its value.
    #[serde(default)]
    pub ramp: f64,
    /// Mass that the force sets in motion [kg]; absent: what weighs as much as the force, force/9.81.
    #[serde(default)]
    pub mass: Option<f64>,
    /// Force against its velocity, over that [N s/m].
    #[serde(default)]
    pub damping: f64,
}

impl Servo {
    /// What weighs 1 N [kg].
    const PER_NEWTON: f64 = 1.0 / 9.81;

    /// The whole force [N]; of a pressure once its tool is [in its world](Tool::in_world).
    pub fn whole(&self) -> f64 {
        self.force.unwrap_or_default()
    }
    /// The force at a time [N].
    pub fn force_at(&self, time: f64) -> f64 {
        self.whole() * self.share_at(time)
    }
    /// How much of its force acts at a time.
    pub fn share_at(&self, time: f64) -> f64 {
        if time < self.ramp { time / self.ramp } else { 1.0 }
    }
    /// The mass that it moves [kg].
    pub fn inertia(&self) -> f64 {
        self.mass.unwrap_or(self.whole().abs() * Self::PER_NEWTON)
    }
}

/// A pose at a time.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Keyframe {
    /// Time [s].
    pub time: f64,
    /// Position of the tool's origin [m].
    pub position: Vec3,
    /// Orientation quaternion (w, x, y, z); absent: as before.
    #[serde(default)]
    pub rotation: Option<[f64; 4]>,
}

/// How a tool moves between keyframes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// C¹: cubic Hermite with zero speed where the path turns back or rests (monotone), slerp eased likewise.
    #[default]
    Smooth,
    /// Straight lines at constant speed, slerp between orientations.
    Linear,
}

/// A coupling from a plugin.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CouplingSpec {
    /// Name in the registry; see `barchan plugins`.
    pub kind: String,
    /// Name in errors, trace and ledger, of this entry alone; absent: its kind, and the kind with a number from 2 for further such entries, as in `wind-2`.
    #[serde(default)]
    pub name: Option<String>,
    /// What the coupling wants to know; see `barchan plugins`. An angle may be given in degrees as `<name>_deg`.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub parameters: Table,
}

/// A task from a plugin.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TaskSpec {
    /// Name in the registry; see `barchan plugins`.
    pub name: String,
    /// What the task wants to know; see `barchan plugins`. An angle may be given in degrees as `<name>_deg`.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub parameters: Table,
}
