//! One world of a batch, as the engine that a simulation drives.

use crate::device::Gpu;
use crate::device::probed::{crossed, exactly, pressed, pressed_of};
use crate::readback::account;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::submission::Clock;
use barchan_core::backend::{Batch, Bound, Look, Looked, NewWorld, Timing, WorldStep};
use barchan_core::plan::PlannedMaterial;
use barchan_core::probe::Filter;
use barchan_core::task::Sampled;
use barchan_core::{
    Aabb, Apart, Coupling, Crossed, Engine, Error, Fields, Ledger, ParticleState, Plan, Reading, Result, Sought, Spot,
    StepReport, Sums, Vec3,
};
use barchan_grid::archive::Reach;
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::io;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Worlds on one device, shared by those who look at one of them, and the threads of what the host does for them; without any of their own,
/// as many as the machine has.
#[derive(Clone)]
pub(crate) struct Worlds {
    batch: Arc<Mutex<WgpuBatch>>,
    pool: Option<Arc<ThreadPool>>,
}

/// One world of a batch.
pub(crate) struct WorldEngine {
    shared: Worlds,
    world: usize,
}

impl Worlds {
    /// A batch of worlds, with so many threads; 0: as many as the machine has.
    pub(crate) fn new(gpu: Arc<Gpu>, worlds: Vec<NewWorld<'_>>, threads: usize) -> Result<Self> {
        let start = || ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = (threads > 0).then(start).transpose().map_err(|e| Error::Io {
            file: "threads".into(),
            what: "starting worker threads",
            source: io::Error::other(e),
        })?;
        let new = || WgpuBatch::new(gpu, worlds);
        let batch = match &pool {
            Some(pool) => pool.install(new),
            None => new(),
        }?;
        Ok(Self { batch: Arc::new(Mutex::new(batch)), pool: pool.map(Arc::new) })
    }

    pub(crate) fn engine(&self, world: usize) -> WorldEngine {
        WorldEngine { shared: self.clone(), world }
    }

    pub(crate) fn batch(&self) -> MutexGuard<'_, WgpuBatch> {
        self.batch.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes steps. What only waits for the device needs none of the batch's threads: to be taken up by one of them and told that it is done takes as long as
    /// some steps of a small world.
    pub(crate) fn take_steps(
        &self,
        dt: f64,
        count: usize,
        world_steps: &mut [WorldStep<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let mut batch = self.batch();
        if batch.only_waits() {
            return batch.steps(dt, count, world_steps);
        }
        drop(batch);
        self.with(|batch| batch.steps(dt, count, world_steps))
    }

    /// Does something with the batch on its threads. From outside of them each parallel loop would wait to be taken up and to be told that it
    /// has ended, tens of microseconds each time.
    pub(crate) fn with<R: Send>(&self, f: impl FnOnce(&mut WgpuBatch) -> R + Send) -> R {
        let mut batch = self.batch();
        let batch = &mut *batch;
        let f = || f(batch);
        match &self.pool {
            Some(pool) => pool.install(f),
            None => rayon::scope(|_| f()),
        }
    }
}

impl Batch for Worlds {
    fn engine(&self, world: usize) -> Box<dyn Engine> {
        Box::new(self.engine(world))
    }

