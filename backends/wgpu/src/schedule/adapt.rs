//! Split and merge. The device finds the particles that may be concerned, the host decides about them, and the device
//! removes the old ones and adds the new ones.

use crate::device::kernel::{Role, Sorted};
use crate::device::layout::{self, Homes, Planes};
use crate::device::memory::{WATCHED, Writes, read, read_all, slots_for, with_room};
use crate::device::status::{BLOCKS, COUNTED, HALTED};
use crate::device::uniforms::StepConstants;
use crate::passes::scene::rest_vectors;
use crate::schedule::Dispatch;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::submission::{Behind, Part};
use crate::worlds::sleep;
use crate::worlds::world::{Level, World};
use barchan_core::{Adapted, Coupling, ParticleList, Regions, Result, StepReport};
use barchan_grid::adapt::{Candidates, CopiedLevel};
use barchan_grid::archive::Reach;
use barchan_grid::block;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

/// Vectors that the device writes for each block whose cells are at least half full: the block, and bits.
pub(crate) const FILLED: usize = 2;
/// Where a particle's cell and layer stand in its record on the way to the host and back.
pub(crate) const PLACE: usize = 5;
/// So many particles come back with the search; as a rule a round that merges nothing concerns fewer.
pub(crate) const AT_ONCE: usize = 2048;
pub(crate) const HAS_LEVELS: &str =
    "only scenes of several levels have rounds, and their passes are made with the others";

/// Copies of particles of a world that a round may concern.
pub(crate) struct Found {
    /// Where each list's particles are, level by level.
    slots: Vec<Vec<Vec<u32>>>,
    levels: Vec<CopiedLevel>,
}

impl WgpuBatch {
    /// Moves a world's levels after the bodies that they follow.
    pub(crate) fn follow(&mut self, w: usize, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        self.look_for_soft(w)?;
        let world = &mut self.worlds[w];
        let boxes = world.softs.boxes(self.h);
        let before = world.adapt.follow(couplings, |body| boxes.get(&body).copied());
        self.write_soft(w);
        before.map_or(Ok(()), |before| self.adapt(w, Some(&before), couplings))
    }

    /// Learns where a world's soft bodies are after its last step.
    pub(crate) fn look_for_soft(&mut self, w: usize) -> Result<()> {
        let Some(count) = self.worlds[w].soft_words() else { return Ok(()) };
        let words: Vec<i32> = read(&self.gpu, self.memory.buffer(Role::Soft, 0), (4 * count * w) as u64, count)?;
        self.worlds[w].take_soft(&words);
        Ok(())
    }

