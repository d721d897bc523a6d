//! What is copied to the host: particles, what steps have left on the device, and what went wrong.

pub(crate) mod account;
pub(crate) mod faults;
pub(crate) mod pending;
pub(crate) mod rest;

use crate::device::Gpu;
use crate::device::kernel::Sorted;
use crate::device::layout::{self, Homes, Planes};
use crate::device::memory::{Memory, read, read_all};
use crate::worlds::world::{Level, World};
use barchan_core::{Aabb, Measured, ParticleList, ParticleState, Reading, Result, SortPhase, Spot};
use barchan_grid::archive::Reach;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// What can be copied to the host: the device's buffers, and what the host knows of the worlds in them.
#[derive(Clone, Copy)]
pub(crate) struct Readback<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) memory: &'a Memory,
    pub(crate) worlds: &'a [World],
    /// Levels of each world.
    pub(crate) levels: usize,
    /// Does ground at rest sleep?
    pub(crate) sleeps: bool,
    /// Is summed up what walls gave?
    pub(crate) has_walls: bool,
}

/// How a level lies in memory.
pub(crate) type Laid = (Homes, Planes<'static>);

impl Readback<'_> {
    /// A world's layers.
    fn layers_of(&self, world: usize) -> Range<usize> {
        self.levels * world..self.levels * (world + 1)
    }

    /// Homes of some worlds' levels as the device has them, the particles of each counted from its first one.
    pub(crate) fn homes(&self, worlds: Range<usize>) -> Result<Vec<Homes>> {
        let levels: Vec<&Level> = self.worlds[worlds].iter().flat_map(|world| &world.levels).collect();
        let start = levels.first().map_or(0, |level| level.blocks.start);
        let count = levels.last().map_or(0, |level| level.blocks.end) - start;
        let at = (16 * layout::ENTRY * start) as u64;
        let entries: Vec<[i32; 4]> = read(self.gpu, self.memory.plane(Sorted::Lists), at, count * layout::ENTRY)?;
        let cells: Vec<u32> = read(self.gpu, self.memory.plane(Sorted::Cells), 256 * start as u64, 64 * count + 1)?;
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
            let words: Vec<u32> = read_all(self.gpu, &[held(Sorted::Record)[0], last])?;
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

    /// Reads particles of a world in a region. Of the planes only those come to the host that hold what is asked for, from the first to the last block that
    /// may have particles there.
    pub(crate) fn read(&self, w: usize, region: Option<&Aabb>, into: &mut Reading) -> Result<()> {
        let (world, fields) = (&self.worlds[w], into.fields);
        let needs_record = [
            true,
            fields.mass,
            fields.velocity | fields.affine,
            fields.velocity | fields.affine,
            fields.velocity | fields.affine,
        ];
        for (l, (level, homes)) in world.levels.iter().zip(self.homes(w..w + 1)?).enumerate() {
            // Who is in a block may have left it by up to two cells.
            let may_meet = |block: &[i32; 3]| {
                region.is_none_or(|region| {
                    let first = block.map(|b| 4.0 * f64::from(b));
                    let (h, axes) = (level.h, 0..3);
                    axes.into_iter()
                        .all(|d| (first[d] - 2.0) * h <= region.max[d] && region.min[d] <= (first[d] + 6.0) * h)
                })
            };
            let meeting = || homes.blocks.iter().enumerate().filter(|(_, block)| may_meet(block)).map(|(b, _)| b);
            let (Some(first), Some(last)) = (meeting().min(), meeting().max()) else { continue };
            let slots = homes.cells[64 * first] as usize..homes.cells[64 * (last + 1)] as usize;
            let (from, count) = (level.particles.start + slots.start, slots.len());
            let held = |sorted: Sorted| self.memory.held(sorted, from, count);
            let mut stretches: Vec<_> = held(Sorted::Record)
                .into_iter()
                .zip(needs_record)
                .filter(|(_, needs)| *needs)
                .map(|(s, _)| s)
                .collect();
            if fields.id || fields.body {
                stretches.extend(held(Sorted::Ids));
            }
            if fields.volume0 {
                stretches.extend(held(Sorted::Rest).pop());
            }
            let words: Vec<u32> = read_all(self.gpu, &stretches)?;
            // Where each plane begins, by its number in the record, then ids and the last of the rest.
            let mut begins = [0; 7];
            let mut at = 0;
            let sizes = needs_record.map(|needs| if needs { 4 } else { 0 }).into_iter();
            let sizes = sizes.chain([if fields.id || fields.body { 2 } else { 0 }, 0]);
            for (begin, size) in begins.iter_mut().zip(sizes) {
                *begin = at;
                at += size * count;
            }
            let record = |k: usize, q: usize| &words[begins[k] + 4 * q..][..4];
            let real = |bits: u32| f32::from_bits(bits);
            for (slot, block) in homes.places().into_iter().filter(|(slot, _)| slots.contains(slot)) {
                let q = slot - slots.start;
                let place = std::array::from_fn(|d| record(0, q)[d]);
                let position = layout::position(place, block, level.h);
                if region.is_some_and(|region| !region.contains(position)) {
                    continue;
                }
                into.add_position(position);
                into.velocity.extend(fields.velocity.then(|| [0, 1, 2].map(|d| real(record(2 + d, q)[0]))));
                let affine = || std::array::from_fn(|e| real(record(2 + e / 3, q)[1 + e % 3]));
                into.affine.extend(fields.affine.then(affine));
                into.mass.extend(fields.mass.then(|| real(record(1, q)[3])));
                into.volume0.extend(fields.volume0.then(|| real(words[begins[6] + 4 * q + 3])));
                let names = |k: usize| words[begins[5] + 2 * q + k];
                into.id.extend(fields.id.then(|| u64::from(names(0))));
                into.body.extend(fields.body.then(|| names(1) as u16));
                into.material.extend(fields.material.then(|| layout::law_of(place[3]) as u16));
                into.level.extend(fields.level.then_some(l as u8));
            }
        }
        Ok(())
    }

    /// All that the device holds of a level's particles.
    pub(crate) fn planes(&self, level: &Level) -> Result<Planes<'static>> {
        let (first, count) = (level.particles.start, level.particles.len());
        let of = |sorted: Sorted| self.memory.held(sorted, first, count);
        let stretches: Vec<_> = [Sorted::Record, Sorted::Ids, Sorted::Rest].into_iter().flat_map(of).collect();
        Ok(Planes::of_words(&read_all(self.gpu, &stretches)?, count).into_owned())
    }

    /// A world's particles, with the phase of the sort and of its levels.
    pub(crate) fn state(&self, w: usize) -> Result<ParticleState> {
        Ok(ParticleState { kept: None, ..self.whole_state(w)? })
    }

    /// The same, with stress.
    pub(crate) fn whole_state(&self, w: usize) -> Result<ParticleState> {
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
        let of_level = |((homes, planes), level): (&Laid, &Level)| {
            planes.stresses(&homes.places(), world.materials.len(), level.particles.len())
        };
        let kept = laid.iter().zip(&world.levels).flat_map(of_level).collect();
        Ok(ParticleState {
            lists,
            sort,
            kept: Some(kept),
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
            values.extend(read::<T>(self.gpu, buffer, from, bytes as usize / size_of::<T>())?);
        }
        Ok(values)
    }
}
