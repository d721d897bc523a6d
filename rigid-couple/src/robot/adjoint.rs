//! Robots backwards.
//!
//! From a state x, which is where the base is, the joints' positions and all rates, a step finds rates v that balance,
//!
//! driven(x) + own(v, x) − M(x) v + Σ J(x)ᵀ W = 0,
//!
//! and moves on to the state next(x, v). `own` is what joints and rigid contacts give, W what the ground gives to each body. With λ from (M − ∂own/∂v − the ground's slopes)ᵀ λ = what is owed to v,
//! what is owed to x is the derivative by x, with v, λ and W as they are, of
//!
//! L = λ · (what balances) + what is owed to bodies' poses and twists in the step + what is owed to the state next(x, v).
//!
//! Joints and contact points go into L by their exact derivatives, each on the side of its case distinctions on which it was. What is smooth is left to central differences of L: mass
//! matrix, forces of motion, where contact points are, and how positions and rates move on. By what motors are told derivatives are exact.

use super::Robot;
use super::coupling::Robots;
use super::dynamics::{self, Place};
use super::joints::Slopes;
use super::solve::Whole;
use super::together::{self, Together};
use super::touching::{Obstacle, Origin, Pair, Points, Span};
use crate::Refusal;
use crate::motion::{Pose, rotation_vector};
use barchan_core::contact::adjoint::{BodyInStep, NearCotangents, drive_back};
use barchan_core::contact::{Grip, System, Touch, Twist};
use barchan_core::coupling::{BodiesOwed, BodiesTold};
use barchan_core::gradient::{BodyCotangents, PoseCotangent, RobotCotangents, RobotGradient};
use barchan_core::scene::{self, Contact};
use barchan_core::{NodeBatch, Result, Wrench};
use glam::DVec3;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Half the length of differences: of places [m, rad], and, relative, of rates, masses and the like.
const DIFFERENCE: f64 = 1e-6;

/// What is owed to a robot behind a step.
#[derive(Clone, Debug, Default)]
pub(super) struct Behind {
    bodies: Vec<BodyCotangents>,
    joints: RobotCotangents,
    /// Where its bodies come to be: small turns are from there.
    poses: Vec<Pose>,
    /// What was given to bodies' twists in place of what is owed to rates.
    handed: Vec<Twist>,
}

/// What a step of all robots is like.
struct Around<'a> {
    span: Span,
    gravity: DVec3,
    tools: &'a [&'a Obstacle],
}

/// What a number of the state before a step, or of the robot, is.
#[derive(Clone, Copy, Debug)]
enum Number {
    /// Of the base: along an axis of the world, and about it, through the centre of mass.
    Place(usize),
    Turn(usize),
    Position(usize),
    Rate(usize),
    Energy,
    /// Of a body.
    Mass(usize),
}

/// How L changes with a contact point that gives an impulse.
struct OfPoint {
    touch: Touch,
    origin: Origin,
    velocity: DVec3,
    normal: DVec3,
    arm: DVec3,
    mass: f64,
    friction: f64,
    /// The impulse on the link, about its centre of mass.
    impulse: Wrench,
    /// By the link's twist.
    twist: Twist,
}

/// Contact points, as they are somewhere.
#[derive(Clone, Copy)]
struct Found<'a> {
    touches: &'a [Touch],
    nodes: &'a NodeBatch,
    origins: &'a [Origin],
}

/// Normal and coefficient of friction of a contact point.
fn of_grip(touch: &Touch) -> (DVec3, f64) {
    match touch.grip {
        Grip::Coulomb { normal, friction, .. } => (normal, friction),
        _ => (DVec3::ZERO, 0.0),
    }
}

