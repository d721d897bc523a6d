//! Buffers on the device, and how many particles and blocks fit into them.

use crate::device::Gpu;
use crate::device::kernel::{FIRST_BINDING, Found, Kernel, Parts, Role, Sorted, Uniform};
use crate::device::layout::{ENTRY, RECORD, ROUNDS, vectors_for};
use crate::device::probed::{CROSSED, PLACE};
use crate::device::uniforms::{Extent, Layer, StepConstants};
use barchan_core::coupling::{DeviceBody, DeviceGroup};
use barchan_core::{Error, Result};
use bytemuck::Pod;
use std::collections::HashMap;
use std::sync::PoisonError;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Words of the status: before those of layers, of each layer that stay and that a submission sums up, and of each layer in each step;
/// see `common.wgsl`.
pub(crate) const OF_LAYERS: usize = 14;
pub(crate) const PER_LAYER: usize = 8;
pub(crate) const PER_SUM: usize = 24;
pub(crate) const PER_STEP: usize = 4;
/// So long a device that is not this machine's processor is asked again and again whether it is done, while others may go first: to be woken takes as
/// long as some steps of a small world.
const AWAKE: Duration = Duration::from_millis(20);
/// Steps that one submission can take, and those of the finest level in them where levels take steps of their own or bodies move.
pub(crate) const MAX_STEPS: usize = 512;
pub(crate) const MAX_SLOTS: usize = 256;
/// Constants of steps in a submission: those of steps and sorts; subcycled, of what begins and what ends with each slot, and of free bodies that
/// coarser levels meet on their own.
const STEP_SLOTS: u64 = 6 * MAX_SLOTS as u64;
/// Bytes from one step's constants to the next.
pub(crate) const STEP_STRIDE: u64 = 256;
/// Workgroups in a row of a dispatch.
const ROW: u32 = 32_768;

/// Vectors of a body in a step; see `contact.wgsl`.
pub(crate) const BODY: u64 = 9;
/// Vectors of a group and of a body that answer, as they stay during a submission, of a body's state before a slot, and of a touch; see `answering.wgsl`.
pub(crate) const GROUP_HEAD: usize = 2;
pub(crate) const BODY_HEAD: usize = 5;
pub(crate) const BODY_STATE: usize = 5;
pub(crate) const TOUCH: usize = 3;
/// Vectors that tell of blocks of nodes near a body on a level, and of such a block; see `answering.wgsl`.
pub(crate) const NEAR_HEAD: usize = 2;
pub(crate) const HELD_HEAD: usize = 2;
/// A body that answers has rooms for a multiple of so many blocks of nodes, since the 256 threads of a body alone take up all nodes of so many at once; see `answer.wgsl`.
pub(crate) const ABREAST: usize = 4;
/// Columns of what touches of a body add up to; see `answer.wgsl`.
const COLUMNS: usize = 11;
/// Vectors of a block of nodes that goes to the host; see `gather.wgsl`.
pub(crate) const NEAR_BLOCK: usize = 65;
/// Words that tell of a block's rest; see `watch_words.wgsl`.
pub(crate) const WATCHED: usize = 12;
/// Words of a soft body that levels follow; see `soft.wgsl`.
pub(crate) const SOFT_WORDS: usize = 27;

/// Room for groups that answer in each world, for their bodies in all and in one group, for words of a group's state and words that it is told, for its rates, for blocks around all bodies
/// on the finest level, and around one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Answering {
    pub(crate) groups: usize,
    pub(crate) bodies: usize,
    pub(crate) together: usize,
    pub(crate) words: usize,
    pub(crate) told: usize,
    pub(crate) rates: usize,
    pub(crate) rooms: usize,
    pub(crate) widest: usize,
}

impl Answering {
    /// For the groups of all couplings of a world, whose bodies have so many blocks around them.
    pub(crate) fn of(groups: &[Vec<DeviceGroup>], rooms: impl Fn(&DeviceBody) -> usize) -> Self {
        let rooms = |body: &DeviceBody| rooms(body).next_multiple_of(ABREAST);
        let all = || groups.iter().flatten();
        Self {
            groups: all().count(),
            bodies: all().map(|group| group.bodies.len()).sum(),
            together: all().map(|group| group.bodies.len()).max().unwrap_or(0),
            words: all().map(|group| group.words).max().unwrap_or(0),
            told: all().map(|group| group.told).max().unwrap_or(0),
            rates: all().map(|group| group.rates).max().unwrap_or(0),
            rooms: all().flat_map(|group| &group.bodies).map(rooms).sum(),
            widest: all().flat_map(|group| &group.bodies).map(rooms).max().unwrap_or(0),
        }
    }

