//! Contacts of robots' links with what is rigid and does not answer: the world's walls, fixed tools, and tools on given paths; and with one another.
//!
//! Contact points come from parry, anew in each step. Each acts like a node of ground that is much heavier than the robot and moves with the surface it lies on:
//! by the same law, in the same system. Before the link is there, the node moves on with it as far as the gap allows. Between two links the node moves
//! with one of them, and pushes both: links of one robot, or of two that are then solved [together](super::together).

use super::dynamics::Place;
use super::model::{Freedom, RobotModel};
use crate::Refusal;
use crate::motion::{KeyframePath, Pose, rotation_from};
use crate::sdf::Sdf;
use crate::world::{SolidWall, friction_of, solid, solid_walls};
use barchan_core::NodeBatch;
use barchan_core::contact::{Grip, Touch, Twist};
use barchan_core::coupling::Aabb;
use barchan_core::scene::{Motion, Scene, Tool, World};
use glam::DVec3;
use parry3d_f64::math::Pose as ParryPose;
use parry3d_f64::query::{ContactManifold, DefaultQueryDispatcher, PersistentQueryDispatcher};
use parry3d_f64::shape::SharedShape;

/// Weight of a contact point, in those of the robot, or of the lighter of two: at rest under its weight, the robot sinks by g dt²/2 over this in each step.
pub(super) const HEAVY: f64 = 1e4;
/// How much of what a link has sunk in is pushed out in a step, and how much in a second.
const PUSH: f64 = 0.1;
const FASTEST_PUSH: f64 = 20.0;
/// Things that meet more slowly than this do not bounce [m/s], nor do those that gravity alone has brought to so many steps' speed: they come to rest.
const SLOW: f64 = 0.01;
const STEPS_OF_GRAVITY: f64 = 2.0;

/// A rigid thing that stays where it is, or moves as it is told.
#[derive(Clone)]
pub struct Obstacle {
    /// Its parts in its own frame.
    parts: Vec<(SharedShape, ParryPose)>,
    motion: Moves,
    friction: f64,
    /// The tool that it is, if it comes or goes.
    tool: Option<Tool>,
}

#[derive(Clone)]
enum Moves {
    /// Where it stays, and a box around it.
    Not(Pose, Aabb),
    Along(Box<(KeyframePath, Sdf)>),
}

/// An obstacle in a step.
struct Met {
    pose: Pose,
    twist: Twist,
    bounds: Aabb,
    /// How far its surface comes in the step at most [m].
    ahead: f64,
}

/// A link's shape as parry sees it.
#[derive(Clone)]
pub struct Body(Vec<(SharedShape, ParryPose)>);

fn to_parry(pose: &Pose) -> ParryPose {
    ParryPose::from_parts(pose.position, pose.rotation)
}

impl Body {
    /// Of a shape.
    pub fn new(shape: &Sdf) -> Self {
        Self(shape.parts().iter().map(|part| solid(part, true)).collect())
    }
}

impl Obstacle {
    /// The scene's tools that stay, or move as they are told.
    ///
    /// # Errors
    /// If a tool's shape, rotation or keyframes cannot be used.
    pub fn tools(scene: &Scene) -> Result<Vec<Self>, Refusal> {
        let mut all = Vec::new();
        for (i, tool) in scene.tool.iter().enumerate() {
            let shape = || {
                Sdf::from_shape(&tool.shape, &scene.folder, &format!("tool[{i}].shape"))
                    .map_err(|e| Refusal::new(e.to_string(), "mend the tool"))
            };
            let rotation = rotation_from(tool.rotation)?;
            match &tool.motion {
                Motion::Fixed => {
                    let (shape, pose) = (shape()?, Pose { position: DVec3::from_array(tool.position), rotation });
                    let bounds = shape.bounds(&pose, 0.0);
                    all.push(Self::new(tool, &shape, Moves::Not(pose, bounds)));
                }
                Motion::Keyframes { frames, interpolation } => {
                    let (shape, path) = (shape()?, KeyframePath::new(frames, *interpolation, rotation)?);
                    all.push(Self::new(tool, &shape.clone(), Moves::Along(Box::new((path, shape)))));
                }
                Motion::Velocity { .. } | Motion::Free { .. } | Motion::Servo(_) => {}
            }
        }
        Ok(all)
    }

