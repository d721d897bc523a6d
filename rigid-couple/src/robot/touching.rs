//! Contacts of robots' links with what is rigid and does not answer: the world's walls, and tools that stay or move as they are told; and with one another.
//!
//! Contact points come from parry, anew in each step. Each acts like a node of ground that is much heavier than the robot and moves with the surface it lies on:
//! by the same law, in the same system. Before the link is there, the node moves on with it as far as the gap allows. Between two links the node moves
//! with one of them, and pushes both: links of one robot, or of two that are then solved [together](super::together).

use super::dynamics::Place;
use super::images::Images;
use super::model::{Freedom, RobotModel};
use crate::motion::Pose;
use crate::rigid::body;
use crate::sdf::Sdf;
use crate::world::{SolidWall, friction_of, solid, solid_walls};
use barchan_core::contact::{Grip, Touch, Twist};
use barchan_core::coupling::Aabb;
use barchan_core::scene::{Scene, Tool, World};
use barchan_core::{BodyState, NodeBatch, Result};
use glam::{DQuat, DVec3};
use parry3d_f64::math::Pose as ParryPose;
use parry3d_f64::query::{self, ContactManifold, DefaultQueryDispatcher, PersistentQueryDispatcher};
use parry3d_f64::shape::SharedShape;

/// Weight of a contact point, in those of the robot, or of the lighter of two: at rest under its weight, the robot sinks by g dt²/2 over this in each step. With ten times as
/// much, what slides and nearly sticks is not found in a few iterations, and f32 bears less.
pub(super) const HEAVY: f64 = 1e3;
/// How much of what a link has sunk in is pushed out in a step, and how much in a second.
const PUSH: f64 = 0.1;
const FASTEST_PUSH: f64 = 20.0;
/// What overlaps by more where it starts is warned of [m]: things that stand on one another do so by less.
const SUNK: f64 = 1e-3;
/// Things that meet more slowly than this do not bounce [m/s], nor do those that gravity alone has brought to so many steps' speed: they come to rest.
const SLOW: f64 = 0.01;
const STEPS_OF_GRAVITY: f64 = 2.0;

/// A rigid thing that stays where it is, or moves as it is told.
#[derive(Clone)]
pub struct Obstacle {
    /// Its parts in its own frame.
    parts: Vec<(SharedShape, ParryPose)>,
    friction: f64,
    /// Where it is as a step begins, and how it moves in it.
    pose: Pose,
    twist: Twist,
    /// A box around it there.
    bounds: Aabb,
    /// What it is; none of a wall.
    tool: Option<DrivenTool>,
}

/// A tool that stays, or moves as it is told.
#[derive(Clone)]
struct DrivenTool {
    tool: Tool,
    shape: Sdf,
    moves: bool,
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

    /// Does it overlap another one by more than [`SUNK`], each at its pose?
    pub(super) fn overlaps(&self, pose: &Pose, (other, of_other): (&Self, &Pose)) -> bool {
        deepest((&self.0, pose), (&other.0, of_other)) > SUNK
    }

    /// How far it is from another one [m], each at its pose; 0 where they overlap.
    pub(super) fn distance(&self, pose: &Pose, (other, of_other): (&Self, &Pose)) -> f64 {
        let (own_at, other_at) = (to_parry(pose), to_parry(of_other));
        let between = |((own, place), (one, within)): (&(SharedShape, ParryPose), &(SharedShape, ParryPose))| {
            // What parry cannot look at does not touch.
            query::distance(&(own_at * *place), &**own, &(other_at * *within), &**one)
                .map_or(f64::INFINITY, |gap| gap.distance)
        };
        let all = self.0.iter().flat_map(|own| other.0.iter().map(move |one| (own, one)));
        all.map(between).fold(f64::INFINITY, f64::min)
    }
}

impl Obstacle {
    /// The scene's tools that stay, or move as they are told, where they are at the start.
    ///
    /// # Errors
    /// If a tool cannot be used, naming its key path.
    pub fn tools(scene: &Scene) -> Result<Vec<Self>> {
        let driven = |(_, tool): &(usize, &Tool)| !tool.answers();
        let obstacle = |(i, tool): (usize, &Tool)| {
            let body = body::Body::new(tool, scene, &format!("tool[{i}]"))?;
            let (pose, shape) = (body.state.pose, body.shape.clone());
            Ok(Self {
                parts: shape.parts().iter().map(|part| solid(part, false)).collect(),
                friction: friction_of(tool.contact),
                pose,
                twist: Twist::default(),
                bounds: shape.bounds(&pose, 0.0),
                tool: Some(DrivenTool { tool: tool.clone(), shape, moves: !body.is_fixed() }),
            })
        };
        scene.tool.iter().enumerate().filter(driven).map(obstacle).collect()
    }

