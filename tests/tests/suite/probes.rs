//! Probes: what they find is what is there.

use barchan::probe::Filter;
use barchan::run::{Existing, Request, Until, run};
use barchan::scene::{Probe, Region, Section, SurfaceProbe};
use barchan::worlds::Worlds;
use barchan::{Crossed, Options, Precision, Simulation, Sought, Sums, Vec3};
use barchan_tests::scenes::{everywhere, minus, norm, options, plus, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, block, body, material, tool};
use std::ops::ControlFlow;
use std::path::Path;

/// Starts a scene with further entries.
fn start(text: &str, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(text), options).unwrap_or_else(|e| panic!("{e}\n{text}"))
}

/// A column of a probe.
fn value(s: &Simulation, probe: &str, column: &str) -> f64 {
    let found = s.probes(|_| true).unwrap_or_else(|e| panic!("{e}"));
    let own = found.iter().find(|found| found.name == probe).unwrap_or_else(|| panic!("no probe {probe}"));
    let value = own.values.iter().find(|(name, _)| name == column).unwrap_or_else(|| panic!("{:?}", own.values));
    value.1.unwrap_or_else(|| panic!("{probe} {column}: nothing found"))
}

/// A block of jelly that flies along x at 1 m/s, without gravity, and sections before it.
fn flying() -> String {
    let section = |name: &str, more: &str| format!("[[probe]]\nname = \"{name}\"\n{more}\n");
    Head::space(0.05).time("step = 2e-3").with(&[
        material("neo_hookean", 900.0, "young_modulus = 5e4"),
        block("neo_hookean", [0.0; 3], [0.2, 0.3, 0.4], "name = \"block\"\nvelocity = [1, 0, 0]"),
        section("whole", "flux = { rectangle = { min = [0.3, -1, -1], max = [0.3, 1, 1] } }"),
        section("lower", "flux = { rectangle = { min = [0.3, -1, -1], max = [0.3, 1, 0.1] } }"),
        section(
            "against",
            "flux = { disc = { center = [0.31, 0, 0], normal = [-3, 0.2, 0.3], radius = 2 } }\nbody = \"block\"",
        ),
        section("beside", "flux = { disc = { center = [0.31, 0, 1], normal = [1, 0, 0], radius = 0.4 } }"),
        section(
            "coarse",
            "flux = { rectangle = { min = [0.3, -1, -1], max = [0.3, 1, 1] } }\nlevel = 0\nmaterial = \"neo_hookean\"",
        ),
    ])
}

/// All of a block that is moved through a section crosses it, once and in one direction: its mass, rest volume and momentum. Of a section that covers a quarter
/// of its height, a quarter does.
#[test]
fn a_block_moved_through_a_section_crosses_it_once() {
    for options in everywhere() {
        let mut s = start(&flying(), &options);
        let all = rows(&s);
        let (mass, volume) = all.iter().fold((0.0, 0.0), |(m, v), row| (m + row.m, v + row.volume0));
        run_to(&mut s, 0.45);
        let crossed = s.crossed().unwrap();
        let what = format!("{} {}", options.backend, options.precision);
        for (number, share, ways) in [(0, 1.0, [0, 1]), (1, 0.25, [0, 1]), (2, 1.0, [1, 0]), (4, 1.0, [0, 1])] {
            let [way, other] = ways;
            let one = &crossed[number];
            assert_eq!(one.count[way], (share * all.len() as f64) as u64, "{what}: section {number}");
            assert_eq!((one.count[other], one.mass[other], one.momentum[other]), (0, 0.0, [0.0; 3]));
            within(&format!("{what}: mass through {number}"), (one.mass[way] / (share * mass) - 1.0).abs(), 1e-6);
            within("rest volume", (one.volume0[way] / (share * volume) - 1.0).abs(), 1e-6);
            within("momentum", (one.momentum[way][0] / (share * mass) - 1.0).abs(), 1e-5);
        }
        assert_eq!(crossed[3].count, [0, 0], "{what}: what passes beside a section");
        assert_eq!(value(&s, "whole", "particles forwards"), all.len() as f64);
        within("from the probe", (value(&s, "whole", "mass [kg]") / mass - 1.0).abs(), 1e-6);
    }
}

