//! What is printed at the end of a run.

use barchan::run::Summary;
use barchan::{Ledger, Vec3};

/// Prints where the time went, how fast it was, and the ledger.
pub(crate) fn print(summary: &Summary) {
    let [least, mean, greatest] = summary.dt.map(|dt| 1e3 * dt);
    println!(
        "\n{}: {:.4} s in {} steps of {mean:.4} ms ({least:.4} to {greatest:.4}), {} particles, {}",
        summary.scene, summary.simulated, summary.steps, summary.particles, summary.precision
    );
    println!("\n  {:<28}{:>10}{:>9}{:>11}", "time by effect", "seconds", "share", "passes");
    for effect in &summary.effects {
        println!("  {:<28}{:>10.3}{:>8.1} %{:>10}", effect.effect, effect.seconds, 100.0 * effect.share, effect.passes);
    }
    println!("  {:<28}{:>10.3}{:>8.1} %", "whole run", summary.wall, 100.0);
    println!(
        "\n  real-time factor {:.4}, {:.1} million particle-steps/s, peak memory {}",
        summary.real_time_factor,
        1e-6 * summary.particle_steps_per_s,
        summary.peak_memory.map_or_else(|| "unknown".to_owned(), bytes)
    );
    ledger(&summary.ledger_start, &summary.ledger_end);
    summary.warnings.iter().for_each(|warning| println!("  warning: {warning}"));
}

fn ledger(start: &Ledger, end: &Ledger) {
    println!("\n  {:<36}{:>30}{:>30}", "ledger", "start", "end");
    let line = |what: &str, value: &dyn Fn(&Ledger) -> String| {
        let (a, b) = (value(start), value(end));
        println!("  {what:<36}{a:>30}{b:>30}");
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
    line("impulse from gravity [N s]", &vector(|l| l.gravity_impulse));
    line("impulse from walls [N s]", &vector(|l| l.wall_impulse));
    line("mass deleted [kg]", &scalar(|l| l.deleted_mass));
    let names: std::collections::BTreeSet<&String> = start.counts.keys().chain(end.counts.keys()).collect();
    for name in names {
        line(name, &|l| l.counts.get(name).copied().unwrap_or(0).to_string());
    }
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
    fn numbers_are_for_people() {
        assert_eq!(duration(59.4), "59 s");
        assert_eq!(duration(61.0), "1 min 01 s");
        assert_eq!(duration(7260.0), "2 h 01 min");
        assert_eq!(bytes(2_400_000_000), "2.40 GB");
        assert_eq!(bytes(61_440), "61 kB");
    }
}
