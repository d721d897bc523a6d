//! What probes ask of the device.

use crate::device::kernel::Role;
use crate::device::layout;
use crate::device::memory::read;
use crate::device::probed::{
    CROSSED, Exact, HEAD, PLACE, POINT, SAMPLED, SUMMED, cloud, crossed_of, heights_of, point, regions, sections,
    sums_of, wall_parts,
};
use crate::passes::binding::build;
use crate::passes::probes::{apart, heights, nearest, sample, sums};
use crate::schedule::Dispatch;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::submission::Size;
use barchan_core::backend::{Look, Looked};
use barchan_core::nearest::Nearest;
use barchan_core::probe::{Apart, Closest, Filter};
use barchan_core::task::{Sampled, chosen};
use barchan_core::{Plan, Result, Vec3};

/// Passes that look between steps: for sums over regions, single particles, heights, distances to points, particles nearest to points.
pub(crate) const LOOKERS: usize = 5;
/// So many cells from the origin, and farther, points are left to the host.
const FAR: f64 = 5e8;

impl WgpuBatch {
    /// Tells the device where a world's sections and parts of walls are, as each of its levels has them.
    pub(crate) fn write_probed(&self, world: usize, plan: &Plan) {
        let of_level = |level| sections(plan, level).into_iter().chain(wall_parts(plan, level));
        let words: Vec<u32> = (0..self.levels).flat_map(of_level).collect();
        let buffer = self.memory.buffer(Role::Crossed, 0);
        self.gpu.queue.write_buffer(buffer, 4 * (words.len() * world) as u64, bytemuck::cast_slice(&words));
    }

    /// Lets the device forget what parts of walls took through rims in a step that is to be repeated.
    pub(crate) fn forget_pressed(&self) {
        let (probed, sections, layers) = (self.fixed.probed, self.fixed.sections, self.memory.words().layers);
        if self.levels == 1 {
            return;
        }
        for part in (0..self.worlds.len()).flat_map(|world| (sections..probed).map(move |k| world * probed + k)) {
            let at = 4 * (PLACE * layers * probed + CROSSED * part + CROSSED / 2);
            self.gpu.queue.write_buffer(self.memory.buffer(Role::Crossed, 0), at as u64, &[0; 2 * CROSSED]);
        }
    }

    /// What the device has counted at a world's sections and parts of walls, by whatever has been in its place.
    fn counted(&self, world: usize) -> Result<Vec<Exact>> {
        let probed = self.fixed.probed;
        let at = 4 * probed * (PLACE * self.memory.words().layers + CROSSED * world);
        let words: Vec<u32> = read(&self.gpu, self.memory.buffer(Role::Crossed, 0), at as u64, CROSSED * probed)?;
        Ok(words.chunks_exact(CROSSED).map(crossed_of).collect())
    }

    /// What has crossed a world's sections since its scene's start, and what parts of walls have taken.
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

