//! What others build onto Barchan: a coupling, a backend and a task, each a crate that depends on the facade alone. (A material
//! of one's own is `materials/template`; `plugins.rs` loads it.)

use barchan::environment::{Environment, Step};
use barchan::parameter::{Kind, Parameter, Range, Table};
use barchan::{Command, Cotangents, Error, Options, Precision, Registry, Scene, Simulation, Tape};
use barchan_tests::scenes::{Row, options, rows, scene};
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

/// An entry that calls for a current.
fn current(keys: &str, parameters: &str) -> String {
    format!("[[coupling]]\nkind = \"current\"\n{keys}\nparameters = {{ {parameters} }}\n")
}

fn refusal(registry: &Registry, text: &str) -> String {
    let made = Scene::from_str(text, "scene.toml", "").and_then(|s| Simulation::new(registry, &s, &Options::default()));
    let error = made.err().unwrap_or_else(|| panic!("accepted: {text}")).to_string();
    println!("{error}");
    error
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
        error.contains(
            "coupling[0].kind: no coupling is called 'magnet'; known are: brakes, current, dumbbell, rigid, robots, rollers"
        ),
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

    let error = registry.task("knit", &Table::new()).expect_err("there is no such task").to_string();
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
    let current = current("", "rate = 5, velocity = [1, -0.5, 0]");
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
            "coupling[0].parameters.rates: coupling 'current' has no parameter `rates`; it has rate, velocity, heading, heading_deg, field, spin, horizontal, record, host; did you mean `rate`?"
        ),
        "{error}"
    );
}

