//! Couplings: what acts on the soft ground through grid nodes, and what it feels in return.

use crate::contact::adjoint::{BodyInStep, GripCotangent, NearCotangents, no_adjoint};
use crate::contact::{Reaction, System, Touch, Twist};
use crate::gradient::{BodyCotangents, BodyGradient, RobotCotangents, RobotGradient};
use crate::sense::RobotState;
use crate::surface::Surface;
use crate::{Error, Result, Vec3};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::ops::Range;
use std::path::PathBuf;

/// Force and torque, or, times a step, impulse and angular impulse.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Wrench {
    /// Force on the body, world frame [N].
    pub force: Vec3,
    /// Torque on the body about its centre of mass, world frame [N m].
    pub torque: Vec3,
}

impl Wrench {
    /// So many times as much.
    #[must_use]
    pub fn scaled(&self, by: f64) -> Self {
        Self { force: self.force.map(|x| by * x), torque: self.torque.map(|x| by * x) }
    }

    /// Adds what came between `before` and `now`, so many times.
    pub fn add_change(&mut self, before: &Self, now: &Self, times: f64) {
        for d in 0..3 {
            self.force[d] += times * (now.force[d] - before.force[d]);
            self.torque[d] += times * (now.torque[d] - before.torque[d]);
        }
    }
}

/// What a body is told to do from now on, or a blow that it gets once.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Command {
    /// Move with this velocity.
    Twist {
        /// Of its reference point: its frame's origin, for a tool; world frame [m/s].
        linear: Vec3,
        /// World frame [rad/s].
        angular: Vec3,
    },
    /// Bring its joints to these positions, in the order in which the body lists them: angles of revolute joints [rad], displacements of prismatic
    /// ones [m].
    JointTargets(Vec<f64>),
    /// Act on its joints, in the order in which the body lists them: torques on revolute joints [N m], forces on prismatic ones [N].
    JointTorques(Vec<f64>),
    /// Motors act on its joints with kp (target − position) + kd (rate − the joint's) + torque, in the order in which the body lists them. What is left out is 0; targets may be only
    /// where no motor has kp.
    JointMotion {
        /// Angles [rad] or displacements [m].
        targets: Option<Vec<f64>>,
        /// Their rates [rad/s or m/s].
        rates: Option<Vec<f64>>,
        /// Torques [N m] or forces [N] besides.
        torques: Option<Vec<f64>>,
    },
    /// Take a blow, once: what it is told besides goes on.
    Impulse {
        /// Through its centre of mass, which is the base's for a robot; world frame [N s].
        linear: Vec3,
        /// World frame [N m s].
        angular: Vec3,
    },
    /// Be elsewhere, or move otherwise, at once: what it is told besides goes on. Ground stays, also within it: at rest it does not push that out.
    Place(Placement),
}

/// Where a body is put, and how it moves there. What is left out stays as it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Placement {
    /// Origin of a robot's base frame; a tool's centre of mass, or origin if it moves as it is told [m].
    pub position: Option<Vec3>,
    /// Orientation quaternion (w, x, y, z).
    pub rotation: Option<[f64; 4]>,
    /// Velocity of that point; world frame [m/s].
    pub velocity: Option<Vec3>,
    /// World frame [rad/s].
    pub angular_velocity: Option<Vec3>,
    /// Of a robot's joints, in the order in which it lists them: angles of revolute joints [rad], displacements of prismatic ones [m].
    pub joints: Option<Vec<f64>>,
    /// Their rates, in the same order [rad/s or m/s].
    pub joint_rates: Option<Vec<f64>>,
}

/// Bodies and particles may be given numbers of at most so much, in SI units: a step is refused long before, but a simulation in f32 goes on from there. What is made of numbers
/// far beyond it is none, and no later step heals that.
pub const GREATEST: f64 = 1e15;

impl Command {
    /// What it gives, for messages: "a twist", "joint targets", "joint torques", "joint rates", "an impulse" or "another place".
    pub fn name(&self) -> &'static str {
        match self {
            Self::Twist { .. } => "a twist",
            Self::JointTargets(_) => "joint targets",
            Self::JointTorques(_) => "joint torques",
            Self::JointMotion { .. } => "joint rates",
            Self::Impulse { .. } => "an impulse",
            Self::Place(_) => "another place",
        }
    }

    /// Is nothing of it beyond [`GREATEST`]? What is no number at all is for the body to refuse, which knows what it is called.
    pub(crate) fn check(&self, body: &str) -> Result<()> {
        let greatest = self.greatest();
        if !(greatest.is_finite() && greatest > GREATEST) {
            return Ok(());
        }
        let what = format!("{} with a number of {greatest:.3e} is asked for", self.name());
        let mend = format!("give numbers of at most {GREATEST:.0e}");
        Err(Error::Body { path: body.to_owned(), what, mend })
    }

    /// The greatest of its numbers, without their signs: NaN if one is none.
    pub fn greatest(&self) -> f64 {
        let greatest = |numbers: &[f64]| numbers.iter().map(|x| x.abs()).max_by(f64::total_cmp).unwrap_or(0.0);
        match self {
            Self::Twist { linear, angular } | Self::Impulse { linear, angular } => {
                greatest(&[*linear, *angular].concat())
            }
            Self::JointTargets(numbers) | Self::JointTorques(numbers) => greatest(numbers),
            Self::JointMotion { targets, rates, torques } => {
                greatest(&[targets, rates, torques].into_iter().flatten().flatten().copied().collect::<Vec<f64>>())
            }
            Self::Place(Placement { position, rotation, velocity, angular_velocity, joints, joint_rates }) => {
                let axes = [position, velocity, angular_velocity].into_iter().flatten().flatten();
                let all =
                    axes.chain(rotation.iter().flatten()).chain([joints, joint_rates].into_iter().flatten().flatten());
                greatest(&all.copied().collect::<Vec<f64>>())
            }
        }
    }
}

