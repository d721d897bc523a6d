//! Two rollers that turn towards each other and draw the ground down between them, as in a mill: bodies that grip nodes.
//!
//! A scene calls for them by `[[coupling]] kind = "rollers"`. They are cylinders along y, without end, their axes at a height `z` [m] on either side of
//! `x` [m], with a `gap` [m] between their surfaces. They turn at `rate` [rad/s] and rub the ground with a coefficient of `friction`.

use barchan::contact::adjoint::{BodyInStep, GripCotangent, NearCotangents};
use barchan::contact::{Grip, Reaction, Touch, Twist};
use barchan::coupling::{Aabb, BodiesOwed, BodiesTold, DeviceLaw};
use barchan::glam::DVec3;
use barchan::parameter::{Parameter, Range};
use barchan::registries::CouplingSetup;
use barchan::{BodyState, Command, Coupling, Error, NodeBatch, Registry, Result, Vec3, Wrench};
use std::sync::Arc;

/// Name of the kind.
pub const KIND: &str = "rollers";

/// Registers the coupling.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let number = |name, unit, range, doc| Parameter::number(name, unit, range, doc);
    let parameters = vec![
        number("radius", "m", Range::POSITIVE, "Radius of each.").or(0.1),
        number("gap", "m", Range::POSITIVE, "Between their surfaces.").or(0.05),
        number("x", "m", Range::FINITE, "Place of the middle between them.").or(0.0),
        number("z", "m", Range::FINITE, "Height of their axes.").or(0.0),
        number("rate", "rad/s", Range::FINITE, "How fast they turn.").or(1.0),
        number("friction", "1", Range::POSITIVE, "Coefficient of friction.").or(0.5),
    ];
    let doc = "Two rollers that draw the ground down between them.";
    registry.add_coupling(KIND, doc, parameters, Arc::new(|setup| Ok(Box::new(Rollers::new(setup)))))
}

/// Two rollers: the left one, then the right one.
#[derive(Clone, Debug)]
pub struct Rollers {
    name: String,
    radius: f64,
    friction: f64,
    axes: [DVec3; 2],
    /// How fast each turns about y [rad/s], and how far it has turned.
    rates: [f64; 2],
    angle: f64,
    world: Aabb,
    wrenches: [Wrench; 2],
}

impl Rollers {
    fn new(setup: &CouplingSetup<'_>) -> Self {
        let value = |key: &str| setup.parameters.number(key);
        let (radius, rate) = (value("radius"), value("rate"));
        let off = radius + 0.5 * value("gap");
        let axis = |side: f64| DVec3::new(value("x") + side * off, 0.0, value("z"));
        Self {
            name: setup.name.to_owned(),
            radius,
            friction: value("friction"),
            axes: [axis(-1.0), axis(1.0)],
            rates: [rate, -rate],
            angle: 0.0,
            world: setup.scene.world_box(),
            wrenches: [Wrench::default(); 2],
        }
    }

    /// From a roller's axis to a point, across the axis.
    fn across(&self, body: usize, x: DVec3) -> DVec3 {
        let arm = x - self.axes[body];
        DVec3::new(arm.x, 0.0, arm.z)
    }
}

/// How they grip nodes, for GPUs; the table holds, for each, its radius and its friction.
const WGSL: &str = "
fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32 {
    return length(x.xz) - coupling_table(body).x;
}
fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip {
    let off = length(x.xz);
    let distance = off - coupling_table(body).x;
    if distance >= 0.0 || off == 0.0 {
        return CouplingGrip(GRIP_NONE, vec3<f32>(0.0), 0.0, false, distance);
    }
    return CouplingGrip(GRIP_COULOMB, vec3<f32>(x.x, 0.0, x.z) / off, GRIP_UNBOUNDED, false, distance);
}
fn coupling_friction(body: u32) -> f32 {
    return coupling_table(body).y;
}
";

