//! Robots: links in a tree of joints, solved together with the ground inside every step.
//!
//! A robot's state is where its base is, its joints' positions, and their rates. A step of a robot:
//! 1. [`dynamics`]: where its links are, its mass matrix M, and what its motion asks of it;
//! 2. contact points with what is rigid ([`touching`]);
//! 3. its rates without soft ground: M (v − v₀) = dt (gravity − bias) + joints(v) + Σ Jᵀ contact(v), with motors, stops and dry friction of [`joints`] taken at the rates
//!    that are solved for; robots that touch one another are one system ([`together`]);
//! 4. where soft ground touches it, the contact solution asks for the change of twists that balances (`Robot::answer`): the same system and the ground's
//!    6 × 6 matrix of each link;
//! 5. positions move on with the rates, which are corrected so that momentum changes by impulses alone, and energy by their work.

mod act;
mod adjoint;
mod balance;
pub mod coupling;
mod device;
pub mod dynamics;
pub mod images;
pub mod joints;
mod loose;
pub mod model;
pub mod motion;
pub mod reach;
mod sense;
mod solve;
mod table;
pub mod together;
pub mod touching;
pub mod urdf;
pub mod visual;

pub use coupling::Robots;
pub use model::RobotModel;

use crate::motion::Pose;
use crate::rigid::body::Guided;
use balance::Correction;
use barchan_core::Aabb;
use barchan_core::contact::{System, Twist};
use dynamics::Place;
use glam::{DMat3, DVec3};
use joints::{Gains, Impulse, Joint, Order};
use motion::JointPath;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Vector6};
use sense::Sensed;
use serde::{Deserialize, Serialize};
use solve::{Balance, Whole, add_system, energy};
use std::sync::Arc;
use touching::{Body, HEAVY, Obstacle, Pair, Points, Seen, Span};

/// The most that a step's correction may raise the energy of joints by: what a motion does that is too fast for its step to follow.
const MOST_RAISED: f64 = 4.0;

/// How far ahead contact points are looked for, besides how far links come in a step [m].
const AHEAD: f64 = 1e-3;

/// Share of the inertia that a joint moves above which an armature is worth a word.
const ROTOR_SHARE: f64 = 0.1;

/// What changes from step to step.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct State {
    /// The base's frame.
    pub base: Pose,
    /// Of the drives [rad or m].
    pub positions: Vec<f64>,
    /// Rates, see [`dynamics`].
    pub rates: Vec<f64>,
    /// By how much twice the kinetic energy is above what it should be [J], where the robot has coiled up too far to turn so fast. Later steps make up for it.
    pub owed: f64,
    /// What each motor was last told, once somebody has.
    pub orders: Option<Vec<Order>>,
    /// How far along its path it is [s].
    pub clock: f64,
    /// What a device made of it in the last step, if one took it.
    pub held: Option<device::Held>,
    /// What sensors keep of the last step.
    pub sensed: Sensed,
}

/// A robot.
#[derive(Clone)]
pub struct Robot {
    pub(crate) name: String,
    pub(crate) model: Arc<RobotModel>,
    pub(crate) floating: bool,
    /// Links with mass or a shape: the robot's bodies, by their numbers, the base first.
    pub(crate) solids: Vec<usize>,
    /// And their names.
    names: Vec<String>,
    pub(crate) bodies: Vec<Option<Body>>,
    /// Greatest distance of a point of each body from its centre of mass [m].
    pub(crate) extents: Vec<f64>,
    pub(crate) gains: Vec<Gains>,
    pub(crate) path: JointPath,
    pub(crate) corrections: Vec<Correction>,
    pub(crate) friction: f64,
    pub(crate) restitution: f64,
    /// Is it a tool, see [`loose`]?
    pub(crate) is_tool: bool,
    /// What pushes it along a guide, if it is such a tool. It passes through walls and through what does not give way.
    pub(crate) guided: Option<Guided>,
    /// The world's walls, as it meets them.
    pub(crate) walls: Vec<Obstacle>,
    /// Bodies that may touch one another.
    pub(crate) pairs: Vec<[usize; 2]>,
    pub(crate) state: State,
    pub(crate) step: Step,
}

/// What a step leaves behind: the rates' equation takes the forces of motion as they were at its start, so rates alone would say a little else.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Kept {
    /// Linear and angular momentum, the latter about the point that comes third.
    momentum: [DVec3; 3],
    /// Twice the kinetic energy [J].
    twice_energy: f64,
    /// Twice the work of impulses in the step [J].
    twice_work: f64,
}

