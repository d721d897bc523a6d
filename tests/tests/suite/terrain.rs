//! Ground whose surface is a function of place, and ground of several materials.

use barchan::picture::Image;
use barchan::probe::Filter;
use barchan::scene::Shape;
use barchan::{Ledger, Options, Precision, Scene, Simulation, Vec3};
use barchan_tests::scenes::{options, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, body, material, tool};

/// Cell width [m].
const CELL: f64 = 0.04;
const WALLS: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
const SAND: &str = "young_modulus = 3e5, friction_angle_deg = 35.0";
const DUNES: &str = "dunes = { wavelength = 1.6, height = 0.12, wind_deg = 20.0, lee_deg = 20.0, seed = 3 }";

/// A terrain over a rectangle from a floor at z = 0, its origin in the middle at a height.
fn terrain([min, max]: [[f64; 2]; 2], height: f64, surface: &str) -> String {
    let middle = [0, 1].map(|d| 0.5 * (min[d] + max[d]));
    format!(
        "terrain = {{ min = {min:?}, max = {max:?}, bottom = 0.0, origin = [{:?}, {:?}, {height:?}], surface = {surface} }}",
        middle[0], middle[1]
    )
}

/// A bed of sand 1.28 m square under a surface.
fn bed(surface: &str, more: &str) -> String {
    let head = Head::cells(CELL, [32, 32, 24], WALLS);
    head.with(&[material("sand", 1600.0, SAND), body("sand", &terrain([[0.0; 2], [1.28; 2]], 0.3, surface), more)])
}

fn counted(ledger: &Ledger, name: &str) -> u64 {
    ledger.counts.get(name).copied().unwrap_or(0)
}

/// Physics: the ground of a terrain is what lies below its surface, and all of it. The volume under dunes and bumps is known from the
/// surface itself, that under planes and stairs in closed form.
#[test]
fn particles_fill_a_terrain_up_to_its_surface() {
    for (surface, volume) in [
        ("\"flat\"", Some(1.28 * 1.28 * 0.3)),
        ("{ slope = { slope_deg = 10.0, direction_deg = 30.0 } }", Some(1.28 * 1.28 * 0.3)),
        (&*format!("{{ {DUNES} }}"), None),
        ("{ bumps = { wavelength = 0.4, height = 0.1, seed = 2 } }", None),
        // Six steps of 5 cm, a tenth of a metre each, from the middle on.
        (
            "{ stairs = { run = 0.1, rise = 0.05, count = 6, direction_deg = 90.0 } }",
            Some(1.28 * (1.28 * 0.3 + 0.1 * 0.05 * (1.0 + 2.0 + 3.0 + 4.0 + 5.0) + 0.14 * 0.3)),
        ),
    ] {
        let s = simulation(&bed(surface, ""), Precision::F64);
        let shape = &s.plan().scene.body[0].shape;
        let Shape::Terrain(terrain) = shape else { panic!("{shape:?}") };
        let heights = terrain.heights();
        let all = rows(&s);
        let above = all.iter().map(|r| r.x[2] - heights.at(r.x[0], r.x[1])).fold(f64::NEG_INFINITY, f64::max);
        assert!(above <= 1e-9, "{surface}: a particle is {above} m above the surface");
        let side = 1.28 / 256.0;
        let under =
            |k: u32| heights.at((f64::from(k % 256) + 0.5) * side, (f64::from(k / 256) + 0.5) * side) * side * side;
        let integral: f64 = (0..256 * 256).map(under).sum();
        let filled: f64 = all.iter().map(|r| r.m / 1600.0).sum();
        within(&format!("{surface}: volume of particles"), (filled / integral - 1.0).abs(), 0.01);
        if let Some(volume) = volume {
            within(&format!("{surface}: volume under the surface"), (integral / volume - 1.0).abs(), 0.005);
        }
    }
}

/// Symptom: dunes flow apart as soon as they are there. Physics: below the angle of repose sand rests, settled or not; what is not
/// settled sinks under its weight and no more.
#[test]
fn dunes_below_the_angle_of_repose_rest() {
    let mut s = simulation(&bed(&format!("{{ {DUNES} }}"), "settled = true"), Precision::F32);
    let before: Vec<_> = rows(&s).iter().map(|r| r.x).collect();
    run_to(&mut s, 0.5);
    let moved =
        rows(&s).into_iter().zip(&before).map(|(r, x)| (0..3).map(|d| (r.x[d] - x[d]).powi(2)).sum::<f64>().sqrt());
    within("way of sand in dunes that nobody touches [cells]", moved.fold(0f64, f64::max) / CELL, 0.25);
}

