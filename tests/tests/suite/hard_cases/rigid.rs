//! Rigid tools and bodies in the ground.

use super::{all_finite, later, norm, plan, refusal, says, steps, within};
use barchan::{Command, Precision, Simulation};
use barchan_tests::long_cases;
use barchan_tests::scenes::{Row, minus, rows, run_to, scene, simulation};
use barchan_tests::sketch::{Head, bed, block, driven, half, material, scoop, tool};
use std::path::Path;

const FRICTION: &str = "{ coulomb = { friction = 0.5 } }";

/// B42. Symptom: particles pass through a blade thinner than a cell, or stick to both of its sides. Physics: a blade that is
/// dragged through sand shoves all of it ahead. Such a blade is warned of, and may let 1 % of the sand that it sweeps through.
#[test]
fn thin_blade_does_not_leak() {
    let h = 0.02;
    for (thickness, angle) in [(0.25, 0.0), (0.25, 0.5), (1.0, 0.0), (2.5, 0.0)] {
        let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"\nz_min = \"slip\"";
        // The floor lets go, for sand that sticks to it stays behind any blade.
        let (start, way, speed) = (0.2, 0.2, 0.5);
        // Leaning back about y, from the floor up.
        let rotation = format!("rotation = [{}, 0, {}, 0]", f64::cos(0.5 * angle), f64::sin(0.5 * angle));
        let toml = Head::cells(h, [36, 4, 24], walls).time("safety = 0.5").with(&[
            material("sand", 1500.0, "young_modulus = 2e5, friction_angle_deg = 30"),
            block("sand", [0.0; 3], [0.72, 0.08, 0.12], ""),
            tool(
                "blade",
                [start, 0.04, 0.0],
                &half([0.5 * thickness * h, 0.5, 0.45]),
                FRICTION,
                &driven([speed, 0.0, 0.0]),
            ) + &rotation
                + "\n",
        ]);
        let warned = plan(&toml).warnings.join("\n").contains("tool 'blade' is") && thickness < 2.0;
        assert_eq!(warned, thickness < 2.0, "{:?}", plan(&toml).warnings);
        let mut s = simulation(&toml, Precision::F32);
        // Distance ahead of the blade's middle plane, which leans by the angle.
        let ahead = |x: &[f64; 3], blade: f64| (x[0] - blade) * f64::cos(angle) - x[2] * f64::sin(angle);
        let from = rows(&s);
        run_to(&mut s, way / speed);
        let blade = s.bodies()[0].position[0];
        let all = rows(&s);
        // What starts within the blade, which counts as two cells thick, is on neither side of it.
        let (mut swept, mut leaked, mut within_it) = (0, 0, 0);
        for (a, b) in from.iter().zip(&all) {
            let before = ahead(&a.x, start);
            if before > 0.0 && before < way * f64::cos(angle) {
                let passed = u32::from(ahead(&b.x, blade) < 0.0);
                if before > h {
                    (swept, leaked) = (swept + 1, leaked + passed);
                } else {
                    within_it += passed;
                }
            }
        }
        println!(
            "B42: of the sand within a cell of the middle of the blade at the start, {within_it} particles end behind it"
        );
        within(
            &format!(
                "B42: blade of {thickness} h leaning by {angle} rad, share of {swept} particles swept that pass it"
            ),
            f64::from(leaked) / f64::from(swept),
            0.01,
        );
        assert!(all_finite(&all));
    }
}

