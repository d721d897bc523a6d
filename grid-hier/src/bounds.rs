//! The world's sides on a level.

use crate::block::SIDE;
use crate::wall::{Mirror, Mirrors, Separation};
use barchan_core::Plan;
use barchan_core::scene::{WHOLE_CELL, Wall};

/// Where the world ends, in cells of one level.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// First cell inside.
    pub min: [i32; 3],
    /// One past the last cell inside.
    pub max: [i32; 3],
    /// Axes whose ends are joined.
    pub periodic: [bool; 3],
    /// Sides without a wall.
    pub open: [[bool; 2]; 3],
    /// Where the sides are: cell of the finest level, and place in it [cells]. Open sides may cut cells.
    pub sides: [[(i32, f64); 2]; 3],
    /// The level.
    level: usize,
    /// Ends with a wall of any kind.
    pub walled: [[bool; 2]; 3],
    /// Slip and stick walls.
    pub mirrors: Mirrors,
    /// Walls that let go, with the sum of the node numbers of each mirrored pair along their axis.
    pub separations: Vec<(Separation, i32)>,
}

impl Bounds {
    /// The world's bounds on a level. Walls are faces of its cells; open sides may cut them.
    pub fn new(plan: &Plan, level: usize) -> Self {
        let walls = &plan.scene.world.walls;
        let ends = [[walls.x_min, walls.x_max], [walls.y_min, walls.y_max], [walls.z_min, walls.z_max]];
        let min = plan.cell_min.map(|c| c >> level);
        let max = plan.cell_max.map(|c| ((c - 1) >> level) + 1);
        let kind = ends.map(|axis| {
            axis.map(|wall| match wall {
                Wall::Slip => Mirror::Slip,
                Wall::Stick => Mirror::Stick,
                Wall::Open | Wall::Periodic | Wall::Separate { .. } => Mirror::Open,
            })
        });
        let mut separations = Vec::new();
        for (axis, wall_ends) in ends.iter().enumerate() {
            for (end, wall) in wall_ends.iter().enumerate() {
                if let Wall::Separate { friction } = *wall {
                    let (inward, face) = if end == 0 { (1.0, min[axis]) } else { (-1.0, max[axis]) };
                    separations.push((Separation { axis, inward, friction }, 2 * face - 1));
                }
            }
        }
        let (h, world) = (plan.cell_widths[0], &plan.scene.world);
        let side = |axis: usize, x: f64, cell: i32| {
            let cells = x / h;
            let cuts = (cells - cells.round()).abs() > WHOLE_CELL;
            // Walls, and sides that mean a face, lie there.
            let first = cells.floor() as i32;
            if cuts && ends[axis].contains(&Wall::Open) { (first, cells - cells.floor()) } else { (cell, 0.0) }
        };
        Self {
            min,
            max,
            periodic: ends.map(|axis| axis[0] == Wall::Periodic),
            open: ends.map(|axis| axis.map(|wall| wall == Wall::Open)),
            sides: [0, 1, 2]
                .map(|d| [side(d, world.min[d], plan.cell_min[d]), side(d, world.max[d], plan.cell_max[d])]),
            level,
            walled: ends.map(|axis| axis.map(|wall| wall.is_wall())),
            mirrors: Mirrors { kind, min, max },
            separations,
        }
    }

    /// Whether a place is beyond a side of the world. Unlike [`min`](Self::min) and [`max`](Self::max), this is exact
    /// for open sides that cut cells.
    pub fn is_beyond(&self, cell: [i32; 3], offset: [f64; 3]) -> bool {
        let fine = f64::from(1 << self.level);
        (0..3).filter(|d| !self.periodic[*d]).any(|d| {
            // Differences of cells are exact, also far from the origin.
            let from = |(side, part): (i32, f64)| {
                (i64::from(cell[d]) * i64::from(1 << self.level) - i64::from(side)) as f64 + offset[d] * fine - part
            };
            from(self.sides[d][0]) < 0.0 || from(self.sides[d][1]) >= 0.0
        })
    }

    /// Whether a block reaches a side without a wall, or comes nearer to it than two cells.
    pub fn is_at_open_side(&self, block: [i32; 3]) -> bool {
        (0..3).any(|d| {
            let [low, high] = self.open[d];
            (low && block[d] * SIDE - 2 < self.min[d]) || (high && (block[d] + 1) * SIDE + 2 > self.max[d])
        })
    }

    /// A block's coordinates, wrapped into the world along periodic axes.
    pub fn wrap(&self, mut block: [i32; 3]) -> [i32; 3] {
        for d in 0..3 {
            if self.periodic[d] {
                let (first, count) = (self.min[d] / SIDE, (self.max[d] - self.min[d]) / SIDE);
                block[d] = first + (block[d] - first).rem_euclid(count);
            }
        }
        block
    }

    /// Cells from end to end of periodic axes; 0 along the others.
    pub fn periods(&self) -> [i32; 3] {
        std::array::from_fn(|d| if self.periodic[d] { self.max[d] - self.min[d] } else { 0 })
    }

    /// By how many blocks images of the world are off along periodic axes that blocks from one to another may lie in.
    pub fn images(&self, first: [i32; 3], last: [i32; 3]) -> impl Iterator<Item = [i32; 3]> {
        let along = std::array::from_fn::<Vec<i32>, 3, _>(|d| match self.periods()[d] / SIDE {
            0 => vec![0],
            period => {
                let image = |block: i32| (block - self.min[d] / SIDE).div_euclid(period);
                // What is wider than the world meets all of it once.
                let (from, to) = (image(first[d]), image(last[d]));
                (from..=to.min(from + 1)).map(|image| image * period).collect()
            }
        });
        let [x, y, z] = along;
        x.into_iter().flat_map(move |x| {
            let z = z.clone();
            y.clone().into_iter().flat_map(move |y| z.clone().into_iter().map(move |z| [x, y, z]))
        })
    }

    /// Whether the block lies wholly behind a mirror, where nothing is ever stored.
    pub fn is_behind_mirror(&self, block: [i32; 3]) -> bool {
        (0..3).any(|d| {
            let [low, high] = self.mirrors.kind[d];
            (low != Mirror::Open && (block[d] + 1) * SIDE <= self.min[d])
                || (high != Mirror::Open && block[d] * SIDE >= self.max[d])
        })
    }
}
