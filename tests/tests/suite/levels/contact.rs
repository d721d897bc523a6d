//! Tools and rigid bodies at and across rims.

use super::{counted, levels, on_levels};
use barchan::{Precision, Simulation, Vec3};
use barchan_tests::scenes::{Row, minus, norm, plane_shear_friction, plus, rows, run_to, simulation, totals, within};
use barchan_tests::sketch::{Head, bed, block, body, driven, half, material, scoop, tool};

const FRICTION: &str = "{ coulomb = { friction = 0.5 } }";

/// A soft ball cut by the rim of a box's region, about to collide with the box off centre.
fn collision(contact: &str, motion: &str) -> String {
    let ball = "sphere = { center = [-0.42, 0.06, 0.02], radius = 0.25 }";
    Head::space(0.05).time("step = 2e-4").with(&[
        levels(3, 8, &["box"]),
        material("neo_hookean", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        body("neo_hookean", ball, "velocity = [1.5, 0.2, 0.0]\nangular_velocity = [0.0, 0.0, 2.0]"),
        tool("box", [0.0; 3], &half([0.15, 0.2, 0.2]), contact, motion),
    ])
}

/// A9 i. Symptom: a contact that is seen on two levels is booked twice, or an impulse that falls on a rim is lost. Physics: soft and
/// rigid together keep momentum exactly. Angular momentum is kept but for what rims and changes of level take.
#[test]
fn isolated_collision_conserves_momentum_across_levels() {
    for contact in ["{ coulomb = { friction = 0.4 } }", "\"stick\"", "\"slip\""] {
        for (precision, tolerance) in [(Precision::F64, 1e-13), (Precision::F32, 2e-6)] {
            let mut pair = simulation(&collision(contact, "{ free = { mass = 8 } }"), precision);
            let start = on_levels(&pair);
            let (p0, l0) = totals(&pair.ledger());
            (0..1000).for_each(|_| drop(pair.step().unwrap()));
            let after = pair.ledger();
            let (p1, l1) = totals(&after);
            let exchanged = norm(after.body_momentum) / norm(p0);
            println!(
                "A9 i {contact} {precision}: {start:?} -> {:?}, body took {exchanged:.2} of P, {:?}",
                on_levels(&pair),
                after.counts
            );
            assert!(exchanged > 0.05 && start[0] > 100 && start[1] > 100, "they never met, or not across a rim");
            within(&format!("A9 i {contact} {precision}: momentum"), norm(minus(p1, p0)) / norm(p0), tolerance);
            within(
                &format!("A9 i {contact} {precision}: angular momentum"),
                norm(minus(l1, l0)) / (norm(p0) * 0.4),
                5e-3,
            );
        }
    }
}

/// A9 v. Symptom: a tool's wrench forgets what happens on one of the levels. Physics: it is the momentum that left the ground, to rounding.
#[test]
fn force_on_a_driven_tool_is_the_momentum_removed_on_all_levels() {
    for (precision, tolerance) in [(Precision::F64, 1e-12), (Precision::F32, 2e-6)] {
        let scene = collision("{ coulomb = { friction = 0.3 } }", "{ velocity = { linear = [-0.5, 0.1, 0.0] } }");
        let mut push = simulation(&scene, precision);
        let before = push.ledger();
        let mut impulse = [0.0; 3];
        for _ in 0..1000 {
            let dt = push.step().unwrap().dt;
            let force = push.wrenches()[0].force;
            (0..3).for_each(|d| impulse[d] += force[d] * dt);
        }
        let after = push.ledger();
        let off = norm(plus(minus(after.momentum, before.momentum), impulse)) / norm(impulse);
        assert!(norm(impulse) > 1.0 && counted(&after, "changed level") > 10, "{impulse:?}, {:?}", after.counts);
        within(&format!("A9 v {precision}: force against momentum"), off, tolerance);
    }
}

/// A9 ii, B44. Symptom: the ring of the region about a box drives a current that carries or shakes it. Physics: a box at rest on sand is borne by
/// its weight, does not sink further, drift or heat.
#[test]
fn resting_box_feels_its_weight_within_its_region() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let head = Head { gravity_ramp: 0.1, ..Head::cells(0.025, [32, 32, 24], walls) }.time("safety = 0.5");
    let scene = head.with(&[
        levels(2, 8, &["box"]),
        material("sand", 1500.0, "young_modulus = 5e5, poisson_ratio = 0.2, friction_angle_deg = 30.0"),
        block("sand", [0.0; 3], [0.8, 0.8, 0.2], ""),
        tool("box", [0.4, 0.4, 0.252], &half([0.05; 3]), FRICTION, "{ free = { mass = 0.8 } }"),
    ]);
    let mut rest = simulation(&scene, Precision::F32);
    run_to(&mut rest, 0.6);
    let from = rest.bodies()[0].position;
    let (mut impulse, begin) = (0.0, rest.time());
    while rest.time() < 1.2 {
        let dt = rest.step().unwrap().dt;
        impulse += rest.wrenches()[0].force[2] * dt;
    }
    let span = rest.time() - begin;
    let to = rest.bodies()[0].position;
    let fastest = rows(&rest).iter().fold(0f64, |f, r| f.max(norm(r.v)));
    println!("A9 ii: {:?}, {:?}, fastest particle {fastest:.2e} m/s", on_levels(&rest), rest.ledger().counts);
    within("A9 ii: mean force over weight, off by", (impulse / span / (0.8 * 9.81) - 1.0).abs(), 0.01);
    within("B44: sinkage a second [h]", (from[2] - to[2]).abs() / 0.025 / span, 0.02);
    within("B44: sideways [h a second]", (to[0] - from[0]).hypot(to[1] - from[1]) / 0.025 / span, 0.02);
    within("B44: fastest particle [m/s]", fastest, 0.02);
}

