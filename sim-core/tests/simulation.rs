//! Running: stops, bounds, errors, snapshots and exports, on an engine that only lets particles fall.
#![allow(clippy::result_large_err, reason = "see the crate's own allowance")]

mod common;

use barchan_core::{Command, Error, Options, Registry, Scene, Simulation};
use proptest::prelude::*;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;

const SCENE: &str = "name = 'run'
    world = { cell = 0.02, min = [0, 0, -1000], max = [1, 1, 1] }
    time = { end = 1, step = 1e-4 }
    material = [{ name = 'm', law = 'elastic', density = 1000 }]
    [[body]]
    material = 'm'
    sampling = 'jitter'
    shape = { box = { min = [0, 0, 0], max = [0.1, 0.1, 0.1] } }
    [[tool]]
    name = 'plate'
    position = [0.5, 0.2, 0.5]
    shape = { box = { half = [0.1, 0.1, 0.1] } }
    motion = { velocity = { linear = [0.1, 0, 0] } }
    [[tool]]
    name = 'ball'
    position = [0.5, 0.6, 0.5]
    shape = { sphere = { radius = 0.05 } }
    motion = { free = { mass = 2, linear = [0, 0, -3] } }
    ";

fn simulation(overrides: &[&str]) -> Simulation {
    let scene = Scene::from_str_with(SCENE, "run.toml", "", overrides).unwrap();
    Simulation::new(&common::registry(), &scene, &Options::default()).unwrap()
}

fn run(simulation: &mut Simulation, until: f64) -> u64 {
    let mut steps = 0;
    let end = simulation.advance(until, |_, _| {
        steps += 1;
        ControlFlow::Continue(())
    });
    assert!(end.unwrap());
    steps
}

#[test]
fn time_lands_on_stops_exactly_with_equal_steps() {
    let mut fixed = simulation(&[]);
    let mut steps = Vec::new();
    for stop in [0.05, 0.1, 0.15] {
        fixed
            .advance(stop, |_, report| {
                steps.push(report.dt);
                ControlFlow::Continue(())
            })
            .unwrap();
        assert_eq!(fixed.time(), stop);
    }
    assert_eq!(steps, vec![1e-4; 1500], "a step that divides the interval keeps its bits");
    assert_eq!(fixed.step_count(), 1500);

    for frame in 4..=40 {
        run(&mut fixed, f64::from(frame) * 0.05);
    }
    assert_eq!(fixed.step_count(), 20_000, "rounding adds no step");

    // One that does not is shortened: 0.05 s / 3e-4 s = 166.7, so 167 steps.
    let mut uneven = simulation(&["time.step=3e-4"]);
    assert_eq!(run(&mut uneven, 0.05), 167);
    assert_eq!(uneven.time(), 0.05);

    let mut stopped = simulation(&[]);
    stopped.set_stop(2.5e-4);
    for expected in [2.5e-4 / 3.0, 5e-4 / 3.0, 2.5e-4, 3.5e-4] {
        stopped.step().unwrap();
        assert!((stopped.time() - expected).abs() < 1e-18, "{}", stopped.time());
    }
}

#[test]
fn an_automatic_step_is_the_safe_fraction_of_the_bound() {
    let text = SCENE.replace(", step = 1e-4", "");
    let scene = Scene::from_str(&text, "run.toml", "").unwrap();
    let mut automatic = Simulation::new(&common::registry(), &scene, &Options::default()).unwrap();
    let bound = automatic.bound().dt;
    assert_eq!(automatic.step().unwrap().dt, 0.6 * bound);
}

#[test]
fn advance_can_be_broken_off_and_taken_up_again() {
    let mut broken = simulation(&[]);
    let end = broken
        .advance(0.01, |s, _| if s.step_count() == 30 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) });
    assert!(!end.unwrap());
    assert_eq!(run(&mut broken, 0.01), 70);
    let mut whole = simulation(&[]);
    run(&mut whole, 0.01);
    assert_eq!(broken.particles(), whole.particles());
}

#[test]
fn an_engines_error_leaves_everything_as_before_the_step() {
    let mut failing = simulation(&[]);
    common::FATE.with(|fate| fate.fails_at.store(5, Relaxed));
    let error = failing.advance(1.0, |_, _| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(error, Error::LeftWorld { step: 5, .. }));
    assert_eq!(failing.step_count(), 5);
    let x = failing.bodies()[0].position[0];
    assert!((x - (0.5 + 5.0 * 1e-5)).abs() < 1e-12, "the tool has gone back: {x}");
    let folder = tempfile::tempdir().unwrap();
    failing.save(folder.path().join("saved")).unwrap();
    common::FATE.with(|fate| fate.fails_at.store(0, Relaxed));
    failing.step().unwrap();
}

