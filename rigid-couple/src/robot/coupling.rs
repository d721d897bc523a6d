//! The coupling "robots": a scene's robots on soft ground, and the tools beside them that answer what they feel.

use super::adjoint::Behind;
use super::device::{self, Roaming};
use super::images::Images;
use super::joints::Gains;
use super::model::RobotModel;
use super::motion::{self, JointPath};
use super::sense::Sensed;
use super::solve::{Balanced, Whole};
use super::together::{self, Felt, Met, Together};
use super::touching::{Body, Obstacle, Span, pairs_of};
use super::{Robot, State, balance, dynamics};
use crate::grip::{self, REACH};
use crate::motion::{Pose, rotation_from};
use crate::rigid::body::Guided;
use crate::rigid::{rounded, thin};
use crate::world::friction_of;
use crate::{Refusal, Sdf, always_there, is_within_reach, sdf};
use barchan_core::contact::adjoint::{BodyInStep, GripCotangent, NearCotangents};
use barchan_core::contact::{Reaction, System, Touch, Twist};
use barchan_core::coupling::{Aabb, BodiesOwed, BodiesTold, DeviceLaw, Group, GroupState, GroupStep, Leashes, Moved};
use barchan_core::plan::ROBOT_COUPLING;
use barchan_core::scene::{self, Contact, World, fits, named_together};
use barchan_core::{
    BodyState, Command, Coupling, Error, JointState, NodeBatch, Result, RobotState, Scene, Surface, Vec3, Wrench,
};
use glam::DVec3;
use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

/// The robots of a scene, and behind them its tools that answer as they do: free ones, and those that a force pushes.
pub struct Robots {
    name: String,
    pub(super) scene: Scene,
    pub(super) robots: Vec<Robot>,
    /// The other tools of the scene: they stay, or move as they are told.
    pub(super) tools: Vec<Obstacle>,
    /// Those that touch one another in the step under way.
    pub(super) together: Vec<Together>,
    /// Does a device solve all of them together, since some may touch?
    as_one: bool,
    pub(super) contacts: Vec<Contact>,
    /// The number of each robot's first body.
    firsts: Vec<usize>,
    /// Do levels follow each of their bodies?
    followed: Vec<bool>,
    pub(super) wrenches: Vec<Wrench>,
    counts: Counts,
    /// Who moves them.
    moved: Moved,
    /// Steps of the finest level that have gone of the simulation's.
    slot: u32,
    /// What is owed to each robot behind the step that is gone back through.
    pub(super) behind: Vec<Behind>,
}

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct Counts {
    deep_nodes: u64,
    unconverged: u64,
    /// Of joints and what is rigid alone; a device counts them among the others.
    unsettled: u64,
}

impl Robot {
    /// Does it reach into the world, or is it above it, to fall in? What does not float may stand anywhere.
    pub(super) fn is_within_reach(&self, scene: &Scene) -> bool {
        let all = self.boxes().into_iter().reduce(|a, b| a.union(&b));
        !self.floating || all.is_none_or(|all| is_within_reach(&all, scene))
    }

