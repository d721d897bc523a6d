//! `trace.csv`: a row for each step, or one an interval with what is true of the whole run besides; and `trace.npz` and `trace.parquet`, the same by columns.

#[cfg(feature = "parquet")]
use super::TRACE_PARQUET;
use super::folder::Folder;
use super::recorder::Files;
use super::{TRACE, TRACE_ARRAYS, TRACE_SINCE, io_error};
use crate::export::npz::Npz;
use barchan_core::observer::{Observer, Output};
use barchan_core::scene::{self, WallPart, fits, plain};
use barchan_core::{BodyState, Error, JointState, Ledger, Plan, Result, Simulation, StepReport, Wrench};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::rc::Rc;

/// What every row begins with.
const FIRST: [&str; 3] = ["time [s]", "step", "dt [s]"];
/// Quantities of a body.
const OF_BODY: [&str; 19] = [
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
/// And, where rows are an interval apart, the means of its wrench since the row before.
const MEANS: [&str; 6] =
    ["mean fx [N]", "mean fy [N]", "mean fz [N]", "mean tx [N m]", "mean ty [N m]", "mean tz [N m]"];
/// Of the whole run, where rows are an interval apart. What walls take one by one follows, where probes ask for it.
const OF_ALL: [&str; 12] = [
    "particles",
    "mass [kg]",
    "kinetic energy [J]",
    "elastic energy [J]",
    "potential energy [J]",
    "damped energy [J]",
    "px [N s]",
    "py [N s]",
    "pz [N s]",
    "wall impulse x [N s]",
    "wall impulse y [N s]",
    "wall impulse z [N s]",
];

/// So many rows are written by several threads.
const FEW_ROWS: usize = 8;

/// The columns of a trace.
pub(super) struct Columns {
    names: Vec<String>,
    /// Which of them are written.
    kept: Vec<bool>,
}

impl Columns {
    /// Those of the trace of a plan with such bodies and joints, with what observers add.
    ///
    /// # Errors
    /// If a pattern fits no column, or a kind of file is wanted that this program does not write.
    pub(super) fn new(
        plan: &Plan,
        bodies: &[BodyState],
        joints: &[JointState],
        observed: impl Iterator<Item = String>,
    ) -> Result<Self> {
        let wanted = &plan.scene.output.trace;
        if wanted.parquet && cfg!(not(feature = "parquet")) {
            return Err(Error::Body {
                path: "output.trace.parquet".to_owned(),
                what: "this program was built without Parquet files".to_owned(),
                mend: "build it with --features parquet, or take output.trace.npz".to_owned(),
            });
        }
        let mut names: Vec<String> = FIRST.map(str::to_owned).into();
        if wanted.interval.is_some() {
            names.extend(OF_ALL.map(str::to_owned));
            let scene = &plan.scene;
            let of_wall = |(i, _): (usize, WallPart)| {
                ["x", "y", "z"].map(|d| format!("{} impulse {d} [N s]", scene.probe[i].name))
            };
            names.extend(scene.wall_parts().flat_map(of_wall));
        }
        for body in bodies {
            let means = if wanted.interval.is_some() { &MEANS[..] } else { &[] };
            names.extend(OF_BODY.iter().chain(means).map(|column| format!("{} {column}", body.name)));
        }
        for joint in joints {
            let units = if joint.turns { ["[rad]", "[rad/s]", "[N m]"] } else { ["[m]", "[m/s]", "[N]"] };
            let column = |(what, unit): (&str, &str)| format!("{}/{} {what} {unit}", joint.body, joint.name);
            names.extend(["position", "rate", "torque"].into_iter().zip(units).map(column));
        }
        names.extend(observed);
        let mut kept = vec![wanted.columns.is_none(); names.len()];
        kept[..FIRST.len()].fill(true);
        for pattern in wanted.columns.iter().flatten() {
            let mut any = false;
            for (name, kept) in names.iter().zip(&mut kept) {
                let without_unit = name.split(" [").next().unwrap_or(name);
                if fits(pattern, name) || fits(pattern, without_unit) {
                    (*kept, any) = (true, true);
                }
            }
            if !any {
                let some: Vec<&str> = names[FIRST.len()..].iter().take(40).map(String::as_str).collect();
                let more = if names.len() > FIRST.len() + some.len() { ", …" } else { "" };
                return Err(Error::Body {
                    path: "output.trace.columns".to_owned(),
                    what: format!("no column of the trace fits '{}'", plain(pattern)),
                    mend: format!("take names, with * for any text, of: {}{more}", some.join(", ")),
                });
            }
        }
        Ok(Self { names, kept })
    }

    pub(super) fn header(&self) -> String {
        let kept = self.names.iter().zip(&self.kept).filter(|(_, kept)| **kept);
        kept.map(|(name, _)| quoted(name)).collect::<Vec<_>>().join(",")
    }

    /// A row, with nothing for what is not known.
    fn row(&self, values: impl IntoIterator<Item = Option<f64>>) -> String {
        let mut row = String::new();
        for (value, _) in values.into_iter().zip(&self.kept).filter(|(_, kept)| **kept) {
            if !row.is_empty() {
                row.push(',');
            }
            if let Some(value) = value {
                add_number(&mut row, value);
            }
        }
        row.push('\n');
        row
    }
}

/// Adds a number in the fewest digits that read back as the same bits, a whole one without a point. A robot's row has hundreds, at each step.
pub(super) fn add_number(row: &mut String, value: f64) {
    let mut buffer = zmij::Buffer::new();
    let digits = buffer.format(value);
    row.push_str(digits.strip_suffix(".0").unwrap_or(digits));
}

/// Writes the rows.
pub(super) struct Trace {
    files: Rc<RefCell<Files>>,
    columns: Columns,
    interval: Option<f64>,
    /// Is it written as arrays too? As a Parquet file?
    npz: bool,
    parquet: bool,
    /// Has a row been written, at the start too? Is the next one due?
    begun: bool,
    due: bool,
}

/// What has gone since the last row of a trace whose rows are an interval apart.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct Since {
    /// Up to which step.
    step: u64,
    seconds: f64,
    /// Of each body, impulse and angular impulse [N s, N m s].
    impulses: Vec<Wrench>,
}