/// Symptom: an engine of another crate that gives neither steps nor an error ended the program. It is an error that names the backend.
#[test]
fn an_engine_that_takes_no_step_is_an_error() {
    let mut running = simulation(&[]);
    common::FATE.with(|fate| fate.mute.store(true, Relaxed));
    for error in [running.step().unwrap_err(), running.steps(7, 1.0).unwrap_err()] {
        assert!(error.to_string().contains("backend 'cpu'") && error.to_string().contains("took no step"), "{error}");
    }
    common::FATE.with(|fate| fate.mute.store(false, Relaxed));
    running.step().unwrap();
    assert_eq!(running.step_count(), 1);
}

#[test]
fn a_bound_that_falls_below_the_step_is_refused_or_cut() {
    common::FATE.with(|fate| fate.stiffens_at.store(3, Relaxed));
    let step = ["time.step=4e-4"];
    let mut refused = simulation(&step);
    let error = refused.advance(1.0, |_, _| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(&error, Error::TimeStep { step: 3, by, .. } if by.contains("stiffness")), "{error}");
    let mut cut = simulation(&[&step[..], &["time.over_bound=substep"]].concat());
    assert!(run(&mut cut, 0.01) > 25);
    let ledger = cut.ledger();
    assert!(ledger.counts["steps cut below time.step"] > 20, "{:?}", ledger.counts);
    let bound = cut.bound().dt;
    assert!(cut.step().unwrap().dt <= 0.6 * bound);
}

#[test]
fn energy_from_nowhere_ends_an_allowed_run_and_falling_does_not() {
    let over = ["time.step=2e-3", "time.over_bound=allow"];
    let mut falling = simulation(&over);
    assert!(falling.bound().dt < 2e-3);
    run(&mut falling, 0.5);
    common::FATE.with(|fate| fate.grows.store(1100, Relaxed));
    let mut growing = simulation(&over);
    let error = growing.advance(0.5, |_, _| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(error, Error::Unstable { step: 50, steps: 50, .. }), "{error}");
    // Below the bound nobody watches.
    let mut below = simulation(&[]);
    run(&mut below, 0.006);
}

#[test]
fn bodies_are_driven_by_name() {
    let mut driven = simulation(&[]);
    driven.act("plate", &Command::Twist { linear: [0.0, 1.0, 0.0], angular: [0.0; 3] }).unwrap();
    driven.step().unwrap();
    assert!((driven.bodies()[0].position[1] - 0.2001).abs() < 1e-12);
    let error = driven.act("plank", &Command::Twist { linear: [0.0; 3], angular: [0.0; 3] }).unwrap_err().to_string();
    assert_eq!(error, "plank: no body has this name; there are plate, ball");
    assert_eq!(driven.wrenches().len(), 2);
}

#[test]
fn the_ledger_adds_bodies_and_counts() {
    let mut booked = simulation(&[]);
    booked.step().unwrap();
    let ledger = booked.ledger();
    assert_eq!(ledger.particles, 1000);
    assert_eq!(ledger.body_kinetic, 9.0);
    assert_eq!((ledger.counts["fallen"], ledger.counts["boxes"]), (1, 2));
}

#[test]
fn an_empty_scene_runs() {
    let text = "name = 'empty'\nworld = { cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }\ntime = { end = 1 }";
    let scene = Scene::from_str(text, "empty.toml", "").unwrap();
    let mut empty = Simulation::new(&common::registry(), &scene, &Options::default()).unwrap();
    run(&mut empty, 1.0);
    assert_eq!(empty.time(), 1.0);
}

#[test]
fn unknown_backends_are_listed() {
    let scene = Scene::from_str(SCENE, "run.toml", "").unwrap();
    let options = Options { backend: "abacus".to_owned(), ..Options::default() };
    let error = Simulation::new(&common::registry(), &scene, &options).unwrap_err().to_string();
    assert_eq!(error, "registry: no backend is called 'abacus'; known are: cpu");
    let error = Simulation::new(&Registry::new(), &scene, &options).unwrap_err().to_string();
    assert_eq!(error, "registry: no backend is called 'abacus'; no backend is registered");
    let mut twice = common::registry();
    let error = twice.add_backend(std::sync::Arc::new(common::Ballistic)).unwrap_err().to_string();
    assert!(error.contains("backend 'cpu' is registered twice"), "{error}");
}

fn saved(folder: &Path, steps: u64) -> (Simulation, std::path::PathBuf) {
    let mut running = simulation(&[]);
    let path = folder.join("state.snapshot");
    running.set_stop(0.0123);
    for _ in 0..steps {
        running.step().unwrap();
    }
    running.save(&path).unwrap();
    (running, path)
}

