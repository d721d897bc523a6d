//! States in memory and copies of worlds go on as their sources do, on every backend.

use barchan::{Aabb, Error, Options, Precision, Scene, Simulation};
use barchan_tests::forks::{ploughed, states_go_on, worlds_fork, worlds_take_over};
use barchan_tests::readings::hold;
use barchan_tests::scenes::{everywhere, options};

#[test]
fn a_state_in_memory_or_in_a_file_goes_on_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    for options in everywhere() {
        for (levels, subcycle) in [(1, false), (2, false), (2, true)] {
            states_go_on(&ploughed(1, levels, subcycle), &options, folder.path());
        }
    }
}

#[test]
fn a_forked_world_goes_on_as_its_source() {
    for options in everywhere() {
        for (levels, subcycle) in [(1, false), (2, true)] {
            worlds_fork(|world| ploughed(world, levels, subcycle), &options);
        }
    }
}

/// Symptom: a batch could not go back to one state, since its worlds have seeds of their own; and a world whose episode had ended went on beside the others.
#[test]
fn worlds_take_over_a_state_and_may_wait() {
    for options in everywhere() {
        for (levels, subcycle) in [(1, false), (2, true)] {
            worlds_take_over(&ploughed(1, levels, subcycle), &options);
        }
    }
}

/// What does not fit is refused by name, and leaves the simulation as it was.
#[test]
fn a_state_of_another_scene_is_refused() {
    let make = |scene, precision| Simulation::new(&barchan::registry(), &scene, &options(precision)).unwrap();
    let (mut one, other) = (make(ploughed(1, 1, false), Precision::F32), make(ploughed(2, 1, false), Precision::F32));
    let wide = make(ploughed(1, 1, false), Precision::F64);
    let before = format!("{:?} {:?}", one.particles(), one.bodies());
    for (foreign, why) in [(&other, "friction_angle_deg is 31.0 there and 28.0 here"), (&wide, "it is in f64")] {
        let error = one.set_state(&foreign.state().unwrap()).unwrap_err();
        assert!(matches!(error, Error::Body { .. }), "{error}");
        let text = error.to_string();
        assert!(text.contains(why) && text.contains("make a simulation of the state"), "{text}");
    }
    let error = Simulation::from_state(&barchan::registry(), &wide.state().unwrap(), &Options::default()).unwrap_err();
    assert!(error.to_string().contains("in f64, and f32 is asked for"), "{error}");
    assert_eq!(format!("{:?} {:?}", one.particles(), one.bodies()), before);
    // Another simulation of the same scene is as good as itself.
    one.set_state(&make(ploughed(1, 1, false), Precision::F32).state().unwrap()).unwrap();
}

/// Symptom: a state from a file was refused by a simulation of the same scene that was made from a dict, since it was of another folder; and a world could not take a state
/// to be drawn larger, or to go on for longer.
#[test]
fn a_state_fits_whatever_the_scene_is_called_and_wherever_it_is_read() {
    let registry = barchan::registry();
    for options in everywhere() {
        let first = Simulation::new(&registry, &ploughed(1, 1, false), &options).unwrap();
        let mut state = first.state().unwrap();
        for seed in [first.plan().scene.seed, 7] {
            let mut scene = ploughed(1, 1, false);
            (scene.name, scene.doc, scene.seed) = ("other".into(), "Other words.".into(), seed);
            (scene.folder, scene.time.end) = ("elsewhere".into(), 2.0 * scene.time.end);
            scene.output.picture.pixels = 300;
            let mut other = Simulation::new(&registry, &scene, &options).unwrap();
            (0..3).for_each(|_| drop(other.step().unwrap()));
            other.check_state(&state).unwrap();
            other.restore(&registry, &state, &options).unwrap();
            let now = &other.plan().scene;
            assert_eq!((other.step_count(), now.name.as_str(), now.output.picture.pixels), (0, "other", 300));
            assert_eq!((now.seed, now.time.end), (first.plan().scene.seed, scene.time.end));
            assert_eq!(format!("{:?}", other.particles().lists), format!("{:?}", first.particles().lists));
            state = other.state().unwrap();
        }
    }
}

/// Symptom: a copy of a simulation read its robot's file again, and went on with a robot of another mass.
#[test]
fn a_copy_does_not_take_over_a_file_that_has_changed() {
    let (registry, folder) = (barchan::registry(), tempfile::tempdir().unwrap());
    let file = folder.path().join("r.urdf");
    let write = |mass: f64| {
        let link = format!("<inertial><mass value='{mass}'/><inertia ixx='1' iyy='1' izz='1'/></inertial>");
        std::fs::write(&file, format!("<robot name='r'><link name='l'>{link}</link></robot>")).unwrap();
    };
    write(2.0);
    let text = "name = \"s\"\nworld = { cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }\ntime = { end = 1, step = 0.001 }\n[[robot]]\nname = \"r\"\nurdf = \"r.urdf\"\nposition = [0.5, 0.5, 0.5]";
    let scene = Scene::from_str(text, "s.toml", folder.path()).unwrap();
    let options = options(Precision::F64);
    let simulation = Simulation::new(&registry, &scene, &options).unwrap();
    let state = simulation.state().unwrap();
    assert_eq!(Simulation::from_state(&registry, &state, &options).unwrap().bodies()[0].mass, 2.0);
    write(6.0);
    let error = Simulation::from_state(&registry, &state, &options).unwrap_err().to_string();
    assert!(error.contains("r.urdf") && error.contains("has changed since the simulation was made"), "{error}");
    let other = Simulation::new(&registry, &scene, &options).unwrap();
    let error = other.check_state(&state).unwrap_err().to_string();
    assert!(error.contains("reads other files: other contents"), "{error}");
}

/// What is read of a region is what a copy of all particles has there, on all levels.
#[test]
fn a_reading_is_what_a_copy_of_all_particles_holds() {
    let region = Aabb { min: [0.21, 0.05, 0.03], max: [0.93, 0.23, 0.3] };
    for options in everywhere() {
        for levels in [1, 2] {
            let scene = ploughed(1, levels, false);
            let mut simulation = Simulation::new(&barchan::registry(), &scene, &options).unwrap();
            hold(&simulation, region);
            (0..5).for_each(|_| drop(simulation.step().unwrap()));
            hold(&simulation, region);
        }
    }
}
