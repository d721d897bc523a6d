//! Levels whose particles are elsewhere, such as on a device: copies of those that a round may concern.

use super::{LevelStore, Parcel};
use crate::block;
use barchan_core::ParticleList;
use std::ops::Range;

/// The particles of a level that a backend has copied because a round may concern them. A place is a particle's index
/// in its list.
#[derive(Clone, Debug)]
pub struct CopiedLevel {
    /// One a material.
    lists: Vec<ParticleList>,
    /// Keys of blocks with particles of the level, rising, and their cells that are at least half full, as bits.
    filled: Vec<(u64, u64)>,
    /// Keys of blocks with copied particles, rising, and where each list's stand.
    blocks: Vec<u64>,
    groups: Vec<Vec<Range<usize>>>,
    /// Has it been taken out?
    gone: Vec<Vec<bool>>,
    /// Particles that have been taken in, a list a material.
    come: Vec<ParticleList>,
}

impl CopiedLevel {
    /// Takes one list a material, its particles in the order of their blocks. `filled` gives for the level's blocks, in
    /// the order of their keys, which cells are at least half full, as bits. It is used only if particles may merge.
    pub fn new(lists: Vec<ParticleList>, filled: Vec<(u64, u64)>) -> Self {
        // What is beyond the reach of blocks is in none.
        let key = |cell: &[i32; 3]| block::key(block::of_cell(*cell)).unwrap_or(u64::MAX);
        let blocks_of = |list: &ParticleList| {
            let mut blocks: Vec<u64> = list.cell.iter().map(key).collect();
            blocks.dedup();
            blocks
        };
        let mut blocks: Vec<u64> = lists.iter().flat_map(blocks_of).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let groups_of = |list: &ParticleList| {
            let end = |block: &u64| list.cell.partition_point(|cell| key(cell) <= *block);
            let ends = blocks.iter().scan(0, |start, block| Some(std::mem::replace(start, end(block))..*start));
            ends.collect::<Vec<_>>()
        };
        let groups = lists.iter().map(groups_of).collect();
        blocks.pop_if(|key| *key == u64::MAX);
        let gone = lists.iter().map(|list| vec![false; list.len()]).collect();
        let come = lists.iter().map(Self::empty).collect();
        Self { lists, filled, blocks, groups, gone, come }
    }

    /// A list as this one, without particles.
    fn empty(list: &ParticleList) -> ParticleList {
        let (level, material) = (list.level as usize, list.material as usize);
        ParticleList::empty(level, material, list.cell_width, list.strain.len(), list.state.len())
    }

    /// All that there is now, as lists.
    pub fn lists(self) -> Vec<ParticleList> {
        let left = |((mut list, gone), come): ((ParticleList, Vec<bool>), ParticleList)| {
            list.keep(&gone.iter().map(|gone| !gone).collect::<Vec<_>>());
            list.append(come);
            list
        };
        self.lists.into_iter().zip(self.gone).zip(self.come).map(left).collect()
    }

    /// For each list, the places of the removed particles.
    pub fn gone(&self) -> impl Iterator<Item = impl Iterator<Item = usize>> {
        self.gone.iter().map(|gone| (0..gone.len()).filter(|&place| gone[place]))
    }

    /// The added particles, as lists, each in the order of numbers.
    pub fn come(self) -> Vec<ParticleList> {
        self.come
    }
}

impl LevelStore for CopiedLevel {
    fn blocks(&self) -> &[u64] {
        &self.blocks
    }
    fn groups(&self) -> usize {
        self.groups.first().map_or(0, Vec::len)
    }
    fn places(&self, list: usize, group: usize) -> impl Iterator<Item = usize> {
        self.groups[list][group].clone()
    }
    fn greatest_volume(&self, list: usize, group: usize) -> f64 {
        self.places(list, group).map(|place| self.volume0(list, place)).fold(0.0, f64::max)
    }
    fn id(&self, list: usize, place: usize) -> u32 {
        self.lists[list].id[place] as u32
    }
    fn body(&self, list: usize, place: usize) -> u16 {
        self.lists[list].body[place]
    }
    fn cell(&self, list: usize, place: usize) -> [i32; 3] {
        self.lists[list].cell[place]
    }
    fn offset(&self, list: usize, place: usize) -> [f64; 3] {
        self.lists[list].offset[place]
    }
    fn volume0(&self, list: usize, place: usize) -> f64 {
        self.lists[list].volume0[place]
    }
    fn parcel(&self, list: usize, place: usize) -> Parcel {
        Parcel { list, ..Parcel::of(&self.lists[list], place) }
    }
    fn remove(&mut self, list: usize, places: impl Iterator<Item = usize>) {
        places.for_each(|place| self.gone[list][place] = true);
    }
    fn push(&mut self, parcels: &[&Parcel]) {
        for own in parcels.chunk_by(|a, b| a.list == b.list) {
            Parcel::add_all(own, &mut self.come[own[0].list]);
        }
    }
    fn filled(&self, _lists: usize, blocks: &[u64], _volume: f64) -> Vec<u64> {
        let of_block =
            |key: &u64| self.filled.binary_search_by_key(key, |(key, _)| *key).map_or(0, |b| self.filled[b].1);
        blocks.iter().map(of_block).collect()
    }
}