    /// A scene's robot.
    ///
    /// # Errors
    /// If its URDF, joints, motors or motion cannot be used.
    pub fn new(robot: &scene::Robot, scene: &Scene) -> Result<Self, Refusal> {
        let mut model = RobotModel::of(robot, &scene.folder)?;
        let mut gains = vec![Gains::default(); model.drives.len()];
        for motor in &robot.motor {
            let mut any = false;
            for (drive, gains) in model.drives.iter_mut().zip(&mut gains) {
                if !fits(&motor.joints, &drive.name) {
                    continue;
                }
                any = true;
                gains.kp = motor.kp.unwrap_or(gains.kp);
                gains.kd = motor.kd.unwrap_or(gains.kd);
                drive.effort = motor.effort.unwrap_or(drive.effort);
                drive.armature = motor.armature.unwrap_or(drive.armature);
            }
            if !any {
                let known: Vec<&str> = model.drives.iter().map(|drive| drive.name.as_str()).collect();
                let what = format!("no joint that moves fits the motor's '{}'", motor.joints);
                return Err(Refusal::new(what, format!("known are: {}", known.join(", "))));
            }
        }
        let mut positions: Vec<f64> =
            model.drives.iter().map(|drive| 0.0_f64.clamp(drive.limits[0], drive.limits[1])).collect();
        motion::set(&robot.joints, &model.drives, &mut positions)?;
        let floating = !robot.fixed;
        let base = Pose { position: DVec3::from_array(robot.position), rotation: rotation_from(robot.rotation)? };
        let path = JointPath::new(robot.motion.as_ref(), &model, &base, &positions, &scene.folder)?;
        if robot.motion.is_some() && gains.iter().all(|gains| gains.kp == 0.0 && gains.kd == 0.0) {
            let what = "its motion moves nothing, since no motor has gains: give it motor = [{ kp = 100, kd = 3 }]";
            model.warnings.push(what.to_owned());
        }
        if robot.motion.as_ref().is_some_and(|motion| motion.path.is_some()) {
            positions.copy_from_slice(path.start());
        }
        let mut rates = vec![0.0; dynamics::rates_of(&model, floating)];
        if floating {
            let arm = base.rotation * model.links[0].centre;
            let twist =
                Twist { linear: DVec3::from_array(robot.velocity), angular: DVec3::from_array(robot.angular_velocity) };
            rates[..3].copy_from_slice(&twist.at(arm).to_array());
            rates[3..6].copy_from_slice(&robot.angular_velocity);
        }
        let sensed = Sensed::at_start(DVec3::from_array(scene.gravity_at(0.0)));
        let state =
            State { base, positions, rates, owed: 0.0, orders: None, clock: path.wrapped(0.0), held: None, sensed };
        let solids: Vec<usize> = (0..model.links.len())
            .filter(|&i| i == 0 || model.links[i].mass > 0.0 || model.links[i].shape.is_some())
            .collect();
        let orders = path.orders(0.0, 0.0);
        let step = Self::at_rest(&model, floating, &solids, &state, orders).ok_or_else(|| {
            Refusal::new(
                "its joints cannot be solved: some move links only as others do, or its numbers are beyond all measure",
                "leave out joints that others stand for, and look at its lengths and masses",
            )
        })?;
        let shapes: Vec<Option<&Sdf>> = solids.iter().map(|&link| model.links[link].shape.as_ref()).collect();
        let extents = shapes.iter().map(|shape| shape.map_or(0.0, Sdf::extent)).collect();
        let bodies: Vec<Option<Body>> = shapes.iter().map(|shape| shape.map(Body::new)).collect();
        let pairs =
            if robot.self_collision { pairs_of(&mut model, &solids, &bodies, &step.places) } else { Vec::new() };
        let corrections = balance::corrections(&robot.balance, &model)?;
        let name = |&link: &usize| match link {
            0 => robot.name.clone(),
            _ => format!("{}/{}", robot.name, model.links[link].name),
        };
        Ok(Self {
            name: robot.name.clone(),
            floating,
            names: solids.iter().map(name).collect(),
            solids,
            bodies,
            extents,
            gains,
            path,
            corrections,
            friction: friction_of(robot.contact),
            restitution: 0.0,
            is_tool: false,
            guided: None,
            walls: Obstacle::walls(&scene.world, base.position),
            pairs,
            state,
            step,
            model: Arc::new(model),
        })
    }

    /// The frame of its base, as it is now.
    pub fn base(&self) -> Pose {
        self.state.base
    }

    pub(super) fn body_name(&self, body: usize) -> &str {
        &self.names[body]
    }

    /// The links at the ends of its branches that have shapes: feet, hands.
    fn ends(&self) -> impl Iterator<Item = usize> {
        let has_shape = |link: usize| self.model.links[link].shape.is_some();
        let parents: Vec<usize> = (0..self.model.links.len())
            .filter(|&link| has_shape(link))
            .flat_map(|link| {
                std::iter::successors(self.model.links[link].parent, |&above| self.model.links[above].parent)
            })
            .collect();
        (0..self.solids.len())
            .filter(move |&body| has_shape(self.solids[body]) && !parents.contains(&self.solids[body]))
    }

    pub(super) fn bounds(&self, body: usize, cell: f64) -> Aabb {
        let pose = self.pose(body);
        match &self.model.links[self.solids[body]].shape {
            Some(shape) => shape.bounds(&pose, cell),
            None => Aabb { min: pose.position.to_array(), max: pose.position.to_array() },
        }
    }

    fn report(&self, body: usize, gravity: DVec3) -> BodyState {
        let (pose, twist) = (self.pose(body), self.twist(body));
        let mass = self.model.links[self.solids[body]].mass;
        let (momentum, spin) = (mass * twist.linear, self.inertia(body) * twist.angular);
        BodyState {
            name: self.body_name(body).to_owned(),
            position: pose.position.to_array(),
            rotation: pose.quaternion(),
            velocity: twist.linear.to_array(),
            angular_velocity: twist.angular.to_array(),
            mass,
            kinetic_energy: 0.5 * (momentum.dot(twist.linear) + spin.dot(twist.angular)),
            // What a guide bears has no weight.
            potential_energy: if self.guided.is_some() { 0.0 } else { -mass * gravity.dot(pose.position) },
            momentum: momentum.to_array(),
            angular_momentum: (pose.position.cross(momentum) + spin).to_array(),
        }
    }

    fn lost(&self, what: &str) -> Error {
        let mend = "lower time.step, or start from the last snapshot";
        Refusal::new(format!("its {what} is no longer finite"), mend).at(&self.path())
    }

    /// What errors call it.
    pub(super) fn path(&self) -> String {
        format!("{} '{}'", if self.is_tool { "tool" } else { "robot" }, self.name)
    }
}

