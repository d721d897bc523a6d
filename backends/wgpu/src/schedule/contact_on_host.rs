//! Contact whose law runs on the host: the nodes near the bodies of all worlds, there and back.

use crate::device::kernel::Role;
use crate::device::memory::{NEAR_BLOCK, Writes, read};
use crate::device::status::{AT_START, HALTED, Halt, MOVE, NEAR, Status};
use crate::device::uniforms::StepConstants;
use crate::passes::since_sort::SinceSort;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::near::{Around, Found, Near, are_within, behind, boxes_of, by_world};
use crate::schedule::steps::of_each;
use crate::schedule::submission::Part;
use crate::schedule::{ContactPasses, Dispatch, Passes, around_contact, passes_beside_host};
use crate::worlds::sleep::near_tools;
use crate::worlds::world::World;
use barchan_core::backend::WorldStep;
use barchan_core::coupling::begin_step;
use barchan_core::schedule::ending;
use barchan_core::{Error, Result, Schedule, StepReport, Wrench};
use barchan_grid::limits::{NODE_MOVE, greater};
use rayon::prelude::*;
use std::ops::Range;
use std::time::Instant;

pub(crate) const ON_HOST: &str = "this is called where a law runs on the host, and its memory is made with the batch";
/// Steps that the status knows of where it does: the last one and the one under way.
pub(crate) const STEPS: usize = 2;

/// As many blocks are put into words by one thread at least.
const FEW_BLOCKS: usize = 64;

/// A world in a step whose contact is on the host.
pub(crate) struct HostedStep<'a, 'b> {
    world_step: &'a mut WorldStep<'b>,
    /// The boxes whose nodes were asked for.
    asked: Vec<Around>,
    near: Near,
    /// Greatest node speed [m/s].
    speed: f64,
    sorted: bool,
    /// What bodies felt in the steps of all levels, as a sum over the slots of mean forces and torques.
    wrenches: Vec<Wrench>,
    failed: Option<Error>,
}

impl<'a, 'b> HostedStep<'a, 'b> {
    pub(crate) fn new(world_step: &'a mut WorldStep<'b>, world: &World, failed: Option<Error>) -> Self {
        let (asked, wrenches) = (Vec::new(), Vec::new());
        let near = Near::new(world, world_step.world * world.levels.len());
        Self { world_step, asked, near, speed: 0.0, sorted: false, wrenches, failed }
    }

    pub(crate) fn world(&self) -> usize {
        self.world_step.world
    }

    pub(crate) fn is_going(&self) -> bool {
        self.failed.is_none()
    }

    pub(crate) fn begin(&mut self, time: f64, dt: f64) -> Result<()> {
        begin_step(self.world_step.couplings, time, dt)
    }

    pub(crate) fn end(&mut self, time: f64, dt: f64) -> Result<()> {
        self.world_step.couplings.iter_mut().try_for_each(|coupling| coupling.after_step(time, dt))
    }

    /// The bodies meet the nodes of some levels.
    pub(crate) fn meet(&mut self, levels: Range<usize>, dt: f64) -> Result<()> {
        let reached = self.near.touch(levels, dt, self.world_step.couplings)?;
        self.speed = greater(self.speed, reached);
        Ok(())
    }

    /// Have nodes become no faster than particles bear?
    pub(crate) fn is_slow_enough(&self, most: f64, step: u64, dt: f64) -> Result<()> {
        if self.speed * dt <= most * (1.0 + 1e-9) {
            return Ok(());
        }
        let by = "the speed that a coupling gave to a node".into();
        Err(Error::TimeStep { step, dt, bound: most / self.speed, by })
    }

    pub(crate) fn wrenches_now(&self) -> Vec<Wrench> {
        self.world_step.couplings.iter().flat_map(|coupling| coupling.wrenches().iter().copied()).collect()
    }

