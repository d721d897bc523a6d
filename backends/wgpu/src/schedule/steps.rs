//! Steps of the worlds of a batch.

use crate::device::memory::{MAX_SLOTS, MAX_STEPS};
use crate::device::status::Halt;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::bodies::{Driven, go_back};
use crate::schedule::groups::HeldGroup;
use crate::schedule::submission::{FEW_STEPS, FORESEEN, LEAST_STEPS, Outcome, cut};
use crate::worlds::world::{Place, World};
use barchan_core::backend::WorldStep;
use barchan_core::coupling::Moved;
use barchan_core::{Error, Result, StepReport};
use barchan_grid::limits::NODE_MOVE;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Some of the worlds.
pub(crate) fn some_of<'a>(world_steps: &'a mut [WorldStep<'_>], which: impl Fn(usize) -> bool) -> Vec<WorldStep<'a>> {
    let own = world_steps.iter_mut().enumerate().filter(|(t, _)| which(*t));
    own.map(|(_, world_step)| WorldStep {
        world: world_step.world,
        time: world_step.time,
        couplings: &mut *world_step.couplings,
        reports_bodies: world_step.reports_bodies,
    })
    .collect()
}

/// What each of some worlds gives, side by side. One need not wait for a thread.
pub(crate) fn of_each<T: Send, R: Send>(worlds: Vec<T>, give: impl Fn(T) -> R + Send + Sync) -> Vec<R> {
    if worlds.len() == 1 { worlds.into_iter().map(give).collect() } else { worlds.into_par_iter().map(give).collect() }
}

impl WgpuBatch {
    /// Up to `count` steps of at most `dt` of the worlds given, without couplings or with such as run on the device. A world that
    /// fails is left out, and the others go on without it.
    pub(crate) fn advance(
        &mut self,
        mut dt: f64,
        mut count: usize,
        world_steps: &mut [WorldStep<'_>],
        held: &[Vec<HeldGroup>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        self.settle()?;
        let mut failed: Vec<Option<Error>> = world_steps.iter().map(|world_step| self.fault(world_step)).collect();
        loop {
            let going: Vec<usize> = (0..world_steps.len()).filter(|&t| failed[t].is_none()).collect();
            let active: Vec<(usize, f64)> =
                going.iter().map(|&t| (world_steps[t].world, world_steps[t].time)).collect();
            if active.is_empty() {
                return Ok(failed
                    .into_iter()
                    .map(|error| Err(error.expect("no world is left, so each has failed")))
                    .collect());
            }
            let mut stretches = self.plan_stretches(&active, dt, count.min(self.most_at_once(held, dt)));
            let planned = stretches.iter().map(|s| s.steps).sum();
            let stepped = world_steps.iter_mut().enumerate().filter(|(t, _)| failed[*t].is_none());
            let turns = of_each(stepped.collect(), |(t, world_step)| self.drive(world_step, dt, planned, &held[t]));
            let (mut steps, mut driven) = (planned, BTreeMap::new());
            for (&t, of_turn) in going.iter().zip(turns) {
                match of_turn {
                    Ok(of_turn) => {
                        // No further than any of them.
                        steps = of_turn.as_ref().map_or(steps, |driven| steps.min(driven.steps));
                        driven.insert(t, of_turn);
                    }
                    Err(error) => failed[t] = Some(error),
                }
            }
            if driven.len() < going.len() {
                for (t, of_turn) in &driven {
                    go_back(world_steps[*t].couplings, of_turn, 0)?;
                }
                continue;
            }
            cut(&mut stretches, steps);
            self.write_bodies(world_steps, &driven, steps);
            let mut writes = std::mem::take(&mut self.writes);
            self.write_groups(world_steps, held, &mut writes);
            self.write_near(world_steps, &driven, steps)?;
            let outcome = self.submit(&active, dt, &stretches, writes)?;
            if outcome.halt == Some(Halt::Misplaced) {
                self.astray = true;
            } else if active.iter().any(|(w, _)| self.layers_of(*w).any(|l| outcome.status.sorted_before(l).is_some()))
            {
                self.astray = false;
            }
            match outcome.halt {
                Some(Halt::Drifted | Halt::TooStiff) => self.horizon = FEW_STEPS,
                // Levels that follow a body that goes on as it does come after it in as many steps again: those written down behind that are for nothing.
                Some(Halt::Follow) => self.horizon = (outcome.done + outcome.done / 4).max(LEAST_STEPS),
                None if outcome.done == self.horizon => self.horizon = MAX_STEPS.min(2 * self.horizon),
                _ => {}
            }
            // Robots have much to be read: a world each by as many threads as there are.
            let (reader, groups, done) = (self.group_reader(), &outcome.groups[..], outcome.done);
            let stepped = world_steps.iter_mut().enumerate().filter(|(t, _)| failed[*t].is_none());
            let pairs = stepped.map(|(_, world_step)| world_step).zip(driven.values_mut()).collect();
            let taken: Vec<Result<Result<()>>> = of_each(pairs, |(world_step, of_turn)| {
                go_back(world_step.couplings, of_turn, done)?;
                Ok(reader.take_groups(world_step, of_turn, groups, done))
            });
            for (t, taken) in driven.keys().zip(taken) {
                failed[*t] = taken?.err();
                let world = world_steps[*t].world;
                if outcome.status.is_astray(self.layers_of(world)) && self.worlds[world].torn.is_none() {
                    if done == 0 {
                        self.adapt(world, None, world_steps[*t].couplings)?;
                    } else {
                        // It belongs to the next step, whose length is chosen before it: as if that were asked for alone, its sort finds them again.
                        self.worlds[world].be_due();
                    }
                }
            }
            for &t in &going {
                failed[t] = failed[t].take().or_else(|| self.fault(&world_steps[t]));
            }
            if outcome.done > 0 {
                // What stopped the others is found again when they are tried again.
                return self.reports(world_steps, failed, driven, &outcome, dt);
            }
            match outcome.halt {
                Some(Halt::Room) => self.make_room(&outcome.status)?,
                // A sort on its own, or one that others have to follow.
                None | Some(Halt::Fewer | Halt::Misplaced | Halt::Follow) => {}
                Some(Halt::Drifted) if !stretches[0].sort => {}
                // Who asked for the steps decides how long the others are.
                Some(Halt::TooFast) => (dt, count) = (self.shorten(world_steps, &mut failed, &outcome, dt), 1),
                _ => {
                    // It cannot be told whose fault it was only if no particle is named.
                    let culprit = self.readback().world_of(&outcome.status).unwrap_or(active[0].0);
                    let t = going.iter().copied().find(|&t| world_steps[t].world == culprit).unwrap_or(going[0]);
                    failed[t] = Some(self.readback().explain(
                        world_steps[t].world,
                        &outcome.status,
                        f64::NAN,
                        world_steps[t].time,
                    ));
                }
            }
        }
    }

    /// How many steps of `dt` to write down at once.
    fn most_at_once(&self, held: &[Vec<HeldGroup>], dt: f64) -> usize {
        let ahead = held.iter().flatten().map(|group| group.steps_on_leash(dt)).fold(f64::INFINITY, f64::min);
        // Where bodies slow down they come further than it seems.
        if ahead < FORESEEN as f64 { ahead as usize + ahead as usize / 8 + 1 } else { self.horizon }
    }

    /// What is wrong with a world's particles as they came in.
    pub(crate) fn fault(&self, world_step: &WorldStep<'_>) -> Option<Error> {
        let world = &self.worlds[world_step.world];
        if world.spoilt || world.torn.is_some() {
            let torn = world.torn.map(|(dt, bound)| Error::TimeStep {
                step: world.steps,
                dt,
                bound,
                by:
                    "the speed of a particle within a subcycled step: set levels.subcycle = false, or lower time.safety"
                        .into(),
            });
            self.readback().find_non_finite(world_step.world, world_step.time).or(torn)
        } else {
            None
        }
    }

    /// The step that the fastest world bears; worlds that bear none have failed.
    pub(crate) fn shorten(
        &mut self,
        world_steps: &[WorldStep<'_>],
        failed: &mut [Option<Error>],
        outcome: &Outcome,
        dt: f64,
    ) -> f64 {
        let mut fastest = 0.0f64;
        for t in (0..world_steps.len()).filter(|&t| failed[t].is_none()).collect::<Vec<_>>() {
            let WorldStep { world, time, .. } = world_steps[t];
            let speed = outcome.status.speed(0, self.layers_of(world));
            let moves = speed * dt / self.h;
            if !moves.is_finite() {
                failed[t] = Some(self.readback().explain(world, &outcome.status, speed, time));
            } else if moves > NODE_MOVE * (1.0 - 1e-6) {
                self.worlds[world].shortened += 1;
                fastest = fastest.max(moves);
            }
        }
        // What was too fast may have been left out.
        if fastest > 0.0 { dt * (0.9 * NODE_MOVE / fastest).max(0.1) } else { dt }
    }

    /// What each world did in the steps that are done.
    pub(crate) fn reports(
        &mut self,
        world_steps: &mut [WorldStep<'_>],
        failed: Vec<Option<Error>>,
        mut driven: BTreeMap<usize, Option<Driven<'_>>>,
        outcome: &Outcome,
        dt: f64,
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let impulses: &[[f32; 4]] = bytemuck::cast_slice(&outcome.impulses);
        let of_world = |(world_step, driven): (&mut WorldStep<'_>, Option<Driven<'_>>)| {
            let layers = self.layers_of(world_step.world);
            let sorted = outcome.status.sorted_before(layers.start);
            let report = |s: usize| StepReport {
                dt,
                sorted: sorted == Some(s),
                max_speed: outcome.status.speed(s, layers.clone()),
                ..StepReport::default()
            };
            let mut reports: Vec<_> = (0..outcome.done).map(report).collect();
            if let Some(driven) = driven {
                self.report_bodies(driven, impulses, world_step, &mut reports);
            }
            reports
        };
        let worlds = world_steps.iter_mut().enumerate();
        let all = of_each(worlds.map(|(t, world_step)| (world_step, driven.remove(&t).flatten())).collect(), of_world);
        Ok(failed.into_iter().zip(all).map(|(error, reports)| error.map_or(Ok(reports), Err)).collect())
    }

    /// Up to `count` steps of at most `dt` of the worlds given; the others stay as they are. All that succeed take the same steps.
    pub(crate) fn steps(
        &mut self,
        dt: f64,
        count: usize,
        world_steps: &mut [WorldStep<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        for world_step in world_steps.iter().filter(|_| ground) {
            if self.fault(world_step).is_none() {
                self.follow(world_step.world, world_step.couplings)?;
            }
        }
        for world_step in world_steps.iter_mut() {
            self.settle_contact(world_step.world, world_step.couplings)?;
        }
        // Each world's laws are asked on the host after as many of its own steps, whatever the others do.
        let until_asked = |world_step: &WorldStep<'_>| {
            let world = &self.worlds[world_step.world];
            world.ask_after.map_or(MAX_STEPS, |age| age.saturating_sub(world.stiffness_age).max(1) as usize)
        };
        let has_bodies = world_steps.iter().any(|world_step| !world_step.couplings.is_empty());
        let at_once = if has_bodies || self.substeps > 1 { MAX_SLOTS / self.substeps } else { MAX_STEPS };
        let most = world_steps.iter().map(until_asked).fold(at_once, usize::min);
        let hold = |world_step: &mut WorldStep<'_>| match &self.worlds[world_step.world] {
            _ if !ground => None,
            World { contact: Some(Place::Host), .. } => None,
            world if !world.answers() => Some(Vec::new()),
            _ => self.hold_groups(world_step, dt, at_once),
        };
        let held: Vec<Option<Vec<HeldGroup>>> = of_each(world_steps.iter_mut().collect(), hold);
        let is_on_host: Vec<bool> = held.iter().map(Option::is_none).collect();
        if ground && is_on_host.contains(&true) && self.contact.host.is_none() {
            self.contact.host =
                Some(Box::new(crate::passes::bodies::near(&self.gpu, &self.kernels, self.worlds.len())));
        }
        let taken = self.take_steps_where_bodies_are(dt, count.clamp(1, most), world_steps, held, &is_on_host);
        world_steps
            .iter_mut()
            .flat_map(|world_step| world_step.couplings.iter_mut())
            .for_each(|coupling| coupling.move_on_device(Moved::ByCoupling));
        let mut reports = taken?;
        for (world_step, reports) in world_steps.iter().zip(&mut reports) {
            self.report_levels(world_step.world, reports.as_deref_mut().unwrap_or_default());
        }
        for (world_step, _) in world_steps.iter().zip(&reports).filter(|(_, report)| report.is_ok()) {
            self.follow_stiffness(world_step.world)?;
        }
        Ok(reports)
    }

    /// The steps of worlds whose bodies the device moves, and a step of those whose bodies' law runs on the host.
    pub(crate) fn take_steps_where_bodies_are(
        &mut self,
        dt: f64,
        count: usize,
        world_steps: &mut [WorldStep<'_>],
        held: Vec<Option<Vec<HeldGroup>>>,
        is_on_host: &[bool],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        let mut reports = Vec::new();
        if is_on_host.contains(&false) {
            let held: Vec<_> = held.into_iter().flatten().collect();
            // Beside worlds that go a step at a time, all do.
            let by_step = is_on_host.contains(&true) || held.iter().flatten().any(|group| group.in_turns);
            let count = if by_step { 1 } else { count };
            reports = self.advance(dt, count, &mut some_of(world_steps, |t| !is_on_host[t]), &held)?;
        }
        if is_on_host.contains(&true) {
            let taken = reports.iter().flatten().flatten().next().map_or(dt, |report| report.dt);
            let mut world_steps = some_of(world_steps, |t| is_on_host[t]);
            let by_levels = ground && self.substeps > 1;
            let others = reports;
            let own = if by_levels {
                self.step_levels_on_host(taken, &mut world_steps)?
            } else {
                self.step_on_host(taken, &mut world_steps)?
            };
            let (mut own, mut others) = (own.into_iter(), others.into_iter());
            let next = |is_on_host: &bool| if *is_on_host { own.next() } else { others.next() };
            reports = is_on_host.iter().filter_map(next).collect();
        }
        Ok(reports)
    }
}
