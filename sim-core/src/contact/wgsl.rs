//! Contact on GPUs, as WGSL: a backend puts bindings and what its passes share before these texts.

/// The law between nodes and bodies.
pub const CONTACT_LAW: &str = include_str!("contact_law.wgsl");
/// How far to go along a step of Newton's method.
pub const SEARCH: &str = include_str!("search.wgsl");
/// Fields and driven bodies on the nodes near them.
pub const CONTACT: &str = include_str!("contact.wgsl");
/// How particles press on bodies, for each node of a block.
pub const PRESS: &str = include_str!("press.wgsl");
/// A body as that pass needs it.
pub const PRESSED: &str = include_str!("pressed.wgsl");
/// Driven bodies as it finds them.
pub const PRESS_DRIVEN: &str = include_str!("press_driven.wgsl");
/// Bodies that answer as it finds them.
pub const PRESS_ANSWERING: &str = include_str!("press_answering.wgsl");
