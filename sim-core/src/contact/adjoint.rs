//! Contact backwards: from what a loss owes to nodes behind contact to what it owes to nodes before it, to the particles that press, and to the bodies.

use super::{Contact, Grip, Regime, System, Touch, Twist, add_outer, wrench_of};
use crate::coupling::{Coupling, Group, NodeBatch, Wrench};
use crate::{Error, Result, Vec3};
use glam::DVec3;
use std::ops::Range;

/// What a loss owes to nodes and particles near bodies, in the order of a batch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NearCotangents {
    /// By the nodes' velocities: behind contact when they are handed over, before it when they come back [s/m].
    pub velocity: Vec<Vec3>,
    /// By their masses [1/kg].
    pub mass: Vec<f64>,
    /// By the particles' positions [1/m].
    pub position: Vec<Vec3>,
    /// By their stiffness [1/Pa].
    pub modulus: Vec<f64>,
}

impl NearCotangents {
    /// Of a loss that owes so much to velocities, and nothing to the rest of a batch.
    pub fn of(velocity: Vec<Vec3>, nodes: &NodeBatch) -> Self {
        let particles = nodes.particles.len();
        Self {
            velocity,
            mass: vec![0.0; nodes.len()],
            position: vec![[0.0; 3]; particles],
            modulus: vec![0.0; particles],
        }
    }
}

/// What a loss owes to how a body grips a node.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GripCotangent {
    /// By the normal.
    pub normal: DVec3,
    /// By the greatest speed that may be taken [s/m].
    pub most: f64,
    /// By the coefficient of friction.
    pub friction: f64,
}

/// What a loss owes to a body by what contact made of it in a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BodyInStep {
    /// By its reference point at the start of the step [1/m].
    pub position: DVec3,
    /// By its rotation then, as a small turn of it about the world's axes [1/rad].
    pub rotation: DVec3,
    /// By its twist over the step [s/m, s/rad].
    pub twist: Twist,
    /// By its coefficient of friction.
    pub friction: f64,
}

impl Grip {
    /// The adjoint of [`kept`](Self::kept): from what is owed to what is left of `u` to what is owed to `u` and to the grip.
    fn kept_back(&self, u: DVec3, owed: DVec3) -> (DVec3, GripCotangent) {
        let Some(Regime { normal, hold, drag, bounded, slide }) = self.regime(u) else {
            return (owed, GripCotangent::default());
        };
        if let Self::Stick { most } = *self {
            let (speed, along) = (u.length(), u.normalize_or_zero());
            // Within the bound nothing is left, whatever u is.
            if hold == 1.0 {
                return (DVec3::ZERO, GripCotangent::default());
            }
            let of_length = along.dot(owed);
            let of_u = owed - most / speed * (owed - of_length * along);
            return (of_u, GripCotangent { most: -of_length, ..GripCotangent::default() });
        }
        // What is left is (1 − hold) (u·n) n + (1 − drag) t, with t = u − (u·n) n.
        let along = u.dot(normal);
        let tangential = u - along * normal;
        let (mut of_along, mut of_most, mut of_normal, mut of_friction) = (0.0, 0.0, DVec3::ZERO, 0.0);
        let mut of_tangential = (1.0 - drag) * owed;
        if bounded {
            let of_left = normal.dot(owed);
            of_along += of_left;
            of_most += of_left;
            of_normal += (1.0 - hold) * along * owed;
        }
        if let Some((direction, friction)) = slide {
            // drag = friction · taken / |t|
            let (speed, of_kept) = (tangential.length(), tangential.dot(owed));
            of_tangential += drag / speed * of_kept * direction;
            let of_taken = -friction / speed * of_kept;
            of_friction += hold * along / speed * of_kept;
            if bounded {
                of_most += of_taken;
            } else {
                of_along -= of_taken;
            }
        }
        // Without friction nothing is dragged, and the first of it would drag.
        if let Self::Coulomb { friction: 0.0, .. } | Self::Bilateral { friction: 0.0, .. } = *self {
            of_friction += hold * along.min(0.0) * tangential.normalize_or_zero().dot(owed);
        }
        of_along -= normal.dot(of_tangential);
        of_normal -= along * of_tangential;
        let normal_owed = of_normal + of_along * u;
        (of_tangential + of_along * normal, GripCotangent { normal: normal_owed, most: of_most, friction: of_friction })
    }
}

