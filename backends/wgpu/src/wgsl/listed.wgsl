// Blocks that only some passes visit. A sort lists them, each kind in the order of blocks: how many of each kind there are, how many on the levels before
// each but the first and on all, and then, for each, as many places as there could be. Behind all of them stands, for each number of a block or a block of
// nodes, of which kinds it is.
const LIST_KINDS: u32 = 4u;
// Blocks of nodes with some at the rim of their level; blocks whose particles give to nodes that, subcycled, the next finer level hands something to; blocks, or
// blocks of nodes, where walls are to be booked or mirrored; and blocks of nodes that, subcycled, the next finer level hands something to, or with images of such.
const AT_RIM: u32 = 0u;
const GIVING: u32 = 1u;
const WALLED: u32 = 2u;
const TAKING: u32 = 3u;

// How many of a kind there are on the levels before one, which is not the first.
fn until_level(kind: u32, level: u32) -> u32 {
    return LIST_KINDS + kind * LEVELS + level - 1u;
}

fn place_in_list(kind: u32, i: u32) -> u32 {
    return LIST_KINDS * (1u + LEVELS) + kind * max(extent.node_room, extent.block_room) + i;
}

// A listed block, or NONE behind the last one.
fn listed_block(kind: u32, i: u32) -> u32 {
    let room = max(extent.node_room, extent.block_room);
    return select(NONE, listed[place_in_list(kind, min(i, room - 1u))], i < listed[kind]);
}