/// Slopes that cannot rest are no error, but the plan says so.
#[test]
fn the_plan_warns_of_slopes_that_slide() {
    let plan = |surface: &str| simulation(&bed(surface, ""), Precision::F32).plan().to_string();
    assert!(!plan(&format!("{{ {DUNES} }}")).contains("deg steep"));
    let steep = plan("{ slope = { slope_deg = 36.0 } }");
    assert!(steep.contains("body[0]: its surface is up to 36.0 deg steep") && steep.contains("35.0 deg"), "{steep}");
}

/// A tool that flies over dunes without end, within reach of 4 coarse cells.
fn flight(levels: &str) -> String {
    let head = Head {
        min: [-40.96, -40.96, 0.0],
        max: [40.96, 40.96, 1.28],
        ..Head::cells(CELL, [0; 3], "z_min = \"stick\"")
    };
    head.time("safety = 0.5").with(&[
        material("sand", 1600.0, SAND),
        body("sand", &terrain([[-40.96; 2], [40.96; 2]], 0.3, &format!("{{ {DUNES} }}")), "settled = true"),
        levels.to_owned(),
        tool(
            "eye",
            [0.0, 0.0, 0.6],
            "sphere = { radius = 0.05 }",
            "\"slip\"",
            "{ velocity = { linear = [6.0, 2.0, 0.0] } }",
        ),
    ])
}

/// Dunes have no end: ground comes in from the function as an agent flies on, rests, is given back as it was, and its memory does not grow.
#[test]
fn dunes_without_end_come_and_go_with_an_agent() {
    let mut s = simulation(&flight("[levels]\ncount = 3\nhalf = 8\nreach = 4\n"), Precision::F32);
    let (start, particles) = (s.ledger(), s.particle_count());
    let mut fastest = 0f64;
    while s.time() < 0.6 {
        (0..20).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        fastest = rows(&s).iter().flat_map(|r| r.v).fold(fastest, |most, v| most.max(v.abs()));
    }
    let end = s.ledger();
    println!("{particles} particles, then {}: fastest {fastest:.2e} m/s, {:?}", s.particle_count(), end.counts);
    assert!(counted(&end, "tiles brought in from the terrain") > 10, "{:?}", end.counts);
    within("speed of dunes that nobody touches [m/s]", fastest, 0.1);
    within("mass less what came in, change", ((end.mass - end.seeded_mass) / start.mass - 1.0).abs(), 1e-6);
    let (kept, dropped) =
        (counted(&end, "tiles archived") as f64, counted(&end, "tiles given back to the terrain") as f64);
    // Slopes come in without shear, and some yield as they take it up: their history has changed.
    within("part of untouched tiles that is archived", kept / (kept + dropped), 0.5);
}

/// Heights and distances to points near an agent, and of ground that lies in the archive, on a device are those of the same particles on a processor.
#[test]
fn heights_on_a_device_are_those_on_a_processor_in_the_archive_too() {
    let flight = flight("[levels]\ncount = 2\nhalf = 8\nreach = 4\n");
    let options = |backend: &str, precision| Options { backend: backend.to_owned(), ..options(precision) };
    let mut s = Simulation::new(&barchan::registry(), &scene(&flight), &options("wgpu", Precision::F32)).unwrap();
    while counted(&s.ledger(), "tiles in the archive now") < 4 {
        assert!(s.time() < 0.6, "no ground was archived: {:?}", s.ledger().counts);
        let next = (s.time() + 0.05).min(0.6);
        run_to(&mut s, next);
    }
    let eye = s.bodies()[0].position;
    let points = [around([eye[0], eye[1]]), around([0.0; 2])];
    let there = points.each_ref().map(|points| s.heights(points).unwrap());
    let cloud: Vec<Vec3> = points.iter().flatten().map(|[x, y]| [*x, *y, 0.31]).collect();
    let apart = s.apart(&cloud, Filter::default()).unwrap();
    s.swap(&barchan::registry(), &options("cpu", Precision::F64)).unwrap();
    for (points, there) in points.iter().zip(&there) {
        let here = s.heights(points).unwrap();
        let off = here.iter().zip(there).map(|(a, b)| (a.unwrap() - b.unwrap()).abs());
        within("heights [m]", off.fold(0.0, f64::max), 1e-6);
    }
    let here = s.apart(&cloud, Filter::default()).unwrap();
    assert_eq!(here.count, apart.count);
    within("distance of particles", (here.distance / apart.distance - 1.0).abs(), 1e-6);
    for (point, (here, there)) in cloud.iter().zip(here.nearest.iter().zip(&apart.nearest)) {
        let [here, there] = [here, there].map(|nearest| nearest.unwrap().distance(*point));
        assert!((here - there).abs() < 1e-6 * here, "nearest to {point:?}: {here} and {there} m");
    }
}

