//! What robots sense, held against physics.

use super::{MOTORS, SAND, root, simulation, space, stand};
use barchan::{BodyState, Command, Options, Precision, RobotState, Scene, Simulation};
use barchan_tests::scenes::everywhere;
use glam::{DQuat, DVec3};

const G: f64 = 9.81;

/// A quadruped on a bare floor, its lowest points just above it, turned by some angle about the vertical.
fn on_floor(height: f64, more: &str) -> Scene {
    let text = format!(
        "name = \"floor\"\nworld = {{ cell = 0.01, min = [-2, -2, 0], max = [2, 2, 3], walls = {{ z_min = \"stick\" }} }}\ntime = {{ end = 2, step = 5e-4 }}\n[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nposition = [0, 0, {height}]\ncontact = {{ coulomb = {{ friction = 0.8 }} }}\njoints = {{ \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }}\nmotor = [{{ kp = 250, kd = 5 }}]\n{more}"
    );
    Scene::from_str(&text, "floor.toml", root()).unwrap()
}

fn only(simulation: &Simulation) -> RobotState {
    simulation.robots().pop().expect("there is one robot")
}

fn run(dog: &mut Simulation, until: f64, mut look: impl FnMut(&Simulation)) {
    while dog.time() < until {
        dog.step().unwrap();
        look(dog);
    }
}

/// Is a link a foot?
fn is_foot(name: &str) -> bool {
    name.ends_with("_foot")
}

/// Symptom: where levels take steps of their own and there is no ground, an accelerometer that is resumed reads something else: it took its mean over as many steps as levels
/// have within one. A state taken in the middle goes on with the same sensors, bit for bit.
#[test]
fn sensors_go_on_where_levels_have_no_ground() {
    let scene = on_floor(0.4, "[levels]\ncount = 3\nsubcycle = true\n");
    let go = |dog: &mut Simulation, steps: usize| (0..steps).for_each(|_| drop(dog.step().unwrap()));
    let mut whole = simulation(&scene, Precision::F64);
    go(&mut whole, 6);
    let mut other = simulation(&scene, Precision::F64);
    other.set_state(&whole.state().unwrap()).unwrap();
    for dog in [&mut whole, &mut other] {
        go(dog, 5);
    }
    assert_eq!(format!("{:?}", whole.robots()), format!("{:?}", other.robots()));
}

/// At rest on a floor an accelerometer reads g upwards, feet alone touch, and the floor bears the weight where they stand.
#[test]
fn a_robot_at_rest_on_a_floor_feels_its_weight() {
    let mut dog = simulation(&on_floor(0.32, "rotation = [0.966, 0, 0, 0.259]"), Precision::F64);
    run(&mut dog, 1.5, |_| ());
    let state = only(&dog);
    let weight = G * dog.bodies().iter().map(|body| body.mass).sum::<f64>();
    let force = DVec3::from_array(state.specific_force);
    let up = -DVec3::from_array(state.projected_gravity);
    let off = (force - G * up).length() / G;
    let borne: f64 = state.links.iter().flat_map(|link| &link.rigid).map(|point| point.force[2]).sum();
    println!(
        "specific force off by {off:.1e} of g (1e-2), the floor bears {:.4} of the weight (1 +- 1e-2)",
        borne / weight
    );
    assert!(off < 1e-2 && (borne / weight - 1.0).abs() < 1e-2, "{force}, {borne} of {weight} N");
    assert!(up.z > 0.99 && DVec3::from_array(state.velocity).length() < 1e-3);
    let patches = dog.patches("dog", 1.0).unwrap();
    for (link, patch) in state.links.iter().zip(&patches) {
        assert_eq!(link.touches(1.0), is_foot(&link.name), "{}", link.name);
        assert_eq!(patch.is_some(), is_foot(&link.name), "{}", link.name);
        let Some(patch) = patch else { continue };
        let arm = DVec3::from_array(patch.centre_of_pressure) - DVec3::from_array(link.centre);
        // The foot is a ball of 22 mm.
        assert!((arm - DVec3::Z * -0.022).length() < 3e-3 && patch.points > 0, "{}: {patch:?}", link.name);
    }
}