/// Bodies of a coupling from outside grip the ground by the law that all share: rollers on either side of a block that falls between them are pushed apart, drag it
/// the way they turn, evenly, and feel what it gains. With a current besides, whichever stands first in the scene, the field acts before the bodies do.
#[test]
fn bodies_from_outside_grip_the_ground() {
    let rollers = "[[coupling]]\nkind = \"rollers\"\nparameters = { radius = 0.3, gap = 0.3, z = 0.1, rate = 2, friction = 0.4 }\n";
    let current = "[[coupling]]\nkind = \"current\"\nparameters = { rate = 5, velocity = [0, 1, 0] }\n";
    let (steps, dt) = (100, 1e-3);
    let run = |couplings: &[&str]| {
        let text = Head::space(0.05)
            .time(format!("step = {dt}"))
            .with(&[cube("velocity = [0, 0, -0.3]").concat(), couplings.concat()]);
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
    let back = run(&[&rollers.replace("rate = 2", "rate = -2")]).0;
    assert!(back[2] - gained[2] > 0.02 * mass * 0.3, "{back:?} N s if they turn back, {gained:?}");
    assert!(gained[0].abs() < 1e-9 * mass && (booked[0][2] / booked[1][2] - 1.0).abs() < 1e-6, "{booked:?}");
    assert!(booked[0][0] < 0.0 && booked[1][0] > 0.0, "the block pushes them apart: {booked:?}");
    // Fields act first, whatever the order.
    let (one, other) = (run(&[rollers, current]), run(&[current, rollers]));
    assert!(one.0[1] > 0.1 * mass * (1.0 - (1.0f64 + 5.0 * dt).powi(-steps)), "{:?}", one.0);
    let apart = one.3.iter().zip(&other.3).flat_map(|(a, b)| (0..3).map(|d| (a.x[d] - b.x[d]).abs()));
    assert!(apart.fold(0.0, f64::max) == 0.0, "their order in the scene matters");
}

/// Gradients go through bodies of a coupling from outside that has what they need: by how fast rollers turn, where they are and how they rub, they are differences of runs. A coupling
/// that has not is refused by its name.
#[test]
fn gradients_go_through_bodies_from_outside() {
    let run = |rate: f64, friction: f64, x: f64| {
        let rollers = format!(
            "[[coupling]]\nkind = \"rollers\"\nparameters = {{ radius = 0.3, gap = 0.3, x = {x:?}, z = 0.1, rate = {rate:?}, friction = {friction:?} }}\n"
        );
        let text = Head::space(0.05).time("step = 1e-3").with(&[
            "[sleep]\non = false\n".to_owned(),
            cube("velocity = [0.1, 0, -0.3]").concat(),
            rollers,
        ]);
        let mut sim = Simulation::new(&registry(), &scene(&text), &options(Precision::F64)).unwrap();
        sim.record(&registry(), 0.015).unwrap_or_else(|e| panic!("{e}"))
    };
    let fallen = |tape: &Tape| tape.end().position.iter().map(|x| x[2] + 0.3 * x[0]).sum::<f64>();
    let tape = run(2.0, 0.4, 0.01);
    let mut loss = Cotangents::zero(tape.end().id.len());
    loss.position.fill([0.3, 0.0, 1.0]);
    let found = tape.pull_back(loss).unwrap_or_else(|e| panic!("{e}"));
    let both = |of: &dyn Fn(usize) -> f64| of(0) + of(1);
    // The right one turns the other way.
    let by_rate = found.bodies[0].angular[1] - found.bodies[1].angular[1];
    let by_friction = both(&|b| found.bodies[b].friction);
    let by_place = both(&|b| found.particles.bodies[b].pose.position[0]);
    for (what, given, step, at) in [
        ("rate", by_rate, 1e-3, &(|by: f64| run(2.0 + by, 0.4, 0.01)) as &dyn Fn(f64) -> Tape),
        ("friction", by_friction, 1e-4, &|by| run(2.0, 0.4 + by, 0.01)),
        ("place", by_place, 1e-6, &|by| run(2.0, 0.4, 0.01 + by)),
    ] {
        let difference = (fallen(&at(step)) - fallen(&at(-step))) / (2.0 * step);
        println!("{what}: {given:.8e} {difference:.8e}");
        assert!((given - difference).abs() < 1e-4 * difference.abs(), "{what}: {given} {difference}");
    }
    let current = current("", "rate = 5, velocity = [0, 1, 0]");
    let text = Head::space(0.05).with(&["[sleep]\non = false\n".to_owned(), cube("").concat(), current]);
    let mut sim = Simulation::new(&registry(), &scene(&text), &options(Precision::F64)).unwrap();
    let refusal = sim.record(&registry(), 0.01).unwrap_err().to_string();
    assert!(refusal.contains("coupling 'current' (registered) has no adjoint"), "{refusal}");
}

/// Each entry makes a coupling of its own: two currents act one after the other, u' = (u + k dt w) / (1 + k dt) for each, their wrenches and names are told
/// apart, and a run that is saved and gone on with has the bits of a whole one, so that each has kept its own state.
#[test]
fn every_entry_makes_a_coupling_of_its_own() {
    let (steps, dt, rates, velocities) = (60, 2e-3, [5.0, 20.0], [[1.0, -0.5, 0.0], [0.0, 0.25, 2.0]]);
    let entries = [
        current("name = \"upper\"", "rate = 5, velocity = [1, -0.5, 0]"),
        current("", "rate = 20, velocity = [0, 0.25, 2]"),
        current("", "rate = 1e-9"),
    ];
    let text = Head::space(0.1).time(format!("step = {dt}")).with(&[cube("").concat(), entries.concat()]);
    let (registry, f64s) = (registry(), options(Precision::F64));
    let mut s = Simulation::new(&registry, &scene(&text), &f64s).unwrap();
    let names = ["upper", "current", "current-2"];
    assert!(s.couplings().iter().map(|coupling| coupling.name()).eq(names));
    assert!(s.bodies().iter().map(|body| body.name.as_str()).eq(names));
    assert!(names.iter().all(|name| s.plan().effects.iter().any(|e| e.name == format!("coupling {name}"))));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("currents.snapshot");
    let (mut u, mass) = ([0.0; 3], s.ledger().mass);
    let (mut speed, mut felt) = (0f64, 0f64);
    for step in 0..steps {
        if step == steps / 2 {
            s.save(&file).unwrap();
        }
        s.step().unwrap();
        for (k, (rate, w)) in rates.into_iter().zip(velocities).enumerate() {
            for d in 0..3 {
                let next = (u[d] + rate * dt * w[d]) / (1.0 + rate * dt);
                felt = felt.max((s.wrenches()[k].force[d] + mass * (next - u[d]) / dt).abs() / mass);
                u[d] = next;
            }
        }
    }
    for row in rows(&s) {
        speed = (0..3).map(|d| (row.v[d] - u[d]).abs()).fold(speed, f64::max);
    }
    println!("velocity off by {speed:.1e} m/s, wrenches by {felt:.1e} N/kg, tolerances 1e-9 and 1e-7");
    assert!(speed < 1e-9 && felt < 1e-7);
    let mut resumed = Simulation::resume(&registry, &file, &f64s).unwrap();
    while resumed.step_count() < s.step_count() {
        resumed.step().unwrap();
    }
    assert!(resumed.particles() == s.particles() && resumed.wrenches() == s.wrenches());
}

/// Two things of one name could not be told apart: couplings, and bodies of whatever coupling.
#[test]
fn names_that_are_taken_are_refused() {
    let (registry, head) = (registry(), Head::space(0.1));
    let twice = [current("name = \"wind\"", "rate = 1"), current("name = \"wind\"", "rate = 2")].concat();
    let error = refusal(&registry, &head.with(&[cube("").concat(), twice]));
    assert!(
        error.contains("coupling[1].name: 'wind' is already the name of coupling[0]; names must differ"),
        "{error}"
    );
    let default = [current("", "rate = 1"), current("name = \"current\"", "rate = 2")].concat();
    let error = refusal(&registry, &head.with(&[cube("").concat(), default]));
    assert!(error.contains("coupling[1].name: 'current' is already the name of coupling[0]"), "{error}");
    let plate = tool("plate", [0.0, 0.0, -1.0], &half([0.2; 3]), "\"slip\"", "\"fixed\"");
    let as_tools = current("name = \"rigid\"", "rate = 1");
    let error = refusal(&registry, &head.with(&[cube("").concat(), plate.clone(), as_tools]));
    assert!(
        error.contains("coupling[0].name: 'rigid' is already the name of the coupling of the scene's tools"),
        "{error}"
    );
    let brakes = "[[coupling]]\nkind = \"brakes\"\n[[coupling.parameters.zone]]\nname = \"plate\"\ncenter = [0, 0, 0]\nhalf = [1, 1, 1]\nrate = 1\n";
    let error = refusal(&registry, &head.with(&[cube("").concat(), plate.clone(), brakes.to_owned()]));
    assert!(error.contains("coupling[0]: its body 'plate' bears the name of one of the coupling 'rigid'"), "{error}");
    // An entry of the tools' own kind is their coupling, under its name.
    let named = "[[coupling]]\nkind = \"rigid\"\nname = \"hands\"\n".to_owned();
    let text = head.with(&[cube("").concat(), plate, named]);
    let s = Simulation::new(&registry, &scene(&text), &Options::default()).unwrap();
    assert!(s.couplings().iter().map(|coupling| coupling.name()).eq(["hands"]));
}

/// What an entry says is held to what its kind declares before anything is made, with the scene's line and key.
#[test]
fn parameters_are_checked_with_line_and_key() {
    let (registry, head) = (registry(), Head::space(0.1));
    let zone = "zone = [{ name = \"a\", center = [0, 0, 0], half = [1, 1, 1], rate = 1 }, { name = \"b\", ";
    for (kind, parameters, says) in [
        (
            "current",
            "velocity = [1, 0, 0]",
            "parameters.rate: this key is required; coupling 'current' needs it: give a number in (0, inf) 1/s",
        ),
        ("current", "rate = -1", "parameters.rate: is -1; must be in (0, inf) 1/s"),
        ("current", "rate = inf", "parameters.rate: is inf; must be in (0, inf) 1/s"),
        ("current", "rate = \"fast\"", "parameters.rate: is the text \"fast\"; give a number in (0, inf) 1/s"),
        (
            "current",
            "rate = 1, velocity = [1, 0]",
            "parameters.velocity: has 2 entries; give an array of 3, each a number in (-inf, inf) m/s",
        ),
        (
            "current",
            "rate = 1, velocity = [1, 0, true]",
            "parameters.velocity[2]: is true; give a number in (-inf, inf) m/s",
        ),
        ("current", "rate = 1, heading = 1, heading_deg = 30", "parameters.heading_deg: gives heading a second time"),
        ("current", "rate = 1, rate_deg = 30", "parameters.rate_deg: coupling 'current' has no parameter `rate_deg`"),
        (
            "current",
            "rate = 1, field = \"swirl\"",
            "parameters.field: is \"swirl\"; must be one of uniform, whirl; did you mean `whirl`?",
        ),
        ("current", "rate = 1, horizontal = 1", "parameters.horizontal: is 1; give true or false"),
        (
            "current",
            "rate = 1, record = \"no.csv\"",
            "parameters.record: there is no file \"no.csv\"; give a file; paths start from",
        ),
        (
            "brakes",
            "",
            "parameters.zone: this key is required; coupling 'brakes' needs it: give an array of 1 to 64, each a table of",
        ),
        ("brakes", "zone = []", "parameters.zone: has 0 entries"),
        (
            "brakes",
            &format!("{zone} center = [0, 0, 0], half = [1, 1, 0], rate = 1 }}]"),
            "parameters.zone[1].half[2]: is 0; must be in (0, inf) m",
        ),
        (
            "brakes",
            &format!("{zone} center = [0, 0, 0], half = [1, 1, 1], rat = 1 }}]"),
            "parameters.zone[1].rat: coupling 'brakes' has no parameter `rat`; it has name, center, half, rate",
        ),
    ] {
        let text = head
            .with(&[cube("").concat(), format!("[[coupling]]\nkind = \"{kind}\"\nparameters = {{ {parameters} }}\n")]);
        let error = refusal(&registry, &text);
        assert!(error.contains(&format!("coupling[0].{says}")), "{says} is not in: {error}");
        let line = error.strip_prefix("scene.toml:").and_then(|rest| rest.split(':').next()?.parse::<usize>().ok());
        let entry = text.lines().position(|line| line == "[[coupling]]").unwrap() + 1;
        assert!(
            line.is_some_and(|line| (entry..entry + 3).contains(&line)),
            "the entry begins in line {entry}: {error}"
        );
    }
}

/// A plugin whose own declaration cannot be kept is refused when it registers, not when a scene meets it.
#[test]
fn declarations_are_held_to_the_rules() {
    let number = |name: &str| Parameter::number(name, "m", Range::POSITIVE, "A length.");
    let any = |of| Kind::Array { of: Box::new(of), count: 0..=1 };
    for (parameters, says) in [
        (vec![number("Length")], "it has a parameter named 'Length'; use snake_case"),
        (vec![number("length"), number("length")], "it declares parameter 'length' twice"),
        (vec![number("length").or(0.0)], "the default 0 of parameter 'length' is outside its range (0, inf)"),
        (vec![Parameter::switch("on", "Is it?").or("yes")], "of parameter 'on' is not true or false"),
        (vec![Parameter::text("kind", &["a", "b"], "Which?").or("c")], "is not one of the texts a, b"),
        (vec![Parameter::path("file", "Which?").or("data.csv")], "of parameter 'file' is not the path of a file"),
        (
            vec![Parameter::new("list", "", any(Kind::Table(vec![number("No")])), "Some.")],
            "parameter 'list': it has a parameter named 'No'",
        ),
    ] {
        let make = |_: &barchan::registries::CouplingSetup<'_>| -> barchan::Result<Box<dyn barchan::Coupling>> {
            unreachable!("it is refused before")
        };
        let error = Registry::new().add_coupling("odd", "Odd.", parameters, std::sync::Arc::new(make)).unwrap_err();
        assert!(error.to_string().contains(says) && error.to_string().contains("coupling 'odd'"), "{error}");
    }
}