impl Robots {
    /// The robots of `scene`, as the coupling 'robots', and the tools that [go with them](Scene::goes_with_robots).
    ///
    /// # Errors
    /// If one cannot be used, naming its key path.
    pub fn new(scene: &Scene) -> Result<Self> {
        let make =
            |(i, robot): (usize, &scene::Robot)| Robot::new(robot, scene).map_err(|e| e.at(&format!("robot[{i}]")));
        let mut robots: Vec<Robot> = scene.robot.iter().enumerate().map(make).collect::<Result<_>>()?;
        for (i, robot) in robots.iter().enumerate() {
            if !robot.is_within_reach(scene) {
                let World { min, max, .. } = scene.world;
                let what = format!("robot '{}' is outside the world, from {min:?} to {max:?}", robot.name);
                let refusal = Refusal::new(what, "move the robot, or widen world.min and world.max");
                return Err(refusal.at(&format!("robot[{i}].position")));
            }
        }
        let mut contacts: Vec<Contact> = scene.robot.iter().map(|robot| robot.contact).collect();
        for (i, tool) in scene.tool.iter().enumerate().filter(|(_, tool)| scene.goes_with_robots(tool)) {
            robots.push(Robot::loose(tool, &format!("tool[{i}]"), scene)?);
            contacts.push(tool.contact);
        }
        let mut firsts = Vec::new();
        let mut count = 0;
        for robot in &robots {
            firsts.push(count);
            count += robot.solids.len();
        }
        let is_followed = |robot: &Robot| -> Vec<bool> {
            let ends: Vec<usize> = robot.ends().collect();
            let is_followed =
                |body: usize| scene.levels.surround(robot.body_name(body)).unwrap_or_else(|| ends.contains(&body));
            (0..robot.solids.len()).map(is_followed).collect()
        };
        Ok(Self {
            followed: robots.iter().flat_map(is_followed).collect(),
            as_one: device::are_together(&robots),
            name: ROBOT_COUPLING.to_owned(),
            scene: scene.clone(),
            contacts,
            robots,
            tools: Obstacle::tools(scene)?,
            together: Vec::new(),
            firsts,
            wrenches: vec![Wrench::default(); count],
            counts: Counts::default(),
            moved: Moved::ByCoupling,
            slot: 0,
            behind: Vec::new(),
        })
    }

    /// The same under another name.
    #[must_use]
    pub fn called(self, name: &str) -> Self {
        Self { name: name.to_owned(), ..self }
    }

    /// The robots, and the tools behind them.
    pub fn robots(&self) -> &[Robot] {
        &self.robots
    }

    fn is_on_device(&self) -> bool {
        self.moved != Moved::ByCoupling
    }

    /// Which robot a body is of, and its number there.
    fn of(&self, body: usize) -> (usize, usize) {
        let robot = self.firsts.partition_point(|first| *first <= body) - 1;
        (robot, body - self.firsts[robot])
    }

    fn all(&self) -> impl Iterator<Item = (&Robot, usize)> {
        self.robots.iter().flat_map(|robot| (0..robot.solids.len()).map(move |body| (robot, body)))
    }

    /// The width of the coarsest cells [m].
    fn widest(&self) -> f64 {
        self.scene.world.cell * f64::from(1 << (self.scene.levels.count - 1))
    }

    /// The robots of some bodies, which are all of theirs.
    pub(super) fn robots_of(&self, bodies: &Range<usize>) -> Range<usize> {
        self.of(bodies.start).0..self.of(bodies.end - 1).0 + 1
    }

    /// The bodies of a robot, in what is listed from the body `from` on.
    pub(super) fn bodies_of(&self, robot: usize, from: usize) -> Range<usize> {
        let first = self.firsts[robot] - from;
        first..first + self.robots[robot].solids.len()
    }

    /// The robots that move as one in the step under way: those that touch, and those that the scene lists between them.
    fn moves_as_one(&self) -> Vec<Range<usize>> {
        let (mut all, mut first) = (Vec::new(), 0);
        while first < self.robots.len() {
            let mut end = first + 1;
            while let Some(more) = self.together.iter().map(Together::span).find(|s| s.start < end && s.end > end) {
                end = more.end;
            }
            all.push(first..end);
            first = end;
        }
        all
    }

    /// The robots of each group on a device.
    fn device_ranges(&self) -> Vec<Range<usize>> {
        if self.as_one {
            return vec![Range { start: 0, end: self.robots.len() }];
        }
        (0..self.robots.len()).map(|robot| robot..robot + 1).collect()
    }

    fn group(&self, robots: Range<usize>) -> Group {
        Group {
            bodies: self.firsts[robots.start]..self.bodies_of(robots.end - 1, 0).end,
            mass: self.robots[robots].iter().map(|robot| robot.model.mass()).sum(),
        }
    }

    /// Those of some robots that touch none, and those that touch one another.
    pub(super) fn parted(&self, robots: Range<usize>) -> (Vec<usize>, Vec<&Together>) {
        let own = self.together.iter().filter(|one| robots.contains(&one.robots[0]));
        let (mut alone, own): (Vec<usize>, Vec<&Together>) = (robots.clone().collect(), own.collect());
        alone.retain(|robot| !own.iter().any(|one| one.robots.contains(robot)));
        (alone, own)
    }

