//! Sleep: what the host knows of ground at rest that is left out. The rule is that of the CPU backend's `sleep.rs`, in
//! `watch.wgsl`.

use crate::device::layout::Homes;
use crate::device::memory::WATCHED;
use crate::worlds::world::Level;
use barchan_core::{Aabb, Coupling, ParticleList, SortPhase, Vec3};
use barchan_grid::rest::{ASLEEP, RESTED, near_tool};

/// What a block's words say; see `watch_words.wgsl`.
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
    let bounds = couplings.iter().flat_map(|coupling| coupling.bounds());
    let tools: Vec<Aabb> = bounds.filter(|one| !one.is_nothing()).collect();
    let of_level = |level: &Level| {
        let of_box = |tool: &Aabb| near_tool(tool, level.h).map(|[x, y, z]| [x, y, z, 0]);
        tools.iter().map(of_box).collect()
    };
    levels.iter().map(of_level).collect()
}
