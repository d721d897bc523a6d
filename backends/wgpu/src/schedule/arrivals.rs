//! Particles copied to the device.

use crate::device::kernel::{Role, Sorted};
use crate::device::layout::{self, Homes, Planes};
use crate::device::memory::{Writes, slots_for, with_room};
use crate::device::status::{BLOCKS, FIRST_BLOCK};
use crate::passes::scene::rest_vectors;
use crate::readback::account;
use crate::schedule::Dispatch;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::submission::Part;
use crate::worlds::sleep;
use crate::worlds::world::{Level, World};
use barchan_core::{ParticleList, ParticleState, Plan, Result};
use barchan_grid::adapt::Candidates;
use std::collections::BTreeMap;
use std::ops::Range;

/// Particles that come in, laid out level by level.
pub(crate) struct Arrival {
    homes: Vec<Homes>,
    /// What is known of their blocks' rest.
    watched: Vec<Vec<sleep::Words>>,
    planes: Vec<Planes<'static>>,
    particles: ParticleState,
}

impl WgpuBatch {
    /// Replaces the particles of some worlds.
    ///
    /// 1. The new ones are laid out. Homes of the others are asked of the device.
    /// 2. Particles go to the other set of buffers, each world behind the one before; so do the lists of blocks, without their links: a sort
    ///    finds them before the next step. It leaves homes as they are, since nobody is due.
    /// 3. Stress of the new ones is found from their strain, unless it has come with them.
    pub(crate) fn take_in(&mut self, news: Vec<(usize, ParticleState)>) -> Result<()> {
        let mut arrivals = BTreeMap::new();
        for (w, particles) in news {
            arrivals.insert(w, self.arrival(w, particles)?);
        }
        self.bring_in(&arrivals, None)?;
        self.find_stress(&arrivals)
    }

    /// Puts a copy of a world in the place of another: particles, lists of blocks and what is known of their rest are copied on the device, as the other
    /// worlds' are that stay when one is replaced.
    pub(crate) fn copy(&mut self, from: usize, to: usize, plan: &Plan) -> Result<()> {
        self.fixed.check(plan, to)?;
        self.settle()?;
        let crossed = self.crossed(from)?;
        self.look_for_soft(from)?;
        self.bring_in(&BTreeMap::new(), Some((from, to)))?;
        let before = std::mem::take(&mut self.worlds[to].levels);
        let mut copy = self.worlds[from].clone();
        // Where its law runs is found anew, as for one that is replaced: the device has a table for each world.
        (copy.contact, copy.groups) = (None, Vec::new());
        for (level, here) in copy.levels.iter_mut().zip(before) {
            let Level { particles, blocks, node_blocks, reach, span, .. } = here;
            *level = Level { particles, blocks, node_blocks, reach, span, ..level.clone() };
        }
        self.worlds[to] = copy;
        self.write_regions(to, Candidates::None);
        if self.worlds[to].reach.is_some() {
            self.write_live()?;
        }
        self.write_parameters(to, plan);
        self.write_probed(to, plan);
        self.set_crossed(to, &crossed)?;
        self.gpu.check()
    }

