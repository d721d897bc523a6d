//! The coupling "rigid": a scene's tools and free bodies.

mod adjoint;
pub(crate) mod body;

use crate::grip::{self, REACH};
use crate::motion::Pose;
use crate::sdf::{self, ROUND, Sdf};
use crate::surface::{mesh_of, placed, planes_of};
use crate::tables::{Listed, Tables, row, rows};
use crate::world::{RigidWorld, Role};
use crate::{Refusal, always_there, is_within_reach};
use adjoint::Turn;
use barchan_core::contact::adjoint::{BodyInStep, GripCotangent, NearCotangents};
use barchan_core::contact::{Reaction, System, Touch, Twist};
use barchan_core::coupling::{
    Aabb, BodiesOwed, BodiesTold, DeviceAnswer, DeviceBody, DeviceGroup, DeviceLaw, Group, GroupState, GroupStep, Kept,
    Leashes, Moved, Placed,
};
use barchan_core::gradient::BodyCotangents;
use barchan_core::plan::TOOL_COUPLING;
use barchan_core::scene::{INSTANT, Motion};
use barchan_core::{BodyState, Command, Coupling, Error, NodeBatch, Result, Scene, Surface, Vec3, Wrench};
use body::{Body, Guided, Mover, State, vector, vector6};
use glam::{DQuat, DVec3};
use rapier3d_f64::prelude::PhysicsWorld;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;

/// Forces on tools thinner than this are off by a third [cells]: the stirrer of `letters` on cells of 14, 7 and 3.5 mm, 3.1, 6.3 and 12.6 of them across, 48.7, 42.4 and
/// 36.4 N s.
const ROUGH_THICKNESS: f64 = 4.0;
/// A device moves free bodies as long as their surfaces move by at most this much in a step [cells], and what they act on keeps as far from what
/// others act on, and a cell further from walls, as two of them can come nearer; rapier looks ahead a little further, by less than this
/// share of the smallest one's extent.
const MOST_MOVE: f64 = 0.5;
const CLEARANCE: f64 = 2.0 * MOST_MOVE;
const LOOK_AHEAD: f64 = 0.01;
/// Words of a body's state on a device: velocity and angular momentum; see `free.wgsl`.
const FREE_WORDS: usize = 2;

/// The coupling "rigid". A body's reference point is its centre of mass if it is free, and its frame's origin if it is driven.
pub struct Rigid {
    name: String,
    bodies: Vec<Body>,
    wrenches: Vec<Wrench>,
    scene: Scene,
    world_box: Aabb,
    /// Only with a free body.
    world: Option<RigidWorld>,
    counts: Counts,
    /// Who moves the free bodies.
    moved: Moved,
    /// The step under way [s].
    dt: f64,
}

/// What steps change, as it was.
struct Before {
    states: Vec<State>,
    wrenches: Vec<Wrench>,
    counts: Counts,
    physics: Option<Arc<PhysicsWorld>>,
}

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct Counts {
    deep_nodes: u64,
    unconverged: u64,
}

impl Rigid {
    fn take_up(&mut self, states: Vec<State>, wrenches: Vec<Wrench>, counts: Counts) {
        for (body, state) in self.bodies.iter_mut().zip(states) {
            body.state = state;
            body.target = state.pose;
        }
        (self.wrenches, self.counts) = (wrenches, counts);
    }

    /// The tools of `scene`, as the coupling 'rigid', but for those that [go with its robots](Scene::goes_with_robots).
    ///
    /// # Errors
    /// [`Error::Body`] if a tool's shape, mesh, mass, contact or motion cannot be used, naming its key path.
    pub fn new(scene: &Scene) -> Result<Self> {
        let mut bodies: Vec<Body> = Vec::new();
        for (i, tool) in scene.tools_apart() {
            let path = format!("tool[{i}]");
            if bodies.iter().any(|body| body.name == tool.name) {
                let refusal = Refusal::new(format!("two tools are called '{}'", tool.name), "rename one of them");
                return Err(refusal.at(&format!("{path}.name")));
            }
            bodies.push(Body::new(tool, scene, &path)?);
        }
        let own = Scene { tool: scene.tools_apart().map(|(_, tool)| tool.clone()).collect(), ..scene.clone() };
        let world_box = Aabb { min: scene.world.min, max: scene.world.max };
        let mut rigid = Self {
            name: TOOL_COUPLING.to_owned(),
            wrenches: vec![Wrench::default(); bodies.len()],
            scene: own,
            // Particles outside the world do not live long enough to reach further nodes than these.
            world_box: world_box.grown(4.0 * scene.world.cell),
            world: None,
            counts: Counts::default(),
            moved: Moved::ByCoupling,
            dt: 0.0,
            bodies,
        };
        rigid.world = rigid.rigid_world();
        Ok(rigid)
    }

