//! Robots as a device moves them: what `robot.wgsl` reads of them, and their states there and back.

use super::images::Images;
use super::model::{Freedom, RobotModel};
use super::motion::JointPath;
use super::together::{self, Felt, Together};
use super::touching::{Obstacle, Points, Span};
use super::{AHEAD, Kept, Robot, dynamics};
use crate::grip::REACH;
use crate::motion::Pose;
use crate::sdf::Sdf;
use crate::tables::{Listed, Row, Tables, row, rows};
use barchan_core::NodeBatch;
use barchan_core::contact::{Grip, Touch};
use barchan_core::coupling::{Aabb, DeviceAnswer, DeviceBody, DeviceGroup, DeviceLaw, GroupState, Placed};
use barchan_core::scene::Contact;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Words of a state before those of drives, see `robot.wgsl`.
const WORDS: usize = 5;
/// Parts of a second, a radian or a metre in a word.
const PARTS: f64 = 4_294_967_296.0;
/// A device moves links as long as their surfaces move by at most this much in a step [cells].
pub(crate) const MOST_MOVE: f64 = 0.5;
/// Words of a point at which links touch what is rigid, and how many points a device is told of at most: for one robot, and for several that may touch.
const POINT: usize = 4;
const MOST_POINTS: usize = 24;
const MOST_POINTS_TOGETHER: usize = 48;
/// Rates of robots that a device solves together at most.
const MOST_RATES: usize = 64;
/// In place of infinity.
const FAR: f64 = 1e30;

