//! Robots beside the wgpu backend's ground.

use barchan::worlds::Worlds;
use barchan::{Options, Precision, Scene, Simulation};
use glam::DVec3;

/// A quadruped that lands on a bed with half a metre a second, on one level or two.
fn landing(levels: u32, x: f64) -> Scene {
    let text = format!(
        r#"
name = "landing"
world = {{ cell = 0.03125, min = [0, 0, 0], max = [1, 0.75, 1], walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }} }}
levels = {{ count = {levels}, half = 8 }}
time = {{ end = 1, step = 5e-4 }}
[[material]]
name = "sand"
law = "sand"
density = 1600
parameters = {{ young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35 }}
[[body]]
name = "bed"
material = "sand"
shape = {{ box = {{ min = [0, 0, 0], max = [1, 0.75, 0.1875] }} }}
settled = true
[[robot]]
name = "dog"
model = "quadruped"
position = [{x}, 0.375, 0.515]
velocity = [0.2, 0, -0.5]
joints = {{ "*_thigh_joint" = 0.8, "*_calf_joint" = -1.6 }}
motor = [{{ kp = 100, kd = 3 }}]
"#
    );
    Scene::from_str(&text, "landing.toml", "").unwrap()
}

fn options(backend: &str, precision: Precision) -> Options {
    Options { backend: backend.into(), precision, threads: 1, ..Options::default() }
}

fn start(scene: &Scene, backend: &str, precision: Precision) -> Simulation {
    Simulation::new(&barchan::registry(), scene, &options(backend, precision)).unwrap()
}

/// After a landing base and joints are where they are on the CPU in f64.
#[test]
fn a_robot_lands_as_it_does_on_the_cpu() {
    for levels in [1, 2] {
        let scene = landing(levels, 0.5);
        let (mut device, mut cpu) = (start(&scene, "wgpu", Precision::F32), start(&scene, "cpu", Precision::F64));
        let most = |simulation: &Simulation| simulation.wrenches().iter().map(|w| w.force[2]).sum::<f64>();
        let mut strongest = 0.0_f64;
        for _ in 0..300 {
            device.step().unwrap();
            cpu.step().unwrap();
            strongest = strongest.max(most(&cpu));
        }
        let base = |simulation: &Simulation| DVec3::from_array(simulation.bodies()[0].position);
        let apart = (base(&device) - base(&cpu)).length();
        let joints = device.joints().into_iter().zip(cpu.joints());
        let turned = joints.map(|(a, b)| (a.position - b.position).abs()).fold(0.0, f64::max);
        println!(
            "{levels} levels: base {apart:.1e} m apart (1e-4), joints {turned:.1e} rad (1e-3); up to {strongest:.0} N"
        );
        assert!(strongest > 150.0, "it has not landed");
        assert!(apart < 1e-4 && turned < 1e-3, "{levels} levels: {apart} m, {turned} rad");
    }
}

/// A world of a batch with robots is the world alone, bit for bit, on both backends.
#[test]
fn robots_in_many_worlds_move_as_alone() {
    for backend in ["cpu", "wgpu"] {
        let scenes = vec![landing(1, 0.45), landing(1, 0.5)];
        let mut worlds = Worlds::new(&barchan::registry(), scenes, &options(backend, Precision::F32)).unwrap();
        let mut alone = [0.45, 0.5].map(|x| landing(1, x)).map(|scene| start(&scene, backend, Precision::F32));
        for _ in 0..60 {
            worlds.step().into_iter().for_each(|step| drop(step.unwrap()));
            alone.iter_mut().for_each(|world| drop(world.step().unwrap()));
        }
        for (w, alone) in alone.iter().enumerate() {
            let of = |simulation: &Simulation| format!("{:?} {:?}", simulation.bodies(), simulation.joints());
            assert_eq!(of(worlds.world(w)), of(alone), "{backend}: world {w}");
        }
    }
}
