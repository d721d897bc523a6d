//! What others build onto Barchan: a coupling, a backend and a task, each a crate that depends on the facade alone. (A material
//! of one's own is `materials/template`; `plugins.rs` loads it.)

use barchan::{Error, Options, Precision, Registry, Simulation};
use barchan_tests::scenes::{options, rows, scene};
use barchan_tests::sketch::{Head, block, half, material, tool};

/// The built-ins, and the example crates of this folder's `seams`.
fn registry() -> Registry {
    let mut registry = barchan::registry();
    barchan_seam_coupling::register(&mut registry).unwrap();
    barchan_seam_backend::register(&mut registry).unwrap();
    barchan_seam_task::register(&mut registry).unwrap();
    registry
}

fn cube(more: &str) -> [String; 2] {
    [material("neo_hookean", 1000.0, "young_modulus = 1e4"), block("neo_hookean", [-0.2; 3], [0.2; 3], more)]
}

/// Every name that a scene or a user can get wrong is answered with the names there are, the newcomers among them: a plugin that
/// registers but cannot be found again would be of no use.
#[test]
fn unknown_names_are_answered_with_the_known_ones() {
    let registry = registry();
    let head = Head::space(0.1);
    let text = head.with(&[cube("").concat(), "[[coupling]]\nkind = \"magnet\"\n".to_owned()]);
    let error = Simulation::new(&registry, &scene(&text), &Options::default()).unwrap_err().to_string();
    println!("{error}");
    assert!(
        error.contains("coupling[0].kind: no coupling is called 'magnet'; known are: current, rigid, rollers"),
        "{error}"
    );

    let text = head.with(&cube("")).replace("law = \"neo_hookean\"", "law = \"granite\"");
    let error = Simulation::new(&registry, &scene(&text), &Options::default()).unwrap_err().to_string();
    println!("{error}");
    assert!(
        error.contains("material[0].law: no material is called 'granite'; known are: fixed_corotated, hencky"),
        "{error}"
    );

    let abacus = Options { backend: "abacus".to_owned(), ..Options::default() };
    let error = Simulation::new(&registry, &scene(&head.with(&cube(""))), &abacus).unwrap_err().to_string();
    println!("{error}");
    assert!(error.contains("no backend is called 'abacus'; known are: cpu, dust"), "{error}");

    let error = registry.task("knit").err().expect("there is no such task").to_string();
    println!("{error}");
    assert!(error.contains("no task is called 'knit'; known are: ") && error.contains("push"), "{error}");

    // And a name can be taken only once.
    let mut twice = registry.clone();
    for result in [
        barchan_seam_coupling::register(&mut twice),
        barchan_seam_backend::register(&mut twice),
        barchan_seam_task::register(&mut twice),
    ] {
        assert!(matches!(result, Err(Error::Duplicate { .. })), "{result:?}");
    }
}

