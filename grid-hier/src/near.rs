//! The nodes that a body may hold, and the cubes of them around particles, for every backend.

use crate::block::{self, CELLS, SIDE};
use barchan_core::{Aabb, NodeBatch};

/// Puts those nodes of a block into a batch that are in any of the boxes and heavier than `least` [kg]: what is lighter carries nothing.
///
/// `first` is the first cell of the block, `periods` are as for [`boxes_near_block`], and `node` gives velocity [m/s] and mass [kg] of its nodes, which are asked for in
/// order. Of each that is put, `taken` learns its number in the block, its cell and its number in the batch.
pub fn gather_block(
    batch: &mut NodeBatch,
    boxes: &[Aabb],
    first: [i32; 3],
    periods: [i32; 3],
    least: f64,
    mut node: impl FnMut(usize) -> ([f64; 3], f64),
    mut taken: impl FnMut(usize, [i32; 3], u32),
) {
    let h = batch.cell_width;
    let boxes = boxes_near_block(boxes, first, h, 0.0, periods);
    if boxes.is_empty() {
        return;
    }
    let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
    for n in 0..CELLS {
        let (velocity, mass) = node(n);
        if mass <= least {
            continue;
        }
        let local = [(n / 16) as i32, (n / 4 % 4) as i32, (n % 4) as i32];
        let cell: [i32; 3] = std::array::from_fn(|d| first[d] + local[d]);
        let position = cell.map(centre);
        if boxes.iter().any(|one| one.contains(position)) {
            taken(n, cell, batch.len() as u32);
            batch.position.push(position);
            batch.mass.push(mass);
            batch.velocity.push(velocity);
        }
    }
}

/// Cubes along a side of those around a block's particles: a cell beyond the block at either end, and half a cell more.
const REACHED: usize = SIDE as usize + 3;

/// Cubes of eight nodes around the particles of a block, which may have left it by a cell.
pub struct Cubes<'a> {
    around: [&'a [u32; CELLS]; 27],
    numbers: [u32; REACHED * REACHED * REACHED],
}

impl<'a> Cubes<'a> {
    /// What no node of a block is among those in a batch.
    pub const ABSENT: [u32; CELLS] = [NodeBatch::NONE; CELLS];

