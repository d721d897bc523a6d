//! Derivatives of a law, backwards: from cotangents of what an update gives to those of what it is given.
//!
//! Laws are written for all numbers, dual ones among them ([`barchan_lanes::Dual`]). A batch is updated once for every few values of strain, rate, history and
//! parameter that may vary, each with its own derivative 1, and what comes out is weighed with the cotangents. A particle has 8 to 21 of them.

use crate::batch::{Batch, Failure, guard, open};
use crate::declare::Param;
use crate::material::{MAX_PARAMS, MAX_STATE, MatIn, Material, Strain};
use crate::tensor::Mat3;
use barchan_abi::*;
use barchan_lanes::{CHUNK, Dual, Isa, Kernel, Lanes, Mask};
use core::marker::PhantomData;

/// Values of strain, velocity gradient, history and parameters.
const MOST_VALUES: usize = 9 + 9 + MAX_STATE + MAX_PARAMS;

/// Where values of each kind begin among those that vary.
const RATES: usize = 9;
const STATES: usize = RATES + 9;
const PARAMS: usize = STATES + MAX_STATE;

/// How many values vary at a time: what of an update does not vary is worked out once for them.
const TOGETHER: usize = 4;

/// The walk over a batch. Returns the first particle with a derivative that is not finite.
struct PullBack<'a, M> {
    batch: Batch<f64>,
    adjoint: &'a BarchanAdjointF64,
    /// Cotangents of parameters, summed over the batch.
    params: &'a mut [f64; MAX_PARAMS],
    material: PhantomData<M>,
}

impl<M: Material> PullBack<'_, M> {
    /// Which values may vary, by their numbers.
    fn values() -> impl Iterator<Item = usize> {
        let rates = if M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD != 0 { 9 } else { 0 };
        let varies = |param: &Param| param.is_differentiable();
        let params = M::PARAMS.iter().enumerate().filter(move |(_, param)| varies(param)).map(|(i, _)| PARAMS + i);
        let strains = 0..<M::Strain<f64> as Strain<f64>>::PLANES;
        strains.chain(RATES..RATES + rates).chain(STATES..STATES + M::STATES.len()).chain(params)
    }
}

/// A plane's values of as many particles as there are lanes, the last one's again behind the batch's end.
///
/// # Safety
/// `plane` must be valid for reading `start + count` values.
#[inline(always)]
unsafe fn load<V: Lanes<Scalar = f64>>(plane: *const f64, start: usize, count: usize) -> V {
    let mut padded = [0.0; CHUNK];
    for (i, to) in padded[..V::COUNT].iter_mut().enumerate() {
        // SAFETY: the caller vouches for the plane, and i is cut at the last particle.
        *to = unsafe { plane.add(start + i.min(count - 1)).read() };
    }
    V::read(&padded)
}

/// Values of which the first has a number, the next one more, and so on: those vary whose numbers are among `together`.
#[inline(always)]
fn vary<V: Lanes>(at: &[V], first: usize, together: &[usize; TOGETHER], values: &mut [Dual<V, TOGETHER>]) {
    for (number, (value, at)) in (first..).zip(values.iter_mut().zip(at)) {
        *value = Dual::fixed(*at);
        for (derivative, varies) in value.derivatives.iter_mut().zip(together) {
            if *varies == number {
                *derivative = V::one();
            }
        }
    }
}

/// Adds what cotangents make of the derivatives of some values.
#[inline(always)]
fn weigh<V: Lanes>(cotangents: &[V], values: &[Dual<V, TOGETHER>], sums: &mut [V; TOGETHER]) {
    for (cotangent, value) in cotangents.iter().zip(values) {
        for (sum, derivative) in sums.iter_mut().zip(&value.derivatives) {
            *sum = cotangent.mul_add(*derivative, *sum);
        }
    }
}

