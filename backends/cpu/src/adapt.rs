//! Levels after their agents: who changes level, who is split, who merges.
//!
//! A particle's class says how many lattice points of its body it stands for along a side, as a power of two: class l is the
//! size that belongs to level l. Regions grown by one parent cell hold nothing coarser than their level; what is finer merges
//! once it is three parent cells away. In between, particles stay as they are, so an agent that trembles changes nothing.

use crate::engine::{CpuEngine, Pass};
use crate::grid::KeyHasher;
use crate::store::{List, PAD, Parcel};
use barchan_core::levels::{CellBox, MERGE_BEHIND, SPLIT_AHEAD, agent_bounds};
use barchan_core::{Aabb, Coupling, Error, Ledger, Regions, Result};
use barchan_grid::block::{self, CELLS, SIDE};
use barchan_grid::particles::{MASS, Run, STRAIN, VOLUME};
use barchan_grid::resample::{CHILDREN, Change, Particle, Planes, Refusal, merge, split};
use barchan_grid::transfer::Scalar;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::BuildHasherDefault;
use std::time::Instant;

/// Particles merge if together they are this part of the class that they merge into.
const PORTION: std::ops::RangeInclusive<f64> = 0.5..=1.6;
/// Rounds after which what has found no partners may merge in pairs, so that leftovers do not add up.
const PATIENCE: u64 = 4;
/// Width of the neighbourhoods in which particles look for partners, in sides of the merged particle. They are cut by fixed sizes, so that
/// no result depends on the number of threads; their faces lie elsewhere each time.
const NEIGHBOURHOOD: u32 = 8;
/// How far from a cluster's centre its members may be, in sides of the merged particle: those of a lattice are √3/4 away, the next
/// ones 0.83.
const REACH: f64 = 0.65;
/// Clusters merge if they are no less like a cube than this, as the norm of their second moments over those of the cube of their
/// volume, less 1: a slab half as thick as wide has 1.02, two particles of a lattice 1.64.
const SHAPELESS: f64 = 1.1;
/// Part of a full cell below which a cell counts as empty: next to it is the surface.
const EMPTY: f64 = 0.5;
/// Rounds without a try after which everything that is finer than need be is tried again.
const STILL_ROUNDS: u64 = 32;
/// Rounds after which it is even while regions move: it looks at footprints too, which are refused as a rule.
const MERGE_ROUNDS: u64 = 128;
/// Cells around a tool, in sides of the merged particle, in which nothing merges: no tool comes to stand inside a particle.
const AROUND_TOOL: f64 = 2.0;

/// What splits and merges have done since the start.
#[derive(Clone, Debug, Default)]
pub(crate) struct Resampled {
    moves: u64,
    splits: u64,
    merged: u64,
    merges: u64,
    kinetic: f64,
    angular: Vector3<f64>,
    /// Groups that were refused in the last round.
    refused: BTreeMap<Refusal, u64>,
}

impl Resampled {
    pub(crate) fn account(&self, ledger: &mut Ledger) {
        ledger.count("particles that changed level", self.moves);
        ledger.count("particles split", self.splits);
        ledger.count("particles merged", self.merged);
        ledger.count("particles that merging left", self.merges);
        for (why, &count) in &self.refused {
            ledger.count(&format!("groups kept apart since {} now", why.name()), count);
        }
        ledger.resampled_kinetic += self.kinetic;
        for d in 0..3 {
            ledger.resampled_angular_momentum[d] += self.angular[d];
        }
    }
}

/// What is to happen to a particle.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Action {
    Move,
    Split,
    Merge,
}

/// Which particles may merge in a round, of those that are finer than need be.
#[derive(Clone, Copy)]
enum Candidates<'a> {
    None,
    /// Those that had to be as fine in these regions.
    New(&'a Regions),
    All,
}

/// A particle that something is to happen to.
#[derive(Clone, Copy)]
struct Found {
    level: usize,
    list: usize,
    chunk: usize,
    lane: usize,
    class: u32,
    /// Level where it belongs.
    home: usize,
    action: Action,
}

/// A particle that looks for partners.
struct Candidate {
    found: Found,
    id: u32,
    body: u16,
    /// Where it is [m].
    x: [f64; 3],
    /// Rest volume [m³].
    volume0: f64,
    /// Side of what it may become a part of [m].
    side: f64,
    at_surface: bool,
}

/// Candidates in their bins: class, list, body and bin first, so that those of a bin stand together, in the order of ids.
type Binned = (u32, usize, u16, [i64; 3], u32, usize);

/// Mass in each cell of a level, as a part of a full cell, by block.
type Filling = HashMap<u64, [f32; CELLS], BuildHasherDefault<KeyHasher>>;

/// What does not change while particles of a round merge.
struct Merging<'a> {
    candidates: &'a [Candidate],
    /// Of each list: is its strain F, and the rules of its history.
    planes: Vec<(bool, Vec<u32>)>,
    /// Size of gravity [m/s²].
    gravity: f64,
}

impl<T: Scalar> CpuEngine<T> {
    /// Moves the levels' boxes after their agents. Returns the regions as they were if any has moved.
    pub(crate) fn follow_agents(&mut self, couplings: &[Box<dyn Coupling>]) -> Option<Regions> {
        if self.levels.len() == 1 {
            return None;
        }
        let agents = agent_bounds(&self.agents, couplings, |body| self.soft_bounds(body));
        let before = self.regions.clone();
        self.regions.follow(&agents).then_some(before)
    }

