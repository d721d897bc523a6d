//! Who looks at a run, and what they write: the observers that a run is given, and its own, which keep the trace, pictures, particle files and snapshots.

use super::folder::Folder;
use super::pictures::Pictures;
use super::probes::{self, Probes};
use super::trace::{self, Columns, Since, Trace};
use super::{FRAMES, HEIGHT, PARTICLES, PROBES, Request, SNAPSHOT, SURFACE, TRACE, TRACE_SINCE, io_error};
use crate::export::{self, Fields, Surface};
use crate::run::Existing;
use barchan_core::backend::Timing;
use barchan_core::observer::{Every, Observer, Output};
use barchan_core::scene::{Export, HeightOutput, SurfaceOutput, plain};
use barchan_core::{BodyState, Coupling, Error, JointState, Plan, Result, Simulation, StepReport};
use std::cell::RefCell;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::rc::Rc;
use std::time::Instant;

/// What a run writes into, shared by all who look at it.
pub(super) struct Files {
    pub(super) folder: Folder,
    trace: BufWriter<File>,
    /// What probes find, if there are any.
    pub(super) probes: Option<probes::Table>,
    /// What observers add to the trace's row of the last step.
    pub(super) values: Vec<Option<f64>>,
    /// What has gone since the trace's last row, if rows are an interval apart and it is known.
    pub(super) since: Option<Since>,
}

impl Files {
    pub(super) fn flush(&mut self) -> Result<()> {
        self.probes.as_mut().map_or(Ok(()), |probes| probes.flush(&self.folder))?;
        self.trace.flush().map_err(|e| io_error(&self.folder.join(TRACE), "writing the trace", e))
    }

    /// Adds rows to the trace.
    pub(super) fn write_trace(&mut self, rows: &str) -> Result<()> {
        let written = self.trace.write_all(rows.as_bytes());
        written.map_err(|e| io_error(&self.folder.join(TRACE), "writing the trace", e))
    }

    /// A snapshot of the simulation as it is, and of the trace as far as it has come: so the trace of a run that goes on from it has no gap.
    pub(super) fn save(&mut self, simulation: &Simulation) -> Result<()> {
        let flushed = self.flush();
        let saved = self.folder.claim(SNAPSHOT).and_then(|path| simulation.save(path));
        let kept = match &self.since {
            Some(since) => self.folder.write(TRACE_SINCE, "writing what has gone since the trace's last row", |out| {
                serde_json::to_writer(out, since).map_err(Into::into)
            }),
            None => Ok(()),
        };
        flushed.and(saved).and(kept)
    }
}

/// Everybody who looks at a run.
pub(super) struct Recorder<'a> {
    pub(super) files: Rc<RefCell<Files>>,
    seats: Vec<Seat<'a>>,
    /// What it took to begin [s].
    seconds: f64,
}

/// An observer, and when it looks.
struct Seat<'a> {
    observer: Who<'a>,
    every: Every,
    /// Its columns among the values of all.
    columns: std::ops::Range<usize>,
    seconds: f64,
    looks: u64,
}

/// Somebody's own, or the run's.
enum Who<'a> {
    Guest(&'a mut dyn Observer),
    Own(Box<dyn Observer>),
}

impl Who<'_> {
    fn get(&mut self) -> &mut dyn Observer {
        match self {
            Self::Guest(guest) => *guest,
            Self::Own(own) => &mut **own,
        }
    }
}

/// Where one of them puts what it has seen.
struct Desk<'a> {
    files: &'a RefCell<Files>,
    name: String,
    columns: std::ops::Range<usize>,
}

impl Output for Desk<'_> {
    fn set(&mut self, column: usize, value: f64) {
        if let Some(place) = self.files.borrow_mut().values[self.columns.clone()].get_mut(column) {
            *place = Some(value);
        }
    }
    fn file(&mut self, name: &str) -> Result<PathBuf> {
        self.files.borrow_mut().folder.claim_observed(&self.name, name)
    }
}

/// How particles are written, and which of their fields, if they are at all; `asked`: whatever the scene says.
fn exported(plan: &Plan, asked: Option<Export>) -> Result<Option<(Export, Fields)>> {
    let output = &plan.scene.output;
    let fields = |format| Ok((format, Fields::new(plan, output.export_fields.as_deref())?));
    asked.or(output.export).map(fields).transpose()
}

