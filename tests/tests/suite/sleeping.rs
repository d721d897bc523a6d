//! Ground at rest that is left out of the step, and what wakes it.

use barchan::{Ledger, Options, Precision, Simulation};
use barchan_tests::scenes::{alter, norm, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, block, material, tool};
use barchan_tests::sleeping::{ADRIFT, CELL, SAND, adrift, asleep, bed, eased, gated, plate};
use std::time::Instant;

/// Symptom: a bed that nothing has touched for an hour costs as much as one that is ploughed. Physics: nothing happens in it, and where
/// and how it is strained stays as it is.
#[test]
fn settled_ground_costs_nothing() {
    // The least time of ten steps: others use the machine too.
    let time = |s: &mut Simulation, tries: usize| {
        let ten_steps = |_| {
            let clock = Instant::now();
            (0..10).for_each(|_| drop(s.step().unwrap()));
            clock.elapsed().as_secs_f64()
        };
        (0..tries).map(ten_steps).fold(f64::INFINITY, f64::min)
    };
    for precision in [Precision::F32, Precision::F64] {
        let mut s = simulation(&bed([64, 32, 8], "sand", SAND, "speed = 5e-4", &[]), precision);
        // It falls asleep after fifty steps.
        let awake = time(&mut s, 4);
        (0..260).for_each(|_| drop(s.step().unwrap()));
        let (before, count) = (rows(&s), s.particle_count() as u64);
        assert_eq!(asleep(&s), count, "{precision}: not all sleeps");
        let still = time(&mut s, 30);
        within(&format!("{precision}: time of a step asleep over awake"), still / awake, 0.05);
        assert!(rows(&s) == before, "{precision}: something has changed in its sleep");
        let ledger = s.ledger();
        assert!(ledger.kinetic == 0.0 && ledger.slept_kinetic < 1e-6, "{precision}: {:e} J", ledger.slept_kinetic);
    }
}

/// Symptom: under gravity that grows slowly, ground falls asleep and never gets its weight. Physics: once all of gravity is there, it is as much compressed as a column of its
/// height, (rho g)^2 h^3 / 6 M for each m2; then it may sleep.
#[test]
fn ground_gets_all_of_gravity_before_it_sleeps() {
    let mut s = simulation(&eased(), Precision::F32);
    run_to(&mut s, 0.99);
    assert_eq!(asleep(&s), 0, "sleeps while gravity grows");
    run_to(&mut s, 1.3);
    assert_eq!(asleep(&s), s.particle_count() as u64, "does not sleep afterwards");
    let modulus = 1e6 * 0.8 / (1.2 * 0.6);
    let energy = 0.08 * 0.08 * (1500.0 * 9.81_f64).powi(2) * 0.06_f64.powi(3) / (6.0 * modulus);
    within("elastic energy over that of a column, less 1", (s.ledger().elastic / energy - 1.0).abs(), 0.1);
}

/// Symptom: where steps are short or gravity is weak, ground in the air is slow for fifty steps, falls asleep and hangs there. Physics: it falls.
#[test]
fn what_falls_does_not_sleep_in_the_air() {
    let [rises, gravity] = ADRIFT;
    for precision in [Precision::F32, Precision::F64] {
        let mut s = simulation(&adrift(), precision);
        (0..400).for_each(|_| drop(s.step().unwrap()));
        let falls = rises + gravity * s.time();
        let off = rows(&s).iter().map(|row| (row.v[2] / falls - 1.0).abs()).fold(0.0, f64::max);
        within(&format!("{precision}: velocity over that of free fall, less 1"), off, 1e-3);
        assert_eq!(asleep(&s), 0, "{precision}: it sleeps");
    }
}