/// What a joint is doing.
#[derive(Clone, Debug, PartialEq)]
pub struct JointState {
    /// Name of the body that takes its commands: the robot.
    pub body: String,
    /// Its own name.
    pub name: String,
    /// Does it turn, or slide?
    pub turns: bool,
    /// Position: an angle [rad], or a displacement [m].
    pub position: f64,
    /// Its rate [rad/s or m/s].
    pub rate: f64,
    /// Torque [N m] or force [N] that its motor gives as it is now, by what it was told last: after a step, that of the step.
    pub torque: f64,
}

/// What a body is doing, world frame.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyState {
    /// Name in the scene.
    pub name: String,
    /// Centre of mass [m].
    pub position: Vec3,
    /// Orientation quaternion (w, x, y, z).
    pub rotation: [f64; 4],
    /// Velocity of the centre of mass [m/s].
    pub velocity: Vec3,
    /// Angular velocity [rad/s].
    pub angular_velocity: Vec3,
    /// Mass [kg]; infinite for a driven body.
    pub mass: f64,
    /// Kinetic energy [J]; 0 for a driven body.
    pub kinetic_energy: f64,
    /// Potential energy in gravity relative to height 0 [J]; 0 for a driven body.
    pub potential_energy: f64,
    /// Momentum [kg m/s]; 0 for a driven body.
    pub momentum: Vec3,
    /// Angular momentum about the world's origin [kg m²/s]; 0 for a driven body.
    pub angular_momentum: Vec3,
}

/// An axis-aligned box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Least corner [m].
    pub min: Vec3,
    /// Greatest corner [m].
    pub max: Vec3,
}

impl Aabb {
    /// Grown by `margin` on every side.
    #[must_use]
    pub fn grown(self, margin: f64) -> Self {
        Self { min: self.min.map(|x| x - margin), max: self.max.map(|x| x + margin) }
    }
    /// Moved by so much [m].
    #[must_use]
    pub fn moved(self, by: Vec3) -> Self {
        let moved = |from: Vec3| std::array::from_fn(|d| from[d] + by[d]);
        Self { min: moved(self.min), max: moved(self.max) }
    }
    /// Is the point inside or on the boundary?
    pub fn contains(&self, x: Vec3) -> bool {
        (0..3).all(|d| self.min[d] <= x[d] && x[d] <= self.max[d])
    }
    /// Do the boxes share a point?
    pub fn meets(&self, other: &Self) -> bool {
        (0..3).all(|d| self.min[d] <= other.max[d] && other.min[d] <= self.max[d])
    }
    /// The least box that holds both.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self {
            min: std::array::from_fn(|d| self.min[d].min(other.min[d])),
            max: std::array::from_fn(|d| self.max[d].max(other.max[d])),
        }
    }
    /// With an end where it has none: that of `other`, or its own other end, if that lies further.
    #[must_use]
    pub fn ended_by(mut self, other: &Self) -> Self {
        for d in 0..3 {
            if self.min[d] == f64::NEG_INFINITY {
                self.min[d] = other.min[d].min(self.max[d]);
            }
            if self.max[d] == f64::INFINITY {
                self.max[d] = other.max[d].max(self.min[d]);
            }
        }
        self
    }
    /// What both hold; its ends are the wrong way round where they share nothing.
    #[must_use]
    pub fn intersection(&self, other: &Self) -> Self {
        Self {
            min: std::array::from_fn(|d| self.min[d].max(other.min[d])),
            max: std::array::from_fn(|d| self.max[d].min(other.max[d])),
        }
    }
    /// A leash that holds nothing: least and greatest displacement along each axis are infinite.
    pub const UNBOUND: Self = Self { min: [f64::NEG_INFINITY; 3], max: [f64::INFINITY; 3] };

    /// A box without a point: where a body acts that is not there.
    pub const NOTHING: Self = Self { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };

    /// Does it hold no point?
    pub fn is_nothing(&self) -> bool {
        (0..3).any(|d| self.min[d] > self.max[d])
    }

    /// How far this box may go along each axis, least and greatest displacement [m], before it comes nearer than `clearance` to `other`; `None` if it is. Of what is
    /// to spare along the axis on which they are furthest apart it may go the part that `own` makes of it.
    pub fn leash(&self, other: &Self, clearance: f64, own: impl FnOnce(f64) -> f64) -> Option<Self> {
        let gaps = (0..3).flat_map(|axis| {
            [(axis, false, self.min[axis] - other.max[axis]), (axis, true, other.min[axis] - self.max[axis])]
        });
        let (axis, upwards, gap) = gaps.max_by(|a, b| a.2.total_cmp(&b.2))?;
        if gap.is_nan() || gap <= clearance {
            return None;
        }
        let (mut leash, by) = (Self::UNBOUND, own(gap - clearance).max(0.0));
        if upwards {
            leash.max[axis] = by;
        } else {
            leash.min[axis] = -by;
        }
        Some(leash)
    }
}

/// A particle of the ground near a coupling's bodies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearParticle {
    /// The cube of nodes around it, as a number in [`NodeBatch::cubes`].
    pub cube: u32,
    /// World position [m].
    pub position: Vec3,
    /// Place between these nodes, 0 to 1 along each axis.
    pub place: Vec3,
    /// Its volume at rest [m³].
    pub volume: f64,
    /// Its stiffness against being pushed into, λ + 2μ at rest [Pa].
    pub modulus: f64,
}

