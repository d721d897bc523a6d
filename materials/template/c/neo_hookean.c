/* A material plugin in C: the compressible neo-Hookean solid, tau = mu (b - I) + lambda ln J I.
 *
 *   cc -std=c11 -O2 -Wall -Wextra -shared -fPIC -I <barchan>/sim-core/abi/include neo_hookean.c -o libneo_hookean.so -lm
 *
 * -lm links the mathematics library, for log; without it the plugin builds, and may fail to load.
 *
 * To make it yours: change the name, the parameters and the laws `stress`, `moduli` and `energy`; the rest is the same for
 * every material. Barchan's conformance suite tells whether it obeys the rules in barchan_abi.h.
 */
#include "barchan_abi.h"

#include <math.h>
#include <string.h>

/* The layout that this plugin was written against; a header that moved a field would not compile. */
#if UINTPTR_MAX == UINT64_MAX
_Static_assert(sizeof(BarchanBatchF32) == 88 && sizeof(BarchanBatchF64) == 88, "batch layout of ABI 1.0");
_Static_assert(sizeof(BarchanParam) == 80 && sizeof(BarchanError) == 40, "declaration layout of ABI 1.0");
_Static_assert(offsetof(BarchanMaterial, update_f32) == 144, "table layout of ABI 1.0");
_Static_assert(offsetof(BarchanMaterial, wgsl_stiffness) == 248, "table layout of ABI 1.1");
#endif

/* A string of the ABI from a literal; its length leaves out the final NUL. */
#define STR(text) {(const uint8_t *)(text), sizeof(text) - 1}

/* det b below this is raised to it before the logarithm. */
#define LEAST_DETERMINANT 1e-24

static BarchanStatus fail(BarchanError *error, BarchanStatus status, const char *message, uint64_t particle) {
  if (error != NULL && error->struct_size >= sizeof(BarchanError)) {
    size_t length = strlen(message); /* ASCII, so any cut is at a character boundary */
    error->len = error->message == NULL ? 0 : length < error->capacity ? length : error->capacity;
    if (error->len > 0) memcpy(error->message, message, error->len);
    error->particle = particle;
  }
  return status;
}

/* What may be refused before a pointer is followed. */
#define CHECK(Batch, batch, error)                                                                        \
  if ((batch) == NULL || (batch)->struct_size < sizeof(Batch))                                            \
    return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: the batch is NULL or older than this plugin", UINT64_MAX); \
  if ((batch)->n > (batch)->stride)                                                                       \
    return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: the stride is below n", UINT64_MAX);              \
  if ((batch)->n > 0 && ((batch)->params == NULL || (batch)->strain_trial == NULL))                       \
    return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: params or strain_trial is NULL", UINT64_MAX)

#define NON_FINITE "c_neo_hookean: strain, modulus or stress is not finite"

/* The laws, written once for both precisions. Planes of b: xx yy zz xy xz yz, `stride` apart. */
#define LAWS(Real, suffix, Batch, LOG)                                                                    \
  static void lame_##suffix(const Real *params, Real *lambda, Real *mu) {                                 \
    const Real young = params[0], poisson = params[1];                                                    \
    *mu = young / (2 * (1 + poisson));                                                                    \
    *lambda = young * poisson / ((1 + poisson) * (1 - 2 * poisson));                                      \
  }                                                                                                       \
                                                                                                          \
  static Real log_volume_##suffix(const Real *b, size_t stride) {                                         \
    const Real xx = b[0], yy = b[stride], zz = b[2 * stride];                                             \
    const Real xy = b[3 * stride], xz = b[4 * stride], yz = b[5 * stride];                                \
    const Real det = xx * (yy * zz - yz * yz) - xy * (xy * zz - xz * yz) + xz * (xy * yz - xz * yy);      \
    const Real least = (Real)LEAST_DETERMINANT;                                                           \
    return LOG(det < least ? least : det) / 2;                                                            \
  }                                                                                                       \
                                                                                                          \
  static BarchanStatus update_##suffix(const Batch *batch, BarchanError *error) {                         \
    CHECK(Batch, batch, error);                                                                           \
    if (batch->n > 0 && (batch->strain == NULL || batch->kirchhoff == NULL))                              \
      return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: an output is NULL", UINT64_MAX);                \
    if (batch->n == 0) return BARCHAN_OK;                                                                 \
    Real lambda, mu;                                                                                      \
    lame_##suffix(batch->params, &lambda, &mu);                                                           \
    for (size_t i = 0; i < batch->n; i++) {                                                               \
      const Real *b = batch->strain_trial + i;                                                            \
      const Real pressure = lambda * log_volume_##suffix(b, batch->stride);                               \
      Real sum = 0; /* finite only if all of its terms are */                                             \
      for (size_t c = 0; c < 6; c++) {                                                                    \
        const Real strain = b[c * batch->stride];                                                         \
        const Real stress = c < 3 ? mu * (strain - 1) + pressure : mu * strain;                           \
        batch->strain[c * batch->stride + i] = strain;                                                    \
        batch->kirchhoff[c * batch->stride + i] = stress;                                                 \
        sum += strain + stress;                                                                           \
      }                                                                                                   \
      if (!isfinite(sum)) return fail(error, BARCHAN_E_NON_FINITE, NON_FINITE, i);                        \
    }                                                                                                     \
    return BARCHAN_OK;                                                                                    \
  }

LAWS(float, f32, BarchanBatchF32, logf)
LAWS(double, f64, BarchanBatchF64, log)

