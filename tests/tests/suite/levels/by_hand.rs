//! Boxes that scenes set by hand for each agent: how large, how far off, and around which part.

use super::{counted, levels, minus, norm, on_levels};
use barchan::{Command, Error, Options, Precision, Scene, Simulation};
use barchan_core::levels::CellBox;
use barchan_tests::long_cases::furrow_scene;
use barchan_tests::scenes::{everywhere, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, bed, block, driven, half, material, tool};

const H: f64 = 0.05;

/// `[levels]` with entries of `levels.agents` as they are written.
fn agents(count: u32, half: u32, entries: &str) -> String {
    format!("[levels]\ncount = {count}\nhalf = {half}\nagents = [{entries}]\n")
}

/// Jelly that turns slowly in space, and tools beside it.
fn jelly(parts: &[String]) -> String {
    let mut all = vec![
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-0.8, -0.2, -0.2], [0.8, 0.2, 0.2], "angular_velocity = [0.3, 0.0, 0.0]"),
    ];
    all.extend_from_slice(parts);
    Head::space(H).time("step = 1e-3").with(&all)
}

fn ball(name: &str, at: [f64; 3], velocity: [f64; 3]) -> String {
    tool(name, at, "sphere = { radius = 0.05 }", "\"slip\"", &driven(velocity))
}

/// The boxes of each level, finest first.
fn boxes(s: &Simulation) -> Vec<Vec<CellBox>> {
    s.particles().levels.expect("there are levels").boxes
}

/// Middle of a box of the finest level, and half of its sides [m].
fn place(one: &CellBox) -> ([f64; 3], [f64; 3]) {
    let of = |sign: f64| [0, 1, 2].map(|d| 0.5 * H * (f64::from(one.max[d]) + sign * f64::from(one.min[d])));
    (of(1.0), of(-1.0))
}

/// An agent's box of the finest level is where it should be: within half a parent cell at the start, and the dead zone of two later.
fn stands_at(what: &str, one: &CellBox, at: [f64; 3], most: f64) {
    let off = minus(place(one).0, at).into_iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    within(&format!("{what}: box off its place [parent cells]"), off / (2.0 * H), most);
}

/// Boxes are of whole parent cells and nest with four of them between their faces.
fn nest(s: &Simulation) {
    let boxes = boxes(s);
    for (finer, coarser) in boxes.iter().zip(boxes.iter().skip(1)) {
        for (inner, outer) in finer.iter().zip(coarser) {
            for d in 0..3 {
                assert!(inner.min[d] % 2 == 0 && inner.max[d] % 2 == 0, "{inner:?}");
                assert!(
                    inner.min[d] / 2 - 4 >= outer.min[d] && inner.max[d] / 2 + 4 <= outer.max[d],
                    "{inner:?}, {outer:?}"
                );
            }
        }
    }
}