/// B43. Symptom: at an edge, or inside a concave scoop where two faces are equally near, the normal jumps or vanishes and the
/// force spikes. Physics: a scoop that moves steadily through level sand feels a steady force.
#[test]
fn scoop_feels_no_spikes() {
    let h = 0.02;
    let (mut head, mut parts) = bed(h, [32, 12], 7, 14, "young_modulus = 2e5, friction_angle_deg = 35");
    head.walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let shape = scoop(h);
    parts.push(tool("scoop", [0.12, 0.12, 0.09], &shape, "{ coulomb = { friction = 0.3 } }", &driven([0.3, 0.0, 0.0])));
    let mut s = simulation(&head.with(&parts), Precision::F32);
    run_to(&mut s, 0.25);
    let mut force = Vec::new();
    while s.time() < 0.8 {
        steps(&mut s, 1);
        force.push(norm(s.wrenches()[0].force));
    }
    assert!(all_finite(&rows(&s)));
    let greatest = force.iter().copied().fold(0.0, f64::max);
    force.sort_by(f64::total_cmp);
    let median = force[force.len() / 2];
    println!("B43: median force {median:.1} N over {} steps", force.len());
    within("B43: greatest force over the median", greatest / median, 3.0);
}

/// B44. See [`long_cases::box_at_rest`].
#[test]
fn box_on_sand_stays_put() {
    long_cases::box_at_rest(3.0).check("B44");
}

/// Boxes of 0.08 m on a bed, one on the other. Returns the scene's simulation.
fn stack(densities: &[f64]) -> Simulation {
    let (h, side) = (0.02, 0.08f64);
    let (mut head, mut parts) = bed(h, [12, 12], 6, 20, "young_modulus = 5e5, friction_angle_deg = 40");
    head.time = "step = 2.5e-4".to_owned();
    for (i, density) in densities.iter().enumerate() {
        let z = 6.0 * h + side * (0.5 + i as f64);
        let motion = format!("{{ free = {{ mass = {} }} }}", density * side.powi(3));
        parts.push(tool(&format!("box{i}"), [0.12, 0.12, z], &half([0.5 * side; 3]), FRICTION, &motion));
    }
    simulation(&head.with(&parts), Precision::F32)
}

/// B45. Symptom: a body much lighter or much heavier than a node's mass is unstable at a step that is good for others, or a
/// stack topples by itself. Physics: contact is solved with the body's own inertia, so mass ratios have no say in the step. A
/// node of full sand weighs 12 g here; the boxes weigh 0.5 g, 0.4 kg and 10 kg.
#[test]
fn stacks_and_extreme_masses_are_stable_at_the_same_step() {
    for densities in [&[800.0; 3][..], &[1.0], &[20_000.0], &[20_000.0, 1.0]] {
        let mut s = stack(densities);
        let start = s.ledger();
        let (mut fastest, mut push, mut time, mut top) = (0f64, 0.0, 0.0, f64::MIN);
        while s.time() < 1.0 {
            let dt = s.step().unwrap().dt;
            assert_eq!(dt, 2.5e-4, "the step stays");
            for body in s.bodies() {
                fastest = fastest.max(norm(body.velocity));
            }
            if s.time() > 0.6 {
                push += s.wrenches().iter().map(|w| w.force[2]).sum::<f64>() * dt;
                time += dt;
            }
            top = top.max(s.ledger().energy());
        }
        let all = rows(&s);
        assert!(all_finite(&all));
        let thrown = all.iter().fold(0f64, |f, r| f.max(norm(r.v)));
        let weight: f64 = s.bodies().iter().map(|b| b.mass * 9.81).sum();
        println!("B45 {densities:?}: fastest body {fastest:.3} m/s, fastest particle at the end {thrown:.3} m/s");
        within(&format!("B45 {densities:?}: mean push over weight, off by"), (push / time / weight - 1.0).abs(), 0.02);
        within(&format!("B45 {densities:?}: greatest speed of a body [m/s]"), fastest, 0.5);
        let scale = start.mass * 9.81 * 0.02;
        within(
            &format!("B45 {densities:?}: energy gained, over that of lifting all sand by a cell"),
            (top - start.energy()) / scale,
            1e-2,
        );
        // Nothing topples: each box stands over the one below, upright.
        for (i, body) in s.bodies().iter().enumerate() {
            let off = (body.position[0] - 0.12).hypot(body.position[1] - 0.12);
            within(&format!("B45 {densities:?}: box {i} off the middle [m]"), off, 0.01);
        }
    }
}

