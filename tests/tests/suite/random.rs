//! What must hold for every scene, held to scenes that nobody has thought of. Thousands of them: see `examples/random_scenes.rs`.

use barchan::Registry;
use barchan_tests::random::{Generator, Judge, Outcome, shrink, write_files};
use std::collections::{BTreeMap, BTreeSet};
use toml::{Table, Value};

/// Scenes that are run.
const SCENES: u64 = 150;

fn registry() -> Registry {
    let mut registry = barchan::registry();
    barchan_seam_coupling::register(&mut registry).unwrap();
    barchan_seam_task::register(&mut registry).unwrap();
    registry
}

/// The keys of a scene with their values, entries of lists as `[]`.
fn keys(table: &Table, path: &str, found: &mut BTreeMap<String, BTreeSet<String>>) {
    for (key, value) in table {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        found.entry(path.clone()).or_default().insert(value.to_string());
        match value {
            Value::Table(table) => keys(table, &path, found),
            Value::Array(items) => {
                let tables = items.iter().filter_map(Value::as_table);
                tables.for_each(|table| keys(table, &format!("{path}[]"), found));
            }
            _ => {}
        }
    }
}

/// A key that is declared and never drawn would not be tested by anything here. If this fails for a new key, its type or unit is one that the generator
/// does not know, or `tests/src/random/draw.rs` must be told when it makes sense.
#[test]
fn every_key_of_a_scene_is_drawn() {
    let generator = Generator::new(&registry());
    let mut found = BTreeMap::new();
    for seed in 0..6000 {
        keys(&generator.scene(seed), "", &mut found);
    }
    let never: Vec<String> = generator.keys().into_iter().filter(|key| !found.contains_key(key)).collect();
    assert!(never.is_empty(), "never drawn: {never:#?}");
    // Of these there is one kind of value only.
    let one = ["name", "world", "time.end", "task.name"];
    let same: Vec<&String> = found
        .iter()
        .filter(|(key, values)| values.len() < 2 && !one.contains(&key.as_str()))
        .map(|(key, _)| key)
        .collect();
    let same: Vec<_> = same.into_iter().filter(|key| !key.ends_with(".point") && !key.contains(".file")).collect();
    assert!(same.is_empty(), "always the same: {same:#?}");
    println!("{} keys, all drawn within 6000 scenes", found.len());
}

/// No panic, mass and momentum closed by the ledger, the same bits on two threads and after a resumption, f32 near f64: whatever the scene.
#[test]
fn no_random_scene_breaks_a_rule() {
    let folder = tempfile::tempdir().unwrap();
    write_files(folder.path()).unwrap();
    let generator = Generator::new(&registry());
    let judge = Judge::new(registry(), folder.path(), 20, None);
    let (mut ran, mut stopped, mut refused) = (0, 0, 0);
    for seed in 0..SCENES {
        let scene = generator.scene(seed);
        match judge.judge(&scene) {
            Outcome::Ran(_, None) => ran += 1,
            Outcome::Ran(_, Some(_)) => stopped += 1,
            Outcome::Refused(why) => {
                assert!(why.len() > 20, "seed {seed}: '{why}' says too little");
                refused += 1;
            }
            Outcome::Failed(failure) => {
                let least = toml::to_string(&shrink(&judge, &scene, failure.rule, 100)).unwrap();
                panic!("seed {seed}: {}: {}\n\n{least}", failure.rule, failure.what);
            }
        }
    }
    println!("{ran} scenes ran to their end, {stopped} stopped with an error, {refused} were refused");
    assert!(ran * 2 > SCENES, "the test must run most of what it draws");
}