    /// The world's walls for a robot whose base starts there: one that stands behind a wall, such as an arm beside a box of sand, reaches over it.
    pub fn walls(world: &World, base: DVec3) -> Vec<Self> {
        let before = |wall: &SolidWall| wall.inwards * (base[wall.axis] - wall.place) >= 0.0;
        let obstacle = |wall: SolidWall| {
            let mut bounds = Aabb::UNBOUND;
            let end = if wall.inwards > 0.0 { &mut bounds.max } else { &mut bounds.min };
            end[wall.axis] = wall.place;
            let parts = vec![(wall.shape(), wall.pose())];
            let (pose, twist) = (Pose::IDENTITY, Twist::default());
            Self { parts, friction: wall.friction, pose, twist, bounds, tool: None }
        };
        solid_walls(world).into_iter().filter(before).map(obstacle).collect()
    }

    /// The box around it; of a wall the half space behind it.
    pub(super) fn bounds(&self) -> &Aabb {
        &self.bounds
    }

    /// Does it ever move?
    pub(super) fn moves(&self) -> bool {
        self.tool.as_ref().is_some_and(|driven| driven.moves)
    }

    /// Takes up where it is as a step begins and how it moves in it, if it is among these bodies.
    pub(super) fn follow(&mut self, bodies: &[BodyState]) {
        let Some(DrivenTool { tool, shape, .. }) = &self.tool else { return };
        let Some(body) = bodies.iter().find(|body| body.name == tool.name) else { return };
        let [w, x, y, z] = body.rotation;
        self.pose = Pose { position: DVec3::from_array(body.position), rotation: DQuat::from_xyzw(x, y, z, w) };
        self.twist =
            Twist { linear: DVec3::from_array(body.velocity), angular: DVec3::from_array(body.angular_velocity) };
        self.bounds = shape.bounds(&self.pose, 0.0);
    }

    /// Changes a number of its pose, or of how it moves: along each axis, then about each.
    pub(super) fn vary(&mut self, number: usize, by: f64) {
        let (axis, zero) = (DVec3::AXES[number % 3], DVec3::ZERO);
        let way = match number / 3 % 2 {
            0 => Twist { linear: axis, angular: zero },
            _ => Twist { linear: zero, angular: axis },
        };
        if number < 6 {
            self.pose = self.pose.advanced(&way, by);
        } else {
            self.twist = self.twist.plus(by, &way);
        }
    }

    /// The tool that it is; none of a wall.
    pub(super) fn tool(&self) -> Option<&Tool> {
        self.tool.as_ref().map(|driven| &driven.tool)
    }

    /// Its coefficient of friction.
    pub(super) fn friction(&self) -> f64 {
        self.friction
    }

    /// What it is called.
    pub(super) fn title(&self) -> String {
        self.tool().map_or("a wall of the world".to_owned(), |tool| format!("'{}'", tool.name))
    }

    /// Does a body at `pose`, in such a box, overlap it or one of its images at the start by more than [`SUNK`]?
    pub(super) fn is_overlapped(&self, body: &Body, pose: &Pose, bounds: &Aabb, images: Images) -> bool {
        let overlaps = |by: DVec3| deepest((&self.parts, &self.pose.moved(by)), (&body.0, pose)) > SUNK;
        self.is_present(0.0) && images.meeting(bounds, &self.bounds).any(overlaps)
    }

    pub(super) fn is_present(&self, time: f64) -> bool {
        self.tool().is_none_or(|tool| tool.is_present(time))
    }

