//! Unbounded ground: what comes within reach of agents is brought in, what falls out of it is put away.
//!
//! Ground comes and goes in tiles, columns of the coarsest level's blocks. A tile is live, or archived if anything in it has
//! changed, or else what the terrain says. Nodes whose support reaches a tile that is not live are held at rest: the other nodes have
//! whole supports, so settled ground is in balance up to the edge.

use crate::engine::{CpuEngine, Pass};
use crate::level::Level;
use crate::store::PAD;
use barchan_core::levels::TILE;
use barchan_core::{Coupling, Error, Ledger, ParticleList, Result, Terrain, Tile};
use barchan_grid::adapt::Parcel;
use barchan_grid::block::{self, CELLS, SIDE};
use barchan_grid::transfer::Scalar;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Instant;

const _: () = assert!(TILE == SIDE, "a tile's columns are those of one block");

/// What is live, what is archived, and what has come and gone since the start.
pub(crate) struct Reach {
    terrain: Arc<Terrain>,
    live: BTreeSet<[i32; 2]>,
    archive: BTreeMap<[i32; 2], Tile>,
    seeded: u64,
    archived: u64,
    returned: u64,
    dropped: u64,
    seeded_mass: f64,
    kinetic: f64,
}

impl Reach {
    pub(crate) fn new(terrain: Arc<Terrain>) -> Self {
        Self {
            terrain,
            live: BTreeSet::new(),
            archive: BTreeMap::new(),
            seeded: 0,
            archived: 0,
            returned: 0,
            dropped: 0,
            seeded_mass: 0.0,
            kinetic: 0.0,
        }
    }

    pub(crate) fn live(&self) -> BTreeSet<[i32; 2]> {
        self.live.clone()
    }

    /// Copies of the lists in the archive.
    pub(crate) fn archived(&self) -> impl Iterator<Item = ParticleList> {
        self.archive.values().flat_map(Tile::unpack)
    }

    pub(crate) fn archive(&self) -> BTreeMap<[i32; 2], Tile> {
        self.archive.clone()
    }

    /// Takes over what a saved run had.
    pub(crate) fn restore(&mut self, live: BTreeSet<[i32; 2]>, archive: BTreeMap<[i32; 2], Tile>) {
        (self.live, self.archive) = (live, archive);
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.archive.values().map(Tile::bytes).sum()
    }

    pub(crate) fn account(&self, ledger: &mut Ledger) {
        let archived: f64 = self.archive.values().map(Tile::mass).sum();
        ledger.mass += archived;
        ledger.archived_mass += archived;
        ledger.seeded_mass += self.seeded_mass;
        ledger.archived_kinetic += self.kinetic;
        ledger.count("tiles brought in from the terrain", self.seeded);
        ledger.count("tiles given back to the terrain", self.dropped);
        ledger.count("tiles archived", self.archived);
        ledger.count("tiles brought back from the archive", self.returned);
        ledger.count("tiles in the archive now", self.archive.len() as u64);
    }

    /// Is the column of a coarsest cell out of reach? Beyond the world there is nothing that could be.
    fn is_away(&self, x: i32, y: i32, world: [[i32; 2]; 2]) -> bool {
        let inside = [x, y].iter().zip(world).all(|(c, [min, max])| (min..max).contains(c));
        inside && !self.live.contains(&[x, y].map(|c| c.div_euclid(TILE)))
    }

