//! Particles to grid.

use crate::device::MANY;
use crate::passes::binding::{
    CELLS, Draft, Found, GRID, Groups, HANDED, LISTED, LISTS, RECORD, STATUS, Uniform, WATCH, blocks, written,
};
use crate::passes::conditions::chosen;
use crate::passes::since_sort::SINCE_SORT;
use crate::passes::unrolled::of_p2g;
use barchan_grid::wgsl;

/// Where there are several levels, P2G also sums parent cells for rims. Subcycled, further workgroups visit blocks once more that give to nodes which
/// two levels share, and leave forces out.
pub(crate) fn p2g([sleeps, mirrored, levels, subcycled, stiffens]: [bool; 5], particles: usize) -> Draft {
    // Where there are few, the memory waits for nobody else; many are faster with the registers that another takes.
    let ahead = if particles < MANY { 2 } else { 1 };
    let conditions = [
        ("sleeps", sleeps),
        ("mirrored", mirrored),
        ("levels", levels),
        ("subcycled", subcycled),
        ("stiffens", stiffens),
    ];
    let body = of_p2g(&chosen(wgsl::P2G, &conditions), ahead);
    let watch = if sleeps { [wgsl::WATCH_WORDS, wgsl::WATCH_P2G].concat() } else { String::new() };
    let mut uses = vec![RECORD, CELLS, written(LISTS), GRID, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    uses.extend(levels.then_some(written(HANDED)));
    uses.extend(subcycled.then_some(LISTED));
    let if_levels = |text: &'static str| if levels { text } else { "" };
    Draft {
        name: "P2G",
        entry: "p2g",
        body: [
            body.as_str(),
            &watch,
            if_levels(wgsl::PARENT_CELLS),
            if_levels(wgsl::HANDED),
            if subcycled {
                concat!(include_str!("../wgsl/listed.wgsl"), include_str!("../wgsl/blocks_now.wgsl"))
            } else {
                ""
            },
            include_str!("../wgsl/rounds.wgsl"),
            wgsl::REACHES_WALL,
            wgsl::WALL,
            SINCE_SORT[0],
            SINCE_SORT[1],
            if stiffens { include_str!("../wgsl/too_stiff.wgsl") } else { "" },
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: if subcycled { Groups::Found(Found::Givers) } else { blocks(levels) },
        // A workgroup goes on only if its block is one of those that hold particles, for which the sort, or the host before it
        // wrote them, has made room in all planes. G2P keeps a particle's cell within three bits an axis; one outside the 6x6x6
        // cells of the tile is never an index, and leavers beyond the list's end are only counted.
        checked: false,
    }
}
