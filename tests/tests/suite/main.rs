//! All suites that cross crates, in one binary: one module a subject.

mod determinism;
mod hard_cases;
mod coupling;
mod transfers;
mod validation;
mod walls;
