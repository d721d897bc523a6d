//! Two-way coupling with rigid bodies, held to conservation laws and to Coulomb's law.

use barchan::{Precision, Simulation, Vec3};
use barchan_tests::scenes::{minus, norm, plus, rows, run_to, simulation, totals};
use barchan_tests::sketch::{Head, block, body, box_mesh, half, incline, material, tool};

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[(d + 1) % 3] * b[(d + 2) % 3] - a[(d + 2) % 3] * b[(d + 1) % 3])
}

/// A soft ball and a rigid box in empty space, about to collide off centre.
fn collision(contact: &str, motion: &str) -> String {
    let ball = "sphere = { center = [-0.36, 0.06, 0.02], radius = 0.2 }";
    Head::space(0.05).time("step = 2e-4").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        body("neo_hookean", ball, "velocity = [1.5, 0.2, 0.0]\nangular_velocity = [0.0, 0.0, 2.0]"),
        tool("box", [0.0; 3], &half([0.15, 0.2, 0.2]), contact, motion),
    ])
}

/// A9 i: in an isolated system total momentum and angular momentum cannot change, whatever the contact does. A push-out
/// without reaction, an impulse applied elsewhere than where it was taken, or one counted twice would show at once.
#[test]
fn isolated_collision_conserves_momentum_and_angular_momentum() {
    for contact in ["{ coulomb = { friction = 0.4 } }", "\"stick\"", "\"slip\""] {
        for (precision, tolerance) in [(Precision::F64, 1e-13), (Precision::F32, 1e-6)] {
            let mut pair = simulation(&collision(contact, "{ free = { mass = 8 } }"), precision);
            let before = pair.ledger();
            let (p0, l0) = totals(&before);
            for _ in 0..1000 {
                pair.step().unwrap();
            }
            let after = pair.ledger();
            let (p1, l1) = totals(&after);
            let exchanged = norm(after.body_momentum) / norm(p0);
            let p = norm(minus(p1, p0)) / norm(p0);
            let l = norm(minus(l1, l0)) / (norm(p0) * 0.4);
            println!(
                "A9 i {contact} {precision}: dP {p:.1e}, dL {l:.1e}, tolerance {tolerance:.0e}; body took {exchanged:.2} of P"
            );
            assert!(exchanged > 0.05, "they never met");
            assert!(p < tolerance && l < tolerance, "{contact} {precision}: dP {p:.1e}, dL {l:.1e}");
        }
    }
}

/// A9 ii: a box at rest on sand is borne by exactly its weight.
#[test]
fn resting_box_feels_its_weight() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let head = Head { gravity_ramp: 0.1, ..Head::cells(0.02, [16, 16, 20], walls) }.time("safety = 0.5");
    let scene = head.with(&[
        material("sand", 1500.0, "young_modulus = 5e5, poisson_ratio = 0.2, friction_angle_deg = 30.0"),
        block("sand", [0.0; 3], [0.32, 0.32, 0.12], ""),
        tool(
            "box",
            [0.16, 0.16, 0.172],
            &half([0.05; 3]),
            "{ coulomb = { friction = 0.5 } }",
            "{ free = { mass = 0.8 } }",
        ),
    ]);
    let mut rest = simulation(&scene, Precision::F32);
    run_to(&mut rest, 1.0);
    let (mut impulse, mut squares, mut time) = (0.0, 0.0, 0.0);
    // Means over 5 ms: the grid's own ringing is faster than any robot's controller.
    let (mut window, mut length, mut windows) = (0.0, 0.0, 0.0);
    while time < 1.0 {
        let dt = rest.step().unwrap().dt;
        let force = rest.wrenches()[0].force[2];
        impulse += force * dt;
        time += dt;
        window += force * dt;
        length += dt;
        if length >= 5e-3 {
            squares += (window / length).powi(2);
            windows += 1.0;
            (window, length) = (0.0, 0.0);
        }
    }
    let (weight, mean) = (0.8 * 9.81, impulse / time);
    let deviation = (squares / windows - mean * mean).max(0.0).sqrt();
    println!(
        "A9 ii: mean force {mean:.4} N, weight {weight:.4} N (±1 %); deviation {:.1} % (< 10 %)",
        100.0 * deviation / mean
    );
    assert!((mean / weight - 1.0).abs() < 0.01 && deviation < 0.1 * mean);
}

