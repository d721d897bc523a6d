//! The stable C interface between Barchan and its material plugins.
//!
//! Everything a plugin sees is `#[repr(C)]`, made of fixed-width integers, floats, raw pointers and nullable function
//! pointers, and lives in [`raw`]. `include/barchan_abi.h` is generated from that file by cbindgen and checked in CI. [`batch`] makes what
//! hosts hand to callbacks.
//!
//! Rules that the types cannot express:
//! - Every struct starts with `struct_size`; fields are only appended. The host copies `min(struct_size, sizeof)` bytes
//!   into a zeroed copy, so a slot an old plugin does not know reads as NULL.
//! - Nobody frees the other side's memory: strings are static in the library, buffers belong to the caller.
//! - Callbacks are stateless and re-entrant, and particle `i`'s result depends on particle `i` only.
//! - No panic and no exception crosses; failure is a status, a message and a particle index.
#![no_std]
#![expect(unsafe_code, reason = "an ABI crate declares unsafe function pointers and Sync for static tables")]

pub mod batch;
pub mod raw;
pub use raw::*;

/// The layout that old plugins rely on: fields may be appended, never moved. The material's table of version 1.0 ends before `viscosity_f32`.
#[cfg(target_pointer_width = "64")]
const _: () = {
    use core::mem::{offset_of, size_of};
    assert!(size_of::<BarchanStr>() == 16);
    assert!(size_of::<BarchanError>() == 40 && offset_of!(BarchanError, particle) == 32);
    assert!(size_of::<BarchanParam>() == 80 && offset_of!(BarchanParam, default_value) == 48);
    assert!(size_of::<BarchanStateVar>() == 64 && offset_of!(BarchanStateVar, merge) == 56);
    assert!(size_of::<BarchanBatchF32>() == 88 && offset_of!(BarchanBatchF32, params) == 32);
    assert!(size_of::<BarchanBatchF64>() == 88 && offset_of!(BarchanBatchF64, params) == 32);
    assert!(offset_of!(BarchanBatchF32, strain) == 64 && offset_of!(BarchanBatchF64, strain) == 64);
    assert!(size_of::<BarchanAdjointF32>() == 64 && size_of::<BarchanAdjointF64>() == 64);
    assert!(size_of::<BarchanMaterial>() == 264 && offset_of!(BarchanMaterial, viscosity_f32) == 240);
    assert!(offset_of!(BarchanMaterial, name) == 32 && offset_of!(BarchanMaterial, params) == 96);
    assert!(offset_of!(BarchanMaterial, update_f32) == 144 && offset_of!(BarchanMaterial, wgsl) == 208);
    assert!(size_of::<BarchanPlugin>() == 40 && offset_of!(BarchanPlugin, materials) == 24);
};
