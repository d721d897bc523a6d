//! States in memory and copies of worlds go on as their sources do, bit for bit, on the device too.

use super::on_gpu;
use barchan_tests::forks::{ploughed, states_go_on, worlds_fork};

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
