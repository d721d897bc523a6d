//! The contact law, and its solution for bodies that answer, alone and together.

use barchan_core::contact::{Contact, Grip, Reaction, System, Touch, Twist};
use barchan_core::coupling::{Aabb, Group};
use barchan_core::glam::{DMat3, DVec3};
use barchan_core::{BodyState, Command, Coupling, NodeBatch, Result, Vec3, Wrench};
use std::ops::Range;

/// Prints the measured error beside the tolerance, and holds one to the other.
#[track_caller]
fn within(what: &str, error: f64, tolerance: f64) {
    println!("{what}: {error:.3e} (tolerance {tolerance:.1e})");
    assert!(error <= tolerance, "{what}: {error:e} > {tolerance:e}");
}

/// Numbers between −1 and 1, the same in every run (SplitMix64).
struct Random(u64);

impl Random {
    fn number(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as f64 / 2f64.powi(63) - 1.0
    }
    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.number(), self.number(), self.number())
    }
}

type Six = [f64; 6];

fn six(twist: &Twist) -> Six {
    let (v, w) = (twist.linear, twist.angular);
    [v.x, v.y, v.z, w.x, w.y, w.z]
}

fn twist(x: &Six) -> Twist {
    Twist { linear: DVec3::new(x[0], x[1], x[2]), angular: DVec3::new(x[3], x[4], x[5]) }
}

/// Solves M x = r by Gauss with pivots.
fn solved(mut m: [Six; 6], mut r: Six) -> Option<Six> {
    for c in 0..6 {
        let pivot = (c..6).max_by(|a, b| m[*a][c].abs().total_cmp(&m[*b][c].abs()))?;
        m.swap(c, pivot);
        r.swap(c, pivot);
        if m[c][c] == 0.0 {
            return None;
        }
        for i in c + 1..6 {
            let f = m[i][c] / m[c][c];
            (c..6).for_each(|j| m[i][j] -= f * m[c][j]);
            r[i] -= f * r[c];
        }
    }
    for c in (0..6).rev() {
        r[c] = (r[c] - (c + 1..6).map(|j| m[c][j] * r[j]).sum::<f64>()) / m[c][c];
    }
    Some(r)
}

/// A free body, and the nodes that it grips whatever there is.
#[derive(Clone)]
struct Body {
    mass: f64,
    /// About the centre of mass, world frame [kg m²].
    inertia: DMat3,
    place: DVec3,
    twist: Twist,
    touches: Vec<Touch>,
}

impl Body {
    fn new(mass: f64, inertia: DVec3, place: DVec3, twist: Twist) -> Self {
        Self { mass, inertia: DMat3::from_diagonal(inertia), place, twist, touches: Vec::new() }
    }
    fn matrix(&self) -> [Six; 6] {
        std::array::from_fn(|i| {
            std::array::from_fn(|j| match (i / 3, j / 3) {
                (0, 0) if i == j => self.mass,
                (1, 1) => self.inertia.col(j % 3)[i % 3],
                _ => 0.0,
            })
        })
    }
    fn residual(&self, at: &Twist, system: &System) -> Six {
        let lag = six(&self.twist.plus(-1.0, at));
        let own = self.matrix();
        std::array::from_fn(|i| system.impulse[i] + (0..6).map(|j| own[i][j] * lag[j]).sum::<f64>())
    }
    fn twice_energy(&self, twist: &Twist) -> f64 {
        self.mass * twist.linear.length_squared() + twist.angular.dot(self.inertia * twist.angular)
    }
}

/// Bodies in space: each for itself, or welded to the first one.
struct Bodies {
    bodies: Vec<Body>,
    welded: bool,
    unconverged: u64,
    wrenches: Vec<Wrench>,
}

impl Bodies {
    fn new(bodies: Vec<Body>, welded: bool) -> Self {
        Self { wrenches: vec![Wrench::default(); bodies.len()], bodies, welded, unconverged: 0 }
    }
    /// What the twist of the first body of a group makes of the twist of one of them.
    fn carried(&self, first: usize, body: usize) -> [Six; 6] {
        let arm = self.bodies[body].place - self.bodies[first].place;
        let mut map = [[0.0; 6]; 6];
        (0..6).for_each(|i| map[i][i] = 1.0);
        for axis in 0..3 {
            let moved = DVec3::AXES[axis].cross(arm);
            (0..3).for_each(|i| map[i][3 + axis] = moved[i]);
        }
        map
    }
}

