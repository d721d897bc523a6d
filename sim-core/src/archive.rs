//! The tile archive: ground that an agent has changed and walked away from.
//!
//! A tile keeps everything of its particles but their motion: place, mass, strain and history come back bit for bit, velocity
//! and its gradient as zero. Planes of equal numbers take one number, so that a particle of sand in f32 takes about 60 bytes.

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
    /// Packs lists of particles; those without any are left out.
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

    /// The particles again, one list per level and material that has any.
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