impl<M: Material> Kernel<f64> for PullBack<'_, M> {
    type Output = Option<usize>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> Option<usize> {
        let Batch { n, dt, params, inputs, .. } = self.batch;
        let (planes, states) = (<M::Strain<f64> as Strain<f64>>::PLANES, M::STATES.len());
        let (has_rates, stride) = (M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD != 0, inputs.stride);
        for start in (0..n).step_by(V::COUNT) {
            let count = (n - start).min(V::COUNT);
            let mut at = [V::zero(); MOST_VALUES];
            let mut strain = [V::zero(); 9];
            let mut kirchhoff = [V::zero(); 6];
            let mut state = [V::zero(); MAX_STATE];
            // SAFETY: `open` and `pull_back` have checked the pointers that are followed; the host vouches for n values in each plane, and for as many
            // parameters as the material declares.
            unsafe {
                for c in 0..planes {
                    at[c] = load::<V>(inputs.strain.add(c * stride), start, count);
                    strain[c] = load::<V>(self.adjoint.adj_strain.add(c * stride), start, count);
                }
                for c in 0..if has_rates { 9 } else { 0 } {
                    at[RATES + c] = load::<V>(inputs.vel_grad.add(c * stride), start, count);
                }
                for c in 0..states {
                    at[STATES + c] = load::<V>(inputs.state.add(c * stride), start, count);
                    if !self.adjoint.adj_state_out.is_null() {
                        state[c] = load::<V>(self.adjoint.adj_state_out.add(c * stride), start, count);
                    }
                }
                for (c, kirchhoff) in kirchhoff.iter_mut().enumerate() {
                    *kirchhoff = load::<V>(self.adjoint.adj_kirchhoff.add(c * stride), start, count);
                }
                for c in 0..M::PARAMS.len() {
                    at[PARAMS + c] = V::fill(params.add(c).read());
                }
            }
            let mut sound = V::Mask::splat(true);
            let mut values = Self::values();
            loop {
                let mut together = [MOST_VALUES; TOGETHER];
                let found = together.iter_mut().zip(&mut values).map(|(to, value)| *to = value).count();
                if found == 0 {
                    break;
                }
                let mut params = [Dual::fixed(V::zero()); MAX_PARAMS];
                let mut planes_of_strain = [Dual::fixed(V::zero()); 9];
                let mut rates = [Dual::fixed(V::zero()); 9];
                let mut history = [Dual::fixed(V::zero()); MAX_STATE];
                vary(&at[PARAMS..][..M::PARAMS.len()], PARAMS, &together, &mut params);
                vary(&at[..planes], 0, &together, &mut planes_of_strain);
                vary(&at[RATES..][..if has_rates { 9 } else { 0 }], RATES, &together, &mut rates);
                vary(&at[STATES..][..states], STATES, &together, &mut history);
                let law = M::law(&params[..M::PARAMS.len()]);
                let given = MatIn {
                    strain: M::Strain::from_planes(planes_of_strain),
                    vel_grad: Mat3::from_components(rates),
                    dt: Dual::fixed(V::fill(dt)),
                };
                let out = M::update(&law, given, &mut history[..states]);
                let mut sums = [V::zero(); TOGETHER];
                weigh(&strain[..planes], &out.strain.into_planes(), &mut sums);
                weigh(&kirchhoff, &out.kirchhoff.components(), &mut sums);
                weigh(&state[..states], &history, &mut sums);
                for (value, sum) in together[..found].iter().zip(sums) {
                    sound = sound & sum.is_finite();
                    let mut lanes = [0.0; CHUNK];
                    sum.write(&mut lanes);
                    let sums = &lanes[..count];
                    let plane = match *value {
                        value @ PARAMS.. => {
                            sums.iter().for_each(|sum| self.params[value - PARAMS] += sum);
                            continue;
                        }
                        // SAFETY: planes are within what the host vouches for.
                        value @ STATES.. => unsafe { self.adjoint.adj_state_in.add((value - STATES) * stride) },
                        // SAFETY: as above.
                        value @ RATES.. => unsafe { self.adjoint.adj_vel_grad.add((value - RATES) * stride) },
                        // SAFETY: as above.
                        value => unsafe { self.adjoint.adj_strain_trial.add(value * stride) },
                    };
                    for (i, sum) in sums.iter().enumerate() {
                        // SAFETY: as above.
                        unsafe { *plane.add(start + i) += sum };
                    }
                }
            }
            let bad = !sound.bits() & (u16::MAX >> (u16::BITS as usize - count));
            if bad != 0 {
                return Some(start + bad.trailing_zeros() as usize);
            }
        }
        None
    }
}

