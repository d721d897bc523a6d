//! The step.

use crate::account;
use crate::device::Gpu;
use crate::kernels::{self, Groups, Kernel, Kernels, Role, Sorted, rest_vectors};
use crate::layout::{self, Homes, Periods, Planes};
use crate::memory::{
    Asked, BODY, Extent, MAX_STEPS, Memory, PER_STEP, STATUS_WORDS, STEP_STRIDE, STEPS, StepConstants, read,
    with_mapped, with_room,
};
use crate::stiffness::{self, Held};
use barchan_abi as abi;
use barchan_core::backend::{Bound, Timing};
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::Wall;
use barchan_core::{
    Aabb, BodyState, Coupling, Engine, Error, Ledger, Measured, ParticleList, ParticleState, Plan, Result, Scene,
    SortPhase, StepReport, Vec3, Wrench,
};
use barchan_grid::block;
use std::collections::BTreeMap;
use std::time::Instant;

/// Steps after which particles are sorted again, if they have moved.
const SORT_AGE: u32 = 20;
/// A sort that finds nobody far from home is not worth its time.
const SORT_DRIFT: f64 = 0.1;
/// Tiles allow for this much drift since the last sort, in cells.
pub(crate) const MAX_DRIFT: f64 = 1.0;
/// No particle may move further in a step, in cells.
const MAX_MOVE: f64 = 0.5;
/// So no node that a particle feels may carry one further than this in a step, in cells.
pub(crate) const NODE_MOVE: f64 = 0.48;
/// Steps between measurements of the stiffness of materials that harden.
const STIFFNESS_AGE: u32 = 10;
/// From how many times the least mass on a node's speed counts in full; see the backend cpu.
const FELT: f64 = 1e17;
/// Every so manieth submission is timed pass by pass.
const TIMED: u64 = 16;
/// And of it so many passes at most.
const MOST_TIMED: usize = 64;

/// After so many passes the device begins with a submission while the rest is still being written; each piece is three times the
/// one before, since writing is faster than running.
const PIECE: usize = 32;

/// Words of the status; see `common.wgsl`.
pub(crate) const BLOCKS: usize = 0;
pub(crate) const NODE_BLOCKS: usize = 1;
const LEAST_BLOCK: usize = 2;
const GREATEST_BLOCK: usize = 5;
const HALTED: usize = 8;
const HALT_STEP: usize = 9;
const WHO: usize = 10;
const PARTED: usize = 11;
const NEW_BLOCKS: usize = 12;
const NEW_NODE_BLOCKS: usize = 13;
/// Sorts done, then what walls gave.
const SORTS: usize = 15;
const WALL_IMPULSE: usize = 16;
const BIAS: i32 = block::REACH;

/// Why the device halted a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Halt {
    TooFast,
    Drifted,
    Room,
    LeftWorld,
    Strayed,
}

impl Halt {
    fn of(word: u32) -> Option<Self> {
        match word {
            0 => None,
            1 => Some(Self::TooFast),
            2 => Some(Self::Drifted),
            3 => Some(Self::Room),
            4 => Some(Self::LeftWorld),
            _ => Some(Self::Strayed),
        }
    }
}

/// What a submission did.
#[derive(Debug)]
struct Outcome {
    /// Steps completed.
    done: usize,
    halt: Option<Halt>,
    /// Greatest node speed of the step that was halted, or else of each step [m/s].
    node_speed: Vec<f64>,
    words: Vec<u32>,
}

/// A pass that is timed.
#[derive(Clone, Copy, Debug, Default)]
struct Clock {
    /// Seconds measured, and passes among them.
    measured: (f64, u64),
    passes: u64,
}

/// A scene of one level on a GPU.
pub(crate) struct WgpuEngine {
    pub(crate) gpu: Gpu,
    pub(crate) kernels: Kernels,
    pub(crate) memory: Memory,
    pub(crate) materials: Vec<PlannedMaterial>,
    pub(crate) scene: Scene,
    pub(crate) h: f64,
    periods: Periods,
    /// Steps since the last sort; `None` before the first one.
    age: Option<u32>,
    /// Upper bound of the drift since the last sort, without the last step if that is pending [cells].
    drift: f64,
    /// Did the last step's numbers stay on the device?
    pub(crate) pending: bool,
    /// Greatest speed of any particle along an axis [m/s].
    particle_speed: f64,
    last_dt: f64,
    /// Nodes lighter than this carry nothing [kg].
    pub(crate) least_mass: f64,
    stiffness: Bound,
    /// Of the laws that do not harden.
    unchanging: Bound,
    /// The least of each material [kg/m³].
    densities: Vec<f64>,
    stiffness_age: u32,
    hardens: bool,
    spoilt: bool,
    steps: u64,
    mass: f64,
    /// Blocks and node blocks of the last sort, and where they are.
    pub(crate) counts: [usize; 2],
    span: ([i32; 3], [i32; 3]),
    /// Node blocks in order, if couplings ask for them.
    pub(crate) node_blocks: Option<Vec<[i32; 3]>>,
    shortened: u64,
    parted: u64,
    parted_seen: u32,
    wall_impulse: Vec3,
    gravity_impulse: Vec3,
    clocks: Clocks,
    pub(crate) contact_seconds: (f64, u64),
    contact: Contact,
}

/// Where the coupling's law runs.
enum Contact {
    /// Nobody has asked yet.
    Unknown,
    /// On the host, a step at a time.
    Host,
    /// On the device: the law, then the sums of impulses; for so many bodies.
    Device(Box<[Kernel; 2]>, usize),
}

/// Driven bodies over the steps of a submission.
struct Driven {
    /// The coupling before each step, and after the last.
    saved: Vec<Vec<u8>>,
    /// Bodies after each step.
    after: Vec<Vec<BodyState>>,
}

/// Steps that follow on one another, after a sort or not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stretch {
    sort: bool,
    steps: usize,
}

/// A part of a submission.
struct Part<'a> {
    /// The set of buffers that it sorts from, if it begins with a sort.
    sorting: Option<usize>,
    dispatches: Vec<Dispatch<'a>>,
}

/// Time of passes, and submissions so far.
#[derive(Debug, Default)]
struct Clocks {
    of: BTreeMap<&'static str, Clock>,
    submissions: u64,
}