    /// The world's walls for a robot whose base starts there: one that stands behind a wall, such as an arm beside a box of sand, reaches over it.
    pub fn walls(world: &World, base: DVec3) -> Vec<Self> {
        let before = |wall: &SolidWall| wall.inwards * (base[wall.axis] - wall.place) >= 0.0;
        let obstacle = |wall: SolidWall| {
            let mut bounds = Aabb::UNBOUND;
            let end = if wall.inwards > 0.0 { &mut bounds.max } else { &mut bounds.min };
            end[wall.axis] = wall.place;
            let parts = vec![(wall.shape(), wall.pose())];
            Self { parts, motion: Moves::Not(Pose::IDENTITY, bounds), friction: wall.friction, tool: None }
        };
        solid_walls(world).into_iter().filter(before).map(obstacle).collect()
    }

    fn new(tool: &Tool, shape: &Sdf, motion: Moves) -> Self {
        let parts = shape.parts().iter().map(|part| solid(part, false)).collect();
        let comes_and_goes = tool.from > 0.0 || tool.until.is_some();
        Self { parts, motion, friction: friction_of(tool.contact), tool: comes_and_goes.then(|| tool.clone()) }
    }

    /// As a step from `time` that takes `dt` [s] meets it.
    fn met(&self, [time, dt]: [f64; 2]) -> Met {
        match &self.motion {
            Moves::Not(pose, bounds) => Met { pose: *pose, twist: Twist::default(), bounds: *bounds, ahead: 0.0 },
            Moves::Along(along) => {
                let (path, shape) = &**along;
                let pose = path.pose(time);
                let twist = pose.chord(&path.pose(time + dt), dt);
                let speed = twist.linear.length() + twist.angular.length() * shape.extent();
                Met { pose, twist, bounds: shape.bounds(&pose, 0.0), ahead: 2.0 * speed * dt }
            }
        }
    }
}

/// Pairs of bodies that may touch: no neighbours at a joint, and none that overlap where the robot starts, which a warning names.
pub fn pairs_of(
    model: &mut RobotModel,
    solids: &[usize],
    bodies: &[Option<Body>],
    places: &[Place],
) -> Vec<[usize; 2]> {
    // What is fixed together counts as one.
    let whole = |mut link: usize| {
        while let (Some(parent), Freedom::Fixed) = (model.links[link].parent, model.links[link].joint.freedom) {
            link = parent;
        }
        link
    };
    let above = |whole_link: usize| model.links[whole_link].parent.map(whole);
    let near = |a: usize, b: usize| a == b || above(a) == Some(b) || above(b) == Some(a);
    let (mut pairs, mut left_out) = (Vec::new(), Vec::new());
    for b in 0..solids.len() {
        for a in 0..b {
            let (Some(first), Some(second)) = (&bodies[a], &bodies[b]) else { continue };
            let [one, other] = [a, b].map(|body| solids[body]);
            if near(whole(one), whole(other)) {
                continue;
            }
            let mut overlap = false;
            let [at, of_other] = [one, other].map(|link| places[link].pose());
            between((&first.0, &at), (&second.0, &of_other), 0.0, &mut |_, _, gap| overlap |= gap < 0.0);
            if overlap {
                left_out.push(format!("'{}' and '{}'", model.links[one].name, model.links[other].name));
            } else {
                pairs.push([a, b]);
            }
        }
    }
    if !left_out.is_empty() {
        let all = left_out.join(", ");
        model.warnings.push(format!("links that overlap at the start pass through each other: {all}"));
    }
    pairs
}