/// Texts, switches, angles in degrees and tables reach a plugin as what they are, seen in what it does to the ground: a current that is turned by 90° drags
/// along y; one that leaves vertical motion alone lets the ground fall freely; a whirl turns it, L = (1 - (1 + k dt)^-n) Ω I about the middle; brakes slow
/// one of two blocks by (1 + k dt)^-n and leave the other alone.
#[test]
fn parameters_of_every_type_arrive() {
    let (steps, dt, rate) = (40, 1e-3, 5.0);
    let share: f64 = 1.0 - (1.0_f64 + rate * dt).powi(-steps);
    let run = |gravity: f64, bodies: String, entry: &str| {
        let head = Head { gravity: [0.0, 0.0, gravity], ..Head::space(0.1).time(format!("step = {dt}")) };
        let text = head.with(&[bodies, entry.to_owned()]);
        let mut s = Simulation::new(&registry(), &scene(&text), &options(Precision::F64)).unwrap();
        (0..steps).for_each(|_| drop(s.step().unwrap()));
        s
    };
    let mean = |s: &Simulation| s.ledger().momentum.map(|p| p / s.ledger().mass);
    let near = |what: &str, a: f64, b: f64, tolerance: f64| {
        println!("{what}: {a} against {b}, off by {:.1e}, tolerance {tolerance:.0e}", (a - b).abs());
        assert!((a - b).abs() < tolerance, "{what}");
    };
    let turned = run(0.0, cube("").concat(), &current("", "rate = 5, velocity = [1, 0, 0], heading_deg = 90"));
    let [vx, vy, _] = mean(&turned);
    near("turned, x", vx, 0.0, 1e-12);
    near("turned, y", vy, share, 1e-12);
    let falling = run(-9.81, cube("").concat(), &current("", "rate = 5, velocity = [1, 0, 3], horizontal = true"));
    let [vx, _, vz] = mean(&falling);
    near("horizontal, x", vx, share, 1e-12);
    near("horizontal, z", vz, -9.81 * dt * f64::from(steps), 1e-12);
    let whirl = run(0.0, cube("").concat(), &current("", "rate = 5, field = \"whirl\", spin = 0.5"));
    // Quadratic B-splines spread a particle over its nodes by h²/4 along each axis.
    let spread = 2.0 * 0.1 * 0.1 / 4.0;
    let about_z = |row: &Row| row.x[0].powi(2) + row.x[1].powi(2) + spread;
    let inertia = rows(&whirl).iter().map(about_z).sum::<f64>() * whirl.ledger().mass / rows(&whirl).len() as f64;
    let spin = whirl.ledger().angular_momentum[2] / inertia;
    near("whirl", spin, 0.5 * share, 1e-3 * share);
    let two = [
        material("neo_hookean", 1000.0, "young_modulus = 1e4"),
        block("neo_hookean", [-1.0, -0.2, -0.2], [-0.6, 0.2, 0.2], "velocity = [0, 1, 0]"),
        block("neo_hookean", [0.6, -0.2, -0.2], [1.0, 0.2, 0.2], "velocity = [0, 1, 0]"),
    ];
    let brakes = "[[coupling]]\nkind = \"brakes\"\n[[coupling.parameters.zone]]\nname = \"left\"\ncenter = [-1, 0, 0]\nhalf = [0.9, 2, 2]\nrate = 5\n[[coupling.parameters.zone]]\nname = \"far\"\ncenter = [0, 0, 3]\nhalf = [0.1, 0.1, 0.1]\nrate = 5\n";
    let braked = run(0.0, two.concat(), brakes);
    assert!(braked.bodies().iter().map(|body| body.name.as_str()).eq(["left", "far"]));
    for row in rows(&braked) {
        let wanted = if row.x[0] < 0.0 { 1.0 - share } else { 1.0 };
        assert!((row.v[1] - wanted).abs() < 1e-12, "{} at {:?}", row.v[1], row.x);
    }
}

