//! The C declarations. Only what cbindgen can print may stand here.

/// Major version: another one is refused. It is also in the entry symbol's name, `barchan_plugin_v1`.
pub const BARCHAN_ABI_MAJOR: u32 = 1;
/// Minor version: counts fields appended.
pub const BARCHAN_ABI_MINOR: u32 = 1;

/// Result of a callback: one of the `BARCHAN_OK` / `BARCHAN_E_*` values; any other value is read as `BARCHAN_E_OTHER`.
pub type BarchanStatus = i32;
/// The callback succeeded and all its outputs are written.
pub const BARCHAN_OK: BarchanStatus = 0;
/// The plugin panicked; the message holds the panic's text.
pub const BARCHAN_E_PANIC: BarchanStatus = 1;
/// A parameter, or a combination of parameters, has no meaning; the message says which.
pub const BARCHAN_E_INVALID_PARAM: BarchanStatus = 2;
/// An input or a result is NaN or infinite; `particle` is the first such index in the batch.
pub const BARCHAN_E_NON_FINITE: BarchanStatus = 3;
/// Any other failure.
pub const BARCHAN_E_OTHER: BarchanStatus = 4;

/// Strain is the deformation gradient F: 9 planes, row-major.
pub const BARCHAN_STRAIN_DEF_GRAD: u32 = 0;
/// Strain is the left Cauchy-Green tensor b_e = F_e F_e^T: 6 planes xx yy zz xy xz yz (isotropic laws).
pub const BARCHAN_STRAIN_LEFT_CAUCHY_GREEN: u32 = 1;

/// The lower bound of a parameter is excluded.
pub const BARCHAN_PARAM_MIN_OPEN: u64 = 1;
/// The upper bound of a parameter is excluded.
pub const BARCHAN_PARAM_MAX_OPEN: u64 = 2;
/// The stress is differentiable with respect to this parameter; gradients are there only if the adjoint slots are filled.
pub const BARCHAN_PARAM_DIFFERENTIABLE: u64 = 4;
/// Sweeps and sliders should treat this parameter on a logarithmic scale.
pub const BARCHAN_PARAM_LOG_SCALE: u64 = 8;

/// When particles merge, this state variable becomes the V0-weighted mean.
pub const BARCHAN_MERGE_MEAN: u32 = 0;
/// When particles merge, this state variable becomes the V0-weighted mean of its logarithm, exponentiated.
pub const BARCHAN_MERGE_LOG_MEAN: u32 = 1;
/// Particles whose values of this state variable differ are not merged.
pub const BARCHAN_MERGE_REFUSE: u32 = 2;

/// The material reads `vel_grad`; otherwise the pointer is NULL.
pub const BARCHAN_CAP_VEL_GRAD: u64 = 1;
/// The tangent moduli or the viscosity change with the particle's state, so the host asks for them again and again.
pub const BARCHAN_CAP_HARDENS: u64 = 2;
/// The material never bears shear at rest (a fluid).
pub const BARCHAN_CAP_FLUID: u64 = 4;
/// The answer follows the step `dt` otherwise than through `vel_grad` (creep, relaxation). Without this bit and BARCHAN_CAP_VEL_GRAD, a
/// strain path has one answer, however fast and in however many steps it is gone.
pub const BARCHAN_CAP_RATE_DEPENDENT: u64 = 8;
/// Nothing in the flow rule keeps a closed strain cycle from giving back more work than was put in, and at some parameters one does. The
/// conformance suite then holds the material to that at its defaults only.
pub const BARCHAN_CAP_MAY_MAKE_ENERGY: u64 = 16;

/// The plugin was built with panic = "abort": a panic in it ends the process.
pub const BARCHAN_PLUGIN_PANIC_ABORT: u64 = 1;

/// UTF-8 text that lives as long as the library; not NUL-terminated.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanStr {
    /// First byte; may be NULL if `len` is 0.
    pub ptr: *const u8,
    /// Length in bytes.
    pub len: usize,
}

/// Written by the callee on failure; all memory belongs to the caller.
#[repr(C)]
#[derive(Debug)]
pub struct BarchanError {
    /// sizeof(BarchanError) as the caller knows it.
    pub struct_size: usize,
    /// Buffer for UTF-8 text, not NUL-terminated.
    pub message: *mut u8,
    /// Size of the buffer in bytes.
    pub capacity: usize,
    /// Bytes written; a longer message is cut at a character boundary.
    pub len: usize,
    /// Index in the batch of the first particle concerned, or UINT64_MAX.
    pub particle: u64,
}