impl NearParticle {
    /// Finds the cube of nodes that a place in a cell, 0 to 1 along each axis, lies in: how many cells on its first node is, 0 or -1 along each
    /// axis, and the place between its nodes.
    pub fn between_nodes(in_cell: Vec3) -> ([i32; 3], Vec3) {
        // Nodes stand at the centres of cells.
        let first = in_cell.map(|f| if f < 0.5 { -1 } else { 0 });
        (first, std::array::from_fn(|d| in_cell[d] - 0.5 - f64::from(first[d])))
    }

    /// Its weights on the eight nodes around it, z fastest: linear along each axis.
    pub fn weights(&self) -> [f64; 8] {
        let along = self.place.map(|f| [1.0 - f, f]);
        std::array::from_fn(|n| along[0][n / 4] * along[1][n / 2 % 2] * along[2][n % 2])
    }

    /// How these weights change with its place between the nodes, along each axis.
    pub fn weight_slopes(&self) -> [Vec3; 8] {
        let along = self.place.map(|f| [1.0 - f, f]);
        std::array::from_fn(|n| {
            let at = [n / 4, n / 2 % 2, n % 2];
            std::array::from_fn(|d| {
                let others = (0..3).filter(|e| *e != d).map(|e| along[e][at[e]]);
                others.product::<f64>() * if at[d] == 1 { 1.0 } else { -1.0 }
            })
        })
    }
}

/// Grid nodes near a coupling's bodies, in the backend's fixed order, and the particles among them.
#[derive(Clone, Debug, Default)]
pub struct NodeBatch {
    /// Cell width [m]; contact thickness is measured against it.
    pub cell_width: f64,
    /// How far apart images are along each axis [m]; 0 along those whose ends do not meet.
    pub periods: Vec3,
    /// World positions [m]. Where ends meet, a body touches the image of a node that is [nearest](Self::image_near) to it.
    pub position: Vec<Vec3>,
    /// Node masses [kg].
    pub mass: Vec<f64>,
    /// Node velocities after forces and gravity [m/s]; the coupling overwrites them.
    pub velocity: Vec<Vec3>,
    /// The particles near the bodies, in the backend's fixed order, if the coupling has a [`reach`](Coupling::reach).
    pub particles: Vec<NearParticle>,
    /// The cubes of nodes around these particles, each as the numbers of its eight nodes, z fastest; [`NONE`](Self::NONE) where the node is not
    /// among these.
    pub cubes: Vec<[u32; 8]>,
}

impl NodeBatch {
    /// The number of no node.
    pub const NONE: u32 = u32::MAX;
    /// How far from a particle the nodes that it acts on are at most, along each axis [cells].
    pub const SPREAD: f64 = 1.0;

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.mass.len()
    }
    /// Is it empty?
    pub fn is_empty(&self) -> bool {
        self.mass.is_empty()
    }
    /// The image of a point that is nearest to another one [m].
    pub fn image_near(&self, point: Vec3, to: Vec3) -> Vec3 {
        std::array::from_fn(|d| nearest(point[d], to[d], self.periods[d]))
    }
    /// Forgets all nodes, keeping the memory.
    pub fn clear(&mut self) {
        self.position.clear();
        self.mass.clear();
        self.velocity.clear();
        self.particles.clear();
        self.cubes.clear();
    }
}

/// The image of a coordinate that is nearest to another one [m], where images are so far apart; 0 where there are none.
pub(crate) fn nearest(x: f64, to: f64, period: f64) -> f64 {
    if period == 0.0 {
        return x;
    }
    let turns = ((to - x) / period).round();
    if turns.is_finite() { x + period * turns } else { x }
}

/// How a coupling acts on nodes, as a device can do it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DeviceLaw {
    /// Do all loops of the text count to a bound that they find at their start? Only if so are they left as they are: of a loop without an end
    /// a driver's compiler may make anything, so that else the backend counts along in each, which costs time.
    pub counted: bool,
    /// WGSL: pure functions, which may read `fn coupling_table(i: u32) -> vec4<f32>` and, if there are samples,
    /// `fn coupling_sample(i: u32) -> vec4<f32>`, which the backend adds. Couplings of a scene share a module: where there are several, the backend gives
    /// what a text declares at module scope names of its own. All places `x` are in the body's frame, from its reference point [m], in cells
    /// of width `cell` [m].
    ///
    /// Of a [field](Coupling::is_field) there is
    /// - `fn coupling_field(body: u32, x: vec3<f32>, u: vec3<f32>, mass: f32, dt: f32) -> vec3<f32>`: what becomes in a step of `dt` [s] of the velocity `u`,
    ///   relative to the body's own there [m/s], of a node of that mass [kg], all in the body's frame.
    ///
    /// Of bodies that grip nodes:
    /// - `fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32`: how far a point is from the body's surface [m], negative inside;
    /// - `fn coupling_press(body: u32, x: vec3<f32>, half: f32, modulus: f32, cell: f32) -> vec3<f32>`: the greatest force with which a particle there
    ///   presses on the body [N], in its frame; `half` is half the particle's width [m], `modulus` its stiffness [Pa]. As for
    ///   [`NearParticle`], the backend adds these up on the eight nodes around; no force may exceed 9 `modulus` (2 `half`)². Only if `reach` is above 0;
    /// - `fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip`: how the surface grips a node there, as
    ///   [`Grip`](crate::contact::Grip) says it, but with an impulse for `most` [N s]; `press` is the sum of forces there, times the step [N s].
    ///   `struct CouplingGrip { kind: u32, normal: vec3<f32>, most: f32, deep: bool, distance: f32 }` is the backend's, with the kinds `GRIP_NONE`,
    ///   `GRIP_STICK`, `GRIP_COULOMB` and `GRIP_BILATERAL`, and `GRIP_UNBOUNDED` for `most` where nothing bounds it;
    /// - `fn coupling_friction(body: u32) -> f32`: its coefficient of friction;
    /// - if any answers, `fn coupling_box(body: u32, rows: array<vec3<f32>, 3>, cell: f32) -> array<vec3<f32>, 2>`: the least and greatest corner of the
    ///   body's [`bounds`](Coupling::bounds), from its reference point [m], along the world's axes, if `rows` are those of its rotation. On coarser cells it
    ///   may be larger.
    ///
    /// Functions may have the names of their choice beside these; a text declares functions, constants, structures and, for [`DeviceAnswer`], variables.
    pub wgsl: String,
    /// How far beyond its bodies' boxes it acts on nodes [cells of their level]. Bodies that answer act no further beyond their surfaces, as
    /// `coupling_distance` tells.
    pub reach: f64,
    /// What it reads: constant over the run.
    pub table: Vec<[f32; 4]>,
    /// What else it reads, likewise, and may be long, such as sampled distances. Worlds of a batch whose laws have the same share them.
    pub samples: Vec<[f32; 4]>,
    /// How the bodies that answer do so.
    pub answer: DeviceAnswer,
}