/// A10 across a rim. Symptom: a rim that gives way lets a slope creep, one that sticks holds it. Physics: sand on a no-slip base flows when tan theta exceeds sin phi_ps of its cone, and
/// stops below.
#[test]
fn infinite_slope_flows_above_the_angle_of_its_cone_only_across_a_rim() {
    let phi = 20f64.to_radians();
    let mobilised = plane_shear_friction(phi);
    let critical = mobilised.atan().to_degrees();
    for (offset, flows) in [(-1.5, false), (1.5, true)] {
        let theta = f64::to_radians(critical + offset);
        let gravity = [9.81 * theta.sin(), 0.0, -9.81 * theta.cos()];
        let (head, mut sand) =
            bed(0.02, [8, 8], 16, 32, "young_modulus = 1e6, poisson_ratio = 0.2, friction_angle_deg = 20.0");
        // Above z = 0.16, half of the depth, it is fine.
        sand.push(super::around_marker(2, 16, [0.08, 0.08, 0.16 + 0.32]));
        let mut slope = simulation(&Head { gravity, gravity_ramp: 0.2, ..head }.with(&sand), Precision::F64);
        let speed = |s: &Simulation| {
            let all = rows(s);
            all.iter().map(|r| r.m * r.v[0]).sum::<f64>() / all.iter().map(|r| r.m).sum::<f64>()
        };
        run_to(&mut slope, 0.5);
        let early = speed(&slope);
        run_to(&mut slope, 0.9);
        let late = speed(&slope);
        let pull = 9.81 * (theta.sin() - mobilised * theta.cos());
        println!(
            "A10 slope {:.2}° (critical {critical:.2}°): {:?}, {early:.2e} then {late:.2e} m/s, free pull {pull:.3} m/s²",
            theta.to_degrees(),
            on_levels(&slope)
        );
        assert!(on_levels(&slope).iter().all(|&n| n > 0));
        if flows {
            within("A10: free pull over the mean acceleration", 0.4 * pull / (late - early), 1.0 / 0.3);
        } else {
            within("A10: creep below the angle [m/s]", late.abs(), 2e-3);
        }
    }
}

