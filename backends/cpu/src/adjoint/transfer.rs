//! The transfers of a step forwards and backwards, cell by cell: particles of one cell share nodes.
//!
//! Nothing here fuses a product with a sum, so that bits are the same on every instruction set.

use super::nodes::{Nodes, Values};
use super::{CpuAdjoint, Deformed, Order, Piece, Step};
use barchan_core::account::BATCH;
use barchan_core::batch::Plane;
use barchan_core::gradient::{Gradient, MOST_STATES};
use barchan_core::{ParticleList, Result, Vec3};
use barchan_grid::block::{self, CELLS};
use barchan_grid::transfer::ENTRIES;
use barchan_grid::transfer::adjoint::{AROUND, Affine, Stencil, Tile};
use barchan_lanes::{Kernel, Lanes};
use rayon::prelude::*;
use std::ops::Range;

/// Particles of a piece that stand in one cell, one behind the other, and the nodes around it.
pub(super) struct Spot {
    /// Their places in the piece.
    particles: Range<usize>,
    /// Numbers of the nodes, z fastest, walls and joined ends seen to.
    nodes: [u32; AROUND],
    /// Which directions a wall mirrors there, a bit each.
    flipped: [u8; AROUND],
}

impl Spot {
    /// What a node holds as the wall shows it, or what it is given through the wall.
    #[inline(always)]
    fn mirrored(&self, n: usize, [x, y, z, other]: [f64; 4]) -> [f64; 4] {
        let sign = |bit: u8| if self.flipped[n] >> bit & 1 == 1 { -1.0 } else { 1.0 };
        [sign(0) * x, sign(1) * y, sign(2) * z, other]
    }

    /// What nodes hold, whose blocks have other numbers there.
    #[inline(always)]
    fn tile(&self, nodes: &Nodes, blocks: &[usize]) -> Tile {
        std::array::from_fn(|n| {
            let node = self.nodes[n] as usize;
            self.mirrored(n, nodes.values[blocks[node / CELLS]][node % CELLS])
        })
    }

    /// Adds to nodes.
    #[inline(always)]
    fn give(&self, tile: &Tile, nodes: &mut Values) {
        for (n, given) in tile.iter().enumerate() {
            let node = self.nodes[n] as usize;
            let sums = nodes[node / CELLS][node % CELLS].iter_mut();
            sums.zip(self.mirrored(n, *given)).for_each(|(sum, given)| *sum += given);
        }
    }
}

/// How a piece gave to nodes.
pub(super) struct Forward {
    spots: Vec<Spot>,
    deformed: Deformed,
}

/// Pieces that give to the same nodes, of their own.
pub(super) struct Group<'a> {
    pub(super) pieces: &'a [Piece<'a>],
    forwards: Vec<Forward>,
    pub(super) nodes: Nodes,
}

/// All that goes back from a piece: to its particles, to its law's parameters, to gravity.
pub(super) struct Given {
    pub(super) position: Vec<Vec3>,
    pub(super) velocity: Vec<Vec3>,
    pub(super) affine: Vec<[f64; 9]>,
    pub(super) strain: Vec<Plane<f64, BATCH>>,
    pub(super) state: Vec<Plane<f64, BATCH>>,
    pub(super) parameters: Vec<f64>,
    pub(super) gravity: Vec3,
}

/// The momentum that a particle gives, and by how much it grows a cell: m (v + dt g), and m h C − 4 dt V τ / h.
#[inline(always)]
fn momentum(list: &ParticleList, p: usize, tau: [f64; 6], step: &Step) -> Affine {
    let h = list.cell_width;
    let [m, stress] = [list.mass[p], -4.0 * step.dt / h * list.volume0[p]];
    let [xx, yy, zz, xy, xz, yz] = tau;
    let full = [xx, xy, xz, xy, yy, yz, xz, yz, zz];
    Affine {
        at: std::array::from_fn(|d| m * (list.velocity[p][d] + step.dt * step.gravity[d])),
        rows: std::array::from_fn(|e| m * h * list.affine[p][e] + stress * full[e]),
    }
}

/// P2G of a piece.
struct Give<'a> {
    piece: &'a Piece<'a>,
    forward: &'a Forward,
    step: &'a Step,
    nodes: &'a mut Values,
}

impl Kernel<f64> for Give<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) {
        let Self { piece: Piece { list, first, .. }, forward, step, nodes } = self;
        for spot in &forward.spots {
            let mut tile = [[0.0; 4]; AROUND];
            for i in spot.particles.clone() {
                let p = first + i;
                let gives = momentum(list, p, forward.deformed.stress(i), step);
                Stencil::new(list.offset[p], list.cell_width).scatter(&gives, list.mass[p], &mut tile);
            }
            spot.give(&tile, nodes);
        }
    }
}