    fn steps(
        &mut self,
        dt: f64,
        count: usize,
        world_steps: &mut [WorldStep<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        self.take_steps(dt, count, world_steps)
    }

    fn upload(&mut self, states: Vec<(usize, ParticleState)>) -> Result<()> {
        self.with(|batch| {
            batch.settle()?;
            batch.take_in(states)
        })
    }

    fn look(&mut self, looks: &[Look<'_>]) -> Result<Vec<Looked>> {
        self.with(|batch| batch.look_at(0, looks))
    }

    fn replace(&mut self, world: usize, new: NewWorld<'_>) -> Result<()> {
        self.with(|batch| batch.replace(world, new))
    }

    fn copy(&mut self, from: usize, to: usize, plan: &Plan) -> Result<()> {
        self.with(|batch| batch.copy(from, to, plan))
    }
}

impl Engine for WorldEngine {
    fn bound(&self) -> Bound {
        self.shared.batch().worlds[self.world].bound()
    }

    fn bound_within(&self, steps: u64) -> Bound {
        self.shared.batch().worlds[self.world].bound_within(steps)
    }

    fn stride(&self) -> u64 {
        self.shared.batch().worlds[self.world].stride()
    }

    fn is_outgrown(&self, dt: f64) -> bool {
        self.shared.batch().worlds[self.world].is_outgrown(dt)
    }

    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let mut reports = self.steps(time, dt, 1, couplings, false)?;
        Ok(reports.pop().expect("whatever is submitted has a step, and what fails says so"))
    }

    fn steps(
        &mut self,
        time: f64,
        dt: f64,
        count: usize,
        couplings: &mut [Box<dyn Coupling>],
        bodies: bool,
    ) -> Result<Vec<StepReport>> {
        let world_step = WorldStep { world: self.world, time, couplings, reports_bodies: bodies };
        self.shared
            .take_steps(dt, count, &mut [world_step])?
            .pop()
            .expect("there is a result for each world, and one world is asked")
    }

    fn download(&self) -> ParticleState {
        // A device that is lost has no particles left; the next step says so.
        self.shared.with(|batch| batch.readback().state(self.world)).unwrap_or_default()
    }

    fn state(&self) -> ParticleState {
        self.shared.with(|batch| batch.readback().whole_state(self.world)).unwrap_or_default()
    }

    fn spots(&self) -> Vec<Spot> {
        self.shared.with(|batch| {
            let mut spots = batch.readback().spots(self.world).unwrap_or_default();
            let archived = batch.worlds[self.world].reach.iter().flat_map(Reach::archived);
            archived.for_each(|list| spots.extend((0..list.len()).map(|i| list.spot(i))));
            spots
        })
    }

    fn download_where(&self, _: Option<&Aabb>, wanted: &(dyn Fn(&Spot) -> bool + Sync)) -> ParticleState {
        self.shared.with(|batch| {
            let mut state = batch.readback().lists_where(self.world, wanted).unwrap_or_default();
            state.lists.extend(batch.worlds[self.world].reach.iter().flat_map(Reach::archived).map(|mut list| {
                list.retain(wanted);
                list
            }));
            state
        })
    }

    fn read(&self, region: Option<&Aabb>, fields: Fields, origin: Vec3) -> Reading {
        self.shared.with(|batch| {
            let mut reading = Reading::new(fields, origin);
            // Of a device that is lost nothing can be read; who asks is told by the check.
            let _ = batch.readback().read(self.world, region, &mut reading);
            let archived = batch.worlds[self.world].reach.iter().flat_map(Reach::archived);
            archived.for_each(|list| reading.add_list(&list, region));
            reading
        })
    }

    fn sums(&self, materials: &[PlannedMaterial], sought: &[Sought]) -> Result<Vec<Sums>> {
        let look = Look { materials, sought, ..Look::default() };
        let looked = self.shared.with(|batch| batch.look_at(self.world, &[look]))?;
        Ok(looked.into_iter().flat_map(|looked| looked.sums).collect())
    }

    fn sample(&self, counts: &[usize]) -> Vec<Sampled> {
        let look = Look { sample: counts, ..Look::default() };
        let looked = self.shared.with(|batch| batch.look_at(self.world, &[look]));
        // Of a device that is lost nothing can be read; who asks is told by the check.
        looked.unwrap_or_default().into_iter().flat_map(|looked| looked.sample).collect()
    }

    fn heights(&self, points: &[[f64; 2]], bottom: f64) -> Option<Vec<Option<f64>>> {
        let look = Look { points: points.to_vec(), bottom, ..Look::default() };
        let looked = self.shared.with(|batch| batch.look_at(self.world, &[look]));
        looked.unwrap_or_default().pop().and_then(|looked| looked.heights)
    }

    fn untouched(&self, points: &[[f64; 2]]) -> Vec<bool> {
        let batch = self.shared.batch();
        let world = &batch.worlds[self.world];
        match (&world.reach, world.levels.last()) {
            (Some(reach), Some(coarsest)) => reach.untouched(points, coarsest.h),
            _ => vec![false; points.len()],
        }
    }

    fn apart(&self, points: &[Vec3], filter: Filter) -> Result<Option<Apart>> {
        self.shared.with(|batch| batch.apart(self.world, points, filter))
    }

    fn crossed(&self) -> Result<Vec<Crossed>> {
        let batch = self.shared.batch();
        Ok(batch.crossed(self.world)?[..batch.fixed.sections].iter().map(crossed).collect())
    }

    fn pressed(&self) -> Vec<Vec3> {
        let batch = self.shared.batch();
        // Who asks a device that is lost is told by the check.
        let all = batch.crossed(self.world).unwrap_or_default();
        all.iter().skip(batch.fixed.sections).map(pressed_of).collect()
    }

    fn check(&self) -> Result<()> {
        self.shared.batch().gpu.check()
    }

    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        Batch::upload(&mut self.shared, vec![(self.world, particles)])
    }