impl Since {
    fn add(&mut self, wrenches: &[Wrench], dt: f64) {
        self.step += 1;
        self.seconds += dt;
        self.impulses.resize(wrenches.len(), Wrench::default());
        for (sum, wrench) in self.impulses.iter_mut().zip(wrenches) {
            sum.add_change(&Wrench::default(), wrench, dt);
        }
    }

    /// Nothing, up to now.
    fn from(simulation: &Simulation) -> Self {
        Self { step: simulation.step_count(), ..Self::default() }
    }

    /// The mean wrench on a body, if time has gone by.
    fn mean(&self, body: usize) -> Option<Wrench> {
        self.impulses.get(body).filter(|_| self.seconds > 0.0).map(|sum| sum.scaled(1.0 / self.seconds))
    }

    /// What a run had come to when it was saved, for one that goes on with its trace; `None` if that is not known.
    pub(super) fn of_run(folder: &Path, simulation: &Simulation, wanted: &scene::Trace, resumed: bool) -> Option<Self> {
        wanted.interval?;
        if !resumed {
            return Some(Self::from(simulation));
        }
        let text = std::fs::read_to_string(folder.join(TRACE_SINCE)).ok()?;
        serde_json::from_str(&text).ok().filter(|since: &Self| since.step == simulation.step_count())
    }
}

impl Trace {
    /// `resumed`: a row for the start is there already.
    pub(super) fn new(files: Rc<RefCell<Files>>, columns: Columns, wanted: &scene::Trace, resumed: bool) -> Self {
        let scene::Trace { interval, npz, parquet, .. } = *wanted;
        Self { files, columns, interval, npz, parquet, begun: resumed, due: false }
    }