    /// A box of cells around a soft body.
    fn soft_bounds(&self, body: u16) -> Option<Aabb> {
        let mut bounds: Option<Aabb> = None;
        for level in &self.levels {
            for list in &level.store.lists {
                for (chunk, lane) in list.places().filter(|&(chunk, lane)| list.body[chunk][lane] == body) {
                    let cell = list.cell_of(chunk, lane);
                    let here = Aabb {
                        min: cell.map(|c| f64::from(c) * level.h()),
                        max: cell.map(|c| f64::from(c + 1) * level.h()),
                    };
                    bounds = Some(bounds.map_or(here, |all| all.union(&here)));
                }
            }
        }
        bounds
    }

    /// Brings particles to the levels whose regions they are in, splits those that are too coarse there and merges those that
    /// are finer than need be. `before` are the regions as they were, if any has moved: then what need not be as fine any more is
    /// merged; what was refused then is tried again now and then. As long as regions stay, only levels that are `stirred` are looked
    /// at: the others' particles have hardly moved since they were sorted. Returns which levels have lost or gained particles, and
    /// must be sorted.
    ///
    /// # Errors
    /// [`Error::Capacity`] if there are no numbers left for new particles; those of materials, whose strain has to be up to date.
    pub(crate) fn adapt(
        &mut self,
        time: f64,
        before: Option<&Regions>,
        stirred: &[bool],
        couplings: &[Box<dyn Coupling>],
    ) -> Result<Vec<bool>> {
        let mut clock = Instant::now();
        let candidates = match before {
            _ if self.rounds.is_multiple_of(MERGE_ROUNDS) || self.rounds >= self.tried + STILL_ROUNDS => {
                Candidates::All
            }
            Some(before) => Candidates::New(before),
            None => Candidates::None,
        };
        if !matches!(candidates, Candidates::None) {
            self.tried = self.rounds;
        }
        let looks = |l: &usize| stirred[*l] || !matches!(candidates, Candidates::None);
        let found: Vec<Found> = (0..self.levels.len()).filter(looks).flat_map(|l| self.find(l, candidates)).collect();
        // Levels have steps of their own, and strain lags behind by one.
        let mut concerned = vec![false; self.levels.len()];
        for one in &found {
            match one.action {
                Action::Move => (concerned[one.level], concerned[one.home]) = (true, true),
                // Children and merged particles may belong on any level.
                Action::Split | Action::Merge => concerned.fill(true),
            }
        }
        let flushing = Instant::now();
        self.flush_strain(time, &concerned)?;
        // P2G's clock has run meanwhile.
        clock += flushing.elapsed();
        let mut coming: Vec<(usize, Parcel)> = Vec::new();
        let mut gone: Vec<Found> = Vec::new();
        let tools: Vec<Aabb> = couplings.iter().flat_map(|c| c.bounds()).collect();
        let splitting: Vec<Found> = found.iter().filter(|one| one.action == Action::Split).copied().collect();
        let away: Vec<Option<Family>> = splitting
            .par_iter()
            .map(|&one| self.split_up(one, |places| is_away(places, &tools).then_some(true)))
            .collect();
        for (&one, family) in splitting.iter().zip(away) {
            let touches = |places: &[[f64; 3]; CHILDREN]| {
                Some(is_away(places, &tools) || couplings.iter().all(|c| c.distance(places).iter().all(|d| *d >= 0.0)))
            };
            let Some(family) = family.or_else(|| self.split_up(one, touches)) else { continue };
            self.resampled.splits += family.splits;
            let first = self.new_ids(family.splits * (CHILDREN as u64 - 1))?;
            coming.extend(family.parcels.into_iter().map(|(level, mut parcel, child)| {
                parcel.id = child.map_or(parcel.id, |child| first + child);
                (level, parcel)
            }));
        }
        gone.extend(splitting);
        let stay = match candidates {
            Candidates::None => Vec::new(),
            _ => self.merge_all(&found, couplings, &tools, &mut coming, &mut gone),
        };
        let moving: Vec<Found> = found.iter().filter(|one| one.action == Action::Move).copied().chain(stay).collect();
        self.resampled.moves += moving.len() as u64;
        coming.par_extend(moving.par_iter().map(|&one| self.moved(one)));
        gone.extend(moving);
        let mut changed = vec![false; self.levels.len()];
        for one in gone {
            changed[one.level] = true;
            self.levels[one.level].store.remove(one.list, one.chunk, one.lane);
        }
        for (l, level) in self.levels.iter_mut().enumerate() {
            let mut here: Vec<(usize, u32, &Parcel)> =
                coming.iter().filter(|(to, _)| *to == l).map(|(_, parcel)| (parcel.list, parcel.id, parcel)).collect();
            if !here.is_empty() {
                here.par_sort_unstable_by_key(|&(list, id, _)| (list, id));
                let here: Vec<&Parcel> = here.into_iter().map(|(.., parcel)| parcel).collect();
                changed[l] = true;
                level.store.push(&here);
            }
        }
        self.clocks.add(Pass::Adapt, clock);
        Ok(changed)
    }

    /// Rest volume of a body's particles on the finest level [m³].
    fn finest_volume(&self, body: u16) -> f64 {
        self.scene
            .body
            .get(usize::from(body))
            .map_or(0.125 * self.levels[0].h().powi(3), |body| self.scene.spacing(body).powi(3))
    }