    /// What bodies felt since, so many times.
    pub(crate) fn feel(&mut self, before: &[Wrench], times: f64) {
        let now = self.wrenches_now();
        self.wrenches.resize(now.len(), Wrench::default());
        for (i, (sum, now)) in self.wrenches.iter_mut().zip(&now).enumerate() {
            sum.add_change(&before.get(i).copied().unwrap_or_default(), now, times);
        }
    }
}

/// Lets something happen to the worlds that go on, side by side; those that it fails for go on no more.
pub(crate) fn side_by_side(
    hosted_steps: &mut [HostedStep<'_, '_>],
    happen: impl Fn(&mut HostedStep<'_, '_>) -> Result<()> + Sync,
) {
    let going = hosted_steps.iter_mut().filter(|hosted| hosted.is_going());
    of_each(going.collect(), |hosted| hosted.failed = happen(hosted).err());
}

impl WgpuBatch {
    /// One step of the worlds given, whose couplings' law runs on the host, or that have no particles. A world that fails is left
    /// out, and the others go on without it.
    ///
    /// 1. What is due is sorted, particles give to nodes, and the nodes near the bodies of all worlds come to the host, in one submission: the
    ///    only one that is waited for. If it turns out that a sort or a shorter step was called for, it is repeated: particles are as they were.
    /// 2. Couplings fix their bodies' velocities, meet the nodes and move, the worlds side by side.
    /// 3. Nodes go back, and particles take their velocities; what that came to stays on the device until the next step.
    pub(crate) fn step_on_host(
        &mut self,
        mut dt: f64,
        world_steps: &mut [WorldStep<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        let mut hosted_steps = self.hosted_steps(world_steps);
        if ground {
            dt = self.bring_near(dt, &mut hosted_steps)?;
        }
        side_by_side(&mut hosted_steps, |hosted| hosted.begin(hosted.world_step.time, dt));
        if ground {
            self.fetch(0..self.levels, &mut hosted_steps)?;
        }
        let begun = Instant::now();
        let (levels, most, steps) = (self.levels, NODE_MOVE * self.h, self.steps_so_far());
        side_by_side(&mut hosted_steps, |hosted| {
            hosted.meet(0..levels, dt)?;
            hosted.is_slow_enough(most, steps[hosted.world()], dt)?;
            hosted.end(hosted.world_step.time, dt)
        });
        self.book_contact(begun);
        if ground {
            self.nodes_to_ground(dt, &hosted_steps)?;
        }
        let mut reports = Vec::new();
        for hosted in hosted_steps {
            let world = &mut self.worlds[hosted.world()];
            reports.push(if let Some(error) = hosted.failed {
                Err(error)
            } else {
                if ground {
                    world.book_gravity(hosted.world_step.time, dt, 1);
                    world.stiffness_age += 1;
                }
                world.steps += 1;
                world.last_dt = dt;
                let (sorted, max_speed) = (hosted.sorted, hosted.speed);
                Ok(vec![StepReport { dt, sorted, max_speed, ..StepReport::default() }])
            });
        }
        Ok(reports)
    }

    /// As [`step_on_host`](Self::step_on_host), where levels take steps of their own: bodies meet the finest level in each slot, which is a step
    /// of it, and coarser ones where theirs end, as in the backend cpu's `subcycle.rs`. A submission is waited for in each slot, and at the end.
    pub(crate) fn step_levels_on_host(
        &mut self,
        dt: f64,
        world_steps: &mut [WorldStep<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let mut hosted_steps = self.hosted_steps(world_steps);
        self.settle()?;
        let (each, steps) = (dt / self.substeps as f64, self.steps_so_far());
        for slot in 0..self.substeps {
            let late =
                |schedule: &Schedule, hosted: &HostedStep<'_, '_>| schedule.time_of(slot, hosted.world_step.time, dt);
            let before = going(&hosted_steps);
            side_by_side(&mut hosted_steps, |hosted| hosted.begin(late(&self.schedule, hosted), each));
            self.slot_to_nodes(dt, slot, &mut hosted_steps)?;
            let begun = Instant::now();
            side_by_side(&mut hosted_steps, |hosted| {
                hosted.meet(0..1, each)?;
                hosted.end(late(&self.schedule, hosted), each)?;
                hosted.feel(&[], 1.0);
                Ok(())
            });
            let coarser = 1..ending(self.levels, slot).end;
            if !coarser.is_empty() {
                self.fetch(coarser.clone(), &mut hosted_steps)?;
            }
            side_by_side(&mut hosted_steps, |hosted| {
                for l in coarser.clone() {
                    let (times, before) = (f64::from(1 << l), hosted.wrenches_now());
                    hosted.meet(l..l + 1, times * each)?;
                    hosted.feel(&before, times);
                }
                // How far particles move is what counts.
                hosted.is_slow_enough(f64::MAX, steps[hosted.world()], each)
            });
            self.book_contact(begun);
            // Particles have moved in the slots before.
            let now = going(&hosted_steps);
            for (w, _) in before.into_iter().filter(|one| slot > 0 && !now.contains(one)) {
                self.worlds[w].torn.get_or_insert((dt, 0.5 * dt));
            }
        }
        let active = going(&hosted_steps);
        if !active.is_empty() {
            let status = self.run_slot(dt, self.substeps, false, &mut hosted_steps)?;
            active.iter().for_each(|&(w, time)| self.take_steps(&status, w, time, dt, 1));
        }
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            hosted.failed = self.fault(hosted.world_step);
        }
        let mean = |sum: &Wrench| sum.scaled(1.0 / self.substeps as f64);
        let report = |hosted: HostedStep<'_, '_>| {
            let wrenches = Some(hosted.wrenches.iter().map(mean).collect());
            let (sorted, max_speed) = (hosted.sorted, hosted.speed);
            let report = StepReport { dt, sorted, max_speed, wrenches, ..StepReport::default() };
            hosted.failed.map_or(Ok(vec![report]), Err)
        };
        Ok(hosted_steps.into_iter().map(report).collect())
    }

    /// From where bodies have met the ground in the slot before, to where nodes are near them in this one.
    pub(crate) fn slot_to_nodes(
        &mut self,
        dt: f64,
        slot: usize,
        hosted_steps: &mut [HostedStep<'_, '_>],
    ) -> Result<()> {
        let levels = ending(self.levels, slot);
        let boxes = |hosted: &mut HostedStep<'_, '_>| {
            // Bodies will have moved when they meet coarser levels.
            let margin = if levels.len() > 1 { self.h } else { 0.0 };
            hosted.asked = boxes_of(hosted.world_step, margin);
        };
        hosted_steps.iter_mut().filter(|hosted| hosted.is_going()).for_each(boxes);
        self.write_near_tools(slot, hosted_steps)?;
        let mut sort = false;
        loop {
            let active = going(hosted_steps);
            let Some(&(first, _)) = active.first() else { return Ok(()) };
            self.write_around(levels.clone(), hosted_steps)?;
            let status = self.run_slot(dt, slot, sort, hosted_steps)?;
            match status.halt() {
                None => {
                    for hosted in
                        hosted_steps.iter_mut().filter(|hosted| hosted.is_going() && !hosted.speed.is_finite())
                    {
                        hosted.failed = Some(self.readback().explain(
                            hosted.world(),
                            &status,
                            hosted.speed,
                            hosted.world_step.time,
                        ));
                    }
                    return Ok(());
                }
                // Only the first slot of a step is halted.
                Some(halt) => self.mend(halt, &status, &mut sort, first, hosted_steps)?,
            }
        }
    }

    /// What makes a submission possible that was halted before particles moved.
    pub(crate) fn mend(
        &mut self,
        halt: Halt,
        status: &Status,
        sort: &mut bool,
        first: usize,
        hosted_steps: &mut [HostedStep<'_, '_>],
    ) -> Result<()> {
        match halt {
            Halt::Fewer => {}
            Halt::Drifted if !*sort => *sort = true,
            Halt::Room | Halt::Misplaced => {
                if halt == Halt::Room {
                    self.make_room(status)?;
                }
                let is_astray = |hosted: &&HostedStep<'_, '_>| status.is_astray(self.layers_of(hosted.world()));
                let astray: Vec<_> = hosted_steps.iter().filter(is_astray).collect();
                astray
                    .into_iter()
                    .try_for_each(|hosted| self.adapt(hosted.world(), None, hosted.world_step.couplings))?;
            }
            _ => {
                let culprit = self.readback().world_of(status).unwrap_or(first);
                if let Some(hosted) = hosted_steps.iter_mut().find(|hosted| hosted.world() == culprit) {
                    hosted.failed = Some(self.readback().explain(culprit, status, f64::NAN, hosted.world_step.time));
                }
            }
        }
        Ok(())
    }

    /// Runs the passes from where bodies met the ground in the slot before a slot to where they meet it in that one, or, behind the last slot, to
    /// the end of the step.
    pub(crate) fn run_slot(
        &mut self,
        dt: f64,
        slot: usize,
        sort: bool,
        hosted_steps: &mut [HostedStep<'_, '_>],
    ) -> Result<Status> {
        let active = going(hosted_steps);
        let sort = slot == 0 && (sort || self.is_any_due(&active));
        if sort {
            self.cover_blocks(1)?;
        }
        self.write_layers(&self.layers(|w| active.iter().any(|a| a.0 == w)));
        let words = self.memory.words();
        if slot == 0 {
            self.write_words(HALTED, &AT_START);
            let sums = words.of_sum(0, 0);
            self.write_words(sums, &self.fresh(sums, 0..1, dt, &active));
        }
        let changed = self.write_changed(hosted_steps);
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let before = self.memory.now;
        let measures = (self.h, self.fixed.gravity.0);
        let contact = ContactPasses::on_host();
        let mut passes = Passes::new(&self.kernels, contact, &self.schedule, before, measures);
        let step = passes.constants(dt);
        if sort {
            passes.sort(dt);
        }
        let mut starts = vec![0];
        for one in 0..self.substeps {
            let (before, after) = around_contact(&self.schedule, one);
            passes.carry_out(before, dt);
            starts.push(passes.dispatches.len());
            passes.carry_out(after, dt);
        }
        passes.look_for_soft(dt);
        let end = starts.get(slot + 1).copied().unwrap_or(passes.dispatches.len());
        let own = passes.dispatches.drain(starts[slot]..end).collect::<Vec<_>>();
        passes.dispatches.clear();
        passes.run(step, Some(&near.scatter).filter(|_| changed > 0));
        passes.dispatches.extend(own);
        if slot < self.substeps {
            passes.run(step, &near.gather);
        } else {
            passes.run(step, &self.kernels.set.collect);
        }
        self.write_steps(0, &passes.constants);
        let parts = self.with_groups(vec![Part { sorting: sort.then_some(before), dispatches: passes.dispatches }]);
        let room = if slot < self.substeps { self.near_expected() } else { 0 };
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        if slot == 0 {
            self.take_blocks(&status);
        }
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            let layers = self.layers_of(hosted.world());
            hosted.sorted = status.sorted_before(layers.start).is_some();
            hosted.speed = greater(hosted.speed, status.speed(0, layers));
        }
        if slot < self.substeps && status.halt().is_none() {
            self.hand_out(&status, of_nodes, hosted_steps)?;
        }
        Ok(status)
    }