/// In free fall an accelerometer reads nothing and nothing touches; velocities are along the base's own axes.
#[test]
fn a_robot_in_free_fall_feels_nothing() {
    let turn = DQuat::from_euler(glam::EulerRot::ZYX, 0.9, 0.2, -0.3);
    let more = format!("velocity = [0.3, -0.2, 0.1]\nrotation = [{}, {}, {}, {}]", turn.w, turn.x, turn.y, turn.z);
    let mut dog = simulation(&on_floor(2.0, &more), Precision::F64);
    assert_eq!(only(&dog).specific_force, [0.0; 3]);
    let mut most = 0.0_f64;
    run(&mut dog, 0.3, |dog| most = most.max(DVec3::from_array(only(dog).specific_force).length()));
    let state = only(&dog);
    println!("specific force of up to {most:.1e} m/s^2 (1e-2 g)");
    assert!(most < 1e-2 * G, "{most}");
    assert!(state.links.iter().all(|link| !link.touches(0.0)), "{state:?}");
    assert!(dog.patches("dog", 0.0).unwrap().iter().all(Option::is_none));
    let expected = turn.conjugate() * DVec3::new(0.3, -0.2, 0.1 - G * dog.time());
    assert!((DVec3::from_array(state.velocity) - expected).length() < 1e-2, "{:?}, not {expected}", state.velocity);
    let down = turn.conjugate() * -DVec3::Z;
    assert!((DVec3::from_array(state.projected_gravity) - down).length() < 1e-2, "{:?}", state.projected_gravity);
}

/// On sand the same: g on average, four feet that touch, each about its own patch.
#[test]
fn a_robot_at_rest_on_sand_feels_it_under_its_feet() {
    // 6 cm above the sand nothing touches.
    let mut high = simulation(&stand(SAND, 0.5, MOTORS), Precision::F32);
    run(&mut high, 0.02, |dog| assert!(only(dog).links.iter().all(|link| !link.touches(0.0))));
    let mut dog = simulation(&stand(SAND, 0.44, MOTORS), Precision::F32);
    run(&mut dog, 1.0, |_| ());
    let (mut sum, mut time) = (DVec3::ZERO, 0.0);
    while dog.time() < 1.2 {
        let dt = dog.step().unwrap().dt;
        let state = only(&dog);
        sum += dt * (DVec3::from_array(state.specific_force) + G * DVec3::from_array(state.projected_gravity));
        time += dt;
    }
    let off = sum.length() / time / G;
    println!("mean specific force off by {off:.1e} of g (1e-2)");
    assert!(off < 1e-2, "{off}");
    let state = only(&dog);
    for (link, patch) in state.links.iter().zip(dog.patches("dog", 1.0).unwrap()) {
        assert_eq!(patch.is_some(), is_foot(&link.name), "{}: {:?}", link.name, link.ground.force);
        let Some(patch) = patch else { continue };
        let arm = DVec3::from_array(patch.centre_of_pressure) - DVec3::from_array(link.centre);
        let wide = patch.bounds.max[0] - patch.bounds.min[0];
        println!("{}: {} particles over {wide:.3} m, centre {arm:.3}", link.name, patch.points);
        // Particles are 16 mm wide, the foot 44 mm.
        assert!(arm.length() < 0.04 && arm.z < 0.0 && wide < 0.08, "{}: {patch:?}", link.name);
    }
}

