//! A host in miniature: calls a material's table from safe code, in either precision.

use barchan_abi::batch::{Adjoint, Batch, Cotangents, Inputs, Number, Outputs};
use barchan_abi::*;
use barchan_lanes::Float;
use core::fmt;
use core::slice::from_raw_parts;

/// Most state variables of a material under test: as many as the engine has room for.
pub const MOST_STATES: usize = 16;

/// A material under test.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a> {
    table: &'a BarchanMaterial,
}

/// One particle's inputs; only the entries that the material declares are read.
#[derive(Clone, Copy, Debug)]
pub struct Particle {
    /// Trial strain: F (9, row-major) or b_e (6: xx yy zz xy xz yz) [1].
    pub strain: [f64; 9],
    /// Velocity gradient, row-major [1/s].
    pub vel_grad: [f64; 9],
    /// State variables.
    pub state: [f64; MOST_STATES],
}

/// One particle's outputs; entries that the material does not declare are 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// Strain after the return map.
    pub strain: [f64; 9],
    /// Kirchhoff stress xx yy zz xy xz yz [Pa].
    pub kirchhoff: [f64; 6],
    /// State variables.
    pub state: [f64; MOST_STATES],
}

/// Cotangents of each particle's inputs, and of the parameters.
pub type PulledBack = (Vec<Particle>, Vec<f64>);

/// Which of the two updates is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// `update_f32`.
    F32,
    /// `update_f64`.
    F64,
}

/// A callback's failure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectError {
    /// `BARCHAN_E_*`.
    pub status: BarchanStatus,
    /// The callback's message.
    pub message: String,
    /// Index of the first particle concerned, if the callback named one.
    pub particle: Option<u64>,
}

impl fmt::Display for SubjectError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "status {}: {}", self.status, self.message)?;
        self.particle.map_or(Ok(()), |p| write!(f, " (particle {p})"))
    }
}
impl std::error::Error for SubjectError {}

fn absent(what: &str) -> SubjectError {
    SubjectError { status: BARCHAN_E_OTHER, message: format!("the table has no {what}"), particle: None }
}

/// Calls `callback` with an error struct and makes a `Result` of what it leaves.
fn call(callback: impl FnOnce(*mut BarchanError) -> BarchanStatus) -> Result<(), SubjectError> {
    let mut message = [0u8; 512];
    let mut error = BarchanError {
        struct_size: size_of::<BarchanError>(),
        message: message.as_mut_ptr(),
        capacity: message.len(),
        len: 0,
        particle: u64::MAX,
    };
    let status = callback(&mut error);
    if status == BARCHAN_OK {
        return Ok(());
    }
    let len = error.len.min(message.len());
    Err(SubjectError {
        status,
        message: String::from_utf8_lossy(&message[..len]).into_owned(),
        particle: (error.particle != u64::MAX).then_some(error.particle),
    })
}

/// Lays `planes` components of each particle out as planes of `stride`.
fn spread<T: Copy + Default>(
    particles: &[Particle],
    planes: usize,
    stride: usize,
    component: impl Fn(&Particle, usize) -> T,
) -> Vec<T> {
    let mut out = vec![T::default(); planes * stride];
    for (i, particle) in particles.iter().enumerate() {
        for c in 0..planes {
            out[c * stride + i] = component(particle, c);
        }
    }
    out
}

impl<'a> Subject<'a> {
    /// Wraps a table.
    ///
    /// # Errors
    /// If the table is of another major version or shorter than this version's, or has more than [`MOST_STATES`] state variables.
    ///
    /// # Safety
    /// The table's pointers and functions must obey the ABI.
    pub unsafe fn new(table: &'a BarchanMaterial) -> Result<Self, SubjectError> {
        if table.abi_major != BARCHAN_ABI_MAJOR || table.struct_size < size_of::<BarchanMaterial>() {
            let (major, size) = (table.abi_major, table.struct_size);
            let message = format!("table of ABI major {major} with {size} bytes");
            return Err(SubjectError { status: BARCHAN_E_OTHER, message, particle: None });
        }
        if table.n_state > MOST_STATES {
            let message = format!("the table has {} state variables; there is room for {MOST_STATES}", table.n_state);
            return Err(SubjectError { status: BARCHAN_E_OTHER, message, particle: None });
        }
        Ok(Self { table })
    }