fn resume(path: &Path) -> Result<Simulation, Error> {
    Simulation::resume(&common::registry(), path, &Options::default())
}

#[test]
fn a_snapshot_continues_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let (mut first, path) = saved(folder.path(), 77);
    let mut second = resume(&path).unwrap();
    assert_eq!(second.particles(), first.particles());
    assert_eq!((second.time().to_bits(), second.step_count()), (first.time().to_bits(), 77));
    // The stop that was set before is still ahead, then another.
    for until in [0.0123, 0.05] {
        run(&mut first, until);
        run(&mut second, until);
    }
    assert_eq!(second.particles(), first.particles());
    assert_eq!(second.bodies(), first.bodies());
    assert_eq!(second.step_count(), first.step_count());
    let (a, b) = (first.ledger(), second.ledger());
    assert_eq!(a.counts, b.counts);
    assert_eq!((a.gravity_impulse, a.kinetic.to_bits()), (b.gravity_impulse, b.kinetic.to_bits()));
    // Nothing but the snapshot is left in the folder.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn resets_give_the_same_episode() {
    let mut first = simulation(&[]);
    let start = first.particles();
    first.step().unwrap();
    let after = first.particles();
    for _ in 0..50 {
        let mut again = simulation(&[]);
        assert_eq!(again.particles(), start);
        again.step().unwrap();
        assert_eq!(again.particles(), after);
    }
}

#[test]
fn f32_planes_take_four_bytes_and_f64_ones_lose_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (mut running, path) = saved(folder.path(), 1);
    let small = std::fs::metadata(&path).unwrap().len();
    // 22 bytes of id, body and cell; 4 each of 3 + 3 + 9 + 2 + 6 + 1 numbers.
    let per_particle = 22 + 4 * 24;
    assert!(small < 1000 * per_particle + 4000, "{small}");
    let mut particles = running.particles();
    particles.lists[0].velocity[3][1] = 0.1;
    particles.lists[0].affine[3][1] = f64::NEG_INFINITY;
    particles.lists[0].strain[0][5] = -0.0;
    running.set_particles(particles).unwrap();
    running.save(&path).unwrap();
    let again = resume(&path).unwrap().particles();
    assert_eq!(again, running.particles());
    assert!(again.lists[0].strain[0][5].is_sign_negative());
}

#[test]
fn a_sort_phase_survives() {
    let folder = tempfile::tempdir().unwrap();
    let (mut running, path) = saved(folder.path(), 1);
    let mut particles = running.particles();
    particles.sort = Some(barchan_core::SortPhase {
        measured: barchan_core::Measured { stiffness_bound: 1e-3, stiffness_age: 7, mass: 3.0, least_mass: 1e-21 },
        age: 7,
        drift: vec![0.123_456_789],
        blocks: vec![([0, 0, -3, 4, i32::MAX], vec![1, 2]), ([0; 5], vec![])],
        rest: vec![7, u16::MAX],
        kept_for: vec![Some((1e-4, [0.0, 0.5, -9.81]))],
    });
    running.set_particles(particles.clone()).unwrap();
    running.save(&path).unwrap();
    assert_eq!(resume(&path).unwrap().particles(), particles);
}

#[test]
fn damaged_snapshots_are_refused_and_say_how() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(folder.path(), 3);
    let good = std::fs::read(&path).unwrap();
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let error = resume(&path).unwrap_err();
        assert!(matches!(error, Error::Snapshot { .. }), "{error}");
        error.to_string()
    };
    let with = |at: usize, value: &[u8]| {
        let mut bytes = good.clone();
        bytes[at..at + value.len()].copy_from_slice(value);
        bytes
    };
    assert!(read(b"").contains("is no snapshot; give a file that `save` has written"));
    assert!(read(b"not a snapshot at all").contains("is no snapshot"));
    let version = u32::from_le_bytes(good[8..12].try_into().unwrap());
    let other = read(&with(8, &(version + 1).to_le_bytes()));
    assert!(other.contains(&format!("has format version {}, this program reads {version}", version + 1)), "{other}");
    // A length that no file could bear out is not believed.
    assert!(read(&with(16, &u64::MAX.to_le_bytes())).contains("section HEAD should have 18446744073709551615 bytes"));
    assert!(read(&with(40, b"\0")).contains("section HEAD has a wrong checksum"));
    assert!(read(&with(good.len() - 60, b"\xaa\xaa")).contains("wrong checksum"));
    assert!(read(&good[..good.len() / 2]).contains("is cut short"));
    assert!(read(&[&good[..], b"!"].concat()).contains("has 1 bytes after its end"));
    for length in (0..good.len()).step_by(997).chain(good.len() - 20..good.len()) {
        assert!(read(&good[..length]).contains("earlier snapshot") || length < 12, "cut at {length}");
    }
}

