//! Tasks of robots on legs: their rewards, their hand-written agents, and how an episode ends.

use barchan::environment::{Environment, Step};
use barchan::parameter::{Given, Table};
use barchan::{Options, Scene};

fn options() -> Options {
    Options { threads: 2, ..Options::default() }
}

/// A world of a task as it comes, with parameters.
fn environment(name: &str, parameters: &[(&str, Given)], seeds: &[u64]) -> Environment {
    let registry = barchan::registry();
    let parameters: Table = parameters.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect();
    Environment::new(&registry, registry.task(name, &parameters).unwrap(), seeds, &options()).unwrap()
}

/// A robot in empty space, without gravity: it keeps its velocity.
fn in_space(task: &str, model: &str, robot: &str) -> Environment {
    let gait = match model {
        "quadruped" => {
            "[robot.motion.gait]\nfeet = { FL_foot = 0.0, RR_foot = 0.0, FR_foot = 0.5, RL_foot = 0.5 }\nperiod = 0.4\nstride = [0.2, 0.0, 0.0]\nlift = 0.05"
        }
        _ => "",
    };
    let text = format!(
        "name = \"space\"\ngravity = [0.0, 0.0, 0.0]\n[world]\ncell = 0.1\nmin = [-20.0, -20.0, -20.0]\nmax = [20.0, 20.0, 20.0]\n\
         [time]\nend = 20.0\nstep = 0.01\n[task]\nname = \"{task}\"\n[[robot]]\nname = \"it\"\nmodel = \"{model}\"\n\
         joints = {{ \"*_calf_joint\" = -1.6, \"*_thigh_joint\" = 0.8 }}\nmotor = [{{ kp = 250, kd = 5 }}]\n{robot}\n{gait}\n"
    );
    let text = if model == "humanoid" {
        text.replace("joints = { \"*_calf_joint\" = -1.6, \"*_thigh_joint\" = 0.8 }\n", "")
    } else {
        text
    };
    let scene = Scene::from_str(&text, "space.toml", "").unwrap();
    let registry = barchan::registry();
    Environment::new(&registry, registry.task_of(&scene).unwrap(), &[0], &options()).unwrap()
}

fn still(environment: &Environment) -> Vec<f64> {
    vec![0.0; environment.task().actions().len()]
}

fn step(environment: &mut Environment, action: Vec<f64>) -> Step {
    environment.step(&[action]).unwrap().remove(0).unwrap()
}

/// So many control steps of the hand-written agent, and the sum of their rewards.
fn played(environment: &mut Environment, steps: u64) -> (Step, f64) {
    let mut sum = 0.0;
    loop {
        let action = environment.heuristic(0).unwrap();
        let step = step(environment, action);
        sum += step.reward;
        if step.terminated || step.truncated || environment.steps_taken(0) == steps {
            return (step, sum);
        }
    }
}

fn info(step: &Step, name: &str) -> f64 {
    step.info.iter().find(|(known, _)| *known == name).unwrap_or_else(|| panic!("no '{name}'")).1
}

fn close(name: &str, value: f64, by_hand: f64) {
    println!("{name}: {value:.6}, by hand {by_hand:.6}");
    assert!((value - by_hand).abs() < 2e-4, "{name}: {value}, by hand {by_hand}");
}

/// R = −Σ d + 2500 over 500 control steps of 20 ms, d the distance from a target that goes 1 m/s: 5 for a step without any loss.
#[test]
fn walks_are_rewarded_for_keeping_up_with_the_target() {
    for (velocity, d) in [("[1.0, 0.0, 0.0]", 0.0), ("[0.0, 0.0, 0.0]", 0.02), ("[0.7, 0.4, 0.0]", 0.01)] {
        let mut world = in_space("QuadrupedWalk", "quadruped", &format!("velocity = {velocity}"));
        for number in 1..=5 {
            let action = still(&world);
            let reward = step(&mut world, action).reward;
            close(&format!("quadruped, {velocity}"), reward, 5.0 - d * f64::from(number));
        }
    }
    // A dune walk has 6000 steps: 2500 / 6000 for a step, less d / 144.
    let mut world = in_space("DuneWalk", "quadruped", "");
    let action = still(&world);
    close("dunes", step(&mut world, action).reward, 0.416_667 - 0.02 / 144.0);
    // A humanoid that rises with 0.5 m/s: its head is off by as much as it has risen, but its target goes along the ground.
    let mut world = in_space("HumanoidWalk", "humanoid", "velocity = [0.5, 0.0, 0.5]");
    let action = still(&world);
    close("humanoid", step(&mut world, action).reward, 5.0 - 0.01 - 0.01);
    // Standing: R = −2 Σ (pelvis + head) + 750 over 250 steps.
    let mut world = in_space("HumanoidStand", "humanoid", "velocity = [0.0, 0.0, -0.5]");
    for number in 1..=3 {
        let action = still(&world);
        close("stand", step(&mut world, action).reward, 3.0 - 2.0 * 0.02 * f64::from(number));
    }
}

