//! Soft bodies that levels follow. After each step the device finds the cells around them, and stops the submission if
//! levels must move before the next one. So results do not depend on how steps are cut into submissions.

use crate::device::memory::SOFT_WORDS;
use crate::worlds::world::World;
use barchan_core::levels::{CellBox, Leeway};
use barchan_core::{Aabb, ParticleList};
use barchan_grid::adapt::around_cells;
use std::collections::BTreeMap;

/// Of a body's words: after the ends of its cells as they are summed up stand those after the last step, and where these and the middle may be.
pub(crate) const FOUND: usize = 6;
pub(crate) const LEEWAY: usize = 12;
/// Of a body without particles.
pub(crate) const NOTHING: CellBox = CellBox { min: [i32::MAX; 3], max: [i32::MIN; 3] };

/// A soft body that levels follow.
#[derive(Clone, Debug)]
pub(crate) struct Soft {
    body: u16,
    /// Cells of the finest level around its particles, if it has any.
    cells: Option<CellBox>,
}

/// Those of a world.
#[derive(Clone, Debug, Default)]
pub(crate) struct Softs {
    all: Vec<Soft>,
    /// The steps after which they were seen last.
    seen: u64,
}

impl Softs {
    pub(crate) fn new(bodies: impl Iterator<Item = u16>) -> Self {
        Self { all: bodies.map(|body| Soft { body, cells: None }).collect(), seen: 0 }
    }

    /// The boxes around them [m], where finest cells have that width [m].
    pub(crate) fn boxes(&self, h: f64) -> BTreeMap<u16, Aabb> {
        let around =
            |cells: CellBox| around_cells([cells.min, cells.max.map(|end| end - 1)].map(|cell| (cell, h)).into_iter());
        self.all.iter().filter_map(|soft| Some((soft.body, around(soft.cells?)?))).collect()
    }
}

impl World {
    /// Finds soft bodies among particles that come in.
    pub(crate) fn see_soft(&mut self, lists: &[ParticleList]) {
        self.softs.seen = self.steps;
        for soft in &mut self.softs.all {
            let cells = lists.iter().flat_map(|list| {
                let own = (0..list.len()).filter(|&i| list.body[i] == soft.body);
                own.map(|i| [list.cell[i], list.cell[i].map(|c| c + 1)].map(|corner| corner.map(|c| c << list.level)))
            });
            let around = cells.fold(NOTHING, |around, [min, max]| CellBox {
                min: std::array::from_fn(|d| around.min[d].min(min[d])),
                max: std::array::from_fn(|d| around.max[d].max(max[d])),
            });
            soft.cells = (around != NOTHING).then_some(around);
        }
    }

    /// How many words the device holds of its soft bodies, if it is not known yet where they are after its last step.
    pub(crate) fn soft_words(&mut self) -> Option<usize> {
        let is_news = !self.softs.all.is_empty() && self.softs.seen != self.steps;
        self.softs.seen = self.steps;
        is_news.then_some(SOFT_WORDS * self.softs.all.len())
    }

    /// Takes in the words that the device holds of its soft bodies.
    pub(crate) fn take_soft(&mut self, words: &[i32]) {
        for (soft, words) in self.softs.all.iter_mut().zip(words.chunks_exact(SOFT_WORDS)) {
            let end = |first: usize| [0, 1, 2].map(|d| words[FOUND + first + d]);
            let around = CellBox { min: end(0), max: end(3) };
            soft.cells = (around != NOTHING).then_some(around);
        }
    }

    /// The words of its soft bodies for the device: where they may go before levels have to move after them. The finest cells have that width [m].
    pub(crate) fn soft_leeways(&self, h: f64) -> Vec<i32> {
        let boxes = self.softs.boxes(h);
        let leeways = self.adapt.leeways(|body| boxes.get(&body).copied());
        let mut words = Vec::new();
        for (soft, leeway) in self.softs.all.iter().zip(leeways) {
            // Where it is the host has found that nothing need move; a body that comes or goes is news.
            let Leeway { ends, sums, least } =
                leeway.zip(soft.cells).map_or_else(Leeway::none, |(leeway, now)| leeway.with(now));
            words.extend(
                [NOTHING.min, NOTHING.max, NOTHING.min, NOTHING.max, ends.min, ends.max, sums[0], sums[1], least]
                    .concat(),
            );
        }
        words
    }
}

const _: () = assert!(LEEWAY + 15 == SOFT_WORDS);