/// Heights that a robot senses are those of the field that the ground was made of, wherever the robot looks.
#[test]
fn a_scan_finds_the_heights_of_a_slope_and_a_field() {
    type Field = fn(f64, f64) -> f64;
    let slope: Field = |x, _| 0.1 + 0.25 * x;
    let bowl: Field = |x, y| 0.1 + 0.4 * ((x - 0.5).powi(2) + (y - 0.5).powi(2));
    let fields = [("slope", slope), ("bowl", bowl)];
    for (name, surface) in fields {
        let row = |j: u32| {
            let heights = (0..=20).map(|i| surface(0.05 * f64::from(i), 0.05 * f64::from(j)).to_string());
            format!("[{}]", heights.collect::<Vec<_>>().join(", "))
        };
        let rows = (0..=20).map(row).collect::<Vec<_>>().join(",\n");
        let text = format!(
            r#"
name = "field"
world = {{ cell = 0.02, min = [0, 0, 0], max = [1, 1, 1.2], walls = {{ z_min = "stick" }} }}
time = {{ end = 1 }}
[[material]]
name = "sand"
law = "sand"
density = 1600
[[body]]
name = "bed"
material = "sand"
shape = {{ height_field = {{ min = [0, 0], max = [1, 1], bottom = 0, heights = [{rows}] }} }}
[[robot]]
name = "dog"
model = "quadruped"
position = [0.5, 0.45, 1.0]
rotation = [0.94, 0.1, 0.05, 0.3]
scan = {{ min = [-0.3, -0.2], max = [0.3, 0.2], points = [9, 5] }}
"#
        );
        let dog = simulation(&Scene::from_str(&text, "field.toml", root()).unwrap(), Precision::F32);
        let scan = dog.scan("dog").unwrap();
        assert_eq!((scan.points.len(), scan.heights.len()), (45, 45));
        let off = scan.points.iter().zip(&scan.heights).map(|(&[x, y], z)| z.unwrap() + 1.0 - surface(x, y));
        let worst = off.fold(0.0, |worst: f64, off| worst.max(off.abs()));
        // Particles start on a lattice: its steps are a particle high, 10 mm.
        println!("{name}: off by {worst:.2e} m (two thirds of a particle: 6.7e-3)");
        assert!(worst < 6.7e-3, "{name}: {worst}");
        // The grid turns with the robot and stays level: its first side is 0.6 m long.
        let side = DVec3::new(scan.points[8][0] - scan.points[0][0], scan.points[8][1] - scan.points[0][1], 0.0);
        let ahead = DQuat::from_xyzw(0.1, 0.05, 0.3, 0.94).normalize() * DVec3::X;
        assert!((side.length() - 0.6).abs() < 1e-9 && side.angle_between(ahead.with_z(0.0)) < 1e-6, "{side}");
        // Beyond the world's side it is as high as beside it.
        let world = &dog.plan().scene.world;
        let side = [world.max[0] - 0.5 * world.cell, 0.5];
        let [beyond, beside] = dog.heights(&[[1.5, 0.5], side]).unwrap()[..] else { panic!("two heights") };
        assert!(beyond == beside && beside.is_some_and(|height| height > 0.1), "{beyond:?} {beside:?}");
    }
}

/// Whoever asks for what is not there is told what is.
#[test]
fn questions_that_cannot_be_answered_are_refused_by_name() {
    let dog = simulation(&on_floor(1.0, ""), Precision::F32);
    for (error, parts) in [
        (dog.scan("dog").unwrap_err(), ["robot 'dog'", "add scan = {"]),
        (dog.scan("cat").unwrap_err(), ["robot 'cat'", "there are dog"]),
        (dog.patches("cat", 1.0).unwrap_err(), ["robot 'cat'", "there are dog"]),
    ] {
        let text = error.to_string();
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
    }
    let refused = |more: &str| {
        let text = format!(
            "name = \"s\"\nworld = {{ cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }}\ntime = {{ end = 1 }}\n[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\n{more}"
        );
        Scene::from_str(&text, "s.toml", root())
            .and_then(|scene| Simulation::new(&barchan::registry(), &scene, &Options::default()).map(drop))
            .map_or_else(|e| e.to_string(), |()| "accepted".to_owned())
    };
    let cases: [(&str, &[&str]); 7] = [
        ("scan = { min = [0, 0], max = [1, 1], points = [3, 0] }", &["robot[0].scan.points", "3 by 0", "at least one"]),
        ("scan = { min = [0, 1], max = [1, 0], points = [3, 2] }", &["robot[0].scan.max", "y goes from 1 to 0"]),
        ("balance = [{ joints = \"tail\", of = \"pitch\", gain = 1 }]", &["robot[0]", "'tail'", "FL_hip_joint"]),
        ("balance = [{ joints = \"*\", of = \"yaw\" }]", &["yaw", "pitch"]),
        ("fixed = true\nbalance = [{ joints = \"*\", of = \"roll\" }]", &["robot[0].balance[0]", "fixed = true"]),
        ("motion = { model = \"waltz\" }", &["robot[0]", "no motion 'waltz'", "humanoid-step"]),
        ("motion = { model = \"quadruped-trot\", file = \"a.csv\" }", &["robot[0].motion", "one way"]),
    ];
    for (more, parts) in cases {
        let text = refused(more);
        for part in parts {
            assert!(text.contains(part), "'{part}' is not in: {text}");
        }
    }
}

