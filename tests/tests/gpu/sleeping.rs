//! Ground at rest that is left out of the step, as in `suite/sleeping.rs`.

use super::{apart, gpu, left, on, on_gpu, take};
use barchan::worlds::Worlds;
use barchan::{Ledger, Options, Precision, Scene, Simulation, Vec3};
use barchan_tests::scenes::{alter, norm, rows, run_to, scene, within};
use barchan_tests::sketch::{driven, half, tool};
use barchan_tests::sleeping::{ADRIFT, CELL, SAND, adrift, asleep, bed, eased, gated, plate};

const LEVELS: &str = "[levels]\ncount = 2\nhalf = 8\n";
const SUBCYCLED: &str = "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\n";

/// Settled ground is all asleep after its fifty steps; then nothing in it changes by a bit, and nothing is booked. What it took to fall asleep is
/// next to nothing, and what gravity has given it until then is what it gives on the CPU.
#[test]
fn settled_ground_sleeps_and_does_not_change() {
    let text = bed([16, 8, 6], "sand", SAND, "speed = 5e-4", &[]);
    let (mut gpu, mut cpu) = (gpu(&text), on("cpu", Precision::F32, &text));
    take(&mut gpu, 160);
    take(&mut cpu, 160);
    let (before, booked) = (rows(&gpu), gpu.ledger());
    assert_eq!([asleep(&gpu), asleep(&cpu)], [gpu.particle_count() as u64; 2]);
    while gpu.step_count() < 260 {
        gpu.steps(40, f64::INFINITY).unwrap();
    }
    assert!(rows(&gpu) == before, "something has changed in its sleep");
    let (g, c) = (gpu.ledger(), cpu.ledger());
    assert!(g.kinetic == 0.0 && g.slept_kinetic > 0.0 && g.slept_kinetic < 1e-6, "{:e} J", g.slept_kinetic);
    assert_eq!(g.counts["blocks that fell asleep"], c.counts["blocks that fell asleep"]);
    assert_eq!(booked.wall_impulse, g.wall_impulse);
    let all = c.gravity_impulse[2].abs();
    within("gravity's impulse on ground awake", (g.gravity_impulse[2] - c.gravity_impulse[2]).abs() / all, 1e-4);
    within("momentum that was lost", norm(g.slept_momentum) / all, 1e-4);
}

/// Nothing sleeps while gravity grows, however slowly it moves; see `suite/sleeping.rs`.
#[test]
fn ground_stays_awake_while_gravity_grows() {
    let mut s = gpu(&eased());
    while s.step_count() < 240 {
        s.steps(40, f64::INFINITY).unwrap();
    }
    assert_eq!(asleep(&s), 0);
}

/// What falls does not sleep in the air, however slow it is; see `suite/sleeping.rs`.
#[test]
fn what_falls_does_not_sleep_in_the_air() {
    let [rises, gravity] = ADRIFT;
    let mut s = gpu(&adrift());
    while s.step_count() < 400 {
        s.steps(40, f64::INFINITY).unwrap();
    }
    let falls = rises + gravity * s.time();
    let off = rows(&s).iter().map(|row| (row.v[2] / falls - 1.0).abs()).fold(0.0, f64::max);
    within("velocity over that of free fall, less 1", off, 1e-3);
    assert_eq!(asleep(&s), 0);
}

