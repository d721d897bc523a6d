//! What a material's author depends on.
//!
//! A material is a type that implements [`Material`]: a pure function of one particle, written once, generic over
//! [`Real`]. [`vtable`] turns it into the table of C functions that the engine calls, the same for built-ins and plugins,
//! in f32 and f64 and for the machine's instruction set; [`export_materials!`] exports it from a cdylib.
//! [`conformance`] tests any such table, also one written in C.
//!
//! - [`SymMat3`], [`Mat3`]: small tensors. [`Hencky`], [`left_stretch`], [`Eigen`]: their logarithm, polar decomposition
//!   and eigen-decomposition, safe at equal principal stretches.
//! - [`param`], [`state`]: declarations, which scene files are checked against.
#![expect(unsafe_code, reason = "the C interface is raw pointers")]

mod adjoint;
mod batch;
pub mod conformance;
mod declare;
mod material;
pub mod random;
mod spectral;
mod subject;
mod tensor;
pub mod timing;

pub use barchan_abi as abi;
pub use barchan_abi::{
    BARCHAN_CAP_FLUID, BARCHAN_CAP_HARDENS, BARCHAN_CAP_MAY_MAKE_ENERGY, BARCHAN_CAP_RATE_DEPENDENT,
    BARCHAN_CAP_VEL_GRAD, BarchanMaterial,
};
pub use barchan_lanes::{Dual, Mask, Real};
pub use batch::vtable;
pub use declare::{Param, State, param, poisson_ratio, state, young_modulus};
pub use material::{Events, Lame, MAX_PARAMS, MAX_STATE, MatIn, MatOut, Material, Strain, TangentModuli};
pub use spectral::{
    Eigen, Hencky, MIN_STRETCH_SQUARED, left_stretch, log_volume, near_identity, sqrt, sqrt_near_identity,
};
pub use subject::{Answer, MOST_STATES, Particle, Precision, PulledBack, Subject, SubjectError};
pub use tensor::{Mat3, SymMat3};
