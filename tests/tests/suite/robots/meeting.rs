//! Robots that meet free bodies and one another.

use super::{MOTORS, SAND, felt, moved, root, simulation, stand, totals};
use barchan::{BodyState, Command, Coupling, Precision, Scene, Simulation};
use barchan_core::coupling::Moved;
use barchan_rigid::robot::Robots;
use barchan_tests::scenes::{missed, round_world};
use glam::{DMat3, DQuat, DVec3};

const DOG: &str = "[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\njoints = { \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }\ncontact = { coulomb = { friction = 0.5 } }";

/// A scene without ground on fine cells, so that shapes meet as they are.
fn bare(gravity: f64, walls: &str, rest: &str) -> Scene {
    let text = format!(
        "name = \"bare\"\ngravity = [0, 0, {gravity}]\nworld = {{ cell = 0.002, min = [-3, -3, 0], max = [3, 3, 3], walls = {{ {walls} }} }}\ntime = {{ end = 10 }}\n{rest}"
    );
    Scene::from_str(&text, "bare.toml", root()).unwrap()
}

const OPEN: &str =
    "x_min = \"open\", x_max = \"open\", y_min = \"open\", y_max = \"open\", z_min = \"open\", z_max = \"open\"";
const FLOOR: &str = "z_min = { separate = { friction = 0.5 } }";

fn body(robots: &Robots, name: &str) -> BodyState {
    robots.bodies().into_iter().find(|body| body.name == name).unwrap_or_else(|| panic!("no body '{name}'"))
}

fn place(robots: &Robots, name: &str) -> DVec3 {
    DVec3::from_array(body(robots, name).position)
}

fn kinetic(robots: &Robots) -> f64 {
    robots.bodies().iter().map(|body| body.kinetic_energy).sum()
}

/// How far a ball of that radius is inside the links of a robot at most [m].
fn sunk(robots: &Robots, ball: &str, radius: f64) -> f64 {
    let at = body(robots, ball).position;
    let links = robots.bodies().into_iter().enumerate().filter(|(_, body)| body.name != ball);
    let nearest = links.map(|(number, _)| robots.contact_distance(number, &[at])[0]).fold(f64::INFINITY, f64::min);
    radius - nearest
}

/// Moves robots in empty space by so many steps. Returns how far their momenta are off at most, as parts of themselves, and their greatest kinetic energy over that of
/// the start.
fn adrift(robots: &mut Robots, steps: u32, mut each: impl FnMut(&Robots)) -> [f64; 2] {
    let (start, energy) = (totals(robots), kinetic(robots));
    let (mut drift, mut most) = (0.0_f64, 0.0_f64);
    let dt = 2.5e-4;
    for step in 0..steps {
        moved(robots, dt * f64::from(step), dt);
        let now = totals(robots);
        (0..2).for_each(|i| drift = drift.max((now[i] - start[i]).length() / start[i].length()));
        most = most.max(kinetic(robots) / energy);
        each(robots);
    }
    [drift, most]
}

