//! Robots as a device moves them: what `robot.wgsl` reads of them, and their states there and back.

use super::balance::Correction;
use super::model::{Freedom, RobotModel};
use super::motion::JointPath;
use super::touching::{Points, Span};
use super::{AHEAD, Robot, dynamics};
use crate::grip::REACH;
use crate::motion::Pose;
use crate::sdf::Sdf;
use crate::tables::{Listed, Row, Tables, row, rows};
use barchan_core::contact::{Grip, Touch};
use barchan_core::coupling::{Aabb, DeviceAnswer, DeviceBody, DeviceGroup, DeviceLaw, GroupState, Placed};
use barchan_core::scene::Contact;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Words of a state before those of drives, see `robot.wgsl`.
const WORDS: usize = 5;
/// Parts of a second, a radian or a metre in a word.
const PARTS: f64 = 4_294_967_296.0;
/// A device moves links as long as their surfaces move by at most this much in a step [cells].
pub(crate) const MOST_MOVE: f64 = 0.5;
/// Words of a point at which links touch what is rigid, and how many points a device is told of at most.
const POINT: usize = 3;
const MOST_POINTS: usize = 24;
/// In place of infinity.
const FAR: f64 = 1e30;

/// What a device made of a robot last, beside its [`State`](super::State).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Held {
    /// Position and rotation of its bodies, as the device has them.
    bodies: Vec<([f64; 3], [f64; 4])>,
    /// Its momentum, and about the base's centre of mass; on the host rates say it.
    momentum: [DVec3; 2],
}

impl Held {
    /// Linear and angular momentum, the latter about the point that comes third.
    pub(crate) fn momentum(&self) -> [DVec3; 3] {
        let [linear, angular] = self.momentum;
        [linear, angular, DVec3::from_array(self.bodies[0].0)]
    }
}

/// A robot's links in an order in which what hangs on one comes right behind it: those that have mass or a shape, or carry one that has.
struct Tree {
    /// Their numbers in the model.
    links: Vec<usize>,
    /// One past the last that hangs on each.
    ends: Vec<usize>,
    depths: Vec<usize>,
}

impl Tree {
    fn of(model: &RobotModel, solids: &[usize]) -> Self {
        let mut carries = vec![false; model.links.len()];
        for &solid in solids {
            let up = |&link: &usize| model.links[link].parent;
            std::iter::successors(Some(solid), up).for_each(|link| carries[link] = true);
        }
        let mut tree = Self { links: Vec::new(), ends: Vec::new(), depths: Vec::new() };
        tree.add(model, &carries, 0, 0);
        tree
    }

    fn add(&mut self, model: &RobotModel, carries: &[bool], link: usize, depth: usize) {
        let own = self.links.len();
        self.links.push(link);
        self.ends.push(0);
        self.depths.push(depth);
        for (child, _) in model.links.iter().enumerate().filter(|(_, one)| one.parent == Some(link)) {
            if carries[child] {
                self.add(model, carries, child, depth + 1);
            }
        }
        self.ends[own] = self.links.len();
    }

    fn place(&self, link: usize) -> Option<usize> {
        self.links.iter().position(|one| *one == link)
    }
}

/// A number that may be none.
fn or_none(number: Option<usize>) -> f32 {
    number.map_or(-1.0, |number| number as f32)
}

impl JointPath {
    /// For each frame its time, then positions, four a vector.
    fn table(&self) -> Vec<Row> {
        let frame = |(time, positions): (&f64, &Vec<f64>)| {
            let four = |four: &[f64]| std::array::from_fn(|i| four.get(i).copied().unwrap_or_default() as f32);
            let mut all = vec![[*time as f32, 0.0, 0.0, 0.0]];
            all.extend(positions.chunks(4).map(four));
            all
        };
        self.times().iter().zip(self.frames()).flat_map(frame).collect()
    }
}