/// What belongs to the step under way.
#[derive(Clone)]
pub(crate) struct Step {
    dt: f64,
    /// Rates before it.
    before: DVector<f64>,
    orders: Vec<Order>,
    /// Of all links.
    pub places: Vec<Place>,
    mass: DMatrix<f64>,
    bias: DVector<f64>,
    /// What no iteration changes: M v₀ + dt (gravity − bias).
    driven: DVector<f64>,
    points: Points,
    /// Rates that balance without soft ground on the levels that are still to come.
    rates: DVector<f64>,
    /// Σ Jᵀ J over bodies, which takes twists of bodies to rates.
    squares: Cholesky<f64, Dyn>,
}

impl Robot {
    /// Number of rates of its base.
    fn base_rates(&self) -> usize {
        if self.floating { 6 } else { 0 }
    }

    /// Places, mass matrix and what follows from them, for the state as it is.
    pub(crate) fn at_rest(
        model: &RobotModel,
        floating: bool,
        solids: &[usize],
        state: &State,
        orders: Vec<Order>,
    ) -> Option<Step> {
        let places = dynamics::places(model, floating, &state.base, &state.positions);
        let mass = dynamics::mass_matrix(model, floating, &places);
        let n = mass.nrows();
        let mut squares = DMatrix::zeros(n, n);
        let one: [[f64; 6]; 6] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
        solids.iter().for_each(|&link| places[link].add_matrix(&one, &mut squares));
        let zeros = DVector::zeros(n);
        Some(Step {
            dt: 0.0,
            before: zeros.clone(),
            orders,
            places,
            mass,
            bias: zeros.clone(),
            driven: zeros,
            points: Points::default(),
            rates: DVector::from_column_slice(&state.rates),
            squares: Cholesky::new(squares)?,
        })
    }

    /// The twists of its bodies at some rates.
    pub(crate) fn twists(&self, rates: &DVector<f64>) -> Vec<Twist> {
        self.solids.iter().map(|&link| self.step.places[link].twist(rates)).collect()
    }

    /// The twist of a body as it is now.
    pub(crate) fn twist(&self, body: usize) -> Twist {
        self.step.places[self.solids[body]].twist(&self.step.rates)
    }

    /// Greatest speed of a point of a body's surface, at most [m/s].
    pub(crate) fn surface_speed(&self, body: usize) -> f64 {
        let twist = self.twist(body);
        twist.linear.length() + twist.angular.length() * self.extents[body]
    }

    /// The rates that give the bodies these twists, as near as they can.
    pub(crate) fn rates(&self, twists: &[Twist]) -> DVector<f64> {
        self.step.squares.solve(&self.sums(twists.iter().copied()))
    }

    /// Σ Jᵀ of what its bodies have each.
    pub(crate) fn sums(&self, of_bodies: impl Iterator<Item = Twist>) -> DVector<f64> {
        let mut sums = DVector::zeros(self.state.rates.len());
        for (&link, Twist { linear, angular }) in self.solids.iter().zip(of_bodies) {
            self.step.places[link].add_wrench(linear, angular, &mut sums);
        }
        sums
    }

    /// Adds what soft ground gives its bodies, and by how much that falls.
    pub(crate) fn add_systems(&self, systems: &[System], residual: &mut DVector<f64>, matrix: &mut DMatrix<f64>) {
        for (&link, system) in self.solids.iter().zip(systems) {
            add_system(&self.step.places[link], system, residual, matrix);
        }
    }