    /// What robots that touch are tried at; lists begin with the body `from`.
    fn met<'a>(&self, own: &Together, from: usize, at: &'a [Twist], systems: &'a [System]) -> Met<'a> {
        let bodies = || own.robots.iter().map(|&robot| self.bodies_of(robot, from));
        Met { at: bodies().map(|own| &at[own]).collect(), systems: bodies().map(|own| &systems[own]).collect() }
    }

    /// What robots press on one another with in the step under way, at some rates of each.
    fn felt(&self, rates: impl Fn(&Robot) -> DVector<f64>) -> Vec<Vec<Felt>> {
        let mut felt = vec![Vec::new(); self.robots.len()];
        for own in &self.together {
            let of_own = own.felt(&self.robots, |robot| rates(&self.robots[robot]));
            own.robots.iter().zip(of_own).for_each(|(&robot, of_robot)| felt[robot] = of_robot);
        }
        felt
    }

    /// What to say of bodies that overlap others' or what is rigid where they start.
    fn overlaps(&self) -> Option<String> {
        let solid = |(robot, body): (usize, usize)| {
            let own = &self.robots[robot];
            Some((own, own.body_name(body), own.bodies[body].as_ref()?, own.pose(body), own.bounds(body, 0.0)))
        };
        let numbers = (0..self.robots.len()).flat_map(|r| (0..self.robots[r].solids.len()).map(move |body| (r, body)));
        let solids: Vec<_> = numbers.filter_map(solid).collect();
        let tools: Vec<&Obstacle> = self.tools.iter().collect();
        let images = Images::of(&self.scene.world);
        let mut found = Vec::new();
        for (i, (robot, name, body, pose, bounds)) in solids.iter().enumerate() {
            let with_obstacles = robot.obstacles(&tools).filter(|one| one.is_overlapped(body, pose, bounds, images));
            found.extend(with_obstacles.map(|obstacle| format!("'{name}' and {}", obstacle.title())));
            let others =
                solids[..i].iter().filter(|(other, ..)| !std::ptr::eq(*robot, *other) && robot.gives_way_to(other));
            let overlapping = others.filter(|(_, _, other, at, around)| {
                images.meeting(bounds, around).any(|by| body.overlaps(pose, (other, &at.moved(by))))
            });
            found.extend(overlapping.map(|(_, other, ..)| format!("'{other}' and '{name}'")));
        }
        let all = found.join("; ");
        (!found.is_empty()).then(|| format!("bodies overlap where they start, and are pushed apart: {all}; move them"))
    }

    /// A step, as contact points know it.
    pub(super) fn span(&self, time: f64, dt: f64) -> Span {
        let gravity = DVec3::from_array(self.scene.gravity_at(time)).length();
        Span { time, dt, gravity, images: Images::of(&self.scene.world) }
    }

    /// Finds who touches whom, and each one's rates without soft ground.
    fn balance_alone(&mut self, boxes: &[Vec<Aabb>], span: Span) -> Result<()> {
        self.together = together::find(&self.robots, boxes, span);
        let (alone, own) = self.parted(0..self.robots.len());
        let mut found: Vec<Option<_>> = self.robots.iter().map(|_| None).collect();
        for robot in alone {
            found[robot] = self.robots[robot].balance_alone();
        }
        for together in own {
            let rates = together.balance_alone(&self.robots).into_iter().flatten();
            together.robots.iter().zip(rates).for_each(|(&robot, rates)| found[robot] = Some(rates));
        }
        for (robot, found) in self.robots.iter_mut().zip(found) {
            let Balanced { rates, converged } = found.ok_or_else(|| robot.lost("motion"))?;
            robot.go(rates).map_err(|()| robot.lost("motion"))?;
            self.counts.unsettled += u64::from(!converged);
        }
        Ok(())
    }
}

impl Coupling for Robots {
    fn name(&self) -> &str {
        &self.name
    }

    fn bodies(&self) -> Vec<BodyState> {
        let gravity = DVec3::from_array(self.scene.gravity);
        self.all().map(|(robot, body)| robot.report(body, gravity)).collect()
    }

    fn followed(&self) -> Vec<String> {
        self.robots.iter().flat_map(|robot| robot.ends().map(|body| robot.body_name(body).to_owned())).collect()
    }

    fn joints(&self) -> Vec<JointState> {
        let of_robot = |robot: &Robot| -> Vec<JointState> {
            let (first, torques) = (robot.base_rates(), robot.motor_torques());
            let joint = |(d, drive): (usize, &super::model::Drive)| JointState {
                body: robot.name.clone(),
                name: drive.name.clone(),
                turns: drive.turns,
                position: robot.state.positions[d],
                rate: robot.step.rates[first + d],
                torque: torques[d],
            };
            robot.model.drives.iter().enumerate().map(joint).collect()
        };
        self.robots.iter().filter(|robot| !robot.is_tool).flat_map(of_robot).collect()
    }

    fn robots(&self) -> Vec<RobotState> {
        self.robots.iter().filter(|robot| !robot.is_tool).map(Robot::sensors).collect()
    }