/// One dispatch of a submission.
struct Dispatch<'a> {
    kernel: &'a Kernel,
    /// Which set of buffers is the present one.
    now: usize,
    /// Number of the step's constants.
    step: usize,
}

impl WgpuEngine {
    pub(crate) fn new(gpu: Gpu, plan: &Plan, particles: ParticleState) -> Result<Self> {
        let kernels = Kernels::new(&gpu, plan)?;
        gpu.check()?;
        let walls = [0, 1, 2].map(|axis| plan.scene.world.walls.pair(axis));
        let pairs = walls.iter().flatten().any(|wall| matches!(wall, Wall::Separate { .. }));
        let periods = Periods {
            first: plan.cell_min.map(|c| c.div_euclid(4)),
            count: std::array::from_fn(|d| {
                if walls[d][0] == Wall::Periodic { (plan.cell_max[d] - plan.cell_min[d]) / 4 } else { 0 }
            }),
        };
        layout::check(&particles, &plan.materials)?;
        let slots = particles.lists.iter().map(ParticleList::len).sum::<usize>().next_multiple_of(128).max(128);
        let params: Vec<f32> = plan.materials.iter().flat_map(|m| &m.parameters).map(|&p| p as f32).collect();
        let extent = Extent { slots: slots as u32, block_room: 64, node_room: 64, box_blocks: 1, ..Extent::default() };
        let vectors = rest_vectors(&plan.materials);
        let asked = Asked { pairs, bodies: 0 };
        let memory = Memory::new(&gpu, extent, vectors, asked, &params, &kernels.step_layout)?;
        let mut engine = Self {
            gpu,
            kernels,
            memory,
            materials: plan.materials.clone(),
            scene: plan.scene.clone(),
            h: plan.cell_widths[0],
            periods,
            age: None,
            drift: 0.0,
            pending: false,
            particle_speed: 0.0,
            last_dt: 0.0,
            least_mass: 0.0,
            stiffness: Bound { dt: f64::INFINITY, by: "nothing".into() },
            unchanging: Bound { dt: f64::INFINITY, by: "nothing".into() },
            densities: Vec::new(),
            stiffness_age: 0,
            hardens: plan.materials.iter().any(|m| m.material.has(abi::BARCHAN_CAP_HARDENS)),
            spoilt: false,
            steps: 0,
            mass: 0.0,
            counts: [0; 2],
            span: ([0; 3], [0; 3]),
            node_blocks: None,
            shortened: 0,
            parted: 0,
            parted_seen: 0,
            wall_impulse: [0.0; 3],
            gravity_impulse: [0.0; 3],
            clocks: Clocks::default(),
            contact_seconds: (0.0, 0),
            contact: Contact::Unknown,
        };
        engine.take_in(particles)?;
        Ok(engine)
    }

    pub(crate) fn particles(&self) -> usize {
        self.memory.extent.particles as usize
    }

    /// The constants of a step.
    fn step_constants(&self, dt: f64, time: f64, number: usize, first: usize, drift: f64) -> StepConstants {
        let gravity = self.scene.gravity_at(time);
        let felt = if self.least_mass > 0.0 { 1.0 / (self.least_mass * FELT) } else { f64::from(f32::MAX) };
        StepConstants {
            dt: dt as f32,
            dt_per_h: (dt / self.h) as f32,
            stress: (-4.0 * dt / self.h) as f32,
            drift: drift as f32,
            gravity: gravity.map(|g| (g * dt) as f32),
            number: number as u32,
            least: self.least_mass as f32,
            felt: felt as f32,
            first: first as u32,
            pad: 0,
        }
    }

    /// The constants of steps from a slot on: one write, since each takes the queue microseconds.
    fn write_steps(&self, slot: usize, constants: &[StepConstants]) {
        let mut bytes = vec![0; STEP_STRIDE as usize * constants.len()];
        for (room, constants) in bytes.chunks_exact_mut(STEP_STRIDE as usize).zip(constants) {
            room[..size_of::<StepConstants>()].copy_from_slice(bytemuck::bytes_of(constants));
        }
        self.gpu.queue.write_buffer(&self.memory.steps, STEP_STRIDE * slot as u64, &bytes);
    }

    pub(crate) fn write_words(&self, from: usize, words: &[u32]) {
        let status = self.memory.buffer(Role::Status, 0);
        self.gpu.queue.write_buffer(status, 4 * from as u64, bytemuck::cast_slice(words));
    }

    /// Workgroups of a pass, in rows.
    fn groups(&self, groups: Groups) -> (u32, u32) {
        let extent = &self.memory.extent;
        // A sort may find more blocks than there were, up to the room there is.
        let count = match groups {
            Groups::One => 1,
            Groups::Exactly(count) => count,
            Groups::Blocks => extent.block_room,
            Groups::NodeBlocks => extent.node_room.max(extent.block_room),
            Groups::BlocksBy(n) => extent.block_room.div_ceil(n),
            Groups::ParticlesBy(n) => extent.particles.div_ceil(n),
            Groups::PlacesBy(n) => extent.box_blocks.div_ceil(n),
        };
        (count.min(extent.row), count.div_ceil(extent.row))
    }

