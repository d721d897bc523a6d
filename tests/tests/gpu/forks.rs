//! States in memory and copies of worlds go on as their sources do, bit for bit, on the device too.

use super::on_gpu;
use barchan::{Aabb, Simulation};
use barchan_tests::forks::{ploughed, states_go_on, worlds_fork};
use barchan_tests::readings::hold;

#[test]
fn a_state_in_memory_or_in_a_file_goes_on_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    for (levels, subcycle) in [(1, false), (2, true)] {
        states_go_on(&ploughed(1, levels, subcycle), &on_gpu(), folder.path());
    }
}

#[test]
fn a_forked_world_goes_on_as_its_source() {
    for (levels, subcycle) in [(1, false), (2, true)] {
        worlds_fork(|world| ploughed(world, levels, subcycle), &on_gpu());
    }
}

/// What is read of a region is what a copy of all particles has there, on all levels.
#[test]
fn a_reading_is_what_a_copy_of_all_particles_holds() {
    let scene = ploughed(1, 2, false);
    let mut simulation = Simulation::new(&barchan::registry(), &scene, &on_gpu()).unwrap();
    (0..3).for_each(|_| drop(simulation.step().unwrap()));
    hold(&simulation, Aabb { min: [0.21, 0.05, 0.03], max: [0.93, 0.23, 0.3] });
}