    /// Tells the device where a world's soft bodies may go before levels have to move after them.
    pub(crate) fn write_soft(&self, w: usize) {
        let words = self.worlds[w].soft_leeways(self.h);
        let at = 4 * (words.len() * w) as u64;
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Soft, 0), at, bytemuck::cast_slice(&words));
    }

    /// Brings a world's particles to the levels where they belong, splits and merges. `before` are its regions as they were, if they
    /// have moved.
    ///
    /// 1. The device learns where levels are, and sorts particles that have moved since they were sorted last, or have never been.
    /// 2. It finds those that the round may concern.
    /// 3. The host splits, merges and moves these.
    /// 4. The device leaves out those that are gone, and sorts in those that have come.
    pub(crate) fn adapt(&mut self, w: usize, before: Option<&Regions>, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        let begun = Instant::now();
        self.settle()?;
        let candidates = self.worlds[w].adapt.candidates(before);
        self.write_regions(w, candidates);
        let have_moved = self.worlds[w].levels.iter().any(|level| level.since_sort.drift != 0.0);
        if have_moved {
            self.worlds[w].be_due();
        }
        if have_moved || self.unlinked {
            self.sort(w)?;
        } else {
            // Where rims are is found by sorts.
            self.unlinked |= before.is_some();
        }
        self.exchange_with_archive(w, couplings)?;
        let Found { slots, mut levels } = self.find_concerned(w, !matches!(candidates, Candidates::None))?;
        let adapt = &mut self.worlds[w].adapt;
        let round = adapt.find(&levels.iter().collect::<Vec<_>>(), before, &vec![true; levels.len()]);
        let changed = adapt.apply(&mut levels.iter_mut().collect::<Vec<_>>(), &round, couplings)?;
        if changed.contains(&true) {
            let gone = levels.iter().zip(&slots).map(|(level, slots)| {
                level.gone().zip(slots).flat_map(|(gone, slots)| gone.map(|place| slots[place])).collect()
            });
            let gone: Vec<Vec<u32>> = gone.collect();
            let come: Vec<ParticleList> = levels.into_iter().flat_map(CopiedLevel::come).collect();
            self.exchange(w, &gone, &come)?;
        }
        self.worlds[w].adapted = true;
        self.adapt_seconds.0 += begun.elapsed().as_secs_f64();
        self.adapt_seconds.1 += 1;
        Ok(())
    }

    /// Reports what became of a world's levels and particles before the steps that it has taken: levels change before the first of them, and particles are sorted before any.
    pub(crate) fn report_levels(&mut self, w: usize, reports: &mut [StepReport]) {
        let World { adapt, adapted, levels, reach, .. } = &mut self.worlds[w];
        let (changes, adapted) = (adapt.take_changes(), std::mem::take(adapted));
        let now = |changes| Adapted {
            boxes: adapt.regions.boxes().to_vec(),
            live: reach.as_ref().map(Reach::live).unwrap_or_default(),
            sorted: vec![true; levels.len()],
            carried: true,
            changes,
        };
        for report in reports.iter_mut().filter(|report| report.sorted && levels.len() > 1) {
            report.adapted = Some(Arc::new(now(Vec::new())));
        }
        if let Some(first) = reports.first_mut().filter(|_| adapted) {
            first.adapted = Some(Arc::new(now(changes)));
        }
    }

    /// Particles of a world that a round may concern, and which cells are full if any may merge.
    pub(crate) fn find_concerned(&mut self, w: usize, merges: bool) -> Result<Found> {
        let kernels = self.kernels.set.adapt.as_ref().expect(HAS_LEVELS);
        self.write_layers(&self.layers(|other| other == w));
        self.write_words(HALTED, &[0]);
        self.write_steps(0, &[self.step_constants(0.0, 0)]);
        let now = self.memory.now;
        let passes = kernels.find.iter().chain(merges.then_some(&kernels.fill));
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 0, end: self.levels }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        // Those that may merge are many, and it takes more to merge them.
        let at_once = if merges { 0 } else { AT_ONCE.min(self.particles()) };
        let few: Vec<_> = self.found(at_once).collect();
        let (status, mut words) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, 0, few)?;
        let count = status.words[COUNTED] as usize;

        let world = &self.worlds[w];
        let blocks = world.levels[0].blocks.start..world.levels[self.levels - 1].blocks.end;
        let (mut room, mut filled) = (at_once, 0);
        if count > at_once {
            (room, filled) = (count, if merges { 4 * FILLED * blocks.len() } else { 0 });
            let from = (16 * FILLED * blocks.start) as u64;
            let cells = Behind::of(Role::Handed, from, 4 * filled as u64);
            let stretches = self.found(count).chain([cells]);
            let places: Vec<_> = stretches.map(|some| some.place(&self.memory, now)).collect();
            words = read_all(&self.gpu, &places)?;
        }
        let (order, rest) = words.split_at(room);
        let (planes, filled) = rest.split_at(rest.len() - filled);
        let planes = Planes::of_words(planes, room);

        let mut places = vec![Vec::new(); self.levels];
        let mut slots = vec![vec![Vec::new(); world.materials.len()]; self.levels];
        for (i, &slot) in order[..count].iter().enumerate() {
            let [x, y, z, layer] = planes.record[layout::vector(i, PLACE, room)];
            let l = layer as usize - self.levels * w;
            places[l].push((i, block::of_cell([x, y, z].map(|c| c as i32))));
            slots[l][planes.law(i)].push(slot);
        }
        let lists = |(l, places): (usize, &Vec<(usize, [i32; 3])>)| {
            planes.lists(places, &world.materials, (l, world.levels[l].h), room)
        };
        let lists: Vec<_> = places.par_iter().enumerate().map(lists).collect();
        let mut of_level = vec![Vec::new(); self.levels];
        for entry in filled.chunks_exact(4 * FILLED) {
            let key = block::key([0, 1, 2].map(|d| entry[d] as i32));
            let bits = u64::from(entry[4]) | u64::from(entry[5]) << 32;
            of_level[entry[3] as usize - self.levels * w].extend(key.map(|key| (key, bits)));
        }
        let levels = lists.into_par_iter().zip(of_level).map(|(lists, filled)| CopiedLevel::new(lists, filled));
        Ok(Found { slots, levels: levels.collect() })
    }

    /// Copies of particles, by their slots.
    pub(crate) fn copies(&mut self, slots: &[u32]) -> Result<Planes<'static>> {
        if slots.is_empty() {
            return Ok(Planes::default());
        }
        let [.., copy] = &self.kernels.set.adapt.as_ref().expect(HAS_LEVELS).find;
        self.write_words(COUNTED, &[slots.len() as u32]);
        self.write(self.memory.buffer(Role::Order, 0), 0, bytemuck::cast_slice(slots));
        self.write_steps(0, &[self.step_constants(0.0, 0)]);
        let copy = Dispatch { kernel: copy, now: self.memory.now, step: 0, end: self.levels };
        let parts = self.with_groups(vec![Part { sorting: None, dispatches: vec![copy] }]);
        // They stand in the order in which they were asked for.
        let copied: Vec<_> = self.found(slots.len()).skip(1).collect();
        let (_, words) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, 0, copied)?;
        Ok(Planes::of_words(&words, slots.len()).into_owned())
    }

    /// Where the device has put so many of those that it has found: their slots, then what it holds of them.
    pub(crate) fn found(&self, count: usize) -> impl Iterator<Item = Behind> {
        let order = Behind::of(Role::Order, 0, 4 * count as u64);
        let of = move |sorted: Sorted| {
            let stretches = self.memory.stretches(sorted, 0, count).into_iter();
            stretches.map(move |piece| Behind::next(sorted, piece))
        };
        [order].into_iter().chain([Sorted::Record, Sorted::Ids, Sorted::Rest].into_iter().flat_map(of))
    }

    /// Takes particles out of a world, by their slots on each level, and others in, one list a level and material.
    ///
    /// 1. Those that come are written behind all others, in blocks of their own.
    /// 2. Those that go are marked, and stress of those that come is found.
    /// 3. A sort in which nobody is due brings all to their places.
    pub(crate) fn exchange(&mut self, w: usize, gone: &[Vec<u32>], come: &[ParticleList]) -> Result<()> {
        let before = self.particles();
        let mut blocks = self.all_levels().last().map_or(0, |level| level.blocks.end);
        let world = &self.worlds[w];
        let lay = |(lists, level): (&[ParticleList], &Level)| {
            let homes = Homes::fresh(lists, &level.periods);
            Ok((Planes::of(lists, None, &homes, &world.materials, rest_vectors(&world.materials))?, homes))
        };
        let of_levels: Vec<_> = layout::by_level(come, world.materials.len()).zip(&world.levels).collect();
        let laid = of_levels.into_par_iter().map(lay).collect::<Result<Vec<_>>>()?;
        let more = |f: fn(&Homes) -> usize| laid.iter().map(|(_, homes)| f(homes)).sum::<usize>();
        let end = before + more(|homes| homes.order.len());
        self.make_room_for(end, blocks + more(|homes| homes.blocks.len()))?;

        let (layers, mut first) = (self.layers_of(w), before);
        for (layer, (mut planes, homes)) in layers.clone().zip(laid) {
            let count = homes.order.len();
            planes.record.to_mut()[layout::vector(0, PLACE, count)..].iter_mut().for_each(|v| v[3] = layer as u32);
            self.write_behind(&planes, &homes, (first, blocks), layer);
            (first, blocks) = (first + count, blocks + homes.blocks.len());
            let level = &mut self.worlds[w].levels[layer - layers.start];
            level.reach = level.reach.into_iter().chain(homes.extent()).reduce(|(a, b), (c, d)| {
                ([0, 1, 2].map(|axis| a[axis].min(c[axis])), [0, 1, 2].map(|axis| b[axis].max(d[axis])))
            });
        }
        self.write_words(BLOCKS, &[blocks as u32]);
        self.write(self.memory.buffer(Role::Order, 0), 0, bytemuck::cast_slice(&gone.concat()));
        self.memory.count(&self.gpu, end);
        self.mark_and_stress(gone.iter().map(Vec::len).sum(), before..end);
        self.sort(w)?;

        let world = &mut self.worlds[w];
        world.take_new(come)?;
        for ((level, come), gone) in
            world.levels.iter_mut().zip(layout::by_level(come, world.materials.len())).zip(gone)
        {
            level.particles.end += come.iter().map(ParticleList::len).sum::<usize>();
            level.particles.end -= gone.len();
        }
        let mut first = 0;
        for level in self.worlds.iter_mut().flat_map(|world| &mut world.levels) {
            level.particles = first..first + level.particles.len();
            first = level.particles.end;
        }
        self.memory.count(&self.gpu, first);
        Ok(())
    }

    /// Makes room for so many particles and blocks.
    pub(crate) fn make_room_for(&mut self, particles: usize, blocks: usize) -> Result<()> {
        layout::check_count(particles, "use fewer levels, simulate fewer particles, or use the backend cpu")?;
        let mut extent = self.memory.extent;
        if particles > extent.slots as usize {
            extent.slots = slots_for(particles) as u32;
        }
        if blocks > extent.block_room as usize {
            extent.block_room = with_room(blocks);
        }
        if extent == self.memory.extent { Ok(()) } else { self.memory.grow(&self.gpu, extent) }
    }

    /// Writes particles of a layer and their blocks behind all others: from that slot and that block on.
    pub(crate) fn write_behind(&self, planes: &Planes, homes: &Homes, (slot, block): (usize, usize), layer: usize) {
        for sorted in [Sorted::Record, Sorted::Ids, Sorted::Rest] {
            let mut bytes = planes.bytes(sorted);
            for (buffer, from, length) in self.memory.held(sorted, slot, homes.order.len()) {
                let (plane, rest) = bytes.split_at(length as usize);
                self.write(buffer, from, plane);
                bytes = rest;
            }
        }
        let entry = |&[x, y, z]: &[i32; 3]| {
            let mut entry = [[0; 4]; layout::ENTRY];
            entry[0] = [x, y, z, layer as i32];
            entry
        };
        let entries: Vec<_> = homes.blocks.iter().flat_map(entry).collect();
        let cells: Vec<u32> = homes.cells.iter().map(|start| start + slot as u32).collect();
        let at = (16 * layout::ENTRY * block) as u64;
        self.write(self.memory.plane(Sorted::Lists), at, bytemuck::cast_slice(&entries));
        self.write(self.memory.plane(Sorted::Cells), 256 * block as u64, bytemuck::cast_slice(&cells));
        if self.may_sleep() {
            let words = vec![sleep::words_of_come(); homes.blocks.len()];
            let at = (4 * WATCHED * block) as u64;
            self.write(self.memory.plane(Sorted::Watch), at, bytemuck::cast_slice(&words));
        }
    }

    /// Marks so many particles that are to go, which the order of the sort lists, and finds the stress of those in some slots.
    pub(crate) fn mark_and_stress(&mut self, gone: usize, come: Range<usize>) {
        let kernels = self.kernels.set.adapt.as_ref().expect(HAS_LEVELS);
        let passes = [(&kernels.remove, 0..gone), (&kernels.stress, come)];
        let of = |some: &Range<usize>| StepConstants {
            first: some.start as u32,
            count: some.len() as u32,
            ..StepConstants::default()
        };
        self.write_steps(0, &[of(&passes[0].1), of(&passes[1].1)]);
        let now = self.memory.now;
        let dispatches = passes
            .iter()
            .enumerate()
            .map(|(step, (kernel, _))| Dispatch { kernel, now, step, end: self.levels })
            .collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let dispatches: Vec<_> =
            parts.iter().flat_map(|(part, groups)| part.dispatches.iter().zip(groups.iter().copied())).collect();
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self::encode(&self.gpu, &mut encoder, &mut self.memory, &dispatches, None);
        self.gpu.queue.submit([encoder.finish()]);
    }
}