    /// The same under another name.
    #[must_use]
    pub fn called(self, name: &str) -> Self {
        Self { name: name.to_owned(), ..self }
    }

    fn rigid_world(&self) -> Option<RigidWorld> {
        // A free tool is here only where it is the only one.
        let ([body], [tool]) = (&self.bodies[..], &self.scene.tool[..]) else { return None };
        let (&Mover::Free { mass, inertia, .. }, &Motion::Free { restitution, .. }) = (&body.mover, &tool.motion)
        else {
            return None;
        };
        let mut world = RigidWorld::new(&self.scene.world, body.extent);
        world.add(&body.shape, &body.state.pose, body.contact, Role::Free { mass, inertia, restitution });
        Some(world)
    }

    /// What `grip.wgsl`, `sampled.wgsl` and `free.wgsl` read; `None` if there are too many samples to number.
    fn device_tables(&self) -> Option<Tables> {
        let behind = |body: &Body| match &body.mover {
            Mover::Free { mass, inertia, inverse_inertia } => {
                let [x, y, z] = rows(inertia);
                let mut all = vec![[x[0], x[1], x[2], *mass as f32], y, z];
                all.extend(rows(inverse_inertia));
                all
            }
            Mover::Servo(Guided { servo, axis, mass }) => {
                vec![row(*axis, *mass), row(DVec3::new(servo.whole() / mass, servo.damping / mass, 0.0), 0.0)]
            }
            _ => Vec::new(),
        };
        let parts = self.bodies.iter().map(|body| (body.shape.parts(), body.contact, behind(body)));
        let listed: Vec<_> = parts.map(|(parts, contact, behind)| Listed { parts, contact, behind }).collect();
        Tables::of(&listed)
    }

    /// Greatest speed of a body's surface during a step [m/s].
    fn fastest(&self, body: &Body, time: f64, dt: f64) -> f64 {
        let world_size = (DVec3::from_array(self.world_box.max) - DVec3::from_array(self.world_box.min)).length();
        let speed = |twist: &Twist| {
            let turning = twist.angular.length();
            // A plane has no extent of its own; only what lies in the world matters.
            twist.linear.length() + if turning > 0.0 { turning * body.extent.min(world_size) } else { 0.0 }
        };
        let gravity = DVec3::from_array(self.scene.gravity).length();
        match &body.mover {
            _ if !body.state.present => 0.0,
            Mover::Fixed => 0.0,
            Mover::Velocity => speed(&body.state.command),
            Mover::Free { .. } => speed(&body.state.twist) + gravity * dt,
            Mover::Servo(Guided { servo, mass, .. }) => speed(&body.state.twist) + servo.whole().abs() / mass * dt,
            Mover::Path(path) => {
                let (linear, angular) = path.fastest(time, time + dt);
                speed(&Twist { linear, angular })
            }
        }
    }

    /// The width of the widest cells that a body meets [m]: one that levels follow meets the finest alone, and they follow none that is fixed unless the scene says so.
    fn widest(&self, body: &Body) -> f64 {
        let (cell, levels) = (self.scene.world.cell, &self.scene.levels);
        if levels.surround(&body.name).unwrap_or_else(|| body.moves()) {
            cell
        } else {
            cell * f64::from(1 << (levels.count - 1))
        }
    }

    /// How far beyond its box a body acts [cells of the widest that it meets]: coarser cells thicken it more than its box says.
    fn reach_of(&self, body: &Body) -> f64 {
        let widest = self.widest(body);
        REACH + (body.shape.padding(widest) - body.shape.padding(self.scene.world.cell)) / widest
    }

    /// Does a device tell which body a node is, of several that reach it? Where levels take steps of their own it has no way to.
    fn shares_nodes(&self) -> bool {
        self.scene.levels.substeps() == 1
    }