/// What a device made of a robot last, beside its [`State`](super::State).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Held {
    /// Position and rotation of its bodies, as the device has them.
    bodies: Vec<([f64; 3], [f64; 4])>,
    /// What its rates are corrected by at the start of its next step; on the host they are already.
    pub kept: Kept,
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
    /// From a robot's first body on. Where that is a tool in a guide, the guide has no part in it.
    fn of(robot: &Robot) -> Self {
        let (model, solids) = (&*robot.model, &robot.solids);
        let mut carries = vec![false; model.links.len()];
        for &solid in solids {
            let up = |&link: &usize| model.links[link].parent;
            std::iter::successors(Some(solid), up).for_each(|link| carries[link] = true);
        }
        let mut tree = Self { links: Vec::new(), ends: Vec::new(), depths: Vec::new() };
        tree.add(model, &carries, solids[0], 0);
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

/// Where a tree begins in its group: what comes before it there.
#[derive(Clone, Copy, Default)]
struct Before {
    trees: usize,
    links: usize,
    rates: usize,
    bodies: usize,
    words: usize,
}

impl Robot {
    fn words(&self) -> usize {
        WORDS + 2 * self.model.drives.len()
    }

    /// The links of its tree that a drive moves.
    fn moved_by<'a>(&'a self, tree: &'a Tree, drive: usize) -> impl Iterator<Item = usize> + 'a {
        let is_moved = move |link: &usize| {
            let joint = &self.model.links[*link].joint;
            joint.freedom != Freedom::Fixed && joint.drive == drive
        };
        tree.links.iter().enumerate().filter(move |(_, link)| is_moved(link)).map(|(place, _)| place)
    }

    /// What a device reads of its links.
    fn link_table(&self, tree: &Tree, before: Before) -> Vec<Row> {
        let model = &*self.model;
        let mut table = Vec::new();
        for (place, (&number, end)) in tree.links.iter().zip(&tree.ends).enumerate() {
            let link = &model.links[number];
            let joint = &link.joint;
            let freedom = match joint.freedom {
                Freedom::Fixed => 0.0,
                Freedom::Revolute => 1.0,
                Freedom::Prismatic => 2.0,
            };
            let next = (joint.freedom != Freedom::Fixed)
                .then(|| self.moved_by(tree, joint.drive).find(|other| *other > place))
                .flatten();
            let body = self.solids.iter().position(|solid| *solid == number);
            let parent = link.parent.and_then(|parent| tree.place(parent));
            let rate = before.rates + self.base_rates() + joint.drive;
            let [parent, next] = [parent, next].map(|link| or_none(link.map(|link| before.links + link)));
            let q = joint.origin.rotation;
            table.push([parent, freedom, rate as f32, or_none(body.map(|body| before.bodies + body))]);
            table.push([joint.ratio, joint.offset, link.mass, tree.depths[place] as f64].map(|x| x as f32));
            table.push(row(joint.origin.position, (before.links + end) as f64));
            table.push([q.x, q.y, q.z, q.w].map(|x| x as f32));
            table.push([joint.axis.x as f32, joint.axis.y as f32, joint.axis.z as f32, next]);
            table.push(row(link.centre, before.trees as f64));
            table.extend(rows(&link.inertia));
        }
        table
    }

    /// What a device reads of its rates: those of its base, then its drives'.
    fn rate_table(&self, tree: &Tree, before: Before) -> Vec<Row> {
        let number = |number: usize| [before.trees as f32, number as f32];
        let mut table = Vec::new();
        for rate in 0..self.base_rates() {
            let [own, number] = number(rate);
            table.extend([[before.links as f32, 0.0, 0.0, 0.0], [0.0; 4], [0.0, 0.0, own, number]]);
        }
        for (d, (drive, gains)) in self.model.drives.iter().zip(&self.gains).enumerate() {
            let [low, high] = drive.limits.map(|x| x.clamp(-FAR, FAR) as f32);
            let first = self.moved_by(tree, d).next().map(|link| before.links + link);
            let [own, number] = number(self.base_rates() + d);
            table.push([or_none(first), low, high, drive.effort.min(FAR) as f32]);
            table.push([drive.speed.min(FAR), drive.damping, drive.friction, drive.armature].map(|x| x as f32));
            table.push([gains.kp as f32, gains.kd as f32, own, number]);
        }
        table
    }

    /// What a device reads of its motion, if that begins at `at` in the table: corrections and path, and the rows of its tree.
    fn tree_table(&self, before: Before, at: usize) -> (Vec<Row>, [Row; 3]) {
        let first = before.rates + self.base_rates();
        let mut table: Vec<Row> = self.corrections.iter().map(|one| one.table(first)).collect();
        let path = at + table.len();
        table.extend(self.path.table());
        let end = self.path.times().last().copied().unwrap_or_default();
        let tree = [
            [before.rates, self.base_rates(), before.bodies, before.words].map(|n| n as f32),
            [path, self.path.times().len(), self.model.drives.len(), 0].map(|n| n as f32),
            [end, self.path.period().unwrap_or_default(), at as f64, self.corrections.len() as f64].map(|x| x as f32),
        ];
        (table, tree)
    }

    /// Its state, for a device to go on from.
    pub(crate) fn device_state(&self) -> GroupState {
        let with = |v: DVec3, last: f64| [v.x, v.y, v.z, last].map(|x| (x as f32).to_bits());
        let parts = |x: f64| {
            let all = (x * PARTS).round() as i64;
            [(all >> 32) as u32, all as u32]
        };
        let own: Vec<_>;
        let (bodies, kept) = match &self.state.held {
            Some(held) => (&held.bodies, held.kept),
            None => {
                own = (0..self.solids.len()).map(|body| of_pose(&self.pose(body))).collect();
                (&own, self.now(DVec3::from_array(own[0].0)))
            }
        };
        let [linear, angular, _] = kept.momentum;
        let [whole, part] = parts(self.state.clock);
        let (base, drives) = self.state.rates.split_at(self.base_rates());
        let of_base = |i: usize| base.get(i..i + 3).map_or(DVec3::ZERO, DVec3::from_slice);
        let mut words = vec![
            [whole, part, u32::from(self.state.orders.is_some()), 0],
            with(linear, kept.twice_energy),
            with(angular, kept.twice_work),
            with(of_base(0), 0.0),
            with(of_base(3), 0.0),
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

    /// What its places are from on a device.
    fn reference(&self) -> DVec3 {
        DVec3::from_array(self.state.held.as_ref().map_or_else(|| of_pose(&self.pose(0)).0, |held| held.bodies[0].0))
    }

    /// How far a body is from an image of another one's [m], or, where their boxes are further apart than `far`, how far those are.
    fn gap(&self, body: usize, (other, of_other): (&Self, usize), image: DVec3, far: f64) -> f64 {
        let (one, two) = (self.bounds(body, 0.0), other.bounds(of_other, 0.0).moved(image.to_array()));
        let along = |d: usize| (one.min[d] - two.max[d]).max(two.min[d] - one.max[d]);
        let of_boxes = along(0).max(along(1)).max(along(2));
        match (&self.bodies[body], &other.bodies[of_other]) {
            (Some(first), Some(second)) if of_boxes <= far => {
                first.distance(&self.pose(body), (second, &other.pose(of_other).moved(image)))
            }
            _ => of_boxes,
        }
    }

    /// Takes note of where its links touch walls, tools and one another in a step that a device takes, or that they do nowhere.
    pub(crate) fn note_touching(&mut self, tools: &[&Obstacle], span: Span, in_turns: bool) {
        let mut points = std::mem::take(&mut self.step.points);
        if in_turns {
            self.find_points(&self.boxes(), tools, span, &mut points);
        } else {
            points.clear();
        }
        self.step.points = points;
    }

    /// Corrects rates by what a device holds, as that does at the start of its next step.
    pub(super) fn correct_held(&mut self) -> Option<()> {
        match self.state.held.as_ref().map(|held| held.kept) {
            Some(kept) => self.correct(&kept),
            None => Some(()),
        }
    }

    /// Takes in what a device made of it in a step of `dt` [s]; `None` if that is not finite.
    pub(crate) fn take_device_state(&mut self, state: &GroupState, dt: f64) -> Option<()> {
        let (count, first) = (self.state.positions.len(), self.base_rates());
        if state.words.len() != WORDS + 2 * count || state.bodies.len() != self.solids.len() {
            return None;
        }
        self.sense_on_device();
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
        let about = DVec3::from_array(state.bodies[0].position);
        let momentum = [vector(state.words[1]), vector(state.words[2]), about];
        let [twice_energy, twice_work] = [1, 2].map(|word| real(state.words[word][3]));
        let kept = Kept { momentum, twice_energy, twice_work };
        let bodies = state.bodies.iter().map(|placed| (placed.position, placed.rotation)).collect();
        let held = Held { bodies, kept };
        self.step.rates.copy_from_slice(&self.state.rates);
        self.step.places = dynamics::places(&self.model, self.floating, &self.state.base, &self.state.positions);
        self.state.held = Some(held);
        self.correct_held()?;
        self.sense_end(dt);
        let is_finite = self.state.base.position.is_finite()
            && self.state.base.rotation.is_finite()
            && self.state.positions.iter().chain(&self.state.rates).all(|x| x.is_finite());
        is_finite.then_some(())
    }
}

fn of_pose(pose: &Pose) -> ([f64; 3], [f64; 4]) {
    (pose.position.to_array(), pose.quaternion())
}

/// Are robots to be solved together on a device, since some may touch? Not where there are too many for that.
pub(crate) fn are_together(robots: &[Robot]) -> bool {
    let may_touch = |(r, robot): (usize, &Robot)| robots[..r].iter().any(|other| other.gives_way_to(robot));
    let rates: usize = robots.iter().map(|robot| robot.state.rates.len()).sum();
    robots.iter().enumerate().any(may_touch) && rates <= MOST_RATES
}

/// At how many points a device solves what links touch at most, in each of these groups of robots beside these tools.
pub(crate) fn most_points(robots: &[Robot], groups: &[Range<usize>], tools: &[&Obstacle]) -> usize {
    let meets_some = |robot: &Robot| robot.obstacles(tools).next().is_some() || !robot.pairs.is_empty();
    let most = groups.iter().map(Range::len).max().unwrap_or_default();
    if most > 1 || robots.iter().any(meets_some) { room(most) } else { 0 }
}

/// How many points a group of so many robots is told of at most.
fn room(robots: usize) -> usize {
    if robots > 1 { MOST_POINTS_TOGETHER } else { MOST_POINTS }
}

/// The law of robots that grip as `contacts` say, in these groups, beside these tools, on finest cells of width `cell` [m]; `None` if there is too much to number, or a robot
/// that can't move.
pub(crate) fn law(
    robots: &[Robot],
    contacts: &[Contact],
    groups: &[Range<usize>],
    tools: &[&Obstacle],
    cell: f64,
) -> Option<DeviceLaw> {
    if robots.iter().any(|robot| robot.state.rates.is_empty()) {
        return None;
    }
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
    table.resize(heads + 2 * groups.len(), [0.0; 4]);
    // Contact thickens a thin link by a cell at most, and acts on nodes further off.
    let further = (1.0 + REACH) * cell;
    let most_trees = groups.iter().map(Range::len).max()?;
    let points = most_points(robots, groups, tools);
    let told = if points > 0 { 1 + POINT * points } else { 0 };
    let (mut most_links, mut all) = (1, Vec::new());
    for (g, group) in groups.iter().enumerate() {
        let own = &robots[group.clone()];
        let trees: Vec<Tree> = own.iter().map(Tree::of).collect();
        let mut before = Before::default();
        let mut begins = Vec::new();
        for (robot, tree) in own.iter().zip(&trees) {
            begins.push(before);
            before.trees += 1;
            before.links += tree.links.len();
            before.rates += robot.state.rates.len();
            before.bodies += robot.solids.len();
            before.words += robot.words();
        }
        let each = || own.iter().zip(&trees).zip(&begins);
        let links_at = table.len();
        table.extend(each().flat_map(|((robot, tree), before)| robot.link_table(tree, *before)));
        let rates_at = table.len();
        table.extend(each().flat_map(|((robot, tree), before)| robot.rate_table(tree, *before)));
        let mut heads_of_trees = Vec::new();
        for (robot, before) in own.iter().zip(&begins) {
            let (motion, head) = robot.tree_table(*before, table.len());
            table.extend(motion);
            heads_of_trees.extend(head);
        }
        let trees_at = table.len();
        table.extend(heads_of_trees);
        let depth = trees.iter().flat_map(|tree| &tree.depths).copied().max().unwrap_or_default();
        table[heads + 2 * g] = [links_at, before.links, rates_at, before.rates].map(|n| n as f32);
        table[heads + 2 * g + 1] = [trees_at, before.trees, depth, before.words].map(|n| n as f32);
        most_links = most_links.max(before.links);
        let body = |robot: &Robot, (link, extent): (&usize, &f64)| {
            let swing = robot.model.links[*link].shape.as_ref().map_or(0.0, Sdf::swing);
            DeviceBody { extent: *extent, swing, reach: extent + further }
        };
        let bodies =
            own.iter().flat_map(|robot| robot.solids.iter().zip(&robot.extents).map(move |one| body(robot, one)));
        all.push(DeviceGroup { words: before.words + points, told, rates: before.rates, bodies: bodies.collect() });
    }
    let rates = all.iter().map(|group| group.rates).max()?;
    let answer = format!(
        "const ROBOT_HEADS: u32 = {heads}u;\nconst ROBOT_TREES: u32 = {most_trees}u;\nconst ROBOT_LINKS: u32 = {most_links}u;\nconst ROBOT_POINTS: u32 = {points}u;\nconst ROBOT_RATES: u32 = {rates}u;\n{}{}{}{}",
        include_str!("../robot.wgsl"),
        include_str!("points.wgsl"),
        include_str!("dynamics.wgsl"),
        include_str!("joints.wgsl")
    );
    let answer = DeviceAnswer { wgsl: answer, groups: all };
    (table.len() < 1 << 24).then_some(DeviceLaw { counted: true, wgsl, reach: REACH, table, samples, answer })
}

/// The states of robots that a device holds as one group, and what points gave them, see [`felt`].
pub(crate) fn parted<'a>(state: &'a GroupState, robots: &[Robot]) -> (Vec<GroupState>, &'a [[u32; 4]]) {
    let (mut words, mut bodies) = (&state.words[..], state.bodies.iter().copied());
    let of_robot = |robot: &Robot| {
        let (own, rest) = words.split_at(robot.words().min(words.len()));
        words = rest;
        GroupState { words: own.to_vec(), bodies: bodies.by_ref().take(robot.solids.len()).collect() }
    };
    (robots.iter().map(of_robot).collect(), words)
}

/// A robot of a group, and its body there.
type End = (usize, usize);

/// A point at which a device solves what links of robots touch: its node, the body at its one end, and at its other, if that answers, too.
struct Point<'a> {
    nodes: &'a NodeBatch,
    touch: &'a Touch,
    normal: DVec3,
    friction: f64,
    end: End,
    /// With how far the image of it that is met is from it [m].
    other: Option<(End, DVec3)>,
}

impl Point<'_> {
    fn position(&self) -> DVec3 {
        DVec3::from_array(self.nodes.position[self.touch.node])
    }
}

