//! When ground at rest sleeps, for every backend: constants of the rule, and how steps at rest are counted. In WGSL: `rest/watch.wgsl` and those beside it.

use crate::block::SIDE;
use barchan_core::{Aabb, Scene};

/// Steps of a level for which ground must have been slow before it sleeps.
pub const RESTED: u16 = 50;
/// Value of that count for a block that sleeps. 0 means that something in it moves, or did in the last step.
pub const ASLEEP: u16 = u16::MAX;
/// Cells around a tool that stay awake.
pub const NEAR_TOOL: f64 = 4.0;

/// Steps in which gravity makes of what is at rest what is not, however short they are, unless the scene says itself what is slow: what falls, and what turns round at the
/// top of its flight, is slow for less than [`RESTED`] steps then, in whatever direction it falls.
pub fn falls(scene: &Scene) -> f64 {
    if scene.sleep.speed.is_none() { 0.25 * f64::from(RESTED) } else { 0.0 }
}

/// Speed up to which ground is slow in a step, if it is so up to `slow` in long ones and gravity gives so much in [`falls`] of them [m/s].
pub fn slow_in(slow: f64, fallen: f64) -> f64 {
    if fallen > 0.0 { slow.min(fallen) } else { slow }
}

/// The count of a block whose particles have moved at up to this speed in a step, if up to `slow` is slow [m/s]. While gravity `grows`, nothing has come to rest, however slow
/// it is: what slept would never get its weight.
pub fn count(rest: u16, speed: f64, slow: f64, grows: bool) -> u16 {
    if speed <= slow && !grows { (rest + 1).min(RESTED) } else { 0 }
}

/// First and last of the blocks that stay awake for a tool, on a level with cells of width `h` [m].
pub fn near_tool(tool: &Aabb, h: f64) -> [[i32; 3]; 2] {
    let near = tool.grown(NEAR_TOOL * h);
    [near.min, near.max].map(|x| x.map(|x| (x / (h * f64::from(SIDE))).floor() as i32))
}
