//! A material, a coupling and a backend that are simple enough to predict.
#![allow(dead_code, unreachable_pub, reason = "each test file uses its own part of these")]
#![expect(unsafe_code, reason = "the material's callbacks are C functions")]

use barchan_abi::*;
use barchan_core::backend::{Bound, Timing};
use barchan_core::contact::Contact;
use barchan_core::coupling::{Aabb, begin_step};
use barchan_core::scene::{Motion, Shape};
use barchan_core::{
    Backend, BodyState, Command, Coupling, Engine, Error, Form, Ledger, NodeBatch, ParticleState, Plan, Registry,
    Result, Scene, Stage, StepReport, Vec3, Wrench,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

const PARAMETERS: [BarchanParam; 4] = [
    parameter("young_modulus", "Pa", 1e6, 0.0, 1e12, BARCHAN_PARAM_MIN_OPEN),
    parameter("poisson_ratio", "1", 0.2, -1.0, 0.5, BARCHAN_PARAM_MIN_OPEN | BARCHAN_PARAM_MAX_OPEN),
    parameter("friction_angle", "rad", 0.5, 0.0, 1.57, 0),
    parameter("strength", "Pa", f64::INFINITY, 0.0, f64::INFINITY, 0),
];
static PARAMS: [BarchanParam; 4] = PARAMETERS;
static STATES: [BarchanStateVar; 1] = [BarchanStateVar {
    name: BarchanStr::new("age"),
    unit: BarchanStr::new("1"),
    doc: BarchanStr::new("Age."),
    initial_value: 0.1,
    merge: BARCHAN_MERGE_MEAN,
    reserved: 0,
}];

const fn parameter(
    name: &'static str,
    unit: &'static str,
    default: f64,
    min: f64,
    max: f64,
    flags: u64,
) -> BarchanParam {
    BarchanParam {
        name: BarchanStr::new(name),
        unit: BarchanStr::new(unit),
        doc: BarchanStr::new("A parameter."),
        default_value: default,
        min_value: min,
        max_value: max,
        flags,
    }
}

unsafe extern "C" fn update(_: *const BarchanBatchF32, _: *mut BarchanError) -> BarchanStatus {
    BARCHAN_OK
}

/// A pressure that grows with compression, and a shear stress that grows with shear, up to the strength and what friction adds.
unsafe extern "C" fn update64(batch: *const BarchanBatchF64, _: *mut BarchanError) -> BarchanStatus {
    // SAFETY: the host's batch has `stride` floats a plane and four parameters, as the ABI promises.
    unsafe {
        let b = &*batch;
        let (modulus, friction, strength) = (*b.params, (*b.params.add(2)).tan(), *b.params.add(3));
        for i in 0..b.n {
            let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(|plane| *b.strain_trial.add(plane * b.stride + i));
            let square = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
            let pressure = 0.5 * modulus * (1.0 - square);
            let most = strength + friction * pressure.max(0.0);
            for (plane, strain) in [xx, yy, zz, xy, xz, yz].into_iter().enumerate() {
                let at = plane * b.stride + i;
                *b.strain.add(at) = strain;
                *b.kirchhoff.add(at) = if plane < 3 { -pressure } else { (modulus * strain).clamp(-most, most) };
            }
        }
    }
    BARCHAN_OK
}

/// Moduli of linear elasticity; checks what the host hands over.
unsafe extern "C" fn moduli(batch: *const BarchanBatchF32, out: *mut f32, _: *mut BarchanError) -> BarchanStatus {
    // SAFETY: the host's batch has `stride` floats a plane, as the ABI promises.
    unsafe {
        let b = &*batch;
        assert!(b.strain_trial.align_offset(64) == 0 && b.stride.is_multiple_of(16) && b.vel_grad.is_null());
        assert_eq!((*b.strain_trial, *b.strain_trial.add(3 * b.stride), *b.state_in), (1.0, 0.0, 0.1));
        let (e, nu) = (*b.params, *b.params.add(1));
        let (lambda, mu) = (e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), e / (2.0 * (1.0 + nu)));
        for i in 0..b.n {
            *out.add(i) = lambda + 2.0 * mu;
            *out.add(b.stride + i) = 3.0 * lambda + 2.0 * mu;
        }
    }
    BARCHAN_OK
}