/// In empty space a ball flies into a robot afloat, a thousandth or a thousand times as heavy as that, and anything between: momentum is kept to rounding, no energy
/// is created, and they do not overlap.
#[test]
fn a_ball_that_hits_a_robot_afloat_keeps_momentum_whatever_it_weighs() {
    let dog = Robots::new(&bare(0.0, OPEN, DOG)).unwrap();
    let weighs: f64 = dog.bodies().iter().map(|body| body.mass).sum();
    for ratio in [1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3] {
        for restitution in [0.0, 0.7] {
            let mass = ratio * weighs;
            let ball = format!(
                "[[tool]]\nname = \"ball\"\nshape = {{ sphere = {{ center = [0, 0, 0], radius = 0.1 }} }}\nposition = [-0.6, 0.06, 1.03]\ncontact = {{ coulomb = {{ friction = 0.3 }} }}\nmotion = {{ free = {{ mass = {mass}, linear = [2, 0, 0], angular = [0, 3, 1], restitution = {restitution} }} }}"
            );
            let dog = DOG.replace("joints", "position = [0, 0, 1]\njoints");
            let mut robots = Robots::new(&bare(0.0, OPEN, &format!("{ball}\n{dog}"))).unwrap();
            let mut deepest = f64::NEG_INFINITY;
            let [drift, most] = adrift(&mut robots, 2400, |robots| deepest = deepest.max(sunk(robots, "ball", 0.1)));
            let passed = (DVec3::from_array(body(&robots, "ball").velocity) - DVec3::X * 2.0).length() / 2.0;
            println!(
                "ball of {mass:.3} kg, restitution {restitution}: momentum off by {drift:.1e} (1e-12), energy at most {most:.6} of the start's (1 + 1e-6), {:.2e} m sunk in (1e-3), speed changed by {passed:.1e}",
                deepest
            );
            assert!(drift < 1e-12, "momentum is off by {drift}");
            assert!(most < 1.0 + 1e-6, "energy grew to {most}");
            assert!(deepest < 1e-3, "{deepest} m sunk in");
            assert!(deepest > -1e-3 && passed > 1e-4, "they never met: {deepest}, {passed}");
        }
    }
}

/// Two robots afloat bump into each other: they keep their momentum, create no energy, and do not pass through each other.
#[test]
fn two_robots_that_bump_do_not_pass_through_each_other() {
    let one = DOG.replace("joints", "position = [-0.8, 0.02, 1]\nvelocity = [1.5, 0, 0]\njoints");
    let other = DOG.replace("\"dog\"", "\"cat\"").replace("joints", "position = [0.3, 0, 1.05]\njoints");
    let mut robots = Robots::new(&bare(0.0, OPEN, &format!("{one}\n{other}"))).unwrap();
    let mut pressed = 0.0_f64;
    let [drift, most] = adrift(&mut robots, 4000, |robots| {
        let [dog, cat] = &Coupling::robots(robots)[..] else { panic!("there are two") };
        let sum = (felt(dog) + felt(cat)).length();
        pressed = pressed.max(felt(cat).length());
        assert!(sum <= 1e-9 * felt(cat).length(), "what they feel of each other is not opposite: {sum} N");
    });
    let gap = place(&robots, "cat").x - place(&robots, "dog").x;
    println!(
        "momentum off by {drift:.1e} (1e-12), energy at most {most:.6} (1 + 1e-6), pressed with {pressed:.0} N, {gap:.3} m apart (0.2)"
    );
    assert!(drift < 1e-12 && most < 1.0 + 1e-6 && pressed > 10.0 && gap > 0.2, "{drift}, {most}, {pressed}, {gap}");
}

/// Box upon box upon the floor, the upper one a thousand times as heavy as the lower, or the other way round: they stay where they are.
#[test]
fn a_heavy_box_rests_on_a_light_one() {
    for [lower, upper] in [[1.0, 1e3], [1e3, 1.0], [1.0, 1.0], [1.0, 100.0]] {
        let of = |name: &str, z: f64, mass: f64| {
            format!(
                "[[tool]]\nname = \"{name}\"\nshape = {{ box = {{ half = [0.1, 0.1, 0.1] }} }}\nposition = [0, 0, {z}]\ncontact = {{ coulomb = {{ friction = 0.5 }} }}\nmotion = {{ free = {{ mass = {mass} }} }}\n"
            )
        };
        let far = DOG.replace("joints", "position = [2, 2, 1]\nfixed = true\njoints");
        let scene = bare(-9.81, FLOOR, &format!("{}{}{far}", of("lower", 0.1, lower), of("upper", 0.3, upper)));
        let mut robots = Robots::new(&scene).unwrap();
        let dt = 5e-4;
        (0..2000).for_each(|step| moved(&mut robots, f64::from(step) * dt, dt));
        let off = |name: &str, z: f64| (place(&robots, name) - DVec3::Z * z).length();
        let off = [off("lower", 0.1), off("upper", 0.3)];
        let fastest = ["lower", "upper"].map(|name| DVec3::from_array(body(&robots, name).velocity).length());
        println!("{upper} kg on {lower} kg: {off:.6?} m off (1e-3), at {fastest:.6?} m/s (1e-3)");
        assert!(off.iter().chain(&fastest).all(|x| *x < 1e-3), "{off:?}, {fastest:?}");
    }
}