/// How the bodies of a coupling that answer impulses do so on a device: a group after the other what [`Coupling::answer`] and its like do on the host.
///
/// The backend finds the nodes that bodies grip, sums up what contact on each comes to, in a fixed order, iterates as [`contact`](crate::contact) does, applies the
/// law to nodes, and keeps bodies on [leashes](Coupling::leashes). What a group makes of that, the coupling says in functions. All threads of a
/// workgroup call them together, a workgroup for each group, in uniform control flow:
///
/// | function | what it does |
/// |---|---|
/// | `coupling_begin(group: u32, thread: u32)` | fixes each body's twist as it would be without contact in this pass (`TWIST_FREE`), gravity added if the group moves in it, and as it is expected with contact (`TWIST_EXPECTED`), where the iteration begins: the same, if nothing better is known |
/// | `coupling_answer(group: u32, thread: u32)` | solves (H + Σ A) δ = r + Σ b as [`Coupling::answer`] does, at the twists that are tried (`TWIST_TRIED`), and sets each body's `TWIST_STEP` to δ |
/// | `coupling_balance(group: u32, along: u32, thread: u32) -> f32` | (r + Σ b) · δ for the twists δ of kind `along`, which is `TWIST_LAST` or `TWIST_STEP` [J] |
/// | `coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32` | twice the kinetic energy of the twists of a kind [J]; of `TWIST_FREE` it is a scale alone |
/// | `coupling_feel(group: u32, thread: u32)` | takes in what nodes gave to each body (`group_impulse`): sets `TWIST_FREE` and `TWIST_EXPECTED` for the next level |
/// | `coupling_advance(group: u32, thread: u32)` | if `group_moves()`, gives each body its pose after the step, at the twists that it has now; in any case writes all words of the state |
///
/// - `group` counts the coupling's groups. What functions return is asked of the first thread, number 0, alone. `coupling_balance` and `coupling_twice_energy` follow on
///   `coupling_answer`, and may use what that has left in variables.
/// - There are at least 256 threads, and maybe more. A group that one thread can see to returns from all others at once: then nothing waits. One that shares
///   its work declares `var<workgroup>` of its own, and puts a `workgroupBarrier()` between what one thread writes and another one reads, of twists as well, and a
///   `storageBarrier()` for words and poses; at its end, too, if the next function reads it on another thread. Behind `coupling_begin`, and before each
///   `coupling_answer` and `coupling_feel`, the backend waits for all.
///   Barriers must stand in uniform control flow, which nobody checks: not where `thread` decides. `group`, words and the table are the same to all threads.
/// - Of an adapter's memory for workgroups, which is 16 KiB at least, the backend takes 12.6, and 208 bytes for each body and 20 for each rate of the largest group. Where a
///   group's own variables do not fit any more, its contact runs on the host.
/// - `var<private>` stay between the calls in a pass, and no longer.
///
/// They may call, where `b` counts the bodies of the group:
/// - `group_bodies() -> u32`, and `group_body(b) -> u32`: a body's number among the coupling's;
/// - `group_told(i) -> vec4<u32>`: what the coupling [tells the group](Coupling::told) for the step at hand;
/// - `group_missed(thread)`: a solution of the group's own did not converge, which is counted as those with the ground are;
/// - `group_word(i) -> vec4<u32>` and `set_group_word(i, word)`: the state before the step and after it. Where the group does not move in a pass,
///   they are the same;
/// - `group_pose(b) -> CouplingPose` and `set_group_pose(b, pose)`: likewise where a body is. `struct CouplingPose { cell: vec3<i32>, place: vec3<u32>, rotation:
///   vec4<i32> }` holds its reference point's cell, and the place in it in 2⁻³² cells of the finest level, and its rotation (x, y, z, w) in 2⁻³⁰. There are
///   `pose_rotation(pose) -> vec4<f32>`, `rows_of(q) -> array<vec3<f32>, 3>`, `turning(q, angle) -> vec4<f32>`, what turning by `angle` [rad] adds to a rotation,
///   `pose_turned(pose, by)`, which adds that, `pose_shifted(pose, by)` with `by` in cells `group_cell()` [m] wide, and `pose_after(pose, twist)`,
///   after a step at a twist;
/// - `group_twist(kind, b) -> CouplingTwist` and `set_group_twist(kind, b, twist)`, with `struct CouplingTwist { linear: vec3<f32>, angular: vec3<f32> }`, of the
///   reference point, world frame;
/// - `group_rate(kind, i) -> f32` and `set_group_rate(kind, i, x)`: numbers of its own that change along with twists, in proportion, such as rates of joints. The
///   backend steps them as it steps twists; whoever sets twists of a kind sets them, too;
/// - `group_touches(b) -> bool`: does a body touch any node on the level at hand? If not, its system is zero;
/// - `group_system(b) -> CouplingSystem`, in `coupling_answer`: b as `force` and `torque`, and A as `force_linear`, `force_angular`, `torque_linear` and
///   `torque_angular`, where column i of each is row i of a quarter; `solve_rows(array<CouplingRow, 6>) -> CouplingTwist` solves six equations without
///   pivots, `struct CouplingRow { linear: vec3<f32>, angular: vec3<f32>, missing: f32 }`;
/// - how far a step of Newton's method goes, for one thread: `search_from(before)` with what is out of balance along it before it,
///   `search_on(left, noise) -> f32` how much further to go, as a part of the step, where so much is, of which rounding may be some, and 0 if that will do,
///   `search_part() -> f32` how far it went;
/// - `group_impulse(b) -> CouplingTwist` in `coupling_feel` [N s, N m s], and in `coupling_begin` `group_impulse_before(b)`: what the last slot gave, where levels
///   take steps of their own, and zero before the first;
/// - `group_room(i) -> vec4<f32>` and `set_group_room(i, v)`: `GROUP_ROOM` vectors, 704, for what a function works out on its way with all threads; nothing stays
///   there when it is left;
/// - `group_moves() -> bool`: does the step begin here? Else bodies have moved in an earlier pass, and meet coarser levels;
/// - `group_dt()` [s], `group_gravity()`, what gravity adds to a velocity in the step [m/s], `coupling_table` and `coupling_sample`, and all that `wgsl` of the
///   [`DeviceLaw`] declares.
///
/// Where a node is deepest in several bodies of a group, the deepest has it. The tangent's matrices are not symmetric, and a solution without pivots may fail; a
/// step along which `coupling_balance` is negative or not a number is replaced by that of the secant, whose matrices are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DeviceAnswer {
    /// These functions, in WGSL; empty if no body answers.
    pub wgsl: String,
    /// What each group asks of the device, in the order of its [groups there](Coupling::device_groups).
    pub groups: Vec<DeviceGroup>,
}

