//! Robots: what their files say, how they move, and how they stand on soft ground.

mod meeting;
mod placing;
mod scenes;
mod sensing;
mod touching;

use barchan::scene::CollisionMeshes;
use barchan::{BodyState, Command, Coupling, Options, Precision, RobotState, Scene, Simulation, Vec3};
use barchan_rigid::motion::Pose;
use barchan_rigid::robot::dynamics::{bias, gravity, mass_matrix, momentum, places};
use barchan_rigid::robot::urdf::Source;
use barchan_rigid::robot::{RobotModel, Robots};
use barchan_tests::scenes::{chain, energies};
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The repository's root.
fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// What pinocchio says; see tests/robots/README.md.
fn truth() -> Value {
    let text = std::fs::read_to_string(root().join("tests/robots/truth.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// Where a robot of the table lies.
fn file_of(urdf: &str) -> PathBuf {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from);
    let ours = !urdf.starts_with("example-robot-data/");
    if ours { root().join(urdf) } else { target.join("robots").join(urdf) }
}

fn read(urdf: &str) -> RobotModel {
    let file = file_of(urdf);
    let text = std::fs::read_to_string(&file)
        .unwrap_or_else(|e| panic!("{}: {e}; run: bash tests/robots/fetch.sh", file.display()));
    let name = file.display().to_string();
    let source = Source {
        text: &text,
        file: &name,
        folder: file.parent().unwrap(),
        mends: false,
        meshes: &CollisionMeshes::Hull,
    };
    let mut model = RobotModel::read(&source).unwrap_or_else(|e| panic!("{}: {}", e.what, e.mend));
    // The truth knows none.
    model.drives.iter_mut().for_each(|drive| drive.armature = 0.0);
    model
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn pose(value: &Value) -> Pose {
    let [x, y, z, w, i, j, k] = numbers(value)[..] else { panic!("no pose: {value}") };
    Pose { position: DVec3::new(x, y, z), rotation: DQuat::from_xyzw(i, j, k, w).normalize() }
}

/// A robot of the table, and the order of its joints there.
struct Known<'a> {
    model: RobotModel,
    floating: bool,
    /// For each of our drives, its number in the table; and among those joints that mimic no other.
    order: Vec<usize>,
    names: Vec<&'a str>,
    own: Vec<&'a str>,
}

impl<'a> Known<'a> {
    fn new(entry: &'a Value) -> Self {
        let model = read(entry["urdf"].as_str().unwrap());
        let names: Vec<&str> = entry["names"].as_array().unwrap().iter().map(|x| x.as_str().unwrap()).collect();
        let place = |name: &str| names.iter().position(|other| *other == name).unwrap();
        let order = model.drives.iter().map(|drive| place(&drive.name)).collect();
        let own = names.iter().copied().filter(|name| model.drives.iter().any(|drive| drive.name == *name)).collect();
        Self { model, floating: entry["floating"].as_bool().unwrap(), order, names, own }
    }

    fn positions(&self, state: &Value) -> Vec<f64> {
        let all = numbers(&state["angles"]);
        self.order.iter().map(|&i| all[i]).collect()
    }

    /// From our rates, along the world's axes and for the base's centre of mass, to those of the table: the base's origin, along the axes that `turn` gives.
    fn to_table(&self, arm: DVec3, turn: DMat3) -> DMatrix<f64> {
        let base = if self.floating { 6 } else { 0 };
        let ours = base + self.model.drives.len();
        // Ours = G · table's.
        let mut g = DMatrix::zeros(ours, ours);
        for (drive, known) in self.model.drives.iter().enumerate() {
            let i = self.own.iter().position(|name| *name == known.name).unwrap();
            g[(base + drive, base + i)] = 1.0;
        }
        if self.floating {
            for j in 0..3 {
                let axis = turn.col(j);
                let moved = axis.cross(arm);
                for i in 0..3 {
                    g[(i, j)] = axis[i];
                    g[(i, 3 + j)] = moved[i];
                    g[(3 + i, 3 + j)] = axis[i];
                }
            }
        }
        g
    }
}

fn greatest(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().fold(0.0, |most, x: f64| most.max(x.abs()))
}

/// Robots of others, and ours: masses, joints, where links are, mass matrix, and what motion and gravity ask of the joints.
#[test]
fn robots_are_what_pinocchio_says() {
    let truth = truth();
    for entry in truth["robots"].as_array().unwrap() {
        let name = entry["name"].as_str().unwrap();
        let known = Known::new(entry);
        let model = &known.model;
        let mass = entry["mass"].as_f64().unwrap();
        assert!((model.mass() - mass).abs() < 1e-8 * mass, "{name}: {} kg, and it has {mass}", model.mass());
        assert_eq!(model.links.len(), entry["links"].as_u64().unwrap() as usize, "{name}: links");
        let mimics = entry["mimic"].as_array().unwrap().iter();
        let follows = mimics.filter(|mimic| known.names.contains(&mimic["joint"].as_str().unwrap_or_default())).count();
        assert_eq!(model.drives.len() + follows, known.names.len(), "{name}: joints");
        let (mut worst_place, mut worst_matrix, mut worst_bias) = (0.0_f64, 0.0_f64, 0.0_f64);
        for state in entry["states"].as_array().unwrap() {
            let base = if known.floating { pose(&state["base"]) } else { Pose::IDENTITY };
            let all = places(model, known.floating, &base, &known.positions(state));
            for (link, place) in model.links.iter().zip(&all) {
                let truth = pose(&state["links"][&link.name]);
                let turned = (truth.rotation * place.frame.rotation.conjugate()).xyz().length();
                worst_place = worst_place.max(turned).max((truth.position - place.frame.position).length());
            }
            let turn = DMat3::from_quat(base.rotation);
            let arm = all[0].centre - all[0].frame.position;
            let g = known.to_table(arm, turn);
            // Where joints mimic others, what is left.
            let of = if state["reduced"].is_null() { state } else { &state["reduced"] };
            let fits = follows == 0 || !state["reduced"].is_null();
            if let Some(rows) = of["mass_matrix"].as_array().filter(|_| fits) {
                let ours = g.transpose() * mass_matrix(model, known.floating, &all) * &g;
                let mut entries = rows.iter().map(|x| x.as_f64().unwrap());
                let scale = ours.amax();
                for i in 0..ours.nrows() {
                    for j in i..ours.ncols() {
                        worst_matrix = worst_matrix.max((ours[(i, j)] - entries.next().unwrap()).abs() / scale);
                    }
                }
            }
            let key = if known.floating { "bias_world" } else { "bias" };
            if let (Some(table), Some(velocity)) =
                (of[key].as_array(), state[key.replace("bias", "velocity")].as_array())
            {
                let base_rates = if known.floating { 6 } else { 0 };
                let is_own = |i: usize| i < base_rates || known.own.contains(&known.names[i - base_rates]);
                let velocity =
                    velocity.iter().enumerate().filter(|(i, _)| is_own(*i)).map(|(_, x)| x.as_f64().unwrap());
                let velocity = DVector::from_iterator(base_rates + known.own.len(), velocity);
                let world = known.to_table(arm, DMat3::IDENTITY);
                let rates = &world * &velocity;
                let asked = bias(model, known.floating, &all, &rates)
                    - gravity(model, &all, DVec3::new(0.0, 0.0, -9.81), rates.len());
                // In the table the base's origin, not its centre of mass, is without acceleration.
                let mut still = DVector::zeros(rates.len());
                if known.floating {
                    let spin = DVec3::new(velocity[3], velocity[4], velocity[5]);
                    let pulled = spin.cross(spin.cross(arm));
                    (0..3).for_each(|d| still[d] = pulled[d]);
                }
                let asked = world.transpose() * (asked + mass_matrix(model, known.floating, &all) * still);
                let table: Vec<f64> = table.iter().map(|x| x.as_f64().unwrap()).collect();
                assert_eq!(table.len(), base_rates + known.own.len());
                let scale = greatest(table.iter().copied());
                worst_bias = worst_bias.max(greatest(asked.iter().zip(&table).map(|(a, b)| a - b)) / scale);
            }
        }
        println!(
            "{name}: places {worst_place:.1e} (2e-6), mass matrix {worst_matrix:.1e} (1e-8), bias {worst_bias:.1e} (1e-8)"
        );
        assert!(worst_place < 2e-6, "{name}: a link is off by {worst_place}");
        assert!(worst_matrix < 1e-8 && worst_bias < 1e-8, "{name}: {worst_matrix}, {worst_bias}");
    }
}

/// Momentum is that of the mass matrix's rows, and kinetic energy half of its form.
#[test]
fn a_robots_momentum_is_that_of_its_links() {
    let known = read("rigid-couple/models/quadruped.urdf");
    let base =
        Pose { position: DVec3::new(0.3, -0.2, 1.0), rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.5, 0.8) };
    let positions: Vec<f64> = (0..known.drives.len()).map(|i| 0.1 * i as f64 - 0.5).collect();
    let all = places(&known, true, &base, &positions);
    let rates = DVector::from_fn(18, |i, _| (i as f64 * 0.7).sin());
    let rows = mass_matrix(&known, true, &all) * &rates;
    let [linear, angular] = momentum(&known, &all, &rates, all[0].centre);
    for d in 0..3 {
        assert!((rows[d] - linear[d]).abs() < 1e-12 && (rows[3 + d] - angular[d]).abs() < 1e-12);
    }
    let mut by_links = BTreeMap::new();
    for (link, place) in known.links.iter().zip(&all) {
        let twist = place.twist(&rates);
        let energy = link.mass * twist.linear.length_squared() + twist.angular.dot(place.inertia * twist.angular);
        by_links.insert(&link.name, energy);
    }
    let energy: f64 = by_links.values().sum();
    assert!((energy - rates.dot(&rows)).abs() < 1e-12 * energy);
}

/// A scene without ground, and what stands behind its head.
fn space(gravity: f64, rest: &str) -> Scene {
    let text = format!(
        "name = \"space\"\ngravity = [0, 0, {gravity}]\nworld = {{ cell = 0.1, min = [-5, -5, -5], max = [5, 5, 5] }}\ntime = {{ end = 10 }}\n{rest}"
    );
    Scene::from_str(&text, "space.toml", root()).unwrap()
}

/// Momentum of all robots, linear and angular about the world's origin.
fn totals(robots: &Robots) -> [DVec3; 2] {
    let bodies = robots.bodies();
    let sum = |of: fn(&BodyState) -> Vec3| bodies.iter().map(|body| DVec3::from_array(of(body))).sum::<DVec3>();
    [sum(|body| body.momentum), sum(|body| body.angular_momentum)]
}

/// What rigid things press on a robot with [N].
fn felt(robot: &RobotState) -> DVec3 {
    robot.links.iter().flat_map(|link| &link.rigid).map(|point| DVec3::from_array(point.force)).sum()
}

fn moved(robots: &mut Robots, time: f64, dt: f64) {
    robots.before_step(time, dt).unwrap();
    robots.after_step(time, dt).unwrap();
}

/// Two rods that swing, against an integration with steps of 1e-5 s by Runge-Kutta: angles at all times, first order in the step.
#[test]
fn a_double_pendulum_swings_as_it_should() {
    let truth = truth();
    let rows = truth["double_pendulum"]["rows"].as_array().unwrap();
    let scene = space(
        -9.81,
        "[[robot]]\nname = \"rods\"\nurdf = \"tests/robots/double_pendulum.urdf\"\nfixed = true\njoints = { shoulder = 1.5, elbow = 0.5 }\nmotor = [{ armature = 0 }]",
    );
    let mut errors = Vec::new();
    for dt in [4e-4, 2e-4] {
        let mut robots = Robots::new(&scene).unwrap();
        let (mut worst, mut step) = (0.0_f64, 0);
        for row in rows {
            let [time, shoulder, elbow, ..] = numbers(row)[..] else { panic!("no row: {row}") };
            while (f64::from(step) + 0.5) * dt < time {
                moved(&mut robots, f64::from(step) * dt, dt);
                step += 1;
            }
            let joints = robots.joints();
            // The truth keeps angles as they add up; so do we.
            worst = worst.max((joints[0].position - shoulder).abs()).max((joints[1].position - elbow).abs());
        }
        errors.push(worst);
    }
    let order = (errors[0] / errors[1]).log2();
    println!("angles off by {:.1e} and {:.1e} rad (8e-3), order {order:.2} (0.8)", errors[0], errors[1]);
    assert!(errors[1] < 8e-3 && order > 0.8, "{errors:?}");
}

/// Chains whose joints nothing drives or slows keep their energy, at steps in which they turn by tenths of a radian and more; and momentum, if they are afloat.
#[test]
fn chains_that_nothing_drives_keep_their_energy() {
    const HUNG: &str = "fixed = true";
    const AFLOAT: &str = "velocity = [1, -0.5, 0.3]\nangular_velocity = [3, 2, -4]";
    let folder = tempfile::tempdir().unwrap();
    let cases: [(usize, f64, &str, f64, f64, f64); 6] = [
        (4, -9.81, HUNG, 5e-3, 24.0, 0.04),
        (4, -9.81, HUNG, 1e-3, 24.0, 0.01),
        (4, 0.0, AFLOAT, 5e-3, 24.0, 0.04),
        (4, 0.0, AFLOAT, 1e-3, 24.0, 0.01),
        (60, -9.81, HUNG, 5e-3, 6.0, 0.04),
        (20, 0.0, AFLOAT, 5e-3, 6.0, 0.01),
    ];
    for (links, gravity, more, dt, end, most) in cases {
        let mut robots = Robots::new(&chain(folder.path(), links, gravity, more)).unwrap();
        let [kinetic, start] = energies(&robots.bodies());
        let first = totals(&robots);
        // Of one that hangs straight down, or of one at rest.
        let hanging: f64 = (0..links).map(|link| 0.1 * gravity * (0.1 + 0.2 * link as f64)).sum();
        let whole = if gravity == 0.0 { kinetic } else { start - hanging };
        let [mut lost, mut gained] = [0.0_f64; 2];
        for step in 0..(end / dt) as usize {
            moved(&mut robots, step as f64 * dt, dt);
            let [_, now] = energies(&robots.bodies());
            gained = gained.max((now - start) / whole);
            lost = lost.max((start - now) / whole);
        }
        println!(
            "{links} links, {gravity} m/s², {dt} s: gained {gained:.1e}, lost {lost:.1e} of {whole:.3} J ({most})"
        );
        assert!(gained < most && lost < most, "{links} links, {gravity} m/s², {dt} s: {gained}, {lost}");
        if gravity == 0.0 {
            let now = totals(&robots);
            let off = (0..2).map(|i| (now[i] - first[i]).length() / first[i].length()).fold(0.0, f64::max);
            assert!(off < 1e-11, "momentum is off by {off}");
        }
    }
}

const AFLOAT: &str = "[[robot]]\nname = \"dog\"\nurdf = \"FILE\"\nposition = [0, 0, 1]\nvelocity = [0.3, -0.2, 0.1]\nangular_velocity = [0.5, -0.4, 1.0]\njoints = { \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }\nmotor = [{ armature = 0, effort = 1e9 }]";

/// Afloat without gravity, its joints driven: it keeps its momentum to rounding, and its base and joints go where an integration by Runge-Kutta has them.
#[test]
fn a_robot_afloat_keeps_its_momentum_and_moves_as_it_should() {
    let truth = truth();
    let known = &truth["free_quadruped"];
    let rows = known["rows"].as_array().unwrap();
    let (amplitude, phase) = (numbers(&known["amplitude"]), numbers(&known["phase"]));
    let names: Vec<&str> = known["names"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    // The truth knows no damping, no friction, no limits.
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(root().join("rigid-couple/models/quadruped.urdf")).unwrap();
    let text = text.replace("damping=\"0.1\"", "damping=\"0\"").replace("friction=\"0.2\"", "friction=\"0\"");
    let text = text.replace("velocity=\"30\"", "").replace("velocity=\"20\"", "");
    let text = text.replace("type=\"revolute\"", "type=\"continuous\"");
    let file = folder.path().join("dog.urdf");
    std::fs::write(&file, text).unwrap();
    let scene = space(0.0, &AFLOAT.replace("FILE", &file.to_string_lossy()));
    let mut errors = Vec::new();
    for dt in [1e-3, 5e-4] {
        let mut robots = Robots::new(&scene).unwrap();
        let joints: Vec<usize> =
            robots.joints().iter().map(|joint| names.iter().position(|name| *name == joint.name).unwrap()).collect();
        let first = totals(&robots);
        let (mut worst, mut step, mut drift) = (0.0_f64, 0, 0.0_f64);
        for row in rows {
            let row = numbers(row);
            while (f64::from(step) + 0.5) * dt < row[0] {
                let time = f64::from(step) * dt;
                // The torque in the middle of the step.
                let torque =
                    |&i: &usize| amplitude[i] * (std::f64::consts::TAU * 4.0 * (time + 0.5 * dt) + phase[i]).sin();
                robots.act("dog", &Command::JointTorques(joints.iter().map(torque).collect())).unwrap();
                moved(&mut robots, time, dt);
                step += 1;
            }
            let base = &robots.robots()[0].base();
            let truth = Pose {
                position: DVec3::new(row[1], row[2], row[3]),
                rotation: DQuat::from_xyzw(row[5], row[6], row[7], row[4]),
            };
            let turned = 2.0 * (truth.rotation * base.rotation.conjugate()).xyz().length();
            worst = worst.max(turned).max((truth.position - base.position).length());
            for (joint, i) in robots.joints().iter().zip(&joints) {
                worst = worst.max((joint.position - row[8 + i]).abs());
            }
            let now = totals(&robots);
            drift = drift.max((now[0] - first[0]).length() / first[0].length());
            drift = drift.max((now[1] - first[1]).length() / first[1].length());
        }
        println!("dt {dt}: off by {worst:.1e} (2e-2), momentum by {drift:.1e} (1e-12)");
        assert!(drift < 1e-12, "momentum is off by {drift}");
        errors.push(worst);
    }
    let order = (errors[0] / errors[1]).log2();
    assert!(errors[1] < 2e-2 && order > 0.8, "{errors:?}, order {order}");
}

/// A quadruped over a bed of a law, with what more stands in its entry.
fn stand(law: &str, height: f64, more: &str) -> Scene {
    let text = format!(
        r#"
name = "stand"
world = {{ cell = 0.03125, min = [0, 0, 0], max = [1, 0.75, 1.5], walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }} }}
time = {{ end = 2 }}
[[material]]
name = "ground"
density = 1600
{law}
[[body]]
name = "bed"
material = "ground"
shape = {{ box = {{ min = [0, 0, 0], max = [1, 0.75, 0.125] }} }}
settled = true
[[robot]]
name = "dog"
model = "quadruped"
position = [0.5, 0.375, {height}]
joints = {{ "*_thigh_joint" = 0.8, "*_calf_joint" = -1.6 }}
{more}
"#
    );
    Scene::from_str(&text, "stand.toml", root()).unwrap()
}