/// Particles of fine and of coarse levels cross a section once, whether levels take steps of their own or not, and sections for a level each add up to one for all.
#[test]
fn particles_of_all_levels_cross_once_whatever_steps_they_take() {
    let section = |name: &str, more: &str| {
        format!(
            "[[probe]]\nname = \"{name}\"\nflux = {{ rectangle = {{ min = [0.75, 0, 0], max = [0.75, 2, 2] }} }}\n{more}\n"
        )
    };
    for (options, subcycle) in everywhere().iter().flat_map(|options| [(options, false), (options, true)]) {
        let head = Head { gravity: [0.0; 3], ..Head::cells(0.05, [32; 3], "") };
        let mut s = start(
            &head.with(&[
                material("neo_hookean", 900.0, "young_modulus = 5e4"),
                block("neo_hookean", [0.6, 0.6, 0.7], [0.7, 1.5, 0.8], "velocity = [1, 0, 0]"),
                tool("eye", [0.8, 0.8, 0.4], "sphere = { radius = 0.05 }", "\"slip\"", "{ velocity = {} }"),
                format!("[levels]\ncount = 2\nhalf = 8\nagents = [\"eye\"]\nsubcycle = {subcycle}\n"),
                section("all", "") + &section("fine", "level = 0") + &section("coarse", "level = 1"),
            ]),
            options,
        );
        let (all, what) = (rows(&s), format!("{} {}, subcycle {subcycle}", options.backend, options.precision));
        let of = |level: u32| all.iter().filter(|row| row.level == level).count() as u64;
        let mass: f64 = all.iter().map(|row| row.m).sum();
        run_to(&mut s, 0.2);
        let crossed = s.crossed().unwrap();
        assert_eq!([1, 2].map(|n| crossed[n].count), [[of(0), 0], [of(1), 0]], "{what}");
        assert!(of(0) > 0 && of(1) > 0);
        within(&format!("{what}: mass"), (crossed[0].mass[0] / mass - 1.0).abs(), 1e-6);
        within("of both levels", (crossed[1].mass[0] + crossed[2].mass[0] - crossed[0].mass[0]).abs(), 1e-6 * mass);
    }
}

/// What crosses a section at the world's open side and has not come back is what the ledger books as deleted, and what is about to be.
#[test]
fn flux_through_an_open_side_is_what_the_ledger_books() {
    for options in everywhere() {
        let head = Head { world: "leaving = \"delete\"", ..Head::cells(0.05, [8, 8, 16], "z_max = \"slip\"") };
        let mut s = start(
            &head.with(&[
                material("sand", 1500.0, "young_modulus = 1e5"),
                block("sand", [0.1, 0.1, 0.1], [0.3, 0.3, 0.4], "velocity = [0, 0, -1]\nsampling = \"jitter\""),
                "[[probe]]\nname = \"out\"\nflux = { rectangle = { min = [-1, -1, 0], max = [2, 2, 0] } }\n".to_owned(),
            ]),
            &options,
        );
        run_to(&mut s, 0.15);
        let beyond: f64 = rows(&s).iter().filter(|row| row.x[2] < 0.0).map(|row| row.m).sum();
        let booked = s.ledger().deleted_mass + beyond;
        assert!(booked > 1.0, "nothing has left");
        let what = format!("{}: out against books [kg]", options.backend);
        within(&what, (-value(&s, "out", "mass [kg]") - booked).abs(), 1e-6 * booked);
    }
}

/// Of worlds that step together, each counts its own, also one that has begun anew and one that goes on from a copy of another; and counts go on over swaps of
/// backends, whichever way.
#[test]
fn counts_are_a_worlds_own_and_go_on_over_swaps() {
    let world = |speed: f64| scene(&flying().replace("velocity = [1, 0, 0]", &format!("velocity = [{speed}, 0, 0]")));
    let through = |s: &Simulation| s.crossed().unwrap()[0].count[0];
    for options in everywhere() {
        let mut worlds = Worlds::new(&barchan::registry(), [1.0, 0.6, 0.4].map(world).into(), &options).unwrap();
        let steps = |worlds: &mut Worlds, count: usize| {
            (0..count).for_each(|_| worlds.step().into_iter().for_each(|report| drop(report.unwrap())));
        };
        steps(&mut worlds, 120);
        let all = worlds.world(0).particle_count() as u64;
        let some = through(worlds.world(1));
        assert_eq!((through(worlds.world(0)), through(worlds.world(2))), (all / 4 * 3, 0), "{}", options.backend);
        assert!(0 < some && some < all, "{some} of {all}");
        worlds.reset(0, None).unwrap();
        worlds.fork(1, 2).unwrap();
        assert_eq!([0, 1, 2].map(|w| through(worlds.world(w))), [0, some, some], "{}", options.backend);
        steps(&mut worlds, 230);
        assert_eq!([0, 1, 2].map(|w| through(worlds.world(w))), [all; 3], "{}", options.backend);
    }
    let [single, _, device] = everywhere();
    let mut s = start(&flying(), &single);
    for (backend, time) in [(&device, 0.12), (&single, 0.2), (&device, 0.3)] {
        run_to(&mut s, time);
        // What f64 does not hold is a device's own.
        let crossed = |s: &Simulation| -> Vec<Crossed> {
            s.crossed().unwrap().into_iter().map(|one| Crossed { rest: Default::default(), ..one }).collect()
        };
        let before = crossed(&s);
        s.swap(&barchan::registry(), backend).unwrap();
        assert_eq!(crossed(&s), before, "a swap counts nothing");
    }
    run_to(&mut s, 0.45);
    assert_eq!(through(&s), s.particle_count() as u64);
}

