//! From a material to its C table: pointers checked, batches cut into registers, panics and failures turned into statuses.

use crate::declare::{Param, State};
use crate::material::{Events, MAX_PARAMS, MAX_STATE, MatIn, Material, Strain};
use crate::tensor::Mat3;
use barchan_abi::*;
use barchan_lanes::{CHUNK, Float, Isa, Kernel, Lanes, Mask, Real};
use core::marker::PhantomData;
use core::mem::MaybeUninit;
use core::ptr::null_mut;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// The table of a material: what the registry takes, and what a plugin exports.
pub const fn vtable<M: Material>() -> &'static BarchanMaterial {
    &Table::<M>::TABLE
}

struct Table<M>(PhantomData<M>);

impl<M: Material> Table<M> {
    const TABLE: BarchanMaterial = {
        assert!(M::PARAMS.len() <= MAX_PARAMS && M::STATES.len() <= MAX_STATE);
        BarchanMaterial {
            struct_size: size_of::<BarchanMaterial>(),
            abi_major: BARCHAN_ABI_MAJOR,
            abi_minor: BARCHAN_ABI_MINOR,
            capabilities: M::CAPABILITIES,
            strain_kind: <M::Strain<f64> as Strain<f64>>::KIND,
            reserved: 0,
            name: BarchanStr::new(M::NAME),
            version: BarchanStr::new(M::VERSION),
            doc: BarchanStr::new(M::DOC),
            reference: BarchanStr::new(M::REFERENCE),
            params: M::PARAMS.as_ptr().cast(),
            n_params: M::PARAMS.len(),
            param_size: size_of::<Param>(),
            states: M::STATES.as_ptr().cast(),
            n_state: M::STATES.len(),
            state_size: size_of::<State>(),
            update_f32: Some(update::<M, BarchanBatchF32>),
            update_adj_f32: None,
            update_f64: Some(update::<M, BarchanBatchF64>),
            update_adj_f64: Some(crate::adjoint::update_adj::<M>),
            tangent_moduli_f32: Some(tangent_moduli::<M>),
            energy_f64: Some(energy::<M>),
            check_params: Some(check_params::<M>),
            count_f64: Some(count::<M>),
            wgsl: BarchanStr::new(M::WGSL),
            wgsl_adj: BarchanStr::new(""),
            viscosity_f32: if M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD != 0 { Some(viscosity::<M>) } else { None },
            wgsl_stiffness: BarchanStr::new(M::WGSL_STIFFNESS),
        }
    };
}

/// Exports materials from a cdylib as the plugin's entry `barchan_plugin_v1`.
#[macro_export]
macro_rules! export_materials {
    ($($material:ty),+ $(,)?) => {
        /// The plugin's table.
        ///
        /// # Safety
        /// None: it returns the address of static data.
        #[unsafe(no_mangle)]
        pub extern "C" fn barchan_plugin_v1() -> *const $crate::abi::BarchanPlugin {
            const MATERIALS: &[&$crate::abi::BarchanMaterial] = &[$($crate::vtable::<$material>()),+];
            static PLUGIN: $crate::abi::BarchanPlugin = $crate::abi::BarchanPlugin {
                struct_size: size_of::<$crate::abi::BarchanPlugin>(),
                abi_major: $crate::abi::BARCHAN_ABI_MAJOR,
                abi_minor: $crate::abi::BARCHAN_ABI_MINOR,
                flags: if cfg!(panic = "abort") { $crate::abi::BARCHAN_PLUGIN_PANIC_ABORT } else { 0 },
                materials: MATERIALS.as_ptr().cast(),
                n_materials: MATERIALS.len(),
            };
            &PLUGIN
        }
    };
}

/// Why a callback failed.
pub(crate) struct Failure {
    pub(crate) status: BarchanStatus,
    pub(crate) message: String,
    pub(crate) particle: u64,
}

impl Failure {
    pub(crate) fn new(status: BarchanStatus, message: impl Into<String>) -> Self {
        Self { status, message: message.into(), particle: u64::MAX }
    }
}