impl Coupling for Bodies {
    fn name(&self) -> &str {
        "bodies"
    }
    fn bodies(&self) -> Vec<BodyState> {
        Vec::new()
    }
    fn max_speed(&self, _: f64, _: f64) -> f64 {
        0.0
    }
    fn before_step(&mut self, _: f64, _: f64) -> Result<()> {
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        Vec::new()
    }
    fn touch(&mut self, body: usize, _: f64, _: &NodeBatch, touches: &mut Vec<Touch>) {
        touches.extend(&self.bodies[body].touches);
    }
    fn twist(&self, body: usize) -> Twist {
        self.bodies[body].twist
    }
    fn groups(&self) -> Vec<Group> {
        let all = 0..self.bodies.len();
        if self.welded {
            return vec![Group { mass: self.bodies.iter().map(|body| body.mass).sum(), bodies: all }];
        }
        all.map(|b| Group { bodies: b..b + 1, mass: self.bodies[b].mass }).collect()
    }
    fn answer(&self, group: Range<usize>, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        // The unknown is the change of the first body's twist, as it is of the joints for a robot: H = sum J' (M + A) J.
        let (mut matrix, mut right) = ([[0.0; 6]; 6], [0.0; 6]);
        let first = group.start;
        for ((b, at), system) in group.clone().zip(at).zip(systems) {
            let (carried, own) = (self.carried(first, b), self.bodies[b].matrix());
            let residual = self.bodies[b].residual(at, system);
            for i in 0..6 {
                right[i] += (0..6).map(|k| carried[k][i] * residual[k]).sum::<f64>();
                for j in 0..6 {
                    let entry = |k: usize, l: usize| carried[k][i] * (own[k][l] + system.matrix[k][l]) * carried[l][j];
                    matrix[i][j] += (0..36).map(|n| entry(n / 6, n % 6)).sum::<f64>();
                }
            }
        }
        let change = solved(matrix, right)?;
        let of_body = |b: usize| {
            let carried = self.carried(first, b);
            twist(&std::array::from_fn(|i| (0..6).map(|j| carried[i][j] * change[j]).sum()))
        };
        Some(group.map(of_body).collect())
    }
    fn balance(&self, group: Range<usize>, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        let of_body = |(((b, at), system), along): (((usize, &Twist), &System), &Twist)| {
            let residual = self.bodies[b].residual(at, system);
            six(along).iter().zip(residual).map(|(x, r)| x * r).sum::<f64>()
        };
        group.zip(at).zip(systems).zip(along).map(of_body).sum()
    }
    fn twice_energy(&self, group: Range<usize>, twists: &[Twist]) -> f64 {
        group.zip(twists).map(|(b, twist)| self.bodies[b].twice_energy(twist)).sum()
    }
    fn feel(&mut self, bodies: Range<usize>, twists: &[Twist], reactions: &[Reaction], _: f64) -> Result<()> {
        for ((b, twist), reaction) in bodies.zip(twists).zip(reactions) {
            self.wrenches[b] = reaction.impulse;
            self.unconverged += u64::from(!reaction.converged);
            let body = &mut self.bodies[b];
            if self.welded {
                body.twist = *twist;
            } else {
                body.twist.linear += DVec3::from_array(reaction.impulse.force) / body.mass;
                body.twist.angular += body.inertia.inverse() * DVec3::from_array(reaction.impulse.torque);
            }
        }
        Ok(())
    }
    fn after_step(&mut self, _: f64, _: f64) -> Result<()> {
        Ok(())
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        vec![f64::INFINITY; points.len()]
    }
    fn act(&mut self, _: &str, _: &Command) -> Result<()> {
        Ok(())
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        Vec::new()
    }
    fn save(&self) -> Vec<u8> {
        Vec::new()
    }
    fn restore(&mut self, _: &[u8]) -> Result<(), String> {
        Ok(())
    }
}

fn nodes(velocities: &[DVec3], masses: &[f64]) -> NodeBatch {
    NodeBatch {
        cell_width: 0.01,
        position: vec![[0.0; 3]; masses.len()],
        mass: masses.to_vec(),
        velocity: velocities.iter().map(|v| v.to_array()).collect(),
        ..NodeBatch::default()
    }
}

fn energy(nodes: &NodeBatch) -> f64 {
    let of_node = |(u, m): (&Vec3, &f64)| 0.5 * m * DVec3::from_array(*u).length_squared();
    nodes.velocity.iter().zip(&nodes.mass).map(of_node).sum()
}

/// Laws of all kinds.
fn any_grip(random: &mut Random, kind: usize) -> Grip {
    let (normal, friction, most) = (random.vector().normalize(), 1.0 + random.number(), 0.5 + 0.5 * random.number());
    match kind {
        0 => Grip::Stick { most },
        1 => Grip::Coulomb { normal, friction, most },
        2 => Grip::Coulomb { normal, friction: 0.0, most },
        3 => Grip::Coulomb { normal, friction, most: f64::INFINITY },
        4 => Grip::Coulomb { normal, friction, most: 0.0 },
        _ => Grip::Bilateral { normal, friction },
    }
}

