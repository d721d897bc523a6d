//! Rounds of split and merge over a copy of the particles, as backends with a memory of their own have them.

use super::{counted, levels, on_levels};
use barchan::{Ledger, ParticleList, ParticleState, Precision, Simulation};
use barchan_grid::adapt::Adapt;
use barchan_tests::scenes::{Noise, Row, alter, rows, simulation};
use barchan_tests::sketch::{Head, block, driven, material, tool};

/// Snow and jelly at rest with an uneven surface, and an agent above that crosses it in leaps.
fn leaps(precision: Precision) -> Simulation {
    let h = 0.05;
    let scene = Head::space(h).time("step = 1e-5\nover_bound = \"allow\"").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4"),
        material("snow", 400.0, "young_modulus = 1e4"),
        block("neo_hookean", [-1.0, -0.4, -0.2], [1.0, 0.4, 0.1], "around_tools = false"),
        block("snow", [-1.0, -0.4, 0.1], [0.4, 0.2, 0.3], "sampling = \"jitter\"\naround_tools = false"),
        levels(3, 12, &["eye"]),
        tool("eye", [-1.0, 0.0, 0.65], "sphere = { radius = 0.05 }", "\"slip\"", &driven([1.0, 0.0, 0.0])),
    ]);
    let mut s = simulation(&scene, precision);
    let mut noise = Noise::new(5);
    // Histories that differ, so that their means show.
    alter(&mut s, |row| row.state.iter_mut().for_each(|q| *q += 1e-3 * noise.draw()));
    s
}

/// The same particles in another order.
fn reverse(list: &mut ParticleList) {
    list.id.reverse();
    list.body.reverse();
    list.cell.reverse();
    list.offset.reverse();
    list.velocity.reverse();
    list.affine.reverse();
    let planes = [&mut list.mass, &mut list.volume0].into_iter().chain(&mut list.strain).chain(&mut list.state);
    planes.for_each(|plane| plane.reverse());
}

/// The particles of a copy as a simulation of this precision holds them, by number.
fn held(by: &mut Simulation, state: &ParticleState) -> Vec<Row> {
    by.set_particles(state.clone()).unwrap_or_else(|e| panic!("{e}"));
    rows(by)
}

/// Symptom: a backend that has its particles adapted on the host splits other particles, forgets a plane, or numbers children otherwise
/// than the CPU's engine does on its own stores. Physics: one algorithm, the same bits. Without the blocks of a sort numbers may differ,
/// particles may not.
#[test]
fn rounds_over_a_copy_leave_the_particles_that_the_engine_has() {
    for precision in [Precision::F32, Precision::F64] {
        let (mut s, mut twin) = (leaps(precision), leaps(precision));
        let (mut adapt, mut other) = (Adapt::new(s.plan()), Adapt::new(s.plan()));
        let mut rounds = 0;
        s.step().unwrap();
        let start = s.ledger();
        for leap in 0..60 {
            // Away over the end and back.
            let speed = if leap < 30 { 1e4 } else { -1e4 };
            s.drive("eye", [speed, 0.0, 0.0], [0.0; 3]).unwrap();
            let mut copy = s.particles();
            adapt.restore(copy.levels.clone().unwrap());
            let regions = adapt.regions.clone();
            s.step().unwrap();
            let (there, phase) = (rows(&s), s.particles().levels.unwrap());
            if phase.rounds == copy.levels.as_ref().unwrap().rounds {
                continue;
            }
            rounds += 1;
            adapt.regions.restore(phase.boxes.clone());
            let before = (adapt.regions != regions).then_some(&regions);
            let mut unsorted = ParticleState { sort: None, ..copy.clone() };
            adapt.round_on_host(&mut copy, before, &[]).unwrap();
            assert_eq!(copy.levels, Some(phase), "{precision}, leap {leap}");
            assert!(held(&mut twin, &copy) == there, "{precision}, leap {leap}: other particles than the engine's");

            other.restore(unsorted.levels.clone().unwrap());
            other.regions = adapt.regions.clone();
            unsorted.lists.iter_mut().for_each(reverse);
            other.round_on_host(&mut unsorted, before, &[]).unwrap();
            let places = |rows: Vec<Row>| {
                let mut places: Vec<_> = rows.into_iter().map(|row| (row.level, row.x, row.volume0)).collect();
                places.sort_by(|a, b| a.partial_cmp(b).unwrap());
                places
            };
            assert!(places(held(&mut twin, &unsorted)) == places(there), "{precision}, leap {leap}: in another order");
        }
        let (mut own, ledger) = (Ledger::default(), s.ledger());
        adapt.account(&mut own);
        println!("{precision}: {rounds} rounds, {:?}, {:?}", on_levels(&s), ledger.counts);
        assert!(rounds > 20, "{rounds}");
        for what in ["particles split", "particles merged", "changed level"] {
            assert!(counted(&ledger, what) > 500, "the test must see {what}: {:?}", ledger.counts);
            assert_eq!(counted(&own, what), counted(&ledger, what) - counted(&start, what), "{what}");
        }
    }
}