unsafe extern "C" fn check(params: *const f64, error: *mut BarchanError) -> BarchanStatus {
    // SAFETY: one value a parameter, and the error's buffer has `capacity` bytes, as the ABI promises.
    unsafe {
        if *params < 1e11 || *params.add(1) < 0.4 {
            return BARCHAN_OK;
        }
        let text = b"too stiff for so large a Poisson's ratio";
        (*error).len = text.len().min((*error).capacity);
        std::ptr::copy_nonoverlapping(text.as_ptr(), (*error).message, (*error).len);
    }
    BARCHAN_E_INVALID_PARAM
}

const ELASTIC: BarchanMaterial = BarchanMaterial {
    struct_size: size_of::<BarchanMaterial>(),
    abi_major: BARCHAN_ABI_MAJOR,
    abi_minor: BARCHAN_ABI_MINOR,
    capabilities: 0,
    strain_kind: BARCHAN_STRAIN_LEFT_CAUCHY_GREEN,
    reserved: 0,
    name: BarchanStr::new("elastic"),
    version: BarchanStr::new("1"),
    doc: BarchanStr::new("Elastic."),
    reference: BarchanStr::new("none"),
    params: PARAMS.as_ptr(),
    n_params: PARAMS.len(),
    param_size: size_of::<BarchanParam>(),
    states: STATES.as_ptr(),
    n_state: STATES.len(),
    state_size: size_of::<BarchanStateVar>(),
    update_f32: Some(update),
    update_adj_f32: None,
    update_f64: Some(update64),
    update_adj_f64: None,
    tangent_moduli_f32: Some(moduli),
    energy_f64: None,
    check_params: Some(check),
    count_f64: None,
    wgsl: BarchanStr::new(""),
    wgsl_adj: BarchanStr::new(""),
    viscosity_f32: None,
    wgsl_stiffness: BarchanStr::new(""),
};
pub static MATERIAL: BarchanMaterial = ELASTIC;
pub static FLUID: BarchanMaterial =
    BarchanMaterial { name: BarchanStr::new("fluid"), capabilities: BARCHAN_CAP_FLUID, ..ELASTIC };
pub static SILENT: BarchanMaterial =
    BarchanMaterial { name: BarchanStr::new("silent"), tangent_moduli_f32: None, update_f64: None, ..ELASTIC };

/// All of this file's plugins.
pub fn registry() -> Registry {
    let mut registry = Registry::new();
    for table in [&MATERIAL, &FLUID, &SILENT] {
        registry.add_material(table, "built-in").unwrap();
    }
    registry
        .add_coupling("rigid", "Boxes.", Vec::new(), Arc::new(|setup| Ok(Box::new(Boxes::new(setup.scene)) as _)))
        .unwrap();
    registry.add_backend(Arc::new(Ballistic)).unwrap();
    registry
}

/// Boxes that do not turn.
struct Boxes {
    bodies: Vec<BodyState>,
    half: Vec<Vec3>,
    wrenches: Vec<Wrench>,
}

