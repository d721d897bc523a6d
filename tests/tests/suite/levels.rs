//! Nested levels: the same truths as on one level, with bodies cut by a level's rim; splits and merges; regions that move.

use barchan::{Ledger, Precision};
use barchan_tests::scenes::{rows, run_to, simulation};
use barchan_tests::sketch::{Head, material, tool};
use std::f64::consts::TAU;

/// Two or more levels around a marker, a small fixed ball that touches nothing.
fn around_marker(count: u32, half: u32, at: [f64; 3]) -> [String; 2] {
    [
        format!("[levels]\ncount = {count}\nhalf = {half}\nagents = [\"marker\"]\n"),
        tool("marker", at, "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\""),
    ]
}

/// A ball of neo-Hookean jelly of radius 0.3 m, cells of `cell`, spinning about z at 6 rad/s around the origin; `x` is where the
/// fine region ends.
fn spinning_ball(cell: f64, levels: u32, x: f64) -> String {
    let half = 16.0 * cell;
    let ball = "[[body]]\nmaterial = \"neo_hookean\"\nshape = { sphere = { radius = 0.3 } }\nangular_velocity = [0.0, 0.0, 6.0]\n";
    Head::space(cell).time("safety = 0.5").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        ball.to_owned(),
        around_marker(levels, 16, [x - half, 0.0, -0.6]).concat(),
    ])
}

fn inner(ledger: &Ledger) -> f64 {
    ledger.kinetic + ledger.elastic
}

/// B28, B29: a ball that spins through the rim. Without a rim it tears; without its affine term a third of the angular momentum
/// and half of the kinetic energy go while linear momentum is exact.
#[test]
fn b29_a_spinning_ball_keeps_its_spin_and_energy() {
    for levels in [1, 2, 3] {
        let mut spin = simulation(&spinning_ball(0.025, levels, 0.0), Precision::F64);
        let before = spin.ledger();
        run_to(&mut spin, TAU / 6.0);
        let after = spin.ledger();
        let spread =
            rows(&spin).iter().fold(0f64, |far, r| far.max((r.x[0].powi(2) + r.x[1].powi(2) + r.x[2].powi(2)).sqrt()));
        println!(
            "B29 {levels} levels: N {} -> {}, dL {:+.2e}, dE {:+.2e}, KE {:+.2e}, dP {:.1e}, dM {:.1e}, reach {spread:.4} m, {:?}",
            before.particles,
            after.particles,
            after.angular_momentum[2] / before.angular_momentum[2] - 1.0,
            inner(&after) / inner(&before) - 1.0,
            after.kinetic / before.kinetic - 1.0,
            after.momentum.iter().fold(0f64, |m, p| m.max(p.abs())) / (before.mass * 6.0 * 0.3),
            (after.mass / before.mass - 1.0).abs(),
            after.counts,
        );
    }
}
