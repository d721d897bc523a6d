//! Damping of elastic strain on the device: as on the CPU, with what it dissipates.

use super::{apart, cpu, gpu, left, on_gpu, take, take_at_once, with_currents};
use barchan::worlds::Worlds;
use barchan::{Options, Precision, Simulation};
use barchan_tests::limits::{self, Lie};
use barchan_tests::scenes::{options, rows, scene, within};
use barchan_tests::sketch::{Head, block, damped, material};

/// Laws with either form of strain, with and without flow, asked for their stiffness on the device and not; and a damping that takes the ringing of a block within
/// some turns.
const LAWS: [(&str, &str, f64); 6] = [
    ("hencky", "young_modulus = 2e4, poisson_ratio = 0.3", 3e-3),
    ("fixed_corotated", "young_modulus = 2e4, poisson_ratio = 0.3", 3e-3),
    ("von_mises", "young_modulus = 2e5, yield_stress = 1e3", 5e-4),
    ("sand", "young_modulus = 2e5, poisson_ratio = 0.3", 5e-4),
    ("snow", "young_modulus = 1.4e5, poisson_ratio = 0.2", 5e-4),
    ("liquid", "bulk_modulus = 2e4, viscosity = 0.5", 3e-3),
];
const WALLS: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";

/// A block that falls on the floor, beside one that nobody damps.
fn fallen(law: &str, parameters: &str, damping: f64, time: &str, more: &str) -> String {
    let at = |x: f64| ([x, 0.0, 0.0], [x + 0.12, 0.12, 0.16]);
    let falls = "velocity = [0.0, 0.0, -0.5]";
    Head::cells(0.02, [20, 8, 12], WALLS).time(time).with(&[
        damped(law, 1000.0, parameters, damping),
        material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
        block(law, at(0.04).0, at(0.04).1, &format!("name = \"block\"\n{falls}")),
        block("neo_hookean", at(0.24).0, at(0.24).1, falls),
        more.to_owned(),
    ])
}

#[test]
fn damped_ground_is_as_on_the_cpu() {
    for (law, parameters, damping) in LAWS {
        // Steps of one length: backends look at how stiff ground has become at different times.
        let step = cpu(&fallen(law, parameters, damping, "safety = 0.3", "")).plan().dt;
        let text = fallen(law, parameters, damping, &format!("step = {step:e}"), "");
        let (mut gpu, mut cpu) = (gpu(&text), cpu(&text));
        take_at_once(&mut gpu, 150);
        take(&mut cpu, 150);
        println!("{law}: {:.2e} s a step, set by {}", gpu.plan().dt, gpu.plan().bound.by);
        within("distance of particles, in cells", apart(&rows(&gpu), &rows(&cpu)) / 0.02, 5e-3);
        // The CPU books what a step's motion dissipates in the next one.
        take(&mut cpu, 1);
        let (found, wanted) = (gpu.ledger(), cpu.ledger());
        println!("damped {:.4e} J of {:.4e} J", wanted.damped, wanted.kinetic + wanted.elastic);
        within("dissipated energy, off", (found.damped / wanted.damped - 1.0).abs(), 2e-3);
        assert!(wanted.damped > 1e-3 * wanted.kinetic, "{law}: damping takes nothing");
    }
}

/// The sum is of whole units: it does not depend on how many steps go in a call, nor on the order in which threads come.
#[test]
fn what_damping_takes_is_summed_the_same_each_time() {
    let levels = "[levels]\ncount = 2\nhalf = 8\nsubcycle = true\nagents = [\"block\"]\n";
    for more in ["", levels] {
        let text = fallen(LAWS[0].0, LAWS[0].1, LAWS[0].2, "safety = 0.3", more);
        let (mut once, mut again, mut exact) = (gpu(&text), gpu(&text), cpu(&text));
        take_at_once(&mut once, 100);
        take_at_once(&mut again, 100);
        take(&mut exact, 101);
        assert_eq!(once.ledger().damped.to_bits(), again.ledger().damped.to_bits());
        within("dissipated energy, off", (once.ledger().damped / exact.ledger().damped - 1.0).abs(), 1e-2);
        // A backend that takes over goes on from it.
        let before = once.ledger().damped;
        once.swap(&barchan::registry(), &barchan::Options::default()).unwrap();
        assert_eq!(once.ledger().damped, before);
        take(&mut once, 10);
        assert!(once.ledger().damped > before);
    }
}

