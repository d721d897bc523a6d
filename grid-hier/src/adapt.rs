//! Moves levels after their agents: which particles change level, are split, or merge.
//!
//! A particle's class is its size: 2^class lattice points of its body along a side. Class l is the size that belongs to
//! level l. A region grown by one parent cell holds nothing coarser than its level. Particles finer than needed merge
//! once they are three parent cells away, or two where a region has moved on. In between, particles stay as they are, so
//! an agent that trembles changes nothing.
//!
//! A round is [`find`](Adapt::find), which lists the particles concerned, then [`apply`](Adapt::apply). Backends pass
//! their levels as [`LevelStore`]s. A backend whose particles are elsewhere, such as on a device, passes copies of
//! those that a round may concern, as [`CopiedLevel`]s.

mod agents;
mod away;
mod clusters;
mod copied;
mod nearby;
mod parcel;
pub mod replay;

pub use copied::CopiedLevel;
pub use parcel::Parcel;

use crate::bounds::Bounds;
use crate::resample::{CHILDREN, Change, Particle, Refusal, merge, split};
use barchan_core::levels::{Agent, MERGE_BEHIND, MERGE_LEFT, SPLIT_AHEAD};
use barchan_core::plan::Precision;
use barchan_core::{Aabb, Coupling, Error, Ledger, LevelChange, LevelPhase, ParticleList, Plan, Regions, Result};
use barchan_lanes::Isa;
use clusters::{Binned, Candidate, Loose, NEIGHBOURHOOD, Near, PORTION};
use nalgebra::Vector3;
use nearby::{Nearby, Surface};
use parcel::{Material, coarsened, finest_cell, moved};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashSet};

/// Rounds after which what has found no partners may merge in pairs, so that leftovers do not add up.
const PATIENCE: u64 = 4;
/// Rounds without a try after which everything that is finer than need be is tried again.
const STILL_ROUNDS: u64 = 32;
/// Rounds after which it is even while regions move: it looks at footprints too, which are refused as a rule.
const MERGE_ROUNDS: u64 = 128;
/// Cells around a tool, in sides of the merged particle, in which nothing merges: no tool comes to stand inside a particle.
const AROUND_TOOL: f64 = 2.0;
/// Particles' numbers are less than this.
pub(crate) const IDS: u64 = u32::MAX as u64;
/// What to do where splits have used them up.
const FEWER_SPLITS: &str = "use fewer levels or agents that move less: each split takes seven new numbers";

/// Access to the particles of one level for split and merge: lists by material, in groups that are the same for all
/// lists. The order of groups and of places decides the numbers of children and the last bits of results.
pub trait LevelStore: Send + Sync {
    /// Keys of the blocks of the first groups, in rising order. No particle is more than a cell outside its block.
    fn blocks(&self) -> &[u64];
    /// Number of groups. Groups after those of the blocks hold particles that are in no block yet.
    fn groups(&self) -> usize;
    /// Places of the particles of a list in a group.
    fn places(&self, list: usize, group: usize) -> impl Iterator<Item = usize>;
    /// Greatest rest volume of a particle of a list in a group, 0 if there is none [m³].
    fn greatest_volume(&self, list: usize, group: usize) -> f64;
    /// A particle's number.
    fn id(&self, list: usize, place: usize) -> u32;
    /// Index of its body in the scene.
    fn body(&self, list: usize, place: usize) -> u16;
    /// Its cell.
    fn cell(&self, list: usize, place: usize) -> [i32; 3];
    /// Where it is in its cell, [0, 1).
    fn offset(&self, list: usize, place: usize) -> [f64; 3];
    /// Its rest volume [m³].
    fn volume0(&self, list: usize, place: usize) -> f64;
    /// A copy of it.
    fn parcel(&self, list: usize, place: usize) -> Parcel;
    /// Removes particles of a list. All other places stay valid.
    fn remove(&mut self, list: usize, places: impl Iterator<Item = usize>);
    /// Adds particles, in the order of lists and numbers. They are in no block yet.
    fn push(&mut self, parcels: &[&Parcel]);
    /// For each of some blocks, the cells that are at least half full, as bits. `volume` is a cell's volume [m³]; block
    /// keys rise.
    fn filled(&self, lists: usize, blocks: &[u64], volume: f64) -> Vec<u64>
    where
        Self: Sized,
    {
        nearby::filled(self, lists, blocks, volume)
    }
}