    /// Of the block in the middle of these, each of which is the number in the batch of each of its nodes.
    pub fn of(around: [&'a [u32; CELLS]; 27]) -> Self {
        Self { around, numbers: [NodeBatch::NONE; REACHED * REACHED * REACHED] }
    }

    /// The number among `cubes` of the one whose first node has that cell, counted from the block's first; it is put there if it is not yet.
    pub fn number(&mut self, first: [i32; 3], cubes: &mut Vec<[u32; 8]>) -> u32 {
        let at = first.iter().fold(0, |i, x| i * REACHED + (x + 2) as usize);
        if self.numbers[at] == NodeBatch::NONE {
            self.numbers[at] = cubes.len() as u32;
            cubes.push(self.nodes(first));
        }
        self.numbers[at]
    }

    fn nodes(&self, first: [i32; 3]) -> [u32; 8] {
        let along = first.map(|x| [x, x + 1].map(|x| (x.div_euclid(SIDE), x.rem_euclid(SIDE) as usize)));
        std::array::from_fn(|n| {
            let [x, y, z] = [along[0][n / 4], along[1][n / 2 % 2], along[2][n % 2]];
            self.around[block::neighbour([x.0, y.0, z.0])][block::in_block(x.1, y.1, z.1) / 4]
        })
    }
}

/// Does any box, or image of one along periodic axes, come within so much [m] of nodes of a block, see [`boxes_near_block`]?
pub fn is_near_block(boxes: &[Aabb], first: [i32; 3], h: f64, within: f64, periods: [i32; 3]) -> bool {
    let near = nodes_of_block(first, h).grown(within);
    // All blocks of a grid are asked about, and most worlds are not periodic.
    if periods == [0; 3] {
        return boxes.iter().any(|one| one.meets(&near));
    }
    boxes.iter().flat_map(|one| images(one, first, h, within, periods)).any(|one| one.meets(&near))
}

/// The boxes, or images of them along periodic axes, that come within so much [m] of nodes of the block with that first cell, of cells that wide [m]. `periods` are the
/// world's cells along each axis, 0 for one that is not periodic.
pub fn boxes_near_block(boxes: &[Aabb], first: [i32; 3], h: f64, within: f64, periods: [i32; 3]) -> Vec<Aabb> {
    let near = nodes_of_block(first, h).grown(within);
    if periods == [0; 3] {
        return boxes.iter().filter(|one| one.meets(&near)).copied().collect();
    }
    let images = boxes.iter().flat_map(|one| images(one, first, h, within, periods));
    images.filter(|one| one.meets(&near)).collect()
}

/// From the first of a block's nodes to the last.
fn nodes_of_block(first: [i32; 3], h: f64) -> Aabb {
    let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
    Aabb { min: first.map(centre), max: first.map(|c| centre(c + SIDE - 1)) }
}

/// The image of a box whose middle is nearest to a block, along periodic axes, and those next to it if it is so wide that they may be within so much [m] of the block, too.
fn images(one: &Aabb, first: [i32; 3], h: f64, within: f64, periods: [i32; 3]) -> impl Iterator<Item = Aabb> + use<> {
    let one = *one;
    let along = std::array::from_fn::<_, 3, _>(|d| {
        let middle = (0.5 * (one.min[d] + one.max[d]) / h).floor();
        if periods[d] == 0 || !middle.is_finite() {
            return (0..1, 0.0, 0.0);
        }
        let period = f64::from(periods[d]) * h;
        let is_wide = 0.5 * (one.max[d] - one.min[d]) + within + f64::from(SIDE) * h > 0.5 * period;
        let turns = if is_wide { -1..2 } else { 0..1 };
        (turns, -f64::from(nearest(first[d] + SIDE / 2, middle as i32, periods[d])) * h, period)
    });
    let [x, y, z] = along.each_ref().map(|(turns, ..)| turns.clone());
    let turns = x.flat_map(move |x| y.clone().map(move |y| [x, y]));
    let turns = turns.flat_map(move |[x, y]| z.clone().map(move |z| [x, y, z]));
    turns.map(move |turns| {
        let by: [f64; 3] = std::array::from_fn(|d| along[d].1 + f64::from(turns[d]) * along[d].2);
        one.moved(by)
    })
}

/// By how much a cell has to move, in whole periods, to be as near to another as it gets.
pub fn nearest(cell: i32, to: i32, period: i32) -> i32 {
    (2 * (to - cell) + period).div_euclid(2 * period) * period
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of a block of nodes those come that are in a box and weigh something, with their places, masses and velocities.
    #[test]
    fn nodes_in_boxes_come_with_what_they_carry() {
        let mut batch = NodeBatch { cell_width: 0.5, ..NodeBatch::default() };
        // Node (x, y, z) is at ((x, y, z) + 1/2) h.
        let boxes = [Aabb { min: [-1.8, 0.2, 0.2], max: [-1.2, 0.3, 0.8] }, Aabb { min: [-9.0; 3], max: [-8.0; 3] }];
        let mut taken = Vec::new();
        let mass = |n: usize| if n == 17 { 1e-30 } else { n as f64 };
        let node = |n: usize| ([n as f64, 0.0, 0.0], mass(n));
        gather_block(&mut batch, &boxes, [-4, 0, 0], [0; 3], 1e-20, node, |n, cell, number| {
            taken.push((n, cell, number))
        });
        // At x = -1.75 and -1.25, y = 0.25, z = 0.25 and 0.75; node 0 has no mass, 17 hardly any.
        assert_eq!(taken, [(1, [-4, 0, 1], 0), (16, [-3, 0, 0], 1)]);
        assert_eq!(
            (batch.position[1], batch.mass[1], batch.velocity[1]),
            ([-1.25, 0.25, 0.25], 16.0, [16.0, 0.0, 0.0])
        );
        // In a world of eight cells along x, 4 m, which is periodic, the block is at -4, 4, 12 and so on.
        let far = [Aabb { min: [6.2, 0.2, 0.2], max: [6.3, 0.3, 0.3] }];
        let near = |boxes: &[Aabb], first: i32, period: i32| -> Vec<f64> {
            let periods = [period, 0, 0];
            let found = boxes_near_block(boxes, [first, 0, 0], 0.5, 0.0, periods);
            let found: Vec<f64> = found.iter().map(|one| one.min[0]).collect();
            assert_eq!(is_near_block(boxes, [first, 0, 0], 0.5, 0.0, periods), !found.is_empty());
            found
        };
        assert!(near(&far, -4, 8).iter().eq(&[6.2 - 8.0]) && near(&far, -4, 0).is_empty());
        // A box in the middle of the world meets both of its blocks where they are, and one as wide as the world meets the one that it begins in from both sides.
        let wide = [Aabb { min: [-1.0, 0.2, 0.2], max: [1.0, 0.3, 0.3] }];
        assert_eq!([-4, 0].map(|x| near(&wide, x, 8)), [[-1.0], [-1.0]]);
        let whole = [Aabb { min: [-0.5, 0.2, 0.2], max: [3.5, 0.3, 0.3] }];
        assert_eq!([-4, 0].map(|x| near(&whole, x, 8)), [vec![-4.5, -0.5], vec![-0.5]]);
        // Each of two boxes meets it by an image of its own.
        assert_eq!(near(&[wide[0], far[0]], -4, 8), [-1.0, 6.2 - 8.0]);
        gather_block(
            &mut batch,
            &boxes[1..],
            [-4, 0, 0],
            [0; 3],
            1e-20,
            |_| unreachable!("no box meets it"),
            |_, _, _| {},
        );
        assert_eq!(batch.len(), 2);
    }

    /// A particle's cube has the nodes around it, in its own block and in those beside, and comes once.
    #[test]
    fn cubes_reach_into_blocks_beside() {
        // The number of a node is that of its cell, counted from the cell (-4, -4, -4) along twelve a side.
        let number = |cell: [i32; 3]| cell.iter().fold(0, |n, c| 12 * n + (c + 4) as u32);
        let of_block = |b: usize| -> [u32; CELLS] {
            std::array::from_fn(|n| {
                let local = [n / 16, n / 4 % 4, n % 4];
                number(std::array::from_fn(|d| SIDE * block::offset(b)[d] + local[d] as i32))
            })
        };
        let mut blocks: Vec<[u32; CELLS]> = (0..27).map(of_block).collect();
        blocks[block::neighbour([1, 0, 0])] = Cubes::ABSENT;
        let mut around = Cubes::of(std::array::from_fn(|b| &blocks[b]));
        let mut cubes = Vec::new();
        for first in [[-2, 4, 3], [0, 1, 2], [3, 0, 0], [0, 1, 2]] {
            let found = around.number(first, &mut cubes);
            for (n, node) in cubes[found as usize].iter().enumerate() {
                let to = [n / 4, n / 2 % 2, n % 2];
                let cell: [i32; 3] = std::array::from_fn(|d| first[d] + to[d] as i32);
                assert_eq!(*node, if cell[0] == 4 { NodeBatch::NONE } else { number(cell) }, "{cell:?}");
            }
        }
        assert_eq!(cubes.len(), 3);
    }
}
