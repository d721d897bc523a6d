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

use crate::motion::Pose;
use crate::sdf::{Sdf, Surface};
use barchan_core::contact::{Grip, Touch};
use barchan_core::scene::Contact;
use barchan_core::{NearParticle, NodeBatch, Vec3};
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

/// Adds the nodes that a body of this shape grips in a step of `dt` [s].
pub(crate) fn touch(shape: &Sdf, contact: Contact, pose: &Pose, nodes: &NodeBatch, dt: f64, touches: &mut Vec<Touch>) {
    let cell = nodes.cell_width;
    let bounds = shape.bounds(pose, cell);
    let around = bounds.grown(TOUCHING * cell);
    let to_world = DMat3::from_quat(pose.rotation);
    let to_body = to_world.transpose();
    let surface_within = |x: Vec3, within: f64| {
        shape.contact_surface_within(to_body * (DVec3::from_array(x) - pose.position), cell, within)
    };
    let (rounding, of_cell) = (1e-6 * cell, cell.powi(3));
    let middle = std::array::from_fn(|d| 0.5 * (bounds.min[d] + bounds.max[d]));
    // Asked for every node and particle of every body.
    let has_images = nodes.periods != [0.0; 3];
    let beside = |x: Vec3| if has_images { nodes.image_near(x, middle) } else { x };
    let press_of = |particle: &NearParticle| {
        let at = beside(particle.position);
        // Few are wider than a cell.
        let touching = if particle.volume <= of_cell { TOUCHING * cell + rounding } else { f64::INFINITY };
        let (Surface { distance, normal }, _) = around.contains(at).then(|| surface_within(at, touching))??;
        // Many are too far off, which is told without a root.
        if (2.0 * distance).powi(3) >= particle.volume {
            return None;
        }
        let width = particle.volume.cbrt();
        let overlap = (0.5 - distance / width).clamp(0.0, MOST_OVERLAP);
        Some(particle.modulus * width * width * overlap / (1.0 - overlap) * normal?)
    };
    let presses: Vec<Option<DVec3>> = nodes.particles.par_iter().with_min_len(FEW).map(press_of).collect();
    let mut forces = vec![DVec3::ZERO; nodes.len()];
    for (particle, press) in nodes.particles.iter().zip(presses) {
        let Some(press) = press else { continue };
        for (&node, weight) in nodes.cubes[particle.cube as usize].iter().zip(particle.weights()) {
            if node != NodeBatch::NONE {
                forces[node as usize] += weight * press;
            }
        }
    }
    let inside_of = |&x: &Vec3| {
        let x = beside(x);
        let surface = bounds.contains(x).then(|| surface_within(x, rounding))?;
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
        let position = beside(nodes.position[node]);
        let distance = || surface_within(position, f64::INFINITY).map_or(f64::INFINITY, |(there, _)| there.distance);
        let distance = inside.map_or_else(distance, |(surface, _)| surface.distance);
        touches.push(Touch { node, arm: DVec3::from_array(position) - pose.position, distance, grip, is_deep });
    }
}