/// Symptom: a wave is swallowed, or late, where the ground it comes to has been asleep. Physics: it passes as if nothing had slept.
#[test]
fn a_pulse_passes_through_ground_asleep() {
    const LENGTH: u32 = 48;
    let [slept, awake] = ["on = true\nspeed = 5e-4", "on = false"].map(|sleep| {
        let law = ("neo_hookean", "young_modulus = 1e5, poisson_ratio = 0.2");
        let mut s = gpu(&bed([LENGTH, 4, 4], law.0, law.1, sleep, &[]));
        take(&mut s, 120);
        let asleep = asleep(&s);
        let begun = s.time();
        alter(&mut s, |row| {
            let x = row.x[0] / 0.16;
            row.v[0] += if x < 1.0 { 0.05 * (1.0 + (std::f64::consts::PI * x).cos()) } else { 0.0 };
        });
        let (mut peak, mut when) = (0.0, 0.0);
        let gauge = 0.6..0.68;
        while s.time() < begun + 0.085 {
            s.step().unwrap();
            let far: Vec<f64> = rows(&s).iter().filter(|r| gauge.contains(&r.x[0])).map(|r| r.v[0]).collect();
            let mean = far.iter().sum::<f64>() / far.len() as f64;
            if mean > peak {
                (peak, when) = (mean, s.time() - begun);
            }
        }
        (asleep, peak, when)
    });
    println!("{slept:?} against {awake:?}");
    assert!(slept.0 == u64::from(LENGTH) * 16 * 8 && awake.0 == 0 && awake.1 > 2e-3, "nothing slept, or no pulse came");
    within("amplitude", (slept.1 / awake.1 - 1.0).abs(), 0.02);
    within("delay over the time it took", (slept.2 / awake.2 - 1.0).abs(), 0.01);
}

/// Symptom: a tool meets ground asleep as if it were rock, or sinks into it as if it were air. Physics: its force, and how the ground then lies, are those of
/// ground that never slept, on the CPU; on one level, on several, and with steps of their own.
#[test]
fn a_tool_finds_ground_asleep_as_it_would_awake() {
    for levels in ["", LEVELS, SUBCYCLED] {
        let cells = if levels.is_empty() { [32, 8, 6] } else { [48, 8, 8] };
        let [slept, awake] = [("wgpu", "on = true\nspeed = 1e-3"), ("cpu", "on = false")].map(|(backend, sleep)| {
            let text = bed(cells, "sand", SAND, sleep, &[levels.to_owned(), plate(cells, 0.15)]);
            let mut s = on(backend, Precision::F32, &text);
            let mut impulse = [0.0; 3];
            let (mut most, mut surface) = (0, 0.0);
            while s.time() < 0.32 {
                for report in s.steps(16, 0.32).unwrap_or_else(|e| panic!("{e}")) {
                    let wrenches = report.wrenches.unwrap_or_else(|| s.wrenches());
                    let force = wrenches[0].force;
                    (0..3).for_each(|d| impulse[d] += force[d] * report.dt);
                }
                if s.time() < 0.2 {
                    most = asleep(&s).max(most);
                }
            }
            let all = rows(&s);
            all.iter().for_each(|r| surface += r.m * r.x[2]);
            (most, impulse, surface / all.iter().map(|r| r.m).sum::<f64>(), asleep(&s))
        });
        println!("{levels:?}: {slept:?} against {awake:?}");
        assert!(slept.0 > 500 && awake.0 == 0, "{levels}: nothing slept");
        let off = [0, 1, 2].map(|d| slept.1[d] - awake.1[d]);
        within(&format!("{levels:?}: impulse on the plate"), norm(off) / norm(awake.1), 0.02);
        within(&format!("{levels:?}: mean height of the ground, in cells"), (slept.2 - awake.2).abs() / CELL, 2e-3);
    }
}

