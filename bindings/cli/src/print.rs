//! What goes to the terminal: the only place that writes there.
//!
//! Nobody has to read on, and a disk behind `>` may fill up: neither ends a run. Text of scenes, files and plugins cannot act on the
//! terminal: control characters are left out.

use std::fmt::Display;
use std::io::{ErrorKind, Write};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Has the standard output failed otherwise than by being closed?
static FAILED: AtomicBool = AtomicBool::new(false);

/// Writes to the standard output.
pub(crate) fn show(text: impl Display) {
    let mut out = std::io::stdout();
    match out.write_all(harmless(&text.to_string()).as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe && !FAILED.swap(true, Relaxed) => {
            tell(format!("error: standard output: {error}"));
        }
        _ => {}
    }
}

/// Writes a line to the standard error. Further lines of the text are set off, so that none can pass for another message.
pub(crate) fn tell(line: impl Display) {
    let text = harmless(&line.to_string()).trim_end().replace('\n', "\n    ");
    // Where this fails, nobody is left to be told.
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Is what was shown lost?
pub(crate) fn failed() -> bool {
    FAILED.load(Relaxed)
}

/// Text without control characters, but for ends of lines.
fn harmless(text: &str) -> String {
    text.chars().filter(|c| !c.is_control() || *c == '\n').collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_left_out() {
        assert_eq!(harmless("a\x1b[31mb\r\x07\u{9b}2Jc\nd\te"), "a[31mb2Jc\nde");
    }
}
