//! Unbounded ground on the device; see `barchan_grid::archive`. The host adds and removes tiles, as it does particles
//! in rounds of split and merge.

use crate::device::kernel::Role;
use crate::device::layout::{Homes, Planes};
use crate::device::memory::with_room;
use crate::schedule::batch::WgpuBatch;
use barchan_core::{Coupling, ParticleList, Result};
use barchan_grid::adapt::{CopiedLevel, LevelStore, Parcel};
use barchan_grid::archive::Reach;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// A tile's particles, a list a level and material.
pub(crate) type Lists = BTreeMap<[i32; 2], Vec<ParticleList>>;

impl WgpuBatch {
    /// Puts away what has fallen out of a world's reach, and brings in what has come within it. Its particles have just been sorted.
    pub(crate) fn exchange_with_archive(&mut self, w: usize, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        let Some(mut reach) = self.worlds[w].reach.take() else { return Ok(()) };
        let moved = reach.advance(&self.worlds[w].adapt.regions);
        let turned = moved.map(|(coming, going)| self.turn_over(w, &mut reach, &coming, &going, couplings));
        self.worlds[w].reach = Some(reach);
        let Some((gone, come)) = turned.transpose()? else { return Ok(()) };
        self.write_live()?;
        let is_empty = gone.iter().all(Vec::is_empty) && come.iter().all(ParticleList::is_empty);
        if is_empty { Ok(()) } else { self.exchange(w, &gone, &come) }
    }

    /// The slots of those that go, level by level, and those that come, a list a level and material.
    pub(crate) fn turn_over(
        &mut self,
        w: usize,
        reach: &mut Reach,
        coming: &[[i32; 2]],
        going: &BTreeSet<[i32; 2]>,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<(Vec<Vec<u32>>, Vec<ParticleList>)> {
        let (gone, tiles) = self.in_tiles(w, reach, going)?;
        let world = &mut self.worlds[w];
        for (mass, momentum) in reach.put_away(tiles.into_iter().collect(), couplings, &mut world.adapt)? {
            world.come(-mass);
            (0..3).for_each(|d| world.wall_impulse[d] -= momentum[d]);
        }
        let (mass, parcels) = reach.bring_in(coming, couplings, &mut world.adapt)?;
        world.come(mass);
        let mut come = Vec::new();
        for (l, level) in world.levels.iter().enumerate() {
            let empty = Planes::default().lists(&[], &world.materials, (l, level.h), 0);
            let mut copied = CopiedLevel::new(empty, Vec::new());
            let here: Vec<&Parcel> = parcels.iter().filter(|(to, _)| *to == l).map(|(_, parcel)| parcel).collect();
            copied.push(&here);
            come.extend(copied.come());
        }
        Ok((gone, come))
    }

    /// The particles of each of the tiles, and the slots of all of them, level by level. The device copies particles of blocks near
    /// the tiles, and the host chooses among them.
    pub(crate) fn in_tiles(
        &mut self,
        w: usize,
        reach: &Reach,
        tiles: &BTreeSet<[i32; 2]>,
    ) -> Result<(Vec<Vec<u32>>, Lists)> {
        let mut gone = vec![Vec::new(); self.levels];
        let mut found: Lists = tiles.iter().map(|tile| (*tile, Vec::new())).collect();
        if tiles.is_empty() {
            return Ok((gone, found));
        }
        let regions = &self.worlds[w].adapt.regions;
        // A block lies in one tile. Where its particles were seeded, and which tile they go with, may each be one further.
        let around = |&[x, y]: &[i32; 2]| (0..25).map(move |n| [x + n / 5 - 2, y + n % 5 - 2]);
        let near: BTreeSet<[i32; 2]> = tiles.iter().flat_map(around).collect();
        let of_level = |(l, homes): (usize, Homes)| {
            homes.places_in(|block| near.contains(&regions.tile_of(block.map(|b| (4 * b) << l))))
        };
        let places: Vec<_> = self.readback().homes(w..w + 1)?.into_iter().enumerate().map(of_level).collect();
        let slots = places.iter().zip(&self.worlds[w].levels).flat_map(|(places, level)| {
            let first = level.particles.start;
            places.iter().map(move |(q, _)| (first + q) as u32)
        });
        let slots: Vec<u32> = slots.collect();
        let planes = self.copies(&slots)?;

        let world = &self.worlds[w];
        let mut first = 0;
        for (l, (level, places)) in world.levels.iter().zip(&places).enumerate() {
            let going = |(i, &(_, block)): (usize, &(usize, [i32; 3]))| {
                let copy = first + i;
                let x = planes.spot(copy, block, level.h, slots.len()).position;
                let tile = reach.goes_with(planes.body(copy), x, &world.adapt.regions, tiles)?;
                Some((tile, (copy, block)))
            };
            let going: Vec<_> = places.par_iter().enumerate().filter_map(going).collect();
            gone[l].extend(going.iter().map(|(_, (copy, _))| slots[*copy]));
            for (tile, found) in &mut found {
                let own: Vec<_> = going.iter().filter(|(to, _)| to == tile).map(|(_, place)| *place).collect();
                let lists = planes.lists(&own, &world.materials, (l, level.h), slots.len());
                found.extend(lists.into_iter().filter(|list| !list.is_empty()));
            }
            first += places.len();
        }
        Ok((gone, found))
    }

    /// Tells the device which tiles of all worlds are live: sorts find the edge anew.
    pub(crate) fn write_live(&mut self) -> Result<()> {
        let live: Vec<_> = self.worlds.iter().map(|w| w.reach.as_ref().map(Reach::live).unwrap_or_default()).collect();
        let most = live.iter().map(BTreeSet::len).max().unwrap_or(0);
        if most > self.memory.live() {
            self.memory.add_live(&self.gpu, with_room(most) as usize)?;
        }
        self.unlinked = true;
        let mut words = Vec::new();
        for tiles in live {
            words.push([tiles.len() as i32, 0]);
            words.extend(&tiles);
            words.extend((tiles.len()..self.memory.live()).map(|_| [0; 2]));
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Live, 0), 0, bytemuck::cast_slice(&words));
        Ok(())
    }
}