/// Symptom: a robot on dunes without end sees a floor at height 0 beyond what is live, and so does who asks for a map of them. Physics: ground that nobody has
/// touched is as high as its shape.
#[test]
fn ground_out_of_reach_is_as_high_as_its_shape() {
    let flight = flight("[levels]\ncount = 2\nhalf = 8\nreach = 4\n");
    for (backend, precision) in [("cpu", Precision::F64), ("wgpu", Precision::F32)] {
        let options = Options { backend: backend.to_owned(), ..options(precision) };
        let mut s = Simulation::new(&barchan::registry(), &scene(&flight), &options).unwrap();
        // Some ground that has been live is given back or archived, some comes.
        while counted(&s.ledger(), "tiles brought in from the terrain") < 20 {
            (0..10).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
        }
        let Shape::Terrain(terrain) = &s.plan().scene.body[0].shape else { panic!("a terrain") };
        let shape = terrain.heights();
        let points: Vec<[f64; 2]> =
            (0..900).map(|n| [n % 30, n / 30].map(|i| 2.7 * (f64::from(i) - 14.6))).chain(around([0.0; 2])).collect();
        let (heights, untouched) = (s.heights(&points).unwrap(), s.untouched_heights(&points, 0.0));
        let (mut far, mut near, mut away) = (0f64, 0f64, 0);
        for ((point, height), untouched) in points.iter().zip(heights).zip(untouched) {
            let off = (height.unwrap() - shape.at(point[0], point[1])).abs();
            if untouched.is_some() {
                (far, away) = (off.max(far), away + 1);
            } else {
                near = off.max(near);
            }
        }
        assert!(
            away > 850 && away < points.len() - 20,
            "{backend}: {away} of {} points are out of reach",
            points.len()
        );
        within(&format!("{backend}: heights out of reach [m]"), far, 1e-12);
        within(&format!("{backend}: heights within reach [cells]"), near / CELL, 1.0);
        let map = barchan::export::height_map(&s, 0.16);
        let columns = (0..map.map().heights().len()).map(|i| (map.map().at(i), map.map().heights()[i]));
        let off = columns.map(|([x, y], height)| (height - shape.at(x, y)).abs());
        within(&format!("{backend}: heights of a map [m]"), off.fold(0.0, f64::max), 0.06);
    }
}

/// 49 points about a place [m].
fn around([x, y]: [f64; 2]) -> Vec<[f64; 2]> {
    (0..49).map(|n| [x + 0.05 * f64::from(n % 7 - 3), y + 0.05 * f64::from(n / 7 - 3)]).collect()
}

/// A bed of layers by depth, snow over sand, perhaps with a block of clay in it.
fn layers(settled: bool, block: bool) -> String {
    let clay = "{ material = \"von_mises\", within = { min = [0.4, 0.4, 0.0], max = [0.8, 0.8, 0.2] } }";
    let zones = format!("zone = [{{ material = \"sand\", below = 0.12 }}, {}]", if block { clay } else { "" });
    Head::cells(CELL, [32, 32, 24], WALLS).with(&[
        material("snow", 400.0, "young_modulus = 1.4e5"),
        material("sand", 1600.0, SAND),
        material("von_mises", 1900.0, "young_modulus = 1e6"),
        body("snow", &terrain([[0.0; 2], [1.28; 2]], 0.36, "\"flat\""), &format!("settled = {settled}\n{zones}")),
    ])
}

