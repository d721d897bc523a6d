//! Materials of a scene: their laws looked up, their parameters resolved.

use super::Precision;
use crate::backend::Bound;
use crate::material::ErrorBuffer;
use crate::parameter::Given;
use crate::scene::MaterialSpec;
use crate::stiffness::{Damping, Moduli, Stiffness};
use crate::{Error, Material, Registry, Result, Scene};
use barchan_abi as abi;

/// Where laws come from that need no library.
pub const BUILT_IN: &str = "built-in";

/// A material of the scene, ready for a backend.
#[derive(Clone, Debug)]
pub struct PlannedMaterial {
    /// Name in the scene.
    pub name: String,
    /// The law.
    pub material: Material,
    /// All parameters in the law's order, SI.
    pub parameters: Vec<f64>,
    /// Density at rest [kg/m³].
    pub density: f64,
    /// Damping of elastic strain, if the scene asks for any.
    pub damping: Option<Damping>,
}

impl PlannedMaterial {
    /// How errors name it: with its law and library, if it comes from one.
    pub fn label(&self) -> String {
        match self.material.origin.as_str() {
            BUILT_IN => self.name.clone(),
            library => format!("{}: law '{}' of {library}", self.name, self.material.name),
        }
    }

    /// Resident bytes of one of its particles in a backend.
    pub fn particle_bytes(&self, precision: Precision) -> u64 {
        let planes = self.material.values();
        let (real, offset) = if precision == Precision::F32 { (4, 4) } else { (8, 8) };
        let indices = 3 * 4 + 3 * offset + 8 + 2;
        // Velocity, affine matrix, mass, rest volume, strain and history.
        (indices + real * (3 + 9 + 2 + planes)) as u64
    }

    /// Greatest stable step of an undeformed particle alone in its cells, in a grid of cell width `h` [m] ([`Moduli::need`]), and what
    /// sets it. `None` if the law gives no tangent moduli.
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] if a callback fails or gives what bounds no step.
    pub fn bound(&self, h: f64) -> Result<Option<Bound>> {
        let Some(stiffness) = Stiffness::of(self) else { return Ok(None) };
        Ok(Some(stiffness.bound(stiffness.at_rest()?.need(h, self.density), 1)))
    }

    /// Its stiffness against being pushed into, λ + 2μ of the undeformed material [Pa]; of a law without tangent moduli the greatest that the
    /// scene's step bears.
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] if a callback fails or gives what bounds no step.
    pub fn contact_modulus(&self, scene: &Scene) -> Result<f64> {
        if let Some(stiffness) = Stiffness::of(self) {
            return Ok(stiffness.at_rest()?.p_wave);
        }
        let step = scene.time.step.expect("a law without moduli is refused where the scene gives no step");
        Ok(self.density * (scene.world.cell / step).powi(2))
    }

    /// Poisson's ratio of the undeformed material, if it bears shear and gives its moduli.
    pub(super) fn poisson_ratio(&self) -> Result<Option<f64>> {
        if self.material.has(abi::BARCHAN_CAP_FLUID) {
            return Ok(None);
        }
        let Some(stiffness) = Stiffness::of(self) else { return Ok(None) };
        let Moduli { p_wave, triple_bulk, .. } = stiffness.at_rest()?;
        let (lambda, mu) = (0.5 * (triple_bulk - p_wave), 0.25 * (3.0 * p_wave - triple_bulk));
        Ok(Some(0.5 * lambda / (lambda + mu)))
    }

    /// Value of a parameter by name.
    pub(super) fn parameter(&self, name: &str) -> Option<f64> {
        self.material.parameters.iter().position(|p| p.name == name).map(|i| self.parameters[i])
    }
}

/// The materials among some that come from libraries, for errors that cannot tell which one it was.
pub fn loaded(materials: &[PlannedMaterial]) -> String {
    let loaded = materials.iter().filter(|planned| planned.material.origin != BUILT_IN);
    loaded.map(PlannedMaterial::label).collect::<Vec<_>>().join(", ")
}

/// The materials that bodies and sources use, in the scene's order.
pub(super) fn plan_materials(registry: &Registry, scene: &Scene, precision: Precision) -> Result<Vec<PlannedMaterial>> {
    let used = |spec: &MaterialSpec| {
        scene.body.iter().any(|body| body.materials().contains(&spec.name.as_str()))
            || scene.inflow.iter().any(|source| source.material == spec.name)
    };
    let mut planned = Vec::new();
    for (i, spec) in scene.material.iter().enumerate() {
        let path = format!("material[{i}]");
        let law = registry.material(&spec.law).map_err(|e| e.at(&scene.place(&format!("{path}.law"))))?;
        let parameters = resolve(scene, &path, spec, law)?;
        if !used(spec) {
            continue;
        }
        let missing = |what: &str, why: String, mend: &str| Error::Missing {
            kind: "material",
            name: law.name.clone(),
            origin: law.origin.clone(),
            what: what.to_owned(),
            why,
            mend: mend.to_owned(),
        };
        if precision == Precision::F64 && law.table.update_f64.is_none() {
            return Err(missing(
                "update_f64",
                "the run is in f64".to_owned(),
                "run in f32, or add the callback to the plugin",
            ));
        }
        if law.table.tangent_moduli_f32.is_none() && scene.time.step.is_none() {
            return Err(missing(
                "tangent_moduli_f32",
                "time.step is absent, so the step must follow the material's stiffness".to_owned(),
                "set time.step, or add the callback to the plugin",
            ));
        }
        if law.table.tangent_moduli_f32.is_none() && spec.damping > 0.0 {
            return Err(missing(
                "tangent_moduli_f32",
                format!("{path}.damping = {} is a part of the material's stiffness", spec.damping),
                "set the damping to 0, or add the callback to the plugin",
            ));
        }
        let undamped = PlannedMaterial {
            name: spec.name.clone(),
            material: law.clone(),
            parameters,
            density: spec.density,
            damping: None,
        };
        let at_rest = Stiffness::of(&undamped).filter(|_| spec.damping > 0.0).map(|law| law.at_rest()).transpose()?;
        let damping = at_rest.map(|moduli| Damping::new(spec.damping, &moduli));
        planned.push(PlannedMaterial { damping, ..undamped });
    }
    Ok(planned)
}

/// Parameters in the law's order, SI, with defaults where the scene is silent.
fn resolve(scene: &Scene, path: &str, spec: &MaterialSpec, law: &Material) -> Result<Vec<f64>> {
    let given = spec.parameters.iter().map(|(key, value)| (key.clone(), Given::Float(*value))).collect();
    let whose = format!("law '{}'", law.name);
    let resolved = scene.resolve(whose, &law.parameters, &given, &format!("{path}.parameters"))?;
    let values: Vec<f64> = law.parameters.iter().map(|parameter| resolved.number(&parameter.name)).collect();
    if let Some(check) = law.table.check_params {
        let mut buffer = ErrorBuffer::default();
        // SAFETY: one value a parameter, as the ABI asks; both arguments live until the call returns.
        let status = unsafe { check(values.as_ptr(), buffer.as_raw()) };
        if status != abi::BARCHAN_OK {
            let what = format!("law '{}' refuses these parameters together: {}", law.name, buffer.message(status));
            return Err(scene.fault(&format!("{path}.parameters"), what, ""));
        }
    }
    Ok(values)
}