/// Symptom: a wave is swallowed, or late, where the ground it comes to has been asleep. Physics: it passes as if nothing had slept.
#[test]
fn a_pulse_passes_through_ground_asleep() {
    for (precision, law, parameters) in [
        (Precision::F64, "neo_hookean", "young_modulus = 1e5, poisson_ratio = 0.2"),
        (Precision::F32, "neo_hookean", "young_modulus = 1e5, poisson_ratio = 0.2"),
        (Precision::F64, "sand", SAND),
    ] {
        // Greatest mean velocity along the bar at its far end, and when.
        let [slept, awake] = ["on = true\nspeed = 5e-4", "on = false"].map(|sleep| {
            let mut s = simulation(&bed([96, 4, 6], law, parameters, sleep, &[]), precision);
            (0..150).for_each(|_| drop(s.step().unwrap()));
            let asleep = asleep(&s);
            let begun = s.time();
            alter(&mut s, |row| {
                let x = row.x[0] / 0.24;
                row.v[0] += if x < 1.0 { 0.05 * (1.0 + (std::f64::consts::PI * x).cos()) } else { 0.0 };
            });
            let (mut peak, mut when) = (0.0, 0.0);
            while s.time() < begun + 0.18 {
                s.step().unwrap();
                let far: Vec<f64> = rows(&s).iter().filter(|r| (1.2..1.28).contains(&r.x[0])).map(|r| r.v[0]).collect();
                let mean = far.iter().sum::<f64>() / far.len() as f64;
                if mean > peak {
                    (peak, when) = (mean, s.time() - begun);
                }
            }
            (asleep, peak, when)
        });
        println!("{law} {precision}: {slept:?} against {awake:?}");
        assert!(slept.0 == 96 * 4 * 6 * 8 && awake.0 == 0 && awake.1 > 2e-3, "{law}: nothing slept, or no pulse came");
        within(&format!("{law} {precision}: amplitude"), (slept.1 / awake.1 - 1.0).abs(), 0.02);
        within(&format!("{law} {precision}: delay over the time it took"), (slept.2 / awake.2 - 1.0).abs(), 0.01);
    }
}

/// Symptom: a tool meets ground asleep as if it were rock, or sinks into it as if it were air. Physics: force and furrow are those of
/// ground that never slept; on one level, on several, and with steps of their own.
#[test]
fn a_tool_finds_ground_asleep_as_it_would_awake() {
    let cells = [48, 24, 8];
    for levels in ["", "[levels]\ncount = 2\nhalf = 8\n", "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\n"] {
        let [slept, awake] = ["on = true\nspeed = 1e-3", "on = false"].map(|sleep| {
            let mut s =
                simulation(&bed(cells, "sand", SAND, sleep, &[levels.to_owned(), plate(cells, 0.25)]), Precision::F32);
            let mut impulse = [0.0; 3];
            let (mut most, mut surface) = (0, 0.0);
            while s.time() < 1.05 {
                let dt = s.step().unwrap().dt;
                let force = s.wrenches()[0].force;
                (0..3).for_each(|d| impulse[d] += force[d] * dt);
                if s.time() < 0.25 {
                    most = asleep(&s).max(most);
                }
            }
            let all = rows(&s);
            all.iter().for_each(|r| surface += r.m * r.x[2]);
            (most, impulse, surface / all.iter().map(|r| r.m).sum::<f64>(), asleep(&s))
        });
        println!("{levels:?}: {slept:?} against {awake:?}");
        assert!(slept.0 > 1000 && awake.0 == 0, "{levels}: nothing slept");
        let off = [0, 1, 2].map(|d| slept.1[d] - awake.1[d]);
        within(&format!("{levels:?}: impulse on the plate"), norm(off) / norm(awake.1), 0.02);
        within(&format!("{levels:?}: mean height of the ground, in cells"), (slept.2 - awake.2).abs() / CELL, 2e-3);
    }
}

/// Symptom: ground whose support goes away hangs in the air asleep. Physics: it falls as it would have.
#[test]
fn ground_asleep_falls_when_its_support_goes() {
    let cells = [24, 12, 10];
    let side = cells.map(|n| CELL * f64::from(n));
    let [slept, awake] = ["on = true\nspeed = 5e-3", "on = false"].map(|sleep| {
        let mut s = simulation(&gated(cells, [0.8, 0.9], sleep, &[]), Precision::F32);
        run_to(&mut s, 0.8);
        let most = asleep(&s);
        run_to(&mut s, 1.5);
        let reach = rows(&s).iter().map(|r| r.x[0]).collect::<Vec<_>>();
        (most, reach.iter().sum::<f64>() / reach.len() as f64, asleep(&s))
    });
    println!("{slept:?} against {awake:?}");
    assert!(slept.0 > 1000 && awake.1 > 0.52 * side[0], "nothing slept, or nothing fell");
    within("mean place of the sand, over how far it went", (slept.1 - awake.1).abs() / (awake.1 - 0.5 * side[0]), 0.02);
}