/// What a group that answers on a device asks of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DeviceGroup {
    /// Words of its state.
    pub words: usize,
    /// Words that it is told at most, beside its state; see [`Coupling::told`].
    pub told: usize,
    /// Numbers that change along with its bodies' twists.
    pub rates: usize,
    /// Its bodies, in their order.
    pub bodies: Vec<DeviceBody>,
}

/// A body that answers on a device.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DeviceBody {
    /// Greatest distance of a point of its surface from its reference point [m].
    pub extent: f64,
    /// How far the ends of its [`bounds`](Coupling::bounds) move at most for each radian that it turns [m]: not at all for a sphere about its reference point, up to
    /// its extent for others.
    pub swing: f64,
    /// Greatest distance of a point of its [`bounds`](Coupling::bounds) at any rotation, and [`reach`](Coupling::reach) further on the finest level [m].
    pub reach: f64,
}

/// Where a body is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placed {
    /// Its reference point [m].
    pub position: Vec3,
    /// Orientation quaternion (w, x, y, z).
    pub rotation: [f64; 4],
}

/// A group as a device holds it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroupState {
    /// Words of its own, as its functions in WGSL read and write them.
    pub words: Vec<[u32; 4]>,
    /// Where its bodies are.
    pub bodies: Vec<Placed>,
}

/// Who moves bodies that answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Moved {
    /// The coupling, with what contact gives them.
    #[default]
    ByCoupling,
    /// A device.
    ByDevice,
    /// A device takes a single step, since they may meet others. What they may meet the coupling [tells it](Coupling::told); or it moves its bodies itself from where a step
    /// [has brought them](Coupling::take_device_state), with the velocities that gravity and the ground have made.
    InTurns,
}

/// How a device may move the bodies of groups.
#[derive(Clone, Debug, PartialEq)]
pub struct Leashes {
    /// How far along each axis each body may move before it may meet what only the coupling knows: least and greatest displacement of the ends of its box [m], in
    /// the order of the groups' bodies.
    pub each: Vec<Aabb>,
    /// Does it take [one step at a time](Moved::InTurns), since bodies are near what only the coupling knows?
    pub in_turns: bool,
}

/// What happened to a group in a step on a device.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroupStep {
    /// How it was afterwards.
    pub state: GroupState,
    /// Nodes that were deep inside its bodies, all levels' together.
    pub deep_nodes: u64,
    /// How often its twists and the nodes' velocities were not found together.
    pub unconverged: u64,
}

/// Bodies that answer the ground's impulses together: a free body alone, the links of a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// Their numbers among the coupling's bodies.
    pub bodies: Range<usize>,
    /// Their mass [kg].
    pub mass: f64,
}

/// What a coupling [keeps](Coupling::keep) of itself while steps may fail: its own to know.
pub type Kept = Box<dyn Any + Send + Sync>;

/// Lets all couplings [begin](Coupling::before_step) a step from `time` that takes `dt` [s]: those that [watch](Coupling::watches) others behind the others.
///
/// # Errors
/// If a body's motion is not defined there.
pub fn begin_step(couplings: &mut [Box<dyn Coupling>], time: f64, dt: f64) -> Result<()> {
    couplings
        .iter_mut()
        .filter(|coupling| !coupling.watches())
        .try_for_each(|coupling| coupling.before_step(time, dt))?;
    show_others(couplings);
    couplings.iter_mut().filter(|coupling| coupling.watches()).try_for_each(|coupling| coupling.before_step(time, dt))
}

/// Shows couplings that [watch](Coupling::watches) others [where their bodies are](Coupling::see).
pub fn show_others(couplings: &mut [Box<dyn Coupling>]) {
    if couplings.iter().any(|coupling| coupling.watches()) {
        let seen: Vec<BodyState> = couplings.iter().filter(|one| !one.watches()).flat_map(|one| one.bodies()).collect();
        couplings.iter_mut().filter(|one| one.watches()).for_each(|one| one.see(&seen));
    }
}