/// G2P of a piece backwards: what its particles owe to nodes, which `owed` takes, and to where they read.
struct Read<'a> {
    piece: &'a Piece<'a>,
    spots: &'a [Spot],
    velocities: (&'a Nodes, &'a [usize]),
    dt: f64,
    gradient: &'a Gradient,
    owed: &'a mut Values,
}

impl Kernel<f64> for Read<'_> {
    type Output = Vec<Vec3>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> Vec<Vec3> {
        let Self { piece, spots, velocities, dt, gradient, owed } = self;
        let (list, after) = (piece.list, &gradient.particles);
        let mut back = Vec::with_capacity(piece.count);
        for spot in spots {
            let (seen, mut given) = (spot.tile(velocities.0, velocities.1), [[0.0; 4]; AROUND]);
            for i in spot.particles.clone() {
                let number = piece.number[i] as usize;
                let position = after.position[number];
                // What the new velocity does to the loss by itself, and by the move.
                let at = std::array::from_fn(|d| after.velocity[number][d] + dt * position[d]);
                let cotangent = Affine { at, rows: after.affine[number] };
                let stencil = Stencil::new(list.offset[piece.first + i], list.cell_width);
                let moved = stencil.gather_back(list.cell_width, &cotangent, &seen, &mut given);
                back.push(std::array::from_fn(|d| position[d] + moved[d]));
            }
            spot.give(&given, owed);
        }
        back
    }
}

/// P2G of a piece backwards: to its particles, and what is owed to their stress.
struct GiveBack<'a> {
    piece: &'a Piece<'a>,
    forward: &'a Forward,
    owed: (&'a Nodes, &'a [usize]),
    step: &'a Step,
    given: &'a mut Given,
}

impl Kernel<f64> for GiveBack<'_> {
    type Output = [Plane<f64, BATCH>; 6];

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> [Plane<f64, BATCH>; 6] {
        let Self { piece: Piece { list, first, .. }, forward, owed, step, given } = self;
        let h = list.cell_width;
        let mut kirchhoff = [Plane::default(); 6];
        for spot in &forward.spots {
            let tile = spot.tile(owed.0, owed.1);
            for i in spot.particles.clone() {
                let p = first + i;
                let (mass, gave) = (list.mass[p], momentum(list, p, forward.deformed.stress(i), step));
                let (of, moved) = Stencil::new(list.offset[p], h).scatter_back(h, &gave, mass, &tile);
                for d in 0..3 {
                    given.position[i][d] += moved[d];
                    given.gravity[d] += mass * step.dt * step.grown * of.at[d];
                }
                given.velocity.push(of.at.map(|v| mass * v));
                given.affine.push(of.rows.map(|a| mass * h * a));
                let stress = -4.0 * step.dt / h * list.volume0[p];
                for (plane, (row, column)) in kirchhoff.iter_mut().zip(ENTRIES) {
                    let other = if row == column { 0.0 } else { of.rows[3 * column + row] };
                    plane.0[i] = stress * (of.rows[3 * row + column] + other);
                }
            }
        }
        kirchhoff
    }
}

impl CpuAdjoint {
    /// Where the particles of a piece stand among the nodes, whose blocks are made if there are none.
    fn spots(&self, piece: &Piece<'_>, nodes: &mut Nodes) -> Vec<Spot> {
        let bounds = &self.grids[piece.list.level as usize].bounds;
        let (mut spots, mut start) = (Vec::new(), 0);
        let (mut last, mut numbers) = (None, [0; AROUND]);
        for same in piece.list.cell[piece.first..][..piece.count].chunk_by(|a, b| a == b) {
            // Along each axis: the cell of each node, and the signs that a wall gives its directions.
            let along: [[(i32, [bool; 3]); 3]; 3] = std::array::from_fn(|d| {
                std::array::from_fn(|i| {
                    let mut cell = [bounds.min[0], bounds.min[1], bounds.min[2]];
                    cell[d] = same[0][d] + i as i32 - 1;
                    let (reflected, flipped) = bounds.mirrors.reflected(cell);
                    (reflected[d], flipped)
                })
            });
            let blocks = along.map(|axis| axis.map(|(cell, _)| cell >> 2));
            if last != Some(blocks) {
                for (n, number) in numbers.iter_mut().enumerate() {
                    *number = nodes.block(bounds.wrap([blocks[0][n / 9], blocks[1][n / 3 % 3], blocks[2][n % 3]]));
                }
                last = Some(blocks);
            }
            let end = start + same.len();
            let mut spot = Spot { particles: start..end, nodes: [0; AROUND], flipped: [0; AROUND] };
            for n in 0..AROUND {
                let at = [along[0][n / 9], along[1][n / 3 % 3], along[2][n % 3]];
                spot.nodes[n] = (numbers[n] * CELLS + block::place(at.map(|(cell, _)| cell))) as u32;
                for (_, flipped) in at {
                    (0..3).for_each(|d| spot.flipped[n] ^= u8::from(flipped[d]) << d);
                }
            }
            spots.push(spot);
            start = end;
        }
        spots
    }