/// Columns of the trace that an observer adds.
fn columns_of(observer: &dyn Observer) -> Vec<String> {
    observer.columns().iter().map(|column| format!("{} {column}", observer.name())).collect()
}

/// Finds out whether this program writes what a scene asks for in `output`, without running it. `couplings` are those that it was [assembled](Plan::assemble) with,
/// `observers` those that would look at the run.
///
/// # Errors
/// If a pattern of `output.trace.columns` or `output.export_fields` fits nothing, or a kind of file is wanted that this program does not write.
pub fn check_output(plan: &Plan, couplings: &[Box<dyn Coupling>], observers: &[Box<dyn Observer>]) -> Result<()> {
    let bodies: Vec<BodyState> = couplings.iter().flat_map(|coupling| coupling.bodies()).collect();
    let joints: Vec<JointState> = couplings.iter().flat_map(|coupling| coupling.joints()).collect();
    Columns::new(plan, &bodies, &joints, observers.iter().flat_map(|observer| columns_of(&**observer)))?;
    exported(plan, None).map(drop)
}

impl<'a> Recorder<'a> {
    /// Opens the folder and the trace. Guests come before the run's own, which write down what those have seen.
    pub(super) fn new(simulation: &Simulation, request: &Request, guests: &'a mut [&mut dyn Observer]) -> Result<Self> {
        let begin = Instant::now();
        let output = &simulation.plan().scene.output;
        let pictures = request.pictures && output.picture.on;
        if pictures {
            super::pictures::check()?;
        }
        check_names(guests)?;
        let export = exported(simulation.plan(), request.export)?;
        let resumed = request.existing == Existing::Resume;
        let columns: Vec<Vec<String>> = guests.iter().map(|guest| columns_of(&**guest)).collect();
        let named = columns.iter().flatten().cloned();
        let trace_columns = Columns::new(simulation.plan(), &simulation.bodies(), &simulation.joints(), named)?;
        let header = trace_columns.header();
        // What is refused is so before a file is touched.
        let mut folder = Folder::open(&request.out, request.existing, simulation.plan().memory.0)?;
        if resumed {
            trace::check_header(&request.out, TRACE, &header)?;
            trace::check_header(&request.out, PROBES, &probes::header(&simulation.plan().scene))?;
        }
        let every = |interval: f64| match resumed {
            true => Every::new(interval).after(simulation.time()),
            false => Every::new(interval),
        };
        // Pictures up to now are kept when a run goes on.
        let past = every(output.interval).number();
        let frames = folder.numbered(FRAMES, past)?;
        folder.numbered(PARTICLES, past)?;
        for (name, interval) in [
            (SURFACE, output.surface.as_ref().map(|surface| surface.interval)),
            (HEIGHT, output.height_map.as_ref().map(|map| map.interval)),
        ] {
            folder.numbered(name, interval.map_or(0, |interval| every(interval).number()))?;
        }
        let pictures = pictures.then(|| Pictures::new(simulation, frames.last().map(PathBuf::as_path))).transpose()?;
        let values = vec![None; columns.iter().map(Vec::len).sum()];
        let trace = trace::open(&mut folder, TRACE, simulation, resumed, &header)?;
        let probes = probes::Table::open(&mut folder, simulation, resumed)?;
        let since = Since::of_run(&request.out, simulation, &output.trace, resumed);
        let files = Rc::new(RefCell::new(Files { folder, trace, probes, values, since }));

        let mut seats = Vec::new();
        let mut first = 0;
        for (guest, columns) in guests.iter_mut().zip(&columns) {
            let (every, columns) = (every(guest.interval()), first..first + columns.len());
            first = columns.end;
            seats.push(Seat { observer: Who::Guest(&mut **guest), every, columns, seconds: 0.0, looks: 0 });
        }
        let shared = || Rc::clone(&files);
        let mut own: Vec<Box<dyn Observer>> = Vec::new();
        for probes in Probes::of(&files, &simulation.plan().scene) {
            own.push(Box::new(probes));
        }
        let rest: [Box<dyn Observer>; 3] = [
            Box::new(Trace::new(shared(), trace_columns, &output.trace, resumed)),
            Box::new(Frames {
                files: shared(),
                every: every(output.interval),
                interval: output.interval,
                pictures,
                export,
            }),
            Box::new(Snapshots { files: shared(), interval: output.snapshot_interval, began: simulation.step_count() }),
        ];
        own.extend(rest);
        if let Some(output) = &output.surface {
            own.push(Box::new(Surfaces { files: shared(), every: every(output.interval), output: output.clone() }));
        }
        if let Some(output) = &output.height_map {
            own.push(Box::new(HeightMaps { files: shared(), every: every(output.interval), output: output.clone() }));
        }
        for own in own {
            let every = every(own.interval());
            seats.push(Seat { observer: Who::Own(own), every, columns: 0..0, seconds: 0.0, looks: 0 });
        }
        Ok(Self { files, seats, seconds: begin.elapsed().as_secs_f64() })
    }

