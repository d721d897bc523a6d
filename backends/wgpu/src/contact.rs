//! Contact whose law runs on the host: the nodes near bodies, there and back.

use crate::engine::WgpuEngine;
use crate::kernels::Role;
use crate::memory::read_parts;
use barchan_core::{Aabb, NodeBatch, Result};
use std::collections::BTreeMap;

/// From how many times the least mass on a node's speed counts in full.
const FELT: f64 = 1e17;
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
fn blocks_in(engine: &WgpuEngine, boxes: &[Aabb]) -> Vec<u32> {
    let centre = |cell: i32| (f64::from(cell) + 0.5) * engine.h;
    let meets = |block: &[i32; 3]| {
        let first = block.map(|b| 4 * b);
        let extent = Aabb { min: first.map(centre), max: first.map(|c| centre(c + 3)) };
        boxes.iter().any(|b| b.meets(&extent))
    };
    let all = engine.node_blocks.iter().flatten().zip(0..);
    all.filter(|(block, _)| meets(block)).map(|(_, g)| g).collect()
}

impl Nodes {
    /// Forgets all, and says which stretches of the grid hold the blocks in the boxes: first byte, bytes.
    pub(crate) fn begin(&mut self, engine: &WgpuEngine, boxes: &[Aabb]) -> Vec<(u64, u64)> {
        self.blocks.clear();
        self.changed.clear();
        self.wanted = blocks_in(engine, boxes);
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
    pub(crate) fn fetch(&mut self, engine: &WgpuEngine, boxes: &[Aabb]) -> Result<()> {
        self.wanted = blocks_in(engine, boxes);
        self.wanted.retain(|g| !self.blocks.contains_key(g));
        let nodes: Vec<[f32; 4]> = read_parts(&engine.gpu, engine.memory.buffer(Role::Grid, 0), &self.stretches())?;
        self.take(&nodes);
        Ok(())
    }

    /// Hands the nodes in the boxes to a law, and takes back their velocities. Returns the greatest speed that particles may
    /// feel [m/s].
    pub(crate) fn apply(
        &mut self,
        engine: &WgpuEngine,
        boxes: &[Aabb],
        law: impl FnOnce(&mut NodeBatch) -> Result<()>,
    ) -> Result<f64> {
        let (mut batch, mut places) = (NodeBatch { cell_width: engine.h, ..NodeBatch::default() }, Vec::new());
        let centre = |cell: i32| (f64::from(cell) + 0.5) * engine.h;
        let at = engine.node_blocks.as_deref().unwrap_or_default();
        for g in blocks_in(engine, boxes) {
            let first = at[g as usize].map(|b| 4 * b);
            for (n, node) in self.blocks[&g].iter().enumerate() {
                let mass = f64::from(node[3]);
                if mass <= engine.least_mass {
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
            let felt = (mass / (engine.least_mass * FELT)).min(1.0);
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
    pub(crate) fn give_back(&mut self, engine: &WgpuEngine) {
        let grid = engine.memory.buffer(Role::Grid, 0);
        for run in self.changed.chunk_by(|a, b| a + 1 == *b) {
            let nodes: Vec<[f32; 4]> = run.iter().flat_map(|g| self.blocks[g].iter().copied()).collect();
            engine.gpu.queue.write_buffer(grid, u64::from(run[0]) * BLOCK, bytemuck::cast_slice(&nodes));
        }
        self.changed.clear();
    }
}
