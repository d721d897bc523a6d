//! A backend outside Barchan's own crates: `dust`, whose particles fly without touching each other.
//!
//! Gravity is all that it knows, and what its parameter `drag` slows down. It has no form of the stage contact, and says so when a scene calls for one.

use barchan::backend::{Bound, Timing};
use barchan::parameter::{Parameter, Range};
use barchan::{
    Backend, Coupling, Engine, Form, Ledger, ParticleList, ParticleState, Plan, Registry, Result, Scene, Stage,
    StepReport,
};
use std::sync::Arc;
use std::time::Instant;

/// Registers the backend.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    registry.add_backend(Arc::new(Dust))
}

/// The backend called `dust`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Dust;

impl Backend for Dust {
    fn name(&self) -> &str {
        "dust"
    }
    fn doc(&self) -> &str {
        "Particles fly without touching each other: no grid, no stress, no contact."
    }
    fn parameters(&self) -> Vec<Parameter> {
        let doc = "How fast particles lose their velocity to the air.";
        vec![Parameter::number("drag", "1/s", Range::NOT_NEGATIVE, doc).or(0.0)]
    }
    fn has_form(&self, stage: Stage, form: Form) -> bool {
        form == Form::Forward && ![Stage::CONTACT, Stage::BODIES].contains(&stage)
    }
    fn compile(&self, plan: &Plan, particles: ParticleState) -> Result<Box<dyn Engine>> {
        plan.check_forms(self)?;
        let (scene, drag) = (plan.scene.clone(), plan.backend_parameters.number("drag"));
        Ok(Box::new(Flight { particles, scene, drag, seconds: 0.0, steps: 0 }))
    }
}

/// Particles in flight.
struct Flight {
    particles: ParticleState,
    scene: Scene,
    /// [1/s]
    drag: f64,
    seconds: f64,
    steps: u64,
}

impl Engine for Flight {
    fn bound(&self) -> Bound {
        Bound { dt: f64::INFINITY, by: "nothing".to_owned() }
    }
    fn step(&mut self, time: f64, dt: f64, _: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let clock = Instant::now();
        let gravity = self.scene.gravity_at(time);
        let mut max_speed = 0f64;
        for list in &mut self.particles.lists {
            for i in 0..list.len() {
                for d in 0..3 {
                    let v = (list.velocity[i][d] + dt * gravity[d]) / (1.0 + self.drag * dt);
                    let moved = list.offset[i][d] + dt * v / list.cell_width;
                    list.velocity[i][d] = v;
                    list.cell[i][d] += moved.floor() as i32;
                    list.offset[i][d] = moved - moved.floor();
                    max_speed = max_speed.max(v.abs());
                }
            }
        }
        self.steps += 1;
        self.seconds += clock.elapsed().as_secs_f64();
        Ok(StepReport { dt, sorted: false, max_speed, wrenches: None, bodies: None, adapted: None })
    }
    fn download(&self) -> ParticleState {
        self.particles.clone()
    }
    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        self.particles = particles;
        Ok(())
    }
    fn particle_count(&self) -> usize {
        self.particles.lists.iter().map(ParticleList::len).sum()
    }
    fn account(&self, ledger: &mut Ledger) {
        for list in &self.particles.lists {
            for i in 0..list.len() {
                let (m, x, v) = (list.mass[i], list.position(i), list.velocity[i]);
                ledger.particles += 1;
                ledger.mass += m;
                for d in 0..3 {
                    ledger.momentum[d] += m * v[d];
                    ledger.kinetic += 0.5 * m * v[d] * v[d];
                    ledger.potential -= m * self.scene.gravity[d] * x[d];
                }
            }
        }
    }
    fn carry_on(&mut self, _: &Ledger) {
        // Nothing is summed up over time.
    }
    fn timings(&self) -> Vec<Timing> {
        vec![Timing { effect: "flight".to_owned(), seconds: self.seconds, passes: self.steps }]
    }
    fn memory(&self) -> (u64, u64) {
        // Id, body, cell, offset, velocity, affine matrix, mass, rest volume, strain and history.
        let bytes = |list: &ParticleList| {
            list.len() * (8 + 2 + 12 + 8 * (3 + 3 + 9 + 2 + list.strain.len() + list.state.len()))
        };
        (self.particles.lists.iter().map(|list| bytes(list) as u64).sum(), 0)
    }
}