/// All points of a group of robots.
fn all_points<'a>(points: impl Iterator<Item = &'a Points>, together: &'a [Together]) -> Vec<Point<'a>> {
    let mut all = Vec::new();
    let mut add = |nodes: &'a NodeBatch, touch: &'a Touch, end: End, other: Option<(End, DVec3)>| {
        if let Grip::Coulomb { normal, friction, .. } = touch.grip {
            all.push(Point { nodes, touch, normal: -normal, friction, end, other });
        }
    };
    for (r, points) in points.enumerate() {
        for (body, touches) in points.touches.iter().enumerate() {
            touches.iter().for_each(|touch| add(&points.nodes, touch, (r, body), None));
        }
        for pair in &points.pairs {
            let [body, other] = pair.bodies.map(|body| (r, body));
            pair.touches.iter().for_each(|touch| add(&points.nodes, touch, body, Some((other, DVec3::ZERO))));
        }
    }
    together.iter().for_each(|own| own.each_touch(&mut add));
    all
}

/// Can a group of robots on a device be told of all points where links touch walls, tools and one another in a step to come?
pub(crate) fn has_room(robots: &[Robot], tools: &[&Obstacle], span: Span) -> bool {
    let boxes: Vec<Vec<Aabb>> = robots.iter().map(Robot::boxes).collect();
    let of_robot = |(robot, boxes): (&Robot, &Vec<Aabb>)| {
        let mut points = Points::default();
        robot.find_points(boxes, tools, span, &mut points);
        points
    };
    let points: Vec<Points> = robots.iter().zip(&boxes).map(of_robot).collect();
    all_points(points.iter(), &together::find(robots, &boxes, span)).len() <= room(robots.len())
}

