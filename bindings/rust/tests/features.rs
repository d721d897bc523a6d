//! What each feature adds is there with it, and refused by name without it.
//!
//! `cargo test -p barchan --no-default-features --test features` is the other half.

use barchan::run::{Existing, Request, Until, run};
use barchan::{Options, Scene, Simulation};

const SCENE: &str = r#"
name = "cube"

[world]
cell = 0.05
min = [0.0, 0.0, 0.0]
max = [0.4, 0.4, 0.4]
walls = { z_min = "slip" }

[time]
end = 1.0

[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000.0
parameters = { young_modulus = 2e4 }

[[body]]
material = "jelly"
shape = { box = { min = [0.1, 0.1, 0.1], max = [0.3, 0.3, 0.3] } }
"#;

#[test]
fn the_backend_wgpu_is_there_with_its_feature() {
    let registry = barchan::registry();
    let found: Vec<_> = registry.backends().map(|backend| backend.name().to_owned()).collect();
    assert_eq!(found, if cfg!(feature = "wgpu") { vec!["cpu", "wgpu"] } else { vec!["cpu"] });
}

/// Without pictures a run that asks for some ends before it touches its folder, and one that asks for none leaves all else.
#[test]
fn pictures_are_made_with_their_feature() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::from_str(SCENE, "features.rs", "").unwrap();
    let attempt = |name: &str, pictures: bool| {
        let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default()).unwrap();
        let out = folder.path().join(name);
        let request =
            Request { out, until: Until::Step(2), pictures, export: None, existing: Existing::Refuse, swap: None };
        run(&mut simulation, &request, &mut |_| std::ops::ControlFlow::Continue(()))
    };
    let is_there = |path: &str| folder.path().join(path).exists();

    attempt("plain", false).unwrap();
    assert!(is_there("plain/trace.csv") && is_there("plain/snapshot.barchan") && !is_there("plain/frames/00000.png"));

    let drawn = attempt("drawn", true);
    if cfg!(feature = "pictures") {
        drawn.unwrap();
        assert!(is_there("drawn/frames/00000.png") && is_there("drawn/contact-sheet.png"));
    } else {
        let error = drawn.unwrap_err().to_string();
        assert!(error.contains("crate 'barchan' (built without the feature 'pictures') has no pictures"), "{error}");
        assert!(!is_there("drawn"), "the folder was made");
    }
}
