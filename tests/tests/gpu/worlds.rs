//! Worlds of a batch: each is the world alone, bit for bit, whatever the others do.

use super::{dropped, eased, followed, left, on_gpu, passes_of, patch, take, with_currents};
use barchan::scene::{CouplingSpec, Leaving, OverBound, Robot, Scene, Shape, Time};
use barchan::worlds::Worlds;
use barchan::{Ledger, Simulation};
use barchan_tests::scenes::{alter, drive_blade, norm, robot_meets_ball, scene};
use barchan_tests::sketch::{Head, block, box_mesh, half, material, tool};
use std::path::Path;

/// The patch with a blade that is a height field.
fn bumpy(world: u64) -> Scene {
    let mut scene = patch(world);
    let heights = vec![vec![0.06, 0.05], vec![0.05, 0.06]];
    scene.tool[0].shape =
        Shape::HeightField { min: [-0.06, -0.08], max: [0.06, 0.08], bottom: -0.06, heights, file: None };
    scene
}

/// The patch in a slow current, whose law the host applies, so that the blade's runs there, too.
fn dragged(world: u64) -> Scene {
    let parameters = toml::from_str("rate = 0.5\nvelocity = [0.2, 0, 0]\nhost = true").unwrap();
    let current = CouplingSpec { kind: barchan_seam_coupling::CURRENT.into(), name: None, parameters };
    Scene { coupling: vec![current], ..patch(world) }
}

/// Symptom guarded against: sums, sorts or tools that worlds of a batch share. Worlds that are sorted at other times, of which one is reset in
/// the middle, are what they are alone, although alone they take their steps one by one: with driven tools, whose law runs on the device, also
/// under gravity that grows, with bodies that move freely, with height fields, and with a law that runs on the host.
#[test]
fn a_world_of_a_batch_is_the_world_alone_bit_for_bit() {
    const AT_ONCE: usize = 12;
    let registry = with_currents();
    for scene in [patch, eased, dropped, bumpy, dragged] {
        let mut worlds = Worlds::new(&registry, (0..4).map(scene).collect(), &on_gpu()).unwrap();
        assert!(worlds.are_together());
        let mut wrenches = vec![Vec::new(); 4];
        for round in 0..5 {
            (0..4).for_each(|w| drive_blade(worlds.world_mut(w), w));
            for (w, reports) in worlds.steps(AT_ONCE).into_iter().enumerate() {
                let reports = reports.unwrap_or_else(|e| panic!("world {w}: {e}"));
                assert_eq!(reports.len(), AT_ONCE);
                wrenches[w].extend(reports.into_iter().map(|report| report.wrenches));
            }
            if round == 1 {
                worlds.reset(2, None).unwrap();
                wrenches[2].clear();
            }
        }
        let ends: Vec<_> = worlds.iter().map(left).collect();
        for (w, end) in ends.iter().enumerate() {
            let mut alone = Simulation::new(&registry, &scene(w as u64), &on_gpu()).unwrap();
            let mut felt = Vec::new();
            for step in 0..if w == 2 { 36 } else { 60 } {
                if step % AT_ONCE == 0 {
                    drive_blade(&mut alone, w);
                }
                felt.push(alone.step().unwrap().wrenches);
            }
            assert!(felt == wrenches[w], "the blade of world {w} feels something else alone");
            assert!(alone.wrenches().iter().all(|wrench| norm(wrench.force) > 0.0), "world {w} touches nothing");
            assert!(*end == left(&alone), "world {w} is not itself alone");
            assert!(ends[..w].iter().all(|other| other != end), "worlds differ");
        }
    }
}

/// The patch with a second driven tool.
fn paired(world: u64) -> Scene {
    let mut scene = patch(world);
    let mut other = scene.tool[0].clone();
    other.name = "other".into();
    other.position[0] = 0.4;
    scene.tool.push(other);
    scene
}