    /// Looks at worlds that follow one another; what lies in the archive of ground out of reach is summed, too.
    pub(crate) fn look_at(&mut self, first: usize, looks: &[Look<'_>]) -> Result<Vec<Looked>> {
        let mut looked = self.look(first, looks)?;
        for ((look, seen), world) in looks.iter().zip(&mut looked).zip(&self.worlds[first..]) {
            let (Some(reach), Some(coarsest)) = (&world.reach, world.levels.last()) else { continue };
            if look.points.iter().any(|point| reach.may_hold(*point, coarsest.h)) {
                // The host finds what the surface is there.
                seen.heights = None;
            }
            if look.sought.is_empty() {
                continue;
            }
            for list in reach.archived() {
                let planned = &look.materials[list.material as usize];
                seen.sums.iter_mut().zip(look.sought).try_for_each(|(sums, one)| sums.add_list(one, planned, &list))?;
            }
        }
        Ok(looked)
    }

    /// Looks at live ground, in one submission: for each, sums over regions, a sample of particles, so many of each level, and heights at points.
    pub(crate) fn look(&mut self, first: usize, asked: &[Look<'_>]) -> Result<Vec<Looked>> {
        let worlds = &self.worlds[first..first + asked.len()];
        let regions_each = asked.iter().map(|look| look.sought.len()).max().unwrap_or_default();
        let layers = asked.len() * self.levels;
        let blocks = match (worlds.first(), worlds.last()) {
            (Some(first), Some(last)) => {
                first.levels[0].blocks.start..last.levels.last().map_or(0, |level| level.blocks.end)
            }
            _ => return Ok(Vec::new()),
        };
        let mut words = vec![0; HEAD];
        for (world, look) in worlds.iter().zip(asked) {
            words.extend(
                world.levels.iter().enumerate().flat_map(|(l, level)| regions(look.sought, regions_each, l, level.h)),
            );
        }
        let sums_at = words.len();
        let sums_each = 4 * SUMMED * regions_each;
        words.resize(sums_at + sums_each * asked.len(), 0);
        let samples_at = words.len();
        let mut samples = Vec::with_capacity(asked.len());
        for (world, look) in worlds.iter().zip(asked) {
            let present: Vec<usize> = world.levels.iter().map(|level| level.particles.len()).collect();
            let wanted = chosen(look.sample, &present);
            for &(l, number) in &wanted {
                let level = &world.levels[l];
                let given = [level.particles.start + number, level.blocks.start, level.blocks.end];
                words.extend(given.map(|word| word as u32));
                words.resize(words.len() + SAMPLED - given.len(), 0);
            }
            samples.push(wanted);
        }
        let heights_at = words.len();
        for (world, look) in worlds.iter().zip(asked) {
            let own = world.levels[0].blocks.start..world.levels.last().map_or(0, |level| level.blocks.end);
            let at = |at: &[f64; 2]| point(*at, look.bottom, world.levels[0].h, own.clone());
            words.extend(look.points.iter().flat_map(at));
        }
        let sample_count = samples.iter().map(Vec::len).sum::<usize>();
        let point_count = (words.len() - heights_at) / POINT;
        let layer = first * self.levels;
        let of_sums = [blocks.start, blocks.end, layer, regions_each, layers];
        let head = of_sums.into_iter().chain([samples_at, sample_count, heights_at, point_count]);
        words.iter_mut().zip(head).for_each(|(word, given)| *word = given as u32);
        let asked_of = [if regions_each > 0 { blocks.len() } else { 0 }, sample_count.div_ceil(64), point_count, 0, 0];
        let found = self.look_for(&words, sums_at, asked_of)?;
        let (sums, found) = found.split_at(samples_at - sums_at);
        let (sampled, mut heights) = found.split_at(heights_at - samples_at);
        let mut sampled = sampled.chunks_exact(SAMPLED);
        let mut looked = Vec::with_capacity(asked.len());
        for (w, (look, wanted)) in asked.iter().zip(samples).enumerate() {
            let own = sums[sums_each * w..][..sums_each].chunks_exact(4 * SUMMED).take(look.sought.len());
            let levels = &self.worlds[first + w].levels;
            let particles = wanted.iter().zip(sampled.by_ref()).map(|((l, _), words)| sampled_of(words, levels[*l].h));
            let points;
            (points, heights) = heights.split_at(POINT * look.points.len());
            looked.push(Looked {
                sums: own.map(sums_of).collect(),
                sample: particles.collect(),
                heights: heights_of(points, look.bottom, levels[0].h),
            });
        }
        Ok(looked)
    }

    /// How far points and a world's particles that count are from one another, with those in the archive of ground out of reach; nothing if points are farther off
    /// than the device counts cells.
    pub(crate) fn apart(&mut self, world: usize, points: &[Vec3], filter: Filter) -> Result<Option<Apart>> {
        let levels = &self.worlds[world].levels;
        let blocks = levels[0].blocks.start..levels.last().map_or(0, |level| level.blocks.end);
        let widths: Vec<f64> = levels.iter().map(|level| level.h).collect();
        if points.iter().flatten().any(|x| (x / widths[0]).abs() > FAR) {
            return Ok(None);
        }
        let mut apart = Apart { nearest: vec![None; points.len()], ..Apart::default() };
        if !blocks.is_empty() && !points.is_empty() {
            let cloud = cloud(points, filter, widths[0], blocks.clone());
            // The sums come first: the second pass writes where points stand.
            let found = self.look_for(&cloud.words, 0, [0, 0, 0, blocks.len(), points.len()])?;
            apart = cloud.apart(&found, &widths);
        }
        let Some(reach) = &self.worlds[world].reach else { return Ok(Some(apart)) };
        let to_points = Nearest::new(points.to_vec());
        for list in reach.archived() {
            let counts = |i: &usize| filter.takes(list.material, list.body[*i], list.level);
            for i in (0..list.len()).filter(counts) {
                let archived = Closest { id: list.id[i], position: list.position(i) };
                apart.count += 1;
                apart.distance += to_points.distance(archived.position);
                for (nearest, point) in apart.nearest.iter_mut().zip(points) {
                    *nearest = Some(nearest.map_or(archived, |nearest| nearest.or_nearer(archived, *point)));
                }
            }
        }
        Ok(Some(apart))
    }

    /// Hands the words to the passes that look, so many workgroups of each, and returns them from `from` on.
    fn look_for(&mut self, words: &[u32], from: usize, groups: [usize; LOOKERS]) -> Result<Vec<u32>> {
        self.memory.add_sought(&self.gpu, words.len())?;
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Sought, 0), 0, bytemuck::cast_slice(words));
        for (looker, _) in groups.iter().enumerate().filter(|(_, count)| **count > 0) {
            let draft = || match looker {
                0 => sums(&self.worlds[0].materials),
                1 => sample(),
                2 => heights(),
                3 => apart(),
                _ => nearest(),
            };
            let (gpu, kernels, worlds) = (&self.gpu, &self.kernels, self.worlds.len());
            self.lookers[looker]
                .get_or_insert_with(|| build(gpu, &kernels.step_layout, &kernels.setting, worlds, draft()));
        }
        let row = self.memory.extent.row;
        let asked: Vec<_> = self
            .lookers
            .iter()
            .zip(groups)
            .filter_map(|(kernel, count)| Some((kernel.as_ref().filter(|_| count > 0)?, count as u32)))
            .map(|(kernel, count)| {
                let dispatch = Dispatch { kernel, now: self.memory.now, step: 0, end: self.levels };
                (dispatch, Size::Known(count.min(row), count.div_ceil(row)))
            })
            .collect();
        let asked: Vec<_> = asked.iter().map(|(dispatch, size)| (dispatch, *size)).collect();
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self::encode(&self.gpu, &mut encoder, &mut self.memory, &asked, None);
        self.gpu.queue.submit([encoder.finish()]);
        read(&self.gpu, self.memory.buffer(Role::Sought, 0), 4 * from as u64, words.len() - from)
    }
}

/// A particle that was sampled, in cells of that width [m].
fn sampled_of(words: &[u32], h: f64) -> Sampled {
    let word = |k: usize| words[k];
    let place = [0, 1, 2, 3].map(word);
    let block = [4, 5, 6].map(|k| word(k) as i32);
    let velocity = [7, 8, 9].map(|k| f64::from(f32::from_bits(word(k))));
    Sampled { position: layout::position(place, block, h), velocity }
}