const SAND: &str = "law = \"sand\"\nparameters = { young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 40 }";
const ELASTIC: &str = "law = \"neo_hookean\"\nparameters = { young_modulus = 2e5, poisson_ratio = 0.3 }";
const MOTORS: &str = "motor = [{ kp = 100, kd = 3 }]";

fn simulation(scene: &Scene, precision: Precision) -> Simulation {
    Simulation::new(&barchan::registry(), scene, &Options { precision, ..Options::default() }).unwrap()
}

/// The soil bears a robot at rest with its weight, and the robot stays where it is.
#[test]
fn a_robot_at_rest_is_borne_by_its_weight() {
    let mut dog = simulation(&stand(SAND, 0.44, MOTORS), Precision::F32);
    let weight = 9.81 * dog.bodies().iter().map(|body| body.mass).sum::<f64>();
    let run = |dog: &mut Simulation, until: f64| {
        let (mut impulse, from) = (0.0, dog.time());
        while dog.time() < until {
            let dt = dog.step().unwrap().dt;
            impulse += dt * dog.wrenches().iter().map(|wrench| wrench.force[2]).sum::<f64>();
        }
        impulse / (dog.time() - from)
    };
    run(&mut dog, 1.0);
    let before = dog.bodies()[0].position;
    let borne = run(&mut dog, 2.0);
    let after = dog.bodies()[0].position;
    let crept = (DVec3::from_array(after) - DVec3::from_array(before)).length();
    let unconverged =
        dog.ledger().counts.iter().find(|(name, _)| name.contains("not converged")).map_or(0, |(_, n)| *n);
    println!(
        "borne {:.4} of its weight (1 +- 0.01), crept {crept:.1e} m in a second (1e-3), height {:.3} m, {unconverged} solutions not converged",
        borne / weight,
        after[2]
    );
    assert!((borne / weight - 1.0).abs() < 0.01, "{borne} of {weight} N");
    assert!(crept < 1e-3 && after[2] > 0.37, "crept {crept}, at {after:?}");
    assert_eq!(unconverged, 0);
}