    /// When somebody looks next [s].
    pub(super) fn next(&self) -> f64 {
        self.seats.iter().map(|seat| seat.every.due()).fold(f64::INFINITY, f64::min)
    }

    /// Does anybody look after every step?
    pub(super) fn looks_always(&mut self) -> bool {
        self.seats.iter_mut().any(|seat| seat.observer.get().interval() == 0.0)
    }

    /// Looks before the first step.
    pub(super) fn begin(&mut self, simulation: &Simulation) -> Result<()> {
        self.each(|observer, every, desk| look(observer, every, simulation, desk))?;
        self.files.borrow_mut().values.fill(None);
        Ok(())
    }

    /// Looks that are due after steps since `from` (time, step), and what was to be noted of each.
    pub(super) fn stepped(&mut self, simulation: &Simulation, from: (f64, u64), reports: &[StepReport]) -> Result<()> {
        self.each(|observer, every, desk| {
            let looked = look(observer, every, simulation, desk)?;
            observer.stepped(simulation, from, reports, desk)?;
            Ok(looked)
        })
    }

    /// Ends everybody's part, also after an error. Fails as the first who did.
    pub(super) fn finish(&mut self, simulation: &Simulation) -> Result<()> {
        let mut first = Ok(());
        for seat in &mut self.seats {
            let finished = seat.ask(&self.files, |observer, _, desk| observer.finish(simulation, desk).map(|()| false));
            first = first.and(finished);
        }
        first.and(self.files.borrow_mut().flush())
    }

