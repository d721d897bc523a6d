//! Subcycling: each level takes two steps in one of the next coarser level.
//!
//! A node of the coarser level that the rim of the finer one hands something to ("shared") takes part in both of the finer
//! level's steps: with the momentum p_o and force f_o of its own level's particles, those of the finer level's now (p_s, f_s), and
//! the finer step dt, u = (p_o + p_s + dt (f_o + f_s)) / (m_o + m_s), then p_o becomes m_o u. So every force acts over the same
//! time on both of its ends, and momentum is exact. Particles of the coarser level move with the velocity at the end of their
//! step; with the mean one they would gain energy without bound.

use crate::engine::{CpuEngine, MAX_DRIFT, MAX_MOVE, Pass, at_time};
use crate::level::greater;
use barchan_core::{Coupling, Error, Result, Wrench};
use barchan_grid::transfer::Scalar;
use std::time::Instant;

impl<T: Scalar> CpuEngine<T> {
    /// One step of the coarsest level over `dt` [s], with all the steps of finer levels within. Returns the mean wrenches of the
    /// finest level's steps on each coupling's bodies.
    ///
    /// # Errors
    /// As a step without subcycling; but on an error, finer levels may have gone ahead of coarser ones.
    pub(crate) fn advance_subcycled(
        &mut self,
        time: f64,
        dt: f64,
        couplings: &mut [Box<dyn Coupling>],
    ) -> Result<Vec<Wrench>> {
        let mut wrenches: Vec<_> = couplings.iter().flat_map(|c| c.wrenches()).map(|_| Wrench::default()).collect();
        self.advance_level(self.levels.len() - 1, time, dt, couplings, &mut wrenches)?;
        let steps = f64::from(1 << (self.levels.len() - 1));
        for wrench in &mut wrenches {
            for x in wrench.force.iter_mut().chain(&mut wrench.torque) {
                *x /= steps;
            }
        }
        Ok(wrenches)
    }

    /// One step of a level, with two steps of the next finer one within.
    fn advance_level(
        &mut self,
        l: usize,
        time: f64,
        dt: f64,
        couplings: &mut [Box<dyn Coupling>],
        wrenches: &mut [Wrench],
    ) -> Result<()> {
        // Boundaries of a coarser step are boundaries of finer ones, so this is where tools stand at each.
        if l == 0 {
            for coupling in couplings.iter_mut() {
                coupling.before_step(time, dt)?;
            }
        }
        self.keep_watch(l, couplings);
        self.particles_to_grid(l..l + 1, dt).map_err(|error| at_time(error, time))?;
        let clock = Instant::now();
        let least = self.least_mass();
        self.levels[l].update_grid(self.isa, least, None, l > 0);
        self.clocks.add(Pass::Grid, clock);
        if l > 0 {
            self.halve(l)?;
        }
        if let ([.., level], [coarser, ..]) = self.levels.split_at_mut(l + 1) {
            let clock = Instant::now();
            coarser.solve_shared(&level.grid.handed, least);
            level.prolong(self.isa, &coarser.grid);
            level.max_speed = greater(level.max_speed, coarser.max_speed);
            self.clocks.add(Pass::Prolong, clock);
        }
        if l == 0 {
            self.touch(0, dt, couplings)?;
        } else {
            for half in [0.0, 0.5] {
                self.advance_level(l - 1, time + half * dt, 0.5 * dt, couplings, wrenches)?;
            }
            // Now the level's velocities are whole. Its impulses act over its own step.
            let before: Vec<Wrench> = couplings.iter().flat_map(|c| c.wrenches()).copied().collect();
            if self.touch(l, dt, couplings)? {
                let after = couplings.iter().flat_map(|c| c.wrenches());
                for ((sum, after), before) in wrenches.iter_mut().zip(after).zip(before) {
                    for d in 0..3 {
                        sum.force[d] += f64::from(1 << l) * (after.force[d] - before.force[d]);
                        sum.torque[d] += f64::from(1 << l) * (after.torque[d] - before.torque[d]);
                    }
                }
            }
        }
        let clock = Instant::now();
        let level = &mut self.levels[l];
        level.grid_to_particles(self.isa, dt);
        self.book_sleepers(l, dt);
        self.clocks.add(Pass::G2P, clock);
        self.check_moves(l, dt)?;
        if l == 0 {
            let mut sums = wrenches.iter_mut();
            for coupling in couplings.iter_mut() {
                coupling.after_step(time, dt)?;
                for (wrench, sum) in coupling.wrenches().iter().zip(&mut sums) {
                    for d in 0..3 {
                        sum.force[d] += wrench.force[d];
                        sum.torque[d] += wrench.torque[d];
                    }
                }
            }
        }
        Ok(())
    }

    /// Splits what the shared nodes hold into what they have at the start and what the forces of half a step add.
    fn halve(&mut self, l: usize) -> Result<()> {
        if self.levels[l].grid.shared.is_empty() {
            return Ok(());
        }
        let step = self.step_of(l, 0.0);
        let clock = Instant::now();
        let outcome = self.levels[l].halve(self.isa, &step);
        self.clocks.add(Pass::Restrict, clock);
        outcome.map_err(|stopped| self.explain(l, stopped))
    }

    /// Holds how far a level's particles moved, and how far they have come since they were sorted, to what blocks allow for. A
    /// light node may be faster: it carries nobody that far.
    fn check_moves(&self, l: usize, dt: f64) -> Result<()> {
        let level = &self.levels[l];
        let moved = level.particle_speed * dt / level.h();
        if moved <= MAX_MOVE && level.drift <= MAX_DRIFT {
            return Ok(());
        }
        Err(self.find_non_finite().unwrap_or(Error::TimeStep {
            step: self.steps(),
            dt,
            bound: MAX_MOVE * dt / moved.max(level.drift),
            by: "the speed of a particle within a subcycled step: set levels.subcycle = false, or lower time.safety"
                .into(),
        }))
    }
}