#[test]
fn what_a_law_takes_is_a_part_of_what_there_is() {
    // What is taken of u is K u with K symmetric and 0 <= K <= 1. Seen from outside: |K u|² <= u · K u. Without it the solution for a
    // free body need not exist, and contact could gain energy.
    let mut random = Random(20);
    let (mut beyond, mut gain, mut bound) = (0f64, 0f64, 0f64);
    for i in 0..60_000 {
        let grip = any_grip(&mut random, i % 6);
        let u = 3.0 * random.vector();
        let kept = grip.kept(u);
        let taken = u - kept;
        beyond = beyond.max(taken.length_squared() - u.dot(taken));
        gain = gain.max(kept.length() - u.length());
        bound = bound.max(match grip {
            Grip::Stick { most } => taken.length() - most,
            Grip::Coulomb { normal, friction, most } => {
                let hold = -taken.dot(normal);
                (hold - most).max((taken + hold * normal).length() - friction * hold)
            }
            Grip::Bilateral { normal, .. } => kept.dot(normal).abs(),
        });
    }
    within("|K u|² beyond u · K u [m²/s²]", beyond, 1e-14);
    within("speed gained [m/s]", gain, 1e-14);
    within("taken beyond the bound or the cone [m/s]", bound, 1e-14);
}

#[test]
fn laws_have_no_jumps() {
    // A law that jumps at its bound, at the friction cone or between approach and separation makes contact chatter, and no iteration finds a
    // balance. The normal part changes at most as fast as u, the tangential part by 1 and μ times as fast.
    let mut random = Random(21);
    let mut worst = 0f64;
    for i in 0..600 {
        let grip = any_grip(&mut random, i % 6);
        let (start, end) = (3.0 * random.vector(), 3.0 * random.vector());
        let taken = |s: i32| {
            let u = start.lerp(end, f64::from(s) / 1000.0);
            u - grip.kept(u)
        };
        let step = start.distance(end) / 1000.0;
        worst = (0..1000).fold(worst, |worst, s| worst.max(taken(s).distance(taken(s + 1)) / step));
    }
    within("change of what is taken, as a share of the change of u", worst, 1.0 + 1.0 + 2.0);
}

#[test]
fn solutions_converge_for_all_frictions_and_mass_ratios() {
    // Coulomb sliding has no energy to minimise, and Newton's method may cycle: however rough the surface and heavy the ground, the
    // result dissipates and closes; that the iteration itself converges is the rule.
    let mut random = Random(10);
    let cases = [f64::INFINITY, 0.3].map(|most| [0.0, 0.1, 0.5, 1.0, 2.0].map(|friction| (friction, most)));
    for (friction, most) in cases.into_iter().flatten() {
        for ratio in [1e-2, 1.0, 1e2, 1e4] {
            let (mut failed, mut gain, mut solved) = (0, 0f64, 0);
            for _ in 0..250 {
                let mut body = Body::new(1.0, DVec3::new(2e-3, 3e-3, 4e-3), DVec3::ZERO, Twist::default());
                // A corner of a box in the ground: three faces at once.
                let stream = 0.5 * random.vector();
                let velocities: Vec<DVec3> = (0..48).map(|_| stream + 0.05 * random.vector()).collect();
                let mut masses = Vec::new();
                for node in 0..48 {
                    let normal = DVec3::AXES[node % 3];
                    let arm = 0.1 * (normal + (random.vector() + 1.0) * 0.5 * (1.0 - normal));
                    masses.push(ratio / 48.0 * (1.0 + 0.99 * random.number()));
                    let grip = Grip::Coulomb { normal, friction, most };
                    body.touches.push(Touch { node, arm, distance: -0.01, grip, is_deep: false });
                }
                body.twist = Twist { linear: random.vector(), angular: 10.0 * random.vector() };
                let mut nodes = nodes(&velocities, &masses);
                let mut bodies = Bodies::new(vec![body], false);
                let total = |bodies: &Bodies, nodes: &NodeBatch| {
                    energy(nodes) + 0.5 * bodies.twice_energy(0..1, &[bodies.bodies[0].twist])
                };
                let before = total(&bodies, &nodes);
                Contact::default().meet(&mut [&mut bodies], 1e-3, &mut nodes).unwrap();
                gain = gain.max(total(&bodies, &nodes) / before - 1.0);
                failed += bodies.unconverged;
                solved += 1;
            }
            println!("friction {friction}, bound {most} m/s, ratio {ratio:e}: {failed} of {solved} not converged");
            within("relative energy gain", gain, 1e-12);
            let share = failed as f64 / f64::from(solved);
            within("share not converged", share, if ratio > 1e3 { 0.4 } else { 0.01 });
        }
    }
}