/// Who sleeps is part of the state: same bits with any number of threads, and after a resume.
#[test]
fn sleeping_is_deterministic_and_survives_a_snapshot() {
    let cells = [48, 24, 8];
    let levels = "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\n".to_owned();
    let text = bed(cells, "sand", SAND, "on = true\nspeed = 1e-3", &[levels, plate(cells, 0.15)]);
    let run = |threads: usize, save: Option<&std::path::Path>| {
        let options = Options { threads, ..Options::default() };
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        run_to(&mut s, 0.2);
        assert!((1..s.particle_count() as u64).contains(&asleep(&s)), "all or nothing sleeps");
        if let Some(path) = save {
            s.save(path).unwrap();
            s = Simulation::resume(&barchan::registry(), path, &options).unwrap();
        }
        run_to(&mut s, 0.5);
        format!("{:?}", s.particles())
    };
    let folder = tempfile::tempdir().unwrap();
    let whole = run(1, None);
    assert!(whole == run(3, None), "three threads differ from one");
    assert!(whole == run(2, Some(&folder.path().join("asleep.barchan"))), "a resumed run differs");
}

/// Asked to sleep where nothing says what is slow, or where walls have to look at each node, a scene is refused; otherwise it
/// stays awake by itself. Velocities given from outside wake ground too.
#[test]
fn what_may_not_sleep_stays_awake() {
    let falling = |head: Head<'_>, sleep: &str| {
        head.with(&[
            format!("[sleep]\n{sleep}\n"),
            material("sand", 1000.0, SAND),
            block("sand", [0.0; 3], [0.2, 0.2, 0.1], ""),
        ])
    };
    let refused = |text: &str| {
        barchan::Scene::from_str(text, "test scene", std::path::Path::new("."))
            .expect_err("must be refused")
            .to_string()
    };
    let error = refused(&falling(Head::space(CELL), "on = true"));
    assert!(error.contains("sleep.on") && error.contains("sleep.speed"), "{error}");
    let separate = "z_min = { separate = { friction = 0.3 } }";
    let error = refused(&falling(Head::cells(CELL, [10, 10, 10], separate), "on = true"));
    assert!(error.contains("sleep.on") && error.contains("slip or stick"), "{error}");
    let error = refused(&falling(Head::space(CELL), "speed = 0.0"));
    assert!(error.contains("sleep.speed"), "{error}");
    for head in [Head::space(CELL), Head::cells(CELL, [10, 10, 10], separate)] {
        let mut s = simulation(&falling(head, ""), Precision::F32);
        (0..70).for_each(|_| drop(s.step().unwrap()));
        assert_eq!(asleep(&s), 0);
    }
}

/// Symptom: up to 2 % of the momentum that was exchanged is in no book where ground sleeps beside ground that still moves a little, most where levels take steps
/// of their own, in the middle of which some falls asleep. Physics: what ground asleep takes from its neighbours, and what gravity does not give it, is booked.
#[test]
fn momentum_is_closed_beside_ground_asleep() {
    let thrown = |cells: [u32; 3], more: &str| {
        let side = cells.map(|n| CELL * f64::from(n));
        let block =
            block("hencky", [0.06, 0.08, side[2] + 0.02], [0.18, 0.16, side[2] + 0.1], "velocity = [0.8, 0.1, -0.8]");
        let eye = tool("eye", [0.12, 0.12, side[2] + 0.3], "sphere = { radius = 0.02 }", "\"slip\"", "\"fixed\"");
        let parameters = "young_modulus = 5e4, poisson_ratio = 0.3";
        bed(cells, "hencky", parameters, "speed = 0.3", &[block, eye, more.to_owned()])
    };
    let levels = "[levels]\ncount = 2\nhalf = 8\nagents = [\"eye\"]\n";
    let subcycled = format!("{levels}subcycle = true\n");
    for (cells, more) in [([24, 12, 8], ""), ([64, 24, 16], levels), ([64, 24, 16], &subcycled)] {
        let mut s = simulation(&thrown(cells, more), Precision::F64);
        let (start, mut given, mut most) = (s.ledger(), [0.0; 3], 0u64);
        for _ in 0..400 {
            let report = s.step().unwrap();
            let wrenches = report.wrenches.unwrap_or_else(|| s.wrenches());
            wrenches.iter().for_each(|w| (0..3).for_each(|d| given[d] += w.force[d] * report.dt));
            most = most.max(asleep(&s));
        }
        let end = s.ledger();
        let of = |ledger: &Ledger, d: usize| {
            ledger.momentum[d] - ledger.gravity_impulse[d] - ledger.wall_impulse[d] + ledger.slept_momentum[d]
        };
        let open: [f64; 3] = std::array::from_fn(|d| of(&end, d) - of(&start, d) + given[d]);
        println!("{more:?}: {most} of {} asleep, {:?} taken by them", s.particle_count(), end.slept_momentum);
        assert!(most > 1000 && norm(end.slept_momentum) > 1e-5 * norm(end.gravity_impulse), "hardly anything slept");
        within("momentum that is open, over what gravity gave", norm(open) / norm(end.gravity_impulse), 1e-10);
    }
}
