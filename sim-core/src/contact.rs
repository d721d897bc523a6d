//! The contact law between grid nodes and bodies, and its implicit solution together with bodies that answer.
//!
//! Each coupling says which nodes its bodies grip, and how ([`Coupling::touch`]); a node is that body's in which it is deepest, over all couplings.
//! A node has a velocity `u` relative to the surface, of which the law takes a part `f(u) = K(u) u`, with 0 ≤ K ≤ 1 symmetric:
//! - stick: all of it, up to a bound;
//! - Coulomb with coefficient μ, where `u·n < 0` (approach): of the normal part as much as the bound allows and, of the tangential part, at
//!   most μ times as much; nothing on separation. μ = 0 is free slip;
//! - bilateral, in the core of thin plates: all of the normal part both ways, so that nothing crosses the plate; friction on approach only.
//!
//! Positions are never corrected, so an initial overlap ejects nothing.
//!
//! The surface's velocity of a body that is not driven depends on what the nodes give: its motion solves r(V) + Σ Gᵀ m_i f(u_i − G_i V) = 0, with V the
//! body's twist, G_i V its velocity at node i, and r what the body itself has out of balance: m (V_free − V) for a free body, what joints, motors and
//! limits add for the links of a robot. Taking V from before the step instead would be unstable as soon as the nodes in contact outweigh the body. Contact is
//! the same for all of them: a 6 × 6 matrix and a 6-vector for each body, a [`System`], which the coupling solves for its
//! bodies ([`Coupling::answer`]). V is found by Newton's method. Its last step is the linear solve with the
//! secant f(u) = K(u) u, K frozen: since 0 ≤ K ≤ 1 is symmetric, this is consistent and dissipative even where the iteration has not converged, and
//! the body receives exactly the momentum that the nodes lose.

pub mod adjoint;
mod search;
pub mod wgsl;

pub use search::Search;

use crate::coupling::{Aabb, Coupling, Group, NodeBatch, Wrench};
use crate::{Result, Vec3};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::ops::{DerefMut, Range};

/// Velocity of a rigid frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Twist {
    /// Of its origin [m/s].
    pub linear: DVec3,
    /// Angular velocity [rad/s].
    pub angular: DVec3,
}

impl Twist {
    /// What no solution gives: the nodes were not finite, and the impulse will not be.
    const NOT_FINITE: Self = Self { linear: DVec3::NAN, angular: DVec3::NAN };

    /// Velocity of the point at `arm` from the origin [m/s].
    pub fn at(&self, arm: DVec3) -> DVec3 {
        self.linear + self.angular.cross(arm)
    }
    /// Are all numbers finite?
    pub fn is_finite(&self) -> bool {
        self.linear.is_finite() && self.angular.is_finite()
    }
    /// This twist and so many times another one.
    #[must_use]
    pub fn plus(&self, times: f64, other: &Self) -> Self {
        Self { linear: self.linear + times * other.linear, angular: self.angular + times * other.angular }
    }
}

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

/// A node that a body grips.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Touch {
    /// Its number in the batch.
    pub node: usize,
    /// Its position from the body's reference point, along the world's axes [m].
    pub arm: DVec3,
    /// How far it is from the body's surface [m], negative inside.
    pub distance: f64,
    /// How it is held.
    pub grip: Grip,
    /// Is it so deep inside that no particle outside reaches it? Such nodes are counted.
    pub is_deep: bool,
}

/// What contact on a body comes to at a twist V that is tried: it gives the body the impulse b(V) [N s, N m s], and V + δ about b − A δ.
#[derive(Clone, Debug, PartialEq)]
pub struct System {
    /// Rows of A: Σ Gᵀ m D G with D the law's derivative or its secant K.
    pub matrix: [[f64; 6]; 6],
    /// The impulse b, then the angular impulse about the body's reference point: Σ Gᵀ m f.
    pub impulse: [f64; 6],
    /// Is A symmetric, hence positive semidefinite? So it is where no node slides without a bound, and for the secant.
    pub symmetric: bool,
    /// Is A that of the secant? So it is where no node slides and no bound is reached.
    is_secant: bool,
}

