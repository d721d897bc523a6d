//! Where the world ends on a level.

use crate::block::SIDE;
use crate::wall::{Mirror, Mirrors, Separation};
use barchan_core::Plan;
use barchan_core::scene::Wall;

/// Where the world ends, in cells of one level.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// First cell inside.
    pub min: [i32; 3],
    /// One past the last cell inside.
    pub max: [i32; 3],
    /// Axes whose ends are joined.
    pub periodic: [bool; 3],
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
        Self {
            min,
            max,
            periodic: ends.map(|axis| axis[0] == Wall::Periodic),
            walled: ends.map(|axis| axis.map(|wall| !matches!(wall, Wall::Open | Wall::Periodic))),
            mirrors: Mirrors { kind, min, max },
            separations,
        }
    }

    /// A block's coordinates brought into the world along periodic axes.
    pub fn wrap(&self, mut block: [i32; 3]) -> [i32; 3] {
        for d in 0..3 {
            if self.periodic[d] {
                let (first, count) = (self.min[d] / SIDE, (self.max[d] - self.min[d]) / SIDE);
                block[d] = first + (block[d] - first).rem_euclid(count);
            }
        }
        block
    }

    /// Does the block lie wholly behind a mirror, where nothing is ever stored?
    pub fn is_behind_mirror(&self, block: [i32; 3]) -> bool {
        (0..3).any(|d| {
            let [low, high] = self.mirrors.kind[d];
            (low != Mirror::Open && (block[d] + 1) * SIDE <= self.min[d])
                || (high != Mirror::Open && block[d] * SIDE >= self.max[d])
        })
    }
}