/// Symptom: ground that was refined or coarsened in its sleep is not what it would be awake. A tool flies over settled ground without touching it,
/// and levels follow it: what is split and merged stirs, comes to rest, and lies where it would lie awake.
#[test]
fn levels_pass_over_ground_asleep() {
    let cells = [64, 4, 8];
    for levels in [LEVELS, SUBCYCLED] {
        let over = tool("eye", [0.1, 0.04, 0.3], &half([0.02; 3]), "\"slip\"", &driven([2.5, 0.0, 0.0]));
        let [slept, awake] = ["speed = 2e-3", "on = false"].map(|sleep| {
            let text = bed(cells, "sand", SAND, sleep, &[levels.to_owned(), over.clone()]);
            let mut s = gpu(&text);
            let (mut least, mut most) = (u64::MAX, 0);
            while s.time() < 0.36 {
                s.steps(32, 0.36).unwrap_or_else(|e| panic!("{e}"));
                if s.step_count() > 60 {
                    (least, most) = (asleep(&s).min(least), asleep(&s).max(most));
                }
            }
            let all = rows(&s);
            let mass: f64 = all.iter().map(|r| r.m).sum();
            let mean = [0, 1, 2].map(|d| all.iter().map(|r| r.m * r.x[d]).sum::<f64>() / mass);
            (s.ledger().counts, [least, most], mass, mean)
        });
        println!("{levels:?}: {slept:?} against {awake:?}");
        let (counts, [least, most], mass, mean) = slept;
        assert!(counts["particles split"] > 0 && counts["particles merged"] > 0, "{levels}: levels did not move");
        assert!(least > 0 && awake.1 == [0, 0], "{levels}: nothing slept");
        // Of settled ground, blocks of coarse cells have 8³ particles, of which half are in this bed.
        assert!(256 * counts["blocks that fell asleep"] > most, "{levels}: what has stirred never slept again");
        within("mass", (mass / awake.2 - 1.0).abs(), 1e-12);
        within("mean place, in cells", norm([0, 1, 2].map(|d| mean[d] - awake.3[d])) / CELL, 2e-4);
    }
}

/// Symptom: ground whose support goes away hangs in the air asleep. Physics: it falls as it would have. Where a free ball beside it calls for
/// contact on the host, too.
#[test]
fn ground_asleep_falls_when_its_support_goes() {
    let cells = [16, 4, 8];
    let side = cells.map(|n| CELL * f64::from(n));
    let ball = |z: f64| {
        let motion = "{ free = { mass = 1.0 } }";
        tool("ball", [0.6, 0.5 * side[1], z], "sphere = { radius = 0.02 }", "\"slip\"", motion)
    };
    for more in [vec![], vec![ball(0.4)]] {
        let [slept, awake] = [("wgpu", "on = true\nspeed = 1e-2"), ("cpu", "on = false")].map(|(backend, sleep)| {
            let mut s = on(backend, Precision::F32, &gated(cells, [0.15, 0.2], sleep, &more));
            run_to(&mut s, 0.15);
            let most = asleep(&s);
            run_to(&mut s, 0.6);
            let reach = rows(&s).iter().map(|r| r.x[0]).collect::<Vec<_>>();
            (most, reach.iter().sum::<f64>() / reach.len() as f64)
        });
        println!("{slept:?} against {awake:?}");
        assert!(slept.0 > 1000 && awake.1 > 0.52 * side[0], "nothing slept, or nothing fell");
        let fallen = awake.1 - 0.5 * side[0];
        within("mean place of the sand, over how far it went", (slept.1 - awake.1).abs() / fallen, 0.02);
    }
}

/// Probes are right where ground sleeps: what crosses a section once sand falls is what would have crossed it awake, on the CPU, and what parts of walls take adds up to
/// what the ledger says of walls. On one level, on several, and with steps of their own.
#[test]
fn probes_see_ground_that_sleeps_and_wakes() {
    let sides = ["x_min", "x_max", "y_min", "y_max", "z_min"];
    let walls: String =
        sides.map(|side| format!("[[probe]]\nname = \"{side}\"\nwall = {{ side = \"{side}\" }}\n")).concat();
    for levels in ["", LEVELS, SUBCYCLED] {
        let cells = if levels.is_empty() { [16, 4, 8] } else { [48, 8, 8] };
        let at = CELL * f64::from(cells[0]) - 0.04;
        let section = format!(
            "[[probe]]\nname = \"out\"\nflux = {{ rectangle = {{ min = [{at:?}, -1, -1], max = [{at:?}, 1, 1] }} }}\n"
        );
        let [slept, awake] = [("wgpu", "on = true\nspeed = 1e-2"), ("cpu", "on = false")].map(|(backend, sleep)| {
            let more = [levels.to_owned(), section.clone(), walls.clone()];
            let mut s = on(backend, Precision::F32, &gated(cells, [0.15, 0.2], sleep, &more));
            run_to(&mut s, 0.15);
            let most = asleep(&s);
            run_to(&mut s, 0.5);
            let given = s.ledger().wall_impulse;
            for d in 0..3 {
                let sum: f64 = s.pressed().iter().map(|one| one[d]).sum();
                let what = format!("{backend} {levels:?}: all walls, axis {d}");
                within(&what, (sum + given[d]).abs(), 5e-6 * norm(given));
            }
            (most, s.crossed().unwrap()[0].mass)
        });
        println!("{levels:?}: {slept:?} against {awake:?}");
        assert!(slept.0 > 500 && awake.1[0] > 0.15, "{levels}: nothing slept, or nothing crossed");
        // Rows of particles across the world cross together, a gram each.
        let row = 2e-3 * f64::from(cells[1]);
        within(&format!("{levels:?}: mass that crossed [kg]"), (slept.1[0] - awake.1[0]).abs(), 1.01 * row);
    }
}