/// A9 iii: what sticks together ends with the common velocity of both masses.
#[test]
fn sticking_capture_ends_with_the_common_velocity() {
    // Head on, so that the pair does not turn and the box's mean velocity is the pair's. Clay, not rubber: a rebound would tear
    // it off again.
    let scene = Head::space(0.05).time("step = 2e-4").with(&[
        material("von_mises", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3, yield_stress = 2e3"),
        body("von_mises", "sphere = { center = [-0.36, 0.0, 0.0], radius = 0.2 }", "velocity = [1.5, 0.0, 0.0]"),
        tool("box", [0.0; 3], &half([0.15, 0.2, 0.2]), "\"stick\"", "{ free = { mass = 20 } }"),
    ]);
    let mut capture = simulation(&scene, Precision::F64);
    let start = capture.ledger();
    let expected = start.momentum[0] / (start.mass + 20.0);
    run_to(&mut capture, 0.4);
    let from = capture.bodies()[0].position[0];
    let (begin, span) = (capture.time(), 1.2);
    run_to(&mut capture, begin + span);
    let mean = (capture.bodies()[0].position[0] - from) / span;
    println!("A9 iii: mean velocity {mean:.5} m/s, common velocity {expected:.5} m/s, tolerance 0.5 %");
    assert!((mean / expected - 1.0).abs() < 0.005, "{mean} instead of {expected}");
}

/// A9 v: the wrench reported for a driven tool is the momentum that left the ground, to rounding.
#[test]
fn force_on_a_driven_tool_is_the_momentum_removed_from_the_ground() {
    for (precision, tolerance) in [(Precision::F64, 1e-12), (Precision::F32, 1e-6)] {
        let motion = "{ velocity = { linear = [-0.5, 0.1, 0.0] } }";
        let scene = collision("{ coulomb = { friction = 0.3 } }", motion);
        let mut push = simulation(&scene, precision);
        let before = push.ledger();
        let (mut impulse, mut moment) = ([0.0; 3], [0.0; 3]);
        for _ in 0..1000 {
            let at = push.bodies()[0].position;
            let dt = push.step().unwrap().dt;
            let wrench = push.wrenches()[0];
            let arm = cross(at, wrench.force);
            for d in 0..3 {
                impulse[d] += wrench.force[d] * dt;
                moment[d] += (wrench.torque[d] + arm[d]) * dt;
            }
        }
        let after = push.ledger();
        let p = norm(plus(minus(after.momentum, before.momentum), impulse)) / norm(impulse);
        let l = norm(plus(minus(after.angular_momentum, before.angular_momentum), moment)) / (norm(impulse) * 0.4);
        println!("A9 v {precision}: force {p:.1e}, torque {l:.1e}, tolerance {tolerance:.0e}");
        assert!(norm(impulse) > 1.0 && p < tolerance && l < tolerance, "{precision}: {p:.1e}, {l:.1e}");
    }
}

/// A10: a block on an incline accelerates by g (sin theta - mu cos theta), or stays; whatever the angle between plane and grid.
/// A friction law that mixes up impulse and force, or sees the grid's axes, would not.
#[test]
fn block_on_an_incline_obeys_coulomb() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = box_mesh(folder.path(), [0.16, 0.08, 0.04]);
    let slope = f64::to_radians(30.0);
    for tilt in [0.0, 17.0, 45.0] {
        for friction in [0.3, 0.7] {
            let mut block = simulation(&incline(tilt, friction, &mesh, ""), Precision::F64);
            let (s, c) = f64::to_radians(tilt).sin_cos();
            let along = |sim: &Simulation| {
                let all = rows(sim);
                let n = all.len() as f64;
                let mean = |f: &dyn Fn(&barchan_tests::scenes::Row) -> Vec3| {
                    let sum = all.iter().fold([0.0; 3], |s, r| std::array::from_fn(|d| s[d] + f(r)[d]));
                    (sum[0] * c + sum[2] * s) / n
                };
                (mean(&|r| r.x), mean(&|r| r.v))
            };
            run_to(&mut block, 0.3);
            let (x0, v0) = along(&block);
            run_to(&mut block, 0.5);
            let (x1, v1) = along(&block);
            if friction < slope.tan() {
                let expected = 9.81 * (slope.sin() - friction * slope.cos());
                let a = (v1 - v0) / 0.2;
                println!("A10 plane at {tilt}°, mu {friction}: {a:.4} m/s², Coulomb {expected:.4}, tolerance 1.5 %");
                assert!((a / expected - 1.0).abs() < 0.015, "{a} instead of {expected} at {tilt}°");
            } else {
                let creep = (x1 - x0) / 0.2 / 0.02;
                println!("A10 plane at {tilt}°, mu {friction}: creeps {creep:.1e} cells/s, tolerance 1e-3");
                assert!(creep.abs() < 1e-3, "creeps {creep:.2e} cells/s at {tilt}°");
            }
        }
    }
}
