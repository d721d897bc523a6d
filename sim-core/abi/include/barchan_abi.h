/* The stable C interface between Barchan and its material plugins, version 1.1.
 * Generated from sim-core/abi/src/raw.rs by cbindgen; edit that file, not this one. */

#ifndef BARCHAN_ABI_H
#define BARCHAN_ABI_H

#include <stddef.h>
#include <stdint.h>

// Major version: another one is refused. It is also in the entry symbol's name, `barchan_plugin_v1`.
#define BARCHAN_ABI_MAJOR 1

// Minor version: counts fields appended.
#define BARCHAN_ABI_MINOR 1

// Strain is the deformation gradient F: 9 planes, row-major.
#define BARCHAN_STRAIN_DEF_GRAD 0

// Strain is the left Cauchy-Green tensor b_e = F_e F_e^T: 6 planes xx yy zz xy xz yz (isotropic laws).
#define BARCHAN_STRAIN_LEFT_CAUCHY_GREEN 1

// The lower bound of a parameter is excluded.
#define BARCHAN_PARAM_MIN_OPEN 1

// The upper bound of a parameter is excluded.
#define BARCHAN_PARAM_MAX_OPEN 2

// The stress is differentiable with respect to this parameter; gradients are there only if the adjoint slots are filled.
#define BARCHAN_PARAM_DIFFERENTIABLE 4

// Sweeps and sliders should treat this parameter on a logarithmic scale.
#define BARCHAN_PARAM_LOG_SCALE 8

// When particles merge, this state variable becomes the V0-weighted mean.
#define BARCHAN_MERGE_MEAN 0

// When particles merge, this state variable becomes the V0-weighted mean of its logarithm, exponentiated.
#define BARCHAN_MERGE_LOG_MEAN 1

// Particles whose values of this state variable differ are not merged.
#define BARCHAN_MERGE_REFUSE 2

// The material reads `vel_grad`; otherwise the pointer is NULL.
#define BARCHAN_CAP_VEL_GRAD 1

// The tangent moduli or the viscosity change with the particle's state, so the host asks for them again and again.
#define BARCHAN_CAP_HARDENS 2

// The material never bears shear at rest (a fluid).
#define BARCHAN_CAP_FLUID 4

// The answer follows the step `dt` otherwise than through `vel_grad` (creep, relaxation). Without this bit and BARCHAN_CAP_VEL_GRAD, a
// strain path has one answer, however fast and in however many steps it is gone.
#define BARCHAN_CAP_RATE_DEPENDENT 8

// Nothing in the flow rule keeps a closed strain cycle from giving back more work than was put in, and at some parameters one does. The
// conformance suite then holds the material to that at its defaults only.
#define BARCHAN_CAP_MAY_MAKE_ENERGY 16

// The plugin was built with panic = "abort": a panic in it ends the process.
#define BARCHAN_PLUGIN_PANIC_ABORT 1

// Number of counts that `count_f64` writes.
#define BARCHAN_N_COUNTERS 4

// Index of the count of particles on the yield surface.
#define BARCHAN_COUNT_YIELDING 0

// Index of the count of particles at the tip of the cone (stress-free).
#define BARCHAN_COUNT_APEX 1

// Index of the count of particles whose stretch was floored before a logarithm.
#define BARCHAN_COUNT_FLOORED 2

// Index of the count of particles whose hardening or volume state was clamped.
#define BARCHAN_COUNT_CLAMPED 3

// Result of a callback: one of the `BARCHAN_OK` / `BARCHAN_E_*` values; any other value is read as `BARCHAN_E_OTHER`.
typedef int32_t BarchanStatus;

// UTF-8 text that lives as long as the library; not NUL-terminated.
typedef struct BarchanStr {
  // First byte; may be NULL if `len` is 0.
  const uint8_t *ptr;
  // Length in bytes.
  size_t len;
} BarchanStr;