    /// For either.
    pub(crate) fn with(self, other: Self) -> Self {
        Self {
            groups: self.groups.max(other.groups),
            bodies: self.bodies.max(other.bodies),
            together: self.together.max(other.together),
            words: self.words.max(other.words),
            told: self.told.max(other.told),
            rates: self.rates.max(other.rates),
            rooms: self.rooms.max(other.rooms),
            widest: self.widest.max(other.widest),
        }
    }
}

/// What not every scene asks for: room for pairs of nodes at walls that let go, and for bodies whose law runs on the device.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Asked {
    pub(crate) pairs: bool,
    pub(crate) bodies: usize,
    pub(crate) answering: Answering,
    pub(crate) layers: usize,
    pub(crate) worlds: usize,
    /// Boxes of the regions of a world's levels.
    pub(crate) boxes: usize,
    /// Steps of the finest level in one of the coarsest.
    pub(crate) substeps: usize,
    /// Soft bodies that levels follow, in all worlds.
    pub(crate) softs: usize,
    /// Tiles of unbounded ground that are live, in each world.
    pub(crate) live: usize,
    /// Where the couplings' law runs on the host: boxes around the bodies of a layer, and blocks of nodes that go there and back.
    pub(crate) around: usize,
    pub(crate) near: usize,
    /// Does ground sleep, and how many boxes of a layer are there that it does not sleep in?
    pub(crate) sleeps: bool,
    pub(crate) tools: usize,
    /// Sections of probes and parts of walls in each world, and words with which worlds are looked at.
    pub(crate) probed: usize,
    pub(crate) sought: usize,
}

/// Is what couplings' laws read stored? A uniform holds so much everywhere, and not what differs from world to world.
pub(crate) fn is_stored(worlds: usize, vectors: usize, samples: usize) -> bool {
    worlds > 1 || 16 * (vectors + samples) > 65_536
}

/// Bytes of bodies that answer, their groups' states in a submission, the nodes near them, how bodies grip them on each level and whether they grip any, and, where
/// groups have several bodies, what their touches add up to.
pub(crate) fn answering_bytes(room: Answering, worlds: usize, levels: usize) -> u64 {
    let Answering { groups, bodies, together, words, told, rooms, .. } = room;
    let touches = 64 * rooms * TOUCH;
    let pressed = ((64 + HELD_HEAD) * rooms + NEAR_HEAD * bodies) * levels;
    let of_groups = worlds * groups * (GROUP_HEAD + told + (MAX_SLOTS + 2) * words);
    let of_bodies = worlds * (bodies * (BODY_HEAD + (MAX_SLOTS + 2) * BODY_STATE) + touches + pressed);
    let systems = if together > 1 { COLUMNS * (worlds * bodies + together) } else { 0 };
    16 * (of_groups + of_bodies + systems) as u64
}

/// Where words of the status stand, for so many layers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Words {
    pub(crate) layers: usize,
}

impl Words {
    /// A word of a layer that stays.
    pub(crate) fn of_layer(self, layer: usize, k: usize) -> usize {
        OF_LAYERS + PER_LAYER * layer + k
    }
    /// A word of a layer that a submission sums up.
    pub(crate) fn of_sum(self, layer: usize, k: usize) -> usize {
        OF_LAYERS + PER_LAYER * self.layers + PER_SUM * layer + k
    }
    /// How many nodes of all layers are too fast for a step.
    pub(crate) fn fast(self, step: usize) -> usize {
        self.of_sum(self.layers, step)
    }
    /// A word of a layer in a step.
    pub(crate) fn of_step(self, step: usize, layer: usize, k: usize) -> usize {
        // Before them stands how many nodes are too fast.
        self.of_sum(self.layers, MAX_STEPS) + PER_STEP * (step * self.layers + layer) + k
    }
    /// How many there are with those of so many steps, which stand last.
    pub(crate) fn count(self, steps: usize) -> usize {
        self.of_step(steps, 0, 0)
    }
}

/// Room for as many particles as there are now and a quarter more, so that it rarely has to grow; beside many millions, a part that is worth its
/// memory.
pub(crate) fn slots_for(particles: usize) -> usize {
    (particles + (particles / 4).min(1 << 22) + 64).next_multiple_of(128)
}

/// Likewise of blocks, of places of the directory, and of tiles.
pub(crate) fn with_room(count: usize) -> u32 {
    (count + (count / 4).min(1 << 14) + 64) as u32
}

