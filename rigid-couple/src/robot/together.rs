//! Robots that touch one another in a step, free tools among them: one system.
//!
//! Their rates stand behind one another. The mass matrix and what joints and obstacles give are blocks on the diagonal; a contact point between two robots moves with
//! the one, pushes both, and so couples their blocks. A light body under a heavy robot then takes what it has to take, however often the two are
//! solved: taken in turns, the body would take too little of the robot's impulse, and the robot would sink into it.

use super::Robot;
use super::dynamics::Place;
use super::solve::{Balance, Balanced, Whole, add_system, mended};
use super::touching::{HEAVY, Origin, Seen, Span, among, forces};
use barchan_core::contact::{System, Touch, Twist};
use barchan_core::{Aabb, NodeBatch};
use glam::DVec3;
use nalgebra::{DMatrix, DVector};
use std::ops::Range;

/// Robots that touch, and where.
#[derive(Debug, Default)]
pub struct Together {
    /// Their numbers, in rising order.
    pub(super) robots: Vec<usize>,
    /// Where the rates of each begin, and at the end their number.
    firsts: Vec<usize>,
    pub(super) nodes: NodeBatch,
    pub(super) origins: Vec<Origin>,
    pub(super) meetings: Vec<Meeting>,
}

/// Two links of different robots that touch.
#[derive(Debug)]
pub(super) struct Meeting {
    /// Their robots, as they are counted here, and their bodies there.
    pub links: [(usize, usize); 2],
    /// How far the image of the second one that the first one touches is from it [m].
    pub image: DVec3,
    /// The first one's place, as it moves against the second; its rates are those of all robots.
    pub place: Place,
    /// What the first one touches, in a frame that moves with the second.
    pub touches: Vec<Touch>,
}

/// A link of one robot that touches one of another.
struct Found {
    links: [(usize, usize); 2],
    image: DVec3,
    touches: Vec<Touch>,
}

/// A force on a body: where [m], and how large [N].
pub(super) type Felt = (usize, DVec3, DVec3);

/// Robots that touch in a step that has begun; `boxes` are those around each one's bodies.
pub(super) fn find(robots: &[Robot], boxes: &[Vec<Aabb>], span: Span) -> Vec<Together> {
    if robots.len() < 2 {
        return Vec::new();
    }
    let seen: Vec<Vec<Seen<'_>>> = robots.iter().zip(boxes).map(|(robot, boxes)| robot.seen(boxes, span.dt)).collect();
    let around = |links: &Vec<Seen<'_>>| {
        let there = links.iter().filter(|link| link.body.is_some());
        there.map(|link| link.bounds.grown(link.ahead)).reduce(|a, b| a.union(&b)).unwrap_or(Aabb::NOTHING)
    };
    let whole: Vec<Aabb> = seen.iter().map(around).collect();
    let (mut nodes, mut origins, mut found) = (NodeBatch::default(), Vec::new(), Vec::new());
    for second in 0..robots.len() {
        let may_touch = |first: usize| {
            let mut images = span.images.meeting(&whole[first], &whole[second]);
            robots[first].gives_way_to(&robots[second]) && images.next().is_some()
        };
        for first in (0..second).filter(|first| may_touch(*first)) {
            let mass = HEAVY * robots[first].model.mass().min(robots[second].model.mass());
            for (a, link) in seen[first].iter().enumerate() {
                for (b, other) in seen[second].iter().enumerate() {
                    // What no rate moves has nothing to answer with.
                    if link.place.columns.is_empty() && other.place.columns.is_empty() {
                        continue;
                    }
                    for image in span.images.beside(&link.bounds, &other.bounds) {
                        let touches = among([link, other], image, (&mut nodes, &mut origins), mass, span);
                        if !touches.is_empty() {
                            found.push(Found { links: [(first, a), (second, b)], image, touches });
                        }
                    }
                }
            }
        }
    }
    let rates: Vec<usize> = robots.iter().map(|robot| robot.state.rates.len()).collect();
    let mut all = joined(&found, &rates);
    for Found { links, image, mut touches } in found {
        let Some(own) = all.iter_mut().find(|one| one.robots.contains(&links[0].0)) else { continue };
        for touch in &mut touches {
            let from = std::mem::replace(&mut touch.node, own.nodes.mass.len());
            own.nodes.position.push(nodes.position[from]);
            own.nodes.mass.push(nodes.mass[from]);
            own.nodes.velocity.push(nodes.velocity[from]);
            own.origins.push(origins[from]);
        }
        let links = links.map(|(robot, body)| (own.robots.partition_point(|one| *one < robot), body));
        let place = own.place_of(robots, links, image);
        own.meetings.push(Meeting { links, image, place, touches });
    }
    all
}

