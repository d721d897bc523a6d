//! Gradients through robots, and through free tools that meet other tools: by where they begin and how fast, by what motors are told, by masses and friction, and of what they felt.

use super::tools::{WAY, along, cross, inner, on_top, rotated, turned};
use super::{AWAKE, H, Noise, Vec3, by_number, difference, dot, simulation, weights, within};
use barchan::gradient::{BodyCotangents, Gradient, PoseCotangent, RobotCotangents};
use barchan::{Command, Cotangents, Placement, Precision, Tape, Wrench};
use barchan_tests::sketch::{Head, block, half, hopper, material, tool};

/// Steps of 1 ms.
const STEPS: u32 = 8;
const RUBBING: &str = "{ coulomb = { friction = 0.3 } }";

/// What is changed, and by how much.
#[derive(Clone, Copy)]
struct Change(&'static str, f64);

impl Change {
    fn of(&self, what: &str) -> f64 {
        if self.0 == what { self.1 } else { 0.0 }
    }
}

/// What is changed, how long differences of it are, and what a gradient says of it.
struct Compared(&'static str, f64, Box<dyn Fn(&Gradient) -> f64>);

fn by(what: &'static str, step: f64, given: impl Fn(&Gradient) -> f64 + 'static) -> Compared {
    Compared(what, step, Box::new(given))
}

/// A scene with what is in it, told what, besides stirred ground.
struct Case<'a> {
    walls: &'a str,
    /// The scene's robots and tools.
    parts: &'a dyn Fn(Change) -> String,
    /// What each is told before it starts.
    told: &'a dyn Fn(Change) -> Vec<(&'static str, Command)>,
    /// Do levels follow them, in wider ground?
    nested: bool,
}

impl Case<'_> {
    fn tape(&self, change: Change) -> Tape {
        self.tape_of(STEPS, change)
    }

    fn tape_of(&self, steps: u32, change: Change) -> Tape {
        let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
        let shares = [1.0 + change.of("mass of the base") / 2.0, 1.0 + change.of("mass of a link") / 0.4];
        let urdf = format!("{:?}", hopper(folder.path(), shares));
        let gravity = [0.6, 0.0, -9.81 - change.of("gravity")];
        let (world, size, levels) = match self.nested {
            false => ([8, 8, 12], [5.0, 5.0, 3.0], ""),
            true => ([28, 20, 16], [27.0, 19.0, 3.0], "[levels]\ncount = 2\nhalf = 8\n"),
        };
        let head = Head { gravity, ..Head::cells(H, world, self.walls) };
        let parts = (self.parts)(change).replace("HOPPER", &urdf);
        let ground = block("neo_hookean", [0.0; 3], size.map(|cells| cells * H), "");
        let jelly = material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3");
        let mut sim = simulation(
            &head.time("step = 1e-3").with(&[AWAKE.into(), levels.into(), jelly, ground, parts]),
            Precision::F64,
        );
        let mut state = sim.particles();
        let mut noise = Noise::new(9);
        for (l, i) in by_number(&state) {
            let list = &mut state.lists[l];
            let [v, way]: [Vec3; 2] = [0; 2].map(|_| std::array::from_fn(|_| noise.draw()));
            list.velocity[i] = std::array::from_fn(|d| 0.4 * v[d] + change.of("ground") * way[d]);
        }
        sim.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
        for (body, command) in (self.told)(change) {
            sim.act(body, &command).unwrap_or_else(|e| panic!("{e}"));
        }
        sim.record(&barchan::registry(), 1e-3 * f64::from(steps)).unwrap_or_else(|e| panic!("{e}"))
    }

    /// What a loss looks at: particles, where bodies end and how they move, what they felt, and joints.
    fn loss(tape: &Tape) -> (f64, Cotangents) {
        let mut all = weights(tape.end().id.len());
        let end = tape.end();
        let mut loss = dot(&end.position, &all.position) + dot(&end.velocity, &all.velocity);
        let mut noise = Noise::new(4);
        let mut three = |size: f64| -> Vec3 { std::array::from_fn(|_| size * noise.draw()) };
        for (body, felt) in end.bodies.iter().zip(tape.impulses()) {
            let (axis, weight) = (rotated(body.rotation, three(1.0)), three(1.0));
            let pose = PoseCotangent { position: three(0.5), rotation: cross(axis, weight) };
            let impulse = Wrench { force: three(0.5), torque: three(3.0) };
            let answers = body.twist != [[0.0; 3]; 2];
            let [velocity, angular_velocity] =
                [three(0.05), three(0.01)].map(|owed| if answers { owed } else { [0.0; 3] });
            loss += inner(body.position, pose.position)
                + inner(axis, weight)
                + inner(body.twist[0], velocity)
                + inner(body.twist[1], angular_velocity)
                + inner(felt.force, impulse.force)
                + inner(felt.torque, impulse.torque);
            all.bodies.push(BodyCotangents { pose, velocity, angular_velocity, impulse });
        }
        for robot in &end.robots {
            let positions: Vec<f64> = robot.positions.iter().map(|_| noise.draw()).collect();
            let rates: Vec<f64> = robot.rates.iter().map(|_| 0.02 * noise.draw()).collect();
            let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            loss += sum(&robot.positions, &positions) + sum(&robot.rates, &rates);
            all.robots.push(RobotCotangents { positions, rates, energy: 0.0 });
        }
        (loss, all)
    }

    /// Compares a gradient with differences of runs.
    fn compare(&self, changes: &[Compared]) {
        let tape = self.tape(Change("", 0.0));
        assert_eq!(tape.len(), STEPS as usize);
        let felt: f64 = tape.impulses().iter().map(|felt| inner(felt.force, felt.force)).sum();
        assert!(felt > 1e-6, "nothing touches the ground");
        let found = tape.pull_back(Self::loss(&tape).1).unwrap_or_else(|e| panic!("{e}"));
        for Compared(what, step, given) in changes {
            let given = given(&found);
            let expected = difference(*step, |by| Self::loss(&self.tape(Change(what, by))).0);
            let off = (given - expected).abs() / expected.abs().max(1e-3);
            within(&format!("{what}: {given:.9e} {expected:.9e}"), off, 5e-6);
        }
    }

    /// What the stirring of the ground says.
    fn ground(found: &Gradient) -> f64 {
        let mut noise = Noise::new(9);
        let way = |_: &Vec3| -> Vec3 {
            (0..3).for_each(|_| _ = noise.draw());
            std::array::from_fn(|_| noise.draw())
        };
        let ways: Vec<Vec3> = found.particles.velocity.iter().map(way).collect();
        dot(&found.particles.velocity, &ways)
    }
}

