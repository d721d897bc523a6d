//! Worlds on one device, and their steps.

use crate::account;
use crate::device::Gpu;
use crate::free::{Felt, states};
use crate::kernels::{self, Free, Groups, Kernel, Kernels, NearKernels, Role, Sorted, rest_vectors};
use crate::layout::{self, Homes, Planes};
use crate::memory::{
    Asked, BODY, Extent, Layer, MAX_SLOTS, MAX_STEPS, Memory, Particles, Piece, STEP_STRIDE, StepConstants, Words,
    Writes, lent_bytes, pad, read, read_all, slots_for, with_mapped, with_room,
};
use crate::schedule::{self, ContactPasses, Dispatch, Passes, step_constants};
use crate::sleep::{self, BlockBox};
use crate::stiffness::{self, Held};
use crate::world::{Foresight, Level, MAX_MOVE, Place, Rhythm, Span, World, most_drift, parameters};
use barchan_core::backend::{NewWorld, Turn};
use barchan_core::coupling::{DeviceLaw, Lent};
use barchan_core::plan::loaded;
use barchan_core::scene::{Leaving, Wall};
use barchan_core::{
    Aabb, BodyState, Coupling, Error, Measured, ParticleList, ParticleState, Plan, Regions, Result, Schedule,
    SortPhase, Spot, StepReport, Vec3, Wrench,
};
use barchan_grid::adapt::{Candidates, finest_volumes};
use barchan_grid::archive::Reach;
use barchan_grid::block;
use rayon::prelude::*;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// No node that a particle feels may carry one further than this in a step, in cells: a little less than particles may move.
pub(crate) const NODE_MOVE: f64 = 0.48;
/// Every so manieth submission is timed pass by pass.
const TIMED: u64 = 16;
/// And of it so many passes at most.
const MOST_TIMED: usize = 64;
/// After so many passes the device begins with a submission while the rest is still being written; each piece is twice the
/// one before, since writing is faster than running.
const PIECE: usize = 16;
/// A world's places of the directory are rounded up to a multiple of this, so that no workgroup has those of two.
const PLACES: u32 = 1024;
/// Steps that a submission begins with; each that comes to its end may be followed by one twice as long, but one that had to stop since
/// particles drifted otherwise than foreseen wastes what was written behind.
const FEW_STEPS: usize = 128;
/// From so many particles on a device is busy: sorts that nobody needs take longer than steps that are written for nothing behind one that is missing, and
/// P2G's registers are scarcer than its time to wait.
pub(crate) const MANY: usize = 500_000;
/// By so many blocks parts of the directory reach further than they must, so that ground that moves on seldom leaves them.
const SPARE_BLOCKS: i32 = 2;

/// Blocks in a free body's box on a level that the device can look into: a larger body's law runs on the host.
const MOST_ROOMS: usize = 8192;

/// Words of the status; see `common.wgsl`.
pub(crate) const BLOCKS: usize = 0;
const NODE_BLOCKS: usize = 1;
pub(crate) const HALTED: usize = 2;
/// Words from there on to that of sorts, as steps begin.
pub(crate) const AT_START: [u32; 8] = [0, 0, u32::MAX, 0, 0, 0, 0, 0];
const HALT_STEP: usize = 3;
const WHO: usize = 4;
const NEW_BLOCKS: usize = 6;
const NEW_NODE_BLOCKS: usize = 7;
const SORTS: usize = 9;
pub(crate) const COUNTED: usize = 10;
/// Blocks of nodes near bodies whose law runs on the host: gathered, and in the next word those on their way back.
pub(crate) const NEAR: usize = 11;
/// Blocks whose particles give to nodes that a finer level takes part in.
const GIVERS: usize = 13;
/// Of a layer.
const FIRST_BLOCK: usize = 0;
const FIRST_NODE_BLOCK: usize = 1;
const LEAST_BLOCK: usize = 2;
const GREATEST_BLOCK: usize = 5;
/// Of what a submission sums up of a layer.
const SORTED: usize = 0;
const PARTED: usize = 1;
pub(crate) const WALL_IMPULSE: usize = 2;
const ASTRAY: usize = 6;
const LEFT: usize = 7;
const LEFT_IMPULSE: usize = 8;
const LEFT_MASS: usize = 11;
pub(crate) const SLEPT: usize = 12;
/// Of a layer in a step.
pub(crate) const SPEED: usize = 0;
pub(crate) const MOVE: usize = 1;
const GROWN: usize = 3;
/// Of a layer in a submission, after an even step and after an odd one.
const NEED: usize = 18;
/// Of a layer in a submission: what damping has dissipated, in so many digits of 32 bits, and the least of these [J].
pub(crate) const DAMPED: usize = 20;
pub(crate) const DAMPED_DIGITS: usize = 4;
const DAMPED_UNIT: f64 = 1.0 / (1_u128 << 80) as f64;
const BIAS: i32 = block::REACH;

/// Why the device halted a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Halt {
    TooFast,
    Drifted,
    Room,
    /// Particles are on another level than they should be.
    Misplaced,
    LeftWorld,
    Strayed,
    /// There are fewer particles than before.
    Fewer,
    /// Levels must move after soft bodies, or the host must look where free bodies are.
    Follow,
    /// Particles need shorter steps.
    TooStiff,
}

impl Halt {
    fn of(word: u32) -> Option<Self> {
        match word {
            0 => None,
            1 => Some(Self::TooFast),
            2 => Some(Self::Drifted),
            3 => Some(Self::Room),
            4 => Some(Self::Misplaced),
            5 => Some(Self::LeftWorld),
            6 => Some(Self::Strayed),
            7 => Some(Self::Fewer),
            8 => Some(Self::Follow),
            _ => Some(Self::TooStiff),
        }
    }
}

/// The status as it was brought back.
pub(crate) struct Status {
    pub(crate) words: Vec<u32>,
    layout: Words,
}

impl Status {
    pub(crate) fn new(words: Vec<u32>, layout: Words) -> Self {
        Self { words, layout }
    }
    pub(crate) fn halt(&self) -> Option<Halt> {
        Halt::of(self.words[HALTED])
    }
    /// A number of a layer in a step.
    pub(crate) fn in_step(&self, step: usize, layer: usize, k: usize) -> f32 {
        f32::from_bits(self.words[self.layout.of_step(step, layer, k)])
    }
    fn of_layer(&self, layer: usize, k: usize) -> usize {
        self.words[self.layout.of_layer(layer, k)] as usize
    }
    fn sum(&self, layer: usize, k: usize) -> u32 {
        self.words[self.layout.of_sum(layer, k)]
    }
    /// A layer's blocks, or node blocks: from its first one to the next layer's.
    fn range(&self, layer: usize, first: usize, all: usize) -> Range<usize> {
        let next = layer + 1;
        let end = if next < self.layout.layers { self.of_layer(next, first) } else { self.words[all] as usize };
        self.of_layer(layer, first)..end
    }
    /// Did a sort find particles of some layers that belong on another level?
    pub(crate) fn is_astray(&self, mut layers: Range<usize>) -> bool {
        layers.any(|layer| self.sum(layer, ASTRAY) > 0)
    }
    /// The step before which a layer was sorted last in the submission.
    pub(crate) fn sorted_before(&self, layer: usize) -> Option<usize> {
        (self.sum(layer, SORTED) as usize).checked_sub(1)
    }
    /// The greatest node speed of some layers in a step, or NaN if any is not finite [m/s].
    pub(crate) fn speed(&self, step: usize, mut layers: Range<usize>) -> f64 {
        layers
            .try_fold(0.0, |most: f64, layer| {
                let speed = f64::from(self.in_step(step, layer, SPEED));
                if speed.is_nan() { Err(speed) } else { Ok(most.max(speed)) }
            })
            .unwrap_or_else(|nan| nan)
    }
}

/// What a submission did.
pub(crate) struct Outcome {
    /// Steps completed.
    pub(crate) done: usize,
    halt: Option<Halt>,
    status: Status,
    /// States of free bodies after each slot.
    pub(crate) lent: Vec<u32>,
}

/// What is brought back behind the status.
pub(crate) struct Behind {
    role: Role,
    part: usize,
    from: u64,
    bytes: u64,
}

impl Behind {
    /// Of a buffer in one part: from that byte on, so many.
    pub(crate) fn of(role: Role, from: u64, bytes: u64) -> Self {
        Self { role, part: 0, from, bytes }
    }

    /// Where particles stand that a pass has written for the next sort.
    pub(crate) fn next(sorted: Sorted, Piece { part, from, bytes }: Piece) -> Self {
        Self { role: Role::Next(sorted), part, from, bytes }
    }

    /// Buffer, first byte, bytes.
    pub(crate) fn place<'a>(&self, memory: &'a Memory, now: usize) -> (&'a wgpu::Buffer, u64, u64) {
        (memory.part(self.role, self.part, now), self.from, self.bytes)
    }
}

/// A pass that is timed.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Clock {
    /// Seconds measured, and passes among them.
    pub(crate) measured: (f64, u64),
    pub(crate) passes: u64,
}