/// Nested levels of one world: their regions, and what split and merge keep from round to round.
#[derive(Clone)]
pub struct Adapt {
    /// Where the levels are.
    pub regions: Regions,
    /// Number of the next new particle.
    pub next_id: u64,
    /// What the levels follow.
    agents: Vec<Agent>,
    /// Rounds since the start, and the last of them in which anything could merge.
    rounds: u64,
    tried: u64,
    resampled: Resampled,
    /// What particles have gone through since that was asked for.
    changes: Vec<LevelChange>,
    /// Cell width of each level [m], and where the world ends there.
    widths: Vec<f64>,
    bounds: Vec<Bounds>,
    /// Rest volume of each body's particles on the finest level [m³].
    finest_volume: Vec<f64>,
    materials: Vec<Material>,
    /// Size of gravity [m/s²].
    gravity: f64,
    tolerance: f64,
    precision: Precision,
    isa: Isa,
}

/// What splits and merges have done since the start.
#[derive(Clone, Debug, Default)]
struct Resampled {
    moves: u64,
    splits: u64,
    merged: u64,
    merges: u64,
    kinetic: f64,
    angular: Vector3<f64>,
    /// Groups that were refused in the last round.
    refused: BTreeMap<Refusal, u64>,
}

/// What is to happen to a particle.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Action {
    Move,
    Split,
    Merge,
}

/// Which of the particles that are finer than needed may merge in a round.
#[derive(Clone, Copy, Debug)]
pub enum Candidates<'a> {
    /// None.
    None,
    /// Those that had to be as fine as they are in these regions.
    New(&'a Regions),
    /// All of them.
    All,
}

/// A particle that something is to happen to.
#[derive(Clone, Copy)]
struct Found {
    level: usize,
    list: usize,
    place: usize,
    class: u32,
    /// Level where it belongs.
    home: usize,
    action: Action,
}

/// What a round will do.
pub struct Round {
    found: Vec<Found>,
    /// Was anything tried to be merged?
    merges: bool,
    levels: usize,
}

impl Round {
    /// The levels that particles may leave or enter. With subcycling, strain lags behind by one step: these levels'
    /// strain must be brought up to date before the round is applied.
    pub fn concerned(&self) -> Vec<bool> {
        let mut concerned = vec![false; self.levels];
        for one in &self.found {
            match one.action {
                Action::Move => (concerned[one.level], concerned[one.home]) = (true, true),
                // Children and merged particles may belong on any level.
                Action::Split | Action::Merge => concerned.fill(true),
            }
        }
        concerned
    }
}

/// What a particle was split into.
struct Family {
    /// Each with the level where it belongs.
    parcels: Vec<(usize, Parcel)>,
    /// Which of the new numbers each gets; `None`: its parent's.
    children: Vec<Option<u32>>,
    /// Each split: by the same numbers, who and into whom, and how far these are from its middle.
    splits: Vec<(Option<u32>, [Option<u32>; CHILDREN], f64)>,
}

/// A merged particle with the level where it belongs, and what that cost.
struct Merged {
    parcel: (usize, Parcel),
    change: Change,
    /// Whose place it takes, by their numbers among the candidates, and by their own.
    members: Vec<usize>,
    ids: Vec<u32>,
    /// Where it is, and how far from tools it has to be [m].
    x: [f64; 3],
    clearance: f64,
}

/// What those that may merge have come to.
#[derive(Default)]
struct Merging {
    merged: Vec<Merged>,
    /// Those that have merged, and those that have not but must change level.
    gone: Vec<Found>,
    left: Vec<Found>,
    /// Groups that were refused.
    refused: BTreeMap<Refusal, u64>,
}

/// How candidates are put together.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Way {
    /// In clusters about particles at the surface.
    Surface,
    /// In bins that lie as the lattice lies.
    Bins,
    /// In clusters, what is left over.
    Rest,
}