impl Boxes {
    fn new(scene: &Scene) -> Self {
        let body = |tool: &barchan_core::scene::Tool| {
            let (mass, velocity) = match tool.motion {
                Motion::Free { mass, linear, .. } => (mass, linear),
                Motion::Velocity { linear, .. } => (f64::INFINITY, linear),
                _ => (f64::INFINITY, [0.0; 3]),
            };
            BodyState {
                name: tool.name.clone(),
                position: tool.position,
                rotation: tool.rotation,
                velocity,
                angular_velocity: [0.0; 3],
                mass,
                kinetic_energy: if mass.is_finite() { 0.5 * mass * velocity[2].powi(2) } else { 0.0 },
                potential_energy: 0.0,
                momentum: [0.0; 3],
                angular_momentum: [0.0; 3],
            }
        };
        let half = |tool: &barchan_core::scene::Tool| match tool.shape {
            Shape::Box { half: Some(half), .. } => half,
            _ => [0.01; 3],
        };
        Self {
            bodies: scene.tool.iter().map(body).collect(),
            half: scene.tool.iter().map(half).collect(),
            wrenches: vec![Wrench::default(); scene.tool.len()],
        }
    }
}

impl Coupling for Boxes {
    fn name(&self) -> &str {
        "rigid"
    }
    fn bodies(&self) -> Vec<BodyState> {
        self.bodies.clone()
    }
    fn max_speed(&self, _: f64, _: f64) -> f64 {
        self.bodies.iter().flat_map(|b| b.velocity).map(f64::abs).fold(0.0, f64::max)
    }
    fn before_step(&mut self, _: f64, _: f64) -> Result<()> {
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        Vec::new()
    }
    fn after_step(&mut self, _: f64, dt: f64) -> Result<()> {
        for body in &mut self.bodies {
            (0..3).for_each(|d| body.position[d] += dt * body.velocity[d]);
        }
        Ok(())
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        let to = |x: &Vec3, (body, half): (&BodyState, &Vec3)| {
            (0..3).map(|d| (x[d] - body.position[d]).abs() - half[d]).fold(f64::NEG_INFINITY, f64::max)
        };
        let nearest = |x| self.bodies.iter().zip(&self.half).map(|b| to(x, b)).fold(f64::INFINITY, f64::min);
        points.iter().map(nearest).collect()
    }
    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        let &Command::Twist { linear: velocity, .. } = command else { unreachable!("no test asks for it") };
        self.bodies.iter_mut().filter(|b| b.name == body).for_each(|b| b.velocity = velocity);
        Ok(())
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        vec!["boxes do not turn".to_owned()]
    }
    fn counts(&self) -> Vec<(String, u64)> {
        vec![("boxes".to_owned(), self.bodies.len() as u64)]
    }
    fn save(&self) -> Vec<u8> {
        self.bodies.iter().flat_map(|b| b.position.into_iter().chain(b.velocity)).flat_map(f64::to_le_bytes).collect()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        if bytes.len() != 48 * self.bodies.len() {
            return Err(format!("{} bytes for {} bodies", bytes.len(), self.bodies.len()));
        }
        let mut numbers = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b));
        for body in &mut self.bodies {
            for x in body.position.iter_mut().chain(&mut body.velocity) {
                *x = numbers.next().unwrap();
            }
        }
        Ok(())
    }
}

/// What the engines of this process do beyond falling.
#[derive(Debug, Default)]
pub struct Fate {
    /// Step (from 0) at which they fail; 0: never.
    pub fails_at: AtomicU64,
    /// From this step on the bound is a tenth; 0: never.
    pub stiffens_at: AtomicU64,
    /// Do they take no steps at all, and not say why?
    pub mute: AtomicBool,
    /// Factor by which velocities grow every step, in thousandths; 0: they do not.
    pub grows: AtomicU64,
}

/// Particles fall and nothing else happens.
pub struct Ballistic;

thread_local! {
    /// Of the engines that this thread's tests make.
    pub static FATE: Arc<Fate> = Arc::default();
}

impl Backend for Ballistic {
    fn name(&self) -> &str {
        "cpu"
    }
    fn doc(&self) -> &str {
        "Free fall."
    }
    fn has_form(&self, _: Stage, form: Form) -> bool {
        form == Form::Forward
    }
    fn compile(&self, plan: &Plan, particles: ParticleState) -> Result<Box<dyn Engine>> {
        Ok(Box::new(Falling {
            particles,
            gravity: plan.gravity,
            bound: plan.bound.clone(),
            steps: 0,
            summed: 0.0,
            fate: FATE.with(Arc::clone),
        }))
    }
}

