//! Materials asked about some particles at once: planes aligned as the ABI promises, and its callbacks wrapped.

use crate::Material;
use crate::material::ErrorBuffer;
use barchan_abi::batch::{Adjoint, Batch, Cotangents, Inputs, Number, Outputs};
use barchan_abi::{BARCHAN_N_COUNTERS, BarchanStatus};

/// One component of `N` particles, aligned as the ABI promises.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Plane<T, const N: usize>(pub [T; N]);

impl<T: Number + Default, const N: usize> Default for Plane<T, N> {
    fn default() -> Self {
        Self([T::default(); N])
    }
}

impl<T: Number, const N: usize> Plane<T, N> {
    const IS_WHOLE: () =
        assert!(N.is_multiple_of(16) && size_of::<Self>() == N * size_of::<T>(), "planes follow each other closely");

    /// The values of some planes, one after the other.
    fn flat(planes: &[Self]) -> &[T] {
        let () = Self::IS_WHOLE;
        // SAFETY: a plane is its values and nothing else.
        unsafe { std::slice::from_raw_parts(planes.as_ptr().cast(), planes.len() * N) }
    }

    /// The same to be written.
    fn flat_mut(planes: &mut [Self]) -> &mut [T] {
        let () = Self::IS_WHOLE;
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts_mut(planes.as_mut_ptr().cast(), planes.len() * N) }
    }
}

/// Particles that a material is asked about.
#[derive(Clone, Copy, Debug)]
pub struct Matter<'a, T, const N: usize> {
    /// How many of the `N` there are.
    pub count: usize,
    /// Parameters in the material's order, SI.
    pub parameters: &'a [T],
    /// Strain, plane by plane [1].
    pub strain: &'a [Plane<T, N>],
    /// History, plane by plane.
    pub state: &'a [Plane<T, N>],
}

/// What has deformed them.
#[derive(Clone, Copy, Debug)]
pub struct Motion<'a, T, const N: usize> {
    /// For how long [s].
    pub dt: T,
    /// The velocity gradient, row by row [1/s].
    pub vel_grad: &'a [Plane<T, N>; 9],
}

/// What a material makes of them.
#[derive(Debug)]
pub struct Answer<'a, T, const N: usize> {
    /// Strain, plane by plane [1].
    pub strain: &'a mut [Plane<T, N>],
    /// Kirchhoff stress xx yy zz xy xz yz [Pa].
    pub kirchhoff: &'a mut [Plane<T, N>; 6],
    /// History, plane by plane.
    pub state: &'a mut [Plane<T, N>],
}

/// What a loss owes to what a material makes of particles, and what it owes to what the material is given, which is added to: each by the particle's own values.
#[derive(Debug)]
pub struct Owed<'a, const N: usize> {
    /// To the strain, plane by plane.
    pub strain: &'a [Plane<f64, N>],
    /// To the Kirchhoff stress [1/Pa].
    pub kirchhoff: &'a [Plane<f64, N>; 6],
    /// To the history after.
    pub state: &'a [Plane<f64, N>],
    /// To the trial strain.
    pub trial: &'a mut [Plane<f64, N>],
    /// To the velocity gradient [s], if the material asks for it.
    pub vel_grad: &'a mut [Plane<f64, N>; 9],
    /// To the history before.
    pub state_before: &'a mut [Plane<f64, N>],
    /// To the parameters, summed over the particles.
    pub parameters: &'a mut [f64],
}