/// A ball beside robots bounces off the floor with its restitution, and one without it stays down.
#[test]
fn a_ball_beside_robots_bounces_with_its_restitution() {
    for restitution in [0.0, 0.5, 0.8, 1.0] {
        let ball = format!(
            "[[tool]]\nname = \"ball\"\nshape = {{ sphere = {{ center = [0, 0, 0], radius = 0.1 }} }}\nposition = [0, 0, 0.6]\nmotion = {{ free = {{ mass = 2, restitution = {restitution} }} }}\n"
        );
        let far = DOG.replace("joints", "position = [2, 2, 1]\nfixed = true\njoints");
        let mut robots = Robots::new(&bare(-9.81, FLOOR, &format!("{ball}{far}"))).unwrap();
        let dt = 2e-4;
        let (mut down, mut most) = (false, 0.0_f64);
        for step in 0..4500 {
            moved(&mut robots, dt * f64::from(step), dt);
            let z = place(&robots, "ball").z - 0.1;
            down |= z < 1e-3;
            if down {
                most = most.max(z);
            }
        }
        let truth = 0.5 * restitution * restitution;
        println!("restitution {restitution}: back up to {most:.4} m ({truth:.4} +- 0.005)");
        assert!(down && (most - truth).abs() < 5e-3, "{restitution}: {most}, not {truth}");
    }
}

/// An arm pushes a box along the floor, against friction: the box goes where its rod goes, and not into it.
#[test]
fn an_arm_pushes_a_box_along_the_floor() {
    let text = "[[tool]]\nname = \"box\"\nshape = { box = { half = [0.05, 0.08, 0.05] } }\nposition = [0.43, 0, 0.05]\ncontact = { coulomb = { friction = 0.4 } }\nmotion = { free = { mass = 0.5 } }\n[[robot]]\nname = \"arm\"\nmodel = \"arm-rod\"\nfixed = true\nposition = [0, 0, 0.1]\nmotor = [{ kp = 3000, kd = 150 }]\nmotion = { path = { link = \"rod\", frames = [{ time = 0, position = [0.33, 0, 0.04], rotation = [0, 1, 0, 0] }, { time = 1, position = [0.53, 0, 0.04], rotation = [0, 1, 0, 0] }] } }";
    let mut robots = Robots::new(&bare(-9.81, FLOOR, text)).unwrap();
    let dt = 5e-4;
    let (mut impulse, mut felt_for) = (0.0, 0.0);
    for step in 0..2400 {
        moved(&mut robots, f64::from(step) * dt, dt);
        let time = f64::from(step) * dt;
        if (0.5..0.8).contains(&time) {
            impulse += dt * felt(&Coupling::robots(&robots)[0]).x;
            felt_for += dt;
        }
    }
    let (pushed, push) = (place(&robots, "box"), -impulse / felt_for);
    let rod = place(&robots, "arm/rod");
    // While it slides, friction of the floor is all that holds it, but for what speeds it up.
    let friction = 0.4 * 0.5 * 9.81;
    println!(
        "the box went {:.3} m (0.13 to 0.16) and {:.1e} m sideways (0.02); pushed with {push:.2} N (friction {friction:.2} +- 15 %); {:.3} m before the rod",
        pushed.x - 0.43,
        pushed.y,
        pushed.x - rod.x
    );
    assert!((0.13..0.16).contains(&(pushed.x - 0.43)) && pushed.y.abs() < 0.02, "{pushed}");
    assert!((push / friction - 1.0).abs() < 0.15, "{push} N");
    let counts = Coupling::counts(&robots);
    let missed = missed(counts.iter().map(|(name, count)| (name, count)));
    println!("rates of {missed} steps of 2400 not found (2)");
    assert!(missed <= 2, "{missed}");
}

