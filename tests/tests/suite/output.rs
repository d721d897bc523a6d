//! Looking at a run changes nothing of it.

use barchan::{Options, Precision, Simulation};
use barchan_tests::scenes::{scene, simulation};
use barchan_tests::sketch::{Head, half, tool};
use barchan_tests::stops::{hold, struck, thrown};

fn steps(simulation: &mut Simulation, count: u32) {
    (0..count).for_each(|_| drop(simulation.step().unwrap_or_else(|e| panic!("{e}"))));
}

/// Symptom: `letters` took steps of 2.6, 2.0 and 0.5 ms with pictures every 0.1, 0.02 and 0.005 s, since an automatic step was at most a tenth of
/// the interval. Output must not change the physics: the last bit is the same.
#[test]
fn how_often_a_run_writes_changes_no_bit() {
    hold(&struck("neo_hookean"), "cpu", 0.08);
    // Its stiffness, and so its step, follows the state.
    hold(&struck("snow"), "cpu", 0.05);
    hold(&thrown("sand").replace("young_modulus = 5e4", "young_modulus = 1e5"), "cpu", 0.05);
    // A device takes many steps of one length: which, and from when to when, must not depend on where a run stops to write.
    hold(&struck("neo_hookean"), "wgpu", 0.05);
    hold(&struck("snow"), "wgpu", 0.03);
    hold(&thrown("neo_hookean"), "wgpu", 0.05);
}

/// Where there is no ground that bounds the step, it is not output that does.
#[test]
fn the_step_of_bodies_alone_does_not_follow_the_output() {
    let head = Head::space(0.1);
    let bodies = [
        tool(
            "a",
            [0.0; 3],
            &half([0.1; 3]),
            "\"slip\"",
            "{ free = { mass = 1, linear = [1, 0, 0], angular = [0, 3, 1] } }",
        ),
        tool("b", [0.5, 0.0, 0.0], &half([0.1; 3]), "\"slip\"", "{ free = { mass = 2 } }"),
    ];
    hold(&head.with(&bodies), "cpu", 0.5);
    let mut alone = simulation(&head.with(&bodies), Precision::F64);
    steps(&mut alone, 1);
    assert_eq!(alone.time(), 5e-3, "nothing here is fast");
}

/// A run that is saved and gone on with keeps the step that was chosen, however many steps it was chosen for.
#[test]
fn the_chosen_step_goes_into_a_snapshot() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("half.barchan");
    let options = Options { threads: 1, ..Options::default() };
    let mut whole = Simulation::new(&barchan::registry(), &scene(&struck("snow")), &options).unwrap();
    whole.set_stop(0.05);
    steps(&mut whole, 23);
    whole.save(&file).unwrap();
    let mut resumed = Simulation::resume(&barchan::registry(), &file, &options).unwrap();
    for step in 0..40 {
        let [a, b] = [&mut whole, &mut resumed].map(|s| s.step().unwrap_or_else(|e| panic!("{e}")).dt);
        assert!(a.to_bits() == b.to_bits(), "step {step} after it takes {a:e} instead of {b:e} s");
    }
}
