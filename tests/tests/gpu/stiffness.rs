//! Laws whose stiffness follows their particles' state: their bound is found on the device, in each step.

use super::{cpu, gpu, on, take, take_at_once};
use barchan::{Error, Options, ParticleState, Precision, Registry, Simulation};
use barchan_tests::limits::{self, Lie};
use barchan_tests::scenes::{scene, within};
use barchan_tests::sketch::{Head, block, driven, half, material, tool};
use std::path::PathBuf;
use std::process::Command;

/// Each built-in law whose bound follows the state, with parameters under which it grows much stiffer when it is squashed.
const LAWS: [(&str, f64, &str); 4] = [
    ("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
    ("fixed_corotated", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
    ("snow", 400.0, "young_modulus = 1.4e5, poisson_ratio = 0.2"),
    ("liquid", 1000.0, "bulk_modulus = 2e4, tait_exponent = 7.0, viscosity = 0.5"),
];

/// A block that is thrown at a wall.
fn thrown((law, density, parameters): (&str, f64, &str), speed: f64, more: &str, time: &str) -> String {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    Head::cells(0.02, [12, 12, 16], walls).time(time).with(&[
        material(law, density, parameters),
        block(law, [0.0; 3], [0.12, 0.12, 0.16], &format!("name = \"block\"\nvelocity = [0.0, 0.0, {}]", -speed)),
        more.to_owned(),
    ])
}

/// The particles of a simulation for one on another backend.
fn unsorted(sim: &Simulation) -> ParticleState {
    ParticleState { sort: None, ..sim.particles() }
}

/// Symptom: forty times less particles a second, since strains went to the host every ten steps to ask there. The device asks in every step, so
/// that many steps go in one call, and what it finds is what the CPU finds for the same particles.
#[test]
fn each_law_that_stiffens_is_asked_on_the_device() {
    let levels = "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\nagents = [\"block\"]\n";
    for (k, law) in LAWS.into_iter().enumerate() {
        for more in ["", levels].into_iter().take(if k == 0 { 2 } else { 1 }) {
            // On levels with steps of their own, no faster than what stiffness bounds more than speed.
            let text = thrown(law, if more.is_empty() { 3.0 } else { 2.0 }, more, "safety = 0.5");
            let mut gpu = gpu(&text);
            let fresh = gpu.plan().bound.dt;
            let at_once = gpu.steps(40, f64::INFINITY).unwrap().len();
            assert!(at_once == 40 || gpu.bound().dt < fresh, "{}: {at_once} steps in one call", law.0);
            take_at_once(&mut gpu, 120);
            // The CPU measures particles as they come in.
            let mut cpu = on("cpu", Precision::F32, &text);
            cpu.set_particles(unsorted(&gpu)).unwrap();
            let (found, own) = (gpu.bound(), cpu.bound());
            println!("{}: {fresh:.3e} s at rest, {:.3e} s by {}; {:.3e} s", law.0, found.dt, found.by, own.dt);
            // A round of split and merge after the last step may have loosened it.
            let looser = if more.is_empty() { 1e-4 } else { 0.02 };
            within("bound beyond the CPU's", found.dt / own.dt - 1.0, 1e-4);
            within("bound below the CPU's", 1.0 - found.dt / own.dt, looser);
            assert!(own.dt < 0.97 * fresh, "{}: the block is no stiffer than at rest", law.0);
            assert!(found.by.contains(&format!("material '{}'", law.0)), "{}", found.by);
        }
    }
}

/// A step that has become too long for the ground is refused in the very step in which it has, however many are taken at once; and with
/// steps that are chosen, none is longer than the ground bears.
#[test]
fn the_device_stops_before_a_step_that_the_ground_no_longer_bears() {
    let law = LAWS[0];
    let bound = gpu(&thrown(law, 1.0, "", "safety = 0.5")).bound().dt;
    let fixed = format!("step = {}", 0.93 * bound);
    // It flies before it strikes the wall.
    let lifted = |text: String| {
        text.replace(
            "min = [0.0, 0.0, 0.0], max = [0.12, 0.12, 0.16]",
            "min = [0.0, 0.0, 0.08], max = [0.12, 0.12, 0.24]",
        )
    };
    let refused = |at_once: usize| {
        let mut sim = gpu(&lifted(thrown(law, 1.0, "", &fixed)));
        let error = loop {
            match sim.steps(at_once, f64::INFINITY) {
                Ok(_) => assert!(sim.step_count() < 1000, "what is thrown at a wall is squashed"),
                Err(error) => break error,
            }
        };
        assert!(matches!(error, Error::TimeStep { .. }), "{error}");
        sim.step_count()
    };
    let (one, many) = (refused(1), refused(512));
    println!("refused after {one} steps, of many at once {many}");
    assert_eq!(one, many);
    assert!(one > 10, "it is stiff only where it is squashed");

    let mut sim = gpu(&thrown(LAWS[2], 4.0, "", "safety = 0.9"));
    while sim.step_count() < 400 {
        let bound = sim.bound().dt;
        let reports = sim.steps(100, f64::INFINITY).unwrap();
        assert!(reports.iter().all(|report| report.dt <= bound));
    }
}

/// When a step is chosen anew, since the ground has become too stiff for it, is for the ground to say: whoever looks after each step, or after
/// a hundred, sees the same particles, bit for bit. Symptom where ground may sleep: what it needed was kept from those steps only after
/// which somebody looked.
#[test]
fn looking_in_between_changes_no_bit() {
    let levels = "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\nagents = [\"block\"]\n";
    for (law, more) in [(LAWS[0], "[sleep]\nspeed = 0.3\n"), (LAWS[3], levels)] {
        let text = thrown(law, 3.0, more, "safety = 0.9").replace("0.12, 0.12, 0.16", "0.06, 0.06, 0.08");
        let run = |most: usize| {
            let (mut sim, mut lengths) = (gpu(&text), Vec::new());
            while lengths.len() < 100 {
                let reports = sim.steps(most.min(100 - lengths.len()), f64::INFINITY);
                lengths.extend(reports.unwrap_or_else(|e| panic!("{e}")).iter().map(|report| report.dt));
            }
            (sim.particles(), lengths)
        };
        let (one, many) = (run(1), run(100));
        let [least, most] = [f64::min, f64::max].map(|of| one.1.iter().copied().reduce(of).unwrap());
        println!("{} {more:?}: steps of {least:.3e} to {most:.3e} s", law.0);
        assert!(least < 0.97 * most, "{}: it never grows too stiff", law.0);
        let first = one.1.iter().zip(&many.1).position(|(a, b)| a.to_bits() != b.to_bits());
        assert!(first.is_none(), "{} {more:?}: step {first:?} has another length", law.0);
        assert!(one.0 == many.0, "{} {more:?}: other bits", law.0);
    }
}

/// Ground asleep is as stiff as it was: what wakes it meets the bound that it set.
#[test]
fn what_sleeps_still_bounds_the_step() {
    let text = thrown(LAWS[2], 2.0, "[sleep]\nspeed = 0.3\n", "safety = 0.5");
    let mut sim = gpu(&text);
    take_at_once(&mut sim, 1500);
    let asleep = sim.ledger().counts.get("particles asleep now").copied().unwrap_or(0);
    let mut cpu = cpu(&text);
    cpu.set_particles(unsorted(&sim)).unwrap();
    println!("{asleep} of {} asleep, bound {:.3e} s, {:.3e} s", sim.particle_count(), sim.bound().dt, cpu.bound().dt);
    assert!(asleep > 0);
    assert!(sim.bound().dt <= cpu.bound().dt * 1.0001, "the device forgets who sleeps");
}

/// A library of the interface's first version has no WGSL for its stiffness: it is asked on the host every ten steps, and the plan says so.
#[test]
fn a_library_without_it_is_asked_on_the_host_and_the_plan_says_what_that_takes() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    let folder = tempfile::tempdir().unwrap();
    let library = folder.path().join("libold.so");
    let old = root.join("tests/golden/abi_v1_0");
    let cc = std::env::var_os("CC").unwrap_or_else(|| "cc".into());
    let built = Command::new(cc)
        .args(["-std=c11", "-O2", "-shared", "-fPIC", "-I"])
        .args([&old, &old.join("neo_hookean.c")])
        .arg("-o")
        .arg(&library)
        .arg("-lm")
        .status();
    assert!(built.unwrap().success());
    let mut registry: Registry = barchan::registry();
    registry.load(&library).unwrap();
    let options = Options { backend: "wgpu".to_owned(), ..Options::default() };
    let text = thrown(("c_neo_hookean", 1000.0, "young_modulus = 2e4"), 3.0, "", "safety = 0.5");
    let mut sim = Simulation::new(&registry, &scene(&text), &options).unwrap();
    let mut most = 0;
    while sim.step_count() < 160 {
        most = most.max(sim.steps(40, f64::INFINITY).unwrap().len());
    }
    assert_eq!(most, 10);
    let own = gpu(&thrown(LAWS[0], 3.0, "", "safety = 0.5"));
    let said = |sim: &Simulation| registry.backend("wgpu").unwrap().passes(sim.plan()).join("\n");
    assert!(said(&sim).contains("material 'c_neo_hookean' has no wgsl_stiffness"), "{}", said(&sim));
    assert!(!said(&own).contains("wgsl_stiffness"));
}

/// A tool whose law runs on the host leaves the bound to the device, a step late.
#[test]
fn beside_a_law_on_the_host_the_bound_is_followed_too() {
    let wall = tool("plate", [0.06, 0.06, 0.19], &half([0.05, 0.05, 0.02]), "\"stick\"", &driven([0.0, 0.0, -1.0]));
    let text = thrown(LAWS[0], 0.0, &wall, "safety = 0.5");
    let mut sim = gpu(&text);
    let fresh = sim.bound().dt;
    take(&mut sim, 120);
    let mut cpu = on("cpu", Precision::F32, &text);
    cpu.set_particles(unsorted(&sim)).unwrap();
    println!("{fresh:.3e} s at rest, {:.3e} s, {:.3e} s", sim.bound().dt, cpu.bound().dt);
    within("bound against the CPU's", (sim.bound().dt / cpu.bound().dt - 1.0).abs(), 1e-2);
}

/// B1 for liquids on the device: a lone particle's step is stable below the bound by viscosity and not above, as in 64 bits on the CPU, and no other
/// arrangement bears less.
#[test]
fn viscosity_bounds_the_step() {
    for (eta, bulk) in [(4000.0, 1e-3), (0.5, 2000.0)] {
        let liquid =
            material("liquid", 1000.0, &format!("viscosity = {eta}, bulk_modulus = {bulk}, tait_exponent = 1.0"));
        let bound = gpu(&limits::scene_of(Lie::Lone, &liquid, "liquid", "")).bound().dt;
        let bears = |lie: Lie, factor: f64| {
            limits::bears(factor * bound, |time| gpu(&limits::scene_of(lie, &liquid, "liquid", time)))
        };
        for lie in [Lie::Lone, Lie::Sheet, Lie::Levels] {
            assert!(bears(lie, 0.99), "eta {eta}, K {bulk}: {lie:?} grows below the bound");
        }
        assert!(!bears(Lie::Lone, 1.05), "eta {eta}, K {bulk}: a lone particle bears more than the bound");
    }
}