/// Which robots are joined by what was found, each with so many rates.
fn joined(found: &[Found], rates: &[usize]) -> Vec<Together> {
    let mut heads: Vec<usize> = (0..rates.len()).collect();
    for Found { links: [(first, _), (second, _)], .. } in found {
        let (keep, give) = (heads[*first].min(heads[*second]), heads[*first].max(heads[*second]));
        heads.iter_mut().filter(|head| **head == give).for_each(|head| *head = keep);
    }
    let of_head = |head: usize| -> Option<Together> {
        let robots: Vec<usize> = (0..rates.len()).filter(|robot| heads[*robot] == head).collect();
        let mut firsts = vec![0];
        robots.iter().for_each(|robot| firsts.push(firsts[firsts.len() - 1] + rates[*robot]));
        (robots.len() > 1).then(|| Together { robots, firsts, ..Together::default() })
    };
    (0..rates.len()).filter_map(of_head).collect()
}

impl Together {
    /// Its first and last robot, and all between.
    pub(super) fn span(&self) -> Range<usize> {
        self.robots[0]..self.robots[self.robots.len() - 1] + 1
    }

    fn place_of(&self, robots: &[Robot], links: [(usize, usize); 2], image: DVec3) -> Place {
        let [first, second] = links.map(|(robot, body)| {
            let own = &robots[self.robots[robot]];
            own.step.places[own.solids[body]].shifted(self.firsts[robot])
        });
        first.against(&second.moved(image))
    }

    pub(super) fn own<'a>(&'a self, robots: &'a [Robot]) -> impl Iterator<Item = &'a Robot> {
        self.robots.iter().map(|robot| &robots[*robot])
    }

    /// The rates of each robot, of those of all.
    pub(super) fn parts<'a>(&'a self, rates: &'a DVector<f64>) -> impl Iterator<Item = DVector<f64>> + 'a {
        self.firsts.windows(2).map(|ends| rates.rows(ends[0], ends[1] - ends[0]).into_owned())
    }

