//! Nested levels: the same truths as on one level, with bodies cut by a level's rim; splits and merges; regions that move.
//!
//! Regions stand around a marker, a fixed ball that touches nothing, so that a rim lies exactly where a test wants it.

mod agents;
mod by_hand;
mod contact;
mod following;
mod footprints;
mod properties;
mod running;
mod sliding;
mod snow;
mod truths;

use barchan::{Ledger, Simulation};
use barchan_core::levels::{CellBox, MERGE_BEHIND, Regions, cell_of};
use barchan_tests::scenes::{Row, minus, norm, rows};
use barchan_tests::sketch::tool;

/// Levels around a marker; nothing for one level.
fn around_marker(count: u32, half: u32, at: [f64; 3]) -> String {
    if count == 1 {
        return String::new();
    }
    levels(count, half, &["marker"]) + &tool("marker", at, "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\"")
}

/// Levels around agents.
fn levels(count: u32, half: u32, agents: &[&str]) -> String {
    format!("[levels]\ncount = {count}\nhalf = {half}\nagents = {agents:?}\n")
}

/// Kinetic and elastic energy of the ground [J].
fn inner(ledger: &Ledger) -> f64 {
    ledger.kinetic + ledger.elastic
}

/// Angular momentum by the particles' own inertia, a²/12 per mass for a cube of side a [kg m²/s]. The ledger's counts what the
/// grid carries, h²/4, which changes with the level.
fn spin(simulation: &Simulation) -> [f64; 3] {
    rows(simulation).iter().fold([0.0; 3], |sum, r| {
        let inertia = r.volume0.powf(2.0 / 3.0) / 12.0;
        std::array::from_fn(|d| {
            let (a, b) = ((d + 1) % 3, (d + 2) % 3);
            sum[d] + r.m * (r.x[a] * r.v[b] - r.x[b] * r.v[a] + inertia * (r.c[3 * b + a] - r.c[3 * a + b]))
        })
    })
}

/// Kinetic energy, likewise [J].
fn kinetic(simulation: &Simulation) -> f64 {
    let square = |values: &[f64]| values.iter().map(|x| x * x).sum::<f64>();
    let of = |r: &Row| 0.5 * r.m * (square(&r.v) + r.volume0.powf(2.0 / 3.0) / 12.0 * square(&r.c));
    rows(simulation).iter().map(of).sum()
}

/// What a ledger says of splits and merges, by a part of its name.
fn counted(ledger: &Ledger, name: &str) -> u64 {
    ledger.counts.iter().filter(|(key, _)| key.contains(name)).map(|(_, n)| n).sum()
}

/// Particles on each level.
fn on_levels(simulation: &Simulation) -> Vec<usize> {
    let all = rows(simulation);
    (0..simulation.plan().cell_widths.len()).map(|l| all.iter().filter(|r| r.level as usize == l).count()).collect()
}

/// How many particles a fresh scene would have, filled at two a cell, if its regions were as they are now and reached as far as merging
/// leaves things alone.
fn static_count(simulation: &Simulation) -> f64 {
    let (regions, h) = (regions_of(simulation), simulation.plan().scene.world.cell);
    let class = |r: &Row| regions.finest_at(cell_of(r.x, h), MERGE_BEHIND) as i32;
    rows(simulation).iter().map(|r| r.volume0 / (0.5 * h).powi(3) / 8_f64.powi(class(r))).sum()
}

/// Where its levels are now.
fn regions_of(simulation: &Simulation) -> Regions {
    let scene = &simulation.plan().scene;
    let h = scene.world.cell;
    let [min, max] = [scene.world.min, scene.world.max].map(|end| cell_of(end.map(|x| x + 0.5 * h), h));
    let mut regions = Regions::new(scene, CellBox { min, max });
    regions.restore(simulation.particles().levels.map(|phase| phase.boxes).unwrap_or_default());
    regions
}
