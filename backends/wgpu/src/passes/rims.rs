//! What levels exchange at their rims.

use crate::passes::binding::{
    DIRECTORY, Draft, Found, GRID, Groups, HANDED, KEPT, LISTED, LISTS, RIMS, STATUS, Uniform, abreast, exchange,
    on_listed, written,
};
use crate::passes::conditions::chosen;
use crate::passes::grid::sums_of_tiles;
use barchan_grid::wgsl;

/// What rims hand to the next coarser level.
pub(crate) fn restrict() -> Draft {
    on_listed(
        Found::Rims,
        Draft {
            name: "restrict",
            entry: "restrict_rims",
            body: sums_of_tiles(1) + &hand_on() + wgsl::RESTRICT,
            uses: vec![written(LISTS), GRID, STATUS, DIRECTORY, RIMS, written(HANDED)],
            uniform: Uniform::None,
            groups: Groups::NodeBlocks,
            checked: true,
        },
    )
}

/// For passes in which rims hand something on.
pub(crate) fn hand_on() -> String {
    [
        exchange(256).as_str(),
        wgsl::HANDED,
        wgsl::HAND_ON,
        include_str!("../wgsl/sum_of_block.wgsl"),
        wgsl::MIRRORS,
        wgsl::BEHIND,
        wgsl::WALL,
    ]
    .concat()
}

/// Velocities at rims and, subcycled, of nodes that two levels share, so many blocks a workgroup, but for the pass's entry.
pub(crate) fn at_rims(subcycled: bool, blocks: u32) -> Draft {
    let own: String = if subcycled {
        [&sums_of_tiles(blocks), wgsl::HANDED_TO, SHARED_NODES, include_str!("../wgsl/solve.wgsl"), wgsl::MIRROR_NODE]
            .concat()
    } else {
        [&abreast(blocks), include_str!("../wgsl/velocity_at.wgsl"), wgsl::PROLONG_TASKS].concat()
    };
    let mut uses = vec![DIRECTORY, written(LISTS), GRID, RIMS, STATUS, LISTED];
    if subcycled {
        uses.extend([HANDED, KEPT]);
    }
    Draft {
        name: if subcycled { "solve" } else { "prolong" },
        entry: "rims_alone",
        body: [
            &own,
            wgsl::PROLONG,
            include_str!("../wgsl/sum_of_block.wgsl"),
            wgsl::MIRRORS,
            wgsl::BEHIND,
            wgsl::IMAGE,
            wgsl::WALL,
            &chosen(wgsl::RIMS, &[("subcycled", subcycled)]),
            include_str!("../wgsl/listed.wgsl"),
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: Groups::Found(Found::RimsInFours),
        checked: true,
    }
}

/// In a pass of its own.
pub(crate) fn rims_alone(subcycled: bool) -> Draft {
    let draft = at_rims(subcycled, 4);
    Draft { body: [&exchange(256), &draft.body, wgsl::RIMS_ALONE].concat(), ..draft }
}

pub(crate) const SHARED_NODES: &str = concat!(include_str!("../wgsl/own.wgsl"), include_str!("../wgsl/shared.wgsl"));