/// Each point of the body is of one material: the zone's that comes last of those that hold there, or else its own.
#[test]
fn layers_and_boxes_hold_their_own_material() {
    let s = simulation(&layers(true, true), Precision::F64);
    let plan = s.plan().to_string();
    assert!(plan.contains("body[0].zone[0].material = \"sand\""), "{plan}");
    let particles = s.particles();
    let (mut seen, mut wrong) = ([0usize; 3], 0);
    for list in &particles.lists {
        for i in 0..list.len() {
            let [x, y, z] = list.position(i);
            let block = [x, y].iter().all(|c| (0.4..=0.8).contains(c)) && z <= 0.2;
            let expected = if block { 2 } else { usize::from(z < 0.36 - 0.12) };
            seen[expected] += 1;
            wrong += usize::from(expected != list.material as usize);
        }
    }
    println!("particles of snow, sand and clay: {seen:?}");
    assert_eq!((wrong, seen.iter().sum::<usize>()), (0, 64 * 64 * 18), "{seen:?}");
    assert!(seen.iter().all(|count| *count > 1000), "{seen:?}");
}

/// Symptom: layered ground falls into itself, or jumps up, when the run begins. Physics: each point carries the weight of all layers above it.
#[test]
fn settled_layers_carry_all_that_lies_above_them() {
    let [rest, fall] = [true, false].map(|settled| {
        let mut s = simulation(&layers(settled, false), Precision::F32);
        let mut fastest = 0f64;
        while s.time() < 0.05 {
            s.step().unwrap_or_else(|e| panic!("{e}"));
            if s.step_count().is_multiple_of(8) {
                fastest = rows(&s).iter().flat_map(|r| r.v).fold(fastest, |most, v| most.max(v.abs()));
            }
        }
        fastest
    });
    println!("{rest:.2e} m/s settled, {fall:.2e} m/s not");
    within("speed of settled layers over that of the same layers unsettled", rest / fall, 5e-3);
}

/// Layers come in from the function with an agent, too, and their mass is booked.
#[test]
fn layers_come_in_with_an_agent() {
    let zoned =
        |text: String| text.replace("settled = true", "settled = true\nzone = [{ material = \"snow\", below = 0.1 }]");
    let with_snow = |levels: &str| {
        let text = zoned(flight(levels));
        text.replace("[[body]]", &format!("{}[[body]]", material("snow", 400.0, "young_modulus = 1.4e5")))
    };
    let mut s = simulation(&with_snow("[levels]\ncount = 3\nhalf = 8\nreach = 4\n"), Precision::F32);
    let start = s.ledger();
    run_to(&mut s, 0.3);
    let end = s.ledger();
    println!("{:?}", end.counts);
    assert!(counted(&end, "tiles brought in from the terrain") > 5, "{:?}", end.counts);
    within("mass less what came in, change", ((end.mass - end.seeded_mass) / start.mass - 1.0).abs(), 1e-6);
    let by_material = |m: u32| s.particles().lists.iter().filter(|l| l.material == m).map(|l| l.len()).sum::<usize>();
    assert!(by_material(0) > 1000 && by_material(1) > 1000);
}

/// A greyscale picture says where a body is of another material: white in its upper left quarter, seen from above.
#[test]
fn a_picture_gives_parts_of_a_body_another_material() {
    let folder = tempfile::tempdir().unwrap();
    let mut picture = Image::new(8, 8, [0; 3]);
    (0..64).filter(|k| k % 8 < 4 && k / 8 < 4).for_each(|k: usize| picture.pixels_mut()[k] = [255; 3]);
    picture.write_png(&folder.path().join("map.png"), &[]).unwrap();
    picture.pixels_mut()[9] = [255, 0, 0];
    picture.write_png(&folder.path().join("red.png"), &[]).unwrap();
    let with = |file: &str| {
        let zone = "zone = [{ material = \"snow\", picture = { file = \"FILE\", min = [0.24, 0], max = [1.04, 1.28], grey = [0.5, 1] } }]";
        let text = bed("\"flat\"", &zone.replace("FILE", file));
        let mut scene = scene(&text.replace("[[body]]", &format!("{}[[body]]", material("snow", 400.0, ""))));
        scene.folder = folder.path().to_owned();
        Simulation::new(&barchan::registry(), &scene, &options(Precision::F64))
    };
    let s = with("map.png").unwrap();
    let (mut snow, mut wrong) = (0, 0);
    for list in &s.particles().lists {
        for i in 0..list.len() {
            let [x, y, _] = list.position(i);
            let white = (0.24..0.64).contains(&x) && y > 0.64;
            snow += usize::from(white);
            wrong += usize::from(white != (list.material == 1));
        }
    }
    assert_eq!((snow, wrong), (20 * 32 * 15, 0));
    let error = with("red.png").unwrap_err().to_string();
    assert!(error.contains("body[0].zone[0].picture.file") && error.contains("save it as greyscale"), "{error}");
    let error = with("none.png").unwrap_err().to_string();
    assert!(error.contains("none.png") && error.contains("No such file"), "{error}");
}

