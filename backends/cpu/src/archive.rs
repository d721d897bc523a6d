//! Unbounded ground on this backend's stores; see `barchan_grid::archive`.

use crate::engine::{CpuEngine, Pass};
use crate::level::Level;
use crate::store::PAD;
use barchan_core::{Coupling, ParticleList, Result};
use barchan_grid::adapt::Parcel;
use barchan_grid::archive::Reach;
use barchan_grid::block::{self, CELLS};
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::time::Instant;

/// Where a live particle is: level, list, chunk, lane.
type Place = (usize, usize, usize, usize);

impl<T: Scalar> CpuEngine<T> {
    /// Puts away what has fallen out of reach and brings in what has come within it. Returns which levels have lost or gained
    /// particles.
    ///
    /// 1. Particles of tiles that fall out of reach are put into the archive, or forgotten where nothing has changed.
    /// 2. Tiles that come within reach are taken from the archive, or seeded.
    ///
    /// # Errors
    /// [`Error::Capacity`] if there are no numbers left for new particles; settled ground that its material cannot carry.
    pub(crate) fn exchange_with_archive(&mut self, time: f64, couplings: &[Box<dyn Coupling>]) -> Result<Vec<bool>> {
        let mut changed = vec![false; self.levels.len()];
        let Some(mut reach) = self.reach.take() else { return Ok(changed) };
        let mut clock = Instant::now();
        let outcome = match reach.advance(&self.adapt.regions) {
            None => Ok(()),
            Some((coming, going)) => {
                let all = vec![true; self.levels.len()];
                let flushing = Instant::now();
                let flushed = self.flush_strain(time, &all);
                // P2G's clock has run meanwhile.
                clock += flushing.elapsed();
                flushed
                    .and_then(|()| self.put_away(&mut reach, &going, couplings, &mut changed))
                    .and_then(|()| self.bring_in(&mut reach, &coming, couplings, &mut changed))
            }
        };
        self.reach = Some(reach);
        self.clocks.add(Pass::Archive, clock);
        outcome.map(|()| changed)
    }

    /// The particles of each of the tiles, in the order of levels, lists and blocks.
    fn in_tiles(&self, reach: &Reach, tiles: &BTreeSet<[i32; 2]>) -> BTreeMap<[i32; 2], Vec<Place>> {
        let mut found: BTreeMap<_, Vec<Place>> = tiles.iter().map(|tile| (*tile, Vec::new())).collect();
        for (l, level) in self.levels.iter().enumerate() {
            for (i, list) in level.store.lists.iter().enumerate() {
                for (chunk, lane) in list.places().filter(|&(chunk, lane)| list.id[chunk][lane] != PAD) {
                    let x = list.position_of(chunk, lane, level.h());
                    let home = reach.goes_with(list.body[chunk][lane], x, &self.adapt.regions, tiles);
                    if let Some(places) = home.and_then(|home| found.get_mut(&home)) {
                        places.push((l, i, chunk, lane));
                    }
                }
            }
        }
        found
    }

    fn put_away(
        &mut self,
        reach: &mut Reach,
        tiles: &BTreeSet<[i32; 2]>,
        couplings: &[Box<dyn Coupling>],
        changed: &mut [bool],
    ) -> Result<()> {
        let mut going: Vec<([i32; 2], Vec<ParticleList>)> = Vec::new();
        for (tile, places) in self.in_tiles(reach, tiles) {
            let mut lists = Vec::new();
            for same in places.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
                let (l, i, ..) = same[0];
                let here: Vec<(usize, usize)> = same.iter().map(|&(_, _, chunk, lane)| (chunk, lane)).collect();
                lists.push(self.levels[l].store.lists[i].give_out(l, self.levels[l].h(), &here));
                changed[l] = true;
                self.levels[l].store.remove(i, same.iter().map(|&(_, _, chunk, lane)| chunk * CHUNK + lane));
            }
            going.push((tile, lists));
        }
        for (mass, momentum) in reach.put_away(going, couplings, &mut self.adapt)? {
            self.mass -= mass;
            for d in 0..3 {
                self.wall_impulse[d] -= momentum[d];
            }
        }
        Ok(())
    }

    fn bring_in(
        &mut self,
        reach: &mut Reach,
        tiles: &[[i32; 2]],
        couplings: &[Box<dyn Coupling>],
        changed: &mut [bool],
    ) -> Result<()> {
        let (mass, coming) = reach.bring_in(tiles, couplings, &mut self.adapt)?;
        self.mass += mass;
        for (l, level) in self.levels.iter_mut().enumerate() {
            let here: Vec<&Parcel> = coming.iter().filter(|(to, _)| *to == l).map(|(_, parcel)| parcel).collect();
            if !here.is_empty() {
                changed[l] = true;
                level.store.push(&here);
            }
        }
        Ok(())
    }

    /// Finds the nodes that ground out of reach holds.
    pub(crate) fn hold_edges(&mut self) {
        let (Some(reach), Some(level)) = (&self.reach, self.levels.last_mut()) else { return };
        let world = [0, 1].map(|d| [level.bounds.min[d], level.bounds.max[d]]);
        let mut edges: HashMap<[i32; 2], u16> = HashMap::new();
        level.grid.held.clear();
        for (g, &key) in level.grid.keys.iter().enumerate() {
            let [x, y, _] = block::of_key(key);
            let columns = *edges.entry([x, y]).or_insert_with(|| reach.edge_of([x, y], world));
            let nodes = (0..16).fold(0, |bits, c| if columns >> c & 1 == 1 { bits | 0xf << (4 * c) } else { bits });
            if nodes != 0 {
                level.grid.held.push((g as u32, nodes));
            }
        }
    }
}

impl<T: Scalar> Level<T> {
    /// Holds the nodes at the edge of what is within reach at rest, and books what that takes.
    pub(crate) fn hold(&mut self) {
        for &(g, nodes) in &self.grid.held {
            // Where all sleeps, nodes are not summed.
            if self.watch.nodes.binary_search(&g).is_err() {
                continue;
            }
            let block = &mut self.grid.nodes[g as usize];
            for n in (0..CELLS).filter(|n| nodes >> n & 1 == 1) {
                let node = &mut block[4 * n..4 * n + 4];
                for d in 0..3 {
                    self.wall_impulse[d] -= node[3].to_f64() * node[d].to_f64();
                    node[d] = T::default();
                }
            }
        }
    }
}
