//! The contact law between grid nodes and rigid surfaces, and its implicit solution for free bodies.
//!
//! Particles that overlap a body press on it, each with a force of at most M d² o/(1 − o) along the surface's normal: M is the ground's λ +
//! 2μ at rest, d the particle's width and o the share of the width by which it overlaps. These forces go to the eight nodes
//! around, by linear weights, and what a node gets bounds what the body may take of the node's velocity in a step. So contact begins where particles are,
//! not where nodes are, and what it does in a second does not depend on the step: ground slides into the body until the bound bears its
//! pressure, by a share p/M of a particle's width.
//!
//! A node has a velocity `u` relative to the surface, of which the law takes a part `f(u) = K(u) u`, with 0 ≤ K ≤ 1 symmetric:
//! - stick: all of it up to the bound, all of it inside the body;
//! - Coulomb with coefficient μ, where `u·n < 0` (approach), n along the sum of the forces: of the normal part as much as the bound allows
//!   and, of the tangential part, at most μ times as much; nothing on separation. μ = 0 is free slip;
//! - in the core of thin plates (see [`crate::Sdf::contact_surface`]): all of the normal part both ways, so that nothing crosses the
//!   plate; friction on approach only;
//! - nodes deeper than two cells, which no particle outside reaches, move with the body.
//!
//! Positions are never corrected, so an initial overlap ejects nothing.
//!
//! For a free body the surface's velocity depends on what the nodes give: m ΔV = Σ Gᵀ m_i f(u_i − G_i V), with V the body's
//! twist and G_i V its velocity at node i. Taking V from before the step instead would be unstable as soon as the nodes in
//! contact outweigh the body. [`FreeBody::solve`] finds V by Newton's method. Its last step is the linear solve with the secant
//! f(u) = K(u) u, K frozen: since 0 ≤ K ≤ 1 is symmetric, this is consistent and dissipative even where the iteration has not
//! converged, and the body receives exactly the momentum that the nodes lose.

use crate::mass::outer;
use crate::motion::Twist;
use barchan_core::{Vec3, Wrench};
use glam::{DMat3, DVec3};
use nalgebra::{Matrix6, Vector6};

/// How a surface grips a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Grip {
    /// The node moves with the surface.
    Stick {
        /// Greatest speed that may be taken [m/s].
        most: f64,
    },
    /// The node may separate; Coulomb friction on approach.
    Coulomb {
        /// Unit normal out of the body.
        normal: DVec3,
        /// Coefficient of friction.
        friction: f64,
        /// Greatest speed of approach that may be taken [m/s].
        most: f64,
    },
    /// As Coulomb without a bound, but that the node may not separate either: in the core of thin plates.
    Bilateral {
        /// Unit normal out of the body.
        normal: DVec3,
        /// Coefficient of friction.
        friction: f64,
    },
}

/// What the law takes from a relative velocity u: K u with K = hold n nᵀ + drag (1 − n nᵀ).
struct Regime {
    /// Any unit vector where hold is drag.
    normal: DVec3,
    hold: f64,
    drag: f64,
    /// Is `hold` less than it would be without the bound?
    bounded: bool,
    /// The direction in which the node slides, and the coefficient of friction.
    slide: Option<(DVec3, f64)>,
}

impl Grip {
    /// `None` if nothing is taken.
    fn regime(&self, u: DVec3) -> Option<Regime> {
        let (normal, friction, most, bilateral) = match *self {
            Self::Stick { most } => {
                let share = if u.length() > most { most / u.length() } else { 1.0 };
                return (share > 0.0).then_some(Regime {
                    normal: DVec3::Z,
                    hold: share,
                    drag: share,
                    bounded: false,
                    slide: None,
                });
            }
            Self::Coulomb { normal, friction, most } => (normal, friction, most, false),
            Self::Bilateral { normal, friction } => (normal, friction, f64::INFINITY, true),
        };
        let approach = -u.dot(normal);
        if approach <= 0.0 {
            return bilateral.then_some(Regime { normal, hold: 1.0, drag: 0.0, bounded: false, slide: None });
        }
        let bounded = approach > most;
        let taken = if bounded { most } else { approach };
        let tangential = u + approach * normal;
        let speed = tangential.length();
        let (drag, slide) = if friction == 0.0 {
            (0.0, None)
        } else if friction * taken >= speed {
            (1.0, None)
        } else {
            (friction * taken / speed, Some((tangential / speed, friction)))
        };
        Some(Regime { normal, hold: taken / approach, drag, bounded, slide })
    }

    /// What is left of the relative velocity `u` [m/s].
    pub fn kept(&self, u: DVec3) -> DVec3 {
        self.regime(u).map_or(u, |regime| regime.kept(u))
    }
}

impl Regime {
    /// (1 − K) u.
    fn kept(&self, u: DVec3) -> DVec3 {
        let along = u.dot(self.normal) * self.normal;
        (1.0 - self.hold) * along + (1.0 - self.drag) * (u - along)
    }
}

