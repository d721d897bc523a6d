//! The step.

use crate::awake::Awake;
use crate::faults::at_time;
use crate::flux::Flux;
use crate::grid::Grid;
use crate::isolated;
use crate::level::{Level, Shares};
use crate::sleep::SleepSums;
use crate::step::{self, Forward};
use crate::store::{Departures, List};
use barchan_abi as abi;
use barchan_core::backend::{Bound, Timing};
use barchan_core::contact::{self, Contact};
use barchan_core::coupling::begin_step;
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::Leaving;
use barchan_core::schedule::Call;
use barchan_core::stiffness::{Need, Stiffness};
use barchan_core::task::{Sampled, chosen};
use barchan_core::{
    Aabb, Adapted, Coupling, Crossed, Engine, Error, Fields, Ledger, Measured, Newcomer, NodeBatch, ParticleList,
    ParticleState, Plan, Reading, Regions, Result, Scene, Schedule, SortPhase, Spot, Stage, StepReport, Vec3,
};
use barchan_grid::adapt::Adapt;
use barchan_grid::archive::Reach;
use barchan_grid::due::{MARGIN_DRIFT, ON_PROCESSOR, is_sort_due, most_drift};
use barchan_grid::limits::{self, LEAST_MASS, MAX_DEFORMATION, MAX_MOVE, MAX_PARTS, STIFFNESS_AGE, greater};
use barchan_grid::particles::Run;
use barchan_grid::rest;
use barchan_grid::transfer::{Scalar, Step};
use barchan_lanes::{CHUNK, Isa};
use rayon::ThreadPool;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A pass that is timed.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Pass {
    Archive,
    Adapt,
    Sort,
    Sleep,
    P2G,
    Restrict,
    Grid,
    Contact,
    Prolong,
    G2P,
    Flux,
}

impl Pass {
    const fn name(self) -> &'static str {
        match self {
            Self::Archive => "archive",
            Self::Adapt => "adapt",
            Self::Sort => "sort",
            Self::Sleep => "sleep",
            Self::P2G => "P2G",
            Self::Restrict => "restrict",
            Self::Grid => "grid",
            Self::Contact => "contact",
            Self::Prolong => "prolong",
            Self::G2P => "G2P",
            Self::Flux => "flux",
        }
    }
}

/// Time spent in each pass, and in each material within P2G.
#[derive(Default)]
pub(crate) struct Clocks {
    passes: BTreeMap<Pass, (Duration, u64)>,
    shares: Shares,
}

impl Clocks {
    pub(crate) fn add(&mut self, pass: Pass, since: Instant) {
        let entry = self.passes.entry(pass).or_default();
        entry.0 += since.elapsed();
        entry.1 += 1;
    }
}

/// One world on the CPU: its levels, finest first.
pub(crate) struct CpuEngine<T: Scalar> {
    /// Everything runs in it, so that what is parallel need not enter it each time.
    pub(crate) pool: Arc<ThreadPool>,
    /// Its threads stay awake during a step.
    awake: Awake,
    pub(crate) isa: Isa,
    pub(crate) materials: Vec<PlannedMaterial>,
    pub(crate) levels: Vec<Level<T>>,
    pub(crate) adapt: Adapt,
    pub(crate) schedule: Schedule,
    /// Its calls, with what carries them out.
    pub(crate) calls: Arc<[(Call, Forward<T>)]>,
    leaving: Leaving,
    pub(crate) scene: Scene,
    /// Gravity of the present step [m/s²].
    gravity: [f64; 3],
    /// Levels that particles have left or come to since the last sort.
    pub(crate) changed: Vec<bool>,
    /// Steps since the last sort; `None` before the first one.
    pub(crate) age: Option<u32>,
    /// Nodes lighter than this carry nothing that a particle could feel [kg].
    pub(crate) least_mass: f64,
    /// Stiffness bound when it was measured last, and the steps since then.
    stiffness: Bound,
    stiffness_age: u32,
    /// Did NaN or infinity come in with the particles?
    spoilt: bool,
    /// Does any material harden, so that the bound follows the state?
    hardens: bool,
    pub(crate) steps: u64,
    /// Mass of all live particles [kg].
    pub(crate) mass: f64,
    departures: Departures,
    /// Impulse that walls have given since the start [N s].
    pub(crate) wall_impulse: [f64; 3],
    pub(crate) slept: SleepSums,
    /// What damping has dissipated since the start [J].
    damped: f64,
    /// What is live, and the archive of what was, if not the whole world is.
    pub(crate) reach: Option<Reach>,
    /// What crosses the sections of probes.
    pub(crate) flux: Flux,
    /// What the parts of walls that probes ask about have taken since the start [N s].
    pub(crate) pressed: Vec<Vec3>,
    pub(crate) shortened: u64,
    parted: u64,
    gravity_impulse: [f64; 3],
    batch: NodeBatch,
    contact: Contact,
    /// The materials' stiffness against being pushed into [Pa].
    contact_moduli: Vec<f64>,
    pub(crate) clocks: Clocks,
}

