//! The CPU backend: f32 and f64, the machine's vector instructions, all cores, no GPU needed.
//!
//! Determinism is a contract: the same input gives the same bits with any number of threads (per instruction set). Work is cut
//! into blocks of cells, never by thread count; no two blocks write the same memory; sums over blocks run in the blocks' order.
//! What hands them out is one type, `memory::Parts`, which no code here can make give the same memory to two threads.
#![deny(unsafe_code)]

mod account;
mod adapt;
mod adjoint;
mod archive;
mod awake;
mod engine;
mod faults;
mod flow;
mod flux;
mod grid;
mod isolated;
mod level;
mod memory;
mod near;
mod reading;
mod sleep;
mod step;
mod store;

use barchan_core::{Adjoint, Backend, Engine, Error, Form, ParticleState, Plan, Precision, Registry, Result, Stage};
use barchan_grid::transfer::MAX_STATE;
use std::sync::Arc;

/// The backend called `cpu`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cpu;

impl Backend for Cpu {
    fn name(&self) -> &str {
        "cpu"
    }

    fn doc(&self) -> &str {
        "Runs on the processor: f32 or f64, SIMD chosen at run time (AVX-512, AVX2, or what the target guarantees), all cores, \
         the same bits for any number of threads."
    }

    fn has_form(&self, stage: Stage, form: Form) -> bool {
        match form {
            Form::Forward => step::forward::<f32>(stage).is_some(),
            // Where particles lie in memory, what probes see and how long a step may be move nothing.
            Form::Adjoint => [
                Stage::ARCHIVE,
                Stage::ADAPT,
                Stage::SORT,
                Stage::P2G,
                Stage::RESTRICT,
                Stage::GRID_UPDATE,
                Stage::CONTACT,
                Stage::LIMIT,
                Stage::BODIES,
                Stage::PROLONG,
                Stage::SIDES,
                Stage::G2P,
                Stage::FLUX,
                Stage::PRESS,
            ]
            .contains(&stage),
        }
    }

    fn check(&self, plan: &Plan) -> Result<()> {
        plan.check_forms(self)?;
        if let Some(planned) = plan.materials.iter().find(|m| m.material.states.len() > MAX_STATE) {
            return Err(Error::Missing {
                kind: "backend",
                name: self.name().into(),
                origin: "built-in".into(),
                what: format!("room for {} history variables; it has {MAX_STATE}", planned.material.states.len()),
                why: format!("material '{}' has the law '{}'", planned.name, planned.material.name),
                mend: "declare fewer, or choose another backend".into(),
            });
        }
        Ok(())
    }

    fn compile(&self, plan: &Plan, particles: ParticleState) -> Result<Box<dyn Engine>> {
        self.check(plan)?;
        Ok(match plan.precision {
            Precision::F32 => Box::new(engine::CpuEngine::<f32>::new(plan, particles)?),
            Precision::F64 => Box::new(engine::CpuEngine::<f64>::new(plan, particles)?),
        })
    }

    fn adjoint(&self, plan: &Plan) -> Result<Box<dyn Adjoint>> {
        Ok(Box::new(adjoint::CpuAdjoint::new(plan)?))
    }
}

/// Registers the backend.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    registry.add_backend(Arc::new(Cpu))
}