/// A file that a parameter names is found beside the scene, read, and noted: a run that is gone on with after it has changed would be another one.
#[test]
fn files_of_parameters_belong_to_the_run() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("wind.csv"), "0, 0\n0.1, 1\n").unwrap();
    let (dt, rate, steps) = (1e-3, 5.0, 50);
    let wind = current("name = \"wind\"", "rate = 5, velocity = [1, 0, 0], record = \"wind.csv\"");
    let text = Head::space(0.1).time(format!("step = {dt}")).with(&[cube("").concat(), wind]);
    let (registry, f64s) = (registry(), options(Precision::F64));
    let scene = Scene::from_str(&text, "scene.toml", folder.path()).unwrap();
    let mut s = Simulation::new(&registry, &scene, &f64s).unwrap();
    assert!(s.plan().files.iter().map(|stamp| stamp.file.to_str().unwrap()).eq(["wind.csv"]));
    let mut u = 0.0;
    for step in 0..steps {
        s.step().unwrap();
        u = (u + rate * dt * (f64::from(step) * dt / 0.1)) / (1.0 + rate * dt);
    }
    let off = rows(&s).iter().map(|row| (row.v[0] - u).abs()).fold(0.0, f64::max);
    println!("velocity {u:.4} m/s, off by {off:.1e}, tolerance 1e-12");
    assert!(off < 1e-12 && u > 0.02);
    let snapshot = folder.path().join("wind.snapshot");
    s.save(&snapshot).unwrap();
    Simulation::resume(&registry, &snapshot, &f64s).unwrap();
    std::fs::write(folder.path().join("wind.csv"), "0, 0\n0.1, 2\n").unwrap();
    let error = Simulation::resume(&registry, &snapshot, &f64s).unwrap_err().to_string();
    assert!(error.contains("wind.csv has changed since the run began"), "{error}");
    std::fs::write(folder.path().join("wind.csv"), "0, 0\n0, 2\n").unwrap();
    let error = Simulation::new(&registry, &scene, &f64s).unwrap_err().to_string();
    assert!(error.contains("coupling[0].parameters.record: ") && error.contains("with times that rise"), "{error}");
}

