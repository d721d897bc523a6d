//! The worlds of a batch on one device, and what they own there.

use crate::device::Gpu;
use crate::device::kernel::{Kernel, Role};
use crate::device::memory::{Asked, Memory, Particles, Writes};
use crate::device::uniforms::{Extent, Layer, StepConstants};
use crate::passes::since_sort::most_drift;
use crate::passes::{Kernels, scene};
use crate::readback::Readback;
use crate::schedule::bodies::Contact;
use crate::schedule::probes::LOOKERS;
use crate::schedule::submission::{Clocks, FEW_STEPS};
use crate::schedule::{of_batch, step_constants};
use crate::worlds::sleep::BlockBox;
use crate::worlds::world::{Level, Place, World, parameters};
use crate::worlds::{Fixed, LawTexts, check_together};
use barchan_core::backend::NewWorld;
use barchan_core::scene::Wall;
use barchan_core::{ParticleList, Plan, Regions, Result, Schedule};
use barchan_grid::adapt::Candidates;
use std::ops::Range;
use std::sync::Arc;

/// A world's places of the directory are rounded up to a multiple of this, so that no workgroup has those of two.
pub(crate) const PLACES: u32 = 1024;

/// Worlds that take part in the same dispatches. Each level of each world is a layer.
pub(crate) struct WgpuBatch {
    pub(crate) gpu: Arc<Gpu>,
    pub(crate) kernels: Kernels,
    pub(crate) memory: Memory,
    pub(crate) worlds: Vec<World>,
    /// Width of the finest cell [m].
    pub(crate) h: f64,
    /// Levels of each world.
    pub(crate) levels: usize,
    /// What the passes were made for.
    pub(crate) fixed: Fixed,
    pub(crate) texts: LawTexts,
    pub(crate) schedule: Schedule,
    /// Steps of the finest level in one of the simulation.
    pub(crate) substeps: usize,
    /// How far particles may have drifted before a step [cells].
    pub(crate) most_drift: f32,
    /// Are the links of blocks lost, so that a sort must come before the next step?
    pub(crate) unlinked: bool,
    /// Did the last sort find particles that belong on another level? Then the next one will, too, as long as bodies move on.
    pub(crate) astray: bool,
    /// Steps that drifts are foreseen for.
    pub(crate) horizon: usize,
    /// Room for what submissions begin with writing.
    pub(crate) writes: Writes,
    /// Blocks of nodes near bodies in the last step whose contact was on the host.
    pub(crate) near_blocks: usize,
    pub(crate) clocks: Clocks,
    pub(crate) contact_seconds: (f64, u64),
    /// Time in splitting and merging on the host, and how often.
    pub(crate) adapt_seconds: (f64, u64),
    pub(crate) contact: Contact,
    /// The passes that look between steps, once anybody has asked.
    pub(crate) lookers: [Option<Kernel>; LOOKERS],
}

