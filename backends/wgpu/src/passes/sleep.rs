//! Who sleeps.

use crate::passes::binding::{
    CELLS, Draft, Groups, LISTS, OWNERS, RECORD, RIMS, Role, STATUS, Uniform, Use, WATCH, blocks, written,
};
use crate::passes::conditions::chosen;
use crate::passes::since_sort::SINCE_SORT;

/// What passes know of the rest of blocks.
pub(crate) const WATCH_WORDS: &str = include_str!("../wgsl/watch_words.wgsl");

/// Who sleeps in a step.
pub(crate) fn watch(levels: bool) -> Draft {
    let body = chosen(include_str!("../wgsl/watch.wgsl"), &[("levels", levels)]);
    let tools: Use = ("tools", "vec4<i32>", Role::Tools, false);
    let mut uses = vec![written(RECORD), written(OWNERS), CELLS, LISTS, WATCH, tools, STATUS];
    uses.extend(levels.then_some(RIMS));
    Draft {
        name: "watch",
        entry: "watch_blocks",
        body: [&body, WATCH_WORDS, include_str!("../wgsl/watch_booked.wgsl"), &SINCE_SORT.concat()].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(levels),
        checked: true,
    }
}

/// What sleep took, and kept gravity from.
pub(crate) fn sum_sleep() -> Draft {
    Draft {
        name: "sleep",
        entry: "sum_sleep",
        body: [include_str!("../wgsl/watch_sum.wgsl"), WATCH_WORDS, include_str!("../wgsl/watch_booked.wgsl")].concat(),
        uses: vec![WATCH, STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}
