//! From tiles to velocities: sums, walls, mirrors.

use crate::passes::binding::{
    DIRECTORY, Draft, Found, GRID, Groups, HANDED, KEPT, LISTS, PAIRS, RIMS, STATUS, Uniform, WATCH, abreast, exchange,
    node_blocks, on_all, on_listed, written,
};
use crate::passes::p2g::each_node;
use crate::passes::rims::{SHARED_NODES, hand_on};
use crate::passes::sleep::{WATCH_WORDS, with_sleep};

/// For passes that need sums of tiles.
pub(crate) fn plain_sums(blocks: u32) -> String {
    abreast(blocks)
        + &include_str!("../wgsl/grid.wgsl")
            .replace("$SUM_TILES", "grid[g * 64u + n] = sum_of_tiles(entry, n);")
            .replace("$TOUCHED", "")
            .replace("$IMAGE", "")
            .replace("$AT_RIM", "")
}

/// For passes that need sums of tiles at rims.
pub(crate) fn sums_of_tiles(blocks: u32) -> String {
    plain_sums(blocks) + include_str!("../wgsl/rim_sums.wgsl")
}

/// Folds what lies behind the walls across an axis, every other plane by the one half of the threads and the rest by the other, a thread a row. The axis is
/// written out, so that compilers see which walls there are.
pub(crate) fn fold(axis: usize) -> String {
    let d = ["x", "y", "z"][axis];
    let node = |plane: &str| match axis {
        0 => format!("vec3<u32>(u32({plane}), row)"),
        1 => format!("vec3<u32>(row.x, u32({plane}), row.y)"),
        _ => format!("vec3<u32>(row, u32({plane}))"),
    };
    // Node and image are as far from the wall: the sum of their planes is known. Beyond the low wall lie the lower planes, beyond the high one the upper.
    let end = |kind: &str, bound: &str, first: &str, last: &str| {
        let (source, to) = (node("image"), node("sum - image"));
        format!(
            "{{\nlet sum = 2 * ({bound}.{d} - first_node.{d}) - 1;\n\
             if {kind}.{d} != 0u && sum >= 1 && sum <= 13 && !is_done {{\n\
             let signs = wall_signs({kind}.{d}, {axis});\n\
             for (var image = {first} + i32(part); image <= {last}; image += 2) {{\n\
             impulse += fold_node({source}, {to}, signs);\n}}\n}}\n}}\n"
        )
    };
    // What is behind a wall across an axis before has been folded already.
    let behind = |before: usize| {
        let b = ["x", "y"][before];
        format!(
            " || (LOW.{b} != 0u && first_node.{b} + i32(row.{b}) < least.{b}) || (HIGH.{b} != 0u && first_node.{b} + i32(row.{b}) >= end_node.{b})"
        )
    };
    let is_done: String = (0..axis).map(behind).collect();
    let low = end("LOW", "least", "max(sum - 7, 0)", "(sum - 1) / 2");
    let high = end("HIGH", "end_node", "(sum + 1) / 2", "min(sum, 7)");
    // Across a world narrower than this, both walls fold onto the same planes.
    let narrow = format!(
        "if LOW.{d} != 0u && HIGH.{d} != 0u && ((WORLD_MAX.{d} - WORLD_MIN.{d}) >> (LEVELS - 1u)) < 4 {{\nworkgroupBarrier();\n}}\n"
    );
    format!("{{\nlet is_done = false{is_done};\n{low}{narrow}{high}}}\nworkgroupBarrier();\n")
}