impl<T: Scalar> CpuEngine<T> {
    pub(crate) fn new(plan: &Plan, particles: ParticleState) -> Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(plan.threads).build().map_err(|e| Error::Io {
            file: "threads".into(),
            what: "starting worker threads",
            source: std::io::Error::other(e),
        })?;
        let shares = Shares { materials: vec![0; plan.materials.len()], sampled: 0 };
        let mut engine = Self {
            pool: Arc::new(pool),
            awake: Awake::default(),
            isa: plan.isa,
            materials: plan.materials.clone(),
            levels: (0..plan.cell_widths.len()).map(|level| Level::new(plan, level)).collect(),
            adapt: Adapt::new(plan),
            calls: step::calls(&plan.schedule),
            schedule: plan.schedule.clone(),
            leaving: plan.scene.world.leaving,
            scene: plan.scene.clone(),
            gravity: plan.gravity,
            changed: vec![false; plan.cell_widths.len()],
            age: None,
            least_mass: 0.0,
            stiffness: Bound { dt: f64::INFINITY, by: "nothing".into() },
            stiffness_age: 0,
            spoilt: false,
            hardens: plan.materials.iter().any(|m| m.material.has(abi::BARCHAN_CAP_HARDENS)),
            steps: 0,
            mass: 0.0,
            departures: Departures::default(),
            wall_impulse: [0.0; 3],
            slept: SleepSums::default(),
            damped: 0.0,
            reach: plan.terrain.clone().map(Reach::new),
            flux: Flux::new(plan),
            pressed: vec![[0.0; 3]; plan.scene.wall_parts().count()],
            shortened: 0,
            parted: 0,
            gravity_impulse: [0.0; 3],
            batch: NodeBatch::default(),
            contact: Contact::default(),
            contact_moduli: plan.materials.iter().map(|m| m.contact_modulus(&plan.scene)).collect::<Result<_>>()?,
            clocks: Clocks { shares, ..Clocks::default() },
        };
        engine.upload(particles)?;
        Ok(engine)
    }

    /// Sorts the levels whose particles are too far from home, or have been so for long; before that, brings particles to the
    /// levels they belong on; `before` are the regions as they were if they have moved. Returns which were sorted, if any was.
    fn keep_in_order(
        &mut self,
        time: f64,
        before: Option<&Regions>,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<Option<Vec<bool>>> {
        let is_due = |level: &Level<T>| {
            let most = most_drift(self.leaving, level.near_open, self.schedule.slots > 1);
            self.age.is_none_or(|age| is_sort_due(age, level.drift, most, &ON_PROCESSOR))
        };
        let mut due: Vec<bool> = self.levels.iter().map(is_due).collect();
        if before.is_none() && !due.contains(&true) {
            return Ok(None);
        }
        let mut holes = std::mem::replace(&mut self.changed, vec![false; self.levels.len()]);
        if self.schedule.has(Stage::ADAPT) {
            let exchanged = self.exchange_with_archive(time, couplings)?;
            let stirred: Vec<bool> =
                self.levels.iter().zip(&due).map(|(level, due)| *due || level.drift > MARGIN_DRIFT).collect();
            let adapted = self.adapt_levels(time, before, &stirred, couplings)?;
            let changes = exchanged.into_iter().zip(adapted).map(|(exchanged, adapted)| exchanged || adapted);
            holes.iter_mut().zip(changes).for_each(|(holes, changed)| *holes |= changed);
        }
        due.iter_mut().zip(&holes).for_each(|(due, holes)| *due |= holes);
        let clock = Instant::now();
        let left = self.sort_levels(&due, &holes)?;
        if let Some((id, position)) = left {
            // All lie in order, to be saved, and whoever goes on finds the same.
            self.age = None;
            return Err(Error::left_world(&self.scene.world, self.steps, u64::from(id), position));
        }
        self.rebuild_grids(before.is_some());
        self.age = Some(0);
        self.clocks.add(Pass::Sort, clock);
        Ok(Some(due))
    }

    /// Sorts the levels that are due, side by side. `holes`: have particles been taken out, or come in? Returns the particle of least number that has left the world
    /// where that is an error, and its place [m].
    fn sort_levels(&mut self, due: &[bool], holes: &[bool]) -> Result<Option<(u32, [f64; 3])>> {
        let leaving = self.leaving;
        let sort = |(level, holes): (&mut Level<T>, &bool)| {
            let departures = level.store.sort(&level.bounds, leaving, *holes)?;
            level.drift = 0.0;
            level.find_open();
            Ok(departures)
        };
        let levels = self.levels.par_iter_mut().zip(holes).zip(due).filter(|(_, due)| **due);
        let sorted: Vec<Result<Departures>> = levels.map(|(level, _)| sort(level)).collect();
        let mut left = None;
        for departures in sorted {
            let departures = departures?;
            self.departures.clamped += departures.clamped;
            self.departures.deleted += departures.deleted;
            self.departures.deleted_mass += departures.deleted_mass;
            self.mass -= departures.deleted_mass;
            for d in 0..3 {
                self.wall_impulse[d] += departures.impulse[d];
            }
            left = [left, departures.refused].into_iter().flatten().min_by_key(|(id, _)| *id);
        }
        Ok(left)
    }

    /// Lets every grid take up its store's blocks, and ties the rims of levels to the next coarser ones.
    fn rebuild_grids(&mut self, changed: bool) {
        let levels = &mut self.levels;
        let mut parents = Vec::new();
        let mut rebuilt = Vec::with_capacity(levels.len());
        for l in 0..levels.len() {
            let (level, coarser) =
                levels[l..].split_first_mut().map_or((None, None), |(one, rest)| (Some(one), rest.first()));
            let Some(level) = level else { continue };
            let new = level.grid.rebuild(&level.store.blocks, std::mem::take(&mut parents), &level.bounds, changed);
            rebuilt.push(new);
            if let Some(coarser) = coarser {
                if new {
                    level.grid.find_rim(&self.adapt.regions, l, &level.bounds, &coarser.bounds);
                }
                parents = level.grid.parents_of_rim().to_vec();
            }
        }
        for l in 1..levels.len() {
            if let ([.., finer], [coarser, ..]) = levels.split_at_mut(l)
                && (rebuilt[l - 1] || rebuilt[l])
            {
                finer.grid.link(&mut coarser.grid, &coarser.bounds);
            }
        }
        for (level, new) in levels.iter_mut().zip(rebuilt) {
            level.list_watch(new);
        }
        self.hold_edges();
    }

    /// P2G of some levels in a step of `dt` of all, side by side. Strain is up to date afterwards.
    pub(crate) fn particles_to_grid(&mut self, levels: Range<usize>, dt: f64) -> Result<()> {
        let clock = Instant::now();
        let steps: Vec<Step> =
            levels.clone().map(|l| self.whole_step(l, self.schedule.dt_of(l, dt))).collect::<Result<_>>()?;
        self.parted += steps.iter().filter(|step| step.strain_parts > 1).count() as u64;
        let (isa, materials) = (self.isa, self.materials.len());
        let one = |(level, step): (&mut Level<T>, &Step)| level.particles_to_grid(isa, step, materials);
        let outcomes: Vec<_> = self.levels[levels.clone()].par_iter_mut().zip(&steps).map(one).collect();
        for (l, outcome) in levels.zip(outcomes) {
            let shares = outcome.map_err(|stopped| self.explain(l, stopped))?;
            self.clocks.shares = std::mem::take(&mut self.clocks.shares).plus(shares);
        }
        self.clocks.add(Pass::P2G, clock);
        Ok(())
    }

    /// A level's step, with the strain that lags behind carried along in parts that are small enough.
    pub(crate) fn whole_step(&self, l: usize, dt: f64) -> Result<Step> {
        let level = &self.levels[l];
        let parts = (level.deformation_rate * level.strain_dt / MAX_DEFORMATION).ceil();
        if parts > MAX_PARTS {
            let bound = MAX_PARTS * MAX_DEFORMATION / level.deformation_rate;
            let dt = level.strain_dt;
            return Err(self.find_non_finite().unwrap_or(Error::TimeStep {
                step: self.steps,
                dt,
                bound,
                by: "the deformation rate that particles were given".into(),
            }));
        }
        Ok(Step { strain_parts: (parts as u32).max(1), ..self.step_of(l, dt) })
    }

    /// Steps that a level takes in one of the simulation.
    fn steps_within(&self, l: usize) -> u32 {
        (self.schedule.slots as u32 >> l).max(1)
    }

    pub(crate) fn step_of(&self, l: usize, dt: f64) -> Step {
        let level = &self.levels[l];
        Step { h: level.h(), dt, strain_dt: level.strain_dt, strain_parts: 1, gravity: self.gravity, frozen: false }
    }

    /// All lists, with the indices of level and list.
    pub(crate) fn lists(&self) -> impl Iterator<Item = ((usize, usize), &List<T>)> {
        let of_level = |(l, level): (usize, &'_ Level<T>)| (l, level.store.lists.len());
        self.levels
            .iter()
            .enumerate()
            .map(of_level)
            .flat_map(|(l, count)| (0..count).map(move |i| (l, i)))
            .map(|(l, i)| ((l, i), &self.levels[l].store.lists[i]))
    }

    /// Books what a level's ground asleep took in its step that has just ended, and what gravity did not give to it.
    pub(crate) fn book_sleepers(&mut self, l: usize, dt: f64) {
        let asleep = self.levels[l].watch.mass;
        (0..3).for_each(|d| self.gravity_impulse[d] -= asleep * self.gravity[d] * dt);
        let taken = self.levels[l].taken_by_those_asleep(self.isa);
        (0..3).for_each(|d| self.slept.momentum[d] += taken[d]);
    }

    /// Carries strain of levels up to where their particles are, before some change to a level with another step.
    pub(crate) fn flush_strain(&mut self, time: f64, concerned: &[bool]) -> Result<()> {
        if self.schedule.slots == 1 || self.age.is_none() {
            return Ok(());
        }
        for l in (0..self.levels.len()).filter(|&l| concerned[l]) {
            if self.levels[l].strain_dt > 0.0 {
                self.particles_to_grid(l..l + 1, 0.0).map_err(|error| at_time(error, time))?;
            }
        }
        Ok(())
    }

    /// Couplings act on the nodes of one level: fields one after the other, then all bodies. Returns whether there were any nodes.
    pub(crate) fn touch(&mut self, l: usize, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<bool> {
        let clock = Instant::now();
        let (h, mut contact, mut reached) = (self.levels[l].h(), std::mem::take(&mut self.contact), false);
        let acted = contact.act(couplings, [dt, h], |boxes, act| {
            reached |= self.with_nodes_near(l, boxes, act)?;
            Ok(())
        });
        self.contact = contact;
        acted?;
        if reached {
            self.clocks.add(Pass::Contact, clock);
        }
        Ok(reached)
    }

    /// Hands over the nodes of a level in the first boxes and the particles in the second ones, and takes the nodes' velocities back, unless there are none.
    fn with_nodes_near(
        &mut self,
        l: usize,
        [of_nodes, of_particles]: [&[Aabb]; 2],
        act: &mut contact::Act<'_>,
    ) -> Result<bool> {
        let (level, subcycled) = (&mut self.levels[l], self.schedule.slots > 1);
        level.gather(of_nodes, self.least_mass, subcycled, &mut self.batch);
        if self.batch.is_empty() {
            return Ok(false);
        }
        if !of_particles.is_empty() {
            level.gather_particles(of_particles, &self.contact_moduli, &mut self.batch);
        }
        act(&mut self.batch)?;
        level.scatter(&self.batch, self.least_mass);
        Ok(true)
    }

    /// Asks every material for its stiffness and keeps the least stable step.
    pub(crate) fn measure_stiffness(&mut self) -> Result<()> {
        self.stiffness_age = 0;
        self.stiffness = Bound { dt: f64::INFINITY, by: "nothing".into() };
        for (l, level) in self.levels.iter().enumerate() {
            // The bound is on a whole step: subcycled, a level takes a part of it.
            let (h, steps_within) = (level.h(), self.steps_within(l));
            for list in &level.store.lists {
                let planned = &self.materials[list.material];
                let Some(stiffness) = Stiffness::of(planned) else { continue };
                let blocks = list.runs.iter().filter(|run| run.count > 0);
                // A law that does not harden is as stiff everywhere as at its first particle.
                let hardens = planned.material.has(abi::BARCHAN_CAP_HARDENS);
                let runs: Vec<_> = if hardens { blocks.collect() } else { blocks.take(1).collect() };
                let of_run = |run: &&Run| {
                    (0..run.chunks()).try_fold(Need::default(), |need, k| {
                        let count = (run.count - k * CHUNK).min(CHUNK);
                        Ok(need.or(list.need(&stiffness, run.first + k, count, h)?))
                    })
                };
                let need = runs.par_iter().map(of_run).try_reduce(Need::default, |a, b| Ok(a.or(b)))?;
                let bound = stiffness.bound(need, steps_within);
                if bound.dt < self.stiffness.dt {
                    self.stiffness = bound;
                }
            }
        }
        Ok(())
    }
}

impl<T: Scalar> Engine for CpuEngine<T> {
    fn bound(&self) -> Bound {
        let speed = self.levels.iter().fold(0.0, |most, level| greater(level.particle_speed / level.h(), most));
        limits::bound(MAX_MOVE / speed, self.stiffness.clone())
    }

    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let (pool, awake) = (Arc::clone(&self.pool), self.awake.clone());
        pool.install(|| awake.during(|| self.advance(time, dt, couplings)))
    }

    fn download(&self) -> ParticleState {
        let sort = self.age.map(|age| SortPhase {
            age,
            drift: self.levels.iter().map(|level| level.drift).collect(),
            measured: Measured {
                stiffness_bound: self.stiffness.dt,
                stiffness_age: self.stiffness_age,
                mass: self.mass,
                least_mass: self.least_mass,
            },
            blocks: self
                .levels
                .iter()
                .enumerate()
                .flat_map(|(l, level)| {
                    level.store.blocks_held().map(move |([x, y, z], counts)| ([0, l as i32, x, y, z], counts))
                })
                .collect(),
            rest: self.levels.iter().flat_map(|level| level.store.rest.iter().copied()).collect(),
            kept_for: self.levels.iter().map(|level| level.watch.tiles_for).collect(),
        });
        let of_level = |(l, level): (usize, &Level<T>)| level.store.download(l);
        let lists = || self.levels.par_iter().enumerate().flat_map_iter(of_level).collect();
        let lists = self.pool.install(lists);
        let archive = self.reach.as_ref().map(Reach::archive).unwrap_or_default();
        ParticleState { lists, sort, archive, ..self.without_particles() }
    }

    fn spots(&self) -> Vec<Spot> {
        let mut spots = Vec::with_capacity(self.particle_count());
        self.pool.install(|| self.levels.iter().for_each(|level| level.store.add_spots(&mut spots)));
        let archived = self.reach.iter().flat_map(Reach::archived);
        archived.for_each(|list| spots.extend((0..list.len()).map(|i| list.spot(i))));
        spots
    }

    fn download_where(&self, region: Option<&Aabb>, wanted: &(dyn Fn(&Spot) -> bool + Sync)) -> ParticleState {
        let levels = self.levels.iter().enumerate();
        let lists = || levels.flat_map(|(l, level)| level.store.download_where(l, region, wanted));
        let mut lists: Vec<_> = self.pool.install(|| lists().collect());
        lists.extend(self.reach.iter().flat_map(Reach::archived).map(|mut list| {
            list.retain(wanted);
            list
        }));
        ParticleState { lists, ..self.without_particles() }
    }

    fn sample(&self, counts: &[usize]) -> Vec<Sampled> {
        let present: Vec<usize> = self.levels.iter().map(|level| level.store.len()).collect();
        let chosen = chosen(counts, &present);
        let of_level = |of_level: &[(usize, usize)]| {
            let numbers = of_level.iter().map(|(_, number)| *number);
            of_level.first().map_or_else(Vec::new, |(level, _)| self.levels[*level].store.sample(numbers).collect())
        };
        chosen.chunk_by(|(a, _), (b, _)| a == b).flat_map(of_level).collect()
    }

    fn read(&self, region: Option<&Aabb>, fields: Fields, origin: Vec3) -> Reading {
        let mut reading = Reading::new(fields, origin);
        let levels = self.levels.iter().enumerate();
        self.pool.install(|| levels.for_each(|(l, level)| level.store.read(l, region, &mut reading)));
        self.reach.iter().flat_map(Reach::archived).for_each(|list| reading.add_list(&list, region));
        reading
    }

    fn untouched(&self, points: &[[f64; 2]]) -> Vec<bool> {
        match (&self.reach, self.levels.last()) {
            (Some(reach), Some(coarsest)) => reach.untouched(points, coarsest.store.cell_width),
            _ => vec![false; points.len()],
        }
    }

    fn crossed(&self) -> Result<Vec<Crossed>> {
        Ok(self.flux.crossed.clone())
    }

    fn pressed(&self) -> Vec<Vec3> {
        self.pressed.clone()
    }

    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        let pool = Arc::clone(&self.pool);
        pool.install(|| self.take_in(particles))
    }

    fn take_out(&mut self, time: f64, gone: &(dyn Fn(&Spot) -> bool + Sync)) -> Result<Vec<ParticleList>> {
        let pool = Arc::clone(&self.pool);
        pool.install(|| self.take_out_where(time, gone))
    }

    fn bring_in(&mut self, plan: &Plan, time: f64, come: &[Newcomer], next_id: &mut u64) -> Result<Vec<ParticleList>> {
        let pool = Arc::clone(&self.pool);
        pool.install(|| self.bring_in_newcomers(plan, time, come, next_id))
    }

    fn particle_count(&self) -> usize {
        self.levels.iter().map(|level| level.store.len()).sum()
    }

    fn account(&self, ledger: &mut Ledger) {
        self.account_particles(ledger);
        for d in 0..3 {
            ledger.wall_impulse[d] += self.wall_impulse[d];
            ledger.gravity_impulse[d] += self.gravity_impulse[d];
        }
        ledger.crossed.clone_from(&self.flux.crossed);
        ledger.pressed.clone_from(&self.pressed);
        self.adapt.account(ledger);
        ledger.slept_kinetic += self.slept.kinetic;
        for d in 0..3 {
            ledger.slept_momentum[d] += self.slept.momentum[d];
        }
        ledger.damped += self.damped;
        ledger.count("blocks that fell asleep", self.slept.blocks);
        ledger.count("particles asleep now", self.levels.iter().map(Level::asleep).sum());
        if let Some(reach) = &self.reach {
            reach.account(ledger);
        }
        ledger.deleted_mass += self.departures.deleted_mass;
        ledger.count("particles put back into the world", self.departures.clamped);
        ledger.count("particles deleted on leaving", self.departures.deleted);
        ledger.count("steps shortened for speed", self.shortened);
        ledger.count("steps with strain applied in parts", self.parted);
        let of_level =
            |(l, level): (usize, &Level<T>)| isolated::count(&level.store.lists, &level.bounds, &self.adapt.regions, l);
        let isolated = self.levels.iter().enumerate().map(of_level).sum();
        ledger.count("particles with an isolated stencil now", isolated);
    }

    fn carry_on(&mut self, sums: &Ledger) {
        (self.wall_impulse, self.gravity_impulse) = (sums.wall_impulse, sums.gravity_impulse);
        self.departures = Departures { deleted_mass: sums.deleted_mass, ..Departures::default() };
        self.slept = SleepSums { blocks: 0, kinetic: sums.slept_kinetic, momentum: sums.slept_momentum };
        (self.shortened, self.parted) = (0, 0);
        self.damped = sums.damped;
        self.flux.carry_on(&sums.crossed);
        self.pressed.iter_mut().zip(&sums.pressed).for_each(|(own, other)| *own = *other);
        self.adapt.carry_on(sums);
        if let Some(reach) = &mut self.reach {
            reach.carry_on(sums);
        }
    }

    fn timings(&self) -> Vec<Timing> {
        let p2g = self.clocks.passes.get(&Pass::P2G).map_or(0.0, |(time, _)| time.as_secs_f64());
        let mut timings = Vec::new();
        for (&pass, &(time, passes)) in &self.clocks.passes {
            let mut seconds = time.as_secs_f64();
            if pass == Pass::P2G {
                for (m, &nanoseconds) in self.clocks.shares.materials.iter().enumerate() {
                    let share = nanoseconds as f64 / self.clocks.shares.sampled.max(1) as f64 * p2g;
                    seconds -= share;
                    timings.push(Timing {
                        effect: format!("material {}", self.materials[m].name),
                        seconds: share,
                        passes,
                    });
                }
            }
            timings.push(Timing { effect: pass.name().into(), seconds, passes });
        }
        timings
    }

    fn memory(&self) -> (u64, u64) {
        let sum = |bytes: fn(&Level<T>) -> u64| self.levels.iter().map(bytes).sum();
        let archived = self.reach.as_ref().map_or(0, Reach::bytes);
        (sum(|level| level.store.bytes()) + archived, sum(|level| level.grid.bytes()))
    }
}