/// A name, and a table with nothing but that name, are the same, written and run.
#[test]
fn a_table_with_only_a_name_is_that_name() {
    let of = |entries: &str| {
        jelly(&[
            agents(3, 8, entries),
            ball("left", [-0.6, 0.0, 0.4], [6.0, 0.0, 0.0]),
            ball("right", [0.7, 0.0, 0.4], [-5.0, 0.0, 0.0]),
        ])
    };
    let [plain, table] =
        [r#""left", "right""#, r#"{ name = "left" }, { name = "right", at = "origin", offset = [0.0, 0.0, 0.0] }"#]
            .map(of);
    assert_eq!(scene(&plain).levels, scene(&table).levels);
    let text = scene(&table).to_toml().unwrap();
    assert!(text.contains(r#"agents = ["left", "right"]"#), "{text}");
    let written = jelly(&[
        agents(3, 8, r#"{ name = "left", half = 10, offset = [0.0, 0.0, -0.1], at = "lowest" }, "right""#),
        ball("left", [0.0; 3], [0.0; 3]),
        ball("right", [0.0; 3], [0.0; 3]),
    ]);
    let read = Scene::from_str(&scene(&written).to_toml().unwrap(), "again.toml", "").unwrap();
    assert_eq!(read.levels, scene(&written).levels);
    for options in everywhere() {
        let run = |text: &str| {
            let mut s = Simulation::new(&barchan::registry(), &scene(text), &options).unwrap();
            (0..60).for_each(|_| drop(s.step().unwrap()));
            (s.particles(), counted(&s.ledger(), "particles split"))
        };
        let (a, b) = (run(&plain), run(&table));
        assert!(a.1 > 0, "boxes have moved");
        assert_eq!(a, b, "{options:?}");
    }
}

/// Symptom: an offset moves boxes at the start only, one agent's half is another's, or coarser levels do not come along. Physics of it: each box
/// stands about its own point to within its dead zone, its half on each side, and nests; matter keeps mass and momentum.
#[test]
fn offsets_and_sizes_are_each_agents_own() {
    let offset = [0.3, -0.2, -0.35];
    let entries = format!(r#"{{ name = "left", half = 12, offset = {offset:?} }}, "right""#);
    let text = jelly(&[
        agents(3, 8, &entries),
        ball("left", [-0.7, 0.2, 0.4], [5.0, 0.0, 0.0]),
        ball("right", [0.9, 0.0, 0.4], [-5.0, 0.0, 0.0]),
    ]);
    for options in everywhere() {
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        let before = s.ledger();
        let mut most = 0.5 + 1e-9;
        for _ in 0..5 {
            let bodies = s.bodies();
            let at = |name: &str| bodies.iter().find(|b| b.name == name).unwrap().position;
            let (left, finest) = (at("left"), boxes(&s).remove(0));
            stands_at("left", &finest[0], [0, 1, 2].map(|d| left[d] + offset[d]), most);
            stands_at("right", &finest[1], at("right"), most);
            for (one, half) in finest.iter().zip([12.0, 8.0]) {
                place(one)
                    .1
                    .into_iter()
                    .for_each(|side| within("half of a box, off [cells]", (side / H - half).abs(), 1e-9));
            }
            nest(&s);
            (0..40).for_each(|_| drop(s.step().unwrap()));
            // The dead zone is two parent cells, and boxes are looked at after each step.
            most = 2.0 + 1e-6;
        }
        let after = s.ledger();
        let (mass, momentum) = if options.precision == Precision::F64 { (1e-13, 1e-11) } else { (1e-6, 2e-5) };
        assert!(counted(&after, "particles split") > 100, "{:?}", after.counts);
        within("mass", (after.mass / before.mass - 1.0).abs(), mass);
        let scale = before.mass * (2.0 * before.kinetic / before.mass).sqrt();
        within("momentum over m v", norm(minus(after.momentum, before.momentum)) / scale, momentum);
    }
}

/// A pole whose middle is high above the ground: all of it makes a tall box, its lowest point a small one, in which that point stays when it moves.
#[test]
fn boxes_follow_the_lowest_point_of_a_tall_tool() {
    let pole = |z: f64, velocity: [f64; 3]| {
        tool("pole", [0.0, 0.0, z], &half([0.05, 0.05, 1.0]), "\"slip\"", &driven(velocity))
    };
    let of = |entry: &str| jelly(&[agents(2, 8, entry), pole(1.15, [0.0, 0.0, -2.0])]);
    let all = simulation(&of(r#""pole""#), Precision::F64);
    let mut s = simulation(&of(r#"{ name = "pole", at = "lowest" }"#), Precision::F64);
    let size = |s: &Simulation| place(&boxes(s)[0][0]).1[2] / H;
    assert!(size(&all) >= 24.0 && (size(&s) - 8.0).abs() < 1e-9, "{} and {}", size(&all), size(&s));
    let finest = |s: &Simulation| {
        let bodies = s.bodies();
        let at = bodies[0].position;
        let lowest = [at[0], at[1], at[2] - 1.0];
        let one = boxes(s)[0][0];
        assert!((0..3).all(|d| one.contains(lowest.map(|x| (x / H).floor() as i32)) && d < 3), "{one:?}, {lowest:?}");
        stands_at("the pole", &one, lowest, 2.0 + 1e-6);
    };
    for _ in 0..10 {
        finest(&s);
        (0..20).for_each(|_| drop(s.step().unwrap()));
    }
    // Turned, another of its ends is the lowest.
    s.act("pole", &Command::Twist { linear: [0.0; 3], angular: [2.0, 0.0, 0.0] }).unwrap();
    run_to(&mut s, 1.0);
    let (body, one) = (s.bodies().remove(0), boxes(&s)[0][0]);
    let [_, x, y, _] = body.rotation;
    let upright = (1.0 - 2.0 * (x * x + y * y)).abs();
    let lowest = body.position[2] - upright - 0.05 * (1.0 - upright * upright).sqrt();
    assert!(upright < 0.9, "it has turned: {upright}");
    within("the box's bottom above the lowest point [cells]", f64::from(one.min[2]) - lowest / H, -3.0);
    within("the lowest point above the box's top [cells]", lowest / H - f64::from(one.max[2]), -3.0);
}

/// A soft body is followed by its lowest cells, too, the same way on every backend.
#[test]
fn boxes_follow_the_lowest_point_of_a_soft_body() {
    let text = Head::space(H).time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-0.2, -0.2, -1.0], [0.2, 0.2, 1.0], "name = \"tall\"\nvelocity = [1.0, 0.0, -2.0]"),
        agents(2, 8, r#"{ name = "tall", at = "lowest", offset = [0.0, 0.1, 0.0] }"#),
    ]);
    for options in everywhere() {
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        let start = boxes(&s)[0][0];
        for _ in 0..8 {
            let ends = |d: usize| {
                rows(&s)
                    .iter()
                    .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], r| [low.min(r.x[d]), high.max(r.x[d])])
            };
            let [x, y, z] = [0, 1, 2].map(ends);
            let at = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]) + 0.1, z[0]];
            // Bounds are those of cells, the coarsest of which are twice as wide.
            stands_at(&options.backend, &boxes(&s)[0][0], at, 3.0);
            nest(&s);
            (0..50).for_each(|_| drop(s.step().unwrap()));
        }
        assert_ne!(start, boxes(&s)[0][0], "it has moved");
        let after = on_levels(&s);
        assert!(after.iter().all(|&n| n > 100), "{after:?}");
    }
}

/// Two agents of one soft body, above and below it: boxes of both move with it, on every backend alike.
#[test]
fn one_soft_body_may_be_several_agents() {
    let text = Head::space(H).time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("neo_hookean", [-0.2, -0.2, -1.0], [0.2, 0.2, 1.0], "name = \"tall\"\nvelocity = [0.0, 0.0, -3.0]"),
        agents(2, 8, r#"{ name = "tall", at = "lowest" }, { name = "tall", at = "lowest", offset = [0.0, 0.0, 2.0] }"#),
    ]);
    let all = everywhere().map(|options| {
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        let mut seen = Vec::new();
        for _ in 0..6 {
            let finest = boxes(&s).remove(0);
            assert_eq!(finest.len(), 2);
            let apart = place(&finest[1]).0[2] - place(&finest[0]).0[2];
            within("the upper box above the lower one, off 2 m [parent cells]", (apart - 2.0).abs() / (2.0 * H), 4.0);
            seen.push(finest);
            (0..50).for_each(|_| drop(s.step().unwrap()));
        }
        seen
    });
    assert!(all[0][0] != all[0][5], "they have moved");
    assert!(all.iter().all(|seen| *seen == all[0]), "{all:?}");
}

