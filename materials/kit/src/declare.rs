//! Declarations of parameters and state variables, built in constants.

use barchan_abi::{
    BARCHAN_MERGE_LOG_MEAN, BARCHAN_MERGE_MEAN, BARCHAN_MERGE_REFUSE, BARCHAN_PARAM_DIFFERENTIABLE,
    BARCHAN_PARAM_LOG_SCALE, BARCHAN_PARAM_MAX_OPEN, BARCHAN_PARAM_MIN_OPEN, BarchanParam, BarchanStateVar, BarchanStr,
};

/// A parameter's declaration; a [`BarchanParam`] with builder methods.
#[repr(transparent)]
#[derive(Clone, Copy, Debug)]
pub struct Param(BarchanParam);

/// Declares a parameter: snake_case name, SI unit ("1" if dimensionless), default, least and greatest value, one sentence.
pub const fn param(
    name: &'static str,
    unit: &'static str,
    default: f64,
    min: f64,
    max: f64,
    doc: &'static str,
) -> Param {
    Param(BarchanParam {
        name: BarchanStr::new(name),
        unit: BarchanStr::new(unit),
        doc: BarchanStr::new(doc),
        default_value: default,
        min_value: min,
        max_value: max,
        flags: 0,
    })
}

impl Param {
    const fn flag(mut self, bit: u64) -> Self {
        self.0.flags |= bit;
        self
    }
    /// The least value is itself excluded.
    pub const fn min_open(self) -> Self {
        self.flag(BARCHAN_PARAM_MIN_OPEN)
    }
    /// The greatest value is itself excluded.
    pub const fn max_open(self) -> Self {
        self.flag(BARCHAN_PARAM_MAX_OPEN)
    }
    /// Sweeps and sliders should treat it on a logarithmic scale.
    pub const fn log_scale(self) -> Self {
        self.flag(BARCHAN_PARAM_LOG_SCALE)
    }
    /// The stress is differentiable with respect to it: gradients tell what it does.
    pub const fn differentiable(self) -> Self {
        self.flag(BARCHAN_PARAM_DIFFERENTIABLE)
    }
    /// Do gradients tell what it does?
    pub const fn is_differentiable(&self) -> bool {
        self.0.flags & BARCHAN_PARAM_DIFFERENTIABLE != 0
    }
    /// The value used where the scene is silent.
    pub const fn default_value(&self) -> f64 {
        self.0.default_value
    }
}

/// A state variable's declaration; a [`BarchanStateVar`] with builder methods.
#[repr(transparent)]
#[derive(Clone, Copy, Debug)]
pub struct State(BarchanStateVar);

/// Declares a state variable: snake_case name, SI unit, value at seeding, one sentence. Merging particles average it,
/// weighted with rest volume, unless a method says otherwise.
pub const fn state(name: &'static str, unit: &'static str, initial: f64, doc: &'static str) -> State {
    State(BarchanStateVar {
        name: BarchanStr::new(name),
        unit: BarchanStr::new(unit),
        doc: BarchanStr::new(doc),
        initial_value: initial,
        merge: BARCHAN_MERGE_MEAN,
        reserved: 0,
    })
}

impl State {
    /// Merging particles average its logarithm.
    pub const fn merge_log_mean(mut self) -> Self {
        self.0.merge = BARCHAN_MERGE_LOG_MEAN;
        self
    }
    /// Particles that differ in it are not merged.
    pub const fn merge_refuse(mut self) -> Self {
        self.0.merge = BARCHAN_MERGE_REFUSE;
        self
    }
    /// The value at seeding.
    pub const fn initial_value(&self) -> f64 {
        self.0.initial_value
    }
}

/// Young's modulus, named and bounded alike in every material that has one.
pub const fn young_modulus(default: f64) -> Param {
    param("young_modulus", "Pa", default, 0.0, 1e13, "Young's modulus E.").min_open().log_scale().differentiable()
}

/// Poisson's ratio, named and bounded alike in every material that has one.
pub const fn poisson_ratio(default: f64) -> Param {
    param("poisson_ratio", "1", default, -1.0, 0.5, "Poisson's ratio; both bounds are excluded.")
        .min_open()
        .max_open()
        .differentiable()
}