/// What a robot's joints' springs hold [J].
fn springs(dog: &Simulation, kp: f64, targets: &[f64]) -> f64 {
    dog.joints().iter().zip(targets).map(|(joint, target)| 0.5 * kp * (joint.position - target).powi(2)).sum()
}

/// B46: however light the feet and however stiff the motors, a fall from half a metre onto elastic ground creates no energy.
#[test]
fn a_fall_creates_no_energy_whatever_the_feet_weigh_and_the_gains_are() {
    for kp in [0.0, 20.0, 300.0, 2000.0] {
        for foot in ["0.05", "0.005", "5"] {
            let folder = tempfile::tempdir().unwrap();
            let text = std::fs::read_to_string(root().join("rigid-couple/models/quadruped.urdf")).unwrap();
            // Feet are spheres: their inertia goes with their mass.
            let foot_inertia = 0.4 * foot.parse::<f64>().unwrap() * 0.022 * 0.022;
            let text = text
                .replace("<mass value=\"0.05\"/>", &format!("<mass value=\"{foot}\"/>"))
                .replace("9.68e-06", &foot_inertia.to_string())
                .replace("effort=\"24\"", "effort=\"1e5\"")
                .replace("effort=\"36\"", "effort=\"1e5\"");
            let file = folder.path().join("dog.urdf");
            std::fs::write(&file, text).unwrap();
            let motors = format!("motor = [{{ kp = {kp}, kd = {} }}]", 0.01 * kp);
            let mut scene = stand(ELASTIC, 0.94, &motors);
            (scene.robot[0].model, scene.robot[0].urdf) = (None, Some(file));
            let mut dog = simulation(&scene, Precision::F64);
            let targets: Vec<f64> = dog.joints().iter().map(|joint| joint.position).collect();
            let all = |dog: &Simulation| {
                let ledger = dog.ledger();
                ledger.energy() + springs(dog, kp, &targets)
            };
            // Elastic energy is known from the first step on.
            dog.step().unwrap();
            let start = all(&dog);
            let fall = 9.81 * 0.5 * dog.bodies().iter().map(|body| body.mass).sum::<f64>();
            let mut most = f64::NEG_INFINITY;
            while dog.time() < 0.5 {
                dog.step().unwrap();
                most = most.max(all(&dog) - start);
            }
            println!("kp {kp}, feet of {foot} kg: energy rose by {:.2e} of the fall's (2e-3)", most / fall);
            assert!(most < 2e-3 * fall, "kp {kp}, foot {foot}: rose by {most} of {fall} J");
        }
    }
}