/// Runs a callback; a failure or panic becomes a status, with its text in `error` if that is a struct we know.
///
/// # Safety
/// `error` must be NULL or point to a struct of the size that it declares, with a buffer of the capacity that it declares.
pub(crate) unsafe fn guard(error: *mut BarchanError, callback: impl FnOnce() -> Result<(), Failure>) -> BarchanStatus {
    let failure = match catch_unwind(AssertUnwindSafe(callback)) {
        Ok(Ok(())) => return BARCHAN_OK,
        Ok(Err(failure)) => failure,
        Err(panic) => {
            let text = panic.downcast_ref::<&str>().map(ToString::to_string);
            let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
            Failure::new(BARCHAN_E_PANIC, text.unwrap_or_else(|| "panic without a message".into()))
        }
    };
    // SAFETY: the caller vouches for `error`.
    unsafe { report(error, &failure) };
    failure.status
}

/// Writes a failure to the caller's struct, the message cut at a character boundary.
///
/// # Safety
/// As for [`guard`].
#[cold]
unsafe fn report(error: *mut BarchanError, failure: &Failure) {
    // SAFETY: the caller vouches that a struct of the size it declares lies behind a pointer that is not NULL.
    let Some(error) = (unsafe { error.as_mut() }).filter(|e| e.struct_size >= size_of::<BarchanError>()) else {
        return;
    };
    error.particle = failure.particle;
    error.len = 0;
    if !error.message.is_null() {
        error.len = failure.message.floor_char_boundary(error.capacity);
        // SAFETY: the buffer holds `capacity` bytes, and `len` is at most that and at most the message's length.
        unsafe { core::ptr::copy_nonoverlapping(failure.message.as_ptr(), error.message, error.len) };
    }
}

/// The two structs of the ABI that describe a batch.
pub(crate) trait AbiBatch {
    type Scalar: Float;
    const SIZE: usize;
    /// The fields, in the precision-free form that the walk over the batch takes.
    fn fields(&self) -> Batch<Self::Scalar>;
}

macro_rules! abi_batch {
    ($batch:ident, $scalar:ident) => {
        impl AbiBatch for $batch {
            type Scalar = $scalar;
            const SIZE: usize = size_of::<Self>();
            #[inline(always)]
            fn fields(&self) -> Batch<$scalar> {
                Batch {
                    n: self.n,
                    dt: self.dt,
                    params: self.params,
                    inputs: Planes {
                        strain: self.strain_trial,
                        vel_grad: self.vel_grad,
                        state: self.state_in,
                        stride: self.stride,
                    },
                    strain: self.strain,
                    kirchhoff: self.kirchhoff,
                    state_out: self.state_out,
                }
            }
        }
    };
}
abi_batch!(BarchanBatchF32, f32);
abi_batch!(BarchanBatchF64, f64);

/// A batch in either precision.
#[derive(Clone, Copy)]
pub(crate) struct Batch<T> {
    pub(crate) n: usize,
    pub(crate) dt: T,
    pub(crate) params: *const T,
    pub(crate) inputs: Planes<T>,
    strain: *mut T,
    kirchhoff: *mut T,
    state_out: *mut T,
}

/// What is read of the particles: component c of particle i is `ptr[c * stride + i]`.
#[derive(Clone, Copy)]
pub(crate) struct Planes<T> {
    pub(crate) strain: *const T,
    pub(crate) vel_grad: *const T,
    pub(crate) state: *const T,
    pub(crate) stride: usize,
}

/// Up to three blocks of planes that a job writes.
type Outputs<T> = [*mut T; 3];

