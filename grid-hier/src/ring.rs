//! The rim of a level: nodes whose support reaches out of the level's region, and their relation to the next coarser
//! level.
//!
//! Per axis, N_I of the coarse level = ¼ N_{2I-1} + ¾ N_{2I} + ¾ N_{2I+1} + ¼ N_{2I+2}. A rim node ("slave") at an even index
//! 2I therefore has the parents I (¾) and I - 1 (¼), one at 2I + 1 has I (¾) and I + 1 (¼); in three dimensions products of
//! these. What particles give to a slave is handed to its parents, and its velocity is theirs. A block of 4³ slaves has its
//! parents among 4³ coarse nodes, the first one before the parent cell of the block's first cell.
//!
//! With momentum alone, the parents would see each slave's neighbourhood move as one, and spin and stretch would be
//! lost. So a slave also gives its affine momentum: its mass times the mean C of the particles about it, from sums over
//! parent cells.
//!
//! # Source
//! Truncated hierarchical B-splines: Giannelli, Jüttler, Speleers 2012.

use crate::block::{CELLS, NODES, in_block};
use barchan_lanes::{CHUNK, Float, Lanes, tabulate};

/// Sums for a slave node, or for a parent cell: momentum and mass, then the three columns of m C, each followed by a
/// zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Carried<T>(pub [T; CHUNK]);

impl<T> Carried<T> {
    /// Where the mass is.
    pub const MASS: usize = 3;
    /// Where column `j` starts.
    pub const fn column(j: usize) -> usize {
        4 * (1 + j)
    }
}

/// Parent cells in a block.
pub const PARENT_CELLS: usize = 8;

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
pub fn each_parent(node: usize, mut f: impl FnMut(usize, f64, [f64; 3])) {
    let (x, y, z) = (node / 16, node / 4 % 4, node % 4);
    for (px, wx, dx) in PARENTS[x] {
        for (py, wy, dy) in PARENTS[y] {
            for (pz, wz, dz) in PARENTS[z] {
                f(px * 16 + py * 4 + pz, wx * wy * wz, [dx, dy, dz]);
            }
        }
    }
}