    /// A row of the present.
    fn note(&mut self, simulation: &Simulation, dt: Option<f64>) -> Result<()> {
        let files = &mut *self.files.borrow_mut();
        let (time, step) = (simulation.time(), simulation.step_count());
        let mut values = vec![Some(time), Some(step as f64), dt];
        values.extend(of_all(&simulation.ledger()));
        values.extend(simulation.pressed().into_iter().flatten().map(Some));
        for (b, (body, wrench)) in simulation.bodies().iter().zip(simulation.wrenches()).enumerate() {
            values.extend(of_body(body, &wrench));
            let mean = files.since.as_ref().and_then(|since| since.mean(b));
            values.extend([0, 1, 2].map(|d| mean.as_ref().map(|mean| mean.force[d])));
            values.extend([0, 1, 2].map(|d| mean.as_ref().map(|mean| mean.torque[d])));
        }
        values.extend(simulation.joints().iter().flat_map(of_joint));
        values.extend(files.values.iter_mut().map(Option::take));
        let row = self.columns.row(values);
        files.since = Some(Since::from(simulation));
        files.write_trace(&row)
    }

    /// A row for each step.
    fn note_each(
        &self,
        simulation: &Simulation,
        (mut time, mut step): (f64, u64),
        reports: &[StepReport],
    ) -> Result<()> {
        let files = &mut *self.files.borrow_mut();
        let columns = &self.columns;
        let (bodies, wrenches) = (simulation.bodies(), simulation.wrenches());
        // Joints are known after the last step, and so is what observers have seen.
        let joints = simulation.joints();
        let after: Vec<_> = joints.iter().flat_map(of_joint).chain(files.values.iter_mut().map(Option::take)).collect();
        let mut steps = Vec::with_capacity(reports.len());
        for (i, report) in reports.iter().enumerate() {
            (time, step) = (time + report.dt, step + 1);
            let is_last = i + 1 == reports.len();
            // The last step may land on a stop.
            steps.push((if is_last { simulation.time() } else { time }, step, is_last, report));
        }
        let row = |&(time, step, is_last, report): &(f64, u64, bool, &StepReport)| {
            let mut values = vec![Some(time), Some(step as f64), Some(report.dt)];
            let (bodies, wrenches) =
                (report.bodies.as_ref().unwrap_or(&bodies), report.wrenches.as_ref().unwrap_or(&wrenches));
            values.extend(bodies.iter().zip(wrenches).flat_map(|(body, wrench)| of_body(body, wrench)));
            values.extend(after.iter().map(|value| value.filter(|_| is_last)));
            columns.row(values)
        };
        // A robot's row has hundreds of numbers. Before a few are written, no thread has woken up.
        let rows: Vec<String> = match steps.len() {
            ..FEW_ROWS => steps.iter().map(row).collect(),
            _ => steps.par_iter().with_min_len(FEW_ROWS / 2).map(row).collect(),
        };
        files.write_trace(&rows.concat())
    }

    /// Writes the trace, all that is there of it, by columns, each under its name.
    ///
    /// They are made from the rows at the end, so that a run that was cut off has a trace, and one that goes on has it whole.
    fn write_columns(&self) -> Result<()> {
        let files = &mut *self.files.borrow_mut();
        files.flush()?;
        let path = files.folder.join(TRACE);
        let text = std::fs::read_to_string(&path).map_err(|e| io_error(&path, "reading the trace", e))?;
        let mut lines = text.lines();
        let names: Vec<String> = fields(lines.next().unwrap_or_default()).into_iter().map(unquoted).collect();
        let mut columns = vec![Vec::new(); names.len()];
        for line in lines {
            for (column, value) in columns.iter_mut().zip(line.split(',')) {
                column.push(value.parse().unwrap_or(f64::NAN));
            }
        }
        if self.npz {
            files.folder.write(TRACE_ARRAYS, "writing the trace", |out| {
                let mut archive = Npz::new(out);
                for (name, column) in names.iter().zip(&columns) {
                    archive.reals(name, &[column.len()], column)?;
                }
                archive.finish()
            })?;
        }
        #[cfg(feature = "parquet")]
        if self.parquet {
            let write = |out: &mut _| crate::export::parquet::write_columns(out, &names, &columns);
            files.folder.write(TRACE_PARQUET, "writing the trace", write)?;
        }
        Ok(())
    }
}

