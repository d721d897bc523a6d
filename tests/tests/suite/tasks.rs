//! Benchmark tasks: rewards of states made by hand, what the hand-written agents reach, and that episodes come out
//! the same again.

use barchan::environment::Recording;
use barchan::parameter::{Given, Table};
use barchan::task::{Episode, Outcome, Seen};
use barchan::{Precision, Scene, Simulation};
use barchan_tests::scenes::options;

/// Tasks in which a tool or an arm is moved.
const ALL: [&str; 7] =
    ["SandPainting", "ScoopOut", "DigAHole", "SmoothSurface", "PressMould", "ArmScoops", "ArmWrites"];

/// A world of a task, with its scene changed, and an episode that begins in it.
fn begin(name: &str, parameters: &Table, change: impl Fn(&mut Scene)) -> (Simulation, Box<dyn Episode>) {
    let registry = barchan::registry();
    let task = registry.task(name, parameters).unwrap();
    let mut scene = task.scene(0).unwrap();
    change(&mut scene);
    let world = Simulation::new(&registry, &scene, &options(Precision::F32)).unwrap();
    let episode = task.reset(&world, 0).unwrap();
    (world, episode)
}

fn put(scene: &mut Scene, tool: &str, position: [f64; 3]) {
    scene.tool.iter_mut().find(|one| one.name == tool).unwrap().position = position;
}

fn seen(world: &Simulation, episode: &dyn Episode) -> Seen {
    world.watch(&episode.watch(world)).unwrap()
}

fn near(found: f64, wanted: f64, within: f64) {
    assert!((found - wanted).abs() < within, "{found} instead of {wanted}");
}

fn info(outcome: &Outcome, name: &str) -> f64 {
    outcome.info.iter().find(|(own, _)| *own == name).unwrap_or_else(|| panic!("no {name}")).1
}

/// L = Σ (n_t − n_{t−1}) / n_0, α = 1000: what goes gives its share of 1000, what comes back takes it again.
#[test]
fn a_heap_that_goes_is_rewarded_by_its_share() {
    let (world, mut episode) = begin("SmoothSurface-lite", &Table::new(), |_| ());
    let mut seen = seen(&world, &*episode);
    let start = seen.sums[0].count;
    assert!(start > 500, "{start} particles above the mean height");
    let mut with = |count: u64| {
        seen.sums[0].count = count;
        episode.observe(&world, &seen).unwrap()
    };
    near(with(start).reward, 0.0, 1e-12);
    let half = start / 2;
    near(with(half).reward, 1000.0 * (start - half) as f64 / start as f64, 1e-9);
    near(with(half + 10).reward, -1000.0 * 10.0 / start as f64, 1e-9);
    assert!(!with(start / 5 + 1).success);
    assert!(with(start / 5 - 1).success);
}

/// The first stage: −α |z − z_p| + β / horizon; once within a centimetre, +α (z − z_p) + β / horizon, for good. β
/// makes a still start worth nothing.
#[test]
fn a_shovel_is_rewarded_for_going_down_and_then_for_coming_up() {
    let at = |z: f64, hole: f64| {
        let (world, mut episode) = begin("DigAHole-lite", &Table::new(), |scene| put(scene, "shovel", [0.1, 0.125, z]));
        let mut seen = seen(&world, &*episode);
        seen.heights.iter_mut().for_each(|height| *height = Some(0.0875));
        seen.heights[100] = Some(0.0875 - hole);
        episode.observe(&world, &seen).unwrap()
    };
    // A metre is worth 10 in a control step, and z_p is 4.5 cm below the surface, which is found to a fraction of a
    // particle's width of 6.25 mm.
    let within = 0.02;
    let (high, low, there) = (at(0.15, 0.03), at(0.08, 0.03), at(0.05, 0.03));
    near(high.reward, 0.0, within);
    near(low.reward, 10.0 * 0.07, within);
    near(there.reward, 10.0 * (0.1075 + 0.0075), within);
    assert_eq!([&high, &low, &there].map(|outcome| info(outcome, "stage")), [1.0, 1.0, 2.0]);
    near(info(&high, "depth of the hole [m]"), 0.03, 2e-3);
    // A hole is not enough: the shovel has to have been down there.
    assert!(!high.success && !there.success);
}