impl WgpuBatch {
    /// Worlds of one scene, each with its particles.
    pub(crate) fn new(gpu: Arc<Gpu>, worlds: Vec<NewWorld<'_>>) -> Result<Self> {
        let (plan, fixed, texts) = check_together(&gpu, &worlds)?;
        let (count, levels) = (worlds.len(), plan.cell_widths.len());
        let particles = worlds.iter().flat_map(|world| &world.particles.lists).map(ParticleList::len).sum::<usize>();
        let kernels = Kernels::new(&gpu, plan, count, particles)?;
        gpu.check()?;
        let walls = [0, 1, 2].map(|axis| plan.scene.world.walls.pair(axis));
        let pairs = walls.iter().flatten().any(|wall| matches!(wall, Wall::Separate { .. }));
        let slots = particles.next_multiple_of(128).max(128);
        let params: Vec<_> = worlds.iter().flat_map(|world| parameters(world.plan)).collect();
        let extent = Extent {
            slots: slots as u32,
            block_room: 64,
            node_room: 64,
            places: PLACES * (count * levels) as u32,
            world: scene::world_cells(plan),
            ..Extent::default()
        };
        let particles = Particles { vectors: scene::rest_vectors(&plan.materials), parts: kernels.setting.parts };
        let boxes = (levels - 1) * scene::boxes(plan);
        let (substeps, softs) = (plan.substeps as usize, count * scene::softs(plan).len());
        let sleeps = scene::may_sleep(plan);
        let (layers, probed) = (count * levels, fixed.probed);
        let asked = Asked { pairs, layers, worlds: count, boxes, substeps, sleeps, softs, probed, ..Asked::default() };
        let memory = Memory::new(&gpu, extent, particles, asked, &params, &kernels.step_layout)?;
        let plans: Vec<&Plan> = worlds.iter().map(|world| world.plan).collect();
        let mut batch = Self {
            gpu,
            kernels,
            memory,
            worlds: worlds.iter().map(|world| World::new(world.plan)).collect::<Result<_>>()?,
            h: plan.cell_widths[0],
            levels,
            fixed,
            texts,
            schedule: of_batch(plan),
            substeps,
            most_drift: most_drift(plan),
            unlinked: true,
            astray: false,
            horizon: FEW_STEPS,
            writes: Writes::default(),
            near_blocks: 0,
            clocks: Clocks::default(),
            contact_seconds: (0.0, 0),
            adapt_seconds: (0.0, 0),
            contact: Contact::default(),
            lookers: [const { None }; LOOKERS],
        };
        plans.iter().enumerate().for_each(|(world, plan)| batch.write_probed(world, plan));
        batch.take_in(worlds.into_iter().map(|world| world.particles).enumerate().collect())?;
        Ok(batch)
    }

    /// Puts another world in a place.
    pub(crate) fn replace(&mut self, world: usize, new: NewWorld<'_>) -> Result<()> {
        self.fixed.check(new.plan, world)?;
        if self.worlds.len() > 1 {
            self.texts.take_up(new.couplings, world)?;
        }
        self.settle()?;
        let before = std::mem::replace(&mut self.worlds[world], World::new(new.plan)?);
        let now = &mut self.worlds[world];
        now.levels.clone_from(&before.levels);
        if let Err(error) = self.take_in(vec![(world, new.particles)]) {
            self.worlds[world] = before;
            return Err(error);
        }
        self.write_parameters(world, new.plan);
        self.write_probed(world, new.plan);
        self.set_crossed(world, &[])
    }

    /// Tells the device the parameters of a world's materials.
    pub(crate) fn write_parameters(&self, world: usize, plan: &Plan) {
        let vectors = parameters(plan);
        let at = (16 * vectors.len() * world) as u64;
        self.gpu.queue.write_buffer(&self.memory.params, at, bytemuck::cast_slice(&vectors));
    }

    /// The levels of all worlds, in the order of layers.
    pub(crate) fn all_levels(&self) -> impl Iterator<Item = &Level> {
        self.worlds.iter().flat_map(|world| &world.levels)
    }

    /// A world's layers.
    pub(crate) fn layers_of(&self, world: usize) -> Range<usize> {
        self.levels * world..self.levels * (world + 1)
    }

    /// Do steps ask no more of the host than to wait for the device? They ask more until it is known where laws run, and where the host has a part in them.
    pub(crate) fn only_waits(&self) -> bool {
        let only_waits = |world: &World| {
            let on_device = matches!(world.contact, Some(Place::Nowhere | Place::Device));
            on_device && !world.answers() && world.reach.is_none() && world.ask_after.is_none()
        };
        self.levels == 1 && self.particles() > 0 && self.worlds.iter().all(only_waits)
    }

    pub(crate) fn particles(&self) -> usize {
        self.memory.extent.particles as usize
    }

    /// The constants of a step, with gravity as it is when it has grown.
    pub(crate) fn step_constants(&self, dt: f64, number: usize) -> StepConstants {
        step_constants(self.h, dt, self.fixed.gravity.0, number)
    }

