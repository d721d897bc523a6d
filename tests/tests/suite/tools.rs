//! Tools that come and go, and tools that a force pushes.

use barchan::{Command, Options, Placement, Precision, Scene, Simulation};
use barchan_tests::scenes::{everywhere, left, minus, norm, options, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, block, damped, half, material, tool};
use glam::DVec3;

const CELL: f64 = 0.02;
const FRICTION: &str = "{ coulomb = { friction = 0.3 } }";

/// A column of sand 8 cells wide and 10 high, in a channel 4 cells wide, held on its right by what `parts` say.
fn column(parts: &[String]) -> String {
    let walls = "x_min = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let sand = [
        material("sand", 1500.0, "young_modulus = 2e5, friction_angle_deg = 30.0"),
        block("sand", [0.0; 3], [0.16, 0.08, 0.2], "sampling = \"lattice\""),
    ];
    Head::cells(CELL, [32, 4, 16], walls).time("step = 2e-4").with(&[&sand, parts].concat())
}

/// A plate 2 cells thick and 0.25 m high beside the column, there while `times` say.
fn gate(times: &str) -> String {
    tool("gate", [0.18, 0.04, 0.125], &half([0.02, 0.06, 0.125]), FRICTION, "\"fixed\"") + times + "\n"
}

fn start(text: &str, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(text), options).unwrap_or_else(|e| panic!("{e}\n{text}"))
}

/// How far the sand has come [m].
fn front(s: &Simulation) -> f64 {
    rows(s).iter().fold(0.0, |most, row| row.x[0].max(most))
}

/// Behind a gate a column stands, and falls once the gate has gone; then it goes on as a column that never had one.
#[test]
fn a_column_falls_once_its_gate_has_vanished() {
    for options in everywhere() {
        let name = format!("{} {}", options.backend, options.precision);
        let mut gated = start(&column(&[gate("until = 0.08")]), &options);
        run_to(&mut gated, 0.08);
        let held = front(&gated);
        within(&format!("{name}: front behind the gate [m]"), held, 0.17);
        let mut free = start(&column(&[]), &options);
        free.set_particles(gated.particles()).unwrap_or_else(|e| panic!("{e}"));
        run_to(&mut gated, 0.23);
        run_to(&mut free, 0.15);
        assert_eq!(gated.wrenches()[0].force, [0.0; 3], "{name}: what is not there feels nothing");
        assert!(front(&gated) > held + 0.03, "{name}: it has come to {} m only", front(&gated));
        let pairs = rows(&gated).into_iter().zip(rows(&free));
        let off = pairs.fold(0f64, |most, (one, other)| most.max(norm(minus(one.x, other.x))));
        let rounding = if options.precision == Precision::F64 { 1e-9 } else { 1e-3 };
        within(&format!("{name}: off a column without gate [m]"), off, rounding);
    }
}

/// Two gates, one that comes and one that goes, and a free box that leans on the second.
fn gates() -> String {
    let late = tool("late", [0.4, 0.04, 0.1], &half([0.02, 0.06, 0.12]), "\"slip\"", "\"fixed\"") + "from = 0.03\n";
    let moving =
        tool("moving", [0.5, 0.04, 0.2], &half([0.02; 3]), "\"slip\"", "{ velocity = { linear = [-0.5, 0, 0] } }");
    let lid = tool("box", [0.18, 0.04, 0.28], &half([0.03; 3]), FRICTION, "{ free = { mass = 0.5 } }");
    column(&[gate("until = 0.05"), late, moving + "from = 0.02\nuntil = 0.06\n", lid])
}

/// Whether it is interrupted, and how many steps are asked for at once, changes no bit of a run in which tools come and go.
#[test]
fn tools_come_and_go_at_the_same_steps_however_a_run_is_cut() {
    for options in everywhere() {
        let folder = tempfile::tempdir().unwrap();
        let mut whole = start(&gates(), &options);
        let mut cut = start(&gates(), &options);
        let mut count = 0;
        while whole.step_count() < 400 {
            count += whole.steps(400 - whole.step_count() as usize, f64::INFINITY).unwrap().len();
        }
        assert_eq!(count, 400);
        for steps in [90, 60, 100, 49, 1, 100] {
            let file = folder.path().join(format!("{steps}.snapshot"));
            cut.state().unwrap().save(&file).unwrap();
            cut = Simulation::resume(&barchan::registry(), &file, &options).unwrap();
            (0..steps).for_each(|_| drop(cut.step().unwrap()));
        }
        assert!(left(&whole) == left(&cut), "{} {}", options.backend, options.precision);
        // With its rest gone, the box has fallen.
        assert!(whole.bodies()[3].position[2] < 0.277, "{:?}", whole.bodies()[3]);
    }
}