/// B42. Symptom: particles that merge across a thin blade jump to its other side. Physics: a blade shoves all sand ahead of it,
/// with its region moving along and sand merging behind.
#[test]
fn thin_blade_does_not_leak_with_levels() {
    let h = 0.02;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"\nz_min = \"slip\"";
    let (start, way, speed) = (0.2, 0.2, 0.5);
    let toml = Head::cells(h, [64, 8, 24], walls).time("safety = 0.5").with(&[
        levels(2, 8, &["blade"]),
        material("sand", 1500.0, "young_modulus = 2e5, friction_angle_deg = 30"),
        block("sand", [0.0; 3], [1.28, 0.16, 0.12], ""),
        tool("blade", [start, 0.08, 0.12], &half([0.125 * h, 0.2, 0.2]), FRICTION, &driven([speed, 0.0, 0.0])),
    ]);
    let mut s = simulation(&toml, Precision::F32);
    let from = rows(&s);
    run_to(&mut s, way / speed);
    let blade = s.bodies()[0].position[0];
    // Mass ahead of the blade, whoever carries it.
    let ahead = |all: &[Row], x: f64| all.iter().filter(|r| r.x[0] > x).map(|r| r.m).sum::<f64>();
    let swept = ahead(&from, start + h) - ahead(&from, start + way);
    let leaked = (ahead(&from, start + h) - ahead(&rows(&s), blade)).max(0.0);
    println!("B42: {:?}, {:?}", on_levels(&s), s.ledger().counts);
    assert!(counted(&s.ledger(), "particles split") > 50 && counted(&s.ledger(), "particles merged") > 150);
    within("B42: share of the mass swept that passes the blade", leaked / swept, 0.01);
}

/// B32. Symptom: a coarse particle that is split next to a tool leaves a child inside, which is thrown out or stuck. Physics: children keep clear of tools, and floors; what the parent had they have together.
#[test]
fn children_keep_clear_of_tools() {
    let h = 0.05;
    let (head, mut parts) = bed(h, [64, 16], 8, 24, "young_modulus = 1e5, friction_angle_deg = 30");
    parts.extend([
        levels(3, 8, &["eye"]),
        // A post without a region of its own; a tilted one, so that no face lies along the lattice.
        tool("post", [1.6, 0.4, 0.3], &half([0.11, 0.13, 0.5]), FRICTION, "\"fixed\"")
            + "rotation = [0.97, 0.05, 0.12, 0.2]\n",
        tool("eye", [0.4, 0.4, 0.8], "sphere = { radius = 0.05 }", "\"slip\"", &driven([6.0, 0.0, 0.0])),
    ]);
    let mut s = simulation(&head.with(&parts), Precision::F64);
    let deepest = |s: &Simulation| {
        let places: Vec<Vec3> = rows(s).iter().map(|r| r.x).collect();
        s.couplings()[0].distance(&places).into_iter().fold(f64::INFINITY, f64::min)
    };
    let (start, before) = (deepest(&s), s.ledger());
    let mut worst = f64::INFINITY;
    while s.time() < 0.2 {
        s.step().unwrap();
        worst = worst.min(deepest(&s));
    }
    let after = s.ledger();
    println!("B32: {:?}, {:?}, nearest {start:.4} then {worst:.4} m", on_levels(&s), after.counts);
    assert!(counted(&after, "particles split") > 100);
    within("B32: depth of a particle in a tool [h]", -worst / h, 0.05);
    within("B32: mass", (after.mass / before.mass - 1.0).abs(), 1e-13);
    assert!(rows(&s).iter().all(|r| r.x[2] >= 0.0));
}

/// B43. Symptom: inside a concave scoop, or where it crosses its region's rim, forces spike. Physics: a scoop that moves steadily
/// through level sand feels a steady force.
#[test]
fn scoop_feels_no_spikes_with_levels() {
    let h = 0.02;
    let (mut head, mut parts) = bed(h, [48, 16], 8, 16, "young_modulus = 2e5, friction_angle_deg = 35");
    head.walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let shape = scoop(h);
    parts.push(levels(2, 8, &["scoop"]));
    parts.push(tool("scoop", [0.14, 0.16, 0.11], &shape, "{ coulomb = { friction = 0.3 } }", &driven([0.3, 0.0, 0.0])));
    let mut s = simulation(&head.with(&parts), Precision::F32);
    run_to(&mut s, 0.25);
    let mut force = Vec::new();
    while s.time() < 0.8 {
        s.step().unwrap();
        force.push(norm(s.wrenches()[0].force));
    }
    let greatest = force.iter().copied().fold(0.0, f64::max);
    force.sort_by(f64::total_cmp);
    let median = force[force.len() / 2];
    println!(
        "B43: median force {median:.1} N over {} steps, {:?}, {:?}",
        force.len(),
        on_levels(&s),
        s.ledger().counts
    );
    assert!(counted(&s.ledger(), "changed level") > 1000);
    within("B43: greatest force over the median", greatest / median, 3.0);
}

