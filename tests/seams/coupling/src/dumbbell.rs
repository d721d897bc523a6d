//! Two balls at the ends of a light rod, thrown into the ground: bodies that answer together, as one rigid body with six degrees of freedom, on the host and on
//! devices.
//!
//! A scene calls for them by `[[coupling]] kind = "dumbbell"`. The rod lies along x of the dumbbell's frame. What contact comes to on each ball is carried to the
//! centre of mass: with r_b from there to a ball, a twist (v, w) gives the ball v + w x r_b, and an impulse f on it gives (f, r_b x f).

use barchan::contact::{Grip, Reaction, System, Touch, Twist};
use barchan::coupling::{
    Aabb, DeviceAnswer, DeviceBody, DeviceGroup, DeviceLaw, Group, GroupState, GroupStep, Leashes, Moved, Placed,
};
use barchan::glam::{DMat3, DQuat, DVec3};
use barchan::parameter::{Parameter, Range as Allowed};
use barchan::registries::CouplingSetup;
use barchan::{BodyState, Command, Coupling, Error, NodeBatch, Registry, Result, Scene, Vec3, Wrench};
use std::ops::Range;
use std::sync::Arc;

/// Name of the kind.
pub const KIND: &str = "dumbbell";
/// What it keeps from the world's ends on a device, and how far it may go in a step [cells].
const CLEARANCE: f64 = 3.0;
const MOST_MOVE: f64 = 0.5;

/// Registers the coupling.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let number = |name, unit, doc| Parameter::number(name, unit, Allowed::POSITIVE, doc);
    let vector = |name, unit, doc| Parameter::vector(name, unit, Allowed::FINITE, doc);
    let parameters = vec![
        vector("position", "m", "Where its centre of mass is."),
        vector("velocity", "m/s", "How fast that moves.").or([0.0; 3]),
        vector("angular", "rad/s", "Angular velocity.").or([0.0; 3]),
        vector("turn", "rad", "Axis times angle by which it is turned.").or([0.0; 3]),
        number("radius", "m", "Radius of each ball.").or(0.04),
        number("rod", "m", "From one ball's centre to the other's.").or(0.12),
        number("left", "kg", "Mass of the ball at the lower end of x.").or(0.3),
        number("right", "kg", "Mass of the other ball.").or(0.6),
        number("friction", "1", "Coefficient of friction.").or(0.5),
    ];
    let doc = "Two balls at the ends of a light rod.";
    registry.add_coupling(KIND, doc, parameters, Arc::new(|setup| Ok(Box::new(Dumbbell::new(setup)))))
}

/// Two balls: the left one, then the right one.
#[derive(Clone, Debug)]
pub struct Dumbbell {
    name: String,
    radius: f64,
    friction: f64,
    masses: [f64; 2],
    /// Where the balls are along x of its frame, from the centre of mass [m].
    places: [f64; 2],
    /// About x, and about the other axes [kg m²].
    inertia: [f64; 2],
    scene: Scene,
    on_device: bool,
    state: State,
    wrenches: [Wrench; 2],
    unconverged: u64,
}

#[derive(Clone, Copy, Debug)]
struct State {
    /// Of the balls: the centre of mass lies between them.
    centers: [DVec3; 2],
    rotation: DQuat,
    velocity: DVec3,
    /// About the centre of mass.
    angular_momentum: DVec3,
}

/// How they grip nodes and answer them, for GPUs; the table holds for each its radius, its friction, its place on the rod and its mass, and then the inertia about
/// x, that about the other axes, and the mass of both. Each ball's thread carries to the centre of mass what contact on it comes to.
const WGSL: &str = "
fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32 {
    return length(x) - coupling_table(2u * body).x;
}
fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip {
    let off = length(x);
    let distance = off - coupling_table(2u * body).x;
    if distance >= 0.0 || off == 0.0 {
        return CouplingGrip(GRIP_NONE, vec3<f32>(0.0), 0.0, false, distance);
    }
    return CouplingGrip(GRIP_COULOMB, x / off, GRIP_UNBOUNDED, false, distance);
}
fn coupling_friction(body: u32) -> f32 {
    return coupling_table(2u * body).y;
}
fn coupling_box(body: u32, rows: array<vec3<f32>, 3>, cell: f32) -> array<vec3<f32>, 2> {
    let radius = vec3<f32>(coupling_table(2u * body).x);
    return array<vec3<f32>, 2>(-radius, radius);
}
";
const ANSWER: &str = "
var<workgroup> carried: array<CouplingRow, 12>;
var<private> velocity: vec3<f32>;
var<private> momentum: vec3<f32>;
var<private> missing: CouplingTwist;

