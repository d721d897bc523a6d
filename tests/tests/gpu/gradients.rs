//! Gradients through steps that a device took: they are taken again there, and gone back through on the CPU in f64.

use super::{cpu, gpu};
use barchan::{Command, Cotangents, Gradient, Options, Precision, Simulation, Tape};
use barchan_tests::scenes::{options, within};
use barchan_tests::sketch::{Head, block, driven, half, hopper, material, tool};

/// A block that falls on the floor and spreads.
fn spreads(law: &str, parameters: &str) -> String {
    let walls = "x_min = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    Head::cells(0.05, [12, 4, 8], walls).time("step = 1e-3").with(&[
        "[sleep]\non = false\n".into(),
        material(law, 1500.0, parameters),
        block(law, [0.0; 3], [0.2, 0.2, 0.2], "velocity = [0.4, 0.0, -0.3]"),
    ])
}

/// What heights and ways along x, weighed by one another, owe to the start: over so many tapes one after the other.
fn pulled_back(mut sim: Simulation, tapes: u32) -> Gradient {
    let record = |k: u32| {
        sim.record(&barchan::registry(), 0.1 * f64::from(k) / f64::from(tapes)).unwrap_or_else(|e| panic!("{e}"))
    };
    let tapes: Vec<Tape> = (1..=tapes).map(record).collect();
    assert_eq!(tapes.iter().map(Tape::len).sum::<usize>(), 100);
    let end = tapes[tapes.len() - 1].end();
    let mut loss = Cotangents::zero(end.id.len());
    for (of, x) in loss.position.iter_mut().zip(&end.position) {
        *of = [x[2], 0.0, x[0]];
    }
    let mut gradient = Gradient { particles: loss, ..Gradient::default() };
    for tape in tapes.iter().rev() {
        gradient = tape.pull_back(gradient.particles).unwrap_or_else(|e| panic!("{e}"));
    }
    gradient
}

/// Also where a loss goes through two tapes, so that it owes something to strain between them, which the device has brought up to date and the CPU has not.
#[test]
fn gradients_through_steps_of_a_device_are_those_of_the_cpu() {
    for (law, parameters) in [
        ("neo_hookean", "young_modulus = 2e4"),
        ("sand", "young_modulus = 2e4, friction_angle = 0.6"),
        ("snow", "young_modulus = 2e4"),
    ] {
        let text = spreads(law, parameters);
        let host = pulled_back(cpu(&text), 1);
        are_alike(law, &pulled_back(gpu(&text), 1), &host);
        are_alike(law, &pulled_back(gpu(&text), 2), &host);
    }
}

/// A run that goes on elsewhere half-way, in either direction: what the two tapes give is what one gives.
#[test]
fn gradients_go_through_a_swap() {
    let text = spreads("neo_hookean", "young_modulus = 2e4");
    let host = pulled_back(cpu(&text), 1);
    let registry = barchan::registry();
    for (mut sim, other) in [(cpu(&text), "wgpu"), (gpu(&text), "cpu")] {
        let first = sim.record(&registry, 0.05).unwrap_or_else(|e| panic!("{e}"));
        let options = Options { backend: other.into(), ..options(Precision::F32) };
        sim.swap(&registry, &options).unwrap_or_else(|e| panic!("{e}"));
        let second = sim.record(&registry, 0.1).unwrap_or_else(|e| panic!("{e}"));
        let mut loss = Cotangents::zero(second.end().id.len());
        for (of, x) in loss.position.iter_mut().zip(&second.end().position) {
            *of = [x[2], 0.0, x[0]];
        }
        let later = second.pull_back(loss).unwrap_or_else(|e| panic!("{e}"));
        let mut both = first.pull_back(later.particles).unwrap_or_else(|e| panic!("{e}"));
        let sums = both.parameters[0].iter_mut().zip(&later.parameters[0]);
        sums.for_each(|(sum, more)| *sum += more);
        are_alike(&format!("on {other} then"), &both, &host);
        let [by, exact] = [both.parameters[0][0], host.parameters[0][0]];
        within("by the modulus", (by / exact - 1.0).abs(), 1e-3);
    }
}

