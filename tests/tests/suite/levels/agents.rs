//! Regions that follow agents: splits, merges, and what they must not do.

use super::{counted, kinetic, levels, minus, norm, on_levels, regions_of, static_count};
use barchan::{Command, Ledger, Precision, Simulation};
use barchan_core::levels::{MERGE_LEFT, cell_of};
use barchan_tests::scenes::{Row, alter, rows, run_to, simulation, within};
use barchan_tests::sketch::{Head, bed, block, driven, half, material, tool};

const FRICTION: &str = "{ coulomb = { friction = 0.4 } }";

/// A block of jelly in space that hardly moves, and an agent that touches nothing above it.
fn jelly_under_agent(cell: f64, count: u32, velocity: [f64; 3], at: f64) -> String {
    let motion = "velocity = [0.02, 0.05, 0.03]\nangular_velocity = [0.02, 0.0, 0.0]";
    moving_jelly_under_agent(cell, count, velocity, at, motion)
}

/// The same with another motion.
fn moving_jelly_under_agent(cell: f64, count: u32, velocity: [f64; 3], at: f64, motion: &str) -> String {
    let head = Head { min: [at - 4.0, at - 4.0, -4.0], max: [at + 4.0, at + 4.0, 4.0], ..Head::space(cell) };
    head.time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [at - 0.8, at - 0.2, -0.2], [at + 0.8, at + 0.2, 0.2], motion),
        levels(count, 8, &["eye"]),
        tool("eye", [at, at, 0.4], "sphere = { radius = 0.05 }", "\"slip\"", &driven(velocity)),
    ])
}

fn step(s: &mut Simulation) {
    s.step().unwrap_or_else(|e| panic!("{e}"));
}

/// What splits and merges must leave as it is: mass, momentum, centre of mass; and they give no energy.
fn conserved(what: &str, before: &Ledger, after: &Ledger, energy: f64) {
    within(&format!("{what}: mass"), (after.mass / before.mass - 1.0).abs(), 1e-13);
    let scale = before.mass * (2.0 * energy / before.mass).sqrt();
    within(&format!("{what}: momentum over m v"), norm(minus(after.momentum, before.momentum)) / scale, 1e-11);
    within(&format!("{what}: kinetic energy that merges gave, over all"), after.resampled_kinetic / energy, 1e-12);
    within(&format!("{what}: share of energy that merges took"), -after.resampled_kinetic / energy, 0.01);
}