/// What a body felt of the ground in a contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reaction {
    /// Impulse on it, and angular impulse about its reference point [N s, N m s].
    pub impulse: Wrench,
    /// Nodes that were deep inside.
    pub deep_nodes: u64,
    /// Were its motion and the nodes' found together?
    pub converged: bool,
}

/// Iterations after which the frozen law is taken as it is.
const MAX_ITERATIONS: u32 = 60;
/// Weight of the ground in terms of the bodies' at which the iteration starts, if it is heavier than that, and the factor by
/// which it grows once the last step was relatively small.
const LIGHT: f64 = 10.0;
const HEAVIER: f64 = 4.0;
const SMALL: f64 = 0.03;
/// Relative size of the last step but one at convergence, in the norm of the kinetic energy. The law's part in momentum and
/// energy is exact whatever it is.
const TOLERANCE: f64 = 1e-10;

/// Where nodes, and then particles, are looked for on a level with cells of width `h` [m], so that all bodies of these couplings find theirs.
fn boxes<C: Coupling + ?Sized>(coupling: &C, h: f64) -> [Vec<Aabb>; 2] {
    let (bounds, reach) = (coupling.bounds(), coupling.reach());
    let grown = |by: f64| bounds.iter().map(|one| one.grown(by * h)).collect();
    let of_particles = if reach > 0.0 { grown(reach - NodeBatch::SPREAD) } else { Vec::new() };
    [grown(reach), of_particles]
}

/// Bodies of couplings meet nodes. Kept from step to step for its memory.
#[derive(Debug, Default)]
pub struct Contact {
    /// What each body grips, over all couplings.
    touches: Vec<Vec<Touch>>,
    /// The body in which each node is deepest, and how far it is from its surface [m].
    owners: Vec<(f64, usize)>,
}

/// What couplings do with the nodes that they are handed.
pub type Act<'a> = dyn FnMut(&mut NodeBatch) -> Result<()> + 'a;