    /// Particles of a level that have to move, split or may merge, in the order of its blocks.
    fn find(&self, l: usize, candidates: Candidates<'_>) -> Vec<Found> {
        let level = &self.levels[l];
        // Particles of class c have from 8^c / √8 of their body's finest volume up to √8 · 8^c.
        let least_of = |body: usize, class: usize| {
            if class == 0 { 0.0 } else { self.finest_volume(body as u16) * 8_f64.powf(class as f64 - 0.5) }
        };
        let classes = self.levels.len() + 1;
        let least: Vec<f64> = (0..self.scene.body.len().max(1))
            .flat_map(|body| (0..classes).map(move |class| least_of(body, class)))
            .collect();
        let splits_from = least.iter().skip(l + 1).step_by(classes).fold(f64::INFINITY, |a, b| a.min(*b));
        let splits_from = T::from_f64(splits_from);
        let least = |body: u16| &least[(usize::from(body) * classes).min(least.len() - classes)..][..classes];
        let runs = level.store.lists.first().map_or(0, |list| list.runs.len());
        let look = |b: usize| {
            let mut found = Vec::new();
            let block = level.store.blocks.get(b).copied();
            let nearby = |regions, margin| Nearby::new(regions, margin, l, block);
            let mut home = nearby(&self.regions, SPLIT_AHEAD);
            let mut behind = match candidates {
                Candidates::None => None,
                _ => Some(nearby(&self.regions, MERGE_BEHIND)),
            };
            let mut before = match candidates {
                Candidates::New(before) => Some(nearby(before, MERGE_BEHIND)),
                _ => None,
            };
            // No class below `behind` is tried that is not below `before`.
            let stays = || before.as_ref().zip(behind.as_ref()).is_some_and(|(a, b)| a.all.is_some() && a.all == b.all);
            let idle = behind.is_none() || stays();
            let all_home = home.all == Some(l);
            // As a rule a block has nothing to do, which its greatest particle tells.
            let is_calm = |list: &List<T>, run: Run| {
                let small = |chunk: usize| list.rest_plane(chunk, VOLUME).iter().all(|v| *v < splits_from);
                idle && all_home && (run.first..run.first + run.chunks()).all(small)
            };
            for (i, list) in level.store.lists.iter().enumerate() {
                if is_calm(list, list.runs[b]) {
                    continue;
                }
                for (chunk, lane) in list.runs[b].places() {
                    if list.id[chunk][lane] == PAD {
                        continue;
                    }
                    let at = || (list.cell_of(chunk, lane), list.offset_of(chunk, lane));
                    let home = home.all.unwrap_or_else(|| home.at(at()));
                    let (volume0, least) = (list.volume0_of(chunk, lane), least(list.body[chunk][lane]));
                    let mut may_merge = || {
                        behind.as_mut().is_some_and(|behind| volume0 < least[behind.at(at())])
                            && before.as_mut().is_none_or(|before| volume0 >= least[before.at(at())])
                    };
                    let action = if volume0 >= least[home + 1] {
                        Action::Split
                    } else if !idle && may_merge() {
                        Action::Merge
                    } else if home != l {
                        Action::Move
                    } else {
                        continue;
                    };
                    let class = least.partition_point(|&v| v <= volume0) as u32 - 1;
                    found.push(Found { level: l, list: i, chunk, lane, class, home, action });
                }
            }
            found
        };
        let found: Vec<Vec<Found>> = (0..runs).into_par_iter().map(look).collect();
        found.concat()
    }

    /// A particle on the level where it belongs.
    fn moved(&self, one: Found) -> (usize, Parcel) {
        let parcel = self.levels[one.level].store.lists[one.list].parcel(one.list, one.chunk, one.lane);
        self.settled(parcel, one.level)
    }

    /// A parcel with coordinates of level `from`, on the level where it belongs.
    pub(crate) fn settled(&self, mut parcel: Parcel, from: usize) -> (usize, Parcel) {
        let finest = finest_cell(parcel.cell, parcel.offset, from);
        let to = self.regions.finest_at(finest, SPLIT_AHEAD);
        for d in 0..3 {
            // Shifts of cell and offset: exact but for the last bit of an offset that becomes coarser.
            let within = parcel.offset[d] * f64::from(1 << from) - f64::from(finest[d] - (parcel.cell[d] << from));
            let along = f64::from(finest[d] & ((1 << to) - 1)) + within;
            parcel.cell[d] = finest[d] >> to;
            parcel.offset[d] = along / f64::from(1 << to);
        }
        (to, parcel)
    }

    /// A particle with its position relative to a cell of its level [m].
    fn particle(&self, parcel: &Parcel, origin: [i32; 3], h: f64) -> Particle {
        let x = Vector3::from_fn(|d, _| (f64::from(parcel.cell[d] - origin[d]) + parcel.offset[d]) * h);
        let planes = self.levels[0].store.lists[parcel.list].strain_planes();
        let mut particle = Particle {
            x,
            v: Vector3::from_column_slice(&parcel.motion[..3]),
            c: Matrix3::from_row_slice(&parcel.motion[3..]),
            mass: parcel.rest[MASS],
            volume0: parcel.rest[VOLUME],
            strain: [0.0; 9],
            state: [0.0; barchan_grid::transfer::MAX_STATE],
        };
        particle.strain[..planes].copy_from_slice(&parcel.rest[STRAIN..][..planes]);
        let n_state = self.levels[0].store.lists[parcel.list].law.table.n_state;
        particle.state[..n_state].copy_from_slice(&parcel.rest[STRAIN + planes..][..n_state]);
        particle
    }

