//! Walls as mirrors.
//!
//! A wall lies on a cell face. Nodes beyond it mirror the nodes before it. What particles give to a mirrored node is
//! reflected and added to its image, and velocities read there are those of the image, reflected. So the spline's
//! support near a wall is complete, stress at the wall is right, and the wall is exactly where it is drawn. (If nodes
//! outside are set to zero instead, the wall is half a cell soft.)
//!
//! Slip and stick walls are linear, so each block folds its own tile. A wall that lets go of the ground has to see a node's
//! whole momentum first; see [`Separation`].

mod parts;

pub use parts::WallParts;

use crate::block::{TILE, TILE_SIDE, in_tile};
use barchan_lanes::Float;

/// Is told of what walls give: the axis that the wall is across and its end of it, the node behind it, and the impulse [N s].
pub trait Witness {
    /// Takes note.
    fn see(&mut self, wall: (usize, usize), cell: [i32; 3], impulse: [f64; 3]);
}

/// Nobody asks.
impl Witness for () {
    #[inline(always)]
    fn see(&mut self, _: (usize, usize), _: [i32; 3], _: [f64; 3]) {}
}

/// A linear wall at one end of an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mirror {
    /// None.
    #[default]
    Open,
    /// Reflects the normal component.
    Slip,
    /// Reflects all components.
    Stick,
}

impl Mirror {
    /// Sign of each velocity component of the mirror image, for a wall across `axis`.
    fn signs(self, axis: usize) -> [f64; 3] {
        match self {
            Self::Open => [1.0; 3],
            Self::Slip => std::array::from_fn(|d| if d == axis { -1.0 } else { 1.0 }),
            Self::Stick => [-1.0; 3],
        }
    }
}

/// The linear walls of a level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mirrors {
    /// Walls at the least and greatest end of each axis.
    pub kind: [[Mirror; 2]; 3],
    /// First cell inside, per axis.
    pub min: [i32; 3],
    /// One past the last cell inside, per axis.
    pub max: [i32; 3],
}

impl Mirrors {
    /// Of planes of the tile that starts at `origin`, along `axis`: the end of the axis, mirror image, node and signs.
    fn planes(
        &self,
        origin: [i32; 3],
        axis: usize,
    ) -> impl DoubleEndedIterator<Item = (usize, usize, usize, [f64; 3])> {
        let side = TILE_SIDE as i32;
        let [low, high] = self.kind[axis];
        // Twice the wall's position in the tile, in nodes: node i and its image j satisfy i + j = 2 wall - 1.
        let walls =
            [(low, 2 * (self.min[axis] - origin[axis]) - 1, 0), (high, 2 * (self.max[axis] - origin[axis]) - 1, 1)];
        walls.into_iter().filter(|(kind, _, _)| *kind != Mirror::Open).flat_map(move |(kind, sum, end)| {
            (0..side).filter_map(move |image| {
                let node = sum - image;
                let beyond = if end == 0 { image < node } else { image > node };
                (beyond && (0..side).contains(&node)).then(|| (end, image as usize, node as usize, kind.signs(axis)))
            })
        })
    }

    /// Whether any wall crosses the tile that starts at `origin`.
    pub fn meet(&self, origin: [i32; 3]) -> bool {
        (0..3).any(|axis| self.planes(origin, axis).next().is_some())
    }

    /// Folds mass and momentum of mirrored nodes back, and notes the masses in `images`. Returns the impulse that the walls gave
    /// in doing so [N s], of which `witness` is told node by node.
    pub fn fold<T: Float>(
        &self,
        tile: &mut [T; TILE],
        origin: [i32; 3],
        images: &mut Vec<T>,
        witness: &mut impl Witness,
    ) -> [f64; 3] {
        let mut impulse = [0.0; 3];
        images.clear();
        for axis in 0..3 {
            for (end, image, node, signs) in self.planes(origin, axis) {
                let signs_t = signs.map(T::from_f64);
                each_pair(axis, image, node, |image, node| {
                    let mut given = [0.0; 3];
                    for d in 0..3 {
                        let p = tile[image + d];
                        tile[node + d] += signs_t[d] * p;
                        given[d] = (signs[d] - 1.0) * p.to_f64();
                        impulse[d] += given[d];
                        tile[image + d] = T::default();
                    }
                    witness.see((axis, end), cell_in_tile(origin, image), given);
                    let m = tile[image + 3];
                    images.push(m);
                    tile[node + 3] += m;
                    tile[image + 3] = T::default();
                });
            }
        }
        impulse
    }

