//! Submissions: what they hold, how they are encoded and timed, what they bring back.

use crate::device::kernel::{Groups, Role, Sorted};
use crate::device::memory::{
    Answering, MAX_STEPS, Memory, Piece, STEP_STRIDE, Writes, pad, read, with_mapped, with_room,
};
use crate::device::status::{AT_START, GIVERS, GROWN, HALT_STEP, HALTED, Halt, NEW_BLOCKS, NEW_NODE_BLOCKS, Status};
use crate::device::uniforms::{Extent, StepConstants};
use crate::device::{Gpu, MANY};
use crate::schedule::batch::{PLACES, WgpuBatch};
use crate::schedule::groups::states;
use crate::schedule::{ContactPasses, Dispatch, Passes};
use crate::worlds::world::{Foresight, Level, Place, Span, World};
use barchan_core::Result;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Bytes that one thread copies faster than several do.
const LITTLE: usize = 1 << 20;

/// Every so manieth submission is timed pass by pass.
pub(crate) const TIMED: u64 = 16;
/// And of it so many passes at most.
pub(crate) const MOST_TIMED: usize = 64;

/// After so many passes the device begins with a submission while the rest is still being written; each piece is twice the
/// one before, since writing is faster than running.
pub(crate) const PIECE: usize = 16;

/// Steps that a submission begins with; each that comes to its end may be followed by one twice as long, but one that had to stop since
/// particles drifted otherwise than foreseen wastes what was written behind.
pub(crate) const FEW_STEPS: usize = 128;

/// And the fewest where levels had to follow a body after some steps: as many are expected before they have to again.
pub(crate) const LEAST_STEPS: usize = 16;

/// So many steps ahead it is looked where bodies come to the end of their leashes as they move now. Feet swing: further ahead they will move otherwise.
pub(crate) const FORESEEN: usize = 64;

/// By so many blocks parts of the directory reach further than they must, so that ground that moves on seldom leaves them.
pub(crate) const SPARE_BLOCKS: i32 = 2;

/// What a submission did.
pub(crate) struct Outcome {
    /// Steps completed.
    pub(crate) done: usize,
    pub(crate) halt: Option<Halt>,
    pub(crate) status: Status,
    /// States of groups and their bodies after each slot.
    pub(crate) groups: Vec<u32>,
    /// What driven bodies felt in each, where there are any; see [`WgpuBatch::felt`].
    pub(crate) impulses: Vec<u32>,
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
    pub(crate) submissions: u64,
}

/// How many workgroups a dispatch has.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Size {
    /// In a row, and rows.
    Known(u32, u32),
    /// As the device has counted them, at a byte of [`Role::Groups`].
    Counted(u64),
}

/// Leaves out what goes beyond so many steps.
pub(crate) fn cut(stretches: &mut Vec<Stretch>, mut steps: usize) {
    stretches.retain_mut(|stretch| {
        let wanted = stretch.steps;
        stretch.steps = wanted.min(steps);
        steps -= stretch.steps;
        stretch.steps > 0 || wanted == 0
    });
}

impl WgpuBatch {
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

