//! Particles to grid.

use crate::device::MANY;
use crate::passes::binding::{
    CELLS, Draft, Found, GRID, Groups, HANDED, LISTED, LISTS, RECORD, STATUS, Uniform, WATCH, blocks, written,
};
use crate::passes::grid::{flush, fold};
use crate::passes::sleep::{WATCH_WORDS, with_sleep};
use std::fmt::Write as _;

/// Where there are several levels, P2G also sums parent cells for rims. Subcycled, further workgroups visit blocks once more that give to nodes which
/// two levels share, and leave forces out.
pub(crate) fn p2g([sleeps, mirrored, levels, subcycled, stiffens]: [bool; 5], particles: usize) -> Draft {
    // Where there are few, the memory waits for nobody else; many are faster with the registers that another takes.
    let ahead = if particles < MANY { 2 } else { 1 };
    let at_rim = match (levels, subcycled) {
        (false, _) => "",
        (true, false) => "at_rim = u32(lists[here * ENTRY + OF_RIMS].w) & 1u;",
        (true, true) => "at_rim = select(u32(lists[here * ENTRY + OF_RIMS].w) & 1u, 0u, is_still);",
    };
    let xy = Half {
        rows: &[("s", 1), ("t", 5), ("r0", 2), ("r1", 3)],
        add: add_momentum(XY, |node, w| format!("{node} = fma(vec2<f32>({w}), u, {node});")),
    };
    let zm = Half {
        rows: &[("s", 1), ("r2", 4)],
        add: add_momentum(ZM, |node, w| format!("{node} = vec2<f32>(fma({w}, u, {node}.x), fma({w}, m, {node}.y));")),
    };
    let zero = |n: usize| format!("a{n} = vec2<f32>(0.0);\n");
    let body = include_str!("../wgsl/p2g.wgsl")
        .replace("$ZERO", &each_node(|n, _| format!("var {}", zero(n))))
        .replace("$CLEAR", &each_node(|n, _| zero(n)))
        .replace("$OWN_XY", &xy.own(ahead, "left |= select(0u, 1u << min(done, 31u), has_left);\n"))
        .replace("$OWN_ZM", &zm.own(ahead, ""))
        .replace("$GUESTS_XY", &xy.guests())
        .replace("$GUESTS_ZM", &zm.guests())
        .replace("$FOLD", &[0, 1, 2].map(fold).concat())
        .replace("$FLUSH", &flush())
        .replace("$IS_STIFF", if stiffens { "is_stiff = is_too_stiff(layer);" } else { "" })
        .replace("$HALT_IF_STIFF", if stiffens { HALT_IF_STIFF } else { "" })
        .replace("$KEPT_NEED", if sleeps { "atomicLoad(&status[need_word(step.number + 1u, layer)])" } else { "0u" })
        .replace("$GIVES", if sleeps { "gives(b, layer)" } else { "1u" })
        .replace("$BOOK_LAST", if mirrored { BOOK_LAST } else { "" })
        .replace("$BOOKED", if sleeps { "select(total, 0.0, is_frozen != 0u)" } else { "total" })
        .replace("$BLOCK", if subcycled { GIVER } else { "let b = group.y * extent.row + group.x;" })
        .replace("$STILL", if subcycled { "if is_still {\nstress = 0.0;\ngravity = vec3<f32>(0.0);\n}" } else { "" })
        .replace("$IF_MOVED", if subcycled { " && !is_still" } else { "" })
        .replace("$AT_RIM", at_rim)
        .replace("$TILE", if subcycled { TILE_OR_STILL } else { "grid[base + t] = node;" })
        .replace("$PARENT_CELLS", if levels { PARENT_CELLS } else { "" });
    let settle = if subcycled { "if !is_still {\nsettle(b);\n}" } else { "settle(b);" };
    let body = with_sleep(sleeps, &body, &[("$SETTLE", settle)]);
    let watch = if sleeps { [WATCH_WORDS, include_str!("../wgsl/watch_p2g.wgsl")].concat() } else { String::new() };
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
            if_levels(include_str!("../wgsl/parent_cells.wgsl")),
            if_levels(include_str!("../wgsl/handed.wgsl")),
            if subcycled {
                concat!(include_str!("../wgsl/listed.wgsl"), include_str!("../wgsl/blocks_now.wgsl"))
            } else {
                ""
            },
            include_str!("../wgsl/rounds.wgsl"),
            include_str!("../wgsl/reaches_wall.wgsl"),
            include_str!("../wgsl/wall.wgsl"),
            include_str!("../wgsl/since_sort.wgsl"),
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

/// The next step's needs come into the word in which those of the step before the last have been; those asleep, which nobody asks, go on needing
/// what they did.
pub(crate) const HALT_IF_STIFF: &str = "if is_first {
            atomicStore(&status[need_word(step.number, layer)], $KEPT_NEED);
        }
        if is_stiff {
            if is_first {
                atomicStore(&status[HALT_STEP], step.number);
                atomicStore(&status[HALTED], TOO_STIFF);
            }
            return 0u;
        }";