// One user-visible parameter: becomes a scene key, a Python argument and a line of documentation.
typedef struct BarchanParam {
  // snake_case, unique within the material.
  struct BarchanStr name;
  // SI unit, "1" if dimensionless.
  struct BarchanStr unit;
  // One sentence.
  struct BarchanStr doc;
  // Used where the scene is silent.
  double default_value;
  // Least value allowed.
  double min_value;
  // Greatest value allowed.
  double max_value;
  // BARCHAN_PARAM_* bits.
  uint64_t flags;
} BarchanParam;

// One history variable that every particle of the material carries.
typedef struct BarchanStateVar {
  // snake_case, unique within the material.
  struct BarchanStr name;
  // SI unit, "1" if dimensionless.
  struct BarchanStr unit;
  // One sentence.
  struct BarchanStr doc;
  // Value at seeding.
  double initial_value;
  // BARCHAN_MERGE_* rule.
  uint32_t merge;
  // Reserved, 0.
  uint32_t reserved;
} BarchanStateVar;

// One batch of particles in f32. Component c of particle i is ptr[c * stride + i]; nothing overlaps.
typedef struct BarchanBatchF32 {
  // sizeof(BarchanBatchF32) as the caller knows it.
  size_t struct_size;
  // Number of particles. Planes may be read, but need not be written, up to `stride`.
  size_t n;
  // Distance between planes, at least n. The host uses a multiple of 16 and aligns planes to 64 bytes.
  size_t stride;
  // Step over which vel_grad carried the particles [s]; 0 asks for stress at the given strain (must be idempotent).
  float dt;
  // Reserved, 0.
  uint32_t reserved;
  // n_params values in declaration order, SI.
  const float *params;
  // Trial strain: F* = (I + dt grad v) F, or b* = (I + dt grad v) b (I + dt grad v)^T [1].
  const float *strain_trial;
  // grad v [1/s], 9 planes row-major; NULL unless the material has BARCHAN_CAP_VEL_GRAD.
  const float *vel_grad;
  // n_state planes; NULL if n_state is 0.
  const float *state_in;
  // Strain after the return map [1].
  float *strain;
  // Kirchhoff stress tau = J sigma [Pa], 6 planes xx yy zz xy xz yz.
  float *kirchhoff;
  // n_state planes; NULL if n_state is 0.
  float *state_out;
} BarchanBatchF32;

// Written by the callee on failure; all memory belongs to the caller.
typedef struct BarchanError {
  // sizeof(BarchanError) as the caller knows it.
  size_t struct_size;
  // Buffer for UTF-8 text, not NUL-terminated.
  uint8_t *message;
  // Size of the buffer in bytes.
  size_t capacity;
  // Bytes written; a longer message is cut at a character boundary.
  size_t len;
  // Index in the batch of the first particle concerned, or UINT64_MAX.
  uint64_t particle;
} BarchanError;

// Advances the material over one batch in f32: trial strain to strain, stress and state.
typedef BarchanStatus (*BarchanUpdateF32)(const struct BarchanBatchF32 *batch, struct BarchanError *error);

// Cotangents of a batch in f32. `adj_<out>` are read, `adj_<in>` are accumulated (+=).
typedef struct BarchanAdjointF32 {
  // sizeof(BarchanAdjointF32) as the caller knows it.
  size_t struct_size;
  // Cotangent of strain.
  const float *adj_strain;
  // Cotangent of kirchhoff; off-diagonal planes stand for both entries of the symmetric tensor.
  const float *adj_kirchhoff;
  // Cotangent of state_out, or NULL.
  const float *adj_state_out;
  // Cotangent of strain_trial.
  float *adj_strain_trial;
  // Cotangent of vel_grad, or NULL.
  float *adj_vel_grad;
  // Cotangent of state_in, or NULL.
  float *adj_state_in;
  // n_params values, summed over this batch; the host sums batches in a fixed order.
  float *adj_params;
} BarchanAdjointF32;

// Vector-Jacobian product of the f32 update.
typedef BarchanStatus (*BarchanAdjointFnF32)(const struct BarchanBatchF32 *batch,
                                             const struct BarchanAdjointF32 *adjoint,
                                             struct BarchanError *error);

