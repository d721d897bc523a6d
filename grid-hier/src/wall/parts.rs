//! Parts of walls, as probes ask about them.

use super::Witness;
use crate::bounds::Bounds;
use barchan_core::Plan;
use barchan_core::scene::WallPart;

/// The parts of walls that a plan's probes ask about, on one level.
#[derive(Clone, Debug, Default)]
pub struct WallParts {
    parts: Vec<Part>,
    /// The world: first cell, one past the last, and axes whose ends are joined.
    min: [i32; 3],
    max: [i32; 3],
    periodic: [bool; 3],
}

/// A part: the axis that its wall is across, and its end of it; first cell, and one past the last.
#[derive(Clone, Copy, Debug)]
struct Part {
    wall: (usize, usize),
    cells: [[i32; 3]; 2],
}

impl WallParts {
    /// Those of a plan, on a level with these bounds.
    pub fn new(plan: &Plan, level: usize, bounds: &Bounds) -> Self {
        let h = plan.cell_widths[level];
        let part = |(_, part): (usize, WallPart)| {
            // Cells count whose middles lie between the corners.
            let cells = part.corners().map(|corner| corner.map(|x| (x / h - 0.5).ceil() as i32));
            Part { wall: part.side.axis(), cells }
        };
        let parts = plan.scene.wall_parts().map(part).collect();
        Self { parts, min: bounds.min, max: bounds.max, periodic: bounds.periodic }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.parts.len()
    }

    /// Each of them: the axis that its wall is across, and its end of it; the first cell, and one past the last.
    pub fn each(&self) -> impl Iterator<Item = ((usize, usize), [[i32; 3]; 2])> {
        self.parts.iter().map(|part| (part.wall, part.cells))
    }

    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.parts.is_empty()
    }

    /// Takes note of what walls give to the ground, with the sign of what the ground gives to them: a sum for each part [N s].
    pub fn witness<'a>(&'a self, sums: &'a mut [[f64; 3]]) -> impl Witness + 'a {
        Sums { parts: self, sums }
    }

    /// The same of a node that is an image, by its place before all walls and the axes that these turned round. A component is that of the wall
    /// across its axis if that is among them, and of the first of them else.
    pub fn see_image(&self, cell: [i32; 3], turned: [bool; 3], impulse: [f64; 3], sums: &mut [[f64; 3]]) {
        for d in (0..3).filter(|&d| impulse[d] != 0.0) {
            let Some(axis) = [d, 0, 1, 2].into_iter().find(|&axis| turned[axis]) else { continue };
            let end = usize::from(cell[axis] - self.min[axis] > self.max[axis] - 1 - cell[axis]);
            let mut given = [0.0; 3];
            given[d] = impulse[d];
            self.add((axis, end), cell, given, sums);
        }
    }

    fn add(&self, wall: (usize, usize), cell: [i32; 3], impulse: [f64; 3], sums: &mut [[f64; 3]]) {
        for (part, sum) in self.parts.iter().zip(sums).filter(|(part, _)| part.wall == wall) {
            let [first, end] = part.cells;
            let is_in = (0..3).filter(|&d| d != wall.0).all(|d| {
                // What lies behind another wall counts where that begins.
                let at = match self.periodic[d] {
                    true => self.min[d] + (cell[d] - self.min[d]).rem_euclid(self.max[d] - self.min[d]),
                    false => cell[d].clamp(self.min[d], self.max[d] - 1),
                };
                (first[d]..end[d]).contains(&at)
            });
            if is_in {
                (0..3).for_each(|d| sum[d] -= impulse[d]);
            }
        }
    }
}

struct Sums<'a> {
    parts: &'a WallParts,
    sums: &'a mut [[f64; 3]],
}

impl Witness for Sums<'_> {
    fn see(&mut self, wall: (usize, usize), cell: [i32; 3], impulse: [f64; 3]) {
        self.parts.add(wall, cell, impulse, self.sums);
    }
}