fn are_alike(law: &str, device: &Gradient, host: &Gradient) {
    for (what, a, b) in [
        ("positions", &device.particles.position, &host.particles.position),
        ("velocities", &device.particles.velocity, &host.particles.velocity),
    ] {
        let dot = |a: &[[f64; 3]], b: &[[f64; 3]]| {
            a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| a * b).sum::<f64>()
        };
        let cosine = dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
        within(&format!("{law}, {what}: one less the cosine"), 1.0 - cosine, 1e-4);
        within(&format!("{law}, {what}: lengths"), ((dot(a, a) / dot(b, b)).sqrt() - 1.0).abs(), 1e-3);
    }
}

/// Through tools, one that is driven and one that falls freely and spins: the device presses as the CPU does, and what the loss owes to the tool's speed and place and to the ground is what
/// the CPU says.
#[test]
fn gradients_go_through_tools_on_a_device() {
    let free = "{ free = { mass = 2.0, linear = [0.1, 0.0, -1.0], angular = [0.0, 2.0, 1.0] } }";
    for (name, motion) in [("driven", driven([0.1, 0.0, -1.0])), ("free", free.to_owned())] {
        let shape = half([0.12, 0.08, 0.1]);
        let plate = tool("plate", [0.2, 0.1, 0.3], &shape, "{ coulomb = { friction = 0.4 } }", &motion);
        let text = spreads("neo_hookean", "young_modulus = 2e4") + &plate;
        let [host, device] = [cpu(&text), gpu(&text)].map(|mut sim| {
            let tape = sim.record(&barchan::registry(), 0.06).unwrap_or_else(|e| panic!("{e}"));
            let mut loss = Cotangents::zero(tape.end().id.len());
            loss.position.iter_mut().for_each(|of| of[0] = 1.0 / tape.end().id.len() as f64);
            loss.bodies.resize_with(1, Default::default);
            loss.bodies[0].impulse.force = [0.0, 0.0, 1e-2];
            (tape.impulses()[0], tape.pull_back(loss).unwrap_or_else(|e| panic!("{e}")))
        });
        let (felt, of_host) = &host;
        assert!(felt.force[2] > 0.05, "{name}: it presses: {:?}", felt.force);
        within(&format!("{name}: impulse"), (device.0.force[2] / felt.force[2] - 1.0).abs(), 1e-3);
        are_alike(name, &device.1, of_host);
        let speed = |gradient: &Gradient| match name {
            "driven" => gradient.bodies[0].linear,
            _ => gradient.particles.bodies[0].velocity,
        };
        let place = |gradient: &Gradient| gradient.particles.bodies[0].pose.position;
        for (what, found, expected) in
            [("speed", speed(&device.1), speed(of_host)), ("place", place(&device.1), place(of_host))]
        {
            let size = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            let apart = (0..3).map(|d| (found[d] - expected[d]).abs()).fold(0.0, f64::max);
            within(&format!("{name}: {what}"), apart / size, 1e-2);
        }
    }
}

