//! Uniforms that all passes read, as `common.wgsl` has them; `shared.rs` lets a test hold one to the other.

use bytemuck::{Pod, Zeroable};

/// `World` of `common.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct WorldCells {
    pub(crate) min: [i32; 3],
    pub(crate) cell: f32,
    pub(crate) max: [i32; 3],
    pub(crate) per_cell: f32,
    pub(crate) side_low: [i32; 4],
    pub(crate) side_high: [i32; 4],
    pub(crate) side_low_part: [u32; 4],
    pub(crate) side_high_part: [u32; 4],
    pub(crate) period_min: [i32; 4],
    pub(crate) period: [i32; 4],
}

/// `Extent` of `common.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Extent {
    pub(crate) slots: u32,
    pub(crate) particles: u32,
    pub(crate) block_room: u32,
    pub(crate) node_room: u32,
    pub(crate) row: u32,
    pub(crate) places: u32,
    pub(crate) giver_room: u32,
    pub(crate) rooms: u32,
    pub(crate) world: WorldCells,
}

/// `Layer` of `common.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Layer {
    pub(crate) box_min: [i32; 3],
    pub(crate) first_place: u32,
    pub(crate) box_size: [i32; 3],
    pub(crate) places: u32,
    pub(crate) on: u32,
    pub(crate) age: u32,
    pub(crate) drift: f32,
    pub(crate) least: f32,
    pub(crate) felt: f32,
    pub(crate) first_particle: u32,
    pub(crate) level: u32,
    pub(crate) shrink: f32,
}

/// `Step` of `common.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct StepConstants {
    pub(crate) dt: f32,
    pub(crate) dt_per_h: f32,
    pub(crate) stress: f32,
    pub(crate) number: u32,
    pub(crate) gravity: [f32; 3],
    pub(crate) slot: u32,
    pub(crate) first_level: u32,
    pub(crate) first: u32,
    pub(crate) count: u32,
    pub(crate) end_level: u32,
    pub(crate) mirrors: u32,
    pub(crate) most_need: f32,
    pub(crate) submission: u32,
    /// WGSL rounds a uniform's size up.
    pub(crate) padding: u32,
}