/// All buffers of an engine.
pub(crate) struct Memory {
    pub(crate) extent: Extent,
    particles: Particles,
    asked: Asked,
    /// Of each as many as there are parts.
    sorted: [[Vec<wgpu::Buffer>; 6]; 2],
    shared: HashMap<&'static str, wgpu::Buffer>,
    pub(crate) constants: wgpu::Buffer,
    pub(crate) params: wgpu::Buffer,
    pub(crate) table: Option<wgpu::Buffer>,
    pub(crate) regions: wgpu::Buffer,
    pub(crate) steps: wgpu::Buffer,
    pub(crate) layers: wgpu::Buffer,
    pub(crate) readback: wgpu::Buffer,
    upload: wgpu::Buffer,
    bindings: HashMap<(&'static str, usize), wgpu::BindGroup>,
    pub(crate) step_binding: wgpu::BindGroup,
    /// Which of the two sets holds the particles.
    pub(crate) now: usize,
}

const SORTED: [Sorted; 6] = [Sorted::Record, Sorted::Ids, Sorted::Rest, Sorted::Lists, Sorted::Cells, Sorted::Watch];
/// What is not sorted.
const SHARED: [Role; 26] = [
    Role::Grid,
    Role::Status,
    Role::Flags,
    Role::Directory,
    Role::Sums,
    Role::Keys,
    Role::Loose,
    Role::Order,
    Role::Owners,
    Role::Pairs,
    Role::Bodies,
    Role::Partials,
    Role::Impulses,
    Role::Answering,
    Role::Rims,
    Role::Handed,
    Role::Shared,
    Role::Around,
    Role::Near,
    Role::Tools,
    Role::Soft,
    Role::Live,
    Role::Listed,
    Role::Groups,
    Role::Crossed,
    Role::Sought,
];

/// How particles stand in memory.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Particles {
    /// Vectors of four of strain and history.
    pub(crate) vectors: usize,
    pub(crate) parts: Parts,
}

impl Particles {
    /// Planes of a particle, and bytes in each.
    fn planes(self, sorted: Sorted) -> (usize, u64) {
        match sorted {
            Sorted::Record => (RECORD, 16),
            Sorted::Ids => (1, 8),
            Sorted::Rest => (self.vectors, 16),
            Sorted::Lists | Sorted::Cells | Sorted::Watch => (0, 0),
        }
    }

    /// Bytes of a particle in a part.
    fn part_bytes(self, sorted: Sorted) -> u64 {
        let (planes, bytes) = self.planes(sorted);
        (planes / self.parts.of_sorted(sorted)) as u64 * bytes
    }
}

/// Most particles with so many values of strain and history that fit what a pass may bind.
pub(crate) fn most_particles(limits: &wgpu::Limits, values: usize) -> u64 {
    let vectors = vectors_for(values);
    let particles = Particles { vectors, parts: Parts::new(limits, vectors) };
    let cap = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    let bytes = [Sorted::Record, Sorted::Ids, Sorted::Rest].map(|sorted| particles.part_bytes(sorted));
    let slots = bytes.into_iter().max().map_or(0, |bytes| cap / bytes);
    // Slots are counted in full workgroups.
    slots / 128 * 128
}

/// Some of a buffer: which part it is, the first byte there, and bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Piece {
    pub(crate) part: usize,
    pub(crate) from: u64,
    pub(crate) bytes: u64,
}

impl Extent {
    /// Bytes of a part.
    fn sorted_bytes(&self, sorted: Sorted, particles: Particles, asked: Asked) -> u64 {
        let (slots, blocks) = (u64::from(self.slots), u64::from(self.block_room));
        match sorted {
            Sorted::Record | Sorted::Ids | Sorted::Rest => particles.part_bytes(sorted) * slots,
            Sorted::Lists => 16 * ENTRY as u64 * (blocks + u64::from(self.node_room)),
            // Starts, and those of rounds behind them.
            Sorted::Cells => 4 * (64 * (blocks + 1) + 64 * (ROUNDS as u64 + 1) * blocks),
            Sorted::Watch if asked.sleeps => 4 * (WATCHED as u64 * blocks + u64::from(self.node_room)),
            Sorted::Watch => 0,
        }
    }

    fn stretches(&self, sorted: Sorted, particles: Particles, first: usize, count: usize) -> Vec<Piece> {
        let (planes, each) = particles.planes(sorted);
        let is_apart = particles.parts.of_sorted(sorted) > 1;
        let of_plane = |k: usize| {
            let (part, within) = if is_apart { (k, 0) } else { (0, k as u64) };
            let from = (within * u64::from(self.slots) + first as u64) * each;
            Piece { part, from, bytes: count as u64 * each }
        };
        (0..planes).map(of_plane).filter(|piece| piece.bytes > 0).collect()
    }