/// A node that a body acts on.
#[derive(Clone, Copy, Debug)]
pub struct Touch {
    /// Its place in the batch.
    pub node: usize,
    /// Its mass [kg].
    pub mass: f64,
    /// Its position from the body's reference point [m].
    pub arm: DVec3,
    /// How it is held.
    pub grip: Grip,
}

/// Sets one node's velocity, and returns the impulse that it gave to the body.
fn hand_over(touch: &Touch, velocity: &mut Vec3, new: DVec3) -> Wrench {
    let impulse = touch.mass * (DVec3::from_array(*velocity) - new);
    *velocity = new.to_array();
    Wrench { force: impulse.to_array(), torque: touch.arm.cross(impulse).to_array() }
}

fn add(sum: &mut Wrench, w: Wrench) {
    for d in 0..3 {
        sum.force[d] += w.force[d];
        sum.torque[d] += w.torque[d];
    }
}

/// Applies the law of a body whose motion is given. Returns the impulse on it.
pub fn drive(touches: &[Touch], velocities: &mut [Vec3], twist: &Twist) -> Wrench {
    let mut sum = Wrench::default();
    for touch in touches {
        let velocity = &mut velocities[touch.node];
        let surface = twist.at(touch.arm);
        let u = DVec3::from_array(*velocity) - surface;
        let kept = touch.grip.kept(u);
        if kept != u {
            add(&mut sum, hand_over(touch, velocity, surface + kept));
        }
    }
    sum
}

/// What a free body is made of.
#[derive(Clone, Copy, Debug)]
pub struct FreeBody {
    /// Mass [kg].
    pub mass: f64,
    /// Inertia about the centre of mass, world frame [kg m²].
    pub inertia: DMat3,
}

/// What the implicit solution came to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solved {
    /// Impulse on the body, about its centre of mass [N s, N m s].
    pub impulse: Wrench,
    /// Newton iterations taken.
    pub iterations: u32,
    /// Did they converge?
    pub converged: bool,
}

/// Iterations after which the frozen law is taken as it is.
const MAX_ITERATIONS: u32 = 40;
/// Weight of the ground in terms of the body's at which the iteration starts, if it is heavier than that, and the factor by
/// which it grows once the last step was relatively small.
const LIGHT: f64 = 10.0;
const HEAVIER: f64 = 4.0;
/// What may be out of balance along a step behind it, as a part of what was before it.
const OVERSHOT: f64 = 0.5;
const SMALL: f64 = 0.03;
/// Relative size of the last step but one at convergence, in the norm of the kinetic energy. The law's part in momentum and
/// energy is exact whatever it is.
const TOLERANCE: f64 = 1e-10;

impl FreeBody {
    /// Finds the body's twist and the nodes' velocities together. `free` is the twist that the body would have without
    /// contact; the caller adds the impulse to it.
    pub fn solve(&self, touches: &[Touch], velocities: &mut [Vec3], free: &Twist) -> Solved {
        let ground: f64 = touches.iter().map(|touch| touch.mass).sum();
        // Ground much heavier than the body is first taken as lighter: its true weight then finds the right nodes in contact.
        let mut weight = (LIGHT * self.mass / ground).min(1.0);
        let assemble = |twist: &Twist, weight: f64, tangent: bool| {
            self.assemble(touches, velocities, free, twist, weight, tangent)
        };
        let secant_step = |twist: &Twist, weight: f64| assemble(twist, weight, false).solve().unwrap_or(NOT_FINITE);
        let mut frozen = *free;
        let mut iterations = 0;
        // The last step, and what was out of balance along it before.
        let mut last: Option<(Vector6<f64>, f64)> = None;
        let (last_step, converged) = loop {
            iterations += 1;
            let system = assemble(&frozen, weight, true);
            // Where bounds are reached on the way, a step may lead beyond what balances along it: it is cut back.
            if let Some((step, before)) = last.take() {
                let beyond = -step.dot(&system.residual);
                if beyond > OVERSHOT * before && iterations < MAX_ITERATIONS {
                    let back = beyond / (before + beyond);
                    frozen = moved(&frozen, &(-back * step));
                    last = Some(((1.0 - back) * step, (1.0 - back) * before));
                    continue;
                }
            }
            // A direction that does not lead towards balance is replaced by the secant's, which always does.
            let newton = system.solve().filter(|step| step.dot(&system.residual) >= 0.0);
            let step = newton.unwrap_or_else(|| secant_step(&frozen, weight));
            let scale = self.energy_norm(&vector(&frozen)).max(self.energy_norm(&vector(free)));
            let size = self.energy_norm(&step);
            let converged = weight == 1.0 && size <= TOLERANCE * scale;
            if converged || iterations == MAX_ITERATIONS {
                let is_secant = weight == 1.0 && system.is_secant;
                break (if is_secant { step } else { secant_step(&frozen, 1.0) }, converged);
            }
            frozen = moved(&frozen, &step);
            last = Some((step, step.dot(&system.residual)));
            if size <= SMALL * scale && weight < 1.0 {
                weight = (HEAVIER * weight).min(1.0);
                last = None;
            }
        };
        let twist = moved(&frozen, &last_step);
        let mut impulse = Wrench::default();
        for touch in touches {
            let velocity = &mut velocities[touch.node];
            let old = DVec3::from_array(*velocity);
            if let Some(regime) = touch.grip.regime(old - frozen.at(touch.arm)) {
                let surface = twist.at(touch.arm);
                add(&mut impulse, hand_over(touch, velocity, surface + regime.kept(old - surface)));
            }
        }
        Solved { impulse, iterations, converged }
    }