/// Sand and a drop of snow that fall onto fine and coarse ground, and a tool that levels follow.
fn nested(more: &str) -> String {
    Head::cells(
        0.025,
        [32, 32, 24],
        "x_min = \"slip\"\nx_max = \"stick\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"",
    )
    .with(&[
        material("sand", 1500.0, "young_modulus = 1e5, friction_angle_deg = 30"),
        material("snow", 400.0, "young_modulus = 5e4"),
        block("sand", [0.0; 3], [0.8, 0.8, 0.2], "name = \"bed\"\nsampling = \"jitter\""),
        block("snow", [0.3, 0.3, 0.25], [0.4, 0.4, 0.35], "name = \"drop\"\nvelocity = [0.3, 0, -1]"),
        tool(
            "ball",
            [0.3, 0.4, 0.25],
            "sphere = { radius = 0.05 }",
            "\"slip\"",
            "{ velocity = { linear = [0.4, 0, -0.5] } }",
        ),
        format!("[levels]\ncount = 2\nhalf = 8\n{more}\n"),
    ])
}

/// All of those particles, those of a material, a body, a level, and of a material that no body uses and a level that is none.
fn filters() -> [Filter; 7] {
    let all = Filter::default();
    [
        all,
        Filter { material: Some(1), ..all },
        Filter { body: Some(0), ..all },
        Filter { level: Some(1), ..all },
        Filter { level: Some(0), ..all },
        Filter { material: Some(u32::MAX), ..all },
        Filter { level: Some(2), ..all },
    ]
}

/// Sums within a box, a sphere and a cylinder that straddle levels are what particles there add up to, of all or of one material, body or level.
#[test]
fn sums_within_regions_are_those_of_the_particles_there() {
    for options in everywhere() {
        let mut s = start(&nested(""), &options);
        (0..40).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        let regions = [
            Region::Box { min: [0.1, 0.1, 0.05], max: [0.6, 0.7, 0.33] },
            Region::Sphere { center: [0.4, 0.4, 0.15], radius: 0.27 },
            Region::Cylinder { center: [0.35, 0.4, 0.2], radius: 0.2, half_height: 0.18 },
        ];
        let sought: Vec<Sought> =
            regions.iter().flat_map(|&region| filters().map(|filter| Sought { region, filter })).collect();
        let found = s.sums_within(&sought).unwrap();
        let particles = s.particles();
        for (one, found) in sought.iter().zip(&found) {
            let mut by_hand = Sums::default();
            let (mut size, mut strength) = (0.0, 0.0);
            for list in &particles.lists {
                let which: Vec<usize> = (0..list.len())
                    .filter(|&i| one.filter.takes(list.material, list.body[i], list.level))
                    .filter(|&i| {
                        let (x, (center, half)) = (list.position(i), one.region.middle());
                        let r: Vec3 = std::array::from_fn(|d| (x[d] - center[d]) / half[d]);
                        match one.region {
                            Region::Box { .. } => r.iter().all(|r| r.abs() < 1.0),
                            Region::Sphere { .. } => r.iter().map(|r| r * r).sum::<f64>() < 1.0,
                            Region::Cylinder { .. } => r[0] * r[0] + r[1] * r[1] < 1.0 && r[2].abs() < 1.0,
                        }
                    })
                    .collect();
                let planned = &s.plan().materials[list.material as usize];
                let stress = barchan::stress::kirchhoff(planned, list, &which).unwrap();
                for (&i, tau) in which.iter().zip(stress) {
                    by_hand.count += 1;
                    by_hand.mass += list.mass[i];
                    by_hand.volume0 += list.volume0[i];
                    by_hand.volume += list.volume0[i] * barchan::stress::volume_ratio(list, i);
                    (0..3).for_each(|d| by_hand.momentum[d] += list.mass[i] * list.velocity[i][d]);
                    (0..6).for_each(|c| by_hand.stress[c] += list.volume0[i] * tau[c]);
                    size += list.mass[i] * list.velocity[i].iter().map(|v| v.abs()).sum::<f64>();
                    // What f32 tells of strain makes so much stress uncertain.
                    strength += list.volume0[i] * 1e5;
                }
            }
            let what = format!("{} {}: {one:?}", options.backend, options.precision);
            assert_eq!(found.count, by_hand.count, "{what}");
            let off = |a: f64, b: f64, scale: f64| (a - b).abs() / scale.max(1e-12);
            within(&what, off(found.mass, by_hand.mass, by_hand.mass), 1e-6);
            within("rest volume", off(found.volume0, by_hand.volume0, by_hand.volume0), 1e-6);
            within("volume", off(found.volume, by_hand.volume, by_hand.volume), 1e-6);
            let worst = (0..3).map(|d| off(found.momentum[d], by_hand.momentum[d], size)).fold(0.0, f64::max);
            within("momentum", worst, 1e-6);
            let worst = (0..6).map(|c| off(found.stress[c], by_hand.stress[c], strength)).fold(0.0, f64::max);
            within("stress", worst, 1e-6);
        }
        assert!(found[3].count > 0 && found[4].count > 0, "regions that straddle levels");
    }
}

