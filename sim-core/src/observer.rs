//! Observers: what looks at a run while it goes on.

use crate::{Result, Simulation, StepReport};
use std::path::PathBuf;

/// Sees a simulation at its own interval, and may add columns to the trace, files and pictures.
///
/// Whoever runs a simulation calls, for all observers in their order: [`observe`](Self::observe) at the start and then after the first step at or past
/// each multiple of the [`interval`](Self::interval); [`stepped`](Self::stepped) after steps; [`finish`](Self::finish) at the end, after an
/// error too. No step is shortened for an observer and none is of another length: a run with observers has the bits of a run without.
///
/// A registry makes those that are [registered](crate::Registry::add_observer) for every run; a program may also hand its own to a run.
pub trait Observer {
    /// Name: of its folder and for messages. Letters, digits, `-` and `_`.
    fn name(&self) -> &str;
    /// Simulated seconds from one look to the next; 0: after every step, which costs a device that could take many at once; infinite: at the start alone.
    fn interval(&self) -> f64;
    /// Columns that it adds to the trace, such as `depth [m]`.
    fn columns(&self) -> Vec<String> {
        Vec::new()
    }
    /// Looks at the simulation as it is.
    ///
    /// # Errors
    /// What it cannot do without: the run ends, and what was simulated until then is saved.
    fn observe(&mut self, simulation: &Simulation, output: &mut dyn Output) -> Result<()>;
    /// Takes note of steps that have been taken, from `from` (time [s], number of the last step before them), after a look that was due.
    ///
    /// # Errors
    /// As [`observe`](Self::observe).
    fn stepped(
        &mut self,
        simulation: &Simulation,
        from: (f64, u64),
        reports: &[StepReport],
        output: &mut dyn Output,
    ) -> Result<()> {
        let _ = (simulation, from, reports, output);
        Ok(())
    }
    /// The run has ended.
    ///
    /// # Errors
    /// As [`observe`](Self::observe).
    fn finish(&mut self, simulation: &Simulation, output: &mut dyn Output) -> Result<()> {
        let _ = (simulation, output);
        Ok(())
    }
}

/// Where an observer puts what it has seen.
pub trait Output {
    /// Sets one of its columns in the trace, by its number among [`Observer::columns`], in the row of the last step. It is empty in rows of steps after
    /// which nobody has set it; the start has no row.
    fn set(&mut self, column: usize, value: f64);
    /// A path to write a file to, of a name of letters, digits, `.`, `-` and `_`: in a folder of its own among the run's output. What an earlier look has written
    /// under that name is overwritten.
    ///
    /// # Errors
    /// [`Error::Io`](crate::Error::Io) if it cannot be made, or if something lies there that is not the run's; [`Error::Body`](crate::Error::Body) for another
    /// name.
    fn file(&mut self, name: &str) -> Result<PathBuf>;
}

/// When something that comes again and again is due next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Every {
    interval: f64,
    next: u64,
}

impl Every {
    /// What times are rounded by, in intervals.
    const ROUNDING: f64 = 1e-9;

    /// Due at each multiple of an interval [s], at 0 too; infinite: at 0 alone.
    pub fn new(interval: f64) -> Self {
        Self { interval, next: 0 }
    }

    /// The same for what goes on after a time at which it has been done.
    #[must_use]
    pub fn after(mut self, time: f64) -> Self {
        self.done(time);
        self
    }

    /// The time from which on it is due [s].
    pub fn due(&self) -> f64 {
        match (self.next, self.interval) {
            (0, _) => f64::NEG_INFINITY,
            (_, interval) if interval > 0.0 => (self.next as f64 - Self::ROUNDING) * interval,
            _ => f64::NEG_INFINITY,
        }
    }

    /// How often an interval has begun before the next one is due.
    pub fn number(&self) -> u64 {
        self.next
    }

    /// Takes note that it has been done at a time [s]: a step longer than the interval skips what it has passed.
    pub fn done(&mut self, time: f64) {
        let passed =
            if self.interval > 0.0 { (time / self.interval + Self::ROUNDING).floor() as u64 } else { self.next };
        self.next = passed + 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_again_is_due_at_the_first_step_at_or_past_its_time() {
        let mut every = Every::new(0.1);
        let mut seen = Vec::new();
        for step in 0..=10 {
            let time = 0.03 * f64::from(step);
            if time >= every.due() {
                seen.push((every.number(), step));
                every.done(time);
            }
        }
        assert_eq!(seen, [(0, 0), (1, 4), (2, 7), (3, 10)]);
        // A long step skips.
        every.done(0.75);
        assert_eq!((every.number(), Every::new(0.1).after(0.75).number()), (8, 8));
        assert!(Every::new(f64::INFINITY).after(3.0).due().is_infinite());
        assert!(Every::new(0.0).after(3.0).due() < 0.0);
    }
}