    pub(crate) fn hosted_steps<'a, 'b>(&self, world_steps: &'a mut [WorldStep<'b>]) -> Vec<HostedStep<'a, 'b>> {
        let hosted = |world_step: &'a mut WorldStep<'b>| {
            let failed = self.fault(world_step);
            let world = &self.worlds[world_step.world];
            HostedStep::new(world_step, world, failed)
        };
        world_steps.iter_mut().map(hosted).collect()
    }

    pub(crate) fn steps_so_far(&self) -> Vec<u64> {
        self.worlds.iter().map(|world| world.steps).collect()
    }

    pub(crate) fn book_contact(&mut self, begun: Instant) {
        self.contact_seconds.0 += begun.elapsed().as_secs_f64();
        self.contact_seconds.1 += 1;
    }

    /// Particles give to nodes, and the nodes near bodies come to the host. Returns the step that all worlds bear [s].
    pub(crate) fn bring_near(&mut self, mut dt: f64, hosted_steps: &mut [HostedStep<'_, '_>]) -> Result<f64> {
        let mut sort = false;
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            hosted.asked = boxes_of(hosted.world_step, 0.0);
        }
        self.write_near_tools(1, hosted_steps)?;
        loop {
            let active = going(hosted_steps);
            let Some(&(first, _)) = active.first() else { return Ok(dt) };
            let status = self.ground_to_nodes(dt, sort, hosted_steps)?;
            if let Some(halt) = status.halt() {
                self.mend(halt, &status, &mut sort, first, hosted_steps)?;
                continue;
            }
            let shorter = self.bearable(hosted_steps, &status, dt);
            if shorter == dt && going(hosted_steps).len() == active.len() {
                return Ok(dt);
            }
            dt = shorter;
        }
    }

    /// Brings those nodes near bodies that have not come, since bodies reach further than they did when nodes were asked for.
    pub(crate) fn fetch(&mut self, levels: Range<usize>, hosted_steps: &mut [HostedStep<'_, '_>]) -> Result<()> {
        let mut is_here = true;
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            let boxes = boxes_of(hosted.world_step, 0.0);
            if !are_within(&boxes, &hosted.asked) {
                (hosted.asked, is_here) = (boxes, false);
            }
        }
        if is_here {
            return Ok(());
        }
        self.write_around(levels, hosted_steps)?;
        self.write_words(NEAR, &[0]);
        let words = self.gather()?;
        self.give_each(&words, hosted_steps);
        Ok(())
    }

    /// The step that the fastest world bears; worlds that bear none have failed.
    pub(crate) fn bearable(&mut self, hosted_steps: &mut [HostedStep<'_, '_>], status: &Status, mut dt: f64) -> f64 {
        let asked = dt;
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            let moves = hosted.speed * asked / self.h;
            if !moves.is_finite() {
                hosted.failed =
                    Some(self.readback().explain(hosted.world(), status, hosted.speed, hosted.world_step.time));
            } else if moves > NODE_MOVE {
                self.worlds[hosted.world()].shortened += 1;
                dt = dt.min(asked * (0.9 * NODE_MOVE / moves).max(0.1));
            }
        }
        dt
    }

    /// Tells the device the boxes around bodies, as cells of each of some levels.
    pub(crate) fn write_around(&mut self, levels: Range<usize>, hosted_steps: &[HostedStep<'_, '_>]) -> Result<()> {
        let most = hosted_steps.iter().map(|hosted| hosted.asked.len()).max().unwrap_or(0).max(1);
        self.memory.add_near(&self.gpu, most, 64 * self.worlds.len())?;
        // A box that holds nothing.
        let none = [[i32::MAX / 4, i32::MAX / 4, i32::MAX / 4, 0], [i32::MIN / 4, i32::MIN / 4, i32::MIN / 4, 0]];
        let mut vectors = vec![[most as i32, 0, 0, 0]];
        vectors.extend(std::iter::repeat_n(none, self.memory.words().layers * most).flatten());
        for hosted in hosted_steps.iter().filter(|hosted| hosted.is_going()) {
            for l in levels.clone() {
                let (layer, h) = (self.layers_of(hosted.world()).start + l, self.worlds[hosted.world()].levels[l].h);
                for (b, Around { bounds, reach }) in hosted.asked.iter().enumerate() {
                    let one = bounds.grown(reach * h);
                    // Nodes stand at the centres of cells; which of them are inside, the host finds out.
                    let node = |x: f64, round: fn(f64) -> f64| round(x / h - 0.5).clamp(-1e9, 1e9) as i32;
                    let [x, y, z] = one.min.map(|x| node(x, f64::floor));
                    let at = 1 + 2 * (layer * most + b);
                    // Particles are asked for where they are looked at.
                    vectors[at] = [x, y, z, i32::from(*reach > 0.0)];
                    let [x, y, z] = one.max.map(|x| node(x, f64::ceil));
                    vectors[at + 1] = [x, y, z, 0];
                }
            }
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Around, 0), 0, bytemuck::cast_slice(&vectors));
        Ok(())
    }

    /// Tells the device near what nothing sleeps in a step.
    pub(crate) fn write_near_tools(&mut self, step: usize, hosted_steps: &[HostedStep<'_, '_>]) -> Result<()> {
        let mut near = vec![Vec::new(); self.memory.words().layers];
        for hosted in hosted_steps {
            let own = near_tools(hosted.world_step.couplings, &self.worlds[hosted.world()].levels);
            near[self.layers_of(hosted.world())].clone_from_slice(&own);
        }
        self.write_tools(step, &[near])
    }

    /// Are worlds due to be sorted, as far as is known?
    pub(crate) fn is_any_due(&self, active: &[(usize, f64)]) -> bool {
        let is_due = |world: &World| world.levels.iter().any(|level| world.likely(level).is_due(self.most_drift));
        self.unlinked || active.iter().any(|(w, _)| is_due(&self.worlds[*w]))
    }

    /// The nodes that have come, to the worlds whose they are.
    pub(crate) fn hand_out(
        &mut self,
        status: &Status,
        of_nodes: Vec<u32>,
        hosted_steps: &mut [HostedStep<'_, '_>],
    ) -> Result<()> {
        let words = self.found_near(status, of_nodes)?;
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            let world = hosted.world();
            hosted.near = Near::new(&self.worlds[world], self.layers_of(world).start);
        }
        self.give_each(&words, hosted_steps);
        Ok(())
    }

    /// What has been gathered, to the worlds whose it is.
    fn give_each(&self, words: &[u32], hosted_steps: &mut [HostedStep<'_, '_>]) {
        let gathered = by_world(bytemuck::cast_slice(words), &self.worlds);
        side_by_side(hosted_steps, |hosted| {
            hosted.near.take(Found::of(&gathered[hosted.world()]));
            Ok(())
        });
    }

    /// Hands back the blocks of nodes that have changed; how many there are.
    pub(crate) fn write_changed(&self, hosted_steps: &[HostedStep<'_, '_>]) -> usize {
        let going = hosted_steps.iter().filter(|hosted| hosted.is_going());
        let blocks: Vec<_> = going.flat_map(|hosted| &hosted.near.blocks).filter(|block| block.changed).collect();
        let count = blocks.len();
        let mut changed = vec![[0; 4]; NEAR_BLOCK * count];
        let pairs = changed.par_chunks_exact_mut(NEAR_BLOCK).with_min_len(FEW_BLOCKS).zip(blocks);
        pairs.for_each(|(words, block)| words.iter_mut().zip(block.words()).for_each(|(to, from)| *to = from));
        self.write_words(NEAR, &[0, count as u32]);
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Near, 0), 0, bytemuck::cast_slice(&changed));
        count
    }

    /// A sort if one is asked for or likely to be due, P2G and the grid update; brings back the status and the nodes near bodies.
    pub(crate) fn ground_to_nodes(
        &mut self,
        dt: f64,
        sort: bool,
        hosted_steps: &mut [HostedStep<'_, '_>],
    ) -> Result<Status> {
        let active = going(hosted_steps);
        let sort = sort || self.is_any_due(&active);
        if sort {
            self.cover_blocks(1)?;
        }
        self.write_around(0..self.levels, hosted_steps)?;
        // The last step's numbers stand in the words of step 0.
        let mut layers = self.layers(|w| active.iter().any(|a| a.0 == w));
        for (layer, of_layer) in layers.iter_mut().enumerate() {
            if !self.worlds[layer / self.levels].pending {
                of_layer.age = of_layer.age.wrapping_sub(1);
            }
        }
        self.write_layers(&layers);
        // What particles need has not been seen when the step is chosen: the next one takes it into account.
        self.write_steps(1, &[StepConstants { most_need: f32::MAX, ..self.step_constants(dt, 1) }]);
        let words = self.memory.words();
        self.write_words(HALTED, &AT_START);
        self.write_words(NEAR, &[0]);
        if self.worlds.iter().any(|world| world.pending) {
            for w in (0..self.worlds.len()).filter(|w| !self.worlds[*w].pending) {
                self.write_words(words.of_step(0, self.layers_of(w).start, 0), &drifts(&self.worlds[w], 0));
            }
        } else {
            let sums = words.of_sum(0, 0);
            self.write_words(sums, &vec![0; words.of_sum(words.layers, 0) - sums]);
            let drifts: Vec<u32> = self.worlds.iter().flat_map(|world| drifts(world, 0)).collect();
            self.write_words(words.of_step(0, 0, 0), &drifts);
        }
        let from = words.of_step(1, 0, 0);
        self.write_words(from, &self.fresh(from, 1..2, dt, &active));
        self.write_words(words.fast(1), &[0]);

        let near = self.contact.host.as_ref().expect(ON_HOST);
        let before = self.memory.now;
        let sorting = sort.then_some(before);
        let now = if sort { 1 - before } else { before };
        let kernels = &self.kernels;
        let sorts = kernels.set.sort.iter().filter(|_| sort).map(|kernel| Dispatch {
            kernel,
            now: before,
            step: 1,
            end: self.levels,
        });
        let (calls, _) = around_contact(&self.schedule, 0);
        let passes = passes_beside_host(&kernels.set, &self.schedule, calls).chain(&near.gather);
        let dispatches =
            sorts.chain(passes.map(|kernel| Dispatch { kernel, now, step: 1, end: self.levels })).collect();
        let parts = self.with_groups(vec![Part { sorting, dispatches }]);
        let room = self.near_expected();
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        self.take_pending(&status);
        self.take_blocks(&status);
        for hosted in hosted_steps.iter_mut().filter(|hosted| hosted.is_going()) {
            let layers = self.layers_of(hosted.world());
            if status.sorted_before(layers.start).is_some() {
                self.worlds[hosted.world()].levels.iter_mut().for_each(|level| level.since_sort = SinceSort::default());
                hosted.sorted = true;
            }
            hosted.speed = status.speed(1, layers);
        }
        if status.halt().is_none() {
            self.hand_out(&status, of_nodes, hosted_steps)?;
        }
        Ok(status)
    }

    /// As many blocks as are brought back with the status: a quarter more than there were.
    pub(crate) fn near_expected(&self) -> usize {
        (self.near_blocks + self.near_blocks / 4 + 16).min(self.memory.near())
    }

    /// All that a gathering has found. If that is more than was expected, it is asked for; if more than there is room for, gathered again.
    pub(crate) fn found_near(&mut self, status: &Status, mut of_nodes: Vec<u32>) -> Result<Vec<u32>> {
        let count = status.words[NEAR] as usize;
        self.near_blocks = count;
        if count > self.memory.near() {
            self.memory.add_near(&self.gpu, 0, count + count / 4)?;
            self.write_words(NEAR, &[0]);
            return self.gather();
        }
        let (here, wanted) = (of_nodes.len(), 4 * NEAR_BLOCK * count);
        if wanted > here {
            let rest = wanted - here;
            of_nodes.extend(read::<u32>(&self.gpu, self.memory.buffer(Role::Near, 0), 4 * here as u64, rest)?);
        }
        of_nodes.truncate(wanted);
        Ok(of_nodes)
    }

    /// Gathers what is in the boxes on its own.
    pub(crate) fn gather(&mut self) -> Result<Vec<u32>> {
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let (now, end) = (self.memory.now, self.levels);
        let dispatches = near.gather.iter().map(|kernel| Dispatch { kernel, now, step: 1, end }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let room = self.near_expected();
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        self.found_near(&status, of_nodes)
    }

    /// Takes in the numbers of a step that were still on the device.
    pub(crate) fn take_pending(&mut self, status: &Status) {
        for w in 0..self.worlds.len() {
            if !std::mem::take(&mut self.worlds[w].pending) {
                continue;
            }
            let layers = self.layers_of(w);
            let world = &mut self.worlds[w];
            for (layer, level) in layers.zip(&mut world.levels) {
                let moved = status.in_step(0, layer, MOVE);
                level.since_sort = level.since_sort.after(moved);
                level.particle_speed = f64::from(moved) * level.h / world.last_dt;
            }
            self.take_sums(status, w);
            self.take_needs(status, w, 0);
        }
    }

    /// Asks for the numbers of a step that are still on the device.
    pub(crate) fn settle(&mut self) -> Result<()> {
        if self.worlds.iter().any(|world| world.pending) {
            let words = self.memory.words();
            let found = read(&self.gpu, self.memory.buffer(Role::Status, 0), 0, words.count(STEPS))?;
            self.take_pending(&Status::new(found, words));
        }
        Ok(())
    }

    /// Nodes go back, and particles take their velocities. What it came to stays on the device until the next step asks for it.
    pub(crate) fn nodes_to_ground(&mut self, dt: f64, hosted_steps: &[HostedStep<'_, '_>]) -> Result<()> {
        let active = going(hosted_steps);
        if active.is_empty() {
            return Ok(());
        }
        let goes = |hosted: &&HostedStep<'_, '_>| hosted.is_going();
        let speed_of =
            |w: usize| hosted_steps.iter().filter(goes).find(|hosted| hosted.world() == w).map(|hosted| hosted.speed);
        let speeds: Vec<_> = (0..self.worlds.len()).map(|w| speed_of(w).unwrap_or(0.0) as f32).collect();
        let words = self.memory.words();
        self.write_steps(0, &[self.step_constants(dt, 0)]);
        let sums = words.of_sum(0, 0);
        self.write_words(sums, &vec![0; words.of_sum(words.layers, 0) - sums]);
        let of_world = |(world, speed): (&World, &f32)| drifts(world, speed.to_bits());
        let drifts: Vec<u32> = self.worlds.iter().zip(&speeds).flat_map(of_world).collect();
        // Nodes that were too fast have been found out by now.
        self.write_words(words.fast(0), &[0]);
        self.write_words(words.of_step(0, 0, 0), &drifts);
        if active.len() < hosted_steps.len() {
            self.write_layers(&self.layers(|w| speed_of(w).is_some()));
        }
        let count = self.write_changed(hosted_steps);
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let (kernels, now) = (&self.kernels.set, self.memory.now);
        let back = Some(&near.scatter).filter(|_| count > 0).into_iter();
        let (_, calls) = around_contact(&self.schedule, 0);
        let passes = back
            .chain(passes_beside_host(kernels, &self.schedule, calls))
            .chain(kernels.soft())
            .chain(&kernels.collect);
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 0, end: self.levels }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (part, groups) in &parts {
            part.dispatches.iter().for_each(|d| self.clocks.of.entry(d.kernel.name).or_default().passes += 1);
            let dispatches: Vec<_> = part.dispatches.iter().zip(groups.iter().copied()).collect();
            Self::encode(&self.gpu, &mut encoder, &mut self.memory, &dispatches, None);
        }
        self.gpu.queue.submit([encoder.finish()]);
        self.gpu.check()?;
        active.iter().for_each(|(w, _)| self.worlds[*w].pending = true);
        Ok(())
    }
}

/// The worlds that go on, and their times [s].
pub(crate) fn going(hosted_steps: &[HostedStep<'_, '_>]) -> Vec<(usize, f64)> {
    hosted_steps
        .iter()
        .filter(|hosted| hosted.is_going())
        .map(|hosted| (hosted.world(), hosted.world_step.time))
        .collect()
}

/// Words of a world's levels in a step that begins, with that greatest node speed.
pub(crate) fn drifts(world: &World, speed: u32) -> Vec<u32> {
    world.levels.iter().flat_map(|level| [speed, 0, level.since_sort.drift.to_bits(), 0]).collect()
}
