//! Any text is a scene or an error. What is a scene survives being written and read again, and can be assembled or is refused.
#![no_main]

use barchan::{Options, Plan, Registry, Scene};
use libfuzzer_sys::fuzz_target;
use std::sync::OnceLock;

static REGISTRY: OnceLock<Registry> = OnceLock::new();

fn read(text: &str) -> Result<Scene, barchan::Error> {
    Scene::from_str(text, "fuzz.toml", "/nowhere")
}

fuzz_target!(
    init: {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/corpus/scene");
        std::fs::create_dir_all(folder).expect("a folder for the corpus");
        for (name, text) in barchan::tasks::scenes() {
            std::fs::write(format!("{folder}/{name}.toml"), text).expect("a seed");
        }
    },
    |data: &[u8]| {
        let Ok(text) = std::str::from_utf8(data) else { return };
        let Ok(scene) = read(text) else { return };
        let written = scene.to_toml().expect("a scene can be written");
        let again = read(&written).unwrap_or_else(|e| panic!("what was written is refused: {e}\n{written}"));
        assert_eq!(again.to_toml().expect("a scene can be written"), written);
        let options = Options { threads: 1, max_bytes: Some(1 << 20), ..Options::default() };
        if let Ok((plan, particles, _)) = Plan::assemble(REGISTRY.get_or_init(barchan::registry), &scene, &options) {
            assert_eq!(plan.particle_count, particles.lists.iter().map(|list| list.len()).sum::<usize>());
            assert!(plan.dt > 0.0 && plan.dt.is_finite(), "the plan's step is {}", plan.dt);
            assert!(!plan.to_string().is_empty());
        }
    }
);
