//! A pole is pushed into sand. Boxes around all of it must be large to hold enough fine ground below its tip, boxes around its lowest point need not: the plan tells
//! how many particles that saves before anything runs.
//!
//! `cargo run --release -p barchan --example fine_tip`

use barchan::{Options, Result, Scene, Simulation};

const SCENE: &str = r#"
name = "fine-tip"

[world]
cell = 0.01
min = [0.0, 0.0, 0.0]
max = [0.96, 0.96, 0.96]
walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }

[levels]
count = 3
half = 12
agents = [{ name = "pole", at = "lowest" }]

[time]
end = 0.1

[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = { young_modulus = 1e6, poisson_ratio = 0.2, friction_angle_deg = 35.0 }

[[body]]
name = "bed"
material = "sand"
settled = true
shape = { box = { min = [0.0, 0.0, 0.0], max = [0.96, 0.96, 0.4] } }

[[tool]]
name = "pole"
shape = { box = { half = [0.03, 0.03, 0.12] } }
position = [0.48, 0.48, 0.49]
contact = { coulomb = { friction = 0.4 } }
motion = { velocity = { linear = [0.0, 0.0, -0.5] } }
"#;

fn main() -> Result<()> {
    let registry = barchan::registry();
    let start = |agents: &str| {
        let mut scene = Scene::from_str(SCENE, "fine_tip.rs", "")?;
        scene.set(&[format!("levels.agents={agents}")])?;
        Simulation::new(&registry, &scene, &Options::default())
    };
    // With less than 22 the plan warns that there may be fewer than 6 fine cells below the tip; around the tip alone, 10 are enough.
    let whole = start(r#"[{ name = "pole", half = 22 }]"#)?;
    let mut tip = start(r#"[{ name = "pole", at = "lowest" }]"#)?;
    println!("{}", tip.plan());
    let [whole, at_tip] = [&whole, &tip].map(|simulation| simulation.plan().particle_count);
    println!("{at_tip} particles with fine cells around the tip, {whole} with fine cells around all of the pole");
    assert!(2 * at_tip < whole, "a small box holds less: {at_tip}, {whole}");

    let mass = tip.ledger().mass;
    while tip.time() < 0.1 {
        tip.step()?;
    }
    assert!((tip.ledger().mass / mass - 1.0).abs() < 1e-6, "splits and merges keep all mass");
    println!("force on the pole: {:?} N", tip.wrenches().first().map(|wrench| wrench.force));
    Ok(())
}