    /// The other way round: the particle on the level where it belongs, as a number and body say.
    fn parcel_of(&self, p: &Particle, origin: [i32; 3], from: usize, like: &Parcel) -> (usize, Parcel) {
        let h = self.levels[from].h();
        let planes = self.levels[0].store.lists[like.list].strain_planes();
        let mut parcel = like.clone();
        for d in 0..3 {
            let along = p.x[d] / h;
            parcel.cell[d] = origin[d] + along.floor() as i32;
            parcel.offset[d] = along - along.floor();
            parcel.motion[d] = p.v[d];
            for e in 0..3 {
                parcel.motion[3 + 3 * d + e] = p.c[(d, e)];
            }
        }
        parcel.rest[MASS] = p.mass;
        parcel.rest[VOLUME] = p.volume0;
        parcel.rest[STRAIN..][..planes].copy_from_slice(&p.strain[..planes]);
        let n_state = self.levels[0].store.lists[like.list].law.table.n_state;
        parcel.rest[STRAIN + planes..][..n_state].copy_from_slice(&p.state[..n_state]);
        self.settled(parcel, from)
    }

    fn planes_of(&self, list: usize) -> (bool, Vec<u32>) {
        let list = &self.levels[0].store.lists[list];
        let states = &self.materials[list.material].material.states;
        (list.strain_planes() == 9, states.iter().map(|state| state.merge).collect())
    }

    /// Replaces a particle by its children, and these by theirs, until none is too coarse for where it is. `is_clear` says whether
    /// children at these places keep clear of tools; `None` if it cannot tell.
    fn split_up(&self, one: Found, is_clear: impl Fn(&[[f64; 3]; CHILDREN]) -> Option<bool>) -> Option<Family> {
        let h = self.levels[one.level].h();
        let parcel = self.levels[one.level].store.lists[one.list].parcel(one.list, one.chunk, one.lane);
        let (is_gradient, rules) = self.planes_of(one.list);
        let planes = Planes { is_gradient, merge: &rules };
        let origin = parcel.cell;
        let corner: [f64; 3] = origin.map(|c| f64::from(c) * h);
        let mut family = Family { parcels: Vec::new(), splits: 0 };
        let mut children = 0;
        let mut open = vec![(self.particle(&parcel, origin, h), one.class, None)];
        while let Some((particle, class, child)) = open.pop() {
            let at: [f64; 3] = std::array::from_fn(|d| particle.x[d] / h);
            let cell: [i32; 3] = std::array::from_fn(|d| origin[d] + at[d].floor() as i32);
            let finest = finest_cell(cell, at.map(|x| x - x.floor()), one.level);
            if class as usize <= self.regions.finest_at(finest, SPLIT_AHEAD) {
                let (level, parcel) = self.parcel_of(&particle, origin, one.level, &parcel);
                family.parcels.push((level, parcel, child));
                continue;
            }
            family.splits += 1;
            let mut tries = (0..5).map(|tries| split(&particle, planes, 0.5_f64.powi(tries)));
            let parts = loop {
                let Some(parts) = tries.next() else { break split(&particle, planes, f64::MIN_POSITIVE) };
                if is_clear(&parts.map(|part| std::array::from_fn(|d| corner[d] + part.x[d])))? {
                    break parts;
                }
            };
            for (k, part) in parts.into_iter().enumerate() {
                let number = if k == 0 { child } else { Some(children) };
                children += u32::from(k > 0);
                open.push((part, class - 1, number));
            }
        }
        Some(family)
    }

    /// So many new numbers in a row: the first.
    fn new_ids(&mut self, count: u64) -> Result<u32> {
        let first = self.next_id;
        let asked = first + count;
        if asked > u64::from(PAD) {
            return Err(Error::Capacity {
                what: "numbers for particles",
                asked,
                cap: u64::from(PAD),
                mend: "use fewer levels or agents that move less: each split takes seven new numbers",
            });
        }
        self.next_id = asked;
        Ok(first as u32)
    }

    /// Merges what can be merged, class by class. Returns those that cannot but have to change level.
    fn merge_all(
        &mut self,
        found: &[Found],
        couplings: &[Box<dyn Coupling>],
        tools: &[Aabb],
        coming: &mut Vec<(usize, Parcel)>,
        gone: &mut Vec<Found>,
    ) -> Vec<Found> {
        self.resampled.refused.clear();
        let candidates = self.candidates(found);
        let merging = Merging {
            candidates: &candidates,
            planes: (0..self.levels[0].store.lists.len()).map(|list| self.planes_of(list)).collect(),
            gravity: self.scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt(),
        };
        let mut merged = vec![false; candidates.len()];
        // Clusters at the surface first, since only some ways to cut it in cubes leave it whole; then bins, as the lattice lies; then
        // clusters of what is left over.
        for way in [Way::Surface, Way::Bins, Way::Rest] {
            let (sides, shift) = match way {
                Way::Bins => (1, 0),
                _ => (NEIGHBOURHOOD, (self.rounds % 8) as usize),
            };
            let free = (0..candidates.len()).into_par_iter().filter(|&i| !merged[i]);
            let mut binned: Vec<Binned> = free.map(|i| candidates[i].binned(i, sides, shift)).collect();
            binned.par_sort_unstable();
            let groups = binned.chunk_by(|a, b| (a.0, a.1, a.2, a.3) == (b.0, b.1, b.2, b.3));
            let groups: Vec<&[Binned]> = match way {
                Way::Surface => groups.filter(|group| group.iter().any(|one| candidates[one.5].at_surface)).collect(),
                _ => groups.collect(),
            };
            let try_group = |group: &&[Binned]| match way {
                Way::Bins => self.try_merge(&merging, group, false).into_iter().collect(),
                _ => self.clusters(&merging, group, shift, matches!(way, Way::Surface)),
            };
            let results: Vec<Vec<Result<Merged, Refusal>>> = groups.par_iter().map(try_group).collect();
            for result in results.into_iter().flatten() {
                match result {
                    Err(refusal) => *self.resampled.refused.entry(refusal).or_default() += 1,
                    Ok(one) if is_near_tool(&one, couplings, tools) => {}
                    Ok(one) => {
                        self.resampled.merges += 1;
                        self.resampled.merged += one.members.len() as u64;
                        self.resampled.kinetic += one.change.kinetic;
                        self.resampled.angular += one.change.angular;
                        for i in one.members {
                            merged[i] = true;
                            gone.push(candidates[i].found);
                        }
                        coming.push((one.level, one.parcel));
                    }
                }
            }
        }
        let left = candidates.iter().zip(merged).filter(|(_, merged)| !merged).map(|(one, _)| one.found);
        left.filter(|one| one.home != one.level).collect()
    }