/// A base that leans changes the targets of the joints that the scene names, by angle and by rate, and of no others.
#[test]
fn joints_follow_the_base_as_it_leans() {
    // Leaning forward by 0.1 rad, to the right by 0.06, and further forward with 0.5 rad/s.
    let turn = DQuat::from_rotation_y(0.1) * DQuat::from_rotation_x(0.06);
    let spin = turn * DVec3::new(0.0, 0.5, 0.0);
    let robot = |balance: &str| {
        let text = format!(
            "[[robot]]\nname = \"man\"\nmodel = \"humanoid\"\nposition = [0, 0, 1]\nrotation = [{}, {}, {}, {}]\nangular_velocity = [{}, {}, {}]\nmotor = [{{ kp = 100, kd = 0 }}]\n{balance}",
            turn.w, turn.x, turn.y, turn.z, spin.x, spin.y, spin.z
        );
        let mut scene = space(0.0, &text);
        scene.time.step = Some(1e-6);
        let mut man = simulation(&scene, Precision::F64);
        man.step().unwrap();
        man.joints()
    };
    let balance = "balance = [{ joints = \"*_ankle_pitch_joint\", of = \"pitch\", gain = 0.5, rate = 0.08 }, { joints = \"left_ankle_roll_joint\", of = \"roll\", gain = 0.4 }]";
    for (with, without) in robot(balance).iter().zip(robot("")) {
        let expected = match with.name.as_str() {
            "left_ankle_pitch_joint" | "right_ankle_pitch_joint" => 100.0 * (0.5 * 0.1 + 0.08 * 0.5),
            "left_ankle_roll_joint" => 100.0 * 0.4 * 0.06,
            _ => 0.0,
        };
        let change = with.torque - without.torque;
        assert!((change - expected).abs() < 1e-2, "{}: {change} N m, not {expected}", with.name);
    }
}

/// Torques of motors are those of the state: one that is restored reads the same, also of joints that follow the base as it leans. A motor at rest gives what its gains say.
#[test]
fn torques_are_those_of_the_state() {
    let balance = "balance = [{ joints = \"*_thigh_joint\", of = \"pitch\", gain = 0.3, rate = 0.02 }]";
    let scene = on_floor(0.4, balance);
    let torques = |s: &Simulation| s.joints().iter().map(|joint| joint.torque).collect::<Vec<_>>();
    let mut dog = simulation(&scene, Precision::F64);
    run(&mut dog, 0.3, |_| ());
    let (state, before) = (dog.state().unwrap(), torques(&dog));
    let calf = dog.joints().into_iter().find(|joint| joint.name.ends_with("calf_joint")).unwrap();
    let by_gains = 250.0 * (-1.6 - calf.position) - 5.0 * calf.rate;
    assert!((calf.torque - by_gains).abs() < 1e-9 && calf.torque.abs() > 0.1, "{} and {by_gains} N m", calf.torque);
    run(&mut dog, 0.35, |_| ());
    assert_ne!(torques(&dog), before);
    dog.set_state(&state).unwrap();
    assert_eq!(torques(&dog), before);
}