/// The first stage: −α l1 + β / horizon; once within 4 cm, α (z ± 0.05 n / n_0) + β / horizon, for good.
#[test]
fn a_scooped_duck_is_rewarded_with_either_sign() {
    for (sign, worth) in [("sensible", 0.05), ("printed", -0.05)] {
        let parameters = Table::from_iter([("sign".to_owned(), Given::String(sign.to_owned()))]);
        let at = |off: f64, share: u64| {
            let shovel = [0.275 - off, 0.125, 0.07];
            let (world, mut episode) = begin("ScoopOut-lite", &parameters, |scene| put(scene, "shovel", shovel));
            let duck = world.bodies().into_iter().find(|body| body.name == "duck").unwrap().position;
            // Where the shovel is to get lies 3 cm below the duck's centre of mass.
            let apart = [duck[0] - shovel[0], duck[1] - shovel[1], duck[2] - 0.03 - shovel[2]];
            let l1 = apart.iter().map(|x| x * x).sum::<f64>().sqrt();
            let mut seen = seen(&world, &*episode);
            seen.sums[0].count = seen.sums[0].count * share / 100;
            (l1, episode.observe(&world, &seen).unwrap())
        };
        let (l1, before) = at(0.1, 100);
        near(before.reward, 10.0 * (0.2 - l1), 1e-9);
        assert_eq!(info(&before, "stage"), 1.0);
        let (l1, there) = at(0.02, 50);
        assert!(l1 < 0.04);
        let near_by = info(&there, "particles near the duck, by those at the start");
        near(near_by, 0.5, 1e-3);
        near(there.reward, 10.0 * (0.07 + worth * near_by) + 10.0 * 0.2, 1e-9);
        assert_eq!(info(&there, "stage"), 2.0);
        // It lies on the shovel, but in the sand.
        assert!(!there.success);
    }
}

/// L = Σ d, α = 1000. An untouched bed is at the distance that β stands for, and the wanted surface at none.
#[test]
fn a_drawn_heart_is_rewarded_at_every_step() {
    let (world, mut episode) = begin("SandPainting-lite", &Table::new(), |_| ());
    let mut seen = seen(&world, &*episode);
    let count = seen.heights.len() as f64;
    let untouched = episode.observe(&world, &seen).unwrap();
    let away = info(&untouched, "chamfer distance [mm]");
    near(untouched.reward, 9.4 - away, 1e-9);
    near(untouched.reward, 0.0, 0.1);
    near(info(&untouched, "chamfer distance, by that of the untouched bed"), 1.0, 1e-6);
    // A point in a corner of the world, where the wanted surface is the bed's, 2 mm higher: so far from the nearest
    // of the others, in both directions.
    seen.heights[0] = seen.heights[0].map(|height| height + 2e-3);
    let bump = episode.observe(&world, &seen).unwrap();
    near(info(&bump, "chamfer distance [mm]"), away + 2.0 * 2.0 / count, 1e-5);
}

/// L = −Σ (share_t − share_{t−1}), α = 1000, the share being that of 0.9 litres.
#[test]
fn a_mould_that_fills_is_rewarded_by_its_share() {
    let (world, mut episode) = begin("PressMould-lite", &Table::new(), |_| ());
    let mut seen = seen(&world, &*episode);
    // A third of the mould is full from the start: 10 × 10 cm of an area of 300 cm².
    near(info(&episode.observe(&world, &seen).unwrap(), "share of the mould that is full"), 1.0 / 3.0, 1e-3);
    for (sums, litres) in seen.sums.iter_mut().zip([0.45, 0.1, 0.2]) {
        sums.volume0 = 1e-3 * litres;
    }
    let outcome = episode.observe(&world, &seen).unwrap();
    near(info(&outcome, "share of the mould that is full"), 0.75 / 0.9, 1e-9);
    near(outcome.reward, 1000.0 * (0.75 / 0.9 - 1.0 / 3.0), 1.0);
    assert!(!outcome.success);
    seen.sums[1].volume0 = 1.5e-4;
    let outcome = episode.observe(&world, &seen).unwrap();
    near(outcome.reward, 1000.0 * 0.05 / 0.9, 1e-9);
    assert!(outcome.success, "0.8 of 0.9 litres");
}