/// In a settled bed the mean stress at a depth is the weight of what lies above, and all space is filled.
#[test]
fn stress_within_a_settled_bed_is_the_weight_above() {
    let head = Head::cells(
        0.05,
        [8, 8, 24],
        "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"",
    );
    let s = simulation(
        &head.with(&[
            material("hencky", 1000.0, "young_modulus = 2e6, poisson_ratio = 0.25"),
            block("hencky", [0.0; 3], [0.4, 0.4, 1.0], "settled = true"),
            "[[probe]]\nname = \"deep\"\nwithin = { box = { min = [0.1, 0.1, 0.2], max = [0.3, 0.3, 0.4] } }\n"
                .to_owned(),
        ]),
        Precision::F64,
    );
    let weight = 1000.0 * 9.81 * 0.7;
    within("vertical stress", (value(&s, "deep", "zz [Pa]") / -weight - 1.0).abs(), 5e-3);
    // K0 = nu / (1 - nu) = 1/3 of an elastic bed between walls.
    within("pressure", (value(&s, "deep", "pressure [Pa]") / (weight * 5.0 / 9.0) - 1.0).abs(), 5e-3);
    let shear = weight * (2.0 / 3.0) / 3f64.sqrt();
    within("shear stress", (value(&s, "deep", "shear stress [Pa]") / shear - 1.0).abs(), 5e-3);
    within("fill", (value(&s, "deep", "fill") - 1.0).abs(), 1e-2);
    within("mean velocity", value(&s, "deep", "vz [m/s]").abs(), 1e-12);
}

/// Heights of a step of two boxes are those of its treads, and of the floor where nothing lies, on a line and on a patch; a share above a height is an area's.
#[test]
fn heights_of_a_step_are_those_of_its_treads() {
    for options in everywhere() {
        let s = start(
            &Head::cells(0.02, [40, 20, 20], "z_min = \"slip\"").with(&[
                material("neo_hookean", 900.0, "young_modulus = 5e4"),
                block("neo_hookean", [0.0; 3], [0.4, 0.4, 0.1], ""),
                block("neo_hookean", [0.0, 0.0, 0.1], [0.2, 0.4, 0.2], ""),
                "[[probe]]\nname = \"points\"\nsurface = { points = [[0.1, 0.2], [0.3, 0.2], [0.6, 0.2]] }\n\
                 [[probe]]\nname = \"line\"\nsurface = { line = { from = [0.1, 0.2], to = [0.3, 0.2], points = 2 } }\n\
                 [[probe]]\nname = \"patch\"\nsurface = { patch = { min = [0, 0], max = [0.8, 0.4], points = [8, 4], above = 0.15 } }\n"
                    .to_owned(),
            ]),
            &options,
        );
        for (probe, column, height) in [
            ("points", "z0 [m]", 0.2),
            ("points", "z1 [m]", 0.1),
            ("points", "z2 [m]", 0.0),
            ("points", "mean [m]", 0.1),
            ("line", "z1 [m]", 0.1),
            ("line", "greatest [m]", 0.2),
            ("patch", "mean [m]", 0.075),
            ("patch", "least [m]", 0.0),
            ("patch", "greatest [m]", 0.2),
            ("patch", "share above", 0.25),
        ] {
            let off = (value(&s, probe, column) - height).abs();
            within(&format!("{} {probe} {column}", options.backend), off, 1e-6);
        }
    }
}

/// A bed at rest presses on the floor with its weight, on a quarter of the floor with a quarter of it.
#[test]
fn the_floor_bears_the_weight_of_a_bed_at_rest() {
    let head = Head::cells(
        0.05,
        [8, 8, 12],
        "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"",
    );
    let mut s = simulation(
        &head.with(&[
            material("hencky", 1000.0, "young_modulus = 2e6, poisson_ratio = 0.25"),
            block("hencky", [0.0; 3], [0.4, 0.4, 0.4], "settled = true"),
            "[sleep]\non = false\n".to_owned(),
            "[[probe]]\nname = \"floor\"\nwall = { side = \"z_min\" }\n\
             [[probe]]\nname = \"quarter\"\nwall = { side = \"z_min\", min = [0, 0, 0], max = [0.2, 0.2, 0] }\n"
                .to_owned(),
        ]),
        Precision::F64,
    );
    run_to(&mut s, 0.5);
    let weight = 1000.0 * 0.4 * 0.4 * 0.4 * 9.81;
    let force = |probe: &str| -value(&s, probe, "impulse z [N s]") / s.time();
    within("floor", (force("floor") / weight - 1.0).abs(), 2e-3);
    within("a quarter of it", (force("quarter") / (0.25 * weight) - 1.0).abs(), 2e-3);
    within("along the floor", value(&s, "floor", "impulse x [N s]").abs(), 1e-9);
}