/// Symptom: a device lets a free tool go on while its boxes should move, since it looks at all of the tool and not at what is followed. Boxes stand where
/// the CPU has them, and many steps at once are the bits of single ones.
#[test]
fn a_free_tool_is_followed_by_its_lowest_point_on_every_backend() {
    let free = "{ free = { mass = 2.0, linear = [1.0, 0.0, -3.0], angular = [0.0, 4.0, 0.0] } }";
    let text = jelly(&[
        agents(
            3,
            8,
            r#"{ name = "rod", at = "lowest", half = 10, offset = [0.1, 0.0, 0.05] }, { name = "rod", half = 12 }"#,
        ),
        tool("rod", [-0.3, 0.0, 0.9], &half([0.06, 0.06, 0.6]), "\"slip\"", free),
    ]);
    let make = |options: &Options| Simulation::new(&barchan::registry(), &scene(&text), options).unwrap();
    let all = everywhere().map(|options| {
        let (mut single, mut at_once) = (make(&options), make(&options));
        let mut seen = vec![boxes(&single)];
        for _ in 0..6 {
            (0..20).for_each(|_| drop(single.step().unwrap()));
            let mut taken = 0;
            while taken < 20 {
                taken += at_once.steps(20 - taken, f64::INFINITY).unwrap().len();
            }
            nest(&single);
            seen.push(boxes(&single));
            assert!(rows(&single) == rows(&at_once), "{options:?}: many steps at once are something else");
            assert_eq!(boxes(&at_once), boxes(&single), "{options:?}");
        }
        seen
    });
    assert!(all[0].first() != all[0].last(), "boxes have moved");
    all.iter().for_each(|seen| assert_eq!(*seen, all[0]));
}

