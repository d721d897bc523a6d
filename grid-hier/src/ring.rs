//! The rim of a level: nodes whose support reaches out of the level's region, and what ties them to the next coarser level.
//!
//! Per axis, N_I of the coarse level = ¼ N_{2I-1} + ¾ N_{2I} + ¾ N_{2I+1} + ¼ N_{2I+2}. A rim node ("slave") at an even index
//! 2I therefore has the parents I (¾) and I - 1 (¼), one at 2I + 1 has I (¾) and I + 1 (¼); in three dimensions products of
//! these. What particles give to a slave is handed to its parents, and its velocity is theirs. A block of 4³ slaves has its
//! parents among 4³ coarse nodes, the first one before the parent cell of the block's first cell.
//!
//! # Source
//! Truncated hierarchical B-splines: Giannelli, Jüttler, Speleers 2012.

use crate::block::{CELLS, NODES, TILE, TILE_SIDE, in_block, in_tile, offset, shared_nodes};
use barchan_lanes::Float;

/// Scalars that hang on to a slave node besides momentum and mass: m C, one column of three a tile.
pub const COLUMNS: usize = 3;

/// Along one axis, for each place in a block: its two parents' places among the block's four, their weights, and how far
/// each is from it, in fine cells.
const PARENTS: [[(usize, f64, f64); 2]; 4] = [
    [(1, 0.75, 0.5), (0, 0.25, -1.5)],
    [(1, 0.75, -0.5), (2, 0.25, 1.5)],
    [(2, 0.75, 0.5), (1, 0.25, -1.5)],
    [(2, 0.75, -0.5), (3, 0.25, 1.5)],
];

/// First of the 4³ coarse nodes that hold the parents of a block's nodes, from the block's coordinates.
pub fn first_parent(block: [i32; 3]) -> [i32; 3] {
    block.map(|b| 2 * b - 1)
}

/// Calls `f` with each parent of a node of a block: its place among the 4³, its weight, its distance in fine cells.
#[inline(always)]
fn each_parent(node: usize, mut f: impl FnMut(usize, f64, [f64; 3])) {
    let (x, y, z) = (node / 16, node / 4 % 4, node % 4);
    for (px, wx, dx) in PARENTS[x] {
        for (py, wy, dy) in PARENTS[y] {
            for (pz, wz, dz) in PARENTS[z] {
                f(px * 16 + py * 4 + pz, wx * wy * wz, [dx, dy, dz]);
            }
        }
    }
}

/// Places among the 4³ coarse nodes that are parents of any of a block's slaves, as bits.
pub fn parents(slaves: u64) -> u64 {
    let mut used = 0;
    for node in (0..CELLS).filter(|node| slaves >> node & 1 == 1) {
        each_parent(node, |parent, _, _| used |= 1 << parent);
    }
    used
}

/// One axis of the restriction, along a line of four nodes with W scalars each: to[I] += P (from[i] + slope[i] (x_I - x_i)).
#[inline(always)]
fn restrict_line<T: Float, const W: usize>(from: [[T; W]; 4], slope: Option<[[T; W]; 4]>) -> [[T; W]; 4] {
    let [near, far, lever] = [0.75, 0.25, 0.375].map(T::from_f64);
    let mut to = [[T::default(); W]; 4];
    for i in 0..W {
        let f = [from[0][i], from[1][i], from[2][i], from[3][i]];
        to[0][i] = far * f[0];
        to[1][i] = near * (f[0] + f[1]) + far * f[2];
        to[2][i] = near * (f[2] + f[3]) + far * f[1];
        to[3][i] = far * f[3];
    }
    if let Some(slope) = slope {
        for i in 0..W {
            let s = [slope[0][i], slope[1][i], slope[2][i], slope[3][i]];
            to[0][i] += -(lever * s[0]);
            to[1][i] += lever * (s[0] - s[1] - s[2]);
            to[2][i] += lever * (s[1] + s[2] - s[3]);
            to[3][i] += lever * s[3];
        }
    }
    to
}

/// One axis of the prolongation, likewise: to[i] = Σ P from[I].
#[inline(always)]
fn prolong_line<T: Float, const W: usize>(from: [[T; W]; 4]) -> [[T; W]; 4] {
    let [near, far] = [0.75, 0.25].map(T::from_f64);
    let mut to = [[T::default(); W]; 4];
    for i in 0..W {
        let c = [from[0][i], from[1][i], from[2][i], from[3][i]];
        to[0][i] = near * c[1] + far * c[0];
        to[1][i] = near * c[1] + far * c[2];
        to[2][i] = near * c[2] + far * c[1];
        to[3][i] = near * c[2] + far * c[3];
    }
    to
}