    /// What merging needs to know of the particles that may merge.
    fn candidates(&self, found: &[Found]) -> Vec<Candidate> {
        let found: Vec<Found> = found.iter().filter(|one| one.action == Action::Merge).copied().collect();
        let surfaces: Vec<Surface> =
            found.chunk_by(|a, b| a.level == b.level).map(|here| self.surface(here[0].level, here)).collect();
        let bodies = self.scene.body.len().max(1);
        let finest_sides: Vec<f64> = (0..bodies).map(|body| self.finest_volume(body as u16).cbrt()).collect();
        let candidate = |&found: &Found| {
            let level = &self.levels[found.level];
            let (list, chunk, lane) = (&level.store.lists[found.list], found.chunk, found.lane);
            let (body, cell) = (list.body[chunk][lane], list.cell_of(chunk, lane));
            let surface = surfaces.iter().find(|surface| surface.level == found.level);
            Candidate {
                found,
                id: list.id[chunk][lane],
                body,
                x: list.position_of(chunk, lane, level.h()),
                volume0: list.volume0_of(chunk, lane),
                side: finest_sides[usize::from(body).min(bodies - 1)] * f64::from(1 << (found.class + 1)),
                at_surface: surface.is_none_or(|surface| surface.is_near(cell)),
            }
        };
        found.par_iter().map(candidate).collect()
    }

    /// Merges what stands together in a neighbourhood, wherever bins would end: about each particle, those with the least choice first,
    /// the cluster that is most like a cube; `only_surface` says whether only about particles there.
    fn clusters(
        &self,
        merging: &Merging<'_>,
        group: &[Binned],
        shift: usize,
        only_surface: bool,
    ) -> Vec<Result<Merged, Refusal>> {
        let candidate = |i: usize| &merging.candidates[group[i].5];
        let (side, bin) = (candidate(0).side, group[0].3);
        // In sides of the merged particle, with bins' faces at whole numbers.
        let width = i64::from(NEIGHBOURHOOD);
        let origin: [f64; 3] = std::array::from_fn(|d| (bin[d] * width - (shift >> d & 1) as i64 * width / 2) as f64);
        let loose_one = |i: usize| {
            let one = candidate(i);
            let x = Vector3::from_fn(|d, _| one.x[d] / side - origin[d]);
            (x, one.volume0 / side.powi(3), one.at_surface)
        };
        let mut loose = Loose::new((0..group.len()).map(loose_one).collect());
        let pairs = !only_surface && self.rounds.is_multiple_of(PATIENCE);
        let least = if pairs { 0.0 } else { *PORTION.start() };
        // At the surface anything less like a cube is refused anyway.
        let tolerance = self.scene.levels.tolerance;
        let strict = 4.0 * tolerance * (1.0 + tolerance);
        // The members of a cluster tend to find the same one.
        let mut refused: HashSet<Vec<usize>> = HashSet::new();
        let mut found = Vec::new();
        for seed in loose.seeds(only_surface) {
            let Some(members) = loose.cluster(seed, least, strict).filter(|members| !refused.contains(members)) else {
                continue;
            };
            let cluster: Vec<Binned> = members.iter().map(|&i| group[loose.number[i]]).collect();
            if let Some(Ok(one)) = self.try_merge(merging, &cluster, pairs) {
                members.iter().for_each(|&i| loose.free[i] = false);
                found.push(Ok(one));
            } else {
                refused.insert(members);
            }
        }
        found
    }

    /// Which cells of a level's blocks that hold such particles are next to one that is less than half full.
    fn surface(&self, l: usize, particles: &[Found]) -> Surface {
        let level = &self.levels[l];
        let block_of =
            |one: &Found| block::key(block::of_cell(level.store.lists[one.list].cell_of(one.chunk, one.lane)));
        let mut blocks: Vec<u64> = particles.iter().filter_map(block_of).collect();
        blocks.sort_unstable();
        blocks.dedup();
        let around = |&key: &u64| {
            let at = block::of_key(key);
            (0..27).filter_map(move |n| {
                let offset = block::offset(n);
                block::key(level.bounds.wrap(std::array::from_fn(|d| at[d] + offset[d])))
            })
        };
        let mut near: Vec<u64> = blocks.iter().flat_map(around).collect();
        near.sort_unstable();
        near.dedup();
        let filling = self.filling(l, &near);
        let cells = blocks.into_par_iter().map(|key| (key, self.near_surface(l, block::of_key(key), &filling)));
        Surface { level: l, cells: cells.collect() }
    }