/// Contact points as nodes, and which link touches which.
#[derive(Clone, Debug, Default)]
pub struct Points {
    /// The points.
    pub nodes: NodeBatch,
    /// What each link touches.
    pub touches: Vec<Vec<Touch>>,
    /// Links that touch one another.
    pub pairs: Vec<Pair>,
}

/// Two links that touch.
#[derive(Clone, Debug)]
pub struct Pair {
    /// Their bodies.
    pub bodies: [usize; 2],
    /// The first one's place, as it moves against the second.
    pub place: Place,
    /// What the first one touches, in a frame that moves with the second.
    pub touches: Vec<Touch>,
}

/// What a link is for contact points.
#[derive(Clone, Copy)]
pub struct Seen<'a> {
    /// Its shape; none touches nothing.
    pub body: Option<&'a Body>,
    /// Where it is: its shape's frame is at its centre of mass, along its axes.
    pub place: &'a Place,
    /// A box around it.
    pub bounds: Aabb,
    /// Its coefficient of friction.
    pub friction: f64,
    /// How far it may come in the step [m].
    pub ahead: f64,
    /// Its twist before the step.
    pub twist: Twist,
    /// Its coefficient of restitution.
    pub restitution: f64,
}

/// A step, as contact points know it.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    /// When it starts [s].
    pub time: f64,
    /// How long it takes [s].
    pub dt: f64,
    /// Size of gravity [m/s²].
    pub gravity: f64,
}

/// Adds contact points to the nodes.
struct Adder<'a> {
    nodes: &'a mut NodeBatch,
    touches: &'a mut Vec<Touch>,
    link: &'a Seen<'a>,
    friction: f64,
    restitution: f64,
    /// Of a node [kg].
    mass: f64,
    span: Span,
}

impl Adder<'_> {
    /// A point of a surface that moves at `surface` [m/s], with its normal out of that surface; the node's velocity is seen from what moves at `frame`.
    fn add(&mut self, at: DVec3, normal: DVec3, gap: f64, [surface, frame]: [DVec3; 2]) {
        let Span { dt, gravity, .. } = self.span;
        let mut push = if gap > 0.0 { gap / dt } else { gap * (PUSH / dt).min(FASTEST_PUSH) };
        if self.restitution > 0.0 {
            let approach = (surface - self.link.twist.at(at - self.link.place.centre)).dot(normal);
            if approach > SLOW + STEPS_OF_GRAVITY * gravity * dt && gap <= approach * dt {
                push = push.min(-self.restitution * approach);
            }
        }
        let velocity = surface - frame;
        self.touches.push(Touch {
            node: self.nodes.mass.len(),
            arm: at - self.link.place.centre,
            distance: gap,
            grip: Grip::Coulomb { normal: -normal, friction: self.friction, most: f64::INFINITY },
            is_deep: false,
        });
        self.nodes.position.push(at.to_array());
        self.nodes.mass.push(self.mass);
        self.nodes.velocity.push((velocity - normal * push).to_array());
    }
}

