/* A material plugin in C++: the compressible neo-Hookean solid, tau = mu (b - I) + lambda ln J I.
 *
 *   c++ -std=c++17 -O2 -Wall -Wextra -shared -fPIC -I <barchan>/sim-core/abi/include neo_hookean.cpp -o libneo_hookean.so
 *
 * To make it yours: change the name, the parameters and the struct `Law`; the rest is the same for every material. Barchan's
 * conformance suite tells whether it obeys the rules in barchan_abi.h.
 */
#include "barchan_abi.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <iterator>
#include <stdexcept>
#include <string_view>

namespace {

/* The layout that this plugin was written against; a header that moved a field would not compile. */
static_assert(sizeof(void *) != 8 || sizeof(BarchanBatchF32) == 88, "batch layout of ABI 1.0");
static_assert(sizeof(void *) != 8 || sizeof(BarchanBatchF64) == 88, "batch layout of ABI 1.0");
static_assert(sizeof(void *) != 8 || sizeof(BarchanParam) == 80, "declaration layout of ABI 1.0");
static_assert(sizeof(void *) != 8 || offsetof(BarchanMaterial, wgsl_stiffness) == 248, "table layout of ABI 1.1");

/* A symmetric tensor: xx yy zz xy xz yz. */
template <class Real> using Sym = std::array<Real, 6>;

/* The law, written once for both precisions. */
template <class Real> struct Law {
  Real lambda, mu;

  /* From the parameters, in the order in which they are declared. */
  explicit Law(const Real *params) {
    const Real young = params[0], poisson = params[1];
    mu = young / (2 * (1 + poisson));
    lambda = young * poisson / ((1 + poisson) * (1 - 2 * poisson));
  }

  /* ln J = 1/2 ln det b; a determinant that is not above 0 is raised to what has a logarithm. */
  static Real log_volume(const Sym<Real> &b) {
    const auto [xx, yy, zz, xy, xz, yz] = b;
    const Real det = xx * (yy * zz - yz * yz) - xy * (xy * zz - xz * yz) + xz * (xy * yz - xz * yy);
    return std::log(std::max(det, Real(1e-24))) / 2;
  }

  /* Kirchhoff stress [Pa]. */
  Sym<Real> stress(const Sym<Real> &b) const {
    const Real pressure = lambda * log_volume(b);
    Sym<Real> tau;
    for (size_t c = 0; c < 6; c++) tau[c] = c < 3 ? mu * (b[c] - 1) + pressure : mu * b[c];
    return tau;
  }

  /* Shear modulus along the axis that is stretched most [Pa]: it grows as mu b, and 1 + |b - I| bounds the greatest eigenvalue of b. */
  Real shear_modulus(const Sym<Real> &b) const {
    Real square = 0;
    for (size_t c = 0; c < 6; c++) square += c < 3 ? (b[c] - 1) * (b[c] - 1) : 2 * b[c] * b[c];
    return mu * (1 + std::sqrt(square));
  }

  /* Elastic energy per rest volume [J/m^3]. */
  Real energy(const Sym<Real> &b) const {
    const Real ln_j = log_volume(b);
    return (mu * (b[0] + b[1] + b[2] - 3 - 2 * ln_j) + lambda * ln_j * ln_j) / 2;
  }
};

/* What a callback throws: no exception may leave it, so `guarded` makes a status of it. */
struct Failure : std::runtime_error {
  BarchanStatus status;
  uint64_t particle;
  Failure(BarchanStatus status, const char *what, uint64_t particle = UINT64_MAX)
      : std::runtime_error(what), status(status), particle(particle) {}
};

BarchanStatus report(BarchanError *error, BarchanStatus status, std::string_view text, uint64_t particle) noexcept {
  if (error != nullptr && error->struct_size >= sizeof(BarchanError)) {
    /* The texts are ASCII, so any cut is at a character boundary. */
    error->len = error->message == nullptr ? 0 : std::min(text.size(), error->capacity);
    std::copy_n(text.begin(), error->len, error->message);
    error->particle = particle;
  }
  return status;
}

/* Looks at a batch before a pointer is followed, and calls `body` if it can be used. */
template <class Batch, class Body>
BarchanStatus guarded(const Batch *batch, BarchanError *error, Body body) noexcept {
  try {
    if (batch == nullptr || batch->struct_size < sizeof(Batch))
      throw Failure(BARCHAN_E_OTHER, "cpp_neo_hookean: the batch is NULL or older than this plugin");
    if (batch->n > batch->stride) throw Failure(BARCHAN_E_OTHER, "cpp_neo_hookean: the stride is below n");
    if (batch->n == 0) return BARCHAN_OK;
    if (batch->params == nullptr || batch->strain_trial == nullptr)
      throw Failure(BARCHAN_E_OTHER, "cpp_neo_hookean: params or strain_trial is NULL");
    body();
    return BARCHAN_OK;
  } catch (const Failure &failure) {
    return report(error, failure.status, failure.what(), failure.particle);
  } catch (const std::exception &exception) {
    return report(error, BARCHAN_E_OTHER, exception.what(), UINT64_MAX);
  } catch (...) {
    return report(error, BARCHAN_E_OTHER, "cpp_neo_hookean: an exception without a text", UINT64_MAX);
  }
}

void must_be_there(const void *output) {
  if (output == nullptr) throw Failure(BARCHAN_E_OTHER, "cpp_neo_hookean: an output is NULL");
}

void must_be_finite(double value, size_t particle) {
  if (!std::isfinite(value))
    throw Failure(BARCHAN_E_NON_FINITE, "cpp_neo_hookean: strain, modulus or stress is not finite", particle);
}

/* The trial strain of a particle: its components lie `stride` apart. */
template <class Real, class Batch> Sym<Real> strain_of(const Batch *batch, size_t particle) {
  Sym<Real> b;
  for (size_t c = 0; c < 6; c++) b[c] = batch->strain_trial[c * batch->stride + particle];
  return b;
}

template <class Real, class Batch> BarchanStatus update(const Batch *batch, BarchanError *error) noexcept {
  return guarded(batch, error, [&] {
    must_be_there(batch->strain);
    must_be_there(batch->kirchhoff);
    const Law<Real> law(batch->params);
    for (size_t i = 0; i < batch->n; i++) {
      const Sym<Real> b = strain_of<Real>(batch, i);
      const Sym<Real> tau = law.stress(b);
      Real sum = 0; /* finite only if all of its terms are */
      for (size_t c = 0; c < 6; c++) {
        batch->strain[c * batch->stride + i] = b[c];
        batch->kirchhoff[c * batch->stride + i] = tau[c];
        sum += b[c] + tau[c];
      }
      must_be_finite(sum, i);
    }
  });
}

BarchanStatus tangent_moduli(const BarchanBatchF32 *batch, float *moduli, BarchanError *error) noexcept {
  return guarded(batch, error, [&] {
    must_be_there(moduli);
    const Law<float> law(batch->params);
    for (size_t i = 0; i < batch->n; i++) {
      const float shear = law.shear_modulus(strain_of<float>(batch, i));
      must_be_finite(shear, i);
      moduli[i] = law.lambda + 2 * shear;
      moduli[batch->stride + i] = 3 * law.lambda + 2 * shear;
    }
  });
}

BarchanStatus energy(const BarchanBatchF64 *batch, double *energy, BarchanError *error) noexcept {
  return guarded(batch, error, [&] {
    must_be_there(energy);
    const Law<double> law(batch->params);
    for (size_t i = 0; i < batch->n; i++) {
      energy[i] = law.energy(strain_of<double>(batch, i));
      must_be_finite(energy[i], i);
    }
  });
}

/* The law on the GPU: a pure function of one particle, without bindings, whose names start with the material's. It may use what
 * Barchan's backends/wgpu/src/prelude.wgsl defines; strains come and go minus I. */
constexpr std::string_view WGSL = R"(
fn cpp_neo_hookean_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let strain = barchan_sym(x.strain);
    let kirchhoff = barchan_affine(law.mu, strain, law.lambda * barchan_log_volume(strain));
    return MatOut(x.strain, barchan_mat(kirchhoff));
}
)";