/// Checks what can be checked of a batch's pointers.
///
/// # Safety
/// `batch` must be NULL or point to a struct of the size that it declares.
#[inline(always)]
pub(crate) unsafe fn open<M: Material, B: AbiBatch>(batch: *const B) -> Result<Batch<B::Scalar>, Failure> {
    let bad = |what: String| Failure::new(BARCHAN_E_OTHER, format!("material '{}': {what}", M::NAME));
    if batch.is_null() {
        return Err(bad("the batch is NULL".into()));
    }
    // SAFETY: every version of the struct starts with its size.
    let size = unsafe { batch.cast::<usize>().read() };
    if size < B::SIZE {
        return Err(bad(format!("the batch has {size} bytes, this material reads {}", B::SIZE)));
    }
    // SAFETY: it has the size that we know, or more.
    let batch = unsafe { &*batch };
    let fields = batch.fields();
    let required = [
        ("params", fields.params, M::PARAMS.is_empty()),
        ("strain_trial", fields.inputs.strain, false),
        ("vel_grad", fields.inputs.vel_grad, M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD == 0),
        ("state_in", fields.inputs.state, M::STATES.is_empty()),
    ];
    for (name, pointer, optional) in required {
        if pointer.is_null() && !optional && fields.n > 0 {
            return Err(bad(format!("{name} is NULL")));
        }
    }
    if fields.inputs.stride < fields.n {
        return Err(bad(format!("the stride {} is below the {} particles", fields.inputs.stride, fields.n)));
    }
    Ok(fields)
}

/// What is done with as many particles as lanes hold.
trait Job<M: Material, T: Float> {
    /// Planes in each of the outputs.
    const OUTPUTS: [usize; 3];
    /// Computes them, of which bit i of `valid` says whether particle i exists, and writes their outputs.
    /// True where all that was read and written is finite.
    ///
    /// # Safety
    /// `outputs` must be valid for writing a scalar for each lane in each plane, planes `stride` apart.
    unsafe fn lanes<V: Lanes<Scalar = T>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        state: [V; MAX_STATE],
        valid: u16,
        outputs: Outputs<T>,
        stride: usize,
    ) -> V::Mask;
}

/// Sum of the components: finite only if all of them are. Not one after the other, so that no sum waits for all those before it.
#[inline(always)]
fn sum<V: Real>(first: V, rest: &[V]) -> V {
    let mut sums = [first, V::zero(), V::zero(), V::zero()];
    for (i, &x) in rest.iter().enumerate() {
        sums[i % 4] += x;
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3])
}

struct Update;
impl<M: Material, T: Float> Job<M, T> for Update {
    const OUTPUTS: [usize; 3] = [<M::Strain<f64> as Strain<f64>>::PLANES, 6, M::STATES.len()];
    #[inline(always)]
    unsafe fn lanes<V: Lanes<Scalar = T>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        mut state: [V; MAX_STATE],
        _valid: u16,
        outputs: Outputs<T>,
        stride: usize,
    ) -> V::Mask {
        let read = sum(sum(V::zero(), &x.strain.into_planes()[..M::Strain::<V>::PLANES]), &state[..M::STATES.len()]);
        let out = M::update::<V>(law, x, &mut state[..M::STATES.len()]);
        let kirchhoff = out.kirchhoff.components();
        let strain = out.strain.into_planes();
        let written = sum(sum(V::zero(), &kirchhoff), &state[..M::STATES.len()]);
        let finite = (read + written + sum(V::zero(), &strain[..M::Strain::<V>::PLANES])).is_finite();
        for (to, from) in
            outputs.into_iter().zip([&strain[..M::Strain::<V>::PLANES], &kirchhoff, &state[..M::STATES.len()]])
        {
            for (c, value) in from.iter().enumerate() {
                // SAFETY: the caller vouches for the scalars in each plane.
                unsafe { value.store(to.add(c * stride)) };
            }
        }
        finite
    }
}

struct Moduli;
impl<M: Material> Job<M, f32> for Moduli {
    const OUTPUTS: [usize; 3] = [2, 0, 0];
    #[inline(always)]
    unsafe fn lanes<V: Lanes<Scalar = f32>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        state: [V; MAX_STATE],
        _valid: u16,
        outputs: Outputs<f32>,
        stride: usize,
    ) -> V::Mask {
        let moduli = M::tangent_moduli::<V>(law, x.strain, &state[..M::STATES.len()]);
        // SAFETY: the caller vouches for the scalars in each of the two planes.
        unsafe {
            moduli.p_wave.store(outputs[0]);
            moduli.triple_bulk.store(outputs[0].add(stride));
        }
        (moduli.p_wave + moduli.triple_bulk).is_finite()
    }
}

