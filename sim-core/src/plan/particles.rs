//! Whether particles that come in fit a plan, and what memory they take.

use super::{Plan, Precision};
use crate::{Error, ParticleList, ParticleState, Result};
use std::collections::HashSet;

/// What errors about particles that do not fit a plan name as their place.
pub(crate) const PARTICLES: &str = "particles";

/// Resident bytes of one occupied block of 4³ cells in f32: its nodes with their halo, and bookkeeping.
const BLOCK_BYTES: u64 = 9 * 1024;

/// Cells further from the origin than any backend reaches; coordinates up to here can be added without overflow.
pub(crate) const FARTHEST_CELL: u32 = 1 << 30;

impl Plan {
    /// Holds particles that come from outside to the shape that every backend relies on: one list a material, planes of
    /// equal length and of the material's number, cells within reach, offsets inside the cell. Numbers may be anything else;
    /// a step finds those that are not finite.
    pub(crate) fn check_particles(&self, particles: &ParticleState) -> Result<()> {
        let refuse = |what: String| {
            Err(Error::Body {
                path: PARTICLES.to_owned(),
                what,
                mend: "use particles of a simulation of the same scene".to_owned(),
            })
        };
        let (levels, materials) = (self.cell_widths.len(), self.materials.len());
        if particles.lists.len() != levels * materials {
            return refuse(format!(
                "{} lists where the plan has {materials} materials on {levels} levels",
                particles.lists.len()
            ));
        }
        if let Some(phase) = &particles.levels {
            self.regions.check(phase).or_else(refuse)?;
        }
        if let Some(tile) = particles.archive.keys().find(|tile| !self.regions.is_tile_of_world(**tile)) {
            return refuse(format!("tile {tile:?} of the archive lies outside the world"));
        }
        if let Some(sort) = particles.sort.as_ref().filter(|sort| sort.rest.len() != sort.blocks.len()) {
            return refuse(format!("{} blocks of which {} say whether they sleep", sort.blocks.len(), sort.rest.len()));
        }
        if let Some(sort) =
            particles.sort.as_ref().filter(|sort| [sort.drift.len(), sort.kept_for.len()] != [levels; 2])
        {
            return refuse(format!("a sort of {} levels where the plan has {levels}", sort.drift.len()));
        }
        if let Some(kept) = &particles.kept {
            let fits = |(words, list): (&Vec<u32>, &ParticleList)| match list.len() {
                0 => words.is_empty(),
                count => words.len().is_multiple_of(count),
            };
            if kept.len() != particles.lists.len() || !kept.iter().zip(&particles.lists).all(fits) {
                return refuse("what the backend keeps besides is not of these particles".to_owned());
            }
        }
        for (i, list) in particles.lists.iter().enumerate() {
            let (level, material) = (i / materials, i % materials);
            if (list.level as usize, list.material as usize) != (level, material) {
                return refuse(format!("list {i} is of level {} and material {}", list.level, list.material));
            }
            self.check_list(&format!("list {i}"), list).or_else(refuse)?;
        }
        if self.terrain.is_some() && particles.levels.as_ref().is_none_or(|phase| phase.live.is_empty()) {
            return refuse("nothing says which tiles are live".to_owned());
        }
        for (tile, archived) in &particles.archive {
            for list in archived.unpack() {
                self.check_list(&format!("a list of tile {tile:?}"), &list).or_else(refuse)?;
            }
        }
        Ok(())
    }

    /// What is wrong with the shape of a list.
    fn check_list(&self, name: &str, list: &ParticleList) -> Result<(), String> {
        let width = self.cell_widths.get(list.level as usize);
        let (Some(planned), 0, true) =
            (self.materials.get(list.material as usize), list.world, width == Some(&list.cell_width))
        else {
            return Err(format!(
                "{name} is of world {}, level {} with cells of {} m and material {}",
                list.world, list.level, list.cell_width, list.material
            ));
        };
        let (law, n) = (&planned.material, list.len());
        if list.strain.len() != law.strain_planes() || list.state.len() != law.states.len() {
            return Err(format!(
                "{name} has {} strain and {} history planes where its material has {} and {}",
                list.strain.len(),
                list.state.len(),
                law.strain_planes(),
                law.states.len()
            ));
        }
        let planes = list.strain.iter().chain(&list.state).chain([&list.mass, &list.volume0]).map(Vec::len);
        let rows = [list.body.len(), list.cell.len(), list.offset.len(), list.velocity.len(), list.affine.len()];
        if let Some(length) = planes.chain(rows).find(|length| *length != n) {
            return Err(format!("{name} has {n} ids and a plane of {length} entries"));
        }
        let lost = list.cell.iter().flatten().position(|c| c.unsigned_abs() > FARTHEST_CELL);
        let outside = list.offset.iter().flatten().position(|x| !(0.0..1.0).contains(x));
        if let Some(at) = lost.or(outside) {
            let (cell, offset) = (list.cell[at / 3], list.offset[at / 3]);
            return Err(format!("particle {} is in cell {cell:?} at offset {offset:?}", list.id[at / 3]));
        }
        Ok(())
    }

    pub(super) fn estimate_memory(&self, particles: &ParticleState) -> (u64, u64) {
        let mut bytes = 0;
        let mut blocks = HashSet::new();
        for list in &particles.lists {
            bytes += list.len() as u64 * self.materials[list.material as usize].particle_bytes(self.precision);
            let mut last = None;
            for cell in &list.cell {
                let block = Some((list.level, cell.map(|c| c >> 2)));
                if block != last {
                    blocks.insert(block);
                    last = block;
                }
            }
        }
        let width = if self.precision == Precision::F32 { 1 } else { 2 };
        (bytes, blocks.len() as u64 * BLOCK_BYTES * width)
    }
}
