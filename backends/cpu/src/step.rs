//! The step: the schedule's calls one after the other, and this backend's form of each stage.
//!
//! Subcycled, a node of a coarser level that the rim of the finer one hands something to ("shared") takes part in both of the finer
//! level's steps: with the momentum p_o and force f_o of its own level's particles, those of the finer level's now (p_s, f_s), and
//! the finer step dt, u = (p_o + p_s + dt (f_o + f_s)) / (m_o + m_s), then p_o becomes m_o u. So every force acts over the same
//! time on both of its ends, and momentum is exact. Particles of the coarser level move with the velocity at the end of their
//! step; with the mean one they would gain energy without bound.

use crate::engine::{CpuEngine, Pass};
use crate::faults::{at_time, cannot_go_back};
use crate::level::Level;
use barchan_core::coupling::{Kept, begin_step};
use barchan_core::plan::loaded;
use barchan_core::schedule::{Call, Stage};
use barchan_core::{Coupling, Error, Result, Schedule, Wrench};
use barchan_grid::limits::{MAX_DRIFT, MAX_MOVE, NODE_MOVE, greater};
use barchan_grid::transfer::Scalar;
use rayon::prelude::*;
use std::sync::Arc;
use std::time::Instant;

/// What carries out a stage.
pub(crate) type Forward<T> = fn(&mut CpuEngine<T>, &Call, &mut UnderWay<'_>) -> Result<Next>;

/// How a stage is carried out forwards.
#[derive(Clone, Copy)]
pub(crate) enum Form<T: Scalar> {
    /// By itself.
    Own(Forward<T>),
    /// Between steps, where it is due.
    Upkeep,
}

/// What comes after a call.
pub(crate) enum Next {
    /// The next one.
    Call,
    /// The step begins anew with a shorter one, but for who sleeps in it.
    Shorter,
}

/// The form of a stage, if this backend has one.
pub(crate) fn forward<T: Scalar>(stage: Stage) -> Option<Form<T>> {
    Some(match stage {
        Stage::ARCHIVE | Stage::ADAPT | Stage::SORT => Form::Upkeep,
        Stage::SLEEP => Form::Own(CpuEngine::sleep),
        Stage::P2G => Form::Own(CpuEngine::p2g),
        Stage::GRID_UPDATE => Form::Own(CpuEngine::grid_update),
        Stage::RESTRICT => Form::Own(CpuEngine::restrict),
        Stage::CONTACT => Form::Own(CpuEngine::contact),
        Stage::LIMIT => Form::Own(CpuEngine::limit),
        Stage::BODIES => Form::Own(CpuEngine::move_bodies),
        Stage::PROLONG => Form::Own(CpuEngine::prolong),
        Stage::SIDES => Form::Own(CpuEngine::see_sides),
        Stage::G2P => Form::Own(CpuEngine::g2p),
        Stage::FLUX => Form::Own(CpuEngine::see_crossed),
        Stage::PRESS => Form::Own(CpuEngine::see_pressed),
        _ => return None,
    })
}

/// The calls of a schedule with their forms.
pub(crate) fn calls<T: Scalar>(schedule: &Schedule) -> Arc<[(Call, Forward<T>)]> {
    let own = |call: &Call| match forward(call.stage) {
        Some(Form::Own(form)) => (call.clone(), form),
        _ => unreachable!("a plan with the stage '{}' has been refused", call.stage),
    };
    schedule.step.iter().map(own).collect()
}

/// A step under way.
pub(crate) struct UnderWay<'a> {
    /// When it began, and its length [s].
    time: f64,
    dt: f64,
    couplings: &'a mut [Box<dyn Coupling>],
    /// Were nodes too fast before bodies acted on them?
    is_fast: bool,
    /// The couplings before bodies acted, if that might make nodes too fast.
    saved: Vec<Kept>,
    /// What bodies felt, as a sum over the slots of mean forces and torques; empty if there is one slot only.
    wrenches: Vec<Wrench>,
}

