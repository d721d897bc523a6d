//! Blocks of cells: keys, tiles, and how tiles and nodes exchange values.

use barchan_lanes::Float;

/// Cells along a block's side.
pub const SIDE: i32 = 4;
/// Cells, and nodes, in a block.
pub const CELLS: usize = 64;
/// Nodes along a tile's side: the block's own and a halo of two on either side, one for the spline's reach and one for
/// particles that have drifted by up to a cell since the last sort.
pub const TILE_SIDE: usize = 8;
/// Scalars in a tile: momentum (or velocity) and mass of each node, and room for a full vector past the last row.
pub const TILE: usize = TILE_SIDE * TILE_SIDE * TILE_SIDE * 4 + 16;
/// Scalars of a block's own nodes.
pub const NODES: usize = CELLS * 4;
/// Marks a block that does not exist.
pub const NONE: u32 = u32::MAX;

/// Blocks along each axis that a key can tell apart, on either side of the origin.
pub const REACH: i32 = 1 << 20;

/// Block that holds a cell.
#[inline]
pub fn of_cell(cell: [i32; 3]) -> [i32; 3] {
    cell.map(|c| c >> 2)
}

/// A cell's place in its block, z fastest.
#[inline]
pub fn place(cell: [i32; 3]) -> usize {
    let [x, y, z] = cell.map(|c| (c & (SIDE - 1)) as usize);
    (4 * x + y) * 4 + z
}

/// A block's sort key: its coordinates, biased and packed 21 bits each, x highest. `None` beyond [`REACH`].
#[inline]
pub fn key(block: [i32; 3]) -> Option<u64> {
    if block.iter().any(|b| !(-REACH..REACH).contains(b)) {
        return None;
    }
    Some(block.iter().fold(0, |key, &b| (key << 21) | (b + REACH) as u64))
}

/// The block of a key.
#[inline]
pub fn of_key(key: u64) -> [i32; 3] {
    let part = |shift: u32| ((key >> shift) & 0x1f_ffff) as i32 - REACH;
    [part(42), part(21), part(0)]
}

/// Index among the 27 neighbours of an offset in {-1, 0, 1}³.
#[inline]
pub fn neighbour(offset: [i32; 3]) -> usize {
    ((offset[0] + 1) * 9 + (offset[1] + 1) * 3 + offset[2] + 1) as usize
}

/// Offset of the neighbour with an index.
#[inline]
pub fn offset(neighbour: usize) -> [i32; 3] {
    let n = neighbour as i32;
    [n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1]
}

/// Start of a node's four scalars in a tile, from its coordinates in the tile.
#[inline(always)]
pub const fn in_tile(x: usize, y: usize, z: usize) -> usize {
    ((x * TILE_SIDE + y) * TILE_SIDE + z) * 4
}

/// Start of a node's four scalars in a block, from its coordinates in the block.
#[inline(always)]
pub const fn in_block(x: usize, y: usize, z: usize) -> usize {
    ((x * 4 + y) * 4 + z) * 4
}

/// Along one axis a node of a block is in two tiles. For each of them: the offset from the tile's block to the node's
/// block, and the node's place in the tile.
#[inline(always)]
pub const fn holders(node: usize) -> [(i32, usize); 2] {
    if node < 2 { [(0, node + 2), (1, node + 6)] } else { [(-1, node - 2), (0, node + 2)] }
}

/// Sums the tiles of a block and its neighbours into the block's nodes. Tiles are ordered by the offset from the tile's
/// block to the nodes' block, as in [`neighbour`].
#[inline(always)]
pub fn sum_tiles<T: Float>(nodes: &mut [T; NODES], tiles: [&[T; TILE]; 27]) {
    for (row, nodes) in nodes.as_chunks_mut::<16>().0.iter_mut().enumerate() {
        let (mut low, mut high) = ([T::default(); 8], [T::default(); 8]);
        for (x, at_x) in holders(row / 4) {
            for (y, at_y) in holders(row % 4) {
                let first = neighbour([x, y, -1]);
                let [before, own, behind] = [tiles[first], tiles[first + 1], tiles[first + 2]]
                    .map(|tile| &tile[in_tile(at_x, at_y, 0)..][..32]);
                for i in 0..8 {
                    high[i] += before[i];
                    low[i] += own[8 + i];
                    high[i] += own[16 + i];
                    low[i] += behind[24 + i];
                }
            }
        }
        nodes[..8].copy_from_slice(&low);
        nodes[8..].copy_from_slice(&high);
    }
}

/// Copies the nodes of a block and its neighbours into the block's tile. Nodes are ordered by the offset from the
/// tile's block to the nodes' block, as in [`neighbour`].
#[inline(always)]
pub fn fill_tile<T: Float>(tile: &mut [T; TILE], nodes: [&[T; NODES]; 27]) {
    /// Along one axis: the offset of the block that a tile's node belongs to, and its place there.
    const fn home(node: usize) -> (i32, usize) {
        match node {
            0..2 => (-1, node + 2),
            2..6 => (0, node - 2),
            _ => (1, node - 6),
        }
    }
    for (row, to) in tile.as_chunks_mut::<32>().0[..TILE_SIDE * TILE_SIDE].iter_mut().enumerate() {
        let ((x, at_x), (y, at_y)) = (home(row / TILE_SIDE), home(row % TILE_SIDE));
        let first = neighbour([x, y, -1]);
        let [before, own, behind] =
            [nodes[first], nodes[first + 1], nodes[first + 2]].map(|nodes| &nodes[in_block(at_x, at_y, 0)..][..16]);
        to[..8].copy_from_slice(&before[8..]);
        to[8..24].copy_from_slice(own);
        to[24..].copy_from_slice(&behind[..8]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Keys must tell negative and far blocks apart and sort like coordinates; a collision would silently mix two places.
    #[test]
    fn keys_are_exact_and_ordered() {
        let far = REACH - 1;
        let blocks =
            [[-REACH, 0, 0], [-1, -1, -1], [-1, 0, far], [0, 0, 0], [0, 0, 1], [0, 1, -REACH], [far, far, far]];
        for pair in blocks.windows(2) {
            assert!(key(pair[0]) < key(pair[1]));
        }
        for block in blocks {
            assert_eq!(of_key(key(block).unwrap()), block);
        }
        assert_eq!(key([REACH, 0, 0]), None);
        assert_eq!(of_cell([-1, 0, 5]), [-1, 0, 1]);
    }

    /// Every node of a tile belongs to exactly one of the 27 blocks around it: summing tiles neither loses nor doubles mass.
    #[test]
    fn a_tile_spreads_over_its_neighbours_exactly_once() {
        let tile: [f64; TILE] = std::array::from_fn(|i| if i < TILE - 16 { (i + 1) as f64 } else { 0.0 });
        let (mut total, mut back) = (0.0, [0.0; TILE]);
        for n in 0..27 {
            let mut nodes = [0.0; NODES];
            sum_tiles(&mut nodes, std::array::from_fn(|i| if i == n { &tile } else { &[0.0; TILE] }));
            total += nodes.iter().sum::<f64>();
            let mut part = [0.0; TILE];
            fill_tile(&mut part, std::array::from_fn(|i| if i == n { &nodes } else { &[0.0; NODES] }));
            back.iter_mut().zip(part).for_each(|(back, part)| *back += part);
            assert_eq!(neighbour(offset(n)), n);
        }
        assert_eq!(total, tile.iter().sum::<f64>());
        assert_eq!(back, tile);
    }
}
