//! From tiles to velocities: sums, walls, mirrors.

use crate::passes::binding::{
    DIRECTORY, Draft, Found, GRID, Groups, HANDED, KEPT, LISTS, PAIRS, RIMS, STATUS, Uniform, WATCH, abreast, exchange,
    node_blocks, on_listed, written,
};
use crate::passes::conditions::chosen;
use crate::passes::rims::{SHARED_NODES, hand_on};
use barchan_grid::wgsl;
use barchan_grid::wgsl::HANDED_TO;

/// For passes that need sums of tiles.
pub(crate) fn plain_sums(blocks: u32) -> String {
    abreast(blocks) + &sums(Finish::Sums, [false; 3])
}

/// The pass that sums tiles; on levels, subcycled, and where ground sleeps.
fn sums(finish: Finish, [levels, subcycled, sleeps]: [bool; 3]) -> String {
    let conditions = [
        ("levels", levels),
        ("subcycled", subcycled),
        ("sleeps", sleeps),
        ("sums", finish == Finish::Sums),
        ("mirrored", finish == Finish::Mirrored),
    ];
    chosen(include_str!("../wgsl/grid.wgsl"), &conditions)
}

/// For passes that need sums of tiles at rims.
pub(crate) fn sums_of_tiles(blocks: u32) -> String {
    plain_sums(blocks) + include_str!("../wgsl/rim_sums.wgsl")
}

/// What the pass that sums tiles leaves at nodes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finish {
    /// Momenta, for walls that let go.
    Sums,
    Velocities,
    /// Velocities, behind mirrors, too.
    Mirrored,
}

pub(crate) fn sum_tiles(finish: Finish, levels: bool, subcycled: bool, sleeps: bool) -> Draft {
    let mirrored = finish == Finish::Mirrored;
    let mirrors = if mirrored { images() + wgsl::MIRRORED } else { String::new() };
    let rims = if levels { include_str!("../wgsl/rim_sums.wgsl") } else { "" };
    let shared = if subcycled {
        [SHARED_NODES, include_str!("../wgsl/keep_back.wgsl"), &hand_on()].concat()
    } else {
        String::new()
    };
    let mut uses = vec![LISTS, GRID, STATUS];
    if mirrored {
        uses = vec![written(LISTS), GRID, STATUS, DIRECTORY];
    }
    if levels {
        uses.extend([DIRECTORY, RIMS, HANDED]);
    }
    if subcycled {
        uses = vec![written(LISTS), GRID, STATUS, DIRECTORY, RIMS, written(HANDED), KEPT];
    }
    uses.extend(sleeps.then_some(WATCH));
    let watch = if sleeps { [wgsl::WATCH_WORDS, wgsl::WATCH_GRID].concat() } else { String::new() };
    Draft {
        name: "grid",
        entry: "sum_tiles",
        body: abreast(1)
            + &sums(finish, [levels, subcycled, sleeps])
            + &mirrors
            + rims
            + if levels && !subcycled { HANDED_TO } else { "" }
            + &shared
            + &watch,
        uses,
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

pub(crate) fn velocities(levels: bool) -> Draft {
    let body = plain_sums(1);
    Draft {
        name: "velocities",
        entry: "velocities",
        body: body + include_str!("../wgsl/velocities.wgsl"),
        uses: vec![LISTS, GRID, STATUS],
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// Nodes at the edge of live ground are held at rest.
pub(crate) fn hold(levels: bool) -> Draft {
    Draft {
        name: "hold",
        entry: "hold",
        body: include_str!("../wgsl/hold.wgsl").to_owned(),
        uses: vec![written(LISTS), GRID, RIMS, STATUS],
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// A wall that lets go decides; afterwards (`back`) images take their nodes' velocities. Nodes at rims are the next coarser level's business. `pressed`: parts of walls
/// are told of what the wall gives.
pub(crate) fn separate(axis: usize, back: bool, levels: bool, pressed: bool) -> Draft {
    let is_slave = if levels { "(rims[g][n >> 5u] & (1u << (n & 31u))) != 0u" } else { "false" };
    let constants =
        format!("const AXIS: u32 = {axis}u;\nfn is_slave(g: u32, n: u32) -> bool {{ return {is_slave}; }}\n");
    Draft {
        name: if back { "mirror" } else { "separate" },
        entry: if back { "mirror_back" } else { "separate" },
        body: constants + wgsl::MIRRORS + &chosen(wgsl::SEPARATE, &[("pressed", pressed)]),
        uses: [DIRECTORY, written(LISTS), GRID, PAIRS, STATUS].into_iter().chain(levels.then_some(RIMS)).collect(),
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// For passes in which nodes behind mirrors take the velocities of their images, a block a workgroup.
pub(crate) fn images() -> String {
    [
        exchange(64).as_str(),
        wgsl::MIRRORS,
        wgsl::BEHIND,
        wgsl::IMAGE,
        include_str!("../wgsl/sum_of_block.wgsl"),
        wgsl::WALL,
    ]
    .concat()
}

/// Velocities of nodes behind mirrors. Where these are found early if no body comes near walls (`mirrored`), what others give to walls is booked at once.
pub(crate) fn reflect(sleeps: bool, levels: bool, mirrored: bool) -> Draft {
    // Where it is seldom asked for, all blocks are visited.
    let listed = levels && !mirrored;
    let conditions = [("sleeps", sleeps), ("mirrored", mirrored), ("listed", listed)];
    let mut uses = vec![DIRECTORY, written(LISTS), GRID, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    let draft = Draft {
        name: "reflect",
        entry: "reflect_nodes",
        body: [
            abreast(1).as_str(),
            &images(),
            &chosen(wgsl::REFLECT, &conditions),
            include_str!("../wgsl/velocity_at.wgsl"),
            wgsl::MIRROR_NODE,
            if sleeps { wgsl::WATCH_WORDS } else { "" },
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: Groups::NodeBlocks,
        checked: true,
    };
    if listed { on_listed(Found::Walled, draft) } else { draft }
}

/// `mirrored`: the last step's gifts still wait for the next one.
pub(crate) fn collect(mirrored: bool) -> Draft {
    Draft {
        name: "wall impulse",
        entry: "collect",
        body: chosen(include_str!("../wgsl/collect.wgsl"), &[("mirrored", mirrored)]),
        uses: vec![written(LISTS), STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}
