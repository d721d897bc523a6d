//! What no scene may do to the backend: panic, or run otherwise because somebody looks.

use super::{gpu, on};
use barchan::picture::View;
use barchan::{Ledger, Precision, Simulation};
use barchan_tests::random::{Generator, Judge, Outcome, write_files};
use barchan_tests::scenes::{minus, norm, scene, within};
use barchan_tests::sketch::{Head, bed, block, half, material, tool};

/// Symptom: a picture of a scene in which some level holds no particle panics ("volumes are in the last"): the finest level follows a tool that is
/// still in the air, or all ground is near enough to be fine.
#[test]
fn a_level_without_particles_has_its_picture() {
    let (head, mut parts) = bed(0.05, [16, 16], 2, 62, "young_modulus = 1e5");
    parts.push(tool(
        "ball",
        [0.4, 0.4, 2.2],
        "sphere = { radius = 0.1 }",
        "\"slip\"",
        "{ velocity = { linear = [0, 0, -1] } }",
    ));
    for nested in ["count = 2\nhalf = 8", "count = 3\nhalf = 32"] {
        let mut text = head.with(&parts).replace("x_min = \"periodic\"", "x_min = \"slip\"");
        for side in ["x_max", "y_min", "y_max"] {
            text = text.replace(&format!("{side} = \"periodic\""), &format!("{side} = \"slip\""));
        }
        let text = text + &format!("[levels]\n{nested}\n");
        let mut sky = gpu(&text);
        let empty = sky.particles().lists.iter().filter(|list| list.is_empty()).count();
        assert!(empty > 0, "{nested}: the test must see a level without particles");
        for _ in 0..2 {
            let spots = sky.spots();
            assert_eq!(spots.len(), sky.particle_count());
            let mass: f64 = spots.iter().map(|spot| 1500.0 * spot.volume0).sum();
            within(&format!("{nested}: mass in the picture, off"), (mass / sky.ledger().mass - 1.0).abs(), 1e-5);
            View::new(&sky).draw(&sky).unwrap_or_else(|e| panic!("{e}"));
            sky.steps(5, f64::INFINITY).unwrap_or_else(|e| panic!("{e}"));
        }
    }
}

/// Symptom: a scene without soft bodies fails with an error in a shader that is "an error in Barchan". Its bodies move as on the CPU.
#[test]
fn bodies_without_ground_need_no_material() {
    let head = Head::cells(0.05, [8, 8, 8], "z_min = \"slip\"");
    let text = head.with(&[
        tool("fixed", [0.2, 0.2, 0.1], "sphere = { radius = 0.1 }", "\"stick\"", "\"fixed\""),
        tool("free", [0.22, 0.2, 0.3], &half([0.04; 3]), "\"slip\"", "{ free = { mass = 1, angular = [0, 2, 0] } }"),
    ]);
    let [mut cpu, mut gpu] = ["cpu", "wgpu"].map(|backend| on(backend, Precision::F32, &text));
    for _ in 0..40 {
        assert_eq!(cpu.step().unwrap().dt, gpu.step().unwrap().dt);
    }
    assert_eq!(cpu.bodies(), gpu.bodies());
    assert!(cpu.bodies()[1].position[2] < 0.27, "it must have fallen");
    assert_eq!((gpu.particle_count(), gpu.spots().len()), (0, 0));
    View::new(&gpu).draw(&gpu).unwrap_or_else(|e| panic!("{e}"));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bodies.barchan");
    gpu.save(&file).unwrap();
    let options = barchan::Options { backend: "wgpu".into(), ..Default::default() };
    let resumed = Simulation::resume(&barchan::registry(), &file, &options).unwrap();
    assert_eq!(resumed.bodies(), gpu.bodies());
}

/// Random scenes are near the CPU's.
#[test]
fn random_scenes_are_as_on_the_cpu() {
    let folder = tempfile::tempdir().unwrap();
    write_files(folder.path()).unwrap();
    let generator = Generator::new(&barchan::registry());
    let judge = Judge::new(barchan::registry(), folder.path(), 20, Some("wgpu".to_owned()));
    let mut ran = 0;
    for seed in 1000..1012 {
        match judge.judge(&generator.scene(seed)) {
            Outcome::Ran(..) => ran += 1,
            Outcome::Refused(_) => {}
            Outcome::Failed(failure) => panic!("seed {seed}: {}: {}", failure.rule, failure.what),
        }
    }
    assert!(ran >= 6, "{ran} ran");
}

/// A run that is gone on with keeps its books: what walls and gravity gave is that of a whole run.
#[test]
fn a_resumed_run_keeps_its_books() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("half.barchan");
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let text = Head::cells(0.05, [12, 12, 12], walls).time("step = 1e-3").with(&[
        material("neo_hookean", 900.0, "young_modulus = 5e4"),
        block("neo_hookean", [0.05, 0.05, 0.0], [0.3, 0.3, 0.2], "velocity = [-1, 0.5, -2]\nsampling = \"jitter\""),
    ]);
    let options = barchan::Options { backend: "wgpu".into(), ..Default::default() };
    let mut whole = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
    let steps = |simulation: &mut Simulation, count: usize| {
        let end = simulation.step_count() + count as u64;
        while simulation.step_count() < end {
            simulation.steps((end - simulation.step_count()) as usize, f64::INFINITY).unwrap();
        }
    };
    steps(&mut whole, 40);
    whole.save(&file).unwrap();
    let mut resumed = Simulation::resume(&barchan::registry(), &file, &options).unwrap();
    steps(&mut whole, 40);
    steps(&mut resumed, 40);
    assert!(whole.particles() == resumed.particles(), "particles differ");
    let (a, b): (Ledger, Ledger) = (whole.ledger(), resumed.ledger());
    assert!(norm(a.wall_impulse) > 0.1, "walls must have had a part in it");
    assert_eq!(a.gravity_impulse.map(f64::to_bits), b.gravity_impulse.map(f64::to_bits));
    within("walls' impulse, of itself", norm(minus(a.wall_impulse, b.wall_impulse)) / norm(a.wall_impulse), 0.0);
}
