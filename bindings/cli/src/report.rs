//! What is printed at the end of a run.

use crate::print::show;
use barchan::run::Summary;
use barchan::scene::plain;
use barchan::{Ledger, Scene, Vec3};
use serde_json::Value;

/// What `barchan bench accuracy` wrote for built-in scenes.
const LADDERS: [(&str, &str); 3] = [
    ("cube-drop", include_str!("../ladders/cube-drop.json")),
    ("dig", include_str!("../ladders/dig.json")),
    ("letters", include_str!("../ladders/letters.json")),
];
/// A rung stands for cells up to this many times wider or narrower than its own.
const SAME_CELL: f64 = 1.5;

/// Prints where the time went, how fast it was, and the ledger.
pub(crate) fn print(summary: &Summary) {
    let [least, mean, greatest] = summary.dt.map(|dt| 1e3 * dt);
    let mut text = format!(
        "\n{}: {:.4} s in {} steps of {mean:.4} ms ({least:.4} to {greatest:.4}), {} particles, {}\n",
        plain(&summary.scene),
        summary.simulated,
        summary.steps,
        summary.particles,
        summary.precision
    );
    text += &format!("\n  {:<28}{:>10}{:>9}{:>11}\n", "time by effect", "seconds", "share", "passes");
    for effect in &summary.effects {
        let (name, share) = (plain(&effect.effect), 100.0 * effect.share);
        text += &format!("  {name:<28}{:>10.3}{share:>8.1} %{:>10}\n", effect.seconds, effect.passes);
    }
    text += &format!("  {:<28}{:>10.3}{:>8.1} %\n", "whole run", summary.wall, 100.0);
    text += &format!(
        "\n  real-time factor {:.4}, {:.1} million particle-steps/s, peak memory {}\n",
        summary.real_time_factor,
        1e-6 * summary.particle_steps_per_s,
        summary.peak_memory.map_or_else(|| "unknown".to_owned(), bytes)
    );
    text += &ledger(&summary.ledger_start, &summary.ledger_end);
    summary.warnings.iter().for_each(|warning| text += &format!("  warning: {}\n", plain(warning)));
    show(text);
}

fn ledger(start: &Ledger, end: &Ledger) -> String {
    let mut text = format!("\n  {:<36}{:>30}{:>30}\n", "ledger", "start", "end");
    let mut line = |what: &str, value: &dyn Fn(&Ledger) -> String| {
        let (a, b) = (value(start), value(end));
        text += &format!("  {:<36}{a:>30}{b:>30}\n", plain(what));
    };
    let scalar = |get: fn(&Ledger) -> f64| move |l: &Ledger| format!("{:.6e}", get(l));
    let vector = |get: fn(&Ledger) -> Vec3| {
        move |l: &Ledger| {
            let [x, y, z] = get(l);
            format!("({x:.2e}, {y:.2e}, {z:.2e})")
        }
    };
    line("particles", &|l| l.particles.to_string());
    line("mass [kg]", &scalar(|l| l.mass));
    line("momentum [kg m/s]", &vector(|l| l.momentum));
    line("angular momentum [kg m²/s]", &vector(|l| l.angular_momentum));
    line("kinetic energy [J]", &scalar(|l| l.kinetic));
    line("elastic energy [J]", &scalar(|l| l.elastic));
    line("potential energy [J]", &scalar(|l| l.potential));
    line("bodies: momentum [kg m/s]", &vector(|l| l.body_momentum));
    line("bodies: angular momentum [kg m²/s]", &vector(|l| l.body_angular_momentum));
    line("bodies: kinetic energy [J]", &scalar(|l| l.body_kinetic));
    line("bodies: potential energy [J]", &scalar(|l| l.body_potential));
    line("all energy [J]", &scalar(Ledger::energy));
    line("energy damped [J]", &scalar(|l| l.damped));
    line("impulse from gravity [N s]", &vector(|l| l.gravity_impulse));
    line("impulse from walls [N s]", &vector(|l| l.wall_impulse));
    line("mass deleted [kg]", &scalar(|l| l.deleted_mass));
    let names: std::collections::BTreeSet<&String> = start.counts.keys().chain(end.counts.keys()).collect();
    for name in names {
        line(name, &|l| l.counts.get(name).copied().unwrap_or(0).to_string());
    }
    text
}