/// Worlds of a batch may be damped by different times, and each has what it would have alone; one that nobody damps is refused beside them, by name.
#[test]
fn worlds_are_damped_each_by_its_own_time() {
    let of = |damping: f64| scene(&fallen("hencky", LAWS[0].1, damping, "step = 3e-4", ""));
    let scenes = [of(1e-3), of(3e-3)];
    let mut worlds = Worlds::new(&barchan::registry(), scenes.to_vec(), &on_gpu()).unwrap();
    (0..40).for_each(|_| drop(worlds.step()));
    for (w, scene) in scenes.iter().enumerate() {
        let mut alone = Simulation::new(&barchan::registry(), scene, &on_gpu()).unwrap();
        take(&mut alone, 40);
        assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
        let (here, there) = (worlds.world(w).ledger().damped, alone.ledger().damped);
        within(&format!("world {w} dissipates {here:.4e} J, off"), (here / there - 1.0).abs(), 1e-6);
    }
    let error =
        Worlds::new(&barchan::registry(), vec![of(1e-3), of(0.0)], &on_gpu()).map(drop).unwrap_err().to_string();
    assert!(error.contains("damped") && error.contains("world 1"), "{error}");
}

/// Where a law of contact runs on the host, the last step's numbers are still on the device when the ledger is read.
#[test]
fn beside_a_law_on_the_host_the_last_step_counts() {
    let current = format!(
        "[[coupling]]\nkind = \"{}\"\nparameters = {{ rate = 0.5, velocity = [0.2, 0, 0], host = true }}\n",
        barchan_seam_coupling::CURRENT
    );
    let text = fallen("hencky", LAWS[0].1, LAWS[0].2, "step = 3e-4", &current);
    let on = |backend: &str, steps: usize| {
        let options = Options { backend: backend.to_owned(), ..options(Precision::F32) };
        let mut sim = Simulation::new(&with_currents(), &scene(&text), &options).unwrap();
        take(&mut sim, steps);
        sim.ledger().damped
    };
    for steps in [20, 21] {
        within("dissipated energy, off", (on("wgpu", steps) / on("cpu", steps + 1) - 1.0).abs(), 1e-4);
    }
}

/// Damped bounds are those of the CPU, of laws that are asked on the host and on the device.
#[test]
fn damping_bounds_the_step() {
    for law in ["hencky", "neo_hookean"] {
        let soft = damped(law, 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3", 0.01);
        let text = limits::scene_of(Lie::Lone, &soft, law, "");
        let (mut sim, exact) = (gpu(&text), cpu(&text).bound());
        assert_eq!(exact.by, format!("damping of material '{law}'"));
        take(&mut sim, 20);
        println!("{law}: {:.4e} s by {}, CPU {:.4e} s", sim.bound().dt, sim.bound().by, exact.dt);
        within("bound, off", (sim.bound().dt / exact.dt - 1.0).abs(), 1e-5);
        let bears = |lie: Lie, factor: f64| {
            limits::bears(factor * exact.dt, |time| gpu(&limits::scene_of(lie, &soft, law, time)))
        };
        assert!(bears(Lie::Lone, 0.99) && bears(Lie::Sheet, 0.99), "{law}: grows below the bound");
        assert!(!bears(Lie::Lone, 1.05), "{law}: a lone particle bears more than the bound");
    }
}
