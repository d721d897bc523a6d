//! Walls that let go of the ground. Slip, stick and periodic sides are held to the plain reference in `transfers`.

use barchan::{Precision, Simulation, Vec3};
use barchan_tests::scenes::{rows, run_to, simulation};
use barchan_tests::sketch::{self, Head, material};

/// An elastic block above a floor, with gravity (gx, gz).
fn block(walls: &str, velocity: Vec3, gravity: [f64; 2], bottom: f64) -> String {
    let [x, z] = gravity;
    let (min, max) = ([-1.0, -1.0, 0.0], [3.0, 1.0, 1.0]);
    let head =
        Head { gravity: [x, 0.0, z], gravity_ramp: 0.1, min, max, walls, ..Head::space(0.02) }.time("safety = 0.5");
    head.with(&[
        material("hencky", 1000.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
        sketch::block("hencky", [0.0, 0.0, bottom], [0.24, 0.12, bottom + 0.08], &format!("velocity = {velocity:?}")),
    ])
}

fn mean(simulation: &Simulation) -> ([f64; 3], [f64; 3]) {
    let all = rows(simulation);
    let n = all.len() as f64;
    let sum = |f: fn(&barchan_tests::scenes::Row) -> [f64; 3]| {
        all.iter().fold([0.0; 3], |s, r| std::array::from_fn(|d| s[d] + f(r)[d] / n))
    };
    (sum(|r| r.x), sum(|r| r.v))
}

/// Symptom: a particle was found outside an open side up to three cells late, or never if it was slow, since sides that cut cells were taken as the
/// next cell of its level and nobody looked before a sort. What is simulated out there is not what the scene says.
#[test]
fn a_particle_that_leaves_is_noticed_within_a_cell() {
    barchan_tests::leaving::hold("cpu");
    barchan_tests::leaving::hold("wgpu");
}

/// A block that touches a wall and moves away from it leaves a separating wall freely; a slip wall holds it back, since mirror
/// images pull as well as push.
#[test]
fn a_separating_wall_lets_a_block_leave_and_a_slip_wall_holds_it_back() {
    let leave = |floor: &str| {
        let mut block = simulation(&block(floor, [0.0, 0.0, 0.1], [0.0, 0.0], 0.0), Precision::F64);
        run_to(&mut block, 0.1);
        mean(&block).1[2] / 0.1
    };
    let (free, held) = (leave("z_min = { separate = {} }"), leave("z_min = \"slip\""));
    println!(
        "leaves a separating wall with {free:.4} of its speed (1 within 1e-9), a slip wall with {held:.3} (less than 0.5)"
    );
    assert!((free - 1.0).abs() < 1e-9, "{free}");
    assert!(held < 0.5, "{held}");
}

/// A block comes to rest on a floor that lets go where it would on a slip floor. Stopping nodes that the ground has not reached
/// yet would hold it one or two cells up.
#[test]
fn a_separating_wall_is_where_it_is_drawn() {
    let lowest = |floor: &str| {
        let mut drop = simulation(&block(floor, [0.0, 0.0, -0.3], [0.0, -9.81], 0.05), Precision::F64);
        let mut lowest = f64::INFINITY;
        while drop.time() < 0.3 {
            let next = drop.time() + 0.005;
            run_to(&mut drop, next);
            lowest = rows(&drop).iter().fold(lowest, |least, r| least.min(r.x[2]));
        }
        lowest
    };
    let (free, held) = (lowest("z_min = { separate = {} }"), lowest("z_min = \"slip\""));
    println!(
        "lowest particle at {:.2} mm over a wall that lets go, {:.2} mm over a slip wall; cells of 20 mm, tolerance 0.1 cell",
        1e3 * free,
        1e3 * held
    );
    assert!((free - held).abs() < 2e-3 && free > 0.0, "{free} and {held}");
}

/// Coulomb friction at a wall: a block on a floor in tilted gravity accelerates by g (sin theta - mu cos theta), or stays.
#[test]
fn a_wall_with_friction_obeys_coulomb() {
    let (s, c) = f64::to_radians(30.0).sin_cos();
    let gravity = [9.81 * s, -9.81 * c];
    for friction in [0.0, 0.3, 0.8] {
        let floor = format!("z_min = {{ separate = {{ friction = {friction} }} }}");
        let mut slide = simulation(&block(&floor, [0.0; 3], gravity, 0.0), Precision::F64);
        run_to(&mut slide, 0.2);
        let from = mean(&slide).1[0];
        run_to(&mut slide, 0.4);
        let a = (mean(&slide).1[0] - from) / 0.2;
        let expected = 9.81 * (s - friction * c).max(0.0);
        println!("wall with friction {friction}: {a:.4} m/s², Coulomb {expected:.4}, tolerance 1.5 % of g sin theta");
        assert!((a - expected).abs() < 0.015 * 9.81 * s, "{a} instead of {expected}");
    }
}

/// Impulses of walls are booked: what gravity gave and walls took is what the ground has. A mirror that forgot its reaction, or
/// a corner folded twice, would not close.
#[test]
fn impulses_of_walls_and_gravity_close_the_momentum_ledger() {
    for (precision, tolerance) in [(Precision::F64, 1e-12), (Precision::F32, 2e-5)] {
        for floor in ["\"slip\"", "\"stick\"", "{ separate = { friction = 0.4 } }"] {
            let walls = format!("x_min = \"slip\"\ny_min = \"stick\"\nz_min = {floor}");
            let scene =
                block(&walls, [0.5, 0.1, -0.5], [3.0, -9.0], 0.01).replace("[-1.0, -1.0, 0.0]", "[-0.02, 0.0, 0.0]");
            let mut box_ = simulation(&scene, precision);
            let before = box_.ledger();
            run_to(&mut box_, 0.2);
            let after = box_.ledger();
            let scale = after.mass * 2.0;
            let gap = (0..3)
                .map(|d| {
                    let booked = after.wall_impulse[d] + after.gravity_impulse[d];
                    (after.momentum[d] - before.momentum[d] - booked).abs() / scale
                })
                .fold(0.0, f64::max);
            println!("momentum ledger at a {floor} floor, {precision}: gap {gap:.1e}, tolerance {tolerance:.0e}");
            assert!(gap < tolerance, "{floor} {precision}: {gap:.2e}");
        }
    }
}