/// The patch with a cube that drops, and nothing else.
fn with_cube_alone(world: u64) -> Scene {
    let mut scene = without_growth(world);
    scene.tool.remove(0);
    scene
}

/// Worlds whose bodies are of different kinds step together: driven ones, whose law runs on the device, beside one that moves freely, a current, more
/// tools and none at all. Each is what it is alone, bit for bit. Free tools beside others are solved in another way, which all worlds have or none.
#[test]
fn worlds_with_bodies_of_all_kinds_step_together() {
    let bare = |world: u64| Scene { tool: Vec::new(), ..patch(world) };
    let scenes = [patch(0), with_cube_alone(1), dragged(2), bare(3), paired(1), patch(4)];
    let registry = with_currents();
    let mixed = [patch(0), without_growth(1)].to_vec();
    let error = Worlds::new(&registry, mixed, &on_gpu()).unwrap_err().to_string();
    assert!(error.contains("kinds of their tools") && error.contains("in batches of their own"), "{error}");
    let act = |sim: &mut Simulation, w: usize| {
        if sim.bodies().iter().any(|body| body.name == "blade") {
            drive_blade(sim, w);
        }
    };
    let mut worlds = Worlds::new(&registry, scenes.to_vec(), &on_gpu()).unwrap();
    for round in 0..24 {
        if round % 8 == 0 {
            (0..scenes.len()).for_each(|w| act(worlds.world_mut(w), w));
        }
        let reports = worlds.step();
        assert!(reports.iter().all(|report| report.is_ok()), "{reports:?}");
        if round == 11 {
            // A world may come back with bodies of another kind.
            worlds.reset(5, Some(with_cube_alone(2))).unwrap();
            worlds.reset(2, Some(patch(3))).unwrap();
            act(worlds.world_mut(2), 2);
            act(worlds.world_mut(5), 5);
        }
    }
    for (w, scene) in scenes.iter().enumerate() {
        let (scene, steps) = match w {
            2 => (patch(3), 12),
            5 => (with_cube_alone(2), 12),
            _ => (scene.clone(), 24),
        };
        let mut alone = Simulation::new(&registry, &scene, &on_gpu()).unwrap();
        for step in 24 - steps..24 {
            if step % 8 == 0 || step == 24 - steps {
                act(&mut alone, w);
            }
            take(&mut alone, 1);
        }
        assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
        assert!(w == 3 || alone.wrenches().iter().any(|wrench| norm(wrench.force) > 0.0), "world {w} touches nothing");
    }
}

/// The patch with a robot that comes down on it, a cube that drops beside it, and the blade that an agent drives.
fn walked(world: u64) -> Scene {
    let robot = scene(&robot_meets_ball(-0.5, 0.1)).robot.swap_remove(0);
    let mut scene = without_growth(world);
    scene.robot.push(Robot { position: [0.3, 0.2, 0.55], ..robot });
    scene
}

/// The patch with a cube that drops beside the blade.
fn without_growth(world: u64) -> Scene {
    Scene { gravity_ramp: 0.0, ..dropped(world) }
}

/// The patch with a blade that is a mesh.
fn meshed(world: u64, folder: &Path) -> Scene {
    let file = box_mesh(folder, [0.06 + 0.005 * world as f64, 0.08, 0.06]);
    let kept = folder.join(format!("box{world}.obj"));
    std::fs::rename(file, &kept).unwrap();
    let mut scene = patch(world);
    scene.tool[0].shape = toml::from_str(&format!("mesh = {{ file = {kept:?} }}")).unwrap();
    scene
}