/// In empty space a robot and a soft ball that it meets keep their momentum together.
#[test]
fn a_robot_and_the_ground_keep_their_momentum() {
    for (precision, tolerance) in [(Precision::F64, 1e-12), (Precision::F32, 2e-6)] {
        let text = barchan_tests::scenes::robot_meets_ball(-0.5, 0.15);
        let mut dog = simulation(&Scene::from_str(&text, "meeting.toml", root()).unwrap(), precision);
        let sums = |dog: &Simulation| {
            let ledger = dog.ledger();
            let (p, l) = barchan_tests::scenes::totals(&ledger);
            [p, l].map(DVec3::from_array)
        };
        let [p0, l0] = sums(&dog);
        while dog.time() < 0.3 {
            dog.step().unwrap();
        }
        let [p1, l1] = sums(&dog);
        let taken = DVec3::from_array(dog.ledger().body_momentum).length() / p0.length();
        let off = ((p1 - p0).length() / p0.length()).max((l1 - l0).length() / (0.4 * p0.length()));
        println!("{precision}: momentum off by {off:.1e} ({tolerance:.0e}); the robot took {taken:.2} of it");
        assert!(taken > 0.1, "they never met");
        assert!(off < tolerance, "{precision}: {off}");
    }
}

/// A state taken in the middle goes on bit for bit.
#[test]
fn a_robots_state_goes_on_bit_for_bit() {
    let scene = stand(SAND, 0.43, MOTORS);
    let mut whole = simulation(&scene, Precision::F32);
    let targets: Vec<f64> = whole.joints().iter().map(|joint| joint.position + 0.1).collect();
    let go = |dog: &mut Simulation, steps: usize| (0..steps).for_each(|_| drop(dog.step().unwrap()));
    go(&mut whole, 60);
    whole.act("dog", &Command::JointTargets(targets)).unwrap();
    go(&mut whole, 60);
    let mut other = simulation(&scene, Precision::F32);
    other.set_state(&whole.state().unwrap()).unwrap();
    go(&mut whole, 100);
    go(&mut other, 100);
    assert_eq!(
        format!("{:?} {:?}", whole.bodies(), whole.joints()),
        format!("{:?} {:?}", other.bodies(), other.joints())
    );
}

