//! The conformance suite on any material of a registry, built in or loaded: `barchan conform`.
//!
//! ```
//! use barchan::conformance::{Finding, Outcome, survey};
//!
//! let registry = barchan::registry();
//! let findings: Vec<Finding> = survey(registry.material("hencky")?, 0, &mut |_, _| {})?;
//! assert!(findings.iter().all(|finding| !matches!(finding.outcome, Outcome::Failed(_))), "{findings:?}");
//! # Ok::<(), barchan::Error>(())
//! ```

pub use barchan_material_kit::conformance::{Finding, Outcome, parameters};

use barchan_abi::BarchanMaterial;
use barchan_core::{Error, Material, Result};
use barchan_material_kit::{Subject, conformance};

#[cfg(feature = "wgpu")]
pub mod wgsl;

/// Seed of the parameters that are drawn: the same in each run.
const SEED: u64 = 1;

/// A material's table as the suite takes it: of this version's size, what an older one lacks being zero.
fn whole(material: &Material) -> BarchanMaterial {
    BarchanMaterial { struct_size: size_of::<BarchanMaterial>(), ..material.table }
}

/// The material under test.
///
/// # Errors
/// If the suite has no room for it.
#[expect(unsafe_code, reason = "the registry's tables are trusted to obey the ABI")]
fn subject<'a>(material: &Material, table: &'a BarchanMaterial) -> Result<Subject<'a>> {
    // SAFETY: the table was read from a static one, whose pointers it keeps.
    unsafe { Subject::new(table) }.map_err(|error| Error::Plugin {
        library: material.origin.clone().into(),
        what: format!("material '{}': {}", material.name, error.message),
        mend: "declare fewer".to_owned(),
    })
}

/// Holds a material to every check, at its defaults and at `samples` sets of parameters drawn from their declared ranges, and gives the worst that
/// each check found. `on_check` is told the number of the set, from 0, and the check's name.
///
/// # Errors
/// If the suite has no room for the material. What is wrong with it is in the findings.
pub fn survey(
    material: &Material,
    samples: usize,
    on_check: &mut dyn FnMut(usize, &'static str),
) -> Result<Vec<Finding>> {
    let table = whole(material);
    let subject = subject(material, &table)?;
    let sets = conformance::samples(&subject, samples, SEED);
    Ok(conformance::survey(&subject, &sets, on_check))
}