impl Contact {
    /// All couplings act on the nodes of a level with cells of width `h` [m], in a step of `dt` [s] of its own: fields first, one after the other in the scene's order,
    /// then all bodies together. `with_nodes` gathers the nodes in the first boxes and the particles in the second ones, hands them over, and takes the nodes'
    /// velocities back.
    ///
    /// # Errors
    /// What `with_nodes` and couplings say.
    pub fn act(
        &mut self,
        couplings: &mut [Box<dyn Coupling>],
        [dt, h]: [f64; 2],
        mut with_nodes: impl FnMut([&[Aabb]; 2], &mut Act<'_>) -> Result<()>,
    ) -> Result<()> {
        for coupling in couplings.iter_mut().filter(|coupling| coupling.is_field()) {
            let [of_nodes, _] = boxes(&**coupling, h);
            with_nodes([&of_nodes, &[]], &mut |nodes| coupling.act_as_field(dt, nodes))?;
        }
        let bodies = couplings.iter().filter(|coupling| !coupling.is_field());
        let (of_nodes, of_particles): (Vec<_>, Vec<_>) = bodies.map(|one| boxes(&**one, h).into()).unzip();
        // Without a body that is there nothing is gathered.
        let there = |boxes: Vec<Vec<Aabb>>| boxes.concat().into_iter().filter(|one| !one.is_nothing()).collect();
        let [of_nodes, of_particles]: [Vec<Aabb>; 2] = [there(of_nodes), there(of_particles)];
        if of_nodes.is_empty() {
            return Ok(());
        }
        with_nodes([&of_nodes, &of_particles], &mut |nodes| self.meet(couplings, dt, nodes))
    }

    /// Has a body, by its number over all couplings, gripped any node when they met last?
    pub fn has_met(&self, body: usize) -> bool {
        self.touches.get(body).is_some_and(|touches| !touches.is_empty())
    }

    /// Bodies that are no fields act on nodes and feel them:
    /// 1. each body says which nodes it grips;
    /// 2. a node that several grip is that one's in which it is deepest, of equals the first one's in the scene's order;
    /// 3. bodies that answer move together with their nodes, the others make nodes move with them;
    /// 4. each feels what its nodes gave.
    ///
    /// # Errors
    /// If a body's state is no longer finite.
    pub fn meet<P, C>(&mut self, couplings: &mut [P], dt: f64, nodes: &mut NodeBatch) -> Result<()>
    where
        P: DerefMut<Target = C>,
        C: Coupling + ?Sized,
    {
        let mut firsts = Vec::with_capacity(couplings.len());
        let mut bodies = 0;
        for coupling in couplings.iter_mut() {
            firsts.push(bodies);
            let own = if coupling.is_field() { 0 } else { coupling.wrenches().len() };
            self.touches.resize_with(self.touches.len().max(bodies + own), Vec::new);
            for (b, touches) in self.touches[bodies..bodies + own].iter_mut().enumerate() {
                touches.clear();
                coupling.touch(b, dt, nodes, touches);
            }
            bodies += own;
        }
        self.touches.truncate(bodies);
        self.give_to_deepest(nodes.len());
        for (coupling, first) in couplings.iter_mut().zip(firsts) {
            if !coupling.is_field() {
                self.settle(&mut **coupling, first, dt, nodes)?;
            }
        }
        Ok(())
    }

    /// Leaves each node to the body in which it is deepest.
    fn give_to_deepest(&mut self, nodes: usize) {
        if self.touches.iter().filter(|touches| !touches.is_empty()).count() < 2 {
            return;
        }
        self.owners.clear();
        self.owners.resize(nodes, (f64::INFINITY, usize::MAX));
        for (b, touches) in self.touches.iter().enumerate() {
            for touch in touches {
                let owner = &mut self.owners[touch.node];
                if touch.distance < owner.0 {
                    *owner = (touch.distance, b);
                }
            }
        }
        for (b, touches) in self.touches.iter_mut().enumerate() {
            touches.retain(|touch| self.owners[touch.node].1 == b);
        }
    }

    /// The bodies of a coupling, the first of which has that number, and their nodes.
    fn settle<C: Coupling + ?Sized>(
        &self,
        coupling: &mut C,
        first: usize,
        dt: f64,
        nodes: &mut NodeBatch,
    ) -> Result<()> {
        let groups = coupling.groups();
        let mut b = 0;
        while b < coupling.wrenches().len() {
            let group = groups.iter().find(|group| group.bodies.start == b);
            let bodies = group.map_or(b..b + 1, |group| group.bodies.clone());
            b = bodies.end.max(b + 1);
            let touches = &self.touches[first + bodies.start..first + bodies.end];
            if touches.iter().all(Vec::is_empty) {
                continue;
            }
            let free: Vec<Twist> = bodies.clone().map(|body| coupling.twist(body)).collect();
            let (twists, reactions) = match group {
                Some(group) => Answering { coupling: &*coupling, group, touches, nodes, free: &free }.solve(),
                None => {
                    let impulse = drive(&touches[0], nodes, &free[0]);
                    (free, vec![Reaction { impulse, deep_nodes: count_deep(&touches[0]), converged: true }])
                }
            };
            coupling.feel(bodies, &twists, &reactions, dt)?;
        }
        Ok(())
    }
}

fn count_deep(touches: &[Touch]) -> u64 {
    touches.iter().filter(|touch| touch.is_deep).count() as u64
}

/// Sets one node's velocity, and adds the impulse that it gave to the body.
fn hand_over(touch: &Touch, mass: f64, velocity: &mut Vec3, new: DVec3, sum: &mut Wrench) {
    let impulse = mass * (DVec3::from_array(*velocity) - new);
    *velocity = new.to_array();
    let torque = touch.arm.cross(impulse);
    for d in 0..3 {
        sum.force[d] += impulse[d];
        sum.torque[d] += torque[d];
    }
}

/// Applies the law of a body whose motion is given. Returns the impulse on it.
fn drive(touches: &[Touch], nodes: &mut NodeBatch, twist: &Twist) -> Wrench {
    let mut sum = Wrench::default();
    for touch in touches {
        let velocity = &mut nodes.velocity[touch.node];
        let surface = twist.at(touch.arm);
        let u = DVec3::from_array(*velocity) - surface;
        let kept = touch.grip.kept(u);
        if kept != u {
            hand_over(touch, nodes.mass[touch.node], velocity, surface + kept, &mut sum);
        }
    }
    sum
}

/// Bodies that answer together, and the nodes that they grip.
struct Answering<'a, C: ?Sized> {
    coupling: &'a C,
    group: &'a Group,
    touches: &'a [Vec<Touch>],
    nodes: &'a mut NodeBatch,
    /// Their twists without contact.
    free: &'a [Twist],
}

