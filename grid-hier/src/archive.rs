//! Unbounded ground: adds ground that comes within reach of agents, and archives ground that goes out of reach.
//!
//! Ground comes and goes in tiles: columns of the coarsest level's blocks. A tile is live; or it is archived, if
//! anything in it has changed; or else it is what the terrain says. Nodes whose support reaches a tile that is not live
//! are held at rest. All other nodes have whole supports, so settled ground is in balance up to the edge. Backends give
//! the particles of tiles that go, and get those of tiles that come.

use crate::adapt::{Adapt, IDS, Parcel};
use crate::block::SIDE;
use barchan_core::levels::TILE;
use barchan_core::{Coupling, Error, Ledger, ParticleList, Regions, Result, Terrain, Tile};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

const _: () = assert!(TILE == SIDE, "a tile's columns are those of one block");

/// Numbers of tiles along x and y.
pub type Tiles = BTreeSet<[i32; 2]>;

/// The live tiles, the archive, and sums of what has come and gone since the start.
#[derive(Clone)]
pub struct Reach {
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
    /// Nothing live yet.
    pub fn new(terrain: Arc<Terrain>) -> Self {
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

    /// Tiles that are live.
    pub fn live(&self) -> BTreeSet<[i32; 2]> {
        self.live.clone()
    }

    /// Copies of the lists in the archive.
    pub fn archived(&self) -> impl Iterator<Item = ParticleList> {
        self.archive.values().flat_map(Tile::unpack)
    }

    /// Which points [m] are out of reach where nothing has changed the ground, where the coarsest cells have that width [m].
    pub fn untouched(&self, points: &[[f64; 2]], cell: f64) -> Vec<bool> {
        let is_untouched = |tile: [i32; 2]| !self.live.contains(&tile) && !self.archive.contains_key(&tile);
        points.iter().map(|point| is_untouched(tile_at(*point, cell))).collect()
    }

    /// Whether ground in the archive may lie at a point [m], where the coarsest cells have that width [m].
    pub fn may_hold(&self, point: [f64; 2], cell: f64) -> bool {
        let [x, y] = tile_at(point, cell);
        // A particle that has strayed lies in the tile beside its own.
        !self.archive.is_empty() && (0..9).any(|n| self.archive.contains_key(&[x + n / 3 - 1, y + n % 3 - 1]))
    }

    /// The archive, for a snapshot.
    pub fn archive(&self) -> BTreeMap<[i32; 2], Tile> {
        self.archive.clone()
    }

    /// Takes over the tiles of a saved run.
    pub fn restore(&mut self, live: BTreeSet<[i32; 2]>, archive: BTreeMap<[i32; 2], Tile>) {
        (self.live, self.archive) = (live, archive);
    }

    /// Bytes that the archive holds.
    pub fn bytes(&self) -> u64 {
        self.archive.values().map(Tile::bytes).sum()
    }

    /// Continues the sums of the engine before this one.
    pub fn carry_on(&mut self, sums: &Ledger) {
        (self.seeded_mass, self.kinetic) = (sums.seeded_mass, sums.archived_kinetic);
        (self.seeded, self.archived, self.returned, self.dropped) = (0, 0, 0, 0);
    }

    /// Adds what is archived, and what has come and gone, to the ledger.
    pub fn account(&self, ledger: &mut Ledger) {
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
        ledger.count("bytes in the archive now", self.bytes());
    }

    /// Columns of a tile whose nodes touch ground out of reach, as bits: 4 x + y.
    pub fn edge_of(&self, tile: [i32; 2], world: [[i32; 2]; 2]) -> u16 {
        edge_of(&self.live, tile, world)
    }

    /// Moves on to the tiles that are within reach now. Returns those that come and those that go, if there are any.
    pub fn advance(&mut self, regions: &Regions) -> Option<(Vec<[i32; 2]>, Tiles)> {
        let live = regions.reached(&self.live);
        let coming: Vec<_> = live.difference(&self.live).copied().collect();
        let going: BTreeSet<_> = self.live.difference(&live).copied().collect();
        self.live = live;
        (!coming.is_empty() || !going.is_empty()).then_some((coming, going))
    }

    /// The tile, of those that go out of reach, with which a particle of a body at `x` [m] goes. A particle that has
    /// strayed over the edge goes with the tile that it came from.
    pub fn goes_with(&self, body: u16, x: [f64; 3], regions: &Regions, going: &BTreeSet<[i32; 2]>) -> Option<[i32; 2]> {
        let tile = self.terrain.tile_of(body, x, regions);
        if self.live.contains(&tile) {
            return None;
        }
        let near = (0..9).map(|n| [tile[0] + n / 3 - 1, tile[1] + n % 3 - 1]);
        std::iter::once(tile).chain(near).find(|tile| going.contains(tile))
    }

    /// Puts the particles of some tiles into the archive, merged as far as [`Adapt::merged`] does, or drops those of tiles
    /// in which nothing has changed. Returns each tile's mass [kg] and momentum [kg m/s].
    ///
    /// # Errors
    /// Those of settled ground that its material cannot carry.
    pub fn put_away(
        &mut self,
        tiles: Vec<([i32; 2], Vec<ParticleList>)>,
        couplings: &[Box<dyn Coupling>],
        adapt: &mut Adapt,
    ) -> Result<Vec<(f64, [f64; 3])>> {
        let motions: Vec<_> = tiles.iter().map(|(_, lists)| motion_of(lists)).collect();
        adapt.leave(tiles.iter().flat_map(|(_, lists)| lists).flat_map(|list| &list.id));
        let (terrain, shown) = (&self.terrain, &*adapt);
        let pack = |(tile, lists)| {
            let changed = terrain.changed(tile, lists, couplings, &shown.regions)?;
            let merged = changed.map(|lists| shown.merged(tile, lists, couplings)).transpose()?;
            Ok((tile, merged.map(|(lists, counts)| (Tile::pack(lists), counts))))
        };
        let packed = tiles.into_par_iter().map(pack).collect::<Result<Vec<_>>>()?;
        for ((tile, packed), (mass, _, kinetic)) in packed.into_iter().zip(&motions) {
            self.kinetic += kinetic;
            match packed {
                Some((kept, counts)) => {
                    self.archived += 1;
                    adapt.count_merged(counts);
                    // The same but for rounding.
                    self.seeded_mass += kept.mass() - mass;
                    self.archive.insert(tile, kept);
                }
                None => {
                    self.dropped += 1;
                    self.seeded_mass -= mass;
                }
            }
        }
        Ok(motions.into_iter().map(|(mass, momentum, _)| (mass, momentum)).collect())
    }

    /// Takes tiles from the archive, or seeds them. Returns their mass [kg], and the particles with their levels.
    ///
    /// # Errors
    /// [`Error::Capacity`] if there are no numbers left for new particles; settled ground that its material cannot carry.
    pub fn bring_in(
        &mut self,
        tiles: &[[i32; 2]],
        couplings: &[Box<dyn Coupling>],
        adapt: &mut Adapt,
    ) -> Result<(f64, Vec<(usize, Parcel)>)> {
        let archived: Vec<_> = tiles.iter().map(|tile| (*tile, self.archive.remove(tile))).collect();
        // Those that are seeded, with how many new numbers they take; they count from 0 as yet.
        let lists_of = |(tile, archived): ([i32; 2], Option<Tile>)| match archived {
            Some(archived) => Ok((archived.unpack(), None)),
            None => {
                let mut numbers = 0;
                let lists = self.terrain.seed_tiles(&[tile], couplings, &adapt.regions, &mut numbers)?;
                Ok((lists, Some(numbers)))
            }
        };
        let mut coming = archived.into_par_iter().map(lists_of).collect::<Result<Vec<_>>>()?;
        let mut mass = 0.0;
        for (lists, numbers) in &mut coming {
            let own = motion_of(lists).0;
            mass += own;
            if let Some(numbers) = numbers {
                self.seeded += 1;
                self.seeded_mass += own;
                lists.iter_mut().flat_map(|list| &mut list.id).for_each(|id| *id += adapt.next_id);
                adapt.next_id += *numbers;
            } else {
                self.returned += 1;
            }
        }
        if adapt.next_id > IDS {
            return Err(Error::Capacity {
                what: "numbers for particles",
                asked: adapt.next_id,
                cap: IDS,
                mend: "start a new run from what this one has made",
            });
        }
        let shown = &*adapt;
        let of_list = |list: &ParticleList| {
            let level = list.level as usize;
            (0..list.len()).map(|i| shown.settled(Parcel::of(list, i), level)).collect::<Vec<_>>()
        };
        let parcels = coming.par_iter().flat_map_iter(|(lists, _)| lists.iter().flat_map(of_list));
        let parcels: Vec<(usize, Parcel)> = parcels.collect();
        adapt.come(&parcels);
        Ok((mass, parcels))
    }
}

/// Columns of a tile whose nodes touch ground out of reach where so many are live, as bits: 4 x + y. `world` are the ends of the world along x and y in coarsest cells.
pub fn edge_of(live: &Tiles, tile: [i32; 2], world: [[i32; 2]; 2]) -> u16 {
    // Columns beyond the world are not out of reach.
    let is_away = |x: i32, y: i32| {
        let inside = [x, y].iter().zip(world).all(|(c, [min, max])| (min..max).contains(c));
        inside && !live.contains(&[x, y].map(|c| c.div_euclid(TILE)))
    };
    (0..16).fold(0, |bits, column| {
        let [x, y] = [tile[0] * TILE + column / 4, tile[1] * TILE + column % 4];
        let away = (-1..=1).any(|dx| (-1..=1).any(|dy| is_away(x + dx, y + dy)));
        bits | u16::from(away) << column
    })
}

/// The tile in which a point [m] lies, where the coarsest cells have that width [m].
fn tile_at(point: [f64; 2], cell: f64) -> [i32; 2] {
    point.map(|x| (x / (cell * f64::from(TILE))).floor() as i32)
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