/// Ground comes within reach around boxes of one's own: on each backend and whatever the size of the world.
#[test]
fn unbounded_ground_follows_boxes_of_ones_own() {
    let own = r#"reach = 4
agents = [{ name = "ball", at = "lowest", half = 12, offset = [0.1, 0.0, -0.05] }]"#;
    for options in everywhere() {
        let run = |side: f64| {
            let text = furrow_scene(side, side).replace("reach = 4", own);
            let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
            let start = boxes(&s);
            (0..50).for_each(|_| drop(s.step().unwrap()));
            assert_ne!(boxes(&s), start, "boxes have moved");
            (boxes(&s), rows(&s))
        };
        assert!(run(10.24) == run(20.48), "{options:?}");
    }
}

/// A quadruped falls onto sand, coarse, with its levels as they are given.
fn quadruped(entries: &str) -> Result<Simulation, Error> {
    let agents = format!("levels.agents=[{entries}]");
    let scene = barchan::tasks::scene(
        "quadruped-stand",
        &["world.cell=0.03125", "levels.count=2", "levels.half=8", "robot.dog.position=[0.625, 0.5, 0.85]", &agents],
    )?;
    Simulation::new(&barchan::registry(), &scene, &Options { threads: 2, ..Options::default() })
}

/// Boxes about a link stand about that link while the robot moves, and so do those about the lowest of all.
#[test]
fn boxes_follow_a_link_and_the_lowest_of_a_robot() {
    let h = 0.03125;
    let mut s = quadruped(
        r#"{ name = "dog", at = "FL_calf", offset = [0.0, 0.0, -0.0625] }, { name = "dog", at = "lowest" }, "dog/RR_calf", "dog/FL_calf""#,
    )
    .unwrap();
    let mut moved = 0;
    let mut before = boxes(&s);
    for _ in 0..20 {
        let now = boxes(&s);
        moved += usize::from(now != before);
        let calves = [&now[0][0], &now[0][3]].map(|one| place(one).0[2] * h / H);
        within(
            "a link's box below that without offset [parent cells]",
            (calves[1] - calves[0] - 0.0625).abs() / (2.0 * h),
            4.0,
        );
        let lowest = &now[0][1];
        let feet = &now[0][2];
        assert!(lowest.min[2] <= feet.min[2] + 8, "{lowest:?}, {feet:?}");
        before = now;
        let next = s.time() + 0.03;
        run_to(&mut s, next);
    }
    let base = s.robots().remove(0).position;
    println!("boxes moved {moved} times, base at {base:?}, {:?}", on_levels(&s));
    assert!(moved > 0, "the robot falls, and its boxes with it");
    // What is followed is at the feet, and not at the trunk.
    let one = boxes(&s)[0][1];
    assert!(f64::from(one.min[2] + one.max[2]) * 0.5 * h < base[2] - 0.1, "{one:?}, {base:?}");
}