/// Worlds with robots, free bodies and a driven tool, and worlds whose tools are other meshes, are what they are alone, bit for bit; also one that comes back with another mesh.
/// None of them steps on the host.
#[test]
fn worlds_with_robots_or_with_other_meshes_step_together() {
    let folder = tempfile::tempdir().unwrap();
    let meshed = |world| meshed(world, folder.path());
    let robots = [walked(0), walked(1)].to_vec();
    let meshes = [meshed(0), meshed(1), meshed(0), meshed(2)].to_vec();
    for (name, scenes, other) in [("robots", robots, walked(2)), ("meshes", meshes, meshed(3))] {
        let mut worlds = Worlds::new(&barchan::registry(), scenes.clone(), &on_gpu()).unwrap();
        for round in 0..16 {
            if round == 8 {
                worlds.reset(1, Some(other.clone())).unwrap();
            }
            if round % 8 == 0 {
                (0..scenes.len()).for_each(|w| drive_blade(worlds.world_mut(w), w));
            }
            assert!(worlds.step().iter().all(|report| report.is_ok()));
        }
        for (w, scene) in scenes.iter().enumerate() {
            let (scene, steps) = if w == 1 { (&other, 8) } else { (scene, 16) };
            let mut alone = Simulation::new(&barchan::registry(), scene, &on_gpu()).unwrap();
            for step in 0..steps {
                if step % 8 == 0 {
                    drive_blade(&mut alone, w);
                }
                take(&mut alone, 1);
            }
            assert!(left(worlds.world(w)) == left(&alone), "{name}: world {w} is not itself alone");
            assert!(
                alone.wrenches().iter().any(|wrench| norm(wrench.force) > 0.0),
                "{name}: world {w} touches nothing"
            );
            assert_eq!(passes_of(worlds.world(w), "gather"), 0, "{name}: world {w} steps on the host");
        }
    }
}

/// A block that flies, from world to world another way, or lands.
fn flight(world: usize) -> Scene {
    scene(&flight_toml(world))
}

fn flight_toml(world: usize) -> String {
    let velocity = [[0.5, 0.2, 0.0], [4.0, 0.0, 0.0], [-0.5, 0.3, -1.5]][world];
    let floor = "z_min = { separate = { friction = 0.3 } }";
    Head::cells(0.02, [12; 3], floor).time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.2"),
        block("hencky", [0.06; 3], [0.12; 3], &format!("velocity = {velocity:?}")),
    ])
}

/// Likewise, with a cube that falls on it.
fn struck(world: usize) -> Scene {
    let free = "{ free = { mass = 0.05, linear = [0.0, 0.0, -0.5] } }";
    let cube = tool("cube", [0.09, 0.09, 0.15], &half([0.025; 3]), "{ coulomb = { friction = 0.3 } }", free);
    scene(&(flight_toml(world) + &cube))
}

/// A world that fails, by what it does or by what it is given, says so and stays; the others go on as they would alone, and it can be reset.
#[test]
fn a_world_that_fails_does_not_stop_the_others() {
    [flight, struck].into_iter().for_each(others_go_on);
}

fn others_go_on(flight: fn(usize) -> Scene) {
    let registry = barchan::registry();
    let mut worlds = Worlds::new(&registry, (0..3).map(flight).collect(), &on_gpu()).unwrap();
    let (mut taken, mut errors) = ([0; 3], Vec::new());
    while taken[0] < 60 {
        for (w, reports) in worlds.steps(20).into_iter().enumerate() {
            match reports {
                Ok(reports) => taken[w] += reports.len(),
                Err(error) => errors.push((w, error.to_string())),
            }
        }
    }
    assert!(!errors.is_empty() && errors.iter().all(|(w, e)| *w == 1 && e.contains("left the world")), "{errors:?}");
    assert!(taken[0] == 60 && taken[2] == 60 && taken[1] < 60, "{taken:?}");
    assert_eq!([0, 1, 2].map(|w| worlds.world(w).step_count()), taken.map(|n| n as u64));
    for (w, steps) in taken.into_iter().enumerate() {
        let mut alone = Simulation::new(&registry, &flight(w), &on_gpu()).unwrap();
        take(&mut alone, steps);
        assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
    }

    worlds.reset(1, Some(flight(2))).unwrap();
    let mut spoilt = worlds.world(0).particles();
    spoilt.lists[0].velocity[7][2] = f64::NAN;
    worlds.world_mut(0).set_particles(spoilt).unwrap();
    let reports = worlds.step();
    let error = reports[0].as_ref().unwrap_err().to_string();
    assert!(error.contains("velocity of particle") && reports[1].is_ok() && reports[2].is_ok(), "{error}");
    assert_eq!([0, 1, 2].map(|w| worlds.world(w).step_count()), [60, 1, 61]);
    worlds.reset(0, None).unwrap();
    assert!(worlds.step().iter().all(Result::is_ok));
}

