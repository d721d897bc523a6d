//! Subcycling: every level with its own step, and nothing lost between them.

use barchan::{Ledger, Precision};
use barchan_tests::scenes::{rows, run_to, simulation};
use barchan_tests::sketch::{Head, material, tool};
use std::f64::consts::TAU;

/// A ball of jelly of radius 0.3 m, in cells of 25 mm, spinning about z at 6 rad/s, cut in two by the rim of the finest level.
fn spinning_ball(levels: u32, subcycle: bool, safety: f64) -> String {
    Head::space(0.025).time(format!("safety = {safety}")).with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        "[[body]]\nmaterial = \"neo_hookean\"\nshape = { sphere = { radius = 0.3 } }\nangular_velocity = [0.0, 0.0, 6.0]\n"
            .to_owned(),
        format!("[levels]\ncount = {levels}\nhalf = 16\nagents = [\"marker\"]\nsubcycle = {subcycle}\n"),
        tool("marker", [-0.4, 0.0, -0.6], "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\""),
    ])
}

fn inner(ledger: &Ledger) -> f64 {
    ledger.kinetic + ledger.elastic
}

/// B41: a ball that spins through rims between levels that each take steps of their own. With the mean velocity for the coarser
/// particles it would gain energy twelvefold in one turn; with forces that act for unlike times on their two ends, momentum
/// would go. Mass, momentum, angular momentum and energy are held, next to the same ball with one step for all.
#[test]
fn a_ball_spins_through_levels_with_steps_of_their_own() {
    for (levels, safety) in [(2, 0.5), (3, 0.5), (2, 0.8)] {
        let mut lost = Vec::new();
        for subcycle in [false, true] {
            let mut spin = simulation(&spinning_ball(levels, subcycle, safety), Precision::F64);
            let before = spin.ledger();
            run_to(&mut spin, TAU / 6.0);
            let after = spin.ledger();
            let far = |r: &barchan_tests::scenes::Row| r.x.iter().map(|x| x * x).sum::<f64>().sqrt();
            let reach = rows(&spin).iter().map(far).fold(0.0, f64::max);
            let momentum = after.momentum.iter().fold(0f64, |m, p| m.max(p.abs())) / (before.mass * 6.0 * 0.3);
            let spun = after.angular_momentum[2] / before.angular_momentum[2] - 1.0;
            let energy = inner(&after) / inner(&before) - 1.0;
            println!(
                "B41 {levels} levels, safety {safety}, subcycle {subcycle}: {} steps, dP {momentum:.1e} / 1e-13, \
                 dL {spun:+.2e} / 1e-3, dE {energy:+.2e} / -1.5e-2 to 0, reach {reach:.4} m / 0.306, N {}",
                spin.step_count(),
                after.particles
            );
            assert!(momentum < 1e-13 && (after.mass / before.mass - 1.0).abs() < 1e-13);
            assert!(spun.abs() < 1e-3 && (-1.5e-2..=0.0).contains(&energy) && reach < 0.306);
            lost.push(energy);
        }
        assert!((lost[1] - lost[0]).abs() < 5e-3, "subcycling itself costs {:.1e} of the energy", lost[1] - lost[0]);
    }
}