/// Replaces each line of a block along an axis by what `f` makes of it, from the places of its units and these. A unit has W
/// scalars: along x and y a row of four nodes, along z one node.
#[inline(always)]
fn each_line<const AXIS: usize, const W: usize, T: Float>(
    values: &mut [T; NODES],
    f: impl Fn([usize; 4], [[T; W]; 4]) -> [[T; W]; 4],
) {
    for line in 0..NODES / (4 * W) {
        let (first, stride) = if AXIS == 0 { (line, 4) } else { (4 * line, 1) };
        let at = [first, first + stride, first + 2 * stride, first + 3 * stride].map(|unit| W * unit);
        let to = f(at, units(values, at));
        for (at, to) in at.into_iter().zip(&to) {
            values[at..at + W].copy_from_slice(to);
        }
    }
}

#[inline(always)]
fn units<const W: usize, T: Float>(values: &[T; NODES], at: [usize; 4]) -> [[T; W]; 4] {
    let mut units = [[T::default(); W]; 4];
    for (unit, at) in units.iter_mut().zip(at) {
        unit.copy_from_slice(&values[at..at + W]);
    }
    units
}

/// Hands what a block's slaves hold to their parents: mass m_c = Σ P m_f, momentum p_c = Σ P (p_f + M_f (x_c - x_f)) with the
/// affine momentum M_f = Σ w m C, whose columns are `affine` [kg m/s a cell]. The slaves hold nothing afterwards.
#[inline(always)]
pub fn restrict<T: Float>(
    slaves: u64,
    nodes: &mut [T; NODES],
    affine: &mut [[T; NODES]; COLUMNS],
    parents: &mut [T; NODES],
) {
    let mut own = [T::default(); NODES];
    for node in 0..CELLS {
        let at = 4 * node;
        if slaves >> node & 1 == 1 {
            own[at..at + 4].copy_from_slice(&nodes[at..at + 4]);
            nodes[at..at + 4].fill(T::default());
        } else {
            affine.iter_mut().for_each(|column| column[at..at + 4].fill(T::default()));
        }
    }
    // Axis by axis; the columns of the axes that are still to come go along.
    let [x, y, z] = affine;
    each_line::<0, 16, _>(&mut own, |at, from| restrict_line(from, Some(units(x, at))));
    each_line::<0, 16, _>(y, |_, from| restrict_line(from, None));
    each_line::<0, 16, _>(z, |_, from| restrict_line(from, None));
    each_line::<1, 16, _>(&mut own, |at, from| restrict_line(from, Some(units(y, at))));
    each_line::<1, 16, _>(z, |_, from| restrict_line(from, None));
    each_line::<2, 4, _>(&mut own, |at, from| restrict_line(from, Some(units(z, at))));
    *parents = own;
}

/// Gives a block's slaves the velocity of their parents: u_f = Σ P u_c.
#[inline(always)]
pub fn prolong<T: Float>(slaves: u64, parents: &[T; NODES], nodes: &mut [T; NODES]) {
    let mut values = *parents;
    each_line::<0, 16, _>(&mut values, |_, from| prolong_line(from));
    each_line::<1, 16, _>(&mut values, |_, from| prolong_line(from));
    each_line::<2, 4, _>(&mut values, |_, from| prolong_line(from));
    for node in (0..CELLS).filter(|node| slaves >> node & 1 == 1) {
        nodes[4 * node..4 * node + 3].copy_from_slice(&values[4 * node..4 * node + 3]);
    }
}

