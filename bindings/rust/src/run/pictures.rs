//! Pictures of a run: drawn while it goes on, and put together at its end.

use super::{ANIMATION, CONTACT_SHEET, FRAMES, Folder, io_error};
use crate::picture::{Image, Sketch, View, contact_sheet, gif};
use barchan_core::file::write_whole;
use barchan_core::{Result, Simulation};
use std::collections::VecDeque;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

/// Animations stay below this many bytes and frames.
const ANIMATION_BYTES: usize = 6 << 20;
const ANIMATION_FRAMES: usize = 240;
const ANIMATION_WIDTH: usize = 640;
/// Pictures on a contact sheet.
const SHEET: usize = 12;
/// Keyword of the view in the pictures' text chunks.
const VIEW: &str = "barchan view";
const TIME: &str = "time";

/// Pictures can be made: nothing to say. A build without them has an error here.
pub(super) fn check() -> Result<()> {
    Ok(())
}

/// The pictures of a run, all drawn with one view.
pub(super) struct Pictures {
    view: View,
    painters: Painters,
}

impl Pictures {
    /// Pictures that go on from the last one that there is.
    pub(super) fn new(simulation: &Simulation, last: Option<&Path>) -> Result<Self> {
        View::check(simulation)?;
        let view = last.and_then(view_of).unwrap_or_else(|| View::new(simulation));
        Ok(Self { view, painters: Painters::default() })
    }

    /// Takes a picture of the simulation as it is, which is drawn and written later. The file is asked for when there is something to draw.
    pub(super) fn take(&mut self, simulation: &Simulation, file: impl FnOnce() -> Result<PathBuf>) -> Result<()> {
        let sketch = self.view.look(simulation)?;
        self.painters.paint(sketch, file()?)
    }

    /// Waits for all that are under way. Fails as the first of them that did.
    pub(super) fn wait(&mut self) -> Result<()> {
        self.painters.finish()
    }

    /// Makes the contact sheet and the animation.
    pub(super) fn overview(&self, folder: &mut Folder, interval: f64) -> Result<()> {
        let frames = folder.numbered(FRAMES, u64::MAX)?;
        if frames.is_empty() {
            return Ok(());
        }
        let load = |path: &Path| Image::read_png(path).map_err(|e| io_error(path, "reading a picture", e));
        let count = frames.len().min(SHEET);
        let picked = (0..count).map(|i| &frames[if count > 1 { i * (frames.len() - 1) / (count - 1) } else { 0 }]);
        let pictures: Vec<(Image, String)> = picked
            .map(|path| {
                let (image, notes) = load(path)?;
                let time =
                    notes.iter().find(|(k, _)| k == TIME).and_then(|(_, t)| t.parse::<f64>().ok()).unwrap_or(0.0);
                Ok((image.crop(self.view.relief_rect()), self.view.label(time)))
            })
            .collect::<Result<_>>()?;
        let sheet = contact_sheet(&pictures, 3, 480);
        folder.write(CONTACT_SHEET, "writing the contact sheet", |out| sheet.encode_png(out, &[]))?;

        let stride = frames.len().div_ceil(ANIMATION_FRAMES);
        let shown: Vec<&PathBuf> = frames.iter().step_by(stride).collect();
        let small = |i: usize| Ok(Image::read_png(shown[i])?.0.shrunk(ANIMATION_WIDTH));
        let bytes = gif(shown.len(), small, interval * stride as f64, ANIMATION_BYTES)
            .map_err(|e| io_error(&folder.join(ANIMATION), "making the animation", e))?;
        folder.write(ANIMATION, "writing the animation", |out| out.write_all(&bytes))
    }
}

/// The view that a picture was drawn with.
fn view_of(path: &Path) -> Option<View> {
    let (_, notes) = Image::read_png(path).ok()?;
    notes.iter().find(|(keyword, _)| keyword == VIEW).and_then(|(_, text)| serde_json::from_str(text).ok())
}

/// Pictures that are drawn and written while the run goes on.
#[derive(Default)]
struct Painters(VecDeque<JoinHandle<Result<()>>>);

impl Painters {
    /// So many pictures are drawn at once, of so many particles in all: they take memory.
    const MOST: usize = 4;
    const MOST_PARTICLES: usize = 4_000_000;

    /// Begins to draw a picture. Waits for one that is under way if there are too many, and fails if that one could not be written.
    fn paint(&mut self, sketch: Sketch, path: PathBuf) -> Result<()> {
        let at_once = (Self::MOST_PARTICLES / sketch.len().max(1)).clamp(1, Self::MOST);
        self.wait(at_once - 1)?;
        self.0.push_back(std::thread::spawn(move || {
            let view = serde_json::to_string(&sketch.view).map_err(io::Error::other);
            let picture = sketch.draw();
            write_whole(&path, "writing a picture", |out| {
                let notes = [(TIME, sketch.time.to_string()), (VIEW, view?)];
                picture.encode_png(out, &notes.each_ref().map(|(keyword, text)| (*keyword, text.as_str())))
            })
        }));
        Ok(())
    }

    /// Waits until no more than so many are under way.
    fn wait(&mut self, left: usize) -> Result<()> {
        while self.0.len() > left {
            let oldest = self.0.pop_front().expect("the queue is longer than its limit, which is not below 0");
            oldest.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        }
        Ok(())
    }

    /// Waits for all. Fails as the first of them that did.
    fn finish(&mut self) -> Result<()> {
        let mut first = Ok(());
        while !self.0.is_empty() {
            first = first.and(self.wait(self.0.len() - 1));
        }
        first
    }
}