/// What is left of an episode counts as if the robot lay where it started: Σ 5 − 0.02 k over k = 1 to 500 is −5. A leap that ends in a fall gains what it gains before that.
#[test]
fn a_fall_ends_an_episode_and_gains_nothing() {
    let upside_down = "rotation = [0.0, 1.0, 0.0, 0.0]";
    let mut world = in_space("QuadrupedWalk", "quadruped", upside_down);
    let action = still(&world);
    let fallen = step(&mut world, action);
    assert!(fallen.terminated && !fallen.success);
    close("quadruped", fallen.reward, 500.0 * 5.0 - 0.02 * 500.0 * 501.0 / 2.0);
    let mut world = in_space("QuadrupedWalk", "quadruped", &format!("{upside_down}\nvelocity = [3.0, 0.0, 0.0]"));
    let action = still(&world);
    let fallen = step(&mut world, action);
    assert!(fallen.terminated && info(&fallen, "distance walked [m]") > 0.05);
    // It is ahead of its target by 0.04 m in one step, where it was behind by 0.02 m.
    close("leaping quadruped", fallen.reward, 500.0 * 5.0 - 0.02 * 500.0 * 501.0 / 2.0 + 0.02 - 0.04);
    // What is left of standing is worth nothing; a walk that has failed counts a head on the ground, 1 m low, in 499 steps.
    let mut world = in_space("HumanoidStand", "humanoid", upside_down);
    let action = still(&world);
    let fallen = step(&mut world, action);
    assert!(fallen.terminated && !fallen.success);
    close("stand", fallen.reward, 3.0);
    let mut world = in_space("HumanoidWalk", "humanoid", upside_down);
    let action = still(&world);
    let fallen = step(&mut world, action);
    assert!(fallen.terminated);
    close("humanoid", fallen.reward, -5.0 - 499.0);
}

/// A humanoid on the ground that lifts its toes falls over backwards.
#[test]
fn a_humanoid_that_lifts_its_toes_falls() {
    let mut world = environment("HumanoidStand-lite", &[], &[0]);
    let action: Vec<f64> = world
        .task()
        .actions()
        .iter()
        .map(|limit| if limit.name.contains("ankle_pitch") { limit.low } else { 0.0 })
        .collect();
    let mut last = step(&mut world, action.clone());
    while !last.terminated && !last.truncated {
        last = step(&mut world, action.clone());
    }
    println!("fell after {} control steps", world.steps_taken(0));
    assert!(last.terminated && !last.success && world.steps_taken(0) < 200);
}

/// The trot's agent walks on each ground, and an episode's particles stay few.
#[test]
fn a_quadruped_walks_on_sand_snow_and_elastic_ground() {
    for (ground, far) in [("sand", 0.35), ("snow", 0.25), ("elastic", 0.35)] {
        let mut world = environment("QuadrupedWalk-lite", &[("ground", Given::String(ground.to_owned()))], &[0]);
        let particles = world.worlds().world(0).particle_count();
        let (last, reward) = played(&mut world, 100);
        let walked = info(&last, "distance walked [m]");
        println!("{ground}: {walked:.2} m in 2 s, reward {reward:.1}, {particles} particles");
        assert!(walked > far && !last.terminated && particles <= 20_000, "{ground}: {walked} m");
    }
}

