//! Speed of a task in many worlds at once: `cargo run --release -p barchan-tests --example task_worlds -- [--task SmoothSurface-lite] [--worlds 64] [--backend wgpu]
//! [--threads 2] [--control 50]`.
//!
//! Each world plays the task's hand-written agent, or stands still where there is none. Prints control steps a second of all worlds together, how long it takes to begin all
//! episodes anew, and whether the first world has the same rewards as alone.

use barchan::environment::Environment;
use barchan::parameter::Table;
use barchan::{Options, Precision};
use barchan_tests::arguments;
use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Instant;

fn main() -> ExitCode {
    arguments::run(run)
}

fn run(given: &[String]) -> Result<(), String> {
    let mut options: BTreeMap<&str, &str> = [
        ("--task", "SmoothSurface-lite"),
        ("--worlds", "64"),
        ("--backend", "wgpu"),
        ("--threads", "2"),
        ("--control", "50"),
    ]
    .into();
    let known: Vec<&str> = options.keys().copied().collect();
    options.extend(arguments::options(given, &known)?);
    let number = |key: &str| options[key].parse::<usize>().map_err(|_| format!("{key} wants a whole number"));
    let (count, control, threads) = (number("--worlds")?, number("--control")?, number("--threads")?);
    let name = options["--task"].to_owned();
    let backend = options["--backend"].to_owned();
    let options = Options { backend, precision: Precision::F32, threads, ..Options::default() };
    let failed = |e: barchan::Error| e.to_string();
    let registry = barchan::registry();
    let start = |seeds: &[u64]| {
        let task = registry.task(&name, &Table::new())?;
        Environment::new(&registry, task, seeds, &options)
    };
    let seeds: Vec<u64> = (0..count as u64).collect();
    let mut environment = start(&seeds).map_err(failed)?;
    let particles = environment.worlds().world(0).particle_count();
    let play = |environment: &mut Environment, steps: usize| -> Result<(f64, Vec<f64>), String> {
        let (mut seconds, mut rewards) = (0.0, Vec::new());
        for _ in 0..steps {
            let still = vec![0.0; environment.task().actions().len()];
            let actions: Vec<Vec<f64>> = (0..environment.worlds().len())
                .map(|world| environment.heuristic(world).unwrap_or_else(|| still.clone()))
                .collect();
            let clock = Instant::now();
            let outcomes = environment.step(&actions).map_err(failed)?;
            seconds += clock.elapsed().as_secs_f64();
            let first = outcomes.into_iter().collect::<barchan::Result<Vec<_>>>().map_err(failed)?;
            rewards.push(first[0].reward);
        }
        Ok((seconds, rewards))
    };
    let warm_up = 10;
    let (_, mut rewards) = play(&mut environment, warm_up)?;
    let (seconds, more) = play(&mut environment, control)?;
    rewards.extend(more);
    let again: Vec<(usize, u64)> = (0..count).zip(seeds).collect();
    let mut resets = Vec::new();
    for _ in 0..2 {
        let clock = Instant::now();
        environment.reset(&again).map_err(failed)?;
        resets.push(clock.elapsed().as_secs_f64());
    }
    let (_, alone) = play(&mut start(&[0]).map_err(failed)?, warm_up + control)?;
    let same = if alone == rewards { "the same" } else { "OTHER" };
    println!(
        "{name}: {count} worlds of {particles} particles on {}: {:.0} control steps/s, {:.2} x real time in each; all begin anew in {:.3} s, from kept states in {:.3} s; \
         the first world's rewards are {same} as alone",
        options.backend,
        (count * control) as f64 / seconds,
        control as f64 * environment.task().interval() / seconds,
        resets[0],
        resets[1],
    );
    Ok(())
}
