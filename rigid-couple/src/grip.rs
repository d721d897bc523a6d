//! How a rigid body grips the nodes near it.
//!
//! Particles that overlap a body press on it, each with a force of at most M d² o/(1 − o) along the surface's normal: M is the ground's λ +
//! 2μ at rest, d the particle's width and o the share of the width by which it overlaps. These forces go to the eight nodes
//! around, by linear weights, and what a node gets bounds what the body may take of the node's velocity in a step. So contact begins where particles are,
//! not where nodes are, and what it does in a second does not depend on the step: ground slides into the body until the bound bears its
//! pressure, by a share p/M of a particle's width.
//!
//! The law is that of [`barchan_core::contact`]: its normal lies along the sum of the forces, and their size bounds it. In the core of thin plates (see
//! [`Sdf::contact_surface`]) it holds both ways, and nodes deeper than two cells, which no particle outside reaches, move with the body.

use crate::mass::outer;
use crate::motion::Pose;
use crate::sdf::{Sdf, Surface};
use barchan_core::contact::adjoint::{BodyInStep, GripCotangent, NearCotangents};
use barchan_core::contact::{Grip, Touch};
use barchan_core::scene::Contact;
use barchan_core::{Aabb, NearParticle, NodeBatch, Vec3};
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Depth inside a body, in cells, below which nodes move with it.
const DEEP: f64 = 2.0;
/// How far from a surface particles touch it at most [cells]: half their width. How far from it the nodes are on which they act then.
const TOUCHING: f64 = 0.5;
pub(crate) const REACH: f64 = TOUCHING + NodeBatch::SPREAD;
/// So many nodes or particles are looked at by one thread at least.
const FEW: usize = 128;
/// Overlap at which a particle presses most, as a share of its width.
const MOST_OVERLAP: f64 = 0.9;

/// A body among the nodes and particles of a level.
struct Meeting<'a> {
    shape: &'a Sdf,
    pose: &'a Pose,
    nodes: &'a NodeBatch,
    bounds: Aabb,
    /// The middle of these bounds.
    middle: Vec3,
    has_images: bool,
    to_world: DMat3,
    to_body: DMat3,
}

impl<'a> Meeting<'a> {
    fn new(shape: &'a Sdf, pose: &'a Pose, nodes: &'a NodeBatch) -> Self {
        let bounds = shape.bounds(pose, nodes.cell_width);
        let to_world = DMat3::from_quat(pose.rotation);
        Self {
            shape,
            pose,
            nodes,
            bounds,
            middle: std::array::from_fn(|d| 0.5 * (bounds.min[d] + bounds.max[d])),
            has_images: nodes.periods != [0.0; 3],
            to_world,
            to_body: to_world.transpose(),
        }
    }

    /// The image of a point that is beside the body. Asked for every node and particle of every body.
    #[inline(always)]
    fn beside(&self, x: Vec3) -> Vec3 {
        if self.has_images { self.nodes.image_near(x, self.middle) } else { x }
    }

    /// A point in the body's frame.
    #[inline(always)]
    fn local(&self, x: Vec3) -> DVec3 {
        self.to_body * (DVec3::from_array(x) - self.pose.position)
    }

    /// The surface and its normal in the body's frame, and whether the point lies in the core of a thin part.
    #[inline(always)]
    fn surface_within(&self, x: Vec3, within: f64) -> Option<(Surface, bool)> {
        self.shape.contact_surface_within(self.local(x), self.nodes.cell_width, within)
    }

    /// What particles press with, in the body's frame; none of those that do not touch it.
    fn presses(&self) -> Vec<Option<DVec3>> {
        let cell = self.nodes.cell_width;
        let (around, of_cell) = (self.bounds.grown(TOUCHING * cell), cell.powi(3));
        let press_of = |particle: &NearParticle| {
            let at = self.beside(particle.position);
            // Few are wider than a cell.
            let touching = if particle.volume <= of_cell { TOUCHING * cell + rounding(cell) } else { f64::INFINITY };
            let (Surface { distance, normal }, _) =
                around.contains(at).then(|| self.surface_within(at, touching))??;
            // Many are too far off, which is told without a root.
            if (2.0 * distance).powi(3) >= particle.volume {
                return None;
            }
            Some(pressing(particle, distance).0 * normal?)
        };
        self.nodes.particles.par_iter().with_min_len(FEW).map(press_of).collect()
    }

    /// What particles press with on each node, in the body's frame.
    fn forces(&self, presses: &[Option<DVec3>]) -> Vec<DVec3> {
        let mut forces = vec![DVec3::ZERO; self.nodes.len()];
        for (particle, press) in self.nodes.particles.iter().zip(presses) {
            let Some(press) = *press else { continue };
            for (&node, weight) in self.nodes.cubes[particle.cube as usize].iter().zip(particle.weights()) {
                if node != NodeBatch::NONE {
                    forces[node as usize] += weight * press;
                }
            }
        }
        forces
    }
}

/// How much further off something may be than what is asked for [m].
fn rounding(cell: f64) -> f64 {
    1e-6 * cell
}

/// How strongly a particle presses at a distance [N], and how that changes with the distance [N/m].
#[inline(always)]
fn pressing(particle: &NearParticle, distance: f64) -> (f64, f64) {
    let width = particle.volume.cbrt();
    let overlap = (0.5 - distance / width).clamp(0.0, MOST_OVERLAP);
    let most = particle.modulus * width * width;
    let slope = if overlap < MOST_OVERLAP { -most / width / (1.0 - overlap).powi(2) } else { 0.0 };
    (most * overlap / (1.0 - overlap), slope)
}

