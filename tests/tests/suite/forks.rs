//! States in memory and copies of worlds go on as their sources do, on every backend.

use barchan::{Aabb, Error, Options, Precision, Simulation};
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
