//! What agents leave, where they may be, and who may be one.

use super::{around_marker, counted, levels, minus, norm, on_levels};
use barchan::{Command, Precision, Simulation};
use barchan_tests::scenes::{Row, alter, everywhere, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, block, body, driven, half, material, tool};

/// B31. Symptom: particles on two sides of a thin blade merge into one that lies on either. Physics: matter left of the blade stays there, all
/// of it; away from the blade it merges.
#[test]
fn particles_on_two_sides_of_a_thin_blade_do_not_merge() {
    let h = 0.05;
    // In the middle of a merged particle's bin, and a quarter of a cell thick.
    let blade = 0.225;
    for precision in [Precision::F64, Precision::F32] {
        let scene = Head::space(h).time("step = 1e-5\nover_bound = \"allow\"").with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e-3, poisson_ratio = 0.3"),
            block("neo_hookean", [0.0; 3], [0.8, 0.2, 0.2], "around_tools = false"),
            levels(3, 8, &["eye"]),
            tool("blade", [blade, 0.1, 0.1], &half([0.125 * h, 0.3, 0.3]), "\"slip\"", "\"fixed\""),
            tool("eye", [0.4, 0.1, 0.3], "sphere = { radius = 0.05 }", "\"slip\"", &driven([0.0; 3])),
        ]);
        let mut s = simulation(&scene, precision);
        let left = |s: &Simulation| rows(s).iter().filter(|r| r.x[0] < blade).map(|r| r.m).sum::<f64>();
        let (before, fine) = (left(&s), on_levels(&s));
        // Away, and on and on, so that there are many rounds.
        s.act("eye", &Command::Twist { linear: [1e5, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
        (0..40).for_each(|_| drop(s.step().unwrap()));
        let all = rows(&s);
        let near = all.iter().filter(|r| (r.x[0] - blade).abs() < h).count();
        println!("B31 {precision}: {fine:?} -> {:?}, {near} at the blade, {:?}", on_levels(&s), s.ledger().counts);
        assert!(counted(&s.ledger(), "particles merged") > 500, "{:?}", s.ledger().counts);
        within(
            &format!("B31 {precision}: mass that has come through the blade"),
            (left(&s) / before - 1.0).abs(),
            1e-12,
        );
        let across = all.iter().filter(|r| (r.x[0] - blade).abs() < 0.5 * r.volume0.cbrt() - 1e-6).count();
        within(&format!("B31 {precision}: particles that reach across the blade's middle"), across as f64, 0.0);
    }
}

/// Height of the surface over columns of `side` m in [from, to]² where cubes of rest volume end, 0 where there are none.
fn heights(all: &[Row], side: f64, from: f64, to: f64) -> Vec<f64> {
    let n = ((to - from) / side).round() as usize;
    let mut top = vec![0f64; n * n];
    for r in all {
        let half = 0.5 * r.volume0.cbrt();
        let reach = [0, 1].map(|d| {
            let at = |x: f64| (((x - from) / side - 0.5).ceil().max(0.0) as usize).min(n);
            // A little wider, since cubes of matter that is stretched leave gaps.
            at(r.x[d] - half - 0.25 * side)..at(r.x[d] + half + 0.25 * side)
        });
        for i in reach[0].clone() {
            for j in reach[1].clone() {
                top[i * n + j] = top[i * n + j].max(r.x[2] + half);
            }
        }
    }
    top
}

/// B38 whole. Symptom: a footprint is smoothed out once its agent is 20 m away and the ground four levels coarser. Physics: matter at
/// rest stays as it is, so the dent's depth stays within half a cell of the level left there, here of the finest, and its volume within 10 %.
#[test]
fn a_footprint_outlasts_a_walk_of_twenty_metres() {
    let h = 0.02;
    let side = 32.0 * h;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    let head = Head { gravity: [0.0; 3], ..Head::cells(h, [32, 32, 64], walls) };
    let middle = 0.5 * side;
    let dt = 4e-4;
    // Clay without gravity: what has been pressed down lies still, so that only splits and merges could change it.
    let scene = head.time(format!("step = {dt}\nover_bound = \"allow\"")).with(&[
        material("von_mises", 1500.0, "young_modulus = 5e5, poisson_ratio = 0.3, yield_stress = 3e3"),
        block("von_mises", [0.0; 3], [side, side, side], ""),
        levels(5, 8, &["foot"]),
        tool("foot", [middle, middle, side + 0.06], &half([0.04, 0.04, 0.05]), "\"slip\"", &driven([0.0, 0.0, -1.0])),
    ]);
    let mut s = simulation(&scene, Precision::F32);
    let dent = |s: &Simulation| {
        let all = rows(s);
        let under = heights(&all, h, middle - 2.0 * h, middle + 2.0 * h);
        // What is deeper than a quarter of a cell: elsewhere the surface is pressed by less than a millimetre.
        let depths = heights(&all, h, middle - 0.16, middle + 0.16).into_iter().map(|z| side - z);
        let volume: f64 = depths.filter(|depth| *depth > 0.25 * h).map(|depth| depth * h * h).sum();
        (side - under.iter().sum::<f64>() / under.len() as f64, volume)
    };
    let start = on_levels(&s);
    run_to(&mut s, 0.05);
    s.act("foot", &Command::Twist { linear: [0.0, 0.0, 1.0], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.12);
    s.act("foot", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap();
    run_to(&mut s, 0.16);
    // What still rings would go on ringing.
    alter(&mut s, |r| (r.v, r.c) = ([0.0; 3], [0.0; 9]));
    let (printed, there) = (dent(&s), on_levels(&s));
    let walk = |s: &mut Simulation, way: f64| {
        s.act("foot", &Command::Twist { linear: [way / 50.0 / dt, 0.0, 0.0], angular: [0.0; 3] }).unwrap();
        (0..50).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        s.act("foot", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap();
        (0..5).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        (dent(s), on_levels(s))
    };
    let (away, gone) = walk(&mut s, 20.0);
    let (back, again) = walk(&mut s, -20.0);
    println!(
        "B38 20 m: {start:?}, {there:?}, {gone:?}, {again:?}: {printed:?}, {away:?}, {back:?}, {:?}",
        s.ledger().counts
    );
    assert!(printed.0 > 0.5 * h, "there is a footprint: {printed:?}");
    let count = |on: &[usize]| on.iter().sum::<usize>() as f64;
    within("B38 20 m: particles when away over those before", count(&gone) / count(&there), 0.5);
    assert!(gone[0] == 0 && gone[4] > 0, "the ground is four levels coarser: {gone:?}");
    for (what, dent) in [("away", away), ("when back", back)] {
        within(&format!("B38 20 m: depth {what} [h]"), (dent.0 - printed.0).abs() / h, 0.5);
        within(&format!("B38 20 m: volume {what}"), (dent.1 / printed.1 - 1.0).abs(), 0.1);
    }
}

/// An elastic block between slip walls that bears its own weight, with what is fine around a marker.
fn resting(h: f64, levels: &str, step: f64) -> String {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    let head = Head { gravity_ramp: 0.3, max: [0.64, 0.64, 1.28], ..Head::cells(h, [0; 3], walls) };
    head.time(format!("step = {step}")).with(&[
        material("hencky", 1500.0, "young_modulus = 5e5, poisson_ratio = 0.2"),
        block("hencky", [0.0; 3], [0.64, 0.64, 0.48], ""),
        levels.to_owned(),
    ])
}

/// B40. Symptom: a region that a wall cuts has slaves behind the wall, or its rim at the wall drives a current. Physics: a block at rest between
/// walls, with an agent in the corner of floor and walls, bears rho g (H - z) on both levels, and its floor its weight.
#[test]
fn an_agent_in_a_corner_leaves_matter_at_rest() {
    let (h, height, rho, g) = (0.04, 0.48, 1500.0, 9.81);
    for (precision, tolerance) in [(Precision::F64, 0.02), (Precision::F32, 0.03)] {
        let mut s = simulation(&resting(h, &around_marker(2, 8, [0.0; 3]), 1e-3), precision);
        let (start, levels) = (rows(&s), on_levels(&s));
        assert!(levels.iter().all(|&n| n > 500), "{levels:?}");
        // By level and layers of two fine cells: mass, height at the start, true stress.
        let mut layers = vec![[0.0; 3]; 12];
        run_to(&mut s, 0.35);
        let floor = s.ledger().wall_impulse[2];
        for _ in 0..20 {
            let next = s.time() + 0.01;
            run_to(&mut s, next);
            for list in &s.particles().lists {
                let all: Vec<usize> = (0..list.len()).collect();
                let tau = barchan::stress::kirchhoff(&s.plan().materials[0], list, &all).unwrap();
                for i in all {
                    let Ok(at) = start.binary_search_by_key(&list.id[i], |r| r.id) else { continue };
                    let z = start[at].x[2];
                    let layer = &mut layers[6 * list.level as usize + (z / (2.0 * h)) as usize];
                    // J from the elastic law in uniaxial strain.
                    let j = list.strain[2][i].sqrt();
                    let add = [list.mass[i], list.mass[i] * z, list.mass[i] * tau[i][2] / j];
                    (0..3).for_each(|d| layer[d] += add[d]);
                }
            }
        }
        let push = (s.ledger().wall_impulse[2] - floor) / 0.2;
        let fastest = rows(&s).iter().fold(0f64, |f, r| f.max(norm(r.v)));
        let off = layers.iter().filter(|l| l[0] > 0.0).fold(0f64, |off, l| {
            let (z, stress) = (l[1] / l[0], l[2] / l[0]);
            off.max((stress + rho * g * (height - z)).abs() / (rho * g * height))
        });
        println!(
            "B40 corner {precision}: {levels:?} -> {:?}, fastest {fastest:.1e} m/s, {:?}",
            on_levels(&s),
            s.ledger().counts
        );
        within(&format!("B40 corner {precision}: sigma_zz over rho g H, off by"), off, tolerance);
        let weight = rho * g * 0.64 * 0.64 * height;
        within(
            &format!("B40 corner {precision}: push of the floor over weight, off by"),
            (push.abs() / weight - 1.0).abs(),
            0.01,
        );
        within(
            &format!("B40 corner {precision}: momentum sideways [m/s]"),
            {
                let p = s.ledger().momentum;
                p[0].hypot(p[1]) / s.ledger().mass
            },
            2e-3,
        );
    }
}

/// B40. Symptom: an agent high above the ground, whose region holds nothing, makes a rim or steps for nothing. Physics: the ground is what it is
/// on the coarse level alone, to rounding.
#[test]
fn an_agent_above_the_ground_changes_nothing() {
    for (precision, tolerance) in [(Precision::F64, 1e-9), (Precision::F32, 1e-3)] {
        let high = levels(2, 8, &["eye"])
            + &tool("eye", [0.3, 0.3, 1.0], "sphere = { radius = 0.02 }", "\"slip\"", &driven([0.1, 0.0, 0.0]));
        let [mut above, mut alone] =
            [(0.04, high.as_str()), (0.08, "")].map(|(h, levels)| simulation(&resting(h, levels, 1e-3), precision));
        (0..150).for_each(|_| drop((above.step().unwrap(), alone.step().unwrap())));
        assert_eq!(on_levels(&above)[0], 0, "nothing is fine");
        let by_place = |s: &Simulation| {
            let mut all = rows(s);
            let key = |r: &Row| r.x.map(|x| (x / 0.04).floor() as i64);
            all.sort_by_key(|r| key(r));
            all
        };
        let (a, b) = (by_place(&above), by_place(&alone));
        assert_eq!(a.len(), b.len());
        let fastest = b.iter().fold(0f64, |f, r| f.max(norm(r.v)));
        let off = a.iter().zip(&b).fold(0f64, |off, (a, b)| off.max(norm(minus(a.v, b.v))));
        within(
            &format!("B40 agent above the ground, {precision}: velocities over the fastest"),
            off / fastest,
            tolerance,
        );
    }
}

/// Symptom: a soft body that levels should follow leaves its fine region, or takes its box from where it was. Physics: a soft agent is
/// fine wherever it flies, what it passes is fine around it and coarse again afterwards; centres fall as symplectic Euler says, and
/// mass and momentum are exact.
#[test]
fn levels_follow_a_soft_body() {
    let (h, dt, g) = (0.05, 1e-3, 9.81);
    for (precision, tolerance, exact) in [(Precision::F64, 1e-12, 1e-13), (Precision::F32, 1e-4, 1e-5)] {
        let scene = Head { gravity: [0.0, 0.0, -g], ..Head::space(h) }.time(format!("step = {dt}")).with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            body(
                "neo_hookean",
                "sphere = { center = [-0.9, 0.0, 0.5], radius = 0.12 }",
                "name = \"ball\"\nvelocity = [4.0, 0.0, 0.0]",
            ),
            block("neo_hookean", [-0.8, -0.2, -0.2], [0.8, 0.2, 0.2], "name = \"ground\""),
            levels(3, 8, &["ball"]),
        ]);
        let mut s = simulation(&scene, precision);
        let (before, start) = (s.ledger(), on_levels(&s));
        let is_ball = |list: &barchan::ParticleList, i: usize| list.body[i] == 0;
        let ball = |s: &Simulation| {
            let (mut centre, mut mass, mut coarse) = ([0.0; 3], 0.0, 0);
            for list in &s.particles().lists {
                for i in (0..list.len()).filter(|&i| is_ball(list, i)) {
                    let x = list.position(i);
                    (0..3).for_each(|d| centre[d] += list.mass[i] * x[d]);
                    mass += list.mass[i];
                    coarse += u32::from(list.level > 0);
                }
            }
            (centre.map(|x| x / mass), mass, coarse)
        };
        let from = ball(&s);
        let mut coarse = 0;
        for _ in 0..400 {
            s.step().unwrap();
            coarse += ball(&s).2;
        }
        let (after, to) = (s.ledger(), ball(&s));
        println!("soft agent {precision}: {start:?} -> {:?}, ball {:?}, {:?}", on_levels(&s), to.0, after.counts);
        assert!(counted(&after, "particles split") > 100 && counted(&after, "particles merged") > 100);
        within(&format!("soft agent {precision}: its particles on coarse levels in any step"), f64::from(coarse), 0.0);
        let drop = g * dt * dt * 400.0 * 401.0 / 2.0;
        let path = [from.0[0] + 1.6, from.0[1], from.0[2] - drop];
        within(&format!("soft agent {precision}: off its path [m]"), norm(minus(to.0, path)), tolerance);
        within(&format!("soft agent {precision}: mass"), (after.mass / before.mass - 1.0).abs(), 1e-13);
        let expected = [before.momentum[0], 0.0, -before.mass * g * 400.0 * dt];
        within(
            &format!("soft agent {precision}: momentum"),
            norm(minus(after.momentum, expected)) / norm(expected),
            exact,
        );
    }
}

/// Ground in a box that stays is as fine as around an agent, and the plan says so before anything runs; what flows through it splits and merges as around a
/// tool. Mass and momentum stay.
#[test]
fn a_fixed_box_keeps_the_ground_in_it_fine() {
    for options in everywhere() {
        let what = format!("{} {}", options.backend, options.precision);
        let h = 0.02;
        let head = Head { gravity: [0.0; 3], ..Head::cells(h, [96, 32, 32], "") };
        let text = head.with(&[
            material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("neo_hookean", [0.2, 0.16, 0.16], [0.6, 0.48, 0.48], "velocity = [2, 0, 0]"),
            "[levels]\ncount = 2\nhalf = 8\nbox = [{ min = [0.9, 0.2, 0.2], max = [1.1, 0.44, 0.44] }]\n".to_owned(),
        ]);
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        let effects = &s.plan().effects;
        let levels = effects.iter().find(|effect| effect.name == "2 levels").unwrap();
        assert!(levels.because.contains("levels.box[0]"), "{levels:?}");
        assert!(levels.adds.starts_with(&format!("adapt, restrict, prolong; 0 + {} particles", s.particle_count())));
        let (before, fine) = (s.ledger(), |s: &Simulation| on_levels(s)[0]);
        run_to(&mut s, 0.3);
        println!("{what}: {} fine particles of {}", fine(&s), s.particle_count());
        let in_box = rows(&s)
            .into_iter()
            .filter(|r| (0..3).all(|d| [0.9, 0.2, 0.2][d] < r.x[d] && r.x[d] < [1.1, 0.44, 0.44][d]));
        let (all, on_finest) = in_box.fold((0, 0), |(all, fine), r| (all + 1, fine + usize::from(r.level == 0)));
        assert!(all > 1000 && on_finest == all, "{what}: {on_finest} of {all} in the box are fine");
        let after = s.ledger();
        within(&format!("{what} mass"), (after.mass / before.mass - 1.0).abs(), 1e-6);
        within(&format!("{what} momentum"), (after.momentum[0] / before.momentum[0] - 1.0).abs(), 1e-4);
    }
}