    fn max_speed(&self, time: f64, dt: f64) -> f64 {
        let gravity = DVec3::from_array(self.scene.gravity_at(time)).length();
        let gained = |robot: &Robot| dt * robot.guided.map_or(gravity, |guided| guided.most());
        self.all().map(|(robot, body)| robot.surface_speed(body) + gained(robot)).fold(0.0, f64::max)
    }

    fn watches(&self) -> bool {
        self.moved != Moved::ByDevice && self.tools.iter().any(Obstacle::moves)
    }

    fn see(&mut self, others: &[BodyState]) {
        self.tools.iter_mut().filter(|tool| tool.moves()).for_each(|tool| tool.follow(others));
    }

    fn before_step(&mut self, time: f64, dt: f64) -> Result<()> {
        self.wrenches.fill(Wrench::default());
        let gravity = DVec3::from_array(self.scene.gravity_at(time));
        let span = self.span(time, dt);
        let mut all = Vec::with_capacity(self.robots.len());
        let tools: Vec<&Obstacle> = self.tools.iter().collect();
        for robot in &mut self.robots {
            if self.moved != Moved::ByCoupling {
                robot.step.dt = dt;
                robot.sense_gravity(gravity);
                robot.note_touching(&tools, span, self.moved == Moved::InTurns);
                continue;
            }
            if self.slot == 0 {
                robot.sense_start(gravity);
            }
            let boxes = robot.boxes();
            robot.begin(span, gravity, &boxes, &tools).map_err(|()| robot.lost("motion"))?;
            all.push(boxes);
        }
        match self.moved {
            Moved::ByCoupling => return self.balance_alone(&all, span),
            // Groups of their own do not come to touch.
            Moved::InTurns if self.as_one => {
                let boxes: Vec<_> = self.robots.iter().map(Robot::boxes).collect();
                self.together = together::find(&self.robots, &boxes, span);
            }
            Moved::InTurns | Moved::ByDevice => self.together.clear(),
        }
        Ok(())
    }

    fn bounds(&self) -> Vec<Aabb> {
        let (cell, world) = (self.scene.world.cell, self.scene.world_box());
        // A tool that a servo pushes may be a plane.
        let world = world.grown(4.0 * cell);
        self.all().map(|(robot, body)| robot.bounds(body, cell).ended_by(&world)).collect()
    }

    fn reach(&self) -> f64 {
        let (cell, widest) = (self.scene.world.cell, self.widest());
        let shapes = self.all().filter_map(|(robot, body)| robot.model.links[robot.solids[body]].shape.as_ref());
        let more = shapes.map(|shape| shape.padding(widest) - shape.padding(cell)).fold(0.0, f64::max);
        REACH + more / widest
    }

    fn touch(&mut self, body: usize, dt: f64, nodes: &NodeBatch, touches: &mut Vec<Touch>) {
        let (number, body) = self.of(body);
        let robot = &self.robots[number];
        if let Some(shape) = &robot.model.links[robot.solids[body]].shape {
            grip::touch(shape, self.contacts[number], &robot.pose(body), nodes, dt, touches);
        }
    }

    fn twist(&self, body: usize) -> Twist {
        let (robot, body) = self.of(body);
        self.robots[robot].twist(body)
    }

    fn twin(&self) -> Result<Box<dyn Coupling>> {
        always_there(&self.scene)?;
        Ok(Box::new(Self {
            name: self.name.clone(),
            scene: self.scene.clone(),
            robots: self.robots.clone(),
            tools: self.tools.clone(),
            together: Vec::new(),
            contacts: self.contacts.clone(),
            firsts: self.firsts.clone(),
            followed: self.followed.clone(),
            wrenches: self.wrenches.clone(),
            moved: Moved::ByCoupling,
            behind: Vec::new(),
            ..*self
        }))
    }

    fn touch_back(
        &self,
        body: usize,
        dt: f64,
        nodes: &NodeBatch,
        touches: (&[Touch], &[GripCotangent]),
        near: &mut NearCotangents,
        owed: &mut BodyInStep,
    ) -> Result<()> {
        let (number, body) = self.of(body);
        let robot = &self.robots[number];
        if let Some(shape) = &robot.model.links[robot.solids[body]].shape {
            grip::touch_back(shape, &robot.pose(body), nodes, dt, touches, near, owed);
        }
        Ok(())
    }

    fn answer_back(&self, group: Range<usize>, systems: &[System]) -> Option<Vec<Twist>> {
        self.answer_together_back(&group, systems)
    }

    fn advance_back(&mut self, _: f64, owed: &mut BodiesOwed<'_>) -> Result<Vec<Twist>> {
        self.go_back_behind(owed)
    }

    fn see_back(&self, time: f64, dt: f64, step: &[BodyInStep]) -> Result<Vec<(String, BodyInStep)>> {
        self.go_back_to_tools(time, dt, step)
    }

    fn begin_back(
        &self,
        time: f64,
        dt: f64,
        step: &[BodyInStep],
        owed: &mut BodiesOwed<'_>,
        told: &mut BodiesTold<'_>,
    ) -> Result<Vec3> {
        Ok(self.go_back_to_start(time, dt, step, owed, told)?.to_array())
    }