/// Symptom: a thin fixed plate among cells eight times as wide as the finest felt a seventh of what it should, on a processor: nothing follows it, and ground was looked for as if
/// only the finest cells came near. A jet of liquid presses on it as on a device, which looks for itself.
#[test]
fn a_thin_plate_that_nothing_follows_is_met_by_coarse_cells() {
    let plate = "height_field = { bottom = -0.04, heights = [[-0.03, -0.03], [-0.03, -0.03]], min = [-0.04, -0.04], max = [0.04, 0.04] }";
    let head = Head { max: [0.64; 3], ..Head::cells(CELL, [0; 3], "") }.time("step = 1e-2\nover_bound = \"allow\"");
    let text = head.with(&[
        "[levels]\ncount = 4\n".to_owned(),
        material("liquid", 8000.0, ""),
        "[[source]]\nmaterial = \"liquid\"\nvelocity = [0.0243, 0, 0]\nsampling = \"lattice\"\nshape = { sphere = { center = [0.2408, 0.42, 0.3677], radius = 0.05 } }\n".to_owned(),
        tool("plate", [0.4384, 0.5035, 0.5015], plate, FRICTION, "\"fixed\""),
    ]);
    for options in everywhere() {
        let mut s = start(&text, &options);
        s.step().unwrap();
        let force = s.wrenches()[0].force;
        println!("{} {}: {force:?} N", options.backend, options.precision);
        // As found on a device, to all digits.
        within("force on the plate [N]", norm(minus(force, [1.2393, 0.0, -0.5244])), 1e-3);
    }
}

/// A tool that would appear within the ground is refused, with the time and the number of particles that it would bury.
#[test]
fn a_tool_does_not_appear_within_the_ground() {
    for options in everywhere() {
        let buried = tool("late", [0.1, 0.04, 0.1], &half([0.021; 3]), "\"slip\"", "\"fixed\"") + "from = 0.01\n";
        let mut s = start(&column(&[buried]), &options);
        let error = loop {
            if let Err(error) = s.step() {
                break error.to_string();
            }
        };
        assert!(s.time() < 0.0102, "{}", s.time());
        assert!(error.contains("tool 'late'") && error.contains("at 0.0100"), "{error}");
        assert!(error.contains("there are 64 particles"), "{error}");
        // The same at the start leaves out what it would bury.
        let early = tool("early", [0.1, 0.04, 0.1], &half([0.021; 3]), "\"slip\"", "\"fixed\"") + "until = 0.01\n";
        assert_eq!(rows(&start(&column(&[early]), &options)).len() + 64, rows(&s).len());
    }
}

/// Times that make no sense, and forces that are none, are refused with the key.
#[test]
fn what_tools_cannot_be_is_refused_by_name() {
    let refused = |tool: String, what: &[&str]| {
        let error = Scene::from_str(&column(&[tool]), "case", "").unwrap_err().to_string();
        assert!(what.iter().all(|what| error.contains(what)), "{error} lacks one of {what:?}");
    };
    refused(gate("from = -1"), &["tool[0].from", "must be 0 or above"]);
    refused(gate("from = 0.2\nuntil = 0.1"), &["tool[0].until", "must be later than from"]);
    let moved = |motion: &str| tool("plate", [0.08, 0.04, 0.25], &half([0.05; 3]), "\"slip\"", motion);
    refused(moved("{ free = { mass = 1 } }") + "from = 0.1\n", &["tool[0].from", "that the ground moves"]);
    let servo = |keys: &str| moved(&format!("{{ servo = {{ {keys} }} }}"));
    refused(servo("axis = [0, 0, -1], force = 10") + "until = 0.1\n", &["tool[0].until", "that the ground moves"]);
    refused(servo("axis = [0, 0, 0], force = 10"), &["motion.servo.axis", "is zero"]);
    refused(servo("axis = [0, 0, -1]"), &["motion.servo", "give force [N], or pressure"]);
    refused(servo("axis = [0, 0, -1], area = 10"), &["motion.servo", "give force [N], or pressure"]);
    refused(servo("axis = [0, 0.1, -1], pressure = 10"), &["motion.servo.area", "give the area"]);
    refused(servo("axis = [0, 0, -1], force = 0"), &["motion.servo.mass", "give a mass"]);
    refused(servo("axis = [0, 0, -1], force = 1, damping = -1"), &["motion.servo.damping", "0 or above"]);
}

