//! Speed of quadrupeds in many worlds at once: `cargo run --release -p barchan-tests --example robot_worlds -- [--worlds 64] [--backend wgpu] [--threads 2] [--control 50] [--self-collision false]`.
//!
//! Each world has a robot that stands in sand (E = 2e5 Pa, cells of 1/32 m, 18 432 particles, periodic in x and y) and is told other joint targets 50 times a
//! second; its links touch one another if asked for. Prints control steps a second of all worlds together, and whether the first world is the same bit for bit as it is alone.

use barchan::worlds::Worlds;
use barchan::{Command, Options, Precision, Scene, Simulation};
use barchan_tests::arguments;
use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Instant;

/// Time between two commands [s].
const CONTROL: f64 = 0.02;

fn main() -> ExitCode {
    arguments::run(run)
}

fn scene() -> Scene {
    let text = r#"
name = "standing"
world = { cell = 0.03125, min = [0, 0, 0], max = [0.75, 0.5, 1], walls = { x_min = "periodic", x_max = "periodic", y_min = "periodic", y_max = "periodic", z_min = "stick" } }
time = { end = 10, step = 1.25e-3 }
[[material]]
name = "sand"
law = "sand"
density = 1600
parameters = { young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 40 }
[[body]]
name = "bed"
material = "sand"
shape = { box = { min = [0, 0, 0], max = [0.75, 0.5, 0.1875] } }
settled = true
[[robot]]
name = "dog"
model = "quadruped"
position = [0.375, 0.25, 0.5]
joints = { "*_thigh_joint" = 0.8, "*_calf_joint" = -1.6 }
motor = [{ kp = 150, kd = 4 }]
"#;
    Scene::from_str(text, "standing.toml", "").expect("the scene of this program is one")
}

/// What a world is told for the n-th time.
fn targets(world: usize, n: usize) -> Command {
    let swing = 0.1 * (0.4 * n as f64 + world as f64).sin();
    Command::JointTargets([0.0, 0.8 + swing, -1.6 - swing].repeat(4))
}

fn run(given: &[String]) -> Result<(), String> {
    let mut options: BTreeMap<&str, &str> = [
        ("--worlds", "64"),
        ("--backend", "wgpu"),
        ("--threads", "2"),
        ("--control", "50"),
        ("--self-collision", "false"),
    ]
    .into();
    let known: Vec<&str> = options.keys().copied().collect();
    options.extend(arguments::options(given, &known)?);
    let number = |key: &str| options[key].parse::<usize>().map_err(|_| format!("{key} wants a whole number"));
    let (count, control, threads) = (number("--worlds")?, number("--control")?, number("--threads")?);
    let touches = options["--self-collision"].parse().map_err(|_| "--self-collision wants true or false")?;
    let mut scene = scene();
    scene.robot[0].self_collision = touches;
    let backend = options["--backend"].to_owned();
    let options = Options { backend, precision: Precision::F32, threads, ..Options::default() };
    let failed = |e: barchan::Error| e.to_string();
    let mut worlds = Worlds::new(&barchan::registry(), vec![scene.clone(); count], &options).map_err(failed)?;
    let mut alone = Simulation::new(&barchan::registry(), &scene, &options).map_err(failed)?;
    let particles = alone.particle_count();
    let steps = (CONTROL / 1.25e-3_f64).round() as usize;
    let mut clock = Instant::now();
    let warm_up = 10;
    for n in 0..warm_up + control {
        if n == warm_up {
            clock = Instant::now();
        }
        for world in 0..count {
            worlds.world_mut(world).act("dog", &targets(world, n)).map_err(failed)?;
        }
        for reports in worlds.steps(steps) {
            reports.map_err(failed)?;
        }
    }
    let seconds = clock.elapsed().as_secs_f64();
    for n in 0..warm_up + control {
        alone.act("dog", &targets(0, n)).map_err(failed)?;
        let mut taken = 0;
        while taken < steps {
            taken += alone.steps(steps - taken, f64::INFINITY).map_err(failed)?.len();
        }
    }
    let left = |of: &Simulation| format!("{:?} {:?}", of.bodies(), of.joints());
    let same = if left(worlds.world(0)) == left(&alone) { "the same bits as alone" } else { "OTHER BITS THAN ALONE" };
    let rate = (count * control) as f64 / seconds;
    println!(
        "{count} worlds of {particles} particles: {rate:.0} control steps/s, {:.2} of real time each; {:.2} ms a step of all; {same}",
        control as f64 * CONTROL / seconds,
        1e3 * seconds / (control * steps) as f64,
    );
    for timing in worlds.world(0).timings().iter().filter(|timing| timing.passes > 0) {
        let each = 1e6 * timing.seconds / timing.passes as f64;
        println!("  {:<28} {:>7} passes, {each:.1} µs each", timing.effect, timing.passes);
    }
    Ok(())
}
