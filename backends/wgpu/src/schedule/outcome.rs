//! What steps did to the worlds, taken in from the status.

use crate::device::kernel::Sorted;
use crate::device::status::{
    BIAS, BLOCKS, DAMPED, FIRST_BLOCK, FIRST_NODE_BLOCK, GREATEST_BLOCK, Halt, LEAST_BLOCK, LEFT, LEFT_IMPULSE,
    LEFT_MASS, MOVE, NEED, NODE_BLOCKS, PARTED, SLEPT, SORTS, Status, WALL_IMPULSE, energy_of,
};
use crate::passes::laws::{is_asked_on_device, is_asked_on_host};
use crate::passes::since_sort::SinceSort;
use crate::schedule::batch::WgpuBatch;
use crate::worlds::stiffness::{self, Held};
use barchan_core::Result;
use barchan_core::scene::Leaving;
use barchan_grid::limits::MAX_MOVE;

impl WgpuBatch {
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
        if status.halt().is_some() {
            self.forget_pressed();
        }
        // A sort that was broken off has overwritten the directory.
        self.unlinked |= matches!(status.halt(), Some(Halt::Room | Halt::LeftWorld));
    }

    /// Takes in what sorts found outside the world.
    pub(crate) fn take_left(&mut self, status: &Status) {
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
    pub(crate) fn leave_behind(&mut self) {
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
                level.since_sort = SinceSort::default();
            }
            let steps = level.steps_within;
            for s in sorted.unwrap_or(0)..done {
                level.since_sort = level.since_sort.after(steps as f32 * status.in_step(s, layer, MOVE));
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

    /// Asks a world's laws on the host how stiff their particles are, if that is due.
    pub(crate) fn follow_stiffness(&mut self, w: usize) -> Result<()> {
        let world = &self.worlds[w];
        let is_wrong = world.stiffness().dt.is_nan();
        if world.ask_after.is_none_or(|age| world.stiffness_age < age) && !is_wrong {
            return Ok(());
        }
        let (mut asked, mut needed) = (stiffness::nothing(), stiffness::nothing());
        for level in world.levels.iter().filter(|level| !level.particles.is_empty()) {
            let (first, count) = (level.particles.start, level.particles.len());
            let rest = self.readback().stretch(Sorted::Rest, first, count)?;
            let places = if world.materials.len() > 1 {
                Some(self.readback().stretch_of(Sorted::Record, 1, first, count)?)
            } else {
                None
            };
            let held = Held { rest: &rest, places: places.as_deref(), slots: count, count };
            let of_level = (level.h, level.steps_within);
            let ask = |is_asked| stiffness::bound_held(&held, &world.materials, is_asked, &world.densities, of_level);
            asked = stiffness::lesser(asked, ask(is_asked_on_host)?);
            if world.asks_those_asleep() || is_wrong {
                needed = stiffness::lesser(needed, ask(is_asked_on_device)?);
            }
        }
        let world = &mut self.worlds[w];
        let needed = (world.asks_those_asleep() || is_wrong).then_some(needed);
        world.take_asked(asked, needed);
        Ok(())
    }
}