    /// Columns of a tile whose nodes touch ground out of reach, as bits: 4 x + y.
    fn edge_of(&self, tile: [i32; 2], world: [[i32; 2]; 2]) -> u16 {
        (0..16).fold(0, |bits, column| {
            let [x, y] = [tile[0] * TILE + column / 4, tile[1] * TILE + column % 4];
            let away = (-1..=1).any(|dx| (-1..=1).any(|dy| self.is_away(x + dx, y + dy, world)));
            bits | u16::from(away) << column
        })
    }
}

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
        let live = self.adapt.regions.reached(&reach.live);
        let coming: Vec<_> = live.difference(&reach.live).copied().collect();
        let going: BTreeSet<_> = reach.live.difference(&live).copied().collect();
        let outcome = if coming.is_empty() && going.is_empty() {
            Ok(())
        } else {
            reach.live = live;
            let all = vec![true; self.levels.len()];
            let flushing = Instant::now();
            let flushed = self.flush_strain(time, &all);
            // P2G's clock has run meanwhile.
            clock += flushing.elapsed();
            flushed
                .and_then(|()| self.put_away(&mut reach, &going, couplings, &mut changed))
                .and_then(|()| self.bring_in(&mut reach, &coming, couplings, &mut changed))
        };
        self.reach = Some(reach);
        self.clocks.add(Pass::Archive, clock);
        outcome.map(|()| changed)
    }

    /// The particles of each of the tiles, in the order of levels, lists and blocks. One that has strayed over the edge goes with the
    /// tile that it came from.
    fn in_tiles(&self, reach: &Reach, tiles: &BTreeSet<[i32; 2]>) -> BTreeMap<[i32; 2], Vec<Place>> {
        let mut found: BTreeMap<_, Vec<Place>> = tiles.iter().map(|tile| (*tile, Vec::new())).collect();
        for (l, level) in self.levels.iter().enumerate() {
            for (i, list) in level.store.lists.iter().enumerate() {
                for (chunk, lane) in list.places().filter(|&(chunk, lane)| list.id[chunk][lane] != PAD) {
                    let x = list.position_of(chunk, lane, level.h());
                    let tile = reach.terrain.tile_of(list.body[chunk][lane], x, &self.adapt.regions);
                    if reach.live.contains(&tile) {
                        continue;
                    }
                    let near = (0..9).map(|n| [tile[0] + n / 3 - 1, tile[1] + n % 3 - 1]);
                    let home = std::iter::once(tile).chain(near).find(|tile| tiles.contains(tile));
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
        for (tile, places) in self.in_tiles(reach, tiles) {
            let mut lists: Vec<ParticleList> = Vec::new();
            for same in places.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
                let (l, i, ..) = same[0];
                let list = &self.levels[l].store.lists[i];
                let mut out = list.empty_copy(l, self.levels[l].h());
                same.iter().for_each(|&(_, _, chunk, lane)| list.copy_to(&mut out, chunk, lane));
                lists.push(out);
            }
            for &(l, i, chunk, lane) in &places {
                changed[l] = true;
                self.levels[l].store.remove(i, chunk, lane);
            }
            let (mass, momentum, kinetic) = motion_of(&lists);
            self.mass -= mass;
            reach.kinetic += kinetic;
            let coarsest = self.levels.len() - 1;
            for d in 0..3 {
                self.levels[coarsest].wall_impulse[d] -= momentum[d];
            }
            if reach.terrain.is_untouched(tile, &lists, couplings, &self.adapt.regions)? {
                reach.dropped += 1;
                reach.seeded_mass -= mass;
            } else {
                reach.archived += 1;
                reach.archive.insert(tile, Tile::pack(lists));
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
        let mut coming: Vec<(usize, Parcel)> = Vec::new();
        for tile in tiles {
            let lists = match reach.archive.remove(tile) {
                Some(archived) => {
                    reach.returned += 1;
                    archived.unpack()
                }
                None => {
                    reach.seeded += 1;
                    let lists =
                        reach.terrain.seed_tiles(&[*tile], couplings, &self.adapt.regions, &mut self.adapt.next_id)?;
                    reach.seeded_mass += motion_of(&lists).0;
                    lists
                }
            };
            self.mass += motion_of(&lists).0;
            for list in &lists {
                let level = list.level as usize;
                coming.extend((0..list.len()).map(|i| self.adapt.settled(Parcel::of(list, i), level)));
            }
        }
        if self.adapt.next_id > u64::from(PAD) {
            return Err(Error::Capacity {
                what: "numbers for particles",
                asked: self.adapt.next_id,
                cap: u64::from(PAD),
                mend: "start a new run from what this one has made",
            });
        }
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

/// Mass [kg], momentum [kg m/s] and kinetic energy of the particles' centres [J].
fn motion_of(lists: &[ParticleList]) -> (f64, [f64; 3], f64) {
    let (mut mass, mut momentum, mut kinetic) = (0.0, [0.0; 3], 0.0);
    for list in lists {
        for (m, v) in list.mass.iter().zip(&list.velocity) {
            mass += m;
            for d in 0..3 {
                momentum[d] += m * v[d];
                kinetic += 0.5 * m * v[d] * v[d];
            }
        }
    }
    (mass, momentum, kinetic)
}