// One batch of particles in f64; see BarchanBatchF32.
typedef struct BarchanBatchF64 {
  // sizeof(BarchanBatchF64) as the caller knows it.
  size_t struct_size;
  // Number of particles.
  size_t n;
  // Distance between planes.
  size_t stride;
  // Step over which vel_grad carried the particles [s].
  double dt;
  // n_params values in declaration order, SI.
  const double *params;
  // Trial strain [1].
  const double *strain_trial;
  // grad v [1/s], 9 planes row-major, or NULL.
  const double *vel_grad;
  // n_state planes, or NULL.
  const double *state_in;
  // Strain after the return map [1].
  double *strain;
  // Kirchhoff stress [Pa], 6 planes.
  double *kirchhoff;
  // n_state planes, or NULL.
  double *state_out;
} BarchanBatchF64;

// Advances the material over one batch in f64.
typedef BarchanStatus (*BarchanUpdateF64)(const struct BarchanBatchF64 *batch, struct BarchanError *error);

// Cotangents of a batch in f64; see BarchanAdjointF32.
typedef struct BarchanAdjointF64 {
  // sizeof(BarchanAdjointF64) as the caller knows it.
  size_t struct_size;
  // Cotangent of strain.
  const double *adj_strain;
  // Cotangent of kirchhoff.
  const double *adj_kirchhoff;
  // Cotangent of state_out, or NULL.
  const double *adj_state_out;
  // Cotangent of strain_trial.
  double *adj_strain_trial;
  // Cotangent of vel_grad, or NULL.
  double *adj_vel_grad;
  // Cotangent of state_in, or NULL.
  double *adj_state_in;
  // n_params values.
  double *adj_params;
} BarchanAdjointF64;

// Vector-Jacobian product of the f64 update.
typedef BarchanStatus (*BarchanAdjointFnF64)(const struct BarchanBatchF64 *batch,
                                             const struct BarchanAdjointF64 *adjoint,
                                             struct BarchanError *error);

// Writes two planes [Pa] of `stride` each to `moduli`: lambda + 2 mu and 3 lambda + 2 mu of the present tangent.
// Reads strain_trial as the present strain and state_in as the present state.
typedef BarchanStatus (*BarchanModuliF32)(const struct BarchanBatchF32 *batch, float *moduli, struct BarchanError *error);

// Writes one plane: elastic energy per rest volume [J/m^3] at strain_trial and state_in.
typedef BarchanStatus (*BarchanEnergyF64)(const struct BarchanBatchF64 *batch,
                                          double *energy,
                                          struct BarchanError *error);

// Checks parameters together (each is inside its own range already); called once when a scene is assembled.
typedef BarchanStatus (*BarchanCheckParams)(const double *params, struct BarchanError *error);

// Writes BARCHAN_N_COUNTERS counts for the batch at strain_trial and state_in: how many particles the update would
// clamp, floor or clip there, per kind.
typedef BarchanStatus (*BarchanCountF64)(const struct BarchanBatchF64 *batch,
                                         uint64_t *counts,
                                         struct BarchanError *error);

// Writes one plane of `stride` to `viscosity` [Pa s]: the greatest ratio of a Kirchhoff stress that follows the rate of deformation to
// twice that rate, eta where tau = 2 eta dev D. Reads strain_trial as the present strain and state_in as the present state.
typedef BarchanStatus (*BarchanViscosityF32)(const struct BarchanBatchF32 *batch,
                                             float *viscosity,
                                             struct BarchanError *error);

