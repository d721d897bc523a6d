//! The time step: what bounds it, and what it is chosen to be.

use super::PlannedMaterial;
use crate::backend::Bound;
use crate::scene::OverBound;
use crate::{Coupling, Error, Result, Scene};

/// Greatest fraction of a cell that a tool's surface may move in one step. Of sand that a plate strikes faster than sound,
/// particles end up 0.8 cells deep in the plate at 0.4 cells a step, 1.3 at 0.5.
pub const TOOL_COURANT: f64 = 0.4;

/// Where no ground bounds it, an automatic step is at most this long [s].
const UNBOUND_STEP: f64 = 5e-3;

/// Relative width to which the longest step is found that tools bear: it is short of what it might be by that at most.
const TOOL_STEP_WIDTH: f64 = 1e-3;

/// The bound that the undeformed ground sets.
pub(super) fn ground_bound(scene: &Scene, materials: &[PlannedMaterial]) -> Result<Bound> {
    let mut bound = Bound { dt: f64::INFINITY, by: "nothing".to_owned() };
    for planned in materials {
        let whole = |own: Bound| Bound { dt: own.dt * f64::from(scene.levels.substeps()), ..own };
        if let Some(own) = planned.bound(scene.world.cell)?.map(whole).filter(|own| own.dt < bound.dt) {
            bound = own;
        }
    }
    Ok(bound)
}

/// Tightens what the ground bears so that no tool's surface moves more than [`TOOL_COURANT`] cells in any of so many steps from `time` [s].
pub(crate) fn tighten(ground: Bound, couplings: &[Box<dyn Coupling>], time: f64, h: f64, steps: u64) -> Bound {
    couplings.iter().fold(ground, |bound, coupling| {
        let longest = if bound.dt.is_finite() { bound.dt } else { UNBOUND_STEP };
        let borne = |dt: f64| TOOL_COURANT * h / coupling.max_speed(time, dt * steps as f64);
        // A shorter step sees less of what a tool is about to do, so that it bears at least what a longer one does.
        let (mut least, mut most) = (borne(longest), longest);
        if least.total_cmp(&most).is_ge() {
            return if least < bound.dt { by_tool(coupling.as_ref(), least) } else { bound };
        }
        // Of one that is as fast at once there is nothing to find.
        while least > 0.0 && least < (1.0 - TOOL_STEP_WIDTH) * most && borne(least) > least {
            let middle = (least * most).sqrt();
            let borne = borne(middle);
            if borne < middle { (least, most) = (least.max(borne), middle) } else { least = middle }
        }
        by_tool(coupling.as_ref(), least)
    })
}

fn by_tool(coupling: &dyn Coupling, dt: f64) -> Bound {
    Bound { dt, by: format!("coupling '{}': speed of a tool", coupling.name()) }
}

/// The step that a scene asks for under a bound, before [`OverBound`] is considered [s]. Where the ground sets none, there is a longest one.
pub(crate) fn wanted_step(scene: &Scene, ground: &Bound, bound: &Bound) -> f64 {
    let longest = if ground.dt.is_finite() { f64::INFINITY } else { UNBOUND_STEP };
    let given = scene.time.step.map(|step| step * f64::from(scene.levels.substeps()));
    given.unwrap_or_else(|| (scene.time.safety * bound.dt).min(longest))
}

pub(super) fn first_step(scene: &Scene, ground: &Bound, bound: &Bound, resumed: bool) -> Result<f64> {
    let dt = wanted_step(scene, ground, bound);
    if dt == 0.0 && !resumed {
        return Err(Error::TimeStep { step: 0, dt, bound: bound.dt, by: bound.by.clone() });
    }
    if dt <= bound.dt || resumed {
        return Ok(dt);
    }
    match scene.time.over_bound {
        OverBound::Refuse => Err(Error::TimeStep { step: 0, dt, bound: bound.dt, by: bound.by.clone() }),
        OverBound::Substep => Ok(cut(dt, scene.time.safety * bound.dt)),
        OverBound::Allow => Ok(dt),
    }
}

/// `dt` divided into the fewest equal parts that are at most `most`.
pub(crate) fn cut(dt: f64, most: f64) -> f64 {
    dt / (dt / most).ceil().max(1.0)
}