    /// Parts with the workgroups of their dispatches.
    fn with_groups<'a>(&self, parts: Vec<Part<'a>>) -> Vec<(Part<'a>, Vec<(u32, u32)>)> {
        let of = |part: &Part<'_>| part.dispatches.iter().map(|d| self.groups(d.kernel.groups)).collect();
        parts.into_iter().map(|part| (of(&part), part)).map(|(groups, part)| (part, groups)).collect()
    }

    /// Writes dispatches into a submission, each in a pass of its own if it is timed.
    fn encode(
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        memory: &mut Memory,
        dispatches: &[(&Dispatch<'_>, (u32, u32))],
        queries: Option<&wgpu::QuerySet>,
    ) {
        let bind =
            |pass: &mut wgpu::ComputePass<'_>, memory: &mut Memory, (d, groups): &(&Dispatch<'_>, (u32, u32))| {
                pass.set_pipeline(&d.kernel.pipeline);
                pass.set_bind_group(0, &memory.binding(&gpu.device, d.kernel, d.now), &[]);
                pass.set_bind_group(1, &memory.step_binding, &[(STEP_STRIDE * d.step as u64) as u32]);
                pass.dispatch_workgroups(groups.0, groups.1, 1);
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

    /// Takes steps of `dt` in stretches, each after a sort if it begins with one, without asking the device in between.
    fn submit(&mut self, time: f64, dt: f64, stretches: &[Stretch]) -> Result<Outcome> {
        let count: usize = stretches.iter().map(|s| s.steps).sum();
        debug_assert!(count <= MAX_STEPS && !self.pending, "a submission starts from what is known");
        let sorts = stretches.iter().filter(|s| s.sort).count();
        if sorts > 0 {
            self.survey_box(sorts)?;
        }
        self.write_words(HALTED, &[0, 0, u32::MAX]);
        self.write_words(SORTS, &[0, 0, 0, 0]);
        self.write_words(STEPS, &vec![0; PER_STEP * count.max(1)]);

        // A sort moves the particles to the other set of buffers.
        let (mut now, mut step, mut first, mut drift) = (self.memory.now, 0, 0, self.drift);
        let mut parts = Vec::new();
        let mut sorted_at = Vec::new();
        let mut constants = Vec::new();
        let kernels = &self.kernels;
        let contact: &[Kernel] = if let Contact::Device(kernels, _) = &self.contact { &**kernels } else { &[] };
        for stretch in stretches {
            let mut part = Part { sorting: stretch.sort.then_some(now), dispatches: Vec::new() };
            if stretch.sort {
                (first, drift) = (step, 0.0);
                sorted_at.push(step);
                part.dispatches.extend(kernels.sort.iter().map(|kernel| Dispatch { kernel, now, step }));
                now = 1 - now;
            }
            for _ in 0..stretch.steps {
                constants.push(self.step_constants(dt, time + step as f64 * dt, step, first, drift));
                let to_nodes = [&kernels.p2g].into_iter().chain(&kernels.grid).chain(contact);
                let passes = to_nodes.chain(&kernels.mirror).chain([&kernels.g2p]);
                part.dispatches.extend(passes.map(|kernel| Dispatch { kernel, now, step }));
                step += 1;
            }
            // A sort forgets what walls gave.
            if stretch.steps > 0 {
                part.dispatches.extend(kernels.collect.iter().map(|kernel| Dispatch { kernel, now, step: 0 }));
            }
            parts.push(part);
        }
        if count == 0 {
            constants.push(self.step_constants(dt, time, 0, 0, drift));
        }
        self.write_steps(0, &constants);
        let parts = self.with_groups(parts);
        let words = Self::run(&self.gpu, &mut self.memory, &mut self.clocks, &parts, &[])?;

        let halt = Halt::of(words[HALTED]);
        let done = if halt.is_some() { words[HALT_STEP] as usize } else { count };
        let word = |s: usize, k: usize| f64::from(f32::from_bits(words[STEPS + PER_STEP * s + k]));
        let mut since = 0;
        if let Some(&last) = (words[SORTS] as usize).checked_sub(1).and_then(|last| sorted_at.get(last)) {
            self.memory.now ^= words[SORTS] as usize & 1;
            self.age = Some(0);
            self.drift = 0.0;
            self.counts = [words[BLOCKS] as usize, words[NODE_BLOCKS] as usize];
            let block = |first: usize| [0, 1, 2].map(|d| words[first + d] as i32 - BIAS);
            self.span = (block(LEAST_BLOCK), block(GREATEST_BLOCK));
            self.node_blocks = None;
            since = last;
        }
        for s in since..done {
            self.drift += word(s, 1);
        }
        if done > 0 {
            self.particle_speed = word(done - 1, 1) * self.h / dt;
            self.last_dt = dt;
        }
        self.take_sums(&words);
        self.age = self.age.map(|age| age + (done - since) as u32);
        self.steps += done as u64;
        self.stiffness_age += done as u32;
        self.book_gravity(time, dt, done);
        let node_speed = (0..count).map(|s| word(s, 0)).collect();
        Ok(Outcome { done, halt, node_speed, words })
    }

    /// Cuts steps into stretches between sorts, as far as the present speed tells when they will be due.
    fn plan_stretches(&self, dt: f64, count: usize, sort_first: bool) -> Vec<Stretch> {
        let each = 1.05 * self.particle_speed * dt / self.h;
        let mut sort = sort_first || self.sort_due(each);
        let (mut age, mut drift) = (self.age.unwrap_or(0), self.drift);
        let (mut left, mut stretches) = (count, Vec::new());
        loop {
            if sort {
                (age, drift) = (0, 0.0);
            }
            // More steps than particles may drift in would be stopped by the device.
            let fitting = ((MAX_DRIFT - drift).max(0.0) / each).min(MAX_STEPS as f64) as usize + 1;
            let until_old = if age < SORT_AGE { SORT_AGE - age } else { SORT_AGE } as usize;
            let steps = left.min(fitting).min(until_old);
            stretches.push(Stretch { sort, steps });
            left -= steps;
            if left == 0 {
                return stretches;
            }
            age += steps as u32;
            drift += each * steps as f64;
            sort = drift > SORT_DRIFT;
            // The directory's box changes before a submission that sorts, and fits the blocks from its first sort on.
            if sort && !stretches[0].sort {
                return stretches;
            }
        }
    }

    /// What was summed on the device since it was asked last.
    fn take_sums(&mut self, words: &[u32]) {
        self.parted += u64::from(words[PARTED].wrapping_sub(self.parted_seen));
        self.parted_seen = words[PARTED];
        if self.kernels.collect.is_some() {
            for d in 0..3 {
                self.wall_impulse[d] += f64::from(f32::from_bits(words[WALL_IMPULSE + d]));
            }
        }
    }

    fn book_gravity(&mut self, time: f64, dt: f64, steps: usize) {
        for s in 0..steps {
            let gravity = self.scene.gravity_at(time + s as f64 * dt);
            for (impulse, g) in self.gravity_impulse.iter_mut().zip(gravity) {
                *impulse += self.mass * g * dt;
            }
        }
    }

    /// Runs parts and brings back the status, and behind it stretches of the grid: first byte, bytes.
    fn run(
        gpu: &Gpu,
        memory: &mut Memory,
        clocks: &mut Clocks,
        parts: &[(Part<'_>, Vec<(u32, u32)>)],
        nodes: &[(u64, u64)],
    ) -> Result<Vec<u32>> {
        for dispatch in parts.iter().flat_map(|(part, _)| &part.dispatches) {
            clocks.of.entry(dispatch.kernel.name).or_default().passes += 1;
        }
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
        for (i, (part, groups)) in parts.iter().enumerate() {
            if let Some(now) = part.sorting {
                encoder.clear_buffer(memory.buffer(Role::Flags, now), 0, None);
                encoder.clear_buffer(memory.buffer(Role::Next(Sorted::Cells), now), 0, None);
            }
            let dispatches: Vec<_> = part.dispatches.iter().zip(groups.iter().copied()).collect();
            let (timed, rest) = dispatches.split_at(if i == 0 { first } else { 0 });
            if !timed.is_empty() {
                Self::encode(gpu, &mut encoder, memory, timed, queries.as_ref());
            }
            for some in rest.chunks(PIECE) {
                Self::encode(gpu, &mut encoder, memory, some, None);
                unsent += some.len();
                if unsent >= piece {
                    gpu.queue.submit([std::mem::replace(&mut encoder, fresh()).finish()]);
                    (unsent, piece) = (0, 3 * piece);
                }
            }
        }
        let mut bytes = 4 * STATUS_WORDS as u64;
        memory.read_back_to(gpu, bytes + nodes.iter().map(|(_, bytes)| bytes).sum::<u64>());
        encoder.copy_buffer_to_buffer(memory.buffer(Role::Status, 0), 0, &memory.readback, 0, bytes);
        for &(from, length) in nodes {
            encoder.copy_buffer_to_buffer(memory.buffer(Role::Grid, 0), from, &memory.readback, bytes, length);
            bytes += length;
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
        Ok(words)
    }

    /// Sets the directory's box around all blocks that a sort can find: they have drifted by up to a cell or two, and nodes
    /// reach a block further.
    fn survey_box(&mut self, sorts: usize) -> Result<()> {
        let mut extent = self.memory.extent;
        let (least, greatest) = self.span;
        // A cell and a half each time is less than a block in two.
        let margin = 2 + sorts as i32 / 2;
        let mut places = 1u64;
        for d in 0..3 {
            let (first, size) = if self.periods.count[d] > 0 {
                (self.periods.first[d], self.periods.count[d])
            } else {
                (least[d] - margin, greatest[d] - least[d] + 1 + 2 * margin)
            };
            extent.box_min[d] = first;
            extent.box_size[d] = size;
            places = places.saturating_mul(size as u64);
        }
        // The same rule as for all buffers finds what is too large for the adapter; this one keeps the number a u32.
        extent.box_blocks = u32::try_from(places).unwrap_or(u32::MAX);
        if extent != self.memory.extent {
            self.memory.grow(&self.gpu, extent)?;
        }
        Ok(())
    }

    /// Makes room for as many blocks as the last sort found, and a quarter more.
    fn make_room(&mut self, words: &[u32]) -> Result<()> {
        let mut extent = self.memory.extent;
        extent.block_room = extent.block_room.max(with_room(words[NEW_BLOCKS] as usize));
        extent.node_room = extent.node_room.max(with_room(words[NEW_NODE_BLOCKS] as usize));
        self.memory.grow(&self.gpu, extent)
    }

    /// Is a sort due before the next step, in which particles move by up to `each` cells?
    fn sort_due(&self, each: f64) -> bool {
        let Some(age) = self.age else { return true };
        self.drift > MAX_DRIFT
            || (age >= SORT_AGE && self.drift > SORT_DRIFT)
            || (age > 0 && self.drift > MAX_DRIFT - each && self.drift > SORT_DRIFT)
    }

    /// Sorts at once.
    pub(crate) fn sort_now(&mut self, time: f64, dt: f64) -> Result<()> {
        loop {
            let outcome = self.submit(time, dt, &[Stretch { sort: true, steps: 0 }])?;
            match outcome.halt {
                None => return Ok(()),
                Some(Halt::Room) => self.make_room(&outcome.words)?,
                Some(_) => return Err(self.left_world(&outcome.words)),
            }
        }
    }

    fn left_world(&self, words: &[u32]) -> Error {
        let who = words[WHO] as usize;
        let found = self.lists().map(|lists| self.find(&lists, who));
        match found {
            Ok(Some((particle, position, _))) => Error::LeftWorld { step: self.steps, particle, position },
            Ok(None) => Error::LeftWorld { step: self.steps, particle: u64::MAX, position: [f64::NAN; 3] },
            Err(error) => error,
        }
    }

    /// Id, position and material of the particle in a slot.
    fn find(
        &self,
        (lists, homes, planes): &(Vec<ParticleList>, Homes, Planes),
        slot: usize,
    ) -> Option<(u64, Vec3, usize)> {
        if slot >= self.particles() {
            return None;
        }
        let law = planes.law(slot);
        let before = (0..slot).filter(|&q| planes.law(q) == law).count();
        let _ = homes;
        let list = lists.get(law).filter(|list| before < list.len())?;
        Some((list.id[before], list.position(before), law))
    }

    /// Turns a halt that no shorter step mends into what a user can act upon.
    fn explain(&self, outcome: &Outcome, time: f64) -> Error {
        if let Some(error) = self.find_non_finite() {
            return at_time(error, time);
        }
        match outcome.halt {
            Some(Halt::LeftWorld) => self.left_world(&outcome.words),
            Some(Halt::Strayed) => match self.lists().map(|l| self.find(&l, outcome.words[WHO] as usize)) {
                Ok(Some((particle, _, law))) => self.non_finite("cell", particle, law, f64::NAN, 1, time),
                Ok(None) => self.non_finite("cell", u64::MAX, 0, f64::NAN, 1, time),
                Err(error) => error,
            },
            _ => Error::NonFinite {
                step: self.steps,
                time,
                field: "node velocity",
                particle: 0,
                list: String::new(),
                value: outcome.node_speed.get(outcome.done).copied().unwrap_or(f64::NAN),
                count: 0,
            },
        }
    }

    fn non_finite(&self, field: &'static str, particle: u64, law: usize, value: f64, count: u64, time: f64) -> Error {
        let list = self.materials[law].name.clone();
        Error::NonFinite { step: self.steps, time, field, particle, list, value, count }
    }

    /// The particle of least id with a NaN or infinite value.
    pub(crate) fn find_non_finite(&self) -> Option<Error> {
        match self.lists() {
            Ok((lists, ..)) => account::find_non_finite(&lists, |field, particle, law, value, count| {
                self.non_finite(field, particle, law, value, count, 0.0)
            }),
            Err(error) => Some(error),
        }
    }

    /// Homes as the device has them.
    fn homes(&self) -> Result<Homes> {
        let [blocks, _] = self.counts;
        let entries: Vec<[i32; 4]> = read(&self.gpu, self.memory.plane(Sorted::Lists), 0, blocks * layout::ENTRY)?;
        let cells = read(&self.gpu, self.memory.plane(Sorted::Cells), 0, 64 * blocks + 1)?;
        let blocks = entries.chunks_exact(layout::ENTRY).map(|e| [e[0][0], e[0][1], e[0][2]]).collect();
        Ok(Homes { blocks, cells, ..Homes::default() })
    }

    /// All particles.
    fn lists(&self) -> Result<(Vec<ParticleList>, Homes, Planes)> {
        let slots = self.memory.extent.slots as usize;
        let homes = self.homes()?;
        let plane = |sorted| self.memory.plane(sorted);
        let planes = Planes {
            record: read(&self.gpu, plane(Sorted::Record), 0, layout::RECORD * slots)?,
            ids: read(&self.gpu, plane(Sorted::Ids), 0, slots)?,
            rest: read(&self.gpu, plane(Sorted::Rest), 0, rest_vectors(&self.materials) * slots)?,
        };
        let lists = planes.lists(&homes, &self.materials, self.h, slots);
        Ok((lists, homes, planes))
    }

    fn take_in(&mut self, particles: ParticleState) -> Result<()> {
        layout::check(&particles, &self.materials)?;
        let count: usize = particles.lists.iter().map(ParticleList::len).sum();
        let slots = self.memory.extent.slots as usize;
        if count > slots {
            return Err(Error::Capacity {
                what: "particles of an engine that was compiled for fewer",
                asked: count as u64,
                cap: slots as u64,
                mend: "compile the scene anew",
            });
        }
        let restored = particles
            .sort
            .as_ref()
            .and_then(|sort| Some((sort, Homes::restored(&particles.lists, &sort.blocks, &self.periods)?)));
        let (homes, sort) = match restored {
            Some((sort, homes)) => (homes, Some(sort.clone())),
            None => (Homes::fresh(&particles.lists, &self.periods), None),
        };
        let vectors = rest_vectors(&self.materials);
        let planes = Planes::of(&particles.lists, &homes, &self.materials, slots, vectors)?;

        let mut extent = self.memory.extent;
        extent.particles = count as u32;
        extent.block_room = extent.block_room.max(with_room(homes.blocks.len()));
        extent.node_room = extent.node_room.max(with_room(homes.nodes.len()));
        self.memory.grow(&self.gpu, extent)?;
        self.counts = [homes.blocks.len(), homes.nodes.len()];
        self.span = homes.extent().unwrap_or_default();
        self.node_blocks = Some(homes.nodes.clone());
        self.survey_box(1)?;

        let write = |sorted, bytes: &[u8]| {
            const PART: usize = 64 << 20;
            for (i, part) in bytes.chunks(PART).enumerate() {
                self.gpu.queue.write_buffer(self.memory.plane(sorted), (i * PART) as u64, part);
                self.gpu.queue.submit([]);
            }
        };
        let extent = self.memory.extent;
        let entries = homes.entries(extent.block_room as usize, extent.node_room as usize, &self.periods);
        write(Sorted::Record, bytemuck::cast_slice(&planes.record));
        write(Sorted::Ids, bytemuck::cast_slice(&planes.ids));
        write(Sorted::Rest, bytemuck::cast_slice(&planes.rest));
        write(Sorted::Lists, bytemuck::cast_slice(&entries));
        write(Sorted::Cells, bytemuck::cast_slice(&homes.cells));
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Owners, 0), 0, bytemuck::cast_slice(&homes.owners()));
        let places: Vec<[u32; 2]> = self.directory(&homes);
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Directory, 0), 0, bytemuck::cast_slice(&places));
        self.write_words(BLOCKS, &[homes.blocks.len() as u32, homes.nodes.len() as u32]);
        self.write_words(PARTED, &[self.parted_seen]);

        let spoilt = account::find_non_finite(&particles.lists, |field, particle, law, value, count| {
            self.non_finite(field, particle, law, value, count, 0.0)
        });
        self.spoilt = spoilt.is_some();
        self.take_stock(&particles.lists);
        if !self.spoilt {
            self.measure_stiffness(&particles.lists)?;
        }
        self.age = None;
        self.drift = 0.0;
        self.pending = false;
        if let Some(sort) = sort {
            self.age = Some(sort.age);
            self.drift = sort.drift.first().copied().unwrap_or(MAX_DRIFT);
            self.stiffness.dt = sort.measured.stiffness_bound;
            self.stiffness_age = sort.measured.stiffness_age;
        } else {
            // They lie as a sort would put them.
            self.age = Some(0);
        }
        // Stress is no part of a state: it follows from strain.
        if count > 0 && !self.spoilt {
            self.write_steps(0, &[self.step_constants(particles.strain_dt, 0.0, 0, 0, 0.0)]);
            let dispatch = Dispatch { kernel: &self.kernels.stress, now: self.memory.now, step: 0 };
            let parts = self.with_groups(vec![Part { sorting: None, dispatches: vec![dispatch] }]);
            let words = Self::run(&self.gpu, &mut self.memory, &mut self.clocks, &parts, &[])?;
            self.parted_seen = words[PARTED];
        }
        Ok(())
    }

    /// The directory of the blocks, as a sort would write it.
    fn directory(&self, homes: &Homes) -> Vec<[u32; 2]> {
        let extent = &self.memory.extent;
        let mut places = vec![[block::NONE; 2]; extent.box_blocks as usize];
        let at = |block: &[i32; 3]| {
            let local = [0, 1, 2].map(|d| block[d] - extent.box_min[d]);
            ((local[0] * extent.box_size[1] + local[1]) * extent.box_size[2] + local[2]) as usize
        };
        for (i, block) in homes.blocks.iter().enumerate() {
            places[at(block)][0] = i as u32;
        }
        for (i, block) in homes.nodes.iter().enumerate() {
            places[at(block)][1] = i as u32;
        }
        places
    }

    /// What depends on the particles as they come in.
    fn take_stock(&mut self, lists: &[ParticleList]) {
        let masses = lists.iter().flat_map(|list| &list.mass);
        let least = masses.clone().copied().fold(f64::INFINITY, f64::min);
        self.mass = masses.sum();
        self.least_mass = if least.is_finite() { least * 1e-20 } else { 0.0 };
        let speeds = lists.iter().flat_map(|list| &list.velocity).flatten();
        self.particle_speed = speeds.fold(0.0, |most: f64, v| if v.is_nan() { *v } else { most.max(v.abs()) });
    }

    fn measure_stiffness(&mut self, lists: &[ParticleList]) -> Result<()> {
        self.stiffness_age = 0;
        self.stiffness = stiffness::bound(lists, &self.materials, self.h)?;
        self.unchanging = self.stiffness.clone();
        if self.hardens {
            let hardens = |m: u32| self.materials[m as usize].material.has(abi::BARCHAN_CAP_HARDENS);
            let others: Vec<_> = lists.iter().filter(|list| !hardens(list.material)).cloned().collect();
            self.unchanging = stiffness::bound(&others, &self.materials, self.h)?;
        }
        let density = |list: &ParticleList| {
            list.mass.iter().zip(&list.volume0).fold(f64::INFINITY, |least, (m, v)| least.min(m / v))
        };
        self.densities = lists.iter().map(density).collect();
        Ok(())
    }

    /// Up to `count` steps of at most `dt`, without couplings or with such as run on the device.
    fn advance(
        &mut self,
        time: f64,
        mut dt: f64,
        count: usize,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<Vec<StepReport>> {
        let mut force_sort = false;
        let mut sorted = false;
        loop {
            let stretches = self.plan_stretches(dt, count, force_sort);
            let sort = stretches[0].sort;
            let driven = couplings.first_mut().map(|c| self.drive(&mut **c, time, dt, count)).transpose()?;
            let outcome = self.submit(time, dt, &stretches)?;
            sorted |= sort;
            if let (Some(driven), Some(coupling)) = (&driven, couplings.first_mut()) {
                go_back(&mut **coupling, &driven.saved[outcome.done])?;
            }
            if outcome.done > 0 {
                // What stopped the others is found again when they are tried again.
                let mut reports: Vec<_> = outcome.node_speed[..outcome.done]
                    .iter()
                    .enumerate()
                    .map(|(i, &max_speed)| StepReport {
                        dt,
                        sorted: sorted && i == 0,
                        max_speed,
                        ..StepReport::default()
                    })
                    .collect();
                if let (Some(driven), Some(coupling)) = (driven, couplings.first_mut()) {
                    self.report_bodies(driven, &mut **coupling, &mut reports)?;
                }
                return Ok(reports);
            }
            force_sort = false;
            match outcome.halt {
                Some(Halt::Room) => {
                    self.make_room(&outcome.words)?;
                    force_sort = true;
                }
                Some(Halt::Drifted) if !sort => force_sort = true,
                Some(Halt::TooFast) => {
                    let moves = outcome.node_speed[0] * dt / self.h;
                    if !moves.is_finite() {
                        return Err(self.explain(&outcome, time));
                    }
                    dt *= (0.9 * NODE_MOVE / moves).max(0.1);
                    self.shortened += 1;
                }
                _ => return Err(self.explain(&outcome, time)),
            }
        }
    }

    /// Finds out where the coupling's law runs.
    fn settle_contact(&mut self, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        if !matches!(self.contact, Contact::Unknown) {
            return Ok(());
        }
        self.contact = Contact::Host;
        let [coupling] = couplings else { return Ok(()) };
        let (bodies, boxes) = (coupling.bodies().len(), coupling.bounds().len());
        if let Some(law) = coupling.device_law().filter(|_| bodies == boxes && bodies > 0) {
            let kernels = kernels::contact(&self.gpu, &self.kernels, &law, bodies);
            self.memory.add_bodies(&self.gpu, bodies, &law.table)?;
            self.gpu.check()?;
            self.contact = Contact::Device(Box::new(kernels), bodies);
        }
        Ok(())
    }

    /// Lets driven bodies go through `count` steps, and tells the device where they are in each.
    fn drive(&self, coupling: &mut dyn Coupling, time: f64, dt: f64, count: usize) -> Result<Driven> {
        let mut driven = Driven { saved: vec![coupling.save()], after: Vec::new() };
        let mut packed: Vec<[f32; 4]> = Vec::new();
        for s in 0..count {
            let at = time + s as f64 * dt;
            coupling.before_step(at, dt)?;
            let bodies = coupling.bodies();
            packed.extend(bodies.iter().zip(coupling.bounds()).flat_map(|(body, bounds)| pack(body, &bounds, self.h)));
            coupling.after_step(at, dt)?;
            driven.after.push(coupling.bodies());
            driven.saved.push(coupling.save());
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Bodies, 0), 0, bytemuck::cast_slice(&packed));
        Ok(driven)
    }

    /// Says in each step's report where bodies were and what they felt.
    fn report_bodies(&self, driven: Driven, coupling: &mut dyn Coupling, reports: &mut [StepReport]) -> Result<()> {
        let Contact::Device(_, bodies) = &self.contact else { return Ok(()) };
        let impulses: Vec<[f32; 4]> =
            read(&self.gpu, self.memory.buffer(Role::Impulses, 0), 0, 2 * bodies * reports.len())?;
        let steps = impulses.chunks_exact(2 * bodies).zip(driven.after);
        for (report, (impulses, after)) in reports.iter_mut().zip(steps) {
            let per_step = |v: [f32; 4]| [v[0], v[1], v[2]].map(|x| f64::from(x) / report.dt);
            let wrench = |pair: &[[f32; 4]]| Wrench { force: per_step(pair[0]), torque: per_step(pair[1]) };
            report.wrenches = Some(impulses.chunks_exact(2).map(wrench).collect());
            report.bodies = Some(after);
        }
        if let Some(StepReport { wrenches: Some(wrenches), .. }) = reports.last() {
            coupling.book(wrenches);
        }
        Ok(())
    }

    /// Reads the stiffness anew where it follows the state.
    fn follow_stiffness(&mut self) -> Result<()> {
        if self.hardens && self.stiffness_age >= STIFFNESS_AGE && self.particles() > 0 {
            let slots = self.memory.extent.slots as usize;
            let vectors = rest_vectors(&self.materials);
            let rest = read(&self.gpu, self.memory.plane(Sorted::Rest), 0, vectors * slots)?;
            let places = if self.materials.len() > 1 {
                Some(read(&self.gpu, self.memory.plane(Sorted::Record), 0, slots)?)
            } else {
                None
            };
            let held = Held { rest: &rest, places: places.as_deref(), slots, count: self.particles() };
            let hardening = stiffness::bound_of_hardening(&held, &self.materials, &self.densities, self.h)?;
            self.stiffness = if hardening.dt < self.unchanging.dt { hardening } else { self.unchanging.clone() };
            self.stiffness_age = 0;
        }
        Ok(())
    }

    /// One step with couplings whose law runs on the host: nodes near their bodies go there and back.
    fn step_with_contact(
        &mut self,
        time: f64,
        mut dt: f64,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<(f64, f64, bool)> {
        let ground = self.particles() > 0;
        let (mut speed, mut sorted) = (0.0, false);
        let mut nodes = crate::contact::Nodes::default();
        if ground {
            if self.sort_due(0.0) {
                self.settle()?;
                self.sort_now(time, dt)?;
                sorted = true;
            }
            loop {
                let boxes: Vec<_> = couplings.iter().flat_map(|c| c.bounds()).collect();
                let words = self.ground_to_nodes(time, dt, &boxes, &mut nodes)?;
                speed = f64::from(f32::from_bits(words[STEPS + PER_STEP]));
                let moves = speed * dt / self.h;
                let halt = match words[HALTED] {
                    0 => None,
                    2 => Some(Halt::Drifted),
                    _ => Some(Halt::Strayed),
                };
                if halt == Some(Halt::Drifted) {
                    self.sort_now(time, dt)?;
                    sorted = true;
                    continue;
                }
                if halt.is_some() || !moves.is_finite() {
                    return Err(self.explain(&Outcome { done: 0, halt, node_speed: vec![speed], words }, time));
                }
                if moves <= NODE_MOVE {
                    break;
                }
                dt *= (0.9 * NODE_MOVE / moves).max(0.1);
                self.shortened += 1;
            }
        }
        let begun = Instant::now();
        for coupling in couplings.iter_mut() {
            coupling.before_step(time, dt)?;
        }
        for coupling in couplings.iter_mut().filter(|_| ground) {
            let boxes = coupling.bounds();
            nodes.fetch(self, &boxes)?;
            let reached = nodes.apply(self, &boxes, |batch| coupling.contact(dt, batch))?;
            speed = if reached.is_nan() { reached } else { speed.max(reached) };
        }
        self.contact_seconds.0 += begun.elapsed().as_secs_f64();
        self.contact_seconds.1 += 1;
        let moves = speed * dt / self.h;
        if moves.is_nan() || moves > NODE_MOVE * (1.0 + 1e-9) {
            return Err(Error::TimeStep {
                step: self.steps,
                dt,
                bound: NODE_MOVE * dt / moves,
                by: "the speed that a coupling gave to a node".into(),
            });
        }
        if ground {
            nodes.give_back(self);
            self.nodes_to_ground(time, dt, speed)?;
            self.book_gravity(time, dt, 1);
            self.stiffness_age += 1;
        }
        self.age = self.age.map(|age| age + 1);
        self.steps += 1;
        for coupling in couplings {
            coupling.after_step(time, dt)?;
        }
        self.last_dt = dt;
        Ok((dt, speed, sorted))
    }

    /// P2G and the grid update; brings back the status and the nodes in the boxes.
    fn ground_to_nodes(
        &mut self,
        time: f64,
        dt: f64,
        boxes: &[Aabb],
        nodes: &mut crate::contact::Nodes,
    ) -> Result<Vec<u32>> {
        self.know_node_blocks()?;
        // The last step's numbers stand in the words of step 0.
        self.write_steps(1, &[self.step_constants(dt, time, 1, 0, self.drift)]);
        self.write_words(HALTED, &[0, 0, u32::MAX]);
        if !self.pending {
            self.write_words(STEPS, &[0; PER_STEP]);
        }
        self.write_words(STEPS + PER_STEP, &[0; PER_STEP]);
        let now = self.memory.now;
        let passes = [&self.kernels.p2g].into_iter().chain(&self.kernels.grid);
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 1 }).collect();
        let wanted = nodes.begin(self, boxes);
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let words = Self::run(&self.gpu, &mut self.memory, &mut self.clocks, &parts, &wanted)?;
        nodes.take(bytemuck::cast_slice(&words[STATUS_WORDS..]));
        self.take_pending(&words);
        Ok(words)
    }

    /// Takes in the numbers of a step that were still on the device.
    fn take_pending(&mut self, words: &[u32]) {
        if std::mem::take(&mut self.pending) {
            let moved = f64::from(f32::from_bits(words[STEPS + 1]));
            self.drift += moved;
            self.particle_speed = moved * self.h / self.last_dt;
            self.take_sums(words);
        }
    }

    /// Asks for the numbers of a step that are still on the device.
    fn settle(&mut self) -> Result<()> {
        if self.pending {
            let words: Vec<u32> =
                read(&self.gpu, self.memory.buffer(Role::Status, 0), 0, STEPS + PER_STEP * MAX_STEPS)?;
            self.take_pending(&words);
        }
        Ok(())
    }

    /// Where the node blocks are.
    fn know_node_blocks(&mut self) -> Result<()> {
        if self.node_blocks.is_none() {
            let from = self.memory.extent.block_room as u64 * (16 * layout::ENTRY) as u64;
            let entries: Vec<[i32; 4]> =
                read(&self.gpu, self.memory.plane(Sorted::Lists), from, self.counts[1] * layout::ENTRY)?;
            self.node_blocks = Some(entries.chunks_exact(layout::ENTRY).map(|e| [e[0][0], e[0][1], e[0][2]]).collect());
        }
        Ok(())
    }

    /// G2P, from nodes that are at most `speed` fast. Its numbers stay on the device until the next step asks for them.
    fn nodes_to_ground(&mut self, time: f64, dt: f64, speed: f64) -> Result<()> {
        self.write_steps(0, &[self.step_constants(dt, time, 0, 0, 0.0)]);
        self.write_words(WALL_IMPULSE, &[0; 3]);
        // Rounding must not stop what has been let through.
        let allowed = (NODE_MOVE * self.h / dt * (1.0 - 1e-6)) as f32;
        self.write_words(STEPS, &[(speed as f32).min(allowed).to_bits(), 0, 0, 0]);
        let now = self.memory.now;
        let passes = self.kernels.mirror.iter().chain([&self.kernels.g2p]).chain(&self.kernels.collect);
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 0 }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (part, groups) in &parts {
            part.dispatches.iter().for_each(|d| self.clocks.of.entry(d.kernel.name).or_default().passes += 1);
            let dispatches: Vec<_> = part.dispatches.iter().zip(groups.iter().copied()).collect();
            Self::encode(&self.gpu, &mut encoder, &mut self.memory, &dispatches, None);
        }
        self.gpu.queue.submit([encoder.finish()]);
        self.gpu.check()?;
        self.pending = true;
        Ok(())
    }
}

