//! A scene pays only for the effects it calls for, counted in passes, bytes and bits. (That time differs by less than 1 % is
//! measured by `barchan bench effects`.)

use barchan::schedule::Call;
use barchan::{Command, Form, Options, Plan, Precision, Simulation, Stage, Wrench};
use barchan_tests::scenes::{options, rows, scene, simulation};
use barchan_tests::sketch::{Head, bed, half, material, tool};
use std::collections::BTreeMap;

const H: f64 = 0.05;
const STEPS: u64 = 40;

/// Sand on a floor, and what is added to it.
fn sand(more: &[String]) -> String {
    let (head, mut parts) = bed(H, [12, 12], 3, 9, "young_modulus = 1e5");
    parts.extend_from_slice(more);
    head.with(&parts)
}

/// What a run of a scene costs and leaves.
#[derive(Debug, PartialEq)]
struct Cost {
    stages: Vec<Stage>,
    /// Passes by effect.
    passes: BTreeMap<String, u64>,
    /// Resident bytes of particles and grid.
    bytes: (u64, u64),
    /// The plan's estimate.
    planned: (u64, u64),
    /// Every bit of every particle.
    state: String,
}

fn run(text: &str) -> (Cost, Simulation) {
    let mut s =
        Simulation::new(&barchan::registry(), &scene(text), &options(Precision::F32)).unwrap_or_else(|e| panic!("{e}"));
    for _ in 0..STEPS {
        s.step().unwrap_or_else(|e| panic!("{e}"));
    }
    let cost = Cost {
        stages: s.plan().schedule.stages(),
        passes: s.timings().into_iter().map(|t| (t.effect, t.passes)).collect(),
        bytes: s.memory(),
        planned: s.plan().memory,
        state: format!("{:?}", s.particles()),
    };
    (cost, s)
}

/// Materials that no body names, a coupling kind without a tool, keys given at their defaults: each may stand in a scene, and
/// none may add a stage, a pass, a byte, or change a bit. Codes that allocate by what is declared pay for it in every step.
#[test]
fn what_is_declared_but_unused_costs_nothing() {
    let (plain, s) = run(&sand(&[]));
    println!("plain: {:?}, {:?}, {:?} bytes", plain.stages, plain.passes, plain.bytes);
    let ground = [Stage::SORT, Stage::SLEEP, Stage::P2G, Stage::GRID_UPDATE, Stage::LIMIT, Stage::G2P];
    assert_eq!(plain.stages, ground);
    assert!(s.plan().effects.iter().all(|e| !e.name.contains("unused")));
    // Snow has more history than sand, so that planes laid out for the widest material declared would show in the bytes.
    let cases: [(&str, Vec<String>, &str); 4] = [
        (
            "two materials without a body",
            vec![material("snow", 400.0, ""), material("fixed_corotated", 900.0, "")],
            "material snow",
        ),
        ("a kind of coupling without a tool", vec!["[[coupling]]\nkind = \"rigid\"\n".to_owned()], "coupling rigid"),
        (
            "output at its defaults",
            vec!["[output]\ninterval = 0.05\npicture = { cut = \"pressure\" }\n".to_owned()],
            "",
        ),
        (
            "all of them",
            vec![material("snow", 400.0, ""), "[[coupling]]\nkind = \"rigid\"\n[output]\ninterval = 0.05\n".to_owned()],
            "material snow",
        ),
    ];
    for (name, more, unused) in cases {
        let (cost, s) = run(&sand(&more));
        let same = cost == plain;
        println!(
            "{name}: passes {:?}, bytes {:?}; the same as plain: {same}, tolerance: none",
            cost.passes, cost.bytes
        );
        assert_eq!(cost.stages, plain.stages, "{name}");
        assert_eq!(cost.passes, plain.passes, "{name}");
        assert_eq!((cost.bytes, cost.planned), (plain.bytes, plain.planned), "{name}");
        assert!(cost.state == plain.state, "{name}: particles differ");
        assert!(s.ledger().counts == run(&sand(&[])).1.ledger().counts, "{name}: the ledger counts other things");
        let listed = s
            .plan()
            .effects
            .iter()
            .any(|e| e.name == format!("declared but unused: {unused}") && e.adds == "costs nothing");
        assert!(unused.is_empty() || listed, "{name}: {}", s.plan());
    }
}