/// The points of a group in a step that has begun, as its device is told of them. If tools that move have brought more than there is room for since [`has_room`] was
/// asked, those furthest off are left out.
fn points_of<'a>(robots: &'a [Robot], together: &'a [Together]) -> Vec<Point<'a>> {
    let mut all = all_points(robots.iter().map(|robot| &robot.step.points), together);
    let room = room(robots.len());
    if all.len() > room {
        all.sort_by(|a, b| a.touch.distance.total_cmp(&b.touch.distance));
        all.truncate(room);
    }
    all
}

/// What a group of robots on a device is told of where their links touch walls, tools and one another in the step that has begun.
pub(crate) fn told(robots: &[Robot], together: &[Together]) -> Vec<[u32; 4]> {
    let bits = |v: DVec3, last: f64| [v.x, v.y, v.z, last].map(|x| (x as f32).to_bits());
    let points = points_of(robots, together);
    // Where each robot's bodies begin in the group.
    let mut firsts = vec![0];
    robots.iter().for_each(|robot| firsts.push(firsts[firsts.len() - 1] + robot.solids.len()));
    let number = |(robot, body): End| (firsts[robot] + body) as u32;
    let mass: f64 = points.iter().map(|point| point.nodes.mass[point.touch.node]).sum();
    let mut all = vec![[points.len() as u32, (mass as f32).to_bits(), 0, 0]];
    for point in &points {
        let node = point.touch.node;
        let velocity = DVec3::from_array(point.nodes.velocity[node]);
        // Between links the point moves along the normal alone; elsewhere with the surface, too.
        let (push, beside) = match point.other {
            Some(((other, _), image)) => {
                (-velocity.dot(point.normal), point.position() - image - robots[other].reference())
            }
            None => (0.0, velocity),
        };
        all.push(bits(point.position() - robots[point.end.0].reference(), point.nodes.mass[node]));
        all.push(bits(point.normal, push));
        let other = point.other.map_or(u32::MAX, |(end, _)| number(end));
        all.push([number(point.end), other, (point.friction as f32).to_bits(), 0]);
        all.push(bits(beside, 0.0));
    }
    all
}