    fn shared_bytes(&self, role: Role, asked: Asked) -> u64 {
        let (slots, blocks, nodes) = (u64::from(self.slots), u64::from(self.block_room), u64::from(self.node_room));
        let places = u64::from(self.places);
        match role {
            Role::Grid => 16 * (64 * nodes + 512 * blocks),
            Role::Status => 4 * Words { layers: asked.layers }.count(MAX_STEPS) as u64,
            Role::Flags => 4 * places,
            Role::Directory => 8 * places,
            Role::Sums => 8 * places.div_ceil(1024).max(blocks),
            Role::Keys | Role::Owners => 8 * slots,
            Role::Loose | Role::Order => 4 * slots,
            Role::Pairs => 16 * if asked.pairs { 3 * 64 * nodes } else { 1 },
            Role::Bodies => 16 * BODY * (MAX_SLOTS * asked.layers * asked.bodies).max(1) as u64,
            Role::Partials => (32 + 1024) * nodes * asked.bodies as u64,
            Role::Impulses => 32 * (MAX_SLOTS * asked.layers * asked.bodies).max(1) as u64,
            Role::Answering => answering_bytes(asked.answering, asked.worlds, asked.layers / asked.worlds.max(1)),
            Role::Around => 16 * (1 + 2 * asked.layers * asked.around) as u64,
            Role::Near => 16 * (NEAR_BLOCK * asked.near) as u64,
            Role::Tools => 16 * (1 + 2 * MAX_SLOTS * asked.layers * asked.tools) as u64,
            Role::Live => 8 * ((1 + asked.live) * asked.worlds) as u64,
            Role::Soft => 4 * (SOFT_WORDS * asked.softs) as u64,
            Role::Rims if asked.boxes > 0 => 16 * (nodes + blocks),
            Role::Handed if asked.boxes > 0 => 16 * (64 * nodes + 24 * blocks + 512 * u64::from(self.giver_room)),
            Role::Shared if asked.substeps > 1 => 16 * 192 * nodes,
            // Behind the lists, of which kinds each block is.
            Role::Listed if asked.boxes > 0 => {
                4 * ((Found::LISTED * (1 + asked.layers)) as u64 + (Found::LISTED as u64 + 1) * nodes.max(blocks))
            }
            Role::Groups => 12 * (Found::ALL * asked.layers) as u64,
            Role::Crossed => 4 * (asked.probed * (PLACE * asked.layers + CROSSED * asked.worlds)) as u64,
            Role::Sought => 4 * asked.sought as u64,
            Role::Listed | Role::Now(_) | Role::Next(_) | Role::Rims | Role::Handed | Role::Shared => 0,
        }
    }

    /// Bytes of each buffer of one set, and how many of it there are.
    fn all_bytes(&self, particles: Particles, asked: Asked) -> impl Iterator<Item = (&'static str, u64, u64)> {
        let copies = |s| 2 * particles.parts.of_sorted(s) as u64;
        let sorted = SORTED.map(|s| (s.name(), self.sorted_bytes(s, particles, asked), copies(s)));
        let shared = SHARED.map(|r| (r.name(), self.shared_bytes(r, asked), 1));
        sorted.into_iter().chain(shared)
    }

    /// Does every buffer fit what the adapter binds?
    fn check(&self, gpu: &Gpu, particles: Particles, asked: Asked) -> Result<()> {
        let cap = (gpu.limits.max_storage_buffer_binding_size).min(gpu.limits.max_buffer_size);
        let Some((what, asked, _)) = self.all_bytes(particles, asked).find(|(_, bytes, _)| *bytes > cap) else {
            return Ok(());
        };
        Err(Error::Capacity {
            what: match what {
                "nodes and tiles" | "what rims hand on" | "nodes that levels share" => {
                    "bytes of nodes and tiles in one binding of the adapter"
                }
                "directory of blocks" | "marks of blocks" => {
                    "bytes of the directory of blocks in one binding of the adapter"
                }
                _ => "bytes of particles in one binding of the adapter",
            },
            asked,
            cap,
            mend: "simulate fewer particles or a smaller box around them, choose an adapter that binds more (--adapter), or use the backend cpu",
        })
    }
}

