//! Rounds over a copy of the particles, for backends that keep theirs elsewhere.

use super::{Adapt, LevelStore, Parcel, around_cells};
use crate::block;
use barchan_core::{Aabb, Coupling, ParticleList, ParticleState, Regions, Result};
use std::ops::Range;

impl Adapt {
    /// One round over a copy of a world's particles: lists level by level, on each one a material, as backends download them.
    /// `before` is what [`follow`](Self::follow) said. Blocks are those of the state's last sort, if it names them and their counts add
    /// up; otherwise particles may come in any order. Returns which levels have lost or gained particles. Afterwards the state asks for
    /// a fresh sort, and its phase of levels is this one's, with the tiles that were live.
    ///
    /// Where levels have steps of their own, every list's strain must be up to date. With one step for all of them it may lag behind,
    /// for it does so everywhere alike.
    ///
    /// # Errors
    /// [`barchan_core::Error::Capacity`] if there are no numbers left for new particles.
    pub fn round_on_host(
        &mut self,
        state: &mut ParticleState,
        before: Option<&Regions>,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<Vec<bool>> {
        let sort = state.sort.take();
        let blocks_of = |l: usize| {
            let all = sort.as_ref()?.blocks.iter().filter(move |([_, level, ..], _)| *level == l as i32);
            all.map(|([_, _, x, y, z], counts)| Some((block::key([*x, *y, *z])?, counts.as_slice()))).collect()
        };
        let materials = self.materials.len().max(1);
        let lists = state.lists.chunks_mut(materials).enumerate();
        let mut levels: Vec<HostLevel<'_>> = lists.map(|(l, lists)| HostLevel::new(lists, blocks_of(l))).collect();
        let ids = levels.iter().flat_map(|level| level.lists.iter()).flat_map(|list| &list.id);
        self.next_id = ids.max().map_or(0, |id| id + 1).max(self.next_id);
        let shown: Vec<&HostLevel<'_>> = levels.iter().collect();
        let round = self.find(&shown, before, &vec![true; shown.len()]);
        let changed = self.apply(&mut levels.iter_mut().collect::<Vec<_>>(), &round, couplings)?;
        levels.into_iter().for_each(HostLevel::close);
        let live = state.levels.take().map(|phase| phase.live).unwrap_or_default();
        state.levels = self.phase(live);
        Ok(changed)
    }
}

/// Box around a soft body [m], for [`Adapt::follow`].
pub fn soft_bounds(lists: &[ParticleList], body: u16) -> Option<Aabb> {
    let cells = |list: &ParticleList| {
        let h = list.cell_width;
        list.cell
            .iter()
            .zip(&list.body)
            .filter(|(_, of)| **of == body)
            .map(move |(cell, _)| (*cell, h))
            .collect::<Vec<_>>()
    };
    around_cells(lists.iter().flat_map(cells))
}

/// One level of a copy. A place is a particle's index in its list.
struct HostLevel<'a> {
    lists: &'a mut [ParticleList],
    /// Which particles stay.
    kept: Vec<Vec<bool>>,
    blocks: Vec<u64>,
    /// Places of each list, group by group, and the range of each group among them.
    order: Vec<Vec<usize>>,
    groups: Vec<Vec<Range<usize>>>,
}

impl<'a> HostLevel<'a> {
    /// With its blocks and the number of each list's particles in them, or as they are now.
    fn new(lists: &'a mut [ParticleList], blocks: Option<Vec<(u64, &[u32])>>) -> Self {
        let key_of = |cell: &[i32; 3]| block::key(block::of_cell(*cell)).unwrap_or(u64::MAX);
        let kept = lists.iter().map(|list| vec![true; list.len()]).collect();
        let mut order: Vec<Vec<usize>> = lists.iter().map(|list| (0..list.len()).collect()).collect();
        let fits = |blocks: &Vec<(u64, &[u32])>| {
            let held = |i: usize| blocks.iter().map(|(_, counts)| counts[i] as usize).sum::<usize>();
            blocks.iter().all(|(_, counts)| counts.len() == lists.len())
                && lists.iter().enumerate().all(|(i, list)| held(i) == list.len())
        };
        let (keys, groups) = match blocks.filter(fits) {
            Some(blocks) => {
                let ranges = |list: usize| {
                    let ends = blocks.iter().scan(0, |end, (_, counts)| {
                        let start = *end;
                        *end += counts[list] as usize;
                        Some(start..*end)
                    });
                    ends.collect()
                };
                (blocks.iter().map(|(key, _)| *key).collect(), (0..lists.len()).map(ranges).collect())
            }
            None => {
                let mut keys: Vec<u64> = lists.iter().flat_map(|list| &list.cell).map(key_of).collect();
                keys.sort_unstable();
                keys.dedup();
                let mut groups = Vec::with_capacity(lists.len());
                for (list, order) in lists.iter().zip(&mut order) {
                    order.sort_by_key(|&i| (key_of(&list.cell[i]), list.cell[i]));
                    let start = |key: u64| order.partition_point(|&i| key_of(&list.cell[i]) < key);
                    let end = |key: u64| order.partition_point(|&i| key_of(&list.cell[i]) <= key);
                    groups.push(keys.iter().map(|&key| start(key)..end(key)).collect());
                }
                // What is beyond the reach of blocks is in none.
                keys.pop_if(|key| *key == u64::MAX);
                (keys, groups)
            }
        };
        Self { lists, kept, blocks: keys, order, groups }
    }

    /// Leaves out what has been removed.
    fn close(self) {
        for (list, mut kept) in self.lists.iter_mut().zip(self.kept) {
            kept.resize(list.len(), true);
            list.keep(&kept);
        }
    }
}

impl LevelStore for HostLevel<'_> {
    fn blocks(&self) -> &[u64] {
        &self.blocks
    }
    fn groups(&self) -> usize {
        self.groups.first().map_or(0, Vec::len)
    }
    fn places(&self, list: usize, group: usize) -> impl Iterator<Item = usize> {
        self.order[list][self.groups[list][group].clone()].iter().copied()
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
    fn remove(&mut self, list: usize, place: usize) {
        self.kept[list][place] = false;
    }
    fn push(&mut self, parcels: &[&Parcel]) {
        parcels.iter().for_each(|parcel| parcel.add_to(&mut self.lists[parcel.list]));
    }
}
