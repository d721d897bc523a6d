//! `probes.csv`: what the probes of the scene find, each at its own interval, and mean forces on walls since the value before; and what of it stands in
//! the summary.

use super::folder::Folder;
use super::recorder::Files;
use super::{PROBES, io_error};
use crate::run::ProbeFigures;
use crate::run::trace::{add_number, quoted};
use barchan_core::observer::{Observer, Output};
use barchan_core::scene::Probe;
use barchan_core::{Result, Scene, Simulation, Vec3, probe};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;
use std::rc::Rc;

/// The table, and the row that is being put together: probes of several intervals may look after the same step.
pub(super) struct Table {
    file: BufWriter<File>,
    row: Option<(f64, u64, Vec<Option<f64>>)>,
}

impl Table {
    /// The table of a scene with probes.
    pub(super) fn open(folder: &mut Folder, simulation: &Simulation, resumed: bool) -> Result<Option<Self>> {
        if simulation.plan().scene.probe.is_empty() {
            return Ok(None);
        }
        let header = header(&simulation.plan().scene);
        let file = super::trace::open(folder, PROBES, simulation, resumed, &header)?;
        Ok(Some(Self { file, row: None }))
    }

    fn set(
        &mut self,
        (time, step): (f64, u64),
        columns: usize,
        first: usize,
        values: &[Option<f64>],
    ) -> std::io::Result<()> {
        if self.row.as_ref().is_none_or(|row| row.1 != step) {
            self.write_row()?;
            self.row = Some((time, step, vec![None; columns]));
        }
        if let Some((_, _, row)) = &mut self.row {
            row[first..first + values.len()].copy_from_slice(values);
        }
        Ok(())
    }

    fn write_row(&mut self) -> std::io::Result<()> {
        let Some((time, step, values)) = self.row.take() else { return Ok(()) };
        let mut line = String::new();
        add_number(&mut line, time);
        line += &format!(",{step}");
        for value in values {
            line.push(',');
            if let Some(value) = value {
                add_number(&mut line, value);
            }
        }
        writeln!(self.file, "{line}")
    }

    /// Writes all that has been found.
    pub(super) fn flush(&mut self, folder: &Folder) -> Result<()> {
        let flushed = self.write_row().and_then(|()| self.file.flush());
        flushed.map_err(|e| io_error(&folder.join(PROBES), "writing what probes found", e))
    }
}

/// Columns of a probe in the table.
fn columns_of(one: &Probe) -> Vec<String> {
    let forces: &[&str] =
        if one.wall.is_some() { &["mean force x [N]", "mean force y [N]", "mean force z [N]"] } else { &[] };
    probe::columns(one).into_iter().chain(forces.iter().map(|&name| name.to_owned())).collect()
}

/// Columns of all probes: `NAME COLUMN`.
fn columns(scene: &Scene) -> Vec<String> {
    let of = |one| columns_of(one).into_iter().map(|column| format!("{} {column}", one.name));
    scene.probe.iter().flat_map(of).collect()
}

/// The rows of a table: time, and the values of probes.
fn rows(file: &Path) -> Vec<(f64, Vec<Option<f64>>)> {
    let text = fs::read_to_string(file).unwrap_or_default();
    let row = |line: &str| {
        let mut values = line.split(',').map(|value| value.parse().ok());
        let time = values.next().flatten()?;
        Some((time, values.skip(1).collect()))
    };
    text.lines().skip(1).filter_map(row).collect()
}

/// The first line of a scene's table.
pub(super) fn header(scene: &Scene) -> String {
    let named = columns(scene).iter().map(|name| format!(",{}", quoted(name))).collect::<String>();
    format!("time [s],step{named}")
}

/// The probes that look together.
pub(super) struct Probes {
    files: Rc<RefCell<Files>>,
    interval: f64,
    probes: Vec<Watched>,
    columns: usize,
}

/// A probe by its number, with the number of its first column; of a wall, when it was looked at last, and the impulse then [s, N s].
struct Watched {
    number: usize,
    first: usize,
    is_wall: bool,
    last: Option<(f64, Vec3)>,
}

impl Probes {
    /// One observer for each interval.
    pub(super) fn of(files: &Rc<RefCell<Files>>, scene: &Scene) -> Vec<Self> {
        let mut first = 0;
        let mut all: BTreeMap<u64, Self> = BTreeMap::new();
        let columns = columns(scene).len();
        // Of a run that goes on.
        let before = match scene.wall_parts().next() {
            Some(_) => rows(&files.borrow().folder.join(PROBES)),
            None => Vec::new(),
        };
        for (number, one) in scene.probe.iter().enumerate() {
            let interval = scene.probe_interval(one);
            let is_wall = one.wall.is_some();
            let impulse = |(time, row): &(f64, Vec<Option<f64>>)| {
                let [x, y, z] = [0, 1, 2].map(|d| row.get(first + d).copied().flatten());
                Some((*time, [x?, y?, z?]))
            };
            let last = if is_wall { before.iter().rev().find_map(impulse) } else { None };
            let new = || Self { files: Rc::clone(files), interval, probes: Vec::new(), columns };
            all.entry(interval.to_bits()).or_insert_with(new).probes.push(Watched { number, first, is_wall, last });
            first += columns_of(one).len();
        }
        all.into_values().collect()
    }
}

impl Observer for Probes {
    fn name(&self) -> &str {
        "probes"
    }
    fn interval(&self) -> f64 {
        self.interval
    }
    fn observe(&mut self, simulation: &Simulation, _: &mut dyn Output) -> Result<()> {
        let found = simulation.probes(|number| self.probes.iter().any(|own| own.number == number))?;
        let files = &mut *self.files.borrow_mut();
        let Some(table) = &mut files.probes else { return Ok(()) };
        let when = (simulation.time(), simulation.step_count());
        for (own, found) in self.probes.iter_mut().zip(found) {
            let mut values: Vec<Option<f64>> = found.values.into_iter().map(|(_, value)| value).collect();
            if own.is_wall {
                let impulse: Vec3 = std::array::from_fn(|d| values[d].unwrap_or_default());
                let before = own.last.replace((when.0, impulse)).filter(|(time, _)| *time < when.0);
                let mean = |d: usize| before.map(|(time, last)| (impulse[d] - last[d]) / (when.0 - time));
                values.extend([0, 1, 2].map(mean));
            }
            let set = table.set(when, self.columns, own.first, &values);
            set.map_err(|e| io_error(&files.folder.join(PROBES), "writing what probes found", e))?;
        }
        Ok(())
    }
}

/// Last, mean, least and greatest value of each column, of all that the table holds.
pub(super) fn figures(file: &Path, scene: &Scene) -> BTreeMap<String, BTreeMap<String, ProbeFigures>> {
    let (rows, mut all) = (rows(file), BTreeMap::new());
    let mut at = 0;
    for one in &scene.probe {
        let mut own = BTreeMap::new();
        for column in columns_of(one) {
            let values: Vec<f64> = rows.iter().filter_map(|(_, row)| row.get(at).copied().flatten()).collect();
            at += 1;
            if let Some(last) = values.last() {
                let mean = values.iter().sum::<f64>() / values.len() as f64;
                let least = values.iter().copied().fold(f64::INFINITY, f64::min);
                let greatest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                own.insert(column, ProbeFigures { last: *last, mean, least, greatest });
            }
        }
        all.insert(one.name.clone(), own);
    }
    all
}