/// B30, B33. Symptom: an agent that goes to and fro leaves more particles at every pass, since clusters that have moved or turned across
/// the lattice of bins find no partners (2.3 times as many after 150 passes over a turning body); or each split and merge takes some of the motion.
/// Physics: nothing happens to matter; the count stays within 1.3 of what a fresh scene would have, whatever has happened.
#[test]
fn passes_of_an_agent_leave_nothing_behind() {
    let h = 0.05;
    let straight = "velocity = [0.02, 0.05, 0.03]\nangular_velocity = [0.02, 0.0, 0.0]";
    let turning = "velocity = [0.05, 0.1, 0.0]\nangular_velocity = [0.5, 0.0, 0.2]";
    for (what, motion, passes) in [("B30", straight, 60), ("B30 turning", turning, 24)] {
        let mut s = simulation(&moving_jelly_under_agent(h, 3, [0.0; 3], 0.0, motion), Precision::F64);
        let before = s.ledger();
        let at_start = s.particle_count();
        let mut counts = Vec::new();
        for pass in 0..passes {
            let v = if pass % 2 == 0 { 20.0 } else { -20.0 };
            // 0.4 of a cell a step at most.
            s.act("eye", &Command::Twist { linear: [v, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
            for _ in 0..if pass == 0 { 20 } else { 40 } {
                step(&mut s);
            }
            counts.push((s.particle_count() as f64 / static_count(&s) * 1000.0).round() / 1000.0);
        }
        let after = s.ledger();
        println!(
            "{what}: {at_start} particles, at the end {}: {:?}, over static {counts:?}",
            s.particle_count(),
            after.counts
        );
        assert!(counted(&after, "particles split") > 1000, "{:?}", after.counts);
        conserved(what, &before, &after, before.kinetic);
        let spin = norm(after.resampled_angular_momentum) / norm(before.angular_momentum);
        within(&format!("{what}: share of angular momentum that merges changed"), spin, 0.01);
        let most = counts.into_iter().fold(0.0, f64::max);
        within(&format!("B33 {motion:?}: particles over the static count, after any of {passes} passes"), most, 1.3);
    }
}

/// Symptom: what a foot's region leaves behind stays fine for a third cell of the next level, 64 particles to a cell there, and a scene has a tenth more particles than
/// it need have. Physics: an agent that moves on leaves fine what is within two such cells of its region, and no more.
#[test]
fn what_an_agent_leaves_behind_merges_two_parent_cells_away() {
    let h = 0.05;
    let mut s = simulation(&jelly_under_agent(h, 2, [20.0, 0.0, 0.0], 0.0), Precision::F64);
    for _ in 0..3 {
        (0..10).for_each(|_| step(&mut s));
        let (regions, all) = (regions_of(&s), rows(&s));
        let is_left =
            |r: &&Row| r.volume0 < 2.0 * (0.5 * h).powi(3) && regions.finest_at(cell_of(r.x, h), MERGE_LEFT) > 0;
        let left = all.iter().filter(is_left).count() as f64 / all.len() as f64;
        within("share of particles that are fine beyond two parent cells", left, 0.01);
    }
    assert!(counted(&s.ledger(), "particles merged") > 500, "{:?}", s.ledger().counts);
}

/// B30, of one cluster. Symptom: children that copy their parent's velocity, or a merge that forgets gradients, take 4 % of the energy of a turn.
/// Physics: split, merged and split again a thousand times, a particle is what it would have been: place, velocity, gradient, strain.
#[test]
fn a_thousand_splits_and_merges_are_the_identity() {
    let h = 0.05;
    // Dust, so that motion stays affine and the same on each level; the agent jumps by 3 m at every step, or stays away.
    let run = |jumps: bool| {
        let scene = Head::space(h).time("step = 1e-5\nover_bound = \"allow\"").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e-3, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [0.2; 3], ""),
            levels(2, 16, &["eye"]),
            tool("eye", [3.0, 0.1, 0.6], "sphere = { radius = 0.05 }", "\"slip\"", &driven([0.0; 3])),
        ]);
        let mut s = simulation(&scene, Precision::F64);
        let rate = [4e-4, -3e-4, 2e-4, 1e-4, -5e-4, 3e-4, 6e-4, -2e-4, 1e-4];
        alter(&mut s, |r| {
            r.c = rate;
            r.v = std::array::from_fn(|i| 0.1 + (0..3).map(|j| rate[3 * i + j] * r.x[j]).sum::<f64>());
        });
        for k in 0..2001 {
            let v = if k == 2000 {
                0.0
            } else if k % 2 == 0 {
                -3e5
            } else {
                3e5
            };
            s.act("eye", &Command::Twist { linear: [if jumps { v } else { 0.0 }, 0.0, 0.0], angular: [0.0; 3] })
                .unwrap();
            step(&mut s);
        }
        s
    };
    let (calm, busy) = (run(false), run(true));
    let (ledger, before) = (busy.ledger(), calm.ledger());
    println!("B30 cycles: {} and {} particles, {:?}", calm.particle_count(), busy.particle_count(), ledger.counts);
    assert!(counted(&ledger, "particles split") >= 1000 * calm.particle_count() as u64, "{:?}", ledger.counts);
    let (a, b) = (rows(&calm), rows(&busy));
    assert_eq!(a.len(), b.len());
    let mut worst = [0f64; 4];
    for (a, b) in a.iter().zip(&b) {
        assert_eq!(a.id, b.id, "a merged particle has the number that its parent had");
        worst[0] = worst[0].max(norm(minus(a.x, b.x)) / h);
        worst[1] = worst[1].max(norm(minus(a.v, b.v)));
        worst[2] = (0..9).fold(worst[2], |w, i| w.max((a.c[i] - b.c[i]).abs()));
        worst[3] = (0..6).fold(worst[3], |w, i| w.max((a.strain[i] - b.strain[i]).abs()));
    }
    // Transfers turn a gradient by dt C² a step, by how much depends on the cell: t C² = 7e-9 / s altogether, and with it the rest.
    let tolerances = [("place [h]", 6e-10), ("velocity [m/s]", 1.5e-9), ("gradient [1/s]", 7e-9), ("strain", 1e-9)];
    for ((what, tolerance), off) in tolerances.into_iter().zip(worst) {
        within(&format!("B30: {what} after a thousand cycles"), off, tolerance);
    }
    conserved("B30 cycles", &before, &ledger, before.kinetic);
}

