//! An observer outside Barchan's own crates: how fast the ground drifts.

use barchan::{Observer, Output, Registry, Result, Simulation};
use std::sync::Arc;

/// Name of the observer.
pub const NAME: &str = "drift";

/// Registers the observer.
///
/// # Errors
/// If the name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let doc = "How fast the ground drifts: two columns of the trace, every 5 ms.";
    registry.add_observer(NAME, doc, Arc::new(|_| Ok(Some(Box::new(Drift)))))
}

struct Drift;

impl Observer for Drift {
    fn name(&self) -> &str {
        NAME
    }
    fn interval(&self) -> f64 {
        5e-3
    }
    fn columns(&self) -> Vec<String> {
        vec!["vx, mean [m/s]".to_owned(), "kinetic [J]".to_owned()]
    }
    fn observe(&mut self, simulation: &Simulation, output: &mut dyn Output) -> Result<()> {
        let ledger = simulation.ledger();
        output.set(0, ledger.momentum[0] / ledger.mass);
        output.set(1, ledger.kinetic);
        Ok(())
    }
}