/// What the step before would give, it has given, since another follows.
pub(crate) const BOOK_LAST: &str =
    "let given = bitcast<f32>(lists[b * ENTRY + WALL][thread]) + bitcast<f32>(lists[b * ENTRY + PENDING][thread]);
            lists[b * ENTRY + WALL][thread] = bitcast<i32>(given);
            lists[b * ENTRY + PENDING].w = i32(step.number);";

/// A workgroup's block, or, behind all of them, one that gives to nodes which two levels share.
pub(crate) const GIVER: &str = "let which = group.y * extent.row + group.x;
    let own_blocks = blocks_now();
    let is_still = which >= own_blocks;
    let number = max(which, own_blocks) - own_blocks;
    let b = select(which, listed_block(GIVING, number), is_still);";

pub(crate) const TILE_OR_STILL: &str = "if is_still {
            handed[of_still_tile(number) + t] = node;
        } else {
            grid[base + t] = node;
        }";

pub(crate) const PARENT_CELLS: &str = "
    // 5. Parent cells, for rims.
    if workgroupUniformLoad(&at_rim) != 0u {
        sum_parent_cells(b, thread, count);
    }";

pub(crate) fn each_node(text: impl Fn(usize, [usize; 3]) -> String) -> String {
    (0..27).map(|n| text(n, [n / 9, n / 3 % 3, n % 3])).collect()
}

/// Momentum along x and y as seen from the first node, and what each step along x, y and z adds.
pub(crate) const XY: &str = "
    let m = s.w;
    let ax = m * width * r0.yzw + stress * vec3<f32>(t.x, t.z, s.x);
    let ay = m * width * r1.yzw + stress * vec3<f32>(t.z, t.y, s.y);
    let base = vec2<f32>(fma(m, r0.x + gravity.x, dot(ax, d)), fma(m, r1.x + gravity.y, dot(ay, d)));
    let by_x = vec2<f32>(ax.x, ay.x);
    let by_y = vec2<f32>(ax.y, ay.y);
    let by_z = vec2<f32>(ax.z, ay.z);
";

/// Likewise along z.
pub(crate) const ZM: &str = "
    let m = s.w;
    let az = m * width * r2.yzw + stress * s.xyz;
    let base = fma(m, r2.x + gravity.z, dot(az, d));
    let by_x = az.x;
    let by_y = az.y;
    let by_z = az.z;
";

/// One of the two threads that own a cell.
pub(crate) struct Half {
    /// What it reads of a particle besides its place: names and numbers of vectors.
    rows: &'static [(&'static str, u32)],
    /// Adds the particle to the sums of the 27 nodes around.
    add: String,
}

