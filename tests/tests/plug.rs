//! Being put together; becomes part of the suite.
#[path = "suite/conformance.rs"]
mod conformance;
#[path = "suite/effects.rs"]
mod effects;
#[path = "suite/libraries.rs"]
mod libraries;
#[path = "suite/plugins.rs"]
mod plugins;
#[path = "suite/properties.rs"]
mod properties;
#[path = "suite/seams.rs"]
mod seams;
