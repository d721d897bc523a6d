// What rims hand on: to each of the 4x4x4 parents around a block of nodes, and behind that the sums of the blocks' parent cells. Behind those,
// subcycled, the tiles without forces of the blocks whose particles give to nodes that two levels share.
fn of_still_tile(number: u32) -> u32 {
    return extent.node_room * 64u + extent.block_room * 24u + number * 512u;
}

fn of_parent_cell(b: u32, parent: u32, column: u32) -> u32 {
    return extent.node_room * 64u + b * 24u + parent * 3u + column;
}