    /// The cells of a block that have one around them that is less than half full, as bits.
    fn near_surface(&self, l: usize, at: [i32; 3], filling: &Filling) -> u64 {
        let bounds = &self.levels[l].bounds;
        let is_empty = |n: usize| {
            let local = [n / 36, n / 6 % 6, n % 6];
            let cell: [i32; 3] = std::array::from_fn(|d| {
                let c = at[d] * SIDE + local[d] as i32 - 1;
                // Behind a wall the ground goes on.
                let c = if bounds.walled[d][0] { c.max(bounds.min[d]) } else { c };
                if bounds.walled[d][1] { c.min(bounds.max[d] - 1) } else { c }
            });
            let key = block::key(bounds.wrap(block::of_cell(cell)));
            let full = key.and_then(|key| filling.get(&key)).map_or(0.0, |cells| cells[place(cell)]);
            f64::from(full) < EMPTY
        };
        let empty: [bool; 216] = std::array::from_fn(is_empty);
        let is_near = |n: &usize| {
            let around = |k: usize| (n / 16 + k / 9) * 36 + (n / 4 % 4 + k / 3 % 3) * 6 + n % 4 + k % 3;
            (0..27).any(|k| empty[around(k)])
        };
        (0..CELLS).filter(is_near).fold(0, |bits, n| bits | 1 << n)
    }

    /// Mass in each cell of a level, as a part of a full cell, by block; of these blocks, and some of what lies beside them.
    fn filling(&self, l: usize, near: &[u64]) -> Filling {
        let level = &self.levels[l];
        let volume = level.h().powi(3);
        let runs = level.store.lists.first().map_or(0, |list| list.runs.len());
        // Most particles are in their block; the others are added afterwards, in order.
        let fill = |b: usize| {
            let (mut cells, mut strays) = ([0f32; CELLS], Vec::new());
            for list in &level.store.lists {
                for (chunk, lane) in list.runs[b].places() {
                    if list.id[chunk][lane] == PAD {
                        continue;
                    }
                    let cell = list.cell_of(chunk, lane);
                    let part = (list.volume0_of(chunk, lane) / volume) as f32;
                    match block::key(block::of_cell(cell)) {
                        Some(key) if level.store.blocks.get(b) == Some(&key) => cells[place(cell)] += part,
                        Some(key) => strays.push((key, place(cell), part)),
                        None => {}
                    }
                }
            }
            (cells, strays)
        };
        let is_wanted = |&b: &usize| level.store.blocks.get(b).is_none_or(|key| near.binary_search(key).is_ok());
        let wanted: Vec<usize> = (0..runs).filter(is_wanted).collect();
        let filled: Vec<_> = wanted.par_iter().map(|&b| fill(b)).collect();
        let keyed =
            wanted.iter().zip(&filled).filter_map(|(&b, (cells, _))| Some((*level.store.blocks.get(b)?, *cells)));
        let mut filling: Filling = keyed.collect();
        for (key, cell, part) in filled.into_iter().flat_map(|(_, strays)| strays) {
            filling.entry(key).or_insert([0.0; CELLS])[cell] += part;
        }
        filling
    }

    /// One particle in place of a bin's, if they are neither too few nor too many, and alike. `None`: not this time.
    fn try_merge(&self, merging: &Merging<'_>, group: &[Binned], pairs: bool) -> Option<Result<Merged, Refusal>> {
        let members = || group.iter().map(|binned| &merging.candidates[binned.5]);
        let side = members().next()?.side;
        let volume: f64 = members().map(|one| one.volume0).sum();
        let least = if pairs { 0.0 } else { *PORTION.start() };
        if group.len() < 2 || volume < least * side.powi(3) || volume > PORTION.end() * side.powi(3) {
            return None;
        }
        let list = group[0].1;
        let near_surface = members().any(|one| one.at_surface);
        let members = || members().map(|one| one.found);
        // All as seen from the first one's cell, on the coarsest level among them.
        let level = members().map(|one| one.level).max()?;
        let h = self.levels[level].h();
        let parcels: Vec<Parcel> = members()
            .map(|one| {
                let mut parcel = self.levels[one.level].store.lists[one.list].parcel(list, one.chunk, one.lane);
                for d in 0..3 {
                    let within = f64::from(parcel.cell[d] & ((1 << (level - one.level)) - 1)) + parcel.offset[d];
                    parcel.cell[d] >>= level - one.level;
                    parcel.offset[d] = within / f64::from(1 << (level - one.level));
                }
                parcel
            })
            .collect();
        let origin = parcels[0].cell;
        let particles: Vec<Particle> = parcels.iter().map(|parcel| self.particle(parcel, origin, h)).collect();
        let (is_gradient, ref rules) = merging.planes[list];
        let planes = Planes { is_gradient, merge: rules };
        let tolerance = self.scene.levels.tolerance;
        let (one, change) = match merge(&particles, planes, merging.gravity, tolerance, near_surface) {
            Ok(merged) => merged,
            Err(refusal) => return Some(Err(refusal)),
        };
        let corner: [f64; 3] = origin.map(|c| f64::from(c) * h);
        let x: [f64; 3] = std::array::from_fn(|d| corner[d] + one.x[d]);
        let mut like = parcels[0].clone();
        like.id = parcels.iter().map(|parcel| parcel.id).min()?;
        let (level, parcel) = self.parcel_of(&one, origin, level, &like);
        // Angular momentum about the world's origin: the particles' own change, since momentum and centre stay.
        let members = group.iter().map(|binned| binned.5).collect();
        Some(Ok(Merged { level, parcel, change, members, x, clearance: AROUND_TOOL * side }))
    }
}