impl<T: Scalar> CpuEngine<T> {
    /// One step of all levels, subcycled or not.
    fn advance(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let ground = self.particle_count() > 0;
        if self.spoilt {
            // Found here, it has touched nothing yet.
            self.find_non_finite().map_or(Ok(()), |error| Err(at_time(error, time)))?;
        }
        // A step that failed has given nothing.
        self.levels.iter_mut().for_each(Level::forget_walls);
        // Nor is what became of its levels the next one's.
        drop(self.adapt.take_changes());
        let before = if ground { self.follow_agents(couplings) } else { None };
        let sorted_levels = if ground { self.keep_in_order(time, before.as_ref(), couplings)? } else { None };
        let sorted = sorted_levels.is_some();
        let adapted = sorted_levels.filter(|levels| levels.len() > 1).map(|sorted| {
            Arc::new(Adapted {
                boxes: self.adapt.regions.boxes().to_vec(),
                live: self.reach.as_ref().map(Reach::live).unwrap_or_default(),
                sorted,
                carried: false,
                changes: self.adapt.take_changes(),
            })
        });
        self.gravity = self.scene.gravity_at(time);
        let fall = rest::falls(&self.scene) * self.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
        let gravity_grows = self.scene.gravity_grows(time);
        for Level { watch, .. } in &mut self.levels {
            (watch.fall, watch.gravity_grows) = (fall, gravity_grows);
        }
        let (dt, wrenches) = if ground {
            self.carry_out(time, dt, couplings)?
        } else {
            self.levels.iter_mut().for_each(|level| level.max_speed = 0.0);
            for slot in 0..self.schedule.slots {
                let (time, dt) = (self.schedule.time_of(slot, time, dt), self.schedule.dt_of(0, dt));
                begin_step(couplings, time, dt)?;
                couplings.iter_mut().try_for_each(|coupling| coupling.after_step(time, dt))?;
            }
            (dt, None)
        };
        for level in &mut self.levels {
            let impulse = std::mem::take(&mut level.wall_impulse);
            (0..3).for_each(|d| self.wall_impulse[d] += impulse[d]);
            self.damped += std::mem::take(&mut level.damped);
        }
        self.stiffness_age += 1;
        if self.hardens && self.stiffness_age >= STIFFNESS_AGE {
            self.measure_stiffness()?;
        }
        for d in 0..3 {
            self.gravity_impulse[d] += self.mass * self.gravity[d] * dt;
        }
        let max_speed = self.levels.iter().fold(0.0, |most, level| greater(level.max_speed, most));
        self.age = self.age.map(|age| age + 1);
        self.steps += 1;
        Ok(StepReport { dt, sorted, max_speed, wrenches, bodies: None, adapted })
    }