/// Each says where it stands, what is wrong, and what may stand there.
#[test]
fn wrong_entries_are_refused_by_key() {
    let make = |entry: &str| {
        let text = jelly(&[agents(2, 8, entry), ball("eye", [0.0, 0.0, 0.4], [0.0; 3])])
            .replace("[[body]]", "[[body]]\nname = \"block\"");
        Scene::from_str(&text, "scene.toml", "")
            .and_then(|scene| Simulation::new(&barchan::registry(), &scene, &Options::default()))
            .map(drop)
    };
    make(r#"{ name = "block", half = 16 }"#).unwrap();
    for (entry, told) in [
        (
            r#"{ name = "eye", half = 6 }"#,
            &["scene.toml:", "levels.agents[0].half", "is 6", "even and from 8 to 512"][..],
        ),
        (r#"{ name = "eye", half = 9 }"#, &["levels.agents[0].half", "is 9", "even"]),
        (r#"{ name = "eye", half = 514 }"#, &["levels.agents[0].half", "is 514"]),
        (
            r#""eye", { name = "eye", offset = [0.0, nan, 0.0] }"#,
            &["levels.agents[1].offset[1]", "NaN", "give a finite number"],
        ),
        (r#"{ name = "eye", offset = [0.0, 0.0, -1e9] }"#, &["levels.agents[0].offset", "8 m"]),
        (r#"{ name = "eye", offset = [0.0, 0.0] }"#, &["levels.agents[0].offset"]),
        (r#"{ name = "eye", at = "tip" }"#, &["levels.agents[0].at", "'tip'", "'eye' is a tool", "\"lowest\""]),
        (r#"{ name = "block", at = "tip" }"#, &["levels.agents[0].at", "'block' is a soft body", "\"lowest\""]),
        (r#"{ name = "ey" }"#, &["levels.agents[0]", "'ey'", "eye", "block"]),
        (r#"{ name = "eye", hafl = 8 }"#, &["levels.agents[0]", "unknown key `hafl`", "did you mean `half`?"]),
        (r#"{ half = 8 }"#, &["levels.agents[0].name", "this key is required"]),
        ("3", &["levels.agents[0]", "a name, or a table with one"]),
        (r#"{ name = "eye", half = -8 }"#, &["levels.agents[0].half"]),
    ] {
        let error = make(entry).expect_err(entry).to_string();
        println!("{error}");
        assert!(told.iter().all(|words| error.contains(words)), "{entry}: {error}");
    }
    // A body and a tool may share a name, but then it says nobody.
    let text = jelly(&[agents(2, 8, "\"block\""), ball("block", [0.0, 0.0, 0.4], [0.0; 3])])
        .replace("[[body]]", "[[body]]\nname = \"block\"");
    let error = Scene::from_str(&text, "scene.toml", "").unwrap_err().to_string();
    assert!(error.contains("levels.agents[0]") && error.contains("a tool and a body"), "{error}");
    for (entry, told) in [
        (r#"{ name = "dog", at = "tail" }"#, &["levels.agents", "'tail'", "FL_calf", "link of that robot"][..]),
        (r#"{ name = "dog/FL_calf", at = "FL_calf" }"#, &["levels.agents[0].at", "no robot with links"]),
        (r#"{ name = "cat", at = "FL_calf" }"#, &["levels.agents", "'cat'", "dog"]),
        (r#"{ name = "bed", at = "FL_calf" }"#, &["levels.agents[0].at", "'bed' is a soft body"]),
    ] {
        let error = quadruped(entry).map(drop).expect_err(entry).to_string();
        println!("{error}");
        assert!(told.iter().all(|words| error.contains(words)), "{entry}: {error}");
    }
}

/// `plan` says of each agent what its boxes follow, how large they are and what is in them, and counts on each level what there is.
#[test]
fn plans_list_the_boxes_of_each_agent() {
    let text = jelly(&[
        agents(3, 8, r#"{ name = "eye", half = 12, offset = [0.0, 0.0, -0.1], at = "lowest" }, "other""#),
        ball("eye", [-0.6, 0.0, 0.4], [1.0, 0.0, 0.0]),
        ball("other", [0.4, 0.0, 3.0], [1.0, 0.0, 0.0]),
        "[[levels.box]]\nmin = [0.6, -0.2, -0.2]\nmax = [0.8, 0.2, 0.2]\n".to_owned(),
    ]);
    let s = simulation(&text, Precision::F64);
    let plan = s.plan().to_string();
    println!("{plan}");
    let line = |name: &str| plan.lines().find(|line| line.starts_with(name)).unwrap_or_else(|| panic!("no {name}"));
    let eye = line("boxes around eye");
    assert!(eye.contains(r#"levels.agents[0]: half = 12, offset = [0.0, 0.0, -0.1], at = "lowest""#), "{eye}");
    assert!(eye.contains("24³ cells of 0.05 m with "), "{eye}");
    assert!(line("boxes around other").contains("16³ cells of 0.05 m with 0 particles"));
    // The first box holds what is fine but for the fixed box's, which it does not meet.
    let count =
        |line: &str| -> usize { line.split(" with ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap() };
    assert_eq!(count(eye) + count(line("boxes around levels.box[0]")), on_levels(&s)[0]);
}

/// Symptom: a tool that is not all in its box presses coarse ground that rims do not expect, or a bed whose boxes are off their tools begins to move.
/// Physics: a settled bed stays at rest.
#[test]
fn a_settled_bed_stays_at_rest_around_boxes_of_ones_own() {
    let h = 0.02;
    let (mut head, mut parts) = bed(h, [48, 48], 16, 32, "young_modulus = 5e5, friction_angle_deg = 40");
    head.walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    parts.iter_mut().for_each(|part| *part = part.replace("[[body]]", "[[body]]\nsettled = true"));
    let of = |levels: String| {
        let mut all = parts.clone();
        all.extend([
            levels,
            tool("eye", [0.3, 0.48, 0.9], &half([0.02, 0.02, 0.5]), "\"slip\"", "\"fixed\""),
            tool("other", [0.7, 0.48, 0.45], &half([0.02; 3]), "\"slip\"", "\"fixed\""),
        ]);
        head.with(&all)
    };
    let own = agents(
        3,
        8,
        r#"{ name = "eye", half = 10, at = "lowest", offset = [0.0, 0.06, -0.1] }, { name = "other", offset = [0.0, 0.0, -0.16] }"#,
    );
    let speed = |text: &str| {
        let mut s = simulation(text, Precision::F32);
        let on = on_levels(&s);
        run_to(&mut s, 0.1);
        (on, rows(&s).iter().map(|r| norm(r.v)).fold(0.0, f64::max))
    };
    let (on, own) = speed(&of(own));
    let (there, plain) = speed(&of(levels(3, 8, &["eye", "other"])));
    println!("on levels {on:?} at {own:.2e} m/s, with plain names {there:?} at {plain:.2e} m/s");
    assert!(on.iter().all(|&n| n > 100), "{on:?}");
    within("greatest speed over that with plain names", own / plain.max(1e-4), 3.0);
}