impl Adapt {
    /// The levels of a plan at the start.
    pub fn new(plan: &Plan) -> Self {
        let scene = &plan.scene;
        Self {
            regions: plan.regions.clone(),
            next_id: 0,
            agents: plan.agents.clone(),
            rounds: 0,
            tried: 0,
            resampled: Resampled::default(),
            changes: Vec::new(),
            widths: plan.cell_widths.clone(),
            bounds: (0..plan.cell_widths.len()).map(|level| Bounds::new(plan, level)).collect(),
            finest_volume: finest_volumes(plan),
            materials: plan.materials.iter().map(Material::of).collect(),
            gravity: scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt(),
            tolerance: scene.levels.tolerance,
            precision: plan.precision,
            isa: plan.isa,
        }
    }

    /// What a snapshot stores of the levels; `None` if there is only one level. `live` are the tiles within reach.
    pub fn phase(&self, live: BTreeSet<[i32; 2]>) -> Option<LevelPhase> {
        (self.widths.len() > 1).then(|| LevelPhase {
            boxes: self.regions.boxes().to_vec(),
            next_id: self.next_id,
            rounds: self.rounds,
            tried: self.tried,
            live,
        })
    }

    /// Takes over the levels of a saved run.
    pub fn restore(&mut self, phase: LevelPhase) {
        self.regions.restore(phase.boxes);
        (self.rounds, self.tried) = (phase.rounds, phase.tried);
        self.next_id = phase.next_id.max(self.next_id);
    }

    /// Continues the sums of splits and merges of the engine before this one.
    pub fn carry_on(&mut self, sums: &Ledger) {
        let (kinetic, angular) = (sums.resampled_kinetic, sums.resampled_angular_momentum.into());
        self.resampled = Resampled { kinetic, angular, ..Resampled::default() };
    }

    /// Counts particles that have merged elsewhere, and what they have merged into.
    pub fn count_merged(&mut self, [merged, merges]: [u64; 2]) {
        self.resampled.merged += merged;
        self.resampled.merges += merges;
    }

