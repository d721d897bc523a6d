//! Random scenes, and what must hold for every one of them.
//!
//! [`Generator`] draws scenes from the same declarations that the JSON schema is made of: keys, types, choices, and the units that stand in
//! brackets in their descriptions; laws, couplings and their parameters from the registry. A key that is new is drawn as its type and unit say.
//! [`Judge`] runs a scene and says what it breaks; [`shrink()`] finds the least scene that breaks the same.

mod draw;
mod judge;
mod shrink;

pub use draw::{Generator, write_files};
pub use judge::{Failure, Judge, Outcome, Rule};
pub use shrink::shrink;
