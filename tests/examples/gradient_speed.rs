//! How long going back through steps takes: `cargo run --release -p barchan-tests --example gradient_speed -- [--scene quadruped-stand] [--steps 16] [--threads 2] [--precision f32]`.
//!
//! Takes some steps of a built-in scene in which nothing sleeps, records as many more, and pulls back a loss on the height of all particles. Prints seconds forwards and backwards, the latter
//! also for each particle and step [us] and as a multiple of a step, and the length of the gradient by velocities, which tells whether two runs did the same.

use barchan::gradient::Cotangents;
use barchan::{Options, Precision, Simulation};
use barchan_tests::arguments;
use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Instant;

/// Steps before those that are recorded.
const BEFORE: usize = 5;

fn main() -> ExitCode {
    arguments::run(run)
}

fn run(given: &[String]) -> Result<(), String> {
    let mut options: BTreeMap<&str, &str> =
        [("--scene", "quadruped-stand"), ("--steps", "16"), ("--threads", "2"), ("--precision", "f32")].into();
    let known: Vec<&str> = options.keys().copied().collect();
    options.extend(arguments::options(given, &known)?);
    let number = |key: &str| options[key].parse::<usize>().map_err(|_| format!("{key} wants a whole number"));
    let (steps, threads) = (number("--steps")?, number("--threads")?);
    let precision = match options["--precision"] {
        "f32" => Precision::F32,
        "f64" => Precision::F64,
        _ => return Err("--precision wants f32 or f64".into()),
    };
    let failed = |e: barchan::Error| e.to_string();
    let scene = barchan::tasks::scene(options["--scene"], &["sleep.on=false"]).map_err(failed)?;
    let registry = barchan::registry();
    let mut simulation =
        Simulation::new(&registry, &scene, &Options { precision, threads, ..Options::default() }).map_err(failed)?;
    for _ in 0..BEFORE {
        simulation.step().map_err(failed)?;
    }
    let end = simulation.time() * (1.0 + steps as f64 / BEFORE as f64);
    let mut clock = Instant::now();
    let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed().as_secs_f64();
    let tape = simulation.record(&registry, end).map_err(failed)?;
    let forwards = lap();
    let particles = tape.end().id.len();
    let loss = Cotangents { position: vec![[0.0, 0.0, 1.0]; particles], ..Cotangents::zero(particles) };
    let gradient = tape.pull_back(loss).map_err(failed)?;
    let backwards = lap();
    let length = gradient.particles.velocity.iter().flatten().map(|x| x * x).sum::<f64>().sqrt();
    println!(
        "{} on {threads} threads: {particles} particles, {} steps; forwards {forwards:.2} s, back {backwards:.2} s, {:.2} us, {:.0} times a step; length {length:.9e}",
        scene.name,
        tape.len(),
        1e6 * backwards / (particles * tape.len()) as f64,
        backwards / forwards,
    );
    Ok(())
}