/// What a device is told of points fits what the law says that it is told at most, also where only a tool can be touched: of one robot over a block that stays or moves, in a world
/// without walls, and with a ball beside it.
#[test]
fn a_device_has_room_for_the_points_that_it_is_told_of() {
    let block = "[[tool]]\nname = \"block\"\nshape = { box = { half = [0.5, 0.5, 0.1] } }\nposition = [0, 0, 0.6]\n";
    let ball = "[[tool]]\nname = \"ball\"\nshape = { sphere = { center = [0, 0, 0], radius = 0.1 } }\nposition = [0.3, 0.3, 0.8]\nmotion = { free = { mass = 2 } }\n";
    let moves = "motion = { velocity = { linear = [0.01, 0, 0] } }\n";
    for (more, points) in [("", 4), (moves, 4), (ball, 5)] {
        let mut robots =
            Robots::new(&bare(-9.81, OPEN, &format!("{block}{more}{DOG}\nposition = [0, 0, 1.0]"))).unwrap();
        let group = robots.device_law().unwrap().answer.groups.remove(0);
        let dt = 5e-4;
        let (mut most, mut in_turns) = (0, 0);
        for step in 0..400 {
            let time = f64::from(step) * dt;
            if robots.leashes(time, dt, 8).is_some_and(|leashes| leashes.in_turns) {
                in_turns += 1;
                robots.move_on_device(Moved::InTurns);
                robots.before_step(time, dt).unwrap();
                most = robots.told().iter().map(Vec::len).fold(most, usize::max);
                robots.move_on_device(Moved::ByCoupling);
            }
            moved(&mut robots, time, dt);
        }
        println!("{in_turns} steps in turns; told up to {most} words of {}", group.told);
        assert!(in_turns > 20 && most > 4 * points && most <= group.told, "{in_turns}, {most} of {}", group.told);
    }
}

/// A dog on a plank that lies on sand.
fn on_plank(mass: f64) -> Scene {
    let plank = format!(
        "contact = {{ coulomb = {{ friction = 0.6 }} }}\n{MOTORS}\n[[tool]]\nname = \"plank\"\nshape = {{ box = {{ half = [0.3, 0.25, 0.03125] }} }}\nposition = [0.5, 0.375, 0.15625]\ncontact = {{ coulomb = {{ friction = 0.6 }} }}\nmotion = {{ free = {{ mass = {mass} }} }}"
    );
    stand(SAND, 0.51, &plank)
}

/// How far the dog's feet are over the plank [m], along its own axes.
fn feet_over(simulation: &Simulation) -> Vec<DVec3> {
    let bodies = simulation.bodies();
    let plank = bodies.iter().find(|body| body.name == "plank").unwrap();
    let [w, x, y, z] = plank.rotation;
    let turn = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)).transpose();
    let feet = bodies.iter().filter(|body| body.name.ends_with("_foot"));
    let over = feet.map(|foot| turn * (DVec3::from_array(foot.position) - DVec3::from_array(plank.position)));
    // Feet are balls of 22 mm.
    over.map(|at| at - DVec3::Z * (0.03125 + 0.022)).collect()
}