/// Snow over hard ground of the same form: a rigid terrain moved down. Physics: no snow lies in the rock, the snow rests on it, and a
/// plate that is pressed through the snow is stopped by the rock's height, not by the floor.
#[test]
fn snow_lies_on_rock_of_the_same_form() {
    let ground = terrain([[0.0; 2], [1.28; 2]], 0.4, &format!("{{ {DUNES} }}"));
    let text = Head::cells(CELL, [32, 32, 24], WALLS).with(&[
        material("snow", 400.0, "young_modulus = 1.4e5"),
        body("snow", &ground, "settled = true"),
        // The rock's lower end may not lie above the floor.
        tool("rock", [0.0, 0.0, -0.2], &ground, "{ coulomb = { friction = 0.5 } }", "\"fixed\""),
    ]);
    let mut s = simulation(&text, Precision::F32);
    let Shape::Terrain(terrain) = &s.plan().scene.body[0].shape else { panic!("no terrain") };
    let heights = terrain.heights();
    let depths = |s: &Simulation| rows(s).iter().map(|r| heights.at(r.x[0], r.x[1]) - r.x[2]).fold(0f64, f64::max);
    let start = depths(&s);
    run_to(&mut s, 0.3);
    println!("deepest snow: {start:.4} m under the surface, then {:.4} m", depths(&s));
    // The rock's crests are blunter by a sample.
    assert!(start <= 0.2 + 0.25 * CELL, "snow starts {start} m deep, and the rock is 0.2 m deep");
    within("snow sinks into rock by [cells]", (depths(&s) - 0.2) / CELL, 0.5);
}

/// Steps of rigid stairs are hard and where they are said to be: balls that are let fall on them rest on the steps.
#[test]
fn balls_come_to_rest_on_rigid_stairs() {
    let stairs = "terrain = { min = [-0.6, -0.3], max = [0.6, 0.3], bottom = -0.1, surface = \
                  { stairs = { run = 0.2, rise = 0.1, count = 2, direction_deg = 180.0 } } }";
    let cube = |name: &str, x: f64, z: f64| {
        tool(
            name,
            [x, 0.0, z],
            "box = { half = [0.04, 0.04, 0.04] }",
            "{ coulomb = { friction = 0.5 } }",
            "{ free = { mass = 1.0 } }",
        )
    };
    let head = Head { min: [-1.0, -1.0, -1.0], max: [1.0, 1.0, 1.0], ..Head::cells(CELL, [0; 3], "") };
    let text = head.time("step = 1e-3").with(&[
        tool("stairs", [0.0; 3], stairs, "{ coulomb = { friction = 0.5 } }", "\"fixed\""),
        cube("low", 0.3, 0.06),
        cube("middle", -0.1, 0.16),
        cube("high", -0.4, 0.26),
    ]);
    let mut s = simulation(&text, Precision::F64);
    run_to(&mut s, 1.0);
    for (name, height) in [("low", 0.04), ("middle", 0.14), ("high", 0.24)] {
        let bodies = s.bodies();
        let z = bodies.iter().find(|b| b.name == name).unwrap_or_else(|| panic!("{name} is gone")).position[2];
        within(&format!("cube on the {name} step, off its height [m]"), (z - height).abs(), 2e-3);
    }
}

