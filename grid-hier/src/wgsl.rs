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

/// Nodes behind mirror walls take the velocities of their images. Conditions: sleeps, listed, mirrored.
pub const REFLECT: &str = include_str!("wall/reflect.wgsl");
/// What walls have given, and where there are nodes behind them.
pub const WALL: &str = include_str!("wall/wall.wgsl");
/// Which tiles come to a wall, and how it turns vectors.
pub const REACHES_WALL: &str = include_str!("wall/reaches_wall.wgsl");
/// A node behind mirrors, and what the walls give to it.
pub const MIRROR_NODE: &str = include_str!("wall/mirror_node.wgsl");
/// The same within the grid update, where nothing changes velocities behind it.
pub const MIRRORED: &str = include_str!("wall/mirrored.wgsl");
/// The node before all mirrors that one is the image of.
pub const MIRRORS: &str = include_str!("wall/mirrors.wgsl");
/// Is a node behind mirrors?
pub const BEHIND: &str = include_str!("wall/behind.wgsl");
/// The image of a node, and how mirrors turn its velocity.
pub const IMAGE: &str = include_str!("wall/image.wgsl");
/// Walls that let go, with friction, across one axis.
pub const SEPARATE: &str = include_str!("wall/separate.wgsl");

/// Who sleeps. Condition: levels.
pub const WATCH: &str = include_str!("rest/watch.wgsl");
/// What passes know of the rest of blocks.
pub const WATCH_WORDS: &str = include_str!("rest/watch_words.wgsl");
/// How particles of blocks that sleep are marked.
pub const OF_SLEEPERS: &str = include_str!("rest/of_sleepers.wgsl");
/// What P2G does for those who sleep.
pub const WATCH_P2G: &str = include_str!("rest/watch_p2g.wgsl");
/// What the grid update does.
pub const WATCH_GRID: &str = include_str!("rest/watch_grid.wgsl");
/// What G2P notes of those who are awake.
pub const WATCH_G2P: &str = include_str!("rest/watch_g2p.wgsl");
/// Words that follow blocks through a sort.
pub const WATCH_CARRY: &str = include_str!("rest/watch_carry.wgsl");
/// Sums of what sleep takes.
pub const WATCH_SUM: &str = include_str!("rest/watch_sum.wgsl");
/// Where they stand.
pub const WATCH_BOOKED: &str = include_str!("rest/watch_booked.wgsl");
