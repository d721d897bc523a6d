//! Sleep: what the host knows of ground at rest that is left out. The rule is that of the CPU backend's `sleep.rs`, in
//! `watch.wgsl`.

use crate::device::layout::Homes;
use crate::device::memory::read;
use crate::passes::binding::{Role, Sorted};
use crate::schedule::status::SLEPT;
use crate::worlds::WgpuBatch;
use crate::worlds::world::Level;
use barchan_core::{Aabb, Coupling, ParticleList, Result, SortPhase, Vec3};
use barchan_grid::rest::{ASLEEP, RESTED, near_tool};
use std::ops::Range;

/// Words of a block; see `watch_words.wgsl`.
pub(crate) const WATCHED: usize = 12;
pub(crate) type Words = [u32; WATCHED];
pub(crate) const RESTS: usize = 0;
pub(crate) const DECIDED: usize = 1;
pub(crate) const HAPPENED: usize = 2;
pub(crate) const STEPPED: u32 = 1;
pub(crate) const FAST: u32 = 2;
pub(crate) const STIRRED: u32 = 4;
pub(crate) const NONE: u32 = u32::MAX;

/// First and last block of a box, as the device reads them.
pub(crate) type BlockBox = [[i32; 4]; 2];

/// What falling asleep took from a world, and what gravity would have given to it asleep.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Slept {
    /// Blocks that fell asleep.
    pub(crate) blocks: u64,
    /// Kinetic energy [J].
    pub(crate) kinetic: f64,
    /// Momentum [N s].
    pub(crate) momentum: Vec3,
}

/// Words of a layer's sums that tell of sleep, from [`SLEPT`] on.
pub(crate) const SUMS: usize = 6;

impl Slept {
    /// Adds what a layer's sums tell of sleep; its mass asleep, times gravity's part, summed over steps [kg].
    pub(crate) fn add(&mut self, [slept, fell, lost @ ..]: [u32; SUMS]) -> f64 {
        let real = |word: u32| f64::from(f32::from_bits(word));
        self.blocks += u64::from(fell);
        (0..3).for_each(|d| self.momentum[d] += real(lost[d]));
        self.kinetic += real(lost[3]);
        real(slept)
    }
}

/// The words of a block that has rested for so many steps.
pub(crate) fn words_of(rest: u16) -> Words {
    let mut words = [0; WATCHED];
    (words[RESTS], words[DECIDED]) = (rest.into(), NONE);
    words
}

/// The words of a block of particles that come in: it knows of no rest, and stirs the one that it falls to.
pub(crate) fn words_of_come() -> Words {
    let mut words = words_of(0);
    (words[RESTS], words[HAPPENED]) = (NONE, STIRRED);
    words
}

/// What is known of the rest of a level's blocks whose particles come back. Whoever hands them back may have set them in motion.
pub(crate) fn restored(sort: &SortPhase, level: usize, lists: &[ParticleList], homes: &Homes) -> Vec<Words> {
    let is_here =
        |(([_, l, ..], counts), _): &(&([i32; 5], Vec<u32>), &u16)| *l == level as i32 && counts.iter().any(|n| *n > 0);
    let rests = sort.blocks.iter().zip(&sort.rest).filter(is_here);
    let moves = |&(list, i): &(usize, usize)| {
        let list: &ParticleList = &lists[list];
        list.velocity[i].iter().chain(&list.affine[i]).any(|x| *x != 0.0)
    };
    let of_block = |(cells, (_, &rest)): (&[u32], (_, &u16))| {
        let particles = &homes.order[cells[0] as usize..cells[64] as usize];
        words_of(if rest == ASLEEP && particles.iter().any(moves) { 0 } else { rest })
    };
    (0..homes.blocks.len()).map(|b| &homes.cells[64 * b..]).zip(rests).map(of_block).collect()
}

/// For how many steps a block has rested, by its words: as `rest_of` of `watch.wgsl`.
pub(crate) fn rest_of(words: &Words) -> u16 {
    let (rest, happened) = (words[RESTS] as u16, words[HAPPENED]);
    let rest = match happened {
        _ if happened & FAST > 0 => 0,
        _ if happened & STEPPED > 0 && rest != ASLEEP => (rest + 1).min(RESTED),
        _ => rest,
    };
    if happened & STIRRED > 0 { rest.min(1) } else { rest }
}

