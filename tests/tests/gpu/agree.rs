//! Scenes that random draws have found apart from the CPU: the least that shows the same. They are judged as random scenes are: mass and momentum closed, the
//! same bits on two threads and after a resumption, f32 near f64, this backend near the CPU.

use super::{cpu, gpu, on, take};
use barchan::{Precision, Simulation};
use barchan_tests::random::{Judge, Outcome};
use barchan_tests::scenes::rows;

/// What the head of a scene says, and where its bodies are.
const HEAD: &str =
    "name = \"agree\"\nseed = 1\ngravity = [0.0, 0.0, -9.81]\noutput = { interval = 1e9, picture = { on = false } }\n";

#[track_caller]
fn is_near(what: &str, text: &str) {
    let folder = tempfile::tempdir().unwrap();
    let judge = Judge::new(barchan::registry(), folder.path(), 20, Some("wgpu".to_owned()));
    match judge.judge(&toml::from_str(&format!("{HEAD}{text}")).unwrap()) {
        Outcome::Ran(20, None) => {}
        other => panic!("{what}: {other:?}"),
    }
}

/// Symptom: after 20 steps particles of the same number are 1.5 to 2.7 cells apart where a soft body is an agent, so that particles are split in the first
/// step: each backend gave children their numbers in the order in which it held the parents. Physics: who is who does not depend on that.
#[test]
fn children_have_the_same_numbers_on_all_backends() {
    let law = |law: &str, parameters: &str| {
        format!("material = [{{ name = \"m\", law = \"{law}\", density = 1000.0, parameters = {{ {parameters} }} }}]\n")
    };
    let world = "world = { cell = 0.02, min = [0.0, 0.0, 0.0], max = [0.96, 0.48, 0.48], walls = { z_min = \"slip\" }, leaving = \"clamp\" }\n\
                 time = { end = 1000.0 }\n";
    let body = "body = [{ material = \"m\", name = \"b\", sampling = \"jitter\", velocity = [0.5, 0.2, -0.3], \
                shape = { box = { min = [0.3, 0.11, 0.02], max = [0.7, 0.21, 0.21] } } }]\n\
                tool = [{ name = \"eye\", position = [0.32, 0.16, 0.3], motion = { velocity = { linear = [1.0, 0.0, 0.0] } }, \
                shape = { sphere = { radius = 0.03 } } }]\n";
    for (what, material, levels) in [
        ("elastic", law("hencky", "young_modulus = 2e4, poisson_ratio = 0.4"), "subcycle = true, agents = [\"eye\"]"),
        (
            "without strength",
            law("von_mises", "young_modulus = 2e4, yield_stress = 0.0, hardening_modulus = 1000.0"),
            "agents = [\"eye\", \"b\"]",
        ),
    ] {
        is_near(what, &format!("{world}{material}{body}levels = {{ count = 2, half = 8, {levels} }}\n"));
    }
}

/// Symptom: after 20 steps a twentieth of the particles is a fifth of a cell away from where the CPU has it, where they are put back into the world: each
/// backend did so when it sorted them, up to a cell outside, and at times of its own. Physics: at the edge is at the edge.
#[test]
fn particles_are_put_back_into_the_world_where_the_cpu_puts_them() {
    let world = "world = { cell = 0.05, min = [0.0, 0.0, 0.0], max = [1.6, 1.6, 0.8], walls = { y_min = \"stick\" }, leaving = \"clamp\" }\n\
                 time = { end = 1000.0, safety = 0.9 }\n\
                 material = [{ name = \"m\", law = \"fixed_corotated\", density = 1600.0, parameters = { young_modulus = 9134.0 } }]\n";
    let body = "body = [{ material = \"m\", name = \"b\", velocity = [0.0, 0.0, -1.0], angular_velocity = [3.3, 2.4, -2.5], \
                shape = { box = { min = [0.2, 0.2, 0.0], max = [1.4, 1.4, 0.05] } } }]\n";
    is_near("a sheet that turns", &format!("{world}{body}"));
}

/// A block of liquid falls through the open bottom of a world with cells of a metre; it begins to leave in the eighth step.
fn falls_out(leaving: &str, more: &str) -> String {
    let world =
        format!("world = {{ cell = 1.0, min = [0.0, 0.0, 0.0], max = [12.0, 12.0, 16.0], leaving = \"{leaving}\" }}");
    let time = "time = { end = 1000.0, step = 0.0485, over_bound = \"substep\" }";
    let material = "material = [{ name = \"m\", law = \"liquid\", density = 8000.0 }]";
    let body = "body = [{ material = \"m\", shape = { box = { min = [4.0, 4.0, 0.5], max = [8.0, 8.0, 3.5] } } }]";
    format!("{HEAD}{world}\n{time}\n{material}\n{body}\n{more}")
}

