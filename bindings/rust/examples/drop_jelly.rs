//! An elastic cube falls onto a smooth floor, and the impulse that the floor gives is what physics says.
//!
//! `cargo run --release -p barchan --example drop_jelly`

use barchan::{Options, Result, Scene, Simulation};

const SCENE: &str = r#"
name = "drop-jelly"

[world]
cell = 0.02
min = [0.0, 0.0, 0.0]
max = [0.4, 0.4, 0.4]
walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = { separate = {} } }

[time]
end = 0.5

[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000.0
parameters = { young_modulus = 2e4, poisson_ratio = 0.3 }

[[body]]
name = "cube"
material = "jelly"
shape = { box = { min = [0.12, 0.12, 0.1], max = [0.28, 0.28, 0.26] } }
"#;

fn main() -> Result<()> {
    let scene = Scene::from_str(SCENE, "drop_jelly.rs", "")?;
    let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
    println!("{}", simulation.plan());

    let start = simulation.ledger();
    let centre = |simulation: &Simulation| {
        let particles = simulation.particles();
        let list = &particles.lists[0];
        (0..list.len()).map(|i| list.position(i)[2]).sum::<f64>() / list.len() as f64
    };
    let mut lowest = f64::INFINITY;
    while simulation.time() < scene.time.end {
        simulation.step()?;
        lowest = lowest.min(centre(&simulation));
    }
    let end = simulation.ledger();

    println!("the middle of the cube went down to {lowest:.4} m and is at {:.4} m now", centre(&simulation));
    println!(
        "momentum {:.4} kg m/s, from gravity {:.4}, from walls {:.4}",
        end.momentum[2], end.gravity_impulse[2], end.wall_impulse[2]
    );

    // It fell 0.1 m, met the floor with its lower side, and was squashed below the height it has at rest.
    assert!(lowest < 0.08, "the cube was not squashed: its middle stayed above {lowest} m");
    // Mass is kept to the last bit of the sum, and momentum is what gravity and the floor gave.
    assert!((end.mass - start.mass).abs() <= 1e-12 * start.mass);
    let change = end.momentum[2] - start.momentum[2];
    let given = end.gravity_impulse[2] + end.wall_impulse[2];
    assert!(
        (change - given).abs() < 1e-3 * end.gravity_impulse[2].abs(),
        "momentum changed by {change}, given {given}"
    );
    // Contact and APIC dissipate, and nothing adds energy.
    assert!(end.energy() < start.energy(), "energy grew from {} to {} J", start.energy(), end.energy());
    Ok(())
}