/// What the parts of all walls take adds up to what the ledger says that walls gave: on one level and on nested ones, with walls that stick, slip and let go, and
/// halves of the floor to the whole.
#[test]
fn what_walls_take_adds_up_to_what_the_ledger_says() {
    let sides = ["x_min", "x_max", "y_min", "y_max", "z_min"];
    let wall = |name: &str, part: &str| format!("[[probe]]\nname = \"{name}\"\nwall = {{ {part} }}\n");
    let all: String = sides.iter().map(|side| wall(side, &format!("side = \"{side}\""))).collect();
    let halves = [("left", "max = [0.4, 1, 1]"), ("right", "min = [0.4, -1, -1]")];
    let halves: String = halves.iter().map(|(name, at)| wall(name, &format!("side = \"z_min\", {at}"))).collect();
    let together = nested("");
    let lets_go = together.replace("x_min = \"slip\"", "x_min = { separate = { friction = 0.3 } }");
    for (what, text) in [("nested", &together), ("subcycled", &nested("subcycle = true")), ("lets go", &lets_go)] {
        // Near two walls, so that rims meet them.
        let text = text.replace("position = [0.3, 0.4, 0.25]", "position = [0.08, 0.1, 0.2]");
        let mut s = simulation(&format!("{text}{all}{halves}"), Precision::F64);
        (0..60).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        let (pressed, given) = (s.pressed(), s.ledger().wall_impulse);
        for d in 0..3 {
            let sum: f64 = pressed[..5].iter().map(|one| one[d]).sum();
            let floor = (pressed[5][d] + pressed[6][d] - pressed[4][d]).abs();
            within(&format!("{what}, axis {d}"), (sum + given[d]).abs().max(floor), 1e-9 * given[2].abs());
        }
        assert!(given[2] > 0.1, "{what}: the floor bears the bed");
    }
}

/// What parts of walls take on a device is what they take on a processor, in corners too, and adds up to what the ledger says; a device goes on where a processor was, and
/// back.
#[test]
fn what_walls_take_on_a_device_is_what_they_take_on_a_processor() {
    let sides = ["x_min", "x_max", "y_min", "y_max", "z_min"];
    let wall = |name: &str, part: &str| format!("[[probe]]\nname = \"{name}\"\nwall = {{ {part} }}\n");
    let all: String = sides.iter().map(|side| wall(side, &format!("side = \"{side}\""))).collect();
    let corner = wall("corner", "side = \"z_min\", max = [0.2, 0.2, 1]");
    // A section before them: its sums and theirs stand side by side.
    let flux = "[[probe]]\nname = \"sunk\"\nflux = { rectangle = { min = [0, 0, 0.1], max = [0.8, 0.8, 0.1] } }\n";
    let one = nested("").replace("count = 2\nhalf = 8\n", "count = 1\n");
    let periodic =
        |text: &str| text.replace("x_min = \"slip\"\nx_max = \"stick\"", "x_min = \"periodic\"\nx_max = \"periodic\"");
    let lets_go = |text: &str| text.replace("x_min = \"slip\"", "x_min = { separate = { friction = 0.3 } }");
    let subcycled = nested("subcycle = true");
    let all_sides = &sides[..];
    for (what, text, sides) in [
        ("one level", one.clone(), all_sides),
        ("nested", nested(""), all_sides),
        ("subcycled", subcycled.clone(), all_sides),
        ("one level, periodic", periodic(&one), &sides[2..]),
        ("subcycled, periodic", periodic(&subcycled), &sides[2..]),
        ("one level, lets go", lets_go(&one), all_sides),
        ("nested, lets go", lets_go(&nested("")), all_sides),
    ] {
        let near = text.replace("position = [0.3, 0.4, 0.25]", "position = [0.08, 0.1, 0.2]");
        // A device plans its steps ahead: with steps of its own it would be a little elsewhere.
        let near = near.replace("[time]\n", "[time]\nstep = 5e-4\n");
        let kept: String =
            all.split_inclusive("}\n").filter(|one| sides.iter().any(|side| one.contains(side))).collect();
        let text = format!("{near}{flux}{kept}{corner}");
        let on = |backend: &str, precision| Options { backend: backend.to_owned(), ..options(precision) };
        let mut here = start(&text, &on("cpu", Precision::F64));
        let mut there = start(&text, &on("wgpu", Precision::F32));
        // The same steps.
        [0.02, 0.03, 0.04].iter().for_each(|time| run_to(&mut here, *time));
        run_to(&mut there, 0.02);
        there.swap(&barchan::registry(), &on("cpu", Precision::F64)).unwrap();
        run_to(&mut there, 0.03);
        there.swap(&barchan::registry(), &on("wgpu", Precision::F32)).unwrap();
        run_to(&mut there, 0.04);
        let (one, other, given) = (here.pressed(), there.pressed(), there.ledger().wall_impulse);
        assert_eq!(other.len(), sides.len() + 1);
        let weight = given[2].abs();
        for d in 0..3 {
            let sum: f64 = other[..sides.len()].iter().map(|one| one[d]).sum();
            within(&format!("{what}, all walls, axis {d}"), (sum + given[d]).abs(), 1e-6 * weight);
        }
        for (k, (one, other)) in one.iter().zip(&other).enumerate() {
            within(&format!("{what}, part {k}"), norm(minus(*one, *other)), 5e-5 * weight);
        }
        assert!(weight > 0.1 && norm(other[sides.len()]) > 0.01, "{what}: the floor bears the bed");
    }
}