    /// The first two parts of [`take_in`](Self::take_in), with arrivals laid out, or with a copy of a world's particles in the place of another's.
    fn bring_in(&mut self, arrivals: &BTreeMap<usize, Arrival>, copy: Option<(usize, usize)>) -> Result<()> {
        let all = self.worlds.len();
        let mut homes = if arrivals.len() < all {
            self.readback().homes(0..all)?
        } else {
            vec![Homes::default(); self.memory.words().layers]
        };
        let mut watched = if arrivals.len() < all {
            self.readback().watched(0..all)?
        } else {
            vec![Vec::new(); self.memory.words().layers]
        };
        for (w, arrival) in arrivals {
            homes[self.layers_of(*w)].clone_from_slice(&arrival.homes);
            watched[self.layers_of(*w)].clone_from_slice(&arrival.watched);
        }
        let mut before: Vec<_> = self.all_levels().map(|level| level.particles.clone()).collect();
        if let Some((from, to)) = copy {
            for (from, to) in self.layers_of(from).zip(self.layers_of(to)) {
                homes[to] = homes[from].clone();
                watched[to] = watched[from].clone();
                before[to] = before[from].clone();
            }
        }
        let counts: Vec<usize> = homes.iter().map(|homes| homes.cells.last().map_or(0, |end| *end as usize)).collect();
        let mut extent = self.memory.extent;
        let all: usize = counts.iter().sum();
        layout::check_count(all, "simulate fewer, or use the backend cpu")?;
        if all > extent.slots as usize {
            extent.slots = slots_for(all) as u32;
        }
        let node_blocks: Vec<usize> =
            homes.iter().zip(self.all_levels()).map(|(homes, level)| homes.node_blocks(&level.periods)).collect();
        let nodes = self.all_levels().zip(&node_blocks).map(|(level, count)| level.node_blocks.len().max(*count)).sum();
        extent.particles = all as u32;
        extent.block_room = extent.block_room.max(with_room(homes.iter().map(|homes| homes.blocks.len()).sum()));
        extent.node_room = extent.node_room.max(with_room(nodes));
        self.memory.grow(&self.gpu, extent)?;

        let (mut slot, mut block) = (0, 0);
        let levels = self.worlds.iter_mut().flat_map(|world| &mut world.levels);
        for ((level, homes), count) in levels.zip(&homes).zip(&counts) {
            level.particles = slot..slot + count;
            level.blocks = block..block + homes.blocks.len();
            level.reach = homes.extent();
            (slot, block) = (level.particles.end, level.blocks.end);
        }
        self.write_particles(arrivals, &before);
        self.write_lists(&homes, &watched);
        self.memory.now = 1 - self.memory.now;
        self.unlinked = true;
        self.cover_blocks(1)?;

        if let Some((_, to)) = copy {
            let layers = self.layers_of(to);
            for (level, count) in self.worlds[to].levels.iter_mut().zip(&node_blocks[layers]) {
                level.node_blocks = 0..*count;
            }
        }
        for (w, arrival) in arrivals {
            let spoilt = account::find_non_finite(&arrival.particles.lists).any();
            let layers = self.layers_of(*w);
            let world = &mut self.worlds[*w];
            world.see_soft(&arrival.particles.lists);
            for (level, count) in world.levels.iter_mut().zip(&node_blocks[layers]) {
                level.node_blocks = 0..*count;
            }
            if let Some(phase) = &arrival.particles.levels {
                if let Some(reach) = &mut world.reach {
                    reach.restore(phase.live.clone(), arrival.particles.archive.clone());
                }
                // Numbers go on as they did there.
                world.adapt.next_id = 0;
                world.adapt.restore(phase.clone());
            }
            let ids = arrival.particles.lists.iter().flat_map(|list| &list.id);
            world.adapt.next_id = ids.max().map_or(0, |id| id + 1).max(world.adapt.next_id);
            self.write_regions(*w, Candidates::None);
            let world = &mut self.worlds[*w];
            world.torn = None;
            world.spoilt = spoilt;
            world.take_stock(&arrival.particles.lists, arrival.particles.sort.as_ref())?;
        }
        if self.worlds.iter().any(|world| world.reach.is_some()) {
            self.write_live()?;
        }
        Ok(())
    }

    /// Lays out particles that come into a world.
    pub(crate) fn arrival(&self, w: usize, mut particles: ParticleState) -> Result<Arrival> {
        let World { materials, levels, .. } = &self.worlds[w];
        layout::check(&particles, materials, self.levels)?;
        let of_levels = || layout::by_level(&particles.lists, materials.len()).zip(levels);
        let restored = particles.sort.as_ref().and_then(|sort| {
            let restore = |(l, (lists, _)): (usize, (&[ParticleList], &Level))| Homes::restored(lists, l, &sort.blocks);
            of_levels().enumerate().map(restore).collect::<Option<Vec<_>>>()
        });
        let is_restored = restored.is_some();
        let fresh = || of_levels().map(|(lists, level)| Homes::fresh(lists, &level.periods)).collect();
        let homes: Vec<Homes> = restored.unwrap_or_else(fresh);
        let kept = |l: usize| particles.kept.as_ref().map(|kept| &kept[l * materials.len()..][..materials.len()]);
        let lay = |(l, ((lists, _), homes)): (usize, ((&[ParticleList], &Level), &Homes))| {
            Planes::of(lists, kept(l), homes, materials, rest_vectors(materials))
        };
        let planes = of_levels().zip(&homes).enumerate().map(lay).collect::<Result<_>>()?;
        if !is_restored {
            particles.sort = None;
        }
        let rest = |(l, (lists, homes)): (usize, (&[ParticleList], &Homes))| match &particles.sort {
            Some(sort) => sleep::restored(sort, l, lists, homes),
            None => vec![sleep::words_of(1); homes.blocks.len()],
        };
        let watched = layout::by_level(&particles.lists, materials.len()).zip(&homes).enumerate().map(rest).collect();
        Ok(Arrival { homes, watched, planes, particles })
    }

