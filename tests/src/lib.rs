//! What the suites share: a plain reference implementation, short ways to say a scene, and the cases that also run long.

pub mod arguments;
pub mod forks;
pub mod goldens;
pub mod granular;
pub mod large_cases;
pub mod leaving;
pub mod limits;
pub mod long_cases;
pub mod random;
pub mod readings;
pub mod reference;
pub mod report;
pub mod scenes;
pub mod sketch;
pub mod sleeping;
pub mod snapshots;
pub mod stops;
