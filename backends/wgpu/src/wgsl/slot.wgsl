// Where a cell's particle stands, by its number among them.
fn slot_of(b: u32, cell: u32, rank: u32) -> u32 {
    let round = round_of(rank);
    return cells[round_at(b, round, cell)] + rank - round * TOGETHER;
}