/// A settled bed on one end of which a blade comes down, and perhaps a cube, once it sleeps; worlds differ in how fast the blade is.
fn struck(world: u64, levels: &str, cube: bool) -> Scene {
    let cells = if levels.is_empty() { [40, 4, 4] } else { [80, 4, 8] };
    let top = CELL * f64::from(cells[2]);
    let down = [0.3, 0.0, -0.5 - 0.05 * world as f64];
    let at = [0.06, 0.04, top + 0.075];
    let mut more = vec![
        levels.to_owned(),
        tool("blade", at, &half([0.02, 0.03, 0.05]), "{ coulomb = { friction = 0.4 } }", &driven(down)),
    ];
    if cube {
        let free = "{ free = { mass = 0.1, linear = [0.0, 0.0, -0.5] } }";
        let at = [0.14, 0.04, top + 0.055];
        more.push(tool("cube", at, &half([0.03; 3]), "{ coulomb = { friction = 0.3 } }", free));
    }
    scene(&bed(cells, "sand", SAND, "speed = 3e-3", &more).replace("safety = 0.6", "step = 8e-4"))
}

const KINDS: [(&str, bool); 3] = [("", false), (LEVELS, false), (SUBCYCLED, true)];

/// The same ground sleeps as on the CPU, all along, while a blade and a cube wake it; and it costs the same.
#[test]
fn the_same_ground_sleeps_as_on_the_cpu() {
    for (levels, cube) in KINDS {
        let [mut gpu, mut cpu] = ["wgpu", "cpu"].map(|backend| {
            let options = Options { backend: backend.into(), ..on_gpu() };
            Simulation::new(&barchan::registry(), &struck(0, levels, cube), &options).unwrap()
        });
        let (mut before, mut woke) = (0, false);
        for _ in 0..28 {
            take(&mut gpu, 5);
            take(&mut cpu, 5);
            assert_eq!(asleep(&gpu), asleep(&cpu), "{levels}: after {} steps", gpu.step_count());
            woke |= asleep(&gpu) < before;
            before = asleep(&gpu);
        }
        assert!(woke, "{levels}: nothing fell asleep and woke");
        let (g, c) = (gpu.ledger(), cpu.ledger());
        assert_eq!(g.counts["blocks that fell asleep"], c.counts["blocks that fell asleep"]);
        within("kinetic energy that was lost", (g.slept_kinetic / c.slept_kinetic - 1.0).abs(), 0.1);
        let off = |f: fn(&Ledger) -> Vec3| norm([0, 1, 2].map(|d| f(&g)[d] - f(&c)[d])) / norm(c.gravity_impulse);
        // The device does not book what ground asleep takes from nodes that it shares with ground awake.
        within("momentum that was lost, over what gravity gave", off(|ledger| ledger.slept_momentum), 2e-2);
        within("what gravity gave", off(|ledger| ledger.gravity_impulse), 1e-4);
        within("what walls gave, over what gravity gave", off(|ledger| ledger.wall_impulse), 1e-2);
    }
}

