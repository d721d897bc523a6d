//! Environments: many worlds of a task are what each is alone, and what is seen of them is what is there.

use barchan::environment::{Environment, Recording};
use barchan::parameter::{Given, Table};
use barchan::task::Watch;
use barchan::worlds::Worlds;
use barchan::{Aabb, Options, Precision, Scene, Simulation};
use barchan_tests::scenes::{everywhere, options, rows, within};

/// A small heap under a scraper; on two levels, the finer one around the scraper.
const SCENE: &str = r#"
name = "heap"
world = { cell = 0.02, min = [0.0, 0.0, 0.0], max = [0.64, 0.32, 0.32], walls = { x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" } }
levels = { count = 2, half = 8 }
time = { end = 1.0, step = 4e-4 }
task = { name = "SmoothSurface-lite" }

[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = { young_modulus = 2e5 }

[[body]]
name = "bed"
material = "sand"
shape = { union = [
  { shape = { box = { min = [0.0, 0.0, 0.0], max = [0.64, 0.32, 0.06] } } },
  { shape = { box = { min = [0.1, 0.1, 0.06], max = [0.2, 0.22, 0.12] } } },
] }

[[tool]]
name = "scraper"
shape = { box = { half = [0.03, 0.08, 0.04] } }
position = [0.08, 0.16, 0.15]
contact = "slip"
motion = { velocity = {} }
"#;

fn start(seeds: &[u64], options: &Options) -> Environment {
    let registry = barchan::registry();
    let scene = Scene::from_str(SCENE, "heap.toml", "").unwrap();
    let task = registry.task_of(&scene).unwrap();
    Environment::new(&registry, task, seeds, options).unwrap_or_else(|e| panic!("{e}"))
}

/// An action that differs from world to world and step to step.
fn action(seed: u64, step: u64) -> Vec<f64> {
    let turn = 0.7 * step as f64 + seed as f64;
    vec![0.003, 0.001 * turn.sin(), -0.001 * turn.cos(), 0.01 * turn.sin()]
}

/// What all worlds are looked at for together is what each is looked at for alone; sums are those over its particles, and what is sampled are particles of it, more of
/// the finer level than of the coarser one.
#[test]
fn what_is_watched_in_all_worlds_is_what_is_there() {
    for options in everywhere() {
        let seeds = [3, 4, 5];
        let mut environment = start(&seeds, &options);
        for step in 0..4 {
            let actions: Vec<_> = seeds.iter().map(|seed| action(*seed, step)).collect();
            environment.step(&actions).unwrap().into_iter().for_each(|step| drop(step.unwrap()));
        }
        let regions = [0.05, 0.08, 0.11].map(|z| barchan::scene::Region::Box { min: [0.0, 0.0, z], max: [1.0; 3] });
        // Over the heap, its slopes, ground of both levels, and beyond the world.
        let points: Vec<[f64; 2]> =
            (0..16 * 9).map(|n| [0.0437 * f64::from(n % 16), 0.0411 * f64::from(n / 16)]).collect();
        let watches: Vec<Watch> = (0..seeds.len())
            .map(|w| {
                let places = Some(Aabb { min: [0.1, 0.1, 0.06], max: [0.3; 3] });
                let watch = Watch { sample: vec![20, 10], heights: points.clone(), places, ..Watch::default() };
                // Worlds may be asked about different numbers of regions.
                regions[..=w].iter().fold(watch, |watch, region| watch.and_within(*region))
            })
            .collect();
        let all = environment.worlds_mut().watch(&watches);
        for (w, seen) in all.into_iter().enumerate() {
            let (seen, world) = (seen.unwrap(), environment.worlds().world(w));
            assert_eq!(seen, world.watch(&watches[w]).unwrap(), "world {w} on {}", options.backend);
            let particles = rows(world);
            assert_eq!(seen.sums.len(), w + 1);
            for (sums, region) in seen.sums.iter().zip(&regions) {
                let inside: Vec<_> = particles.iter().filter(|row| region.contains(row.x)).collect();
                assert_eq!(sums.count, inside.len() as u64);
                let mass: f64 = inside.iter().map(|row| row.m).sum();
                assert!((sums.mass - mass).abs() < 1e-6 * mass, "{} of {mass} kg", sums.mass);
            }
            assert_eq!(seen.sample.len(), 30);
            for (k, sampled) in seen.sample.iter().enumerate() {
                let same = particles.iter().find(|row| row.x == sampled.position && row.v == sampled.velocity);
                let row = same.unwrap_or_else(|| panic!("{sampled:?} is no particle of world {w}"));
                assert_eq!(row.level, u32::from(k >= 20), "{sampled:?}");
            }
            let mut places: Vec<_> = seen.sample.iter().map(|sampled| sampled.position.map(f64::to_bits)).collect();
            places.sort_unstable();
            places.dedup();
            assert_eq!(places.len(), 30, "no particle is sampled twice");
            // The host finds the same heights in the same particles.
            let there = environment.worlds_mut().world_mut(w);
            there.swap(&barchan::registry(), &self::options(Precision::F64)).unwrap();
            let by_host = there.heights(&points).unwrap();
            let off = seen.heights.iter().zip(by_host).map(|(a, b)| (a.unwrap() - b.unwrap()).abs());
            within(&format!("heights on {} [m]", options.backend), off.fold(0.0, f64::max), 1e-6);
            let mean = seen.heights.iter().flatten().sum::<f64>() / points.len() as f64;
            assert!(mean > 0.03, "{mean}");
        }
    }
}

/// Heights of soft ground in all worlds are those of each, at points of its own; a fixed tool is ground only for those who watch.
#[test]
fn heights_in_all_worlds_are_those_of_soft_ground() {
    let fixed =
        SCENE.replace("motion = { velocity = {} }\n", "").replace("task = { name = \"SmoothSurface-lite\" }\n", "");
    for options in everywhere() {
        let scenes = [3, 4, 5].map(|seed| Scene { seed, ..Scene::from_str(&fixed, "heap.toml", "").unwrap() });
        let mut worlds = Worlds::new(&barchan::registry(), scenes.to_vec(), &options).unwrap();
        let points = |w: u32| (0..32).map(|n| [0.02 * f64::from(n), 0.1 + 0.02 * f64::from(w)]).collect::<Vec<_>>();
        let soft = worlds.heights((0..3).map(points).collect()).unwrap();
        let watch = |w| Watch { heights: points(w), ..Watch::default() };
        let watched = worlds.watch(&[0, 1, 2].map(watch));
        for (w, (soft, watched)) in soft.into_iter().zip(watched).enumerate() {
            assert_eq!(soft, worlds.world(w).heights(&points(w as u32)).unwrap(), "world {w} on {}", options.backend);
            let higher = soft.iter().zip(&watched.unwrap().heights).filter(|(soft, top)| top > soft).count();
            // Three points or four are above the scraper, whose top is at 0.19.
            assert!((3..=4).contains(&higher), "{higher} points on {}", options.backend);
        }
    }
}

/// Symptom: beside a wall a robot's scan saw a cliff down to the floor, where there is no world any more.
#[test]
fn beyond_the_sides_the_ground_is_as_high_as_beside_them() {
    for options in everywhere() {
        let scene = Scene::from_str(SCENE, "heap.toml", "").unwrap();
        let [min, max] = [scene.world.min, scene.world.max];
        let (inner, y) = (0.5 * scene.world.cell, 0.5 * (min[1] + max[1]));
        let simulation = Simulation::new(&barchan::registry(), &scene, &options).unwrap();
        let beside = [[min[0] + inner, y], [max[0] - inner, y], [0.5 * (min[0] + max[0]), max[1] - inner]];
        let beyond = [[min[0] - 0.3, y], [max[0] + 9.0, y], [0.5 * (min[0] + max[0]), max[1] + 0.01]];
        let [beside, beyond] = [beside, beyond].map(|points| simulation.heights(&points).unwrap());
        assert_eq!(beside, beyond, "{}", options.backend);
        assert!(beside.iter().any(|height| height.is_some_and(|height| height > min[2])), "{beside:?}");
    }
}

/// What agents see of all worlds on a device comes in one transfer a control step, and as many bytes however many particles there are.
#[test]
fn observations_of_all_worlds_come_in_one_transfer_of_few_bytes() {
    let registry = barchan::registry();
    let options = Options { backend: "wgpu".to_owned(), precision: Precision::F32, ..Options::default() };
    let parameters = Table::from_iter([("observation".to_owned(), Given::String("both".to_owned()))]);
    let transferred = |spacing: f64| {
        let mut scene = Scene::from_str(SCENE, "heap.toml", "").unwrap();
        scene.body[0].spacing = Some(spacing);
        scene.levels.count = 1;
        scene.task.as_mut().unwrap().parameters = parameters.clone();
        let task = registry.task_of(&scene).unwrap();
        let mut environment = Environment::new(&registry, task, &[1, 2, 3], &options).unwrap();
        let particles = environment.worlds().world(0).particle_count();
        let count = |environment: &Environment| environment.worlds().world(0).transferred();
        let before = count(&environment);
        for step in 0..2 {
            let actions = [1, 2, 3].map(|seed| action(seed, step));
            environment.step(&actions).unwrap().into_iter().for_each(|step| drop(step.unwrap()));
        }
        let stepped = count(&environment);
        let watch = Watch { sample: vec![200], heights: vec![[0.15, 0.16]; 256], ..Watch::default() };
        let watch = watch.and_within(barchan::scene::Region::Sphere { center: [0.1; 3], radius: 0.1 });
        environment
            .worlds_mut()
            .watch(&[watch.clone(), watch.clone(), watch])
            .into_iter()
            .for_each(|seen| drop(seen.unwrap()));
        let looked = count(&environment);
        let since = |after: (u64, u64), before: (u64, u64)| [after.0 - before.0, after.1 - before.1];
        (particles, since(stepped, before), since(looked, stepped))
    };
    let (few, many) = (transferred(0.01), transferred(0.0066));
    println!("particles; transfers and bytes of two steps, and of a look: {few:?} and {many:?}");
    assert!(many.0 > 3 * few.0);
    assert_eq!((few.1, few.2), (many.1, many.2));
    assert_eq!(few.2[0], 1);
    assert!(few.2[1] < 3 * 20_000, "{} bytes", few.2[1]);
}

/// A world among others is the world that it is alone, with all that its agent sees and gets; and an episode that begins again with its seed goes as it went, whether its
/// start was kept or is made anew.
#[test]
fn worlds_are_those_alone_and_episodes_can_begin_again() {
    for options in everywhere() {
        let play = |environment: &mut Environment, seeds: &[u64]| -> Vec<(Vec<f64>, f64)> {
            let mut all = Vec::new();
            for step in 0..3 {
                let actions: Vec<_> = seeds.iter().map(|seed| action(*seed, step)).collect();
                let steps = environment.step(&actions).unwrap();
                all.extend(
                    steps.into_iter().map(|step| step.unwrap()).map(|step| (step.observation.clone(), step.reward)),
                );
            }
            all
        };
        let mut together = start(&[1, 2], &options);
        let first = play(&mut together, &[1, 2]);
        for (w, seed) in [1, 2].into_iter().enumerate() {
            let alone = play(&mut start(&[seed], &options), &[seed]);
            let own: Vec<_> = first.iter().skip(w).step_by(2).cloned().collect();
            assert_eq!(alone, own, "seed {seed} on {} {}", options.backend, options.precision);
        }
        for _ in 0..3 {
            together.reset(&[(0, 1), (1, 2)]).unwrap();
            assert_eq!(together.steps_taken(0), 0);
            assert_eq!(play(&mut together, &[1, 2]), first, "{} {}", options.backend, options.precision);
        }
        // Another seed, and back.
        together.reset(&[(0, 7)]).unwrap();
        together.reset(&[(1, 2), (0, 1)]).unwrap();
        assert_eq!(play(&mut together, &[1, 2]), first);
    }
}

/// A recorded episode that is read back and played again earns the same rewards; what is no episode is refused with the file's name.
#[test]
fn a_recorded_episode_is_played_again() {
    let registry = barchan::registry();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("episode.json");
    let parameters = Table::from_iter([("randomise".to_owned(), Given::Float(1.0))]);
    let mut recording =
        Recording { task: "SmoothSurface-lite".to_owned(), parameters, seed: 5, ..Recording::default() };
    let options = options(Precision::F32);
    let mut environment = recording.environment(&registry, &options).unwrap();
    for step in 0..2 {
        let taken = environment.step(&[action(5, step)]).unwrap().remove(0).unwrap();
        recording.add(action(5, step), &taken);
    }
    recording.write(&file).unwrap();
    let read = Recording::read(&file).unwrap();
    assert_eq!(read, recording);
    let mut again = read.environment(&registry, &options).unwrap();
    for (action, reward) in read.actions.iter().zip(&read.rewards) {
        assert_eq!(again.step(std::slice::from_ref(action)).unwrap().remove(0).unwrap().reward, *reward);
    }
    std::fs::write(&file, "{ \"task\": 3 }").unwrap();
    let error = Recording::read(&file).unwrap_err().to_string();
    assert!(error.contains("episode.json") && error.contains("invalid type"), "{error}");
}

/// A scene of one's own may be played by the path of its file; parameters take the place of those of its task, and an episode's file finds it again.
#[test]
fn a_scene_of_ones_own_is_played_by_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("heap.toml");
    std::fs::write(&file, SCENE).unwrap();
    let (registry, path, options) = (barchan::registry(), file.to_str().unwrap(), Options::default());
    let own = barchan::environment::task(&registry, path, &Table::new()).unwrap();
    assert_eq!(own.scene(0).unwrap().name, Scene::from_file(&file).unwrap().name);
    let both = Table::from_iter([("observation".to_owned(), Given::String("both".to_owned()))]);
    let seen = |task: Box<dyn barchan::Task>| task.observations().iter().map(|part| part.size).sum::<usize>();
    assert!(seen(barchan::environment::task(&registry, path, &both).unwrap()) > seen(own));
    let recording = Recording { task: path.to_owned(), seed: 3, ..Recording::default() };
    let mut played = recording.environment(&registry, &options).unwrap();
    let mut by_hand = start(&[3], &options);
    let one = |environment: &mut Environment| environment.step(&[action(3, 0)]).unwrap().remove(0).unwrap();
    assert_eq!(one(&mut played), one(&mut by_hand));
    let drawn = Table::from_iter([("randomise".to_owned(), Given::Float(1.0))]);
    let error = barchan::environment::task(&registry, path, &drawn).unwrap_err().to_string();
    assert!(error.contains("task.parameters.randomise") && error.contains("draws nothing"), "{error}");
    let error = barchan::environment::task(&registry, "there/is/none.toml", &both).unwrap_err().to_string();
    assert!(error.contains("none.toml"), "{error}");
}