struct Viscosity;
impl<M: Material> Job<M, f32> for Viscosity {
    const OUTPUTS: [usize; 3] = [1, 0, 0];
    #[inline(always)]
    unsafe fn lanes<V: Lanes<Scalar = f32>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        state: [V; MAX_STATE],
        _valid: u16,
        outputs: Outputs<f32>,
        _stride: usize,
    ) -> V::Mask {
        let viscosity = M::viscosity::<V>(law, x.strain, &state[..M::STATES.len()]);
        // SAFETY: the caller vouches for the scalars in the plane.
        unsafe { viscosity.store(outputs[0]) };
        viscosity.is_finite()
    }
}

struct Energy;
impl<M: Material> Job<M, f64> for Energy {
    const OUTPUTS: [usize; 3] = [1, 0, 0];
    #[inline(always)]
    unsafe fn lanes<V: Lanes<Scalar = f64>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        state: [V; MAX_STATE],
        _valid: u16,
        outputs: Outputs<f64>,
        _stride: usize,
    ) -> V::Mask {
        let energy = M::energy::<V>(law, x.strain, &state[..M::STATES.len()]);
        // SAFETY: the caller vouches for the scalars in the plane.
        unsafe { energy.store(outputs[0]) };
        energy.is_finite()
    }
}

struct Count([u64; BARCHAN_N_COUNTERS]);
impl<M: Material> Job<M, f64> for Count {
    const OUTPUTS: [usize; 3] = [0; 3];
    #[inline(always)]
    unsafe fn lanes<V: Lanes<Scalar = f64>>(
        &mut self,
        law: &M::Law<V>,
        x: MatIn<V, M::Strain<V>>,
        mut state: [V; MAX_STATE],
        valid: u16,
        _outputs: Outputs<f64>,
        _stride: usize,
    ) -> V::Mask {
        let out = M::update::<V>(law, x, &mut state[..M::STATES.len()]);
        let Events { yielding, apex, floored, clamped } = out.events;
        let mut add = |counter: usize, mask: V::Mask| self.0[counter] += u64::from((mask.bits() & valid).count_ones());
        add(BARCHAN_COUNT_YIELDING, yielding);
        add(BARCHAN_COUNT_APEX, apex);
        add(BARCHAN_COUNT_FLOORED, floored);
        add(BARCHAN_COUNT_CLAMPED, clamped);
        sum(V::zero(), &out.kirchhoff.components()).is_finite()
    }
}

/// The walk over a batch, as many particles at a time as lanes hold; returns the first particle with a number that is not finite.
struct Walk<'a, M, T, J> {
    batch: Batch<T>,
    outputs: Outputs<T>,
    job: &'a mut J,
    material: PhantomData<M>,
}

/// Most planes that one particle's inputs or outputs fill.
const MAX_PLANES: usize = 9 + 9 + MAX_STATE;