impl Coupling for Rollers {
    fn name(&self) -> &str {
        &self.name
    }
    fn bodies(&self) -> Vec<BodyState> {
        let of_body = |(b, side): (usize, &str)| {
            let half = 0.5 * self.angle * self.rates[b].signum();
            BodyState {
                name: format!("{side} {}", self.name),
                position: self.axes[b].to_array(),
                rotation: [half.cos(), 0.0, half.sin(), 0.0],
                velocity: [0.0; 3],
                angular_velocity: [0.0, self.rates[b], 0.0],
                mass: f64::INFINITY,
                kinetic_energy: 0.0,
                potential_energy: 0.0,
                momentum: [0.0; 3],
                angular_momentum: [0.0; 3],
            }
        };
        ["left", "right"].into_iter().enumerate().map(of_body).collect()
    }
    fn max_speed(&self, _: f64, _: f64) -> f64 {
        self.radius * self.rates[0].abs()
    }
    fn before_step(&mut self, _: f64, _: f64) -> Result<()> {
        self.wrenches = [Wrench::default(); 2];
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        let of_body = |axis: &DVec3| Aabb {
            min: [axis.x - self.radius, self.world.min[1], axis.z - self.radius],
            max: [axis.x + self.radius, self.world.max[1], axis.z + self.radius],
        };
        self.axes.iter().map(of_body).collect()
    }
    fn twin(&self) -> Result<Box<dyn Coupling>> {
        Ok(Box::new(self.clone()))
    }
    fn advance_back(&mut self, _: f64, owed: &mut BodiesOwed<'_>) -> Result<Vec<Twist>> {
        // They turn as they are told, whatever they felt.
        Ok(vec![Twist::default(); owed.bodies.len()])
    }
    fn touch_back(
        &self,
        body: usize,
        _: f64,
        nodes: &NodeBatch,
        (touches, grips): (&[Touch], &[GripCotangent]),
        _: &mut NearCotangents,
        owed: &mut BodyInStep,
    ) -> Result<()> {
        for (touch, grip) in touches.iter().zip(grips) {
            // The normal is the direction from the axis to the node, and nothing bounds the grip.
            let across = self.across(body, DVec3::from_array(nodes.position[touch.node]));
            let normal = across.normalize();
            let of_point = (grip.normal - normal.dot(grip.normal) * normal) / across.length();
            owed.position -= DVec3::new(of_point.x, 0.0, of_point.z);
        }
        Ok(())
    }
    fn begin_back(
        &self,
        _: f64,
        _: f64,
        step: &[BodyInStep],
        owed: &mut BodiesOwed<'_>,
        told: &mut BodiesTold<'_>,
    ) -> Result<Vec3> {
        for ((step, owed), told) in step.iter().zip(&mut *owed.bodies).zip(&mut *told.bodies) {
            told.friction += step.friction;
            told.angular[1] += step.twist.angular.y;
            (0..3).for_each(|d| owed.pose.position[d] += step.position[d]);
        }
        Ok([0.0; 3])
    }
    fn touch(&mut self, body: usize, _: f64, nodes: &NodeBatch, touches: &mut Vec<Touch>) {
        for (node, position) in nodes.position.iter().enumerate() {
            let x = DVec3::from_array(*position);
            let across = self.across(body, x);
            let distance = across.length() - self.radius;
            if distance < 0.0
                && let Some(normal) = across.try_normalize()
            {
                let grip = Grip::Coulomb { normal, friction: self.friction, most: f64::INFINITY };
                touches.push(Touch { node, arm: x - self.axes[body], distance, grip, is_deep: false });
            }
        }
    }
    fn twist(&self, body: usize) -> Twist {
        Twist { linear: DVec3::ZERO, angular: self.rates[body] * DVec3::Y }
    }
    fn feel(&mut self, bodies: std::ops::Range<usize>, _: &[Twist], reactions: &[Reaction], dt: f64) -> Result<()> {
        for (wrench, reaction) in self.wrenches[bodies].iter_mut().zip(reactions) {
            wrench.add_change(&Wrench::default(), &reaction.impulse, 1.0 / dt);
        }
        Ok(())
    }
    fn device_law(&self) -> Option<DeviceLaw> {
        let table = vec![[self.radius as f32, self.friction as f32, 0.0, 0.0]; 2];
        Some(DeviceLaw { counted: true, wgsl: WGSL.to_owned(), table, ..DeviceLaw::default() })
    }
    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrenches.copy_from_slice(wrenches);
    }
    fn after_step(&mut self, _: f64, dt: f64) -> Result<()> {
        self.angle += self.rates[0].abs() * dt;
        Ok(())
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        let to = |x: &Vec3| {
            let of_body = |b| self.across(b, DVec3::from_array(*x)).length() - self.radius;
            (0..2).map(of_body).fold(f64::INFINITY, f64::min)
        };
        points.iter().map(to).collect()
    }
    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        Err(Error::Body {
            path: format!("coupling '{}'", self.name),
            what: format!("'{body}' turns at its own rate, and {} is asked for", command.name()),
            mend: "move a tool instead, or change the rollers' rate".to_owned(),
        })
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        Vec::new()
    }
    fn save(&self) -> Vec<u8> {
        let wrenches = self.wrenches.iter().flat_map(|w| w.force.into_iter().chain(w.torque));
        std::iter::once(self.angle).chain(wrenches).flat_map(f64::to_le_bytes).collect()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        let numbers: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
        let [angle, rest @ ..] = &numbers[..] else { return Err("no bytes where rollers have 104".to_owned()) };
        if bytes.len() != 104 || !numbers.iter().all(|x| x.is_finite()) {
            return Err(format!("{} bytes where rollers have 104, or a number that is not finite", bytes.len()));
        }
        self.angle = *angle;
        for (wrench, own) in self.wrenches.iter_mut().zip(rest.chunks_exact(6)) {
            *wrench = Wrench { force: [own[0], own[1], own[2]], torque: [own[3], own[4], own[5]] };
        }
        Ok(())
    }
}
