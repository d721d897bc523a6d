//! Robots and tools that are put elsewhere while a scene runs.

use super::root;
use barchan::{BodyState, Command, Options, Placement, Precision, Scene, Simulation, State};
use barchan_rigid::robot::RobotModel;
use barchan_tests::scenes::everywhere;
use glam::DVec3;

/// Where the dog is put, and how it moves there: half a millimetre above the bed, falling on it.
const THERE: [f64; 3] = [2.5, 0.375, 0.505];
const FALL: [f64; 3] = [0.2, 0.0, -0.5];

/// A quadruped above one end of a bed, or where it will be put; `more` besides.
fn above_bed(position: [f64; 3], velocity: [f64; 3], calf: f64, more: &str) -> Scene {
    let text = format!(
        r#"
name = "placed"
world = {{ cell = 0.03125, min = [0, 0, 0], max = [3, 0.75, 1], walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }} }}
time = {{ end = 1, step = 5e-4 }}
[[material]]
name = "sand"
law = "sand"
density = 1600
parameters = {{ young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35 }}
[[body]]
name = "bed"
material = "sand"
shape = {{ box = {{ min = [0, 0, 0], max = [3, 0.75, 0.1875] }} }}
settled = true
[[robot]]
name = "dog"
model = "quadruped"
position = {position:?}
velocity = {velocity:?}
joints = {{ "*_thigh_joint" = 0.8, "*_calf_joint" = {calf} }}
motor = [{{ kp = 100, kd = 3 }}]
{more}"#
    );
    Scene::from_str(&text, "placed.toml", root()).unwrap()
}

fn start(scene: &Scene, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), scene, options).unwrap()
}

fn resumed(state: &State, options: &Options) -> Simulation {
    Simulation::from_state(&barchan::registry(), state, options).unwrap()
}

fn steps(simulation: &mut Simulation, count: usize) {
    (0..count).for_each(|_| drop(simulation.step().unwrap()));
}

/// How far bodies are apart at most [m].
fn apart(one: &Simulation, other: &Simulation) -> f64 {
    let off = |(a, b): (BodyState, BodyState)| DVec3::from_array(a.position).distance(DVec3::from_array(b.position));
    one.bodies().into_iter().zip(other.bodies()).map(off).fold(0.0, f64::max)
}

/// A robot that is put elsewhere lands there as one that began there: on one level and on several, whose boxes come along, and on every backend.
#[test]
fn a_robot_that_is_put_elsewhere_is_as_if_it_had_begun_there() {
    let tall = [0.5, 0.375, 0.7];
    for (levels, near) in [("", 3e-6), ("[levels]\ncount = 2\nhalf = 8\n", 2e-4)] {
        for options in everywhere() {
            let what =
                format!("{} {}{}", options.backend, options.precision, if levels.is_empty() { "" } else { ", levels" });
            let mut fresh = start(&above_bed(THERE, FALL, -1.6, levels), &options);
            let mut dog = start(&above_bed(tall, [0.0; 3], -1.4, levels), &options);
            dog.act("dog", &Command::JointTargets([0.0, 0.8, -1.6].repeat(4))).unwrap();
            steps(&mut dog, 20);
            let placement = Placement {
                position: Some(THERE),
                rotation: Some([1.0, 0.0, 0.0, 0.0]),
                velocity: Some(FALL),
                angular_velocity: Some([0.0; 3]),
                joints: Some([0.0, 0.8, -1.6].repeat(4)),
                joint_rates: Some(vec![0.0; 12]),
            };
            dog.act("dog", &Command::Place(placement)).unwrap();
            assert!(apart(&dog, &fresh) < 1e-6, "{what}: it is at once where it is put");
            for simulation in [&mut dog, &mut fresh] {
                steps(simulation, 120);
            }
            let down = fresh.bodies()[0].velocity[2];
            let off = apart(&dog, &fresh);
            println!("{what}: {off:.2e} m apart after 60 ms ({near:.0e}); it falls by {down:.3} m/s");
            assert!(down.abs() < 0.4, "{what}: the ground does not bear it: {down} m/s");
            assert!(off < near, "{what}: {off} m");
        }
    }
}