/// A robot stands on a plank a fortieth as heavy, which lies on sand: its feet stay on the plank, the plank bears the robot, and the sand both.
#[test]
fn a_robot_stands_on_a_light_plank_on_sand() {
    let mut dog = simulation(&on_plank(0.3), Precision::F64);
    let mass = |name: &str| -> f64 {
        dog.bodies().iter().filter(|body| body.name.starts_with(name)).map(|body| body.mass).sum()
    };
    let [robot, plank] = ["dog", "plank"].map(|name| 9.81 * mass(name));
    let (mut ground, mut feet, mut time) = (0.0, 0.0, 0.0);
    let (mut deepest, mut before) = (0.0_f64, Vec::new());
    while dog.time() < 1.0 {
        let dt = dog.step().unwrap().dt;
        if dog.time() < 0.5 {
            continue;
        }
        let over = feet_over(&dog);
        deepest = over.iter().fold(deepest, |most, at| most.max(-at.z));
        if before.is_empty() {
            before = over;
        }
        ground += dt * dog.wrenches().iter().map(|wrench| wrench.force[2]).sum::<f64>();
        feet += dt * felt(&dog.robots()[0]).z;
        time += dt;
    }
    let after = feet_over(&dog);
    let slip = before.iter().zip(&after).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max);
    let unconverged =
        dog.ledger().counts.iter().find(|(name, _)| name.contains("not converged")).map_or(0, |(_, n)| *n);
    let [ground, feet] = [ground / time / (robot + plank), feet / time / robot];
    println!(
        "feet {deepest:.1e} m in the plank (1e-3), slipped {slip:.1e} m (2e-4); the plank bears {feet:.4} of the robot (1 +- 0.02), the sand {ground:.4} of both (1 +- 0.03); {unconverged} solutions not converged (0)"
    );
    assert!(deepest < 1e-3 && slip < 2e-4, "{deepest}, {slip}");
    assert_eq!(unconverged, 0);
    assert!((feet - 1.0).abs() < 0.02 && (ground - 1.0).abs() < 0.03, "{feet}, {ground}");
    assert!(after.iter().all(|at| at.z < 1e-3), "feet are in the air: {after:?}");
}

/// A state taken while a robot stands on a free body goes on bit for bit.
#[test]
fn a_robot_on_a_free_body_goes_on_bit_for_bit() {
    let scene = on_plank(0.3);
    let mut whole = simulation(&scene, Precision::F32);
    let go = |dog: &mut Simulation, steps: usize| (0..steps).for_each(|_| drop(dog.step().unwrap()));
    go(&mut whole, 150);
    let felt: usize = whole.robots()[0].links.iter().map(|link| link.rigid.len()).sum();
    assert!(felt > 0, "they do not touch");
    let mut other = simulation(&scene, Precision::F32);
    other.set_state(&whole.state().unwrap()).unwrap();
    go(&mut whole, 60);
    go(&mut other, 60);
    let of = |simulation: &Simulation| format!("{:?} {:?}", simulation.bodies(), simulation.joints());
    assert_eq!(of(&whole), of(&other));
}

/// Tools beside robots that answer what they feel take no commands, and are moved by the robots' coupling.
#[test]
fn tools_that_answer_take_no_commands_beside_robots() {
    for (motion, coupling) in
        [("free = { mass = 1 }", 0), ("servo = { axis = [0, 0, 1], force = 1 }", 0), ("velocity = {}", 1)]
    {
        let tool = format!(
            "[[tool]]\nname = \"ball\"\nshape = {{ sphere = {{ center = [0, 0, 0], radius = 0.1 }} }}\nposition = [1, 1, 1]\nmotion = {{ {motion} }}\n"
        );
        let mut simulation = simulation(&bare(0.0, OPEN, &format!("{tool}{DOG}")), Precision::F64);
        let warnings: Vec<String> = simulation.couplings().iter().flat_map(|one| one.warnings(0.002)).collect();
        assert!(warnings.iter().all(|warning| !warning.contains("pass")), "{warnings:?}");
        let refused = simulation.act("ball", &Command::JointTargets(Vec::new())).unwrap_err().to_string();
        assert!(refused.contains("tool 'ball'") && refused.contains("asked for"), "{refused}");
        assert_eq!(simulation.robots().len(), 1);
        let rigid = simulation.couplings().iter().filter(|one| one.name() == "rigid").count();
        assert_eq!(rigid, coupling, "{motion}");
        let twist = Command::Twist { linear: [1.0, 0.0, 0.0], angular: [0.0; 3] };
        assert_eq!(simulation.act("ball", &twist).is_ok(), coupling == 1, "{motion}");
    }
}