    /// A cell and its mirror image inside the walls, and which components of a vector there change their sign.
    pub fn reflected(&self, mut cell: [i32; 3]) -> ([i32; 3], [bool; 3]) {
        let mut flipped = [false; 3];
        for axis in 0..3 {
            let [low, high] = self.kind[axis];
            for (kind, beyond, sum) in [
                (low, cell[axis] < self.min[axis], 2 * self.min[axis] - 1),
                (high, cell[axis] >= self.max[axis], 2 * self.max[axis] - 1),
            ] {
                if kind != Mirror::Open && beyond {
                    cell[axis] = sum - cell[axis];
                    for (d, sign) in kind.signs(axis).into_iter().enumerate() {
                        flipped[d] ^= sign < 0.0;
                    }
                }
            }
        }
        (cell, flipped)
    }

    /// Whether the cell lies behind a mirror.
    pub fn is_behind(&self, cell: [i32; 3]) -> bool {
        self.reflected(cell).0 != cell
    }

    /// Gives mirrored nodes the velocity of their images. Returns the impulse that the walls gave in doing so [N s], of which
    /// `witness` is told node by node: what particles read from a mirrored node is not what they would have read from the node itself.
    pub fn unfold<T: Float>(
        &self,
        tile: &mut [T; TILE],
        origin: [i32; 3],
        images: &[T],
        witness: &mut impl Witness,
    ) -> [f64; 3] {
        let mut impulse = [0.0; 3];
        // In reverse, since along an edge the images of one wall are nodes of the next.
        let mut masses = images.rchunks_exact(TILE_SIDE * TILE_SIDE);
        for axis in (0..3).rev() {
            for (end, image, node, signs) in self.planes(origin, axis).rev() {
                let mut plane = masses.next().unwrap_or_default().iter();
                let signs_t = signs.map(T::from_f64);
                each_pair(axis, image, node, |image, node| {
                    let mass = plane.next().map_or(0.0, |m| m.to_f64());
                    let mut given = [0.0; 3];
                    for d in 0..3 {
                        let u = tile[node + d];
                        tile[image + d] = signs_t[d] * u;
                        given[d] = (signs[d] - 1.0) * u.to_f64() * mass;
                        impulse[d] += given[d];
                    }
                    witness.see((axis, end), cell_in_tile(origin, image), given);
                });
            }
        }
        impulse
    }
}

/// The cell of the node whose scalars start at `at` in the tile that starts at `origin`.
#[inline(always)]
fn cell_in_tile(origin: [i32; 3], at: usize) -> [i32; 3] {
    let n = at / 4;
    let local = [n / (TILE_SIDE * TILE_SIDE), n / TILE_SIDE % TILE_SIDE, n % TILE_SIDE];
    std::array::from_fn(|d| origin[d] + local[d] as i32)
}

/// Calls `f` with the starts of each pair of nodes in two planes of a tile across `axis`.
fn each_pair(axis: usize, image: usize, node: usize, mut f: impl FnMut(usize, usize)) {
    for a in 0..TILE_SIDE {
        for b in 0..TILE_SIDE {
            let at = |plane| match axis {
                0 => in_tile(plane, a, b),
                1 => in_tile(a, plane, b),
                _ => in_tile(a, b, plane),
            };
            f(at(image), at(node));
        }
    }
}

/// A wall that keeps the ground from passing but lets it leave, with Coulomb friction.
///
/// A node before the wall and its mirror image behind it are decided together, once the sums of both are known. Pressing: the
/// image's momentum is folded back reflected, as at a slip wall, and friction may take tangential momentum up to `friction`
/// times the normal impulse. Leaving: node and image move together, as if there were no wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Separation {
    /// Axis that the wall is across.
    pub axis: usize,
    /// +1 if inside is towards greater coordinates, -1 otherwise.
    pub inward: f64,
    /// Coefficient of friction.
    pub friction: f64,
}

