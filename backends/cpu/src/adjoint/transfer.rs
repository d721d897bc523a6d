//! The transfers of a step forwards and backwards, cell by cell: particles of one cell share nodes, and as many as there are lanes are worked on together.

use super::nodes::{Nodes, Values};
use super::{CpuAdjoint, Deformed, Order, Piece, Step};
use barchan_core::account::BATCH;
use barchan_core::batch::Plane;
use barchan_core::gradient::{Gradient, MOST_STATES};
use barchan_core::{Result, Vec3};
use barchan_grid::block::{self, CELLS};
use barchan_grid::transfer::adjoint::{AROUND, Affine, Stencil, Tile, deformed_back, sum_lanes};
use barchan_grid::transfer::{ENTRIES, deformed};
use barchan_lanes::{CHUNK, Kernel, Lanes, tabulate};
use rayon::prelude::*;
use std::ops::Range;

/// Particles of a piece that stand in one cell, one behind the other, and the nodes around it.
pub(super) struct Spot {
    /// Their places in the piece.
    particles: Range<usize>,
    /// Numbers of the nodes, z fastest, walls and joined ends seen to.
    nodes: [u32; AROUND],
    /// Which directions a wall mirrors there, a bit each, and is there any?
    flipped: [u8; AROUND],
    flips: bool,
}

impl Spot {
    /// What a node holds as the wall shows it, or what it is given through the wall.
    #[inline(always)]
    fn mirror(&self, tile: &mut Tile<f64>) {
        if self.flips {
            for (node, flipped) in tile.iter_mut().zip(self.flipped) {
                for (d, value) in node[..3].iter_mut().enumerate() {
                    *value = if flipped >> d & 1 == 1 { -*value } else { *value };
                }
            }
        }
    }

    /// What nodes hold, whose blocks have other numbers there.
    #[inline(always)]
    fn tile(&self, nodes: &Nodes, blocks: &[usize]) -> Tile<f64> {
        let mut tile = [[0.0; 4]; AROUND];
        for (held, node) in tile.iter_mut().zip(self.nodes) {
            *held = nodes.values[blocks[node as usize / CELLS]][node as usize % CELLS];
        }
        self.mirror(&mut tile);
        tile
    }