/// Symptom: what a heavy block presses on sank into the ground without end, twenty times its mass by 5 cm/s, and the ground pushed back with its own weight alone: bodies
/// pressed on each other behind the ground's solution. Physics: all that touch are found together, so that the ground bears them and they come to rest.
#[test]
fn what_a_heavy_block_presses_on_is_borne_by_the_ground() {
    let mut s = stack(&[300.0, 6000.0]);
    let weight: f64 = s.bodies().iter().map(|b| b.mass * 9.81).sum();
    let (mut at_first, mut push, mut time) = (None, 0.0, 0.0);
    while s.time() < 1.0 {
        let dt = s.step().unwrap().dt;
        if s.time() > 0.6 {
            at_first.get_or_insert(s.bodies()[0].position[2]);
            push += s.wrenches()[0].force[2] * dt;
            time += dt;
        }
    }
    let sunk = at_first.unwrap() - s.bodies()[0].position[2];
    within("sunk in the last 0.4 s [m]", sunk.abs(), 1e-3);
    within("mean push on the lower block over the weight of both, off by", (push / time / weight - 1.0).abs(), 0.02);
}

/// Symptom: a free box on a fixed plane less steep than friction holds crept down it by 2 mm/s at steps of 5 ms, unless there was a robot. Physics: it stays, but for what
/// contact points of finite mass let it creep, g dt/1000.
#[test]
fn a_box_stays_on_a_rigid_slope() {
    let (slope, dt) = (20_f64.to_radians(), 5e-3);
    let turned = |at: f64| {
        format!(
            "position = [{}, 0, {}]\nrotation = [{}, 0, {}, 0]\ncontact = {{ coulomb = {{ friction = 0.5 }} }}",
            at * slope.sin(),
            at * slope.cos(),
            (0.5 * slope).cos(),
            (0.5 * slope).sin()
        )
    };
    let one = |name: &str, half: [f64; 3], at: f64, motion: &str| {
        format!(
            "[[tool]]\nname = \"{name}\"\nshape = {{ box = {{ half = {half:?} }} }}\nmotion = {motion}\n{}\n",
            turned(at)
        )
    };
    let head = Head { gravity: [0.0, 0.0, -9.81], ..Head::space(0.1) }.time(format!("step = {dt}"));
    let parts = [
        one("plane", [1.0, 1.0, 0.05], -0.05, "\"fixed\""),
        one("box", [0.1, 0.1, 0.05], 0.0505, "{ free = { mass = 1 } }"),
    ];
    let mut s = simulation(&head.with(&parts), Precision::F64);
    let at = |s: &Simulation| s.bodies().into_iter().find(|b| b.name == "box").unwrap().position;
    let mut settled = None;
    while s.time() < 2.0 {
        s.step().unwrap();
        if s.time() > 0.5 {
            settled.get_or_insert((s.time(), at(&s)));
        }
    }
    let (then, there) = settled.unwrap();
    let creep = norm(minus(at(&s), there)) / (s.time() - then);
    within("speed at which it creeps [m/s]", creep, 9.81 * dt / 1000.0);
}