    /// P2G of a level.
    pub(super) fn give_level<'a>(&self, pieces: &'a [Piece<'a>], step: &Step) -> Result<Vec<Group<'a>>> {
        pieces.par_chunks(super::PIECES).map(|pieces| self.give_all(pieces, step)).collect()
    }

    /// P2G of some pieces.
    fn give_all<'a>(&self, pieces: &'a [Piece<'a>], step: &Step) -> Result<Group<'a>> {
        let mut nodes = Nodes::default();
        let give = |piece: &Piece<'_>| {
            let forward = Forward { spots: self.spots(piece, &mut nodes), deformed: self.deform(piece, step)? };
            self.isa.run(Give { piece, forward: &forward, step, nodes: &mut nodes.values });
            Ok(forward)
        };
        let forwards = pieces.iter().map(give).collect::<Result<_>>()?;
        Ok(Group { pieces, forwards, nodes })
    }

    /// G2P of a group backwards: what its particles owe to its nodes, and to where they are, piece by piece.
    pub(super) fn read_back(
        &self,
        group: &Group<'_>,
        velocities: &Nodes,
        dt: f64,
        gradient: &Gradient,
    ) -> (Values, Vec<Vec<Vec3>>) {
        let blocks = velocities.numbers_of(&group.nodes);
        let mut owed = vec![[[0.0; 4]; CELLS]; group.nodes.keys.len()];
        let of_piece = |(piece, forward): (&Piece<'_>, &Forward)| {
            let (spots, velocities) = (&forward.spots[..], (velocities, &blocks[..]));
            self.isa.run(Read { piece, spots, velocities, dt, gradient, owed: &mut owed })
        };
        let positions = group.pieces.iter().zip(&group.forwards).map(of_piece).collect();
        (owed, positions)
    }

    /// P2G of a group backwards, and its laws. `positions` are what is owed to these so far.
    pub(super) fn give_back(
        &self,
        group: &Group<'_>,
        owed: &Nodes,
        step: &Step,
        gradient: &Gradient,
        positions: Vec<Vec<Vec3>>,
    ) -> Result<Vec<Given>> {
        let blocks = owed.numbers_of(&group.nodes);
        let of_piece = |((piece, forward), position): ((&Piece<'_>, &Forward), Vec<Vec3>)| {
            let mut given = Given {
                position,
                velocity: Vec::with_capacity(piece.count),
                affine: Vec::with_capacity(piece.count),
                strain: Vec::new(),
                state: Vec::new(),
                parameters: Vec::new(),
                gravity: [0.0; 3],
            };
            let owed = (owed, &blocks[..]);
            let kirchhoff = self.isa.run(GiveBack { piece, forward, owed, step, given: &mut given });
            self.deform_back(piece, &forward.deformed, step, gradient, kirchhoff, &mut given)?;
            Ok(given)
        };
        group.pieces.iter().zip(&group.forwards).zip(positions).map(of_piece).collect()
    }
}

/// What goes back to particles, parameters and gravity, piece by piece in the order of lists.
pub(super) fn take_in(gradient: &mut Gradient, order: &Order, pieces: &[Piece<'_>], given: &[Given]) {
    // Where each list's pieces begin.
    let mut starts = vec![0; order.numbers.len()];
    for (k, (piece, given)) in pieces.iter().zip(given).enumerate() {
        if piece.first == 0 {
            starts[piece.of] = k;
        }
        let sums = &mut gradient.parameters[piece.list.material as usize];
        sums.iter_mut().zip(&given.parameters).for_each(|(sum, own)| *sum += own);
        (0..3).for_each(|d| gradient.gravity[d] += given.gravity[d]);
    }
    let particles = &mut gradient.particles;
    let all = (
        &order.places,
        &mut particles.position,
        &mut particles.velocity,
        &mut particles.affine,
        &mut particles.strain,
        &mut particles.state,
    );
    all.into_par_iter().with_min_len(BATCH).for_each(|(&(list, i), position, velocity, affine, strain, state)| {
        let (piece, i) = (&given[starts[list as usize] + i as usize / BATCH], i as usize % BATCH);
        (*position, *velocity, *affine) = (piece.position[i], piece.velocity[i], piece.affine[i]);
        *strain = super::values(&piece.strain, i);
        *state = [0.0; MOST_STATES];
        state.iter_mut().zip(&piece.state).for_each(|(to, plane)| *to = plane.0[i]);
    });
}
