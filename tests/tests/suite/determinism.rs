//! Determinism is a contract: same input, same bits, whatever the number of threads, and whether or not a run was interrupted.

use barchan::{BodyState, Options, ParticleState, Precision, Simulation, Wrench};
use barchan_tests::scenes::scene;
use barchan_tests::sketch::{Head, bed, block, half, material, tool};

/// Sand with a driven tool and two free bodies that meet in it, and jelly and snow beside.
fn busy() -> String {
    let h = 0.05;
    let (mut head, mut parts) = bed(h, [24, 16], 3, 16, "young_modulus = 1e5, friction_angle_deg = 30");
    head.walls = "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"slip\"\ny_max = { separate = { friction = 0.3 } }\nz_min = \"stick\"";
    let contact = "{ coulomb = { friction = 0.4 } }";
    parts.extend([
        material("neo_hookean", 900.0, "young_modulus = 5e4"),
        material("snow", 400.0, "young_modulus = 5e4"),
        block("neo_hookean", [0.2, 0.1, 0.2], [0.4, 0.3, 0.4], "velocity = [0, 0.5, -1]\nsampling = \"jitter\""),
        block("snow", [0.9, 0.5, 0.2], [1.1, 0.7, 0.5], "velocity = [-0.5, 0, -1]"),
        tool(
            "rod",
            [0.3, 0.4, 0.2],
            &half([0.06, 0.06, 0.12]),
            contact,
            "{ velocity = { linear = [1.2, 0.2, 0], angular = [0, 0, 3] } }",
        ),
        tool(
            "ball",
            [0.7, 0.4, 0.25],
            "sphere = { radius = 0.08 }",
            contact,
            "{ free = { mass = 3, linear = [-0.5, 0, -1] } }",
        ),
        tool("box", [0.72, 0.42, 0.45], &half([0.07; 3]), contact, "{ free = { mass = 1, angular = [1, 2, 0] } }"),
    ]);
    head.with(&parts)
}

fn start(text: &str, precision: Precision, threads: usize) -> Simulation {
    let options = Options { precision, threads, ..Options::default() };
    Simulation::new(&barchan::registry(), &scene(text), &options).unwrap_or_else(|e| panic!("{e}"))
}

/// Everything that a run leaves: particles with the phase of their sort, bodies, wrenches, and the bits of time.
type Left = (ParticleState, Vec<BodyState>, Vec<Wrench>, u64);

fn left(s: &Simulation) -> Left {
    (s.particles(), s.bodies(), s.wrenches(), s.time().to_bits())
}

/// Steps, and how many of them sorted.
fn steps(s: &mut Simulation, count: u32) -> u32 {
    (0..count).map(|_| u32::from(s.step().unwrap_or_else(|e| panic!("{e}")).sorted)).sum()
}

/// NaN would make equal bits differ under `==`, and -0 different ones equal: compare what is printed.
fn same(a: &Left, b: &Left) -> bool {
    a == b && format!("{a:?}") == format!("{b:?}")
}

/// Work is cut into blocks, never by the number of threads, and sums are taken in the blocks' order. A sum in the order in which
/// threads finish differs at the first step and, in sand, visibly after a second.
#[test]
fn any_number_of_threads_gives_the_same_bits() {
    for precision in [Precision::F32, Precision::F64] {
        let run = |threads| {
            let mut s = start(&busy(), precision, threads);
            let sorts = steps(&mut s, 120);
            (sorts, left(&s), s.ledger())
        };
        let (sorts, alone, ledger) = run(1);
        println!("{precision}: {} particles, 120 steps with {sorts} sorts", ledger.particles);
        assert!(sorts >= 4, "the test must see sorts: {sorts}");
        for threads in [2, 3, 5] {
            let (others, shared, shared_ledger) = run(threads);
            assert!(others == sorts && same(&alone, &shared), "{precision}: {threads} threads differ from one");
            assert_eq!(
                format!("{ledger:?}"),
                format!("{shared_ledger:?}"),
                "{precision}: the ledger of {threads} threads differs"
            );
        }
        // B23: and twice the same is the same.
        assert!(same(&alone, &run(1).1), "{precision}: a second run differs");
    }
}

/// A run that is saved, read again and continued is the run that was not: particles, their order, the sort's phase, tools, rigid
/// bodies and their contacts, the ledger's sums, the stop that lies ahead. On another number of threads too.
#[test]
fn resuming_continues_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    for precision in [Precision::F32, Precision::F64] {
        // Saved just after assembling, between two sorts, and late.
        for at in [0, 33, 90] {
            let mut whole = start(&busy(), precision, 2);
            whole.set_stop(0.1);
            steps(&mut whole, at);
            let file = folder.path().join(format!("{precision}-{at}.snapshot"));
            whole.save(&file).unwrap();
            for threads in [1, 2, 5] {
                let options = Options { precision, threads, ..Options::default() };
                let mut resumed = Simulation::resume(&barchan::registry(), &file, &options).unwrap();
                let mut ahead = start(&busy(), precision, 2);
                ahead.set_stop(0.1);
                steps(&mut ahead, at);
                if at > 0 {
                    assert!(same(&left(&resumed), &left(&ahead)), "{precision}: read at {at} it differs already");
                }
                let sorts = (steps(&mut resumed, 70), steps(&mut ahead, 70));
                assert_eq!(sorts.0, sorts.1, "{precision}, saved at {at}: sorts");
                assert!(
                    same(&left(&resumed), &left(&ahead)),
                    "{precision}, saved at {at}, {threads} threads: differs after 70 steps"
                );
                assert_eq!(resumed.step_count(), ahead.step_count());
                let (a, b) = (resumed.ledger(), ahead.ledger());
                assert_eq!(a.counts, b.counts, "{precision}, saved at {at}");
                // Sums over time start anew from what was booked, so they may round.
                for d in 0..3 {
                    let off = (a.wall_impulse[d] - b.wall_impulse[d]).abs()
                        + (a.gravity_impulse[d] - b.gravity_impulse[d]).abs();
                    assert!(off < 1e-9, "{precision}, saved at {at}: sums are off by {off}");
                }
            }
        }
    }
    println!("resumed at steps 0, 33, 90 on 1, 2, 5 threads in f32 and f64: 18 runs, no bit differs after 70 steps");
}

/// Snow's stiffness is measured every so many steps and sets the automatic step: a resumed run must measure at the same steps,
/// or its dt and with it every bit differs.
#[test]
fn resuming_keeps_the_automatic_step_of_a_material_that_hardens() {
    let h = 0.05;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    let text = Head::cells(h, [4, 4, 16], walls).time("safety = 0.6").with(&[
        material("snow", 400.0, ""),
        block("snow", [0.0; 3], [0.2, 0.2, 0.4], ""),
        tool("lid", [0.1, 0.1, 0.5], &half([0.3, 0.3, 0.1]), "\"slip\"", "{ velocity = { linear = [0, 0, -2] } }"),
    ]);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("snow.snapshot");
    for at in [5, 37, 61] {
        let mut whole = start(&text, Precision::F32, 1);
        steps(&mut whole, at);
        whole.save(&file).unwrap();
        let mut resumed = Simulation::resume(&barchan::registry(), &file, &Options::default()).unwrap();
        for i in 0..60 {
            let (a, b) = (whole.step().unwrap().dt, resumed.step().unwrap().dt);
            assert!(a == b, "saved at {at}: step {i} after it is {b:e} s instead of {a:e} s");
        }
        assert!(same(&left(&whole), &left(&resumed)), "saved at {at}: differs after 60 steps");
    }
}