/// One user-visible parameter: becomes a scene key, a Python argument and a line of documentation.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanParam {
    /// snake_case, unique within the material.
    pub name: BarchanStr,
    /// SI unit, "1" if dimensionless.
    pub unit: BarchanStr,
    /// One sentence.
    pub doc: BarchanStr,
    /// Used where the scene is silent.
    pub default_value: f64,
    /// Least value allowed.
    pub min_value: f64,
    /// Greatest value allowed.
    pub max_value: f64,
    /// BARCHAN_PARAM_* bits.
    pub flags: u64,
}

/// One history variable that every particle of the material carries.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanStateVar {
    /// snake_case, unique within the material.
    pub name: BarchanStr,
    /// SI unit, "1" if dimensionless.
    pub unit: BarchanStr,
    /// One sentence.
    pub doc: BarchanStr,
    /// Value at seeding.
    pub initial_value: f64,
    /// BARCHAN_MERGE_* rule.
    pub merge: u32,
    /// Reserved, 0.
    pub reserved: u32,
}

/// One batch of particles in f32. Component c of particle i is ptr[c * stride + i]; nothing overlaps.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanBatchF32 {
    /// sizeof(BarchanBatchF32) as the caller knows it.
    pub struct_size: usize,
    /// Number of particles. Planes may be read, but need not be written, up to `stride`.
    pub n: usize,
    /// Distance between planes, at least n. The host uses a multiple of 16 and aligns planes to 64 bytes.
    pub stride: usize,
    /// Step over which vel_grad carried the particles [s]; 0 asks for stress at the given strain (must be idempotent).
    pub dt: f32,
    /// Reserved, 0.
    pub reserved: u32,
    /// n_params values in declaration order, SI.
    pub params: *const f32,
    /// Trial strain: F* = (I + dt grad v) F, or b* = (I + dt grad v) b (I + dt grad v)^T [1].
    pub strain_trial: *const f32,
    /// grad v [1/s], 9 planes row-major; NULL unless the material has BARCHAN_CAP_VEL_GRAD.
    pub vel_grad: *const f32,
    /// n_state planes; NULL if n_state is 0.
    pub state_in: *const f32,
    /// Strain after the return map [1].
    pub strain: *mut f32,
    /// Kirchhoff stress tau = J sigma [Pa], 6 planes xx yy zz xy xz yz.
    pub kirchhoff: *mut f32,
    /// n_state planes; NULL if n_state is 0.
    pub state_out: *mut f32,
}

/// One batch of particles in f64; see BarchanBatchF32.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanBatchF64 {
    /// sizeof(BarchanBatchF64) as the caller knows it.
    pub struct_size: usize,
    /// Number of particles.
    pub n: usize,
    /// Distance between planes.
    pub stride: usize,
    /// Step over which vel_grad carried the particles [s].
    pub dt: f64,
    /// n_params values in declaration order, SI.
    pub params: *const f64,
    /// Trial strain [1].
    pub strain_trial: *const f64,
    /// grad v [1/s], 9 planes row-major, or NULL.
    pub vel_grad: *const f64,
    /// n_state planes, or NULL.
    pub state_in: *const f64,
    /// Strain after the return map [1].
    pub strain: *mut f64,
    /// Kirchhoff stress [Pa], 6 planes.
    pub kirchhoff: *mut f64,
    /// n_state planes, or NULL.
    pub state_out: *mut f64,
}

/// Cotangents of a batch in f32. `adj_<out>` are read, `adj_<in>` are accumulated (+=).
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanAdjointF32 {
    /// sizeof(BarchanAdjointF32) as the caller knows it.
    pub struct_size: usize,
    /// Cotangent of strain.
    pub adj_strain: *const f32,
    /// Cotangent of kirchhoff; off-diagonal planes stand for both entries of the symmetric tensor.
    pub adj_kirchhoff: *const f32,
    /// Cotangent of state_out, or NULL.
    pub adj_state_out: *const f32,
    /// Cotangent of strain_trial.
    pub adj_strain_trial: *mut f32,
    /// Cotangent of vel_grad, or NULL.
    pub adj_vel_grad: *mut f32,
    /// Cotangent of state_in, or NULL.
    pub adj_state_in: *mut f32,
    /// n_params values, summed over this batch; the host sums batches in a fixed order.
    pub adj_params: *mut f32,
}