/// Adds the sums of the cell `at` to the tile: for one of its 27 nodes at a time, different cells touch different nodes. Places that differ along x alone are
/// found once.
pub(crate) fn flush() -> String {
    let place = |n: usize| format!("let t{n} = part * 512u + in_tile(at.x, at.y + {}u, at.z + {}u);\n", n / 3, n % 3);
    let add = |n: usize, [i, ..]: [usize; 3]| format!("tile[t{} + {}u] += a{n};\nworkgroupBarrier();\n", n % 9, 64 * i);
    (0..9).map(place).collect::<String>() + &each_node(add)
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

/// Of nodes behind mirrors, what their velocity is made of.
pub(crate) const IMAGE: &str = "let first = 4 * lists[entry].xyz;
    let layer = layer_of(min(g, extent.node_room - 1u));
    let behind = has_nodes_behind(layer, first);
    var image = Image(first + local, vec3<f32>(1.0), vec3<f32>(1.0), false);
    var there = tiles;
    var booked = vec4<f32>(0.0);
    if behind {
        image = image_of(layer, first + local);
        if image.is_other {
            there = tiles_at(layer, image.cell);
        }
        if n == 0u {
            booked = bitcast<vec4<f32>>(lists[entry + WALL]) + bitcast<vec4<f32>>(lists[entry + PENDING]);
        }
    }
    if n == 0u {
        mirrors = u32(behind);
    }";

pub(crate) fn sum_tiles(finish: Finish, levels: bool, subcycled: bool, sleeps: bool) -> Draft {
    let sum = match (levels, subcycled) {
        (false, _) => "sum_of(tiles, local)",
        (true, false) => "kept(g, n, sum_of(tiles, local) + given)",
        (true, true) => "kept_back(g, n, sum, tiles, local)",
    };
    // Subcycled, what rims hand on is not needed here, and both begin with the same sums.
    let hand_on_here = "let sum = sum_of(tiles, local);\nif workgroupUniformLoad(&at_rim) != 0u {\n\
                        let hands = is_slave(g, n) && !(MIRRORED && is_behind(layer_of(g), 4 * lists[entry].xyz + local));\n\
                        hand_on(g, entry, n, select(vec4<f32>(0.0), sum, hands));\n}\n";
    let at_rim = "at_rim = rims[min(g, extent.node_room - 1u)].z & HANDS_ON;";
    // Else it is, where blocks get any.
    let take_here = "var given = vec4<f32>(0.0);\nif workgroupUniformLoad(&takes) != 0u {\n\
                     find_givers(g, n);\nworkgroupBarrier();\ngiven = handed_to(n);\n}\n";
    let takes = "takes = rims[min(g, extent.node_room - 1u)].z & IS_GIVEN;";
    let if_subcycled = |text: &'static str| if subcycled { text } else { "" };
    let if_taken = |text: &'static str| if levels && !subcycled { text } else { "" };
    let find = format!("let node = velocity(g, {sum});\n");
    let text = match finish {
        Finish::Sums => format!("grid[g * 64u + n] = {sum};"),
        Finish::Velocities => find + "grid[g * 64u + n] = node;\nnote_speed(g, node, n);",
        Finish::Mirrored => {
            find + "var now = node;\n\
             if workgroupUniformLoad(&mirrors) != 0u {\nnow = reflect(g, entry, n, image, there, booked, node);\n}\n\
             grid[g * 64u + n] = now;\nnote_speed(g, node, n);"
        }
    };
    let mirrored = finish == Finish::Mirrored;
    let mirrors = if mirrored { images() + include_str!("../wgsl/mirrored.wgsl") } else { String::new() };
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
    // Half of the threads find out while the first one looks whether there is such a block.
    let tied = if levels { "| u32(any(rims[min(g, extent.node_room - 1u)].xyz != vec3<u32>(0u)))" } else { "" };
    let touched = format!(
        "if n >= 32u && n < 59u {{\nlook_at(g, n - 32u);\n}}\nworkgroupBarrier();\n\
         if n == 0u && go != 0u {{\ngo = atomicLoad(&touched) {tied};\natomicStore(&watch[touched_word(g)], go);\n}}"
    );
    let body = abreast(1) + &with_sleep(sleeps, include_str!("../wgsl/grid.wgsl"), &[("$TOUCHED", &touched)]);
    let watch = if sleeps { [WATCH_WORDS, include_str!("../wgsl/watch_grid.wgsl")].concat() } else { String::new() };
    Draft {
        name: "grid",
        entry: "sum_tiles",
        body: body
            .replace("$SUM_TILES", &[if_subcycled(hand_on_here), if_taken(take_here), &text].concat())
            .replace("$AT_RIM", &[if_subcycled(at_rim), if_taken(takes)].concat())
            .replace("$IMAGE", if mirrored { IMAGE } else { "" })
            + &mirrors
            + rims
            + if_taken(include_str!("../wgsl/handed_to.wgsl"))
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

/// A wall that lets go decides; afterwards (`back`) images take their nodes' velocities. Nodes at rims are the next coarser level's business.
pub(crate) fn separate(axis: usize, back: bool, levels: bool) -> Draft {
    let is_slave = if levels { "(rims[g][n >> 5u] & (1u << (n & 31u))) != 0u" } else { "false" };
    let constants =
        format!("const AXIS: u32 = {axis}u;\nfn is_slave(g: u32, n: u32) -> bool {{ return {is_slave}; }}\n");
    Draft {
        name: if back { "mirror" } else { "separate" },
        entry: if back { "mirror_back" } else { "separate" },
        body: constants + include_str!("../wgsl/separate.wgsl"),
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
        include_str!("../wgsl/mirrors.wgsl"),
        include_str!("../wgsl/behind.wgsl"),
        include_str!("../wgsl/image.wgsl"),
        include_str!("../wgsl/sum_of_block.wgsl"),
        include_str!("../wgsl/wall.wgsl"),
    ]
    .concat()
}

/// What folding gave to a block's nodes, and handing on to parents behind walls.
pub(crate) const PENDING: &str = "let blocks = atomicLoad(&status[BLOCKS]);
    let pending = bitcast<vec4<f32>>(lists[w * ENTRY + PENDING]);
    let before = bitcast<vec4<f32>>(lists[w * ENTRY + WALL]);";

pub(crate) const BOOK: &str = "if w < blocks && any(pending != vec4<f32>(0.0)) && is_live(u32(lists[w * ENTRY].w)) {
        lists[w * ENTRY + WALL] = bitcast<vec4<i32>>(before + pending);
    }
    if LEVELS > 1u && is_live(layer_of(w)) {
        let entry = (extent.block_room + w) * ENTRY;
        book(entry + WALL, bitcast<vec4<f32>>(lists[entry + PENDING]));
    }";

/// Velocities of nodes behind mirrors. Where these are found early if no body comes near walls (`mirrored`), what others give to walls is booked at once.
pub(crate) fn reflect(sleeps: bool, levels: bool, mirrored: bool) -> Draft {
    let touched = [("$IF_TOUCHED", " && atomicLoad(&watch[touched_word(w)]) != 0u")];
    let mut uses = vec![DIRECTORY, written(LISTS), GRID, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    let draft = Draft {
        name: "reflect",
        entry: "reflect_nodes",
        body: [
            abreast(1).as_str(),
            &images(),
            &with_sleep(sleeps, include_str!("../wgsl/reflect.wgsl"), &touched)
                .replace("$PENDING", if mirrored { "" } else { PENDING })
                .replace("$BOOK", if mirrored { "" } else { BOOK }),
            include_str!("../wgsl/velocity_at.wgsl"),
            include_str!("../wgsl/mirror_node.wgsl"),
            if sleeps { WATCH_WORDS } else { "" },
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: Groups::NodeBlocks,
        checked: true,
    };
    // Where it is seldom asked for, all blocks are visited.
    if levels && !mirrored { on_listed(Found::Walled, draft) } else { on_all(draft) }
}

/// `mirrored`: the last step's gifts still wait for the next one.
pub(crate) fn collect(mirrored: bool) -> Draft {
    let pending = "if u32(lists[entry + PENDING].w) < done {\nsum += vec4<f32>(bitcast<vec3<f32>>(lists[entry + PENDING].xyz), 0.0);\n}\n\
                   lists[entry + PENDING] = vec4<i32>(0);";
    let done = "let done = select(NONE, atomicLoad(&status[HALT_STEP]), atomicLoad(&status[HALTED]) != 0u);\n";
    Draft {
        name: "wall impulse",
        entry: "collect",
        body: include_str!("../wgsl/collect.wgsl")
            .replace("$PENDING", &if mirrored { [done, pending].concat() } else { String::new() }),
        uses: vec![written(LISTS), STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}
