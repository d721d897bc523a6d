//! Particles into blocks and cells.

use crate::passes::binding::{
    CELLS, COUNTS, DIRECTORY, Draft, FLAGS, Groups, KEYS, LISTED, LISTS, LIVE, LOOSE, NEW_CELLS, NEW_LISTS, ORDER,
    OWNERS, RECORD, RIMS, Role, STATUS, SUMS, Sorted, Uniform, Use, WATCH, atomic, next, particles_to_next, written,
};
use crate::passes::conditions::chosen;
use crate::passes::scene::{may_sleep, regions};
use crate::passes::since_sort::SINCE_SORT;
use barchan_core::Plan;
use barchan_core::scene::Leaving;
use barchan_grid::wgsl;

/// A pass over particles as a sort sees them.
pub(crate) fn draft(name: &'static str, entry: &'static str, body: &str, uses: Vec<Use>, groups: Groups) -> Draft {
    let body = include_str!("../wgsl/sort.wgsl").to_owned() + body;
    Draft { name, entry, body, uses, uniform: Uniform::None, groups, checked: true }
}

pub(crate) fn sort(plan: &Plan, worlds: usize) -> Vec<Draft> {
    let levels = plan.cell_widths.len() > 1;
    // With several levels, some passes know their regions.
    let knowing = |draft: Draft, helpers: &str| {
        if !levels {
            return draft;
        }
        Draft { body: draft.body + &regions(plan, worlds) + helpers, uniform: Uniform::Regions, ..draft }
    };
    let leaving = plan.scene.world.leaving;
    let is_error = leaving == Leaving::Error;
    let (sleeps, unbounded) = (may_sleep(plan), plan.terrain.is_some());
    let conditions = [
        ("levels", levels),
        ("sleeps", sleeps),
        ("unbounded", unbounded),
        // What becomes of a particle outside the world: it halts the submission, is put back, or is deleted.
        ("halts", is_error),
        ("puts_back", leaving == Leaving::Clamp),
    ];
    // Where particles change, or what they gave is noted, passes write.
    let mark_text = chosen(include_str!("../wgsl/sort_mark.wgsl"), &conditions);
    let changed = |binding: Use| if is_error { binding } else { written(binding) };
    let words = if sleeps { wgsl::WATCH_WORDS } else { "" };
    let link_text = chosen(include_str!("../wgsl/sort_link.wgsl"), &conditions);
    let count_text = chosen(include_str!("../wgsl/sort_count.wgsl"), &conditions);
    let with_watch = |mut uses: Vec<Use>| {
        uses.extend(sleeps.then_some(next("watch", WATCH)));
        uses
    };
    let old_lists = ("old_lists", "vec4<i32>", Role::Now(Sorted::Lists), false);
    let rim_text = [
        include_str!("../wgsl/listed.wgsl"),
        wgsl::REACHES_WALL,
        wgsl::MIRRORS,
        wgsl::BEHIND,
        if unbounded { include_str!("../wgsl/sort_edge.wgsl") } else { "" },
        &chosen(include_str!("../wgsl/sort_rim.wgsl"), &conditions),
    ]
    .concat();
    let rims = knowing(
        draft(
            "rims",
            "find_rims",
            &rim_text,
            [DIRECTORY, NEW_LISTS, written(RIMS), STATUS, written(LISTED)]
                .into_iter()
                .chain(unbounded.then_some(LIVE))
                .collect(),
            Groups::NodeBlocks,
        ),
        "",
    );
    let mut passes = vec![
        Draft {
            name: "due",
            entry: "due",
            body: SINCE_SORT.concat() + include_str!("../wgsl/sort_due.wgsl"),
            uses: vec![STATUS],
            uniform: Uniform::None,
            groups: Groups::LayersBy(64),
            checked: true,
        },
        knowing(
            draft(
                "mark",
                "mark",
                &([if is_error { "" } else { include_str!("../wgsl/sort_leave.wgsl") }, &mark_text].concat()),
                vec![changed(RECORD), changed(LISTS), CELLS, atomic(FLAGS), STATUS],
                Groups::Blocks,
            ),
            include_str!("../wgsl/sort_check.wgsl"),
        ),
        knowing(
            draft(
                "spread",
                "spread",
                &chosen(include_str!("../wgsl/sort_spread.wgsl"), &conditions),
                vec![atomic(FLAGS), STATUS],
                Groups::PlacesBy(1024),
            ),
            "",
        ),
        draft(
            "survey",
            "survey",
            include_str!("../wgsl/sort_survey.wgsl"),
            vec![FLAGS, written(DIRECTORY), written(SUMS), STATUS],
            Groups::PlacesBy(1024),
        ),
        draft(
            "total",
            "total_blocks",
            include_str!("../wgsl/sort_total.wgsl"),
            vec![written(SUMS), STATUS],
            Groups::One,
        ),
        draft(
            "number",
            "number",
            include_str!("../wgsl/sort_number.wgsl"),
            vec![written(DIRECTORY), SUMS, NEW_LISTS, STATUS],
            Groups::PlacesBy(1024),
        ),
        draft(
            "link",
            "link",
            &(link_text + words),
            with_watch(vec![DIRECTORY, NEW_LISTS, written(COUNTS), STATUS]),
            Groups::NodeBlocks,
        ),
        draft(
            "count",
            "count_cells",
            &(count_text + words),
            with_watch(vec![RECORD, old_lists, CELLS, DIRECTORY, atomic(COUNTS), written(KEYS), STATUS]),
            Groups::Blocks,
        ),
        draft(
            "sum cells",
            "sum_cells",
            include_str!("../wgsl/sort_sums.wgsl"),
            vec![COUNTS, written(SUMS), STATUS],
            Groups::BlocksBy(64),
        ),
        draft(
            "sum blocks",
            "sum_blocks",
            include_str!("../wgsl/sort_before.wgsl"),
            vec![written(SUMS), STATUS],
            Groups::One,
        ),
        draft(
            "starts",
            "starts",
            concat!(include_str!("../wgsl/rounds.wgsl"), include_str!("../wgsl/sort_starts.wgsl")),
            vec![written(NEW_CELLS), SUMS, STATUS],
            Groups::Blocks,
        ),
        draft(
            "scatter",
            "scatter",
            include_str!("../wgsl/sort_scatter.wgsl"),
            vec![RECORD, COUNTS, KEYS, written(LOOSE), STATUS],
            Groups::ParticlesBy(128),
        ),
        draft(
            "rank",
            "rank",
            concat!(include_str!("../wgsl/rounds.wgsl"), include_str!("../wgsl/sort_rank.wgsl")),
            vec![NEW_CELLS, KEYS, LOOSE, RECORD, written(ORDER), written(OWNERS), STATUS],
            Groups::ParticlesBy(128),
        ),
        draft(
            "move",
            "move_rest",
            include_str!("../wgsl/sort_move.wgsl"),
            particles_to_next(),
            Groups::ParticlesBy(128),
        ),
    ];
    if sleeps {
        let old_watch = ("old_watch", WATCH.1, WATCH.2, WATCH.3);
        let text = wgsl::WATCH_CARRY.to_owned() + words;
        let uses = with_watch(vec![old_lists, DIRECTORY, old_watch, STATUS]);
        passes.push(draft("carry", "carry", &text, uses, Groups::BlocksBy(64)));
    }
    if levels {
        let placed = include_str!("../wgsl/sort_placed.wgsl");
        let listed = include_str!("../wgsl/listed.wgsl").to_owned() + include_str!("../wgsl/sort_list.wgsl");
        let groups: Use = ("groups", "u32", Role::Groups, true);
        let uses = vec![written(LISTED), groups, NEW_LISTS, STATUS];
        passes.extend([
            rims,
            draft("lists", "list_blocks", &listed, uses, Groups::One),
            draft("placed", "placed", placed, vec![STATUS], Groups::One),
        ]);
    }
    if !is_error {
        // Before blocks are numbered anew.
        let at =
            passes.iter().position(|pass| pass.name == "survey").expect("the passes of a sort, listed above, have it");
        let left = include_str!("../wgsl/sort_left.wgsl");
        passes.insert(at, draft("left", "sum_left", left, vec![LISTS, STATUS], Groups::Layers));
    }
    if leaving == Leaving::Delete {
        passes.push(draft("gone", "gone", include_str!("../wgsl/sort_gone.wgsl"), vec![STATUS], Groups::One));
    }
    passes
}
