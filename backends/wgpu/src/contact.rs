//! Contact whose law runs on the host, in a batch of one world: the nodes near bodies, there and back.

use crate::batch::{Dispatch, HALTED, Halt, MOVE, NODE_MOVE, Part, SORTED, Status, WALL_IMPULSE, WgpuBatch};
use crate::kernels::{Role, Sorted};
use crate::layout;
use crate::memory::{PER_STEP, read, read_parts};
use crate::world::FELT;
use barchan_core::{Aabb, Coupling, Error, NodeBatch, Result, StepReport, Vec3};
use std::collections::BTreeMap;
use std::time::Instant;

/// The world whose bodies are near: a batch of several has none whose law runs on the host.
const WORLD: usize = 0;
/// Bytes of a block's nodes.
const BLOCK: u64 = 1024;

/// Blocks of nodes on the host: velocities and masses.
#[derive(Default)]
pub(crate) struct Nodes {
    blocks: BTreeMap<u32, Vec<[f32; 4]>>,
    /// Numbers of those that are to be read.
    wanted: Vec<u32>,
    changed: Vec<u32>,
}

/// Numbers of the blocks with nodes in the boxes.
fn blocks_in(ground: &WgpuBatch, boxes: &[Aabb]) -> Vec<u32> {
    let meets = |(block, level): &([i32; 3], usize)| {
        let h = ground.worlds[WORLD].levels[*level].h;
        let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
        let first = block.map(|b| 4 * b);
        let extent = Aabb { min: first.map(centre), max: first.map(|c| centre(c + 3)) };
        boxes.iter().any(|b| b.meets(&extent))
    };
    let all = ground.node_blocks.iter().flatten().zip(0..);
    all.filter(|(place, _)| meets(place)).map(|(_, g)| g).collect()
}

impl Nodes {
    /// Forgets all, and says which stretches of the grid hold the blocks in the boxes: first byte, bytes.
    pub(crate) fn begin(&mut self, ground: &WgpuBatch, boxes: &[Aabb]) -> Vec<(u64, u64)> {
        self.blocks.clear();
        self.changed.clear();
        self.wanted = blocks_in(ground, boxes);
        self.stretches()
    }

    /// Blocks that stand together are read together.
    fn stretches(&self) -> Vec<(u64, u64)> {
        let runs = self.wanted.chunk_by(|a, b| a + 1 == *b);
        runs.map(|run| (u64::from(run[0]) * BLOCK, run.len() as u64 * BLOCK)).collect()
    }

    /// Takes in what the wanted stretches hold.
    pub(crate) fn take(&mut self, nodes: &[[f32; 4]]) {
        self.blocks.extend(self.wanted.drain(..).zip(nodes.chunks_exact(64).map(<[_]>::to_vec)));
    }

    /// Reads those in the boxes that are not here yet.
    pub(crate) fn fetch(&mut self, ground: &WgpuBatch, boxes: &[Aabb]) -> Result<()> {
        self.wanted = blocks_in(ground, boxes);
        self.wanted.retain(|g| !self.blocks.contains_key(g));
        let nodes: Vec<[f32; 4]> = read_parts(&ground.gpu, ground.memory.buffer(Role::Grid, 0), &self.stretches())?;
        self.take(&nodes);
        Ok(())
    }

    /// Hands a level's nodes in the boxes to a law, and takes back their velocities. Returns the greatest speed that particles
    /// may feel [m/s].
    pub(crate) fn apply(
        &mut self,
        ground: &WgpuBatch,
        level: usize,
        boxes: &[Aabb],
        law: impl FnOnce(&mut NodeBatch) -> Result<()>,
    ) -> Result<f64> {
        let h = ground.worlds[WORLD].levels[level].h;
        let (mut batch, mut places) = (NodeBatch { cell_width: h, ..NodeBatch::default() }, Vec::new());
        let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
        let at = ground.node_blocks.as_deref().unwrap_or_default();
        for g in blocks_in(ground, boxes).into_iter().filter(|g| at[*g as usize].1 == level) {
            let first = at[g as usize].0.map(|b| 4 * b);
            for (n, node) in self.blocks[&g].iter().enumerate() {
                let mass = f64::from(node[3]);
                if mass <= ground.worlds[WORLD].least_mass {
                    continue;
                }
                let local = [(n / 16) as i32, (n / 4 % 4) as i32, (n % 4) as i32];
                let x = std::array::from_fn(|d| centre(first[d] + local[d]));
                if boxes.iter().any(|b| b.contains(x)) {
                    batch.position.push(x);
                    batch.mass.push(mass);
                    batch.velocity.push([node[0], node[1], node[2]].map(f64::from));
                    places.push((g, n));
                }
            }
        }
        if batch.is_empty() {
            return Ok(0.0);
        }
        law(&mut batch)?;
        let mut greatest = 0.0f64;
        for ((&(g, n), u), mass) in places.iter().zip(&batch.velocity).zip(&batch.mass) {
            let node = self.blocks.get_mut(&g).expect("its block was read");
            let felt = (mass / (ground.worlds[WORLD].least_mass * FELT)).min(1.0);
            for d in 0..3 {
                node[n][d] = u[d] as f32;
                let speed = felt * u[d].abs();
                greatest = if speed.is_nan() || greatest.is_nan() { f64::NAN } else { greatest.max(speed) };
            }
        }
        self.changed.extend(places.iter().map(|(g, _)| g));
        self.changed.sort_unstable();
        self.changed.dedup();
        Ok(greatest)
    }