    pub(super) fn rates<'a>(&self, parts: impl Iterator<Item = &'a DVector<f64>>) -> DVector<f64> {
        let all: Vec<f64> = parts.flat_map(|part| part.iter().copied()).collect();
        DVector::from_vec(all)
    }

    /// A matrix of the robots' own ones.
    fn blocks<'a>(&self, parts: impl Iterator<Item = &'a DMatrix<f64>>) -> DMatrix<f64> {
        let n = self.firsts[self.firsts.len() - 1];
        let mut all = DMatrix::zeros(n, n);
        for (first, part) in self.firsts.iter().zip(parts) {
            all.view_mut((*first, *first), part.shape()).copy_from(part);
        }
        all
    }

    /// What each robot's joints and rigid contacts of its own give at some rates, and by how much that falls.
    fn of_each(&self, robots: &[Robot], rates: &DVector<f64>, weight: f64, tangent: bool) -> Balance {
        let of_robot = |(robot, rates): (&Robot, DVector<f64>)| robot.own_impulses(&rates, weight, tangent);
        let own: Vec<Balance> = self.own(robots).zip(self.parts(rates)).map(of_robot).collect();
        let residual = self.rates(own.iter().map(|own| &own.residual));
        Balance { residual, matrix: self.blocks(own.iter().map(|own| &own.matrix)) }
    }

    /// Adds what robots give one another.
    fn add_meetings(&self, rates: &DVector<f64>, weight: f64, tangent: bool, sums: &mut Balance) {
        for Meeting { place, touches, .. } in &self.meetings {
            let system = System::of(touches, &self.nodes, &place.twist(rates), weight, tangent);
            add_system(place, &system, &mut sums.residual, &mut sums.matrix);
        }
    }

    /// Subtracts by how much that falls in a step of the secant's from `rates`: equal and opposite on both robots to the last bits, however heavy points are, which it is
    /// not where it is summed in a matrix.
    fn subtract_fall(&self, rates: &DVector<f64>, weight: f64, step: &DVector<f64>, sums: &mut DVector<f64>) {
        for Meeting { place, touches, .. } in &self.meetings {
            let System { matrix, .. } = System::of(touches, &self.nodes, &place.twist(rates), weight, false);
            let Twist { linear: v, angular: w } = place.twist(step);
            let by = [v.x, v.y, v.z, w.x, w.y, w.z];
            let [fx, fy, fz, tx, ty, tz] = matrix.map(|row| -(0..6).map(|j| row[j] * by[j]).sum::<f64>());
            place.add_wrench(DVec3::new(fx, fy, fz), DVec3::new(tx, ty, tz), sums);
        }
    }

    /// Rates of each robot that balance without soft ground, see [`Whole::balance_alone`].
    pub(super) fn balance_alone(&self, robots: &[Robot]) -> Option<Vec<Balanced>> {
        let begun = Begun {
            together: self,
            robots,
            mass: self.blocks(self.own(robots).map(|robot| &robot.step.mass)),
            driven: self.rates(self.own(robots).map(|robot| &robot.step.driven)),
            before: self.rates(self.own(robots).map(|robot| &robot.step.rates)),
        };
        let Balanced { rates, converged } = begun.balance_alone()?;
        Some(self.parts(&rates).map(|rates| Balanced { rates, converged }).collect())
    }

    /// By how much what is out of balance falls for each unit of the rates that robots have.
    pub(super) fn slopes(&self, robots: &[Robot]) -> DMatrix<f64> {
        let rates = self.rates(self.own(robots).map(|robot| &robot.step.rates));
        let mut own = self.of_each(robots, &rates, 1.0, true);
        self.add_meetings(&rates, 1.0, true, &mut own);
        own.matrix + self.blocks(self.own(robots).map(|robot| &robot.step.mass))
    }

    /// Adds what soft ground gives, robot by robot.
    pub(super) fn add_systems(
        &self,
        robots: &[Robot],
        systems: &[&[System]],
        residual: &mut DVector<f64>,
        matrix: &mut DMatrix<f64>,
    ) {
        for ((robot, systems), first) in self.own(robots).zip(systems).zip(&self.firsts) {
            for (&link, system) in robot.solids.iter().zip(*systems) {
                add_system(&robot.step.places[link].shifted(*first), system, residual, matrix);
            }
        }
    }

    /// What is out of balance at some twists, with what soft ground gives there.
    fn balance_with(&self, robots: &[Robot], met: &Met<'_>, tangent: bool) -> Tried {
        let own: Vec<DVector<f64>> = self.own(robots).zip(&met.at).map(|(robot, at)| robot.rates(at)).collect();
        let (rates, before) = (self.rates(own.iter()), self.rates(self.own(robots).map(|robot| &robot.step.rates)));
        let impulses = |rates: &DVector<f64>| {
            let own = self.of_each(robots, rates, 1.0, tangent);
            let n = rates.len();
            let mut given = Balance { residual: DVector::zeros(n), matrix: DMatrix::zeros(n, n) };
            // As of one robot.
            self.add_meetings(rates, 1.0, tangent, &mut given);
            (own, given)
        };
        let (own, given) = impulses(&rates);
        let (own_before, given_before) = impulses(&before);
        let mass = self.blocks(self.own(robots).map(|robot| &robot.step.mass));
        let mut residual = own.residual - own_before.residual + given.residual - given_before.residual;
        residual += &mass * (before - &rates);
        let mut rest = own.matrix + mass;
        self.add_systems(robots, &met.systems, &mut residual, &mut rest);
        Tried { rates, residual, rest, given: given.matrix }
    }

    /// By how much twists have to change for balance, robot by robot; see [`barchan_core::Coupling::answer`].
    pub(super) fn answer(&self, robots: &[Robot], met: &Met<'_>) -> Option<Vec<Vec<Twist>>> {
        let symmetric = met.systems.iter().copied().flatten().all(|system| system.symmetric);
        let Tried { rates, residual, rest, given } = self.balance_with(robots, met, !symmetric);
        let matrix = &rest + given;
        let step = if symmetric {
            let factor = matrix.cholesky()?;
            mended(factor.solve(&residual), &factor, |step| {
                let mut left = &residual - rest * step;
                self.subtract_fall(&rates, 1.0, step, &mut left);
                Some(left)
            })
        } else {
            matrix.lu().solve(&residual)?
        };
        Some(self.own(robots).zip(self.parts(&step)).map(|(robot, step)| robot.twists(&step)).collect())
    }

    /// What is out of balance along some change of twists, see [`barchan_core::Coupling::balance`] [J].
    pub(super) fn balance(&self, robots: &[Robot], met: &Met<'_>, along: &[&[Twist]]) -> f64 {
        let Tried { residual, .. } = self.balance_with(robots, met, true);
        let along: Vec<DVector<f64>> = self.own(robots).zip(along).map(|(robot, along)| robot.rates(along)).collect();
        residual.dot(&self.rates(along.iter()))
    }

    /// Goes through all that links of theirs touch of one another's: nodes and touch, and robot and body at both ends, with how far the image of the second that is met is from it [m].
    pub(super) fn each_touch<'a>(
        &'a self,
        see: &mut impl FnMut(&'a NodeBatch, &'a Touch, (usize, usize), Option<((usize, usize), DVec3)>),
    ) {
        for Meeting { links, image, touches, .. } in &self.meetings {
            let [first, second] = links.map(|(robot, body)| (self.robots[robot], body));
            touches.iter().for_each(|touch| see(&self.nodes, touch, first, Some((second, *image))));
        }
    }

    /// What robots press on one another with in the step under way, at some rates of each: for each of them, as they are counted here.
    pub(super) fn felt(&self, robots: &[Robot], rates: impl Fn(usize) -> DVector<f64>) -> Vec<Vec<Felt>> {
        let mut felt = vec![Vec::new(); self.robots.len()];
        let each: Vec<DVector<f64>> = self.robots.iter().map(|robot| rates(*robot)).collect();
        let rates = self.rates(each.iter());
        let dt = robots[self.robots[0]].step.dt;
        for Meeting { links: [(first, a), (second, b)], image, place, touches } in &self.meetings {
            for (at, force) in forces(&self.nodes, touches, &place.twist(&rates), dt) {
                felt[*first].push((*a, at, force));
                felt[*second].push((*b, at - *image, -force));
            }
        }
        felt
    }

    /// Goes on to where robots are now: coarser levels of the ground come behind their motion where levels take steps of their own.
    pub(super) fn follow(&mut self, robots: &[Robot]) {
        let places: Vec<Place> = self.meetings.iter().map(|one| self.place_of(robots, one.links, one.image)).collect();
        for (Meeting { place, touches, .. }, now) in self.meetings.iter_mut().zip(places) {
            *place = now;
            for touch in touches {
                touch.arm = DVec3::from_array(self.nodes.position[touch.node]) - place.centre;
            }
        }
    }
}

