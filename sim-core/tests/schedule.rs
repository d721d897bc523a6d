//! Schedules: which stages a step has, on which levels, in what order.

use barchan_core::schedule::{Call, Needs, Schedule, Stage};

fn levels(levels: usize, subcycled: bool) -> Schedule {
    Schedule::new(Needs {
        ground: true,
        levels,
        subcycled,
        sleeps: true,
        unbounded: true,
        bodies: true,
        flux: false,
        press: false,
    })
}

fn position(calls: &[Call], stage: Stage, level: usize) -> usize {
    let is_it = |call: &Call| call.stage == stage && call.levels.contains(&level);
    calls.iter().position(is_it).unwrap_or_else(|| panic!("no {stage} of level {level} in {calls:?}"))
}

/// Bodies act on velocities that forces have changed, and rims of levels that step together take what bodies have made of the coarser level.
#[test]
fn together_bodies_come_between_the_grid_and_the_rims() {
    let schedule = levels(3, false);
    assert_eq!(schedule.upkeep, [Stage::ARCHIVE, Stage::ADAPT, Stage::SORT]);
    let stages: Vec<_> = schedule.step.iter().map(|call| call.stage.name()).collect();
    assert_eq!(stages, ["sleep", "P2G", "restrict", "grid update", "contact", "limit", "bodies", "prolong", "G2P"]);
    // The coarsest level has no rim, and nothing is handed to the finest.
    assert_eq!(schedule.step[position(&schedule.step, Stage::PROLONG, 0)].levels, 0..2);
    assert_eq!(schedule.step[position(&schedule.step, Stage::RESTRICT, 1)].levels, 1..3);
    assert_eq!(schedule.to_string(), format!("when due: archive -> adapt -> sort\neach step: {}", stages.join(" -> ")));
}

/// Each level takes two steps in one of the next coarser one: its steps fill the whole one without gap or overlap, and it gives to the grid and takes from it
/// by turns.
#[test]
fn subcycled_levels_take_twice_as_many_steps_as_the_next_coarser_one() {
    const DT: f64 = 0.3;
    for count in 2..=5 {
        let schedule = levels(count, true);
        assert_eq!(schedule.slots, 1 << (count - 1));
        for level in 0..count {
            let of_level = |call: &&Call| call.levels.contains(&level);
            let own: Vec<&Call> = schedule.step.iter().filter(of_level).collect();
            let transfers: Vec<_> = own.iter().filter(|c| [Stage::P2G, Stage::G2P].contains(&c.stage)).collect();
            assert_eq!(transfers.len(), 2 * (schedule.slots >> level));
            for (pair, begin) in transfers.chunks(2).zip((0..).step_by(1 << level)) {
                let [to_grid, back] = pair else { panic!("an odd number of transfers") };
                assert_eq!((to_grid.stage, to_grid.slot), (Stage::P2G, begin));
                assert_eq!((back.stage, back.slot), (Stage::G2P, begin + (1 << level) - 1));
            }
            let steps = transfers.len() as f64 / 2.0;
            assert!((schedule.dt_of(level, DT) * steps - DT).abs() < 1e-15);
        }
        for slot in 0..schedule.slots {
            let want = 2.0 + slot as f64 * DT / schedule.slots as f64;
            assert!((schedule.time_of(slot, 2.0, DT) - want).abs() < 1e-15);
        }
    }
}

/// A rim needs the coarser level's velocities as its step begins, before bodies act; bodies meet a coarser level once they have moved with the finest.
#[test]
fn subcycled_bodies_meet_coarser_levels_where_they_have_come() {
    let schedule = levels(3, true);
    let last = schedule.of_slot(3);
    assert!(position(last, Stage::PROLONG, 0) < position(last, Stage::CONTACT, 0));
    assert!(position(last, Stage::CONTACT, 0) < position(last, Stage::BODIES, 0));
    assert!(position(last, Stage::BODIES, 0) < position(last, Stage::CONTACT, 2));
    assert!(position(last, Stage::CONTACT, 2) < position(last, Stage::G2P, 2));
    assert_eq!(
        schedule.to_string().lines().nth(2),
        Some(
            "slot 1: sleep 0 -> P2G 0 -> grid update 0 -> prolong 0 -> contact 0 -> bodies 0 -> contact 1 -> G2P 0-1 -> limit 0-1"
        )
    );
    assert!(levels(5, true).to_string().contains("\n… 16 slots in all; behind each stage its levels"));
}

#[test]
fn what_is_not_called_for_is_not_there() {
    let bare = Schedule::new(Needs { ground: true, levels: 1, ..Needs::default() });
    assert_eq!(bare.stages(), [Stage::SORT, Stage::P2G, Stage::GRID_UPDATE, Stage::LIMIT, Stage::G2P]);
    let bodies = Schedule::new(Needs { levels: 1, bodies: true, ..Needs::default() });
    assert_eq!(bodies.stages(), [Stage::CONTACT, Stage::BODIES]);
    assert_eq!(Schedule::new(Needs::default()).to_string(), "none");
}