/// What parts of walls take through rims in a step that turns out to be too long counts once, when it has been repeated.
#[test]
fn what_walls_take_in_a_repeated_step_counts_once() {
    let sides = ["x_min", "x_max", "y_min", "y_max", "z_min"];
    let wall = |side: &str| format!("[[probe]]\nname = \"{side}\"\nwall = {{ side = \"{side}\" }}\n");
    let all: String = sides.iter().map(|side| wall(side)).collect();
    // Fast ground meets a frictionless plate at a slant between walls, and nodes become faster than either.
    let (sine, cosine) = f64::to_radians(50.0).sin_cos();
    let (half_sine, half_cosine) = f64::to_radians(25.0).sin_cos();
    let plate = format!(
        "[[tool]]\nname = \"plate\"\nposition = [1.7, 0.4, 0.4]\nrotation = [{half_cosine}, 0, 0, {half_sine}]\n\
         shape = {{ box = {{ half = [0.12, 0.5, 0.3] }} }}\ncontact = \"slip\"\n\
         motion = {{ velocity = {{ linear = [{}, {}, 0] }} }}\n",
        -16.0 * cosine,
        -16.0 * sine
    );
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"stick\"\nz_min = \"stick\"";
    let mut head = Head::cells(0.1, [32, 8, 12], walls).time("safety = 0.9");
    head.gravity = [0.0; 3];
    let text = head.with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e3"),
        block("neo_hookean", [0.2, 0.0, 0.0], [1.2, 0.8, 0.7], "velocity = [20, 0, 0]"),
        plate,
        "[levels]\ncount = 2\nhalf = 8\n".to_owned(),
        all,
    ]);
    let options = Options { backend: "wgpu".to_owned(), ..options(Precision::F32) };
    let mut s = start(&text, &options);
    (0..40).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
    let (pressed, given, counts) = (s.pressed(), s.ledger().wall_impulse, s.ledger().counts);
    assert!(counts.get("steps shortened for speed").is_some_and(|count| *count > 0), "{counts:?}");
    let size: f64 = pressed.iter().map(|one| norm(*one)).sum();
    for d in 0..3 {
        let sum: f64 = pressed.iter().map(|one| one[d]).sum();
        within(&format!("all walls, axis {d}"), (sum + given[d]).abs(), 1e-6 * size);
    }
}

/// The particle nearest to a point is the one that a look at all of them finds, and a cloud is at no distance from itself.
#[test]
fn the_nearest_particle_and_a_cloud_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let text = |probes: &str| {
        Head::space(0.05).with(&[
            material("neo_hookean", 900.0, "young_modulus = 5e4"),
            body("neo_hookean", "sphere = { center = [0, 0, 0], radius = 0.3 }", "velocity = [1, 2, 3]"),
            probes.to_owned(),
        ])
    };
    let all = rows(&simulation(&text(""), Precision::F32));
    let csv: String = all.iter().map(|row| format!("{},{},{}\n", row.x[0] + 0.01, row.x[1], row.x[2])).collect();
    std::fs::write(folder.path().join("cloud.csv"), format!("x,y,z\n{csv}")).unwrap();
    let point = [1.7, -1.1, 0.4];
    let probes = format!(
        "[[probe]]\nname = \"grain\"\nnearest = {point:?}\n[[probe]]\nname = \"cloud\"\nchamfer = \"cloud.csv\"\n"
    );
    for options in everywhere() {
        let scene = barchan::Scene::from_str(&text(&probes), "test scene", folder.path()).unwrap();
        let s = Simulation::new(&barchan::registry(), &scene, &options).unwrap();
        let distance = |x: Vec3| (0..3).map(|d| (x[d] - point[d]).powi(2)).sum::<f64>().sqrt();
        let nearest = rows(&s).into_iter().min_by(|a, b| distance(a.x).total_cmp(&distance(b.x))).unwrap();
        assert_eq!(value(&s, "grain", "id"), nearest.id as f64, "{}", options.backend);
        within("distance", (value(&s, "grain", "distance [m]") - distance(nearest.x)).abs(), 1e-9);
        within("velocity", (value(&s, "grain", "vy [m/s]") - 2.0).abs(), 1e-6);
        within("density", (value(&s, "grain", "density [kg/m3]") / 900.0 - 1.0).abs(), 1e-5);
        // Each is 1 cm from its own, and from no other less: particles are 2.5 cm apart.
        within("to the cloud", (value(&s, "cloud", "to cloud [m]") - 0.01).abs(), 1e-6);
        within("chamfer", (value(&s, "cloud", "chamfer [m]") - 0.02).abs(), 2e-6);
    }
}