#[test]
fn absurd_counts_inside_a_section_with_a_good_checksum_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(folder.path(), 1);
    let mut bytes = std::fs::read(&path).unwrap();
    let list = bytes.windows(4).position(|w| w == b"LIST").unwrap();
    let length = u64::from_le_bytes(bytes[list + 4..list + 12].try_into().unwrap()) as usize;
    let payload = list + 16..list + 16 + length;
    // The number of particles follows five u32 and an f64.
    bytes[payload.start + 28..payload.start + 36].copy_from_slice(&(1_u64 << 60).to_le_bytes());
    let checksum = crc32fast::hash(&bytes[payload]);
    bytes[list + 12..list + 16].copy_from_slice(&checksum.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let error = resume(&path).unwrap_err().to_string();
    assert!(error.contains("announces 1152921504606846976 entries of 22 bytes"), "{error}");
}

/// Symptom: a snapshot of a step near the greatest number there is ended the program with an overflow at the next one, and one whose steps
/// have no length went on for ever.
#[test]
fn a_snapshot_whose_clock_cannot_go_on_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(folder.path(), 1);
    let good = std::fs::read(&path).unwrap();
    let length = u64::from_le_bytes(good[16..24].try_into().unwrap()) as usize;
    let head: serde_json::Value = serde_json::from_slice(&good[28..28 + length]).unwrap();
    let with = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut head = head.clone();
        change(&mut head);
        let head = serde_json::to_vec(&head).unwrap();
        let mut bytes = good[..16].to_vec();
        bytes.extend_from_slice(&(head.len() as u64).to_le_bytes());
        bytes.extend_from_slice(&crc32fast::hash(&head).to_le_bytes());
        bytes.extend_from_slice(&head);
        bytes.extend_from_slice(&good[28 + length..]);
        std::fs::write(&path, bytes).unwrap();
        resume(&path).and_then(|mut resumed| resumed.step())
    };
    assert!(with(&|_| ()).is_ok());
    for (key, value, said) in [
        (&["step"][..], serde_json::json!(u64::MAX), "step 18446744073709551615"),
        (&["chosen", "dt"], serde_json::json!(0.0), "goes on"),
        (&["chosen", "dt"], serde_json::json!(-1e-3), "goes on"),
    ] {
        let change = |head: &mut serde_json::Value| {
            *key.iter().fold(head, |value, key| &mut value[*key]) = value.clone();
        };
        let error = with(&change).unwrap_err().to_string();
        assert!(error.contains(said) && error.contains("earlier snapshot"), "{error}");
    }
}

#[test]
fn snapshots_that_cannot_be_written_leave_the_old_one() {
    let folder = tempfile::tempdir().unwrap();
    let (running, path) = saved(folder.path(), 2);
    let before = std::fs::read(&path).unwrap();
    let error = running.save(folder.path().join("absent/state.snapshot")).unwrap_err().to_string();
    assert!(error.contains("absent/state.snapshot: writing a snapshot: No such file"), "{error}");
    // A folder stands where the file should go: the rename fails, the part is removed.
    let taken = folder.path().join("taken");
    std::fs::create_dir_all(taken.join("inside")).unwrap();
    assert!(matches!(running.save(&taken), Err(Error::Io { .. })));
    assert_eq!(std::fs::read(&path).unwrap(), before);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn resuming_in_another_precision_or_without_a_file_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(folder.path(), 1);
    let options = Options { precision: barchan_core::Precision::F64, ..Options::default() };
    let error = Simulation::resume(&common::registry(), &path, &options).unwrap_err().to_string();
    assert!(error.contains("was written by a run in f32, and f64 is asked for"), "{error}");
    let error = resume(&folder.path().join("absent")).unwrap_err().to_string();
    assert!(error.contains("absent: reading a snapshot: No such file"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn any_damage_is_refused_or_harmless(place in 0.0_f64..1.0, bytes in prop::collection::vec(any::<u8>(), 1..16)) {
        let folder = tempfile::tempdir().unwrap();
        let (running, path) = saved(folder.path(), 1);
        let mut file = std::fs::read(&path).unwrap();
        let at = (place * (file.len() - bytes.len()) as f64) as usize;
        file[at..at + bytes.len()].copy_from_slice(&bytes);
        std::fs::write(&path, file).unwrap();
        if let Ok(resumed) = resume(&path) {
            prop_assert_eq!(resumed.particles(), running.particles());
        }
    }
}