impl OfPoint {
    /// Of those of these points that give an impulse to a link.
    fn all(found: Found<'_>, place: &Place, rates: [&DVector<f64>; 2]) -> Vec<Self> {
        let Found { touches, nodes, origins } = found;
        let [twist, multiplier] = rates.map(|rates| place.twist(rates));
        let owed = Wrench { force: multiplier.linear.to_array(), torque: multiplier.angular.to_array() };
        let of_touch = |touch: &Touch| {
            let (velocity, mass) = (nodes.velocity[touch.node], nodes.mass[touch.node]);
            let alone = NodeBatch { velocity: vec![velocity], mass: vec![mass], ..NodeBatch::default() };
            let u = DVec3::from_array(velocity) - twist.at(touch.arm);
            let given = mass * (u - touch.grip.kept(u));
            if given == DVec3::ZERO {
                return None;
            }
            let mut near = NearCotangents::of(vec![[0.0; 3]], &alone);
            let mut body = BodyInStep::default();
            let grips = drive_back(&[Touch { node: 0, ..*touch }], &alone, &twist, &owed, &mut near, &mut body);
            Some(Self {
                touch: *touch,
                origin: origins[touch.node],
                velocity: DVec3::from_array(near.velocity[0]),
                normal: grips[0].normal,
                arm: -body.position,
                mass: near.mass[0],
                friction: body.friction,
                impulse: Wrench { force: given.to_array(), torque: touch.arm.cross(given).to_array() },
                twist: body.twist,
            })
        };
        touches.iter().filter_map(of_touch).collect()
    }

    /// What it comes to where the point has come to be, as apart or overlapping as it was; `None` where it is no more.
    fn value(&self, found: Found<'_>, place: &Place, rates: [&DVector<f64>; 2], dt: f64) -> Option<f64> {
        let Found { touches, nodes, origins } = found;
        let (was, _) = of_grip(&self.touch);
        let apart =
            |touch: &Touch| (touch.arm - self.touch.arm).length_squared() + (of_grip(touch).0 - was).length_squared();
        let same = touches.iter().filter(|touch| origins[touch.node].obstacle == self.origin.obstacle);
        let touch = same.min_by(|a, b| apart(a).total_cmp(&apart(b))).filter(|touch| apart(touch) < SAME * SAME)?;
        let (normal, _) = of_grip(touch);
        let origin = &origins[touch.node];
        let closes = origin.push(dt) - origin.push_like(&self.origin, dt);
        let velocity = DVec3::from_array(nodes.velocity[touch.node]) - normal * closes;
        let [twist, multiplier] = rates.map(|rates| place.twist(rates));
        let [force, torque] = [self.impulse.force, self.impulse.torque].map(DVec3::from_array);
        Some(
            self.velocity.dot(velocity)
                + self.normal.dot(normal - was)
                + self.arm.dot(touch.arm - self.touch.arm)
                + self.mass * nodes.mass[touch.node]
                + self.twist.linear.dot(twist.linear)
                + self.twist.angular.dot(twist.angular)
                + force.dot(multiplier.linear)
                + torque.dot(multiplier.angular),
        )
    }

    /// What is owed to the coefficient of friction of a body, if this point has that body's: of two bodies that meet it is the smaller one.
    fn friction_of(&self, friction: f64) -> f64 {
        if of_grip(&self.touch).1 == friction { self.friction } else { 0.0 }
    }
}

/// A robot's part in L.
struct Part<'a> {
    behind: &'a Behind,
    /// λ, and v.
    multiplier: DVector<f64>,
    rates: DVector<f64>,
    /// What is owed to bodies in the step, their twists apart from what has been [handed](Behind::handed) on, and what the ground gave them [N s, N m s].
    bodies: Vec<BodyInStep>,
    impulses: Vec<Wrench>,
    /// Where they were.
    poses: Vec<Pose>,
    joints: Vec<Slopes>,
    /// Of each body, with what is rigid, and of each pair.
    points: Vec<Vec<OfPoint>>,
    pairs: Vec<([usize; 2], Vec<OfPoint>)>,
}

/// Robots that touch, and L's part of that.
struct Meetings<'a> {
    together: &'a Together,
    /// v and λ of all.
    rates: [DVector<f64>; 2],
    points: Vec<Vec<OfPoint>>,
}

/// Contact points that are less far apart are the same one: between places of them [m], and normals.
const SAME: f64 = 1e-3;

impl Robot {
    /// As the step under way began, once more.
    fn begun(&self, around: &Around<'_>) -> Option<Self> {
        let mut begun = self.clone();
        begun.state.rates.copy_from_slice(self.step.before.as_slice());
        begun.begin_again(around)?;
        Some(begun)
    }

    /// Begins the step from the state as it is.
    fn begin_again(&mut self, around: &Around<'_>) -> Option<()> {
        let orders = std::mem::take(&mut self.step.orders);
        self.step = Self::at_rest(&self.model, self.floating, &self.solids, &self.state, orders)?;
        let boxes = self.boxes();
        self.begin(around.span, around.gravity, &boxes, around.tools).ok()
    }