/// What each of a group of robots felt of what is rigid in the step that a device took, by the impulses that points gave it [N s]; see [`told`].
///
/// The law of a point says them no better than to a few per cent: it weighs so much that what rounding leaves of a velocity in f32 is a force.
pub(crate) fn felt(robots: &[Robot], together: &[Together], given: &[[u32; 4]]) -> Vec<Vec<Felt>> {
    let mut felt = vec![Vec::new(); robots.len()];
    for (point, given) in points_of(robots, together).iter().zip(given) {
        let (robot, body) = point.end;
        let impulse = DVec3::from_array([0, 1, 2].map(|d| f64::from(f32::from_bits(given[d]))));
        let force = impulse / robots[robot].step.dt;
        if force != DVec3::ZERO {
            felt[robot].push((body, point.position(), force));
            if let Some(((other, body), image)) = point.other {
                felt[other].push((body, point.position() - image, -force));
            }
        }
    }
    felt
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
pub(crate) fn apart(robots: &[Vec<Option<Roaming>>], images: Images, cell: f64) -> Option<Vec<Aabb>> {
    let mut all = Vec::new();
    for (r, robot) in robots.iter().enumerate() {
        for body in robot {
            let mut leash = Aabb::UNBOUND;
            let others = robots.iter().enumerate().filter(|(other, _)| *other != r).flat_map(|(_, other)| other);
            for (body, other) in body.iter().flat_map(|body| others.clone().flatten().map(move |other| (body, other))) {
                let clearance = 2.0 * (MOST_MOVE * cell + AHEAD + body.reach.min(other.reach));
                for image in images.beside(&body.bounds, &other.bounds) {
                    let other = other.bounds.moved(image.to_array());
                    leash = leash.intersection(&body.bounds.leash(&other, clearance, |spare| 0.5 * spare)?);
                }
            }
            all.push(leash);
        }
    }
    Some(all)
}

/// The same on `leashes`, before a link may touch a wall or a tool that its robot meets, or another link; `None` if one may now, so that a device has to be told where.
pub(crate) fn off_what_is_rigid(
    robots: &[Robot],
    tools: &[&Obstacle],
    roaming: &[Vec<Option<Roaming>>],
    leashes: &[Aabb],
    images: Images,
    cell: f64,
) -> Option<Vec<Aabb>> {
    let (mut all, mut first) = (leashes.to_vec(), 0);
    let clearance = 2.0 * MOST_MOVE * cell + AHEAD;
    for (robot, bodies) in robots.iter().zip(roaming) {
        let own = &mut all[first..first + bodies.len()];
        first += bodies.len();
        for (leash, body) in own.iter_mut().zip(bodies) {
            let Some(body) = body.as_ref().filter(|body| body.moves) else { continue };
            for obstacle in robot.obstacles(tools) {
                for image in images.beside(&body.bounds, obstacle.bounds()) {
                    let obstacle = obstacle.bounds().moved(image.to_array());
                    *leash = leash.intersection(&body.bounds.leash(&obstacle, clearance, |spare| spare)?);
                }
            }
        }
        for &pair in &robot.pairs {
            let spare = robot.gap(pair[0], (robot, pair[1]), DVec3::ZERO, 4.0 * clearance) - clearance;
            let half = half_of(spare)?;
            for body in pair {
                own[body] = own[body].intersection(&half);
            }
        }
    }
    Some(all)
}

/// Half of what is to spare between two bodies, in whatever direction; `None` if nothing is.
fn half_of(spare: f64) -> Option<Aabb> {
    let by = 0.5 * spare / 3.0_f64.sqrt();
    (spare > 0.0).then_some(Aabb { min: [-by; 3], max: [by; 3] })
}

/// The same on `leashes`, before bodies of robots that a device solves together may touch.
pub(crate) fn off_one_another(
    robots: &[Robot],
    roaming: &[Vec<Option<Roaming>>],
    leashes: &[Aabb],
    images: Images,
    cell: f64,
) -> Option<Vec<Aabb>> {
    let (mut all, mut firsts) = (leashes.to_vec(), vec![0]);
    roaming.iter().for_each(|bodies| firsts.push(firsts[firsts.len() - 1] + bodies.len()));
    let clearance = 2.0 * MOST_MOVE * cell + AHEAD;
    let bodies = |r: usize| {
        let there = roaming[r].iter().enumerate();
        there.filter_map(move |(b, body)| body.as_ref().map(|body| (b, body)))
    };
    for second in 0..robots.len() {
        for first in (0..second).filter(|first| robots[*first].gives_way_to(&robots[second])) {
            for (a, own) in bodies(first) {
                for (b, other) in bodies(second).filter(|(_, other)| own.moves || other.moves) {
                    for image in images.beside(&own.bounds, &other.bounds) {
                        let gap = robots[first].gap(a, (&robots[second], b), image, 4.0 * clearance);
                        let halves = if gap > 4.0 * clearance {
                            let other = other.bounds.moved(image.to_array());
                            let from = |one: &Aabb, two: &Aabb| one.leash(two, clearance, |spare| 0.5 * spare);
                            [from(&own.bounds, &other)?, from(&other, &own.bounds)?]
                        } else {
                            [half_of(gap - clearance)?; 2]
                        };
                        for (body, half) in [firsts[first] + a, firsts[second] + b].into_iter().zip(&halves) {
                            all[body] = all[body].intersection(half);
                        }
                    }
                }
            }
        }
    }
    Some(all)
}
