//! Rounds of split and merge.

use crate::passes::AdaptSet;
use crate::passes::binding::{
    CELLS, Draft, Groups, IDS, LISTS, LOOSE, ORDER, RECORD, REST, Role, STATUS, SUMS, Uniform, Use, next,
    particles_to_next, written,
};
use crate::passes::scene::regions;
use crate::passes::sort::draft;
use barchan_core::Plan;
use barchan_core::levels::MERGE_LEFT;
use barchan_grid::adapt::finest_volumes;
use barchan_grid::wgsl;

/// Where particles of a cell stand.
const ROUNDS: &str = include_str!("../wgsl/rounds.wgsl");

/// Rounds of split and merge.
pub(crate) fn adapt(plan: &Plan, laws: &str, worlds: usize) -> AdaptSet<Draft> {
    let volumes = finest_volumes(plan);
    let volume = |b: usize| format!("{:?}", volumes[b] as f32);
    let last = volumes.len() - 1;
    let cases: String = (0..last).map(|b| format!("case {b}u: {{ return {}; }} ", volume(b))).collect();
    // f32 may decide otherwise than the host by no more than some roundings.
    let constants = format!(
        "const MERGE_LEFT: i32 = {MERGE_LEFT};\nconst LESS: f32 = 0.99999;\nconst MORE: f32 = 1.00001;\n\
         fn finest_volume(body: u32) -> f32 {{ switch body {{ {cases}default: {{ return {}; }} }} }}\n",
        volume(last)
    );
    let find = draft(
        "find",
        "find_concerned",
        &(regions(plan, worlds) + &constants + wgsl::ADAPT_FIND),
        vec![RECORD, REST, IDS, LISTS, CELLS, written(LOOSE), written(SUMS), STATUS],
        Groups::Blocks,
    );
    let filled: Use = ("filled", "vec4<u32>", Role::Handed, true);
    AdaptSet {
        find: [
            Draft { uniform: Uniform::Regions, ..find },
            draft(
                "sum found",
                "sum_blocks",
                include_str!("../wgsl/sort_before.wgsl"),
                vec![written(SUMS), STATUS],
                Groups::One,
            ),
            draft(
                "list",
                "list_found",
                &[ROUNDS, wgsl::ADAPT_LIST].concat(),
                vec![RECORD, LISTS, CELLS, LOOSE, SUMS, written(ORDER), next("new_record", RECORD), STATUS],
                Groups::Blocks,
            ),
            draft("copy", "copy_found", wgsl::ADAPT_COPY, particles_to_next(), Groups::ParticlesBy(128)),
        ],
        fill: draft(
            "fill",
            "fill",
            &[ROUNDS, wgsl::ADAPT_FILL].concat(),
            vec![LISTS, CELLS, REST, filled, STATUS],
            Groups::Blocks,
        ),
        remove: draft(
            "remove",
            "remove",
            wgsl::ADAPT_REMOVE,
            vec![ORDER, written(RECORD), STATUS],
            Groups::ParticlesBy(128),
        ),
        stress: Draft {
            name: "stress of new",
            entry: "stress_of_new",
            body: wgsl::ADAPT_STRESS.to_owned() + laws,
            uses: vec![written(RECORD), written(REST), STATUS],
            uniform: Uniform::Params,
            groups: Groups::ParticlesBy(128),
            checked: true,
        },
    }
}
