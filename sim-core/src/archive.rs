//! The tile archive: ground that an agent has changed, and that is now out of its reach.
//!
//! A tile keeps everything of its particles but their motion. Place, mass, strain and history come back bit for bit,
//! velocity and its gradient as zero. A plane of equal numbers is stored as one number, so a particle of sand in f32
//! takes about 60 bytes.

use crate::snapshot::{Flaw, decode_tile, encode_list};
use crate::{ParticleList, Vec3};
use std::fmt;
use std::sync::Arc;

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
    pub fn pack(mut lists: Vec<ParticleList>) -> Self {
        let mut bytes = Vec::new();
        lists.retain(|list| !list.is_empty());
        for list in &mut lists {
            list.velocity.fill(Vec3::default());
            list.affine.fill([0.0; 9]);
            bytes.extend(encode_list(list));
        }
        Self::of(&lists, bytes)
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

#[cfg(test)]
mod tests {
    use super::*;

    fn list(n: usize) -> ParticleList {
        ParticleList {
            id: (7..7 + n as u64).collect(),
            body: vec![1; n],
            cell: (0..n as i32).map(|i| [i, -i, 3]).collect(),
            offset: (0..n).map(|i| [0.1 * i as f64 % 1.0, 0.25, 0.5]).collect(),
            velocity: vec![[1.0, 2.0, 3.0]; n],
            affine: vec![[4.0; 9]; n],
            mass: vec![0.1; n],
            volume0: (0..n).map(|i| 1e-4 * (1 + i) as f64).collect(),
            strain: vec![vec![0.9; n]; 6],
            state: vec![(0..n).map(|i| -0.0 * i as f64).collect()],
            ..ParticleList::empty(2, 0, 0.16, 6, 1)
        }
    }

    /// What is put away comes back bit for bit, at rest; equal numbers take next to no room.
    #[test]
    fn a_tile_keeps_all_but_motion() {
        let (some, none) = (list(500), list(0));
        let tile = Tile::pack(vec![some.clone(), none]);
        let rest = ParticleList { velocity: vec![[0.0; 3]; 500], affine: vec![[0.0; 9]; 500], ..some };
        let back = tile.unpack();
        assert_eq!(format!("{back:?}"), format!("{:?}", [&rest]));
        assert_eq!((tile.particle_count(), tile.mass()), (500, rest.mass.iter().sum()));
        assert_eq!(Tile::read(tile.packed()).map_err(|_| ()), Ok(tile.clone()));
        // Id, body, cell, offset and rest volume in f64.
        assert!(tile.bytes() < 500 * (8 + 2 + 12 + 24 + 8 + 1) + 300, "{} bytes", tile.bytes());
        let cut = &tile.packed()[..tile.packed().len() / 2];
        assert!(Tile::read(cut).is_err());
    }
}
