//! A blade is drawn through sand, and the force on it points back and is about as large as soil mechanics says.
//!
//! `cargo run --release -p barchan --example drag_tool`

use barchan::{Options, Result, Scene, Simulation};

const SCENE: &str = r#"
name = "drag-tool"

[world]
cell = 0.0125
min = [0.0, 0.0, 0.0]
max = [0.5, 0.3, 0.3]
walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }

[time]
end = 0.5
safety = 0.8

[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = { young_modulus = 2e5, friction_angle_deg = 32.0, cone = 1.0 }

[[body]]
name = "bed"
material = "sand"
shape = { box = { min = [0.0, 0.0, 0.0], max = [0.5, 0.3, 0.1] } }

[[tool]]
name = "blade"
shape = { box = { half = [0.0125, 0.05, 0.06] } }
position = [0.12, 0.15, 0.11]
contact = { coulomb = { friction = 0.4 } }
motion = { velocity = { linear = [0.4, 0.0, 0.0] } }
"#;

fn main() -> Result<()> {
    let scene = Scene::from_str(SCENE, "drag_tool.rs", "")?;
    let mut simulation = Simulation::new(&barchan::registry(), &scene, &Options::default())?;
    println!("{}", simulation.plan());

    // The mean force while the blade is at full speed and its bow wave is there.
    let (mut impulse, mut seconds) = ([0.0; 3], 0.0);
    while simulation.time() < scene.time.end {
        let dt = simulation.step()?.dt;
        if simulation.time() > 0.15 {
            let force = simulation.wrenches()[0].force;
            (0..3).for_each(|d| impulse[d] += force[d] * dt);
            seconds += dt;
        }
    }
    let force = impulse.map(|i| i / seconds);
    println!("mean force on the blade ({:.2}, {:.2}, {:.2}) N", force[0], force[1], force[2]);

    // Passive earth pressure on a smooth wall, 1/2 rho g d² b (1 + sin phi) / (1 - sin phi), is the least that such a
    // blade needs; wedges at its sides, friction and the heap before it add up to several times as much.
    let (depth, width, phi) = (0.05f64, 0.1, 32f64.to_radians());
    let passive = 0.5 * 1600.0 * 9.81 * depth.powi(2) * width * (1.0 + phi.sin()) / (1.0 - phi.sin());
    println!("passive earth pressure on a smooth wall of its size: {passive:.2} N");
    assert!(force[0] < 0.0, "sand must hold the blade back, not push it");
    assert!((1.0..8.0).contains(&(-force[0] / passive)), "{:.2} N against {passive:.2} N", force[0]);
    assert!(force[1].abs() < 0.1 * force[0].abs(), "the scene is symmetric, the force is not: {} N", force[1]);
    Ok(())
}