    fn groups(&self) -> Vec<Group> {
        self.moves_as_one().into_iter().map(|robots| self.group(robots)).collect()
    }

    fn device_groups(&self) -> Vec<Group> {
        self.device_ranges().into_iter().map(|robots| self.group(robots)).collect()
    }

    fn part_device_groups(&mut self) -> bool {
        std::mem::take(&mut self.as_one)
    }

    fn answer(&self, group: Range<usize>, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        let (alone, own) = self.parted(self.robots_of(&group));
        let mut all = vec![Twist::default(); at.len()];
        for robot in alone {
            let bodies = self.bodies_of(robot, group.start);
            let steps = self.robots[robot].answer(&at[bodies.clone()], &systems[bodies.clone()])?;
            all[bodies].copy_from_slice(&steps);
        }
        for together in own {
            let steps = together.answer(&self.robots, &self.met(together, group.start, at, systems))?;
            for (&robot, steps) in together.robots.iter().zip(steps) {
                all[self.bodies_of(robot, group.start)].copy_from_slice(&steps);
            }
        }
        Some(all)
    }

    fn balance(&self, group: Range<usize>, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        let (alone, own) = self.parted(self.robots_of(&group));
        let of_one = |robot: usize| {
            let bodies = self.bodies_of(robot, group.start);
            self.robots[robot].balance(&at[bodies.clone()], &systems[bodies.clone()], &along[bodies])
        };
        let of_own = |together: &Together| {
            let bodies = together.robots.iter().map(|&robot| &along[self.bodies_of(robot, group.start)]);
            together.balance(&self.robots, &self.met(together, group.start, at, systems), &bodies.collect::<Vec<_>>())
        };
        alone.into_iter().map(of_one).sum::<f64>() + own.into_iter().map(of_own).sum::<f64>()
    }

    fn twice_energy(&self, group: Range<usize>, twists: &[Twist]) -> f64 {
        let of_one = |robot: usize| self.robots[robot].twice_energy(&twists[self.bodies_of(robot, group.start)]);
        self.robots_of(&group).map(of_one).sum()
    }

    fn feel(&mut self, bodies: Range<usize>, twists: &[Twist], reactions: &[Reaction], dt: f64) -> Result<()> {
        for number in self.robots_of(&bodies) {
            let own = self.bodies_of(number, bodies.start);
            let robot = &mut self.robots[number];
            robot.feel(&twists[own.clone()]);
            let wrenches = &mut self.wrenches[bodies.clone()][own.clone()];
            for (wrench, Reaction { impulse, deep_nodes, .. }) in wrenches.iter_mut().zip(&reactions[own]) {
                wrench.add_change(&Wrench::default(), impulse, 1.0 / dt);
                self.counts.deep_nodes += deep_nodes;
                if !wrench.force.iter().chain(&wrench.torque).all(|x| x.is_finite()) {
                    return Err(robot.lost("impulse from the ground"));
                }
            }
        }
        self.counts.unconverged += u64::from(reactions.iter().any(|reaction| !reaction.converged));
        Ok(())
    }

    fn after_step(&mut self, _: f64, _: f64) -> Result<()> {
        // A device has still to say what came of its step.
        if !self.is_on_device() {
            let felt = self.felt(|robot| robot.step.rates.clone());
            for (robot, felt) in self.robots.iter_mut().zip(felt) {
                robot.advance().ok_or_else(|| robot.lost("motion"))?;
                robot.sense_others(felt);
            }
            self.together.iter_mut().for_each(|own| own.follow(&self.robots));
        }
        self.slot = (self.slot + 1) % self.scene.levels.substeps();
        Ok(())
    }

    fn device_law(&self) -> Option<DeviceLaw> {
        let tools: Vec<&Obstacle> = self.tools.iter().collect();
        device::law(&self.robots, &self.contacts, &self.device_ranges(), &tools, self.scene.world.cell)
    }