/// A coupling from outside is handed every node once, its velocities count, and what it books is what the ground gains. A block
/// in free space that a current of rate k drags along without deforming it approaches the current as (1 + k dt)^-n, exactly;
/// a node handed over twice, or left out, would change that or tear the block.
#[test]
fn a_coupling_from_outside_acts_on_every_node_once() {
    let current = "[[coupling]]\nkind = \"current\"\nparameters = { rate = 5, x = 1, y = -0.5 }\n".to_owned();
    let (steps, dt, rate) = (100, 2e-3, 5.0);
    for (precision, tolerance) in [(Precision::F64, 1e-12), (Precision::F32, 1e-5)] {
        let text = Head::space(0.1)
            .time(format!("step = {dt}"))
            .with(&[cube("sampling = \"jitter\"").concat(), current.clone()]);
        let mut s = Simulation::new(&registry(), &scene(&text), &options(precision)).unwrap();
        let before = s.ledger();
        let mut booked = [0.0; 3];
        for _ in 0..steps {
            s.step().unwrap();
            for d in 0..3 {
                booked[d] -= s.wrenches()[0].force[d] * dt;
            }
        }
        let after = s.ledger();
        let share = 1.0 - (1.0 + rate * dt).powi(-steps);
        let (mut speed, mut balance) = (0f64, 0f64);
        for row in rows(&s) {
            for (v, w) in row.v.iter().zip([1.0, -0.5, 0.0]) {
                speed = speed.max((v - share * w).abs());
            }
        }
        for d in 0..3 {
            balance = balance.max((after.momentum[d] - before.momentum[d] - booked[d]).abs() / after.mass);
        }
        println!(
            "{precision}: velocity off by {speed:.1e} m/s, booked impulse by {balance:.1e} m/s, tolerance {tolerance:.0e}"
        );
        assert!(speed < tolerance && balance < tolerance);
        let contact = s.timings().into_iter().find(|t| t.effect == "contact").expect("a pass");
        assert_eq!(contact.passes, steps as u64);
        assert!(s.plan().effects.iter().any(|e| e.name == "coupling current"), "{}", s.plan());
    }
    // Its own parameters are its own to check, with the scene's line and key.
    let text = Head::space(0.1).with(&[cube("").concat(), current.replace("rate = 5", "rates = 5")]);
    let error = Simulation::new(&registry(), &scene(&text), &Options::default()).unwrap_err().to_string();
    println!("{error}");
    assert!(
        error.contains(
            "coupling[0].parameters.rates: coupling 'current' has no parameter `rates`; it has rate, x, y, z, host"
        ),
        "{error}"
    );
}

/// Bodies of a coupling from outside grip the ground by the law that all share: rollers on either side draw a block down between them, evenly, no faster
/// than their surfaces, and feel what it gains. With a current besides, whichever stands first in the scene, the field acts before the bodies do.
#[test]
fn bodies_from_outside_grip_the_ground() {
    let rollers = "[[coupling]]\nkind = \"rollers\"\nparameters = { radius = 0.3, gap = 0.3, z = 0.1, rate = 2, friction = 0.4 }\n";
    let current = "[[coupling]]\nkind = \"current\"\nparameters = { rate = 5, y = 1 }\n";
    let (steps, dt) = (100, 1e-3);
    let run = |couplings: &[&str]| {
        let text = Head::space(0.05).time(format!("step = {dt}")).with(&[cube("").concat(), couplings.concat()]);
        let mut s = Simulation::new(&registry(), &scene(&text), &options(Precision::F64)).unwrap();
        let before = s.ledger();
        let mut booked = vec![[0.0; 3]; s.wrenches().len()];
        for _ in 0..steps {
            s.step().unwrap();
            for (booked, wrench) in booked.iter_mut().zip(s.wrenches()) {
                (0..3).for_each(|d| booked[d] += wrench.force[d] * dt);
            }
        }
        let after = s.ledger();
        let gained: [f64; 3] = std::array::from_fn(|d| after.momentum[d] - before.momentum[d]);
        let missing = (0..3).map(|d| gained[d] + booked.iter().map(|one| one[d]).sum::<f64>());
        let missing = missing.fold(0.0, |most: f64, x| most.max(x.abs())) / after.mass;
        println!("{couplings:?}: gained {gained:?} N s, booked {booked:?}, missing {missing:.1e} m/s");
        assert!(missing < 1e-12, "what is booked is not what the ground gains");
        (gained, booked, after.mass, rows(&s))
    };
    let (gained, booked, mass, _) = run(&[rollers]);
    let surface = 2.0 * 0.3;
    assert!(gained[2] < -0.05 * mass * surface && gained[2] > -mass * surface, "{gained:?}");
    assert!(gained[0].abs() < 1e-9 * mass && (booked[0][2] / booked[1][2] - 1.0).abs() < 1e-6, "{booked:?}");
    assert!(booked[0][0] < 0.0 && booked[1][0] > 0.0, "the block pushes them apart: {booked:?}");
    // Fields act first, whatever the order.
    let (one, other) = (run(&[rollers, current]), run(&[current, rollers]));
    assert!(one.0[1] > 0.1 * mass * (1.0 - (1.0f64 + 5.0 * dt).powi(-steps)), "{:?}", one.0);
    let apart = one.3.iter().zip(&other.3).flat_map(|(a, b)| (0..3).map(|d| (a.x[d] - b.x[d]).abs()));
    assert!(apart.fold(0.0, f64::max) == 0.0, "their order in the scene matters");
}