impl<'a, T: Number + Default, const N: usize> Matter<'a, T, N> {
    /// Does something with the batch, at rest unless there is a motion.
    fn with<R>(
        &self,
        material: &Material,
        motion: Option<Motion<'_, T, N>>,
        answer: Option<Answer<'_, T, N>>,
        ask: impl FnOnce(&Batch<'_, T>) -> R,
    ) -> R {
        let at_rest = [Plane::<T, N>::default(); 9];
        let Motion { dt, vel_grad } = motion.unwrap_or(Motion { dt: T::default(), vel_grad: &at_rest });
        let Self { count, parameters, strain, state } = *self;
        let (strain, vel_grad, state) = (Plane::flat(strain), Plane::flat(vel_grad), Plane::flat(state));
        let inputs = Inputs { n: count, stride: N, dt, params: parameters, strain, vel_grad, state };
        let outputs = answer.map(|Answer { strain, kirchhoff, state }| Outputs {
            strain: Plane::flat_mut(strain),
            kirchhoff: Plane::flat_mut(kirchhoff),
            state: Plane::flat_mut(state),
        });
        ask(&Batch::new(&material.table, inputs, outputs))
    }
}

/// The callbacks. Each gives the callback's status, or `None` if the material has none; what went wrong is in `error`.
///
/// # Panics
/// If the planes are not those that the material declares.
impl Material {
    /// Strain after the return map, stress and history, given the trial strain that a motion has led to; without a motion the stress of the
    /// strain as it is.
    pub fn update<T: Number + Default, const N: usize>(
        &self,
        trial: &Matter<'_, T, N>,
        motion: Option<Motion<'_, T, N>>,
        answer: Answer<'_, T, N>,
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let update = T::update_of(&self.table)?;
        // SAFETY: the batch has the planes that this material declares; whoever registered its table vouched for the callback.
        Some(trial.with(self, motion, Some(answer), |batch| unsafe { update(batch.as_raw(), error.as_raw()) }))
    }

    /// The adjoint of [`update`](Self::update) in f64.
    pub fn pull_back<const N: usize>(
        &self,
        trial: &Matter<'_, f64, N>,
        motion: Motion<'_, f64, N>,
        owed: Owed<'_, N>,
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let callback = self.table.update_adj_f64?;
        let adjoint = Adjoint::new(
            &self.table,
            N,
            Cotangents {
                strain: Plane::flat(owed.strain),
                kirchhoff: Plane::flat(owed.kirchhoff),
                state: Plane::flat(owed.state),
                strain_trial: Plane::flat_mut(owed.trial),
                vel_grad: Plane::flat_mut(owed.vel_grad),
                state_in: Plane::flat_mut(owed.state_before),
                params: owed.parameters,
            },
        );
        // SAFETY: as for the update; the cotangents have the planes of the batch.
        Some(trial.with(self, Some(motion), None, |batch| unsafe {
            callback(batch.as_raw(), adjoint.as_raw(), error.as_raw())
        }))
    }

    /// Elastic energy per rest volume [J/m³].
    pub fn energy<const N: usize>(
        &self,
        matter: &Matter<'_, f64, N>,
        energy: &mut Plane<f64, N>,
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let callback = self.table.energy_f64?;
        let out = energy.0.as_mut_ptr();
        // SAFETY: as for the update; `energy` is a plane of the batch's stride.
        Some(matter.with(self, None, None, |batch| unsafe { callback(batch.as_raw(), out, error.as_raw()) }))
    }

    /// How many particles yield, are at the apex, and so on.
    pub fn counts<const N: usize>(
        &self,
        matter: &Matter<'_, f64, N>,
        counts: &mut [u64; BARCHAN_N_COUNTERS],
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let callback = self.table.count_f64?;
        let out = counts.as_mut_ptr();
        // SAFETY: as for the update; there are as many counts as the ABI has.
        Some(matter.with(self, None, None, |batch| unsafe { callback(batch.as_raw(), out, error.as_raw()) }))
    }

    /// λ + 2μ and 3λ + 2μ of the present tangent [Pa].
    pub fn tangent_moduli<const N: usize>(
        &self,
        matter: &Matter<'_, f32, N>,
        moduli: &mut [Plane<f32, N>; 2],
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let callback = self.table.tangent_moduli_f32?;
        let out = Plane::flat_mut(moduli).as_mut_ptr();
        // SAFETY: as for the update; there are two planes of the batch's stride.
        Some(matter.with(self, None, None, |batch| unsafe { callback(batch.as_raw(), out, error.as_raw()) }))
    }

    /// Viscosity [Pa s].
    pub fn viscosity<const N: usize>(
        &self,
        matter: &Matter<'_, f32, N>,
        viscosity: &mut Plane<f32, N>,
        error: &mut ErrorBuffer,
    ) -> Option<BarchanStatus> {
        let callback = self.table.viscosity_f32?;
        let out = viscosity.0.as_mut_ptr();
        // SAFETY: as for the update; it is a plane of the batch's stride.
        Some(matter.with(self, None, None, |batch| unsafe { callback(batch.as_raw(), out, error.as_raw()) }))
    }
}