    /// Takes note of particles that go out of reach.
    pub(crate) fn leave<'a>(&mut self, ids: impl Iterator<Item = &'a u64>) {
        self.changes.extend(ids.map(|id| LevelChange::Leave { id: *id as u32 }));
    }

    /// Takes note of particles that come within reach, each with its level.
    pub(crate) fn come(&mut self, parcels: &[(usize, Parcel)]) {
        for (level, width) in self.widths.iter().enumerate() {
            for (m, material) in self.materials.iter().enumerate() {
                let own = parcels.iter().filter(|(to, parcel)| *to == level && parcel.list == m);
                let own: Vec<&Parcel> = own.map(|(_, parcel)| parcel).collect();
                if !own.is_empty() {
                    let mut list = ParticleList::empty(level, m, *width, material.strain, material.rules.len());
                    Parcel::add_all(&own, &mut list);
                    self.changes.push(LevelChange::Come(Box::new(list)));
                }
            }
        }
    }

    /// What particles have gone through since this was asked for last.
    pub fn take_changes(&mut self) -> Vec<LevelChange> {
        std::mem::take(&mut self.changes)
    }

    /// Adds what splits and merges have done since the start to the ledger.
    pub fn account(&self, ledger: &mut Ledger) {
        let done = &self.resampled;
        ledger.count("particles that changed level", done.moves);
        ledger.count("particles split", done.splits);
        ledger.count("particles merged", done.merged);
        ledger.count("particles that merging left", done.merges);
        for (why, &count) in &done.refused {
            ledger.count(&format!("groups kept apart since {} now", why.name()), count);
        }
        ledger.resampled_kinetic += done.kinetic;
        for d in 0..3 {
            ledger.resampled_angular_momentum[d] += done.angular[d];
        }
    }

    /// Which particles may merge in the next round. `before` are the former regions, if any region has moved: particles
    /// that no longer need to be as fine may then merge. Clusters that were refused are tried again now and then.
    pub fn candidates<'a>(&self, before: Option<&'a Regions>) -> Candidates<'a> {
        let round = self.rounds + 1;
        match before {
            _ if round.is_multiple_of(MERGE_ROUNDS) || round >= self.tried + STILL_ROUNDS => Candidates::All,
            Some(before) => Candidates::New(before),
            None => Candidates::None,
        }
    }

    /// Finds particles that have to change level or split, or may merge. `before` are the former regions, if any region
    /// has moved. While regions stay, only levels marked in `stirred` are searched: in the others, particles must not
    /// have moved by much of a cell since the last search.
    pub fn find<S: LevelStore>(&mut self, levels: &[&S], before: Option<&Regions>, stirred: &[bool]) -> Round {
        let candidates = self.candidates(before);
        self.rounds += 1;
        let merges = !matches!(candidates, Candidates::None);
        if merges {
            self.tried = self.rounds;
        }
        let looked_at = (0..levels.len()).into_par_iter().filter(|&l| stirred[l] || merges);
        let found: Vec<_> = looked_at.map(|l| self.find_on(l, levels[l], candidates)).collect();
        Round { found: found.concat(), merges, levels: levels.len() }
    }

    /// Splits, merges and moves what a round has found, and puts every particle on its level. Returns which levels have
    /// lost or gained particles; these must be sorted.
    ///
    /// # Errors
    /// [`Error::Capacity`] if there are no numbers left for new particles.
    pub fn apply<S: LevelStore>(
        &mut self,
        levels: &mut [&mut S],
        round: &Round,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<Vec<bool>> {
        let shown: Vec<&S> = levels.iter().map(|level| &**level).collect();
        let of = |action: Action| round.found.iter().filter(move |one| one.action == action).copied().collect();
        let [splitting, moving, merging]: [Vec<Found>; 3] = [Action::Split, Action::Move, Action::Merge].map(of);
        let tools: Vec<Aabb> = couplings.iter().flat_map(|c| c.bounds()).collect();
        let move_all = |some: &[Found]| -> Vec<(usize, Parcel)> {
            let moved = |one: &Found| self.settled(shown[one.level].parcel(one.list, one.place), one.level);
            some.par_iter().map(moved).collect()
        };
        // Neighbourhoods in which particles merge are few: beside them there is time for the others.
        let ((mut families, moved), (merging, left)) = rayon::join(
            || (self.split_all(&shown, &splitting, couplings, &tools), move_all(&moving)),
            || {
                let merging = round.merges.then(|| self.merge_all(&shown, merging, couplings, &tools));
                let left = merging.as_ref().map(|merging| move_all(&merging.left));
                (merging, left.unwrap_or_default())
            },
        );
        self.number(&mut families)?;
        let Merging { merged, gone, left: unmerged, refused } = merging.unwrap_or_default();
        if round.merges {
            self.resampled.refused = refused;
        }
        self.resampled.moves += (moved.len() + left.len()) as u64;
        self.resampled.merges += merged.len() as u64;
        for one in &merged {
            self.changes.push(LevelChange::Merge { members: one.ids.clone() });
            self.resampled.merged += one.members.len() as u64;
            self.resampled.kinetic += one.change.kinetic;
            self.resampled.angular += one.change.angular;
        }

        let children = families.par_iter().flat_map_iter(|family| &family.parcels);
        let come = children.chain(&moved).chain(&left).chain(merged.par_iter().map(|one| &one.parcel));
        // By level, list and number.
        let key = |(level, parcel): &(usize, Parcel)| {
            (*level as u64) << 56 | (parcel.list as u64) << 32 | u64::from(parcel.id)
        };
        let mut come: Vec<_> = come.map(|one| (key(one), &one.1)).collect();
        come.par_sort_unstable_by_key(|(key, _)| *key);
        let level = |key: u64| (key >> 56) as u32;
        self.changes.extend(come.chunk_by(|a, b| level(a.0) == level(b.0)).map(|settled| LevelChange::Move {
            ids: settled.iter().map(|(_, parcel)| parcel.id).collect(),
            to: level(settled[0].0),
        }));
        let gone = [splitting, moving, gone, unmerged];
        let exchange = |(l, level): (usize, &mut &mut S)| {
            let mut changed = false;
            for here in gone.iter().flat_map(|some| some.chunk_by(|a, b| (a.level, a.list) == (b.level, b.list))) {
                if here[0].level == l {
                    changed = true;
                    level.remove(here[0].list, here.iter().map(|one| one.place));
                }
            }
            let before = |l: usize| come.partition_point(|(key, _)| (*key >> 56) < l as u64);
            let parcels: Vec<&Parcel> = come[before(l)..before(l + 1)].iter().map(|(_, parcel)| *parcel).collect();
            if !parcels.is_empty() {
                level.push(&parcels);
            }
            changed || !parcels.is_empty()
        };
        let changed = levels.par_iter_mut().enumerate().map(exchange).collect();
        Ok(changed)
    }

    /// Particles of a level that have to move, split or may merge, in the order of its groups.
    fn find_on<S: LevelStore>(&self, l: usize, level: &S, candidates: Candidates<'_>) -> Vec<Found> {
        // Particles of class c have from 8^c / √8 of their body's finest volume up to √8 · 8^c.
        let classes = self.widths.len() + 1;
        let least_of = |&finest: &f64| (0..classes).map(move |class| least_volume(finest, class));
        let least: Vec<f64> = self.finest_volume.iter().flat_map(least_of).collect();
        let splits_from = least.iter().skip(l + 1).step_by(classes).fold(f64::INFINITY, |a, b| a.min(*b));
        let least = |body: u16| &least[(usize::from(body) * classes).min(least.len() - classes)..][..classes];
        let look = |group: usize| {
            let mut found = Vec::new();
            let nearby = |regions, margin| Nearby::new(regions, margin, l, level.blocks().get(group).copied());
            let mut home = nearby(&self.regions, SPLIT_AHEAD);
            let mut behind = match candidates {
                Candidates::None => None,
                Candidates::New(_) => Some(nearby(&self.regions, MERGE_LEFT)),
                Candidates::All => Some(nearby(&self.regions, MERGE_BEHIND)),
            };
            let mut before = match candidates {
                Candidates::New(before) => Some(nearby(before, MERGE_LEFT)),
                _ => None,
            };
            // No class below `behind` is tried that is not below `before`.
            let stays = || before.as_ref().zip(behind.as_ref()).is_some_and(|(a, b)| a.all.is_some() && a.all == b.all);
            let idle = behind.is_none() || stays();
            // As a rule a block has nothing to do, which its greatest particle tells.
            let is_quiet = idle && home.all == Some(l);
            for list in 0..self.materials.len() {
                if is_quiet && level.greatest_volume(list, group) < splits_from {
                    continue;
                }
                for place in level.places(list, group) {
                    let at = || (level.cell(list, place), level.offset(list, place));
                    let home = home.all.unwrap_or_else(|| home.at(at()));
                    let (volume0, least) = (level.volume0(list, place), least(level.body(list, place)));
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
                    found.push(Found { level: l, list, place, class, home, action });
                }
            }
            found
        };
        let found: Vec<Vec<Found>> = (0..level.groups()).into_par_iter().map(look).collect();
        found.concat()
    }

    /// Moves a parcel with coordinates of level `from` to the level where it belongs.
    pub fn settled(&self, parcel: Parcel, from: usize) -> (usize, Parcel) {
        let to = self.regions.finest_at(finest_cell(parcel.cell, parcel.offset, from), SPLIT_AHEAD);
        (to, moved(parcel, from, to))
    }

    /// A parcel of a particle on the level where it belongs, with the number and body of another.
    fn parcel_of(&self, p: &Particle, origin: [i32; 3], from: usize, like: &Parcel) -> (usize, Parcel) {
        self.settled(self.materials[like.list].parcel(p, origin, self.widths[from], like), from)
    }

    /// Splits particles. The children have no numbers yet.
    fn split_all<S: LevelStore>(
        &self,
        levels: &[&S],
        splitting: &[Found],
        couplings: &[Box<dyn Coupling>],
        tools: &[Aabb],
    ) -> Vec<Family> {
        // Tools are asked only about what is near them.
        let is_clear = |places: &[[f64; 3]; CHILDREN]| {
            !tools.iter().any(|tool| places.iter().any(|x| tool.contains(*x)))
                || couplings.iter().all(|c| c.distance(places).iter().all(|d| *d >= 0.0))
        };
        let split = |one: &Found| self.split_up(levels[one.level], one, is_clear);
        splitting.par_iter().map(split).collect()
    }

    /// Gives children their numbers, in the order of their parents' numbers: so they are the same in whatever order a backend holds particles.
    fn number(&mut self, families: &mut [Family]) -> Result<()> {
        families.par_sort_unstable_by_key(|family| family.parcels.first().map(|(_, parent)| parent.id));
        for family in families {
            let splits = family.splits.len() as u64;
            self.resampled.splits += splits;
            let first = self.new_ids(splits * (CHILDREN as u64 - 1), 0, FEWER_SPLITS)?;
            let parent = family.parcels.first().map_or(first, |(_, parent)| parent.id);
            let number = |child: Option<u32>| child.map_or(parent, |child| first + child);
            let changes = family.splits.iter();
            self.changes.extend(changes.map(|&(one, children, scale)| LevelChange::Split {
                id: number(one),
                children: children.map(number),
                scale,
            }));
            for (child, (_, parcel)) in family.children.iter().zip(&mut family.parcels) {
                parcel.id = number(*child);
            }
        }
        Ok(())
    }

    /// Replaces a particle by its children, and these by theirs, until none is too coarse for where it is. `is_clear` says whether
    /// children at these places keep clear of tools.
    fn split_up<S: LevelStore>(
        &self,
        level: &S,
        one: &Found,
        is_clear: impl Fn(&[[f64; 3]; CHILDREN]) -> bool,
    ) -> Family {
        let h = self.widths[one.level];
        let parcel = level.parcel(one.list, one.place);
        let planes = self.materials[one.list].planes();
        let origin = parcel.cell;
        let corner: [f64; 3] = origin.map(|c| f64::from(c) * h);
        let mut family = Family { parcels: Vec::new(), children: Vec::new(), splits: Vec::new() };
        let mut children = 0;
        let mut open = vec![(self.materials[one.list].particle(&parcel, origin, h), one.class, None)];
        while let Some((particle, class, child)) = open.pop() {
            let at: [f64; 3] = std::array::from_fn(|d| particle.x[d] / h);
            let cell: [i32; 3] = std::array::from_fn(|d| origin[d] + at[d].floor() as i32);
            let finest = finest_cell(cell, at.map(|x| x - x.floor()), one.level);
            if class as usize <= self.regions.finest_at(finest, SPLIT_AHEAD) {
                family.parcels.push(self.parcel_of(&particle, origin, one.level, &parcel));
                family.children.push(child);
                continue;
            }
            let mut tries = (0..5).map(|tries| 0.5_f64.powi(tries));
            let (scale, parts) = loop {
                let scale = tries.next();
                let parts = split(&particle, planes, scale.unwrap_or(f64::MIN_POSITIVE));
                if scale.is_none() || is_clear(&parts.map(|part| std::array::from_fn(|d| corner[d] + part.x[d]))) {
                    break (scale.unwrap_or(f64::MIN_POSITIVE), parts);
                }
            };
            let numbers: [_; CHILDREN] =
                std::array::from_fn(|k| if k == 0 { child } else { Some(children + k as u32 - 1) });
            children += CHILDREN as u32 - 1;
            family.splits.push((child, numbers, scale));
            open.extend(parts.into_iter().zip(numbers).map(|(part, number)| (part, class - 1, number)));
        }
        family
    }

    /// So many new numbers in a row, at `least` or beyond: the first. `mend` says what to do where there are no more.
    ///
    /// # Errors
    /// [`Error::Capacity`] then.
    pub fn new_ids(&mut self, count: u64, least: u64, mend: &'static str) -> Result<u32> {
        let first = self.next_id.max(least);
        let asked = first + count;
        if asked > IDS {
            return Err(Error::Capacity { what: "numbers for particles", asked, cap: IDS, mend });
        }
        self.next_id = asked;
        Ok(first as u32)
    }

    /// Merges what can be merged, class by class.
    fn merge_all<S: LevelStore>(
        &self,
        levels: &[&S],
        found: Vec<Found>,
        couplings: &[Box<dyn Coupling>],
        tools: &[Aabb],
    ) -> Merging {
        let mut merging = Merging::default();
        let candidates = self.those_that_merge(levels, found);
        let mut merged = vec![false; candidates.len()];
        // Clusters at the surface first, since only some ways to cut it in cubes leave it whole; then bins, as the lattice lies; then
        // clusters of what is left over.
        let shift = (self.rounds % 8) as usize;
        let (in_neighbourhoods, in_bins) =
            rayon::join(|| sorted_into_bins(&candidates, NEIGHBOURHOOD, shift), || sorted_into_bins(&candidates, 1, 0));
        for way in [Way::Surface, Way::Bins, Way::Rest] {
            let all = if way == Way::Bins { &in_bins } else { &in_neighbourhoods };
            let binned: Vec<Binned> = all.iter().copied().filter(|one| !merged[one.i as usize]).collect();
            let is_wanted =
                |bin: &&[Binned]| way != Way::Surface || bin.iter().any(|one| one.of(&candidates).at_surface);
            let bins = binned.chunk_by(Binned::is_beside);
            let bins: Vec<&[Binned]> = bins.filter(is_wanted).collect();
            let try_bin = |bin: &&[Binned]| match way {
                Way::Bins => self.try_merge(levels, &candidates, bin, false).into_iter().collect(),
                _ => self.clusters(levels, &candidates, bin, shift, way == Way::Surface),
            };
            // Neighbourhoods are few, and some hold much more than others.
            let most = if way == Way::Bins { bins.len() } else { 1 };
            let results: Vec<Vec<Result<Merged, Refusal>>> =
                bins.par_iter().with_max_len(most.max(1)).map(try_bin).collect();
            for result in results.into_iter().flatten() {
                match result {
                    Err(refusal) => *merging.refused.entry(refusal).or_default() += 1,
                    Ok(one) if is_near_tool(&one, couplings, tools) => {}
                    Ok(one) => {
                        for &i in &one.members {
                            merged[i] = true;
                            merging.gone.push(candidates[i].found);
                        }
                        merging.merged.push(one);
                    }
                }
            }
        }
        let left = candidates.iter().zip(merged).filter(|(_, merged)| !merged).map(|(one, _)| one.found);
        merging.left = left.filter(|one| one.home != one.level).collect();
        merging
    }

    /// What merging needs to know of the particles that may merge.
    fn those_that_merge<S: LevelStore>(&self, levels: &[&S], found: Vec<Found>) -> Vec<Candidate> {
        let surface = |here: &[Found]| {
            let (l, lists) = (here[0].level, self.materials.len());
            let cells = here.iter().map(|one| levels[l].cell(one.list, one.place));
            (l, Surface::new(levels[l], lists, cells, self.widths[l], &self.bounds[l]))
        };
        let surfaces: BTreeMap<usize, Surface> = found.chunk_by(|a, b| a.level == b.level).map(surface).collect();
        let finest_side: Vec<f64> = self.finest_volume.iter().map(|volume| volume.cbrt()).collect();
        let candidate = |found: Found| {
            let (level, list, place) = (levels[found.level], found.list, found.place);
            let (body, cell, offset) = (level.body(list, place), level.cell(list, place), level.offset(list, place));
            Candidate {
                found,
                id: level.id(list, place),
                body,
                x: std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * self.widths[found.level]),
                volume0: level.volume0(list, place),
                side: finest_side[usize::from(body).min(finest_side.len() - 1)] * f64::from(1 << (found.class + 1)),
                at_surface: surfaces[&found.level].is_near(cell),
            }
        };
        found.into_par_iter().map(candidate).collect()
    }

    /// Merges what stands together in a neighbourhood, wherever bins would end: about each particle, those with the least choice first,
    /// the cluster that is most like a cube; `only_surface` says whether only about particles there.
    fn clusters<S: LevelStore>(
        &self,
        levels: &[&S],
        candidates: &[Candidate],
        bin: &[Binned],
        shift: usize,
        only_surface: bool,
    ) -> Vec<Result<Merged, Refusal>> {
        let mut loose = Loose::new(candidates, bin, shift);
        let pairs = !only_surface && self.rounds.is_multiple_of(PATIENCE);
        let least = if pairs { 0.0 } else { *PORTION.start() };
        // At the surface anything less like a cube is refused anyway.
        let strict = 4.0 * self.tolerance * (1.0 + self.tolerance);
        // The members of a cluster tend to find the same one.
        let mut refused: HashSet<Vec<usize>> = HashSet::new();
        let (mut near, mut found) = (Near::default(), Vec::new());
        for seed in loose.seeds(self.isa, only_surface) {
            let members = loose.cluster(self.isa, seed, least, strict, &mut near);
            let Some(members) = members.filter(|members| !refused.contains(members)) else {
                continue;
            };
            let cluster: Vec<Binned> = members.iter().map(|&i| bin[loose.number[i]]).collect();
            if let Some(Ok(one)) = self.try_merge(levels, candidates, &cluster, pairs) {
                members.iter().for_each(|&i| loose.free[i] = false);
                found.push(Ok(one));
            } else {
                refused.insert(members);
            }
        }
        found
    }

    /// One particle in place of a bin's, if they are neither too few nor too many, and alike. `None`: not this time.
    fn try_merge<S: LevelStore>(
        &self,
        levels: &[&S],
        candidates: &[Candidate],
        bin: &[Binned],
        pairs: bool,
    ) -> Option<Result<Merged, Refusal>> {
        let members = || bin.iter().map(|binned| binned.of(candidates));
        let side = members().next()?.side;
        let volume: f64 = members().map(|one| one.volume0).sum();
        let least = if pairs { 0.0 } else { *PORTION.start() };
        if bin.len() < 2 || volume < least * side.powi(3) || volume > PORTION.end() * side.powi(3) {
            return None;
        }
        // All as seen from the first one's cell, on the coarsest level among them.
        let level = members().map(|one| one.found.level).max()?;
        let h = self.widths[level];
        let parcels: Vec<Parcel> = members()
            .map(|Candidate { found: one, .. }| {
                coarsened(levels[one.level].parcel(one.list, one.place), one.level, level)
            })
            .collect();
        let origin = parcels[0].cell;
        let material = &self.materials[parcels[0].list];
        let particles: Vec<Particle> = parcels.iter().map(|parcel| material.particle(parcel, origin, h)).collect();
        let planes = material.planes();
        let near_surface = members().any(|one| one.at_surface);
        let (one, change) = match merge(&particles, planes, self.gravity, self.tolerance, near_surface) {
            Ok(merged) => merged,
            Err(refusal) => return Some(Err(refusal)),
        };
        let x: [f64; 3] = std::array::from_fn(|d| f64::from(origin[d]) * h + one.x[d]);
        let mut like = parcels[0].clone();
        like.id = parcels.iter().map(|parcel| parcel.id).min()?;
        let parcel = self.parcel_of(&one, origin, level, &like);
        // Angular momentum about the world's origin: the particles' own change, since momentum and centre stay.
        let members = bin.iter().map(|binned| binned.i as usize).collect();
        let ids = parcels.iter().map(|parcel| parcel.id).collect();
        Some(Ok(Merged { parcel, change, members, ids, x, clearance: AROUND_TOOL * side }))
    }
}