impl Contact {
    /// The adjoint of [`meet`](Self::meet), which has come before. `nodes` are those that it was given, with their velocities before contact, `impulses` what is owed to the impulse on each
    /// body in this step [1/(N s), 1/(N m s)], and `twists` what is owed to its twist behind contact. Returns what is owed to each body; of those that answer, to the twist without contact.
    ///
    /// # Errors
    /// [`Error::Missing`] if a coupling [has no adjoint](Coupling::twin), [`Error::Body`] if the balance of a body that answers has no solution.
    pub fn meet_back(
        &self,
        couplings: &[Box<dyn Coupling>],
        dt: f64,
        nodes: &NodeBatch,
        (impulses, twists): (&[Wrench], &[Twist]),
        near: &mut NearCotangents,
    ) -> Result<Vec<BodyInStep>> {
        let mut found: Vec<BodyInStep> = Vec::with_capacity(twists.len());
        for coupling in couplings {
            let coupling: &dyn Coupling = &**coupling;
            let own = found.len()..found.len() + coupling.wrenches().len();
            let (touches, twists) = (&self.touches[own.clone()], &twists[own.clone()]);
            let mut impulses = impulses[own].to_vec();
            for Group { bodies, .. } in coupling.groups() {
                let touches = &touches[bodies.clone()];
                if touches.iter().all(Vec::is_empty) {
                    continue;
                }
                let owed = (&impulses[bodies.clone()], &twists[bodies.clone()]);
                let balance = balance_back(coupling, bodies.clone(), (touches, nodes), owed, &near.velocity);
                let balance = balance.filter(|all| all.iter().all(Twist::is_finite)).ok_or_else(|| Error::Body {
                    path: format!("coupling '{}'", coupling.name()),
                    what: "gradients: the balance of bodies with the ground has no solution backwards".to_owned(),
                    mend: "lower time.step, or record a shorter time".to_owned(),
                })?;
                for (impulse, Twist { linear, angular }) in impulses[bodies].iter_mut().zip(balance) {
                    for d in 0..3 {
                        impulse.force[d] += linear[d];
                        impulse.torque[d] += angular[d];
                    }
                }
            }
            for (b, ((touches, impulse), twist)) in touches.iter().zip(&impulses).zip(twists).enumerate() {
                let mut body = BodyInStep { twist: *twist, ..BodyInStep::default() };
                if !touches.is_empty() {
                    let grips = drive_back(touches, nodes, &coupling.twist(b), impulse, near, &mut body);
                    coupling.touch_back(b, dt, nodes, (touches, &grips), near, &mut body)?;
                }
                found.push(body);
            }
        }
        Ok(found)
    }
}

/// What is owed to the balance M (V_f − V) + J(V) = 0 by which bodies that answer together have found their twists V: λ with (M + A)ᵀ λ = what is owed to V, where A = −dJ/dV. What nodes gave to a
/// body is then owed its λ besides.
fn balance_back(
    coupling: &dyn Coupling,
    group: Range<usize>,
    (touches, nodes): (&[Vec<Touch>], &NodeBatch),
    (impulses, twists): (&[Wrench], &[Twist]),
    velocity: &[Vec3],
) -> Option<Vec<Twist>> {
    let mut near = NearCotangents { velocity: velocity.to_vec(), mass: vec![0.0; nodes.len()], ..Default::default() };
    let of_body = |(((b, touches), impulse), twist): (((usize, &Vec<Touch>), &Wrench), &Twist)| {
        let at = coupling.twist(b);
        let mut owed = BodyInStep { twist: *twist, ..BodyInStep::default() };
        drive_back(touches, nodes, &at, impulse, &mut near, &mut owed);
        // Aᵀ = Σ Gᵀ m Dᵀ G, with D what is taken of a change of a node's velocity.
        let mut matrix = [[0.0; 6]; 6];
        for touch in touches {
            let u = DVec3::from_array(nodes.velocity[touch.node]) - at.at(touch.arm);
            for axis in DVec3::AXES {
                let taken = axis - touch.grip.kept_back(u, axis).0;
                let [rows, columns] = [taken, axis].map(|d| wrench_of(d, touch.arm));
                add_outer(&mut matrix, nodes.mass[touch.node], &rows, &columns);
            }
        }
        let Twist { linear, angular } = owed.twist;
        let impulse = [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z];
        System { matrix, impulse, symmetric: false, is_secant: false }
    };
    let systems: Vec<System> = group.clone().zip(touches).zip(impulses).zip(twists).map(of_body).collect();
    coupling.answer_back(group, &systems)
}