impl Separation {
    /// The axis that it is across, and the end of it.
    pub fn wall(&self) -> (usize, usize) {
        (self.axis, usize::from(self.inward < 0.0))
    }

    /// Folds the image's momentum and mass into the node's. Returns whether the pair presses on the wall, and the impulse that
    /// the wall gave [N s].
    pub fn fold<T: Float>(&self, node: &mut [T; 4], image: &mut [T; 4]) -> (bool, [f64; 3]) {
        let n = self.axis;
        let (p, q) = (node.map(T::to_f64), image.map(T::to_f64));
        let mut sum: [f64; 4] = std::array::from_fn(|d| p[d] + q[d]);
        *image = [T::default(); 4];
        // A wall pushes or does nothing. Ground that has not reached it gives the image nothing, and is left alone.
        let presses = q[n] * self.inward < 0.0;
        let mut impulse = [0.0; 3];
        if presses {
            let reflected = p[n] - q[n];
            impulse[n] = reflected - sum[n];
            sum[n] = reflected;
            let tangential = (0..3).filter(|&d| d != n).map(|d| sum[d] * sum[d]).sum::<f64>().sqrt();
            if tangential > 0.0 {
                let kept = (1.0 - self.friction * impulse[n].abs() / tangential).max(0.0);
                for d in (0..3).filter(|&d| d != n) {
                    impulse[d] = (kept - 1.0) * sum[d];
                    sum[d] *= kept;
                }
            }
        }
        *node = sum.map(T::from_f64);
        (presses, impulse)
    }

    /// The adjoint of [`fold`](Self::fold) of a node and an image that were as given: from the cotangent of the node's sum to those of both.
    pub fn fold_back(&self, node: &[f64; 4], image: &[f64; 4], cotangent: [f64; 4]) -> [[f64; 4]; 2] {
        let n = self.axis;
        if image[n] * self.inward >= 0.0 {
            return [cotangent; 2];
        }
        let mut back = cotangent;
        let sum: [f64; 3] = std::array::from_fn(|d| if d == n { 0.0 } else { node[d] + image[d] });
        let tangential = sum.iter().map(|p| p * p).sum::<f64>().sqrt();
        let mut pressed = 0.0;
        if tangential > 0.0 {
            // What friction leaves of the sum t is t − 2 μ |q| t / |t|, with the image's momentum q along the axis, or nothing.
            let taken = 2.0 * self.friction * image[n].abs() / tangential;
            let along = (0..3).map(|d| sum[d] * cotangent[d]).sum::<f64>() / tangential;
            for d in (0..3).filter(|&d| d != n) {
                let kept = cotangent[d] - taken * (cotangent[d] - along * sum[d] / tangential);
                back[d] = if taken < 1.0 { kept } else { 0.0 };
            }
            if taken < 1.0 {
                pressed = -2.0 * self.friction * image[n].signum() * along;
            }
        }
        let mut of_image = back;
        of_image[n] = pressed - cotangent[n];
        [back, of_image]
    }

    /// The adjoint of [`unfold`](Self::unfold): what the cotangent of the image's velocity adds to that of the node's.
    pub fn unfold_back(&self, presses: bool, mut cotangent: [f64; 3]) -> [f64; 3] {
        if presses {
            cotangent[self.axis] = -cotangent[self.axis];
        }
        cotangent
    }

    /// Velocity of the image, from the node's, whether the pair presses, and the mass that was folded; and the impulse that the
    /// wall gave in doing so [N s].
    pub fn unfold<T: Float>(&self, node: &[T; 4], presses: bool, mass: f64) -> ([T; 4], [f64; 3]) {
        let mut image = *node;
        let mut impulse = [0.0; 3];
        image[3] = T::default();
        if presses {
            image[self.axis] = -image[self.axis];
            impulse[self.axis] = -2.0 * mass * node[self.axis].to_f64();
        }
        (image, impulse)
    }
}