/// Candidates by bins of so many merged particles' sides, those of a bin in the order of ids; see [`Candidate::binned`].
fn sorted_into_bins(candidates: &[Candidate], sides: u32, shift: usize) -> Vec<Binned> {
    let mut binned: Vec<Binned> =
        candidates.par_iter().enumerate().map(|(i, one)| one.binned(i, sides, shift)).collect();
    binned.par_sort_unstable();
    binned
}

/// The rest volume from which on a particle is of a class, by that of its body's finest ones [m³].
fn least_volume(finest: f64, class: usize) -> f64 {
    if class == 0 { 0.0 } else { finest * 8_f64.powf(class as f64 - 0.5) }
}

/// Rest volume of each body's particles on the finest level, then of each source's [m³]. Particles that belong to none count as the
/// last one's.
pub fn finest_volumes(plan: &Plan) -> Vec<f64> {
    let scene = &plan.scene;
    let bodies = scene.body.iter().map(|body| scene.spacing(body));
    let sources = scene.inflow.iter().map(|source| scene.inflow_spacing(source));
    let mut volumes: Vec<f64> = bodies.chain(sources).map(|spacing| spacing.powi(3)).collect();
    if volumes.is_empty() {
        volumes.push(0.125 * plan.cell_widths[0].powi(3));
    }
    volumes
}

/// Does a tool come so near that particles stay fine?
fn is_near_tool(one: &Merged, couplings: &[Box<dyn Coupling>], tools: &[Aabb]) -> bool {
    tools.iter().any(|tool| tool.grown(one.clearance).contains(one.x))
        && couplings.iter().any(|c| c.distance(&[one.x])[0] < one.clearance)
}

/// A box around cells, each with its width [m].
pub fn around_cells(cells: impl Iterator<Item = ([i32; 3], f64)>) -> Option<Aabb> {
    let boxes =
        cells.map(|(cell, h)| Aabb { min: cell.map(|c| f64::from(c) * h), max: cell.map(|c| f64::from(c + 1) * h) });
    boxes.reduce(|all, here| all.union(&here))
}
