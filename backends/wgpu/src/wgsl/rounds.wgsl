// A block's particles stand in rounds: the first four of each of its cells, cell by cell, then the next four of those that hold more, and so on. So
// neighbouring threads, which own neighbouring cells, find theirs side by side. What cells hold beyond ROUNDS rounds stands behind, cell by cell.

// Where there stands, behind the starts of cells, from where on a cell's particles of a round are; of the last one it is those beyond.
fn round_at(b: u32, round: u32, cell: u32) -> u32 {
    return extent.block_room * 64u + 64u + (b * (ROUNDS + 1u) + round) * 64u + cell;
}

// The round of a cell's particle by its number among them.
fn round_of(rank: u32) -> u32 {
    return min(rank / TOGETHER, ROUNDS);
}

// Where a cell's particle stands, by its number among them.
fn slot_of(b: u32, cell: u32, rank: u32) -> u32 {
    let round = round_of(rank);
    return cells[round_at(b, round, cell)] + rank - round * TOGETHER;
}