/// A bed of elastic ground between slip walls, 4 cells wide and 0.2 m deep, and a plate on it that a force pushes.
fn footing(servo: &str) -> String {
    footing_under([0.02, 0.02, 0.22], &half([0.04, 0.04, 0.02]), servo)
}

/// The same under another shape.
fn footing_under(position: [f64; 3], shape: &str, servo: &str) -> String {
    let walls = ["x_min", "x_max", "y_min", "y_max", "z_min"].map(|side| format!("{side} = \"slip\"\n")).concat();
    let head = Head { gravity: [0.0; 3], ..Head::cells(0.01, [4, 4, 28], &walls) };
    head.with(&[
        damped("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3", 1e-3),
        block("hencky", [0.0; 3], [0.04, 0.04, 0.2], ""),
        tool("plate", position, shape, "\"slip\"", servo),
    ])
}

/// Under a plate with a given pressure ground comes to rest where its oedometric modulus M bears it: -ln λ = λ p / M for the law of Hencky, in which the
/// Kirchhoff stress is M ln λ. The plate itself sinks into its outermost particles by p/M of their width besides. It may be a plane, too, which has no end and for
/// which a device would ask for room without end.
#[test]
fn a_plate_under_a_pressure_rests_where_the_ground_bears_it() {
    let (young, poisson, pressure, depth) = (1e5, 0.3, 4e3, 0.2);
    let modulus = young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson));
    let stretch = (0..50).fold(1.0f64, |stretch, _| (-stretch * pressure / modulus).exp());
    let expected = depth * (1.0 - stretch) + 0.005 * pressure / modulus;
    let plate = ("plate", 0.22, half([0.04, 0.04, 0.02]));
    let plane = ("plane", 0.2, "plane = { normal = [0, 0, -1] }".to_owned());
    let cases = [plate, plane].map(|shape| everywhere().map(|options| (shape.clone(), options)));
    for ((what, height, shape), options) in cases.into_iter().flatten() {
        let name = format!("{what}, {} {}", options.backend, options.precision);
        let servo = format!(
            "{{ servo = {{ axis = [0, 0, -2], pressure = {pressure}, area = 0.0016, damping = 20, ramp = 0.1 }} }}"
        );
        let mut s = start(&footing_under([0.02, 0.02, height], &shape, &servo), &options);
        run_to(&mut s, 0.6);
        let (sunk, reaction) = (height - s.bodies()[0].position[2], s.wrenches()[0].force[2]);
        println!("{name}: sunk {sunk:.5} m, expected {expected:.5} m");
        within(&format!("{name}: depth off the formula"), (sunk / expected - 1.0).abs(), 0.02);
        within(&format!("{name}: reaction off the force"), (reaction / (pressure * 0.0016) - 1.0).abs(), 0.02);
        within(&format!("{name}: speed [m/s]"), norm(s.bodies()[0].velocity), 1e-3);
        assert_eq!(s.bodies()[0].position[..2], [0.02, 0.02], "its guide lets it go along its axis only");
    }
}

/// What a servo's force gives to a plate, and the ground takes from it, is its momentum, to rounding; also where it moves at an angle to the grid and is damped.
#[test]
fn the_momentum_of_a_servo_is_what_its_force_and_the_ground_gave() {
    let axis = [0.6, 0.0, -0.8];
    let sand = [
        material("sand", 1500.0, "young_modulus = 2e5, friction_angle_deg = 30.0"),
        block("sand", [0.0; 3], [0.48, 0.4, 0.2], "settled = true"),
        tool(
            "plate",
            [0.2, 0.2, 0.26],
            &half([0.05, 0.05, 0.05]),
            FRICTION,
            &format!("{{ servo = {{ axis = {axis:?}, force = 60, damping = 20, mass = 2 }} }}"),
        ),
    ];
    let walls = ["x_min", "x_max", "y_min", "y_max", "z_min"].map(|side| format!("{side} = \"slip\"\n")).concat();
    let text = Head::cells(CELL, [24, 20, 20], &walls).time("step = 2e-4").with(&sand);
    let mut places = Vec::new();
    for options in everywhere() {
        let mut s = start(&text, &options);
        let (mut gained, mut felt) = (0.0, 0.0);
        for _ in 0..600 {
            let dt = s.step().unwrap_or_else(|e| panic!("{e}")).dt;
            let ground: f64 = (0..3).map(|d| axis[d] * s.wrenches()[0].force[d]).sum::<f64>() * dt;
            felt += ground;
            // Damping acts with the velocity that force and damping alone lead to.
            gained = (gained + 60.0 * dt) / (1.0 + 20.0 * dt / 2.0) + ground;
        }
        let momentum = 2.0 * (0..3).map(|d| axis[d] * s.bodies()[0].velocity[d]).sum::<f64>();
        let tolerance = if options.precision == Precision::F64 { 1e-12 } else { 2e-5 };
        let name = format!("{} {}", options.backend, options.precision);
        assert!(felt < -1.0, "{name}: they never met: {felt} N s");
        within(
            &format!("{name}: momentum off its sum, over what the ground took"),
            (momentum - gained).abs() / -felt,
            tolerance,
        );
        places.push(s.bodies()[0].position);
    }
    within("plate on the GPU off that on the CPU [m]", norm(minus(places[0], places[2])), 2e-4);
}