/// Cotangents of a batch in f64; see BarchanAdjointF32.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanAdjointF64 {
    /// sizeof(BarchanAdjointF64) as the caller knows it.
    pub struct_size: usize,
    /// Cotangent of strain.
    pub adj_strain: *const f64,
    /// Cotangent of kirchhoff.
    pub adj_kirchhoff: *const f64,
    /// Cotangent of state_out, or NULL.
    pub adj_state_out: *const f64,
    /// Cotangent of strain_trial.
    pub adj_strain_trial: *mut f64,
    /// Cotangent of vel_grad, or NULL.
    pub adj_vel_grad: *mut f64,
    /// Cotangent of state_in, or NULL.
    pub adj_state_in: *mut f64,
    /// n_params values.
    pub adj_params: *mut f64,
}

/// Advances the material over one batch in f32: trial strain to strain, stress and state.
pub type BarchanUpdateF32 =
    Option<unsafe extern "C" fn(batch: *const BarchanBatchF32, error: *mut BarchanError) -> BarchanStatus>;
/// Advances the material over one batch in f64.
pub type BarchanUpdateF64 =
    Option<unsafe extern "C" fn(batch: *const BarchanBatchF64, error: *mut BarchanError) -> BarchanStatus>;
/// Vector-Jacobian product of the f32 update.
pub type BarchanAdjointFnF32 = Option<
    unsafe extern "C" fn(
        batch: *const BarchanBatchF32,
        adjoint: *const BarchanAdjointF32,
        error: *mut BarchanError,
    ) -> BarchanStatus,
>;
/// Vector-Jacobian product of the f64 update.
pub type BarchanAdjointFnF64 = Option<
    unsafe extern "C" fn(
        batch: *const BarchanBatchF64,
        adjoint: *const BarchanAdjointF64,
        error: *mut BarchanError,
    ) -> BarchanStatus,
>;
/// Writes two planes [Pa] of `stride` each to `moduli`: lambda + 2 mu and 3 lambda + 2 mu of the present tangent.
/// Reads strain_trial as the present strain and state_in as the present state.
pub type BarchanModuliF32 = Option<
    unsafe extern "C" fn(batch: *const BarchanBatchF32, moduli: *mut f32, error: *mut BarchanError) -> BarchanStatus,
>;
/// Writes one plane of `stride` to `viscosity` [Pa s]: the greatest ratio of a Kirchhoff stress that follows the rate of deformation to
/// twice that rate, eta where tau = 2 eta dev D. Reads strain_trial as the present strain and state_in as the present state.
pub type BarchanViscosityF32 = Option<
    unsafe extern "C" fn(batch: *const BarchanBatchF32, viscosity: *mut f32, error: *mut BarchanError) -> BarchanStatus,
>;
/// Writes one plane: elastic energy per rest volume [J/m^3] at strain_trial and state_in.
pub type BarchanEnergyF64 = Option<
    unsafe extern "C" fn(batch: *const BarchanBatchF64, energy: *mut f64, error: *mut BarchanError) -> BarchanStatus,
>;
/// Checks parameters together (each is inside its own range already); called once when a scene is assembled.
pub type BarchanCheckParams =
    Option<unsafe extern "C" fn(params: *const f64, error: *mut BarchanError) -> BarchanStatus>;
/// Writes BARCHAN_N_COUNTERS counts for the batch at strain_trial and state_in: how many particles the update would
/// clamp, floor or clip there, per kind.
pub type BarchanCountF64 = Option<
    unsafe extern "C" fn(batch: *const BarchanBatchF64, counts: *mut u64, error: *mut BarchanError) -> BarchanStatus,
>;

/// Number of counts that `count_f64` writes.
pub const BARCHAN_N_COUNTERS: usize = 4;
/// Index of the count of particles on the yield surface.
pub const BARCHAN_COUNT_YIELDING: usize = 0;
/// Index of the count of particles at the tip of the cone (stress-free).
pub const BARCHAN_COUNT_APEX: usize = 1;
/// Index of the count of particles whose stretch was floored before a logarithm.
pub const BARCHAN_COUNT_FLOORED: usize = 2;
/// Index of the count of particles whose hardening or volume state was clamped.
pub const BARCHAN_COUNT_CLAMPED: usize = 3;