impl Points {
    /// Finds where links are, or may come to be in a step, in contact; `mass` is the robot's [kg], and `pairs` are the links that may touch one another.
    pub fn find(&mut self, links: &[Seen<'_>], obstacles: &[Obstacle], pairs: &[[usize; 2]], mass: f64, span: Span) {
        self.nodes.clear();
        self.touches.resize_with(links.len(), Vec::new);
        self.touches.iter_mut().for_each(Vec::clear);
        self.pairs.clear();
        let (nodes, mass) = (&mut self.nodes, HEAVY * mass);
        for obstacle in obstacles {
            if obstacle.tool.as_ref().is_some_and(|tool| !tool.is_present(span.time)) {
                continue;
            }
            let Met { pose, twist, bounds, ahead } = obstacle.met([span.time, span.dt]);
            for (link, touches) in links.iter().zip(&mut self.touches) {
                let ahead = link.ahead + ahead;
                let Some(body) = link.body.filter(|_| bounds.meets(&link.bounds.grown(ahead))) else { continue };
                let friction = link.friction.min(obstacle.friction);
                let restitution = link.restitution;
                let mut adder = Adder { nodes, touches, link, friction, restitution, mass, span };
                between((&obstacle.parts, &pose), (&body.0, &link.place.pose()), ahead, &mut |at, normal, gap| {
                    adder.add(at, normal, gap, [twist.at(at - pose.position), DVec3::ZERO]);
                });
            }
        }
        for &bodies in pairs {
            let both = bodies.map(|body| &links[body]);
            let touches = among(both, nodes, mass, span);
            if !touches.is_empty() {
                let place = both[0].place.against(both[1].place);
                self.pairs.push(Pair { bodies, place, touches });
            }
        }
    }
}

/// Where touches press a link that moves with this twist, and with what mean force in a step of `dt` [s]; world frame [m, N].
pub fn forces(nodes: &NodeBatch, touches: &[Touch], twist: &Twist, dt: f64) -> impl Iterator<Item = (DVec3, DVec3)> {
    touches.iter().filter_map(move |touch| {
        let u = DVec3::from_array(nodes.velocity[touch.node]) - twist.at(touch.arm);
        let force = nodes.mass[touch.node] / dt * (u - touch.grip.kept(u));
        (force != DVec3::ZERO).then(|| (DVec3::from_array(nodes.position[touch.node]), force))
    })
}

/// What the first of two links touches of the second, in a frame that moves with that; points weigh `mass` [kg].
pub fn among([link, other]: [&Seen<'_>; 2], nodes: &mut NodeBatch, mass: f64, span: Span) -> Vec<Touch> {
    let mut touches = Vec::new();
    let ahead = link.ahead + other.ahead;
    let (Some(body), Some(others)) = (link.body, other.body) else { return touches };
    if !other.bounds.meets(&link.bounds.grown(ahead)) {
        return touches;
    }
    let friction = link.friction.min(other.friction);
    let restitution = link.restitution.max(other.restitution);
    let mut adder = Adder { nodes, touches: &mut touches, link, friction, restitution, mass, span };
    between((&others.0, &other.place.pose()), (&body.0, &link.place.pose()), ahead, &mut |at, normal, gap| {
        adder.add(at, normal, gap, [other.twist.at(at - other.place.centre); 2]);
    });
    touches
}

type Parts = [(SharedShape, ParryPose)];

/// Contact points of two things made of parts, no further apart than `ahead` [m]: place, normal out of the first, gap.
fn between(
    (first, first_at): (&Parts, &Pose),
    (second, second_at): (&Parts, &Pose),
    ahead: f64,
    add: &mut dyn FnMut(DVec3, DVec3, f64),
) {
    let (first_at, second_at) = (to_parry(first_at), to_parry(second_at));
    for (own, within) in second {
        for (shape, place) in first {
            manifolds((shape, first_at * *place), (own, second_at * *within), ahead, add);
        }
    }
}

/// Contact points of two shapes no further apart than `ahead` [m]: place, normal out of the first, gap.
fn manifolds(
    (first, first_at): (&SharedShape, ParryPose),
    (second, second_at): (&SharedShape, ParryPose),
    ahead: f64,
    add: &mut dyn FnMut(DVec3, DVec3, f64),
) {
    let mut found: Vec<ContactManifold<(), ()>> = Vec::new();
    let between = first_at.inverse() * second_at;
    // Pairs of shapes that parry cannot look at, such as two half spaces, do not touch.
    if DefaultQueryDispatcher.contact_manifolds(&between, &**first, &**second, ahead, &mut found, &mut None).is_err() {
        return;
    }
    for manifold in &found {
        let within = *manifold.subshape_pos1().unwrap_or(&ParryPose::IDENTITY);
        let frame = first_at * within;
        let normal = frame.rotation * manifold.local_n1;
        for point in manifold.points.iter().filter(|point| point.dist <= ahead) {
            let on_first = frame * point.local_p1;
            add(on_first + normal * (0.5 * point.dist), normal, point.dist);
        }
    }
}