static BarchanStatus tangent_moduli_f32(const BarchanBatchF32 *batch, float *moduli, BarchanError *error) {
  CHECK(BarchanBatchF32, batch, error);
  if (batch->n == 0) return BARCHAN_OK;
  if (moduli == NULL) return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: moduli is NULL", UINT64_MAX);
  float lambda, mu;
  lame_f32(batch->params, &lambda, &mu);
  for (size_t i = 0; i < batch->n; i++) {
    /* The stiffness along a stretched axis grows as mu b; 1 + |b - I| bounds the greatest eigenvalue of b. */
    float square = 0;
    for (size_t c = 0; c < 6; c++) {
      const float b = batch->strain_trial[c * batch->stride + i];
      square += c < 3 ? (b - 1) * (b - 1) : 2 * b * b;
    }
    const float shear = mu * (1 + sqrtf(square));
    if (!isfinite(shear)) return fail(error, BARCHAN_E_NON_FINITE, NON_FINITE, i);
    moduli[i] = lambda + 2 * shear;
    moduli[batch->stride + i] = 3 * lambda + 2 * shear;
  }
  return BARCHAN_OK;
}

static BarchanStatus energy_f64(const BarchanBatchF64 *batch, double *energy, BarchanError *error) {
  CHECK(BarchanBatchF64, batch, error);
  if (batch->n == 0) return BARCHAN_OK;
  if (energy == NULL) return fail(error, BARCHAN_E_OTHER, "c_neo_hookean: energy is NULL", UINT64_MAX);
  double lambda, mu;
  lame_f64(batch->params, &lambda, &mu);
  for (size_t i = 0; i < batch->n; i++) {
    const double *b = batch->strain_trial + i;
    const double ln_j = log_volume_f64(b, batch->stride);
    const double stretch = b[0] + b[batch->stride] + b[2 * batch->stride] - 3;
    energy[i] = (mu * (stretch - 2 * ln_j) + lambda * ln_j * ln_j) / 2;
    if (!isfinite(energy[i])) return fail(error, BARCHAN_E_NON_FINITE, NON_FINITE, i);
  }
  return BARCHAN_OK;
}

static const BarchanParam PARAMS[] = {
    {
        .name = STR("young_modulus"),
        .unit = STR("Pa"),
        .doc = STR("Young's modulus E."),
        .default_value = 1e5,
        .min_value = 0,
        .max_value = 1e13,
        .flags = BARCHAN_PARAM_MIN_OPEN | BARCHAN_PARAM_LOG_SCALE,
    },
    {
        .name = STR("poisson_ratio"),
        .unit = STR("1"),
        .doc = STR("Poisson's ratio; both bounds are excluded."),
        .default_value = 0.3,
        .min_value = -1,
        .max_value = 0.5,
        .flags = BARCHAN_PARAM_MIN_OPEN | BARCHAN_PARAM_MAX_OPEN,
    },
};

/* The law on the GPU: a pure function of one particle, without bindings, whose names start with the material's. It may use what
 * Barchan's backends/wgpu/src/prelude.wgsl defines; strains come and go minus I. */
static const char WGSL[] =
    "fn c_neo_hookean_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {\n"
    "    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));\n"
    "    let strain = barchan_sym(x.strain);\n"
    "    let kirchhoff = barchan_affine(law.mu, strain, law.lambda * barchan_log_volume(strain));\n"
    "    return MatOut(x.strain, barchan_mat(kirchhoff));\n"
    "}\n";

/* How stiff a particle is, there too; without it, its particles would be copied to the host every few steps to ask tangent_moduli_f32. */
static const char WGSL_STIFFNESS[] =
    "fn c_neo_hookean_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {\n"
    "    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));\n"
    "    let bound = 1.0 + sqrt(barchan_norm2(barchan_sym(strain)));\n"
    "    return barchan_stiffness(Lame(law.lambda, law.mu * bound));\n"
    "}\n";

/* Slots that are left out are NULL: no gradients, no check of parameters, no counts, no viscosity. */
static const BarchanMaterial NEO_HOOKEAN = {
    .struct_size = sizeof(BarchanMaterial),
    .abi_major = BARCHAN_ABI_MAJOR,
    .abi_minor = BARCHAN_ABI_MINOR,
    .capabilities = BARCHAN_CAP_HARDENS,
    .strain_kind = BARCHAN_STRAIN_LEFT_CAUCHY_GREEN,
    .name = STR("c_neo_hookean"),
    .version = STR("1.0.0"),
    .doc = STR("Compressible neo-Hookean solid, written in C."),
    .reference = STR("Bonet and Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, eq. 6.29"),
    .params = PARAMS,
    .n_params = sizeof(PARAMS) / sizeof(PARAMS[0]),
    .param_size = sizeof(BarchanParam),
    .state_size = sizeof(BarchanStateVar),
    .update_f32 = update_f32,
    .update_f64 = update_f64,
    .tangent_moduli_f32 = tangent_moduli_f32,
    .energy_f64 = energy_f64,
    .wgsl = {(const uint8_t *)WGSL, sizeof(WGSL) - 1},
    .wgsl_stiffness = {(const uint8_t *)WGSL_STIFFNESS, sizeof(WGSL_STIFFNESS) - 1},
};

static const BarchanMaterial *const MATERIALS[] = {&NEO_HOOKEAN};

const BarchanPlugin *barchan_plugin_v1(void) {
  static const BarchanPlugin PLUGIN = {
      .struct_size = sizeof(BarchanPlugin),
      .abi_major = BARCHAN_ABI_MAJOR,
      .abi_minor = BARCHAN_ABI_MINOR,
      .materials = MATERIALS,
      .n_materials = sizeof(MATERIALS) / sizeof(MATERIALS[0]),
  };
  return &PLUGIN;
}
