//! Any bytes are a snapshot or an error, and what can be resumed can be stepped or says why not.
//!
//! Checksums would turn almost every mutation away at the door: they are mended first, so that what lies behind is reached. Not
//! those of couplings: there lies the rigid solver's own state in the solver's own form, which it trusts. Its panics are caught and
//! become errors, but libfuzzer aborts at any panic, caught or not; `rigid-couple/tests` tries every byte of such a state instead.
#![no_main]

use barchan::{Options, Registry, Scene, Simulation};
use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::OnceLock;

static REGISTRY: OnceLock<Registry> = OnceLock::new();

const PLAIN: &str = r#"
name = "seed"
world = { cell = 0.1, min = [0, 0, 0], max = [1, 1, 1], walls = { z_min = "slip" }, leaving = "delete" }
time = { end = 1, step = 1e-3 }
material = [{ name = "s", law = "snow", density = 400 }]
body = [{ material = "s", shape = { box = { min = [0.2, 0.2, 0], max = [0.4, 0.4, 0.1] } } }]
"#;

const TOOLS: &str = r#"
tool = [
    { name = "driven", position = [0.3, 0.3, 0.2], shape = { sphere = { radius = 0.1 } }, motion = { velocity = { linear = [0, 0, -1] } } },
    { name = "free", position = [0.7, 0.7, 0.3], shape = { box = { half = [0.1, 0.1, 0.1] } }, motion = { free = { mass = 2 } } },
]
"#;

fn options() -> Options {
    Options { threads: 1, ..Options::default() }
}

fn registry() -> &'static Registry {
    REGISTRY.get_or_init(barchan::registry)
}

/// The head that every snapshot has, lengths that fit into the file, and right checksums.
fn mended(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    if bytes.len() < 12 {
        return bytes;
    }
    bytes[..12].copy_from_slice(b"BARCHAN\x1a\x01\0\0\0");
    let mut at = 12;
    while at + 16 <= bytes.len() {
        let payload = at + 16;
        let announced = u64::from_le_bytes(std::array::from_fn(|i| bytes[at + 4 + i]));
        let length = announced.min((bytes.len() - payload) as u64);
        bytes[at + 4..at + 12].copy_from_slice(&length.to_le_bytes());
        let end = payload + length as usize;
        if &bytes[at..at + 4] != b"COUP" {
            let checksum = crc32fast::hash(&bytes[payload..end]);
            bytes[at + 12..at + 16].copy_from_slice(&checksum.to_le_bytes());
        }
        at = end;
    }
    bytes
}

fuzz_target!(
    init: {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/corpus/snapshot");
        std::fs::create_dir_all(folder).expect("a folder for the corpus");
        for (name, text) in [("plain", PLAIN.to_owned()), ("tools", format!("{PLAIN}{TOOLS}"))] {
            let scene = Scene::from_str(&text, name, "").unwrap_or_else(|e| panic!("{e}"));
            let mut simulation = Simulation::new(registry(), &scene, &options()).unwrap_or_else(|e| panic!("{e}"));
            simulation.save(format!("{folder}/{name}-start")).expect("a seed");
            (0..3).for_each(|_| drop(simulation.step().expect("a step")));
            simulation.save(format!("{folder}/{name}")).expect("a seed");
        }
    },
    |data: &[u8]| {
        static FILE: OnceLock<PathBuf> = OnceLock::new();
        let file = FILE.get_or_init(|| std::env::temp_dir().join(format!("barchan-fuzz-{}", std::process::id())));
        std::fs::write(file, mended(data)).expect("a file to resume from");
        if let Ok(mut simulation) = Simulation::resume(registry(), file, &options()) {
            for _ in 0..2 {
                if simulation.step().is_err() {
                    break;
                }
            }
            let _ = simulation.ledger();
        }
    }
);