/// B47. Symptom: particles are pushed out of a body by an impulse that the body never gets. Physics: in space, soft and rigid
/// together keep momentum and angular momentum, through any collision and overlap.
#[test]
fn collisions_in_space_keep_all_momentum() {
    for (precision, tolerance) in [(Precision::F32, 1e-6), (Precision::F64, 1e-13)] {
        let mut s = simulation(
            &Head::space(0.05).time("step = 1e-3").with(&[
                material("neo_hookean", 1000.0, "young_modulus = 1e5"),
                material("sand", 1500.0, "young_modulus = 1e5"),
                block("neo_hookean", [0.0; 3], [0.3; 3], "velocity = [0.5, 0, 0]\nangular_velocity = [1, 0, 2]"),
                block("sand", [0.3, 0.0, 0.0], [0.5, 0.3, 0.3], ""),
                tool(
                    "ball",
                    [0.75, 0.2, 0.1],
                    "sphere = { radius = 0.15 }",
                    FRICTION,
                    "{ free = { mass = 8, linear = [-2, 0, 0.3], angular = [0, 3, 0] } }",
                ),
                // Half inside the jelly from the start.
                tool(
                    "box",
                    [0.15, 0.15, 0.32],
                    &half([0.1; 3]),
                    FRICTION,
                    "{ free = { mass = 3, linear = [0, 0, -1] } }",
                ),
            ]),
            precision,
        );
        let totals = |s: &Simulation| {
            let l = s.ledger();
            let sum = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|d| a[d] + b[d]) };
            (sum(l.momentum, l.body_momentum), sum(l.angular_momentum, l.body_angular_momentum))
        };
        let (p, l) = totals(&s);
        let start = s.ledger();
        steps(&mut s, 1000);
        let (q, m) = totals(&s);
        let off = |a: [f64; 3], b: [f64; 3]| norm(std::array::from_fn::<_, 3, _>(|d| a[d] - b[d]));
        // Scales: the momentum of the parts before they met.
        let end = s.ledger();
        within(&format!("B47 {precision}: momentum, over 20 kg m/s"), off(p, q) / 20.0, tolerance);
        within(&format!("B47 {precision}: angular momentum, over 10 kg m²/s"), off(l, m) / 10.0, 4.0 * tolerance);
        let exchanged = off(start.body_momentum, end.body_momentum);
        assert!(exchanged > 2.0, "they have met: {exchanged} kg m/s");
    }
}

/// Mass per volume in cubes of `side` cells of width `h`, at every cell, as a multiple of `density`.
fn densities(all: &[Row], h: f64, side: i64, density: f64) -> Vec<f64> {
    let mut cells = std::collections::HashMap::<[i64; 3], f64>::new();
    for r in all {
        let cell = r.x.map(|x| (x / h).floor() as i64);
        for corner in 0..side.pow(3) {
            let at = [cell[0] - corner % side, cell[1] - corner / side % side, cell[2] - corner / (side * side)];
            *cells.entry(at).or_default() += r.m;
        }
    }
    cells.into_values().map(|m| m / ((h * side as f64).powi(3) * density)).collect()
}

/// B48. Symptom: a bucket that pushes particles out of itself leaves them overlapping: sand stays denser after each scoop.
/// Physics: contact changes velocities only, and stress sets volume: after scooping no sand is denser than 1.05 times at first.
#[test]
fn scooping_does_not_compact() {
    let h = 0.02;
    let (mut head, mut parts) = bed(h, [28, 12], 8, 14, "young_modulus = 5e5, friction_angle_deg = 35");
    head.walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let wall =
        |half: [f64; 3], at: [f64; 3]| format!("{{ shape = {{ box = {{ half = {half:?} }} }}, position = {at:?} }}");
    let t = 1.25 * h;
    let shape =
        format!("union = [{}, {}]", wall([0.08, 0.08, t], [0.0; 3]), wall([t, 0.08, 0.08], [-0.08 + t, 0.0, 0.08]));
    parts.push(tool("scoop", [0.12, 0.12, 0.1], &shape, "{ coulomb = { friction = 0.3 } }", &driven([0.0; 3])));
    let mut s = simulation(&head.with(&parts), Precision::F32);
    let quantile = |s: &Simulation, side: i64| {
        let mut all = densities(&rows(s), h, side, 1500.0);
        all.sort_by(f64::total_cmp);
        all[all.len() * 99 / 100]
    };
    run_to(&mut s, 0.2);
    let before = [2, 3, 4].map(|side| quantile(&s, side));
    for (velocity, time) in [([0.4, 0.0, 0.0], 0.5), ([0.2, 0.0, 0.3], 0.6), ([0.0, 0.0, 0.3], 0.8), ([0.0; 3], 1.2)] {
        s.act("scoop", &Command::Twist { linear: velocity, angular: [0.0; 3] }).unwrap();
        run_to(&mut s, time);
    }
    let after = [2, 3, 4].map(|side| quantile(&s, side));
    // Particles count as points: cubes of 2 cells hold 64, whose number alone scatters by some per cent.
    println!(
        "B48: densest hundredth of cubes of 2, 3, 4 cells, after over before: {:?}",
        [0, 1, 2].map(|i| after[i] / before[i])
    );
    within(
        "B48: density of the densest hundredth of cubes of 4 cells after scooping over before",
        after[2] / before[2],
        1.05,
    );
}