impl<M: Material, T: Float, J: Job<M, T>> Kernel<T> for Walk<'_, M, T, J> {
    type Output = Option<usize>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> Option<usize> {
        let Batch { n, dt, params, inputs, .. } = self.batch;
        let wants_vel_grad = M::CAPABILITIES & BARCHAN_CAP_VEL_GRAD != 0;
        let strain_planes = M::Strain::<V>::PLANES;
        let mut lanes = [V::zero(); MAX_PARAMS];
        for (i, lane) in lanes[..M::PARAMS.len()].iter_mut().enumerate() {
            // SAFETY: `params` holds as many values as the material declares.
            *lane = V::fill(unsafe { params.add(i).read() });
        }
        let law = M::law::<V>(&lanes[..M::PARAMS.len()]);
        let dt = V::fill(dt);
        let mut scratch = MaybeUninit::<[[T; CHUNK]; 2 * MAX_PLANES]>::uninit();
        let scratch = scratch.as_mut_ptr().cast::<T>();

        for start in (0..n).step_by(V::COUNT) {
            let count = (n - start).min(V::COUNT);
            // The last particles of a batch whose length is no multiple of that are worked on in a padded copy.
            let whole = count == V::COUNT;
            // SAFETY: `open` checked the pointers that the material reads, the caller vouches for n entries a plane; the
            // scratch holds MAX_PLANES planes of inputs, and as many of outputs behind them.
            let (from, to, to_stride) = unsafe {
                if whole {
                    let from = Planes {
                        strain: inputs.strain.add(start),
                        vel_grad: inputs.vel_grad.wrapping_add(start),
                        state: inputs.state.wrapping_add(start),
                        stride: inputs.stride,
                    };
                    (from, self.outputs.map(|p| p.wrapping_add(start)), inputs.stride)
                } else {
                    let (strain, vel_grad, state) = (scratch, scratch.add(9 * CHUNK), scratch.add(18 * CHUNK));
                    pad(inputs.strain, inputs.stride, start, count, strain_planes, strain);
                    if wants_vel_grad {
                        pad(inputs.vel_grad, inputs.stride, start, count, 9, vel_grad);
                    }
                    pad(inputs.state, inputs.stride, start, count, M::STATES.len(), state);
                    let from = Planes { strain, vel_grad, state, stride: CHUNK };
                    let out = scratch.add(MAX_PLANES * CHUNK);
                    let first = out.add(J::OUTPUTS[0] * CHUNK);
                    (from, [out, first, first.add(J::OUTPUTS[1] * CHUNK)], CHUNK)
                }
            };

            let mut strain = [V::zero(); 9];
            let mut vel_grad = [V::zero(); 9];
            let mut state = [V::zero(); MAX_STATE];
            // SAFETY: each plane holds a scalar for each lane from here on.
            unsafe {
                for (c, lane) in strain[..strain_planes].iter_mut().enumerate() {
                    *lane = V::load(from.strain.add(c * from.stride));
                }
                if wants_vel_grad {
                    for (c, lane) in vel_grad.iter_mut().enumerate() {
                        *lane = V::load(from.vel_grad.add(c * from.stride));
                    }
                }
                for (c, lane) in state[..M::STATES.len()].iter_mut().enumerate() {
                    *lane = V::load(from.state.add(c * from.stride));
                }
            }
            let x = MatIn { strain: M::Strain::from_planes(strain), vel_grad: Mat3::from_components(vel_grad), dt };
            let valid = u16::MAX >> (u16::BITS as usize - count);
            // SAFETY: the outputs hold a scalar for each lane a plane from here on.
            let finite = unsafe { self.job.lanes::<V>(&law, x, state, valid, to, to_stride) };

            if !whole {
                for (block, planes) in J::OUTPUTS.into_iter().enumerate() {
                    for c in 0..planes {
                        // SAFETY: both planes hold `count` entries there, and the scratch overlaps nothing.
                        unsafe {
                            let plane = self.outputs[block].add(c * inputs.stride + start);
                            core::ptr::copy_nonoverlapping(to[block].add(c * CHUNK), plane, count);
                        }
                    }
                }
            }
            if !finite.all() {
                let bad = !finite.bits() & valid;
                if bad != 0 {
                    return Some(start + bad.trailing_zeros() as usize);
                }
            }
        }
        None
    }
}

/// Copies `count` particles from `start` on of `planes` planes to planes of 16, and repeats the last of them to the end.
///
/// # Safety
/// `from` must be valid for reading `start + count` entries in each plane, `to` for writing 16, and they must not overlap.
#[inline(always)]
unsafe fn pad<T: Copy>(from: *const T, stride: usize, start: usize, count: usize, planes: usize, to: *mut T) {
    for c in 0..planes {
        for i in 0..CHUNK {
            // SAFETY: the caller vouches for the planes, and i is cut at the last particle.
            unsafe { to.add(c * CHUNK + i).write(from.add(c * stride + start + i.min(count - 1)).read()) };
        }
    }
}