// The rod's direction in the world.
fn rod(q: vec4<f32>) -> vec3<f32> {
    let rows = rows_of(q);
    return vec3<f32>(rows[0].x, rows[1].x, rows[2].x);
}
fn place(b: u32) -> f32 {
    return coupling_table(2u * group_body(b)).z;
}
// From the centre of mass to a ball.
fn arm(b: u32) -> vec3<f32> {
    return place(b) * rod(pose_rotation(group_pose(0u)));
}
fn inertia() -> vec3<f32> {
    return coupling_table(2u * group_body(0u) + 1u).xyz;
}
// The inertia times an angular velocity.
fn momentum_of(angular: vec3<f32>) -> vec3<f32> {
    let axis = rod(pose_rotation(group_pose(0u)));
    return inertia().y * angular + (inertia().x - inertia().y) * dot(axis, angular) * axis;
}
fn set_both(kind: u32, twist: CouplingTwist) {
    for (var b = 0u; b < 2u; b++) {
        set_group_twist(kind, b, CouplingTwist(twist.linear + cross(twist.angular, arm(b)), twist.angular));
    }
}
// The dumbbell's own twist, which that of its left ball tells.
fn own(kind: u32) -> CouplingTwist {
    let left = group_twist(kind, 0u);
    return CouplingTwist(left.linear - cross(left.angular, arm(0u)), left.angular);
}
fn set_free() {
    let axis = rod(pose_rotation(group_pose(0u)));
    let angular = (momentum + (inertia().y / inertia().x - 1.0) * dot(axis, momentum) * axis) / inertia().y;
    set_both(TWIST_FREE, CouplingTwist(velocity, angular));
    set_both(TWIST_EXPECTED, CouplingTwist(velocity, angular));
}
fn coupling_begin(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    velocity = bitcast<vec3<f32>>(group_word(0u).xyz);
    momentum = bitcast<vec3<f32>>(group_word(1u).xyz);
    if group_moves() {
        velocity += group_gravity();
    }
    set_free();
}
fn row_at(system: mat3x3<f32>, also: mat3x3<f32>, i: u32, arm: vec3<f32>, missing: f32) -> CouplingRow {
    return CouplingRow(system[i], also[i] - cross(system[i], arm), missing);
}
fn sum_of_rows(a: CouplingRow, s: f32, b: CouplingRow, t: f32, c: CouplingRow) -> CouplingRow {
    return CouplingRow(
        a.linear + s * b.linear + t * c.linear,
        a.angular + s * b.angular + t * c.angular,
        a.missing + s * b.missing + t * c.missing,
    );
}
fn coupling_answer(group: u32, thread: u32) {
    if thread < 2u {
        let system = group_system(thread);
        let r = arm(thread);
        let fx = row_at(system.force_linear, system.force_angular, 0u, r, system.force.x);
        let fy = row_at(system.force_linear, system.force_angular, 1u, r, system.force.y);
        let fz = row_at(system.force_linear, system.force_angular, 2u, r, system.force.z);
        let tx = row_at(system.torque_linear, system.torque_angular, 0u, r, system.torque.x);
        let ty = row_at(system.torque_linear, system.torque_angular, 1u, r, system.torque.y);
        let tz = row_at(system.torque_linear, system.torque_angular, 2u, r, system.torque.z);
        carried[6u * thread] = fx;
        carried[6u * thread + 1u] = fy;
        carried[6u * thread + 2u] = fz;
        carried[6u * thread + 3u] = sum_of_rows(tx, r.y, fz, -r.z, fy);
        carried[6u * thread + 4u] = sum_of_rows(ty, r.z, fx, -r.x, fz);
        carried[6u * thread + 5u] = sum_of_rows(tz, r.x, fy, -r.y, fx);
    }
    workgroupBarrier();
    if thread != 0u {
        return;
    }
    let free = own(TWIST_FREE);
    let tried = own(TWIST_TRIED);
    let mass = inertia().z;
    let lag = mass * (free.linear - tried.linear);
    let turning_lag = momentum_of(free.angular - tried.angular);
    var all: array<CouplingRow, 6>;
    for (var i = 0u; i < 3u; i++) {
        var unit = vec3<f32>(0.0);
        unit[i] = 1.0;
        let moved = CouplingRow(mass * unit, vec3<f32>(0.0), lag[i]);
        let turned = CouplingRow(vec3<f32>(0.0), momentum_of(unit), turning_lag[i]);
        all[i] = sum_of_rows(moved, 1.0, carried[i], 1.0, carried[6u + i]);
        all[3u + i] = sum_of_rows(turned, 1.0, carried[3u + i], 1.0, carried[9u + i]);
    }
    missing.linear = vec3<f32>(all[0].missing, all[1].missing, all[2].missing);
    missing.angular = vec3<f32>(all[3].missing, all[4].missing, all[5].missing);
    set_both(TWIST_STEP, solve_rows(all));
}
fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    let by = own(along);
    return dot(by.linear, missing.linear) + dot(by.angular, missing.angular);
}
fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    let twist = own(which);
    return inertia().z * dot(twist.linear, twist.linear) + dot(twist.angular, momentum_of(twist.angular));
}
fn coupling_feel(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    for (var b = 0u; b < 2u; b++) {
        let felt = group_impulse(b);
        velocity += felt.linear / inertia().z;
        momentum += felt.angular + cross(arm(b), felt.linear);
    }
    set_free();
}
fn coupling_advance(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    if group_moves() {
        let left = group_pose(0u);
        let before = rod(pose_rotation(left));
        let turned = pose_turned(left, turning(pose_rotation(left), group_dt() * own(TWIST_FREE).angular));
        let after = rod(pose_rotation(turned));
        let moved = pose_shifted(turned, (group_dt() * velocity + place(0u) * (after - before)) / group_cell());
        set_group_pose(0u, moved);
        set_group_pose(1u, pose_shifted(moved, (place(1u) - place(0u)) * after / group_cell()));
    }
    set_group_word(0u, vec4<u32>(bitcast<vec3<u32>>(velocity), 0u));
    set_group_word(1u, vec4<u32>(bitcast<vec3<u32>>(momentum), 0u));
}
";