    /// By how much what is out of balance falls for each unit of the rates that were found.
    fn slopes(&self) -> DMatrix<f64> {
        self.own_impulses(&self.step.rates, 1.0, true).matrix + &self.step.mass
    }

    /// The adjoint of [`answer`](Self::answer).
    pub(super) fn answer_back(&self, systems: &[System]) -> Option<Vec<Twist>> {
        let mut matrix = self.slopes().transpose();
        let mut owed = DVector::zeros(matrix.nrows());
        self.add_systems(systems, &mut owed, &mut matrix);
        Some(self.twists(&solved(matrix, owed)?))
    }

    /// What is owed to where it is now.
    fn owed_here(&self, behind: &Behind) -> f64 {
        let of_body = |(body, (owed, from)): (usize, (&BodyCotangents, &Pose))| {
            let (pose, twist) = (self.pose(body), self.twist(body));
            let turn = rotation_vector(pose.rotation * from.rotation.conjugate());
            let [position, rotation] = [owed.pose.position, owed.pose.rotation].map(DVec3::from_array);
            let [linear, angular] = [owed.velocity, owed.angular_velocity].map(DVec3::from_array);
            position.dot(pose.position - from.position)
                + rotation.dot(turn)
                + linear.dot(twist.linear)
                + angular.dot(twist.angular)
        };
        let bodies = behind.bodies.iter().zip(&behind.poses).enumerate();
        let RobotCotangents { positions, rates, energy } = &behind.joints;
        let positions = positions.iter().zip(&self.state.positions);
        let rates = rates.iter().zip(self.step.rates.iter().skip(self.base_rates()));
        let joints = positions.chain(rates).map(|(owed, x)| owed * x).sum::<f64>();
        bodies.map(of_body).sum::<f64>() + joints + energy * self.state.owed
    }

    /// The adjoint of [`advance`](Self::advance): what is owed to twists of bodies, which comes to what is owed to the rates that were found.
    pub(super) fn advance_back(&self, bodies: &[BodyCotangents], joints: RobotCotangents) -> Option<Behind> {
        let mut after = self.clone();
        after.advance()?;
        let poses = (0..self.solids.len()).map(|body| after.pose(body)).collect();
        let mut behind = Behind { bodies: bodies.to_vec(), joints, poses, handed: Vec::new() };
        let mut owed = DVector::zeros(self.step.rates.len());
        for rate in 0..owed.len() {
            owed[rate] = slope(DIFFERENCE * self.step.rates[rate].abs().max(1.0), |by| {
                let mut tried = self.clone();
                tried.step.rates[rate] += by;
                tried.advance()?;
                Some(tried.owed_here(&behind))
            })?;
        }
        behind.handed = self.twists(&self.step.squares.solve(&owed));
        Some(behind)
    }

    /// The numbers of its state and of itself that something may be owed to.
    fn numbers(&self) -> Vec<Number> {
        let drives = self.model.drives.len();
        let mut all: Vec<Number> = (0..3).map(Number::Place).chain((0..3).map(Number::Turn)).collect();
        all.extend((0..self.step.rates.len()).map(Number::Rate));
        all.extend(
            (0..self.solids.len()).filter(|&body| self.model.links[self.solids[body]].mass > 0.0).map(Number::Mass),
        );
        if !self.is_tool {
            all.extend((0..drives).map(Number::Position));
            all.extend((drives > 0).then_some(Number::Energy));
        }
        all
    }

    /// What a number is measured by.
    fn scale(&self, number: Number) -> f64 {
        match number {
            Number::Rate(rate) => self.state.rates[rate].abs().max(1.0),
            Number::Mass(body) => self.model.links[self.solids[body]].mass,
            _ => 1.0,
        }
    }

    /// Changes a number.
    fn vary(&mut self, number: Number, by: f64) {
        match number {
            Number::Place(axis) => self.state.base.position[axis] += by,
            Number::Turn(axis) => {
                let base = &mut self.state.base;
                let about = Twist { linear: DVec3::ZERO, angular: DVec3::AXES[axis] };
                let turned = base.advanced(&about, by).rotation;
                if self.guided.is_some() {
                    // The guide does not turn with the tool.
                    let joint = &mut Arc::make_mut(&mut self.model).links[self.solids[0]].joint;
                    joint.axis = turned.conjugate() * (base.rotation * joint.axis);
                } else {
                    let centre = self.model.links[0].centre;
                    base.position += base.rotation * centre - turned * centre;
                }
                base.rotation = turned;
            }
            Number::Position(drive) => self.state.positions[drive] += by,
            Number::Rate(rate) => self.state.rates[rate] += by,
            Number::Energy => self.state.owed += by,
            Number::Mass(body) => {
                let link = &mut Arc::make_mut(&mut self.model).links[self.solids[body]];
                link.inertia *= 1.0 + by / link.mass;
                link.mass += by;
                if let Some(guided) = &mut self.guided {
                    guided.mass += by;
                }
            }
        }
    }

