//! A state goes on as the simulation that it was taken of, bit for bit: in memory, in a file, and as a world of a batch.

use crate::scenes::scene;
use barchan::worlds::Worlds;
use barchan::{Command, Options, Scene, Simulation, registry};
use std::path::Path;
use std::time::Duration;

/// Steps before a state is taken, and behind it.
const BEFORE: usize = 14;
const BEHIND: usize = 16;

/// Loose sand and snow that hardens, a blade that an agent drives, and a cube that falls: on one level, or on two whose steps may be of their own lengths.
/// Worlds differ in where ground is seeded and in friction.
pub fn ploughed(world: u64, levels: u32, subcycle: bool) -> Scene {
    let friction = 25.0 + 3.0 * world as f64;
    let mut scene = scene(&format!(
        r#"
name = "ploughed"
gravity = [0, 0, -9.81]
world = {{ cell = 0.04, min = [0, 0, 0], max = [1.28, 0.32, 0.48], walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "slip" }} }}
time = {{ end = 1, step = 5e-4 }}
levels = {{ count = {levels}, half = 8, subcycle = {subcycle} }}
material = [
    {{ name = "s", law = "sand", density = 1600, parameters = {{ young_modulus = 1e5, friction_angle_deg = {friction} }} }},
    {{ name = "n", law = "snow", density = 400 }},
]
body = [
    {{ material = "s", sampling = "jitter", shape = {{ box = {{ min = [0, 0, 0], max = [0.8, 0.32, 0.12] }} }} }},
    {{ material = "n", sampling = "jitter", shape = {{ box = {{ min = [0.8, 0, 0], max = [1.28, 0.32, 0.08] }} }} }},
]
tool = [
    {{ name = "blade", position = [0.3, 0.16, 0.16], shape = {{ box = {{ half = [0.06, 0.1, 0.1] }} }}, motion = {{ velocity = {{ linear = [0.5, 0, 0] }} }}, contact = {{ coulomb = {{ friction = 0.4 }} }} }},
    {{ name = "cube", position = [0.9, 0.16, 0.17], shape = {{ box = {{ half = [0.08, 0.08, 0.08] }} }}, motion = {{ free = {{ mass = 2, linear = [0, 0, -0.5], angular = [1, 0, 2] }} }}, contact = {{ coulomb = {{ friction = 0.4 }} }} }},
]
"#
    ));
    scene.seed = world;
    scene
}

/// What an agent does, by the step and the world that it began in.
fn act(s: &mut Simulation, world: u64) {
    let turn = 0.05 * s.step_count() as f64 + world as f64;
    let (linear, angular) = ([2.0 * turn.cos(), 0.3 * turn.sin(), -0.1], [0.0, 0.0, turn.sin()]);
    s.act("blade", &Command::Twist { linear, angular }).unwrap_or_else(|e| panic!("{e}"));
}

fn take(s: &mut Simulation, world: u64, steps: usize) {
    for _ in 0..steps {
        act(s, world);
        s.step().unwrap_or_else(|e| panic!("{e}"));
    }
}

fn left(s: &Simulation) -> String {
    let ledger = s.ledger();
    format!(
        "{:?} {:?} {:?} {:?} {:?} {:?} {:?}",
        s.particles(),
        s.bodies(),
        s.wrenches(),
        s.time().to_bits(),
        ledger.counts,
        ledger.wall_impulse,
        ledger.gravity_impulse
    )
}

/// Holds a simulation of a scene that goes back to a state, one that is made of the state, and one that is resumed from its file, to the one that has gone
/// on.
///
/// # Panics
/// If a bit differs.
pub fn states_go_on(scene: &Scene, options: &Options, folder: &Path) {
    let registry = registry();
    let mut first = Simulation::new(&registry, scene, options).unwrap_or_else(|e| panic!("{e}"));
    // At the start nothing has been sorted yet.
    for before in [0, BEFORE] {
        take(&mut first, scene.seed, before);
        let state = first.state().unwrap_or_else(|e| panic!("{e}"));
        let there = left(&first);
        take(&mut first, scene.seed, BEHIND);
        let end = left(&first);
        assert!(end != there, "nothing happens");
        let file = folder.join("run.barchan");
        state.save(&file).unwrap_or_else(|e| panic!("{e}"));
        let made = Simulation::from_state(&registry, &state, options).unwrap_or_else(|e| panic!("{e}"));
        let resumed = Simulation::resume(&registry, &file, options).unwrap_or_else(|e| panic!("{e}"));
        for (how, mut other) in [("made of its state", made), ("resumed", resumed)] {
            assert_eq!((other.time(), other.step_count()), (state.time(), state.step_count()));
            assert!(left(&other) == there, "{how} after {before} steps: it is another one");
            take(&mut other, scene.seed, BEHIND);
            assert!(left(&other) == end, "{how} after {before} steps: differs after {BEHIND} steps");
        }
        // Back, from where it has gone, and from further off.
        for further in [0, 7] {
            take(&mut first, scene.seed, further);
            first.set_state(&state).unwrap_or_else(|e| panic!("{e}"));
            assert!(left(&first) == there, "set back to {before} steps: it is another one");
            take(&mut first, scene.seed, BEHIND);
            assert!(left(&first) == end, "set back to {before} steps: differs after {BEHIND} steps");
        }
    }
}