impl Memory {
    pub(crate) fn new(
        gpu: &Gpu,
        extent: Extent,
        particles: Particles,
        asked: Asked,
        params: &[[f32; 4]],
        step_layout: &wgpu::BindGroupLayout,
    ) -> Result<Self> {
        let extent = Extent { row: ROW, ..extent };
        extent.check(gpu, particles, asked)?;
        let device = &gpu.device;
        let storage = |label: &'static str, size: u64| storage(gpu, label, size);
        let uniform = |label: &'static str, size: u64| {
            buffer(gpu, label, size, wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST)
        };
        let of_parts = |s: Sorted| {
            let part = |_| storage(s.name(), extent.sorted_bytes(s, particles, asked));
            (0..particles.parts.of_sorted(s)).map(part).collect::<Vec<_>>()
        };
        let set = || SORTED.map(of_parts);
        let mut shared: HashMap<_, _> =
            SHARED.iter().map(|&r| (r.name(), storage(r.name(), extent.shared_bytes(r, asked)))).collect();
        shared.insert(Role::Groups.name(), groups(gpu, extent.shared_bytes(Role::Groups, asked)));
        let constants = uniform("extent", size_of::<Extent>() as u64);
        gpu.queue.write_buffer(&constants, 0, bytemuck::bytes_of(&extent));
        let values = params;
        let params = table(gpu, "parameters", values.len(), asked.worlds > 1);
        gpu.queue.write_buffer(&params, 0, bytemuck::cast_slice(values));
        let steps = uniform("steps", STEP_STRIDE * STEP_SLOTS);
        let regions = uniform("regions", 64 * (asked.worlds * asked.boxes).max(1) as u64);
        let layers = uniform("layers", (size_of::<Layer>() * asked.layers) as u64);
        let step_binding = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("step"),
            layout: step_layout,
            entries: &[
                wgpu::BindGroupEntry {
                    binding: 0,
                    resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                        buffer: &steps,
                        offset: 0,
                        size: wgpu::BufferSize::new(size_of::<StepConstants>() as u64),
                    }),
                },
                wgpu::BindGroupEntry { binding: 1, resource: layers.as_entire_binding() },
            ],
        });
        let readback = mappable(gpu, 4 * Words { layers: asked.layers }.count(MAX_STEPS) as u64);
        Ok(Self {
            extent,
            particles,
            asked,
            sorted: [set(), set()],
            shared,
            constants,
            params,
            table: None,
            regions,
            steps,
            layers,
            readback,
            upload: upload(gpu, 1 << 16),
            bindings: HashMap::new(),
            step_binding,
            now: 0,
        })
    }

    /// Boxes of levels that there is room for.
    pub(crate) fn boxes(&self) -> usize {
        self.asked.boxes
    }

    /// Bytes for particles, and for the grid.
    pub(crate) fn bytes(&self) -> (u64, u64) {
        let of_grid = |name: &str| {
            [Role::Grid, Role::Flags, Role::Directory, Role::Sums, Role::Pairs, Role::Rims, Role::Handed, Role::Shared]
                .map(Role::name)
                .contains(&name)
                || [Sorted::Lists, Sorted::Cells, Sorted::Watch].map(Sorted::name).contains(&name)
        };
        let all = self.extent.all_bytes(self.particles, self.asked);
        all.fold((0, 0), |(particles, grid), (name, bytes, copies)| {
            if of_grid(name) { (particles, grid + bytes * copies) } else { (particles + bytes * copies, grid) }
        })
    }

    /// A buffer, the first if it has several parts.
    pub(crate) fn buffer(&self, role: Role, now: usize) -> &wgpu::Buffer {
        self.part(role, 0, now)
    }

    /// A part of a buffer.
    pub(crate) fn part(&self, role: Role, part: usize, now: usize) -> &wgpu::Buffer {
        match role {
            Role::Now(sorted) => &self.sorted[now][sorted as usize][part],
            Role::Next(sorted) => &self.sorted[1 - now][sorted as usize][part],
            shared => &self.shared[shared.name()],
        }
    }

    /// What a sort has laid out.
    pub(crate) fn plane(&self, sorted: Sorted) -> &wgpu::Buffer {
        self.buffer(Role::Now(sorted), self.now)
    }

    /// Where to read so many particles from one on, plane by plane: buffer, first byte, bytes.
    pub(crate) fn held(&self, sorted: Sorted, first: usize, count: usize) -> Vec<(&wgpu::Buffer, u64, u64)> {
        let buffer = |s: Piece| (self.part(Role::Now(sorted), s.part, self.now), s.from, s.bytes);
        self.stretches(sorted, first, count).into_iter().map(buffer).collect()
    }

    pub(crate) fn binding(&mut self, device: &wgpu::Device, kernel: &Kernel, now: usize) -> wgpu::BindGroup {
        if let Some(group) = self.bindings.get(&(kernel.name, now)) {
            return group.clone();
        }
        let mut entries = vec![wgpu::BindGroupEntry { binding: 0, resource: self.constants.as_entire_binding() }];
        let uniform = match kernel.uniform {
            Uniform::None => None,
            Uniform::Params => Some(&self.params),
            Uniform::Table { .. } => self.table.as_ref(),
            Uniform::Regions => Some(&self.regions),
        };
        entries.extend(uniform.map(|b| wgpu::BindGroupEntry { binding: 1, resource: b.as_entire_binding() }));
        entries.extend((FIRST_BINDING..).zip(&kernel.roles).map(|(binding, &(role, part))| wgpu::BindGroupEntry {
            binding,
            resource: self.part(role, part, now).as_entire_binding(),
        }));
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.name),
            layout: &kernel.layout,
            entries: &entries,
        });
        self.bindings.insert((kernel.name, now), group.clone());
        group
    }

    /// Where words of the status stand.
    pub(crate) fn words(&self) -> Words {
        Words { layers: self.asked.layers }
    }

    /// Where so many particles stand, plane by plane.
    pub(crate) fn stretches(&self, sorted: Sorted, first: usize, count: usize) -> Vec<Piece> {
        self.extent.stretches(sorted, self.particles, first, count)
    }

    /// Says how many particles there are.
    pub(crate) fn count(&mut self, gpu: &Gpu, particles: usize) {
        self.extent.particles = particles as u32;
        gpu.queue.write_buffer(&self.constants, 0, bytemuck::bytes_of(&self.extent));
    }

    /// Lets a submission begin with writes.
    pub(crate) fn write(&mut self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, writes: &Writes) {
        if self.upload.size() < writes.bytes.len() as u64 {
            self.upload = upload(gpu, (writes.bytes.len() + writes.bytes.len() / 4).next_multiple_of(16) as u64);
        }
        if !writes.bytes.is_empty() {
            gpu.queue.write_buffer(&self.upload, 0, &writes.bytes);
        }
        let mut at = 0;
        for (buffer, from, bytes) in &writes.places {
            encoder.copy_buffer_to_buffer(&self.upload, at, buffer, *from, *bytes);
            at += bytes;
        }
    }

    /// Makes room for so many bytes to be read back at once.
    pub(crate) fn read_back_to(&mut self, gpu: &Gpu, bytes: u64) {
        if self.readback.size() < bytes {
            self.readback = mappable(gpu, bytes + bytes / 4);
        }
    }

    /// Makes room for bodies whose law runs on the device, so many in each layer and such as answer in each world, and for what it reads: so many
    /// vectors of all worlds, and these samples.
    pub(crate) fn add_bodies(
        &mut self,
        gpu: &Gpu,
        [bodies, vectors]: [usize; 2],
        answering: Answering,
        samples: &[[f32; 4]],
    ) -> Result<()> {
        let stored = is_stored(self.asked.worlds, vectors, samples.len());
        let buffer = table(gpu, "table of bodies", vectors + samples.len(), stored);
        gpu.queue.write_buffer(&buffer, 16 * vectors as u64, bytemuck::cast_slice(samples));
        self.table = Some(buffer);
        (self.asked.bodies, self.asked.answering) = (bodies, answering);
        let extent = self.extent;
        self.grow(gpu, extent)
    }

    /// Blocks of nodes near bodies that there is room for.
    pub(crate) fn near(&self) -> usize {
        self.asked.near
    }

    /// Makes room for so many boxes around the bodies of each layer, and blocks of nodes near them.
    pub(crate) fn add_near(&mut self, gpu: &Gpu, around: usize, near: usize) -> Result<()> {
        if around <= self.asked.around && near <= self.asked.near {
            return Ok(());
        }
        (self.asked.around, self.asked.near) = (self.asked.around.max(around), self.asked.near.max(near));
        let extent = self.extent;
        self.grow(gpu, extent)
    }

    /// Boxes of a layer that nothing sleeps in that there is room for.
    pub(crate) fn tools(&self) -> usize {
        self.asked.tools
    }

    /// Makes room for so many of them.
    pub(crate) fn add_tools(&mut self, gpu: &Gpu, tools: usize) -> Result<()> {
        if tools <= self.asked.tools {
            return Ok(());
        }
        self.asked.tools = tools;
        let extent = self.extent;
        self.grow(gpu, extent)
    }

    /// Live tiles of a world that there is room for.
    pub(crate) fn live(&self) -> usize {
        self.asked.live
    }

    /// Makes room for so many live tiles in each world.
    pub(crate) fn add_live(&mut self, gpu: &Gpu, live: usize) -> Result<()> {
        self.asked.live = live;
        let extent = self.extent;
        self.grow(gpu, extent)
    }

    /// Makes room for so many words with which worlds are looked at.
    pub(crate) fn add_sought(&mut self, gpu: &Gpu, words: usize) -> Result<()> {
        if words <= self.asked.sought {
            return Ok(());
        }
        self.asked.sought = words.next_power_of_two();
        let extent = self.extent;
        self.grow(gpu, extent)
    }

    /// Makes room for `extent`, keeping particles and blocks. What the grid holds is lost, and so are the links of blocks: a sort must follow.
    pub(crate) fn grow(&mut self, gpu: &Gpu, extent: Extent) -> Result<()> {
        let extent = Extent { row: ROW, rooms: self.asked.answering.rooms as u32, ..extent };
        extent.check(gpu, self.particles, self.asked)?;
        let storage = |label: &'static str, size: u64| storage(gpu, label, size);
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for sorted in [Sorted::Lists, Sorted::Cells, Sorted::Watch] {
            for set in 0..2 {
                let old = &self.sorted[set][sorted as usize][0];
                let bytes = extent.sorted_bytes(sorted, self.particles, self.asked);
                if old.size() >= bytes {
                    continue;
                }
                let new = storage(sorted.name(), bytes);
                encoder.copy_buffer_to_buffer(old, 0, &new, 0, old.size());
                self.sorted[set][sorted as usize][0] = new;
            }
        }
        let held = self.extent.particles as usize;
        for sorted in [Sorted::Record, Sorted::Ids, Sorted::Rest] {
            if extent.slots <= self.extent.slots {
                continue;
            }
            for set in 0..2 {
                let bytes = extent.sorted_bytes(sorted, self.particles, self.asked);
                let stretches = |extent: &Extent| extent.stretches(sorted, self.particles, 0, held);
                for (part, buffer) in self.sorted[set][sorted as usize].iter_mut().enumerate() {
                    let old = std::mem::replace(buffer, storage(sorted.name(), bytes));
                    if set != self.now {
                        continue;
                    }
                    for (from, to) in stretches(&self.extent).iter().zip(stretches(&extent)) {
                        if to.part == part {
                            encoder.copy_buffer_to_buffer(&old, from.from, buffer, to.from, to.bytes);
                        }
                    }
                }
            }
        }
        for role in [
            Role::Keys,
            Role::Loose,
            Role::Order,
            Role::Owners,
            Role::Grid,
            Role::Flags,
            Role::Directory,
            Role::Sums,
            Role::Pairs,
            Role::Bodies,
            Role::Partials,
            Role::Impulses,
            Role::Answering,
            Role::Rims,
            Role::Handed,
            Role::Shared,
            Role::Around,
            Role::Near,
            Role::Tools,
            Role::Live,
            Role::Listed,
            Role::Sought,
        ] {
            let bytes = extent.shared_bytes(role, self.asked);
            if self.buffer(role, 0).size() < bytes {
                self.shared.insert(role.name(), storage(role.name(), bytes));
            }
        }
        gpu.queue.submit([encoder.finish()]);
        self.extent = extent;
        self.bindings.clear();
        gpu.queue.write_buffer(&self.constants, 0, bytemuck::bytes_of(&extent));
        Ok(())
    }
}