impl Robot {
    /// What a device reads of it, if its links begin at `at` in the table: its head, and the rest.
    fn table(&self, at: usize) -> ([Row; 3], Vec<Row>) {
        let model = &*self.model;
        let tree = Tree::of(model, &self.solids);
        let with_drive = |drive: usize| {
            let moved = move |link: &usize| {
                let joint = &model.links[*link].joint;
                joint.freedom != Freedom::Fixed && joint.drive == drive
            };
            tree.links.iter().enumerate().filter(move |(_, link)| moved(link)).map(|(place, _)| place)
        };
        let mut rest = Vec::new();
        for (place, (&number, end)) in tree.links.iter().zip(&tree.ends).enumerate() {
            let link = &model.links[number];
            let joint = &link.joint;
            let freedom = match joint.freedom {
                Freedom::Fixed => 0.0,
                Freedom::Revolute => 1.0,
                Freedom::Prismatic => 2.0,
            };
            let next = (joint.freedom != Freedom::Fixed)
                .then(|| with_drive(joint.drive).find(|other| *other > place))
                .flatten();
            let body = self.solids.iter().position(|solid| *solid == number);
            let parent = link.parent.and_then(|parent| tree.place(parent));
            let q = joint.origin.rotation;
            rest.push([or_none(parent), freedom, joint.drive as f32, or_none(body)]);
            rest.push([joint.ratio, joint.offset, link.mass, tree.depths[place] as f64].map(|x| x as f32));
            rest.push(row(joint.origin.position, *end as f64));
            rest.push([q.x, q.y, q.z, q.w].map(|x| x as f32));
            rest.push([joint.axis.x as f32, joint.axis.y as f32, joint.axis.z as f32, or_none(next)]);
            rest.push(row(link.centre, 0.0));
            rest.extend(rows(&link.inertia));
        }
        let drives = at + rest.len();
        for (d, (drive, gains)) in model.drives.iter().zip(&self.gains).enumerate() {
            let [low, high] = drive.limits.map(|x| x.clamp(-FAR, FAR) as f32);
            rest.push([or_none(with_drive(d).next()), low, high, drive.effort.min(FAR) as f32]);
            rest.push([drive.speed.min(FAR), drive.damping, drive.friction, drive.armature].map(|x| x as f32));
            rest.push([gains.kp as f32, gains.kd as f32, 0.0, 0.0]);
        }
        let corrections = at + rest.len();
        rest.extend(self.corrections.iter().map(Correction::table));
        let path = at + rest.len();
        rest.extend(self.path.table());
        let depth = tree.depths.iter().copied().max().unwrap_or_default();
        let end = self.path.times().last().copied().unwrap_or_default();
        let head = [
            [at, tree.links.len(), drives, model.drives.len()].map(|n| n as f32),
            [self.base_rates(), depth, path, self.path.times().len()].map(|n| n as f32),
            [end, self.path.period().unwrap_or_default(), corrections as f64, self.corrections.len() as f64]
                .map(|x| x as f32),
        ];
        (head, rest)
    }

    /// Its state, for a device to go on from.
    pub(crate) fn device_state(&self) -> GroupState {
        let bits = |v: DVec3| [(v.x as f32).to_bits(), (v.y as f32).to_bits(), (v.z as f32).to_bits(), 0];
        let parts = |x: f64| {
            let all = (x * PARTS).round() as i64;
            [(all >> 32) as u32, all as u32]
        };
        let own: Vec<_>;
        let (bodies, [linear, angular]) = match &self.state.held {
            Some(held) => (&held.bodies, held.momentum),
            None => {
                own = (0..self.solids.len()).map(|body| of_pose(&self.pose(body))).collect();
                let momentum =
                    dynamics::momentum(&self.model, &self.step.places, &self.step.rates, DVec3::from_array(own[0].0));
                (&own, momentum)
            }
        };
        let [whole, part] = parts(self.state.clock);
        let (base, drives) = self.state.rates.split_at(self.base_rates());
        let of_base = |i: usize| base.get(i..i + 3).map_or(DVec3::ZERO, DVec3::from_slice);
        let mut words = vec![
            [whole, part, u32::from(self.state.orders.is_some()), 0],
            bits(linear),
            bits(angular),
            bits(of_base(0)),
            bits(of_base(3)),
        ];
        words.extend(self.state.positions.iter().zip(drives).map(|(position, rate)| {
            let [whole, part] = parts(*position);
            [whole, part, (*rate as f32).to_bits(), 0]
        }));
        let orders = self.state.orders.as_deref().unwrap_or_default();
        words.extend((0..drives.len()).map(|d| {
            let order = orders.get(d).copied().unwrap_or_default();
            [order.target, order.rate, order.torque, f64::from(u8::from(order.holds))].map(|x| (x as f32).to_bits())
        }));
        let placed = |&(position, rotation): &([f64; 3], [f64; 4])| Placed { position, rotation };
        GroupState { words, bodies: bodies.iter().map(placed).collect() }
    }

