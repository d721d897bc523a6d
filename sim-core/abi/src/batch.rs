//! The ABI's batches, made from slices: the one place where a host turns memory into the pointers that callbacks follow.

use crate::raw::*;
use core::marker::PhantomData;
use core::ptr::{null, null_mut};

/// `f32` or `f64`, with the struct and the update that the ABI has for it.
pub trait Number: Copy + private::Sealed {
    /// The struct that describes a batch.
    type Batch: Copy;
    /// The material's update, if it has one.
    fn update_of(table: &BarchanMaterial) -> Option<Update<Self>>;
    #[doc(hidden)]
    fn raw(pointers: Pointers<Self>) -> Self::Batch;
}

/// An update in either precision.
pub type Update<T> = unsafe extern "C" fn(*const <T as Number>::Batch, *mut BarchanError) -> BarchanStatus;

mod private {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// What a batch reads: components of particle i at `plane * stride + i`.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a, T> {
    /// Particles.
    pub n: usize,
    /// Distance between planes.
    pub stride: usize,
    /// Step over which the velocity gradient acted [s].
    pub dt: T,
    /// Parameters, SI.
    pub params: &'a [T],
    /// Trial strain, 9 or 6 planes [1].
    pub strain: &'a [T],
    /// Velocity gradient, 9 planes [1/s]; left alone if the material does not ask for it.
    pub vel_grad: &'a [T],
    /// History.
    pub state: &'a [T],
}

/// What an update writes.
#[derive(Debug)]
pub struct Outputs<'a, T> {
    /// Strain, as many planes as go in [1].
    pub strain: &'a mut [T],
    /// Kirchhoff stress, 6 planes [Pa].
    pub kirchhoff: &'a mut [T],
    /// History.
    pub state: &'a mut [T],
}

/// The same as pointers, for memory of which parts have not been written yet. As in the ABI, those to nothing are NULL.
#[derive(Clone, Copy, Debug)]
pub struct Pointers<T> {
    /// Particles.
    pub n: usize,
    /// Distance between planes.
    pub stride: usize,
    /// Step over which the velocity gradient acted [s].
    pub dt: T,
    /// Parameters.
    pub params: *const T,
    /// Trial strain.
    pub strain_trial: *const T,
    /// Velocity gradient, or NULL.
    pub vel_grad: *const T,
    /// History before, or NULL.
    pub state_in: *const T,
    /// Strain after.
    pub strain: *mut T,
    /// Kirchhoff stress [Pa].
    pub kirchhoff: *mut T,
    /// History after, or NULL.
    pub state_out: *mut T,
}

macro_rules! number {
    ($t:ident, $batch:ident, $update:ident $(, $reserved:ident)?) => {
        impl Number for $t {
            type Batch = $batch;
            #[inline]
            fn update_of(table: &BarchanMaterial) -> Option<Update<Self>> {
                table.$update
            }
            #[inline]
            fn raw(pointers: Pointers<Self>) -> $batch {
                let Pointers { n, stride, dt, params, strain_trial, vel_grad, state_in, .. } = pointers;
                let Pointers { strain, kirchhoff, state_out, .. } = pointers;
                $batch {
                    struct_size: size_of::<$batch>(),
                    n,
                    stride,
                    dt,
                    $($reserved: 0,)?
                    params,
                    strain_trial,
                    vel_grad,
                    state_in,
                    strain,
                    kirchhoff,
                    state_out,
                }
            }
        }
    };
}
number!(f32, BarchanBatchF32, update_f32, reserved);
number!(f64, BarchanBatchF64, update_f64);

/// A batch that callbacks of a material can be handed.
#[derive(Debug)]
pub struct Batch<'a, T: Number> {
    raw: T::Batch,
    memory: PhantomData<&'a mut [T]>,
}

