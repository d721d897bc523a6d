//! The GPU backend: every pass in WGSL, in f32, on any adapter that Vulkan, Metal or Direct3D 12 offers, software ones
//! included.

pub mod device;
pub mod material;
