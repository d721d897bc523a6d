//! For how long blocks have rested, and who is asleep.

use crate::device::kernel::Sorted;
use crate::device::memory::{WATCHED, read};
use crate::readback::Readback;
use crate::worlds::sleep::{Words, rest_of, words_of};
use crate::worlds::world::Level;
use barchan_core::Result;
use barchan_grid::rest::ASLEEP;
use std::ops::Range;

impl Readback<'_> {
    /// What is known of the rest of the blocks of each level of some worlds.
    pub(crate) fn watched(&self, worlds: Range<usize>) -> Result<Vec<Vec<Words>>> {
        let levels: Vec<&Level> = self.worlds[worlds].iter().flat_map(|world| &world.levels).collect();
        if !self.sleeps {
            return Ok(levels.iter().map(|level| vec![words_of(0); level.blocks.len()]).collect());
        }
        let start = levels.first().map_or(0, |level| level.blocks.start);
        let count = levels.last().map_or(0, |level| level.blocks.end) - start;
        let watch = self.memory.plane(Sorted::Watch);
        let words: Vec<u32> = read(self.gpu, watch, (4 * WATCHED * start) as u64, WATCHED * count)?;
        let all = words.as_chunks::<WATCHED>().0;
        Ok(levels.iter().map(|level| all[level.blocks.start - start..level.blocks.end - start].to_vec()).collect())
    }

    /// For how many steps the blocks of each of a world's levels have rested.
    pub(crate) fn rests(&self, w: usize) -> Result<Vec<Vec<u16>>> {
        Ok(self.watched(w..w + 1)?.iter().map(|level| level.iter().map(rest_of).collect()).collect())
    }

    /// A world's particles asleep.
    pub(crate) fn asleep(&self, w: usize) -> Result<u64> {
        if !self.sleeps {
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
}
