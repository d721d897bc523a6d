//! What Rust and WGSL both say, so that a test can hold one to the other: numbers of words, reasons to halt, and layouts of uniforms.

use crate::device::layout::ENTRY;
use crate::device::memory::{
    BODY, BODY_HEAD, BODY_STATE, GROUP_HEAD, OF_LAYERS, PER_LAYER, PER_STEP, PER_SUM, SOFT_WORDS, TOUCH, WATCHED,
};
use crate::device::status::{self, Halt};
use crate::device::uniforms::{Extent, Layer, StepConstants, WorldCells};
use crate::worlds::{sleep, soft};
use std::mem::offset_of;

/// A constant by its name in WGSL, and what Rust takes it for.
pub type Shared = (&'static str, i64);

/// A structure of WGSL, and where Rust writes its members [bytes].
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Its name in WGSL.
    pub name: &'static str,
    /// What Rust writes of it.
    pub size: usize,
    /// Names and offsets.
    pub members: &'static [(&'static str, usize)],
}

macro_rules! layout {
    ($name:literal, $ty:ty, [$($member:ident),*]) => {
        Layout { name: $name, size: size_of::<$ty>(), members: &[$((stringify!($member), offset_of!($ty, $member))),*] }
    };
}

/// The uniforms that all passes read.
pub const LAYOUTS: [Layout; 4] = [
    layout!("Extent", Extent, [slots, particles, block_room, node_room, row, places, giver_room, rooms, world]),
    layout!(
        "World",
        WorldCells,
        [min, cell, max, per_cell, side_low, side_high, side_low_part, side_high_part, period_min, period]
    ),
    layout!(
        "Layer",
        Layer,
        [box_min, first_place, box_size, places, on, age, drift, least, felt, first_particle, level, shrink]
    ),
    layout!(
        "Step",
        StepConstants,
        [
            dt,
            dt_per_h,
            stress,
            number,
            gravity,
            slot,
            first_level,
            first,
            count,
            end_level,
            mirrors,
            most_need,
            submission
        ]
    ),
];

/// Constants that stand in a text of WGSL and in Rust. Where a pass has one of these names, it has this value.
pub const CONSTANTS: &[Shared] = &[
    ("ENTRY", ENTRY as i64),
    ("BODY", BODY as i64),
    ("GROUP_HEAD", GROUP_HEAD as i64),
    ("BODY_HEAD", BODY_HEAD as i64),
    ("BODY_STATE", BODY_STATE as i64),
    ("TOUCH", TOUCH as i64),
    ("OF_LAYERS", OF_LAYERS as i64),
    ("PER_LAYER", PER_LAYER as i64),
    ("PER_SUM", PER_SUM as i64),
    ("PER_STEP", PER_STEP as i64),
    ("BLOCKS", status::BLOCKS as i64),
    ("NODE_BLOCKS", status::NODE_BLOCKS as i64),
    ("HALTED", status::HALTED as i64),
    ("HALT_STEP", status::HALT_STEP as i64),
    ("WHO", status::WHO as i64),
    ("NEW_BLOCKS", status::NEW_BLOCKS as i64),
    ("NEW_NODE_BLOCKS", status::NEW_NODE_BLOCKS as i64),
    ("SORTS", status::SORTS as i64),
    ("COUNTED", status::COUNTED as i64),
    ("NEAR", status::NEAR as i64),
    ("GIVERS", status::GIVERS as i64),
    ("FIRST_BLOCK", status::FIRST_BLOCK as i64),
    ("FIRST_NODE_BLOCK", status::FIRST_NODE_BLOCK as i64),
    ("LEAST_BLOCK", status::LEAST_BLOCK as i64),
    ("GREATEST_BLOCK", status::GREATEST_BLOCK as i64),
    ("SORTED", status::SORTED as i64),
    ("PARTED", status::PARTED as i64),
    ("WALL_IMPULSE", status::WALL_IMPULSE as i64),
    ("ASTRAY", status::ASTRAY as i64),
    ("LEFT", status::LEFT as i64),
    ("LEFT_IMPULSE", status::LEFT_IMPULSE as i64),
    ("SUM_SLEPT", status::SLEPT as i64),
    ("SPEED", status::SPEED as i64),
    ("MOVE", status::MOVE as i64),
    ("GROWN", status::GROWN as i64),
    ("NEED", status::NEED as i64),
    ("DAMPED", status::DAMPED as i64),
    ("BIAS", status::BIAS as i64),
    ("TOO_FAST", Halt::TooFast as i64),
    ("DRIFTED", Halt::Drifted as i64),
    ("ROOM", Halt::Room as i64),
    ("MISPLACED", Halt::Misplaced as i64),
    ("LEFT_WORLD", Halt::LeftWorld as i64),
    ("STRAYED", Halt::Strayed as i64),
    ("FEWER", Halt::Fewer as i64),
    ("FOLLOW", Halt::Follow as i64),
    ("TOO_STIFF", Halt::TooStiff as i64),
    ("WATCHED", WATCHED as i64),
    ("RESTS", sleep::RESTS as i64),
    ("DECIDED", sleep::DECIDED as i64),
    ("HAPPENED", sleep::HAPPENED as i64),
    ("STEPPED", sleep::STEPPED as i64),
    ("FAST", sleep::FAST as i64),
    ("STIRRED", sleep::STIRRED as i64),
    ("WORDS", SOFT_WORDS as i64),
    ("LEEWAY", soft::LEEWAY as i64),
];