/// What is said of a coupling through which gradients cannot go back.
pub(crate) fn no_adjoint(name: &str) -> Error {
    Error::Missing {
        kind: "coupling",
        name: name.to_owned(),
        origin: "registered".to_owned(),
        what: "adjoint of what its bodies do to the ground".to_owned(),
        why: "gradients go back through all contact".to_owned(),
        mend:
            "leave its bodies out: gradients go through tools and robots, and through other couplings that have a twin"
                .to_owned(),
    }
}

/// The adjoint of a body with this twist driving the nodes that it touches, where so much is owed to the impulse on it: from what is owed to nodes' velocities behind that to what is owed to them before it,
/// and to their masses. Returns what is owed to each grip; `body` gets what is owed to the place by arms, to the twist, and to friction.
pub fn drive_back(
    touches: &[Touch],
    nodes: &NodeBatch,
    twist: &Twist,
    impulse: &Wrench,
    near: &mut NearCotangents,
    body: &mut BodyInStep,
) -> Vec<GripCotangent> {
    let [of_impulse, of_angular] = [impulse.force, impulse.torque].map(DVec3::from_array);
    let of_touch = |touch: &Touch| {
        let (mass, arm) = (nodes.mass[touch.node], touch.arm);
        let (before, surface) = (DVec3::from_array(nodes.velocity[touch.node]), twist.at(arm));
        let u = before - surface;
        // The body is given m (before − after) at the arm.
        let given = of_impulse + of_angular.cross(arm);
        let lost = u - touch.grip.kept(u);
        let of_after = DVec3::from_array(near.velocity[touch.node]) - mass * given;
        let (of_u, of_grip) = touch.grip.kept_back(u, of_after);
        near.velocity[touch.node] = (mass * given + of_u).to_array();
        near.mass[touch.node] += given.dot(lost);
        body.friction += of_grip.friction;
        let of_surface = of_after - of_u;
        body.twist.linear += of_surface;
        body.twist.angular += arm.cross(of_surface);
        body.position -= of_surface.cross(twist.angular) + mass * lost.cross(of_angular);
        of_grip
    };
    touches.iter().map(of_touch).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Physics: in each of the law's cases, what comes back is the derivative of what is left of a relative velocity.
    #[test]
    fn what_grips_give_back_are_derivatives() {
        let normal = DVec3::new(0.48, -0.6, 0.64);
        let (friction, free) = (0.3, f64::INFINITY);
        let grips = [
            Grip::Stick { most: free },
            Grip::Stick { most: 0.4 },
            Grip::Coulomb { normal, friction: 0.0, most: 0.2 },
            Grip::Coulomb { normal, friction, most: 0.2 },
            Grip::Coulomb { normal, friction, most: 2.0 },
            Grip::Coulomb { normal, friction: 20.0, most: 0.2 },
            Grip::Bilateral { normal, friction },
        ];
        let owed = DVec3::new(0.7, -1.1, 0.4);
        let ways = [DVec3::new(0.3, 0.5, -0.2), DVec3::new(-0.4, 0.1, 0.6)];
        for grip in grips {
            for u in [-0.5 * normal + DVec3::new(0.3, 0.2, 0.1), 0.3 * normal + DVec3::new(0.1, 0.4, -0.2)] {
                let (of_u, of_grip) = grip.kept_back(u, owed);
                let left = |by: f64| {
                    let grip = match grip {
                        Grip::Stick { most } => Grip::Stick { most: most + 0.7 * by },
                        Grip::Coulomb { normal, friction, most } => Grip::Coulomb {
                            normal: normal + by * ways[1],
                            friction: if friction > 0.0 { friction + 0.4 * by } else { 0.0 },
                            most: most + 0.7 * by,
                        },
                        Grip::Bilateral { normal, friction } => {
                            Grip::Bilateral { normal: normal + by * ways[1], friction: friction + 0.4 * by }
                        }
                    };
                    grip.kept(u + by * ways[0]).dot(owed)
                };
                let found = (left(1e-6) - left(-1e-6)) / 2e-6;
                let mut given = of_u.dot(ways[0]) + of_grip.normal.dot(ways[1]) + 0.7 * of_grip.most;
                if let Grip::Coulomb { normal, friction: 0.0, most } = grip {
                    // Friction can only grow.
                    let rubbing = Grip::Coulomb { normal, friction: 1e-7, most };
                    let found = (rubbing.kept(u) - grip.kept(u)).dot(owed) / 1e-7;
                    assert!((found - of_grip.friction).abs() < 1e-6, "{grip:?} {u}: {} {found}", of_grip.friction);
                } else {
                    given += 0.4 * of_grip.friction;
                }
                assert!((found - given).abs() < 1e-8, "{grip:?} {u}: {given} {found}");
            }
        }
    }
}