/// Each stage of the plan runs once a step, sorts as often as they are due, and no other pass runs. Contact runs only where a
/// tool's box holds nodes: a tool out of reach costs no pass and changes no bit.
#[test]
fn exactly_the_passes_of_the_plan_are_run() {
    // The bed is 0.15 m deep, and the plate 0.05 m to each side of its centre.
    let plate = |height: f64| {
        let motion = "{ velocity = { linear = [0, 0, -0.5] } }";
        vec![tool("plate", [0.3, 0.3, height], &half([0.1, 0.1, 0.05]), "\"slip\"", motion)]
    };
    let mut states = Vec::new();
    for (name, more, contact) in [
        ("without a tool", vec![], 0),
        ("with a tool out of reach", plate(0.4), 0),
        ("with a tool on the ground", plate(0.2), STEPS),
    ] {
        let planned = !more.is_empty();
        let (cost, s) = run(&sand(&more));
        let passes = |effect: &str| cost.passes.get(effect).copied().unwrap_or(0);
        println!("{name}, {STEPS} steps: {:?}", cost.passes);
        assert_eq!(cost.stages.contains(&Stage::CONTACT), planned, "{name}");
        for (effect, wanted) in [
            ("P2G", STEPS),
            ("material sand", STEPS),
            ("grid", STEPS),
            ("G2P", STEPS),
            ("contact", contact),
            ("sleep", STEPS),
        ] {
            assert_eq!(passes(effect), wanted, "{name}: {effect}");
        }
        assert!((1..=STEPS / 2).contains(&passes("sort")), "{name}: {} sorts", passes("sort"));
        assert_eq!(
            cost.passes.len(),
            if contact > 0 { 7 } else { 6 },
            "{name}: a pass that no stage calls for in {:?}",
            cost.passes
        );
        assert_eq!(
            s.plan().effects.iter().filter(|e| e.name.starts_with("contact with")).count(),
            usize::from(planned)
        );
        states.push(cost.state);
    }
    assert!(states[0] == states[1], "a tool out of reach changed a bit");
    assert!(states[0] != states[2], "a tool on the ground changed nothing");
}

/// A tool that has left the ground is out of reach, and the force of its last contact does not stay with it.
#[test]
fn a_tool_that_has_left_the_ground_feels_nothing() {
    let plate = tool("plate", [0.3, 0.3, 0.2], &half([0.1, 0.1, 0.05]), "\"slip\"", "{ velocity = {} }");
    let mut s = simulation(&sand(&[plate]), Precision::F32);
    let mut moved = |velocity: f64| {
        s.act("plate", &Command::Twist { linear: [0.0, 0.0, velocity], angular: [0.0; 3] }).unwrap();
        for _ in 0..STEPS {
            s.step().unwrap();
        }
        let passes = s.timings().iter().filter(|t| t.effect == "contact").map(|t| t.passes).sum::<u64>();
        (s.wrenches()[0], passes)
    };
    let ((pressed, touching), (lifted, since)) = (moved(-0.2), moved(3.0));
    println!(
        "{touching} contact passes and {:?} N when pressed, {since} passes and {:?} N after lifting",
        pressed.force, lifted.force
    );
    assert!(pressed.force[2] > 0.0 && touching == STEPS && since < 2 * STEPS);
    assert_eq!(lifted, Wrench::default());
}

/// A scene of tools alone has no ground to transfer, and one of nothing has no stages at all.
#[test]
fn a_scene_without_ground_runs_no_transfer() {
    let plate = tool("plate", [0.3, 0.3, 0.3], &half([0.1; 3]), "\"slip\"", "{ velocity = { linear = [0, 0, -0.5] } }");
    for (name, parts, stages) in
        [("empty", vec![], vec![]), ("a tool alone", vec![plate], vec![Stage::CONTACT, Stage::BODIES])]
    {
        let text = Head::cells(H, [12, 12, 12], "z_min = \"slip\"").time("step = 1e-3").with(&parts);
        let (cost, s) = run(&text);
        println!("{name}: stages {:?}, passes {:?}, bytes {:?}", cost.stages, cost.passes, cost.bytes);
        assert_eq!(cost.stages, stages, "{name}");
        assert_eq!((cost.bytes, cost.planned), ((0, 0), (0, 0)), "{name}");
        for effect in ["sort", "P2G", "grid", "contact", "G2P"] {
            assert_eq!(cost.passes.get(effect), None, "{name}: {effect} ran without a particle");
        }
        assert!((s.time() - STEPS as f64 * 1e-3).abs() < 1e-12);
    }
}