/// A plate with a weight goes on bit for bit after a snapshot, while its force still grows and afterwards.
#[test]
fn a_servo_goes_on_bit_for_bit() {
    let servo = "{ servo = { axis = [0, 0, -1], force = 5, ramp = 0.02 } }";
    let mut whole = simulation(&footing(servo), Precision::F32);
    let mut cut = simulation(&footing(servo), Precision::F32);
    (0..300).for_each(|_| drop(whole.step().unwrap()));
    for _ in 0..3 {
        cut = Simulation::from_state(&barchan::registry(), &cut.state().unwrap(), &options(Precision::F32)).unwrap();
        (0..100).for_each(|_| drop(cut.step().unwrap()));
    }
    assert!(left(&whole) == left(&cut));
}

/// A wall that moves is a tool. On smooth walls that yield to a bed of sand, and are pushed into it, forces go from the pressure at rest to the active and the passive one.
///
/// # Source
/// Rankine (1857), with friction tan φ* = sin φ_ps for flow without dilation (Davis 1968); sin φ_ps = 2√3 sin φ / (3 - sin φ) for a cone matched in triaxial
/// compression.
#[test]
fn walls_that_move_feel_the_active_and_the_passive_pressure() {
    let changes = ["world.cell=0.02", "time.end=0.8"].map(str::to_owned);
    let mut s = Simulation::new(
        &barchan::registry(),
        &barchan::tasks::scene("retaining-wall", &changes).unwrap(),
        &Options::default(),
    )
    .unwrap();
    let mut mean = |from: f64, to: f64| {
        run_to(&mut s, from);
        let (mut impulses, start) = ([0.0; 2], s.time());
        while s.time() < to {
            let before = s.time();
            s.step().unwrap();
            let wrenches = s.wrenches();
            impulses.iter_mut().zip(wrenches).for_each(|(sum, wrench)| *sum += wrench.force[0] * (s.time() - before));
        }
        // By what the bed's weight is over its height.
        impulses.map(|impulse| impulse.abs() / (s.time() - start) / (0.5 * 1600.0 * 9.81 * 0.3 * 0.3 * 0.04))
    };
    let sine = 20f64.to_radians().sin();
    let friction = (2.0 * 3f64.sqrt() * sine / (3.0 - sine)).atan().sin();
    let passive = (1.0 + friction) / (1.0 - friction);
    let [pushed, yielding] = mean(0.1, 0.2);
    within("pressure at rest, pushed wall", (pushed / 0.6 - 1.0).abs(), 0.05);
    within("pressure at rest, yielding wall", (yielding / 0.6 - 1.0).abs(), 0.05);
    let [pushed, yielding] = mean(0.5, 0.8);
    within("passive pressure", (pushed / passive - 1.0).abs(), 0.08);
    within("active pressure", (yielding * passive - 1.0).abs(), 0.08);
}

