//! The core of Barchan: what a scene is, what a plugin must offer, and how a simulation is put together and stepped.
//!
//! ```text
//! scene.toml -> Scene -> Registry -> Plan (the effects called for, and why) -> Backend::compile -> Simulation
//! ```
//! This crate names no plugin. Materials, couplings, backends and tasks meet in the [`Registry`] by kind and name.
#![expect(unsafe_code, reason = "the loader and the material wrapper call through the C ABI")]
#![allow(
    clippy::result_large_err,
    reason = "Error::Missing has 136 bytes, 8 above the lint's mark; errors end a run, so their size costs nothing"
)]

pub mod account;
pub mod archive;
pub mod backend;
pub mod batch;
pub mod contact;
pub mod coupling;
pub mod error;
pub mod file;
pub mod flow;
pub mod gradient;
pub mod ledger;
pub mod levels;
pub mod loader;
pub mod material;
pub mod nearest;
pub mod observer;
pub mod parameter;
pub mod plan;
pub mod probe;
pub mod reading;
pub mod registry;
mod runout;
pub mod scene;
pub mod schedule;
pub mod seed;
pub mod sense;
mod settle;
pub mod simulation;
pub mod snapshot;
pub mod solid;
pub mod state;
pub mod stiffness;
pub mod stress;
pub mod surface;
pub mod task;
pub mod together;
mod zoned;

pub use archive::Tile;
pub use backend::{Adjoint, Backend, Engine, StepReport};
pub use coupling::{
    Aabb, BodyState, Command, Coupling, GREATEST, JointState, NearParticle, NodeBatch, Placement, Wrench,
};
pub use error::{Error, Result};
pub use flow::Newcomer;
pub use gradient::{Cotangents, Gradient, Tape};
pub use ledger::Ledger;
pub use levels::{Adapted, LevelChange, Regions};
pub use material::Material;
pub use observer::{Observer, Output};
pub use plan::{Effect, Plan, Precision};
pub use probe::{Apart, Closest, Crossed, Probed, Sought, Sums};
pub use reading::{Fields, Reading};
pub use registry::Registry;
pub use scene::Scene;
pub use schedule::{Form, Schedule, Stage};
pub use seed::Terrain;
pub use sense::{HeightScan, LinkState, Patch, PointForce, RobotState};
pub use simulation::{Options, Simulation, State};
pub use state::{LevelPhase, Measured, ParticleList, ParticleState, SortPhase, Spot};
pub use surface::Surface;
pub use task::Task;
pub use together::Together;

/// The vectors and matrices of [`contact`].
pub use glam;

/// A point, vector or triple of factors: x, y, z.
pub type Vec3 = [f64; 3];
