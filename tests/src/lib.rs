//! What the suites share: a plain reference implementation, short ways to say a scene, and the cases that also run long.

pub mod long_cases;
pub mod reference;
pub mod scenes;
pub mod sketch;