#[test]
fn bodies_welded_by_their_answer_move_as_the_one_body_that_they_are() {
    // Links of a robot answer together. Two bodies that a coupling solves as one must do what the one body does that they make: the same nodes, the same
    // law, half of the nodes held by each.
    let mut random = Random(11);
    let mut worst = 0f64;
    for i in 0..200 {
        let (masses, places) = ([0.7, 1.9], [random.vector(), random.vector()].map(|v| 0.1 * v));
        let inertias = [DVec3::new(2e-3, 3e-3, 4e-3), DVec3::new(5e-3, 4e-3, 7e-3)];
        let total = masses[0] + masses[1];
        let centre = (masses[0] * places[0] + masses[1] * places[1]) / total;
        let motion = Twist { linear: random.vector(), angular: 3.0 * random.vector() };
        let part = |b: usize| {
            let own = Twist { linear: motion.at(places[b] - centre), angular: motion.angular };
            Body::new(masses[b], inertias[b], places[b], own)
        };
        let mut parts = vec![part(0), part(1)];
        let mut whole = Body::new(total, DVec3::ONE, centre, motion);
        // Steiner's theorem.
        whole.inertia = (0..2).fold(DMat3::ZERO, |sum, b| {
            let r = places[b] - centre;
            let outer = DMat3::from_cols(r.x * r, r.y * r, r.z * r);
            let shift = DMat3::from_diagonal(DVec3::splat(r.length_squared())) - outer;
            sum + DMat3::from_diagonal(inertias[b]) + masses[b] * shift
        });
        let (mut velocities, mut weights) = (Vec::new(), Vec::new());
        for node in 0..40 {
            let place = 0.2 * random.vector();
            let grip = any_grip(&mut random, (i + node) % 6);
            velocities.push(random.vector());
            weights.push(0.05 * (1.01 + random.number()));
            let touch = |from: DVec3| Touch { node, arm: place - from, distance: -0.01, grip, is_deep: false };
            parts[node % 2].touches.push(touch(places[node % 2]));
            whole.touches.push(touch(centre));
        }
        let [mut of_parts, mut of_whole] = [(), ()].map(|()| nodes(&velocities, &weights));
        let (mut parts, mut whole) = (Bodies::new(parts, true), Bodies::new(vec![whole], false));
        Contact::default().meet(&mut [&mut parts], 1e-3, &mut of_parts).unwrap();
        Contact::default().meet(&mut [&mut whole], 1e-3, &mut of_whole).unwrap();
        let (moved, apart) = (whole.bodies[0].twist, |a: Vec3, b: Vec3| DVec3::from_array(a).distance(b.into()));
        for (a, b) in of_parts.velocity.iter().zip(&of_whole.velocity) {
            worst = worst.max(apart(*a, *b));
        }
        for body in &parts.bodies {
            worst = worst.max(body.twist.linear.distance(moved.at(body.place - centre)));
            worst = worst.max(0.1 * body.twist.angular.distance(moved.angular));
        }
    }
    within("velocities of nodes and bodies [m/s]", worst, 1e-8);
}

#[test]
fn a_node_is_the_body_s_in_which_it_is_deepest() {
    // Two plates that meet in a node would act on it in turn: the later one would undo what the earlier one did, and neither force would be what the node
    // lost. It moves with the one whose surface it is farther behind, whatever their order and their couplings.
    let gripping = |speed: f64, distance: f64| {
        let twist = Twist { linear: DVec3::new(speed, 0.0, 0.0), angular: DVec3::ZERO };
        let mut body = Body::new(1e30, DVec3::splat(1e30), DVec3::ZERO, twist);
        let grip = Grip::Stick { most: f64::INFINITY };
        body.touches.push(Touch { node: 0, arm: DVec3::ZERO, distance, grip, is_deep: false });
        body
    };
    for (distances, expected) in [([-0.01, -0.02], 2.0), ([-0.02, -0.01], 1.0), ([-0.01, 0.01], 1.0)] {
        let [a, b] = [gripping(1.0, distances[0]), gripping(2.0, distances[1])];
        for together in [false, true] {
            let mut nodes = nodes(&[DVec3::ZERO], &[0.5]);
            let couplings =
                if together { vec![vec![a.clone(), b.clone()]] } else { vec![vec![a.clone()], vec![b.clone()]] };
            let mut couplings: Vec<Box<dyn Coupling>> =
                couplings.into_iter().map(|own| Box::new(Bodies::new(own, false)) as _).collect();
            Contact::default().meet(&mut couplings, 1e-3, &mut nodes).unwrap();
            assert!((nodes.velocity[0][0] - expected).abs() < 1e-12, "{distances:?}: {:?}", nodes.velocity);
            let felt: Vec<f64> = couplings.iter().flat_map(|c| c.wrenches()).map(|w| w.force[0]).collect();
            let own = usize::from(expected == 2.0);
            assert!((felt[own] + 0.5 * expected).abs() < 1e-12 && felt[1 - own] == 0.0, "{felt:?}");
        }
    }
}