/// Whatever cannot do what a command says, says so, by name.
#[test]
fn commands_are_refused_by_those_who_cannot_follow() {
    let plate = tool("plate", [0.0, 0.0, -1.0], &half([0.2; 3]), "\"slip\"", "{ velocity = {} }");
    let text = Head::space(0.1).with(&[cube("").concat(), plate, current("", "rate = 1")]);
    let mut s = Simulation::new(&registry(), &scene(&text), &Options::default()).unwrap();
    for (body, command, says) in [
        ("plate", Command::JointTorques(vec![1.0]), "tool 'plate': it has no joints, and joint torques are asked for"),
        (
            "plate",
            Command::JointTargets(vec![1.0]),
            "it has no joints, and joint targets are asked for; give it a twist",
        ),
        ("current", Command::Twist { linear: [1.0; 3], angular: [0.0; 3] }, "'current' stays where it is"),
        ("robot", Command::JointTargets(Vec::new()), "robot: no body has this name; there are plate, current"),
    ] {
        let error = s.act(body, &command).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains(says), "{error}");
    }
    s.act("plate", &Command::Twist { linear: [0.0, 0.0, 0.5], angular: [0.0; 3] }).unwrap();
    s.step().unwrap();
    assert!((s.bodies()[0].velocity[2] - 0.5).abs() < 1e-12, "{:?}", s.bodies()[0]);
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

