//! Run-time choice of the instruction set.

use crate::{Float, Lanes};
use std::sync::OnceLock;

/// An instruction set that the kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Isa {
    /// Whatever the target guarantees (SSE2 on x86-64, NEON on aarch64).
    Baseline,
    /// AVX2 and FMA.
    Avx2,
    /// AVX-512 F, DQ and VL.
    Avx512,
}

/// `BARCHAN_ISA` names no instruction set, or one that this machine lacks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownIsa(pub String);

impl std::fmt::Display for UnknownIsa {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let known: Vec<&str> = Isa::available().map(Isa::name).collect();
        write!(
            f,
            "BARCHAN_ISA: instruction set '{}' is not available here; known are: {}, or leave it unset for the last of them",
            self.0,
            known.join(", ")
        )
    }
}
impl std::error::Error for UnknownIsa {}

/// Work that is generic over the lane type. Mark `run` `#[inline(always)]`, or it is compiled without the instruction set.
pub trait Kernel<T: Float> {
    /// What the work returns.
    type Output;
    /// Does the work with lanes `V`.
    fn run<V: Lanes<Scalar = T>>(self) -> Self::Output;
}

impl Isa {
    /// The name that `BARCHAN_ISA` takes.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Baseline => "baseline",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Does this machine have it?
    pub fn is_available(self) -> bool {
        match self {
            Self::Baseline => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                Self::Avx2.is_available()
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// Those that this machine has, plainest first.
    pub fn available() -> impl Iterator<Item = Self> {
        [Self::Baseline, Self::Avx2, Self::Avx512].into_iter().filter(|isa| isa.is_available())
    }

    /// The instruction set in use: the one that `BARCHAN_ISA` names, or else the best one here. As it is at the first call.
    ///
    /// # Errors
    /// [`UnknownIsa`] if the variable names none that this machine has.
    #[inline]
    pub fn current() -> Result<Self, UnknownIsa> {
        static CURRENT: OnceLock<Result<Isa, UnknownIsa>> = OnceLock::new();
        let find = || match std::env::var_os("BARCHAN_ISA") {
            Some(name) => Self::available()
                .find(|isa| name == isa.name())
                .ok_or_else(|| UnknownIsa(name.to_string_lossy().into())),
            None => Ok(Self::available().last().unwrap_or(Self::Baseline)),
        };
        CURRENT.get_or_init(find).clone()
    }

    /// Runs `kernel` compiled for this instruction set.
    ///
    /// # Panics
    /// If the machine lacks it.
    #[inline]
    pub fn run<T: Float, K: Kernel<T>>(self, kernel: K) -> K::Output {
        match self {
            Self::Baseline => kernel.run::<T::Base>(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                debug_assert!(self.is_available());
                // SAFETY: `Isa` values other than Baseline come from `available`, which asked the machine.
                unsafe { run_avx2(kernel) }
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                debug_assert!(self.is_available());
                // SAFETY: as above.
                unsafe { run_avx512(kernel) }
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => unreachable!("instruction set of another architecture"),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<T: Float, K: Kernel<T>>(kernel: K) -> K::Output {
    kernel.run::<T::Avx2>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn run_avx512<T: Float, K: Kernel<T>>(kernel: K) -> K::Output {
    kernel.run::<T::Avx512>()
}