/// B45. Symptom: bodies much lighter or heavier than a node are unstable where nodes of two sizes meet, or a stack topples by
/// itself. Physics: contact is solved with the body's own inertia, whatever the levels.
#[test]
fn stacks_and_extreme_masses_are_stable_with_levels() {
    for densities in [&[800.0; 3][..], &[20_000.0, 1.0]] {
        let (h, side) = (0.02, 0.08f64);
        let (mut head, mut parts) = bed(h, [24, 24], 6, 22, "young_modulus = 5e5, friction_angle_deg = 40");
        head.time = "step = 2.5e-4".to_owned();
        parts.push(levels(2, 8, &["box0"]));
        for (i, density) in densities.iter().enumerate() {
            let z = 6.0 * h + side * (0.5 + i as f64);
            let motion = format!("{{ free = {{ mass = {} }} }}", density * side.powi(3));
            parts.push(tool(&format!("box{i}"), [0.24, 0.24, z], &half([0.5 * side; 3]), FRICTION, &motion));
        }
        let mut s = simulation(&head.with(&parts), Precision::F32);
        let (mut fastest, mut push, mut time) = (0f64, 0.0, 0.0);
        while s.time() < 0.8 {
            let dt = s.step().unwrap().dt;
            fastest = s.bodies().iter().fold(fastest, |f, body| f.max(norm(body.velocity)));
            if s.time() > 0.5 {
                push += s.wrenches().iter().map(|w| w.force[2]).sum::<f64>() * dt;
                time += dt;
            }
        }
        let weight: f64 = s.bodies().iter().map(|b| b.mass * 9.81).sum();
        println!("B45 {densities:?}: {:?}, {:?}", on_levels(&s), s.ledger().counts);
        within(&format!("B45 {densities:?}: mean push over weight, off by"), (push / time / weight - 1.0).abs(), 0.02);
        within(&format!("B45 {densities:?}: greatest speed of a body [m/s]"), fastest, 0.5);
        for (i, body) in s.bodies().iter().enumerate() {
            let off = (body.position[0] - 0.24).hypot(body.position[1] - 0.24);
            within(&format!("B45 {densities:?}: box {i} off the middle [m]"), off, 0.01);
        }
    }
}

/// Symptom: a ball pressed into elastic ground feels 7.5 % more where its box's half side is 8 cells than where it is 12, and nothing says so. Physics: ground
/// that is coarse from 4 cells below the ball on is stiffer. The plan says how far away the rim is, and which `levels.half` keeps it away.
#[test]
fn a_rim_close_under_a_tool_is_warned_of() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let warnings = |half: u32, depth: f64, height: f64| -> Vec<String> {
        let scene = Head::cells(0.01, [48, 48, 40], walls).with(&[
            levels(2, half, &["ball"]),
            material("hencky", 1500.0, "young_modulus = 1e5"),
            block("hencky", [0.0; 3], [0.48, 0.48, depth], ""),
            tool(
                "ball",
                [0.24, 0.24, depth + height],
                "sphere = { radius = 0.04 }",
                "\"slip\"",
                &driven([0.0, 0.0, -0.1]),
            ),
        ]);
        let all = simulation(&scene, Precision::F32).plan().warnings.clone();
        all.into_iter().filter(|warning| warning.contains("rim")).collect()
    };
    for height in [0.04, 0.02, 0.1] {
        let [warning] = &warnings(8, 0.24, height)[..] else { panic!("no warning {height} m above") };
        println!("{warning}");
        for part in ["fine cells between the lowest point of 'ball'", "fewer than 6", "set levels.half = 14"] {
            assert!(warning.contains(part), "'{part}' is not in: {warning}");
        }
        assert_eq!(warnings(14, 0.24, height), [""; 0]);
    }
    // The box reaches down to the floor.
    assert_eq!(warnings(8, 0.04, 0.04), [""; 0]);
}