// One material.
typedef struct BarchanMaterial {
  // sizeof(BarchanMaterial) as the plugin knows it.
  size_t struct_size;
  // BARCHAN_ABI_MAJOR the plugin was built with.
  uint32_t abi_major;
  // BARCHAN_ABI_MINOR the plugin was built with.
  uint32_t abi_minor;
  // BARCHAN_CAP_* bits.
  uint64_t capabilities;
  // BARCHAN_STRAIN_*.
  uint32_t strain_kind;
  // Reserved, 0.
  uint32_t reserved;
  // snake_case name, unique in the registry.
  struct BarchanStr name;
  // The material's own version.
  struct BarchanStr version;
  // One paragraph.
  struct BarchanStr doc;
  // Paper or DOI.
  struct BarchanStr reference;
  // n_params entries, param_size bytes apart.
  const struct BarchanParam *params;
  // Number of parameters.
  size_t n_params;
  // sizeof(BarchanParam) as the plugin knows it.
  size_t param_size;
  // n_state entries, state_size bytes apart.
  const struct BarchanStateVar *states;
  // Number of history variables.
  size_t n_state;
  // sizeof(BarchanStateVar) as the plugin knows it.
  size_t state_size;
  // Required for f32 runs.
  BarchanUpdateF32 update_f32;
  // Needed for gradients in f32.
  BarchanAdjointFnF32 update_adj_f32;
  // Required for f64 runs.
  BarchanUpdateF64 update_f64;
  // Needed for gradients in f64.
  BarchanAdjointFnF64 update_adj_f64;
  // Needed for the time-step bound; NULL: the scene must fix dt.
  BarchanModuliF32 tangent_moduli_f32;
  // Optional: elastic energy for ledgers and for the test that stress is its derivative.
  BarchanEnergyF64 energy_f64;
  // Optional: parameter combinations.
  BarchanCheckParams check_params;
  // Optional: counts of clamps, floors and clips for the ledger.
  BarchanCountF64 count_f64;
  // WGSL text of `<name>_update`; empty: not available on the GPU. A pure function of one particle, strains minus I, all names at
  // module scope starting with the material's; what it may use is in backends/wgpu/src/prelude.wgsl.
  struct BarchanStr wgsl;
  // WGSL text of `<name>_update_adj`; empty: no gradient on the GPU.
  struct BarchanStr wgsl_adj;
  // Needed for the time-step bound of a law whose stress follows the rate of deformation; NULL: it does not. Since minor version 1.
  BarchanViscosityF32 viscosity_f32;
  // WGSL text of `<name>_stiffness`, which gives the tangent moduli and the viscosity of one particle on the GPU; it may call what `wgsl`
  // defines. Empty: the stiffness of a law with BARCHAN_CAP_HARDENS is asked on the host, for which the GPU's particles are copied there
  // every few steps. Since minor version 1.
  struct BarchanStr wgsl_stiffness;
} BarchanMaterial;

// What `const BarchanPlugin *barchan_plugin_v1(void)` returns.
typedef struct BarchanPlugin {
  // sizeof(BarchanPlugin) as the plugin knows it.
  size_t struct_size;
  // BARCHAN_ABI_MAJOR the plugin was built with.
  uint32_t abi_major;
  // BARCHAN_ABI_MINOR the plugin was built with.
  uint32_t abi_minor;
  // BARCHAN_PLUGIN_* bits.
  uint64_t flags;
  // n_materials pointers.
  const struct BarchanMaterial *const *materials;
  // Number of materials.
  size_t n_materials;
} BarchanPlugin;

// Type of the exported entry function `barchan_plugin_v1`.
typedef const struct BarchanPlugin *(*BarchanPluginEntry)(void);

// The callback succeeded and all its outputs are written.
#define BARCHAN_OK 0

// The plugin panicked; the message holds the panic's text.
#define BARCHAN_E_PANIC 1

// A parameter, or a combination of parameters, has no meaning; the message says which.
#define BARCHAN_E_INVALID_PARAM 2

// An input or a result is NaN or infinite; `particle` is the first such index in the batch.
#define BARCHAN_E_NON_FINITE 3

// Any other failure.
#define BARCHAN_E_OTHER 4

#ifdef _WIN32
#define BARCHAN_EXPORT __declspec(dllexport)
#else
#define BARCHAN_EXPORT __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif
/* The one function that a plugin exports. */
BARCHAN_EXPORT const BarchanPlugin *barchan_plugin_v1(void);
#ifdef __cplusplus
}
#endif

#endif /* BARCHAN_ABI_H */
