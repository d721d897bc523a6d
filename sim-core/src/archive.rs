//! The tile archive: ground that an agent has changed, and that is now out of its reach.
//!
//! A tile keeps everything of its particles but their motion. Number, body, mass and rest volume come back bit for bit, velocity and its gradient as zero. Place,
//! strain and history are rounded to what merging would leave of them, and all is compressed: a particle of sand in f32 takes about 10 bytes, a quarter of which
//! is its place and half its strain.

use crate::material::strain_identity;
use crate::snapshot::{Flaw, decode_tile, encode_tile};
use crate::{ParticleList, Vec3};
use std::fmt;
use std::sync::Arc;

/// To what parts of a cell places are rounded: a 64th of a spacing where eight particles fill a cell.
const PLACE: f64 = 1.0 / 256.0;

/// The particles of one tile, at rest.
#[derive(Clone, PartialEq)]
pub struct Tile {
    particles: u64,
    mass: f64,
    lists: Arc<[u8]>,
}

impl fmt::Debug for Tile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tile").field("particles", &self.particles).field("mass", &self.mass).finish_non_exhaustive()
    }
}

impl Tile {
    /// Packs lists of particles; empty lists are left out.
    pub fn pack(lists: Vec<ParticleList>) -> Self {
        let lists: Vec<ParticleList> = lists.into_iter().filter(|list| !list.is_empty()).map(at_rest).collect();
        Self::of(&lists, encode_tile(&lists))
    }

    fn of(lists: &[ParticleList], bytes: Vec<u8>) -> Self {
        let particles = lists.iter().map(|list| list.len() as u64).sum();
        let mass = lists.iter().flat_map(|list| &list.mass).sum();
        Self { particles, mass, lists: bytes.into() }
    }

    /// The particles, one list per level and material that has any.
    pub fn unpack(&self) -> Vec<ParticleList> {
        decode_tile(&self.lists).unwrap_or_default()
    }

    /// Reads what [`packed`](Self::packed) gave.
    pub(crate) fn read(bytes: &[u8]) -> Result<Self, Flaw> {
        Ok(Self::of(&decode_tile(bytes)?, bytes.to_vec()))
    }

    /// The packed lists.
    pub(crate) fn packed(&self) -> &[u8] {
        &self.lists
    }

    /// Number of particles.
    pub fn particle_count(&self) -> u64 {
        self.particles
    }

    /// Their mass [kg].
    pub fn mass(&self) -> f64 {
        self.mass
    }

    /// Bytes held.
    pub fn bytes(&self) -> u64 {
        self.lists.len() as u64
    }
}

/// A list's particles by their numbers, at rest, with rounded places, strains and histories.
fn at_rest(list: ParticleList) -> ParticleList {
    let mut order: Vec<usize> = (0..list.len()).collect();
    order.sort_unstable_by_key(|&i| list.id[i]);
    let by_number = |plane: &Vec<f64>| order.iter().map(|&i| plane[i]).collect::<Vec<f64>>();
    let mut strain: Vec<Vec<f64>> = list.strain.iter().map(by_number).collect();
    let mut state: Vec<Vec<f64>> = list.state.iter().map(by_number).collect();
    let identity = strain_identity(strain.len());
    let off = |i: usize| strain.iter().zip(identity).map(|(plane, one)| (plane[i] - one).abs()).fold(0.0, f64::max);
    // One step for all: numbers of one kind compress best.
    let step = step_of((0..order.len()).map(off).sum::<f64>() / order.len() as f64);
    for (values, one) in strain.iter_mut().zip(identity) {
        values.iter_mut().for_each(|x| *x = one + rounded(*x - one, step));
    }
    for values in &mut state {
        let step = step_of(values.iter().map(|x| x.abs()).sum::<f64>() / values.len() as f64);
        values.iter_mut().for_each(|x| *x = rounded(*x, step));
    }
    let place = |x: f64| rounded(x, PLACE).min(1.0 - PLACE);
    ParticleList {
        id: order.iter().map(|&i| list.id[i]).collect(),
        body: order.iter().map(|&i| list.body[i]).collect(),
        cell: order.iter().map(|&i| list.cell[i]).collect(),
        offset: order.iter().map(|&i| list.offset[i].map(place)).collect(),
        velocity: vec![Vec3::default(); order.len()],
        affine: vec![[0.0; 9]; order.len()],
        mass: by_number(&list.mass),
        volume0: by_number(&list.volume0),
        strain,
        state,
        ..list
    }
}