/// Distances between a cloud and particles on two levels are those of trying all pairs, of all particles or of one material, body or level, also where the cloud lies far
/// outside, is one point, or is as dense as the ground.
#[test]
fn distances_to_clouds_are_those_of_trying_all_pairs() {
    let scattered = |count: usize, size: f64, from: Vec3| -> Vec<Vec3> {
        let at = |i: usize, by: f64| ((i as f64 + 0.3) * by).fract() * size;
        (0..count)
            .map(|i| [0.618_033_988, 0.414_213_562, 0.732_050_807].map(|by| at(i, by)))
            .map(|x| plus(x, from))
            .collect()
    };
    let clouds = [
        scattered(150, 0.8, [0.0; 3]),
        scattered(60, 0.05, [0.3, 0.35, 0.2]),
        scattered(40, 0.6, [-3.0, 0.2, 5.0]),
        scattered(300, 0.5, [0.1, 0.1, 0.0]).into_iter().map(|[x, y, _]| [x, y, 0.2]).collect(),
        vec![[0.41, 0.37, 0.21]],
    ];
    for options in everywhere() {
        let mut s = start(&nested(""), &options);
        (0..40).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        let particles = s.particles();
        for (cloud, filter) in clouds.iter().flat_map(|cloud| filters().map(|filter| (cloud, filter))) {
            let found = s.apart(cloud, filter).unwrap();
            let counts = particles.lists.iter().flat_map(|list| {
                let takes = |i: &usize| filter.takes(list.material, list.body[*i], list.level);
                (0..list.len()).filter(takes).map(|i| list.position(i))
            });
            let places: Vec<Vec3> = counts.collect();
            let least = |x: Vec3, of: &[Vec3]| of.iter().map(|y| norm(minus(x, *y))).fold(f64::INFINITY, f64::min);
            let what = format!("{} {}, {} points, {filter:?}", options.backend, options.precision, cloud.len());
            assert_eq!(found.count as usize, places.len(), "{what}");
            let sum: f64 = places.iter().map(|x| least(*x, cloud)).sum();
            within(&what, (found.distance - sum).abs() / sum.max(1e-12), 1e-6);
            for (point, nearest) in cloud.iter().zip(&found.nearest) {
                let Some(nearest) = nearest else {
                    assert!(places.is_empty(), "{what}: nothing near {point:?}");
                    continue;
                };
                let away = least(*point, &places);
                assert!((nearest.distance(*point) - away).abs() < 1e-6 * away + 1e-12, "{what}: {point:?}");
            }
        }
    }
}

/// Runs a scene in a folder up to a step, from the start or on from where it was.
fn recorded(text: &str, backend: &str, threads: usize, out: &Path, step: u64) -> String {
    let options = Options { threads, backend: backend.to_owned(), ..options(Precision::F32) };
    let snapshot = out.join("snapshot.barchan");
    let (existing, mut s) = match snapshot.is_file() {
        true => (Existing::Resume, Simulation::resume(&barchan::registry(), &snapshot, &options).unwrap()),
        false => (Existing::Refuse, start(text, &options)),
    };
    let request =
        Request { out: out.to_owned(), until: Until::Step(step), pictures: false, export: None, existing, swap: None };
    run(&mut s, &request, &mut |_| ControlFlow::Continue(())).unwrap_or_else(|e| panic!("{e}"));
    std::fs::read_to_string(out.join("probes.csv")).unwrap()
}