/// What is owed along the direction in which joints are changed.
fn joints(all: &[f64]) -> f64 {
    0.7 * all[0] - 0.4 * all[1]
}

/// A hopper in the ground, at a height [m], told all that a robot can be told.
fn hop(walls: &str, height: f64, [hip, target]: [f64; 2], fixed: bool, nested: bool) {
    let parts = |change: Change| {
        let friction = 0.3 + change.of("friction");
        let [kp, kd] = [("kp", 30.0), ("kd", 0.4)].map(|(name, gain)| gain + change.of(name));
        format!(
            "[[robot]]\nname = \"hopper\"\nurdf = HOPPER\nfixed = {fixed}\nposition = [0.12, 0.13, {height:?}]\ncontact = {{ coulomb = {{ friction = {friction:?} }} }}\nmotor = [{{ kp = {kp:?}, kd = {kd:?} }}]\n"
        )
    };
    let told = |change: Change| {
        let joint =
            |from: [f64; 2], what: &str| [from[0] + 0.7 * change.of(what), from[1] - 0.4 * change.of(what)].to_vec();
        let moving = |all: Vec3, what: &str| Some(along(all, change.of(what))).filter(|_| !fixed);
        let placement = Placement {
            position: Some(along([0.12, 0.13, height], change.of("position"))),
            rotation: Some(on_top(turned(along([0.0; 3], change.of("rotation"))), turned([0.1, -0.2, 0.3]))),
            velocity: moving([0.2, -0.1, -0.9], "velocity"),
            angular_velocity: moving([1.5, -2.0, 1.0], "angular velocity"),
            joints: Some(joint([hip, -0.5], "joints")),
            joint_rates: Some(joint([1.2, -2.0], "joint rates")),
        };
        let motion = Command::JointMotion {
            targets: Some(joint([target, -0.1], "targets")),
            rates: Some(joint([0.3, -0.2], "target rates")),
            torques: Some(joint([0.4, 0.5], "torques")),
        };
        vec![("hopper", Command::Place(placement)), ("hopper", motion)]
    };
    let mut changes = vec![
        by("ground", 1e-6, Case::ground),
        by("gravity", 1e-4, |found| -found.gravity[2]),
        by("position", 1e-7, |found| inner(found.particles.bodies[0].pose.position, WAY)),
        by("rotation", 1e-6, |found| inner(found.particles.bodies[0].pose.rotation, WAY)),
        by("joint rates", 1e-5, |found| joints(&found.particles.robots[0].rates)),
        by("joints", 1e-6, |found| joints(&found.particles.robots[0].positions)),
        by("targets", 1e-5, |found| joints(&found.robots[0].targets)),
        by("target rates", 1e-5, |found| joints(&found.robots[0].rates)),
        by("torques", 1e-4, |found| joints(&found.robots[0].torques)),
        by("kp", 1e-3, |found| found.robots[0].kp.iter().sum()),
        by("kd", 1e-4, |found| found.robots[0].kd.iter().sum()),
        by("mass of a link", 1e-5, |found| found.bodies[2].mass),
        by("friction", 1e-5, |found| found.bodies.iter().map(|body| body.friction).sum()),
    ];
    if !fixed {
        changes.push(by("velocity", 1e-5, |found| inner(found.particles.bodies[0].velocity, WAY)));
        changes.push(by("angular velocity", 1e-5, |found| inner(found.particles.bodies[0].angular_velocity, WAY)));
        changes.push(by("mass of the base", 1e-5, |found| found.bodies[0].mass));
    }
    Case { walls, parts: &parts, told: &told, nested }.compare(&changes);
}