/// A backend is asked for what it offers, and for nothing else: drag of rate k on dust in flight, v' = (v + g dt) / (1 + k dt).
#[test]
fn a_backend_takes_parameters() {
    let (dt, drag, steps) = (2e-3, 3.0, 50);
    let head = Head { gravity: [0.0, 0.0, -9.81], ..Head::space(0.1).time(format!("step = {dt}")) };
    let scene = scene(&head.with(&cube("velocity = [1, 0, 0]")));
    let asked = |text: &str| Options {
        backend: "dust".to_owned(),
        backend_parameters: barchan::parameter::parse(text).into_iter().collect(),
        ..options(Precision::F64)
    };
    let mut s = Simulation::new(&registry(), &scene, &asked("drag=3")).unwrap();
    let mut v = [1.0, 0.0, 0.0];
    for _ in 0..steps {
        s.step().unwrap();
        v = std::array::from_fn(|d| (v[d] + dt * head.gravity[d]) / (1.0 + drag * dt));
    }
    let off = rows(&s).iter().flat_map(|row| (0..3).map(move |d| (row.v[d] - v[d]).abs())).fold(0.0, f64::max);
    println!("velocity {v:?} m/s, off by {off:.1e}, tolerance 1e-13");
    assert!(off < 1e-13);
    for (text, says) in [
        (
            "drug=3",
            "--backend-parameter: drug: backend 'dust' has no parameter `drug`; it has drag; did you mean `drag`?",
        ),
        ("drag=-3", "--backend-parameter: drag: is -3; must be in [0, inf) 1/s"),
        ("drag=much", "--backend-parameter: drag: is the text \"much\"; give a number in [0, inf) 1/s"),
    ] {
        let error = Simulation::new(&registry(), &scene, &asked(text)).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains(says), "{error}");
    }
    let cpu = Options { backend: "cpu".to_owned(), ..asked("drag=3") };
    let error = s.swap(&registry(), &cpu).unwrap_err().to_string();
    assert!(error.contains("backend 'cpu' has no parameter `drag`; it has none"), "{error}");
    assert!(barchan::parameter::parse("drag").is_err());
}

