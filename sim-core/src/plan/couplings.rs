//! Couplings of a scene: one for its tools, and one for each entry.

use super::{ROBOT_COUPLING, TOOL_COUPLING};
use crate::parameter::Table;
use crate::registry::CouplingSetup;
use crate::{Coupling, Error, Registry, Result, Scene};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A coupling that a scene calls for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedCoupling {
    /// Kind, as registered.
    pub kind: String,
    /// Its own name: the entry's, or else made of the kind; see [`Scene::coupling_names`].
    pub name: String,
}

/// The couplings of a scene.
#[derive(Default)]
pub(super) struct Couplings {
    pub(super) planned: Vec<PlannedCoupling>,
    pub(super) made: Vec<Box<dyn Coupling>>,
    /// The files that they read.
    pub(super) files: Vec<PathBuf>,
}

/// What calls for a coupling.
struct Call<'a> {
    /// Key path.
    path: String,
    kind: &'a str,
    name: &'a str,
    parameters: &'a Table,
}

/// Makes the couplings: the tools' first, unless an entry of that kind says where it comes, then one for each entry in the scene's order.
///
/// 1. Kinds are looked up, and what entries say is held to what the kinds have declared.
/// 2. Each is made. One for tools, where there are none, is not.
/// 3. Names are held to be different: those of couplings, then those of all bodies.
///
/// # Errors
/// Unknown kinds and parameters, names that are taken, and the kinds' own, each with line and key.
pub(super) fn make_couplings(registry: &Registry, scene: &Scene) -> Result<Couplings> {
    let (names, none) = (scene.coupling_names(), Table::new());
    let entries = scene.coupling.iter().enumerate().zip(&names).map(|((i, spec), name)| Call {
        path: format!("coupling[{i}]"),
        kind: &spec.kind,
        name,
        parameters: &spec.parameters,
    });
    let has_own = |kind: &str| scene.coupling.iter().any(|spec| spec.kind == kind);
    let implied = |path: &str, kind: &'static str| Call { path: path.to_owned(), kind, name: kind, parameters: &none };
    let tools = (!scene.tool.is_empty() && !has_own(TOOL_COUPLING)).then(|| implied("tool", TOOL_COUPLING));
    // Who registers one coupling of tools alone has all of them there.
    let is_known = !scene.robot.is_empty() || registry.coupling(ROBOT_COUPLING).is_ok();
    let robots = (scene.has_robots() && is_known && !has_own(ROBOT_COUPLING)).then(|| implied("robot", ROBOT_COUPLING));
    let mut couplings = Couplings::default();
    let mut bodies = BTreeMap::new();
    for call in tools.into_iter().chain(robots).chain(entries) {
        let Call { path, kind: kind_name, name, parameters } = call;
        let place = if ["tool", "robot"].contains(&path.as_str()) { path.clone() } else { format!("{path}.kind") };
        let kind = registry.coupling(kind_name).map_err(|e| e.at(&scene.place(&place)))?;
        let path_of_parameters = format!("{path}.parameters");
        let whose = format!("coupling '{kind_name}'");
        let parameters = scene.resolve(whose, &kind.parameters, parameters, &path_of_parameters)?;
        let no_tools = scene.tools_apart().next().is_none();
        let has_none = [(TOOL_COUPLING, no_tools), (ROBOT_COUPLING, !scene.has_robots())];
        if has_none.contains(&(kind_name, true)) {
            continue;
        }
        if couplings.planned.iter().any(|planned| planned.name == name) {
            let what = format!("'{name}' is already the name of the coupling of the scene's tools or robots");
            return Err(scene.fault(&format!("{path}.name"), what, "names must differ"));
        }
        let made = kind.make(&CouplingSetup { scene, name, parameters: &parameters, path: path_of_parameters })?;
        if made.name() != name {
            return Err(Error::Missing {
                kind: "coupling",
                name: kind_name.to_owned(),
                origin: "registered".to_owned(),
                what: format!("name of its own: it calls itself '{}'", made.name()),
                why: format!("{path} is called '{name}'"),
                mend: "return CouplingSetup::name from Coupling::name".to_owned(),
            });
        }
        for body in made.bodies() {
            if let Some(other) = bodies.insert(body.name.clone(), name.to_owned()) {
                let what = format!("its body '{}' bears the name of one of the coupling '{other}'", body.name);
                return Err(scene.fault(&path, what, "names of bodies must differ: rename one of them"));
            }
        }
        couplings.planned.push(PlannedCoupling { kind: kind_name.to_owned(), name: name.to_owned() });
        couplings.files.extend(parameters.files().into_iter().map(ToOwned::to_owned));
        couplings.files.extend(made.files());
        couplings.made.push(made);
    }
    Ok(couplings)
}