impl Observer for Trace {
    fn name(&self) -> &str {
        "trace"
    }
    fn interval(&self) -> f64 {
        self.interval.unwrap_or(f64::INFINITY)
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        self.due = self.interval.is_some();
        if self.due && !std::mem::replace(&mut self.begun, true) {
            self.due = false;
            self.note(simulation, None)?;
        }
        Ok(())
    }
    fn stepped(
        &mut self,
        simulation: &Simulation,
        from: (f64, u64),
        reports: &[StepReport],
        _: &mut dyn Output,
    ) -> Result<()> {
        if self.interval.is_none() {
            return self.note_each(simulation, from, reports);
        }
        if let Some(since) = &mut self.files.borrow_mut().since {
            for StepReport { dt, wrenches, .. } in reports {
                match wrenches {
                    Some(wrenches) => since.add(wrenches, *dt),
                    None => since.add(&simulation.wrenches(), *dt),
                }
            }
        }
        if std::mem::take(&mut self.due) {
            self.note(simulation, reports.last().map(|report| report.dt))?;
        }
        Ok(())
    }
    fn finish(&mut self, _: &Simulation, _: &mut dyn Output) -> Result<()> {
        if self.npz || self.parquet { self.write_columns() } else { Ok(()) }
    }
}

fn of_all(ledger: &Ledger) -> impl Iterator<Item = Option<f64>> {
    let energies = [ledger.kinetic, ledger.elastic, ledger.potential, ledger.damped];
    let sums = [ledger.particles as f64, ledger.mass].into_iter().chain(energies);
    // No law has to know its energy.
    sums.chain(ledger.momentum).chain(ledger.wall_impulse).map(|x| Some(x).filter(|x| x.is_finite()))
}

fn of_body(body: &BodyState, wrench: &Wrench) -> impl Iterator<Item = Option<f64>> + use<> {
    let vectors = [body.velocity, body.angular_velocity, wrench.force, wrench.torque];
    body.position.into_iter().chain(body.rotation).chain(vectors.into_iter().flatten()).map(Some)
}

fn of_joint(joint: &JointState) -> [Option<f64>; 3] {
    [joint.position, joint.rate, joint.torque].map(Some)
}

/// Holds a table of a run that is to go on to the columns that it will have.
pub(super) fn check_header(folder: &Path, file: &str, header: &str) -> Result<()> {
    let path = folder.join(file);
    let mut first = String::new();
    match File::open(&path).and_then(|file| BufReader::new(file).read_line(&mut first)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(io_error(&path, "reading a table that is to go on", error));
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
        what: format!("holds a {file} of other columns: it {}", plain(&what)),
        mend: "go on with the probes and observers that the run had, or choose another folder with --out".to_owned(),
    })
}

/// Opens a table whose second column is the step; one that goes on is cut after the present one.
pub(super) fn open(
    folder: &mut Folder,
    file: &str,
    simulation: &Simulation,
    resumed: bool,
    header: &str,
) -> Result<BufWriter<File>> {
    let path = folder.claim(file)?;
    let open = || -> io::Result<BufWriter<File>> {
        let mut file = File::options().read(true).write(true).create(true).truncate(!resumed).open(&path)?;
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
    open().map_err(|e| io_error(&path, "opening a table", e))
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

/// What [`quoted`] was given.
fn unquoted(field: &str) -> String {
    let inner = field.strip_prefix('"').and_then(|rest| rest.strip_suffix('"'));
    inner.map_or_else(|| field.to_owned(), |inner| inner.replace("\"\"", "\""))
}

/// A field of a CSV file (RFC 4180), on one line.
pub(super) fn quoted(field: &str) -> String {
    let field = plain(field);
    if field.contains(['"', ',']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is read back is what was written, bit for bit, and counts look like counts.
    #[test]
    fn numbers_in_rows_read_back_as_the_same_bits() {
        let text = |value: f64| {
            let mut row = String::new();
            add_number(&mut row, value);
            row
        };
        for value in [0.1, -2.5e-12, 1.0 / 3.0, 5e-324, f64::MAX, 3e8, -0.0, 1e21, f64::INFINITY] {
            let read: f64 = text(value).parse().unwrap();
            assert_eq!(read.to_bits(), value.to_bits(), "{value}: {}", text(value));
        }
        assert!(text(f64::NAN).parse::<f64>().unwrap().is_nan());
        for (value, written) in [(0.0, "0"), (231.0, "231"), (132_411.0, "132411"), (0.25, "0.25")] {
            assert_eq!(text(value), written);
        }
    }
}