/// Twists that are tried, and contact there, robot by robot.
pub(super) struct Met<'a> {
    pub at: Vec<&'a [Twist]>,
    pub systems: Vec<&'a [System]>,
}

/// What is out of balance at some rates, and by how much it falls with them: by what robots give one another, and by the rest.
struct Tried {
    rates: DVector<f64>,
    residual: DVector<f64>,
    rest: DMatrix<f64>,
    given: DMatrix<f64>,
}

/// Robots that touch, in a step that has begun.
struct Begun<'a> {
    together: &'a Together,
    robots: &'a [Robot],
    mass: DMatrix<f64>,
    driven: DVector<f64>,
    before: DVector<f64>,
}

impl Whole for Begun<'_> {
    fn mass_matrix(&self) -> &DMatrix<f64> {
        &self.mass
    }

    fn driven(&self) -> &DVector<f64> {
        &self.driven
    }

    fn before(&self) -> &DVector<f64> {
        &self.before
    }

    fn mass(&self) -> f64 {
        self.together.own(self.robots).map(|robot| robot.model.mass()).sum()
    }

    fn points(&self) -> f64 {
        let own: f64 = self.together.own(self.robots).map(Whole::points).sum();
        own + self.together.nodes.mass.iter().sum::<f64>()
    }

    fn own_impulses(&self, rates: &DVector<f64>, weight: f64, tangent: bool) -> Balance {
        let mut all = self.together.of_each(self.robots, rates, weight, tangent);
        self.together.add_meetings(rates, weight, tangent, &mut all);
        all
    }

    fn left(&self, rates: &DVector<f64>, weight: f64, step: &DVector<f64>) -> Option<DVector<f64>> {
        let own = self.together.of_each(self.robots, rates, weight, false);
        let mut given = Balance { residual: DVector::zeros(rates.len()), ..own };
        let mut left = &self.driven - &self.mass * (rates + step) + own.residual - &given.matrix * step;
        self.together.add_meetings(rates, weight, false, &mut given);
        left += given.residual;
        self.together.subtract_fall(rates, weight, step, &mut left);
        Some(left)
    }
}