/// B31. Symptom: jets that meet merge into matter at rest, and their energy is gone. Physics: particles merge only if little of their
/// motion would be lost; what moves apart or against each other stays apart, and the ledger says so.
#[test]
fn colliding_jets_do_not_merge() {
    let run = |speed: f64| {
        let scene = Head::space(0.05).time("step = 1e-5\nover_bound = \"allow\"").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e-3, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [0.4; 3], ""),
            levels(2, 16, &["eye"]),
            tool("eye", [0.0, 0.1, 0.7], "sphere = { radius = 0.05 }", "\"slip\"", &driven([3e5, 0.0, 0.0])),
        ]);
        let mut s = simulation(&scene, Precision::F64);
        // The agent is gone after this step; what it leaves may merge at the start of the next.
        step(&mut s);
        alter(&mut s, |r| {
            let layer = (r.x[1] / 0.025).floor() as i32;
            r.v = [if layer % 2 == 0 { speed } else { -speed }, 0.0, 0.0];
            r.c = [0.0; 9];
        });
        step(&mut s);
        let ledger = s.ledger();
        println!("B31 at {speed} m/s: {} particles, {:?}", s.particle_count(), ledger.counts);
        (counted(&ledger, "particles merged"), counted(&ledger, "velocities differ"))
    };
    assert_eq!(run(2.0), (0, 512), "all 512 cubes are refused");
    assert_eq!(run(0.0), (4096, 0), "at rest they all merge");
}

/// B17 with levels. Symptom: 10 km from the origin regions, cells or offsets lose digits. Physics: the same scene elsewhere runs the same.
#[test]
fn ten_kilometres_away_levels_are_the_same() {
    // The scene's own numbers have 1e-12 m there, and the sum for the body's centre less.
    for (precision, tolerance) in [(Precision::F32, 1e-6), (Precision::F64, 1e-6)] {
        let run = |at: f64| {
            let mut s = simulation(&jelly_under_agent(0.05, 3, [10.0, 0.0, 0.0], at), precision);
            (0..100).for_each(|_| step(&mut s));
            s
        };
        let (here, there) = (run(0.0), run(10_000.0));
        let (a, b) = (rows(&here), rows(&there));
        assert!(counted(&here.ledger(), "particles split") > 100 && a.len() == b.len(), "{} {}", a.len(), b.len());
        let off = a.iter().zip(&b).fold(0f64, |off, (a, b)| off.max(norm(minus(a.v, b.v))));
        within(&format!("B17 {precision}: velocities 10 km away [m/s]"), off, tolerance);
    }
}

