//! Damping of elastic strain on the device: as on the CPU, with what it dissipates.

use super::{apart, cpu, gpu, take, take_at_once};
use barchan_tests::limits::{self, Lie};
use barchan_tests::scenes::{rows, within};
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
            let time = format!("step = {}\nover_bound = \"allow\"", factor * exact.dt);
            let mut sim = gpu(&limits::scene_of(lie, &soft, law, &time));
            limits::stir(&mut sim);
            limits::bears(&mut sim)
        };
        assert!(bears(Lie::Lone, 0.99) && bears(Lie::Sheet, 0.99), "{law}: grows below the bound");
        assert!(!bears(Lie::Lone, 1.05), "{law}: a lone particle bears more than the bound");
    }
}