/// What is wrong with a URDF or a robot's entry is named, with its element and line or its key.
#[test]
fn bad_robots_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let good = r#"<robot name="r">
<link name="a"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint>
<link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size="1 1 1"/></geometry></collision></link>
</robot>"#;
    let refused = |urdf: &str, entry: &str| {
        let file = folder.path().join("r.urdf");
        std::fs::write(&file, urdf).unwrap();
        let robot = format!("[[robot]]\nname = \"r\"\nurdf = \"{}\"\n{entry}", file.display());
        let text = format!(
            "name = \"s\"\nworld = {{ cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }}\ntime = {{ end = 1 }}\n{robot}"
        );
        Scene::from_str(&text, "s.toml", root())
            .and_then(|scene| Simulation::new(&barchan::registry(), &scene, &Options::default()).map(drop))
            .map_or_else(|e| e.to_string(), |()| "accepted".to_owned())
    };
    assert_eq!(refused(good, ""), "accepted");
    let b = |old: &str, new: &str| good.replace(old, new);
    let loops =
        b("</robot>", "<joint name=\"k\" type=\"fixed\"><parent link=\"a\"/><child link=\"b\"/></joint></robot>");
    let orphan = b("</robot>", "<link name=\"c\"/></robot>");
    let bare = b("<link name=\"b\">", "<link name=\"b\"/><link name=\"unused\">");
    let bare = bare.replace(
        "</robot>",
        "<joint name=\"k\" type=\"fixed\"><parent link=\"a\"/><child link=\"unused\"/></joint></robot>",
    );
    let two = "joints = { \"*j\" = 0.1, \"j*\" = 0.2 }";
    let cases: [(String, &str, &[&str]); 18] = [
        ("<robot name=\"r\"/>".to_owned(), "", &["r.urdf:1", "<robot> 'r'", "no <link>"]),
        (bare, "", &["r.urdf:3", "<joint> 'j'", "no link with mass or shape", "make the joint fixed"]),
        (good.to_owned(), "position = [5, 0, 0]", &["robot[0].position", "'r' is outside the world", "world.max"]),
        (good.to_owned(), two, &["robot[0]", "'*j' and 'j*'", "joint 'j'", "0.1 and 0.2"]),
        ("<robot".to_owned(), "", &["r.urdf", "not XML"]),
        (loops, "", &["r.urdf:6", "<joint> 'k'", "loop"]),
        (orphan, "", &["r.urdf:6", "<link> 'c'", "two bases"]),
        (b("link=\"b\"", "link=\"x\""), "", &["r.urdf:3", "<joint> 'j'", "'x' is no link"]),
        (b("<axis xyz=\"0 1 0\"/>", "<axis xyz=\"0 0 0\"/>"), "", &["r.urdf:3", "axis is zero"]),
        (b("ixx=\"1\"", "ixx=\"9\""), "", &["r.urdf:2", "<link> 'a'", "no body has", "mend_inertias"]),
        (
            b("box size=\"1 1 1\"", "mesh filename=\"package://p/m.stl\""),
            "",
            &["r.urdf:5", "package://p/m.stl", "no folder around"],
        ),
        (b("box size=\"1 1 1\"", "mesh filename=\"m.stl\""), "", &["r.urdf:5", "m.stl"]),
        (b("box size=\"1 1 1\"", "teapot size=\"1\""), "", &["r.urdf:5", "'teapot'"]),
        (b("revolute", "bendy"), "", &["r.urdf:3", "\"bendy\" is unknown"]),
        (good.to_owned(), "motor = [{ kp = -1 }]", &["robot[0].motor[0].kp", "-1"]),
        (good.to_owned(), "motor = [{ joints = \"knee\", kp = 1 }]", &["robot[0]", "'knee'", "known are: j"]),
        (good.to_owned(), "joints = { j = 2 }", &["robot[0]", "2 is beyond the limits of joint 'j'", "from -1 to 1"]),
        (good.to_owned(), "model = \"cat\"", &["robot[0]", "either urdf or model"]),
    ];
    // A pattern that says less, a fixed base beside the world, and one that falls into it.
    for entry in
        ["joints = { \"*\" = 0.1, \"j*\" = 0.2 }", "fixed = true\nposition = [5, 0, 0]", "position = [0.5, 0.5, 5]"]
    {
        assert_eq!(refused(good, entry), "accepted", "{entry}");
    }
    for (urdf, entry, parts) in cases {
        let text = refused(&urdf, entry);
        for part in parts {
            assert!(text.contains(part), "'{part}' is not in: {text}");
        }
    }
}