fn buffer(gpu: &Gpu, label: &'static str, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
    let label = Some(label);
    gpu.device.create_buffer(&wgpu::BufferDescriptor { label, size, usage, mapped_at_creation: false })
}

/// A buffer that passes read and write.
fn storage(gpu: &Gpu, label: &'static str, size: u64) -> wgpu::Buffer {
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
    buffer(gpu, label, size.next_multiple_of(16).max(16), usage)
}

/// A table of so many vectors that passes read: uniform, or, as long as it must be, stored.
fn table(gpu: &Gpu, label: &'static str, vectors: usize, stored: bool) -> wgpu::Buffer {
    let kind = if stored { wgpu::BufferUsages::STORAGE } else { wgpu::BufferUsages::UNIFORM };
    buffer(gpu, label, 16 * vectors as u64, kind | wgpu::BufferUsages::COPY_DST)
}

/// What the device counts its own dispatches by: none, until a sort has counted.
fn groups(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::INDIRECT | wgpu::BufferUsages::COPY_SRC;
    buffer(gpu, Role::Groups.name(), size, usage)
}

/// What a submission begins with writing. Each write of its own takes a queue tens of microseconds.
#[derive(Default)]
pub(crate) struct Writes {
    bytes: Vec<u8>,
    /// Buffer, first byte there, and bytes.
    places: Vec<(wgpu::Buffer, u64, u64)>,
}