    /// Σ Gᵀ m f − M (V − V_free) at the twist V, and M + Σ Gᵀ m D G with D the law's derivative (`tangent`) or its secant K;
    /// nodes' masses count `weight` times.
    fn assemble(
        &self,
        touches: &[Touch],
        velocities: &[Vec3],
        free: &Twist,
        twist: &Twist,
        weight: f64,
        tangent: bool,
    ) -> System {
        let mut force = self.mass * (free.linear - twist.linear);
        let mut torque = self.inertia * (free.angular - twist.angular);
        // D = drag + rank-one terms: the first part of all nodes together is a rigid body of point masses.
        let (mut mass, mut first, mut second) = (self.mass, DVec3::ZERO, DMat3::ZERO);
        let mut matrix = Matrix6::zeros();
        let (mut symmetric, mut is_secant) = (true, true);
        for &Touch { node, mass: m, arm, ref grip } in touches {
            let u = DVec3::from_array(velocities[node]) - twist.at(arm);
            let Some(regime) = grip.regime(u) else { continue };
            let m = m * weight;
            let Regime { normal, hold, drag, bounded, ref slide } = regime;
            // Where the bound is reached, more approach is not met by more.
            let hold = if tangent && bounded { 0.0 } else { hold };
            is_secant &= !(tangent && (bounded || slide.is_some()));
            let n = reach(arm, normal);
            matrix.ger(m * (hold - drag), &n, &n, 1.0);
            if let (true, Some((along, friction))) = (tangent, slide) {
                // d(μ |f_n| t) = −μ t nᵀ + drag (1 − n nᵀ − t tᵀ), without the first term where f_n is bounded
                let t = reach(arm, *along);
                let friction = if bounded { 0.0 } else { *friction };
                matrix.ger(-m, &t, &(n * friction + t * drag), 1.0);
                symmetric &= bounded;
            }
            let held = m * drag;
            let taken = m * (u - regime.kept(u));
            force += taken;
            torque += arm.cross(taken);
            mass += held;
            first += held * arm;
            second += outer(held * arm, arm);
        }
        let trace = second.x_axis.x + second.y_axis.y + second.z_axis.z;
        let angular = self.inertia + DMat3::from_diagonal(DVec3::splat(trace)) - second;
        let lower = DMat3::from_cols(
            DVec3::new(0.0, first.z, -first.y),
            DVec3::new(-first.z, 0.0, first.x),
            DVec3::new(first.y, -first.x, 0.0),
        );
        let blocks = [[DMat3::from_diagonal(DVec3::splat(mass)), lower.transpose()], [lower, angular]];
        matrix += Matrix6::from_fn(|i, j| blocks[i / 3][j / 3].col(j % 3)[i % 3]);
        System { residual: joined(force, torque), matrix, symmetric, is_secant }
    }

    /// Size of a twist, as the root of twice its kinetic energy.
    fn energy_norm(&self, twist: &Vector6<f64>) -> f64 {
        let [v, w] = halves(twist);
        (self.mass * v.length_squared() + w.dot(self.inertia * w)).sqrt()
    }
}

/// The linear system of one iteration.
struct System {
    residual: Vector6<f64>,
    matrix: Matrix6<f64>,
    /// Is the matrix symmetric, hence positive definite? So it is where no node slides without a bound, and for the secant.
    symmetric: bool,
    /// Is it that of the secant? So it is where no node slides and no bound is reached.
    is_secant: bool,
}

/// What no solution gives: the nodes were not finite, and the impulse will not be.
const NOT_FINITE: Vector6<f64> = Vector6::new(f64::NAN, f64::NAN, f64::NAN, f64::NAN, f64::NAN, f64::NAN);

impl System {
    fn solve(&self) -> Option<Vector6<f64>> {
        if self.symmetric {
            Some(self.matrix.cholesky()?.solve(&self.residual))
        } else {
            self.matrix.lu().solve(&self.residual)
        }
    }
}

/// Gᵀ d: what a force along `d` at `arm` does to a body.
fn reach(arm: DVec3, d: DVec3) -> Vector6<f64> {
    joined(d, arm.cross(d))
}

fn joined(a: DVec3, b: DVec3) -> Vector6<f64> {
    Vector6::new(a.x, a.y, a.z, b.x, b.y, b.z)
}

fn halves(v: &Vector6<f64>) -> [DVec3; 2] {
    [DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5])]
}

fn vector(twist: &Twist) -> Vector6<f64> {
    joined(twist.linear, twist.angular)
}

fn moved(twist: &Twist, step: &Vector6<f64>) -> Twist {
    let [linear, angular] = halves(step);
    Twist { linear: twist.linear + linear, angular: twist.angular + angular }
}