/// B49. Symptom: a body that starts inside sand, or overlaps it by cells, is shot out or shoots it out. Physics: an overlap
/// stores no energy. Contact never moves anything, so nothing may be faster than 1 m/s.
#[test]
fn overlap_at_the_start_ejects_nothing() {
    let h = 0.02;
    for (what, z, around) in
        [("buried whole", 0.08, false), ("five cells deep", 0.16, false), ("buried, seeded around", 0.08, true)]
    {
        let (head, _) = bed(h, [16, 16], 8, 14, "");
        let mass = 1500.0 * 0.12f64.powi(3);
        let mut s = simulation(
            &head.with(&[
                material("sand", 1500.0, "young_modulus = 2e5, friction_angle_deg = 35"),
                block("sand", [0.0; 3], [0.32, 0.32, 0.16], &format!("around_tools = {around}")),
                tool("box", [0.16, 0.16, z], &half([0.06; 3]), FRICTION, &format!("{{ free = {{ mass = {mass} }} }}")),
            ]),
            Precision::F32,
        );
        let mut fastest = 0f64;
        while s.time() < 0.5 {
            let all = later(&mut s, 0.005);
            assert!(all_finite(&all));
            fastest = all.iter().fold(fastest, |f, r| f.max(norm(r.v))).max(norm(s.bodies()[0].velocity));
        }
        println!("B49 {what}: body ends at {:.3} m from {z} m", s.bodies()[0].position[2]);
        within(&format!("B49 {what}: greatest speed [m/s]"), fastest, 1.0);
    }
}

/// Writes an OBJ file of a box with half sides 0.1, 0.2, 0.3, with some faces left out, or inside out.
fn write_box(folder: &Path, name: &str, faces: usize, flipped: bool) {
    let mut text = String::new();
    for i in 0..8 {
        let s = |bit: i32, a: f64| if i >> bit & 1 == 0 { -a } else { a };
        text.push_str(&format!("v {} {} {}\n", s(0, 0.1), s(1, 0.2), s(2, 0.3)));
    }
    // Two triangles a face, anticlockwise from outside.
    let triangles = [
        [1, 3, 4],
        [1, 4, 2],
        [5, 6, 8],
        [5, 8, 7],
        [1, 2, 6],
        [1, 6, 5],
        [3, 7, 8],
        [3, 8, 4],
        [1, 5, 7],
        [1, 7, 3],
        [2, 4, 8],
        [2, 8, 6],
    ];
    for [a, b, c] in &triangles[..faces] {
        text.push_str(&if flipped { format!("f {a} {c} {b}\n") } else { format!("f {a} {b} {c}\n") });
    }
    std::fs::write(folder.join(name), text).unwrap();
}

