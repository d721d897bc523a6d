//! Any bytes are a snapshot or an error, and what can be resumed can be stepped or says why not.
//!
//! Checksums would turn almost every mutation away at the door: they are mended first, so that what lies behind is reached. Not
//! those of couplings, whose panics are caught and become errors, but libfuzzer aborts at any panic, caught or not; `rigid-couple/tests` tries
//! every byte of such a state instead.
#![no_main]

use barchan::Registry;
use barchan_tests::snapshots::{mended, try_resume, write_seeds};
use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::OnceLock;

static REGISTRY: OnceLock<Registry> = OnceLock::new();

fn registry() -> &'static Registry {
    REGISTRY.get_or_init(barchan::registry)
}

fuzz_target!(
    init: {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/corpus/snapshot");
        std::fs::create_dir_all(folder).expect("a folder for the corpus");
        write_seeds(registry(), folder.as_ref()).expect("seeds");
    },
    |data: &[u8]| {
        static FILE: OnceLock<PathBuf> = OnceLock::new();
        let file = FILE.get_or_init(|| std::env::temp_dir().join(format!("barchan-fuzz-{}", std::process::id())));
        try_resume(registry(), file, &mended(data));
    }
);
