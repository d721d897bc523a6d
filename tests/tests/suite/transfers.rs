//! The engine against the plain reference, to rounding.

use barchan::{Precision, Simulation};
use barchan_tests::reference::{Ends, Law, Particle, Reference};
use barchan_tests::scenes::{Noise, alter, rows, simulation};
use nalgebra::{Matrix3, Vector3};

const H: f64 = 0.05;

/// A twisting, stretching jittered block near the walls of a small world, so that every kind of side is touched.
fn block(law: &str, walls: &str, gravity: &str) -> String {
    format!(
        r#"
        name = "block"
        seed = 7
        gravity = {gravity}
        [world]
        cell = {H}
        min = [0.0, 0.0, 0.0]
        max = [0.6, 0.6, 0.6]
        leaving = "clamp"
        [world.walls]
        {walls}
        [time]
        end = 1.0
        step = 2e-4
        [[material]]
        name = "m"
        law = "{law}"
        density = 1000.0
        parameters = {{ young_modulus = 1e5, poisson_ratio = 0.3 }}
        [[body]]
        material = "m"
        shape = {{ box = {{ min = [0.0, 0.1, 0.0], max = [0.3, 0.6, 0.3] }} }}
        sampling = "jitter"
        velocity = [-0.5, 0.3, -1.0]
        angular_velocity = [3.0, -2.0, 4.0]
        "#
    )
}

fn reference_of(simulation: &Simulation, law: Law, ends: [Ends; 3], gravity: Vector3<f64>) -> Reference {
    let particles = rows(simulation)
        .into_iter()
        .map(|r| Particle {
            x: r.x.into(),
            v: r.v.into(),
            c: Matrix3::from_row_slice(&r.c),
            b: {
                let s = &r.strain;
                Matrix3::new(s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2])
            },
            vc: r.state.first().copied().unwrap_or(0.0),
            m: r.m,
            volume0: r.volume0,
        })
        .collect();
    Reference { h: H, cells: [12; 3], ends, gravity, law, particles, strain_dt: 0.0 }
}

/// Runs both for `steps` and returns the greatest differences of position [m], velocity [m/s] and strain.
fn compare(law: &str, walls: &str, ends: [Ends; 3], steps: usize, precision: Precision) -> [f64; 3] {
    let (young, nu) = (1e5, 0.3);
    let (mu, lambda) = (young / (2.0 * (1.0 + nu)), young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)));
    let sin = std::f64::consts::FRAC_PI_4.sin();
    let laws = match law {
        "sand" => Law::Sand { lambda, mu, alpha: (2f64 / 3.0).sqrt() * 2.0 * sin / (3.0 - sin) },
        _ => Law::NeoHookean { lambda, mu },
    };
    let gravity = Vector3::new(0.4, -0.2, -9.81);
    let mut text = block(law, walls, "[0.4, -0.2, -9.81]");
    if ends[0] == Ends::Open {
        // Close to the sides, but nobody leaves: the reference puts nobody back.
        text = text
            .replace("min = [0.0, 0.1, 0.0], max = [0.3, 0.6, 0.3]", "min = [0.01, 0.1, 0.01], max = [0.3, 0.59, 0.3]");
    }
    let mut ours = simulation(&text, precision);
    let mut noise = Noise::new(3);
    alter(&mut ours, |r| {
        for v in &mut r.v {
            *v += 0.1 * noise.draw();
        }
    });
    let mut plain = reference_of(&ours, laws, ends, gravity);
    let mut worst = [0f64; 3];
    for _ in 0..steps {
        let dt = ours.step().unwrap().dt;
        plain.step(dt);
    }
    let period = 12.0 * H;
    for (r, p) in rows(&ours).iter().zip(&plain.particles) {
        for d in 0..3 {
            // On a periodic axis the two may name the same place differently.
            let gap = (r.x[d] - p.x[d]).abs();
            worst[0] = worst[0].max(gap.min((gap - period).abs()));
            worst[1] = worst[1].max((r.v[d] - p.v[d]).abs());
        }
        for (plane, (i, j)) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
            worst[2] = worst[2].max((r.strain[plane] - p.b[(i, j)]).abs());
        }
    }
    println!("{law} {walls}: x {:.1e} m, v {:.1e} m/s, b {:.1e} after {steps} steps", worst[0], worst[1], worst[2]);
    worst
}

/// Blocks, tiles, lanes and sorting are only a faster way to compute the same sums: any slip in halo, mirror, wrap or
/// permutation would show here at the first step.
#[test]
fn engine_equals_the_plain_reference_in_f64() {
    let open = "";
    let slip =
        "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"\nz_max = \"slip\"";
    let stick = slip.replace("slip", "stick");
    let periodic = slip.replace("slip", "periodic");
    let mixed = "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"\nz_max = \"stick\"";
    for law in ["neo_hookean", "sand"] {
        for (walls, ends) in [
            (slip, [Ends::Slip; 3]),
            (stick.as_str(), [Ends::Stick; 3]),
            (periodic.as_str(), [Ends::Periodic; 3]),
            (mixed, [Ends::Periodic, Ends::Slip, Ends::Stick]),
        ] {
            let [x, v, b] = compare(law, walls, ends, 60, Precision::F64);
            assert!(x < 1e-12 && v < 1e-10 && b < 1e-10, "{law}, {walls}: {x:.1e} m, {v:.1e} m/s, strain {b:.1e}");
        }
    }
    let [x, ..] = compare("neo_hookean", open, [Ends::Open; 3], 12, Precision::F64);
    assert!(x < 1e-12);
}

/// The same in f32, where only rounding may differ: positions to a few 1e-7 of the distance moved.
#[test]
fn engine_equals_the_plain_reference_in_f32_to_rounding() {
    let slip =
        "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"\nz_max = \"slip\"";
    let [x, v, b] = compare("neo_hookean", slip, [Ends::Slip; 3], 60, Precision::F32);
    assert!(x < 1e-6 && v < 1e-3 && b < 1e-4, "{x:.1e} m, {v:.1e} m/s, strain {b:.1e}");
}