    fn particle_count(&self) -> usize {
        self.shared.batch().worlds[self.world].particles().len()
    }

    fn account(&self, ledger: &mut Ledger) {
        let lists = self.shared.with(|batch| batch.readback().lists(self.world));
        let batch = self.shared.batch();
        let world = &batch.worlds[self.world];
        if let Ok((lists, ..)) = lists {
            account::add_particles(ledger, &lists, &world.materials, &world.scene);
        }
        let pending = batch.readback().pending_walls(self.world);
        let (slept, kept) = batch.readback().pending_sleep(self.world);
        for d in 0..3 {
            ledger.wall_impulse[d] += world.wall_impulse[d] + pending[d];
            ledger.gravity_impulse[d] += world.gravity_impulse[d] - kept[d];
            ledger.slept_momentum[d] += world.slept.momentum[d] + slept.momentum[d];
        }
        // Who asks a device that is lost is told by the check.
        let probed = batch.crossed(self.world).unwrap_or_default();
        let (sections, parts) = probed.split_at(batch.fixed.sections.min(probed.len()));
        ledger.crossed = sections.iter().map(crossed).collect();
        ledger.pressed = parts.iter().map(pressed_of).collect();
        ledger.damped += world.damped + batch.readback().pending_damped(self.world);
        ledger.slept_kinetic += world.slept.kinetic + slept.kinetic;
        ledger.count("blocks that fell asleep", world.slept.blocks + slept.blocks);
        ledger.count("particles asleep now", batch.readback().asleep(self.world).unwrap_or(0));
        world.adapt.account(ledger);
        if let Some(reach) = &world.reach {
            reach.account(ledger);
        }
        ledger.deleted_mass += world.deleted_mass;
        ledger.count("particles put back into the world", world.clamped);
        ledger.count("particles deleted on leaving", world.deleted);
        ledger.count("steps shortened for speed", world.shortened);
        ledger.count("particles' steps with strain applied in parts", world.parted);
    }

    fn carry_on(&mut self, sums: &Ledger) {
        let mut batch = self.shared.batch();
        batch.worlds[self.world].carry_on(sums);
        // A device that is lost has nothing to go on from; the next step says so.
        let before: Vec<_> = sums.crossed.iter().map(exactly).chain(sums.pressed.iter().map(pressed)).collect();
        let _ = batch.set_crossed(self.world, &before);
    }

    /// Of the whole batch: passes are shared.
    fn timings(&self) -> Vec<Timing> {
        let batch = self.shared.batch();
        let timing = |(name, clock): (&&str, &Clock)| Timing {
            effect: (*name).to_owned(),
            seconds: clock.measured.0 / clock.measured.1.max(1) as f64 * clock.passes as f64,
            passes: clock.passes,
        };
        let mut timings: Vec<_> = batch.clocks.of.iter().map(timing).collect();
        for (effect, (seconds, passes)) in [("contact", batch.contact_seconds), ("adapt", batch.adapt_seconds)] {
            if passes > 0 {
                timings.push(Timing { effect: effect.into(), seconds, passes });
            }
        }
        timings
    }

    /// The world's share of the batch's, by particles.
    fn memory(&self) -> (u64, u64) {
        let batch = self.shared.batch();
        let all: usize = batch.worlds.iter().map(|world| world.particles().len()).sum();
        let own = batch.worlds[self.world].particles().len();
        let share = |bytes: u64| (u128::from(bytes) * own as u128 / all.max(1) as u128) as u64;
        let (particles, grid) = batch.memory.bytes();
        let archived = batch.worlds[self.world].reach.as_ref().map_or(0, Reach::bytes);
        let (particles, grid) =
            if batch.worlds.len() == 1 { (particles, grid) } else { (share(particles), share(grid)) };
        (particles + archived, grid)
    }

    fn transferred(&self) -> (u64, u64) {
        let [times, bytes] = self.shared.batch().gpu.transferred.each_ref().map(|sum| sum.load(Ordering::Relaxed));
        (times, bytes)
    }
}
