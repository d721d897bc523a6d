//! Suites that cross Barchan's crates: conformance, hard cases, validation, plugins, determinism.