/// Checks what can be checked of a batch and its cotangents, and walks over it.
///
/// # Safety
/// Both must be NULL or as the ABI describes them.
unsafe fn pull_back<M: Material>(
    batch: *const BarchanBatchF64,
    adjoint: *const BarchanAdjointF64,
) -> Result<(), Failure> {
    let bad = |what: String| Failure::new(BARCHAN_E_OTHER, format!("material '{}': {what}", M::NAME));
    // SAFETY: the caller vouches for the batch.
    let batch = unsafe { open::<M, BarchanBatchF64>(batch)? };
    if adjoint.is_null() {
        return Err(bad("the cotangents are NULL".into()));
    }
    // SAFETY: every version of the struct starts with its size.
    let size = unsafe { adjoint.cast::<usize>().read() };
    if size < size_of::<BarchanAdjointF64>() {
        let known = size_of::<BarchanAdjointF64>();
        return Err(bad(format!("the cotangents have {size} bytes, this material reads {known}")));
    }
    // SAFETY: it has the size that we know, or more.
    let adjoint = unsafe { &*adjoint };
    let no_rates = M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD == 0;
    let required = [
        ("adj_strain", adjoint.adj_strain, false),
        ("adj_kirchhoff", adjoint.adj_kirchhoff, false),
        ("adj_strain_trial", adjoint.adj_strain_trial.cast_const(), false),
        ("adj_vel_grad", adjoint.adj_vel_grad.cast_const(), no_rates),
        ("adj_state_in", adjoint.adj_state_in.cast_const(), M::STATES.is_empty()),
        ("adj_params", adjoint.adj_params.cast_const(), M::PARAMS.is_empty()),
    ];
    if let Some((name, ..)) =
        required.iter().find(|(_, pointer, optional)| pointer.is_null() && !optional && batch.n > 0)
    {
        return Err(bad(format!("{name} is NULL")));
    }
    let mut params = [0.0; MAX_PARAMS];
    let isa = Isa::current().map_err(|e| Failure::new(BARCHAN_E_OTHER, e.to_string()))?;
    let fault = isa.run(PullBack { batch, adjoint, params: &mut params, material: PhantomData::<M> });
    if let Some(particle) = fault {
        return Err(Failure {
            status: BARCHAN_E_NON_FINITE,
            message: format!("material '{}': a derivative of strain, state or stress is not finite", M::NAME),
            particle: particle as u64,
        });
    }
    for (i, sum) in params[..M::PARAMS.len()].iter().enumerate().filter(|_| batch.n > 0) {
        // SAFETY: the host vouches for as many values as the material declares.
        unsafe { *adjoint.adj_params.add(i) += sum };
    }
    Ok(())
}

/// The callback `update_adj_f64`.
pub(crate) unsafe extern "C" fn update_adj<M: Material>(
    batch: *const BarchanBatchF64,
    adjoint: *const BarchanAdjointF64,
    error: *mut BarchanError,
) -> BarchanStatus {
    // SAFETY: the ABI obliges the host to pass batches, cotangents and error structs as `barchan_abi` describes them; `guard` lets no panic through.
    unsafe { guard(error, || pull_back::<M>(batch, adjoint)) }
}