/// One material.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanMaterial {
    /// sizeof(BarchanMaterial) as the plugin knows it.
    pub struct_size: usize,
    /// BARCHAN_ABI_MAJOR the plugin was built with.
    pub abi_major: u32,
    /// BARCHAN_ABI_MINOR the plugin was built with.
    pub abi_minor: u32,
    /// BARCHAN_CAP_* bits.
    pub capabilities: u64,
    /// BARCHAN_STRAIN_*.
    pub strain_kind: u32,
    /// Reserved, 0.
    pub reserved: u32,
    /// snake_case name, unique in the registry.
    pub name: BarchanStr,
    /// The material's own version.
    pub version: BarchanStr,
    /// One paragraph.
    pub doc: BarchanStr,
    /// Paper or DOI.
    pub reference: BarchanStr,
    /// n_params entries, param_size bytes apart.
    pub params: *const BarchanParam,
    /// Number of parameters.
    pub n_params: usize,
    /// sizeof(BarchanParam) as the plugin knows it.
    pub param_size: usize,
    /// n_state entries, state_size bytes apart.
    pub states: *const BarchanStateVar,
    /// Number of history variables.
    pub n_state: usize,
    /// sizeof(BarchanStateVar) as the plugin knows it.
    pub state_size: usize,
    /// Required for f32 runs.
    pub update_f32: BarchanUpdateF32,
    /// Needed for gradients in f32.
    pub update_adj_f32: BarchanAdjointFnF32,
    /// Required for f64 runs.
    pub update_f64: BarchanUpdateF64,
    /// Needed for gradients in f64.
    pub update_adj_f64: BarchanAdjointFnF64,
    /// Needed for the time-step bound; NULL: the scene must fix dt.
    pub tangent_moduli_f32: BarchanModuliF32,
    /// Optional: elastic energy for ledgers and for the test that stress is its derivative.
    pub energy_f64: BarchanEnergyF64,
    /// Optional: parameter combinations.
    pub check_params: BarchanCheckParams,
    /// Optional: counts of clamps, floors and clips for the ledger.
    pub count_f64: BarchanCountF64,
    /// WGSL text of `<name>_update`; empty: not available on the GPU. A pure function of one particle, strains minus I, all names at
    /// module scope starting with the material's; what it may use is in backends/wgpu/src/prelude.wgsl.
    pub wgsl: BarchanStr,
    /// WGSL text of `<name>_update_adj`; empty: no gradient on the GPU.
    pub wgsl_adj: BarchanStr,
    /// Needed for the time-step bound of a law whose stress follows the rate of deformation; NULL: it does not. Since minor version 1.
    pub viscosity_f32: BarchanViscosityF32,
    /// WGSL text of `<name>_stiffness`, which gives the tangent moduli and the viscosity of one particle on the GPU; it may call what `wgsl`
    /// defines. Empty: the stiffness of a law with BARCHAN_CAP_HARDENS is asked on the host, for which the GPU's particles are copied there
    /// every few steps. Since minor version 1.
    pub wgsl_stiffness: BarchanStr,
}

/// What `const BarchanPlugin *barchan_plugin_v1(void)` returns.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct BarchanPlugin {
    /// sizeof(BarchanPlugin) as the plugin knows it.
    pub struct_size: usize,
    /// BARCHAN_ABI_MAJOR the plugin was built with.
    pub abi_major: u32,
    /// BARCHAN_ABI_MINOR the plugin was built with.
    pub abi_minor: u32,
    /// BARCHAN_PLUGIN_* bits.
    pub flags: u64,
    /// n_materials pointers.
    pub materials: *const *const BarchanMaterial,
    /// Number of materials.
    pub n_materials: usize,
}

/// Type of the exported entry function `barchan_plugin_v1`.
pub type BarchanPluginEntry = Option<unsafe extern "C" fn() -> *const BarchanPlugin>;

impl BarchanStr {
    /// Makes a string of the ABI from a static one.
    pub const fn new(text: &'static str) -> Self {
        Self { ptr: text.as_ptr(), len: text.len() }
    }
}

// SAFETY: the tables hold pointers to immutable static data and to re-entrant functions only; the ABI demands both.
unsafe impl Sync for BarchanStr {}
// SAFETY: as above.
unsafe impl Send for BarchanStr {}
// SAFETY: as above.
unsafe impl Sync for BarchanParam {}
// SAFETY: as above.
unsafe impl Send for BarchanParam {}
// SAFETY: as above.
unsafe impl Sync for BarchanStateVar {}
// SAFETY: as above.
unsafe impl Send for BarchanStateVar {}
// SAFETY: as above.
unsafe impl Sync for BarchanMaterial {}
// SAFETY: as above.
unsafe impl Send for BarchanMaterial {}
// SAFETY: as above.
unsafe impl Sync for BarchanPlugin {}
// SAFETY: as above.
unsafe impl Send for BarchanPlugin {}
