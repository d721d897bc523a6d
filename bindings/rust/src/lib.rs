//! Barchan simulates robots on and in soft ground: sand, snow, elastic and elastoplastic bodies, coupled with rigid tools.
//!
//! This crate registers everything built in and re-exports what a program needs:
//!
//! ```no_run
//! use barchan::{Options, Scene, Simulation};
//!
//! let registry = barchan::registry();
//! let scene = Scene::from_file("scene.toml")?;
//! let mut simulation = Simulation::new(&registry, &scene, &Options::default())?;
//! println!("{}", simulation.plan());
//! while simulation.time() < scene.time.end {
//!     simulation.step()?;
//! }
//! println!("{:#?}", simulation.ledger());
//! # Ok::<(), barchan::Error>(())
//! ```
//! [`run::run`] does the same with pictures, traces and a summary; [`picture`] draws, [`stress`] asks for stress, [`accuracy`]
//! tells how far a run is from a finer one, [`worlds`] steps many scenes side by side.
//!
//! Both features are on unless `default-features = false` leaves them out: `pictures` (the module [`picture`], and the pictures that
//! [`run::run`] makes) and `wgpu` (the backend of that name). Without them a program is built of 103 crates instead of 146.

pub mod accuracy;
pub mod conformance;
#[cfg(feature = "pictures")]
pub mod picture;
pub mod run;
pub mod stress;
pub mod worlds;

pub use barchan_core::{
    Backend, BodyState, Coupling, Effect, Engine, Error, Form, Ledger, Material, Measured, NodeBatch, Options,
    ParticleList, ParticleState, Plan, Precision, Registry, Result, Scene, Schedule, Simulation, SortPhase, Spot,
    Stage, StepReport, Task, Vec3, Wrench, backend, coupling, export, file, ledger, material, plan,
    registry as registries, scene, schedule, simulation, snapshot, solid, state, task,
};
pub use barchan_tasks as tasks;

/// A registry of everything that comes with Barchan; GPUs with the feature `wgpu`.
///
/// # Panics
/// If a built-in plugin breaks the rules for plugins, which the tests rule out.
pub fn registry() -> Registry {
    let mut registry = Registry::new();
    let materials = [
        barchan_elastic::materials(),
        barchan_sand::materials(),
        barchan_snow::materials(),
        barchan_elastoplastic::materials(),
        barchan_liquid::materials(),
    ];
    let registered = materials
        .into_iter()
        .flatten()
        .try_for_each(|table| registry.add_material(table, plan::BUILT_IN))
        .and_then(|()| barchan_rigid::register(&mut registry))
        .and_then(|()| barchan_backend_cpu::register(&mut registry));
    #[cfg(feature = "wgpu")]
    let registered = registered.and_then(|()| barchan_wgpu::register(&mut registry));
    registered.expect("built-in plugins keep to the rules and have names of their own");
    registry
}
