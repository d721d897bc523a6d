//! The worlds of a batch on one device.

pub(crate) mod adapt;
pub(crate) mod archive;
pub(crate) mod arrivals;
pub(crate) mod engine;
pub(crate) mod sleep;
pub(crate) mod soft;
pub(crate) mod stiffness;
pub(crate) mod world;

use crate::device::memory::{Asked, Extent, Layer, Memory, Particles, StepConstants, Writes};
use crate::device::{Gpu, layout};
use crate::passes::Kernels;
use crate::passes::scene::rest_vectors;
use crate::schedule::bodies::Contact;
use crate::schedule::submission::{Clocks, FEW_STEPS};
use crate::schedule::{self, step_constants};
use crate::worlds::world::{Level, Place, World, most_drift, parameters};
use barchan_core::backend::NewWorld;
use barchan_core::scene::Wall;
use barchan_core::{Error, ParticleList, Plan, Regions, Result, Schedule, Vec3};
use barchan_grid::adapt::{Candidates, finest_volumes};
use std::ops::Range;
use std::sync::Arc;

/// A world's places of the directory are rounded up to a multiple of this, so that no workgroup has those of two.
pub(crate) const PLACES: u32 = 1024;

/// From so many particles on a device is busy: sorts that nobody needs take longer than steps that are written for nothing behind one that is missing, and
/// P2G's registers are scarcer than its time to wait.
pub(crate) const MANY: usize = 500_000;

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
}

/// What all worlds of a batch must have in common.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Fixed {
    pub(crate) world: String,
    /// When it has grown [m/s²], and over what time it grows [s].
    pub(crate) gravity: (Vec3, f64),
    pub(crate) laws: Vec<(String, String, bool)>,
    /// How many there are, steps of the finest in one of the coarsest, boxes of each, and soft bodies that they follow.
    pub(crate) levels: (usize, u32, usize, Vec<u16>),
    /// Of the finest particles of each body, if there are several levels [m³].
    pub(crate) volumes: Vec<f64>,
}

impl Fixed {
    pub(crate) fn of(plan: &Plan) -> Self {
        let law = |m: &barchan_core::plan::PlannedMaterial| {
            (m.material.name.clone(), m.material.origin.clone(), m.damping.is_some())
        };
        Self {
            world: crate::passes::scene::constants(plan),
            gravity: (plan.scene.gravity, plan.scene.gravity_ramp),
            laws: plan.materials.iter().map(law).collect(),
            levels: (
                plan.cell_widths.len(),
                plan.substeps,
                crate::passes::scene::boxes(plan),
                crate::passes::scene::softs(plan),
            ),
            volumes: if plan.cell_widths.len() > 1 { finest_volumes(plan) } else { Vec::new() },
        }
    }

    /// Refuses a world that differs, by name.
    pub(crate) fn check(&self, plan: &Plan, world: usize) -> Result<()> {
        let other = Self::of(plan);
        let differs = |what: &str, mend: &str| {
            Err(crate::lacks(
                format!("batch of worlds that differ in {what}"),
                format!("world {world} does not have that of the first"),
                mend,
            ))
        };
        const MEND: &str = "give all worlds the same, or run them on the backend cpu";
        if other.world != self.world {
            return differs("cell width, extent, walls, world.leaving, what sleeps, or what materials keep", MEND);
        }
        if other.laws != self.laws {
            return differs("their materials' laws, or which of these are damped", MEND);
        }
        if other.levels != self.levels {
            return differs("levels.count, levels.subcycle, or the number or the soft ones of levels.agents", MEND);
        }
        if other.volumes != self.volumes {
            return differs("how many bodies they have on levels, or how finely these are sampled", MEND);
        }
        if other.gravity != self.gravity {
            return differs("gravity", MEND);
        }
        Ok(())
    }
}

/// What the worlds have in common, if it is enough for one batch.
pub(crate) fn check_together<'a>(gpu: &Gpu, worlds: &[NewWorld<'a>]) -> Result<(&'a Plan, Fixed)> {
    let Some(NewWorld { plan, .. }) = worlds.first() else {
        return Err(crate::lacks("batch of no worlds", "none is given", "give one at least"));
    };
    let levels = plan.cell_widths.len();
    let fixed = Fixed::of(plan);
    worlds.iter().enumerate().try_for_each(|(w, world)| fixed.check(world.plan, w))?;
    let of_regions = 16 * crate::passes::scene::region_vectors(plan);
    let most = gpu.limits.max_uniform_buffer_binding_size as usize / (size_of::<Layer>() * levels).max(of_regions);
    if worlds.len() > most {
        return Err(Error::Capacity {
            what: "worlds in one batch of the adapter",
            asked: worlds.len() as u64,
            cap: most as u64,
            mend: "run fewer worlds together",
        });
    }
    worlds.iter().try_for_each(|world| layout::check(&world.particles, &world.plan.materials, levels))?;
    let particles: usize = worlds.iter().flat_map(|world| &world.particles.lists).map(ParticleList::len).sum();
    layout::check_count(particles, "simulate fewer, or use the backend cpu")?;
    Ok((plan, fixed))
}

impl WgpuBatch {
    /// Worlds of one scene, each with its particles.
    pub(crate) fn new(gpu: Arc<Gpu>, worlds: Vec<NewWorld<'_>>) -> Result<Self> {
        let (plan, fixed) = check_together(&gpu, &worlds)?;
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
            ..Extent::default()
        };
        let particles = Particles { vectors: rest_vectors(&plan.materials), parts: kernels.setting.parts };
        let boxes = (levels - 1) * crate::passes::scene::boxes(plan);
        let (substeps, softs) = (plan.substeps as usize, count * crate::passes::scene::softs(plan).len());
        let sleeps = crate::passes::scene::may_sleep(plan);
        let asked =
            Asked { pairs, layers: count * levels, worlds: count, boxes, substeps, sleeps, softs, ..Asked::default() };
        let memory = Memory::new(&gpu, extent, particles, asked, &params, &kernels.step_layout)?;
        let mut batch = Self {
            gpu,
            kernels,
            memory,
            worlds: worlds.iter().map(|world| World::new(world.plan)).collect::<Result<_>>()?,
            h: plan.cell_widths[0],
            levels,
            fixed,
            schedule: schedule::of_batch(plan),
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
        };
        batch.take_in(worlds.into_iter().map(|world| world.particles).enumerate().collect())?;
        Ok(batch)
    }

    /// Puts another world in a place.
    pub(crate) fn replace(&mut self, world: usize, new: NewWorld<'_>) -> Result<()> {
        self.fixed.check(new.plan, world)?;
        self.settle()?;
        let before = std::mem::replace(&mut self.worlds[world], World::new(new.plan)?);
        let now = &mut self.worlds[world];
        now.levels.clone_from(&before.levels);
        if let Err(error) = self.take_in(vec![(world, new.particles)]) {
            self.worlds[world] = before;
            return Err(error);
        }
        self.write_parameters(world, new.plan);
        Ok(())
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
}