/// Robots of others stand on a floor, and arms hold still, with motors that only hold their joints.
#[test]
fn robots_of_others_stand_on_a_floor() {
    let legs = "\"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6";
    let anymal = "LF_HFE = 0.7, RF_HFE = 0.7, LH_HFE = -0.7, RH_HFE = -0.7, LF_KFE = -1.2, RF_KFE = -1.2, LH_KFE = 1.2, RH_KFE = 1.2";
    let solo = "FL_HFE = 0.8, FR_HFE = 0.8, HL_HFE = -0.8, HR_HFE = -0.8, FL_KFE = -1.6, FR_KFE = -1.6, HL_KFE = 1.6, HR_KFE = 1.6";
    let g1 = "\"*_hip_pitch_joint\" = -0.2, \"*_knee_joint\" = 0.42, \"*_ankle_pitch_joint\" = -0.22";
    let talos = "\"leg_*_3_joint\" = -0.4, \"leg_*_4_joint\" = 0.8, \"leg_*_5_joint\" = -0.4";
    let ours = "\"*_hip_pitch_joint\" = -0.2, \"*_knee_joint\" = 0.4, \"*_ankle_pitch_joint\" = -0.2";
    let cases = [
        ("go2", legs, 150.0),
        ("a1", legs, 150.0),
        ("anymal_b", anymal, 150.0),
        ("anymal_c", anymal, 150.0),
        ("solo12", solo, 5.0),
        ("g1", g1, 300.0),
        ("talos", talos, 1500.0),
        ("humanoid", ours, 300.0),
        ("panda", "", 300.0),
        ("ur5", "", 300.0),
    ];
    let truth = truth();
    for (name, joints, kp) in cases {
        let entry = truth["robots"].as_array().unwrap().iter().find(|entry| entry["name"] == name).unwrap();
        let floating = entry["floating"].as_bool().unwrap();
        let file = file_of(entry["urdf"].as_str().unwrap());
        let text = |height: f64| {
            format!(
                "name = \"floor\"\nworld = {{ cell = 0.002, min = [-2, -2, 0], max = [2, 2, 3], walls = {{ x_min = \"open\", x_max = \"open\", y_min = \"open\", y_max = \"open\", z_min = \"stick\", z_max = \"open\" }} }}\ntime = {{ end = 1 }}\n[[robot]]\nname = \"r\"\nurdf = \"{}\"\nfixed = {}\nposition = [0, 0, {height}]\ncontact = {{ coulomb = {{ friction = 0.8 }} }}\njoints = {{ {joints} }}\nmotor = [{{ kp = {kp}, kd = {}, effort = 1e4 }}]",
                file.display(),
                !floating,
                0.03 * kp
            )
        };
        let make = |height: f64| Robots::new(&Scene::from_str(&text(height), "floor.toml", root()).unwrap()).unwrap();
        // Its lowest point is to be just above the floor.
        let lowest = make(1.0).bounds().iter().map(|bounds| bounds.min[2]).fold(f64::INFINITY, f64::min);
        let height = 1.0 - lowest + 0.002;
        let mut robots = make(height);
        let dt = 5e-4;
        (0..2000).for_each(|step| moved(&mut robots, f64::from(step) * dt, dt));
        let base = robots.robots()[0].base();
        let (upright, sunk) = ((base.rotation * DVec3::Z).z, height - base.position.z);
        let speed = robots.bodies().iter().map(|body| DVec3::from_array(body.velocity).length()).fold(0.0, f64::max);
        println!(
            "{name}: stands {sunk:.3} m lower (0.05), upright {upright:.4} (0.99), at up to {speed:.3} m/s (0.15)"
        );
        assert!(upright > 0.99 && sunk.abs() < 0.05 && speed < 0.15, "{name}: {upright}, {sunk} m, {speed} m/s");
    }
}

