//! Particles that leave the world where that is an error.

use crate::scenes::{options, scene};
use crate::sketch::{Head, block, material};
use barchan::{Error, Options, Precision, Simulation};

/// Lets a block drift out of an open side that cuts cells, on one to three levels, slowly and fast: the run ends before any particle is further out than a
/// cell of its level, and not before one is out.
///
/// # Panics
/// If it does not.
pub fn hold(backend: &str) {
    let (h, side) = (0.1, 0.83);
    for levels in 1..=3 {
        for speed in [0.2, 1.0, 30.0] {
            let head = Head { gravity: [0.0; 3], min: [-side; 3], max: [side; 3], ..Head::space(h) };
            // Levels without agents: all is on the coarsest.
            let nested = format!("[levels]\ncount = {levels}\nhalf = 8\nagents = []\n");
            let drifting = format!("velocity = [{speed}, 0, 0]");
            let text = head.time("step = 2e-3\nover_bound = \"substep\"").with(&[
                material("neo_hookean", 1000.0, "young_modulus = 1e5"),
                block("neo_hookean", [0.4, -0.2, -0.2], [0.8, 0.2, 0.2], &drifting),
                nested,
            ]);
            let options = Options { backend: backend.to_owned(), ..options(Precision::F32) };
            let run = Simulation::new(&barchan::registry(), &scene(&text), &options);
            let mut run = run.unwrap_or_else(|e| panic!("{e}"));
            let width = h * f64::from(1 << (levels - 1));
            let farthest = |run: &Simulation| {
                let spots = run.spots();
                spots.iter().map(|spot| (spot.position[0] - side) / width).fold(f64::MIN, f64::max)
            };
            // The slowest would need 16 s to be two cells out.
            let error = loop {
                match run.steps(50, f64::INFINITY) {
                    Ok(_) => assert!(farthest(&run) <= 1.0, "{backend}, {levels} levels: {speed} m/s goes unnoticed"),
                    Err(error) => break error,
                }
            };
            let Error::LeftWorld { position, .. } = error else { panic!("{backend}, {levels} levels: {error}") };
            let [named, most] = [(position[0] - side) / width, farthest(&run)];
            println!(
                "{backend}, {levels} levels, {speed} m/s: one is named {named:.3} cells out, the farthest is {most:.3}"
            );
            assert!(named >= 0.0 && most <= 1.0, "{backend}, {levels} levels, {speed} m/s");
        }
    }
}
