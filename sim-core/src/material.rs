//! A material as the engine sees it: a checked copy of its ABI table, with the callbacks wrapped.

use crate::loader::{LEAST_MATERIAL, Refusal, check_major, read_array, read_prefix, read_text};
use crate::parameter::{self, Parameter, is_snake_case};
use crate::{Error, Result};
use barchan_abi as abi;
use std::path::Path;

/// One history variable of a material.
#[derive(Clone, Debug, PartialEq)]
pub struct StateVariable {
    /// snake_case name.
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// One sentence.
    pub doc: String,
    /// Value at seeding.
    pub initial: f64,
    /// `BARCHAN_MERGE_*` rule.
    pub merge: u32,
}

impl StateVariable {
    /// # Safety
    /// The strings are empty or static text.
    unsafe fn read(raw: abi::BarchanStateVar) -> Result<Self, Refusal> {
        // SAFETY: the caller's promise.
        let (name, unit, doc) = unsafe {
            (
                read_text(raw.name, "state variable's name")?,
                read_text(raw.unit, "state variable's unit")?,
                read_text(raw.doc, "state variable's doc")?,
            )
        };
        if !is_snake_case(&name) || !raw.initial_value.is_finite() || raw.merge > abi::BARCHAN_MERGE_REFUSE {
            return Err(Refusal::new(
                format!("state variable '{name}' has initial value {} and merge rule {}", raw.initial_value, raw.merge),
                "give a snake_case name, a finite initial value and a BARCHAN_MERGE_* rule",
            ));
        }
        Ok(Self { name, unit, doc, initial: raw.initial_value, merge: raw.merge })
    }
}

/// # Safety
/// The strings are empty or static text.
unsafe fn read_parameter(raw: abi::BarchanParam) -> Result<Parameter, Refusal> {
    // SAFETY: the caller's promise.
    let (name, unit, doc) = unsafe {
        (
            read_text(raw.name, "parameter's name")?,
            read_text(raw.unit, "parameter's unit")?,
            read_text(raw.doc, "parameter's doc")?,
        )
    };
    Ok(Parameter::of_material(name, unit, doc, &raw))
}

/// A material plugin, checked on registration.
#[derive(Clone, Debug)]
pub struct Material {
    /// Name in the registry.
    pub name: String,
    /// The material's own version.
    pub version: String,
    /// One paragraph.
    pub doc: String,
    /// Paper or DOI.
    pub reference: String,
    /// "built-in", or the library's path.
    pub origin: String,
    /// Parameters in the order that callbacks take them.
    pub parameters: Vec<Parameter>,
    /// History variables.
    pub states: Vec<StateVariable>,
    /// WGSL of the update; empty if there is none.
    pub wgsl: String,
    /// WGSL of the stiffness; empty if there is none.
    pub wgsl_stiffness: String,
    /// The table, cut or zero-filled to this host's size.
    pub table: abi::BarchanMaterial,
}

/// The undeformed strain of laws with so many planes of it, plane by plane.
pub(crate) fn strain_identity(planes: usize) -> &'static [f64] {
    if planes == 9 { &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0] } else { &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0] }
}

impl Material {
    /// Reads and checks a table; see [`read_table`](Self::read_table).
    ///
    /// # Safety
    /// As there.
    pub(crate) unsafe fn read(table: *const abi::BarchanMaterial, origin: &str) -> Result<Self> {
        // SAFETY: the caller's promise.
        unsafe { Self::read_table(table, origin) }.map_err(|refusal| refusal.of(Path::new(origin)))
    }

    /// Copies a table by the prefix rule, and checks it against the ABI's rules. Fields of newer minor versions are
    /// ignored; fields that an older version lacks are zero.
    ///
    /// # Safety
    /// The pointer is null or a table as the ABI describes it, which lives as long as the process.
    pub(crate) unsafe fn read_table(table: *const abi::BarchanMaterial, origin: &str) -> Result<Self, Refusal> {
        // SAFETY: the caller's promise; a table of zeros is valid: null pointers, empty strings, absent callbacks.
        let table = unsafe { read_prefix(table, "BarchanMaterial", LEAST_MATERIAL) }?;
        check_major(table.abi_major, table.abi_minor, "the material")?;
        // SAFETY: strings of a table are empty or static text, by the ABI.
        let name = unsafe { read_text(table.name, "name") }?;
        if !is_snake_case(&name) {
            return Err(Refusal::new(format!("its name is '{name}'"), "use snake_case: a-z, 0-9 and _"));
        }
        // SAFETY: as for the name; arrays have the lengths and steps that the table says, by the ABI.
        unsafe { Self::read_rest(table, name.clone(), origin) }
            .map_err(|r| Refusal::new(format!("material '{name}': {}", r.what), r.mend))
    }