/// A world that loses particles, with and without bodies that move freely, is what it is alone, and so is one that loses none.
#[test]
fn a_world_of_a_batch_that_loses_particles_is_the_world_alone() {
    let registry = barchan::registry();
    for flight in [flight, struck] {
        for leaving in [Leaving::Delete, Leaving::Clamp] {
            let scene = |w: usize| {
                let mut scene = flight(w);
                scene.world.leaving = leaving;
                scene
            };
            let mut worlds = Worlds::new(&registry, [0, 1, 2].map(scene).to_vec(), &on_gpu()).unwrap();
            let before = worlds.world(1).particle_count();
            for _ in 0..3 {
                assert!(worlds.steps(12).into_iter().all(|reports| reports.unwrap().len() == 12));
            }
            let now = worlds.world(1).particle_count();
            assert!(now > 0 && (now < before) == (leaving == Leaving::Delete), "{now} of {before}");
            for w in 0..3 {
                let mut alone = Simulation::new(&registry, &scene(w), &on_gpu()).unwrap();
                take(&mut alone, 36);
                assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
                let lost = |l: Ledger| (l.mass, l.deleted_mass, l.gravity_impulse, l.counts);
                assert_eq!(lost(worlds.world(w).ledger()), lost(alone.ledger()));
            }
        }
    }
}

/// More worlds take no more passes; with bodies that move freely, they take one submission that is waited for a step, sorts within it.
#[test]
fn passes_do_not_grow_with_worlds() {
    for scene in [patch, dropped] {
        let passes = |count: usize| {
            let mut worlds = Worlds::new(&barchan::registry(), vec![scene(2); count], &on_gpu()).unwrap();
            let timings = |worlds: &Worlds| worlds.world(0).timings();
            let before = timings(&worlds);
            assert!(worlds.steps(44).iter().all(Result::is_ok));
            let of = |name: &str| before.iter().find(|t| t.effect == name).map_or(0, |t| t.passes);
            timings(&worlds).into_iter().map(|t| (t.passes - of(&t.effect), t.effect)).collect::<Vec<_>>()
        };
        let (one, three) = (passes(1), passes(3));
        println!("{one:?}");
        let of = |name: &str| one.iter().find(|(_, effect)| effect == name).map_or(0, |(passes, _)| *passes);
        // Where particles drift otherwise than was foreseen, the device stops, and what was written behind is in vain.
        assert!((44..=52).contains(&of("P2G")), "{one:?}");
        assert_eq!(one, three);
    }
}

