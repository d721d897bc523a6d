//! The GPU backend: every pass in WGSL, in f32, on any adapter that Vulkan, Metal or Direct3D 12 offers, software ones
//! included.
//!
//! Within a step nothing is copied to the host, except for couplings whose law runs there. Many steps go to the device
//! in one submission. Where levels have to move, or particles between them, the particles concerned are copied to the
//! host for a round of split and merge. Sums run in orders that do not depend on which workgroup comes first, and no
//! float is added atomically. So the same adapter gives the same bits.
#![expect(
    unsafe_code,
    reason = "drivers get shaders whose bounds checks are left out where naga's have been shown not to be needed"
)]

pub mod device;
mod engine;
mod passes;
pub mod points;
mod readback;
mod schedule;
pub mod shared;
mod worlds;

pub use passes::{Shader, material, shaders};

use crate::device::lacks;
use barchan_core::backend::{Adapter, Batch, NewWorld};
use barchan_core::{Backend, Coupling, Engine, Form, ParticleState, Plan, Precision, Registry, Result, Stage};
use std::sync::Arc;

/// The backend called `wgpu`.
#[derive(Clone, Debug, Default)]
pub struct Wgpu {
    /// How much of what an adapter offers is used: all of it, except to test what runs on the poorest adapter.
    pub offer: device::Offer,
    /// An open device to run everything on, whatever adapter is asked for. If absent, each simulation opens its own.
    pub device: Option<Arc<device::Gpu>>,
}

impl Backend for Wgpu {
    fn name(&self) -> &str {
        device::BACKEND
    }

    fn doc(&self) -> &str {
        "Runs on a GPU through Vulkan, Metal or Direct3D 12, or on software in its place: f32, every pass in WGSL, the same \
         bits on the same adapter."
    }

    fn has_form(&self, stage: Stage, form: Form) -> bool {
        form == Form::Forward && schedule::has_form(stage)
    }

    fn adapters(&self) -> Option<Vec<Adapter>> {
        Some(device::list())
    }

    fn check_couplings(&self, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        couplings.iter().try_for_each(|coupling| passes::coupling_check::check(&**coupling))
    }

    fn check(&self, plan: &Plan) -> Result<()> {
        plan.check_forms(self)?;
        if plan.precision == Precision::F64 {
            return Err(lacks("64-bit floats", "the run is in f64", "run in f32, or use the backend cpu"));
        }
        if plan.materials.len() > device::layout::MAX_LAWS {
            let why = format!("bodies use {} materials", plan.materials.len());
            return Err(lacks(
                format!("room for more than {} materials", device::layout::MAX_LAWS),
                why,
                "use fewer, or the backend cpu",
            ));
        }
        device::layout::check_count(plan.particle_count, "simulate fewer, or use the backend cpu")?;
        plan.materials.iter().try_for_each(|planned| material::check(&planned.material))
    }

    fn most_particles(&self, adapter: Option<&str>, values: usize) -> Result<Option<u64>> {
        let limits = match &self.device {
            Some(gpu) => gpu.limits.clone(),
            None => device::limits(adapter, self.offer)?,
        };
        Ok(Some(device::memory::most_particles(&limits, values)))
    }

    fn passes(&self, plan: &Plan) -> Vec<String> {
        schedule::describe::describe(plan).unwrap_or_default()
    }

    fn compile(&self, plan: &Plan, particles: ParticleState) -> Result<Box<dyn Engine>> {
        Ok(Box::new(batch_of(self, vec![NewWorld { plan, particles, couplings: &[] }])?.engine(0)))
    }

    fn has_batches(&self) -> bool {
        true
    }

    fn compile_batch(&self, worlds: Vec<NewWorld<'_>>) -> Result<Box<dyn Batch>> {
        Ok(Box::new(batch_of(self, worlds)?))
    }
}

/// Worlds on the adapter that the first one asks for.
fn batch_of(backend: &Wgpu, worlds: Vec<NewWorld<'_>>) -> Result<engine::Worlds> {
    worlds.iter().try_for_each(|world| backend.check(world.plan))?;
    let adapter = worlds.first().and_then(|world| world.plan.adapter.as_deref());
    let gpu = match &backend.device {
        Some(gpu) => Arc::clone(gpu),
        None => Arc::new(device::open_with(adapter, backend.offer)?),
    };
    let threads = worlds.first().map_or(0, |world| world.plan.threads);
    engine::Worlds::new(gpu, worlds, threads)
}

/// Registers the backend.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    registry.add_backend(Arc::new(Wgpu::default()))
}