/// To what values of this mean size are rounded, a power of two: by no more than 0.8 % of it, nor by more than 3.1e-5 of the larger of it and 1.
fn step_of(size: f64) -> f64 {
    // The exponent of a number's bits, the same on every machine.
    let power = |size: f64| (size.to_bits() >> 52 & 0x7ff) as i64;
    let least = (power(size) - 6).min(power(size.max(1.0)) - 14).max(1);
    f64::from_bits((least as u64) << 52)
}

/// To the nearest multiple of a step; zero has no sign.
fn rounded(x: f64, step: f64) -> f64 {
    (x / step).round() * step + 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Grains in a heap, none like another, in an order of their own.
    fn list(n: usize) -> ParticleList {
        let part = |i: usize, k: usize| (0.618_033_988_7 * (i * (k + 1)) as f64).fract();
        let strain = |k: usize| (0..n).map(|i| f64::from(k < 3) + 0.02 * (part(i, k) - 0.5) * part(i, 9)).collect();
        ParticleList {
            id: (0..n as u64).map(|i| 7 + (i * 37) % n as u64).collect(),
            body: vec![1; n],
            cell: (0..n as i32).map(|i| [i / 64, -(i / 8 % 8), 3]).collect(),
            offset: (0..n).map(|i| [part(i, 2), part(i, 3), 0.9999]).collect(),
            velocity: vec![[1.0, 2.0, 3.0]; n],
            affine: vec![[4.0; 9]; n],
            mass: vec![0.1; n],
            volume0: (0..n).map(|i| 1e-4 * (1 + i % 8) as f64).collect(),
            strain: (0..6).map(strain).collect(),
            state: vec![(0..n).map(|i| if i % 3 == 0 { -0.0 } else { 3.0 * part(i, 5) }).collect()],
            ..ParticleList::empty(2, 0, 0.16, 6, 1)
        }
    }

    /// What is put away comes back at rest, by number: all that the ledger counts bit for bit, the rest as near as is promised. It takes little
    /// room.
    #[test]
    fn a_tile_keeps_all_but_motion() {
        let (some, none) = (list(512), list(0));
        let tile = Tile::pack(vec![some.clone(), none]);
        let [back] = &tile.unpack()[..] else { panic!("a list for each that is not empty") };
        for (i, id) in back.id.iter().enumerate() {
            let j = some.id.iter().position(|other| other == id).unwrap();
            let exact = |list: &ParticleList, i: usize| (list.body[i], list.cell[i], list.mass[i], list.volume0[i]);
            assert_eq!(exact(back, i), exact(&some, j));
            assert_eq!((back.velocity[i], back.affine[i]), ([0.0; 3], [0.0; 9]));
            assert!((0..3).all(|d| (back.offset[i][d] - some.offset[j][d]).abs() <= PLACE && back.offset[i][d] < 1.0));
            assert!((0..6).all(|k| (back.strain[k][i] - some.strain[k][j]).abs() <= 3.1e-5));
            assert!((back.state[0][i] - some.state[0][j]).abs() <= 3.1e-5);
        }
        assert_eq!((tile.particle_count(), tile.mass()), (512, back.mass.iter().sum()));
        assert_eq!(Tile::read(tile.packed()).map_err(|_| ()), Ok(tile.clone()));
        // Most of it is strain and history of grains that have nothing in common.
        assert!(tile.bytes() < 512 * 18, "{} bytes", tile.bytes());
        // Stiff ground is strained less, and kept as well.
        let stiff = |x: f64, k: usize| f64::from(k < 3) + 1e-4 * (x - f64::from(k < 3));
        let mut rock = some.clone();
        (0..6).for_each(|k| rock.strain[k].iter_mut().for_each(|x| *x = stiff(*x, k)));
        let [back] = &Tile::pack(vec![rock.clone()]).unpack()[..] else { panic!("one list") };
        for (i, id) in back.id.iter().enumerate() {
            let j = rock.id.iter().position(|other| other == id).unwrap();
            assert!((0..6).all(|k| (back.strain[k][i] - rock.strain[k][j]).abs() <= 8e-9));
        }
        for cut in [tile.packed().len() / 2, tile.packed().len() - 1] {
            assert!(Tile::read(&tile.packed()[..cut]).is_err());
        }
    }
}
