//! The plan as a table for people.

use super::{Effect, Plan};
use crate::scene::plain;

use barchan_lanes::Isa;
use std::fmt;

/// The plan as a table for people.
impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "scene     {}", plain(&self.scene.name))?;
        for line in self.scene.doc.lines() {
            writeln!(f, "          {}", plain(line))?;
        }
        let cells: Vec<_> = (0..3).map(|d| (self.cell_max[d] - self.cell_min[d]).to_string()).collect();
        let widths: Vec<_> = self.cell_widths.iter().map(f64::to_string).collect();
        writeln!(f, "world     {} cells of {} m, {}", cells.join(" x "), self.cell_widths[0], self.precision)?;
        if widths.len() > 1 {
            let cells =
                self.ground_cells.iter().map(|cells| cells.map_or("none".to_owned(), |cells| format!("{cells:.1}")));
            let cells = cells.collect::<Vec<_>>().join(", ");
            writeln!(
                f,
                "levels    cells of {} m; cells of ground under each level's surface: {cells}",
                widths.join(", ")
            )?;
        }
        let staggered = self.staggered.iter().map(|&body| plain(&self.scene.name_of_body(body)));
        let staggered = staggered.collect::<Vec<_>>().join(", ");
        let note = if staggered.is_empty() { String::new() } else { format!("; staggered in {staggered}") };
        writeln!(f, "particles {}{note}", self.particle_count)?;
        let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
        writeln!(
            f,
            "memory    about {:.1} MiB of particles, {:.1} MiB of grid",
            mib(self.memory.0),
            mib(self.memory.1)
        )?;
        writeln!(f, "step      {:.3e} s; bound {:.3e} s by {}", self.dt, self.bound.dt, self.bound.by)?;
        let isas: Vec<_> = Isa::available().map(Isa::name).collect();
        writeln!(f, "isa       {}, by BARCHAN_ISA one of {}", self.isa.name(), isas.join(", "))?;
        for (i, line) in self.schedule.to_string().lines().enumerate() {
            writeln!(f, "{:10}{line}", if i == 0 { "stages" } else { "" })?;
        }
        let width = |pick: fn(&Effect) -> &str, head: &str| {
            self.effects.iter().map(|e| pick(e).chars().count()).chain([head.len()]).max().unwrap_or(0)
        };
        let (name, because) = (width(|e| &e.name, "effect"), width(|e| &e.because, "because"));
        writeln!(f, "\n{:name$}  {:because$}  adds", "effect", "because")?;
        for effect in &self.effects {
            writeln!(f, "{:name$}  {:because$}  {}", effect.name, effect.because, effect.adds)?;
        }
        for warning in &self.warnings {
            writeln!(f, "\nwarning: {warning}")?;
        }
        Ok(())
    }
}