/// The couplings' laws, where they run: as far as any world has asked.
#[derive(Default)]
pub(crate) struct Contact {
    /// On the host, a step at a time: what is near bodies is gathered, and nodes are scattered again.
    pub(crate) host: Option<Box<NearKernels>>,
    /// On the device.
    device: Option<Box<DeviceContact>>,
}

impl Contact {
    /// What the device does in each step.
    fn on_device(&self) -> ContactPasses<'_> {
        let Some(contact) = &self.device else { return ContactPasses::default() };
        let driven: &[Kernel] = if contact.needs.driven { &contact.kernels } else { &[] };
        let (free, with_rims): (&[Kernel], _) =
            contact.free.as_ref().map_or((&[], false), |(free, rims)| (free, *rims));
        ContactPasses { driven, free, with_rims, roams: contact.needs.roams, on_host: false }
    }

    /// Free bodies of each world that the device has room for.
    pub(crate) fn free(&self) -> usize {
        self.device.as_ref().map_or(0, |contact| contact.needs.free.bodies)
    }
}

/// What a world's law asks of the device, or the laws of several worlds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Needs {
    /// Bodies of each world, and vectors of each world's table.
    bodies: usize,
    vectors: usize,
    free: Free,
    /// Are there driven bodies?
    driven: bool,
    /// May bodies come near coarser levels?
    roams: bool,
}

impl Needs {
    /// Of a law for so many bodies, where finest cells have that width [m].
    fn of(law: &DeviceLaw, materials: usize, bodies: usize, h: f64, roams: bool) -> Self {
        // Blocks that a box of the bodies' extents can reach into along an axis.
        let across = |extent: &f64| (2.0 * extent / (4.0 * h)).min(1e6) as usize + 2;
        let free = Free { bodies: law.free.len(), across: law.free.iter().map(across).max().unwrap_or(0) };
        Self { bodies, vectors: law.table.len() + materials, free, driven: law.free.len() < bodies, roams }
    }

    /// Those of both.
    fn with(self, other: Self) -> Self {
        Self {
            bodies: self.bodies.max(other.bodies),
            vectors: self.vectors.max(other.vectors),
            free: Free {
                bodies: self.free.bodies.max(other.free.bodies),
                across: self.free.across.max(other.free.across),
            },
            driven: self.driven || other.driven,
            roams: self.roams || other.roams,
        }
    }
}

/// The law on the device.
pub(crate) struct DeviceContact {
    /// How particles press, the law, then the sums of impulses.
    kernels: [Kernel; 3],
    /// Free bodies' contact and motion; does it move rims, too?
    free: Option<([Kernel; 2], bool)>,
    wgsl: String,
    samples: Vec<[f32; 4]>,
    needs: Needs,
    /// Each world's table.
    tables: Vec<Vec<[f32; 4]>>,
}

/// Bodies of a world over the steps of a submission.
pub(crate) struct Driven {
    /// The coupling before each step, and after the last.
    saved: Vec<Vec<u8>>,
    /// Bodies after each step.
    after: Vec<Vec<BodyState>>,
    /// As the device reads them, step by step.
    packed: Vec<Vec<[f32; 4]>>,
    /// Boxes of blocks near them on each level, likewise.
    near: Vec<Vec<Vec<BlockBox>>>,
    /// Free bodies that the device moves, and what happened to them in each step.
    pub(crate) lent: Vec<Lent>,
    pub(crate) moved: Vec<Vec<Felt>>,
}

/// Steps that follow on one another, after a sort or not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stretch {
    pub(crate) sort: bool,
    pub(crate) steps: usize,
}

/// A part of a submission.
pub(crate) struct Part<'a> {
    /// The set of buffers that it sorts from, if it begins with a sort.
    pub(crate) sorting: Option<usize>,
    pub(crate) dispatches: Vec<Dispatch<'a>>,
}

/// Time of passes, and submissions so far.
#[derive(Debug, Default)]
pub(crate) struct Clocks {
    pub(crate) of: BTreeMap<&'static str, Clock>,
    submissions: u64,
}

/// How many workgroups a dispatch has.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Size {
    /// In a row, and rows.
    Known(u32, u32),
    /// As the device has counted them, at a byte of [`Role::Groups`].
    Counted(u64),
}

/// Particles that come in, laid out level by level.
struct Arrival {
    homes: Vec<Homes>,
    /// What is known of their blocks' rest.
    watched: Vec<Vec<sleep::Words>>,
    planes: Vec<Planes<'static>>,
    particles: ParticleState,
}

/// How a level lies in memory.
type Laid = (Homes, Planes<'static>);

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
    astray: bool,
    /// Steps that drifts are foreseen for.
    horizon: usize,
    /// Room for what submissions begin with writing.
    writes: Writes,
    /// Blocks of nodes near bodies in the last step whose contact was on the host.
    pub(crate) near_blocks: usize,
    pub(crate) clocks: Clocks,
    pub(crate) contact_seconds: (f64, u64),
    /// Time in splitting and merging on the host, and how often.
    pub(crate) adapt_seconds: (f64, u64),
    pub(crate) contact: Contact,
}

/// What digits of dissipated energy come to [J].
pub(crate) fn energy_of(digits: [u32; DAMPED_DIGITS]) -> f64 {
    digits.iter().rev().fold(0.0, |sum, digit| sum * 2f64.powi(32) + f64::from(*digit)) * DAMPED_UNIT
}

/// What all worlds of a batch must have in common.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Fixed {
    world: String,
    /// When it has grown [m/s²], and over what time it grows [s].
    pub(crate) gravity: (Vec3, f64),
    laws: Vec<(String, String, bool)>,
    /// How many there are, steps of the finest in one of the coarsest, boxes of each, and soft bodies that they follow.
    levels: (usize, u32, usize, Vec<u16>),
    /// Of the finest particles of each body, if there are several levels [m³].
    volumes: Vec<f64>,
}

impl Fixed {
    fn of(plan: &Plan) -> Self {
        let law = |m: &barchan_core::plan::PlannedMaterial| {
            (m.material.name.clone(), m.material.origin.clone(), m.damping.is_some())
        };
        Self {
            world: kernels::constants(plan),
            gravity: (plan.scene.gravity, plan.scene.gravity_ramp),
            laws: plan.materials.iter().map(law).collect(),
            levels: (plan.cell_widths.len(), plan.substeps, kernels::boxes(plan), kernels::softs(plan)),
            volumes: if plan.cell_widths.len() > 1 { finest_volumes(plan) } else { Vec::new() },
        }
    }