/// What is left out of a placement stays as it is, and what cannot be is refused by name and changes nothing.
#[test]
fn a_placement_says_what_changes() {
    let tools = r#"
[[tool]]
name = "ball"
position = [1.5, 0.375, 0.6]
shape = { sphere = { radius = 0.1 } }
motion = { free = { mass = 2, linear = [0, 0, 0.5], angular = [0, 1, 0] } }
[[tool]]
name = "blade"
position = [1.0, 0.375, 0.6]
shape = { box = { half = [0.05, 0.05, 0.05] } }
motion = { velocity = { linear = [0, 0, 0.1] } }
[[tool]]
name = "post"
position = [0.9, 0.1, 0.6]
shape = { box = { half = [0.05, 0.05, 0.05] } }
[[robot]]
name = "arm"
model = "arm"
fixed = true
position = [0.2, 0.375, 0.6]
motor = [{ kp = 9, kd = 1 }]
"#;
    let options = Options { precision: Precision::F64, threads: 1, ..Options::default() };
    let mut world = start(&above_bed([2.0, 0.375, 0.7], [0.1, 0.2, 0.3], -1.6, tools), &options);
    steps(&mut world, 5);
    let of = |world: &Simulation, name: &str| world.bodies().into_iter().find(|body| body.name == name).unwrap();
    let place = |world: &mut Simulation, name: &str, placement: Placement| world.act(name, &Command::Place(placement));
    let at = |x: f64| Placement { position: Some([x, 0.375, 0.7]), ..Placement::default() };
    for (name, x) in [("dog", 2.0), ("ball", 1.5), ("blade", 1.0)] {
        let before = of(&world, name);
        place(&mut world, name, at(2.3)).unwrap();
        let after = of(&world, name);
        let (moved, kept) = (after.position[0] - before.position[0], [after.velocity, after.angular_velocity]);
        assert!(moved > 0.2 && after.rotation == before.rotation, "{name}: {before:?} {after:?}");
        let kept = DVec3::from_array(kept[0]).distance(DVec3::from_array(before.velocity))
            + DVec3::from_array(kept[1]).distance(DVec3::from_array(before.angular_velocity));
        assert!(kept < 1e-12, "{name}: {kept}");
        place(&mut world, name, at(x)).unwrap();
    }
    // A turn leaves the velocity of the base's origin as it is.
    let velocity = world.robots()[0].velocity;
    place(&mut world, "dog", Placement { rotation: Some([0.0, 0.0, 0.0, 2.0]), ..Placement::default() }).unwrap();
    let turned = world.robots()[0].velocity;
    assert!((turned[0] + velocity[0]).abs() + (turned[1] + velocity[1]).abs() < 1e-9, "{velocity:?} {turned:?}");
    let before = format!("{:?}", world.bodies());
    let joints = |joints: Vec<f64>| Placement { joints: Some(joints), ..Placement::default() };
    let velocity = |x: f64| Placement { velocity: Some([x, 0.0, 0.0]), ..Placement::default() };
    for (name, placement, expected) in [
        ("cat", at(1.0), "cat"),
        ("dog/FL_foot", at(1.0), "give them to the robot"),
        ("dog", joints(vec![0.0; 3]), "3 numbers for its 12 joints"),
        ("dog", joints(vec![9.0; 12]), "beyond the limits of joint"),
        ("dog", joints(vec![f64::NAN; 12]), "is NaN"),
        ("dog", at(f64::NAN), "the position is"),
        ("dog", at(50.0), "robot 'dog': its base would be on the other side of a wall"),
        ("arm", at(-0.5), "robot 'arm': its base would be on the other side of a wall"),
        ("dog", Placement { rotation: Some([0.0; 4]), ..Placement::default() }, "is no quaternion"),
        ("ball", at(-9.0), "tool 'ball': its base would be on the other side of a wall"),
        ("ball", joints(vec![0.0]), "joints"),
        ("blade", velocity(1.0), "give it a twist"),
        ("post", at(1.0), "tool 'post': it stays"),
        ("arm", velocity(1.0), "its base is fixed"),
    ] {
        let error = place(&mut world, name, placement).unwrap_err().to_string();
        assert!(error.contains(expected), "{name}: {error}");
        assert_eq!(format!("{:?}", world.bodies()), before, "{name}");
    }
    // A state that was taken before goes on as if nothing had been put elsewhere.
    let (state, mut twin) = (world.state().unwrap(), world.state().map(|state| resumed(&state, &options)).unwrap());
    place(&mut world, "dog", joints([0.0, 0.9, -1.2].repeat(4))).unwrap();
    place(&mut world, "arm", at(1.0)).unwrap();
    steps(&mut world, 5);
    world.set_state(&state).unwrap();
    for simulation in [&mut world, &mut twin] {
        steps(simulation, 10);
    }
    assert_eq!(format!("{:?}", world.bodies()), format!("{:?}", twin.bodies()));
}

/// Masses of links may be given by name and by pattern, and inertias grow with them: what a robot carries, and what is drawn anew for each episode.
#[test]
fn links_have_the_masses_that_a_scene_gives() {
    let of = |masses: &[(&str, f64)]| {
        let mut robot = barchan::scene::Robot::built_in("dog", "quadruped");
        robot.masses = masses.iter().map(|(name, mass)| ((*name).to_owned(), *mass)).collect();
        RobotModel::of(&robot, std::path::Path::new(""))
    };
    let (plain, heavy) = (of(&[]).unwrap(), of(&[("*_calf", 0.5), ("FL_calf", 2.0)]).unwrap());
    for (link, was) in heavy.links.iter().zip(&plain.links) {
        let mass = match link.name.as_str() {
            "FL_calf" => 2.0,
            name if name.ends_with("_calf") => 0.5,
            _ => was.mass,
        };
        assert_eq!(link.mass, mass, "{}", link.name);
        if was.mass > 0.0 {
            let off = (link.inertia - was.inertia * (mass / was.mass)).abs();
            assert!(off.x_axis.max(off.y_axis).max(off.z_axis).max_element() < 1e-15, "{}", link.name);
        }
    }
    for (masses, expected) in [
        (&[("tail", 1.0)][..], "no link with a mass of its own fits 'tail'"),
        (&[("FL_calf", 0.0)], "0 kg is no mass of link 'FL_calf'"),
        (&[("FL_calf", f64::NAN)], "NaN kg is no mass"),
        (&[("FL_*alf", 1.0), ("*L_calf", 2.0)], "fit link 'FL_calf' alike, and give"),
    ] {
        let refusal = of(masses).unwrap_err();
        assert!(refusal.what.contains(expected), "{}", refusal.what);
    }
}