/// Physics: gradients are derivatives through a robot that sinks in and pushes off, free or on a fixed base.
#[test]
fn gradients_go_through_robots() {
    for fixed in [false, true] {
        hop("z_min = \"stick\"\n", 0.27, [0.1, 0.2], fixed, false);
    }
}

/// Likewise where levels follow its foot, which is at the rim of the finest one.
#[test]
fn gradients_go_through_robots_on_levels() {
    hop("z_min = \"stick\"\n", 0.27, [0.1, 0.2], false, true);
}

/// Likewise where a joint is at its stop, and told to go beyond it, and where the foot stands on hard ground below the soft one.
#[test]
fn gradients_go_through_stops_and_hard_ground() {
    hop("z_min = \"stick\"\n", 0.27, [0.4195, 0.7], false, false);
    hop("z_min = { separate = { friction = 0.3 } }\n", 0.195, [0.1, 0.2], false, false);
}

/// Likewise through free tools that touch one another, and a plate that moves as it is told and carries one.
#[test]
fn gradients_go_through_tools_that_touch() {
    let parts = |change: Change| {
        let smoother = format!("{{ coulomb = {{ friction = {:?} }} }}", 0.2 + change.of("plate's friction"));
        let free = |mass: f64| {
            format!("{{ free = {{ mass = {mass:?}, linear = [0.1, -0.2, -1.0], angular = [1.5, -2.0, 1.0] }} }}")
        };
        let ball =
            tool("ball", [0.1, 0.12, 0.19], "sphere = { radius = 0.06 }", RUBBING, &free(0.8 + change.of("mass")));
        let cube = tool("cube", [0.105, 0.125, 0.287], &half([0.05, 0.04, 0.04]), RUBBING, &free(1.5));
        let plate = tool("plate", [0.187, 0.12, 0.19], &half([0.03, 0.1, 0.05]), &smoother, "{ velocity = {} }");
        [ball, cube, plate].concat()
    };
    let told = |change: Change| {
        let linear = along([-0.6, 0.1, -0.2], change.of("plate's velocity"));
        let angular = along([0.2, -0.3, 0.1], change.of("plate's turning"));
        let place = |at: Vec3, what: &str, turn: &str| Placement {
            position: Some(along(at, change.of(what))),
            rotation: Some(turned(along([0.0; 3], change.of(turn)))),
            ..Placement::default()
        };
        vec![
            ("ball", Command::Place(place([0.1, 0.12, 0.19], "ball", "ball's rotation"))),
            ("cube", Command::Place(place([0.105, 0.125, 0.287], "cube", "cube's rotation"))),
            ("plate", Command::Place(place([0.187, 0.12, 0.19], "plate", "plate's rotation"))),
            ("plate", Command::Twist { linear, angular }),
        ]
    };
    // The plate's coupling comes first.
    const PLATE: usize = 0;
    const BALL: usize = 1;
    const CUBE: usize = 2;
    fn of(found: &Gradient, body: usize) -> PoseCotangent {
        found.particles.bodies[body].pose
    }
    let changes = vec![
        by("ground", 1e-6, Case::ground),
        by("gravity", 1e-4, |found| -found.gravity[2]),
        by("ball", 1e-7, |found| inner(of(found, BALL).position, WAY)),
        by("cube", 1e-7, |found| inner(of(found, CUBE).position, WAY)),
        by("cube's rotation", 1e-6, |found| inner(of(found, CUBE).rotation, WAY)),
        by("plate", 1e-7, |found| inner(of(found, PLATE).position, WAY)),
        by("plate's rotation", 1e-6, |found| inner(of(found, PLATE).rotation, WAY)),
        by("plate's velocity", 1e-5, |found| inner(found.bodies[PLATE].linear, WAY)),
        by("plate's turning", 1e-5, |found| inner(found.bodies[PLATE].angular, WAY)),
        by("plate's friction", 1e-5, |found| found.bodies[PLATE].friction),
        by("mass", 1e-5, |found| found.bodies[BALL].mass),
    ];
    Case { walls: "z_min = \"stick\"\n", parts: &parts, told: &told, nested: false }.compare(&changes);
}