impl UnderWay<'_> {
    fn wrenches_now(&self) -> Vec<Wrench> {
        self.couplings.iter().flat_map(|coupling| coupling.wrenches()).copied().collect()
    }

    fn add_wrenches(&mut self, before: &[Wrench], times: f64) {
        let now = self.couplings.iter().flat_map(|coupling| coupling.wrenches());
        for (i, (sum, now)) in self.wrenches.iter_mut().zip(now).enumerate() {
            sum.add_change(&before.get(i).copied().unwrap_or_default(), now, times);
        }
    }
}

impl<T: Scalar> CpuEngine<T> {
    /// Carries out the schedule from `time` over at most `dt` [s]. Returns the step taken, and the mean wrenches on each coupling's bodies if
    /// these have taken several steps within it.
    ///
    /// # Errors
    /// NaN or infinity, a material's or a coupling's failure, and what moves too far. Subcycled, finer levels may have gone ahead of coarser ones then.
    pub(crate) fn carry_out(
        &mut self,
        time: f64,
        dt: f64,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<(f64, Option<Vec<Wrench>>)> {
        // Couplings know what a single slot came to.
        let summed = couplings.iter().filter(|_| self.is_subcycled()).flat_map(|coupling| coupling.wrenches());
        let wrenches = summed.map(|_| Wrench::default()).collect();
        let mut step = UnderWay { time, dt, couplings, is_fast: false, saved: Vec::new(), wrenches };
        self.carry_out_calls(&mut step)?;
        let mean = |sum: &Wrench| sum.scaled(1.0 / self.schedule.slots as f64);
        let wrenches = self.is_subcycled().then(|| step.wrenches.iter().map(mean).collect());
        Ok((step.dt, wrenches))
    }

    fn carry_out_calls(&mut self, step: &mut UnderWay<'_>) -> Result<()> {
        let calls = Arc::clone(&self.calls);
        let first = calls.iter().position(|(call, _)| call.stage != Stage::SLEEP).unwrap_or(0);
        let mut at = 0;
        while let Some((call, form)) = calls.get(at) {
            at = match form(self, call, step)? {
                Next::Call => at + 1,
                Next::Shorter => first,
            };
        }
        Ok(())
    }

    fn is_subcycled(&self) -> bool {
        self.schedule.slots > 1
    }

    /// Who of the ground at rest is left out.
    fn sleep(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let clock = Instant::now();
        for level in &mut self.levels[call.levels.clone()] {
            level.keep_watch(step.couplings, &mut self.slept);
        }
        self.clocks.add(Pass::Sleep, clock);
        Ok(Next::Call)
    }

    fn p2g(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let time = self.schedule.time_of(call.slot, step.time, step.dt);
        self.particles_to_grid(call.levels.clone(), step.dt).map_err(|error| at_time(error, time))?;
        Ok(Next::Call)
    }

    /// Node sums, gravity, walls, finest level first. Together, each level takes up what the rim of the finer one hands to it in the same pass; subcycled, what
    /// its shared nodes hold is kept back.
    fn grid_update(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let (clock, subcycled) = (Instant::now(), self.is_subcycled());
        let (isa, least) = (self.isa, self.least_mass);
        let mut finer: Option<&mut Level<T>> = None;
        for (l, level) in self.levels.iter_mut().enumerate().take(call.levels.end) {
            let handed = finer.filter(|_| !subcycled).map(|finer| &finer.grid);
            level.update_grid(isa, least, handed, subcycled && l > 0);
            finer = Some(level);
        }
        self.clocks.add(Pass::Grid, clock);
        if !subcycled {
            step.is_fast = self.are_nodes_fast(step)?;
        }
        Ok(Next::Call)
    }

    /// Splits what the shared nodes hold into what they have at the start and what the forces of half a step add. Together, the grid update has done all.
    fn restrict(&mut self, call: &Call, _: &mut UnderWay<'_>) -> Result<Next> {
        let subcycled = self.is_subcycled();
        for l in call.levels.clone().filter(|_| subcycled) {
            if self.levels[l].grid.shared.is_empty() {
                continue;
            }
            let (clock, halved) = (Instant::now(), self.step_of(l, 0.0));
            let outcome = self.levels[l].halve(self.isa, &halved);
            self.clocks.add(Pass::Restrict, clock);
            outcome.map_err(|stopped| self.explain(l, stopped))?;
        }
        Ok(Next::Call)
    }

    /// Velocities of rims, coarsest level first. Together they read what stands behind walls that let go, too; subcycled, the nodes that both levels share
    /// are solved before.
    fn prolong(&mut self, call: &Call, _: &mut UnderWay<'_>) -> Result<Next> {
        let (clock, isa, least, subcycled) = (Instant::now(), self.isa, self.least_mass, self.is_subcycled());
        for l in call.levels.clone().rev() {
            if let ([.., level], [coarser, ..]) = self.levels.split_at_mut(l + 1) {
                if subcycled {
                    coarser.solve_shared(&level.grid.handed, least);
                } else {
                    coarser.mirror_separated();
                }
                level.prolong(isa, coarser);
                level.max_speed = greater(level.max_speed, coarser.max_speed);
            }
        }
        self.clocks.add(Pass::Prolong, clock);
        Ok(Next::Call)
    }

    /// Bodies act on the nodes near them. Impulses on coarser levels act over these levels' own steps.
    fn contact(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let finest = call.levels.start == 0;
        if finest {
            step.saved = if self.is_subcycled() { Vec::new() } else { self.before_contact(step) };
            let time = self.schedule.time_of(call.slot, step.time, step.dt);
            let dt = self.schedule.dt_of(0, step.dt);
            begin_step(step.couplings, time, dt)?;
        }
        for l in call.levels.clone() {
            let before: Vec<Wrench> = if finest { Vec::new() } else { step.wrenches_now() };
            let reached = self.touch(l, self.schedule.dt_of(l, step.dt), step.couplings)?;
            if reached && !finest {
                step.add_wrenches(&before, f64::from(1 << l));
            }
        }
        Ok(Next::Call)
    }

    fn move_bodies(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let time = self.schedule.time_of(call.slot, step.time, step.dt);
        let dt = self.schedule.dt_of(0, step.dt);
        step.couplings.iter_mut().try_for_each(|coupling| coupling.after_step(time, dt))?;
        step.add_wrenches(&[], 1.0);
        Ok(Next::Call)
    }

    fn g2p(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        let (clock, isa, schedule) = (Instant::now(), self.isa, &self.schedule);
        if schedule.slots == 1 {
            self.levels[0].mirror_separated();
        }
        let of_levels = self.levels[call.levels.clone()].par_iter_mut().enumerate();
        of_levels.for_each(|(l, level)| level.grid_to_particles(isa, schedule.dt_of(l, step.dt)));
        for l in call.levels.clone() {
            self.book_sleepers(l, self.schedule.dt_of(l, step.dt));
        }
        self.clocks.add(Pass::G2P, clock);
        Ok(Next::Call)
    }

    /// Who may cross a section of a probe as particles move.
    fn see_sides(&mut self, call: &Call, _: &mut UnderWay<'_>) -> Result<Next> {
        let clock = Instant::now();
        call.levels.clone().for_each(|l| self.flux.see_sides(l, &self.levels[l]));
        self.clocks.add(Pass::Flux, clock);
        Ok(Next::Call)
    }

    /// Who has.
    fn see_crossed(&mut self, call: &Call, _: &mut UnderWay<'_>) -> Result<Next> {
        let clock = Instant::now();
        call.levels.clone().for_each(|l| self.flux.see_crossed(l, &self.levels[l]));
        self.clocks.add(Pass::Flux, clock);
        Ok(Next::Call)
    }

    /// What the step has done to the parts of walls that probes ask about.
    fn see_pressed(&mut self, call: &Call, _: &mut UnderWay<'_>) -> Result<Next> {
        for level in &mut self.levels[call.levels.clone()] {
            for (sum, pressed) in self.pressed.iter_mut().zip(&mut level.pressed) {
                let pressed = std::mem::take(pressed);
                (0..3).for_each(|d| sum[d] += pressed[d]);
            }
        }
        Ok(Next::Call)
    }

    /// Does anything move too far?
    ///
    /// Together, nodes may not. Where ground is squeezed, nodes that hardly weigh anything shoot off into the body that squeezes it, and are held
    /// there: only what is too fast behind bodies' contact has everything repeated with a shorter step.
    ///
    /// Subcycled, particles have moved. A light node may be faster: it carries nobody that far.
    fn limit(&mut self, call: &Call, step: &mut UnderWay<'_>) -> Result<Next> {
        if self.is_subcycled() {
            return call
                .levels
                .clone()
                .try_for_each(|l| self.check_moves(l, self.schedule.dt_of(l, step.dt)))
                .map(|()| Next::Call);
        }
        if step.is_fast {
            self.levels.iter_mut().for_each(|level| level.find_speed(self.least_mass));
        }
        let moves = self.greatest_move(step.dt);
        if moves <= NODE_MOVE * (1.0 + 1e-9) {
            return Ok(Next::Call);
        }
        if !moves.is_finite() || step.saved.is_empty() && !step.is_fast {
            return Err(Error::TimeStep {
                step: self.steps,
                dt: step.dt,
                bound: NODE_MOVE * step.dt / moves,
                by: "the speed that a coupling gave to a node".into(),
            });
        }
        for (coupling, before) in step.couplings.iter_mut().zip(std::mem::take(&mut step.saved)) {
            coupling.go_back(before).map_err(|what| cannot_go_back(&**coupling, what))?;
        }
        self.levels.iter_mut().for_each(Level::forget_walls);
        self.shortened += 1;
        step.dt *= (0.9 * NODE_MOVE / moves).max(0.1);
        Ok(Next::Shorter)
    }

    /// Are nodes too fast for the step, as they are before bodies act on them?
    fn are_nodes_fast(&self, step: &UnderWay<'_>) -> Result<bool> {
        let moves = self.greatest_move(step.dt);
        if moves.is_finite() {
            return Ok(moves > NODE_MOVE);
        }
        let error = self.find_non_finite().unwrap_or_else(|| Error::NonFinite {
            step: self.steps,
            time: step.time,
            field: "node velocity",
            particle: 0,
            list: loaded(&self.materials),
            value: moves,
            count: 0,
        });
        Err(at_time(error, step.time))
    }

    /// How far nodes would carry particles in a step of all levels, in cells of their level.
    fn greatest_move(&self, dt: f64) -> f64 {
        self.levels.iter().fold(0.0, |most, level| greater(level.max_speed * dt / level.h(), most))
    }

    /// The couplings before a step's contact, if that might make nodes too fast; else nothing. A law leaves no more of a node's velocity relative
    /// to a surface than it had, so that it gives a node twice the surface's speed at most.
    fn before_contact(&self, step: &UnderWay<'_>) -> Vec<Kept> {
        let finest = self.levels[0].h();
        let speeds = step.couplings.iter().map(|coupling| coupling.max_speed(step.time, step.dt));
        let bodies = speeds.fold(0.0, f64::max) * step.dt / finest;
        let might = 3f64.sqrt() * self.greatest_move(step.dt) + 2.0 * bodies > NODE_MOVE;
        if might { step.couplings.iter().map(|coupling| coupling.keep()).collect() } else { Vec::new() }
    }

    /// Holds how far a level's particles moved, and how far they have come since they were sorted, to what blocks allow for.
    fn check_moves(&self, l: usize, dt: f64) -> Result<()> {
        let level = &self.levels[l];
        let moved = level.particle_speed * dt / level.h();
        if moved <= MAX_MOVE && level.drift <= MAX_DRIFT {
            return Ok(());
        }
        Err(self.find_non_finite().unwrap_or(Error::TimeStep {
            step: self.steps,
            dt,
            bound: MAX_MOVE * dt / moved.max(level.drift),
            by: "the speed of a particle within a subcycled step: set levels.subcycle = false, or lower time.safety"
                .into(),
        }))
    }
}