impl Half {
    /// Over the cell's own particles. So many are fetched before the present one is added; behind the last, the block's first. One that is no longer
    /// there weighs nothing, and `leaver` is done with it. Nothing here is left out where it is not needed: small worlds wait for branches more than
    /// for arithmetic.
    pub(crate) fn own(&self, ahead: usize, leaver: &str) -> String {
        let each =
            |line: &dyn Fn(&str, u32) -> String| -> String { self.rows.iter().map(|(v, k)| line(v, *k)).collect() };
        let declare = |n: usize| {
            format!("var p_{n} = vec4<u32>(0u);\n{}", each(&|v, _| format!("var {v}_{n} = vec4<f32>(0.0);\n")))
        };
        let fetch = |n: usize| {
            let rows = each(&|v, k| format!("{v}_{n} = bitcast<vec4<f32>>(record_of(at, {k}u));\n"));
            format!("{{\nlet at = select(start, next, rank < count);\np_{n} = record_of(at, 0u);\n{rows}}}\n")
        };
        let advance = "rank += 1u;\nnext += 1u;\n\
                       if rank % TOGETHER == 0u && rank <= ROUNDS * TOGETHER {\n\
                       next = ahead;\nahead = cells[round_at(here, round_of(rank) + u32(rank < ROUNDS * TOGETHER), own)];\n}\n";
        let shift = |n: usize| format!("p_{} = p_{n};\n{}", n - 1, each(&|v, _| format!("{v}_{} = {v}_{n};\n", n - 1)));
        let take = format!("let p = p_0;\n{}", each(&|v, _| format!("let {v} = {v}_0;\n")));
        let last = ahead - 1;
        [
            "var rank = 0u;\n".to_owned(),
            (0..ahead).map(declare).collect(),
            fetch(0),
            (1..ahead).map(|n| advance.to_owned() + &fetch(n)).collect(),
            format!("while rank < count + {last}u {{\n{take}"),
            (1..ahead).map(shift).collect(),
            advance.to_owned(),
            fetch(last),
            format!(
                "let is_beside = (p.w & BESIDE) != 0u;\n\
                 let f = fraction(p) + select(vec3<f32>(0.0), vec3<f32>(cell_of(p.w) - vec3<i32>(own_cell)), is_beside);\n\
                 let has_left = (p.w & LEFT_HOME) != 0u;\nlet part_here = select(1.0, 0.0, has_left);\n\
                 let done = rank - {ahead}u;\n{leaver}{}}}\n",
                self.add
            ),
        ]
        .concat()
    }

    /// Over those that have come from other cells.
    pub(crate) fn guests(&self) -> String {
        let fetch = |(v, k): &(&str, u32)| format!("let {v} = bitcast<vec4<f32>>(record_of(q, {k}u));\n");
        format!(
            "for (var q = next_leaver(&walk); q != NONE; q = next_leaver(&walk)) {{\nlet p = record_of(q, 0u);\n\
             let f = fraction(p);\nlet part_here = 1.0;\n{}{}}}\n",
            self.rows.iter().map(fetch).collect::<String>(),
            self.add
        )
    }
}

/// Adds the momentum u of a particle at place `f` of its cell, times `part_here`, as seen from each of the 27 nodes around: what it is at the first one and grows by
/// along the axes; and how, times a weight, it enters the node's sum.
pub(crate) fn add_momentum(momentum: &str, sum: fn(&str, &str) -> String) -> String {
    let mut text = format!(
        "let d = vec3<f32>(-0.5) - f;\n\
         let wx = weights(f.x) * part_here;\nlet wy = weights(f.y);\nlet wz = weights(f.z);\n{momentum}"
    );
    for i in 0..3 {
        for j in 0..3 {
            let _ = write!(text, "{{ let w = wx[{i}] * wy[{j}];\nvar u = base + {i}.0 * by_x + {j}.0 * by_y;\n");
            for k in 0..3 {
                let sum = sum(&format!("a{}", 9 * i + 3 * j + k), &format!("w * wz[{k}]"));
                let _ = writeln!(text, "{sum}{}", if k < 2 { " u += by_z;" } else { "" });
            }
            text.push_str("}\n");
        }
    }
    text
}