/// Calls `f` with each parent cell that enters the mean about a node of a block, as [`spread`] finds it: its place among the 4³ around the block, and its weight.
pub fn each_mean(node: usize, mut f: impl FnMut(usize, f64)) {
    const FAR: f64 = 1.0 / 32.0;
    const NEAR: f64 = 9.0 / 32.0;
    const OWN: f64 = 11.0 / 16.0;
    // Along an axis, from the first of three cells on.
    const ALONG: [(usize, [f64; 3]); 4] =
        [(0, [NEAR, OWN, FAR]), (0, [FAR, OWN, NEAR]), (1, [NEAR, OWN, FAR]), (1, [FAR, OWN, NEAR])];
    let [(x, of_x), (y, of_y), (z, of_z)] = [node / 16, node / 4 % 4, node % 4].map(|at| ALONG[at]);
    for n in 0..27 {
        let (i, j, k) = (n / 9, n / 3 % 3, n % 3);
        f((x + i) * 16 + (y + j) * 4 + z + k, of_x[i] * of_y[j] * of_z[k]);
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

/// Which of the 4³ parent cells around a block enter the mean C of any of its slaves, as bits.
pub fn parent_cells(slaves: u64) -> u64 {
    // Per axis, places 0 and 1 have it from the first three, 2 and 3 from the last three.
    const AROUND: [u64; CELLS] = {
        let mut around = [0; CELLS];
        let mut at = 0;
        while at < CELLS * 27 {
            let (node, k) = (at / 27, at % 27);
            let x = node / 16 / 2 + k / 9;
            let y = node / 4 % 4 / 2 + k / 3 % 3;
            let z = node % 4 / 2 + k % 3;
            around[node] |= 1 << (x * 16 + y * 4 + z);
            at += 1;
        }
        around
    };
    (0..CELLS).filter(|node| slaves >> node & 1 == 1).fold(0, |used, node| used | AROUND[node])
}

/// The lines of four nodes of a block along an axis, by number, and for each where the parts start that lanes hold of what a node carries.
#[inline(always)]
fn parts_of_lines<V: Lanes>() -> impl Iterator<Item = (usize, usize)> {
    let parts = CHUNK / V::COUNT;
    (0..CELLS / 4 * parts).map(move |i| (i / parts, i % parts * V::COUNT))
}

/// Means about the nodes of a block, from sums over the 4³ parent cells around it, with the quadratic spline of twice
/// the cell's width. These reach as far as any particle that gives mass to a node, even one that is a cell away from
/// where it was sorted.
#[inline(always)]
pub fn spread<V: Lanes>(carried: &mut [Carried<V::Scalar>; CELLS]) {
    let [far, near, own] = [V::splat(1.0 / 32.0), V::splat(9.0 / 32.0), V::splat(11.0 / 16.0)];
    for stride in [16, 4, 1] {
        for (line, part) in parts_of_lines::<V>() {
            // SAFETY: a node carries 16 scalars.
            unsafe {
                let line =
                    carried.as_mut_ptr().add(line / stride * 4 * stride + line % stride).cast::<V::Scalar>().add(part);
                let f: [V; 4] = tabulate!(4, |i| V::load(line.add(i * stride * CHUNK)));
                let to = [
                    near.mul_add(f[0], own.mul_add(f[1], far * f[2])),
                    far.mul_add(f[0], own.mul_add(f[1], near * f[2])),
                    near.mul_add(f[1], own.mul_add(f[2], far * f[3])),
                    far.mul_add(f[1], own.mul_add(f[2], near * f[3])),
                ];
                for i in 0..4 {
                    to[i].store(line.add(i * stride * CHUNK));
                }
            }
        }
    }
}

/// Gives what a block's slaves carry to their parents: mass m_c = Σ P m_f, momentum p_c = Σ P (p_f + M_f (x_c - x_f)).
/// The affine momentum M_f [kg m/s a cell] of a slave is its mass times the mean C about it. Nodes that are no slaves
/// must carry nothing.
#[inline(always)]
pub fn restrict<V: Lanes>(carried: &mut [Carried<V::Scalar>; CELLS], parents: &mut [V::Scalar; NODES]) {
    // Axis by axis; the columns of the axes that are still to come go along.
    restrict_axis::<V, 0>(carried);
    restrict_axis::<V, 1>(carried);
    restrict_axis::<V, 2>(carried);
    for (parent, Carried(carried)) in parents.as_chunks_mut::<4>().0.iter_mut().zip(carried) {
        parent.copy_from_slice(&carried[..4]);
    }
}

/// One axis of the restriction, along each line of four nodes: to[I] = Σ P (from[i] + column[i] (x_I - x_i)).
#[inline(always)]
fn restrict_axis<V: Lanes, const AXIS: usize>(carried: &mut [Carried<V::Scalar>; CELLS]) {
    // A column is momentum, whose lanes are the first four. It lies behind them, so that it is still there when they are summed.
    const LEVER: [f64; CHUNK] = [0.375, 0.375, 0.375, 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0.];
    let stride = [16, 4, 1][AXIS];
    let (near, far) = (V::splat(0.75), V::splat(0.25));
    let lever = LEVER.map(V::Scalar::from_f64);
    for (line, part) in parts_of_lines::<V>() {
        // SAFETY: a node carries 16 scalars, of which a column starts at most at the twelfth.
        unsafe {
            let lever = V::load(lever.as_ptr().add(part));
            let node = carried.as_mut_ptr().add(line / stride * 4 * stride + line % stride).cast::<V::Scalar>();
            let line = node.add(part);
            let f: [V; 4] = tabulate!(4, |i| V::load(line.add(i * stride * CHUNK)));
            let s: [V; 4] = tabulate!(4, |i| {
                V::repeat4(node.add(i * stride * CHUNK + Carried::<V::Scalar>::column(AXIS))) * lever
            });
            let to = [
                far * f[0] - s[0],
                near.mul_add(f[0] + f[1], far.mul_add(f[2], s[0] - s[1] - s[2])),
                near.mul_add(f[2] + f[3], far.mul_add(f[1], s[1] + s[2] - s[3])),
                far.mul_add(f[3], s[3]),
            ];
            for i in 0..4 {
                to[i].store(line.add(i * stride * CHUNK));
            }
        }
    }
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

/// Start of a node's four scalars in a block, from its cell.
pub fn node_in_block(cell: [i32; 3]) -> usize {
    let local = cell.map(|c| (c & 3) as usize);
    in_block(local[0], local[1], local[2])
}

#[cfg(test)]
mod tests {
    use super::*;

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
