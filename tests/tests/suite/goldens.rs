//! States stay as they are to the last bit, unless a commit says why.

use barchan::{Options, Simulation};
use barchan_tests::goldens::{compute, file, read, run, scenes};
use barchan_tests::sleeping::asleep;

/// Every law, levels, sleep, bodies, worlds and unbounded ground on the CPU, in both precisions, against the hashes that are kept.
#[test]
fn states_on_the_cpu_are_those_that_were_kept() {
    let folder = tempfile::tempdir().unwrap();
    let kept = read(&std::fs::read_to_string(file()).unwrap());
    let now = compute("cpu", folder.path()).unwrap_or_else(|e| panic!("{e}"));
    let off: Vec<_> = now.iter().filter(|(what, hash)| kept.get(*what) != Some(hash)).map(|(what, _)| what).collect();
    assert!(
        off.is_empty(),
        "{off:?} are not as they were, or not kept for this instruction set: cargo run --release -p barchan-tests --example goldens compares with the commit \
         that they are of, and with -- --write keeps new ones; say in the commit why they changed"
    );
}

/// A scene that does not do what it is kept for would guard nothing.
#[test]
fn kept_scenes_do_what_they_are_called_after() {
    let folder = tempfile::tempdir().unwrap();
    let all = scenes(folder.path());
    let run = |name: &str| -> Simulation {
        let (_, worlds) = all.iter().find(|(other, _)| *other == name).unwrap();
        run(&worlds[0], &Options { threads: 1, ..Options::default() }).unwrap_or_else(|e| panic!("{name}: {e}"))
    };
    let count = |s: &Simulation, what: &str| s.ledger().counts.get(what).copied().unwrap_or(0);
    for name in ["levels", "levels with steps of their own"] {
        let s = run(name);
        let inhabited = s.particles().lists.iter().filter(|list| !list.is_empty()).count();
        let [split, merged] = ["particles split", "particles merged"].map(|what| count(&s, what));
        assert!(
            inhabited == 3 && split > 0 && merged > 0,
            "{name}: {inhabited} levels, {split} split, {merged} merged"
        );
    }
    let s = run("sleep");
    assert!((1..s.particle_count() as u64).contains(&asleep(&s)), "sleep: {} asleep", asleep(&s));
    let archive = run("unbounded ground").particles().archive;
    assert!(!archive.is_empty(), "unbounded ground: nothing was left behind");
    for name in ["driven tool", "free bodies", "mesh"] {
        let felt = run(name).wrenches().iter().all(|wrench| wrench.force != [0.0; 3]);
        assert!(felt, "{name}: a body feels nothing");
    }
}