    /// How far along each axis a body that answers may go, as long as the others move for up to `duration` [s], before it comes too near to one of
    /// them or to a wall; `None` if it is there.
    fn leash(&self, of: usize, boxes: &[Aabb], time: f64, duration: f64) -> Option<Aabb> {
        let world = &self.scene.world;
        let shares = self.shares_nodes();
        // In a guide it passes through the others.
        if shares && !self.bodies[of].is_free() {
            return Some(Aabb::UNBOUND);
        }
        let free = self.bodies.iter().filter(|body| body.answering().is_some());
        let size = free.map(|body| body.extent).fold(f64::INFINITY, f64::min);
        let clearance = CLEARANCE * world.cell + LOOK_AHEAD * size;
        let reach = |body: &Body| if shares { 0.0 } else { self.reach_of(body) * self.widest(body) };
        let own_reach = reach(&self.bodies[of]);
        // Nodes behind walls move as their images before them, which may be two layers of nodes. Where steps are levels' own those are not to be a body's.
        let off_walls = if shares { clearance } else { clearance + world.cell + own_reach };
        let mut leash = Aabb::UNBOUND;
        let own = &boxes[of];
        for axis in 0..3 {
            let gaps = [own.min[axis] - world.min[axis], world.max[axis] - own.max[axis]];
            for (wall, (gap, upwards)) in world.walls.pair(axis).into_iter().zip(gaps.into_iter().zip([false, true])) {
                if !wall.is_wall() {
                    continue;
                }
                if gap.is_nan() || gap <= off_walls {
                    return None;
                }
                let end = if upwards { &mut leash.max[axis] } else { &mut leash.min[axis] };
                *end = if upwards { gap - off_walls } else { off_walls - gap };
            }
        }
        for (other, near) in self.bodies.iter().zip(boxes).enumerate().filter(|(i, _)| *i != of).map(|(_, pair)| pair) {
            // Where both act, one would have to wait for the other.
            let clearance = clearance + 2.0 * own_reach.min(reach(other));
            let off = own.leash(near, clearance, |spare| {
                if other.answering().is_some() {
                    0.5 * spare
                } else {
                    spare - duration * self.fastest(other, time, duration)
                }
            })?;
            leash = leash.intersection(&off);
        }
        Some(leash)
    }

    /// A body's part of [`advance_back`](Coupling::advance_back).
    fn advance_body_back(&mut self, body: usize, dt: f64, owed: &mut BodyCotangents) -> Result<Twist> {
        let before = self.bodies[body].state;
        let mut turn = Turn::default();
        if let (true, Some(world)) = (self.bodies[body].is_free(), &self.world) {
            turn = Turn::of(self.bodies[body].midway_spin(dt), dt, world.substeps());
            self.move_free_body(dt)?;
            let after = std::mem::replace(&mut self.bodies[body].state, before);
            let Twist { linear, .. } = before.twist;
            let place = before.pose.position + dt * linear;
            let off = (after.pose.position - place).length() + (after.twist.linear - linear).length() * dt;
            let turned = (after.pose.rotation * turn.after(before.pose.rotation).conjugate()).xyz().length();
            if off > 1e-9 * (self.scene.world.cell + dt * linear.length()) || turned > 1e-9 {
                let what = "gradients: a wall of the world has pushed it, and they do not go through that";
                let refusal = Refusal::new(what, "record a shorter time, or make the world larger");
                return Err(refusal.at(&format!("tool '{}'", self.bodies[body].name)));
            }
        }
        Ok(self.bodies[body].advance_back(dt, &turn, owed))
    }

    /// Lets rapier move the free body, if there is one, with the velocities that gravity and ground gave it.
    fn move_free_body(&mut self, dt: f64) -> Result<()> {
        let (Some(world), [body]) = (&mut self.world, &mut self.bodies[..]) else {
            return Ok(());
        };
        let Some(free) = body.answering() else {
            return Ok(());
        };
        // A backend may have moved it since.
        world.place(0, &body.state.pose);
        world.show(0, body.state.present);
        world.throw(0, &Twist { linear: body.state.twist.linear, angular: body.midway_spin(dt) });
        world.step(dt).map_err(|what| Error::Body {
            path: format!("coupling '{}'", self.name),
            what: format!("the solver of contacts among rigid bodies failed: {what}"),
            mend: "lower time.step, or start from another snapshot".into(),
        })?;
        let (pose, twist) = world.state(0);
        // Without contact the velocities come back as they went in, and the angular momentum stays to the last bit.
        body.state.angular_momentum += free.inertia * (twist.angular - body.midway_spin(dt));
        body.state.twist = Twist { linear: twist.linear, angular: body.spin(&pose) };
        body.state.pose = pose;
        if !(pose.position.is_finite() && pose.rotation.is_finite() && body.state.twist.is_finite()) {
            return Err(body.lost("motion"));
        }
        Ok(())
    }
}

