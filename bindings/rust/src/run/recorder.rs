//! Who looks at a run, and what they write: the observers that a run is given, and its own, which keep the trace, pictures, particle files and snapshots.

use super::folder::Folder;
use super::pictures::Pictures;
use super::{FRAMES, PARTICLES, Request, SNAPSHOT, TRACE, io_error};
use crate::run::Existing;
use barchan_core::backend::Timing;
use barchan_core::export::export;
use barchan_core::observer::{Every, Observer, Output};
use barchan_core::scene::{Export, plain};
use barchan_core::{BodyState, Error, JointState, Result, Simulation, StepReport, Vec3, Wrench};
use std::cell::RefCell;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

/// What a run writes into, shared by all who look at it.
pub(super) struct Files {
    pub(super) folder: Folder,
    trace: BufWriter<File>,
    /// What observers add to the trace's row of the last step.
    values: Vec<Option<f64>>,
}

impl Files {
    fn flush(&mut self) -> Result<()> {
        self.trace.flush().map_err(|e| io_error(&self.folder.join(TRACE), "writing the trace", e))
    }

    /// A snapshot of the simulation as it is, and of the trace as far as it has come: so the trace of a run that goes on from it has no gap.
    pub(super) fn save(&mut self, simulation: &Simulation) -> Result<()> {
        let flushed = self.flush();
        let saved = self.folder.claim(SNAPSHOT).and_then(|path| simulation.save(path));
        flushed.and(saved)
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
        let mut folder = Folder::open(&request.out, request.existing, simulation.plan().memory.0)?;
        let resumed = request.existing == Existing::Resume;
        let columns: Vec<Vec<String>> = guests.iter().map(|guest| guest.columns()).collect();
        let named = guests.iter().zip(&columns).flat_map(|(guest, columns)| {
            columns.iter().map(|column| format!("{} {column}", guest.name())).collect::<Vec<_>>()
        });
        let header = header(&simulation.bodies(), &simulation.joints(), named);
        if resumed {
            check_header(&request.out, &header)?;
        }
        let every = |interval: f64| match resumed {
            true => Every::new(interval).after(simulation.time()),
            false => Every::new(interval),
        };
        // Pictures up to now are kept when a run goes on.
        let past = every(output.interval).number();
        let frames = folder.numbered(FRAMES, past)?;
        folder.numbered(PARTICLES, past)?;
        let pictures = pictures.then(|| Pictures::new(simulation, frames.last().map(PathBuf::as_path))).transpose()?;
        let values = vec![None; columns.iter().map(Vec::len).sum()];
        let trace = open_trace(&folder.claim(TRACE)?, simulation, resumed, &header)?;
        let files = Rc::new(RefCell::new(Files { folder, trace, values }));

        let mut seats = Vec::new();
        let mut first = 0;
        for (guest, columns) in guests.iter_mut().zip(&columns) {
            let (every, columns) = (every(guest.interval()), first..first + columns.len());
            first = columns.end;
            seats.push(Seat { observer: Who::Guest(&mut **guest), every, columns, seconds: 0.0, looks: 0 });
        }
        let shared = || Rc::clone(&files);
        let own: [Box<dyn Observer>; 3] = [
            Box::new(Trace { files: shared() }),
            Box::new(Frames {
                files: shared(),
                every: every(output.interval),
                interval: output.interval,
                pictures,
                export: request.export.or(output.export),
            }),
            Box::new(Snapshots { files: shared(), interval: output.snapshot_interval, began: simulation.step_count() }),
        ];
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

/// Writes a row for every step.
struct Trace {
    files: Rc<RefCell<Files>>,
}

impl Observer for Trace {
    fn name(&self) -> &str {
        "trace"
    }
    fn interval(&self) -> f64 {
        f64::INFINITY
    }
    fn observe(&mut self, _: &Simulation, _: &mut dyn Output) -> Result<()> {
        Ok(())
    }
    fn stepped(
        &mut self,
        simulation: &Simulation,
        (mut time, mut step): (f64, u64),
        reports: &[StepReport],
        _: &mut dyn Output,
    ) -> Result<()> {
        let files = &mut *self.files.borrow_mut();
        let mut lines = String::new();
        let joints = simulation.joints();
        for (i, StepReport { dt, bodies, wrenches, .. }) in reports.iter().enumerate() {
            (time, step) = (time + dt, step + 1);
            let is_last = i + 1 == reports.len();
            // The last step may land on a stop.
            let time = if is_last { simulation.time() } else { time };
            lines += &format!("{time},{step},{dt}");
            let bodies = bodies.clone().unwrap_or_else(|| simulation.bodies());
            let wrenches = wrenches.clone().unwrap_or_else(|| simulation.wrenches());
            for (body, wrench) in bodies.iter().zip(&wrenches) {
                lines.push_str(&row(body, wrench));
            }
            // Joints take part in every step on the host, so that there is none between.
            for joint in &joints {
                let JointState { position, rate, torque, .. } = joint;
                lines += &if is_last { format!(",{position},{rate},{torque}") } else { ",,,".to_owned() };
            }
            // Observers have looked after the last one.
            for value in &mut files.values {
                let value = if is_last { value.take() } else { None };
                lines.push_str(&value.map_or_else(|| ",".to_owned(), |value| format!(",{value}")));
            }
            lines.push('\n');
        }
        let written = files.trace.write_all(lines.as_bytes());
        written.map_err(|e| io_error(&files.folder.join(TRACE), "writing the trace", e))
    }
}

/// Pictures and particle files.
struct Frames {
    files: Rc<RefCell<Files>>,
    every: Every,
    interval: f64,
    pictures: Option<Pictures>,
    export: Option<Export>,
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
        if let Some(format) = self.export {
            let path = files.folder.claim(&format!("{PARTICLES}/{number:05}.{}", format.extension()))?;
            export(&simulation.ground(), simulation.plan(), path, format)?;
        }
        files.flush()
    }
    fn finish(&mut self, _: &Simulation, _: &mut dyn Output) -> Result<()> {
        let drawn = self.pictures.as_mut().map_or(Ok(()), Pictures::wait);
        let folder = &mut self.files.borrow_mut().folder;
        drawn.and(self.pictures.as_ref().map_or(Ok(()), |pictures| pictures.overview(folder, self.interval)))
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

/// Holds the trace of a run that is to go on to the columns that it will have.
fn check_header(folder: &Path, header: &str) -> Result<()> {
    let path = folder.join(TRACE);
    let mut first = String::new();
    match File::open(&path).and_then(|file| BufReader::new(file).read_line(&mut first)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(io_error(&path, "reading the trace", error));
        }
        _ => {}
    }
    // A line that was cut off is written anew.
    let Some(first) = first.strip_suffix('\n').filter(|first| *first != header) else { return Ok(()) };
    let (there, here) = (fields(first), fields(header));
    let more = there.iter().find(|field| !here.contains(field));
    let less = here.iter().find(|field| !there.contains(field));
    let what = match (more, less) {
        (None, None) => "has the columns in another order".to_owned(),
        (Some(more), None) => format!("has '{more}'"),
        (None, Some(less)) => format!("lacks '{less}'"),
        (Some(more), Some(less)) => format!("has '{more}' and lacks '{less}'"),
    };
    Err(Error::Folder {
        folder: folder.to_owned(),
        what: format!("holds a trace of other columns: it {}", plain(&what)),
        mend: "go on with the observers that the run had, or choose another folder with --out".to_owned(),
    })
}

/// Opens the trace; one that goes on is cut after the present step.
fn open_trace(path: &Path, simulation: &Simulation, resumed: bool, header: &str) -> Result<BufWriter<File>> {
    let open = || -> io::Result<BufWriter<File>> {
        let mut file = File::options().read(true).write(true).create(true).truncate(!resumed).open(path)?;
        let mut text = String::new();
        file.read_to_string(&mut text)?;
        let step = |line: &str| line.split(',').nth(1).and_then(|s| s.parse::<u64>().ok());
        let kept = text
            .split_inclusive('\n')
            .take_while(|line| line.ends_with('\n') && step(line).is_none_or(|step| step <= simulation.step_count()));
        let length: usize = kept.map(str::len).sum();
        file.set_len(length as u64)?;
        file.seek(SeekFrom::End(0))?;
        let mut writer = BufWriter::new(file);
        if length == 0 {
            writeln!(writer, "{header}")?;
        }
        Ok(writer)
    };
    open().map_err(|e| io_error(path, "opening the trace", e))
}

/// Quantities of a body in the trace, with units.
const COLUMNS: [&str; 19] = [
    "x [m]",
    "y [m]",
    "z [m]",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx [m/s]",
    "vy [m/s]",
    "vz [m/s]",
    "wx [rad/s]",
    "wy [rad/s]",
    "wz [rad/s]",
    "fx [N]",
    "fy [N]",
    "fz [N]",
    "tx [N m]",
    "ty [N m]",
    "tz [N m]",
];

fn header(bodies: &[BodyState], joints: &[JointState], observed: impl Iterator<Item = String>) -> String {
    let columns = bodies.iter().flat_map(|body| COLUMNS.map(|column| quoted(&format!("{} {column}", body.name))));
    let of_joint = |joint: &JointState| {
        let units = if joint.turns { ["[rad]", "[rad/s]", "[N m]"] } else { ["[m]", "[m/s]", "[N]"] };
        let column = |(what, unit): (&str, &str)| quoted(&format!("{}/{} {what} {unit}", joint.body, joint.name));
        ["position", "rate", "torque"].into_iter().zip(units).map(column).collect::<Vec<_>>()
    };
    let columns = columns.chain(joints.iter().flat_map(of_joint));
    let all = ["time [s]", "step", "dt [s]"].map(str::to_owned).into_iter().chain(columns);
    all.chain(observed.map(|column| quoted(&column))).collect::<Vec<_>>().join(",")
}

/// The fields of a line as [`quoted`] writes them.
fn fields(line: &str) -> Vec<&str> {
    let mut inside = false;
    let ends = |c: char| {
        inside ^= c == '"';
        c == ',' && !inside
    };
    line.split(ends).collect()
}

/// A field of a CSV file (RFC 4180), on one line.
fn quoted(field: &str) -> String {
    let field = plain(field);
    if field.contains(['"', ',']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field }
}

fn row(body: &BodyState, wrench: &Wrench) -> String {
    let vectors: [&Vec3; 4] = [&body.velocity, &body.angular_velocity, &wrench.force, &wrench.torque];
    let numbers = body.position.iter().chain(&body.rotation).chain(vectors.into_iter().flatten());
    numbers.fold(String::new(), |row, number| format!("{row},{number}"))
}