/// A backend from outside runs a plan, takes over another's run in its middle, and is refused by name where it lacks a stage.
/// In free flight without strain both agree to rounding, and both follow the symplectic Euler parabola
/// x = x0 + v0 t + g t (t + dt) / 2.
#[test]
fn a_backend_from_outside_takes_over_a_run() {
    let (dt, v) = (2e-3, [0.7, -0.3, 1.1]);
    let head = Head { gravity: [0.0, 0.2, -9.81], ..Head::space(0.1).time(format!("step = {dt}")) };
    let text = head.with(&cube(&format!("velocity = {v:?}")));
    let cpu = options(Precision::F64);
    let dust = Options { backend: "dust".to_owned(), ..cpu.clone() };
    let mut first = Simulation::new(&registry(), &scene(&text), &cpu).unwrap();
    let start = rows(&first);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("flight.snapshot");
    for _ in 0..40 {
        first.step().unwrap();
    }
    first.save(&file).unwrap();
    let mut taken = Simulation::resume(&registry(), &file, &dust).unwrap();
    for _ in 0..60 {
        first.step().unwrap();
        taken.step().unwrap();
    }
    assert_eq!(taken.timings()[0].effect, "flight");
    let t = 100.0 * dt;
    let (mut apart, mut off) = (0f64, 0f64);
    for ((a, b), s) in rows(&first).iter().zip(&rows(&taken)).zip(&start) {
        for d in 0..3 {
            let x = s.x[d] + v[d] * t + 0.5 * head.gravity[d] * t * (t + dt);
            apart = apart.max((a.x[d] - b.x[d]).abs());
            off = off.max((b.x[d] - x).abs());
        }
    }
    println!("cpu and dust are {apart:.1e} m apart, dust {off:.1e} m off the parabola, tolerance 1e-12");
    assert!(apart < 1e-12 && off < 1e-12);

    let plate = tool("plate", [0.0, 0.0, -1.0], &half([0.2; 3]), "\"slip\"", "\"fixed\"");
    let text = head.with(&[cube("").concat(), plate]);
    let error = Simulation::new(&registry(), &scene(&text), &dust).unwrap_err().to_string();
    println!("{error}");
    assert!(error.contains("backend 'dust' (registered) has no forward form of the stage 'contact'"), "{error}");
}

/// A task from outside is found by name, resets and steps, and pays for what happened: the rewards add up to the cube's way.
#[test]
fn a_task_from_outside_is_played_to_its_end() {
    let registry = registry();
    let mut task = registry.task("push").unwrap();
    let mut s = Simulation::new(&registry, &task.scene().unwrap(), &options(Precision::F32)).unwrap();
    let first = task.reset(&mut s, 0).unwrap();
    assert_eq!(first.len(), task.observation_size());
    let (mut rewards, mut actions) = (0.0, 0);
    let last = loop {
        let step = task.step(&mut s, &vec![0.6; task.action_size()]).unwrap();
        rewards += step.reward;
        actions += 1;
        if step.terminated || step.truncated {
            break step;
        }
    };
    let moved = last.observation[1] - first[1];
    println!(
        "cube pushed by {moved:.3} m in {actions} actions, goal 0.1 m; rewards are {:.1e} m off",
        (rewards - moved).abs()
    );
    assert!(last.terminated && !last.truncated && moved >= 0.1, "{last:?}");
    assert!((rewards - moved).abs() < 1e-12);
    let error = task.step(&mut s, &[0.0, 1.0]).unwrap_err().to_string();
    assert!(error.contains("an action has 2 numbers; give one"), "{error}");
}