/// What is to be said of a tool that is thin for cells of that width [m], or whose faces are narrow, if it `moves`.
pub(crate) fn thin(name: &str, shape: &Sdf, cell_width: f64, moves: bool) -> Option<String> {
    let thickness = 2.0 * shape.half_thickness();
    if thickness < 2.0 * cell_width {
        return Some(format!(
            "tool '{name}' is {:.3} mm thick, {:.2} cells: the ground meets it as if it were two cells thick, and what lies within them moves along with it; use world.cell <= {:.3} mm or a thicker tool",
            1e3 * thickness,
            thickness / cell_width,
            0.5e3 * thickness,
        ));
    }
    if thickness < ROUGH_THICKNESS * cell_width {
        return Some(format!(
            "tool '{name}' is only {:.1} cells thick: forces on it may be a third off (a rod of three cells felt 1.3 times the force on one of twelve, of six 1.2 times); for forces within a fifth use world.cell <= {:.3} mm",
            thickness / cell_width,
            1e3 * thickness / 6.0,
        ));
    }
    // What stays presses on nothing by itself.
    shape
        .rounded_face(cell_width)
        .filter(|_| moves)
        .map(|width| format!("tool '{name}' has {}", rounded(width, cell_width)))
}

/// What is to be said of faces so many cells wide, whose edges contact rounds: a cube of 16 cm that was pressed 2 cm into sand felt 0.31, 0.62, 0.75 and 0.82 of the force on
/// one with sharp edges on cells of 4, 2, 1⅓ and 1 cm, so that three over its width in cells were missing.
pub(crate) fn rounded(width: f64, cell_width: f64) -> String {
    format!(
        "faces {width:.1} cells wide, and contact rounds edges to {ROUND} cells: {:.0} % of the force on a face may be missing while it is less than {ROUND} cells deep in the ground; for a tenth use world.cell <= {:.3} mm, or a mesh of the same shape, which keeps its edges",
        100.0 * (2.0 * ROUND / width).min(0.75),
        1e3 * width * cell_width / (20.0 * ROUND),
    )
}

impl Coupling for Rigid {
    fn name(&self) -> &str {
        &self.name
    }

    fn bodies(&self) -> Vec<BodyState> {
        let gravity = DVec3::from_array(self.scene.gravity);
        self.bodies.iter().map(|body| body.report(gravity)).collect()
    }

    fn has_body(&self, name: &str) -> bool {
        self.bodies.iter().any(|body| body.name == name)
    }

    fn followed(&self) -> Vec<String> {
        let moving = self.bodies.iter().filter(|body| body.moves());
        moving.map(|body| body.name.clone()).collect()
    }

    fn max_speed(&self, time: f64, dt: f64) -> f64 {
        self.bodies.iter().map(|body| self.fastest(body, time, dt)).fold(0.0, f64::max)
    }

    fn before_step(&mut self, time: f64, dt: f64) -> Result<()> {
        self.wrenches.fill(Wrench::default());
        self.dt = dt;
        let gravity = DVec3::from_array(self.scene.gravity_at(time));
        for body in &mut self.bodies {
            body.from = body.state.pose;
            match body.driven_pose(time, dt) {
                Some(target) => {
                    body.state.twist = body.state.pose.chord(&target, dt);
                    body.target = target;
                }
                None if self.moved != Moved::ByCoupling => {}
                None => body.accelerate(gravity, time, dt),
            }
            if !body.state.twist.is_finite() {
                return Err(body.lost("velocity"));
            }
        }
        Ok(())
    }

    fn extents(&self) -> Vec<Aabb> {
        // Only an infinite side is clipped: a body may have business beyond open sides.
        let of = |body: &Body| body.shape.bounds(&body.state.pose, self.scene.world.cell).ended_by(&self.world_box);
        self.bodies.iter().map(of).collect()
    }