/// B34. Symptom: an agent that jumps leaves its fine region behind, or everything is rebuilt. Physics: the region is where the
/// agent is; mass and momentum are exact; far away no bit changes.
#[test]
fn teleport_moves_the_region_at_once() {
    let scene = Head { gravity: [0.0; 3], min: [-4.0, -1.0, -1.0], max: [4.0, 1.0, 1.0], ..Head::space(0.05) }.time("step = 1e-3\nover_bound = \"allow\"").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-3.0, -0.2, -0.2], [3.0, 0.2, 0.2], "velocity = [0.01, 0.02, 0.0]"),
        levels(3, 8, &["eye"]),
        tool(
            "eye",
            [-2.5, 0.0, 0.4],
            "sphere = { radius = 0.05 }",
            "\"slip\"",
            "{ keyframes = { frames = [{ time = 0.0, position = [-2.5, 0.0, 0.4] }, { time = 0.01, position = [-2.5, 0.0, 0.4] }, { time = 0.0101, position = [2.5, 0.0, 0.4] }] } }",
        ),
    ]);
    let mut s = simulation(&scene, Precision::F64);
    let before = s.ledger();
    let start = on_levels(&s);
    let mut steps = 0;
    while s.time() < 0.0305 {
        step(&mut s);
        steps += 1;
    }
    let (after, end) = (s.ledger(), on_levels(&s));
    let boxes = s.particles().levels.unwrap().boxes;
    println!("B34: {start:?} -> {end:?} in {steps} steps, boxes {boxes:?}, {:?}", after.counts);
    assert!(boxes[0][0].contains([50, 0, 8]), "the region is at the agent: {boxes:?}");
    conserved("B34", &before, &after, before.kinetic);
    assert!(counted(&after, "particles split") > 100 && counted(&after, "particles merged") > 100);
    within("B34: particles over those before", s.particle_count() as f64 / start.iter().sum::<usize>() as f64, 1.3);
    let middle: Vec<Row> = rows(&s).into_iter().filter(|r| r.x[0].abs() < 0.5).collect();
    let off = middle.iter().fold(0f64, |o, r| o.max(norm(minus(r.v, [0.01, 0.02, 0.0]))));
    assert!(middle.len() > 50);
    within("B34: velocity far from both places [m/s]", off, 1e-14);
}

/// B35. Symptom: an agent that trembles makes its region jump to and fro, and particles with it. Physics: within two parent cells
/// nothing moves; splits and merges are less than 1 % of the particles in a second.
#[test]
fn a_trembling_agent_moves_nothing() {
    let mut s = simulation(&jelly_under_agent(0.05, 3, [0.0; 3], 0.0), Precision::F64);
    // Still, so that all splits and merges would be the agent's.
    alter(&mut s, |r| (r.v, r.c) = ([0.0; 3], [0.0; 9]));
    step(&mut s);
    let boxes = |s: &Simulation| s.particles().levels.unwrap().boxes;
    let (first, count) = (boxes(&s), s.particle_count());
    // ±1 cell at 100 Hz: 5 ms each way at 0.05 m / 2.5 ms.
    let mut moved = 0;
    for k in 0..200 {
        let v = if (k + 2) / 5 % 2 == 0 { 19.0 } else { -19.0 };
        s.act("eye", &Command::Twist { linear: [v, 0.3 * v, 0.0], angular: [0.0; 3] }).unwrap();
        step(&mut s);
        moved += u32::from(boxes(&s) != first);
    }
    let ledger = s.ledger();
    println!("B35: {:?}, {:?}", s.bodies()[0].position, ledger.counts);
    let events = counted(&ledger, "particles split") + counted(&ledger, "particles merged");
    within("B35: steps in which a region moved", f64::from(moved), 0.0);
    within("B35: splits and merges a second over particles", events as f64 / s.time() / count as f64, 0.01);
}

/// B39. Symptom: where two regions overlap, particles are on two levels or on none, and what lies between is lost as they merge
/// and part. Physics: a level is the union of its boxes.
#[test]
fn two_agents_meet_and_part() {
    let scene = Head::space(0.05).time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-1.4, -0.2, -0.2], [1.4, 0.2, 0.2], "angular_velocity = [0.3, 0.0, 0.0]"),
        levels(3, 8, &["left", "right"]),
        tool("left", [-1.2, -0.1, 0.4], "sphere = { radius = 0.05 }", "\"slip\"", &driven([8.0, 0.0, 0.0])),
        tool("right", [1.2, 0.1, 0.4], "sphere = { radius = 0.05 }", "\"slip\"", &driven([-8.0, 0.0, 0.0])),
    ]);
    let mut s = simulation(&scene, Precision::F64);
    let (before, energy, mut least, mut most) = (s.ledger(), kinetic(&s), usize::MAX, 0);
    let start = on_levels(&s);
    for _ in 0..300 {
        step(&mut s);
        let fine = on_levels(&s)[0];
        (least, most) = (least.min(fine), most.max(fine));
    }
    let after = s.ledger();
    println!("B39: {start:?} -> {:?}, fine from {least} to {most}, {:?}", on_levels(&s), after.counts);
    conserved("B39", &before, &after, before.kinetic);
    assert!((least as f64) < 0.8 * most as f64, "regions have overlapped: {least}, {most}");
    within(
        "B39: particles at the end over those at the start",
        s.particle_count() as f64 / start.iter().sum::<usize>() as f64,
        1.3,
    );
    within("B39: energy gained", (kinetic(&s) + after.elastic) / energy - 1.0, 0.0);
}