/// A column on a stick floor, its lower half on a coarser level: the two halves rest on each other though they step
/// differently; a force that acted for another time on one of its ends would push it up or let it sink.
#[test]
fn a_column_rests_on_a_coarser_one_with_longer_steps() {
    let scene = |subcycle: bool| {
        let head = Head::cells(
            0.05,
            [8, 8, 48],
            "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"",
        );
        Head { gravity_ramp: 0.5, ..head.time("safety = 0.5") }.with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e6, poisson_ratio = 0.2"),
            "[[body]]\nmaterial = \"neo_hookean\"\nshape = { box = { min = [0.0, 0.0, 0.0], max = [0.4, 0.4, 1.6] } }\n".to_owned(),
            format!("[levels]\ncount = 2\nhalf = 24\nagents = [\"marker\"]\nsubcycle = {subcycle}\n"),
            tool("marker", [0.2, 0.2, 2.2], "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\""),
        ])
    };
    for subcycle in [false, true] {
        let mut column = simulation(&scene(subcycle), Precision::F64);
        let start = column.ledger();
        // Nothing damps the column: it swings about its rest, with the period 4 H / c.
        let modulus = 1e6 * 0.8 / (1.2 * 0.6);
        let period = 4.0 * 1.6 / f64::sqrt(modulus / 1000.0);
        let top = |s: &barchan::Simulation| rows(s).iter().map(|r| r.x[2]).fold(0.0, f64::max);
        run_to(&mut column, 0.6);
        let mut mean = 0.0;
        for i in 1..=24 {
            run_to(&mut column, 0.6 + 2.0 * period * f64::from(i) / 24.0);
            mean += top(&column) / 24.0;
        }
        let end = column.ledger();
        let walls = end.wall_impulse[2] - start.wall_impulse[2];
        let weight_and_time = end.mass * 9.81 * column.time();
        let closes = (end.momentum[2] - start.momentum[2] - walls - end.gravity_impulse[2]).abs() / weight_and_time;
        // Uniaxial strain under its own weight: the top sinks by rho g H² / (2 M), M = E (1 - nu) / ((1 + nu)(1 - 2 nu)).
        let sinks = 1000.0 * 9.81 * 1.6 * 1.6 / (2.0 * modulus);
        let sunk = 1.5875 - mean;
        println!(
            "column, subcycle {subcycle}: sinks {:.3} mm against {:.3} mm / 3 %, momentum closes to {closes:.1e} / 1e-12",
            1e3 * sunk,
            1e3 * sinks
        );
        assert!(closes < 1e-12, "momentum is off by {closes:.1e} of weight x time");
        assert!((sunk / sinks - 1.0).abs() < 0.03, "sinks {sunk} m, {sinks} m wanted");
    }
}

/// A bed on a plane that is a tool, far from the finest box: what coarser levels rest on is felt there too, and in full. A floor
/// felt on the finest level only would let the rest of the ground fall through it.
#[test]
fn coarser_levels_rest_on_tools_too() {
    let head = Head::cells(0.05, [32, 8, 32], "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"");
    let scene = Head { gravity_ramp: 0.3, ..head.time("safety = 0.5") }.with(&[
        material("sand", 1500.0, "young_modulus = 1e6, poisson_ratio = 0.2"),
        "[[body]]\nmaterial = \"sand\"\nshape = { box = { min = [0.0, 0.0, 0.4], max = [1.6, 0.4, 0.8] } }\n"
            .to_owned(),
        "[levels]\ncount = 2\nhalf = 8\nagents = [\"marker\"]\nsubcycle = true\n".to_owned(),
        tool("marker", [0.2, 0.2, 1.1], "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\""),
        tool(
            "floor",
            [0.0; 3],
            "plane = { point = [0.0, 0.0, 0.4], normal = [0.0, 0.0, 1.0] }",
            "\"slip\"",
            "\"fixed\"",
        ),
    ]);
    let mut bed = simulation(&scene, Precision::F64);
    let weight = bed.ledger().mass * 9.81;
    run_to(&mut bed, 0.8);
    let mut impulse = 0.0;
    let from = bed.time();
    let momentum = bed.ledger().momentum[2];
    for _ in 0..200 {
        let before = bed.time();
        bed.step().unwrap();
        impulse -= bed.wrenches()[1].force[2] * (bed.time() - before);
    }
    let expected = weight * (bed.time() - from) + bed.ledger().momentum[2] - momentum;
    let lowest = rows(&bed).iter().map(|r| r.x[2]).fold(f64::INFINITY, f64::min);
    println!("floor: impulse {impulse:.4} N s against {expected:.4} / 1e-9, lowest particle {lowest:.4} m / 0.375");
    assert!((impulse / expected - 1.0).abs() < 1e-9, "{impulse} N s on the floor, {expected} wanted");
    assert!(lowest > 0.375);
}