/// A tool that is put elsewhere goes on from there, with the motion that it is given or has, on every backend: a free one alone and beside another, and one that is driven.
#[test]
fn a_tool_that_is_put_elsewhere_goes_on_from_there() {
    let cube = |name: &str, x: f64, motion: &str| tool(name, [x, 0.0, 0.0], &half([0.1; 3]), "\"slip\"", motion);
    let free = cube("box", 0.0, "{ free = { mass = 2, linear = [0.5, 0, 0] } }");
    let driven = cube("driven", 2.0, "{ velocity = { linear = [0, 0.25, 0] } }");
    for options in everywhere() {
        for parts in [vec![free.clone()], vec![free.clone(), driven.clone()]] {
            let mut s = start(&Head::space(0.1).time("step = 1e-3").with(&parts), &options);
            let steps = |s: &mut Simulation| (0..50).for_each(|_| drop(s.step().unwrap()));
            let place = |s: &mut Simulation, name: &str, placement: Placement| {
                s.act(name, &Command::Place(placement)).unwrap();
            };
            steps(&mut s);
            let upright = Placement { rotation: Some([0.0, 0.0, 1.0, 0.0]), ..Placement::default() };
            place(&mut s, "box", Placement { position: Some([-1.0, 1.0, 0.5]), ..upright });
            let mut expected = vec![("box", [-1.0, 1.0, 0.5], [0.5, 0.0, 0.0])];
            if parts.len() > 1 {
                place(&mut s, "driven", Placement { position: Some([1.0, 0.0, 0.0]), ..Placement::default() });
                expected.push(("driven", [1.0, 0.0, 0.0], [0.0, 0.25, 0.0]));
            }
            steps(&mut s);
            for (name, from, velocity) in expected {
                let body = s.bodies().into_iter().find(|body| body.name == name).unwrap();
                let there: [f64; 3] = std::array::from_fn(|d| from[d] + 0.05 * velocity[d]);
                let what = format!("{} {}: {name} is off by [m]", options.backend, options.precision);
                within(&what, norm(minus(body.position, there)), 1e-6);
                within("its velocity [m/s]", norm(minus(body.velocity, velocity)), 1e-6);
                let turned = if name == "box" { body.rotation[2] } else { body.rotation[0] };
                within("its turn", 1.0 - turned.abs(), 1e-6);
            }
            let thrown = Placement {
                velocity: Some([0.0, 0.0, 1.0]),
                angular_velocity: Some([0.0, 0.0, 2.0]),
                ..Placement::default()
            };
            place(&mut s, "box", thrown);
            let before = s.bodies().into_iter().find(|body| body.name == "box").unwrap();
            steps(&mut s);
            let after = s.bodies().into_iter().find(|body| body.name == "box").unwrap();
            within("thrown up, it rises as told [m]", (after.position[2] - before.position[2] - 0.05).abs(), 1e-6);
            within("and turns so fast [rad/s]", norm(minus(after.angular_velocity, [0.0, 0.0, 2.0])), 1e-6);
        }
    }
}

/// A blow is momentum, once: a free tool has it at once and keeps it, on every backend, alone or beside another tool; what is driven takes none.
#[test]
fn a_blow_is_momentum() {
    let cube = |name: &str, x: f64, motion: &str| tool(name, [x, 0.0, 0.0], &half([0.1; 3]), "\"slip\"", motion);
    let free = "{ free = { mass = 2, linear = [0.5, 0, 0] } }";
    for options in everywhere() {
        for others in [vec![], vec![cube("driven", 2.0, "{ velocity = {} }")]] {
            let parts = [vec![cube("box", 0.0, free)], others].concat();
            let mut s = start(&Head::space(0.1).time("step = 1e-3").with(&parts), &options);
            let steps = |s: &mut Simulation| (0..50).for_each(|_| drop(s.step().unwrap()));
            steps(&mut s);
            let (linear, angular) = ([0.4, -0.2, 0.6], [0.01, 0.02, -0.03]);
            s.act("box", &Command::Impulse { linear, angular }).unwrap();
            let wanted = [0.5 + 0.2, -0.1, 0.3];
            for when in ["at once", "after 50 steps"] {
                let body = s.bodies().into_iter().find(|body| body.name == "box").unwrap();
                let what = format!("{} {}, {when}: velocity off by [m/s]", options.backend, options.precision);
                within(&what, norm(minus(body.velocity, wanted)), 1e-6);
                let [x, p, about] = [body.position, body.momentum, body.angular_momentum].map(DVec3::from_array);
                within(
                    "and angular momentum [N m s]",
                    (about - x.cross(p) - DVec3::from_array(angular)).length(),
                    1e-6,
                );
                steps(&mut s);
            }
            if parts.len() > 1 {
                let error = s.act("driven", &Command::Impulse { linear, angular }).unwrap_err().to_string();
                assert!(error.contains("tool 'driven'") && error.contains("as it is told"), "{error}");
            }
            let nan = Command::Impulse { linear: [f64::NAN, 0.0, 0.0], angular };
            assert!(s.act("box", &nan).unwrap_err().to_string().contains("finite"));
        }
    }
}
