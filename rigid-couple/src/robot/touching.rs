//! Contacts of a robot's links with what is rigid and does not answer: the world's walls and fixed tools.
//!
//! Contact points come from parry, anew in each step. Each acts like a node of ground that is much heavier than the robot: by the same law, in the same
//! system. Before the link is there, the node moves on with it as far as the gap allows.

use crate::motion::Pose;
use crate::sdf::Sdf;
use crate::world::{SolidWall, friction_of, solid, solid_walls};
use barchan_core::NodeBatch;
use barchan_core::contact::{Grip, Touch};
use barchan_core::coupling::Aabb;
use barchan_core::scene::{Contact, World};
use glam::DVec3;
use parry3d_f64::math::Pose as ParryPose;
use parry3d_f64::query::{ContactManifold, DefaultQueryDispatcher, PersistentQueryDispatcher};
use parry3d_f64::shape::SharedShape;

/// Weight of a contact point, in those of the robot: at rest under its weight, the robot sinks by g dt²/2 over this in each step.
const HEAVY: f64 = 1e4;
/// How much of what a link has sunk in is pushed out in a step, and how much in a second.
const PUSH: f64 = 0.1;
const FASTEST_PUSH: f64 = 20.0;

/// A rigid thing that stays where it is.
#[derive(Clone)]
pub struct Obstacle {
    parts: Vec<(SharedShape, ParryPose)>,
    bounds: Aabb,
    friction: f64,
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
    /// The world's walls for a robot whose base starts there: one that stands behind a wall, such as an arm beside a box of sand, reaches over it.
    pub fn walls(world: &World, base: DVec3) -> Vec<Self> {
        let before = |wall: &SolidWall| wall.inwards * (base[wall.axis] - wall.place) >= 0.0;
        let obstacle = |wall: SolidWall| {
            let mut bounds = Aabb::UNBOUND;
            let end = if wall.inwards > 0.0 { &mut bounds.max } else { &mut bounds.min };
            end[wall.axis] = wall.place;
            Self { parts: vec![(wall.shape(), wall.pose())], bounds, friction: wall.friction }
        };
        solid_walls(world).into_iter().filter(before).map(obstacle).collect()
    }

    /// A fixed tool.
    pub fn fixed(shape: &Sdf, pose: &Pose, contact: Contact) -> Self {
        let place = |part| {
            let (shape, within) = solid(part, false);
            (shape, to_parry(pose) * within)
        };
        let parts = shape.parts().iter().map(place).collect();
        Self { parts, bounds: shape.bounds(pose, 0.0), friction: friction_of(contact) }
    }
}

/// Contact points as nodes, and which link touches which.
#[derive(Clone, Debug, Default)]
pub struct Points {
    /// The points.
    pub nodes: NodeBatch,
    /// What each link touches.
    pub touches: Vec<Vec<Touch>>,
}

/// What a link is for contact points.
#[derive(Clone, Copy)]
pub struct Seen<'a> {
    /// Its shape; none touches nothing.
    pub body: Option<&'a Body>,
    /// Where its shape's frame is: at its centre of mass, along its axes.
    pub pose: Pose,
    /// A box around it.
    pub bounds: Aabb,
    /// Its coefficient of friction.
    pub friction: f64,
    /// How far it may come in the step [m].
    pub ahead: f64,
}

impl Points {
    /// Finds where links are, or may come to be in a step of `dt` [s], in contact; `mass` is the robot's [kg].
    pub fn find(&mut self, links: &[Seen<'_>], obstacles: &[Obstacle], mass: f64, dt: f64) {
        self.nodes.clear();
        self.touches.resize_with(links.len(), Vec::new);
        self.touches.iter_mut().for_each(Vec::clear);
        for (link, touches) in links.iter().zip(&mut self.touches) {
            let Some(body) = link.body else { continue };
            let reached = link.bounds.grown(link.ahead);
            for obstacle in obstacles.iter().filter(|obstacle| obstacle.bounds.meets(&reached)) {
                let friction = link.friction.min(obstacle.friction);
                for own in &body.0 {
                    let own = (&own.0, to_parry(&link.pose) * own.1);
                    for (shape, place) in &obstacle.parts {
                        manifolds((shape, *place), own, link.ahead, &mut |at, normal, gap| {
                            let push = if gap > 0.0 { gap / dt } else { gap * (PUSH / dt).min(FASTEST_PUSH) };
                            touches.push(Touch {
                                node: self.nodes.mass.len(),
                                arm: at - link.pose.position,
                                distance: gap,
                                grip: Grip::Coulomb { normal: -normal, friction, most: f64::INFINITY },
                                is_deep: false,
                            });
                            self.nodes.position.push(at.to_array());
                            self.nodes.mass.push(HEAVY * mass);
                            self.nodes.velocity.push((-normal * push).to_array());
                        });
                    }
                }
            }
        }
    }

    /// Is there any?
    pub fn is_empty(&self) -> bool {
        self.nodes.mass.is_empty()
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