    /// Reads what follows the name.
    ///
    /// # Safety
    /// As [`read_table`](Self::read_table).
    unsafe fn read_rest(table: abi::BarchanMaterial, name: String, origin: &str) -> Result<Self, Refusal> {
        if table.update_f32.is_none() {
            return Err(Refusal::new("its update_f32 is NULL", "supply it: every material is updated through it"));
        }
        if table.strain_kind > abi::BARCHAN_STRAIN_LEFT_CAUCHY_GREEN {
            return Err(Refusal::new(
                format!("its strain_kind is {}", table.strain_kind),
                "use BARCHAN_STRAIN_DEF_GRAD (0) or BARCHAN_STRAIN_LEFT_CAUCHY_GREEN (1)",
            ));
        }
        // SAFETY: the caller's promise.
        let (params, states) = unsafe {
            (
                read_array(table.params, table.n_params, table.param_size, "BarchanParam")?,
                read_array(table.states, table.n_state, table.state_size, "BarchanStateVar")?,
            )
        };
        // SAFETY: entries' strings are empty or static text, by the ABI.
        let parameters = params.into_iter().map(|p| unsafe { read_parameter(p) }).collect::<Result<Vec<_>, _>>()?;
        // SAFETY: as above.
        let states = states.into_iter().map(|s| unsafe { StateVariable::read(s) }).collect::<Result<Vec<_>, _>>()?;
        parameter::check(&parameters)?;
        // SAFETY: strings of a table are empty or static text, by the ABI.
        unsafe {
            // No backend reads it yet; it is held to the ABI like all text.
            read_text(table.wgsl_adj, "wgsl_adj")?;
            Ok(Self {
                version: read_text(table.version, "version")?,
                doc: read_text(table.doc, "doc")?,
                reference: read_text(table.reference, "reference")?,
                wgsl: read_text(table.wgsl, "wgsl")?,
                wgsl_stiffness: read_text(table.wgsl_stiffness, "wgsl_stiffness")?,
                origin: origin.to_owned(),
                name,
                parameters,
                states,
                table,
            })
        }
    }

    /// Planes of strain: 9 for the deformation gradient, 6 for left Cauchy-Green.
    pub fn strain_planes(&self) -> usize {
        if self.table.strain_kind == abi::BARCHAN_STRAIN_DEF_GRAD { 9 } else { 6 }
    }
    /// Number of values of strain and history of one particle.
    pub fn values(&self) -> usize {
        self.strain_planes() + self.states.len()
    }
    /// The undeformed strain, plane by plane.
    pub fn strain_identity(&self) -> &'static [f64] {
        strain_identity(self.strain_planes())
    }
    /// Whether the capability bit is set.
    pub fn has(&self, capability: u64) -> bool {
        self.table.capabilities & capability != 0
    }
}

/// A callback's message buffer and how to read it.
pub struct ErrorBuffer {
    text: [u8; 512],
    raw: abi::BarchanError,
}

// SAFETY: the pointer is set anew by `as_raw` and points into the buffer itself; nothing reads it in between.
unsafe impl Send for ErrorBuffer {}

impl Default for ErrorBuffer {
    fn default() -> Self {
        Self {
            text: [0; 512],
            raw: abi::BarchanError {
                struct_size: size_of::<abi::BarchanError>(),
                message: std::ptr::null_mut(),
                capacity: 0,
                len: 0,
                particle: u64::MAX,
            },
        }
    }
}

impl ErrorBuffer {
    /// The struct to pass to a callback; valid while the buffer is neither moved nor dropped.
    pub fn as_raw(&mut self) -> *mut abi::BarchanError {
        self.raw.message = self.text.as_mut_ptr();
        self.raw.capacity = self.text.len();
        self.raw.len = 0;
        self.raw.particle = u64::MAX;
        &raw mut self.raw
    }
    /// Index in the batch that the callback named.
    pub fn particle(&self) -> Option<u64> {
        (self.raw.particle != u64::MAX).then_some(self.raw.particle)
    }
    /// The callback's text.
    pub fn message(&self, status: abi::BarchanStatus) -> String {
        let text = String::from_utf8_lossy(&self.text[..self.raw.len.min(self.text.len())]).into_owned();
        let kind = match status {
            abi::BARCHAN_E_PANIC => "panic",
            abi::BARCHAN_E_INVALID_PARAM => "invalid parameter",
            abi::BARCHAN_E_NON_FINITE => "NaN or infinity",
            _ => "error",
        };
        if text.is_empty() { format!("{kind} (status {status}), no message") } else { format!("{kind}: {text}") }
    }
    /// The error that a status stands for; `ids` maps an index in the batch to a particle id, and an index
    /// beyond the batch to `u64::MAX`: a callback may name any number.
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] unless the status is OK.
    pub fn check(
        &self,
        status: abi::BarchanStatus,
        material: &Material,
        callback: &'static str,
        ids: impl Fn(u64) -> u64,
    ) -> Result<()> {
        if status == abi::BARCHAN_OK { Ok(()) } else { Err(self.failure(status, material, callback, ids)) }
    }
    /// The error that a status other than OK stands for, as in [`check`](Self::check).
    pub fn failure(
        &self,
        status: abi::BarchanStatus,
        material: &Material,
        callback: &'static str,
        ids: impl Fn(u64) -> u64,
    ) -> Error {
        Error::MaterialFailed {
            material: material.name.clone(),
            origin: material.origin.clone(),
            callback,
            message: self.message(status),
            particle: self.particle().map(ids).filter(|id| *id != u64::MAX),
        }
    }
}
