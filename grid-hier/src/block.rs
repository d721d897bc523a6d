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

/// Where a tile and the nodes of the block at `offset` from it overlap along one axis: first node in the tile, first node in
/// the block, number of nodes.
#[inline(always)]
const fn overlap(offset: i32) -> (usize, usize, usize) {
    match offset {
        -1 => (0, 2, 2),
        0 => (2, 0, 4),
        _ => (6, 0, 2),
    }
}

/// Calls `$row` with the starts, in the tile and in the block, of each row of nodes along z that both hold, and with the row's
/// length in scalars as a constant, so that a row is one or two vector operations.
macro_rules! rows {
    ($offset:expr, |$tile:ident, $block:ident, $width:ident| $row:expr) => {{
        let [(tx, bx, nx), (ty, by, ny), (tz, bz, nz)] =
            [overlap($offset[0]), overlap($offset[1]), overlap($offset[2])];
        for x in 0..nx {
            for y in 0..ny {
                let $tile = in_tile(tx + x, ty + y, tz);
                let $block = in_block(bx + x, by + y, bz);
                if nz == 4 {
                    const $width: usize = 16;
                    $row
                } else {
                    const $width: usize = 8;
                    $row
                }
            }
        }
    }};
}

/// Adds to a block's nodes what the tile of a neighbour holds for them. `offset` points from the tile's block to the nodes'.
#[inline(always)]
pub fn add_tile<T: Float>(nodes: &mut [T; NODES], tile: &[T; TILE], offset: [i32; 3]) {
    rows!(offset, |t, b, WIDTH| {
        let (to, from) = (&mut nodes[b..b + WIDTH], &tile[t..t + WIDTH]);
        for i in 0..WIDTH {
            to[i] += from[i];
        }
    });
}

/// Copies a block's nodes to where they stand in the tile of a neighbour; without a block there, zeros. `offset` points from
/// the tile's block to the nodes'.
#[inline(always)]
pub fn fill_tile<T: Float>(tile: &mut [T; TILE], nodes: Option<&[T; NODES]>, offset: [i32; 3]) {
    match nodes {
        Some(nodes) => rows!(offset, |t, b, WIDTH| {
            tile[t..t + WIDTH].copy_from_slice(&nodes[b..b + WIDTH]);
        }),
        None => rows!(offset, |t, _b, WIDTH| {
            tile[t..t + WIDTH].fill(T::default());
        }),
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
            add_tile(&mut nodes, &tile, offset(n));
            total += nodes.iter().sum::<f64>();
            fill_tile(&mut back, Some(&nodes), offset(n));
            assert_eq!(neighbour(offset(n)), n);
        }
        assert_eq!(total, tile.iter().sum::<f64>());
        assert_eq!(back, tile);
    }
}