    fn bounds(&self) -> Vec<Aabb> {
        let of = |(body, extent): (&Body, Aabb)| if body.state.present { extent } else { Aabb::NOTHING };
        self.bodies.iter().zip(self.extents()).map(of).collect()
    }

    fn next_change(&self, time: f64) -> f64 {
        let times = self.scene.tool.iter().flat_map(|tool| [Some(tool.from), tool.until]).flatten();
        times.filter(|at| *at > time + INSTANT).fold(f64::INFINITY, f64::min)
    }

    fn change(&mut self, time: f64, places: &mut dyn FnMut(&Aabb) -> Result<Vec<Vec3>>) -> Result<bool> {
        let wanted: Vec<bool> = self.scene.tool.iter().map(|tool| tool.is_present(time)).collect();
        let extents = self.extents();
        for ((body, extent), wanted) in self.bodies.iter().zip(&extents).zip(&wanted) {
            if body.state.present || !wanted {
                continue;
            }
            let buried = sdf::distances(&[(&body.shape, body.state.pose)], &places(extent)?);
            let count = buried.into_iter().filter(|distance| *distance < 0.0).count();
            if count > 0 {
                let what = format!("it would appear at {time:.6} s where there are {count} particles of the ground");
                return Err(Refusal::new(what, "let it appear elsewhere or at another time (from)")
                    .at(&format!("tool '{}'", body.name)));
            }
        }
        let mut changed = false;
        for (body, wanted) in self.bodies.iter_mut().zip(wanted) {
            changed |= body.state.present != wanted;
            body.state.present = wanted;
        }
        Ok(changed)
    }

    fn reach(&self) -> f64 {
        self.bodies.iter().map(|body| self.reach_of(body)).fold(0.0, f64::max)
    }

    fn touch(&mut self, body: usize, dt: f64, nodes: &NodeBatch, touches: &mut Vec<Touch>) {
        let body = &self.bodies[body];
        if !body.state.present {
            return;
        }
        grip::touch(&body.shape, body.contact, &body.state.pose, nodes, dt, touches);
    }

    fn twin(&self) -> Result<Box<dyn Coupling>> {
        always_there(&self.scene)?;
        let mut twin = Self {
            name: self.name.clone(),
            bodies: self.bodies.clone(),
            wrenches: self.wrenches.clone(),
            scene: self.scene.clone(),
            world_box: self.world_box,
            world: None,
            counts: self.counts,
            moved: Moved::ByCoupling,
            dt: self.dt,
        };
        twin.world = twin.rigid_world();
        Ok(Box::new(twin))
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
        let body = &self.bodies[body];
        grip::touch_back(&body.shape, &body.state.pose, nodes, dt, touches, near, owed);
        Ok(())
    }

    fn advance_back(&mut self, dt: f64, owed: &mut BodiesOwed<'_>) -> Result<Vec<Twist>> {
        (0..self.bodies.len()).map(|body| self.advance_body_back(body, dt, &mut owed.bodies[body])).collect()
    }

    fn begin_back(
        &self,
        time: f64,
        dt: f64,
        step: &[BodyInStep],
        owed: &mut BodiesOwed<'_>,
        told: &mut BodiesTold<'_>,
    ) -> Result<Vec3> {
        let mut of_gravity = DVec3::ZERO;
        let all = self.bodies.iter().zip(&self.wrenches).zip(step).zip(&mut *owed.bodies).zip(&mut *told.bodies);
        for ((((body, felt), step), owed), told) in all {
            of_gravity += body.begin_back([time, dt], step, felt, owed, told);
        }
        Ok(of_gravity.to_array())
    }

    fn twist(&self, body: usize) -> Twist {
        self.bodies[body].state.twist
    }

    fn groups(&self) -> Vec<Group> {
        let free = self.bodies.iter().enumerate().filter_map(|(i, body)| body.answering().map(|one| (i, one)));
        free.map(|(i, one)| Group { bodies: i..i + 1, mass: one.mass }).collect()
    }

    fn stays(&self, body: usize) -> bool {
        self.bodies[body].is_fixed()
    }