    /// Adds to nodes.
    #[inline(always)]
    fn give(&self, mut tile: Tile<f64>, nodes: &mut Values) {
        self.mirror(&mut tile);
        for (given, node) in tile.iter().zip(self.nodes) {
            let sums = &mut nodes[node as usize / CELLS][node as usize % CELLS];
            for c in 0..4 {
                sums[c] += given[c];
            }
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

/// Numbers of up to as many particles as there are lanes, 0 in those that are left.
#[inline(always)]
fn lanes<V: Lanes<Scalar = f64>, const N: usize>(count: usize, of: impl Fn(usize) -> [f64; N]) -> [V; N] {
    let mut planes = [[0.0; CHUNK]; N];
    for lane in 0..count {
        for (plane, value) in planes.iter_mut().zip(of(lane)) {
            plane[lane] = value;
        }
    }
    tabulate!(N, |c| V::read(&planes[c]))
}

/// The numbers of some lanes, one after the other.
#[inline(always)]
fn each<V: Lanes<Scalar = f64>, const N: usize>(values: &[V; N]) -> impl Iterator<Item = [f64; N]> {
    let mut planes = [[0.0; CHUNK]; N];
    for (plane, value) in planes.iter_mut().zip(values) {
        value.write(plane);
    }
    (0..V::COUNT).map(move |lane| {
        let mut own = [0.0; N];
        own.iter_mut().zip(&planes).for_each(|(own, plane)| *own = plane[lane]);
        own
    })
}

/// What some particles of a spot give to nodes.
struct Gives<V> {
    stencil: Stencil<V>,
    mass: V,
    /// Momentum, and by how much it grows a cell: m (v + dt g), and m h C − 4 dt V τ / h.
    momentum: Affine<V>,
    /// −4 dt V / h.
    by_stress: V,
}

impl<V: Lanes<Scalar = f64>> Gives<V> {
    /// Of so many particles from place `i` of a piece on.
    #[inline(always)]
    fn of(piece: &Piece<'_>, forward: &Forward, step: &Step, i: usize, count: usize) -> Self {
        let (list, p) = (piece.list, piece.first + i);
        let h = list.cell_width;
        let [mass, volume]: [V; 2] = lanes(count, |k| [list.mass[p + k], list.volume0[p + k]]);
        let velocity: [V; 3] = lanes(count, |k| list.velocity[p + k]);
        let affine: [V; 9] = lanes(count, |k| list.affine[p + k]);
        let [xx, yy, zz, xy, xz, yz]: [V; 6] = lanes(count, |k| forward.deformed.stress(i + k));
        let stress: [V; 9] = [xx, xy, xz, xy, yy, yz, xz, yz, zz];
        let (by_stress, by_affine) = (volume * V::fill(-4.0 * step.dt / h), mass * V::fill(h));
        let momentum = Affine {
            at: tabulate!(3, |d| mass * (velocity[d] + V::fill(step.dt * step.gravity[d]))),
            rows: tabulate!(9, |e| by_affine.mul_add(affine[e], by_stress * stress[e])),
        };
        Self { stencil: Stencil::new(lanes(count, |k| list.offset[p + k]), h), mass, momentum, by_stress }
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
        let Self { piece, forward, step, nodes } = self;
        for spot in &forward.spots {
            let mut tile = [[V::zero(); 4]; AROUND];
            for i in spot.particles.clone().step_by(V::COUNT) {
                let count = (spot.particles.end - i).min(V::COUNT);
                let gives = Gives::<V>::of(piece, forward, step, i, count);
                gives.stencil.scatter(&gives.momentum, gives.mass, &mut tile);
            }
            spot.give(sum_lanes(&tile), nodes);
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
            let (seen, mut given) = (spot.tile(velocities.0, velocities.1), [[V::zero(); 4]; AROUND]);
            for i in spot.particles.clone().step_by(V::COUNT) {
                let count = (spot.particles.end - i).min(V::COUNT);
                let numbers = &piece.number[i..][..count];
                let position: [V; 3] = lanes(count, |k| after.position[numbers[k] as usize]);
                let velocity: [V; 3] = lanes(count, |k| after.velocity[numbers[k] as usize]);
                // What the new velocity does to the loss by itself, and by the move.
                let cotangent = Affine {
                    at: tabulate!(3, |d| V::fill(dt).mul_add(position[d], velocity[d])),
                    rows: lanes(count, |k| after.affine[numbers[k] as usize]),
                };
                let stencil = Stencil::new(lanes(count, |k| list.offset[piece.first + i + k]), list.cell_width);
                let moved = stencil.gather_back(list.cell_width, &cotangent, &seen, &mut given);
                back.extend(each(&tabulate!(3, |d| position[d] + moved[d])).take(count));
            }
            spot.give(sum_lanes(&given), owed);
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
        let Self { piece, forward, owed, step, given } = self;
        let h = piece.list.cell_width;
        let (mut kirchhoff, mut gravity) = ([Plane::default(); 6], [V::zero(); 3]);
        for spot in &forward.spots {
            let tile = spot.tile(owed.0, owed.1);
            for i in spot.particles.clone().step_by(V::COUNT) {
                let count = (spot.particles.end - i).min(V::COUNT);
                let Gives { stencil, mass, momentum, by_stress } = Gives::<V>::of(piece, forward, step, i, count);
                let (of, moved) = stencil.scatter_back(h, &momentum, mass, &tile);
                let of_velocity: [V; 3] = tabulate!(3, |d| mass * of.at[d]);
                let of_affine: [V; 9] = tabulate!(9, |e| mass * V::fill(h) * of.rows[e]);
                let of_stress: [V; 6] = tabulate!(6, |c| {
                    let (row, column) = ENTRIES[c];
                    let one = of.rows[3 * row + column];
                    by_stress * if row == column { one } else { one + of.rows[3 * column + row] }
                });
                for (sum, own) in gravity.iter_mut().zip(of_velocity) {
                    *sum += own;
                }
                given.velocity.extend(each(&of_velocity).take(count));
                given.affine.extend(each(&of_affine).take(count));
                for (position, moved) in given.position[i..][..count].iter_mut().zip(each(&moved)) {
                    (0..3).for_each(|d| position[d] += moved[d]);
                }
                for (k, stress) in (i..i + count).zip(each(&of_stress)) {
                    kirchhoff.iter_mut().zip(stress).for_each(|(plane, stress)| plane.0[k] = stress);
                }
            }
        }
        for (sum, own) in given.gravity.iter_mut().zip(gravity) {
            *sum += step.dt * step.grown * own.sum();
        }
        kirchhoff
    }
}

/// Trial strain of a piece: what G = dt C makes of its strain.
pub(super) struct Try<'a> {
    pub(super) dt: f64,
    pub(super) vel_grad: &'a [Plane<f64, BATCH>; 9],
    pub(super) strain: &'a [Plane<f64, BATCH>],
}

/// As many values of planes as there are lanes, from place `i` on.
#[inline(always)]
fn at<V: Lanes<Scalar = f64>>(planes: &[Plane<f64, BATCH>], i: usize) -> [V; 9] {
    let mut values = [V::zero(); 9];
    for (value, plane) in values.iter_mut().zip(planes) {
        *value = V::read(&plane.0[i..]);
    }
    values
}

/// The reverse of [`at`].
#[inline(always)]
fn put<V: Lanes<Scalar = f64>>(values: &[V; 9], planes: &mut [Plane<f64, BATCH>], i: usize) {
    for (value, plane) in values.iter().zip(planes) {
        value.write(&mut plane.0[i..]);
    }
}

impl Kernel<f64> for Try<'_> {
    type Output = Vec<Plane<f64, BATCH>>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> Self::Output {
        let (planes, mut trial) = (self.strain.len(), vec![Plane::default(); self.strain.len()]);
        for i in (0..BATCH).step_by(V::COUNT) {
            let (rates, own) = (at::<V>(self.vel_grad, i), at::<V>(self.strain, i));
            put(&deformed(&tabulate!(9, |c| rates[c] * V::fill(self.dt)), &own[..planes]), &mut trial, i);
        }
        trial
    }
}

/// The adjoint of [`Try`]: returns what is owed to the strain, and adds to `of_rates`.
pub(super) struct TryBack<'a> {
    pub(super) given: Try<'a>,
    pub(super) of_trial: &'a [Plane<f64, BATCH>],
    pub(super) of_rates: &'a mut [Plane<f64, BATCH>; 9],
}

impl Kernel<f64> for TryBack<'_> {
    type Output = Vec<Plane<f64, BATCH>>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> Self::Output {
        let Self { given: Try { dt, vel_grad, strain }, of_trial, of_rates } = self;
        let (planes, mut of_strain) = (strain.len(), vec![Plane::default(); strain.len()]);
        for i in (0..BATCH).step_by(V::COUNT) {
            let (rates, own, owed) = (at::<V>(vel_grad, i), at::<V>(strain, i), at::<V>(of_trial, i));
            let motion = tabulate!(9, |c| rates[c] * V::fill(dt));
            let mut of_motion = [V::zero(); 9];
            put(&deformed_back(&motion, &own[..planes], &owed[..planes], &mut of_motion), &mut of_strain, i);
            let so_far = at::<V>(of_rates, i);
            put(&tabulate!(9, |c| V::fill(dt).mul_add(of_motion[c], so_far[c])), of_rates, i);
        }
        of_strain
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
                // Where along an axis the block of a node comes first: few of them are not the same.
                let first = blocks.map(|axis| axis.map(|block| axis.iter().position(|other| *other == block)));
                for n in 0..AROUND {
                    let at = [n / 9, n / 3 % 3, n % 3];
                    let same = (0..3).fold(0, |number, d| 3 * number + first[d][at[d]].unwrap_or(at[d]));
                    numbers[n] = if same < n {
                        numbers[same]
                    } else {
                        nodes.block(bounds.wrap([blocks[0][at[0]], blocks[1][at[1]], blocks[2][at[2]]]))
                    };
                }
                last = Some(blocks);
            }
            let end = start + same.len();
            let flips = along.iter().flatten().any(|(_, flipped)| flipped.contains(&true));
            let mut spot = Spot { particles: start..end, nodes: [0; AROUND], flipped: [0; AROUND], flips };
            for n in 0..AROUND {
                let at = [along[0][n / 9], along[1][n / 3 % 3], along[2][n % 3]];
                spot.nodes[n] = (numbers[n] * CELLS + block::place(at.map(|(cell, _)| cell))) as u32;
                if spot.flips {
                    for (_, flipped) in at {
                        (0..3).for_each(|d| spot.flipped[n] ^= u8::from(flipped[d]) << d);
                    }
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