/// L = Σ (left_t − left_{t−1}), α = 1000: what is left is 1 less the share of the lines that is a groove of 5 mm, plus the mean by which the rest has moved,
/// in such depths.
#[test]
fn a_written_word_is_rewarded_by_its_share_of_the_lines() {
    let parameters = Table::from_iter([("observation".to_owned(), Given::String("none".to_owned()))]);
    let (world, mut episode) = begin("ArmWrites-lite", &parameters, |_| ());
    let mut seen = seen(&world, &*episode);
    near(episode.observe(&world, &seen).unwrap().reward, 0.0, 1e-9);
    // The last points are those of the lines, and the last stroke is the foot of the L, of 6 cm.
    let count = seen.heights.len();
    let sink = |seen: &mut Seen, point: usize, by: f64| seen.heights[point] = seen.heights[point].map(|z| z - by);
    (count - 6..count).for_each(|point| sink(&mut seen, point, 0.02));
    let foot = episode.observe(&world, &seen).unwrap();
    let drawn = info(&foot, "share of the lines that is drawn");
    near(foot.reward, 1000.0 * drawn, 1e-9);
    near(drawn, 6.0 / 90.0, 0.01);
    // Half a groove counts half.
    sink(&mut seen, count - 1, -0.0175);
    let half = episode.observe(&world, &seen).unwrap();
    near(half.reward, -1000.0 * 0.5 * drawn / 6.0, 0.2);
    // What is done elsewhere takes it again.
    sink(&mut seen, 0, 0.01);
    let other = episode.observe(&world, &seen).unwrap();
    assert!(other.reward < -3.0, "{}", other.reward);
    near(info(&other, "what the rest has moved, by the groove's depth"), -other.reward / 1000.0, 1e-9);
    assert!(!other.success);
}

/// An episode of so many control steps under a task's own agent.
fn played(name: &str, steps: u64, seed: u64) -> (Recording, Outcome) {
    let mut recording = Recording { task: name.to_owned(), seed, ..Recording::default() };
    let mut environment = recording.environment(&barchan::registry(), &options(Precision::F32)).unwrap();
    let mut last = Outcome::default();
    for _ in 0..steps {
        let action = environment.heuristic(0).unwrap();
        let step = environment.step(std::slice::from_ref(&action)).unwrap().remove(0).unwrap();
        recording.add(action, &step);
        last = step.outcome;
    }
    (recording, last)
}

#[test]
fn a_heart_is_drawn() {
    let (recording, last) = played("SandPainting-lite", 450, 0);
    let left = info(&last, "chamfer distance, by that of the untouched bed");
    assert!(recording.total() > 800.0 && left < 0.5, "reward {}, {left} left", recording.total());
}

#[test]
fn a_duck_is_scooped_out() {
    let (recording, last) = played("ScoopOut-lite", 350, 0);
    assert!(recording.total() > 1000.0 && last.success, "reward {}, {last:?}", recording.total());
}

#[test]
fn a_hole_is_dug() {
    let (recording, last) = played("DigAHole-lite", 400, 0);
    assert!(recording.total() > 750.0 && last.success, "reward {}, {last:?}", recording.total());
}

#[test]
fn a_heap_is_smoothed() {
    let (recording, last) = played("SmoothSurface-lite", 450, 0);
    let left = info(&last, "share of the heap that is left");
    assert!(recording.total() > 550.0 && left < 0.45, "reward {}, {left} left", recording.total());
}