    fn answer(&self, group: Range<usize>, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        let answer = |((body, at), system): ((&Body, &Twist), &System)| {
            let free = body.answering()?;
            free.answer(&free.residual(&body.state.twist, at, system), system)
        };
        self.bodies[group].iter().zip(at).zip(systems).map(answer).collect()
    }

    fn balance(&self, group: Range<usize>, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        let of_body = |(((body, at), system), along): (((&Body, &Twist), &System), &Twist)| {
            let residual = body.answering().map(|one| one.residual(&body.state.twist, at, system));
            residual.map_or(0.0, |residual| vector6(along.linear, along.angular).dot(&residual))
        };
        self.bodies[group].iter().zip(at).zip(systems).zip(along).map(of_body).sum()
    }

    fn twice_energy(&self, group: Range<usize>, twists: &[Twist]) -> f64 {
        let of_body = |(body, twist): (&Body, &Twist)| body.answering().map_or(0.0, |one| one.twice_energy(twist));
        self.bodies[group].iter().zip(twists).map(of_body).sum()
    }

    fn feel(&mut self, bodies: Range<usize>, _: &[Twist], reactions: &[Reaction], dt: f64) -> Result<()> {
        for (i, Reaction { impulse, deep_nodes, converged }) in bodies.zip(reactions) {
            let (body, wrench) = (&mut self.bodies[i], &mut self.wrenches[i]);
            self.counts.deep_nodes += deep_nodes;
            self.counts.unconverged += u64::from(!converged);
            body.gain([impulse.force, impulse.torque].map(DVec3::from_array));
            for d in 0..3 {
                wrench.force[d] += impulse.force[d] / dt;
                wrench.torque[d] += impulse.torque[d] / dt;
            }
            if !wrench.force.iter().chain(&wrench.torque).all(|x| x.is_finite()) {
                return Err(body.lost("impulse from the ground"));
            }
        }
        Ok(())
    }

    fn device_law(&self) -> Option<DeviceLaw> {
        // Contact thickens a thin body by a cell at most, and acts on nodes further off.
        let further = (1.0 + REACH) * self.scene.world.cell;
        let body =
            |body: &Body| DeviceBody { extent: body.extent, swing: body.shape.swing(), reach: body.extent + further };
        let answering = self.bodies.iter().filter(|body| body.answering().is_some());
        // A device has room for the nodes that such a body can be near to, and a plane is near to them all.
        if answering.clone().any(|body| body.extent.is_infinite()) {
            return None;
        }
        let group = |one| DeviceGroup { words: FREE_WORDS, told: 0, rates: 0, bodies: vec![body(one)] };
        let groups: Vec<_> = answering.map(group).collect();
        let is_guided = self.bodies.iter().any(|body| matches!(body.mover, Mover::Servo(_)));
        let tables = self.device_tables()?;
        let wgsl = tables.wgsl();
        let Tables { table, samples } = tables;
        let answer = match groups.len() {
            0 => "",
            _ if is_guided => include_str!("servo.wgsl"),
            _ => include_str!("free.wgsl"),
        };
        let answer = DeviceAnswer { wgsl: answer.to_owned(), groups };
        Some(DeviceLaw { counted: true, wgsl, reach: REACH, table, samples, answer })
    }

    fn leashes(&self, time: f64, dt: f64, steps: usize) -> Option<Leashes> {
        let (boxes, duration) = (self.bounds(), dt * steps as f64);
        let free = self.bodies.iter().enumerate().filter(|(_, body)| body.answering().is_some());
        let mut in_turns = false;
        let leash = |(i, body): (usize, &Body)| {
            // A device knows only the whole force.
            if matches!(body.mover, Mover::Servo(Guided { servo, .. }) if time < servo.ramp) {
                return None;
            }
            let moves = self.fastest(body, time, dt) * dt / self.scene.world.cell;
            if moves > MOST_MOVE {
                return None;
            }
            let leash = self.leash(i, &boxes, time, duration);
            in_turns |= leash.is_none();
            leash.or_else(|| self.shares_nodes().then_some(Aabb::UNBOUND))
        };
        let each = free.map(leash).collect::<Option<_>>()?;
        Some(Leashes { each, in_turns })
    }