impl<'a, T: Number> Batch<'a, T> {
    /// A batch as a material's callbacks take it; without outputs, for those that write elsewhere.
    ///
    /// # Panics
    /// If a slice is shorter than the planes that the material declares: the host has made it, nothing that a user says.
    pub fn new(table: &BarchanMaterial, inputs: Inputs<'a, T>, outputs: Option<Outputs<'a, T>>) -> Self {
        let Inputs { n, stride, dt, params, strain, vel_grad, state } = inputs;
        let planes = if table.strain_kind == BARCHAN_STRAIN_DEF_GRAD { 9 } else { 6 };
        let wants_vel_grad = table.capabilities & BARCHAN_CAP_VEL_GRAD != 0;
        assert!(
            n <= stride
                && params.len() == table.n_params
                && strain.len() >= planes * stride
                && (!wants_vel_grad || vel_grad.len() >= 9 * stride)
                && state.len() >= table.n_state * stride,
            "a batch has the planes that its material reads"
        );
        let (mut written, mut stress, mut state_out) = (null_mut(), null_mut(), null_mut());
        if let Some(Outputs { strain, kirchhoff, state }) = outputs {
            assert!(
                strain.len() >= planes * stride
                    && kirchhoff.len() >= 6 * stride
                    && state.len() >= table.n_state * stride,
                "a batch has the planes that its material writes"
            );
            (written, stress) = (strain.as_mut_ptr(), kirchhoff.as_mut_ptr());
            state_out = if table.n_state > 0 { state.as_mut_ptr() } else { null_mut() };
        }
        let raw = T::raw(Pointers {
            n,
            stride,
            dt,
            params: params.as_ptr(),
            strain_trial: strain.as_ptr(),
            vel_grad: if wants_vel_grad { vel_grad.as_ptr() } else { null() },
            state_in: if table.n_state > 0 { state.as_ptr() } else { null() },
            strain: written,
            kirchhoff: stress,
            state_out,
        });
        Self { raw, memory: PhantomData }
    }

    /// A batch from pointers.
    ///
    /// # Safety
    /// For as long as the batch lives they must be what the ABI says of a batch of the material whose callbacks get it.
    #[inline]
    pub unsafe fn from_pointers(pointers: Pointers<T>) -> Self {
        Self { raw: T::raw(pointers), memory: PhantomData }
    }

    /// The struct, for a callback.
    #[inline]
    pub fn as_raw(&self) -> *const T::Batch {
        &raw const self.raw
    }
}

/// Cotangents of a batch: those of what an update writes, which are read, and those of what it reads, which are added to. Planes are as far apart as the
/// batch's.
#[derive(Debug)]
pub struct Cotangents<'a> {
    /// Of the strain.
    pub strain: &'a [f64],
    /// Of the Kirchhoff stress, 6 planes.
    pub kirchhoff: &'a [f64],
    /// Of the history after.
    pub state: &'a [f64],
    /// Of the trial strain.
    pub strain_trial: &'a mut [f64],
    /// Of the velocity gradient, 9 planes; left alone if the material does not ask for it.
    pub vel_grad: &'a mut [f64],
    /// Of the history before.
    pub state_in: &'a mut [f64],
    /// Of the parameters.
    pub params: &'a mut [f64],
}

/// Cotangents that the adjoint of a material's update can be handed.
#[derive(Debug)]
pub struct Adjoint<'a> {
    raw: BarchanAdjointF64,
    memory: PhantomData<&'a mut [f64]>,
}

impl<'a> Adjoint<'a> {
    /// Cotangents of a batch with planes `stride` apart.
    ///
    /// # Panics
    /// If a slice is shorter than the planes that the material declares: the host has made it, nothing that a user says.
    pub fn new(table: &BarchanMaterial, stride: usize, cotangents: Cotangents<'a>) -> Self {
        let Cotangents { strain, kirchhoff, state, strain_trial, vel_grad, state_in, params } = cotangents;
        let planes = if table.strain_kind == BARCHAN_STRAIN_DEF_GRAD { 9 } else { 6 };
        let wants_vel_grad = table.capabilities & BARCHAN_CAP_VEL_GRAD != 0;
        assert!(
            strain.len() >= planes * stride
                && strain_trial.len() >= planes * stride
                && kirchhoff.len() >= 6 * stride
                && (!wants_vel_grad || vel_grad.len() >= 9 * stride)
                && state.len() >= table.n_state * stride
                && state_in.len() >= table.n_state * stride
                && params.len() == table.n_params,
            "cotangents have the planes of their batch"
        );
        let has_state = table.n_state > 0;
        let raw = BarchanAdjointF64 {
            struct_size: size_of::<BarchanAdjointF64>(),
            adj_strain: strain.as_ptr(),
            adj_kirchhoff: kirchhoff.as_ptr(),
            adj_state_out: if has_state { state.as_ptr() } else { null() },
            adj_strain_trial: strain_trial.as_mut_ptr(),
            adj_vel_grad: if wants_vel_grad { vel_grad.as_mut_ptr() } else { null_mut() },
            adj_state_in: if has_state { state_in.as_mut_ptr() } else { null_mut() },
            adj_params: params.as_mut_ptr(),
        };
        Self { raw, memory: PhantomData }
    }

    /// The struct, for the callback.
    #[inline]
    pub fn as_raw(&self) -> *const BarchanAdjointF64 {
        &raw const self.raw
    }
}
