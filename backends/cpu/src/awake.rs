//! Keeps the threads of a pool awake from one parallel loop to the next.
//!
//! A step has tens of loops of a few tens of microseconds each. Rayon lets threads sleep that have found no work for about as
//! long, and the loop that comes next wakes them one by one, which may take longer than the loop.

use rayon::Yield;
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// A thread that has found no work for so long goes to sleep: what one thread does alone between two loops is shorter as a rule.
const PATIENCE: Duration = Duration::from_micros(300);

thread_local! {
    /// Is this thread one that looks for work, or does what others are awake for?
    static IS_AWAKE: Cell<bool> = const { Cell::new(false) };
}

/// The threads of a pool that look for work.
#[derive(Clone, Default)]
pub(crate) struct Awake {
    looking: Arc<AtomicUsize>,
}

impl Awake {
    /// Does something on a thread of a pool, whose other threads stay awake meanwhile.
    pub(crate) fn during<R>(&self, work: impl FnOnce() -> R) -> R {
        let others = rayon::current_num_threads() - 1;
        let was_awake = IS_AWAKE.replace(true);
        // A thread that looks for work and has taken this up counts as one of those looking.
        if self.looking.load(Ordering::Relaxed) < others + usize::from(was_awake) {
            let looking = Arc::clone(&self.looking);
            rayon::spawn_broadcast(move |_| look_for_work(&looking));
        }
        let outcome = work();
        IS_AWAKE.set(was_awake);
        outcome
    }
}

/// Works on what there is until there has been nothing for a while.
fn look_for_work(looking: &AtomicUsize) {
    // What another thread waits for must not wait for this.
    if IS_AWAKE.replace(true) {
        return;
    }
    looking.fetch_add(1, Ordering::Relaxed);
    let mut last = Instant::now();
    while last.elapsed() < PATIENCE {
        match rayon::yield_now() {
            Some(Yield::Executed) => last = Instant::now(),
            _ => std::thread::yield_now(),
        }
    }
    looking.fetch_sub(1, Ordering::Relaxed);
    IS_AWAKE.set(false);
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    /// Of three threads two stay awake, however often something is done and within whatever else; they work on what there is, and sleep when there has been
    /// nothing for long.
    #[test]
    fn others_stay_awake_while_there_is_work_and_sleep_afterwards() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let awake = Awake::default();
        let looking = || awake.looking.load(Ordering::Relaxed);
        let until = |is_so: &dyn Fn() -> bool| {
            let begun = Instant::now();
            while !is_so() {
                assert!(begun.elapsed() < Duration::from_secs(20), "{} threads look for work", looking());
                std::thread::yield_now();
            }
        };
        for _ in 0..50 {
            // Three pieces that wait for one another end only if three threads take one each.
            let met = AtomicUsize::new(0);
            let meet = |_| {
                met.fetch_add(1, Ordering::Relaxed);
                until(&|| met.load(Ordering::Relaxed) == 3);
            };
            let sum: u64 = pool.install(|| {
                awake.during(|| {
                    (0..3).into_par_iter().with_max_len(1).for_each(meet);
                    awake.during(|| (0..1000u64).into_par_iter().sum())
                })
            });
            assert_eq!(sum, 499_500);
            assert!(looking() <= 3, "{} threads look for work", looking());
        }
        until(&|| looking() == 0);
        // A thread that is alone has nobody to keep awake.
        let (alone, one) = (Awake::default(), rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap());
        assert_eq!(one.install(|| alone.during(|| alone.looking.load(Ordering::Relaxed))), 0);
    }
}
