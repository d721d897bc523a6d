//! Many worlds side by side are each the world that it is alone.

use barchan::worlds::Worlds;
use barchan::{Options, Precision, Scene, Simulation};
use barchan_tests::scenes::{drive_blade, left, options, scene};
use barchan_tests::sketch::{bed, half, tool};

/// A patch of sand, sown at random, and a blade that an agent drives; worlds differ in seed, friction and the blade's height.
fn patch(seed: u64) -> Scene {
    let friction = 25.0 + 3.0 * seed as f64;
    let parameters = format!("young_modulus = 1e5, friction_angle_deg = {friction}");
    let (head, mut parts) = bed(0.05, [12, 8], 3, 8, &parameters);
    parts[1] += "sampling = \"jitter\"\n";
    parts.push(tool(
        "blade",
        [0.15, 0.2, 0.14 + 0.01 * seed as f64],
        &half([0.06, 0.08, 0.06]),
        "{ coulomb = { friction = 0.4 } }",
        "{ velocity = { linear = [0.5, 0, 0] } }",
    ));
    Scene { seed, ..scene(&head.with(&parts)) }
}

fn alone(world: usize, steps: usize, options: &Options) -> Simulation {
    let mut s = Simulation::new(&barchan::registry(), &patch(world as u64), options).unwrap();
    for _ in 0..steps {
        drive_blade(&mut s, world);
        s.step().unwrap();
    }
    s
}

/// Symptom guarded against: worlds that share a random number, a tool or a sum. A reset of one must not touch the others, and starts
/// it from the very start.
#[test]
fn a_world_of_a_batch_is_the_world_alone_bit_for_bit() {
    for precision in [Precision::F32, Precision::F64] {
        let options = Options { threads: 2, ..options(precision) };
        let mut worlds = Worlds::new(&barchan::registry(), (0..5).map(patch).collect(), &options).unwrap();
        let steps = |worlds: &mut Worlds, count: usize| {
            for _ in 0..count {
                (0..worlds.len()).for_each(|w| drive_blade(worlds.world_mut(w), w));
                worlds.step().into_iter().for_each(|report| drop(report.unwrap()));
            }
        };
        steps(&mut worlds, 25);
        worlds.reset(3, None).unwrap();
        steps(&mut worlds, 15);
        let ends: Vec<_> = worlds.iter().map(left).collect();
        for (world, end) in ends.iter().enumerate() {
            let taken = if world == 3 { 15 } else { 40 };
            assert!(*end == left(&alone(world, taken, &options)), "{precision}: world {world} is not itself alone");
            assert!(ends[..world].iter().all(|other| other != end), "worlds differ");
        }
    }
}

/// Symptom guarded against: a thread that waits for one world's engine takes up the next world within that call, one in another, until its stack is full.
#[test]
fn hundreds_of_worlds_do_not_nest_in_one_another() {
    let (head, parts) = bed(0.05, [4, 4], 1, 8, "young_modulus = 1e5, friction_angle_deg = 30");
    let small = scene(&head.with(&parts));
    let options = Options { threads: 2, ..options(Precision::F32) };
    let mut worlds = Worlds::of(&barchan::registry(), &small, 600, 0, &options).unwrap();
    assert!(worlds.step().into_iter().all(|report| report.is_ok()));
    assert!(worlds.approach(&[2e-3; 600], std::time::Duration::MAX).into_iter().all(|there| there.unwrap()));
    let mut alone = Worlds::of(&barchan::registry(), &small, 1, 599, &options).unwrap();
    alone.step();
    alone.approach(&[2e-3], std::time::Duration::MAX);
    assert!(left(worlds.world(599)) == left(alone.world(0)), "the last is itself alone");
}

/// A world that fails says so and stays; the others go on.
#[test]
fn a_world_that_fails_does_not_stop_the_others() {
    let options = options(Precision::F32);
    let mut worlds = Worlds::new(&barchan::registry(), (0..3).map(patch).collect(), &options).unwrap();
    let mut spoilt = worlds.world(1).particles();
    spoilt.lists[0].velocity[7][2] = f64::NAN;
    worlds.world_mut(1).set_particles(spoilt).unwrap();
    let reports = worlds.step();
    let error = reports[1].as_ref().unwrap_err().to_string();
    assert!(error.contains("velocity of particle") && reports[0].is_ok() && reports[2].is_ok(), "{error}");
    assert_eq!([0, 1, 2].map(|w| worlds.world(w).step_count()), [1, 0, 1]);
    worlds.reset(1, Some(patch(9))).unwrap();
    assert!(worlds.step().iter().all(Result::is_ok));
}