impl Writes {
    pub(crate) fn add<T: Pod>(&mut self, buffer: &wgpu::Buffer, from: u64, what: &[T]) {
        self.bytes.extend_from_slice(bytemuck::cast_slice(what));
        self.places.push((buffer.clone(), from, size_of_val(what) as u64));
    }

    /// The constants of steps.
    pub(crate) fn add_steps(&mut self, buffer: &wgpu::Buffer, constants: &[StepConstants]) {
        pad(constants, &mut self.bytes);
        self.places.push((buffer.clone(), 0, STEP_STRIDE * constants.len() as u64));
    }

    /// Forgets what has been written, but keeps the room: 400 steps need a hundred kilobytes.
    pub(crate) fn clear(&mut self) {
        self.bytes.clear();
        self.places.clear();
    }
}

/// Adds the constants of steps as the device reads them.
pub(crate) fn pad(constants: &[StepConstants], bytes: &mut Vec<u8>) {
    bytes.reserve(STEP_STRIDE as usize * constants.len());
    for one in constants {
        let end = bytes.len() + STEP_STRIDE as usize;
        bytes.extend_from_slice(bytemuck::bytes_of(one));
        bytes.resize(end, 0);
    }
}

/// A buffer that is filled for what is written with a submission.
fn upload(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    buffer(gpu, "upload", size, wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST)
}