/// The last step of an episode under one action, and the sum of its rewards.
fn played(environment: &mut Environment, action: f64) -> (Step, f64) {
    let mut rewards = 0.0;
    loop {
        let step = environment.step(&[vec![action]]).unwrap().remove(0).unwrap();
        rewards += step.reward;
        if step.terminated || step.truncated {
            return (step, rewards);
        }
    }
}

/// A scene calls for a task by its `[task]`, which says what it is about; it is played in that scene.
#[test]
fn a_scene_calls_for_a_task() {
    let registry = registry();
    let plate = tool("blade", [-0.4, 0.0, 0.0], &half([0.15, 0.3, 0.3]), "\"slip\"", "{ velocity = {} }");
    let scene_with = |task: &str| Head::space(0.1).with(&[cube("").concat(), plate.clone(), task.to_owned()]);
    let push = "[task]\nname = \"push\"\nparameters = { goal = 0.02, actions = 9, tool = \"blade\" }\n";
    let made = scene(&scene_with(push));
    let task = registry.task_of(&made).unwrap();
    let mut environment = Environment::new(&registry, task, &[0], &options(Precision::F32)).unwrap();
    let plan = environment.worlds().world(0).plan();
    assert!(plan.effects.iter().any(|effect| effect.name == "task push"), "{plan}");
    let first = environment.observation(0).to_vec();
    let (last, _) = played(&mut environment, 1.0);
    let actions = environment.steps_taken(0);
    let moved = last.observation[1] - first[1];
    println!("pushed by {moved:.3} m in {actions} actions, goal 0.02 m");
    assert!(last.terminated && moved >= 0.02 && actions < 9, "{last:?}");
    for (task, says) in [
        ("[task]\nname = \"pull\"\n", "task.name: no task is called 'pull'; known are: "),
        (
            &push.replace("goal", "gaol"),
            "task.parameters.gaol: task 'push' has no parameter `gaol`; it has goal, actions, tool; did you mean `goal`?",
        ),
        (&push.replace("0.02", "0"), "task.parameters.goal: is 0; must be in (0, inf) m"),
        (
            &push.replace("\"blade\"", "\"plate\""),
            "task.parameters.tool: no tool 'plate' of the scene is driven by velocity",
        ),
        ("[task]\nparameters = {}\n", "task.name: this key is required"),
    ] {
        let error = refusal(&registry, &scene_with(task));
        assert!(error.contains(says) && error.starts_with("scene.toml:"), "{error}");
    }
    let error = registry.task_of(&scene(&scene_with(""))).expect_err("there is none").to_string();
    assert!(error.contains("task: the scene has none; add a [task]"), "{error}");
}

/// A task from outside is found by name, resets and steps, and pays for what happened: the rewards add up to the cube's way.
#[test]
fn a_task_from_outside_is_played_to_its_end() {
    let registry = registry();
    let task = registry.task("push", &Table::new()).unwrap();
    let mut environment = Environment::new(&registry, task, &[0], &options(Precision::F32)).unwrap();
    let first = environment.observation(0).to_vec();
    assert_eq!(first.len(), environment.task().observations().iter().map(|part| part.size).sum::<usize>());
    let (last, rewards) = played(&mut environment, 0.6);
    let actions = environment.steps_taken(0);
    let moved = last.observation[1] - first[1];
    println!(
        "cube pushed by {moved:.3} m in {actions} actions, goal 0.1 m; rewards are {:.1e} m off",
        (rewards - moved).abs()
    );
    assert!(last.terminated && !last.truncated && moved >= 0.1, "{last:?}");
    assert!((rewards - moved).abs() < 1e-12);
    for (action, says) in [
        (vec![0.0, 1.0], "the action has 2 numbers; give 1: share of 1 m/s along x"),
        (vec![f64::NAN], "share of 1 m/s along x of the action is NaN; give a number from -1 to 1"),
    ] {
        let error = environment.step(&[action]).unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
    }
    assert_eq!(environment.steps_taken(0), actions, "an action that is none moves nothing");
    environment.step(&[vec![1.5]]).unwrap();
    assert_eq!(environment.clipped(0), 1);
}