/// Action 0 is the trot itself for those who ask for it, and nothing else.
#[test]
fn an_action_from_the_trot_is_what_is_added_to_it() {
    let trot = ("from", Given::String("trot".to_owned()));
    let mut world = environment("QuadrupedWalk-lite", &[trot], &[0]);
    let mut last = None;
    for _ in 0..100 {
        let action = still(&world);
        last = Some(step(&mut world, action));
    }
    let walked = info(&last.unwrap(), "distance walked [m]");
    println!("the trot alone: {walked:.2} m in 2 s");
    assert!(walked > 0.3, "{walked}");
    let mut stands = environment("QuadrupedWalk-lite", &[], &[0]);
    let mut last = None;
    for _ in 0..30 {
        let action = still(&stands);
        last = Some(step(&mut stands, action));
    }
    assert!(info(&last.unwrap(), "distance walked [m]").abs() < 0.05);
}

/// A humanoid's agents keep it on its feet, and take it forward.
#[test]
fn a_humanoid_stands_and_walks() {
    let mut world = environment("HumanoidStand-lite", &[], &[0]);
    let (last, reward) = played(&mut world, 100);
    println!("stands: reward {reward:.1} of 300 in 2 s");
    assert!(!last.terminated && reward > 270.0, "{reward}");
    let mut world = environment("HumanoidWalk-lite", &[], &[0]);
    let (last, _) = played(&mut world, 200);
    let (walked, steps) = (info(&last, "distance walked [m]"), info(&last, "steps of the hand-written agent"));
    println!("walks: {walked:.2} m in 4 s, {steps} steps");
    assert!(!last.terminated && walked > 0.25 && steps >= 5.0, "{walked} m, {steps} steps");
}

/// A quadruped on dunes that have no end leaves ground behind that is no longer live.
#[test]
fn a_quadruped_walks_over_dunes() {
    let mut world = environment("DuneWalk-lite", &[], &[0]);
    let (last, _) = played(&mut world, 100);
    let walked = info(&last, "distance walked [m]");
    println!("dunes: {walked:.2} m in 2 s");
    assert!(walked > 0.4 && !last.terminated, "{walked}");
}

/// The same seed gives the same bits; another one does, too, unless a task is asked to draw.
#[test]
fn the_same_seed_gives_the_same_trajectory() {
    let draws = ("randomise", Given::Float(1.0));
    let mut worlds = environment("QuadrupedWalk-lite", &[draws], &[3, 3, 4]);
    for _ in 0..10 {
        let actions: Vec<Vec<f64>> = (0..3).map(|world| worlds.heuristic(world).unwrap()).collect();
        for step in worlds.step(&actions).unwrap() {
            step.unwrap();
        }
    }
    let seen: Vec<Vec<u64>> =
        (0..3).map(|world| worlds.observation(world).iter().map(|x| x.to_bits()).collect()).collect();
    assert_eq!(seen[0], seen[1]);
    assert_ne!(seen[0], seen[2]);
}

/// An observation is as long as a task says, whatever it is asked to hold.
#[test]
fn observations_are_as_long_as_their_parts() {
    for name in ["QuadrupedWalk-lite", "DuneWalk-lite", "HumanoidStand-lite", "HumanoidWalk-lite"] {
        for view in ["none", "heights", "both"] {
            let world = environment(name, &[("observation", Given::String(view.to_owned()))], &[0]);
            let parts: usize = world.task().observations().iter().map(|part| part.size).sum();
            assert_eq!(world.observation(0).len(), parts, "{name}, {view}");
        }
    }
}

/// An agent that has learnt nothing flings its joints from limit to limit. A limb that is too fast for the task's step is followed in shorter ones.
#[test]
fn wild_actions_never_end_an_episode_with_an_error() {
    for name in ["QuadrupedWalk-lite", "DuneWalk-lite", "HumanoidStand-lite", "HumanoidWalk-lite"] {
        let mut worlds = environment(name, &[], &[0, 1, 2, 3]);
        let limits = worlds.task().actions();
        for turn in 0..6 {
            let seeds = (0..4).map(|world| 4 * turn + world);
            let actions: Vec<Vec<f64>> = seeds
                .map(|seed| {
                    let sides = barchan::task::draw(&limits, 1.0, seed);
                    limits
                        .iter()
                        .zip(sides)
                        .map(|(one, at)| if at > 0.5 * (one.low + one.high) { one.high } else { one.low })
                        .collect()
                })
                .collect();
            for (world, step) in worlds.step(&actions).unwrap().into_iter().enumerate() {
                step.unwrap_or_else(|error| panic!("{name}, world {world}, turn {turn}: {error}"));
            }
        }
    }
}