impl<C: Coupling + ?Sized> Answering<'_, C> {
    fn bodies(&self) -> Range<usize> {
        self.group.bodies.clone()
    }

    /// Finds the bodies' twists and the nodes' velocities together. Returns the twists, and what each body felt.
    fn solve(&mut self) -> (Vec<Twist>, Vec<Reaction>) {
        let ground: f64 = self.touches.iter().flatten().map(|touch| self.nodes.mass[touch.node]).sum();
        // Ground much heavier than the bodies is first taken as lighter: its true weight then finds the right nodes in contact.
        let mut weight = (LIGHT * self.group.mass / ground).min(1.0);
        let mut frozen = self.free.to_vec();
        let mut systems = self.assemble(&frozen, weight, true);
        let mut iterations = 0;
        let (last_step, converged) = loop {
            iterations += 1;
            // A direction that does not lead towards balance is replaced by the secant's, which always does.
            let newton = self.coupling.answer(self.bodies(), &frozen, &systems);
            let newton =
                newton.map(|step| (self.left(&frozen, &systems, &step), step)).filter(|(lead, _)| *lead >= 0.0);
            let (lead, step) = newton.unwrap_or_else(|| {
                let step = self.secant_step(&frozen, weight);
                (self.left(&frozen, &systems, &step), step)
            });
            let scale = self.energy(&frozen).max(self.energy(self.free)).sqrt();
            let size = self.energy(&step).sqrt();
            let converged = weight == 1.0 && size <= TOLERANCE * scale;
            if converged || iterations == MAX_ITERATIONS {
                let is_secant = weight == 1.0 && systems.iter().all(|system| system.is_secant);
                break (if is_secant { step } else { self.secant_step(&frozen, 1.0) }, converged);
            }
            let part;
            (part, (frozen, systems)) = Search::along(lead, |part| {
                let tried = moved(&frozen, part, &step);
                let systems = self.assemble(&tried, weight, true);
                let left = self.left(&tried, &systems, &step);
                ((tried, systems), left)
            });
            if part * size <= SMALL * scale && weight < 1.0 {
                weight = (HEAVIER * weight).min(1.0);
                systems = self.assemble(&frozen, weight, true);
            }
        };
        let twists = moved(&frozen, 1.0, &last_step);
        let reactions = self.hand_over(&frozen, &twists, converged);
        (twists, reactions)
    }

    /// The step that balances with the law as it is at `frozen`; not finite if there is none.
    fn secant_step(&self, frozen: &[Twist], weight: f64) -> Vec<Twist> {
        let systems = self.assemble(frozen, weight, false);
        let step = self.coupling.answer(self.bodies(), frozen, &systems);
        step.unwrap_or_else(|| vec![Twist::NOT_FINITE; frozen.len()])
    }

    fn assemble(&self, twists: &[Twist], weight: f64, tangent: bool) -> Vec<System> {
        let pairs = self.touches.iter().zip(twists);
        pairs.map(|(touches, twist)| System::of(touches, self.nodes, twist, weight, tangent)).collect()
    }

    /// What is out of balance along a step [J].
    fn left(&self, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        self.coupling.balance(self.bodies(), at, systems, along)
    }

    /// Twice the kinetic energy of the bodies at some twists [J].
    fn energy(&self, twists: &[Twist]) -> f64 {
        self.coupling.twice_energy(self.bodies(), twists)
    }

    /// Nodes take the velocities that the law at `frozen` leaves them at `twists`.
    fn hand_over(&mut self, frozen: &[Twist], twists: &[Twist], converged: bool) -> Vec<Reaction> {
        let mut reactions = Vec::with_capacity(twists.len());
        for ((touches, frozen), twist) in self.touches.iter().zip(frozen).zip(twists) {
            let mut impulse = Wrench::default();
            for touch in touches {
                let velocity = &mut self.nodes.velocity[touch.node];
                let old = DVec3::from_array(*velocity);
                if let Some(regime) = touch.grip.regime(old - frozen.at(touch.arm)) {
                    let surface = twist.at(touch.arm);
                    let new = surface + regime.kept(old - surface);
                    hand_over(touch, self.nodes.mass[touch.node], velocity, new, &mut impulse);
                }
            }
            reactions.push(Reaction { impulse, deep_nodes: count_deep(touches), converged });
        }
        reactions
    }
}