    /// Refuses a world that differs, by name.
    fn check(&self, plan: &Plan, world: usize) -> Result<()> {
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
fn check_together<'a>(gpu: &Gpu, worlds: &[NewWorld<'a>]) -> Result<(&'a Plan, Fixed)> {
    let Some(NewWorld { plan, .. }) = worlds.first() else {
        return Err(crate::lacks("batch of no worlds", "none is given", "give one at least"));
    };
    let levels = plan.cell_widths.len();
    let fixed = Fixed::of(plan);
    worlds.iter().enumerate().try_for_each(|(w, world)| fixed.check(world.plan, w))?;
    let of_regions = 16 * kernels::region_vectors(plan);
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
        let boxes = (levels - 1) * kernels::boxes(plan);
        let (substeps, softs) = (plan.substeps as usize, count * kernels::softs(plan).len());
        let sleeps = kernels::may_sleep(plan);
        let asked =
            Asked { pairs, layers: count * levels, worlds: count, boxes, substeps, sleeps, softs, ..Asked::default() };
        let memory = Memory::new(&gpu, extent, particles, asked, &params, &kernels.step_layout)?;
        let mut batch = Self {
            gpu,
            kernels,
            memory,
            worlds: worlds.iter().map(|world| World::new(world.plan)).collect(),
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
        let before = std::mem::replace(&mut self.worlds[world], World::new(new.plan));
        let now = &mut self.worlds[world];
        now.levels.clone_from(&before.levels);
        if let Err(error) = self.take_in(vec![(world, new.particles)]) {
            self.worlds[world] = before;
            return Err(error);
        }
        let vectors = parameters(new.plan);
        let at = (16 * vectors.len() * world) as u64;
        self.gpu.queue.write_buffer(&self.memory.params, at, bytemuck::cast_slice(&vectors));
        Ok(())
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
            on_device && world.free == 0 && world.reach.is_none() && world.ask_after.is_none()
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

    /// Zeros for the words of the status from one on to the end of some steps of `dt`, but for what part of gravity there is in each of the
    /// worlds that take part, with their times [s] before the first of these steps.
    pub(crate) fn fresh(&self, from: usize, steps: Range<usize>, dt: f64, active: &[(usize, f64)]) -> Vec<u32> {
        let layout = self.memory.words();
        let mut words = vec![0; layout.of_step(steps.end, 0, 0) - from];
        for &(w, mut time) in active.iter().filter(|(w, _)| self.worlds[*w].scene.gravity_ramp > 0.0) {
            for s in steps.clone() {
                let grown = self.worlds[w].grown(time);
                self.layers_of(w).for_each(|layer| words[layout.of_step(s, layer, GROWN) - from] = grown.to_bits());
                // As a simulation counts it.
                time += dt;
            }
        }
        words
    }

    /// The constants of steps from a slot on: one write, since each takes the queue microseconds.
    pub(crate) fn write_steps(&self, slot: usize, constants: &[StepConstants]) {
        let mut bytes = Vec::new();
        pad(constants, &mut bytes);
        self.gpu.queue.write_buffer(&self.memory.steps, STEP_STRIDE * slot as u64, &bytes);
    }

    pub(crate) fn write_words(&self, from: usize, words: &[u32]) {
        let status = self.memory.buffer(Role::Status, 0);
        self.gpu.queue.write_buffer(status, 4 * from as u64, bytemuck::cast_slice(words));
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

    /// Workgroups of a pass that concerns the levels before one.
    fn size(&self, groups: Groups, end: usize) -> Size {
        let extent = &self.memory.extent;
        let layers = self.memory.words().layers as u32;
        // A sort may find more blocks than there were, up to the room there is.
        let count = match groups {
            Groups::One => 1,
            Groups::Layers => layers,
            Groups::LayersBy(n) => layers.div_ceil(n),
            Groups::Exactly(count) => count,
            Groups::Blocks => extent.block_room,
            Groups::NodeBlocks => extent.node_room.max(extent.block_room),
            Groups::Near => self.memory.near() as u32,
            Groups::BlocksBy(n) => extent.block_room.div_ceil(n),
            Groups::ParticlesBy(n) => self.particles_before(end).div_ceil(n),
            Groups::PlacesBy(n) => extent.places.div_ceil(n),
            Groups::Found(found) => {
                return Size::Counted(12 * (self.levels * found as usize + end - 1) as u64);
            }
        };
        Size::Known(count.min(extent.row), count.div_ceil(extent.row))
    }

    /// Particles of the levels before one: of a world that is alone, those stand together.
    fn particles_before(&self, end: usize) -> u32 {
        match &self.worlds[..] {
            [world] if end < self.levels => world.levels[end - 1].particles.end as u32,
            _ => self.memory.extent.particles,
        }
    }

    /// Parts with the workgroups of their dispatches.
    pub(crate) fn with_groups<'a>(&self, parts: Vec<Part<'a>>) -> Vec<(Part<'a>, Vec<Size>)> {
        let of = |part: &Part<'_>| part.dispatches.iter().map(|d| self.size(d.kernel.groups, d.end)).collect();
        parts.into_iter().map(|part| (of(&part), part)).map(|(groups, part)| (part, groups)).collect()
    }

    /// Writes dispatches into a submission, each in a pass of its own if it is timed.
    pub(crate) fn encode(
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        memory: &mut Memory,
        dispatches: &[(&Dispatch<'_>, Size)],
        queries: Option<&wgpu::QuerySet>,
    ) {
        let bind = |pass: &mut wgpu::ComputePass<'_>, memory: &mut Memory, (d, size): &(&Dispatch<'_>, Size)| {
            pass.set_pipeline(&d.kernel.pipeline);
            pass.set_bind_group(0, &memory.binding(&gpu.device, d.kernel, d.now), &[]);
            pass.set_bind_group(1, &memory.step_binding, &[(STEP_STRIDE * d.step as u64) as u32]);
            match size {
                Size::Known(row, rows) => pass.dispatch_workgroups(*row, *rows, 1),
                Size::Counted(at) => pass.dispatch_workgroups_indirect(memory.buffer(Role::Groups, 0), *at),
            }
        };
        let Some(queries) = queries else {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            dispatches.iter().for_each(|dispatch| bind(&mut pass, memory, dispatch));
            return;
        };
        for (i, dispatch) in dispatches.iter().enumerate() {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some(dispatch.0.kernel.name),
                timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                    query_set: queries,
                    beginning_of_pass_write_index: Some(2 * i as u32),
                    end_of_pass_write_index: Some(2 * i as u32 + 1),
                }),
            });
            bind(&mut pass, memory, dispatch);
        }
    }

    /// Takes steps of `dt` in stretches, each after a sort if it begins with one, without asking the device in between. The worlds
    /// that take part are given with their times [s].
    fn submit(
        &mut self,
        active: &[(usize, f64)],
        dt: f64,
        stretches: &[Stretch],
        mut writes: Writes,
    ) -> Result<Outcome> {
        let count: usize = stretches.iter().map(|s| s.steps).sum();
        debug_assert!(
            count <= MAX_STEPS && !self.worlds.iter().any(|w| w.pending),
            "a submission starts from what is known"
        );
        let sorts = stretches.iter().filter(|s| s.sort).count();
        if sorts > 0 {
            self.cover_blocks(sorts)?;
        }
        writes.add(&self.memory.layers, 0, &self.layers(|w| active.iter().any(|a| a.0 == w)));
        let status = self.memory.buffer(Role::Status, 0);
        let sums = self.memory.words().of_sum(0, 0);
        writes.add(status, 4 * HALTED as u64, &AT_START);
        writes.add(status, 4 * sums as u64, &self.fresh(sums, 0..count.max(1), dt, active));

        let measures = (self.h, self.fixed.gravity.0);
        let is_felt = active.iter().any(|(w, _)| self.worlds[*w].contact == Some(Place::Device));
        let contact = if is_felt { self.contact.on_device() } else { ContactPasses::default() };
        let free = if is_felt { self.contact.free() } else { 0 };
        let mut passes = Passes::new(&self.kernels, contact, &self.schedule, self.memory.now, measures);
        let mut parts = Vec::new();
        for stretch in stretches {
            let sorting = stretch.sort.then_some(passes.now);
            if stretch.sort {
                passes.sort(dt);
            }
            for _ in 0..stretch.steps {
                passes.step(dt);
            }
            // A sort forgets what walls gave.
            if stretch.steps > 0 {
                passes.run(0, &self.kernels.set.collect);
            }
            parts.push(Part { sorting, dispatches: std::mem::take(&mut passes.dispatches) });
        }
        writes.add_steps(&self.memory.steps, &passes.constants);
        let parts = self.with_groups(parts);
        let behind = states(free * self.worlds.len(), count * self.substeps);
        let steps = count.max(1);
        let (status, lent) = Self::run(&writes, &self.gpu, &mut self.memory, &mut self.clocks, &parts, steps, behind)?;
        writes.clear();
        self.writes = writes;
        let halt = status.halt();
        let done = if halt.is_some() { status.words[HALT_STEP] as usize } else { count };
        for &(w, time) in active {
            self.take_steps(&status, w, time, dt, done);
        }
        // Who has left was there in these steps.
        self.take_blocks(&status);
        Ok(Outcome { done, halt, status, lent })
    }

    /// Takes in where blocks are after a submission, and who has left the world.
    pub(crate) fn take_blocks(&mut self, status: &Status) {
        self.take_left(status);
        let sorts = status.words[SORTS] as usize;
        if sorts > 0 {
            self.memory.now ^= sorts & 1;
            self.unlinked = false;
            for (layer, level) in self.worlds.iter_mut().flat_map(|world| &mut world.levels).enumerate() {
                let block = |first: usize| [0, 1, 2].map(|d| status.of_layer(layer, first + d) as i32 - BIAS);
                level.blocks = status.range(layer, FIRST_BLOCK, BLOCKS);
                level.node_blocks = status.range(layer, FIRST_NODE_BLOCK, NODE_BLOCKS);
                level.reach = (!level.blocks.is_empty()).then(|| (block(LEAST_BLOCK), block(GREATEST_BLOCK)));
            }
            self.leave_behind();
        }
        // A sort that was broken off has overwritten the directory.
        self.unlinked |= matches!(status.halt(), Some(Halt::Room | Halt::LeftWorld));
    }

    /// Takes in what sorts found outside the world.
    fn take_left(&mut self, status: &Status) {
        let real = |layer: usize, k: usize| f64::from(f32::from_bits(status.sum(layer, k)));
        for w in 0..self.worlds.len() {
            for (layer, l) in self.layers_of(w).zip(0..) {
                let count = status.sum(layer, LEFT);
                let world = &mut self.worlds[w];
                let mass = real(layer, LEFT_MASS);
                match world.scene.world.leaving {
                    Leaving::Error => {}
                    Leaving::Clamp => world.clamped += u64::from(count),
                    Leaving::Delete => {
                        world.deleted += u64::from(count);
                        world.levels[l].gone += count as usize;
                    }
                }
                world.delete(mass);
                (0..3).for_each(|d| world.wall_impulse[d] += real(layer, LEFT_IMPULSE + d));
            }
        }
    }

    /// A sort has left behind those that were to go.
    fn leave_behind(&mut self) {
        let mut slot = 0;
        for level in self.worlds.iter_mut().flat_map(|world| &mut world.levels) {
            let count = level.particles.len() - std::mem::take(&mut level.gone);
            level.particles = slot..slot + count;
            slot += count;
        }
        if slot != self.particles() {
            self.memory.count(&self.gpu, slot);
        }
    }

    /// Takes in what steps did to a world. In one that is subcycled, particles may have moved too far in one of them.
    pub(crate) fn take_steps(&mut self, status: &Status, w: usize, time: f64, dt: f64, done: usize) {
        let layers = self.layers_of(w);
        let mut moves =
            (0..done).flat_map(|s| layers.clone().map(move |layer| f64::from(status.in_step(s, layer, MOVE))));
        if let Some(moves) = moves.find(|moves| self.substeps > 1 && (moves.is_nan() || *moves > MAX_MOVE)) {
            self.worlds[w].torn = Some((dt, MAX_MOVE * dt / moves));
        }
        let world = &mut self.worlds[w];
        for (layer, level) in layers.zip(&mut world.levels) {
            let sorted = status.sorted_before(layer);
            if sorted.is_some() {
                level.rhythm = Rhythm::default();
            }
            let steps = level.steps_within;
            for s in sorted.unwrap_or(0)..done {
                level.rhythm = level.rhythm.after(steps as f32 * status.in_step(s, layer, MOVE));
            }
            if let Some(last) = done.checked_sub(1) {
                let each = dt / f64::from(steps);
                level.particle_speed = f64::from(status.in_step(last, layer, MOVE)) * level.h / each;
            }
        }
        if done > 0 {
            world.last_dt = dt;
        }
        world.steps += done as u64;
        world.stiffness_age += done as u32;
        world.book_gravity(time, dt, done);
        self.take_sums(status, w);
        if let Some(last) = done.checked_sub(1) {
            self.take_needs(status, w, last);
        }
    }

    /// What particles need after a step, as far as laws are asked on the device.
    pub(crate) fn take_needs(&mut self, status: &Status, w: usize, step: usize) {
        let layers = self.layers_of(w);
        if self.worlds[w].stiffens {
            self.worlds[w].take_needs(layers.map(|layer| f32::from_bits(status.sum(layer, NEED + step % 2))));
        }
    }

    /// What was summed on the device in a submission.
    pub(crate) fn take_sums(&mut self, status: &Status, w: usize) {
        for layer in self.layers_of(w) {
            let world = &mut self.worlds[w];
            world.parted += u64::from(status.sum(layer, PARTED));
            world.damped += energy_of(std::array::from_fn(|k| status.sum(layer, DAMPED + k)));
            for d in 0..3 {
                world.wall_impulse[d] += f64::from(f32::from_bits(status.sum(layer, WALL_IMPULSE + d)));
            }
            let slept = world.slept.add(std::array::from_fn(|k| status.sum(layer, SLEPT + k)));
            world.unbook_gravity(layer % self.levels, slept);
        }
    }

    /// Cuts steps into stretches between sorts, as far as the present speeds tell when worlds will be due, or might be. Where they tell wrong, a sort
    /// that nobody needs leaves all particles as they are, and the device stops before a step that needs one.
    fn plan_stretches(&self, active: &[(usize, f64)], dt: f64, count: usize) -> Vec<Stretch> {
        let of_world = |&(w, _): &(usize, f64)| {
            let each = |level: &Level| {
                let each = (level.particle_speed * dt / level.h) as f32;
                Foresight { foreseen: level.rhythm, faster: level.rhythm, each }
            };
            self.worlds[w].levels.iter().map(each).collect()
        };
        // To sort many takes longer than to be stopped; levels would look for those on a wrong one, and of many worlds one might always be due.
        let guesses = self.levels == 1 && self.worlds.len() == 1 && self.particles() < MANY;
        let is_due = |world: &Vec<Foresight>| world.iter().any(|level| level.foreseen.is_due(self.most_drift));
        let might_be = |world: &Vec<Foresight>| guesses && world.iter().any(|level| level.faster.is_far());
        let mut worlds: Vec<Vec<Foresight>> = active.iter().map(of_world).collect();
        let (mut stretches, mut sorts): (Vec<Stretch>, usize) = (Vec::new(), 0);
        for step in 0..count.min(self.horizon) {
            let sort = (step == 0 && self.unlinked) || worlds.iter().any(|world| is_due(world) || might_be(world));
            // Where the directory's boxes have to change they do so before a submission, and fit the blocks from its first sort on.
            if sort && stretches.first().is_some_and(|first| !first.sort) && !self.covers(1 + sorts) {
                break;
            }
            // A sort that stops the submission is one by itself: steps behind it would be written for nothing, and before it levels may have to follow
            // their agents.
            if sort && self.astray && step > 0 {
                break;
            }
            sorts += usize::from(sort);
            if sort || stretches.is_empty() {
                stretches.push(Stretch { sort, steps: 0 });
            }
            if sort && self.astray {
                break;
            }
            for world in &mut worlds {
                let sorted = is_due(world);
                world.iter_mut().for_each(|level| level.step(sorted));
            }
            stretches.iter_mut().next_back().expect("there is one").steps += 1;
        }
        stretches
    }

    /// Writes what is to be written, runs parts and brings back the status with the words of so many steps, and what is asked for besides, one after the
    /// other.
    pub(crate) fn run(
        writes: &Writes,
        gpu: &Gpu,
        memory: &mut Memory,
        clocks: &mut Clocks,
        parts: &[(Part<'_>, Vec<Size>)],
        steps: usize,
        behind: impl IntoIterator<Item = Behind>,
    ) -> Result<(Status, Vec<u32>)> {
        // The first is not worth timing: caches are cold. Of the others, the first part stands for all.
        let timed = gpu.features.contains(wgpu::Features::TIMESTAMP_QUERY) && clocks.submissions % TIMED == 1;
        clocks.submissions += 1;
        let first = if timed { parts.first().map_or(0, |(part, _)| part.dispatches.len().min(MOST_TIMED)) } else { 0 };
        let queries = (first > 0).then(|| {
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("clock"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * first as u32,
            })
        });
        let fresh = || gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let (mut encoder, mut unsent, mut piece) = (fresh(), 0, PIECE);
        memory.write(gpu, &mut encoder, writes);
        for (i, (part, groups)) in parts.iter().enumerate() {
            if let Some(now) = part.sorting {
                encoder.clear_buffer(memory.buffer(Role::Flags, now), 0, None);
            }
            let dispatches: Vec<_> = part.dispatches.iter().zip(groups.iter().copied()).collect();
            let (timed, mut rest) = dispatches.split_at(if i == 0 { first } else { 0 });
            if !timed.is_empty() {
                Self::encode(gpu, &mut encoder, memory, timed, queries.as_ref());
            }
            while !rest.is_empty() {
                let (some, others) = rest.split_at(rest.len().min(piece - unsent));
                Self::encode(gpu, &mut encoder, memory, some, None);
                rest = others;
                unsent += some.len();
                if unsent >= piece {
                    gpu.queue.submit([std::mem::replace(&mut encoder, fresh()).finish()]);
                    (unsent, piece) = (0, 2 * piece);
                }
            }
        }
        let layout = memory.words();
        let status = Behind::of(Role::Status, 0, 4 * layout.count(steps) as u64);
        let back: Vec<_> = [status].into_iter().chain(behind).filter(|some| some.bytes > 0).collect();
        let bytes = back.iter().map(|some| some.bytes).sum();
        memory.read_back_to(gpu, bytes);
        let mut at = 0;
        for (buffer, from, bytes) in back.iter().map(|some| some.place(memory, memory.now)) {
            encoder.copy_buffer_to_buffer(buffer, from, &memory.readback, at, bytes);
            at += bytes;
        }
        let resolved = queries.map(|queries| {
            let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("clock"),
                size: 16 * first as u64,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            encoder.resolve_query_set(&queries, 0..2 * first as u32, &buffer, 0);
            buffer
        });
        gpu.queue.submit([encoder.finish()]);
        // The device works meanwhile.
        for dispatch in parts.iter().flat_map(|(part, _)| &part.dispatches) {
            clocks.of.entry(dispatch.kernel.name).or_default().passes += 1;
        }
        let mut words = Vec::new();
        with_mapped(gpu, &memory.readback, bytes, |bytes| words = bytemuck::pod_collect_to_vec(bytes))?;
        if let (Some(buffer), Some((part, _))) = (resolved, parts.first()) {
            let ticks: Vec<u64> = read(gpu, &buffer, 0, 2 * first)?;
            let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-9;
            for (dispatch, pair) in part.dispatches.iter().zip(ticks.chunks_exact(2)) {
                let clock = clocks.of.entry(dispatch.kernel.name).or_default();
                clock.measured.0 += pair[1].saturating_sub(pair[0]) as f64 * period;
                clock.measured.1 += 1;
            }
        }
        let found = words.split_off(layout.count(steps));
        Ok((Status::new(words, layout), found))
    }

    /// Do the worlds' parts of the directory cover all blocks that so many sorts can find?
    fn covers(&self, sorts: usize) -> bool {
        let covers = |world: &World| world.levels.iter().zip(world.spans(sorts, 0)).all(|(l, s)| l.span.holds(s));
        self.worlds.iter().all(covers)
    }

    /// Sets the worlds' parts of the directory so that they cover all blocks that so many sorts can find, if they do not.
    pub(crate) fn cover_blocks(&mut self, sorts: usize) -> Result<()> {
        if self.covers(sorts) {
            return Ok(());
        }
        let spans: Vec<Vec<Span>> =
            self.worlds.iter().map(|world| world.spans(sorts, SPARE_BLOCKS).collect()).collect();
        let room = |span: &Span| span.places().min(u64::from(u32::MAX)).next_multiple_of(u64::from(PLACES));
        let places: u64 = spans.iter().flatten().map(room).sum();
        // The same rule as for all buffers finds what is too large for the adapter; this one keeps the number a u32.
        let extent = Extent { places: u32::try_from(places).unwrap_or(!(PLACES - 1)), ..self.memory.extent };
        if extent != self.memory.extent {
            self.memory.grow(&self.gpu, extent)?;
        }
        for (world, spans) in self.worlds.iter_mut().zip(spans) {
            world.levels.iter_mut().zip(spans).for_each(|(level, span)| level.span = span);
        }
        Ok(())
    }

    /// Makes room for as many blocks as the last sort found, and a quarter more.
    pub(crate) fn make_room(&mut self, status: &Status) -> Result<()> {
        let mut extent = self.memory.extent;
        extent.block_room = extent.block_room.max(with_room(status.words[NEW_BLOCKS] as usize));
        extent.node_room = extent.node_room.max(with_room(status.words[NEW_NODE_BLOCKS] as usize));
        if self.substeps > 1 {
            extent.giver_room = extent.giver_room.max(with_room(status.words[GIVERS] as usize));
        }
        self.unlinked = true;
        self.memory.grow(&self.gpu, extent)
    }

    /// Sorts what is due at once. Are particles on another level than they should be?
    pub(crate) fn sort(&mut self, world: usize) -> Result<bool> {
        // One that is done before it finds too little room for lists leaves nobody due for the next.
        let mut astray = false;
        loop {
            let writes = std::mem::take(&mut self.writes);
            let outcome = self.submit(&[(world, 0.0)], 0.0, &[Stretch { sort: true, steps: 0 }], writes)?;
            astray |= outcome.status.is_astray(self.layers_of(world));
            match outcome.halt {
                None | Some(Halt::Fewer) => return Ok(astray),
                Some(Halt::Misplaced) => return Ok(true),
                Some(Halt::Room) => self.make_room(&outcome.status)?,
                Some(_) => return Err(self.left_world(world, &outcome.status)),
            }
        }
    }

    /// The world of a particle that a halt names.
    pub(crate) fn world_of(&self, status: &Status) -> Option<usize> {
        let who = status.words[WHO] as usize;
        self.worlds.iter().position(|world| world.particles().contains(&who))
    }

    fn left_world(&self, world: usize, status: &Status) -> Error {
        let step = self.worlds[world].steps;
        match self.lists(world).map(|lists| self.find(world, &lists, status.words[WHO] as usize)) {
            Ok(Some((particle, position, _))) => Error::LeftWorld { step, particle, position },
            Ok(None) => Error::LeftWorld { step, particle: u64::MAX, position: [f64::NAN; 3] },
            Err(error) => error,
        }
    }

    /// Id, position and material of the particle in a slot.
    fn find(
        &self,
        world: usize,
        (lists, laid): &(Vec<ParticleList>, Vec<Laid>),
        slot: usize,
    ) -> Option<(u64, Vec3, usize)> {
        let world = &self.worlds[world];
        let l = world.levels.iter().position(|level| level.particles.contains(&slot))?;
        let (slot, (homes, planes)) = (slot - world.levels[l].particles.start, &laid[l]);
        let law = planes.law(slot);
        // Lists go by places, not by slots.
        let own = homes.places().into_iter().map(|(q, _)| q).filter(|&q| planes.law(q) == law);
        let (i, list) = own.zip(0..).find(|(q, _)| *q == slot).zip(lists.get(l * world.materials.len() + law))?;
        Some((*list.id.get(i.1)?, list.position(i.1), law))
    }

    /// Turns a halt that no shorter step mends into what a user can act upon.
    pub(crate) fn explain(&self, w: usize, status: &Status, speed: f64, time: f64) -> Error {
        if let Some(error) = self.find_non_finite(w, time) {
            return error;
        }
        let who = status.words[WHO] as usize;
        match status.halt() {
            Some(Halt::LeftWorld) => self.left_world(w, status),
            Some(Halt::Strayed) => match self.lists(w).map(|l| self.find(w, &l, who)) {
                Ok(Some((particle, _, law))) => self.non_finite(w, "cell", (particle, law), f64::NAN, 1, time),
                Ok(None) => self.non_finite(w, "cell", (u64::MAX, 0), f64::NAN, 1, time),
                Err(error) => error,
            },
            _ => Error::NonFinite {
                step: self.worlds[w].steps,
                time,
                field: "node velocity",
                particle: 0,
                list: loaded(&self.worlds[w].materials),
                value: speed,
                count: 0,
            },
        }
    }

    fn non_finite(
        &self,
        w: usize,
        field: &'static str,
        (particle, law): (u64, usize),
        value: f64,
        count: u64,
        time: f64,
    ) -> Error {
        let world = &self.worlds[w];
        let list = world.materials[law % world.materials.len()].label();
        Error::NonFinite { step: world.steps, time, field, particle, list, value, count }
    }

    /// The particle of least id with a NaN or infinite value.
    fn find_non_finite(&self, w: usize, time: f64) -> Option<Error> {
        match self.lists(w) {
            Ok((lists, ..)) => account::find_non_finite(&lists, |field, particle, law, value, count| {
                self.non_finite(w, field, (particle, law), value, count, time)
            }),
            Err(error) => Some(error),
        }
    }

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
            let last = held(Sorted::Rest).pop().expect("volumes are in the last");
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
    fn planes(&self, level: &Level) -> Result<Planes<'static>> {
        let (first, count) = (level.particles.start, level.particles.len());
        let of = |sorted: Sorted| self.memory.held(sorted, first, count);
        let stretches: Vec<_> = [Sorted::Record, Sorted::Ids, Sorted::Rest].into_iter().flat_map(of).collect();
        Ok(Planes::of_words(&read_all(&self.gpu, &stretches)?, count).into_owned())
    }

    /// A world's particles, with the phase of the sort and of its levels.
    pub(crate) fn state(&self, w: usize) -> Result<ParticleState> {
        let (lists, laid) = self.lists(w)?;
        let (world, rhythms) = (&self.worlds[w], self.rhythms(w));
        let of_level = |(l, (homes, planes)): (usize, &Laid)| planes.counts(homes, world.materials.len(), l);
        let blocks: Vec<_> = laid.iter().enumerate().flat_map(of_level).collect();
        let sort = Some(SortPhase {
            // A world's levels are sorted together.
            age: rhythms.first().map_or(0, |rhythm| rhythm.age),
            drift: rhythms.iter().map(|rhythm| f64::from(rhythm.drift)).collect(),
            measured: Measured {
                stiffness_bound: world.stiffness().dt,
                stiffness_age: world.stiffness_age,
                mass: world.mass,
                least_mass: world.least_mass,
            },
            rest: self.rests(w)?.concat(),
            blocks,
            kept_for: vec![None; rhythms.len()],
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
    fn stretch<T: bytemuck::Pod>(&self, sorted: Sorted, first: usize, count: usize) -> Result<Vec<T>> {
        self.stretch_of(sorted, usize::MAX, first, count)
    }

    /// What the first planes of a buffer hold of so many particles.
    fn stretch_of<T: bytemuck::Pod>(
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

    /// Replaces the particles of some worlds.
    ///
    /// 1. The new ones are laid out. Homes of the others are asked of the device.
    /// 2. Particles go to the other set of buffers, each world behind the one before; so do the lists of blocks, without their links: a sort
    ///    finds them before the next step. It leaves homes as they are, since nobody is due.
    /// 3. Stress of the new ones is found from their strain.
    pub(crate) fn take_in(&mut self, news: Vec<(usize, ParticleState)>) -> Result<()> {
        let mut arrivals = BTreeMap::new();
        for (w, particles) in news {
            arrivals.insert(w, self.arrival(w, particles)?);
        }
        let all = self.worlds.len();
        let mut homes =
            if arrivals.len() < all { self.homes(0..all)? } else { vec![Homes::default(); self.memory.words().layers] };
        let mut watched =
            if arrivals.len() < all { self.watched(0..all)? } else { vec![Vec::new(); self.memory.words().layers] };
        for (w, arrival) in &arrivals {
            homes[self.layers_of(*w)].clone_from_slice(&arrival.homes);
            watched[self.layers_of(*w)].clone_from_slice(&arrival.watched);
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

        let before: Vec<_> = self.all_levels().map(|level| level.particles.clone()).collect();
        let (mut slot, mut block) = (0, 0);
        let levels = self.worlds.iter_mut().flat_map(|world| &mut world.levels);
        for ((level, homes), count) in levels.zip(&homes).zip(&counts) {
            level.particles = slot..slot + count;
            level.blocks = block..block + homes.blocks.len();
            level.reach = homes.extent();
            (slot, block) = (level.particles.end, level.blocks.end);
        }
        self.write_particles(&arrivals, &before);
        self.write_lists(&homes, &watched);
        self.memory.now = 1 - self.memory.now;
        self.unlinked = true;
        self.cover_blocks(1)?;

        for (w, arrival) in &arrivals {
            let spoilt = account::find_non_finite(&arrival.particles.lists, |field, particle, law, value, count| {
                self.non_finite(*w, field, (particle, law), value, count, 0.0)
            });
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
                world.adapt.restore(phase.clone());
            }
            let ids = arrival.particles.lists.iter().flat_map(|list| &list.id);
            world.adapt.next_id = ids.max().map_or(0, |id| id + 1).max(world.adapt.next_id);
            self.write_regions(*w, Candidates::None);
            let world = &mut self.worlds[*w];
            world.torn = None;
            world.spoilt = spoilt.is_some();
            world.take_stock(&arrival.particles.lists, arrival.particles.sort.as_ref())?;
        }
        if self.worlds.iter().any(|world| world.reach.is_some()) {
            self.write_live()?;
        }
        self.find_stress(&arrivals)
    }

    /// Lays out particles that come into a world.
    fn arrival(&self, w: usize, mut particles: ParticleState) -> Result<Arrival> {
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
        let lay = |((lists, _), homes): ((&[ParticleList], &Level), &Homes)| {
            let count = lists.iter().map(ParticleList::len).sum();
            Planes::of(lists, homes, materials, count, rest_vectors(materials))
        };
        let planes = of_levels().zip(&homes).map(lay).collect::<Result<_>>()?;
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
    fn write_particles(&self, arrivals: &BTreeMap<usize, Arrival>, before: &[Range<usize>]) {
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
    fn write_lists(&self, homes: &[Homes], watched: &[Vec<sleep::Words>]) {
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

    /// Stress is no part of a state: it follows from strain.
    fn find_stress(&mut self, arrivals: &BTreeMap<usize, Arrival>) -> Result<()> {
        let fit = |w: usize| !self.worlds[w].spoilt && !self.worlds[w].particles().is_empty();
        let mut by_step: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (&w, arrival) in arrivals.iter().filter(|(w, _)| fit(**w)) {
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

    /// Up to `count` steps of at most `dt` of the worlds that have a turn, without couplings or with such as run on the device. A world that
    /// fails is left out, and the others go on without it.
    fn advance(
        &mut self,
        mut dt: f64,
        mut count: usize,
        turns: &mut [Turn<'_>],
        lent: &[Vec<Lent>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        self.settle()?;
        let mut failed: Vec<Option<Error>> = turns.iter().map(|turn| self.fault(turn)).collect();
        loop {
            let going: Vec<usize> = (0..turns.len()).filter(|&t| failed[t].is_none()).collect();
            let active: Vec<(usize, f64)> = going.iter().map(|&t| (turns[t].world, turns[t].time)).collect();
            if active.is_empty() {
                return Ok(failed.into_iter().map(|error| Err(error.expect("all have failed"))).collect());
            }
            let mut stretches = self.plan_stretches(&active, dt, count);
            let mut steps = stretches.iter().map(|s| s.steps).sum();
            let mut driven = BTreeMap::new();
            for &t in &going {
                match self.drive(&mut turns[t], dt, steps, &lent[t]) {
                    Ok(of_turn) => {
                        steps = of_turn.as_ref().map_or(steps, |driven| driven.after.len());
                        driven.insert(t, of_turn);
                    }
                    Err(error) => failed[t] = Some(error),
                }
            }
            if driven.len() < going.len() {
                for (t, of_turn) in &driven {
                    go_back(turns[*t].couplings, of_turn, 0)?;
                }
                continue;
            }
            cut(&mut stretches, steps);
            self.write_bodies(turns, &driven, steps);
            let mut writes = std::mem::take(&mut self.writes);
            self.write_lent(turns, lent, &mut writes);
            self.write_near(turns, &driven, steps)?;
            let outcome = self.submit(&active, dt, &stretches, writes)?;
            if stretches[0].sort {
                self.astray = outcome.halt == Some(Halt::Misplaced);
            }
            match outcome.halt {
                Some(Halt::Drifted | Halt::TooStiff) => self.horizon = FEW_STEPS,
                None if outcome.done == self.horizon => self.horizon = MAX_STEPS.min(2 * self.horizon),
                _ => {}
            }
            for (t, of_turn) in &mut driven {
                go_back(turns[*t].couplings, of_turn, outcome.done)?;
                failed[*t] = self.adopt(&mut turns[*t], of_turn, &outcome).err();
                let world = turns[*t].world;
                if outcome.status.is_astray(self.layers_of(world)) && self.worlds[world].torn.is_none() {
                    self.adapt(world, None, turns[*t].couplings)?;
                }
            }
            for &t in &going {
                failed[t] = failed[t].take().or_else(|| self.fault(&turns[t]));
            }
            if outcome.done > 0 {
                // What stopped the others is found again when they are tried again.
                return self.reports(turns, failed, driven, &outcome, dt);
            }
            match outcome.halt {
                Some(Halt::Room) => self.make_room(&outcome.status)?,
                // A sort on its own, or one that others have to follow.
                None | Some(Halt::Fewer | Halt::Misplaced | Halt::Follow) => {}
                Some(Halt::Drifted) if !stretches[0].sort => {}
                // Who asked for the steps decides how long the others are.
                Some(Halt::TooFast) => (dt, count) = (self.shorten(turns, &mut failed, &outcome, dt), 1),
                _ => {
                    // It cannot be told whose fault it was only if no particle is named.
                    let culprit = self.world_of(&outcome.status).unwrap_or(active[0].0);
                    let t = going.iter().copied().find(|&t| turns[t].world == culprit).unwrap_or(going[0]);
                    failed[t] = Some(self.explain(turns[t].world, &outcome.status, f64::NAN, turns[t].time));
                }
            }
        }
    }

    /// What is wrong with a world's particles as they came in.
    pub(crate) fn fault(&self, turn: &Turn<'_>) -> Option<Error> {
        let world = &self.worlds[turn.world];
        if world.spoilt || world.torn.is_some() {
            let torn = world.torn.map(|(dt, bound)| Error::TimeStep {
                step: world.steps,
                dt,
                bound,
                by:
                    "the speed of a particle within a subcycled step: set levels.subcycle = false, or lower time.safety"
                        .into(),
            });
            self.find_non_finite(turn.world, turn.time).or(torn)
        } else {
            None
        }
    }

    /// The step that the fastest world bears; worlds that bear none have failed.
    fn shorten(&mut self, turns: &[Turn<'_>], failed: &mut [Option<Error>], outcome: &Outcome, dt: f64) -> f64 {
        let mut fastest = 0.0f64;
        for t in (0..turns.len()).filter(|&t| failed[t].is_none()).collect::<Vec<_>>() {
            let Turn { world, time, .. } = turns[t];
            let speed = outcome.status.speed(0, self.layers_of(world));
            let moves = speed * dt / self.h;
            if !moves.is_finite() {
                failed[t] = Some(self.explain(world, &outcome.status, speed, time));
            } else if moves > NODE_MOVE * (1.0 - 1e-6) {
                self.worlds[world].shortened += 1;
                fastest = fastest.max(moves);
            }
        }
        // What was too fast may have been left out.
        if fastest > 0.0 { dt * (0.9 * NODE_MOVE / fastest).max(0.1) } else { dt }
    }

    /// What each turn's world did in the steps that are done.
    fn reports(
        &mut self,
        turns: &mut [Turn<'_>],
        failed: Vec<Option<Error>>,
        mut driven: BTreeMap<usize, Option<Driven>>,
        outcome: &Outcome,
        dt: f64,
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let feels = driven.values().any(Option::is_some);
        let impulses = if feels { self.impulses(outcome.done)? } else { Vec::new() };
        let mut all = Vec::new();
        for (t, error) in failed.into_iter().enumerate() {
            let world = turns[t].world;
            let layers = self.layers_of(world);
            let sorted = outcome.status.sorted_before(layers.start);
            let report = |s: usize| StepReport {
                dt,
                sorted: sorted == Some(s),
                max_speed: outcome.status.speed(s, layers.clone()),
                ..StepReport::default()
            };
            let mut reports: Vec<_> = (0..outcome.done).map(report).collect();
            if let Some(driven) = driven.remove(&t).flatten() {
                self.report_bodies(driven, &impulses, &mut turns[t], &mut reports);
            }
            all.push(error.map_or(Ok(reports), Err));
        }
        Ok(all)
    }

    /// Finds out where the law of a world's bodies runs: on the device if it can run there and the other worlds' law is the same; else on the
    /// host.
    fn settle_contact(&mut self, w: usize, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        if self.worlds[w].contact.is_some() {
            return Ok(());
        }
        let mut place = if couplings.is_empty() { Place::Nowhere } else { Place::Host };
        if let Some((law, bodies)) = device_law(couplings) {
            let adapt = &self.worlds[w].adapt;
            let roams = couplings.iter().flat_map(|coupling| coupling.bodies()).any(|body| !adapt.follows(&body.name));
            let needs = Needs::of(&law, self.worlds[w].materials.len(), bodies, self.h, roams);
            // One world alone may have other bodies from now on.
            let before = self.contact.device.as_ref().filter(|_| self.worlds.len() > 1);
            let all = before.map_or(needs, |contact| contact.needs.with(needs));
            let is_same = |contact: &DeviceContact| contact.wgsl == law.wgsl && contact.samples == law.samples;
            let is_known = self.contact.device.as_deref().is_some_and(is_same);
            let vectors = self.worlds.len() * all.vectors + law.samples.len();
            if (is_known || before.is_none()) && self.has_room(all.free, vectors) {
                if !is_known || self.contact.device.as_ref().is_some_and(|contact| contact.needs != all) {
                    self.add_law(&law, all)?;
                }
                self.write_table(w, law.table);
                self.worlds[w].free = law.free.len();
                place = Place::Device;
            }
        }
        self.gpu.check()?;
        self.worlds[w].contact = Some(place);
        Ok(())
    }

    /// Is there room on the device for what is inside so many free bodies, and for tables of so many vectors?
    fn has_room(&self, free: Free, vectors: usize) -> bool {
        let cap = self.gpu.limits.max_storage_buffer_binding_size.min(self.gpu.limits.max_buffer_size);
        free.rooms() <= MOST_ROOMS && lent_bytes(free, self.worlds.len(), self.levels).max(16 * vectors as u64) <= cap
    }

    /// Teaches the device a law.
    fn add_law(&mut self, law: &DeviceLaw, needs: Needs) -> Result<()> {
        let (worlds, Needs { bodies, vectors, free, .. }) = (self.worlds.len(), needs);
        let shape = [worlds, self.levels];
        let materials = self.worlds[0].materials.len();
        let kernels = kernels::contact(&self.gpu, &self.kernels, law, [bodies, vectors, materials], shape);
        let of_free = (free.bodies > 0)
            .then(|| kernels::free(&self.gpu, &self.kernels, law, [vectors, materials], shape, free, needs.roams));
        self.memory.add_bodies(&self.gpu, [bodies, worlds * vectors], free, &law.samples)?;
        self.unlinked = true;
        let before = self.contact.device.take().map_or_else(|| vec![Vec::new(); worlds], |contact| contact.tables);
        let (wgsl, samples, tables) = (law.wgsl.clone(), law.samples.clone(), vec![Vec::new(); worlds]);
        self.contact.device = Some(Box::new(DeviceContact { kernels, free: of_free, wgsl, samples, needs, tables }));
        before.into_iter().enumerate().for_each(|(w, table)| self.write_table(w, table));
        Ok(())
    }

    /// Tells the device what the law of a world's bodies reads.
    fn write_table(&mut self, w: usize, table: Vec<[f32; 4]>) {
        if let (Some(contact), Some(buffer)) = (&mut self.contact.device, &self.memory.table) {
            let at = (16 * contact.needs.vectors * w) as u64;
            let materials = self.worlds[w].contact_materials.clone();
            let mut all = table.clone();
            all.resize(contact.needs.vectors - materials.len(), [0.0; 4]);
            all.extend(materials);
            self.gpu.queue.write_buffer(buffer, at, bytemuck::cast_slice(&all));
            contact.tables[w] = table;
        }
    }

    /// Lets a world's driven bodies go through up to `count` steps: no further than to where its levels have to move after them.
    fn drive(&self, turn: &mut Turn<'_>, dt: f64, count: usize, lent: &[Lent]) -> Result<Option<Driven>> {
        let couplings = &mut *turn.couplings;
        let Some(coupling) = couplings.first() else { return Ok(None) };
        let saved = vec![coupling.save()];
        let mut driven = Driven {
            saved,
            after: Vec::new(),
            packed: Vec::new(),
            near: Vec::new(),
            lent: lent.to_vec(),
            moved: Vec::new(),
        };
        let bodies = self.contact.device.as_ref().map_or(0, |contact| contact.needs.bodies);
        // Bodies that are all lent stay where they are until they come back: one step is like the next.
        let all_lent = lent.len() == coupling.bodies().len();
        let seen = if all_lent { count.min(1) } else { count };
        let mut go = || {
            let each = dt / self.substeps as f64;
            let levels = &self.worlds[turn.world].levels;
            // Soft ones are watched by the device.
            let softs = self.worlds[turn.world].softs.boxes(self.h);
            let mut time = turn.time;
            for slot in 0..seen * self.substeps {
                let at = self.schedule.time_of(slot % self.substeps, time, dt);
                if self.may_sleep() {
                    driven.near.push(sleep::near_tools(couplings, levels));
                }
                couplings[0].before_step(at, each)?;
                // Levels that step together meet bodies where they are before the step; subcycled, coarser ones where they are after it.
                let (before, after) = levels.split_at(if self.substeps > 1 { 1 } else { levels.len() });
                let mut packed = pack_all(couplings[0].as_ref(), before, lent, bodies);
                couplings[0].after_step(at, each)?;
                packed.extend(pack_all(couplings[0].as_ref(), after, lent, bodies));
                driven.packed.push(packed);
                if (slot + 1) % self.substeps == 0 {
                    // As a simulation counts it: a path knows the last bit.
                    time += dt;
                    driven.after.push(couplings[0].bodies());
                    driven.saved.push(couplings[0].save());
                    if self.worlds[turn.world].adapt.must_follow(couplings, |body| softs.get(&body).copied()) {
                        break;
                    }
                }
            }
            Ok(())
        };
        if let Err(error) = go() {
            go_back(turn.couplings, &Some(driven), 0)?;
            return Err(error);
        }
        if all_lent {
            go_on(&mut driven.after, count);
            go_on(&mut driven.saved, count + 1);
            go_on(&mut driven.near, count * self.substeps);
        }
        Ok(Some(driven))
    }

    /// Tells the device where bodies are in each step.
    fn write_bodies(&self, turns: &[Turn<'_>], driven: &BTreeMap<usize, Option<Driven>>, steps: usize) {
        let Some(contact) = self.contact.device.as_ref().filter(|contact| contact.needs.driven) else { return };
        let each = self.levels * contact.needs.bodies * BODY as usize;
        // Of worlds that have none there.
        let nowhere = NOWHERE.repeat(steps * self.substeps * self.worlds.len() * each / NOWHERE.len());
        let mut packed = nowhere;
        for (t, driven) in driven {
            // Another world may have stopped sooner.
            let packed_of = driven.iter().flat_map(|driven| &driven.packed).take(steps * self.substeps);
            for (s, bodies) in packed_of.enumerate() {
                packed[(s * self.worlds.len() + turns[*t].world) * each..][..each].copy_from_slice(bodies);
            }
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Bodies, 0), 0, bytemuck::cast_slice(&packed));
    }

    /// Tells the device near what nothing sleeps in each step.
    fn write_near(&mut self, turns: &[Turn<'_>], driven: &BTreeMap<usize, Option<Driven>>, steps: usize) -> Result<()> {
        if !self.may_sleep() {
            return Ok(());
        }
        let mut near = vec![vec![Vec::new(); self.memory.words().layers]; steps * self.substeps];
        for (t, driven) in driven {
            let layers = self.layers_of(turns[*t].world);
            for (near, own) in near.iter_mut().zip(driven.iter().flat_map(|driven| &driven.near)) {
                near[layers.clone()].clone_from_slice(own);
            }
        }
        self.write_tools(0, &near)
    }

    /// Force and torque on each body of each world in each step, times the step.
    fn impulses(&self, steps: usize) -> Result<Vec<[f32; 4]>> {
        let Some(contact) = self.contact.device.as_ref().filter(|contact| contact.needs.driven) else {
            return Ok(Vec::new());
        };
        let count = 2 * contact.needs.bodies * self.memory.words().layers * self.substeps * steps;
        read(&self.gpu, self.memory.buffer(Role::Impulses, 0), 0, count)
    }

    /// Says in each step's report where a world's bodies were and what they felt.
    fn report_bodies(&self, driven: Driven, impulses: &[[f32; 4]], turn: &mut Turn<'_>, reports: &mut [StepReport]) {
        let Some(contact) = &self.contact.device else { return };
        let each = 2 * contact.needs.bodies;
        let Driven { after, lent, moved, .. } = driven;
        for (s, (report, mut after)) in reports.iter_mut().zip(after).enumerate() {
            // Over all levels' steps within this one.
            let sum = |k: usize| {
                let mut sum = [0.0; 3];
                for slot in (0..self.substeps).filter(|_| !impulses.is_empty()) {
                    let has_stepped = |level: &usize| self.substeps == 1 || (slot + 1) % (1 << level) == 0;
                    for level in (0..self.levels).filter(has_stepped) {
                        let row = ((s * self.substeps + slot) * self.worlds.len() + turn.world) * self.levels + level;
                        (0..3).for_each(|d| sum[d] += f64::from(impulses[row * each + k][d]));
                    }
                }
                sum
            };
            let per_step = |impulse: Vec3| impulse.map(|x| x / report.dt);
            let wrench = |body: usize| Wrench { force: per_step(sum(2 * body)), torque: per_step(sum(2 * body + 1)) };
            let mut wrenches: Vec<_> = (0..after.len()).map(wrench).collect();
            for (lent, felt) in lent.iter().zip(moved.get(s).into_iter().flatten()) {
                after[lent.body] = felt.body.clone();
                wrenches[lent.body] =
                    Wrench { force: per_step(felt.impulse.force), torque: per_step(felt.impulse.torque) };
            }
            report.wrenches = Some(wrenches);
            report.bodies = Some(after);
        }
        if let (Some(StepReport { wrenches: Some(wrenches), .. }), Some(coupling)) =
            (reports.last(), turn.couplings.first_mut())
        {
            coupling.book(wrenches);
        }
    }

    /// Asks a world's laws on the host how stiff their particles are, if that is due.
    fn follow_stiffness(&mut self, w: usize) -> Result<()> {
        let world = &self.worlds[w];
        let is_wrong = world.stiffness().dt.is_nan();
        if world.ask_after.is_none_or(|age| world.stiffness_age < age) && !is_wrong {
            return Ok(());
        }
        let (mut asked, mut needed) = (stiffness::nothing(), stiffness::nothing());
        for level in world.levels.iter().filter(|level| !level.particles.is_empty()) {
            let (first, count) = (level.particles.start, level.particles.len());
            let rest = self.stretch(Sorted::Rest, first, count)?;
            let places =
                if world.materials.len() > 1 { Some(self.stretch_of(Sorted::Record, 1, first, count)?) } else { None };
            let held = Held { rest: &rest, places: places.as_deref(), slots: count, count };
            let of_level = (level.h, level.steps_within);
            let ask = |is_asked| stiffness::bound_held(&held, &world.materials, is_asked, &world.densities, of_level);
            asked = stiffness::lesser(asked, ask(stiffness::is_asked_on_host)?);
            if world.asks_those_asleep() || is_wrong {
                needed = stiffness::lesser(needed, ask(stiffness::is_asked_on_device)?);
            }
        }
        let world = &mut self.worlds[w];
        let needed = (world.asks_those_asleep() || is_wrong).then_some(needed);
        world.take_asked(asked, needed);
        Ok(())
    }

    /// Up to `count` steps of at most `dt` of the worlds that have a turn; the others stay as they are. All that succeed take the same steps.
    pub(crate) fn steps(
        &mut self,
        dt: f64,
        count: usize,
        turns: &mut [Turn<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        for turn in turns.iter().filter(|_| ground) {
            if self.fault(turn).is_none() {
                self.follow(turn.world, turn.couplings)?;
            }
        }
        for turn in turns.iter() {
            self.settle_contact(turn.world, turn.couplings)?;
        }
        // Each world's laws are asked on the host after as many of its own steps, whatever the others do.
        let until_asked = |turn: &Turn<'_>| {
            let world = &self.worlds[turn.world];
            world.ask_after.map_or(MAX_STEPS, |age| age.saturating_sub(world.stiffness_age).max(1) as usize)
        };
        let has_bodies = turns.iter().any(|turn| !turn.couplings.is_empty());
        let at_once = if has_bodies || self.substeps > 1 { MAX_SLOTS / self.substeps } else { MAX_STEPS };
        let most = turns.iter().map(until_asked).fold(at_once, usize::min);
        let lent: Vec<Option<Vec<Lent>>> = turns
            .iter_mut()
            .map(|turn| match self.worlds[turn.world] {
                _ if !ground => None,
                World { contact: Some(Place::Host), .. } => None,
                World { free: 0, .. } => Some(Vec::new()),
                _ => self.borrow(turn, dt, at_once),
            })
            .collect();
        let is_on_host: Vec<bool> = lent.iter().map(Option::is_none).collect();
        if ground && is_on_host.contains(&true) && self.contact.host.is_none() {
            self.contact.host = Some(Box::new(kernels::near(&self.gpu, &self.kernels, self.worlds.len())));
        }
        let taken = self.take_steps_where_bodies_are(dt, count.clamp(1, most), turns, lent, &is_on_host);
        turns.iter_mut().filter_map(|turn| turn.couplings.first_mut()).for_each(|coupling| coupling.take_back());
        let reports = taken?;
        for (turn, _) in turns.iter().zip(&reports).filter(|(_, report)| report.is_ok()) {
            self.follow_stiffness(turn.world)?;
        }
        Ok(reports)
    }

    /// The steps of worlds whose bodies the device moves, and a step of those whose bodies' law runs on the host.
    fn take_steps_where_bodies_are(
        &mut self,
        dt: f64,
        count: usize,
        turns: &mut [Turn<'_>],
        lent: Vec<Option<Vec<Lent>>>,
        is_on_host: &[bool],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        let mut reports = Vec::new();
        if is_on_host.contains(&false) {
            // Beside worlds that go a step at a time, they do.
            let count = if is_on_host.contains(&true) { 1 } else { count };
            let lent: Vec<_> = lent.into_iter().flatten().collect();
            reports = self.advance(dt, count, &mut some_turns(turns, |t| !is_on_host[t]), &lent)?;
        }
        if is_on_host.contains(&true) {
            let taken = reports.iter().flatten().flatten().next().map_or(dt, |report| report.dt);
            let mut turns = some_turns(turns, |t| is_on_host[t]);
            let by_levels = ground && self.substeps > 1;
            let others = reports;
            let own = if by_levels {
                self.step_levels_on_host(taken, &mut turns)?
            } else {
                self.step_on_host(taken, &mut turns)?
            };
            let (mut own, mut others) = (own.into_iter(), others.into_iter());
            let next = |is_on_host: &bool| if *is_on_host { own.next() } else { others.next() };
            reports = is_on_host.iter().filter_map(next).collect();
        }
        Ok(reports)
    }
}

/// Some of the turns.
fn some_turns<'a>(turns: &'a mut [Turn<'_>], which: impl Fn(usize) -> bool) -> Vec<Turn<'a>> {
    let own = turns.iter_mut().enumerate().filter(|(t, _)| which(*t));
    own.map(|(_, turn)| Turn { world: turn.world, time: turn.time, couplings: &mut *turn.couplings }).collect()
}

/// The law on devices of a world's one coupling, and how many bodies it has.
fn device_law(couplings: &[Box<dyn Coupling>]) -> Option<(DeviceLaw, usize)> {
    let [coupling] = couplings else { return None };
    let bodies = coupling.bodies().len();
    let fits = bodies == coupling.bounds().len() && bodies > 0;
    coupling.device_law().filter(|_| fits).map(|law| (law, bodies))
}

/// Leaves out what goes beyond so many steps.
fn cut(stretches: &mut Vec<Stretch>, mut steps: usize) {
    stretches.retain_mut(|stretch| {
        let wanted = stretch.steps;
        stretch.steps = wanted.min(steps);
        steps -= stretch.steps;
        stretch.steps > 0 || wanted == 0
    });
}

/// Repeats the last one until there are so many.
fn go_on<T: Clone>(all: &mut Vec<T>, count: usize) {
    if let Some(last) = all.last().cloned() {
        all.resize(count, last);
    }
}

/// Takes a world's coupling back, or on, to what it was before a step.
fn go_back(couplings: &mut [Box<dyn Coupling>], driven: &Option<Driven>, step: usize) -> Result<()> {
    let (Some(coupling), Some(driven)) = (couplings.first_mut(), driven) else { return Ok(()) };
    coupling.restore(&driven.saved[step]).map_err(|what| Error::Body {
        path: format!("coupling '{}'", coupling.name()),
        what: format!("cannot go back to an earlier step: {what}"),
        mend: "resume from the last snapshot".to_owned(),
    })
}

/// A coupling's bodies as each of some levels sees them, of so many places for bodies: without those that are lent.
fn pack_all(coupling: &dyn Coupling, levels: &[Level], lent: &[Lent], places: usize) -> Vec<[f32; 4]> {
    let (bodies, boxes) = (coupling.bodies(), coupling.bounds());
    let is_lent = |body: usize| lent.iter().any(|lent| lent.body == body);
    let of_level = |level: &Level| {
        let pairs = bodies.iter().zip(&boxes).enumerate();
        let packed = pairs.map(|(b, (body, bounds))| {
            if is_lent(b) { NOWHERE } else { pack(body, &bounds.grown(coupling.reach() * level.h), level.h) }
        });
        packed.chain(std::iter::repeat(NOWHERE)).take(places).flatten().collect::<Vec<_>>()
    };
    levels.iter().flat_map(of_level).collect()
}

/// A body whose box holds no node, as `contact.wgsl` reads it.
const NOWHERE: [[f32; 4]; BODY as usize] = {
    let mut body = [[0.0; 4]; BODY as usize];
    let far = f32::from_bits(1 << 30);
    body[7] = [far, far, far, 0.0];
    body
};

/// A body in a step, as `contact.wgsl` reads it.
fn pack(body: &BodyState, bounds: &Aabb, h: f64) -> [[f32; 4]; BODY as usize] {
    let ints =
        |v: [i32; 3]| [f32::from_bits(v[0] as u32), f32::from_bits(v[1] as u32), f32::from_bits(v[2] as u32), 0.0];
    let reals = |v: Vec3| [v[0] as f32, v[1] as f32, v[2] as f32, 0.0];
    let cell = body.position.map(|x| (x / h).floor());
    let place = std::array::from_fn(|d| body.position[d] / h - cell[d]);
    let [w, x, y, z] = body.rotation;
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    // Nodes stand at the centres of cells.
    let node = |x: f64, round: fn(f64) -> f64| round(x / h - 0.5).clamp(-1e9, 1e9) as i32;
    [
        ints(cell.map(|c| c as i32)),
        reals(place),
        reals(rows[0]),
        reals(rows[1]),
        reals(rows[2]),
        reals(body.velocity),
        reals(body.angular_velocity),
        ints(bounds.min.map(|x| node(x, f64::ceil))),
        ints(bounds.max.map(|x| node(x, f64::floor))),
    ]
}