#[test]
fn a_mould_is_filled() {
    let (recording, last) = played("PressMould-lite", 150, 0);
    let full = info(&last, "share of the mould that is full");
    assert!(recording.total() > 400.0 && full > 0.75, "reward {}, {full} full", recording.total());
}

#[test]
fn an_arm_scoops_a_cube() {
    let (recording, last) = played("ArmScoops-lite", 310, 0);
    let lifted = info(&last, "height of the cube above its start [m]");
    assert!(recording.total() > 400.0 && lifted > 0.1, "reward {}, {last:?}", recording.total());
}

/// The first letter of four, and the way to the second.
#[test]
fn an_arm_writes_a_c() {
    let (recording, last) = played("ArmWrites-lite", 330, 0);
    let [drawn, stray] = ["share of the lines that is drawn", "what the rest has moved, by the groove's depth"]
        .map(|name| info(&last, name));
    println!("{drawn} drawn, {stray} astray, reward {}", recording.total());
    assert!(drawn > 0.2 && stray < 0.05 && recording.total() > 150.0, "reward {}, {last:?}", recording.total());
}

/// The same seed gives the same trajectory, bit for bit, and a recording that is played again gives its own rewards;
/// another seed draws another scene.
#[test]
fn episodes_come_out_the_same_again() {
    let registry = barchan::registry();
    for name in ALL.map(|name| format!("{name}-lite")) {
        let parameters = Table::from_iter([("randomise".to_owned(), Given::Float(1.0))]);
        let play = |seed: u64, actions: Option<&[Vec<f64>]>| {
            let mut recording =
                Recording { task: name.clone(), parameters: parameters.clone(), seed, ..Recording::default() };
            let mut environment = recording.environment(&registry, &options(Precision::F32)).unwrap();
            let mut seen = vec![environment.observation(0).to_vec()];
            for k in 0..4 {
                let action = actions.map_or_else(|| environment.heuristic(0).unwrap(), |actions| actions[k].clone());
                let step = environment.step(std::slice::from_ref(&action)).unwrap().remove(0).unwrap();
                recording.add(action, &step);
                seen.push(step.outcome.observation);
            }
            (recording, seen)
        };
        let (one, seen) = play(3, None);
        assert_eq!((&one, &seen), (&play(3, None).0, &play(3, None).1), "{name}");
        let (again, seen_again) = play(3, Some(&one.actions));
        assert_eq!((&again.rewards, &seen_again), (&one.rewards, &seen), "{name}");
        assert_ne!(play(4, None).1, seen, "{name}: another seed");
        // Both sizes see what they say, and go by the limits that they name.
        let task = registry.task(&name, &parameters).unwrap();
        let size: usize = task.observations().iter().map(|part| part.size).sum();
        assert!(seen.iter().all(|seen| seen.len() == size && seen.iter().all(|x| x.is_finite())), "{name}");
        assert_eq!(one.actions[0].len(), task.actions().len(), "{name}");
        assert!(!task.ranges().is_empty(), "{name}");
    }
}

/// A scene of one's own is played in if it has what the task needs, and refused by name if it has not.
#[test]
fn a_scene_without_the_tool_is_refused() {
    let registry = barchan::registry();
    for (name, tool) in [("DigAHole", "shovel"), ("ScoopOut", "duck")] {
        let mut scene = registry.task(&format!("{name}-lite"), &Table::new()).unwrap().scene(0).unwrap();
        scene.task = Some(barchan::scene::TaskSpec { name: format!("{name}-lite"), parameters: Table::new() });
        registry.task_of(&scene).unwrap();
        scene.tool.retain(|one| one.name != tool);
        let error = registry.task_of(&scene).unwrap_err().to_string();
        assert!(error.contains(&format!("'{tool}'")) && error.contains("[[tool]]"), "{error}");
    }
}