/// Probes with several intervals write the same bits with any number of threads, and where a run was cut in two; the summary holds what the table does.
#[test]
fn a_table_of_probes_has_the_same_bits_however_it_was_run() {
    let probes = "[[probe]]\nname = \"sunk\"\ninterval = 2e-3\nflux = { rectangle = { min = [0, 0, 0.1], max = [0.8, 0.8, 0.1] } }\n\
                  [[probe]]\nname = \"lower\"\nwithin = { box = { min = [0, 0, 0], max = [0.8, 0.8, 0.1] } }\n\
                  [[probe]]\nname = \"ground\"\ninterval = 4e-3\nsurface = { patch = { min = [0.2, 0.2], max = [0.6, 0.6], points = [8, 8] } }\n";
    let wall = "[[probe]]\nname = \"floor\"\ninterval = 2e-3\nwall = { side = \"z_min\" }\n";
    for (backend, more) in [("cpu", wall), ("wgpu", "")] {
        let folder = tempfile::tempdir().unwrap();
        let text = format!("{}[output]\ninterval = 3e-3\n{probes}{more}", nested(""));
        let go = |out: &str, threads, step| recorded(&text, backend, threads, &folder.path().join(out), step);
        let whole = go("whole", 1, 40);
        go("parts", 2, 17);
        let parts = go("parts", 2, 40);
        assert!(whole.lines().count() > 5, "{whole}");
        assert_eq!(whole, parts, "{backend}");
        let summary = std::fs::read_to_string(folder.path().join("parts/summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
        let header: Vec<&str> = whole.lines().next().unwrap().split(',').collect();
        let at = header.iter().position(|name| *name == "sunk mass back [kg]").unwrap();
        let values = whole.lines().skip(1).filter_map(|line| line.split(',').nth(at)?.parse::<f64>().ok());
        let last = values.last().unwrap();
        assert!(last > 0.0, "nothing has sunk");
        assert_eq!(summary["probes"]["sunk"]["mass back [kg]"]["last"].as_f64(), Some(last));
    }
}

/// A probe that cannot be meant is an error that says where and what would mend it.
#[test]
fn a_probe_that_cannot_be_meant_is_refused() {
    let cases = [
        ("level = 0", ["probe[0]", "measures nothing", "give one of flux"]),
        ("within = { sphere = { center = [0, 0, 0], radius = 0 } }", ["within.sphere.radius", "is 0", "above 0"]),
        (
            "within = { box = { min = [0, 0, 0], max = [0, 1, 1] } }",
            ["within.box.max", "x goes from 0 to 0", "above min"],
        ),
        (
            "flux = { rectangle = { min = [0, 0, 0], max = [1, 1, 1] } }",
            ["flux.rectangle", "0 of its sides have no length", "equal along one axis"],
        ),
        (
            "flux = { disc = { center = [0, 0, 0], normal = [0, 0, 0], radius = 1 } }",
            ["disc.normal", "is zero", "forwards"],
        ),
        ("wall = { side = \"z_max\" }", ["wall.side", "there is no wall", "world.walls"]),
        ("nearest = [0, 0, 0]\nbody = \"stone\"", ["probe[0].body", "stone", "bed"]),
        ("nearest = [0, 0, 0]\nlevel = 7", ["probe[0].level", "is 7", "0, the finest"]),
        ("surface = { points = [] }", ["probe[0].surface", "has 0 points", "1 to 256"]),
        ("surface = { points = [[0, 0]] }\nlevel = 0", ["probe[0]", "surfaces and walls feel all", "leave out"]),
    ];
    for (probe, parts) in cases {
        let text = format!("{}[[probe]]\nname = \"p\"\n{probe}\n", nested(""));
        let error = barchan::Scene::from_str(&text, "test scene", Path::new(".")).unwrap_err().to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{probe}: {error}");
    }
}

/// A scene without sections and walls to look at has the stages that it had, and one with probes of other kinds too: these look between steps only.
#[test]
fn only_flux_and_walls_add_to_a_step() {
    let stages = |probe: Option<Probe>| {
        let mut scene = scene(&nested(""));
        scene.probe.extend(probe);
        let s = Simulation::new(&barchan::registry(), &scene, &options(Precision::F32)).unwrap();
        let effects = s.plan().effects.iter().filter(|effect| effect.name.starts_with("probe")).count();
        (s.plan().schedule.stages().into_iter().map(|stage| stage.to_string()).collect::<Vec<_>>(), effects)
    };
    let named = |probe: Probe| Some(Probe { name: "p".to_owned(), ..probe });
    let (bare, none) = stages(None);
    let region = Region::Sphere { center: [0.4; 3], radius: 0.1 };
    let (region, one) = stages(named(Probe { within: Some(region), ..Probe::default() }));
    let surface = SurfaceProbe::Points(vec![[0.4, 0.4]]);
    let (surface, _) = stages(named(Probe { surface: Some(surface), ..Probe::default() }));
    assert_eq!((&bare, &bare), (&region, &surface));
    assert_eq!((none, one), (0, 1), "the plan tells of probes");
    let section = Section::Rectangle { min: [0.0; 3], max: [1.0, 1.0, 0.0] };
    let (flux, _) = stages(named(Probe { flux: Some(section), ..Probe::default() }));
    let more: Vec<_> = flux.into_iter().filter(|stage| !bare.contains(stage)).collect();
    assert_eq!(more, ["sides", "flux"]);
}

/// The scene of docs/probes.md runs, and what its probes find is plausible: sand falls through the disc onto the bed, and the floor bears both.
#[test]
fn the_scene_of_the_documentation_measures_what_it_says() {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/probes.md")).unwrap();
    let scene = text.split("```toml").nth(1).and_then(|rest| rest.split("```").next()).expect("it shows a scene");
    let mut s = simulation(scene, Precision::F32);
    run_to(&mut s, 0.3);
    let drop = 0.08 * 0.08 * 0.12 * 1500.0;
    within("what has fallen", (value(&s, "falls", "mass [kg]") / drop - 1.0).abs(), 0.02);
    let heap = value(&s, "heap", "greatest [m]");
    assert!((0.07..0.17).contains(&heap), "the heap is {heap} m high");
    assert!(value(&s, "floor", "impulse z [N s]") < 0.0 && value(&s, "below", "pressure [Pa]") > 0.0);
    assert_eq!(s.probes(|_| true).unwrap().len(), 5);
}