/// Takes a coupling back, or on, to what it was.
fn go_back(coupling: &mut dyn Coupling, saved: &[u8]) -> Result<()> {
    coupling.restore(saved).map_err(|what| Error::Body {
        path: format!("coupling '{}'", coupling.name()),
        what: format!("cannot go back to an earlier step: {what}"),
        mend: "resume from the last snapshot".to_owned(),
    })
}

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

/// A fault in the state, with the time at which it was found.
fn at_time(error: Error, at: f64) -> Error {
    match error {
        Error::NonFinite { step, field, particle, list, value, count, .. } => {
            Error::NonFinite { step, time: at, field, particle, list, value, count }
        }
        other => other,
    }
}

impl Engine for WgpuEngine {
    fn bound(&self) -> Bound {
        let speed = MAX_MOVE * self.h / self.particle_speed;
        if speed < self.stiffness.dt && speed > 0.0 {
            Bound { dt: speed, by: "particle speed: no particle may move further than half a cell in a step".into() }
        } else {
            self.stiffness.clone()
        }
    }

    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let mut reports = self.steps(time, dt, 1, couplings)?;
        Ok(reports.pop().expect("at least one step"))
    }

    fn steps(
        &mut self,
        time: f64,
        dt: f64,
        count: usize,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<Vec<StepReport>> {
        if self.spoilt {
            self.find_non_finite().map_or(Ok(()), |error| Err(at_time(error, time)))?;
        }
        self.settle_contact(couplings)?;
        let ground = self.particles() > 0;
        let reports = if ground && (couplings.is_empty() || matches!(self.contact, Contact::Device(..))) {
            let most = if self.hardens { STIFFNESS_AGE as usize } else { MAX_STEPS };
            self.advance(time, dt, count.clamp(1, most), couplings)?
        } else {
            let (dt, max_speed, sorted) = self.step_with_contact(time, dt, couplings)?;
            vec![StepReport { dt, sorted, max_speed, ..StepReport::default() }]
        };
        self.follow_stiffness()?;
        Ok(reports)
    }

    fn download(&self) -> ParticleState {
        // A device that is lost has no particles left; the next step says so.
        let Ok((lists, homes, planes)) = self.lists() else { return ParticleState::default() };
        let pending = if self.pending { self.pending_move() } else { 0.0 };
        let blocks = planes.counts(&homes, self.materials.len());
        let sort = self.age.map(|age| SortPhase {
            age,
            drift: vec![self.drift + pending],
            measured: Measured { stiffness_bound: self.stiffness.dt, stiffness_age: self.stiffness_age },
            rest: vec![0; blocks.len()],
            blocks,
            kept_for: vec![None],
        });
        ParticleState { lists, sort, ..ParticleState::default() }
    }

    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        self.settle()?;
        self.take_in(particles)
    }

    fn particle_count(&self) -> usize {
        self.particles()
    }

    fn account(&self, ledger: &mut Ledger) {
        if let Ok((lists, ..)) = self.lists() {
            account::add_particles(ledger, &lists, &self.materials, &self.scene, self.h);
        }
        for d in 0..3 {
            ledger.wall_impulse[d] += self.wall_impulse[d] + self.pending_walls()[d];
            ledger.gravity_impulse[d] += self.gravity_impulse[d];
        }
        ledger.count("steps shortened for speed", self.shortened);
        ledger.count("particles' steps with strain applied in parts", self.parted);
    }

    fn timings(&self) -> Vec<Timing> {
        let mut timings: Vec<_> = self
            .clocks
            .of
            .iter()
            .map(|(name, clock)| Timing {
                effect: (*name).to_owned(),
                seconds: clock.measured.0 / clock.measured.1.max(1) as f64 * clock.passes as f64,
                passes: clock.passes,
            })
            .collect();
        let (seconds, passes) = self.contact_seconds;
        if passes > 0 {
            timings.push(Timing { effect: "contact".into(), seconds, passes });
        }
        timings
    }

    fn memory(&self) -> (u64, u64) {
        self.memory.bytes()
    }
}

impl WgpuEngine {
    /// How far particles moved in a step that is pending [cells].
    fn pending_move(&self) -> f64 {
        let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), 4 * (STEPS as u64 + 1), 1);
        words.map_or(MAX_DRIFT, |words| f64::from(words[0]))
    }

    /// What walls gave in a step that is pending [N s].
    fn pending_walls(&self) -> Vec3 {
        if !self.pending || self.kernels.collect.is_none() {
            return [0.0; 3];
        }
        let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), 4 * WALL_IMPULSE as u64, 3);
        words.map_or([0.0; 3], |w| [w[0], w[1], w[2]].map(f64::from))
    }
}
