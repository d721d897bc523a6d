//! Couplings outside Barchan's own crates: [`rollers`], bodies that grip the ground, and a current, a field that drags the ground along.
//!
//! A scene calls for it by `[[coupling]] kind = "current"`, with the parameters `rate` [1/s] and `x`, `y`, `z` [m/s]. The box
//! is the whole world. A node's velocity u follows du/dt = rate (w - u), taken implicitly, so that any step is stable; what the
//! node gains, a pump without an end of mass loses.

pub mod rollers;

use barchan::coupling::{Aabb, DeviceLaw};
use barchan::material::Parameter;
use barchan::{BodyState, Coupling, Error, NodeBatch, Registry, Result, Scene, Vec3, Wrench};
use std::sync::Arc;

/// Name of the kind.
pub const KIND: &str = "current";

/// Registers both couplings.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let along = |axis: &str| {
        let doc = format!("Speed of the current along {axis}.");
        Parameter::new(axis, "m/s", 0.0, [f64::MIN, f64::MAX], &doc)
    };
    let rate = Parameter::new("rate", "1/s", 0.0, [0.0, f64::MAX], "How fast the ground takes it up.");
    let host =
        Parameter::new("host", "1", 0.0, [0.0, 1.0], "1: beside a GPU the host applies it, as if it had no WGSL.");
    let parameters = [rate].into_iter().chain(["x", "y", "z"].map(along)).chain([host]).collect();
    let doc = "A current that drags the ground along.";
    registry.add_coupling(KIND, doc, parameters, Arc::new(|scene| Ok(Box::new(Current::new(scene)?))))?;
    rollers::register(registry)
}

/// The same for GPUs; the table holds the rate and the velocity.
const WGSL: &str = "
fn coupling_field(body: u32, x: vec3<f32>, u: vec3<f32>, mass: f32, dt: f32) -> vec3<f32> {
    let current = coupling_table(body);
    let share = current.x * dt / (1.0 + current.x * dt);
    return u + share * (current.yzw - u);
}
";

/// The current, and what it felt in the last step.
#[derive(Clone, Debug)]
pub struct Current {
    rate: f64,
    velocity: Vec3,
    on_host: bool,
    extent: Aabb,
    wrench: [Wrench; 1],
}

impl Current {
    /// Reads its parameters from the scene.
    ///
    /// # Errors
    /// [`Error::Scene`] if `rate` is missing or 0.
    pub fn new(scene: &Scene) -> Result<Self> {
        let Some(index) = scene.coupling.iter().position(|spec| spec.kind == KIND) else {
            return Err(scene.fault("coupling", "none is a current", "add [[coupling]] kind = \"current\""));
        };
        let parameters = &scene.coupling[index].parameters;
        let path = |key: &str| format!("coupling[{index}].parameters.{key}");
        let value = |key: &str| parameters.get(key).copied().unwrap_or(0.0);
        let rate = value("rate");
        if rate == 0.0 {
            return Err(scene.fault(&path("rate"), "is 0", "give a rate above 0"));
        }
        Ok(Self {
            rate,
            velocity: [value("x"), value("y"), value("z")],
            on_host: value("host") != 0.0,
            extent: scene.world_box(),
            wrench: [Wrench::default()],
        })
    }
}

impl Coupling for Current {
    fn name(&self) -> &str {
        KIND
    }
    fn bodies(&self) -> Vec<BodyState> {
        vec![BodyState {
            name: "pump".to_owned(),
            position: [0.0; 3],
            rotation: [1.0, 0.0, 0.0, 0.0],
            velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
            mass: f64::INFINITY,
            kinetic_energy: 0.0,
            potential_energy: 0.0,
            momentum: [0.0; 3],
            angular_momentum: [0.0; 3],
        }]
    }
    fn max_speed(&self, _: f64, _: f64) -> f64 {
        0.0
    }
    fn before_step(&mut self, _: f64, _: f64) -> Result<()> {
        self.wrench = [Wrench::default()];
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        vec![self.extent]
    }
    fn is_field(&self) -> bool {
        true
    }
    fn act_as_field(&mut self, dt: f64, nodes: &mut NodeBatch) -> Result<()> {
        let share = self.rate * dt / (1.0 + self.rate * dt);
        for (u, &mass) in nodes.velocity.iter_mut().zip(&nodes.mass) {
            for d in 0..3 {
                let gain = share * (self.velocity[d] - u[d]);
                u[d] += gain;
                self.wrench[0].force[d] -= mass * gain / dt;
            }
        }
        Ok(())
    }
    fn device_law(&self) -> Option<DeviceLaw> {
        let [x, y, z] = self.velocity.map(|v| v as f32);
        let table = vec![[self.rate as f32, x, y, z]];
        let law = DeviceLaw { counted: true, wgsl: WGSL.to_owned(), table, ..DeviceLaw::default() };
        (!self.on_host).then_some(law)
    }
    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrench.copy_from_slice(wrenches);
    }
    fn after_step(&mut self, _: f64, _: f64) -> Result<()> {
        Ok(())
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrench
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        vec![f64::INFINITY; points.len()]
    }
    fn drive(&mut self, body: &str, _: Vec3, _: Vec3) -> Result<()> {
        Err(Error::Body {
            path: body.to_owned(),
            what: "the pump of a current does not move".to_owned(),
            mend: "drive a tool instead".to_owned(),
        })
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        Vec::new()
    }
    fn save(&self) -> Vec<u8> {
        self.wrench[0].force.iter().flat_map(|x| x.to_le_bytes()).collect()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        let numbers = bytes.as_chunks::<8>().0;
        if bytes.len() != 24 {
            return Err(format!("{} bytes where a current has 24", bytes.len()));
        }
        self.wrench[0].force = std::array::from_fn(|d| f64::from_le_bytes(numbers[d]));
        Ok(())
    }
}