/// Symptom: an arm beside a box of sand was thrown by the box's wall, behind which it stands.
#[test]
fn an_arm_that_stands_behind_a_wall_reaches_over_it() {
    let text = "name = \"box\"\nworld = { cell = 0.02, min = [0.2, -0.2, 0], max = [0.7, 0.2, 0.4], walls = { x_min = \"slip\", x_max = \"slip\", y_min = \"slip\", y_max = \"slip\", z_min = \"stick\" } }\ntime = { end = 1 }\n[[robot]]\nname = \"arm\"\nmodel = \"arm-rod\"\nfixed = true\nposition = [0, 0, 0.1]\nmotor = [{ kp = 3000, kd = 150 }]\nmotion = { path = { link = \"rod\", frames = [{ time = 0, position = [0.4, 0, 0.2], rotation = [0, 1, 0, 0] }] } }";
    let mut arm = Robots::new(&Scene::from_str(text, "box.toml", root()).unwrap()).unwrap();
    (0..500).for_each(|step| moved(&mut arm, 1e-3 * f64::from(step), 1e-3));
    let rod = arm.bodies().into_iter().find(|body| body.name == "arm/rod").unwrap();
    // The rod's middle hangs above its tip; what is left is sag under its weight.
    let off = (rod.position[0] - 0.4).hypot(rod.position[1]);
    println!("the rod is {off:.4} m off (0.02), at {:.3} m/s", DVec3::from_array(rod.velocity).length());
    assert!(off < 0.02 && DVec3::from_array(rod.velocity).length() < 1e-3, "{rod:?}");
}