/// The boxes of blocks of each of a world's levels that stay awake for its tools.
pub(crate) fn near_tools(couplings: &[Box<dyn Coupling>], levels: &[Level]) -> Vec<Vec<BlockBox>> {
    let tools: Vec<Aabb> = couplings.iter().flat_map(|coupling| coupling.bounds()).collect();
    let of_level = |level: &Level| {
        let of_box = |tool: &Aabb| near_tool(tool, level.h).map(|[x, y, z]| [x, y, z, 0]);
        tools.iter().map(of_box).collect()
    };
    levels.iter().map(of_level).collect()
}

impl WgpuBatch {
    /// Does ground at rest sleep?
    pub(crate) fn may_sleep(&self) -> bool {
        self.kernels.set.watch.is_some()
    }

    /// What is known of the rest of the blocks of each level of some worlds.
    pub(crate) fn watched(&self, worlds: Range<usize>) -> Result<Vec<Vec<Words>>> {
        let levels: Vec<&Level> = self.worlds[worlds].iter().flat_map(|world| &world.levels).collect();
        if !self.may_sleep() {
            return Ok(levels.iter().map(|level| vec![words_of(0); level.blocks.len()]).collect());
        }
        let start = levels.first().map_or(0, |level| level.blocks.start);
        let count = levels.last().map_or(0, |level| level.blocks.end) - start;
        let watch = self.memory.plane(Sorted::Watch);
        let words: Vec<u32> = read(&self.gpu, watch, (4 * WATCHED * start) as u64, WATCHED * count)?;
        let all = words.as_chunks::<WATCHED>().0;
        Ok(levels.iter().map(|level| all[level.blocks.start - start..level.blocks.end - start].to_vec()).collect())
    }

    /// For how many steps the blocks of each of a world's levels have rested.
    pub(crate) fn rests(&self, w: usize) -> Result<Vec<Vec<u16>>> {
        Ok(self.watched(w..w + 1)?.iter().map(|level| level.iter().map(rest_of).collect()).collect())
    }

    /// A world's particles asleep.
    pub(crate) fn asleep(&self, w: usize) -> Result<u64> {
        if !self.may_sleep() {
            return Ok(0);
        }
        let mut count = 0;
        for (homes, rests) in self.homes(w..w + 1)?.iter().zip(self.rests(w)?) {
            for (b, _) in rests.iter().enumerate().filter(|(_, rest)| **rest == ASLEEP) {
                count += u64::from(homes.cells[64 * b + 64] - homes.cells[64 * b]);
            }
        }
        Ok(count)
    }

    /// What sleep took from a world in a step whose numbers are still on the device, and what gravity has not given it [N s].
    pub(crate) fn pending_sleep(&self, w: usize) -> (Slept, Vec3) {
        let (mut slept, mut kept) = (Slept::default(), [0.0; 3]);
        if self.may_sleep() && self.worlds[w].pending {
            for (l, layer) in self.layers_of(w).enumerate() {
                let at = 4 * self.memory.words().of_sum(layer, SLEPT) as u64;
                let words: Vec<u32> =
                    read(&self.gpu, self.memory.buffer(Role::Status, 0), at, SUMS).unwrap_or_default();
                if let Ok(words) = <[u32; SUMS]>::try_from(words) {
                    let by_gravity = self.worlds[w].kept_from_gravity(l, slept.add(words));
                    (0..3).for_each(|d| kept[d] += by_gravity[d]);
                }
            }
        }
        (slept, kept)
    }

    /// Tells the device where tools are: for the steps, or slots, from one on, the boxes of each layer.
    pub(crate) fn write_tools(&mut self, first: usize, steps: &[Vec<Vec<BlockBox>>]) -> Result<()> {
        let most = steps.iter().flatten().map(Vec::len).max().unwrap_or(0);
        if !self.may_sleep() || (most == 0 && self.memory.tools() == 0) {
            return Ok(());
        }
        self.memory.add_tools(&self.gpu, most)?;
        // A box that holds nothing.
        let none = [[i32::MAX / 4; 4], [i32::MIN / 4; 4]];
        let padded = |boxes: &'_ Vec<BlockBox>| boxes.clone().into_iter().chain(std::iter::repeat(none)).take(most);
        let vectors: Vec<[i32; 4]> = steps.iter().flatten().flat_map(padded).flatten().collect();
        let buffer = self.memory.buffer(Role::Tools, 0);
        self.gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(&[[most as i32, 0, 0, 0]]));
        let at = (16 + 32 * first * self.memory.words().layers * most) as u64;
        self.gpu.queue.write_buffer(buffer, at, bytemuck::cast_slice(&vectors));
        Ok(())
    }
}