    /// What the device is to know of each layer; those of the worlds that `on` names take part.
    pub(crate) fn layers(&self, on: impl Fn(usize) -> bool) -> Vec<Layer> {
        let mut first_place = 0;
        let layer = |(w, l): (usize, usize)| {
            let layer = self.worlds[w].layer(l, first_place, on(w));
            first_place += layer.places.next_multiple_of(PLACES);
            layer
        };
        (0..self.worlds.len()).flat_map(|w| (0..self.levels).map(move |l| (w, l))).map(layer).collect()
    }

    /// Tells the device where a world's levels are, and what may merge in a round.
    pub(crate) fn write_regions(&self, w: usize, candidates: Candidates<'_>) {
        let world = &self.worlds[w];
        let each = self.memory.boxes().checked_div(self.levels - 1).unwrap_or(0);
        // Boxes that hold nothing, for agents that have none, and such as hold everything.
        let (nothing, all) = ([[i32::MAX / 4; 4], [i32::MIN / 4; 4]], [[i32::MIN / 4; 4], [i32::MAX / 4; 4]]);
        let mut vectors: Vec<[i32; 4]> = Vec::new();
        let mut write = |regions: &Regions| {
            for boxes in regions.boxes() {
                let vector = |v: [i32; 3]| [v[0], v[1], v[2], 0];
                vectors.extend(boxes.iter().take(each).flat_map(|one| [vector(one.min), vector(one.max)]));
                vectors.extend((boxes.len()..each).flat_map(|_| nothing));
            }
        };
        write(&world.adapt.regions);
        match candidates {
            Candidates::None => write(&world.adapt.regions),
            Candidates::New(before) => write(before),
            Candidates::All => vectors.extend((0..self.memory.boxes()).flat_map(|_| all)),
        }
        let at = (16 * vectors.len() * w) as u64;
        self.gpu.queue.write_buffer(&self.memory.regions, at, bytemuck::cast_slice(&vectors));
    }

    pub(crate) fn write_layers(&self, layers: &[Layer]) {
        self.gpu.queue.write_buffer(&self.memory.layers, 0, bytemuck::cast_slice(layers));
    }

    /// What can be copied to the host.
    pub(crate) fn readback(&self) -> Readback<'_> {
        Readback {
            gpu: &self.gpu,
            memory: &self.memory,
            worlds: &self.worlds,
            levels: self.levels,
            sleeps: self.may_sleep(),
            has_walls: !self.kernels.set.collect.is_empty(),
        }
    }

    /// Does ground at rest sleep?
    pub(crate) fn may_sleep(&self) -> bool {
        self.kernels.set.watch.is_some()
    }

    /// Tells the device where tools are: for the steps, or slots, from one on, the boxes of each layer.
    pub(crate) fn write_tools(&mut self, first: usize, steps: &[Vec<Vec<BlockBox>>]) -> Result<()> {
        let most = steps.iter().flatten().map(Vec::len).max().unwrap_or(0);
        if !self.may_sleep() || (most == 0 && self.memory.tools() == 0) {
            return Ok(());
        }
        self.memory.add_tools(&self.gpu, most)?;
        // A box that holds nothing.
        let none = [[i32::MAX / 4; 4], [i32::MIN / 4; 4]];
        let padded = |boxes: &'_ Vec<BlockBox>| boxes.clone().into_iter().chain(std::iter::repeat(none)).take(most);
        let vectors: Vec<[i32; 4]> = steps.iter().flatten().flat_map(padded).flatten().collect();
        let buffer = self.memory.buffer(Role::Tools, 0);
        self.gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(&[[most as i32, 0, 0, 0]]));
        let at = (16 + 32 * first * self.memory.words().layers * most) as u64;
        self.gpu.queue.write_buffer(buffer, at, bytemuck::cast_slice(&vectors));
        Ok(())
    }
}