/// Mean height of the topmost particles in columns of `side` m over [x0, x1] x [y0, y1], top being the cube's end.
fn heights(all: &[Row], side: f64, x: [f64; 2], y: [f64; 2]) -> Vec<f64> {
    let n = [x, y].map(|e| ((e[1] - e[0]) / side).round() as usize);
    let mut top = vec![0f64; n[0] * n[1]];
    for r in all {
        let (i, j) = ((r.x[0] - x[0]) / side, (r.x[1] - y[0]) / side);
        if i >= 0.0 && j >= 0.0 && (i as usize) < n[0] && (j as usize) < n[1] {
            let top = &mut top[i as usize * n[1] + j as usize];
            *top = top.max(r.x[2] + 0.5 * r.volume0.cbrt());
        }
    }
    top
}

/// B38. Symptom: a footprint that an agent walks away from is smoothed out as its particles merge. Physics: its
/// depth stays within half a cell of the level that is left there, and its volume within 10 %.
#[test]
fn a_footprint_outlasts_its_agent() {
    let h = 0.02;
    let (mut head, mut parts) = bed(h, [96, 24], 8, 24, "young_modulus = 5e5, friction_angle_deg = 40");
    head.walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    parts.extend([
        levels(3, 8, &["foot"]),
        tool("foot", [0.24, 0.24, 0.24], &half([0.06, 0.06, 0.06]), FRICTION, &driven([0.0, 0.0, -0.5])),
    ]);
    let mut s = simulation(&head.with(&parts), Precision::F32);
    let dent = |s: &Simulation| {
        let all = rows(s);
        let cells = heights(&all, 2.0 * h, [0.04, 0.44], [0.04, 0.44]);
        let volume: f64 = cells.iter().map(|z| (0.16 - z).max(0.0) * 4.0 * h * h).sum();
        let under = heights(&all, 2.0 * h, [0.2, 0.28], [0.2, 0.28]);
        (0.16 - under.iter().sum::<f64>() / under.len() as f64, volume)
    };
    let start = on_levels(&s);
    // Down to 40 mm, up again, slowly, since sand that has borne the foot springs back after a quick one, away, and back.
    run_to(&mut s, 0.12);
    s.act("foot", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.14);
    s.act("foot", &Command::Twist { linear: [0.0, 0.0, 0.5], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.3);
    s.act("foot", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.36);
    let here = |s: &Simulation| rows(s).iter().filter(|r| r.x[0] < 0.48).count();
    let (printed, near) = (dent(&s), here(&s));
    s.act("foot", &Command::Twist { linear: [5.0, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.64);
    let (away, far) = (dent(&s), here(&s));
    s.act("foot", &Command::Twist { linear: [-5.0, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.92);
    let back = dent(&s);
    println!(
        "B38: {start:?} {near} {far} {:?}: dent {printed:?}, away {away:?}, back {back:?}, {:?}",
        on_levels(&s),
        s.ledger().counts
    );
    assert!((far as f64) < 0.6 * near as f64, "it has become coarser: {near}, {far}");
    assert!(printed.0 > 0.015, "there is a footprint: {printed:?}");
    within("B38: depth away [m]", (away.0 - printed.0).abs(), 0.5 * 4.0 * h);
    within("B38: depth when back [m]", (back.0 - printed.0).abs(), 0.5 * 4.0 * h);
    within("B38: volume when back", (back.1 / printed.1 - 1.0).abs(), 0.1);
    within("B38: volume away", (away.1 / printed.1 - 1.0).abs(), 0.1);
}