    fn joint(&self, drive: usize) -> Joint<'_> {
        let rate = self.base_rates() + drive;
        Joint {
            drive: &self.model.drives[drive],
            gains: self.gains[drive],
            order: self.step.orders[drive],
            position: self.state.positions[drive],
            inertia: self.step.mass[(rate, rate)],
            dt: self.step.dt,
        }
    }

    /// The torque of each drive's motor at the end of the last step [N m or N]: a state that is restored has the same.
    pub(crate) fn motor_torques(&self) -> Vec<f64> {
        let mut orders = self.state.orders.clone().unwrap_or_else(|| self.path.orders(self.state.clock, 0.0));
        self.balance_orders(self.leaning(), &mut orders);
        let rates = self.step.rates.iter().skip(self.base_rates());
        let torque = |(drive, (order, rate)): (usize, (Order, &f64))| {
            // A step ends where its rates lead: what the motor gives in it is what it gives there.
            Joint { order, dt: 0.0, ..self.joint(drive) }.motor(*rate).value
        };
        orders.into_iter().zip(rates).enumerate().map(torque).collect()
    }

    /// Says which joints that nothing drives have an armature that matters.
    pub(crate) fn heavy_rotors(&self) -> Option<String> {
        let is_slowed = |(d, drive): &(usize, &model::Drive)| {
            let rate = self.base_rates() + d;
            let is_idle = self.gains[*d].kp == 0.0 && self.gains[*d].kd == 0.0;
            is_idle && drive.armature > ROTOR_SHARE * (self.step.mass[(rate, rate)] - drive.armature)
        };
        let slowed = self.model.drives.iter().enumerate().filter(is_slowed);
        let names: Vec<String> = slowed.map(|(_, drive)| format!("'{}'", drive.name)).collect();
        (!names.is_empty()).then(|| {
            format!(
                "robot '{}': the armature of joints without a motor that holds them, {}, is more than a tenth of the inertia that they move, and slows them down; where nothing drives them, give them a [[robot.motor]] with armature = 0",
                self.name,
                names.join(", ")
            )
        })
    }

    /// Moves on to a step: the motors' orders, where links are, and what touches what is rigid, such as `tools`.
    ///
    /// # Errors
    /// If the state cannot be gone on from.
    pub(crate) fn begin(&mut self, span: Span, gravity: DVec3, boxes: &[Aabb], tools: &[&Obstacle]) -> Result<(), ()> {
        let Span { time, dt, .. } = span;
        self.take_over().ok_or(())?;
        if let Some(guided) = &self.guided {
            self.state.orders = Some(vec![guided.order(time, gravity)]);
        }
        self.state.clock = self.path.wrapped(time + dt);
        let mut orders = self.state.orders.clone().unwrap_or_else(|| self.path.orders(time, dt));
        self.balance_orders(self.leaning(), &mut orders);
        let before = DVector::from_column_slice(&self.state.rates);
        let places = std::mem::take(&mut self.step.places);
        let bias = dynamics::bias(&self.model, self.floating, &places, &before);
        let weight = dynamics::gravity(&self.model, &places, gravity, before.len());
        let driven = &self.step.mass * &before + dt * (weight - &bias);
        self.step = Step {
            dt,
            orders,
            bias,
            driven,
            places,
            rates: before.clone(),
            before,
            ..std::mem::replace(&mut self.step, Step::empty())
        };
        let mut points = std::mem::take(&mut self.step.points);
        self.find_points(boxes, tools, span, &mut points);
        self.step.points = points;
        Ok(())
    }

    /// Boxes around its bodies.
    pub(crate) fn boxes(&self) -> Vec<Aabb> {
        (0..self.solids.len()).map(|body| self.bounds(body, 0.0)).collect()
    }

    /// Finds where its links, in these boxes, touch what is rigid in a step, and one another.
    pub(crate) fn find_points(&self, boxes: &[Aabb], tools: &[&Obstacle], span: Span, points: &mut Points) {
        let mass = HEAVY * self.model.mass();
        points.find(&self.seen(boxes, span.dt), self.obstacles(tools), &self.pairs, mass, span);
    }

    /// What is rigid and does not answer, as far as it meets it: walls, and of `tools` all or none.
    pub(crate) fn obstacles<'a>(&'a self, tools: &'a [&'a Obstacle]) -> impl Iterator<Item = &'a Obstacle> {
        self.walls.iter().chain(if self.guided.is_some() { &[] } else { tools }.iter().copied())
    }

    /// Do it and another one touch? Tools in guides pass through one another.
    pub(crate) fn gives_way_to(&self, other: &Self) -> bool {
        self.guided.is_none() || other.guided.is_none()
    }

    /// What its bodies in these boxes are for contact points, in a step of `dt` [s] that is not solved.
    pub(crate) fn seen<'a>(&'a self, boxes: &[Aabb], dt: f64) -> Vec<Seen<'a>> {
        let of_body = |body: usize| Seen {
            body: self.bodies[body].as_ref(),
            place: &self.step.places[self.solids[body]],
            bounds: boxes[body],
            friction: self.friction,
            ahead: AHEAD + 2.0 * self.surface_speed(body) * dt,
            twist: self.twist(body),
            restitution: self.restitution,
        };
        (0..self.solids.len()).map(of_body).collect()
    }

    /// Takes up the rates that balance without soft ground.
    ///
    /// # Errors
    /// If they are no longer finite.
    pub(crate) fn go(&mut self, rates: DVector<f64>) -> Result<(), ()> {
        self.step.rates = rates;
        if self.step.rates.iter().all(|rate| rate.is_finite()) { Ok(()) } else { Err(()) }
    }

    /// What is out of balance at the rates of some twists, with what soft ground gives there.
    fn balance_with(&self, at: &[Twist], systems: &[System], tangent: bool) -> Balance {
        let rates = self.rates(at);
        let Balance { mut residual, mut matrix } = self.own_impulses(&rates, 1.0, tangent);
        residual -= self.own_impulses(&self.step.rates, 1.0, false).residual;
        residual += &self.step.mass * (&self.step.rates - rates);
        matrix += &self.step.mass;
        self.add_systems(systems, &mut residual, &mut matrix);
        Balance { residual, matrix }
    }

    /// By how much bodies' twists have to change for balance, see [`barchan_core::Coupling::answer`].
    pub(crate) fn answer(&self, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        let symmetric = systems.iter().all(|system| system.symmetric);
        let Balance { residual, matrix } = self.balance_with(at, systems, !symmetric);
        if residual.is_empty() {
            return Some(self.twists(&residual));
        }
        let step = if symmetric { matrix.cholesky()?.solve(&residual) } else { matrix.lu().solve(&residual)? };
        Some(self.twists(&step))
    }

    /// What is out of balance along some change of twists, see [`barchan_core::Coupling::balance`] [J].
    pub(crate) fn balance(&self, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        self.balance_with(at, systems, false).residual.dot(&self.rates(along))
    }

    /// Twice the kinetic energy at some twists [J].
    pub(crate) fn twice_energy(&self, twists: &[Twist]) -> f64 {
        energy(&self.step.mass, &self.rates(twists))
    }

    /// Takes up the twists that were found together with soft ground.
    pub(crate) fn feel(&mut self, twists: &[Twist]) {
        self.step.rates = self.rates(twists);
        self.state.rates.copy_from_slice(self.step.rates.as_slice());
    }

    /// Momentum about a point, and energy, as rates say.
    fn now(&self, about: DVec3) -> Kept {
        let Step { ref places, ref rates, .. } = self.step;
        let [linear, angular] = dynamics::momentum(&self.model, places, rates, about);
        let twice_energy = dynamics::twice_energy(&self.model, places, rates) - self.state.owed;
        Kept { momentum: [linear, angular, about], twice_energy, twice_work: 0.0 }
    }

    /// What the step under way leaves behind: impulses change momentum, and energy by their work. The forces of motion that the equation has are none of them.
    fn kept(&self) -> Kept {
        let Step { dt, ref rates, ref before, ref bias, ref places, ref mass, .. } = self.step;
        let mut kept = self.now(self.state.base.position);
        if self.floating {
            let [linear, angular, about] = &mut kept.momentum;
            let force = DVec3::new(bias[0], bias[1], bias[2]);
            let torque = DVec3::new(bias[3], bias[4], bias[5]) + (places[0].centre - *about).cross(force);
            *linear += dt * force;
            *angular += dt * torque;
        }
        kept.twice_energy += dt * (before + rates).dot(bias);
        kept.twice_work = kept.twice_energy + self.state.owed - energy(mass, before);
        kept
    }

    /// Moves positions on by the step under way, and corrects the rates there.
    pub(crate) fn advance(&mut self) -> Option<()> {
        self.sense_rigid();
        let kept = self.kept();
        let Step { dt, ref rates, ref places, .. } = self.step;
        if self.floating {
            let base = &places[0];
            let twist = base.twist(rates);
            // The centre of mass moves straight, the frame around it.
            let centre = base.centre + dt * twist.linear;
            let turned = self.state.base.advanced(&twist, dt).rotation;
            let arm = turned * self.model.links[0].centre;
            self.state.base = Pose { position: centre - arm, rotation: turned };
        }
        let first = self.base_rates();
        for (drive, position) in self.state.positions.iter_mut().enumerate() {
            *position += dt * rates[first + drive];
        }
        self.state.rates.copy_from_slice(rates.as_slice());
        let orders = std::mem::take(&mut self.step.orders);
        let points = std::mem::take(&mut self.step.points);
        let next = Self::at_rest(&self.model, self.floating, &self.solids, &self.state, orders)?;
        self.step = Step { dt, points, ..next };
        self.correct(&kept)?;
        self.state.rates.copy_from_slice(self.step.rates.as_slice());
        self.sense_end(dt);
        self.state.rates.iter().all(|rate| rate.is_finite()).then_some(())
    }

    /// Corrects rates by what a step has left behind, where links are now: those of the base make up for momentum, and the motion of joints, less
    /// what the robot moves as a whole, for energy.
    fn correct(&mut self, kept: &Kept) -> Option<()> {
        let Kept { momentum: [linear, angular, about], twice_energy, twice_work } = *kept;
        let places = &self.step.places;
        let mut rates = self.step.rates.clone();
        // As if no joint moved.
        let mut whole = DVector::zeros(rates.len());
        if self.floating {
            let of_all = dynamics::inertia_of_all(&self.model, places).cholesky()?;
            let arm = places[0].centre - about;
            let solved = |force: DVec3, torque: DVec3| {
                let torque = torque - arm.cross(force);
                of_all.solve(&Vector6::new(force.x, force.y, force.z, torque.x, torque.y, torque.z))
            };
            let [now, turning] = dynamics::momentum(&self.model, places, &rates, about);
            let change = solved(linear - now, angular - turning);
            whole.rows_mut(0, 6).copy_from(&solved(linear, angular));
            let mut of_base = rates.rows_mut(0, 6);
            of_base += change;
        }
        let beside = &rates - &whole;
        let twice_energy_of = |rates: &DVector<f64>| dynamics::twice_energy(&self.model, places, rates);
        self.state.owed = 0.0;
        let own = if self.model.drives.is_empty() { 0.0 } else { twice_energy_of(&beside) };
        if own > 0.0 {
            let all = twice_energy_of(&rates);
            // When in the step impulses did their work is not known. Where that is much for the energy that is left, as in a blow, it matters.
            let missing = (twice_energy - all) / (1.0 + (twice_work / all).powi(2));
            let share = (1.0 + missing / own).clamp(0.0, MOST_RAISED);
            rates = whole + share.sqrt() * beside;
            self.state.owed = ((share - 1.0) * own - missing).max(0.0);
        }
        self.step.rates = rates;
        Some(())
    }

    /// Goes on from what a device made of it, if one did.
    fn take_over(&mut self) -> Option<()> {
        if self.state.held.is_none() {
            return Some(());
        }
        let Step { dt, ref mut orders, .. } = self.step;
        let orders = std::mem::take(orders);
        let step = Self::at_rest(&self.model, self.floating, &self.solids, &self.state, orders)?;
        self.step = Step { dt, ..step };
        self.correct_held()?;
        self.state.held = None;
        self.state.rates.copy_from_slice(self.step.rates.as_slice());
        Some(())
    }

    /// Where a body's centre of mass is, and its axes.
    pub(crate) fn pose(&self, body: usize) -> Pose {
        self.step.places[self.solids[body]].pose()
    }

    /// Inertia of a body about its centre of mass, along the world's axes [kg m²].
    pub(crate) fn inertia(&self, body: usize) -> DMat3 {
        self.step.places[self.solids[body]].inertia
    }
}

