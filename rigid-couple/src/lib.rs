//! Rigid tools and bodies: signed distance fields, motion, contact with soft ground.
//!
//! One step of [`Rigid`], the coupling that a scene's `tool` entries make:
//! 1. [`motion`]: a driven tool's velocity is the chord of its path over the step, so that its pose afterwards is exact; a
//!    free body takes up gravity.
//! 2. [`sdf`]: every grid node inside a body gets its distance and normal, and how it is held (`grip.rs`).
//! 3. [`barchan_core::contact`]: the node's velocity relative to the surface loses what the contact law forbids. For a free body this is
//!    solved together with the body's own velocity, so that no mass ratio is unstable, and the body receives exactly the
//!    momentum that the nodes lose.
//! 4. [`world`]: contacts of a free body with the world's walls (rapier), and its motion. One that may touch more is solved with all of that in [`robot`].
//!
//! Nothing here knows the grid: nodes come in batches, through [`barchan_core::Coupling`]. Meshes are read in [`mesh`], masses
//! and inertias come from [`mass`].

#![expect(clippy::result_large_err, reason = "errors are rare, carry what a user needs, and end the run")]

mod grip;
pub mod mass;
pub mod mesh;
pub mod motion;
pub mod rigid;
pub mod robot;
pub mod sdf;
mod surface;
mod tables;
mod terrain;
pub mod world;

pub use mesh::MeshSolid;
pub use rigid::Rigid;
pub use robot::Robots;
pub use sdf::Sdf;

use barchan_core::plan::{ROBOT_COUPLING, TOOL_COUPLING};
use barchan_core::scene::{Tool, World};
use barchan_core::{Aabb, Error, Registry, Result, Scene};
use std::sync::Arc;

/// Registers the couplings "rigid" and "robots", and the reader of triangle meshes.
///
/// # Errors
/// If another plugin has taken the name.
pub fn register(registry: &mut Registry) -> Result<()> {
    registry.set_mesh_reader(Arc::new(|file, scale| {
        let mesh = mesh::TriangleMesh::read(file, scale).map_err(|refusal| refusal.at(&file.display().to_string()))?;
        Ok(Box::new(MeshSolid::new(&mesh)) as _)
    }));
    registry.add_coupling(
        TOOL_COUPLING,
        "Rigid tools and free rigid bodies in contact with the ground",
        Vec::new(),
        Arc::new(|setup| Ok(Box::new(Rigid::new(setup.scene)?.called(setup.name)) as _)),
    )?;
    registry.add_coupling(
        ROBOT_COUPLING,
        "Robots of links and joints on the ground, and free tools beside them or one another",
        Vec::new(),
        Arc::new(|setup| Ok(Box::new(Robots::new(setup.scene)?.called(setup.name)) as _)),
    )
}

/// Why a shape, a mesh or a motion cannot be used, before it is known where it stands in the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// What is wrong.
    pub what: String,
    /// What would mend it.
    pub mend: String,
}

impl Refusal {
    fn new(what: impl Into<String>, mend: impl Into<String>) -> Self {
        Self { what: what.into(), mend: mend.into() }
    }
    /// That something would be outside the world.
    fn outside(world: &World) -> Self {
        let what = format!("it would be outside the world, from {:?} to {:?}", world.min, world.max);
        Self::new(what, "give a position in the world, or above it")
    }
    /// The error for the thing at `path`, a key path or a name.
    pub fn at(self, path: &str) -> Error {
        Error::Body { path: path.into(), what: self.what, mend: self.mend }
    }
}

/// Holds a scene's tools to being there throughout, which gradients need.
fn always_there(scene: &Scene) -> Result<()> {
    let is_late = |tool: &&Tool| tool.from > 0.0 || tool.until.is_some();
    scene.tool.iter().find(is_late).map_or(Ok(()), |tool| {
        let what = "gradients do not go through tools that appear or vanish";
        Err(Refusal::new(what, "leave out from and until").at(&format!("tool '{}'", tool.name)))
    })
}

/// Does a body in such a box reach into the world, or is it above it, to fall in?
fn is_within_reach(bounds: &Aabb, scene: &Scene) -> bool {
    let mut reached = scene.reached_box();
    reached.max[2] = f64::INFINITY;
    bounds.meets(&reached)
}