/// A blow on a robot afloat, on its base or on a link, is momentum that it keeps; one on a base that stays moves nothing, and is refused.
#[test]
fn a_blow_on_a_robot_is_momentum() {
    let (linear, angular) = ([3.0, -1.0, 2.0], [0.1, 0.2, -0.3]);
    let dog = "[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nmotor = [{ kp = 250, kd = 5 }]\n";
    let scene = space(0.0, dog);
    for hit in ["dog", "dog/FL_foot"] {
        let mut world = simulation(&scene, Precision::F64);
        (0..20).for_each(|_| drop(world.step().unwrap()));
        let links = world.bodies();
        // The base is the first.
        let centre = links.iter().find(|link| link.name == hit).unwrap_or(&links[0]).position;
        world.act(hit, &Command::Impulse { linear, angular }).unwrap();
        for when in ["at once", "after 100 steps"] {
            let sum = |of: fn(&BodyState) -> [f64; 3]| -> DVec3 {
                world.bodies().iter().map(|body| DVec3::from_array(of(body))).sum()
            };
            let [blow, about] = [linear, angular].map(DVec3::from_array);
            let about = about + DVec3::from_array(centre).cross(blow);
            let off =
                (sum(|body| body.momentum) - blow).length() + (sum(|body| body.angular_momentum) - about).length();
            println!("{hit}, {when}: momentum off by {off:.1e} (1e-9)");
            assert!(off < 1e-9, "{hit}, {when}: {off}");
            (0..100).for_each(|_| drop(world.step().unwrap()));
        }
        let none = world.act("cat", &Command::Impulse { linear, angular }).unwrap_err().to_string();
        assert!(none.contains("cat"), "{none}");
    }
    let mut arm = simulation(
        &space(0.0, "[[robot]]\nname = \"arm\"\nmodel = \"arm\"\nfixed = true\nmotor = [{ kp = 9, kd = 1 }]\n"),
        Precision::F64,
    );
    let error = arm.act("arm", &Command::Impulse { linear, angular }).unwrap_err().to_string();
    assert!(error.contains("robot 'arm'") && error.contains("cannot move that way"), "{error}");
    let last = arm.bodies().pop().unwrap().name;
    arm.act(&last, &Command::Impulse { linear, angular }).unwrap();
    assert!(arm.joints().iter().any(|joint| joint.rate.abs() > 0.1));
}

/// Motors told rates turn at these; told torques besides targets, they rest by torque/kp off. What no gain acts on is refused by name.
#[test]
fn motors_take_rates_and_torques_besides_targets() {
    let arm = |motor: &str| {
        space(0.0, &format!("[[robot]]\nname = \"arm\"\nmodel = \"arm\"\nfixed = true\nmotor = [{{ {motor} }}]\n"))
    };
    for options in everywhere() {
        let start = |motor: &str| Simulation::new(&barchan::registry(), &arm(motor), &options).unwrap();
        // Its joints have some damping of their own.
        let mut turning = start("kd = 2000");
        let count = turning.joints().len();
        let motion = |targets: Option<f64>, rates: Option<f64>, torques: Option<f64>| {
            let all = |x: Option<f64>| x.map(|x| vec![x; count]);
            Command::JointMotion { targets: all(targets), rates: all(rates), torques: all(torques) }
        };
        turning.act("arm", &motion(None, Some(0.2), None)).unwrap();
        // And dry friction, which holds them by less than half a milliradian.
        let mut held = start("kp = 1000, kd = 200");
        let first: Vec<f64> = held.joints().iter().map(|joint| joint.position).collect();
        let offset = first.iter().map(|x| x + 0.01).collect();
        held.act("arm", &Command::JointMotion { targets: Some(offset), rates: None, torques: Some(vec![10.0; count]) })
            .unwrap();
        for simulation in [&mut turning, &mut held] {
            run(simulation, 2.0, |_| ());
        }
        for (joint, first) in turning.joints().iter().zip(&first) {
            let what = format!(
                "{} {}: {} at {:.4} rad/s, {:.3} rad",
                options.backend, options.precision, joint.name, joint.rate, joint.position
            );
            assert!((joint.rate - 0.2).abs() < 2e-3 && joint.position - first > 0.3, "{what}");
        }
        for (joint, first) in held.joints().iter().zip(&first) {
            let off = joint.position - first;
            assert!(
                (off - 0.01 - 10.0 / 1000.0).abs() < 1e-3,
                "{} {}: {} is {off} rad off",
                options.backend,
                options.precision,
                joint.name
            );
        }
        for (motor, command, expected) in [
            ("kp = 50, kd = 20", motion(None, Some(1.0), None), "has kp, and no joint targets are given"),
            ("kd = 50", motion(Some(0.0), None, None), "no motor of it has kp"),
            ("kp = 5", motion(Some(0.0), Some(1.0), None), "no motor of it has kd"),
            ("kd = 50", motion(None, Some(f64::NAN), None), "is NaN"),
        ] {
            let error = start(motor).act("arm", &command).unwrap_err().to_string();
            assert!(error.contains("robot 'arm'") && error.contains(expected), "{error}");
        }
    }
}