/// Through a robot that lands, whose joints the device solves with the ground: by its motors' targets, its speed and its joints.
#[test]
fn gradients_go_through_robots_on_a_device() {
    let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
    let robot = format!(
        "[[robot]]\nname = \"hopper\"\nurdf = {:?}\nposition = [0.1, 0.1, 0.345]\nvelocity = [0.1, 0.0, -1.0]\njoints = {{ hip = 0.1, knee = -0.5 }}\ncontact = {{ coulomb = {{ friction = 0.4 }} }}\nmotor = [{{ kp = 30, kd = 0.4 }}]\n",
        hopper(folder.path(), [1.0; 2])
    );
    let text = spreads("neo_hookean", "young_modulus = 2e4") + &robot;
    let [host, device] = [cpu(&text), gpu(&text)].map(|mut sim| {
        sim.act("hopper", &Command::JointTargets(vec![0.2, -0.4])).unwrap_or_else(|e| panic!("{e}"));
        let tape = sim.record(&barchan::registry(), 0.06).unwrap_or_else(|e| panic!("{e}"));
        let mut loss = Cotangents::zero(tape.end().id.len());
        loss.position.iter_mut().for_each(|of| of[0] = 1.0 / tape.end().id.len() as f64);
        loss.bodies.resize_with(tape.end().bodies.len(), Default::default);
        loss.bodies[0].velocity = [0.0, 0.0, 0.1];
        loss.robots.resize_with(1, Default::default);
        loss.robots[0].positions = vec![0.2, -0.1];
        let felt: f64 = tape.impulses().iter().map(|felt| felt.force[2]).sum();
        (felt, tape.pull_back(loss).unwrap_or_else(|e| panic!("{e}")))
    });
    assert!(host.0 > 0.05, "it lands: {}", host.0);
    within("impulse", (device.0 / host.0 - 1.0).abs(), 1e-3);
    are_alike("hopper", &device.1, &host.1);
    let numbers = |gradient: &Gradient| {
        let (base, joints) = (&gradient.particles.bodies[0], &gradient.particles.robots[0]);
        let told = &gradient.robots[0];
        [
            base.velocity.to_vec(),
            base.pose.position.to_vec(),
            joints.positions.clone(),
            joints.rates.clone(),
            told.targets.clone(),
        ]
    };
    for (found, expected) in numbers(&device.1).into_iter().zip(numbers(&host.1)) {
        let size = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        let apart = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        within(&format!("{found:?} {expected:?}"), apart / size, 1e-2);
    }
}

/// Through levels that follow a tool, whose particles the device finds and the host splits and merges: over one tape and over two, of which the second begins behind that.
#[test]
fn gradients_go_through_levels_on_a_device() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let text = Head::cells(0.05, [44, 20, 14], walls).time("step = 1e-3").with(&[
        "[sleep]\non = false\n[levels]\ncount = 2\nhalf = 8\n".into(),
        material("neo_hookean", 1500.0, "young_modulus = 2e4"),
        block("neo_hookean", [0.0; 3], [2.0, 0.9, 0.3], "velocity = [0.4, 0.0, -0.3]"),
        tool("ball", [0.5, 0.47, 0.45], "sphere = { radius = 0.05 }", "\"stick\"", &driven([16.0, 0.0, 0.0])),
    ]);
    let over = |mut sim: Simulation, ends: &[f64]| {
        let record = |end: &f64| sim.record(&barchan::registry(), *end).unwrap_or_else(|e| panic!("{e}"));
        let tapes: Vec<Tape> = ends.iter().map(record).collect();
        let end = tapes[tapes.len() - 1].end();
        assert!(sim.ledger().counts.contains_key("particles merged"), "levels move");
        let mut loss = Cotangents::zero(end.id.len());
        for ((of, x), mass) in loss.position.iter_mut().zip(&end.position).zip(&end.mass) {
            *of = [mass * x[2], 0.0, mass * x[0]];
        }
        let mut gradient = Gradient { particles: loss, ..Gradient::default() };
        for tape in tapes.iter().rev() {
            gradient = tape.pull_back(gradient.particles).unwrap_or_else(|e| panic!("{e}"));
        }
        gradient
    };
    let host = over(cpu(&text), &[0.04]);
    let device = over(gpu(&text), &[0.04]);
    are_alike("levels", &device, &host);
    // The device brings strain up to date before particles split.
    let [by, exact] = [device.parameters[0][0], host.parameters[0][0]];
    within("by the modulus", (by / exact - 1.0).abs(), 3e-4);
    are_alike("levels, two tapes", &over(gpu(&text), &[0.025, 0.04]), &host);
}
