//! What probes ask of the device.

use crate::device::kernel::Role;
use crate::device::memory::read;
use crate::device::probed::{CROSSED, Exact, HEAD, PLACE, REGIONS, SUMMED, crossed_of, regions, sections, sums_of};
use crate::passes::binding::build;
use crate::passes::probes::sums;
use crate::schedule::Dispatch;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::submission::Size;
use barchan_core::{Plan, Result, Sought, Sums};

impl WgpuBatch {
    /// Tells the device where a world's sections are, as each of its levels has them.
    pub(crate) fn write_sections(&self, world: usize, plan: &Plan) {
        let words: Vec<u32> = (0..self.levels).flat_map(|level| sections(plan, level)).collect();
        let buffer = self.memory.buffer(Role::Crossed, 0);
        self.gpu.queue.write_buffer(buffer, 4 * (words.len() * world) as u64, bytemuck::cast_slice(&words));
    }

    /// What the device has counted at a world's sections, by whatever has been in its place.
    fn counted(&self, world: usize) -> Result<Vec<Exact>> {
        let sections = self.fixed.sections;
        let at = 4 * sections * (PLACE * self.memory.words().layers + CROSSED * world);
        let words: Vec<u32> = read(&self.gpu, self.memory.buffer(Role::Crossed, 0), at as u64, CROSSED * sections)?;
        Ok(words.chunks_exact(CROSSED).map(crossed_of).collect())
    }

    /// What has crossed a world's sections since its scene's start.
    pub(crate) fn crossed(&self, world: usize) -> Result<Vec<Exact>> {
        let mut all = self.counted(world)?;
        for (sum, before) in
            all.iter_mut().flatten().flatten().zip(self.worlds[world].crossed.iter().flatten().flatten())
        {
            *sum += before;
        }
        Ok(all)
    }

    /// Lets a world's sums go on from these.
    pub(crate) fn set_crossed(&mut self, world: usize, wanted: &[Exact]) -> Result<()> {
        let mut before = self.counted(world)?;
        let wanted = wanted.iter().flatten().flatten().copied().chain(std::iter::repeat(0));
        before.iter_mut().flatten().flatten().zip(wanted).for_each(|(sum, wanted)| *sum = wanted - *sum);
        self.worlds[world].crossed = before;
        Ok(())
    }

    /// Sums over the particles of a world in regions.
    pub(crate) fn sums(&mut self, world: usize, sought: &[Sought]) -> Result<Vec<Sums>> {
        self.memory.add_regions(&self.gpu, REGIONS)?;
        if self.sums.is_none() {
            let (draft, kernels) = (sums(&self.worlds[world].materials), &self.kernels);
            self.sums = Some(build(&self.gpu, &kernels.step_layout, &kernels.setting, self.worlds.len(), draft));
        }
        let mut found = Vec::with_capacity(sought.len());
        for some in sought.chunks(REGIONS) {
            found.extend(self.sums_of_some(world, some)?);
        }
        Ok(found)
    }

    /// The same for as many regions as there is room for.
    fn sums_of_some(&mut self, world: usize, sought: &[Sought]) -> Result<Vec<Sums>> {
        let levels = &self.worlds[world].levels;
        let blocks = levels[0].blocks.start..levels.last().map_or(0, |level| level.blocks.end);
        let mut words = vec![0; HEAD];
        words[..4].copy_from_slice(&[blocks.start as u32, blocks.end as u32, 0, sought.len() as u32]);
        words[2] = (world * self.levels) as u32;
        words.extend(levels.iter().enumerate().flat_map(|(l, level)| regions(sought, l, level.h)));
        let at = words.len();
        words.resize(at + 4 * SUMMED * REGIONS, 0);
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Sought, 0), 0, bytemuck::cast_slice(&words));
        let (count, row) = (blocks.len() as u32, self.memory.extent.row);
        if let Some(kernel) = self.sums.as_ref().filter(|_| count > 0) {
            let dispatch = Dispatch { kernel, now: self.memory.now, step: 0, end: self.levels };
            let size = Size::Known(count.min(row), count.div_ceil(row));
            let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            Self::encode(&self.gpu, &mut encoder, &mut self.memory, &[(&dispatch, size)], None);
            self.gpu.queue.submit([encoder.finish()]);
        }
        let sums: Vec<u32> =
            read(&self.gpu, self.memory.buffer(Role::Sought, 0), 4 * at as u64, 4 * SUMMED * sought.len())?;
        Ok(sums.chunks_exact(4 * SUMMED).map(sums_of).collect())
    }
}