/// Opens a batch and walks over it with a job whose outputs `outputs` picks.
///
/// # Safety
/// `batch` must be NULL or a batch as the ABI describes it; the outputs must be valid for the job's planes.
#[inline(always)]
unsafe fn walk<M: Material, B: AbiBatch, J: Job<M, B::Scalar>>(
    batch: *const B,
    job: &mut J,
    outputs: impl FnOnce(&Batch<B::Scalar>) -> Outputs<B::Scalar>,
) -> Result<(), Failure> {
    // SAFETY: the caller vouches for the batch.
    let batch = unsafe { open::<M, B>(batch)? };
    let outputs = outputs(&batch);
    for (pointer, planes) in outputs.iter().zip(J::OUTPUTS) {
        if pointer.is_null() && planes > 0 && batch.n > 0 {
            let message = format!("material '{}': an output is NULL", M::NAME);
            return Err(Failure::new(BARCHAN_E_OTHER, message));
        }
    }
    let isa = Isa::current().map_err(|e| Failure::new(BARCHAN_E_OTHER, e.to_string()))?;
    match isa.run(Walk { batch, outputs, job, material: PhantomData::<M> }) {
        None => Ok(()),
        Some(particle) => Err(Failure {
            status: BARCHAN_E_NON_FINITE,
            message: format!("material '{}': strain, state or stress is not finite", M::NAME),
            particle: particle as u64,
        }),
    }
}

// SAFETY of the callbacks: the ABI obliges the host to pass batches, outputs and error structs as `barchan_abi` describes
// them; `guard` lets no panic through.

unsafe extern "C" fn update<M: Material, B: AbiBatch>(batch: *const B, error: *mut BarchanError) -> BarchanStatus {
    // SAFETY: see above.
    unsafe { guard(error, || walk::<M, B, _>(batch, &mut Update, |b| [b.strain, b.kirchhoff, b.state_out])) }
}

unsafe extern "C" fn tangent_moduli<M: Material>(
    batch: *const BarchanBatchF32,
    moduli: *mut f32,
    error: *mut BarchanError,
) -> BarchanStatus {
    // SAFETY: see above.
    unsafe { guard(error, || walk::<M, _, _>(batch, &mut Moduli, |_| [moduli, null_mut(), null_mut()])) }
}

unsafe extern "C" fn viscosity<M: Material>(
    batch: *const BarchanBatchF32,
    viscosity: *mut f32,
    error: *mut BarchanError,
) -> BarchanStatus {
    // SAFETY: see above.
    unsafe { guard(error, || walk::<M, _, _>(batch, &mut Viscosity, |_| [viscosity, null_mut(), null_mut()])) }
}

unsafe extern "C" fn energy<M: Material>(
    batch: *const BarchanBatchF64,
    energy: *mut f64,
    error: *mut BarchanError,
) -> BarchanStatus {
    // SAFETY: see above.
    unsafe { guard(error, || walk::<M, _, _>(batch, &mut Energy, |_| [energy, null_mut(), null_mut()])) }
}

unsafe extern "C" fn count<M: Material>(
    batch: *const BarchanBatchF64,
    counts: *mut u64,
    error: *mut BarchanError,
) -> BarchanStatus {
    let callback = || {
        if counts.is_null() {
            return Err(Failure::new(BARCHAN_E_OTHER, format!("material '{}': counts is NULL", M::NAME)));
        }
        let mut job = Count([0; BARCHAN_N_COUNTERS]);
        // SAFETY: see above.
        unsafe {
            walk::<M, _, _>(batch, &mut job, |_| [null_mut(); 3])?;
            counts.cast::<[u64; BARCHAN_N_COUNTERS]>().write_unaligned(job.0);
        }
        Ok(())
    };
    // SAFETY: see above.
    unsafe { guard(error, callback) }
}

unsafe extern "C" fn check_params<M: Material>(params: *const f64, error: *mut BarchanError) -> BarchanStatus {
    let callback = || {
        if params.is_null() && !M::PARAMS.is_empty() {
            return Err(Failure::new(BARCHAN_E_OTHER, format!("material '{}': params is NULL", M::NAME)));
        }
        let params = if M::PARAMS.is_empty() {
            &[]
        } else {
            // SAFETY: see above.
            unsafe { core::slice::from_raw_parts(params, M::PARAMS.len()) }
        };
        M::check(params)
            .map_err(|message| Failure::new(BARCHAN_E_INVALID_PARAM, format!("material '{}': {message}", M::NAME)))
    };
    // SAFETY: see above.
    unsafe { guard(error, callback) }
}