    /// What is owed to what its motors are told, and to their gains.
    fn told_back(&self, multiplier: &DVector<f64>, joints: &[Slopes], told: &mut RobotGradient) {
        let RobotGradient { targets, rates, torques, kp, kd } = told;
        for sums in [&mut *targets, rates, torques, kp, kd] {
            sums.resize(joints.len(), 0.0);
        }
        for (drive, slopes) in joints.iter().enumerate() {
            let owed = multiplier[self.base_rates() + drive];
            let ([least, most], target) = (self.model.drives[drive].limits, self.step.orders[drive].target);
            // What is told stays within limits, and so does what balance makes of it.
            let is_bounded = self.state.orders.is_some() || self.corrects(drive);
            let follows = !is_bounded || (target > least && target < most);
            targets[drive] += if follows { owed * slopes.target } else { 0.0 };
            rates[drive] += owed * slopes.rate;
            torques[drive] += owed * slopes.torque;
            kp[drive] += owed * slopes.kp;
            kd[drive] += owed * slopes.kd;
        }
    }

    /// L, without what it has with other robots, if it has begun the step.
    fn value(&mut self, part: &Part<'_>) -> Option<f64> {
        let Part { behind, multiplier, rates, bodies, impulses, poses, joints, points, pairs } = part;
        let both = [rates, multiplier];
        let mut sum = multiplier.dot(&(&self.step.driven - &self.step.mass * rates));
        for (body, ((owed, impulse), from)) in bodies.iter().zip(impulses).zip(poses).enumerate() {
            let place = &self.step.places[self.solids[body]];
            let [twist, given] = both.map(|rates| place.twist(rates));
            let pose = place.pose();
            let [force, torque] = [impulse.force, impulse.torque].map(DVec3::from_array);
            sum += owed.position.dot(pose.position - from.position)
                + owed.rotation.dot(rotation_vector(pose.rotation * from.rotation.conjugate()))
                + owed.twist.linear.dot(twist.linear)
                + owed.twist.angular.dot(twist.angular)
                + force.dot(given.linear)
                + torque.dot(given.angular);
        }
        let first = self.base_rates();
        for (drive, slopes) in joints.iter().enumerate() {
            let (rate, order) = (first + drive, &self.step.orders[drive]);
            sum += multiplier[rate]
                * (slopes.position * self.state.positions[drive]
                    + slopes.inertia * self.step.mass[(rate, rate)]
                    + slopes.target * order.target
                    + slopes.torque * order.torque);
        }
        sum += self.value_of_points(points, both)?;
        let own = &self.step.points;
        for (bodies, points) in pairs.iter().filter(|(_, points)| !points.is_empty()) {
            let Pair { place, touches, .. } = own.pairs.iter().find(|pair| pair.bodies == *bodies)?;
            for point in points {
                sum += point.value(self.found(touches), place, both, self.step.dt)?;
            }
        }
        self.step.rates.copy_from(rates);
        self.advance()?;
        Some(sum + self.owed_here(behind))
    }

    /// What points with rigid things come to in L.
    fn value_of_points(&self, points: &[Vec<OfPoint>], rates: [&DVector<f64>; 2]) -> Option<f64> {
        let own = &self.step.points;
        let mut sum = 0.0;
        for ((points, touches), &link) in points.iter().zip(&own.touches).zip(&self.solids) {
            for point in points {
                sum += point.value(self.found(touches), &self.step.places[link], rates, self.step.dt)?;
            }
        }
        Some(sum)
    }

    /// Some of its contact points.
    fn found<'a>(&'a self, touches: &'a [Touch]) -> Found<'a> {
        let Points { nodes, origins, .. } = &self.step.points;
        Found { touches, nodes, origins }
    }
}