/// Likewise through a piston that a force pushes against a free cube.
#[test]
fn gradients_go_through_what_a_force_pushes_beside_others() {
    for own_mass in [true, false] {
        let parts = |change: Change| {
            let force = 30.0 + change.of("force");
            let mass = if own_mass { format!("mass = {:?},", 2.0 + change.of("mass")) } else { String::new() };
            let servo = format!(
                "{{ servo = {{ axis = [0.9, 0.1, -0.4], force = {force:?}, {mass} ramp = 6e-3, damping = 8.0 }} }}"
            );
            let turn = on_top(turned(along([0.0; 3], change.of("rotation"))), turned([0.1, 0.0, 0.2]));
            let piston =
                tool("piston", along([0.08, 0.13, 0.16], change.of("position")), &half([0.05; 3]), RUBBING, &servo)
                    + &format!("rotation = {turn:?}\n");
            let free = "{ free = { mass = 1.2, linear = [-0.8, 0.0, -0.6], angular = [0.4, 0.2, -0.3] } }";
            let cube = tool("cube", [0.165, 0.125, 0.17], &half([0.04, 0.06, 0.05]), RUBBING, free);
            [piston, cube].concat()
        };
        let mut changes = vec![
            by("ground", 1e-6, Case::ground),
            by("gravity", 1e-4, |found| -found.gravity[2]),
            by("position", 1e-7, |found| inner(found.particles.bodies[0].pose.position, WAY)),
            by("rotation", 1e-6, |found| inner(found.particles.bodies[0].pose.rotation, WAY)),
            by("force", 1e-3, |found| found.bodies[0].force),
        ];
        if own_mass {
            changes.push(by("mass", 1e-5, |found| found.bodies[0].mass));
        }
        Case { walls: "z_min = \"stick\"\n", parts: &parts, told: &|_| Vec::new(), nested: false }.compare(&changes);
    }
}

/// A gap between rigid things closes at once, and an overlap slowly. Next to where they just touch, gradients are still those of the side that was taken.
#[test]
fn gradients_are_those_of_the_side_that_was_taken() {
    for gap in [3e-7, -3e-7] {
        let parts = |_: Change| {
            let plate = tool("plate", [0.12, 0.13, 0.13], &half([0.08, 0.08, 0.04]), RUBBING, "\"fixed\"");
            let ball =
                tool("ball", [0.1, 0.1, 0.3], "sphere = { radius = 0.05 }", RUBBING, "{ free = { mass = 0.8 } }");
            [plate, ball].concat()
        };
        let told = |change: Change| {
            let position = Some([0.12, 0.13, 0.22 + gap + change.of("height")]);
            vec![("ball", Command::Place(Placement { position, ..Placement::default() }))]
        };
        let case = Case { walls: "z_min = \"stick\"\n", parts: &parts, told: &told, nested: false };
        // Over the first step alone: behind it they rest on one another.
        let tape = |by: f64| case.tape_of(1, Change("height", by));
        let (_, loss) = Case::loss(&tape(0.0));
        let found = tape(0.0).pull_back(loss).unwrap_or_else(|e| panic!("{e}")).particles.bodies[1].pose.position[2];
        let expected = difference(5e-8, |by| Case::loss(&tape(by)).0);
        within(&format!("{gap}: {found} {expected}"), (found / expected - 1.0).abs(), 1e-5);
    }
}