    fn take_in(&mut self, particles: ParticleState) -> Result<()> {
        let materials = self.materials.len();
        if particles.lists.len() != self.levels.len() * materials {
            return Err(Error::Body {
                path: "particles".into(),
                what: format!(
                    "{} lists where the plan has {materials} materials on {} levels",
                    particles.lists.len(),
                    self.levels.len()
                ),
                mend: "hand back particles of a simulation of the same scene".into(),
            });
        }
        for l in 0..self.levels.len() {
            // It was saved for the finest level.
            let strain_dt = particles.strain_dt * f64::from(self.steps_within(0) / self.steps_within(l));
            let level = &mut self.levels[l];
            let blocks: Option<Vec<_>> = particles.sort.as_ref().map(|sort| {
                let all = sort.blocks.iter().zip(&sort.rest);
                let here = all.filter(|(([_, level, ..], _), _)| *level == l as i32);
                here.map(|(([_, _, x, y, z], counts), rest)| ([*x, *y, *z], counts.as_slice(), *rest)).collect()
            });
            level.store.upload(&particles.lists[l * materials..][..materials], blocks.as_deref())?;
            level.strain_dt = strain_dt;
        }
        self.spoilt = self.find_non_finite().is_some();
        self.take_stock();
        // Materials cannot say how stiff NaN is; the next step names it.
        if !self.spoilt {
            self.measure_stiffness()?;
        }
        let ids = particles.lists.iter().flat_map(|list| &list.id);
        self.adapt.next_id = ids.max().map_or(0, |id| id + 1);
        if let Some(phase) = particles.levels {
            if let Some(reach) = &mut self.reach {
                reach.restore(phase.live.clone(), particles.archive);
            }
            self.adapt.restore(phase);
        }
        match particles.sort {
            Some(sort) => {
                self.age = Some(sort.age);
                for (level, (drift, kept_for)) in self.levels.iter_mut().zip(sort.drift.into_iter().zip(sort.kept_for))
                {
                    level.drift = drift;
                    level.watch.tiles_for = kept_for;
                }
                self.rebuild_grids(true);
                self.levels.iter_mut().for_each(Level::find_open);
                self.stiffness.dt = sort.measured.stiffness_bound;
                self.stiffness_age = sort.measured.stiffness_age;
                (self.mass, self.least_mass) = (sort.measured.mass, sort.measured.least_mass);
            }
            None => {
                self.age = None;
                // Nothing is left of the particles before these.
                for level in &mut self.levels {
                    (level.drift, level.grid) = (0.0, Grid::default());
                    level.watch.forget();
                }
            }
        }
        Ok(())
    }

    /// What a copy of some particles comes with.
    fn without_particles(&self) -> ParticleState {
        ParticleState {
            strain_dt: self.levels[0].strain_dt,
            levels: self.adapt.phase(self.reach.as_ref().map(Reach::live).unwrap_or_default()),
            ..ParticleState::default()
        }
    }

    /// What depends on the particles as they come in: total and least mass, greatest deformation rate and speed.
    fn take_stock(&mut self) {
        let isa = self.isa;
        let least = self.levels.iter_mut().fold(f64::INFINITY, |least, level| level.take_stock(isa).min(least));
        self.mass = self.lists().flat_map(|(_, list)| list.places().map(|(c, l)| list.mass_of(c, l))).sum();
        self.least_mass = if least.is_finite() { least * LEAST_MASS } else { 0.0 };
    }
}
