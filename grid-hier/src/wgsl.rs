//! What this crate's stages are on GPUs, as WGSL, beside the Rust that does the same. A backend puts bindings and what passes share before these
//! texts, and applies their conditions (`@if(...)`, as in WESL).

/// When particles are to be sorted.
pub const DUE: &str = include_str!("due.wgsl");

/// Particles to grid. Conditions: levels, subcycled, mirrored, sleeps, stiffens.
pub const P2G: &str = include_str!("transfer/p2g.wgsl");
/// Sums over parent cells in P2G, for rims.
pub const PARENT_CELLS: &str = include_str!("transfer/parent_cells.wgsl");
/// Grid to particles. Conditions: asks, several, sleeps, stiffens, damps.
pub const G2P: &str = include_str!("transfer/g2p.wgsl");

/// The pass in which rims hand on what they hold.
pub const RESTRICT: &str = include_str!("ring/restrict.wgsl");
/// What a block at a rim hands to its parents.
pub const HAND_ON: &str = include_str!("ring/hand_on.wgsl");
/// Where what is handed on stands.
pub const HANDED: &str = include_str!("ring/handed.wgsl");
/// What finer blocks hand to a node.
pub const HANDED_TO: &str = include_str!("ring/handed_to.wgsl");
/// Velocities at rims.
pub const PROLONG: &str = include_str!("ring/prolong.wgsl");
/// Which blocks a pass moves whose levels step together.
pub const PROLONG_TASKS: &str = include_str!("ring/prolong_tasks.wgsl");
/// Blocks at rims, some a workgroup. Condition: subcycled.
pub const RIMS: &str = include_str!("ring/rims.wgsl");
/// The pass that does nothing else.
pub const RIMS_ALONE: &str = include_str!("ring/rims_alone.wgsl");

/// Rounds of split and merge: which particles one may concern.
pub const ADAPT_FIND: &str = include_str!("adapt/find.wgsl");
/// Lists them.
pub const ADAPT_LIST: &str = include_str!("adapt/list.wgsl");
/// Copies them to where the host reads them.
pub const ADAPT_COPY: &str = include_str!("adapt/copy.wgsl");
/// Which cells are at least half full.
pub const ADAPT_FILL: &str = include_str!("adapt/fill.wgsl");
/// Marks those that are to go.
pub const ADAPT_REMOVE: &str = include_str!("adapt/remove.wgsl");
/// The stress of those that have come in.
pub const ADAPT_STRESS: &str = include_str!("adapt/stress.wgsl");