/// Symptom: where a sink or a source has changed which particles there are, and where a run goes on on another backend, a device did not look until a later sort who is
/// outside the world: it was a fifth of a cell further down than on the CPU with `leaving = "clamp"`, and refused three steps later, a cell further, with "error".
/// Physics: who is outside is found at once, whatever has brought particles in.
#[test]
fn who_is_outside_is_found_at_once_wherever_particles_come_from() {
    let sink = "sink = [{ shape = { sphere = { center = [4.0, 4.0, 0.5], radius = 2.0 } } }]";
    let source = "source = [{ material = \"m\", from = 0.38, velocity = [0.0, 0.0, -1.0], \
                  shape = { sphere = { center = [10.0, 10.0, 10.0], radius = 1.0 } } }]";
    for (what, more) in [("a sink", sink), ("a source", source)] {
        let text = falls_out("clamp", more);
        let (mut on_gpu, mut on_cpu) = (gpu(&text), cpu(&text));
        for step in 1..=10 {
            take(&mut on_gpu, 1);
            take(&mut on_cpu, 1);
            let (device, truth) = (rows(&on_gpu), rows(&on_cpu));
            assert!(device.iter().map(|r| r.id).eq(truth.iter().map(|r| r.id)), "{what}, step {step}: other particles");
            let apart = device.iter().zip(&truth).flat_map(|(a, b)| (0..3).map(|d| (a.x[d] - b.x[d]).abs()));
            let apart = apart.fold(0.0, f64::max);
            assert!(apart < 1e-5, "{what}, step {step}: {apart} cells apart");
        }
        let text = falls_out("error", more);
        let refused = |mut simulation: Simulation| loop {
            if let Err(error) = simulation.step() {
                break (simulation.step_count(), error.to_string());
            }
        };
        let ((device, said), (truth, _)) = (refused(gpu(&text)), refused(cpu(&text)));
        assert_eq!(device, truth, "{what}: {said}");
        assert!(said.contains("left the world"), "{what}: {said}");
    }
    // What has left while another backend ran is found there, too.
    for (from, to) in [("cpu", "wgpu"), ("wgpu", "cpu")] {
        let mut simulation = on(from, Precision::F32, &falls_out("error", ""));
        let error = loop {
            let options = barchan::Options { backend: to.into(), ..barchan::Options::default() };
            if simulation.step_count() == 8 && simulation.backend() == from {
                simulation.swap(&barchan::registry(), &options).unwrap();
            }
            if let Err(error) = simulation.step() {
                break error.to_string();
            }
        };
        assert!(simulation.step_count() <= 9, "from {from} to {to}: step {}: {error}", simulation.step_count());
    }
}

/// Symptom: where particles came to finer cells, many steps at once took a shorter step before they were on these, one by one behind it: the device's
/// round of split and merge ended the steps that it was asked for, and the next one's length was chosen by what had come of it.
#[test]
fn steps_that_bring_particles_to_finer_cells_are_as_long_however_many_are_asked_for() {
    let world = "world = { cell = 0.05, min = [0.0, 0.0, 0.0], max = [1.2, 1.2, 1.6], leaving = \"clamp\" }\n\
                 time = { end = 1000.0 }\nlevels = { count = 2, half = 8 }\n\
                 material = [{ name = \"m\", law = \"liquid\", density = 8000.0 }]\n";
    let body = "body = [{ material = \"m\", velocity = [0.82, 0.0, 0.0], shape = { box = { min = [0.26, 0.2, 0.95], max = [0.38, 0.42, 1.05] } } }]\n";
    let tool = "tool = [{ name = \"t\", position = [1.04, 0.3, 1.3], shape = { box = { half = [0.1, 0.1, 0.4] } }, \
                motion = { keyframes = { frames = [{ time = 0.0, position = [1.04, 0.3, 1.3] }] } } }]\n";
    let text = format!("{HEAD}{world}{body}{tool}");
    let (mut each, mut all) = (gpu(&text), gpu(&text));
    let mut times = Vec::new();
    while times.len() < 12 {
        take(&mut each, 1);
        times.push(each.time());
    }
    let steps: Vec<f64> = times.windows(2).map(|t| t[1] - t[0]).collect();
    assert!(steps.last().unwrap() < &(0.6 * steps[0]), "particles came to finer cells: {steps:?}");
    let mut taken = 0;
    while taken < times.len() {
        taken += all.steps(times.len() - taken, f64::INFINITY).unwrap().len();
        assert_eq!(all.time(), times[taken - 1], "after {taken} steps");
    }
    assert!(rows(&all).iter().zip(&rows(&each)).all(|(a, b)| a.id == b.id && a.x == b.x && a.v == b.v));
}