    fn leashes(&self, time: f64, dt: f64, steps: usize) -> Option<Leashes> {
        let world = &self.scene.world;
        // What pushes tools must not change on the way.
        let end = time + steps as f64 * dt;
        let is_told = |robot: &Robot| {
            let order = |guided: Guided, at: f64| guided.order(at, DVec3::from_array(self.scene.gravity_at(at)));
            let keeps = |guided: Guided| [time, end].map(|at| Some(vec![order(guided, at)]) == robot.state.orders);
            robot.guided.is_none_or(|guided| keeps(guided) == [true; 2])
        };
        if !self.robots.iter().all(is_told) {
            return None;
        }
        if self.max_speed(time, dt) * dt > device::MOST_MOVE * world.cell {
            return None;
        }
        let of_robot = |(robot, &first): (&Robot, &usize)| -> Vec<Option<Roaming>> {
            let of_body = |(body, link): (usize, &usize)| {
                // Coarser levels keep away from bodies that levels follow.
                let widest = if self.followed[first + body] { world.cell } else { self.widest() };
                let shape = robot.model.links[*link].shape.as_ref()?;
                let moves = robot.floating || *link > 0;
                Some(Roaming::new(robot.bounds(body, world.cell), moves, shape, [world.cell, widest]))
            };
            robot.solids.iter().enumerate().map(of_body).collect()
        };
        let robots = self.robots.iter().zip(&self.firsts);
        let all: Vec<Vec<Option<Roaming>>> = robots.map(of_robot).collect();
        let images = Images::of(world);
        let unbound = || vec![Aabb::UNBOUND; self.wrenches.len()];
        let each = if self.as_one { unbound() } else { device::apart(&all, images, world.cell)? };
        // Steps that are taken at once end before one appears or vanishes.
        let tools: Vec<&Obstacle> = self.tools.iter().filter(|tool| tool.is_present(time)).collect();
        let off_walls = device::off_what_is_rigid(&self.robots, &tools, &all, &each, images, world.cell);
        let off_others = |each: Vec<Aabb>| match self.as_one {
            true => device::off_one_another(&self.robots, &all, &each, images, world.cell),
            false => Some(each),
        };
        if let Some(each) = off_walls.and_then(off_others) {
            return Some(Leashes { each, in_turns: false });
        }
        let fits = |robots: Range<usize>| device::has_room(&self.robots[robots], &tools, self.span(time, dt));
        self.device_ranges().into_iter().all(fits).then_some(Leashes { each, in_turns: true })
    }

    fn told(&self) -> Vec<Vec<[u32; 4]>> {
        if self.moved != Moved::InTurns {
            return Vec::new();
        }
        let of_group = |range: Range<usize>| {
            let robots = &self.robots[range];
            device::told(robots, &self.together)
        };
        self.device_ranges().into_iter().map(of_group).collect()
    }

    fn device_state(&self) -> Vec<GroupState> {
        let ranges = self.device_ranges();
        let points = device::most_points(&self.robots, &ranges, &self.tools.iter().collect::<Vec<_>>());
        let of_group = |robots: Range<usize>| {
            let mut all = GroupState::default();
            for GroupState { words, bodies } in self.robots[robots].iter().map(Robot::device_state) {
                all.words.extend(words);
                all.bodies.extend(bodies);
            }
            // What points gave.
            all.words.resize(all.words.len() + points, [0; 4]);
            all
        };
        ranges.into_iter().map(of_group).collect()
    }

    fn move_on_device(&mut self, moved: Moved) {
        self.moved = moved;
    }