/* How stiff a particle is, there too; without it, its particles would be copied to the host every few steps to ask tangent_moduli. */
constexpr std::string_view WGSL_STIFFNESS = R"(
fn cpp_neo_hookean_stiffness(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    let law = barchan_lame(barchan_param(base, 0u), barchan_param(base, 1u));
    let bound = 1.0 + sqrt(barchan_norm2(barchan_sym(strain)));
    return barchan_stiffness(Lame(law.lambda, law.mu * bound));
}
)";

/* A text that lives as long as the library. */
BarchanStr str(std::string_view text) { return {reinterpret_cast<const uint8_t *>(text.data()), text.size()}; }

const BarchanParam PARAMS[] = {
    {str("young_modulus"), str("Pa"), str("Young's modulus E."), 1e5, 0, 1e13,
     BARCHAN_PARAM_MIN_OPEN | BARCHAN_PARAM_LOG_SCALE},
    {str("poisson_ratio"), str("1"), str("Poisson's ratio; both bounds are excluded."), 0.3, -1, 0.5,
     BARCHAN_PARAM_MIN_OPEN | BARCHAN_PARAM_MAX_OPEN},
};

/* Slots that are left out are NULL: no gradients, no check of parameters, no counts, no viscosity. */
const BarchanMaterial NEO_HOOKEAN = [] {
  BarchanMaterial m{};
  m.struct_size = sizeof m;
  m.abi_major = BARCHAN_ABI_MAJOR;
  m.abi_minor = BARCHAN_ABI_MINOR;
  m.capabilities = BARCHAN_CAP_HARDENS;
  m.strain_kind = BARCHAN_STRAIN_LEFT_CAUCHY_GREEN;
  m.name = str("cpp_neo_hookean");
  m.version = str("1.0.0");
  m.doc = str("Compressible neo-Hookean solid, written in C++.");
  m.reference = str("Bonet and Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, eq. 6.29");
  m.params = PARAMS;
  m.n_params = std::size(PARAMS);
  m.param_size = sizeof(BarchanParam);
  m.state_size = sizeof(BarchanStateVar);
  m.update_f32 = update<float, BarchanBatchF32>;
  m.update_f64 = update<double, BarchanBatchF64>;
  m.tangent_moduli_f32 = tangent_moduli;
  m.energy_f64 = energy;
  m.wgsl = str(WGSL);
  m.wgsl_stiffness = str(WGSL_STIFFNESS);
  return m;
}();

const BarchanMaterial *const MATERIALS[] = {&NEO_HOOKEAN};

const BarchanPlugin PLUGIN = [] {
  BarchanPlugin p{};
  p.struct_size = sizeof p;
  p.abi_major = BARCHAN_ABI_MAJOR;
  p.abi_minor = BARCHAN_ABI_MINOR;
  p.materials = MATERIALS;
  p.n_materials = std::size(MATERIALS);
  return p;
}();

} // namespace

const BarchanPlugin *barchan_plugin_v1() { return &PLUGIN; }