    /// Writes the particles of all worlds into the other set of buffers: new ones from here, others from where they were.
    pub(crate) fn write_particles(&self, arrivals: &BTreeMap<usize, Arrival>, before: &[Range<usize>]) {
        let next = 1 - self.memory.now;
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (layer, level) in self.all_levels().enumerate() {
            let (to, l) = (&level.particles, layer % self.levels);
            for sorted in [Sorted::Record, Sorted::Ids, Sorted::Rest] {
                let stretches = self.memory.stretches(sorted, to.start, to.len());
                if let Some(arrival) = arrivals.get(&(layer / self.levels)) {
                    let mut bytes = arrival.planes[l].bytes(sorted);
                    for to in stretches {
                        let (plane, rest) = bytes.split_at(to.bytes as usize);
                        self.write(self.memory.part(Role::Now(sorted), to.part, next), to.from, plane);
                        bytes = rest;
                    }
                } else {
                    let sources = self.memory.held(sorted, before[layer].start, to.len());
                    for ((buffer, from, bytes), to) in sources.into_iter().zip(stretches) {
                        let next = self.memory.part(Role::Now(sorted), to.part, next);
                        encoder.copy_buffer_to_buffer(buffer, from, next, to.from, bytes);
                    }
                }
            }
        }
        self.gpu.queue.submit([encoder.finish()]);
    }

    /// Writes much, a part at a time.
    pub(crate) fn write(&self, buffer: &wgpu::Buffer, at: u64, bytes: &[u8]) {
        const PART: usize = 64 << 20;
        for (i, part) in bytes.chunks(PART).enumerate() {
            self.gpu.queue.write_buffer(buffer, at + (i * PART) as u64, part);
            // What has been written waits for a submission, and takes memory until then.
            if part.len() == PART {
                self.gpu.queue.submit([]);
            }
        }
    }

    /// Writes where all blocks are into the other set of buffers, without their links.
    pub(crate) fn write_lists(&self, homes: &[Homes], watched: &[Vec<sleep::Words>]) {
        let next = 1 - self.memory.now;
        let layout = self.memory.words();
        let (mut entries, mut cells) = (Vec::new(), Vec::new());
        for (layer, (level, homes)) in self.all_levels().zip(homes).enumerate() {
            self.write_words(layout.of_layer(layer, FIRST_BLOCK), &[level.blocks.start as u32, 0]);
            for &[x, y, z] in &homes.blocks {
                entries.push([x, y, z, layer as i32]);
                entries.extend([[0; 4]; layout::ENTRY - 1]);
            }
            let starts = &homes.cells[..64 * homes.blocks.len()];
            cells.extend(starts.iter().map(|start| start + level.particles.start as u32));
        }
        let (blocks, particles) = self.all_levels().last().map_or((0, 0), |last| (last.blocks.end, last.particles.end));
        cells.push(particles as u32);
        self.write(self.memory.buffer(Role::Now(Sorted::Lists), next), 0, bytemuck::cast_slice(&entries));
        self.write(self.memory.buffer(Role::Now(Sorted::Cells), next), 0, bytemuck::cast_slice(&cells));
        if self.may_sleep() {
            self.write(self.memory.buffer(Role::Now(Sorted::Watch), next), 0, bytemuck::cast_slice(&watched.concat()));
        }
        self.write_words(BLOCKS, &[blocks as u32, 0]);
    }

    /// Stress follows from strain, to rounding; where it has come with particles it is there already.
    pub(crate) fn find_stress(&mut self, arrivals: &BTreeMap<usize, Arrival>) -> Result<()> {
        let fit = |w: usize| !self.worlds[w].spoilt && !self.worlds[w].particles().is_empty();
        let lacks = |(w, arrival): &(&usize, &Arrival)| fit(**w) && arrival.particles.kept.is_none();
        let mut by_step: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (&w, arrival) in arrivals.iter().filter(lacks) {
            by_step.entry(arrival.particles.strain_dt.to_bits()).or_default().push(w);
        }
        for (dt, worlds) in by_step {
            self.write_layers(&self.layers(|w| worlds.contains(&w)));
            self.write_steps(0, &[self.step_constants(f64::from_bits(dt), 0)]);
            let dispatch =
                Dispatch { kernel: &self.kernels.set.stress, now: self.memory.now, step: 0, end: self.levels };
            let parts = self.with_groups(vec![Part { sorting: None, dispatches: vec![dispatch] }]);
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, 0, None)?;
        }
        Ok(())
    }
}