    fn take_device_state(&mut self, groups: &[GroupStep]) -> Result<()> {
        let substeps = self.scene.levels.substeps();
        for (range, GroupStep { state, deep_nodes, unconverged }) in self.device_ranges().into_iter().zip(groups) {
            self.counts.deep_nodes += deep_nodes;
            self.counts.unconverged += unconverged;
            let robots = &mut self.robots[range];
            let (states, given) = device::parted(state, robots);
            // From where links were.
            let felt = device::felt(robots, &self.together, given);
            for ((robot, state), felt) in robots.iter_mut().zip(&states).zip(felt) {
                let dt = robot.step.dt * f64::from(substeps);
                robot.take_device_state(state, dt).ok_or_else(|| robot.lost("motion on the device"))?;
                robot.sense_others(felt);
            }
        }
        Ok(())
    }

    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrenches.copy_from_slice(wrenches);
    }

    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }

    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        let shapes: Vec<(&Sdf, Pose)> = self
            .all()
            .filter_map(|(robot, body)| Some((robot.model.links[robot.solids[body]].shape.as_ref()?, robot.pose(body))))
            .collect();
        sdf::distances(&shapes, points)
    }

    fn contact_distance(&self, body: usize, points: &[Vec3]) -> Vec<f64> {
        let (number, body) = self.of(body);
        let robot = &self.robots[number];
        match &robot.model.links[robot.solids[body]].shape {
            Some(shape) => sdf::contact_distances(shape, &robot.pose(body), self.scene.world.cell, points),
            None => vec![f64::INFINITY; points.len()],
        }
    }

    fn surfaces(&self) -> Vec<Surface> {
        self.robots.iter().flat_map(|robot| robot.model.surfaces(&robot.step.places)).collect()
    }

    fn has_body(&self, name: &str) -> bool {
        self.all().any(|(robot, body)| robot.body_name(body) == name)
    }

    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        let path = format!("robot '{body}'");
        if let &Command::Impulse { linear, angular } = command {
            // A robot's base has the robot's name.
            let body_of = |robot: &Robot| (0..robot.solids.len()).find(|i| robot.body_name(*i) == body);
            let hit = self.robots.iter_mut().find_map(|robot| body_of(robot).map(|i| (robot, i)));
            let Some((robot, i)) = hit else {
                return Err(Refusal::new("there is no such body", "push a robot, a link or a free tool").at(&path));
            };
            return robot.take_blow(i, linear, angular).map_err(|refusal| refusal.at(&robot.path()));
        }
        let of_robots = self.robots.iter().filter(|robot| !robot.is_tool);
        let names: Vec<String> = of_robots.map(|robot| robot.name.clone()).collect();
        match self.robots.iter_mut().find(|robot| robot.name == body) {
            Some(robot) => match command {
                Command::Place(placement) => robot.place(placement, &self.scene),
                _ => robot.act(command),
            }
            .map_err(|refusal| refusal.at(&robot.path())),
            None => {
                Err(Refusal::new("links take no commands", format!("give them to the robot: {}", names.join(", ")))
                    .at(&path))
            }
        }
    }

    fn files(&self) -> Vec<PathBuf> {
        let all = self.robots.iter().flat_map(|robot| &robot.model.files);
        all.map(|file| file.strip_prefix(&self.scene.folder).unwrap_or(file).to_owned()).collect()
    }

    fn warnings(&self, cell_width: f64) -> Vec<String> {
        let of_models = self
            .robots
            .iter()
            .flat_map(|robot| robot.model.warnings.iter().map(|w| format!("robot '{}': {w}", robot.name)));
        let mut warnings: Vec<String> = of_models.chain(self.overlaps()).collect();
        warnings.extend(self.robots.iter().filter_map(Robot::heavy_rotors));
        for robot in &self.robots {
            let ends =
                || robot.ends().filter_map(|body| Some((body, robot.model.links[robot.solids[body]].shape.as_ref()?)));
            if robot.is_tool {
                warnings.extend(ends().filter_map(|(_, shape)| thin(&robot.name, shape, cell_width, true)));
                continue;
            }
            let halves = ends().map(|(body, shape)| (robot.body_name(body), shape.half_thickness()));
            let thin_links = named_together(halves.filter(|(_, half)| *half < 2.0 * cell_width));
            warnings.extend(thin_links.into_iter().map(|(names, several, half)| {
                let (links, are, them) = if several { ("links", "are", "them") } else { ("link", "is", "it") };
                format!(
                    "{links} {names} {are} {:.1} cells thick: forces of the ground on {them} may be a third off; for forces within a fifth use world.cell <= {:.3} mm",
                    2.0 * half / cell_width,
                    1e3 * half / 3.0,
                )
            }));
            let thick = ends().filter(|(_, shape)| shape.half_thickness() >= 2.0 * cell_width);
            let faces =
                thick.filter_map(|(body, shape)| Some((robot.body_name(body), shape.rounded_face(cell_width)?)));
            warnings.extend(named_together(faces).into_iter().map(|(names, several, width)| {
                let (links, have) = if several { ("links", "have") } else { ("link", "has") };
                format!("{links} {names} {have} {}", rounded(width, cell_width))
            }));
        }
        warnings
    }

    fn counts(&self) -> Vec<(String, u64)> {
        vec![
            ("nodes deeper than two cells inside a link".into(), self.counts.deep_nodes),
            ("contact solutions of robots not converged".into(), self.counts.unconverged),
            ("rates of robots without soft ground not found".into(), self.counts.unsettled),
        ]
    }

    fn save(&self) -> Vec<u8> {
        let states: Vec<&State> = self.robots.iter().map(|robot| &robot.state).collect();
        let wrenches: Vec<_> = self.wrenches.iter().map(|w| (w.force, w.torque)).collect();
        postcard::to_stdvec(&(states, wrenches, self.counts)).expect("writing to memory does not fail")
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        type Saved = (Vec<State>, Vec<(Vec3, Vec3)>, Counts);
        let (states, wrenches, counts): Saved =
            postcard::from_bytes(bytes).map_err(|e| format!("the robots' state cannot be read: {e}"))?;
        if states.len() != self.robots.len() || wrenches.len() != self.wrenches.len() {
            return Err(format!("it holds {} robots, and the scene has {}", states.len(), self.robots.len()));
        }
        let mut steps = Vec::new();
        for (robot, state) in self.robots.iter().zip(&states) {
            let finite = state.base.position.is_finite()
                && (state.base.rotation.length() - 1.0).abs() < 1e-6
                && state.positions.iter().chain(&state.rates).all(|x| x.is_finite());
            let fits = state.positions.len() == robot.model.drives.len()
                && state.rates.len() == robot.state.rates.len()
                && state.orders.as_ref().is_none_or(|orders| orders.len() == robot.model.drives.len());
            let step = (finite && fits)
                .then(|| {
                    Robot::at_rest(&robot.model, robot.floating, &robot.solids, state, robot.path.orders(0.0, 0.0))
                })
                .flatten();
            steps.push(step.ok_or_else(|| format!("the state of {} is not this one's, or not finite", robot.path()))?);
        }
        for ((robot, state), step) in self.robots.iter_mut().zip(states).zip(steps) {
            (robot.state, robot.step) = (state, step);
            robot.correct_held().ok_or_else(|| format!("the state of {} has no motion", robot.path()))?;
        }
        self.wrenches = wrenches.into_iter().map(|(force, torque)| Wrench { force, torque }).collect();
        self.counts = counts;
        // What is saved is between two steps.
        self.slot = 0;
        self.together.clear();
        Ok(())
    }
}
