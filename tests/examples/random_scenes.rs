//! Random scenes by the thousand: `cargo run --release -p barchan-tests --example random_scenes -- --count 1000 --seed 1`.
//!
//! `--backend wgpu` holds that backend against the CPU besides; `--only SEED` judges one scene and prints it. What breaks a rule is shrunk, printed as
//! TOML, and written into `--out` (default `out/random`), beside the files that scenes name. Ends with 1 if any scene broke a rule.

use barchan_tests::arguments;
use barchan_tests::random::{Generator, Judge, Outcome, shrink, write_files};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

const OPTIONS: [&str; 6] = ["--count", "--seed", "--steps", "--backend", "--only", "--out"];
/// Scenes that are tried to find the least one that breaks a rule.
const TRIES: usize = 400;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let options = match arguments::options(&args, &OPTIONS) {
        Ok(options) => options,
        Err(message) => {
            println!("{message}");
            return ExitCode::from(2);
        }
    };
    let number = |name: &str, default: u64| options.get(name).map_or(Some(default), |text| text.parse().ok());
    let (Some(count), Some(seed), Some(steps)) = (number("--count", 1000), number("--seed", 1), number("--steps", 20))
    else {
        println!("--count, --seed and --steps want whole numbers");
        return ExitCode::from(2);
    };
    let out = PathBuf::from(options.get("--out").unwrap_or(&"out/random"));
    if let Err(error) = std::fs::create_dir_all(&out).and_then(|()| write_files(&out)) {
        println!("{}: {error}", out.display());
        return ExitCode::from(2);
    }
    let registry = barchan::registry();
    let generator = Generator::new(&registry);
    let judge = Judge::new(registry, &out, steps, options.get("--backend").map(|&name| name.to_owned()));
    if let Some(only) = options.get("--only").and_then(|seed| seed.parse().ok()) {
        let scene = generator.scene(only);
        println!("{}\n{:#?}", toml::to_string(&scene).unwrap_or_default(), judge.judge(&scene));
        return ExitCode::SUCCESS;
    }
    std::panic::set_hook(Box::new(|_| ()));
    let start = Instant::now();
    let (mut ran, mut stopped, mut refused, mut failed) = (0, BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    // What is said, without its numbers and names.
    let kind = |text: &str| {
        let words = text.split([':', ';', '(']).filter(|part| part.trim().contains(' '));
        words.take(1).flat_map(|part| part.chars().filter(|c| !c.is_ascii_digit())).take(90).collect::<String>()
    };
    for seed in seed..seed + count {
        let scene = generator.scene(seed);
        match judge.judge(&scene) {
            Outcome::Ran(_, None) => ran += 1,
            Outcome::Ran(_, Some(error)) => *stopped.entry(kind(&error)).or_insert(0) += 1,
            Outcome::Refused(error) => *refused.entry(kind(&error)).or_insert(0) += 1,
            Outcome::Failed(failure) => {
                let least = shrink(&judge, &scene, failure.rule, TRIES);
                let text = toml::to_string(&least).unwrap_or_default();
                let said = match judge.judge(&least) {
                    Outcome::Failed(failure) => failure.what,
                    _ => failure.what,
                };
                println!("seed {seed}: {}: {said}\n\n{text}", failure.rule);
                let written = std::fs::write(
                    out.join(format!("failed-{seed}.toml")),
                    format!("# {}: {said}\n{text}", failure.rule),
                );
                written.unwrap_or_else(|error| println!("{}: {error}", out.display()));
                *failed.entry(failure.rule).or_insert(0) += 1;
            }
        }
    }
    println!("{count} scenes in {:.0} s: {ran} ran to their end", start.elapsed().as_secs_f64());
    for (what, all) in [("stopped", &stopped), ("refused", &refused)] {
        println!("{what}: {}", all.values().sum::<i32>());
        all.iter().for_each(|(kind, count)| println!("  {count:>5}  {kind}"));
    }
    println!("failed: {}", failed.values().sum::<i32>());
    failed.iter().for_each(|(rule, count): (_, &i32)| println!("  {count:>5}  {rule}"));
    ExitCode::from(u8::from(!failed.is_empty()))
}