/// Holds a world that is made a copy of another one to this one, and the others to what they are without.
///
/// # Panics
/// If a bit differs.
pub fn worlds_fork(scene: impl Fn(u64) -> Scene, options: &Options) {
    let scenes: Vec<Scene> = (0..3).map(scene).collect();
    let make = || Worlds::new(&registry(), scenes.clone(), options).unwrap_or_else(|e| panic!("{e}"));
    let steps = |worlds: &mut Worlds, acts: [u64; 3], count: usize| {
        for _ in 0..count {
            (0..3).for_each(|w| act(worlds.world_mut(w), acts[w]));
            worlds.step().into_iter().for_each(|report| drop(report.unwrap_or_else(|e| panic!("{e}"))));
        }
    };
    let (mut forked, mut plain) = (make(), make());
    steps(&mut forked, [0, 1, 2], BEFORE);
    steps(&mut plain, [0, 1, 2], BEFORE);
    // Into a world before it and one behind; then back from the copy.
    for (from, to) in [(0, 2), (2, 1), (1, 0)] {
        forked.fork(from, to).unwrap_or_else(|e| panic!("{e}"));
        assert!(left(forked.world(to)) == left(forked.world(from)), "world {to} is no copy of {from}");
        let mut acts = [0, 1, 2];
        acts[to] = acts[from];
        if (from, to) != (0, 2) {
            acts = [0; 3];
        }
        steps(&mut forked, acts, BEHIND);
        steps(&mut plain, [0, 1, 2], BEHIND);
        assert!(left(forked.world(to)) == left(forked.world(from)), "world {to}, a copy of {from}, differs");
        assert!(left(forked.world(0)) == left(plain.world(0)), "world 0 is not what it is without copies");
        if (from, to) == (0, 2) {
            assert!(left(forked.world(1)) == left(plain.world(1)), "world 1 is not what it is without copies");
            assert!(left(forked.world(2)) != left(plain.world(2)), "worlds do not differ");
        }
    }
    // A copy may be led elsewhere, and starts anew as what it is a copy of.
    steps(&mut forked, [0, 5, 0], BEHIND);
    assert!(left(forked.world(1)) != left(forked.world(0)), "a copy cannot be led elsewhere");
    forked.reset(1, None).unwrap_or_else(|e| panic!("{e}"));
    let start = Simulation::new(&registry(), &scenes[0], options).unwrap_or_else(|e| panic!("{e}"));
    assert!(left(forked.world(1)) == left(&start), "a copy starts anew as another world");
}

/// Holds worlds of one scene with seeds of their own to the world whose state they take over; and, while one of them waits, the others to what they are beside it, and that one to
/// what it was.
///
/// # Panics
/// If a bit differs.
pub fn worlds_take_over(scene: &Scene, options: &Options) {
    let seeded = |seed: u64| Scene { seed, ..scene.clone() };
    let make = || Worlds::new(&registry(), (0..3).map(seeded).collect(), options).unwrap_or_else(|e| panic!("{e}"));
    let (mut some, mut all) = (make(), make());
    // A control step of those that do not wait.
    let control = |worlds: &mut Worlds, waits: Option<usize>| {
        let until: Vec<f64> =
            (0..3).map(|w| worlds.world(w).time() + if waits == Some(w) { 0.0 } else { 5e-3 }).collect();
        (0..3).filter(|w| waits != Some(*w)).for_each(|w| act(worlds.world_mut(w), 0));
        while worlds.approach(&until, Duration::MAX).into_iter().any(|there| !there.unwrap_or_else(|e| panic!("{e}"))) {
        }
    };
    control(&mut some, None);
    control(&mut all, None);
    let state = some.world(1).state().unwrap_or_else(|e| panic!("{e}"));
    let there = left(some.world(1));
    assert!(left(some.world(0)) != there, "seeds change nothing");
    for worlds in [&mut some, &mut all] {
        worlds.restore(&[(0, &state), (1, &state), (2, &state)]).unwrap_or_else(|e| panic!("{e}"));
        assert!((0..3).all(|w| left(worlds.world(w)) == there), "a world has not taken over the state");
    }
    for _ in 0..3 {
        control(&mut some, Some(2));
        control(&mut all, None);
    }
    assert!(left(some.world(2)) == there, "a world that waits has changed");
    let end = left(all.world(2));
    assert!(end != there && left(all.world(0)) == end && left(all.world(1)) == end, "worlds of one state differ");
    assert!(left(some.world(0)) == end && left(some.world(1)) == end, "worlds beside one that waits differ");
    // It begins anew as what it has taken over.
    some.reset(0, None).unwrap_or_else(|e| panic!("{e}"));
    let start = Simulation::new(&registry(), &seeded(1), options).unwrap_or_else(|e| panic!("{e}"));
    assert!(left(some.world(0)) == left(&start), "it starts anew as another world");
}