/// Adds the nodes that a body of this shape grips in a step of `dt` [s].
pub(crate) fn touch(shape: &Sdf, contact: Contact, pose: &Pose, nodes: &NodeBatch, dt: f64, touches: &mut Vec<Touch>) {
    let meeting = Meeting::new(shape, pose, nodes);
    let (cell, to_world) = (nodes.cell_width, meeting.to_world);
    let forces = meeting.forces(&meeting.presses());
    let inside_of = |&x: &Vec3| {
        let x = meeting.beside(x);
        let surface = meeting.bounds.contains(x).then(|| meeting.surface_within(x, rounding(cell)))?;
        surface.filter(|(surface, _)| surface.distance < 0.0)
    };
    let inside: Vec<Option<(Surface, bool)>> = nodes.position.par_iter().with_min_len(FEW).map(inside_of).collect();
    for (node, (inside, &mass)) in inside.iter().zip(&nodes.mass).enumerate() {
        let force = to_world * forces[node];
        if inside.is_none() && force == DVec3::ZERO {
            continue;
        }
        let is_deep = inside.is_some_and(|(surface, _)| surface.distance < -DEEP * cell);
        let most = force.length() * dt / mass;
        let core_normal = inside.filter(|(_, core)| *core).and_then(|(surface, _)| surface.normal);
        let friction = match contact {
            Contact::Stick => None,
            Contact::Slip => Some(0.0),
            Contact::Coulomb { friction } => Some(friction),
        };
        let grip = match (friction, core_normal, force.try_normalize()) {
            _ if is_deep => Grip::Stick { most: f64::INFINITY },
            (None, ..) => Grip::Stick { most: if inside.is_some() { f64::INFINITY } else { most } },
            (Some(friction), Some(normal), _) => Grip::Bilateral { normal: to_world * normal, friction },
            (Some(friction), None, Some(normal)) => Grip::Coulomb { normal, friction, most },
            (Some(_), None, None) => continue,
        };
        let position = meeting.beside(nodes.position[node]);
        let distance =
            || meeting.surface_within(position, f64::INFINITY).map_or(f64::INFINITY, |(there, _)| there.distance);
        let distance = inside.map_or_else(distance, |(surface, _)| surface.distance);
        touches.push(Touch { node, arm: DVec3::from_array(position) - pose.position, distance, grip, is_deep });
    }
}

/// The adjoint of [`touch`]: from what is owed to grips to what is owed to nodes' masses and to particles, and to where the body is.
pub(crate) fn touch_back(
    shape: &Sdf,
    pose: &Pose,
    nodes: &NodeBatch,
    dt: f64,
    (touches, grips): (&[Touch], &[GripCotangent]),
    near: &mut NearCotangents,
    body: &mut BodyInStep,
) {
    let meeting = Meeting::new(shape, pose, nodes);
    let (cell, to_world) = (nodes.cell_width, meeting.to_world);
    let presses = meeting.presses();
    let forces = meeting.forces(&presses);
    // How a vector that belongs to a point changes with the point, along the world's axes.
    let turned = |rows: DMat3| to_world * rows * meeting.to_body;
    // What is owed to a vector at a point goes to the point, which is returned, and to the body's place: a body that moves along with the point changes nothing, and one that
    // turns carries both round.
    let mut owe = |arm: DVec3, vector: DVec3, rows: DMat3, owed: DVec3| {
        let of_point = rows.transpose() * owed;
        body.position -= of_point;
        body.rotation += vector.cross(owed) - arm.cross(of_point);
        of_point
    };
    let mut of_forces = vec![DVec3::ZERO; nodes.len()];
    for (touch, owed) in touches.iter().zip(grips).filter(|(_, owed)| **owed != GripCotangent::default()) {
        if let Grip::Bilateral { normal, .. } = touch.grip {
            let rows = turned(shape.contact_slopes(meeting.to_body * touch.arm, cell).normal);
            owe(touch.arm, normal, rows, owed.normal);
            continue;
        }
        // The direction is that of the sum of forces, and the bound its size times dt / m.
        let (force, mass) = (to_world * forces[touch.node], nodes.mass[touch.node]);
        let (length, along) = (force.length(), force.normalize_or_zero());
        if length > 0.0 {
            let across = owed.normal - along.dot(owed.normal) * along;
            of_forces[touch.node] += across / length + owed.most * dt / mass * along;
            near.mass[touch.node] -= owed.most * length * dt / (mass * mass);
        }
    }
    for (i, (particle, press)) in nodes.particles.iter().zip(&presses).enumerate() {
        let Some(press) = press.map(|press| to_world * press) else { continue };
        let cube = nodes.cubes[particle.cube as usize].iter();
        let (mut owed, mut of_place) = (DVec3::ZERO, DVec3::ZERO);
        let weights = particle.weights().into_iter().zip(particle.weight_slopes());
        for (&node, (weight, slopes)) in cube.zip(weights) {
            if node != NodeBatch::NONE {
                let of_force = of_forces[node as usize];
                owed += weight * of_force;
                of_place += of_force.dot(press) * DVec3::from_array(slopes);
            }
        }
        if owed == DVec3::ZERO && of_place == DVec3::ZERO {
            continue;
        }
        let at = meeting.beside(particle.position);
        let Some((Surface { distance, normal: Some(normal) }, _)) = meeting.surface_within(at, f64::INFINITY) else {
            continue;
        };
        let (size, slope) = pressing(particle, distance);
        let slopes = shape.contact_slopes(meeting.local(at), cell);
        let rows = turned(outer(slope * normal, slopes.distance) + slopes.normal * size);
        let of_point = owe(DVec3::from_array(at) - pose.position, press, rows, owed) + of_place / cell;
        (0..3).for_each(|d| near.position[i][d] += of_point[d]);
        near.modulus[i] += press.dot(owed) / particle.modulus;
    }
}