    /// What a device is told of where its links touch walls and one another in a step; `None` where that is at more points than it takes.
    pub(crate) fn told(&self, span: Span) -> Option<Vec<[u32; 4]>> {
        let mut points = Points::default();
        self.find_points(&self.boxes(), &[], span, &mut points);
        let about = DVec3::from_array(
            self.state.held.as_ref().map_or_else(|| of_pose(&self.pose(0)).0, |held| held.bodies[0].0),
        );
        let bits = |v: DVec3, last: f64| [v.x, v.y, v.z, last].map(|x| (x as f32).to_bits());
        let word = |touch: &Touch, bodies: [u32; 2]| {
            let at = DVec3::from_array(points.nodes.position[touch.node]);
            let Grip::Coulomb { normal, friction, .. } = touch.grip else { return [[0; 4]; POINT] };
            let mass = points.nodes.mass[touch.node];
            // What bounces must not come as near as the gap allows.
            let bounces = self.restitution > 0.0;
            let most =
                if bounces { DVec3::from_array(points.nodes.velocity[touch.node]).dot(normal) } else { FAR } as f32;
            [
                bits(at - about, mass),
                bits(-normal, touch.distance),
                [bodies[0], bodies[1], (friction as f32).to_bits(), most.to_bits()],
            ]
        };
        // A base that stays has nothing to answer with.
        let moves = |body: usize| !self.step.places[self.solids[body]].columns.is_empty();
        let of_walls = (0_u32..)
            .zip(&points.touches)
            .filter(|(body, _)| moves(*body as usize))
            .flat_map(|(body, touches)| touches.iter().map(move |touch| (touch, [body, u32::MAX])));
        let of_pairs = points
            .pairs
            .iter()
            .flat_map(|pair| pair.touches.iter().map(|touch| (touch, pair.bodies.map(|body| body as u32))));
        let all: Vec<_> = of_walls.chain(of_pairs).flat_map(|(touch, bodies)| word(touch, bodies)).collect();
        let count = all.len() / POINT;
        let head = [count as u32, 0, 0, 0];
        (count <= MOST_POINTS).then(|| [vec![head], all].concat())
    }

    /// How far two of its bodies are from each other [m], or, where their boxes are further apart than `far`, how far those are.
    fn gap(&self, [a, b]: [usize; 2], far: f64) -> f64 {
        let (one, other) = (self.bounds(a, 0.0), self.bounds(b, 0.0));
        let along = |d: usize| (one.min[d] - other.max[d]).max(other.min[d] - one.max[d]);
        let of_boxes = along(0).max(along(1)).max(along(2));
        match (&self.bodies[a], &self.bodies[b]) {
            (Some(first), Some(second)) if of_boxes <= far => first.distance(&self.pose(a), (second, &self.pose(b))),
            _ => of_boxes,
        }
    }

    /// Takes note of where its links touch walls and one another in a step that a device takes, or that they do nowhere.
    pub(crate) fn note_touching(&mut self, span: Span, in_turns: bool) {
        let mut points = std::mem::take(&mut self.step.points);
        if in_turns {
            self.find_points(&self.boxes(), &[], span, &mut points);
        } else {
            points.clear();
        }
        self.step.points = points;
    }

    /// Gives the base's rates in the step under way what they lack of the momentum that a device holds, as that does at the start of its next step.
    pub(super) fn correct_held(&mut self) -> Option<()> {
        let Some([linear, angular, about]) = self.state.held.as_ref().filter(|_| self.floating).map(Held::momentum)
        else {
            return Some(());
        };
        self.correct(linear, angular, about)
    }