/// A buffer that the host can look into.
fn mappable(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    buffer(gpu, "readback", size, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)
}

/// Copies a stretch of a buffer to the host.
pub(crate) fn read<T: Pod>(gpu: &Gpu, buffer: &wgpu::Buffer, from: u64, count: usize) -> Result<Vec<T>> {
    read_all(gpu, &[(buffer, from, (count * size_of::<T>()) as u64)])
}

/// Copies stretches of several buffers to the host, (buffer, first byte, bytes) each, one after the other, and much of it a part at a
/// time. The memory that they pass through is kept: it takes longer to get than to fill.
pub(crate) fn read_all<T: Pod>(gpu: &Gpu, stretches: &[(&wgpu::Buffer, u64, u64)]) -> Result<Vec<T>> {
    const PART: u64 = 64 << 20;
    let bytes: u64 = stretches.iter().map(|(.., bytes)| bytes).sum();
    let mut out = Vec::with_capacity(bytes as usize / size_of::<T>());
    if bytes == 0 {
        return Ok(out);
    }
    for (sum, more) in gpu.transferred.iter().zip([1, bytes]) {
        sum.fetch_add(more, Ordering::Relaxed);
    }
    let mut passage = gpu.passage.lock().unwrap_or_else(PoisonError::into_inner);
    let room = bytes.min(PART);
    let staging = match passage.take().filter(|staging| staging.size() >= room) {
        Some(staging) => staging,
        None => mappable(gpu, room.next_power_of_two()),
    };
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    let mut filled = 0;
    let mut left = bytes;
    for &(buffer, mut from, mut bytes) in stretches {
        while bytes > 0 {
            let some = bytes.min(PART - filled);
            encoder.copy_buffer_to_buffer(buffer, from, &staging, filled, some);
            (from, bytes, filled, left) = (from + some, bytes - some, filled + some, left - some);
            if filled == PART || left == 0 {
                let fresh = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
                gpu.queue.submit([std::mem::replace(&mut encoder, fresh).finish()]);
                // What is mapped begins at a multiple of eight.
                let take = |bytes: &[u8]| out.extend_from_slice(bytemuck::cast_slice(bytes));
                with_mapped(gpu, &staging, filled, take)?;
                filled = 0;
            }
        }
    }
    *passage = Some(staging);
    Ok(out)
}

/// Waits for the device and shows what a buffer that can be mapped holds.
pub(crate) fn with_mapped(gpu: &Gpu, buffer: &wgpu::Buffer, bytes: u64, see: impl FnOnce(&[u8])) -> Result<()> {
    let lost = |what: String| Error::Device {
        backend: crate::device::BACKEND.to_owned(),
        device: gpu.adapter_info.name.clone(),
        what,
        mend: "resume from the last snapshot, or use the backend cpu".to_owned(),
    };
    let slice = buffer.slice(0..bytes);
    slice.map_async(wgpu::MapMode::Read, |_| {});
    let asked = Instant::now();
    // An error shows when the device is waited for.
    let is_busy = || gpu.device.poll(wgpu::PollType::Poll).is_ok_and(|status| !status.is_queue_empty());
    while gpu.adapter_info.device_type != wgpu::DeviceType::Cpu && asked.elapsed() < AWAKE && is_busy() {
        std::thread::yield_now();
    }
    let polled = gpu.device.poll(wgpu::PollType::wait_indefinitely());
    gpu.check()?;
    polled.map_err(|e| lost(format!("waiting for it failed: {e}")))?;
    {
        let range = slice.get_mapped_range().map_err(|e| lost(format!("its memory cannot be read: {e}")))?;
        see(&range);
    }
    buffer.unmap();
    Ok(())
}