/// What a loss owes to the bodies of a coupling, in their order, and to its robots, in that of [`robots`](Coupling::robots).
#[derive(Debug)]
pub struct BodiesOwed<'a> {
    /// Bodies.
    pub bodies: &'a mut [BodyCotangents],
    /// Robots' joints.
    pub robots: &'a mut [RobotCotangents],
}

/// What it owes to what they are told and are, likewise.
#[derive(Debug)]
pub struct BodiesTold<'a> {
    /// Bodies.
    pub bodies: &'a mut [BodyGradient],
    /// Robots' motors.
    pub robots: &'a mut [RobotGradient],
}

/// Rigid tools, free bodies, robots, wind: anything that acts on nodes and feels the reaction.
///
/// In each step the simulation calls, in this order: [`before_step`](Self::before_step), then, on each level, fields
/// ([`act_as_field`](Self::act_as_field)) and bodies ([`touch`](Self::touch), [`answer`](Self::answer), [`feel`](Self::feel); see [`contact`](crate::contact)),
/// and [`after_step`](Self::after_step). So what was booked
/// in the last step is cleared in `before_step`. An impulse is taken from the node where it acts and booked once, on the body,
/// at that node's position.
pub trait Coupling: Send + Sync {
    /// Its own name in the scene, as it was [given](crate::registry::CouplingSetup::name) when it was made.
    fn name(&self) -> &str;
    /// Bodies in the scene's order, as they are now.
    fn bodies(&self) -> Vec<BodyState>;
    /// Has it a body of that name? Asked for every action: a coupling that knows without a copy of all says so.
    fn has_body(&self, name: &str) -> bool {
        self.bodies().iter().any(|body| body.name == name)
    }
    /// Names of the bodies that levels follow where the scene names none.
    fn followed(&self) -> Vec<String> {
        Vec::new()
    }
    /// Joints of its bodies, as they are now, in the order of commands to them.
    fn joints(&self) -> Vec<JointState> {
        Vec::new()
    }
    /// What its robots' sensors say: their links are all of its bodies, in their order. Whoever asks fills in what the [ground](crate::LinkState::ground) does.
    fn robots(&self) -> Vec<RobotState> {
        Vec::new()
    }
    /// Greatest speed of any surface point during the step that starts at `time` and takes at most `dt` [m/s].
    fn max_speed(&self, time: f64, dt: f64) -> f64;
    /// Is it to be shown the bodies of other couplings before each step, see [`see`](Self::see)?
    fn watches(&self) -> bool {
        false
    }
    /// Is shown the bodies of couplings that do not [watch](Self::watches) others: where they are as the coming step begins, and, if they are driven, how they
    /// move in it.
    fn see(&mut self, others: &[BodyState]) {
        let _ = others;
    }
    /// Fixes the bodies' velocities over the step from `time` to `time + dt` [s]. Poses stay those at `time`.
    ///
    /// # Errors
    /// If a body's motion is not defined there.
    fn before_step(&mut self, time: f64, dt: f64) -> Result<()>;
    /// Where each body can act during this step. Nodes are handed over that lie in these boxes, or beyond them by no more than the
    /// [`reach`](Self::reach), and maybe others, near other couplings' bodies. [`NOTHING`](Aabb::NOTHING) for a body that is not there.
    fn bounds(&self) -> Vec<Aabb>;
    /// Where each body is, there or not, for levels and pictures that follow it: by then the ground is fine where a body is to appear.
    fn extents(&self) -> Vec<Aabb> {
        self.bounds()
    }
    /// When a body next appears or vanishes after `time` [s]; infinite if none does. No steps are asked for at once that go beyond it.
    fn next_change(&self, time: f64) -> f64 {
        let _ = time;
        f64::INFINITY
    }
    /// Lets bodies appear and vanish for which it is time, before a step that begins at `time` [s]; between such calls no body does. `places` says where particles
    /// of the ground are within a box [m]. Returns whether anything has changed.
    ///
    /// # Errors
    /// [`Error::Body`] if a body would appear within the ground; nothing has changed then. What `places` says.
    fn change(&mut self, time: f64, places: &mut dyn FnMut(&Aabb) -> Result<Vec<Vec3>>) -> Result<bool> {
        let _ = (time, places);
        Ok(false)
    }
    /// How far beyond its [`bounds`](Self::bounds) it acts on nodes [cells of their level]. Above 0, particles are handed over, too: those less far
    /// out by [`SPREAD`](NodeBatch::SPREAD), whose nodes are all in reach.
    fn reach(&self) -> f64 {
        0.0
    }
    /// Does it act on all nodes within its [`bounds`](Self::bounds) as wind does, instead of gripping them? Fields act first, in the scene's order.
    fn is_field(&self) -> bool {
        false
    }
    /// A field changes the velocities of nodes in a step of `dt` [s], and adds what that takes from its bodies, over `dt`, to their
    /// [`wrenches`](Self::wrenches). The nodes are those near its own bodies. Levels come one after the other, coarser ones maybe
    /// behind [`after_step`](Self::after_step).
    ///
    /// # Errors
    /// If its state is no longer finite.
    fn act_as_field(&mut self, dt: f64, nodes: &mut NodeBatch) -> Result<()> {
        let _ = (dt, nodes);
        Ok(())
    }
    /// Which nodes a body grips in a step of `dt` [s], and how: they are added to `touches`, each node at most once.
    fn touch(&mut self, body: usize, dt: f64, nodes: &NodeBatch, touches: &mut Vec<Touch>) {
        let _ = (body, dt, nodes, touches);
    }
    /// One of its own, of the same bodies where they are now, with which steps can be taken again and gone back through, by [`advance_back`](Self::advance_back),
    /// [`answer_back`](Self::answer_back), [`touch_back`](Self::touch_back), [`see_back`](Self::see_back) and [`begin_back`](Self::begin_back): what gradients need.
    ///
    /// # Errors
    /// What gradients do not go through, and what mends it: all of it, if a coupling has nothing of the kind.
    fn twin(&self) -> Result<Box<dyn Coupling>> {
        Err(no_adjoint(self.name()))
    }
    /// The adjoint of [`touch`](Self::touch) in the step that has begun: from what is owed to its grips, one for each of its touches, to what is owed to nodes' masses
    /// and to particles, which is added to `near`, and to the body's place, which is added to `owed`.
    ///
    /// # Errors
    /// [`Error::Missing`] if it has none.
    fn touch_back(
        &self,
        body: usize,
        dt: f64,
        nodes: &NodeBatch,
        touches: (&[Touch], &[GripCotangent]),
        near: &mut NearCotangents,
        owed: &mut BodyInStep,
    ) -> Result<()> {
        let _ = (body, dt, nodes, touches, near, owed);
        Err(no_adjoint(self.name()))
    }
    /// The adjoint of [`answer`](Self::answer) where contact has found the twists that bodies [have](Self::twist) now, at which they balance: `systems` hold the ground's slopes transposed and,
    /// in place of impulses, what is owed to twists.
    fn answer_back(&self, group: Range<usize>, systems: &[System]) -> Option<Vec<Twist>> {
        let at: Vec<Twist> = group.clone().map(|body| self.twist(body)).collect();
        self.answer(group, &at, systems)
    }
    /// The adjoint of [`after_step`](Self::after_step), where contact has found the twists of a step of `dt` [s]: from what is owed to its bodies behind the step to what is owed to
    /// where they were before it, and to their twists, which are returned. A driven body's own motion is [`begin_back`](Self::begin_back)'s.
    ///
    /// # Errors
    /// As [`touch_back`](Self::touch_back), and what gradients do not go through, if it has come in this step.
    fn advance_back(&mut self, dt: f64, owed: &mut BodiesOwed<'_>) -> Result<Vec<Twist>> {
        let _ = (dt, owed);
        Err(no_adjoint(self.name()))
    }
    /// The adjoint of [`see`](Self::see): what is owed to bodies of other couplings, by their names, for what its own bodies, to which `step` is owed, found of them in the step from `time` that takes
    /// `dt` [s]. It comes between [`advance_back`](Self::advance_back) and [`begin_back`](Self::begin_back) of all couplings.
    ///
    /// # Errors
    /// As [`advance_back`](Self::advance_back).
    fn see_back(&self, time: f64, dt: f64, step: &[BodyInStep]) -> Result<Vec<(String, BodyInStep)>> {
        let _ = (time, dt, step);
        Ok(Vec::new())
    }
    /// The adjoint of [`before_step`](Self::before_step), and of driven bodies' motion over the step from `time` that takes `dt` [s]. `step` is what is owed to its bodies in it: of those that
    /// answer, to what balances at their twists. `owed` gets what is owed to their state before the step, and `told` what is owed to what they are told. Returns what is owed to the
    /// gravity of the step [s²/m].
    ///
    /// # Errors
    /// As [`advance_back`](Self::advance_back).
    fn begin_back(
        &self,
        time: f64,
        dt: f64,
        step: &[BodyInStep],
        owed: &mut BodiesOwed<'_>,
        told: &mut BodiesTold<'_>,
    ) -> Result<Vec3> {
        let _ = (time, dt, step, owed, told);
        Err(no_adjoint(self.name()))
    }
    /// The twist of a body's reference point: as it is given over this step if the body is driven, else as it would be without contact.
    fn twist(&self, body: usize) -> Twist {
        let _ = body;
        Twist::default()
    }
    /// Bodies that answer impulses, in groups that answer together. The others are driven: they move as they are told, whatever they feel.
    fn groups(&self) -> Vec<Group> {
        Vec::new()
    }
    /// Does a driven body stay where it is over the whole run, as others may know?
    fn stays(&self, body: usize) -> bool {
        let _ = body;
        false
    }
    /// The groups as a device moves them, which stay the same over the run: bodies that may come to touch are one.
    fn device_groups(&self) -> Vec<Group> {
        self.groups()
    }
    /// A device has no memory for groups of that size: makes them smaller before the run begins, so that it keeps their bodies [off one another](Self::leashes). Returns
    /// whether it could.
    fn part_device_groups(&mut self) -> bool {
        false
    }
    /// By how much the twists `at` of a group have to change so that all is in balance: solves (H + Σ A) δ = r + Σ b, with A and b of `systems`, one a body, r
    /// what the bodies themselves have out of balance at these twists, and H what they set against a change: their inertias and, for a robot, what its
    /// joints allow. `None` if there is no solution.
    fn answer(&self, group: Range<usize>, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        let _ = (group, at, systems);
        None
    }
    /// What is out of balance at the twists `at` of a group, along some change of them: (r + Σ b) · δ, see [`answer`](Self::answer) [J].
    fn balance(&self, group: Range<usize>, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        let _ = (group, at, systems, along);
        0.0
    }
    /// Twice the kinetic energy that a group has at some twists [J].
    fn twice_energy(&self, group: Range<usize>, twists: &[Twist]) -> f64 {
        let _ = (group, twists);
        0.0
    }
    /// Takes in what bodies felt of the ground in a step of `dt` [s], one driven body or a group: books it, and lets those that answer move by it;
    /// `twists` is what was found for them.
    ///
    /// # Errors
    /// If a body's state is no longer finite.
    fn feel(&mut self, bodies: Range<usize>, twists: &[Twist], reactions: &[Reaction], dt: f64) -> Result<()> {
        let _ = (bodies, twists, reactions, dt);
        Ok(())
    }
    /// The law in a form for devices, if there is one for all of the bodies. A backend that uses it calls
    /// [`before_step`](Self::before_step), takes poses and velocities from [`bodies`](Self::bodies) and one box a body from
    /// [`bounds`](Self::bounds), and calls [`after_step`](Self::after_step), for several steps ahead; then it says what the
    /// last of them gave, by [`book`](Self::book). Groups that answer move on the device, see [`DeviceAnswer`]: it asks for their
    /// [`leashes`](Self::leashes) and their [state](Self::device_state) before, and hands back what [came of them](Self::take_device_state).
    fn device_law(&self) -> Option<DeviceLaw> {
        None
    }
    /// How a device may move its groups in up to so many steps of `dt` from `time` [s].
    ///
    /// `None` if the coupling itself must take the next step, since one of the bodies is too near to anything but the ground. Nearer than two finest cells to a
    /// wall is too near where [levels take steps of their own](crate::scene::Levels::subcycle), but for robots, in whose scenes nodes behind walls are found after contact. Whether it is, and who moves
    /// them, depends on where bodies are and how they move now, not on the number of steps.
    fn leashes(&self, time: f64, dt: f64, steps: usize) -> Option<Leashes> {
        let _ = (time, dt, steps);
        None
    }
    /// What each group is told for the step that has begun, where a device takes [one at a time](Moved::InTurns), in the order of the groups, or nothing: words as its functions
    /// in WGSL read them, as many as [it may be told](DeviceGroup::told) at most. Behind those that are given there stand zeros.
    fn told(&self) -> Vec<Vec<[u32; 4]>> {
        Vec::new()
    }
    /// The groups as they are now, for a device to go on from.
    fn device_state(&self) -> Vec<GroupState> {
        Vec::new()
    }
    /// Says who moves the groups from now on. As long as a device takes part, [`before_step`](Self::before_step) and
    /// [`after_step`](Self::after_step) leave them where they are, and what is [saved](Self::save) is only good for a coupling whose groups a device moves, too. If all
    /// of its bodies are in groups that a device moves alone, a backend may call the two for the first of many steps alone.
    fn move_on_device(&mut self, moved: Moved) {
        let _ = moved;
    }
    /// Takes in what happened to each group in a step that a device took. Where nobody asks for [where bodies
    /// were](crate::StepReport::bodies) after each of many steps, only the last two are taken in, one after the other; what is counted is of all.
    ///
    /// # Errors
    /// If a body's state is no longer finite.
    fn take_device_state(&mut self, groups: &[GroupStep]) -> Result<()> {
        let _ = groups;
        Ok(())
    }
    /// Takes the mean wrench of the ground on each body over the last step from a backend that has applied the law itself.
    fn book(&mut self, wrenches: &[Wrench]) {
        let _ = wrenches;
    }
    /// Moves the bodies to `time + dt` with the impulses booked.
    ///
    /// # Errors
    /// If a body's state is no longer finite.
    fn after_step(&mut self, time: f64, dt: f64) -> Result<()>;
    /// Mean wrench of the soft ground on each body over the last step; as many as there are bodies.
    fn wrenches(&self) -> &[Wrench];
    /// Signed distance to the nearest body's surface [m], negative inside, at each point; used to seed ground around
    /// bodies and by tests. Bodies of a coupling without a surface answer infinity.
    fn distance(&self, points: &[Vec3]) -> Vec<f64>;
    /// Signed distance of points from the surface by which one body meets the ground on the finest level [m]: thin parts count as thicker there.
    fn contact_distance(&self, body: usize, points: &[Vec3]) -> Vec<f64> {
        let _ = body;
        self.distance(points)
    }
    /// What its bodies look like now. Pictures in perspective show nothing else of a coupling; top views and cuts ask for the
    /// [`distance`](Self::distance).
    fn surfaces(&self) -> Vec<Surface> {
        Vec::new()
    }
    /// Tells a body what to do from now on, for agents that act every step.
    ///
    /// # Errors
    /// If there is no such body, it does not take such commands, or the numbers are not finite.
    fn act(&mut self, body: &str, command: &Command) -> Result<()>;
    /// Files that it has read besides those that the scene and its parameters name, from the scene's folder: a run that is resumed wants them as they were.
    fn files(&self) -> Vec<PathBuf> {
        Vec::new()
    }
    /// Warnings about the set-up (a blade thinner than two cells, say) on finest cells of width `cell_width` [m]: 0 where there is no ground.
    fn warnings(&self, cell_width: f64) -> Vec<String>;
    /// Named counts of clamps and clips since the start, for the ledger.
    fn counts(&self) -> Vec<(String, u64)> {
        Vec::new()
    }
    /// Everything needed to continue bit for bit.
    fn save(&self) -> Vec<u8>;
    /// Takes up what [`save`](Self::save) gave.
    ///
    /// # Errors
    /// A text saying what is wrong with the bytes.
    fn restore(&mut self, bytes: &[u8]) -> std::result::Result<(), String>;
    /// What it can [go back](Self::go_back) to if what comes next fails, within this run. It is asked for before every step: a coupling that saves much which
    /// no step changes, such as the shapes of its bodies, says here what does change.
    fn keep(&self) -> Kept {
        Box::new(self.save())
    }
    /// Goes back to what it has [kept](Self::keep).
    ///
    /// # Errors
    /// A text saying what is wrong with it.
    fn go_back(&mut self, kept: Kept) -> std::result::Result<(), String> {
        match kept.downcast::<Vec<u8>>() {
            Ok(bytes) => self.restore(&bytes),
            Err(_) => Err("it is not what this coupling keeps".to_owned()),
        }
    }
}