impl Whole for Robot {
    fn mass_matrix(&self) -> &DMatrix<f64> {
        &self.step.mass
    }

    fn driven(&self) -> &DVector<f64> {
        &self.step.driven
    }

    fn before(&self) -> &DVector<f64> {
        &self.step.before
    }

    fn mass(&self) -> f64 {
        self.model.mass()
    }

    fn points(&self) -> f64 {
        self.step.points.nodes.mass.iter().sum()
    }

    fn own_impulses(&self, rates: &DVector<f64>, weight: f64, tangent: bool) -> Balance {
        let n = rates.len();
        let (mut residual, mut matrix) = (DVector::zeros(n), DMatrix::zeros(n, n));
        for drive in 0..self.model.drives.len() {
            let rate = self.base_rates() + drive;
            let Impulse { value, slope } = self.joint(drive).impulse(rates[rate]);
            residual[rate] += value;
            matrix[(rate, rate)] += slope;
        }
        let points = &self.step.points;
        let with_obstacles = self.solids.iter().map(|&link| &self.step.places[link]).zip(&points.touches);
        let among_links = points.pairs.iter().map(|Pair { place, touches, .. }| (place, touches));
        for (place, touches) in with_obstacles.chain(among_links).filter(|(_, touches)| !touches.is_empty()) {
            let system = System::of(touches, &points.nodes, &place.twist(rates), weight, tangent);
            add_system(place, &system, &mut residual, &mut matrix);
        }
        Balance { residual, matrix }
    }
}

impl Step {
    /// In place of one that is taken apart.
    fn empty() -> Self {
        let none = DMatrix::identity(1, 1);
        Self {
            dt: 0.0,
            before: DVector::zeros(0),
            orders: Vec::new(),
            places: Vec::new(),
            mass: none.clone(),
            bias: DVector::zeros(0),
            driven: DVector::zeros(0),
            points: Points::default(),
            rates: DVector::zeros(0),
            squares: Cholesky::new(none).expect("a matrix that is one has a root"),
        }
    }
}
