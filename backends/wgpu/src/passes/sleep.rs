//! Who sleeps.

use crate::passes::binding::{
    CELLS, Draft, Groups, LISTS, OWNERS, RECORD, RIMS, Role, STATUS, Uniform, Use, WATCH, blocks, written,
};
use crate::passes::conditions::chosen;
use crate::passes::since_sort::SINCE_SORT;
use barchan_grid::wgsl;

/// Who sleeps in a step.
pub(crate) fn watch(levels: bool) -> Draft {
    let body = chosen(wgsl::WATCH, &[("levels", levels)]);
    let tools: Use = ("tools", "vec4<i32>", Role::Tools, false);
    let mut uses = vec![written(RECORD), written(OWNERS), CELLS, LISTS, WATCH, tools, STATUS];
    uses.extend(levels.then_some(RIMS));
    Draft {
        name: "watch",
        entry: "watch_blocks",
        body: [&body, wgsl::WATCH_WORDS, wgsl::OF_SLEEPERS, wgsl::WATCH_BOOKED, &SINCE_SORT.concat()].concat(),
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
        body: [wgsl::WATCH_SUM, wgsl::WATCH_WORDS, wgsl::WATCH_BOOKED].concat(),
        uses: vec![WATCH, STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}