/// The derivative of a value at 0, by differences of this length; from one side where it has no value on the other, since points may come or go there.
fn slope(by: f64, mut value: impl FnMut(f64) -> Option<f64>) -> Option<f64> {
    let found = match (value(by), value(-by)) {
        (Some(more), Some(less)) => (more - less) / (2.0 * by),
        (Some(more), None) => (more - value(0.0)?) / by,
        (None, Some(less)) => (value(0.0)? - less) / by,
        (None, None) => return None,
    };
    Some(found).filter(|slope| slope.is_finite())
}

/// The solution of a system that need not be symmetric.
fn solved(matrix: DMatrix<f64>, owed: DVector<f64>) -> Option<DVector<f64>> {
    if owed.is_empty() {
        return Some(owed);
    }
    matrix.lu().solve(&owed).filter(|x| x.iter().all(|x| x.is_finite()))
}

impl Together {
    /// The adjoint of [`answer`](Self::answer), robot by robot.
    pub(super) fn answer_back(&self, robots: &[Robot], systems: &[&[System]]) -> Option<Vec<Vec<Twist>>> {
        let mut matrix = self.slopes(robots).transpose();
        let mut owed = DVector::zeros(matrix.nrows());
        self.add_systems(robots, systems, &mut owed, &mut matrix);
        let all = solved(matrix, owed)?;
        Some(self.own(robots).zip(self.parts(&all)).map(|(robot, rates)| robot.twists(&rates)).collect())
    }

    /// How L changes with the points between these robots.
    fn points_back(&self, rates: [&DVector<f64>; 2]) -> Vec<Vec<OfPoint>> {
        self.meetings.iter().map(|one| OfPoint::all(self.found(&one.touches), &one.place, rates)).collect()
    }

    /// Some of their points.
    fn found<'a>(&'a self, touches: &'a [Touch]) -> Found<'a> {
        Found { touches, nodes: &self.nodes, origins: &self.origins }
    }
}

impl<'a> Meetings<'a> {
    fn new(together: &'a Together, robots: &[Robot], multipliers: &[DVector<f64>]) -> Self {
        let rates = together.rates(together.robots.iter().map(|robot| &robots[*robot].step.rates));
        let multipliers = together.rates(together.robots.iter().map(|robot| &multipliers[*robot]));
        let points = together.points_back([&rates, &multipliers]);
        Self { together, rates: [rates, multipliers], points }
    }

    /// What points between robots come to in L, if `robots` are where they are.
    fn value(&self, robots: &[Robot], span: Span) -> Option<f64> {
        let boxes: Vec<_> = robots.iter().map(Robot::boxes).collect();
        let all = together::find(robots, &boxes, span);
        let now = all.iter().find(|one| one.robots == self.together.robots)?;
        let mut sum = 0.0;
        for (points, was) in self.points.iter().zip(&self.together.meetings).filter(|(points, _)| !points.is_empty()) {
            let is_same = |one: &&together::Meeting| one.links == was.links && one.image == was.image;
            let one = now.meetings.iter().find(is_same)?;
            for point in points {
                sum += point.value(now.found(&one.touches), &one.place, self.rates.each_ref(), span.dt)?;
            }
        }
        Some(sum)
    }
}

impl Robots {
    /// What no derivative could be found for.
    fn rough(&self, robot: usize) -> barchan_core::Error {
        let what = "gradients: its points of contact with what is rigid come and go too fast, or its motion has no solution backwards";
        Refusal::new(what, "lower time.step, or record a shorter time").at(&self.robots[robot].path())
    }

    /// The numbers of those of its robots that are no tools, each with its place among them.
    fn without_tools(&self) -> Vec<Option<usize>> {
        let mut count = 0..;
        self.robots.iter().map(|robot| if robot.is_tool { None } else { count.next() }).collect()
    }

    /// See [`Coupling::answer_back`](barchan_core::Coupling::answer_back).
    pub(super) fn answer_together_back(&self, group: &Range<usize>, systems: &[System]) -> Option<Vec<Twist>> {
        let (alone, own) = self.parted(self.robots_of(group));
        let mut all = vec![Twist::default(); systems.len()];
        for robot in alone {
            let bodies = self.bodies_of(robot, group.start);
            all[bodies.clone()].copy_from_slice(&self.robots[robot].answer_back(&systems[bodies])?);
        }
        for together in own {
            let bodies = || together.robots.iter().map(|&robot| self.bodies_of(robot, group.start));
            let systems: Vec<&[System]> = bodies().map(|own| &systems[own]).collect();
            let found = together.answer_back(&self.robots, &systems)?;
            bodies().zip(found).for_each(|(own, found)| all[own].copy_from_slice(&found));
        }
        Some(all)
    }