fn moved(twists: &[Twist], times: f64, by: &[Twist]) -> Vec<Twist> {
    twists.iter().zip(by).map(|(twist, by)| twist.plus(times, by)).collect()
}

impl System {
    /// Σ Gᵀ m f at a twist, and Σ Gᵀ m D G with D the law's derivative (`tangent`) or its secant K; nodes' masses count `weight` times.
    pub fn of(touches: &[Touch], nodes: &NodeBatch, twist: &Twist, weight: f64, tangent: bool) -> Self {
        let (mut force, mut torque) = (DVec3::ZERO, DVec3::ZERO);
        // D = drag + rank-one terms: the first part of all nodes together is a rigid body of point masses.
        let (mut mass, mut first, mut second) = (0.0, DVec3::ZERO, DMat3::ZERO);
        let mut matrix = [[0.0; 6]; 6];
        let (mut symmetric, mut is_secant) = (true, true);
        for &Touch { node, arm, ref grip, .. } in touches {
            let u = DVec3::from_array(nodes.velocity[node]) - twist.at(arm);
            let Some(regime) = grip.regime(u) else { continue };
            let m = nodes.mass[node] * weight;
            let Regime { normal, hold, drag, bounded, ref slide } = regime;
            // Where the bound is reached, more approach is not met by more.
            let hold = if tangent && bounded { 0.0 } else { hold };
            is_secant &= !(tangent && (bounded || slide.is_some()));
            let n = wrench_of(normal, arm);
            add_outer(&mut matrix, m * (hold - drag), &n, &n);
            if let (true, Some((along, friction))) = (tangent, slide) {
                // d(μ |f_n| t) = −μ t nᵀ + drag (1 − n nᵀ − t tᵀ), without the first term where f_n is bounded
                let t = wrench_of(*along, arm);
                let friction = if bounded { 0.0 } else { *friction };
                add_outer(&mut matrix, -m, &t, &std::array::from_fn(|i| n[i] * friction + t[i] * drag));
                symmetric &= bounded;
            }
            let held = m * drag;
            let taken = m * (u - regime.kept(u));
            force += taken;
            torque += arm.cross(taken);
            mass += held;
            first += held * arm;
            second += DMat3::from_cols(held * arm.x * arm, held * arm.y * arm, held * arm.z * arm);
        }
        let trace = second.x_axis.x + second.y_axis.y + second.z_axis.z;
        let lower = DMat3::from_cols(
            DVec3::new(0.0, first.z, -first.y),
            DVec3::new(-first.z, 0.0, first.x),
            DVec3::new(first.y, -first.x, 0.0),
        );
        let angular = DMat3::from_diagonal(DVec3::splat(trace)) - second;
        let blocks = [[DMat3::from_diagonal(DVec3::splat(mass)), lower.transpose()], [lower, angular]];
        for (i, row) in matrix.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry += blocks[i / 3][j / 3].col(j % 3)[i % 3];
            }
        }
        let impulse = [force.x, force.y, force.z, torque.x, torque.y, torque.z];
        Self { matrix, impulse, symmetric, is_secant }
    }
}

/// Gᵀ d: what a force along `d` at `arm` does to a body.
fn wrench_of(d: DVec3, arm: DVec3) -> [f64; 6] {
    let torque = arm.cross(d);
    [d.x, d.y, d.z, torque.x, torque.y, torque.z]
}

/// Adds s a bᵀ.
fn add_outer(matrix: &mut [[f64; 6]; 6], s: f64, a: &[f64; 6], b: &[f64; 6]) {
    for (row, a) in matrix.iter_mut().zip(a) {
        for (entry, b) in row.iter_mut().zip(b) {
            *entry += s * a * b;
        }
    }
}
