//! Determinism and resuming with levels, and levels that do nothing.

use super::{counted, levels, on_levels};
use barchan::{BodyState, Options, ParticleState, Precision, Simulation, Spot, Wrench};
use barchan_tests::scenes::{rows, scene, within};
use barchan_tests::sketch::{bed, block, half, material, tool};

/// Sand with two agents that pass through it in a hurry, jelly and snow beside.
fn busy(table: &str) -> String {
    let h = 0.05;
    let (mut head, mut parts) = bed(h, [64, 16], 6, 18, "young_modulus = 1e5, friction_angle_deg = 30");
    head.walls = "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"slip\"\ny_max = { separate = { friction = 0.3 } }\nz_min = \"stick\"";
    let contact = "{ coulomb = { friction = 0.4 } }";
    parts.extend([
        table.to_owned(),
        material("neo_hookean", 900.0, "young_modulus = 5e4"),
        material("snow", 400.0, "young_modulus = 5e3"),
        block("neo_hookean", [0.2, 0.1, 0.3], [0.5, 0.4, 0.5], "velocity = [0, 0.5, -1]\nsampling = \"jitter\""),
        block("snow", [0.9, 0.4, 0.3], [1.2, 0.7, 0.6], "velocity = [-0.5, 0, -1]"),
        tool(
            "rod",
            [0.3, 0.4, 0.3],
            &half([0.06, 0.06, 0.12]),
            contact,
            "{ velocity = { linear = [5, 0.4, 0], angular = [0, 0, 3] } }",
        ),
        tool(
            "ball",
            [2.1, 0.4, 0.45],
            "sphere = { radius = 0.08 }",
            contact,
            "{ free = { mass = 3, linear = [-5, 0, -1] } }",
        ),
    ]);
    head.with(&parts)
}

fn start(text: &str, precision: Precision, threads: usize) -> Simulation {
    let options = Options { precision, threads, ..Options::default() };
    Simulation::new(&barchan::registry(), &scene(text), &options).unwrap_or_else(|e| panic!("{e}"))
}

fn steps(s: &mut Simulation, count: u32) {
    (0..count).for_each(|_| drop(s.step().unwrap_or_else(|e| panic!("{e}"))));
}

/// Everything that a run leaves: particles with their levels' boxes and the phase of their sort, bodies, wrenches, time.
type Left = (ParticleState, Vec<BodyState>, Vec<Wrench>, u64);

fn left(s: &Simulation) -> Left {
    (s.particles(), s.bodies(), s.wrenches(), s.time().to_bits())
}

/// NaN would make equal bits differ under `==`, and -0 different ones equal: compare what is printed.
fn same(a: &Left, b: &Left) -> bool {
    a == b && format!("{a:?}") == format!("{b:?}")
}

/// Symptom: splits number their children in the order in which threads find them, merges add in that order, or two agents'
/// regions depend on it. Physics: same input, same bits, on any number of threads.
#[test]
fn any_number_of_threads_gives_the_same_bits_with_moving_levels() {
    let text = busy(&levels(3, 8, &["rod", "ball"]));
    for precision in [Precision::F32, Precision::F64] {
        let run = |threads| {
            let mut s = start(&text, precision, threads);
            steps(&mut s, 260);
            (left(&s), s.ledger())
        };
        let (alone, ledger) = run(1);
        println!("{precision}: {} particles, {:?}, t {}", ledger.particles, ledger.counts, f64::from_bits(alone.3));
        for what in ["particles split", "particles merged", "changed level"] {
            assert!(counted(&ledger, what) > 50, "the test must see {what}: {:?}", ledger.counts);
        }
        for threads in [2, 3] {
            let (others, other_ledger) = run(threads);
            assert!(same(&alone, &others), "{precision}: {threads} threads differ from one");
            assert_eq!(format!("{ledger:?}"), format!("{other_ledger:?}"), "{precision}: ledger of {threads} threads");
        }
    }
}

