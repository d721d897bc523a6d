//! All suites that cross crates, in one binary: one module a subject.

mod conformance;
mod contact_edges;
mod coupling;
mod damping;
mod determinism;
mod effects;
mod goldens;
mod hard_cases;
mod instruction_sets;
mod levels;
mod libraries;
mod output;
mod passes;
mod plugins;
mod properties;
mod random;
mod seams;
mod settled;
mod sleeping;
mod subcycling;
mod swap;
mod transfers;
mod unbounded;
mod validation;
mod walls;
mod worlds;