/// Who sleeps is each world's own affair, and it does not matter how steps are cut into submissions: worlds of a batch, of which one is reset in
/// the middle, are what they are alone, step by step. On one level, on two, and with steps of their own and a free cube.
#[test]
fn a_world_of_a_batch_sleeps_as_it_does_alone_bit_for_bit() {
    const AT_ONCE: usize = 32;
    for (levels, cube) in KINDS {
        let scenes = (0..2).map(|w| struck(w, levels, cube)).collect();
        let mut worlds = Worlds::new(&barchan::registry(), scenes, &on_gpu()).unwrap();
        assert!(worlds.are_together());
        for round in 0..3 {
            for (w, reports) in worlds.steps(AT_ONCE).into_iter().enumerate() {
                assert_eq!(reports.unwrap_or_else(|e| panic!("world {w}: {e}")).len(), AT_ONCE);
            }
            if round == 0 {
                worlds.reset(1, None).unwrap();
            }
        }
        for w in 0..2 {
            let world = worlds.world(w);
            println!("{levels:?}, world {w}: {} of {} asleep", asleep(world), world.particle_count());
            assert!((1..world.particle_count() as u64).contains(&asleep(world)), "all or nothing sleeps");
            let mut alone = Simulation::new(&barchan::registry(), &struck(w as u64, levels, cube), &on_gpu()).unwrap();
            take(&mut alone, if w == 1 { 2 } else { 3 } * AT_ONCE);
            assert!(left(world) == left(&alone), "world {w} is not itself alone");
        }
    }
}

/// Who sleeps is part of a snapshot: a run goes on with the same ground asleep and to the same places, to what finding stress anew rounds off; and
/// on the CPU, where all are awake at first.
#[test]
fn sleeping_survives_a_snapshot() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("asleep.barchan");
    for (levels, cube) in KINDS {
        let mut s = Simulation::new(&barchan::registry(), &struck(0, levels, cube), &on_gpu()).unwrap();
        take(&mut s, 90);
        let (before, all) = (asleep(&s), s.particle_count() as u64);
        assert!((1..all).contains(&before), "{levels}: all or nothing sleeps");
        s.save(&file).unwrap();
        let resumed = |options: &Options| Simulation::resume(&barchan::registry(), &file, options).unwrap();
        let mut again = resumed(&on_gpu());
        assert!(again.particles() == s.particles(), "{levels}: a copy differs");
        let mut cpu = resumed(&Options { backend: "cpu".into(), ..on_gpu() });
        assert_eq!([asleep(&again), asleep(&cpu)], [before, 0]);
        take(&mut s, 30);
        take(&mut again, 30);
        assert!(s.particles().sort.unwrap().rest == again.particles().sort.unwrap().rest, "{levels}: others sleep");
        // Contact makes more of what is rounded off: 2.9e-5 cells found on lavapipe.
        within("distance of particles, in cells", apart(&rows(&s), &rows(&again)) / CELL, 5e-5);
        take(&mut cpu, 30);
        within("distance from the cpu's, in cells", apart(&rows(&s), &rows(&cpu)) / CELL, 0.01);
    }
}

/// Symptom guarded against: what ground asleep asks for costs bits where nobody sleeps. A speed that nothing is ever below gives what
/// `sleep.on = false` gives.
#[test]
fn ground_that_stays_awake_does_not_know_of_sleep() {
    for (levels, cube) in KINDS {
        let [may, may_not] = ["speed = 1e-30", "on = false"].map(|sleep| {
            let mut scene = struck(1, levels, cube);
            scene.sleep = self::scene(&bed([4; 3], "sand", SAND, sleep, &[])).sleep;
            let mut s = Simulation::new(&barchan::registry(), &scene, &on_gpu()).unwrap();
            take(&mut s, 70);
            assert_eq!(asleep(&s), 0);
            s.particles().lists
        });
        assert!(may == may_not, "{levels}: bits differ");
    }
}
