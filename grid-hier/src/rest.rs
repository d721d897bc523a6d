//! When ground at rest sleeps: the constants of the rule, for every backend.

use crate::block::SIDE;
use barchan_core::Aabb;

/// Steps of a level for which ground must have been slow before it sleeps.
pub const RESTED: u16 = 50;
/// Value of that count for a block that sleeps. 0 means that something in it moves, or did in the last step.
pub const ASLEEP: u16 = u16::MAX;
/// Cells around a tool that stay awake.
pub const NEAR_TOOL: f64 = 4.0;

/// First and last of the blocks that stay awake for a tool, on a level with cells of width `h` [m].
pub fn near_tool(tool: &Aabb, h: f64) -> [[i32; 3]; 2] {
    let near = tool.grown(NEAR_TOOL * h);
    [near.min, near.max].map(|x| x.map(|x| (x / (h * f64::from(SIDE))).floor() as i32))
}