    /// Writes back the blocks that a law has changed.
    pub(crate) fn give_back(&mut self, ground: &WgpuBatch) {
        let grid = ground.memory.buffer(Role::Grid, 0);
        for run in self.changed.chunk_by(|a, b| a + 1 == *b) {
            let nodes: Vec<[f32; 4]> = run.iter().flat_map(|g| self.blocks[g].iter().copied()).collect();
            ground.gpu.queue.write_buffer(grid, u64::from(run[0]) * BLOCK, bytemuck::cast_slice(&nodes));
        }
        self.changed.clear();
    }
}

impl WgpuBatch {
    /// One step with couplings whose law runs on the host: nodes near their bodies go there and back.
    pub(crate) fn step_with_contact(
        &mut self,
        time: f64,
        mut dt: f64,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<StepReport> {
        let ground = !self.worlds[WORLD].particles().is_empty();
        let (mut speed, mut sorted) = (0.0, false);
        let mut nodes = Nodes::default();
        if ground {
            if self.unlinked {
                self.settle()?;
                self.sort_now(WORLD, couplings)?;
            }
            loop {
                let boxes: Vec<_> = couplings.iter().flat_map(|c| c.bounds()).collect();
                let status = self.ground_to_nodes(time, dt, &boxes, &mut nodes)?;
                speed = status.speed(1, self.layers_of(WORLD));
                let moves = speed * dt / self.h;
                if status.halt() == Some(Halt::Drifted) && !sorted {
                    self.sort_now(WORLD, couplings)?;
                    sorted = true;
                    continue;
                }
                if status.halt().is_some() || !moves.is_finite() {
                    return Err(self.explain(WORLD, &status, speed, time));
                }
                if moves <= NODE_MOVE {
                    break;
                }
                dt *= (0.9 * NODE_MOVE / moves).max(0.1);
                self.worlds[WORLD].shortened += 1;
            }
        }
        let begun = Instant::now();
        for coupling in couplings.iter_mut() {
            coupling.before_step(time, dt)?;
        }
        for coupling in couplings.iter_mut().filter(|_| ground) {
            let boxes = coupling.bounds();
            nodes.fetch(self, &boxes)?;
            for level in 0..self.levels {
                let reached = nodes.apply(self, level, &boxes, |batch| coupling.contact(dt, batch))?;
                speed = if reached.is_nan() { reached } else { speed.max(reached) };
            }
        }
        self.contact_seconds.0 += begun.elapsed().as_secs_f64();
        self.contact_seconds.1 += 1;
        let moves = speed * dt / self.h;
        if moves.is_nan() || moves > NODE_MOVE * (1.0 + 1e-9) {
            return Err(Error::TimeStep {
                step: self.worlds[WORLD].steps,
                dt,
                bound: NODE_MOVE * dt / moves,
                by: "the speed that a coupling gave to a node".into(),
            });
        }
        if ground {
            nodes.give_back(self);
            self.nodes_to_ground(time, dt, speed)?;
            self.worlds[WORLD].book_gravity(time, dt, 1);
            self.worlds[WORLD].stiffness_age += 1;
        }
        self.worlds[WORLD].steps += 1;
        for coupling in couplings {
            coupling.after_step(time, dt)?;
        }
        self.worlds[WORLD].last_dt = dt;
        Ok(StepReport { dt, sorted, max_speed: speed, ..StepReport::default() })
    }

    /// P2G and the grid update; brings back the status and the nodes in the boxes.
    fn ground_to_nodes(&mut self, time: f64, dt: f64, boxes: &[Aabb], nodes: &mut Nodes) -> Result<Status> {
        self.know_node_blocks()?;
        // The last step's numbers stand in the words of step 0.
        let mut layers = self.layers(|_| true);
        if !self.pending {
            layers.iter_mut().for_each(|layer| layer.age = layer.age.wrapping_sub(1));
        }
        self.write_layers(&layers);
        self.write_steps(1, &[self.step_constants(dt, self.worlds[WORLD].scene.gravity_at(time), 1)]);
        let words = self.words();
        self.write_words(HALTED, &[0, 0, u32::MAX]);
        self.layers_of(WORLD).for_each(|layer| self.write_words(words.of_sum(layer, SORTED), &[0]));
        if !self.pending {
            self.write_words(words.of_step(0, WORLD, 0), &self.drifts(0));
        }
        self.write_words(words.of_step(1, WORLD, 0), &vec![0; PER_STEP * words.layers]);
        self.write_words(words.greatest(1), &[0]);
        let now = self.memory.now;
        let passes = [&self.kernels.p2g].into_iter().chain(&self.kernels.restrict).chain(&self.kernels.grid);
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 1 }).collect();
        let wanted = nodes.begin(self, boxes);
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let mut found = Self::run(&self.gpu, &mut self.memory, &mut self.clocks, &parts, &wanted)?;
        let of_nodes = found.split_off(words.count());
        nodes.take(bytemuck::cast_slice(&of_nodes));
        let status = Status::new(found, words);
        self.take_pending(&status);
        Ok(status)
    }

    /// Words of all levels in a step that begins, with that greatest node speed.
    fn drifts(&self, speed: u32) -> Vec<u32> {
        self.worlds[WORLD].levels.iter().flat_map(|level| [speed, 0, level.rhythm.drift.to_bits(), 0]).collect()
    }

    /// Takes in the numbers of a step that were still on the device.
    fn take_pending(&mut self, status: &Status) {
        if std::mem::take(&mut self.pending) {
            let world = &mut self.worlds[WORLD];
            for (layer, level) in world.levels.iter_mut().enumerate() {
                let moved = status.in_step(0, layer, MOVE);
                level.rhythm = level.rhythm.after(moved);
                level.particle_speed = f64::from(moved) * level.h / world.last_dt;
            }
            self.take_sums(status, WORLD);
        }
    }

    /// Asks for the numbers of a step that are still on the device.
    pub(crate) fn settle(&mut self) -> Result<()> {
        if self.pending {
            let words = self.words();
            let found = read(&self.gpu, self.memory.buffer(Role::Status, 0), 0, words.count())?;
            self.take_pending(&Status::new(found, words));
        }
        Ok(())
    }

    /// Where the node blocks are.
    fn know_node_blocks(&mut self) -> Result<()> {
        if self.node_blocks.is_none() {
            let from = self.memory.extent.block_room as u64 * (16 * layout::ENTRY) as u64;
            let blocks: usize = self.worlds[WORLD].levels.iter().map(|level| level.node_blocks.len()).sum();
            let count = blocks * layout::ENTRY;
            let entries: Vec<[i32; 4]> = read(&self.gpu, self.memory.plane(Sorted::Lists), from, count)?;
            let place = |e: &[[i32; 4]]| ([e[0][0], e[0][1], e[0][2]], e[0][3] as usize);
            self.node_blocks = Some(entries.chunks_exact(layout::ENTRY).map(place).collect());
        }
        Ok(())
    }

    /// G2P, from nodes that are at most `speed` fast. Its numbers stay on the device until the next step asks for them.
    fn nodes_to_ground(&mut self, time: f64, dt: f64, speed: f64) -> Result<()> {
        let words = self.words();
        self.write_steps(0, &[self.step_constants(dt, self.worlds[WORLD].scene.gravity_at(time), 0)]);
        let sums = words.of_sum(0, 0);
        self.write_words(sums, &vec![0; words.of_sum(words.layers, 0) - sums]);
        // Rounding must not stop what has been let through.
        let allowed = (NODE_MOVE * self.h / dt * (1.0 - 1e-6)) as f32;
        let speed = (speed as f32).min(allowed).to_bits();
        self.write_words(words.of_step(0, WORLD, 0), &self.drifts(speed));
        self.write_words(words.greatest(0), &[speed]);
        let now = self.memory.now;
        let passes = self
            .kernels
            .prolong
            .iter()
            .chain(&self.kernels.mirror)
            .chain([&self.kernels.g2p])
            .chain(&self.kernels.collect);
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

    /// The rhythms of a world's levels after its last step, also if that step's numbers are still on the device.
    pub(crate) fn rhythms(&self, w: usize) -> Vec<crate::world::Rhythm> {
        let rhythm = |(layer, level): (usize, &crate::world::Level)| {
            if !self.pending {
                return level.rhythm;
            }
            let at = 4 * self.words().of_step(0, layer, MOVE) as u64;
            let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), at, 1);
            level.rhythm.after(words.map_or(crate::world::MAX_DRIFT, |words| words[0]))
        };
        self.worlds[w].levels.iter().enumerate().map(rhythm).collect()
    }

    /// What walls gave in a step whose numbers are still on the device [N s].
    pub(crate) fn pending_walls(&self) -> Vec3 {
        if !self.pending || self.kernels.collect.is_none() {
            return [0.0; 3];
        }
        let of_layer = |layer: usize| {
            let at = 4 * self.words().of_sum(layer, WALL_IMPULSE) as u64;
            let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), at, 3);
            words.map_or([0.0; 3], |w| [w[0], w[1], w[2]].map(f64::from))
        };
        self.layers_of(WORLD).map(of_layer).fold([0.0; 3], |sum, v| std::array::from_fn(|d| sum[d] + v[d]))
    }
}