/// What the scene's ladder says about its resolution; `None` if it has no ladder, or no rung of that cell and number of levels.
pub(crate) fn accuracy(scene: &Scene) -> Option<String> {
    let (name, text) = LADDERS.iter().find(|(name, _)| scene.name.starts_with(name))?;
    let ladder: Value = serde_json::from_str(text).expect("a committed ladder is JSON");
    let off = |row: &Value, key: &str, of: f64| Some((row[key].as_f64()? / of).ln().abs());
    // Random starts of the reference are no rungs.
    let rows = ladder["rows"].as_array()?.iter().filter(|row| row["seed"].is_null());
    let rungs = rows.filter(|row| row["levels"] == scene.levels.count);
    let apart = rungs.filter_map(|row| {
        let half = off(row, "half", scene.levels.half.into())?;
        Some((off(row, "cell_m", scene.world.cell)?, half, &row["errors"])).filter(|(.., errors)| !errors.is_null())
    });
    let near = apart.filter(|(cell, ..)| *cell < SAME_CELL.ln());
    let (.., errors) = near.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)))?;
    let height = &errors["height_near"];
    let tool = errors["final_z_mm"]
        .as_f64()
        .map_or_else(String::new, |z| format!(", and the tool's end about {} mm off", one_digit(z.abs())));
    Some(format!(
        "height error about {} mm near the tool, {} mm at most{tool} at this resolution \
         (docs/reports/accuracy-{name}.md)",
        one_digit(height["mean_mm"].as_f64()?),
        one_digit(height["max_mm"].as_f64()?)
    ))
}

/// To one significant digit: more is not known of an error.
fn one_digit(value: f64) -> f64 {
    format!("{value:.0e}").parse().expect("Rust reads the numbers that it writes")
}

/// Bytes for people.
pub(crate) fn bytes(bytes: u64) -> String {
    match bytes as f64 {
        b if b >= 1e9 => format!("{:.2} GB", 1e-9 * b),
        b if b >= 1e6 => format!("{:.1} MB", 1e-6 * b),
        b => format!("{:.0} kB", 1e-3 * b),
    }
}

/// A duration for people.
pub(crate) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_knows_its_rung() {
        let said = |cell: f64, levels: u32| {
            let mut scene = barchan::tasks::scene("cube-drop", &[] as &[&str]).unwrap();
            (scene.world.cell, scene.levels.count) = (cell, levels);
            accuracy(&scene)
        };
        let line = said(0.04, 1).unwrap();
        assert!(line.contains("mm near the tool") && line.contains("docs/reports/accuracy-cube-drop.md"), "{line}");
        assert_ne!(said(0.04, 1), said(0.08, 1));
        assert_eq!(said(0.001, 1), None, "finer than the ladder");
        assert_eq!(accuracy(&barchan::tasks::scene("jelly-drop", &[] as &[&str]).unwrap()), None, "no ladder");
    }

    #[test]
    fn numbers_are_for_people() {
        assert_eq!([0.0, 0.0881, 1.35, 0.96, 26.0].map(|v| one_digit(v).to_string()), ["0", "0.09", "1", "1", "30"]);
        assert_eq!(duration(59.4), "59 s");
        assert_eq!(duration(61.0), "1 min 01 s");
        assert_eq!(duration(7260.0), "2 h 01 min");
        assert_eq!(bytes(2_400_000_000), "2.40 GB");
        assert_eq!(bytes(61_440), "61 kB");
    }
}