    fn each(
        &mut self,
        mut ask: impl FnMut(&mut dyn Observer, &mut Every, &mut Desk<'_>) -> Result<bool>,
    ) -> Result<()> {
        let files = &self.files;
        self.seats.iter_mut().try_for_each(|seat| seat.ask(files, &mut ask))
    }

    /// What output took, and what guests did.
    pub(super) fn timings(&mut self) -> Vec<Timing> {
        let mut own = Timing { effect: "output".to_owned(), seconds: self.seconds, passes: 0 };
        let mut timings = Vec::new();
        for seat in &mut self.seats {
            match &seat.observer {
                Who::Guest(guest) => timings.push(Timing {
                    effect: format!("observer {}", guest.name()),
                    seconds: seat.seconds,
                    passes: seat.looks,
                }),
                Who::Own(_) => {
                    own.seconds += seat.seconds;
                    own.passes += seat.looks;
                }
            }
        }
        timings.push(own);
        timings
    }
}

impl Seat<'_> {
    fn ask(
        &mut self,
        files: &RefCell<Files>,
        ask: impl FnOnce(&mut dyn Observer, &mut Every, &mut Desk<'_>) -> Result<bool>,
    ) -> Result<()> {
        let begin = Instant::now();
        let observer = self.observer.get();
        let mut desk = Desk { files, name: observer.name().to_owned(), columns: self.columns.clone() };
        let asked = ask(observer, &mut self.every, &mut desk);
        self.seconds += begin.elapsed().as_secs_f64();
        self.looks += u64::from(*asked.as_ref().unwrap_or(&false));
        asked.map(drop)
    }
}

/// A look, if one is due.
fn look(observer: &mut dyn Observer, every: &mut Every, simulation: &Simulation, desk: &mut Desk<'_>) -> Result<bool> {
    let time = simulation.time();
    if time < every.due() {
        return Ok(false);
    }
    every.done(time);
    observer.observe(simulation, desk)?;
    Ok(true)
}

/// Names of folders, each once, and intervals that time can pass.
fn check_names(guests: &[&mut dyn Observer]) -> Result<()> {
    let refuse = |name: &str, what: &str, mend: &str| {
        Err(Error::Body { path: format!("observer '{}'", plain(name)), what: what.to_owned(), mend: mend.to_owned() })
    };
    for (i, guest) in guests.iter().enumerate() {
        let name = guest.name();
        if !Folder::is_name(name) {
            return refuse(name, "its name is no name of a folder", "use letters, digits, - and _");
        }
        if guests[..i].iter().any(|other| other.name() == name) {
            return refuse(name, "two observers have this name", "give them names of their own");
        }
        if guest.interval().is_nan() || guest.interval() < 0.0 {
            return refuse(name, "its interval is no time", "give it an interval of 0 s or more");
        }
    }
    Ok(())
}

/// Pictures and particle files.
struct Frames {
    files: Rc<RefCell<Files>>,
    every: Every,
    interval: f64,
    pictures: Option<Pictures>,
    export: Option<(Export, Fields)>,
}

impl Observer for Frames {
    fn name(&self) -> &str {
        "frames"
    }
    fn interval(&self) -> f64 {
        self.interval
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        // A step longer than the interval skips pictures rather than repeat one.
        let number = self.every.number();
        self.every.done(simulation.time());
        let files = &mut *self.files.borrow_mut();
        if let Some(pictures) = &mut self.pictures {
            pictures.take(simulation, || files.folder.claim(&format!("{FRAMES}/{number:05}.png")))?;
        }
        if let Some((format, fields)) = &self.export {
            let path = files.folder.claim(&format!("{PARTICLES}/{number:05}.{}", format.extension()))?;
            export::particles(simulation, fields, path, *format)?;
        }
        files.flush()
    }
    fn finish(&mut self, _: &Simulation, _: &mut dyn Output) -> Result<()> {
        let drawn = self.pictures.as_mut().map_or(Ok(()), Pictures::wait);
        let folder = &mut self.files.borrow_mut().folder;
        drawn.and(self.pictures.as_ref().map_or(Ok(()), |pictures| pictures.overview(folder, self.interval)))
    }
}

/// Meshes of the ground's surface.
struct Surfaces {
    files: Rc<RefCell<Files>>,
    every: Every,
    output: SurfaceOutput,
}

impl Observer for Surfaces {
    fn name(&self) -> &str {
        "surface"
    }
    fn interval(&self) -> f64 {
        self.output.interval
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        let number = self.every.number();
        self.every.done(simulation.time());
        let spacing = self.output.spacing.unwrap_or(simulation.plan().scene.world.cell);
        let surface = Surface::new(&simulation.spots(), spacing)?;
        let path = self.files.borrow_mut().folder.claim(&format!("{SURFACE}/{number:05}.ply"))?;
        surface.write_ply(path, simulation)
    }
}

/// Maps of the ground's height.
struct HeightMaps {
    files: Rc<RefCell<Files>>,
    every: Every,
    output: HeightOutput,
}

impl Observer for HeightMaps {
    fn name(&self) -> &str {
        "height map"
    }
    fn interval(&self) -> f64 {
        self.output.interval
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        let number = self.every.number();
        self.every.done(simulation.time());
        let map = export::height_map(simulation, self.output.spacing.unwrap_or(simulation.plan().scene.world.cell));
        let folder = &mut self.files.borrow_mut().folder;
        map.write_npz(folder.claim(&format!("{HEIGHT}/{number:05}.npz"))?)?;
        if self.output.png {
            map.write_png(folder.claim(&format!("{HEIGHT}/{number:05}.png"))?)?;
        }
        Ok(())
    }
}

/// Snapshots while the run goes on.
struct Snapshots {
    files: Rc<RefCell<Files>>,
    interval: Option<f64>,
    /// The step at which the run began, which nobody has to save.
    began: u64,
}

impl Observer for Snapshots {
    fn name(&self) -> &str {
        "snapshots"
    }
    fn interval(&self) -> f64 {
        self.interval.unwrap_or(f64::INFINITY)
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        if simulation.step_count() > self.began { self.files.borrow_mut().save(simulation) } else { Ok(()) }
    }
}