struct Falling {
    particles: ParticleState,
    gravity: Vec3,
    bound: Bound,
    steps: u64,
    /// Steps that an engine before this one has summed up as an impulse.
    summed: f64,
    fate: Arc<Fate>,
}

impl Falling {
    fn past(&self, mark: &AtomicU64) -> bool {
        let mark = mark.load(Ordering::Relaxed);
        mark > 0 && self.steps >= mark
    }
}

impl Engine for Falling {
    fn bound(&self) -> Bound {
        let factor = if self.past(&self.fate.stiffens_at) { 0.1 } else { 1.0 };
        Bound { dt: self.bound.dt * factor, by: self.bound.by.clone() }
    }
    fn steps(
        &mut self,
        time: f64,
        dt: f64,
        _: usize,
        couplings: &mut [Box<dyn Coupling>],
        _: bool,
    ) -> Result<Vec<StepReport>> {
        let is_mute = self.fate.mute.load(Ordering::Relaxed);
        if is_mute { Ok(Vec::new()) } else { Ok(vec![self.step(time, dt, couplings)?]) }
    }
    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        begin_step(couplings, time, dt)?;
        Contact::default().meet(couplings, dt, &mut NodeBatch::default())?;
        couplings.iter_mut().try_for_each(|coupling| coupling.after_step(time, dt))?;
        if self.past(&self.fate.fails_at) {
            return Err(Error::LeftWorld { step: self.steps, particle: 0, position: [0.0; 3], wall: None });
        }
        let growth = self.fate.grows.load(Ordering::Relaxed) as f64 / 1000.0;
        let growth = if growth > 0.0 { growth } else { 1.0 };
        for list in &mut self.particles.lists {
            for i in 0..list.len() {
                for d in 0..3 {
                    let v = f64::from(((list.velocity[i][d] + dt * self.gravity[d]) * growth) as f32);
                    list.velocity[i][d] = v;
                    let counts = ((list.offset[i][d] + dt * v / list.cell_width) * 2_f64.powi(32)).round() as i64;
                    list.cell[i][d] += (counts >> 32) as i32;
                    list.offset[i][d] = (counts & 0xffff_ffff) as f64 / 2_f64.powi(32);
                }
            }
        }
        self.particles.strain_dt = dt;
        self.steps += 1;
        Ok(StepReport { dt, sorted: false, max_speed: 0.0, wrenches: None, bodies: None, adapted: None })
    }
    fn download(&self) -> ParticleState {
        self.particles.clone()
    }
    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        self.particles = particles;
        Ok(())
    }
    fn particle_count(&self) -> usize {
        self.particles.lists.iter().map(barchan_core::ParticleList::len).sum()
    }
    fn account(&self, ledger: &mut Ledger) {
        for list in &self.particles.lists {
            for i in 0..list.len() {
                let v = list.velocity[i];
                ledger.particles += 1;
                ledger.mass += list.mass[i];
                ledger.kinetic += 0.5 * list.mass[i] * v.iter().map(|c| c * c).sum::<f64>();
                ledger.potential -= list.mass[i] * self.gravity[2] * list.position(i)[2];
            }
        }
        ledger.elastic = f64::NAN;
        ledger.gravity_impulse[2] += self.summed + self.steps as f64;
        ledger.count("fallen", self.steps);
    }
    fn carry_on(&mut self, sums: &Ledger) {
        self.summed = sums.gravity_impulse[2];
    }
    fn timings(&self) -> Vec<Timing> {
        Vec::new()
    }
    fn memory(&self) -> (u64, u64) {
        (0, 0)
    }
}