    /// Takes in what a device made of it in a step of `dt` [s]; `None` if that is not finite.
    pub(crate) fn take_device_state(&mut self, state: &GroupState, dt: f64) -> Option<()> {
        let (count, first) = (self.state.positions.len(), self.base_rates());
        if state.words.len() != WORDS + 2 * count || state.bodies.len() != self.solids.len() {
            return None;
        }
        self.sense_on_device();
        let leaning = self.leaning();
        let real = |bits: u32| f64::from(f32::from_bits(bits));
        let vector = |word: [u32; 4]| DVec3::new(real(word[0]), real(word[1]), real(word[2]));
        let number = |word: &[u32; 4]| f64::from(word[0] as i32) + f64::from(word[1]) / PARTS;
        self.state.clock = number(&state.words[0]);
        for (d, word) in state.words[WORDS..WORDS + count].iter().enumerate() {
            self.state.positions[d] = number(word);
            self.state.rates[first + d] = real(word[2]);
        }
        if self.floating {
            self.state.rates[..3].copy_from_slice(&vector(state.words[3]).to_array());
            self.state.rates[3..6].copy_from_slice(&vector(state.words[4]).to_array());
            let [w, x, y, z] = state.bodies[0].rotation;
            let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
            let centre = DVec3::from_array(state.bodies[0].position);
            self.state.base = Pose { position: centre - rotation * self.model.links[0].centre, rotation };
        }
        let bodies = state.bodies.iter().map(|placed| (placed.position, placed.rotation)).collect();
        let held = Held { bodies, momentum: [vector(state.words[1]), vector(state.words[2])] };
        self.step.rates.copy_from_slice(&self.state.rates);
        // From where links were.
        self.sense_rigid();
        self.step.places = dynamics::places(&self.model, self.floating, &self.state.base, &self.state.positions);
        self.state.held = Some(held);
        self.correct_held()?;
        self.sense_end(dt);
        let mut orders = self.state.orders.clone().unwrap_or_else(|| self.path.orders(self.state.clock, 0.0));
        self.balance_orders(leaning, &mut orders);
        self.step.orders = orders;
        let is_finite = self.state.base.position.is_finite()
            && self.state.base.rotation.is_finite()
            && self.state.positions.iter().chain(&self.state.rates).all(|x| x.is_finite());
        is_finite.then_some(())
    }
}

fn of_pose(pose: &Pose) -> ([f64; 3], [f64; 4]) {
    let q = pose.rotation;
    (pose.position.to_array(), [q.w, q.x, q.y, q.z])
}

/// The law of robots that grip as `contacts` say, each its own, on finest cells of width `cell` [m]; `None` if there is too much to number.
pub(crate) fn law(robots: &[Robot], contacts: &[Contact], cell: f64) -> Option<DeviceLaw> {
    let mut bodies = Vec::new();
    for (robot, &contact) in robots.iter().zip(contacts) {
        for &link in &robot.solids {
            let parts = robot.model.links[link].shape.as_ref().map_or(&[][..], |shape| shape.parts());
            bodies.push(Listed { parts, contact, behind: Vec::new() });
        }
    }
    let tables = Tables::of(&bodies)?;
    let wgsl = tables.wgsl();
    let Tables { mut table, samples } = tables;
    let heads = table.len();
    table.resize(heads + 3 * robots.len(), [0.0; 4]);
    let mut links = 1;
    for (r, robot) in robots.iter().enumerate() {
        let (head, rest) = robot.table(table.len());
        links = links.max(head[0][1] as usize);
        table[heads + 3 * r..][..3].copy_from_slice(&head);
        table.extend(rest);
    }
    // Contact thickens a thin link by a cell at most, and acts on nodes further off.
    let further = (1.0 + REACH) * cell;
    let meets = robots.iter().any(|robot| !robot.walls.is_empty() || !robot.pairs.is_empty());
    let points = if meets { MOST_POINTS } else { 0 };
    let told = if meets { 1 + POINT * MOST_POINTS } else { 0 };
    let group = |robot: &Robot| DeviceGroup {
        words: WORDS + 2 * robot.model.drives.len(),
        told,
        rates: robot.state.rates.len(),
        bodies: robot
            .solids
            .iter()
            .zip(&robot.extents)
            .map(|(link, &extent)| {
                let swing = robot.model.links[*link].shape.as_ref().map_or(0.0, Sdf::swing);
                DeviceBody { extent, swing, reach: extent + further }
            })
            .collect(),
    };
    let rates = robots.iter().map(|robot| robot.state.rates.len()).max()?;
    let answer = format!(
        "const ROBOT_HEADS: u32 = {heads}u;\nconst ROBOT_LINKS: u32 = {links}u;\nconst ROBOT_POINTS: u32 = {points}u;\nconst ROBOT_RATES: u32 = {rates}u;\n{}{}{}{}",
        include_str!("../robot.wgsl"),
        include_str!("points.wgsl"),
        include_str!("dynamics.wgsl"),
        include_str!("joints.wgsl")
    );
    let answer = DeviceAnswer { wgsl: answer, groups: robots.iter().map(group).collect() };
    (table.len() < 1 << 24).then_some(DeviceLaw { counted: true, wgsl, reach: REACH, table, samples, answer })
}

