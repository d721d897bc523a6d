//! Particles copied to the host.

pub(crate) mod account;
pub(crate) mod faults;

use crate::device::layout::{self, Homes, Planes};
use crate::device::memory::{read, read_all};
use crate::passes::binding::Sorted;
use crate::worlds::WgpuBatch;
use crate::worlds::world::Level;
use barchan_core::{Measured, ParticleList, ParticleState, Result, SortPhase, Spot};
use barchan_grid::archive::Reach;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// How a level lies in memory.
pub(crate) type Laid = (Homes, Planes<'static>);

impl WgpuBatch {
    /// Homes of some worlds' levels as the device has them, the particles of each counted from its first one.
    pub(crate) fn homes(&self, worlds: Range<usize>) -> Result<Vec<Homes>> {
        let levels: Vec<&Level> = self.worlds[worlds].iter().flat_map(|world| &world.levels).collect();
        let start = levels.first().map_or(0, |level| level.blocks.start);
        let count = levels.last().map_or(0, |level| level.blocks.end) - start;
        let at = (16 * layout::ENTRY * start) as u64;
        let entries: Vec<[i32; 4]> = read(&self.gpu, self.memory.plane(Sorted::Lists), at, count * layout::ENTRY)?;
        let cells: Vec<u32> = read(&self.gpu, self.memory.plane(Sorted::Cells), 256 * start as u64, 64 * count + 1)?;
        let of_level = |level: &&Level| {
            let own = level.blocks.start - start..level.blocks.end - start;
            let blocks = entries[own.start * layout::ENTRY..own.end * layout::ENTRY].chunks_exact(layout::ENTRY);
            let mut cells = if own.is_empty() { vec![0] } else { cells[64 * own.start..=64 * own.end].to_vec() };
            if !own.is_empty() {
                cells.iter_mut().for_each(|slot| *slot -= level.particles.start as u32);
            }
            Homes { blocks: blocks.map(|e| [e[0][0], e[0][1], e[0][2]]).collect(), cells, ..Homes::default() }
        };
        Ok(levels.iter().map(of_level).collect())
    }

    /// All particles of a world: one list a level and material; and how each level lies in memory.
    pub(crate) fn lists(&self, w: usize) -> Result<(Vec<ParticleList>, Vec<Laid>)> {
        let world = &self.worlds[w];
        let (mut lists, mut laid) = (Vec::new(), Vec::new());
        for (l, (level, homes)) in world.levels.iter().zip(self.homes(w..w + 1)?).enumerate() {
            let planes = self.planes(level)?;
            let of_level = (l, level.h);
            lists.extend(planes.lists(&homes.places(), &world.materials, of_level, level.particles.len()));
            laid.push((homes, planes));
        }
        Ok((lists, laid))
    }

    /// The particles of a world for which `wanted` holds, likewise.
    pub(crate) fn lists_where(&self, w: usize, wanted: &(dyn Fn(&Spot) -> bool + Sync)) -> Result<ParticleState> {
        let world = &self.worlds[w];
        let mut lists = Vec::new();
        for (l, (level, homes)) in world.levels.iter().zip(self.homes(w..w + 1)?).enumerate() {
            let (planes, count) = (self.planes(level)?, level.particles.len());
            let is_wanted = |&(q, block): &(usize, [i32; 3])| wanted(&planes.spot(q, block, level.h, count));
            let places: Vec<_> = homes.places().into_par_iter().filter(is_wanted).collect();
            lists.extend(planes.lists(&places, &world.materials, (l, level.h), count));
        }
        Ok(ParticleState { lists, levels: world.phase(), ..ParticleState::default() })
    }

    /// Where each particle of a world is and how large, in the order of [`lists`](Self::lists).
    pub(crate) fn spots(&self, w: usize) -> Result<Vec<Spot>> {
        let world = &self.worlds[w];
        let mut spots = Vec::new();
        for (level, homes) in world.levels.iter().zip(self.homes(w..w + 1)?) {
            let (first, count) = (level.particles.start, level.particles.len());
            if count == 0 {
                continue;
            }
            let held = |sorted: Sorted| self.memory.held(sorted, first, count);
            let last = held(Sorted::Rest)
                .pop()
                .expect("every law has a strain, so there are planes, with volumes in the last");
            let words: Vec<u32> = read_all(&self.gpu, &[held(Sorted::Record)[0], last])?;
            let (record, rest) = words.split_at(4 * count);
            let (record, rest) = (bytemuck::cast_slice(record), bytemuck::cast_slice(rest));
            let planes = Planes { record: Cow::Borrowed(record), rest: Cow::Borrowed(rest), ..Planes::default() };
            let places = homes.places();
            for law in 0..world.materials.len() {
                let own = places.par_iter().filter(|(q, _)| planes.law(*q) == law);
                spots.par_extend(own.map(|&(q, block)| planes.spot(q, block, level.h, count)));
            }
        }
        Ok(spots)
    }

    /// All that the device holds of a level's particles.
    pub(crate) fn planes(&self, level: &Level) -> Result<Planes<'static>> {
        let (first, count) = (level.particles.start, level.particles.len());
        let of = |sorted: Sorted| self.memory.held(sorted, first, count);
        let stretches: Vec<_> = [Sorted::Record, Sorted::Ids, Sorted::Rest].into_iter().flat_map(of).collect();
        Ok(Planes::of_words(&read_all(&self.gpu, &stretches)?, count).into_owned())
    }

    /// A world's particles, with the phase of the sort and of its levels.
    pub(crate) fn state(&self, w: usize) -> Result<ParticleState> {
        let (lists, laid) = self.lists(w)?;
        let (world, since_sorts) = (&self.worlds[w], self.since_sorts(w));
        let of_level = |(l, (homes, planes)): (usize, &Laid)| planes.counts(homes, world.materials.len(), l);
        let blocks: Vec<_> = laid.iter().enumerate().flat_map(of_level).collect();
        let sort = Some(SortPhase {
            // A world's levels are sorted together.
            age: since_sorts.first().map_or(0, |since_sort| since_sort.age),
            drift: since_sorts.iter().map(|since_sort| f64::from(since_sort.drift)).collect(),
            measured: Measured {
                stiffness_bound: world.stiffness().dt,
                stiffness_age: world.stiffness_age,
                mass: world.mass,
                least_mass: world.least_mass,
            },
            rest: self.rests(w)?.concat(),
            blocks,
            kept_for: vec![None; since_sorts.len()],
        });
        Ok(ParticleState {
            lists,
            sort,
            levels: world.phase(),
            archive: world.reach.as_ref().map(Reach::archive).unwrap_or_default(),
            ..ParticleState::default()
        })
    }

    /// What the planes of a buffer hold of so many particles, plane by plane.
    pub(crate) fn stretch<T: bytemuck::Pod>(&self, sorted: Sorted, first: usize, count: usize) -> Result<Vec<T>> {
        self.stretch_of(sorted, usize::MAX, first, count)
    }

    /// What the first planes of a buffer hold of so many particles.
    pub(crate) fn stretch_of<T: bytemuck::Pod>(
        &self,
        sorted: Sorted,
        planes: usize,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>> {
        let mut values = Vec::new();
        for (buffer, from, bytes) in self.memory.held(sorted, first, count).into_iter().take(planes) {
            values.extend(read::<T>(&self.gpu, buffer, from, bytes as usize / size_of::<T>())?);
        }
        Ok(values)
    }
}