/// Symptom guarded against: regions, rims or rounds of split and merge that worlds of a batch share. Worlds whose levels follow a tool, each at
/// its own pace, and of which one is reset in the middle, are what they are alone: driven through many steps at once, and with steps of each level's
/// own and a free cube in all of them or in one.
#[test]
fn a_world_on_levels_in_a_batch_is_the_world_alone_bit_for_bit() {
    const AT_ONCE: usize = 20;
    for (subcycle, cube) in [(false, false), (true, false), (false, true), (true, true)] {
        println!("subcycled: {subcycle}, with a cube: {cube}");
        let scene = |w: usize| followed(w as u64, subcycle, cube);
        let scenes = (0..3).map(scene).collect();
        let mut worlds = Worlds::new(&barchan::registry(), scenes, &on_gpu()).unwrap();
        assert!(worlds.are_together());
        let rounds = if subcycle { 2 } else { 4 };
        for round in 0..rounds {
            for (w, reports) in worlds.steps(AT_ONCE).into_iter().enumerate() {
                assert_eq!(reports.unwrap_or_else(|e| panic!("world {w}: {e}")).len(), AT_ONCE);
            }
            if round == 0 {
                worlds.reset(1, None).unwrap();
            }
        }
        let counts = worlds.world(2).ledger().counts;
        println!("{counts:?}");
        assert!(counts["particles split"] > 0 && counts["particles merged"] > 0, "{counts:?}");
        for w in 0..3 {
            let mut alone = Simulation::new(&barchan::registry(), &scene(w), &on_gpu()).unwrap();
            take(&mut alone, AT_ONCE * if w == 1 { rounds - 1 } else { rounds });
            assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
        }
    }
}

/// A world whose particles move too far within a step of several, which nothing can take back, says so; the others go on.
#[test]
fn a_world_that_is_too_fast_within_its_steps_does_not_stop_the_others() {
    for cube in [false, true] {
        let scenes = (0..2).map(|w| Scene {
            time: Time { over_bound: OverBound::Allow, ..followed(w, true, cube).time },
            ..followed(w, true, cube)
        });
        let scenes: Vec<_> = scenes.collect();
        let mut worlds = Worlds::new(&barchan::registry(), scenes.clone(), &on_gpu()).unwrap();
        alter(worlds.world_mut(1), |r| r.v = [0.0, 0.0, 40.0]);
        for _ in 0..2 {
            let reports = worlds.step();
            let error = reports[1].as_ref().unwrap_err().to_string();
            assert!(reports[0].is_ok() && error.contains("within a subcycled step"), "{error}");
        }
        assert_eq!([0, 1].map(|w| worlds.world(w).step_count()), [2, 0]);
        worlds.reset(1, None).unwrap();
        assert!(worlds.step().iter().all(Result::is_ok));
        let mut alone = Simulation::new(&barchan::registry(), &scenes[0], &on_gpu()).unwrap();
        take(&mut alone, 3);
        assert!(left(worlds.world(0)) == left(&alone), "world 0 is not itself alone");
    }
}

/// What worlds must share to be batched is said by name.
#[test]
fn worlds_that_cannot_be_batched_are_refused_by_name() {
    let refused =
        |scenes: Vec<Scene>| Worlds::new(&barchan::registry(), scenes, &on_gpu()).map(drop).unwrap_err().to_string();
    let mut other = flight(0);
    other.gravity[0] = 1.0;
    let error = refused(vec![flight(0), other]);
    assert!(error.contains("gravity") && error.contains("world 1") && error.contains("cpu"), "{error}");
    let mut other = flight(0);
    other.world.max[0] += 0.08;
    let error = refused(vec![flight(0), other]);
    assert!(error.contains("extent") && error.contains("world 1"), "{error}");
    let error = refused(vec![followed(0, false, false), followed(1, true, false)]);
    assert!(error.contains("levels.subcycle") && error.contains("world 1"), "{error}");
    // The law of their tools would be another text there than alone.
    let folder = tempfile::tempdir().unwrap();
    for other in [walked(1), meshed(1, folder.path())] {
        let error = refused(vec![patch(0), other.clone()]);
        assert!(error.contains("tools and robots") && error.contains("world 1"), "{error}");
        let mut worlds = Worlds::new(&barchan::registry(), vec![patch(0), patch(1)], &on_gpu()).unwrap();
        let error = worlds.reset(0, Some(other)).unwrap_err().to_string();
        assert!(error.contains("tools and robots") && error.contains("world 0"), "{error}");
        assert!(worlds.step().iter().all(|report| report.is_ok()), "the batch is as it was");
    }
}