/// B50, speed. Symptom: only the origin's velocity counts, and the tip of a fast rotor jumps over cells. Physics: the tip moves
/// at ω r; it must not move more than half a cell in a step. Sand that it strikes is thrown no faster than the tip.
#[test]
fn tip_speed_bounds_the_step() {
    let (h, omega, reach) = (0.02, 60.0, 0.1);
    let rotor = |time: &str| {
        let (head, mut parts) = bed(h, [16, 16], 5, 16, "young_modulus = 1e5, friction_angle_deg = 35");
        let motion = format!("{{ velocity = {{ angular = [0, 0, {omega}] }} }}");
        parts.push(tool("rotor", [0.16, 0.16, 0.1], &half([reach, 0.025, 0.04]), FRICTION, &motion));
        head.time(time).with(&parts)
    };
    let tip = omega * f64::hypot(reach, f64::hypot(0.025, 0.04));
    let bound = barchan::plan::TOOL_COURANT * h / tip;
    says(
        &refusal(&rotor(&format!("step = {}", 1.05 * bound))),
        &["is above the bound", "coupling 'rigid': speed of a tool"],
    );
    let mut s = simulation(&rotor("safety = 0.9"), Precision::F32);
    let (mut longest, mut fastest) = (0f64, 0f64);
    while s.time() < 0.12 {
        let dt = s.step().unwrap().dt;
        longest = longest.max(tip * dt / h);
        if s.step_count().is_multiple_of(10) {
            fastest = rows(&s).iter().fold(fastest, |f, r| f.max(norm(r.v)));
        }
    }
    within("B50: way of the tip in a step [h]", longest, 0.5);
    within("B50: fastest sand over the tip's speed", fastest / tip, 1.5);
    assert!(all_finite(&rows(&s)));
}

/// B50, meshes. Symptom: a mirrored or open mesh has an inside that is outside, and swallows the scene; far from the mesh the
/// sampled distance ends. Physics: distance is defined everywhere, and only for closed surfaces that face outwards.
#[test]
fn bad_meshes_are_refused_and_distance_goes_on_far_away() {
    let folder = tempfile::tempdir().unwrap();
    write_box(folder.path(), "box.obj", 12, false);
    write_box(folder.path(), "inside_out.obj", 12, true);
    write_box(folder.path(), "open.obj", 11, false);
    let text = |file: &str, scale: f64| {
        let path = folder.path().join(file);
        let shape = format!("mesh = {{ file = {path:?}, scale = {scale} }}");
        Head::space(0.05).with(&[tool("thing", [0.5, 0.0, 0.0], &shape, FRICTION, &driven([0.0; 3]))])
    };
    says(&refusal(&text("box.obj", -1.0)), &["tool[0].shape.mesh.scale", "is -1", "must be above 0"]);
    says(&refusal(&text("inside_out.obj", 1.0)), &["tool[0].shape", "the mesh is inside out", "flip the faces"]);
    says(&refusal(&text("open.obj", 1.0)), &["tool[0].shape", "the mesh is not closed: the edge", "close the hole"]);
    says(
        &refusal(&text("absent.obj", 1.0)),
        &["tool[0].shape", "absent.obj", "give the path of an OBJ, STL or DAE file"],
    );

    for scale in [1.0, 0.5, 2.0] {
        let s = simulation(&text("box.obj", scale), Precision::F32);
        let half = [0.1 * scale, 0.2 * scale, 0.3 * scale];
        let mut worst = 0f64;
        for x in [
            [0.9, 0.1, 0.2],
            [3.5, 0.0, 0.0],
            [0.5, -3.0, 1.0],
            [-3.0, 3.0, -3.5],
            [0.52, 0.0, 0.01],
            [100.0, 50.0, -20.0],
        ] {
            let q: [f64; 3] = std::array::from_fn(|d| f64::abs(x[d] - [0.5, 0.0, 0.0][d]) - half[d]);
            let outside = norm(q.map(|a: f64| a.max(0.0)));
            let exact = outside + q.iter().copied().fold(f64::MIN, f64::max).min(0.0);
            worst = worst.max((s.couplings()[0].distance(&[x])[0] - exact).abs() / exact.abs().max(0.3 * scale));
        }
        within(&format!("B50: distance of a mesh of scale {scale} from that of the box, near and far"), worst, 0.03);
    }
    assert!(scene(&text("box.obj", 1.0)).tool.len() == 1);
}