/// A body with a shape that a device moves.
pub(crate) struct Roaming {
    bounds: Aabb,
    /// Does it ever move? The base of a fixed robot may stand at a wall.
    moves: bool,
    /// How far beyond its box it acts on nodes [m].
    reach: f64,
}

impl Roaming {
    /// One in such a box, on finest cells of the first width, and on none wider than the second [m].
    pub(crate) fn new(bounds: Aabb, moves: bool, shape: &Sdf, [cell, widest]: [f64; 2]) -> Self {
        Self { bounds, moves, reach: REACH * widest + shape.padding(widest) - shape.padding(cell) }
    }
}

/// How far along each axis each of the robots' bodies may go, on finest cells of width `cell` [m], before two robots may touch, or act on the same nodes; `None` if two
/// may now: they are the host's to solve together. Bodies without a shape touch nothing.
pub(crate) fn apart(robots: &[Vec<Option<Roaming>>], cell: f64) -> Option<Vec<Aabb>> {
    let mut all = Vec::new();
    for (r, robot) in robots.iter().enumerate() {
        for body in robot {
            let mut leash = Aabb::UNBOUND;
            let others = robots.iter().enumerate().filter(|(other, _)| *other != r).flat_map(|(_, other)| other);
            for (body, other) in body.iter().flat_map(|body| others.clone().flatten().map(move |other| (body, other))) {
                let clearance = 2.0 * (MOST_MOVE * cell + AHEAD + body.reach.min(other.reach));
                leash = leash.intersection(&body.bounds.leash(&other.bounds, clearance, |spare| 0.5 * spare)?);
            }
            all.push(leash);
        }
    }
    Some(all)
}

/// The same on `leashes`, before a link may touch a wall that its robot meets, or another link; `None` if one may now, so that a device has to be told where.
pub(crate) fn off_what_is_rigid(
    robots: &[Robot],
    roaming: &[Vec<Option<Roaming>>],
    leashes: &[Aabb],
    cell: f64,
) -> Option<Vec<Aabb>> {
    let (mut all, mut first) = (leashes.to_vec(), 0);
    let clearance = 2.0 * MOST_MOVE * cell + AHEAD;
    for (robot, bodies) in robots.iter().zip(roaming) {
        let own = &mut all[first..first + bodies.len()];
        first += bodies.len();
        for (leash, body) in own.iter_mut().zip(bodies) {
            let Some(body) = body.as_ref().filter(|body| body.moves) else { continue };
            for wall in &robot.walls {
                *leash = leash.intersection(&body.bounds.leash(wall.bounds(), clearance, |spare| spare)?);
            }
        }
        for &pair in &robot.pairs {
            let spare = robot.gap(pair, 4.0 * clearance) - clearance;
            if spare <= 0.0 {
                return None;
            }
            // Half of it each, in whatever direction.
            let by = 0.5 * spare / 3.0_f64.sqrt();
            let box_of = Aabb { min: [-by; 3], max: [by; 3] };
            for body in pair {
                own[body] = own[body].intersection(&box_of);
            }
        }
    }
    Some(all)
}