    /// See [`Coupling::advance_back`](barchan_core::Coupling::advance_back).
    pub(super) fn go_back_behind(&mut self, owed: &BodiesOwed<'_>) -> Result<Vec<Twist>> {
        self.behind.clear();
        for (robot, number) in self.without_tools().into_iter().enumerate() {
            let drives = self.robots[robot].model.drives.len();
            let joints = number.map_or_else(|| RobotCotangents::zero(drives), |number| owed.robots[number].clone());
            let bodies = &owed.bodies[self.bodies_of(robot, 0)];
            let behind = self.robots[robot].advance_back(bodies, joints).ok_or_else(|| self.rough(robot))?;
            self.behind.push(behind);
        }
        Ok(self.behind.iter().flat_map(|behind| behind.handed.iter().copied()).collect())
    }

    /// A step, as robots begin it.
    fn around<'a>(&self, time: f64, dt: f64, tools: &'a [&'a Obstacle]) -> Around<'a> {
        Around { span: self.span(time, dt), gravity: DVec3::from_array(self.scene.gravity_at(time)), tools }
    }

    /// The robots as the step began.
    fn begun(&self, around: &Around<'_>) -> Result<Vec<Robot>> {
        let begun = |(r, robot): (usize, &Robot)| robot.begun(around).ok_or_else(|| self.rough(r));
        self.robots.iter().enumerate().map(begun).collect()
    }

    /// λ of each robot, from what is owed to the twists of all bodies.
    fn multipliers(&self, found: &[BodyInStep]) -> Result<Vec<DVector<f64>>> {
        let twists = |robot: usize| found[self.bodies_of(robot, 0)].iter().map(|body| body.twist);
        let owed: Vec<_> = self.robots.iter().enumerate().map(|(r, robot)| robot.sums(twists(r))).collect();
        let mut all = owed.clone();
        let (alone, own) = self.parted(0..self.robots.len());
        for robot in alone {
            let matrix = self.robots[robot].slopes().transpose();
            all[robot] = solved(matrix, owed[robot].clone()).ok_or_else(|| self.rough(robot))?;
        }
        for together in own {
            let of_own = together.rates(together.robots.iter().map(|robot| &owed[*robot]));
            let matrix = together.slopes(&self.robots).transpose();
            let multipliers = solved(matrix, of_own).ok_or_else(|| self.rough(together.robots[0]))?;
            together.robots.iter().zip(together.parts(&multipliers)).for_each(|(&robot, part)| all[robot] = part);
        }
        Ok(all)
    }

    /// L's part of a robot.
    fn part<'a>(&'a self, number: usize, dt: f64, found: &[BodyInStep], multiplier: &DVector<f64>) -> Part<'a> {
        let (robot, behind, own) = (&self.robots[number], &self.behind[number], self.bodies_of(number, 0));
        let rates = &robot.step.rates;
        let both = [rates, multiplier];
        let of_body =
            |(body, handed): (&BodyInStep, &Twist)| BodyInStep { twist: body.twist.plus(-1.0, handed), ..*body };
        let impulse = |felt: &Wrench| {
            let mut impulse = Wrench::default();
            impulse.add_change(&Wrench::default(), felt, dt);
            impulse
        };
        let places = || robot.solids.iter().map(|&link| &robot.step.places[link]);
        let points = &robot.step.points;
        let of_link = |(touches, place): (&Vec<Touch>, &Place)| OfPoint::all(robot.found(touches), place, both);
        let of_pair = |pair: &Pair| (pair.bodies, OfPoint::all(robot.found(&pair.touches), &pair.place, both));
        let drives = 0..robot.model.drives.len();
        Part {
            behind,
            multiplier: multiplier.clone(),
            rates: rates.clone(),
            bodies: found[own.clone()].iter().zip(&behind.handed).map(of_body).collect(),
            impulses: self.wrenches[own].iter().map(impulse).collect(),
            poses: places().map(Place::pose).collect(),
            joints: drives.map(|d| robot.joint(d).slopes(rates[robot.base_rates() + d])).collect(),
            points: points.touches.iter().zip(places()).map(of_link).collect(),
            pairs: points.pairs.iter().map(of_pair).collect(),
        }
    }

    /// L's parts of all robots.
    fn parts(&self, dt: f64, found: &[BodyInStep], multipliers: &[DVector<f64>]) -> Vec<Part<'_>> {
        multipliers.iter().enumerate().map(|(r, multiplier)| self.part(r, dt, found, multiplier)).collect()
    }

    /// See [`Coupling::begin_back`](barchan_core::Coupling::begin_back).
    pub(super) fn go_back_to_start(
        &self,
        time: f64,
        dt: f64,
        found: &[BodyInStep],
        owed: &mut BodiesOwed<'_>,
        told: &mut BodiesTold<'_>,
    ) -> Result<DVec3> {
        let tools: Vec<&Obstacle> = self.tools.iter().collect();
        let around = self.around(time, dt, &tools);
        let multipliers = self.multipliers(found)?;
        let parts = self.parts(dt, found, &multipliers);
        let of_own = |together| Meetings::new(together, &self.robots, &multipliers);
        let meetings: Vec<Meetings<'_>> = self.together.iter().map(of_own).collect();
        let begun = self.begun(&around)?;
        let mut of_gravity = DVec3::ZERO;
        for (r, number) in self.without_tools().into_iter().enumerate() {
            let own = self.bodies_of(r, 0);
            let meeting = meetings.iter().find(|one| one.together.robots.contains(&r));
            let value = |begun: &mut [Robot], number: Number, by: f64| -> Option<f64> {
                let mut tried = begun[r].clone();
                tried.vary(number, by);
                tried.begin_again(&around)?;
                std::mem::swap(&mut tried, &mut begun[r]);
                let of_others = meeting.map_or(Some(0.0), |one| one.value(begun, around.span));
                std::mem::swap(&mut tried, &mut begun[r]);
                Some(of_others? + tried.value(&parts[r])?)
            };
            let robot = &self.robots[r];
            let slope = |begun: &mut Vec<Robot>, number: Number| {
                let found = slope(DIFFERENCE * robot.scale(number), |by| value(begun, number, by));
                Ok((number, found.ok_or_else(|| self.rough(r))?))
            };
            // Side by side: none depends on another.
            let numbers = robot.numbers().into_par_iter().map_init(|| begun.clone(), slope);
            let slopes = numbers.collect::<Result<Vec<(Number, f64)>>>()?;
            let mut base = BodyCotangents::default();
            let PoseCotangent { position, rotation } = &mut base.pose;
            let mut joints = RobotCotangents::zero(robot.model.drives.len());
            let mut of_mass = 0.0;
            for (number, found) in slopes {
                match number {
                    Number::Place(axis) => position[axis] = found,
                    Number::Turn(axis) => rotation[axis] = found,
                    Number::Position(drive) => joints.positions[drive] = found,
                    Number::Energy => joints.energy = found,
                    Number::Mass(body) => {
                        told.bodies[own.start + body].mass += found;
                        of_mass = found;
                    }
                    Number::Rate(rate) => match (rate.checked_sub(robot.base_rates()), robot.guided) {
                        (None, _) if rate < 3 => base.velocity[rate] = found,
                        (None, _) => base.angular_velocity[rate - 3] = found,
                        (Some(_), Some(guided)) => base.velocity = (found * guided.axis).to_array(),
                        (Some(drive), None) => joints.rates[drive] = found,
                    },
                }
            }
            for (body, owed) in owed.bodies[own.clone()].iter_mut().enumerate() {
                let start = if body == 0 { base } else { BodyCotangents::default() };
                *owed = BodyCotangents { impulse: owed.impulse, ..start };
            }
            let multiplier = &multipliers[r];
            match robot.guided {
                Some(guided) => {
                    let of_force = dt * multiplier[0];
                    let body = &mut told.bodies[own.start];
                    body.force += of_force * guided.servo.share_at(time);
                    if guided.servo.mass.is_none() {
                        body.force += of_mass * guided.mass / guided.servo.whole();
                    }
                }
                None => {
                    let weighed = |axis: usize| {
                        dynamics::gravity(&robot.model, &robot.step.places, DVec3::AXES[axis], multiplier.len())
                            .dot(multiplier)
                    };
                    of_gravity += dt * DVec3::from_array([0, 1, 2].map(weighed));
                }
            }
            if let Some(number) = number {
                owed.robots[number] = joints;
                robot.told_back(multiplier, &parts[r].joints, &mut told.robots[number]);
            }
        }
        for (r, friction) in self.friction_back(found, &parts, &meetings).into_iter().enumerate() {
            let known = matches!(self.contacts[r], Contact::Coulomb { .. });
            told.bodies[self.bodies_of(r, 0).start].friction += if known { friction } else { 0.0 };
        }
        Ok(of_gravity)
    }

    /// What is owed to each robot's coefficient of friction, on soft ground and where it is the smaller one of two that touch.
    fn friction_back(&self, found: &[BodyInStep], parts: &[Part<'_>], meetings: &[Meetings<'_>]) -> Vec<f64> {
        let of_robot = |(r, part): (usize, &Part<'_>)| {
            let points = part.points.iter().chain(part.pairs.iter().map(|(_, points)| points)).flatten();
            let rigid = points.map(|point| point.friction_of(self.robots[r].friction)).sum::<f64>();
            rigid + found[self.bodies_of(r, 0)].iter().map(|body| body.friction).sum::<f64>()
        };
        let mut all: Vec<f64> = parts.iter().enumerate().map(of_robot).collect();
        for Meetings { together, points, .. } in meetings {
            for (points, meeting) in points.iter().zip(&together.meetings) {
                let both = meeting.links.map(|(robot, _)| together.robots[robot]);
                // Of equal ones it is the first one's.
                let first_is_smoother = self.robots[both[0]].friction <= self.robots[both[1]].friction;
                let smoother = if first_is_smoother { both[0] } else { both[1] };
                all[smoother] += points.iter().map(|point| point.friction).sum::<f64>();
            }
        }
        all
    }

    /// See [`Coupling::see_back`](barchan_core::Coupling::see_back): what is owed to tools that are told how to move, by what robots feel of them.
    pub(super) fn go_back_to_tools(
        &self,
        time: f64,
        dt: f64,
        found: &[BodyInStep],
    ) -> Result<Vec<(String, BodyInStep)>> {
        let mut seen = Vec::new();
        let feels = |robot: &Robot| robot.step.points.touches.iter().any(|touches| !touches.is_empty());
        if self.tools.is_empty() || !self.robots.iter().any(feels) {
            return Ok(seen);
        }
        let tools: Vec<&Obstacle> = self.tools.iter().collect();
        let around = self.around(time, dt, &tools);
        let parts = self.parts(dt, found, &self.multipliers(found)?);
        let begun = self.begun(&around)?;
        for (t, tool) in self.tools.iter().enumerate() {
            let Some(scene::Tool { name, contact, .. }) = tool.tool() else { continue };
            let is_of_tool = |r: usize, point: &OfPoint| point.origin.obstacle == Some(self.robots[r].walls.len() + t);
            let of_robot = |r: usize| parts[r].points.iter().flatten().filter(move |point| is_of_tool(r, point));
            let touching: Vec<usize> = (0..parts.len()).filter(|&r| of_robot(r).next().is_some()).collect();
            let Some(&first) = touching.first() else { continue };
            let value = |number: usize, by: f64| -> Option<f64> {
                let mut tried = tool.clone();
                tried.vary(number, by);
                let tools = [&tools[..t], &[&tried], &tools[t + 1..]].concat();
                let of_robot = |&r: &usize| {
                    let mut robot = begun[r].clone();
                    let mut points = std::mem::take(&mut robot.step.points);
                    robot.find_points(&robot.boxes(), &tools, around.span, &mut points);
                    robot.step.points = points;
                    robot.value_of_points(&parts[r].points, [&parts[r].rates, &parts[r].multiplier])
                };
                touching.iter().map(of_robot).sum()
            };
            let mut numbers = [0.0; 12];
            for (number, found) in numbers.iter_mut().enumerate() {
                *found = slope(DIFFERENCE, |by| value(number, by)).ok_or_else(|| self.rough(first))?;
            }
            let three = |from: usize| DVec3::from_slice(&numbers[from..from + 3]);
            let twist = Twist { linear: three(6), angular: three(9) };
            // Of equal ones it is the robot's.
            let smoother = touching.iter().filter(|&&r| tool.friction() < self.robots[r].friction);
            let friction = smoother.flat_map(|&r| of_robot(r)).map(|point| point.friction_of(tool.friction()));
            let friction = if matches!(contact, Contact::Coulomb { .. }) { friction.sum() } else { 0.0 };
            seen.push((name.clone(), BodyInStep { position: three(0), rotation: three(3), twist, friction }));
        }
        Ok(seen)
    }
}