impl Dumbbell {
    fn new(setup: &CouplingSetup<'_>) -> Self {
        let value = |key: &str| setup.parameters.number(key);
        let vector = |key: &str| DVec3::from_array(setup.parameters.vector(key));
        let (masses, radius, rod) = ([value("left"), value("right")], value("radius"), value("rod"));
        let total = masses[0] + masses[1];
        let places = [-rod * masses[1] / total, rod * masses[0] / total];
        let about_x = 0.4 * total * radius * radius;
        let inertia = [about_x, about_x + masses[0] * places[0].powi(2) + masses[1] * places[1].powi(2)];
        let (position, rotation) = (vector("position"), DQuat::from_scaled_axis(vector("turn")));
        let centers = places.map(|place| position + place * (rotation * DVec3::X));
        let state = State { centers, rotation, velocity: vector("velocity"), angular_momentum: DVec3::ZERO };
        let mut dumbbell = Self {
            name: setup.name.to_owned(),
            radius,
            friction: value("friction"),
            masses,
            places,
            inertia,
            scene: setup.scene.clone(),
            on_device: false,
            state,
            wrenches: [Wrench::default(); 2],
            unconverged: 0,
        };
        dumbbell.state.angular_momentum = dumbbell.inertia() * vector("angular");
        dumbbell
    }

    fn mass(&self) -> f64 {
        self.masses[0] + self.masses[1]
    }

    fn rod(&self) -> DVec3 {
        self.state.rotation * DVec3::X
    }

    /// From the centre of mass to a ball [m].
    fn arm(&self, body: usize) -> DVec3 {
        self.places[body] * self.rod()
    }

    /// In the world's frame [kg m²].
    fn inertia(&self) -> DMat3 {
        let ([about_x, across], rod) = (self.inertia, self.rod());
        DMat3::from_diagonal(DVec3::splat(across))
            + (about_x - across) * DMat3::from_cols(rod.x * rod, rod.y * rod, rod.z * rod)
    }

    /// Its own twist.
    fn own(&self) -> Twist {
        Twist { linear: self.state.velocity, angular: self.inertia().inverse() * self.state.angular_momentum }
    }

    /// Its own twist, if that of its left ball is this.
    fn own_of(&self, left: &Twist) -> Twist {
        Twist { linear: left.linear - left.angular.cross(self.arm(0)), angular: left.angular }
    }

    /// A ball's twist, if its own is this.
    fn of_ball(&self, body: usize, own: &Twist) -> Twist {
        Twist { linear: own.at(self.arm(body)), angular: own.angular }
    }