/// A scan sees hard ground: the top of fixed tools, whatever they are, where they stand above the soft ground, also beside their upright faces and beyond a periodic side. What
/// moves it does not see, nor what is not there.
#[test]
fn scans_see_tools_that_stay() {
    let tool = |name: &str, shape: &str, at: [f64; 3], more: &str| {
        format!("[[tool]]\nname = \"{name}\"\nposition = {at:?}\nshape = {shape}\n{more}\n")
    };
    let cube = "{ box = { half = [0.09, 0.09, 0.1] } }";
    let parts = [
        tool("cube", cube, [0.3, 0.5, 0.2], ""),
        tool("ball", "{ sphere = { radius = 0.09 } }", [0.7, 0.5, 0.21], ""),
        tool("driven", cube, [0.5, 0.5, 0.4], "motion = { velocity = {} }"),
        tool("late", cube, [0.5, 0.8, 0.4], "from = 0.5"),
        tool("slope", "{ plane = { normal = [0.1, 0, 1] } }", [0.0, 0.0, 0.15], ""),
    ];
    let scan = |x: f64| {
        let text = format!(
            "name = \"hard\"\nworld = {{ cell = 0.02, min = [0, 0, 0], max = [0.96, 1, 1.2], walls = {{ x_min = \"periodic\", x_max = \"periodic\" }} }}\ntime = {{ end = 1 }}\n[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nposition = [{x}, 0.5, 1.0]\nscan = {{ min = [-0.2, 0], max = [0.2, 0.3], points = [5, 2] }}\n{}",
            parts.concat()
        );
        let scene = Scene::from_str(&text, "hard.toml", root()).unwrap();
        simulation(&scene, Precision::F64).scan("dog").unwrap().heights
    };
    let slope = |x: f64| 0.15 - 0.1 * x;
    let expected: Vec<f64> = [0.3, slope(0.4), slope(0.5), slope(0.6), 0.3]
        .into_iter()
        .chain([0.3, 0.4, 0.5, 0.6, 0.7].map(slope))
        .collect();
    for x in [0.5, 0.5 + 0.96] {
        for (i, (height, expected)) in scan(x).iter().zip(&expected).enumerate() {
            let height = height.unwrap() + 1.0;
            assert!((height - expected).abs() < 1e-4, "point {i}: {height} m, {expected} m");
        }
    }
}

/// Targets for joints whose motors have no gains move nothing, and are refused; an armature that slows down what nothing drives is told.
#[test]
fn joints_without_motors_take_no_targets() {
    let dog = |motor: &str| space(0.0, &format!("[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\n{motor}\n"));
    let mut limp = simulation(&dog(""), Precision::F64);
    let error = limp.act("dog", &Command::JointTargets(vec![0.0; 12])).unwrap_err().to_string();
    assert!(error.contains("robot 'dog'") && error.contains("move nothing"), "{error}");
    limp.act("dog", &Command::JointTorques(vec![0.1; 12])).unwrap();
    let warned = |s: &Simulation| s.plan().warnings.iter().any(|warning| warning.contains("armature"));
    assert!(warned(&limp));
    assert!(!warned(&simulation(&dog("motor = [{ kp = 9 }]"), Precision::F64)));
    assert!(!warned(&simulation(&dog("motor = [{ armature = 0 }]"), Precision::F64)));
}