impl Candidate {
    /// In its bin, `sides` merged particles wide and moved by half of that along the axes of `shift`.
    fn binned(&self, i: usize, sides: u32, shift: usize) -> Binned {
        let side = self.side * f64::from(sides);
        let half = |d: usize| f64::from((shift >> d & 1) as u32) * 0.5;
        let bin = std::array::from_fn(|d| (self.x[d] / side + half(d)).floor() as i64);
        (self.found.class, self.found.list, self.body, bin, self.id, i)
    }
}

/// Cells of a level next to one that is less than half full: bits by block.
struct Surface {
    level: usize,
    cells: HashMap<u64, u64, BuildHasherDefault<KeyHasher>>,
}

impl Surface {
    fn is_near(&self, cell: [i32; 3]) -> bool {
        let bits = block::key(block::of_cell(cell)).and_then(|key| self.cells.get(&key));
        bits.is_none_or(|bits| bits >> place(cell) & 1 == 1)
    }
}

/// The levels to which the cells of a block and those next to it belong.
struct Nearby<'a> {
    regions: &'a Regions,
    margin: i32,
    /// Level of the block, and its first cell less 1: particles may have drifted out of it by a cell.
    level: usize,
    first: Option<[i32; 3]>,
    /// The level of all of them, if it is one.
    all: Option<usize>,
    /// Levels of the cells that have been asked for.
    known: [u8; 216],
}

impl<'a> Nearby<'a> {
    const UNKNOWN: u8 = u8::MAX;

    fn new(regions: &'a Regions, margin: i32, level: usize, block: Option<u64>) -> Self {
        let first = block.map(|key| block::of_key(key).map(|c| c * SIDE - 1));
        let all = first.and_then(|first| {
            let cells = CellBox { min: first.map(|c| c << level), max: first.map(|c| (c + SIDE + 2) << level) };
            regions.finest(cells, margin)
        });
        Self { regions, margin, level, first, all, known: [Self::UNKNOWN; 216] }
    }

    /// The level at an offset in a cell.
    fn at(&mut self, (cell, offset): ([i32; 3], [f64; 3])) -> usize {
        if let Some(all) = self.all {
            return all;
        }
        let local = self.first.map(|first| std::array::from_fn::<i32, 3, _>(|d| cell[d] - first[d]));
        let Some(local) = local.filter(|local| local.iter().all(|c| (0..6).contains(c))) else {
            return self.regions.finest_at(finest_cell(cell, offset, self.level), self.margin);
        };
        let known = &mut self.known[(local[0] * 36 + local[1] * 6 + local[2]) as usize];
        if *known == Self::UNKNOWN {
            let cells = CellBox { min: cell.map(|c| c << self.level), max: cell.map(|c| (c + 1) << self.level) };
            match self.regions.finest(cells, self.margin) {
                Some(level) => *known = level as u8,
                None => return self.regions.finest_at(finest_cell(cell, offset, self.level), self.margin),
            }
        }
        usize::from(*known)
    }
}

/// How candidates are put together.
#[derive(Clone, Copy)]
enum Way {
    /// In clusters about particles at the surface.
    Surface,
    /// In bins that lie as the lattice lies.
    Bins,
    /// In clusters, what is left over.
    Rest,
}

/// Particles of a neighbourhood that look for partners, by cubes of one side.
struct Loose {
    /// Places, in sides of the merged particle.
    x: Vec<Vector3<f64>>,
    /// Rest volumes over that of the merged particle, and the second moment of each as a cube, per mass.
    volume: Vec<f64>,
    own: Vec<f64>,
    /// Are they at the surface?
    surface: Vec<bool>,
    free: Vec<bool>,
    /// Their numbers in the group that they came in.
    number: Vec<usize>,
    /// Where each cube's begin.
    starts: Vec<usize>,
}

