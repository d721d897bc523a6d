//! Signals that ask a run to end: it saves and says how to go on. One that comes a second later, or more, ends the process at once.

use crate::print::tell;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::low_level;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// What is sent twice within this time is sent once: `timeout` signals the process and then its group, and batch systems do alike.
const AT_ONCE: Duration = Duration::from_secs(1);

/// Ctrl-C, a polite end by the system, and where there is such a thing, a terminal that is gone.
#[cfg(unix)]
const ASKING: [i32; 3] = [SIGINT, SIGTERM, signal_hook::consts::SIGHUP];
#[cfg(not(unix))]
const ASKING: [i32; 2] = [SIGINT, SIGTERM];

/// Has whoever started the run seen to it that it outlives its terminal, as `nohup` does?
#[cfg(unix)]
fn is_to_be_ignored(signal: i32) -> bool {
    // SAFETY: all zeros are a value of this struct, and asking for the present action changes none.
    let action = unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        (libc::sigaction(signal, std::ptr::null(), &raw mut action) == 0).then_some(action.sa_sigaction)
    };
    signal == signal_hook::consts::SIGHUP && action == Some(libc::SIG_IGN)
}
#[cfg(not(unix))]
fn is_to_be_ignored(_: i32) -> bool {
    false
}

/// A signal that was caught.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Caught(i32);

impl Caught {
    /// Exit status after it, as shells have it: 128 and its number.
    pub(crate) fn status(self) -> u8 {
        (128 + self.0) as u8
    }
}

/// Which signal was caught first, if any was.
pub(crate) struct Signals(Arc<AtomicUsize>);

impl Signals {
    /// From now on, signals are caught.
    pub(crate) fn new() -> Self {
        let (first, asked) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicU64::new(u64::MAX)));
        let start = Instant::now();
        let register = |signal: i32| -> io::Result<()> {
            let (first, asked) = (Arc::clone(&first), Arc::clone(&asked));
            let hear = move || {
                let now = start.elapsed().as_millis() as u64;
                match asked.compare_exchange(u64::MAX, now, Ordering::Relaxed, Ordering::Relaxed) {
                    Ok(_) => first.store(signal as usize, Ordering::Relaxed),
                    Err(asked) if now < asked + AT_ONCE.as_millis() as u64 => (),
                    Err(_) => low_level::exit(128 + signal),
                }
            };
            // SAFETY: the handler reads a clock, changes two atomics or ends the process as `_exit` does: all of it may be done in a handler.
            unsafe { low_level::register(signal, hear) }.map(drop)
        };
        let mut asking = ASKING.into_iter().filter(|signal| !is_to_be_ignored(*signal));
        if let Err(error) = asking.try_for_each(register) {
            tell(format!("warning: a signal such as Ctrl-C will end the run without saving it: {error}"));
        }
        Self(first)
    }

    /// The signal that was caught, if any was.
    pub(crate) fn caught(&self) -> Option<Caught> {
        Some(self.0.load(Ordering::Relaxed)).filter(|signal| *signal > 0).map(|signal| Caught(signal as i32))
    }
}
