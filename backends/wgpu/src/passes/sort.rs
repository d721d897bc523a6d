//! Particles into blocks and cells.

use crate::passes::binding::{
    CELLS, COUNTS, DIRECTORY, Draft, FLAGS, Groups, KEYS, LISTED, LISTS, LIVE, LOOSE, NEW_CELLS, NEW_LISTS, ORDER,
    OWNERS, RECORD, RIMS, Role, STATUS, SUMS, Sorted, Uniform, Use, WATCH, atomic, next, particles_to_next, written,
};
use crate::passes::scene::{may_sleep, regions};
use crate::passes::sleep::{WATCH_WORDS, with_sleep};
use barchan_core::Plan;
use barchan_core::scene::Leaving;

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
    let only_with_levels = |text: &'static str| if levels { text } else { "" };
    let check = only_with_levels(
        " else if due && !is_placed(layer, cell, vec3<i32>(record_of(q, 0u).xyz >> vec3<u32>(31u))) {\n\
         atomicStore(&status[sum_word(layer, ASTRAY)], 1u);\n}",
    );
    let rim = only_with_levels("reached |= u32(reached == 0u && on && takes_from_rim(layer, block));");
    let leaving = plan.scene.world.leaving;
    let is_error = leaving == Leaving::Error;
    // What becomes of a particle outside the world; where particles change, or what they gave is noted, passes write.
    let leave = match leaving {
        Leaving::Error => {
            "atomicMin(&status[WHO], q);\natomicStore(&status[HALT_STEP], step.number);\natomicStore(&status[HALTED], LEFT_WORLD);"
        }
        // One that keeps its home is put back when its layer is due.
        Leaving::Clamp => "if due {\nmine += put_back(q, layer, block, &local);\n}",
        Leaving::Delete => {
            "set_record(q, 0u, vec4<u32>(record_of(q, 0u).xyz, tag | GONE));\nmine.w += bitcast<f32>(record_of(q, 1u).w);\n\
             atomicAdd(&status[sum_word(layer, LEFT)], 1u);\ncontinue;"
        }
    };
    // Whom the world ends for at a face of cells is put back there, or goes; an error is one at the side itself. Those of layers that are not
    // due stand in their homes.
    let outside = if is_error {
        "due && is_beyond(layer, cell, record_of(q, 0u).xyz)"
    } else {
        "any(((cell < world_min(layer)) | (cell >= world_max(layer))) & (PERIOD == vec3<i32>(0)))"
    };
    let unless_error = |text: &'static str| if is_error { "" } else { text };
    let mark_text = include_str!("../wgsl/sort_mark.wgsl")
        .replace("$CHECK", check)
        .replace("$OUTSIDE", outside)
        .replace("$LEAVE", leave)
        .replace("$BEGIN", unless_error("var mine = vec4<f32>(0.0);"))
        .replace("$END", unless_error("note_left(b, thread, mine);"));
    let changed = |binding: Use| if is_error { binding } else { written(binding) };
    let sleeps = may_sleep(plan);
    // Where particles come or go, nobody goes on sleeping.
    let words = if sleeps { WATCH_WORDS } else { "" };
    let fresh = "if thread < WATCHED {\n\
                 atomicStore(&watch[watch_word(w, thread)], select(select(0u, NONE, thread == DECIDED), 1u, thread == RESTS));\n}";
    let link_text = with_sleep(sleeps, include_str!("../wgsl/sort_link.wgsl"), &[("$FRESH", fresh)]);
    let stir = "fn stir(at: u32) {\nif at != NONE && directory[at].x != NONE {\n\
                note_happened(directory[at].x, STIRRED);\n}\n}\n";
    let texts = [
        ("$GONE", "stir(place_in_box(layer, block));"),
        ("$COME", "if any((local >> vec3<u32>(2u)) != vec3<i32>(0)) {\nstir(at);\n}"),
    ];
    let count_text =
        with_sleep(sleeps, include_str!("../wgsl/sort_count.wgsl"), &texts) + if sleeps { stir } else { "" };
    let with_watch = |mut uses: Vec<Use>| {
        uses.extend(sleeps.then_some(next("watch", WATCH)));
        uses
    };
    let old_lists = ("old_lists", "vec4<i32>", Role::Now(Sorted::Lists), false);
    let unbounded = plan.terrain.is_some();
    let (helpers, edge, find) = if unbounded {
        (include_str!("../wgsl/sort_edge.wgsl"), "atomicLoad(&edge)", "find_edge(layer, block, n);")
    } else {
        ("", "0u", "")
    };
    let rim_text = [
        include_str!("../wgsl/listed.wgsl"),
        include_str!("../wgsl/reaches_wall.wgsl"),
        include_str!("../wgsl/mirrors.wgsl"),
        include_str!("../wgsl/behind.wgsl"),
        helpers,
    ]
    .concat()
        + &include_str!("../wgsl/sort_rim.wgsl").replace("$EDGE", edge).replace("$FIND", find);
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
            body: [include_str!("../wgsl/since_sort.wgsl"), include_str!("../wgsl/sort_due.wgsl")].concat(),
            uses: vec![STATUS],
            uniform: Uniform::None,
            groups: Groups::LayersBy(64),
            checked: true,
        },
        knowing(
            draft(
                "mark",
                "mark",
                &(unless_error(include_str!("../wgsl/sort_leave.wgsl")).to_owned() + &mark_text),
                vec![changed(RECORD), changed(LISTS), CELLS, atomic(FLAGS), STATUS],
                Groups::Blocks,
            ),
            include_str!("../wgsl/sort_check.wgsl"),
        ),
        knowing(
            draft(
                "survey",
                "survey",
                &include_str!("../wgsl/sort_survey.wgsl").replace("$RIM", rim),
                vec![FLAGS, written(DIRECTORY), written(SUMS), STATUS],
                Groups::PlacesBy(1024),
            ),
            include_str!("../wgsl/rim_reach.wgsl"),
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
        let text = include_str!("../wgsl/watch_carry.wgsl").to_owned() + words;
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