/// For each first node of the tile of a block: which of the nine rows of nodes that a particle there gives to hold a slave, as
/// bits. `slaves` says which nodes of the block at an offset are slaves.
pub fn touching(slaves: impl Fn(usize) -> u64) -> [u16; TILE / 4] {
    let mut is_slave = [false; TILE / 4];
    for n in 0..27 {
        let bits = slaves(n) & shared_nodes(offset(n));
        let from = offset(n).map(|o| 4 * o + 2);
        for node in (0..CELLS).filter(|node| bits >> node & 1 == 1) {
            let local = [node / 16, node / 4 % 4, node % 4];
            let [x, y, z]: [usize; 3] = std::array::from_fn(|d| (from[d] + local[d] as i32) as usize);
            is_slave[in_tile(x, y, z) / 4] = true;
        }
    }
    let mut touches = [0; TILE / 4];
    for x in 0..TILE_SIDE - 2 {
        for y in 0..TILE_SIDE - 2 {
            for z in 0..TILE_SIDE - 2 {
                let holds = |r: usize| (0..3).any(|k| is_slave[in_tile(x + r / 3, y + r % 3, z + k) / 4]);
                touches[in_tile(x, y, z) / 4] = (0..9).filter(|&r| holds(r)).fold(0, |bits, r| bits | 1 << r);
            }
        }
    }
    touches
}

/// Start of a node's four scalars in a block, from its cell.
pub fn node_in_block(cell: [i32; 3]) -> usize {
    let local = cell.map(|c| (c & 3) as usize);
    in_block(local[0], local[1], local[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mass, momentum and angular momentum go over whole, for any slaves: Σ P = 1 and Σ P x_c = x_f.
    #[test]
    fn restriction_keeps_mass_momentum_and_angular_momentum() {
        let value = |i: usize| ((i * 7919) % 1009) as f64 / 1009.0 - 0.4;
        let mut nodes: [f64; NODES] = std::array::from_fn(value);
        for node in 0..CELLS {
            nodes[4 * node + 3] = 0.1 + value(node).abs();
        }
        // Symmetric: a pure stretch, which carries no angular momentum of its own.
        let symmetric = |i: usize, j: usize, node: usize| value(3 * node + (i + 1) * (j + 1));
        let affine: [[f64; NODES]; COLUMNS] = std::array::from_fn(|j| {
            std::array::from_fn(|at| if at % 4 == 3 { 0.0 } else { symmetric(at % 4, j, at / 4) })
        });
        let fine = |node: usize| [node / 16, node / 4 % 4, node % 4].map(|i| i as f64);
        let coarse = |node: usize| [node / 16, node / 4 % 4, node % 4].map(|i| 2.0 * i as f64 - 1.5);
        let totals = |values: &[f64; NODES], x: &dyn Fn(usize) -> [f64; 3], slaves: u64| {
            let mut sum = [0.0; 7];
            for node in (0..CELLS).filter(|node| slaves >> node & 1 == 1) {
                let (p, x) = (&values[4 * node..4 * node + 4], x(node));
                (0..4).for_each(|d| sum[d] += p[d]);
                (0..3).for_each(|d| sum[4 + d] += x[(d + 1) % 3] * p[(d + 2) % 3] - x[(d + 2) % 3] * p[(d + 1) % 3]);
            }
            sum
        };
        for slaves in [u64::MAX, 0xf00f_0ff0_1248_8421, 1] {
            let mut left = nodes;
            let mut parents = [0.0; NODES];
            let before = totals(&nodes, &fine, slaves);
            restrict(slaves, &mut left, &mut affine.clone(), &mut parents);
            let after = totals(&parents, &coarse, u64::MAX);
            for (b, a) in before.iter().zip(after) {
                assert!((b - a).abs() < 1e-12, "{before:?} became {after:?}");
            }
            assert_eq!(totals(&left, &fine, slaves), [0.0; 7]);
        }
    }

    /// An affine velocity field of the coarse nodes is the same field at the slaves.
    #[test]
    fn prolongation_reproduces_affine_fields() {
        let field = |x: [f64; 3]| [0.3 + x[0] - 2.0 * x[1], 0.5 * x[2] - x[0], 1.0 - x[1] + 0.25 * x[2]];
        let mut parents = [0.0; NODES];
        for node in 0..CELLS {
            let u = field([node / 16, node / 4 % 4, node % 4].map(|i| 2.0 * i as f64 - 1.5));
            parents[4 * node..4 * node + 3].copy_from_slice(&u);
        }
        let mut nodes = [0.0; NODES];
        prolong(u64::MAX, &parents, &mut nodes);
        for node in 0..CELLS {
            let u = field([node / 16, node / 4 % 4, node % 4].map(|i| i as f64));
            (0..3).for_each(|d| assert!((nodes[4 * node + d] - u[d]).abs() < 1e-13));
        }
        assert_eq!(super::parents(u64::MAX), u64::MAX);
        assert_eq!(super::parents(1).count_ones(), 8);
    }
}