impl Loose {
    /// From places, volumes and whether they are at the surface.
    fn new(particles: Vec<(Vector3<f64>, f64, bool)>) -> Self {
        let mut starts = vec![0; (NEIGHBOURHOOD as usize).pow(3) + 1];
        let cubes: Vec<usize> = particles.iter().map(|(x, ..)| Self::index(Self::cube(x))).collect();
        cubes.iter().for_each(|cube| starts[cube + 1] += 1);
        (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
        let mut number: Vec<usize> = (0..particles.len()).collect();
        number.sort_by_key(|&i| cubes[i]);
        let volume: Vec<f64> = number.iter().map(|&i| particles[i].1).collect();
        Self {
            x: number.iter().map(|&i| particles[i].0).collect(),
            own: volume.iter().map(|volume| volume.cbrt().powi(2) / 12.0).collect(),
            volume,
            surface: number.iter().map(|&i| particles[i].2).collect(),
            free: vec![true; particles.len()],
            number,
            starts,
        }
    }

    fn cube(x: &Vector3<f64>) -> [usize; 3] {
        // What rounding puts outside belongs to the outermost cubes.
        std::array::from_fn(|d| (x[d].max(0.0) as usize).min(NEIGHBOURHOOD as usize - 1))
    }

    fn index(cube: [usize; 3]) -> usize {
        (cube[0] * NEIGHBOURHOOD as usize + cube[1]) * NEIGHBOURHOOD as usize + cube[2]
    }

    /// Runs of particles that may be less than a side away from one.
    fn around(&self, i: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
        let cube = Self::cube(&self.x[i]);
        let [x, y, z] = cube.map(|c| c.saturating_sub(1)..=(c + 1).min(NEIGHBOURHOOD as usize - 1));
        let rows = x.flat_map(move |x| y.clone().map(move |y| (x, y)));
        rows.map(move |(x, y)| {
            self.starts[Self::index([x, y, *z.start()])]..self.starts[Self::index([x, y, *z.end()]) + 1]
        })
    }

    /// Particles in the order in which they look for partners: those with the least choice first, and in the group's order.
    fn seeds(&self, only_surface: bool) -> Vec<usize> {
        let wanted = (0..self.x.len()).filter(|&i| !only_surface || self.surface[i]);
        let choice = |i: usize| -> usize {
            let x = self.x[i];
            self.around(i)
                .map(|run| self.x[run].iter().map(|y| usize::from((y - x).norm_squared() < 1.0)).sum::<usize>())
                .sum()
        };
        let mut seeds: Vec<(usize, usize, usize)> = wanted.map(|i| (choice(i), self.number[i], i)).collect();
        seeds.sort_unstable();
        seeds.into_iter().map(|(.., i)| i).collect()
    }

    /// Of the clusters about a particle's eight corners, with at least so much volume, the one most like the merged cube, and as bins lie
    /// where that is a tie; at the surface no less like it than `strict`. In the group's order.
    fn cluster(&self, seed: usize, least: f64, strict: f64) -> Option<Vec<usize>> {
        if !self.free[seed] {
            return None;
        }
        let is_near = |i: &usize| self.free[*i] && (self.x[*i] - self.x[seed]).norm_squared() < 1.0;
        let near: Vec<usize> = self.around(seed).flatten().filter(is_near).collect();
        if near.len() < 2 || self.sum(&near) < least {
            return None;
        }
        let mut best: Option<(f64, Vec<usize>)> = None;
        let mut members: Vec<usize> = Vec::with_capacity(near.len());
        for corner in 0..8 {
            let towards = |d: usize| if corner >> d & 1 == 1 { 0.25 } else { -0.25 };
            let mut centre = self.x[seed] + Vector3::from_fn(|d, _| towards(d));
            let mut volume = 0.0;
            // Turned matter has its cubes' centres elsewhere: go there.
            for _ in 0..2 {
                members.clear();
                members.extend(near.iter().filter(|&&i| (self.x[i] - centre).norm_squared() < REACH * REACH));
                let moment: Vector3<f64> = members.iter().map(|&i| self.x[i] * self.volume[i]).sum();
                volume = self.sum(&members);
                centre = moment / volume;
            }
            if members.len() < 2 || volume < least || volume > *PORTION.end() {
                continue;
            }
            let mut spread = Matrix3::zeros();
            for &i in &members {
                let arm = self.x[i] - centre;
                spread +=
                    (arm * arm.transpose() + Matrix3::from_diagonal_element(self.own[i])) * (self.volume[i] / volume);
            }
            let unlike_cube = (spread * (12.0 / volume.cbrt().powi(2)) - Matrix3::identity()).norm();
            let off_bin = centre.map(|x| x - x.floor() - 0.5).norm();
            let score = unlike_cube + (volume - 1.0).abs() + 0.1 * off_bin;
            let bearable = if members.iter().any(|&i| self.surface[i]) { strict } else { SHAPELESS };
            if unlike_cube <= bearable && best.as_ref().is_none_or(|(least, _)| score < *least) {
                best = Some((score, members.clone()));
            }
        }
        let (_, mut members) = best?;
        members.sort_unstable_by_key(|&i| self.number[i]);
        Some(members)
    }

    fn sum(&self, members: &[usize]) -> f64 {
        members.iter().map(|&i| self.volume[i]).sum()
    }
}

/// A merged particle, the level where it belongs, and what that cost.
struct Merged {
    level: usize,
    parcel: Parcel,
    change: Change,
    /// Whose place it takes, by their numbers among the candidates.
    members: Vec<usize>,
    /// Where it is, and how far from tools it has to be [m].
    x: [f64; 3],
    clearance: f64,
}

/// What a particle was split into: where each belongs, and which of the new numbers it gets; `None`: its parent's.
struct Family {
    parcels: Vec<(usize, Parcel, Option<u32>)>,
    splits: u64,
}

/// Are all the places out of tools' boxes?
fn is_away(places: &[[f64; 3]; CHILDREN], tools: &[Aabb]) -> bool {
    !tools.iter().any(|tool| places.iter().any(|x| tool.contains(*x)))
}

/// Does a tool come so near that particles stay fine?
fn is_near_tool(one: &Merged, couplings: &[Box<dyn Coupling>], tools: &[Aabb]) -> bool {
    tools.iter().any(|tool| tool.grown(one.clearance).contains(one.x))
        && couplings.iter().any(|c| c.distance(&[one.x])[0] < one.clearance)
}

/// The finest level's cell that holds a particle.
fn finest_cell(cell: [i32; 3], offset: [f64; 3], level: usize) -> [i32; 3] {
    std::array::from_fn(|d| {
        let within = (offset[d] * f64::from(1 << level)).floor() as i32;
        (cell[d] << level) + within.min((1 << level) - 1)
    })
}

/// Where a cell stands in its block.
fn place(cell: [i32; 3]) -> usize {
    let local = cell.map(|c| (c & 3) as usize);
    local[0] * 16 + local[1] * 4 + local[2]
}