/// Bodies that overlap others where they start are named; those that stand on one another are not.
#[test]
fn bodies_that_overlap_others_at_the_start_are_named() {
    let warned = |tools: &str| {
        let robots = Robots::new(&bare(-9.81, FLOOR, &format!("{tools}{DOG}\nposition = [0, 0, 1]"))).unwrap();
        robots.warnings(0.002).into_iter().find(|warning| warning.contains("overlap where they start"))
    };
    let tool = |name: &str, z: f64, motion: &str| {
        format!(
            "[[tool]]\nname = \"{name}\"\nshape = {{ sphere = {{ center = [0, 0, 0], radius = 0.1 }} }}\nposition = [1, 1, {z}]\nmotion = {motion}\n"
        )
    };
    let (free, still) = ("{ free = { mass = 1 } }", "\"fixed\"");
    assert_eq!(warned(&(tool("ball", 0.1, free) + &tool("other", 0.3, free))), None);
    let text = warned(&(tool("ball", 0.15, free) + &tool("other", 0.3, free))).unwrap();
    assert!(text.contains("'ball' and 'other'") && !text.contains("dog"), "{text}");
    let text = warned(&(tool("ball", 0.05, free) + &tool("stone", 0.2, still))).unwrap();
    assert!(text.contains("'ball' and a wall of the world") && text.contains("'ball' and 'stone'"), "{text}");
    let servo = "{ servo = { axis = [1, 0, 0], force = 1 } }";
    assert_eq!(warned(&(tool("one", 0.05, servo) + &tool("other", 0.1, servo))), None);
}

/// How far two balls of [`round_world`] have come after a second, along x [m], beside a robot or alone.
fn come(places: [f64; 2], other: &str, is_alone: bool) -> [f64; 2] {
    let free = "{ free = { mass = 1, linear = [1, 0, 0], restitution = 0.5 } }";
    let mut scene = round_world(&[(places[0], free), (places[1], other)]);
    if is_alone {
        scene.robot.clear();
    }
    let mut world = simulation(&scene, Precision::F64);
    while world.time() < 0.9995 {
        world.step().unwrap();
    }
    let bodies = world.bodies();
    let of = |ball: &str| bodies.iter().find(|body| body.name == ball).unwrap().position[0];
    [of("ball0") - places[0], of("ball1") - places[1]]
}

/// A free ball that leaves a periodic world at one side meets what is near the other: another free ball, one that stays, and one that comes towards it. Both move as
/// they do in the middle of the world.
#[test]
fn beyond_a_periodic_side_tools_meet_what_is_near_the_other() {
    let others =
        [("{ free = { mass = 2 } }", 0.2), ("\"fixed\"", 0.0), ("{ velocity = { linear = [-0.5, 0, 0] } }", -0.5)];
    for ((other, by), is_alone) in others.into_iter().flat_map(|other| [(other, false), (other, true)]) {
        let middle = come([-0.2, 0.2037], other, is_alone);
        for places in [[0.7, -0.8963], [0.9, -0.6963]] {
            let there = come(places, other, is_alone);
            let off = (0..2).map(|i| (there[i] - middle[i]).abs()).fold(0.0, f64::max);
            println!(
                "{other}, without a robot {is_alone}: came {there:.4?} m, {off:.1e} from what it is in the middle (1e-9)"
            );
            assert!(off < 1e-9, "{other}: {there:?} and {middle:?}");
        }
        assert!(middle[0] < 0.9 && (middle[1] - by).abs() < 0.3, "{other}: {middle:?}, they do not meet");
    }
}
