//! Levels after their agents, on this backend's stores.

use crate::engine::{CpuEngine, Pass};
use crate::store::{PAD, Store};
use barchan_core::{Coupling, Regions, Result};
use barchan_grid::adapt::{LevelStore, Parcel, around_cells};
use barchan_grid::particles::VOLUME;
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;
use std::time::Instant;

impl<T: Scalar> CpuEngine<T> {
    /// Moves the levels' boxes after their agents. Returns the regions as they were if any has moved.
    pub(crate) fn follow_agents(&mut self, couplings: &[Box<dyn Coupling>]) -> Option<Regions> {
        let levels = &self.levels;
        let soft = |body: u16| {
            around_cells(levels.iter().flat_map(|level| {
                let lists = level.store.lists.iter();
                let places = lists.flat_map(|list| list.places().map(move |(chunk, lane)| (list, chunk, lane)));
                let own = places.filter(move |(list, chunk, lane)| list.body[*chunk][*lane] == body);
                own.map(|(list, chunk, lane)| (list.cell_of(chunk, lane), level.h()))
            }))
        };
        self.adapt.follow(couplings, soft)
    }

    /// Brings particles to the levels whose regions they are in, splits those that are too coarse there and merges those that
    /// are finer than need be. `before` are the regions as they were, if any has moved; otherwise levels that are not `stirred`
    /// are passed over. Returns which levels have lost or gained particles, and must be sorted too.
    ///
    /// # Errors
    /// [`barchan_core::Error::Capacity`] if there are no numbers left for new particles; those of materials, whose strain has to be up
    /// to date.
    pub(crate) fn adapt_levels(
        &mut self,
        time: f64,
        before: Option<&Regions>,
        stirred: &[bool],
        couplings: &[Box<dyn Coupling>],
    ) -> Result<Vec<bool>> {
        let mut clock = Instant::now();
        let shown: Vec<&Store<T>> = self.levels.iter().map(|level| &level.store).collect();
        let round = self.adapt.find(&shown, before, stirred);
        let flushing = Instant::now();
        self.flush_strain(time, &round.concerned())?;
        // P2G's clock has run meanwhile.
        clock += flushing.elapsed();
        let mut stores: Vec<&mut Store<T>> = self.levels.iter_mut().map(|level| &mut level.store).collect();
        let changed = self.adapt.apply(&mut stores, &round, couplings)?;
        self.clocks.add(Pass::Adapt, clock);
        Ok(changed)
    }
}

/// Chunk and lane of a place, which is the number of its lane.
fn lane_of(place: usize) -> (usize, usize) {
    (place / CHUNK, place % CHUNK)
}

impl<T: Scalar> LevelStore for Store<T> {
    fn blocks(&self) -> &[u64] {
        &self.blocks
    }
    fn groups(&self) -> usize {
        self.lists.first().map_or(0, |list| list.runs.len())
    }
    fn places(&self, list: usize, group: usize) -> impl Iterator<Item = usize> {
        let list = &self.lists[list];
        let held = list.runs[group].places().filter(|&(chunk, lane)| list.id[chunk][lane] != PAD);
        held.map(|(chunk, lane)| chunk * CHUNK + lane)
    }
    fn greatest_volume(&self, list: usize, group: usize) -> f64 {
        let (list, mut greatest) = (&self.lists[list], [T::default(); CHUNK]);
        let run = list.runs[group];
        for chunk in run.first..run.first + run.chunks() {
            for (greatest, volume) in greatest.iter_mut().zip(list.rest_plane(chunk, VOLUME)) {
                *greatest = if volume > *greatest { volume } else { *greatest };
            }
        }
        greatest.iter().fold(0.0, |greatest, volume| volume.to_f64().max(greatest))
    }
    fn id(&self, list: usize, place: usize) -> u32 {
        let (chunk, lane) = lane_of(place);
        self.lists[list].id[chunk][lane]
    }
    fn body(&self, list: usize, place: usize) -> u16 {
        let (chunk, lane) = lane_of(place);
        self.lists[list].body[chunk][lane]
    }
    fn cell(&self, list: usize, place: usize) -> [i32; 3] {
        let (chunk, lane) = lane_of(place);
        self.lists[list].cell_of(chunk, lane)
    }
    fn offset(&self, list: usize, place: usize) -> [f64; 3] {
        let (chunk, lane) = lane_of(place);
        self.lists[list].offset_of(chunk, lane)
    }
    fn volume0(&self, list: usize, place: usize) -> f64 {
        let (chunk, lane) = lane_of(place);
        self.lists[list].volume0_of(chunk, lane)
    }
    fn parcel(&self, list: usize, place: usize) -> Parcel {
        let (chunk, lane) = lane_of(place);
        self.lists[list].parcel(list, chunk, lane)
    }
    fn remove(&mut self, list: usize, places: impl Iterator<Item = usize>) {
        Store::remove(self, list, places);
    }
    fn push(&mut self, parcels: &[&Parcel]) {
        Store::push(self, parcels);
    }
}