/// Walls that a scene does not have are not folded, booked or listed; the same walls far from the ground cost no byte either,
/// since only blocks at a wall mirror anything.
#[test]
fn absent_and_distant_walls_cost_nothing() {
    let text = |walls: &'static str| {
        let head = Head { walls, ..Head::space(H).time("step = 1e-3") };
        head.with(&[
            material("hencky", 1000.0, "young_modulus = 1e4"),
            barchan_tests::sketch::block(
                "hencky",
                [-0.2; 3],
                [0.2; 3],
                "velocity = [0.5, 0, 0]\nangular_velocity = [0, 0, 3]",
            ),
        ])
    };
    let (open, s) = run(&text(""));
    assert!(s.plan().effects.iter().all(|e| !e.name.starts_with("wall")));
    assert_eq!(s.ledger().wall_impulse, [0.0; 3]);
    let (walled, s) = run(&text("x_min = \"slip\"\nx_max = \"stick\"\nz_min = { separate = { friction = 0.3 } }"));
    assert_eq!(s.plan().effects.iter().filter(|e| e.name.starts_with("wall")).count(), 3);
    assert_eq!(s.ledger().wall_impulse, [0.0; 3]);
    println!("bytes {:?} without walls, {:?} with three far away; tolerance: none", open.bytes, walled.bytes);
    assert_eq!(open.bytes, walled.bytes);
    assert_eq!(open.passes, walled.passes);
    assert!(open.state == walled.state, "walls 3 m away changed a bit");
}

/// State takes at most 128 bytes a particle in f32 and residents at most 220, scratch and grid included, also after sorting has
/// grown what it needs; and the plan's estimate, which a user sees before the run, is near the truth.
#[test]
fn memory_is_bounded_and_as_the_plan_says() {
    for law in ["neo_hookean", "sand", "snow"] {
        let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"\nz_max = \"slip\"";
        let text = Head::cells(0.02, [40, 40, 24], walls).with(&[
            material(law, 1000.0, "young_modulus = 1e5"),
            barchan_tests::sketch::block(law, [0.0; 3], [0.8, 0.8, 0.4], ""),
        ]);
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &Options { threads: 2, ..Options::default() })
            .unwrap();
        for _ in 0..3 {
            s.step().unwrap();
        }
        // Stir, so that particles change blocks and lists are laid out anew.
        let mut noise = barchan_tests::scenes::Noise::new(5);
        barchan_tests::scenes::alter(&mut s, |row| (0..3).for_each(|d| row.v[d] += noise.draw()));
        for _ in 0..50 {
            s.step().unwrap_or_else(|e| panic!("{law}: {e}"));
        }
        let n = s.particle_count() as f64;
        let state = s.plan().materials[0].particle_bytes(Precision::F32);
        let (particles, grid) = s.memory();
        let (planned_particles, planned_grid) = s.plan().memory;
        let resident = (particles + grid) as f64 / n;
        println!(
            "{law}: {n} particles; state {state} bytes each, tolerance 128; resident {:.1} with sort and {:.1} of grid = {resident:.1}, tolerance 220; planned {:.1} and {:.1}",
            particles as f64 / n,
            grid as f64 / n,
            planned_particles as f64 / n,
            planned_grid as f64 / n
        );
        assert!(state <= 128 && resident <= 220.0, "{law}: {state} and {resident} bytes");
        let ratio = (planned_particles + planned_grid) as f64 / (particles + grid) as f64;
        assert!((0.5..2.0).contains(&ratio), "{law}: the plan estimates {ratio:.2} of what is resident");
        assert_eq!(rows(&s).len() as f64, n);
    }
}

/// A stage that a backend cannot carry out is refused by name before anything is built, not left out.
#[test]
fn a_stage_that_a_backend_has_no_form_of_is_refused_by_name() {
    let registry = barchan::registry();
    let assembled = Plan::assemble(&registry, &scene(&sand(&[])), &options(Precision::F32));
    let (mut plan, particles, _) = assembled.unwrap_or_else(|e| panic!("{e}"));
    plan.schedule.step.insert(1, Call { stage: Stage::new("smooth"), levels: 0..1, slot: 0 });
    for name in ["cpu", "wgpu"] {
        let backend = registry.backend(name).unwrap();
        for refused in [backend.check(&plan).err(), backend.compile(&plan, particles.clone()).err()] {
            let error = refused.expect("it has no such stage").to_string();
            assert!(error.contains(&format!("backend '{name}'")), "{error}");
            assert!(error.contains("has no forward form of the stage 'smooth'"), "{error}");
            assert!(error.contains("sleep -> smooth -> P2G"), "{error}");
        }
        // Gradients are asked for in the same way.
        assert!(backend.has_form(Stage::P2G, Form::Forward) && !backend.has_form(Stage::SLEEP, Form::Adjoint));
        for stage in [Stage::P2G, Stage::CONTACT] {
            assert_eq!(backend.has_form(stage, Form::Adjoint), name == "cpu");
        }
    }
}
