//! Friction and sticking where a contact crosses a rim, held to Coulomb's law and to momentum.

use super::{around_marker, counted, on_levels};
use barchan::{Command, Precision, Simulation};
use barchan_tests::scenes::{minus, norm, rows, run_to, simulation, totals, within};
use barchan_tests::sketch::{Head, block, body, box_mesh, half, incline, material, tool};

/// A9 iii. Symptom: where a rim cuts what sticks to a body, one level's grip is lost or counted twice. Physics: what sticks together ends with
/// the common velocity of both masses.
#[test]
fn sticking_capture_across_a_rim_ends_with_the_common_velocity() {
    for (precision, tolerance) in [(Precision::F64, 0.005), (Precision::F32, 0.005)] {
        // Head on and of clay, so that the pair neither turns nor tears.
        let scene = Head::space(0.05).time("safety = 0.5").with(&[
            // Fine where y > 0.05, up to x = 0.8: the rim crosses the face that sticks, and the pair slides out of the region.
            around_marker(2, 16, [0.0, 0.85, 0.0]),
            material("von_mises", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3, yield_stress = 2e3"),
            body("von_mises", "sphere = { center = [-0.4, 0.0, 0.0], radius = 0.24 }", "velocity = [1.5, 0.0, 0.0]"),
            tool("box", [0.0; 3], &half([0.15, 0.2, 0.2]), "\"stick\"", "{ free = { mass = 20 } }"),
        ]);
        let mut capture = simulation(&scene, precision);
        let box_at = |s: &Simulation| {
            s.bodies().iter().find(|body| body.name == "box").map_or(f64::NAN, |body| body.position[0])
        };
        let (start, levels) = (capture.ledger(), on_levels(&capture));
        let expected = start.momentum[0] / (start.mass + 20.0);
        run_to(&mut capture, 0.4);
        let from = box_at(&capture);
        run_to(&mut capture, 1.4);
        let mean = box_at(&capture) - from;
        let (p0, p1) = (totals(&start).0, totals(&capture.ledger()).0);
        println!("A9 iii {precision}: {levels:?} -> {:?}, {:?}", on_levels(&capture), capture.ledger().counts);
        assert!(levels.iter().all(|&n| n > 50), "the rim cuts the ball: {levels:?}");
        within(
            &format!("A9 iii {precision}: velocity over the common one, off by"),
            (mean / expected - 1.0).abs(),
            tolerance,
        );
        let exact = if precision == Precision::F64 { 1e-13 } else { 1e-5 };
        within(&format!("A9 iii {precision}: momentum"), norm(minus(p1, p0)) / norm(p0), exact);
    }
}

/// Coulomb's law. Symptom: contact that is decided on two levels rubs twice, or not at all, along the rim. Physics: a plate that is pressed on
/// a block and slides feels friction of μ times the pressure, whatever level decides.
#[test]
fn friction_on_a_plate_that_slides_across_a_rim_is_mu_times_the_pressure() {
    let (h, friction) = (0.02, 0.3);
    for (precision, tolerance) in [(Precision::F64, 0.015), (Precision::F32, 0.02)] {
        let walls = "z_min = \"stick\"";
        let head =
            Head { gravity: [0.0; 3], min: [-0.64, -0.32, 0.0], max: [0.64, 0.32, 0.64], walls, ..Head::space(h) };
        let scene = head.time("safety = 0.5").with(&[
            material("hencky", 1000.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
            block("hencky", [-0.16, -0.08, 0.0], [0.16, 0.08, 0.16], ""),
            tool(
                "plate",
                [0.0, 0.0, 0.245],
                &half([0.6, 0.3, 0.08]),
                &format!("{{ coulomb = {{ friction = {friction} }} }}"),
                "{ velocity = { linear = [0.0, 0.0, -0.1] } }",
            ),
            // Fine where x > 0 and z > 0.08: the rim crosses the face that slides.
            around_marker(2, 8, [0.16, 0.0, 0.24]),
        ]);
        let mut s = simulation(&scene, precision);
        let levels = on_levels(&s);
        run_to(&mut s, 0.12);
        s.act("plate", &Command::Twist { linear: [0.3, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
        run_to(&mut s, 0.2);
        let mut impulse = [0.0; 3];
        while s.time() < 0.32 {
            let dt = s.step().unwrap().dt;
            let force = s.wrenches()[0].force;
            (0..3).for_each(|d| impulse[d] += force[d] * dt);
        }
        println!("friction {precision}: {levels:?}, impulse {impulse:?} N s");
        assert!(levels.iter().all(|&n| n > 500) && impulse[2] > 5.0, "{levels:?}, {impulse:?}");
        let off = (impulse[0].hypot(impulse[1]) / impulse[2] / friction - 1.0).abs();
        within(&format!("friction over mu N across a rim, {precision}, off by"), off, tolerance);
        within(&format!("friction sideways over friction, {precision}"), (impulse[1] / impulse[0]).abs(), 1e-3);
    }
}

/// A10 across a rim. Symptom: a block that slides out of a fine region is braked or carried at the rim, or creeps where it should stick. Physics:
/// it accelerates by g (sin theta - mu cos theta), or stays, whatever the angle between plane and grid.
#[test]
fn block_on_an_incline_obeys_coulomb_across_a_rim() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = box_mesh(folder.path(), [0.16, 0.08, 0.04]);
    let slope = f64::to_radians(30.0);
    let cases =
        [(17.0, 0.3, Precision::F64, 0.015), (17.0, 0.7, Precision::F64, 1e-3), (0.0, 0.3, Precision::F32, 0.02)];
    for (tilt, friction, precision, tolerance) in cases {
        // Fine below x = 0.06: the rim is in the block, which slides out of the fine region.
        let rim = around_marker(2, 16, [0.06 - 0.32, 0.0, 0.2]);
        let mut block = simulation(&incline(tilt, friction, &mesh, &rim), precision);
        let (s, c) = f64::to_radians(tilt).sin_cos();
        let along = |s0: &Simulation| {
            rows(s0).iter().fold([0.0; 3], |sum, r| {
                [sum[0] + r.m * (r.x[0] * c + r.x[2] * s), sum[1] + r.m * (r.v[0] * c + r.v[2] * s), sum[2] + r.m]
            })
        };
        let start = on_levels(&block);
        run_to(&mut block, 0.3);
        let a = along(&block);
        run_to(&mut block, 0.5);
        let b = along(&block);
        println!(
            "A10 {tilt}°, mu {friction}, {precision}: {start:?} -> {:?}, {:?}",
            on_levels(&block),
            block.ledger().counts
        );
        assert!(start.iter().all(|&n| n > 100), "{start:?}");
        if friction < slope.tan() {
            assert!(counted(&block.ledger(), "changed level") > 100);
            let expected = 9.81 * (slope.sin() - friction * slope.cos());
            let off = ((b[1] - a[1]) / b[2] / 0.2 / expected - 1.0).abs();
            within(&format!("A10 {tilt}°, mu {friction}, {precision}: acceleration off by"), off, tolerance);
        } else {
            let creep = ((b[0] - a[0]) / b[2] / 0.2 / 0.02).abs();
            within(&format!("A10 {tilt}°, mu {friction}, {precision}: creep [h/s]"), creep, tolerance);
        }
    }
}