    fn device_state(&self) -> Vec<GroupState> {
        let word = |v: DVec3| [(v.x as f32).to_bits(), (v.y as f32).to_bits(), (v.z as f32).to_bits(), 0];
        let free = self.bodies.iter().filter(|body| body.answering().is_some());
        let state = |body: &Body| {
            let State { pose, twist, angular_momentum, .. } = body.state;
            let words = vec![word(twist.linear), word(angular_momentum)];
            let placed = Placed { position: pose.position.to_array(), rotation: pose.quaternion() };
            GroupState { words, bodies: vec![placed] }
        };
        free.map(state).collect()
    }

    fn move_on_device(&mut self, moved: Moved) {
        self.moved = moved;
    }

    fn take_device_state(&mut self, groups: &[GroupStep]) -> Result<()> {
        let vector = |word: [u32; 4]| DVec3::from_array([0, 1, 2].map(|d| f64::from(f32::from_bits(word[d]))));
        let free = self.bodies.iter_mut().filter(|body| body.answering().is_some());
        for (body, GroupStep { state, deep_nodes, unconverged }) in free.zip(groups) {
            let ([velocity, momentum], [placed]) = (&state.words[..], &state.bodies[..]) else {
                return Err(body.lost("state on the device"));
            };
            if self.moved == Moved::ByDevice {
                let [w, x, y, z] = placed.rotation;
                body.state.pose =
                    Pose { position: DVec3::from_array(placed.position), rotation: DQuat::from_xyzw(x, y, z, w) };
            }
            body.state.angular_momentum = vector(*momentum);
            body.state.twist.linear = vector(*velocity);
            body.state.twist.angular = body.spin(&body.state.pose);
            body.target = body.state.pose;
            if !body.state.is_sound() {
                return Err(body.lost("motion"));
            }
            self.counts.deep_nodes += deep_nodes;
            self.counts.unconverged += unconverged;
        }
        if self.moved == Moved::InTurns { self.move_free_body(self.dt) } else { Ok(()) }
    }

    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrenches.copy_from_slice(wrenches);
    }

    fn after_step(&mut self, _time: f64, dt: f64) -> Result<()> {
        if self.moved == Moved::ByCoupling {
            for body in self.bodies.iter_mut().filter(|body| matches!(body.mover, Mover::Servo(_))) {
                body.target = body.state.pose.advanced(&body.state.twist, dt);
            }
            self.move_free_body(dt)?;
        }
        for body in self.bodies.iter_mut().filter(|body| !body.is_free()) {
            body.state.pose = body.target;
        }
        Ok(())
    }

    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }

    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        let present = self.bodies.iter().filter(|body| body.state.present);
        let shapes: Vec<_> = present.map(|body| (&body.shape, body.state.pose)).collect();
        sdf::distances(&shapes, points)
    }

    fn contact_distance(&self, body: usize, points: &[Vec3]) -> Vec<f64> {
        let Body { shape, state, .. } = &self.bodies[body];
        if !state.present {
            return vec![f64::INFINITY; points.len()];
        }
        sdf::contact_distances(shape, &state.pose, self.scene.world.cell, points)
    }

    fn surfaces(&self) -> Vec<Surface> {
        let of_body = |body: &Body| {
            let mesh = body.mesh.get_or_init(|| mesh_of(&body.shape));
            let pose = &body.state.pose;
            [Some(placed(mesh, pose, None)), planes_of(&body.shape, pose, &self.world_box)]
        };
        self.bodies.iter().filter(|body| body.state.present).flat_map(of_body).flatten().collect()
    }

    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        let path = format!("tool '{body}'");
        let names: Vec<&str> = self.bodies.iter().map(|body| body.name.as_str()).collect();
        let Some(i) = names.iter().position(|name| *name == body) else {
            return Err(Refusal::new("there is no such tool", format!("known are: {}", names.join(", "))).at(&path));
        };
        let body = &mut self.bodies[i];
        if let &Command::Impulse { linear, angular } = command {
            let blow = vector(linear, "the impulse")
                .and_then(|linear| Ok([linear, vector(angular, "the angular impulse")?]))
                .map_err(|refusal| refusal.at(&path))?;
            let before = (body.state.twist, body.state.angular_momentum);
            body.gain(blow);
            if blow != [DVec3::ZERO; 2] && before == (body.state.twist, body.state.angular_momentum) {
                let what = "it moves as it is told or guided, whatever pushes it that way";
                return Err(Refusal::new(what, "give it a motion = { free = {} }").at(&path));
            }
            return Ok(());
        }
        if let Command::Place(placement) = command {
            let before = body.state;
            body.place(placement).map_err(|refusal| refusal.at(&path))?;
            if !is_within_reach(&body.shape.bounds(&body.state.pose, 0.0), &self.scene) {
                body.state = before;
                return Err(Refusal::outside(&self.scene.world).at(&path));
            }
            return Ok(());
        }
        let &Command::Twist { linear, angular } = command else {
            let what = format!("it has no joints, and {} are asked for", command.name());
            return Err(Refusal::new(what, "give it a twist").at(&path));
        };
        if !matches!(body.mover, Mover::Velocity) {
            return Err(Refusal::new("it is not driven by velocity", "give it a motion = { velocity = {} }").at(&path));
        }
        let twist = vector(linear, "the velocity asked for")
            .and_then(|linear| Ok(Twist { linear, angular: vector(angular, "the angular velocity asked for")? }));
        body.state.command = twist.map_err(|refusal| refusal.at(&path))?;
        Ok(())
    }

    fn warnings(&self, cell_width: f64) -> Vec<String> {
        let mut warnings = Vec::new();
        for body in &self.bodies {
            warnings.extend(thin(&body.name, &body.shape, cell_width, body.moves()));
            if body.ignored_position {
                warnings
                    .push(format!("tool '{}': its position is ignored, since keyframes say where it is", body.name));
            }
        }
        warnings
    }

    fn counts(&self) -> Vec<(String, u64)> {
        vec![
            ("nodes deeper than two cells inside a rigid body".into(), self.counts.deep_nodes),
            ("contact solutions of free bodies not converged".into(), self.counts.unconverged),
        ]
    }

    fn save(&self) -> Vec<u8> {
        let states: Vec<&State> = self.bodies.iter().map(|body| &body.state).collect();
        let wrenches: Vec<_> = self.wrenches.iter().map(|w| (w.force, w.torque)).collect();
        // While a device moves bodies, rapier's world does not change.
        let physics = self.world.as_ref().filter(|_| self.moved == Moved::ByCoupling).map(RigidWorld::physics);
        postcard::to_stdvec(&(states, wrenches, self.counts, physics)).expect("writing to memory does not fail")
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        type Saved = (Vec<State>, Vec<(Vec3, Vec3)>, Counts, Option<PhysicsWorld>);
        let (states, wrenches, counts, physics): Saved =
            postcard::from_bytes(bytes).map_err(|e| format!("the rigid bodies' state cannot be read: {e}"))?;
        if states.len() != self.bodies.len()
            || wrenches.len() != states.len()
            || physics.is_some() != (self.world.is_some() && self.moved == Moved::ByCoupling)
        {
            return Err(format!("it holds {} rigid bodies, and the scene {}", states.len(), self.bodies.len()));
        }
        if !wrenches.iter().flat_map(|(force, torque)| force.iter().chain(torque)).all(|x| x.is_finite()) {
            return Err("a wrench is not finite".to_owned());
        }
        for (body, state) in self.bodies.iter().zip(&states) {
            if !state.is_sound() {
                return Err(format!(
                    "the state of tool '{}' is not finite, or its rotation not of length 1",
                    body.name
                ));
            }
        }
        let wrenches = wrenches.into_iter().map(|(force, torque)| Wrench { force, torque }).collect();
        if let (Some(world), Some(physics)) = (&mut self.world, physics) {
            world.restore(physics)?;
        }
        self.take_up(states, wrenches, counts);
        Ok(())
    }

    /// Shapes, of which meshes and height fields have many triangles, are shared and not copied.
    fn keep(&self) -> Kept {
        Box::new(Before {
            states: self.bodies.iter().map(|body| body.state).collect(),
            wrenches: self.wrenches.clone(),
            counts: self.counts,
            physics: self.world.as_ref().filter(|_| self.moved == Moved::ByCoupling).map(RigidWorld::keep),
        })
    }

    fn go_back(&mut self, kept: Kept) -> Result<(), String> {
        let before = kept.downcast::<Before>().map_err(|_| "it is not what rigid bodies keep".to_owned())?;
        let Before { states, wrenches, counts, physics } = *before;
        if let (Some(world), Some(physics)) = (&mut self.world, physics) {
            world.go_back(physics);
        }
        self.take_up(states, wrenches, counts);
        Ok(())
    }
}