/// What cannot be a terrain, a zone or rigid ground is refused, with the key and what would mend it.
#[test]
fn what_is_no_terrain_is_refused_by_name() {
    let whole = bed(&format!("{{ {DUNES} }}"), "zone = [{ material = \"sand\", below = 0.1 }]");
    for (from, to, key, what) in [
        ("height = 0.12", "height = 0.3", "body[0].shape.terrain.surface.dunes.height", "must be at most 0.17"),
        ("lee_deg = 20.0", "lee_deg = 80.0", "body[0].shape.terrain.surface.dunes.lee_deg", "must be from 1 to 60"),
        ("wavelength = 1.6", "wavelength = 0.0", "body[0].shape.terrain.surface.dunes.wavelength", "must be above 0"),
        ("bottom = 0.0", "bottom = 0.5", "body[0].shape.terrain.bottom", "lower bottom or raise origin"),
        ("max = [1.28, 1.28]", "max = [1.28, 0.0]", "body[0].shape.terrain.max", "max must be above min"),
        ("max = [1.28, 1.28], bottom", "max = [1.28, 2.0], bottom", "body[0].shape", "reaches out of the world"),
        (
            DUNES,
            "slope = { slope_deg = 70 }",
            "body[0].shape.terrain.surface.slope.slope_deg",
            "must be from -60 to 60",
        ),
        (
            DUNES,
            "stairs = { run = 0.1, rise = 0, count = 1 }",
            "body[0].shape.terrain.surface.stairs.rise",
            "give a height",
        ),
        (
            DUNES,
            "stairs = { run = 0.1, rise = 1, count = 0 }",
            "body[0].shape.terrain.surface.stairs.count",
            "must be from 1 to 1000",
        ),
        (DUNES, "ridges = {}", "body[0].shape.terrain.surface", "dunes"),
        ("below = 0.1", "below = -0.1", "body[0].zone[0].below", "must be 0 or above"),
        (", below = 0.1", "", "body[0].zone[0]", "give below, within, picture"),
        ("zone = [{ material = \"sand\"", "zone = [{ material = \"peat\"", "body[0].zone[0].material", "sand"),
        ("zone = ", "angular_velocity = [0, 0, 1]\nzone = ", "body[0].angular_velocity", "leave out the zones"),
        (
            "below = 0.1",
            "picture = { file = \"a.png\", min = [0, 0], max = [1, 1], grey = [0.5, 0.2] }",
            "body[0].zone[0].picture.grey",
            "from 0 for black to 1 for white",
        ),
        (
            "below = 0.1",
            "within = { min = [0, 0, 0], max = [1, 1, 0] }",
            "body[0].zone[0].within.max",
            "max must be above min",
        ),
    ] {
        assert!(whole.contains(from), "{from}");
        let error = Scene::from_str(&whole.replacen(from, to, 1), "terrain", "").unwrap_err().to_string();
        assert!(error.contains(key) && error.contains(what), "{from} -> {to}: {error}");
    }
    let empty = scene(
        &whole
            .replace("below = 0.1", "within = { min = [2, 2, 2], max = [3, 3, 3] }")
            .replace("\"sand\", within", "\"snow\", within")
            .replace("[[body]]", &format!("{}[[body]]", material("snow", 400.0, ""))),
    );
    let error = Simulation::new(&barchan::registry(), &empty, &options(Precision::F32)).unwrap_err().to_string();
    assert!(error.contains("no particles of material 'snow'"), "{error}");
    let rock = |surface: &str, motion: &str| {
        let ground = terrain([[0.0; 2], [1.28; 2]], 0.3, surface);
        bed("\"flat\"", "") + &tool("rock", [0.0; 3], &ground, "\"slip\"", motion)
    };
    let free = Scene::from_str(&rock("\"flat\"", "{ free = { mass = 1.0 } }"), "terrain", "").unwrap_err().to_string();
    assert!(free.contains("tool[0].motion.free") && free.contains("cannot move freely"), "{free}");
    for (surface, what) in [
        ("{ bumps = { wavelength = 0.01, height = 0.01 } }", "raise wavelength"),
        ("{ stairs = { run = 0.1, rise = 0.1, count = 3, direction_deg = 45 } }", "turn the tool by its rotation"),
        ("{ stairs = { run = 0.1, rise = -0.2, count = 3 } }", "lower the bottom"),
    ] {
        let scene = scene(&rock(surface, "\"fixed\""));
        let error = Simulation::new(&barchan::registry(), &scene, &options(Precision::F32)).unwrap_err().to_string();
        assert!(error.contains("tool[0].shape") && error.contains(what), "{surface}: {error}");
    }
}