    /// Workgroups of a pass that concerns the levels before one.
    pub(crate) fn size(&self, groups: Groups, end: usize) -> Size {
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
    pub(crate) fn particles_before(&self, end: usize) -> u32 {
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
            pass.set_pipeline(d.kernel.pipeline.made());
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
    pub(crate) fn submit(
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
        let answering = if is_felt { self.contact.answering() } else { Answering::default() };
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
        let submission = self.clocks.submissions as u32;
        passes.constants.iter_mut().for_each(|constants| constants.submission = submission);
        writes.add_steps(&self.memory.steps, &passes.constants);
        let parts = self.with_groups(parts);
        let states = states(answering, self.worlds.len(), count * self.substeps);
        let of_states = states.as_ref().map_or(0, |states| states.bytes as usize / 4);
        let behind = states.into_iter().chain(self.felt(count).filter(|_| is_felt));
        let steps = count.max(1);
        let (status, mut groups) =
            Self::run(&writes, &self.gpu, &mut self.memory, &mut self.clocks, &parts, steps, behind)?;
        let impulses = groups.split_off(of_states);
        writes.clear();
        self.writes = writes;
        let halt = status.halt();
        let done = if halt.is_some() { status.words[HALT_STEP] as usize } else { count };
        for &(w, time) in active {
            self.take_steps(&status, w, time, dt, done);
        }
        // Who has left was there in these steps.
        self.take_blocks(&status);
        Ok(Outcome { done, halt, status, groups, impulses })
    }

    /// Cuts steps into stretches between sorts, as far as the present speeds tell when worlds will be due, or might be. Where they tell wrong, a sort
    /// that nobody needs leaves all particles as they are, and the device stops before a step that needs one.
    pub(crate) fn plan_stretches(&self, active: &[(usize, f64)], dt: f64, count: usize) -> Vec<Stretch> {
        let of_world = |&(w, _): &(usize, f64)| {
            let each = |level: &Level| {
                let each = (level.particle_speed * dt / level.h) as f32;
                Foresight { foreseen: level.since_sort, faster: level.since_sort, each }
            };
            self.worlds[w].levels.iter().map(each).collect()
        };
        // To sort many takes longer than to be stopped; levels would look for those on a wrong one, and of many worlds one might always be due.
        let guesses = self.levels == 1 && self.worlds.len() == 1 && self.particles() < MANY;
        let is_due = |world: &Vec<Foresight>| world.iter().any(|level| level.foreseen.is_due(self.most_drift));
        let might_be = |world: &Vec<Foresight>| guesses && world.iter().any(|level| level.faster.is_far());
        let mut worlds: Vec<Vec<Foresight>> = active.iter().map(of_world).collect();
        let (mut stretches, mut sorts): (Vec<Stretch>, usize) = (Vec::new(), 0);
        for step in 0..count {
            let sort = (step == 0 && self.unlinked) || worlds.iter().any(|world| is_due(world) || might_be(world));
            // Where the directory's boxes have to change they do so before a submission, and fit the blocks from its first sort on.
            if sort && stretches.first().is_some_and(|first| !first.sort) && !self.covers(1 + sorts) {
                break;
            }
            sorts += usize::from(sort);
            if sort || stretches.is_empty() {
                stretches.push(Stretch { sort, steps: 0 });
            }
            // A sort that stops the submission is its last: steps behind it would be written for nothing.
            if sort && self.astray {
                break;
            }
            for world in &mut worlds {
                let sorted = is_due(world);
                world.iter_mut().for_each(|level| level.step(sorted));
            }
            stretches.iter_mut().next_back().expect("the first step begins a stretch").steps += 1;
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
        let (mut words, mut found) = (Vec::new(), Vec::new());
        with_mapped(gpu, &memory.readback, bytes, |bytes| {
            let (of_status, behind) = bytes.split_at(4 * layout.count(steps));
            words = bytemuck::pod_collect_to_vec(of_status);
            // With many worlds this is tens of megabytes in each step. Little need not wait for a thread.
            found = match behind.len() {
                ..LITTLE => bytemuck::pod_collect_to_vec(behind),
                _ => bytemuck::cast_slice(behind).par_iter().with_min_len(LITTLE / 4).copied().collect(),
            };
        })?;
        if let (Some(buffer), Some((part, _))) = (resolved, parts.first()) {
            let ticks: Vec<u64> = read(gpu, &buffer, 0, 2 * first)?;
            let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-9;
            for (dispatch, pair) in part.dispatches.iter().zip(ticks.chunks_exact(2)) {
                let clock = clocks.of.entry(dispatch.kernel.name).or_default();
                clock.measured.0 += pair[1].saturating_sub(pair[0]) as f64 * period;
                clock.measured.1 += 1;
            }
        }
        Ok((Status::new(words, layout), found))
    }

    /// Do the worlds' parts of the directory cover all blocks that so many sorts can find?
    pub(crate) fn covers(&self, sorts: usize) -> bool {
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
                Some(_) => return Err(self.readback().left_world(world, &outcome.status)),
            }
        }
    }
}