    /// How far its surface comes in a step of `dt` [s] at most [m].
    fn ahead(&self, dt: f64) -> f64 {
        let turning = self.twist.angular.length();
        let extent = || self.tool.as_ref().map_or(0.0, |driven| driven.shape.extent());
        // A plane has no extent of its own.
        let speed = self.twist.linear.length() + if turning > 0.0 { turning * extent() } else { 0.0 };
        2.0 * speed * dt
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
            let [at, of_other] = [one, other].map(|link| places[link].pose());
            if deepest((&first.0, &at), (&second.0, &of_other)) > 0.0 {
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

/// What a contact point comes of.
#[derive(Clone, Copy, Debug)]
pub struct Origin {
    /// The number of the obstacle that is touched, if it is one.
    pub obstacle: Option<usize>,
    /// The gap [m].
    gap: f64,
    /// How fast a bounce closes it [m/s], which is less than nothing; and does it bounce?
    bounce: f64,
    bounces: bool,
}

impl Origin {
    /// How fast the gap may close in a step of `dt` [s], on the side of the case distinctions on which another point is: it bounces, or is apart, or overlaps [m/s].
    pub fn push_like(&self, other: &Self, dt: f64) -> f64 {
        let gap = self.gap;
        match (other.bounces, other.gap > 0.0) {
            (true, _) => self.bounce,
            (_, true) => gap / dt,
            (_, false) => gap * (PUSH / dt).min(FASTEST_PUSH),
        }
    }

    /// The same on its own side.
    pub fn push(&self, dt: f64) -> f64 {
        self.push_like(self, dt)
    }
}

/// Contact points as nodes, and which link touches which.
#[derive(Clone, Debug, Default)]
pub struct Points {
    /// The points.
    pub nodes: NodeBatch,
    /// What each comes of.
    pub origins: Vec<Origin>,
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

impl Seen<'_> {
    /// Does it ever move? The base of a fixed robot does not.
    fn moves(&self) -> bool {
        !self.place.columns.is_empty()
    }
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
    /// Where the world's ends meet.
    pub images: Images,
}

/// Adds contact points to the nodes.
struct Adder<'a> {
    nodes: &'a mut NodeBatch,
    origins: &'a mut Vec<Origin>,
    obstacle: Option<usize>,
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
        let mut origin = Origin { obstacle: self.obstacle, gap, bounce: 0.0, bounces: false };
        if self.restitution > 0.0 {
            let approach = (surface - self.link.twist.at(at - self.link.place.centre)).dot(normal);
            origin.bounce = -self.restitution * approach;
            let is_blow = approach > SLOW + STEPS_OF_GRAVITY * gravity * dt && gap <= approach * dt;
            origin.bounces = is_blow && origin.bounce < origin.push(dt);
        }
        let push = origin.push(dt);
        self.origins.push(origin);
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
    /// Forgets all points, keeping the memory.
    pub fn clear(&mut self) {
        self.nodes.clear();
        self.origins.clear();
        self.touches.iter_mut().for_each(Vec::clear);
        self.pairs.clear();
    }

    /// Finds where links are, or may come to be in a step, in contact; points weigh `mass` [kg] each, and `pairs` are the links that may touch one another.
    pub fn find<'a>(
        &mut self,
        links: &[Seen<'_>],
        obstacles: impl Iterator<Item = &'a Obstacle>,
        pairs: &[[usize; 2]],
        mass: f64,
        span: Span,
    ) {
        self.clear();
        self.touches.resize_with(links.len(), Vec::new);
        let (nodes, origins) = (&mut self.nodes, &mut self.origins);
        for (o, obstacle) in obstacles.enumerate().filter(|(_, obstacle)| obstacle.is_present(span.time)) {
            let Obstacle { parts, pose, twist, bounds, .. } = obstacle;
            let ahead = obstacle.ahead(span.dt);
            for (link, touches) in links.iter().zip(&mut self.touches) {
                let ahead = link.ahead + ahead;
                let reached = link.bounds.grown(ahead);
                // What presses a link that stays on what does not answer cannot be told, and moves nothing.
                let Some(body) = link.body.filter(|_| link.moves()) else { continue };
                for image in span.images.meeting(&reached, bounds) {
                    let pose = pose.moved(image);
                    let friction = link.friction.min(obstacle.friction);
                    let restitution = link.restitution;
                    let obstacle = Some(o);
                    let mut adder =
                        Adder { nodes, origins, obstacle, touches, link, friction, restitution, mass, span };
                    between((parts, &pose), (&body.0, &link.place.pose()), ahead, &mut |at, normal, gap| {
                        adder.add(at, normal, gap, [twist.at(at - pose.position), DVec3::ZERO]);
                    });
                }
            }
        }
        for &bodies in pairs {
            let both = bodies.map(|body| &links[body]);
            let touches = among(both, DVec3::ZERO, (nodes, origins), mass, span);
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

/// What the first of two links touches of the second, which is as far off as that `image` of it [m], in a frame that moves with that; points weigh `mass` [kg].
pub fn among(
    [link, other]: [&Seen<'_>; 2],
    image: DVec3,
    (nodes, origins): (&mut NodeBatch, &mut Vec<Origin>),
    mass: f64,
    span: Span,
) -> Vec<Touch> {
    let mut touches = Vec::new();
    let ahead = link.ahead + other.ahead;
    let (Some(body), Some(others)) = (link.body, other.body) else { return touches };
    if !other.bounds.moved(image.to_array()).meets(&link.bounds.grown(ahead)) {
        return touches;
    }
    let friction = link.friction.min(other.friction);
    let restitution = link.restitution.max(other.restitution);
    let obstacle = None;
    let mut adder = Adder { nodes, origins, obstacle, touches: &mut touches, link, friction, restitution, mass, span };
    let pose = other.place.pose().moved(image);
    between((&others.0, &pose), (&body.0, &link.place.pose()), ahead, &mut |at, normal, gap| {
        adder.add(at, normal, gap, [other.twist.at(at - pose.position); 2]);
    });
    touches
}

type Parts = [(SharedShape, ParryPose)];

/// How far two things made of parts overlap [m]; 0 where they do not.
fn deepest(first: (&Parts, &Pose), second: (&Parts, &Pose)) -> f64 {
    let mut deepest = 0.0_f64;
    between(first, second, 0.0, &mut |_, _, gap| deepest = deepest.max(-gap));
    deepest
}

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