/// Symptom: a run that was interrupted while a region moved goes on with boxes about where agents are now, with other numbers
/// for children, or with another round of merges. Physics: resumed is not interrupted, bit for bit.
#[test]
fn resuming_in_the_middle_of_a_move_continues_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let plain = busy(&levels(3, 8, &["rod", "ball"]));
    let own = "[levels]\ncount = 3\nhalf = 8\nagents = [{ name = \"rod\", at = \"lowest\", half = 10 }, { name = \"ball\", offset = [0.1, 0.0, -0.05] }]\n";
    for (text, precision, times) in [
        (&plain, Precision::F32, &[0, 41, 77][..]),
        (&plain, Precision::F64, &[0, 41, 77]),
        (&busy(own), Precision::F32, &[41]),
    ] {
        for &at in times {
            let mut whole = start(text, precision, 2);
            steps(&mut whole, at);
            let file = folder.path().join(format!("{precision}-{at}.snapshot"));
            whole.save(&file).unwrap();
            let mut resumed = Simulation::resume(
                &barchan::registry(),
                &file,
                &Options { precision, threads: 1, ..Options::default() },
            )
            .unwrap();
            if at > 0 {
                assert!(same(&left(&whole), &left(&resumed)), "{precision}, {at}: read again it differs already");
            }
            let boxes = |s: &Simulation| s.particles().levels.map(|phase| phase.boxes);
            let then = boxes(&whole);
            steps(&mut whole, 60);
            steps(&mut resumed, 60);
            assert_ne!(boxes(&whole), then, "regions have moved in between");
            assert!(same(&left(&whole), &left(&resumed)), "{precision}, saved at {at}: differs after 60 steps");
        }
    }
}

/// B40. Symptom: levels that nobody uses change a result, or cost. Physics: with one level the `[levels]` table says nothing: bits
/// are those of the scene without it. And a box that holds the whole world is one fine level, so that nothing is on the coarse one.
#[test]
fn one_level_is_the_scene_without_levels() {
    for precision in [Precision::F32, Precision::F64] {
        let run = |table: &str| {
            let mut s = start(&busy(table), precision, 2);
            steps(&mut s, 60);
            s
        };
        let (none, one) = (run(""), run(&levels(1, 8, &["rod", "ball"])));
        assert!(same(&left(&none), &left(&one)), "{precision}: one level differs from none");
        println!("B40 {precision}: {} particles, no bit differs", none.particle_count());
    }
}

/// B40. Symptom: a box that reaches out of the world, or an agent above the ground, makes a rim where there is no matter. Physics: a box that
/// holds the whole world is one fine level; it differs by rounding, since particles are listed in another order.
#[test]
fn a_box_larger_than_the_world_is_one_fine_level() {
    let [mut one, mut all] = [String::new(), levels(2, 64, &["rod"])].map(|t| start(&busy(&t), Precision::F64, 2));
    assert_eq!(on_levels(&all)[1], 0, "the fine box holds the world");
    // Numbers differ, since the lattice is filled cube by cube: pair by place.
    let by_place = |s: &Simulation| {
        let mut all = rows(s);
        all.sort_by(|a, b| a.x.partial_cmp(&b.x).unwrap());
        all.into_iter().map(|r| r.id).collect::<Vec<_>>()
    };
    let pairs: Vec<_> = by_place(&one).into_iter().zip(by_place(&all)).collect();
    assert_eq!(one.particle_count(), all.particle_count());
    steps(&mut one, 20);
    steps(&mut all, 20);
    let (plain, boxed) = (rows(&one), rows(&all));
    let off = pairs.iter().fold(0f64, |off, (a, b)| {
        let (a, b) = (&plain[*a as usize], &boxed[*b as usize]);
        (0..3).fold(off, |off, d| off.max((a.v[d] - b.v[d]).abs()))
    });
    within("B40 box larger than the world: velocities [m/s]", off, 1e-9);
}

/// Pictures ask for places and sizes alone, and for all of what lies near the cut: the very particles that a whole copy holds.
#[test]
fn spots_and_parts_are_those_of_the_whole_copy() {
    let mut s = start(&busy(&levels(3, 8, &["rod", "ball"])), Precision::F32, 2);
    steps(&mut s, 30);
    let mut whole = s.particles();
    let spots: Vec<Spot> =
        whole.lists.iter().flat_map(|list| (0..list.len()).map(|i| list.spot(i)).collect::<Vec<_>>()).collect();
    assert_eq!(s.spots(), spots);
    let wanted = |spot: &Spot| spot.position[1] > 0.5;
    let count = spots.iter().filter(|spot| wanted(spot)).count();
    assert!(0 < count && count < spots.len(), "{count} of {} are wanted", spots.len());
    whole.lists.iter_mut().for_each(|list| list.retain(wanted));
    assert_eq!(whole.lists.iter().map(barchan::ParticleList::len).sum::<usize>(), count);
    assert_eq!(s.ground_where(&wanted), ParticleState { sort: None, ..whole });
}