    /// The table.
    pub fn table(&self) -> &'a BarchanMaterial {
        self.table
    }

    /// The material's name.
    pub fn name(&self) -> &'a str {
        self.text(self.table.name)
    }

    /// Does it have this `BARCHAN_CAP_*` bit?
    pub fn has(&self, capability: u64) -> bool {
        self.table.capabilities & capability != 0
    }

    /// Does it carry the left Cauchy–Green tensor (or else the deformation gradient)?
    pub fn is_left_cauchy_green(&self) -> bool {
        self.table.strain_kind == BARCHAN_STRAIN_LEFT_CAUCHY_GREEN
    }

    /// Planes of its strain.
    pub fn strain_planes(&self) -> usize {
        if self.is_left_cauchy_green() { 6 } else { 9 }
    }

    /// Its parameters' declarations.
    pub fn params(&self) -> impl Iterator<Item = BarchanParam> {
        let BarchanMaterial { params, n_params, param_size, .. } = *self.table;
        // SAFETY: `new`'s caller vouches for n_params entries, param_size bytes apart.
        (0..n_params).map(move |i| unsafe { params.byte_add(i * param_size).read() })
    }

    /// Its state variables' declarations.
    pub fn states(&self) -> impl Iterator<Item = BarchanStateVar> {
        let BarchanMaterial { states, n_state, state_size, .. } = *self.table;
        // SAFETY: as in `params`.
        (0..n_state).map(move |i| unsafe { states.byte_add(i * state_size).read() })
    }

    /// The parameters' defaults.
    pub fn default_params(&self) -> Vec<f64> {
        self.params().map(|p| p.default_value).collect()
    }

    /// The defaults with some parameters changed by name.
    ///
    /// # Panics
    /// If the material has no parameter of that name.
    pub fn params_with(&self, changes: &[(&str, f64)]) -> Vec<f64> {
        let mut values = self.default_params();
        for &(name, value) in changes {
            let index = self.params().position(|p| self.text(p.name) == name);
            values[index.unwrap_or_else(|| panic!("'{}' has no parameter '{name}'", self.name()))] = value;
        }
        values
    }

    /// An undeformed particle as seeded.
    pub fn particle_at_rest(&self) -> Particle {
        let mut state = [0.0; MOST_STATES];
        for (value, declared) in state.iter_mut().zip(self.states()) {
            *value = declared.initial_value;
        }
        let mut strain = [0.0; 9];
        let ones: &[usize] = if self.is_left_cauchy_green() { &[0, 1, 2] } else { &[0, 4, 8] };
        for &c in ones {
            strain[c] = 1.0;
        }
        Particle { strain, vel_grad: [0.0; 9], state }
    }

    /// Builds a batch, hands it to `callback`, and returns strain, stress and state planes.
    fn with<T: Float + Number>(
        &self,
        params: &[f64],
        dt: f64,
        particles: &[Particle],
        stride: usize,
        callback: impl FnOnce(*const T::Batch, *mut BarchanError) -> BarchanStatus,
    ) -> Result<Vec<Answer>, SubjectError> {
        let (strains, states) = (self.strain_planes(), self.table.n_state);
        let params: Vec<T> = params.iter().map(|&p| T::from_f64(p)).collect();
        let trial = spread(particles, strains, stride, |p, c| T::from_f64(p.strain[c]));
        let vel_grad = spread(particles, 9, stride, |p, c| T::from_f64(p.vel_grad[c]));
        let before = spread(particles, states, stride, |p, c| T::from_f64(p.state[c]));
        let (mut strain, mut state) = (vec![T::default(); strains * stride], vec![T::default(); states * stride]);
        let mut kirchhoff = vec![T::default(); 6 * stride];
        let (n, dt) = (particles.len(), T::from_f64(dt));
        let inputs = Inputs { n, stride, dt, params: &params, strain: &trial, vel_grad: &vel_grad, state: &before };
        let outputs = Outputs { strain: &mut strain, kirchhoff: &mut kirchhoff, state: &mut state };
        let batch = Batch::new(self.table, inputs, Some(outputs));
        call(|error| callback(batch.as_raw(), error))?;
        let answer = |i: usize| {
            let mut answer = Answer { strain: [0.0; 9], kirchhoff: [0.0; 6], state: [0.0; MOST_STATES] };
            for (to, from) in [
                (&mut answer.strain[..strains], &strain),
                (&mut answer.kirchhoff, &kirchhoff),
                (&mut answer.state[..states], &state),
            ] {
                to.iter_mut().enumerate().for_each(|(c, to)| *to = from[c * stride + i].to_f64());
            }
            answer
        };
        Ok((0..particles.len()).map(answer).collect())
    }

    /// Calls the update with planes `stride` apart.
    ///
    /// # Errors
    /// What the callback answers, or that the table lacks it.
    pub fn update_strided(
        &self,
        precision: Precision,
        params: &[f64],
        dt: f64,
        particles: &[Particle],
        stride: usize,
    ) -> Result<Vec<Answer>, SubjectError> {
        match precision {
            Precision::F32 => {
                let update = self.table.update_f32.ok_or_else(|| absent("update_f32"))?;
                // SAFETY: `new`'s caller vouches for the function, `with` for the batch.
                self.with::<f32>(params, dt, particles, stride, |batch, error| unsafe { update(batch, error) })
            }
            Precision::F64 => {
                let update = self.table.update_f64.ok_or_else(|| absent("update_f64"))?;
                // SAFETY: as above.
                self.with::<f64>(params, dt, particles, stride, |batch, error| unsafe { update(batch, error) })
            }
        }
    }

    /// Calls the update with planes as far apart as there are particles.
    ///
    /// # Errors
    /// As [`Subject::update_strided`].
    pub fn update(
        &self,
        precision: Precision,
        params: &[f64],
        dt: f64,
        particles: &[Particle],
    ) -> Result<Vec<Answer>, SubjectError> {
        self.update_strided(precision, params, dt, particles, particles.len())
    }

    /// λ + 2μ and 3λ + 2μ [Pa] of each particle; `None` if the table lacks the callback.
    ///
    /// # Errors
    /// What the callback answers.
    pub fn tangent_moduli(
        &self,
        params: &[f64],
        particles: &[Particle],
    ) -> Result<Option<Vec<[f64; 2]>>, SubjectError> {
        let Some(callback) = self.table.tangent_moduli_f32 else { return Ok(None) };
        let n = particles.len();
        let mut moduli = vec![0f32; 2 * n];
        let out = moduli.as_mut_ptr();
        // SAFETY: as in `update_strided`; `moduli` holds two planes of n.
        self.with::<f32>(params, 0.0, particles, n, |batch, error| unsafe { callback(batch, out, error) })?;
        Ok(Some((0..n).map(|i| [f64::from(moduli[i]), f64::from(moduli[n + i])]).collect()))
    }

    /// Viscosity [Pa s] of each particle; `None` if the table lacks the callback: then stress does not follow the rate of deformation.
    ///
    /// # Errors
    /// What the callback answers.
    pub fn viscosity(&self, params: &[f64], particles: &[Particle]) -> Result<Option<Vec<f64>>, SubjectError> {
        let Some(callback) = self.table.viscosity_f32 else { return Ok(None) };
        let n = particles.len();
        let mut viscosity = vec![0f32; n];
        let out = viscosity.as_mut_ptr();
        // SAFETY: as in `update_strided`; `viscosity` holds one plane of n.
        self.with::<f32>(params, 0.0, particles, n, |batch, error| unsafe { callback(batch, out, error) })?;
        Ok(Some(viscosity.into_iter().map(f64::from).collect()))
    }

    /// Elastic energy [J/m³] of each particle; `None` if the table lacks the callback.
    ///
    /// # Errors
    /// What the callback answers.
    pub fn energy(&self, params: &[f64], particles: &[Particle]) -> Result<Option<Vec<f64>>, SubjectError> {
        let Some(callback) = self.table.energy_f64 else { return Ok(None) };
        let n = particles.len();
        let mut energy = vec![0f64; n];
        let out = energy.as_mut_ptr();
        // SAFETY: as in `update_strided`; `energy` holds one plane of n.
        self.with::<f64>(params, 0.0, particles, n, |batch, error| unsafe { callback(batch, out, error) })?;
        Ok(Some(energy))
    }

    /// Cotangents of what the f64 update is given, from those of what it answers: of each particle's strain, velocity gradient and history, and of the
    /// parameters, summed over all particles. `None` if the table lacks the callback.
    ///
    /// # Errors
    /// What the callback answers.
    ///
    /// # Panics
    /// If there are not as many cotangents as particles.
    pub fn pull_back(
        &self,
        params: &[f64],
        dt: f64,
        particles: &[Particle],
        cotangents: &[Answer],
    ) -> Result<Option<PulledBack>, SubjectError> {
        let Some(callback) = self.table.update_adj_f64 else { return Ok(None) };
        let n = particles.len();
        assert_eq!(n, cotangents.len(), "a cotangent for each particle");
        let (strains, states) = (self.strain_planes(), self.table.n_state);
        let planes = |count: usize, of: &dyn Fn(&Answer, usize) -> f64| -> Vec<f64> {
            (0..count).flat_map(|c| cotangents.iter().map(move |cotangent| of(cotangent, c))).collect()
        };
        let strain = planes(strains, &|cotangent, c| cotangent.strain[c]);
        let kirchhoff = planes(6, &|cotangent, c| cotangent.kirchhoff[c]);
        let state = planes(states, &|cotangent, c| cotangent.state[c]);
        let (mut trial, mut vel_grad) = (vec![0.0; strains * n], vec![0.0; 9 * n]);
        let (mut before, mut of_params) = (vec![0.0; states * n], vec![0.0; self.table.n_params]);
        let adjoint = Adjoint::new(
            self.table,
            n,
            Cotangents {
                strain: &strain,
                kirchhoff: &kirchhoff,
                state: &state,
                strain_trial: &mut trial,
                vel_grad: &mut vel_grad,
                state_in: &mut before,
                params: &mut of_params,
            },
        );
        // SAFETY: as in `update_strided`; the cotangents have the batch's planes.
        self.with::<f64>(params, dt, particles, n, |batch, error| unsafe { callback(batch, adjoint.as_raw(), error) })?;
        let of_particle = |i: usize| {
            let mut particle = Particle { strain: [0.0; 9], vel_grad: [0.0; 9], state: [0.0; MOST_STATES] };
            let into = [
                (&mut particle.strain[..strains], &trial),
                (&mut particle.vel_grad[..], &vel_grad),
                (&mut particle.state[..states], &before),
            ];
            for (to, from) in into {
                to.iter_mut().enumerate().for_each(|(c, to)| *to = from[c * n + i]);
            }
            particle
        };
        Ok(Some(((0..n).map(of_particle).collect(), of_params)))
    }

    /// Counts of the batch, in the order of `BARCHAN_COUNT_*`; `None` if the table lacks the callback.
    ///
    /// # Errors
    /// What the callback answers.
    pub fn counts(
        &self,
        params: &[f64],
        particles: &[Particle],
    ) -> Result<Option<[u64; BARCHAN_N_COUNTERS]>, SubjectError> {
        let Some(callback) = self.table.count_f64 else { return Ok(None) };
        let mut counts = [0; BARCHAN_N_COUNTERS];
        let out = counts.as_mut_ptr();
        // SAFETY: as in `update_strided`; `counts` holds BARCHAN_N_COUNTERS numbers.
        self.with::<f64>(params, 0.0, particles, particles.len(), |batch, error| unsafe {
            callback(batch, out, error)
        })?;
        Ok(Some(counts))
    }

    /// Checks parameters against each other; fine if the table lacks the callback.
    ///
    /// # Errors
    /// What the callback answers.
    pub fn check_params(&self, params: &[f64]) -> Result<(), SubjectError> {
        assert_eq!(params.len(), self.table.n_params);
        let Some(callback) = self.table.check_params else { return Ok(()) };
        // SAFETY: `new`'s caller vouches for the function; `params` has the declared length.
        call(|error| unsafe { callback(params.as_ptr(), error) })
    }

    /// A string of the table or of its declarations.
    pub(crate) fn text(&self, s: BarchanStr) -> &'a str {
        if s.len == 0 {
            return "";
        }
        // SAFETY: `new`'s caller vouches for the table's strings.
        core::str::from_utf8(unsafe { from_raw_parts(s.ptr, s.len) }).unwrap_or("(not UTF-8)")
    }
}