    /// What it has out of balance at a twist, with what contact gives it.
    fn residual(&self, at: &Twist, systems: &[System]) -> [f64; 6] {
        let free = self.own();
        let mut force = self.mass() * (free.linear - at.linear);
        let mut torque = self.inertia() * (free.angular - at.angular);
        for (body, system) in systems.iter().enumerate() {
            let [fx, fy, fz, tx, ty, tz] = system.impulse;
            let own = DVec3::new(fx, fy, fz);
            force += own;
            torque += DVec3::new(tx, ty, tz) + self.arm(body).cross(own);
        }
        [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    }

    /// How a ball's twist follows from its own.
    fn carrying(&self, body: usize) -> [[f64; 6]; 6] {
        let r = self.arm(body);
        let mut rows = [[0.0; 6]; 6];
        (0..6).for_each(|i| rows[i][i] = 1.0);
        rows[0][4..].copy_from_slice(&[r.z, -r.y]);
        (rows[1][3], rows[1][5]) = (-r.z, r.x);
        (rows[2][3], rows[2][4]) = (r.y, -r.x);
        rows
    }

    fn fastest(&self, dt: f64) -> f64 {
        let own = self.own();
        let extent = self.radius + self.places[1].max(-self.places[0]);
        own.linear.length() + own.angular.length() * extent + DVec3::from_array(self.scene.gravity).length() * dt
    }

    fn lost(&self) -> Error {
        Error::Body {
            path: format!("coupling '{}'", self.name),
            what: "its motion is no longer finite".to_owned(),
            mend: "lower time.step, or start from the last snapshot".to_owned(),
        }
    }
}

/// Solves six equations, by elimination with pivots.
fn solve(mut rows: [[f64; 6]; 6], mut right: [f64; 6]) -> Option<[f64; 6]> {
    for i in 0..6 {
        let pivot = (i..6).max_by(|a, b| rows[*a][i].abs().total_cmp(&rows[*b][i].abs()))?;
        rows.swap(i, pivot);
        right.swap(i, pivot);
        if rows[i][i] == 0.0 || !rows[i][i].is_finite() {
            return None;
        }
        for below in i + 1..6 {
            let times = rows[below][i] / rows[i][i];
            for j in i..6 {
                rows[below][j] -= times * rows[i][j];
            }
            right[below] -= times * right[i];
        }
    }
    for i in (0..6).rev() {
        let rest: f64 = (i + 1..6).map(|j| rows[i][j] * right[j]).sum();
        right[i] = (right[i] - rest) / rows[i][i];
    }
    Some(right)
}

fn of_six([a, b, c, d, e, f]: [f64; 6]) -> Twist {
    Twist { linear: DVec3::new(a, b, c), angular: DVec3::new(d, e, f) }
}

impl Coupling for Dumbbell {
    fn name(&self) -> &str {
        &self.name
    }
    fn bodies(&self) -> Vec<BodyState> {
        let of_body = |(b, side): (usize, &str)| {
            let twist = self.twist(b);
            let (momentum, spin) =
                (self.masses[b] * twist.linear, 0.4 * self.masses[b] * self.radius.powi(2) * twist.angular);
            let center = self.state.centers[b];
            let q = self.state.rotation;
            BodyState {
                name: format!("{side} {}", self.name),
                position: center.to_array(),
                rotation: [q.w, q.x, q.y, q.z],
                velocity: twist.linear.to_array(),
                angular_velocity: twist.angular.to_array(),
                mass: self.masses[b],
                kinetic_energy: 0.5 * (momentum.dot(twist.linear) + spin.dot(twist.angular)),
                potential_energy: -self.masses[b] * DVec3::from_array(self.scene.gravity).dot(center),
                momentum: momentum.to_array(),
                angular_momentum: (center.cross(momentum) + spin).to_array(),
            }
        };
        ["left", "right"].into_iter().enumerate().map(of_body).collect()
    }
    fn max_speed(&self, _: f64, dt: f64) -> f64 {
        self.fastest(dt)
    }
    fn before_step(&mut self, time: f64, dt: f64) -> Result<()> {
        self.wrenches = [Wrench::default(); 2];
        if !self.on_device {
            self.state.velocity += DVec3::from_array(self.scene.gravity_at(time)) * dt;
        }
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        let of_body = |center: &DVec3| Aabb { min: center.to_array(), max: center.to_array() }.grown(self.radius);
        self.state.centers.iter().map(of_body).collect()
    }
    fn touch(&mut self, body: usize, _: f64, nodes: &NodeBatch, touches: &mut Vec<Touch>) {
        for (node, position) in nodes.position.iter().enumerate() {
            let center = self.state.centers[body];
            let arm = DVec3::from_array(nodes.image_near(*position, center.to_array())) - center;
            let distance = arm.length() - self.radius;
            if distance < 0.0
                && let Some(normal) = arm.try_normalize()
            {
                let grip = Grip::Coulomb { normal, friction: self.friction, most: f64::INFINITY };
                touches.push(Touch { node, arm, distance, grip, is_deep: false });
            }
        }
    }
    fn twist(&self, body: usize) -> Twist {
        self.of_ball(body, &self.own())
    }
    fn groups(&self) -> Vec<Group> {
        vec![Group { bodies: 0..2, mass: self.mass() }]
    }
    fn answer(&self, _: Range<usize>, at: &[Twist], systems: &[System]) -> Option<Vec<Twist>> {
        let mut rows = [[0.0; 6]; 6];
        let inertia = self.inertia();
        for i in 0..3 {
            rows[i][i] = self.mass();
            rows[3 + i][3..].copy_from_slice(&inertia.row(i).to_array());
        }
        for (body, system) in systems.iter().enumerate() {
            let carrying = self.carrying(body);
            for (i, j) in (0..36).map(|k| (k / 6, k % 6)) {
                let of = |k: usize| carrying[k][i] * (0..6).map(|l| system.matrix[k][l] * carrying[l][j]).sum::<f64>();
                rows[i][j] += (0..6).map(of).sum::<f64>();
            }
        }
        let step = of_six(solve(rows, self.residual(&self.own_of(&at[0]), systems))?);
        Some(vec![self.of_ball(0, &step), self.of_ball(1, &step)])
    }
    fn balance(&self, _: Range<usize>, at: &[Twist], systems: &[System], along: &[Twist]) -> f64 {
        let (missing, by) = (of_six(self.residual(&self.own_of(&at[0]), systems)), self.own_of(&along[0]));
        missing.linear.dot(by.linear) + missing.angular.dot(by.angular)
    }
    fn twice_energy(&self, _: Range<usize>, twists: &[Twist]) -> f64 {
        let own = self.own_of(&twists[0]);
        self.mass() * own.linear.length_squared() + own.angular.dot(self.inertia() * own.angular)
    }
    fn feel(&mut self, _: Range<usize>, _: &[Twist], reactions: &[Reaction], dt: f64) -> Result<()> {
        for (body, Reaction { impulse, converged, .. }) in reactions.iter().enumerate() {
            let force = DVec3::from_array(impulse.force);
            self.state.velocity += force / self.mass();
            self.state.angular_momentum += DVec3::from_array(impulse.torque) + self.arm(body).cross(force);
            self.wrenches[body].add_change(&Wrench::default(), impulse, 1.0 / dt);
            self.unconverged += u64::from(!converged && body == 0);
        }
        if self.state.velocity.is_finite() { Ok(()) } else { Err(self.lost()) }
    }
    fn device_law(&self) -> Option<DeviceLaw> {
        let of_ball = |b: usize| {
            let both = [self.inertia[0], self.inertia[1], self.mass(), 0.0];
            [[self.radius, self.friction, self.places[b], self.masses[b]], both].map(|row| row.map(|x| x as f32))
        };
        let ball = DeviceBody { extent: self.radius, swing: 0.0, reach: self.radius };
        let groups = vec![DeviceGroup { words: 2, told: 0, rates: 0, bodies: vec![ball; 2] }];
        Some(DeviceLaw {
            counted: true,
            wgsl: WGSL.to_owned(),
            table: (0..2).flat_map(of_ball).collect(),
            answer: DeviceAnswer { wgsl: ANSWER.to_owned(), groups },
            ..DeviceLaw::default()
        })
    }
    fn leashes(&self, _: f64, dt: f64, _: usize) -> Option<Leashes> {
        let (world, cell) = (self.scene.world_box(), self.scene.world.cell);
        if self.fastest(dt) * dt > MOST_MOVE * cell {
            return None;
        }
        let leash = |own: Aabb| {
            let off = |d: usize| CLEARANCE * cell + world.min[d] - own.min[d];
            let leash = Aabb {
                min: std::array::from_fn(off),
                max: std::array::from_fn(|d| world.max[d] - CLEARANCE * cell - own.max[d]),
            };
            leash.contains([0.0; 3]).then_some(leash)
        };
        let each = self.bounds().into_iter().map(leash).collect::<Option<_>>()?;
        Some(Leashes { each, in_turns: false })
    }
    fn device_state(&self) -> Vec<GroupState> {
        let word = |v: DVec3| [(v.x as f32).to_bits(), (v.y as f32).to_bits(), (v.z as f32).to_bits(), 0];
        let q = self.state.rotation;
        let bodies = self.state.centers.map(|x| Placed { position: x.to_array(), rotation: [q.w, q.x, q.y, q.z] });
        let words = vec![word(self.state.velocity), word(self.state.angular_momentum)];
        vec![GroupState { words, bodies: bodies.into() }]
    }
    fn move_on_device(&mut self, moved: Moved) {
        self.on_device = moved == Moved::ByDevice;
    }
    fn take_device_state(&mut self, groups: &[GroupStep]) -> Result<()> {
        let vector = |word: [u32; 4]| DVec3::from_array([0, 1, 2].map(|d| f64::from(f32::from_bits(word[d]))));
        let [GroupStep { state: GroupState { words, bodies }, unconverged, .. }] = groups else { return Ok(()) };
        let ([velocity, momentum], [left, right]) = (&words[..], &bodies[..]) else { return Err(self.lost()) };
        let [w, x, y, z] = left.rotation;
        self.state = State {
            centers: [left, right].map(|ball| DVec3::from_array(ball.position)),
            rotation: DQuat::from_xyzw(x, y, z, w),
            velocity: vector(*velocity),
            angular_momentum: vector(*momentum),
        };
        self.unconverged += unconverged;
        if self.state.velocity.is_finite() && self.state.centers[0].is_finite() { Ok(()) } else { Err(self.lost()) }
    }
    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrenches.copy_from_slice(wrenches);
    }
    fn after_step(&mut self, _: f64, dt: f64) -> Result<()> {
        if self.on_device {
            return Ok(());
        }
        let (own, before) = (self.own(), self.arm(0));
        let position = self.state.centers[0] - before + own.linear * dt;
        self.state.rotation = (DQuat::from_scaled_axis(own.angular * dt) * self.state.rotation).normalize();
        self.state.centers = [position + self.arm(0), position + self.arm(1)];
        if position.is_finite() { Ok(()) } else { Err(self.lost()) }
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        let to = |x: &Vec3| {
            let off = self.state.centers.map(|center| (DVec3::from_array(*x) - center).length() - self.radius);
            off[0].min(off[1])
        };
        points.iter().map(to).collect()
    }
    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        Err(Error::Body {
            path: format!("coupling '{}'", self.name),
            what: format!("'{body}' is free, and {} is asked for", command.name()),
            mend: "move a tool instead".to_owned(),
        })
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        Vec::new()
    }
    fn counts(&self) -> Vec<(String, u64)> {
        vec![("contact solutions of dumbbells not converged".to_owned(), self.unconverged)]
    }
    fn save(&self) -> Vec<u8> {
        let State { centers: [left, right], rotation, velocity, angular_momentum } = self.state;
        let vectors = [left, right, velocity, angular_momentum].map(|v| v.to_array());
        let wrenches = self.wrenches.iter().flat_map(|w| w.force.into_iter().chain(w.torque));
        let numbers = vectors.into_iter().flatten().chain(rotation.to_array()).chain(wrenches);
        numbers.flat_map(f64::to_le_bytes).chain(self.unconverged.to_le_bytes()).collect()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        let (words, rest) = bytes.as_chunks::<8>();
        let ([numbers @ .., unconverged], 29, []) = (words, words.len(), rest) else {
            return Err(format!("{} bytes where a dumbbell has 232", bytes.len()));
        };
        let numbers: Vec<f64> = numbers.iter().map(|b| f64::from_le_bytes(*b)).collect();
        if !numbers.iter().all(|x| x.is_finite()) {
            return Err("a number is not finite".to_owned());
        }
        let vector = |at: usize| DVec3::from_slice(&numbers[at..]);
        self.state = State {
            centers: [vector(0), vector(3)],
            rotation: DQuat::from_slice(&numbers[12..]),
            velocity: vector(6),
            angular_momentum: vector(9),
        };
        for (wrench, own) in self.wrenches.iter_mut().zip(numbers[16..].chunks_exact(6)) {
            *wrench = Wrench { force: [own[0], own[1], own[2]], torque: [own[3], own[4], own[5]] };
        }
        self.unconverged = u64::from_le_bytes(*unconverged);
        Ok(())
    }
}
