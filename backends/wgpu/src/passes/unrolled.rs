//! Text of passes that is written out, the one place where Rust writes what passes do in a loop: the 27 nodes around a cell or a particle stand in registers
//! `a0` to `a26`, which WGSL cannot index without putting them into memory, and compilers for GPUs unroll no loop of that length by themselves. A pass's file
//! calls `unrolled_<name>()` where such a text is to stand, so that the file alone is WGSL.

use std::fmt::Write as _;

/// A pass's text with what stands for its calls of `unrolled_<name>()`.
pub(crate) fn unrolled(text: &str, parts: &[(&str, &str)]) -> String {
    parts.iter().fold(text.to_owned(), |text, (name, part)| text.replace(&format!("unrolled_{name}();"), part))
}

/// What P2G writes out. So many particles are fetched ahead of the one that is added.
pub(crate) fn of_p2g(text: &str, ahead: usize) -> String {
    let xy = Half {
        rows: &[("s", 1), ("t", 5), ("r0", 2), ("r1", 3)],
        add: add_momentum(XY, |node, w| format!("{node} = fma(vec2<f32>({w}), u, {node});")),
    };
    let zm = Half {
        rows: &[("s", 1), ("r2", 4)],
        add: add_momentum(ZM, |node, w| format!("{node} = vec2<f32>(fma({w}, u, {node}.x), fma({w}, m, {node}.y));")),
    };
    let zero = |n: usize| format!("a{n} = vec2<f32>(0.0);\n");
    let parts = [
        ("zero", each_node(|n, _| format!("var {}", zero(n)))),
        ("clear", each_node(|n, _| zero(n))),
        ("own_xy", xy.own(ahead, "left |= select(0u, 1u << done, has_left);\n")),
        ("own_zm", zm.own(ahead, "")),
        ("unit_xy", xy.unit("if has_left {\nlist_leaver(q, q - start, p.w);\n}\n")),
        ("unit_zm", zm.unit("")),
        ("guests_xy", xy.guests()),
        ("guests_zm", zm.guests()),
        ("fold", [0, 1, 2].map(fold).concat()),
        ("flush", flush(|_, to, sum| format!("{to} += {sum};\nworkgroupBarrier();\n"))),
        ("flush_in_turn", flush(|_, to, sum| format!("if is_turn {{\n{to} += {sum};\n}}\nworkgroupBarrier();\n"))),
    ];
    unrolled(text, &parts.each_ref().map(|(name, part)| (*name, part.as_str())))
}

/// Where a particle of `own_cell` is, seen from there, and whether it counts there.
const PLACE: &str = "
    let is_beside = (p.w & BESIDE) != 0u;
    let f = fraction(p) + select(vec3<f32>(0.0), vec3<f32>(cell_of(p.w) - vec3<i32>(own_cell)), is_beside);
    let has_left = (p.w & LEFT_HOME) != 0u;
    let part_here = select(1.0, 0.0, has_left);
";

fn each_node(text: impl Fn(usize, [usize; 3]) -> String) -> String {
    (0..27).map(|n| text(n, [n / 9, n / 3 % 3, n % 3])).collect()
}

/// Momentum along x and y as seen from the first node, and what each step along x, y and z adds.
const XY: &str = "
    let m = s.w;
    let ax = m * width * r0.yzw + stress * vec3<f32>(t.x, t.z, s.x);
    let ay = m * width * r1.yzw + stress * vec3<f32>(t.z, t.y, s.y);
    let base = vec2<f32>(fma(m, r0.x + gravity.x, dot(ax, d)), fma(m, r1.x + gravity.y, dot(ay, d)));
    let by_x = vec2<f32>(ax.x, ay.x);
    let by_y = vec2<f32>(ax.y, ay.y);
    let by_z = vec2<f32>(ax.z, ay.z);
";

/// Likewise along z.
const ZM: &str = "
    let m = s.w;
    let az = m * width * r2.yzw + stress * s.xyz;
    let base = fma(m, r2.x + gravity.z, dot(az, d));
    let by_x = az.x;
    let by_y = az.y;
    let by_z = az.z;
";

/// One of the two threads that own a cell.
struct Half {
    /// What it reads of a particle besides its place: names and numbers of vectors.
    rows: &'static [(&'static str, u32)],
    /// Adds the particle to the sums of the 27 nodes around.
    add: String,
}

impl Half {
    /// A line for each vector that is read of a particle, by its name and number.
    fn each(&self, line: impl Fn(&str, u32) -> String) -> String {
        self.rows.iter().map(|(v, k)| line(v, *k)).collect()
    }

    /// Over the cell's own particles. So many are fetched before the present one is added; behind the last, the block's first. One that is no longer
    /// there weighs nothing, and `leaver` is done with it. Nothing here is left out where it is not needed: small worlds wait for branches more than
    /// for arithmetic.
    fn own(&self, ahead: usize, leaver: &str) -> String {
        let declare = |n: usize| {
            let rows = self.each(|v, _| format!("var {v}_{n} = vec4<f32>(0.0);\n"));
            format!("var p_{n} = vec4<u32>(0u);\n{rows}")
        };
        let fetch = |n: usize| {
            let rows = self.each(|v, k| format!("{v}_{n} = bitcast<vec4<f32>>(record_of(at, {k}u));\n"));
            format!("{{\nlet at = select(start, next, rank < count);\np_{n} = record_of(at, 0u);\n{rows}}}\n")
        };
        let advance = "rank += 1u;\nnext += 1u;\n\
                       if rank % TOGETHER == 0u && rank <= ROUNDS * TOGETHER {\n\
                       next = ahead;\nahead = cells[round_at(here, round_of(rank) + u32(rank < ROUNDS * TOGETHER), own)];\n}\n";
        let shift = |n: usize| {
            let rows = self.each(|v, _| format!("{v}_{} = {v}_{n};\n", n - 1));
            format!("p_{} = p_{n};\n{rows}", n - 1)
        };
        let take = format!("let p = p_0;\n{}", self.each(|v, _| format!("let {v} = {v}_0;\n")));
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
            format!("{PLACE}let done = rank - {ahead}u;\n{leaver}{}}}\n", self.add),
        ]
        .concat()
    }

    /// Over the particles of a unit, from `first` to `end_of_unit`. The next one is asked for before the present one is added.
    fn unit(&self, leaver: &str) -> String {
        let declare = self.each(|v, _| format!("var {v}_0 = vec4<f32>(0.0);\n"));
        let take = self.each(|v, _| format!("let {v} = {v}_0;\n"));
        let rows = self.each(|v, k| format!("{v}_0 = bitcast<vec4<f32>>(record_of(next, {k}u));\n"));
        let fetch = format!("p_0 = record_of(next, 0u);\n{rows}");
        format!(
            "var next = first;\nvar p_0 = vec4<u32>(0u);\n{declare}{fetch}\
             for (var q = first; q < end_of_unit; q++) {{\nlet p = p_0;\n{take}next = min(q + 1u, end_of_unit - 1u);\n{fetch}{PLACE}{leaver}{}}}\n",
            self.add
        )
    }

    /// Over those that have come from other cells.
    fn guests(&self) -> String {
        format!(
            "for (var q = next_leaver(&walk); q != NONE; q = next_leaver(&walk)) {{\nlet p = record_of(q, 0u);\n\
             let f = fraction(p);\nlet part_here = 1.0;\n{}{}}}\n",
            self.each(|v, k| format!("let {v} = bitcast<vec4<f32>>(record_of(q, {k}u));\n")),
            self.add
        )
    }
}

/// Adds the momentum u of a particle at place `f` of its cell, times `part_here`, as seen from each of the 27 nodes around: what it is at the first one and grows by
/// along the axes; and how, times a weight, it enters the node's sum.
fn add_momentum(momentum: &str, sum: fn(&str, &str) -> String) -> String {
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
/// Folds what lies behind the walls across an axis, every other plane by the one half of the threads and the rest by the other, a thread a row. The axis is
/// written out, so that compilers see which walls there are.
fn fold(axis: usize) -> String {
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
    let narrow = format!("if LOW.{d} != 0u && HIGH.{d} != 0u && IS_NARROW.{d} {{\nworkgroupBarrier();\n}}\n");
    format!("{{\nlet is_done = false{is_done};\n{low}{narrow}{high}}}\nworkgroupBarrier();\n")
}

/// Adds sums of the cell `at` to the tile, as `add` says of a node's number, place and sum: for one of its 27 nodes at a time, different cells touch different
/// nodes. Places that differ along x alone are found once.
fn flush(add: impl Fn(usize, String, String) -> String) -> String {
    let place = |n: usize| format!("let t{n} = part * 512u + in_tile(at.x, at.y + {}u, at.z + {}u);\n", n / 3, n % 3);
    let node = |n: usize, [i, ..]: [usize; 3]| add(n, format!("tile[t{} + {}u]", n % 9, 64 * i), format!("a{n}"));
    (0..9).map(place).collect::<String>() + &each_node(node)
}

/// Sums over the 27 nodes around a particle, row by row. The first of three nodes along an axis stands in the near block, the last
/// in the far one, if that is another, and the middle one in either.
pub(crate) fn gather() -> String {
    let mut text = String::new();
    for n in 0..8 {
        let end = |bit: usize, axis: &str| format!("{}.{axis}", if n & bit == 0 { "near" } else { "far" });
        let _ = writeln!(text, "let g{n} = first_node(b, {}, {}, {});", end(4, "x"), end(2, "y"), end(1, "z"));
    }
    for (axis, stride) in [("x", 16), ("y", 4), ("z", 1)] {
        let _ = writeln!(text, "let leaves_{axis} = (base.{axis} & 3u) == 3u;");
        for i in 0..3 {
            let _ = writeln!(text, "let {axis}{i} = ((base.{axis} + {i}u) & 3u) * {stride}u;");
        }
    }
    let pick = |i: usize, axis: &str, near: String, far: String| match i {
        0 => near,
        1 => format!("select({near}, {far}, leaves_{axis})"),
        _ => far,
    };
    for i in 0..3 {
        text.push_str("{ var plain = vec3<f32>(0.0);\nvar along_y = vec3<f32>(0.0);\nvar along_z = vec3<f32>(0.0);\n");
        for n in 0..4 {
            let _ = writeln!(text, "let p{n} = {};", pick(i, "x", format!("g{n}"), format!("g{}", n + 4)));
        }
        for j in 0..3 {
            let _ = writeln!(text, "{{ let row = x{i} + y{j};");
            for n in 0..2 {
                let _ = writeln!(text, "let l{n} = {} + row;", pick(j, "y", format!("p{n}"), format!("p{}", n + 2)));
            }
            let at = |k: usize| format!("grid[{} + z{k}].xyz", pick(k, "z", "l0".into(), "l1".into()));
            let _ = write!(
                text,
                "let low = wz.x * {};\nlet high = wz.z * {};\nlet sum = fma(vec3<f32>(wz.y), {}, low + high);\n\
                 plain = fma(vec3<f32>(wy[{j}]), sum, plain);\nalong_z = fma(vec3<f32>(wy[{j}]), high - low, along_z);\n",
                at(0),
                at(2),
                at(1)
            );
            if j != 1 {
                let _ =
                    writeln!(text, "along_y = fma(vec3<f32>({}wy[{j}]), sum, along_y);", if j == 0 { "-" } else { "" });
            }
            text.push_str("}\n");
        }
        let _ = write!(
            text,
            "v = fma(vec3<f32>(wx[{i}]), plain, v);\nby_y = fma(vec3<f32>(wx[{i}]), along_y, by_y);\n\
             by_z = fma(vec3<f32>(wx[{i}]), along_z, by_z);\n"
        );
        if i != 1 {
            let _ = writeln!(text, "by_x = fma(vec3<f32>({}wx[{i}]), plain, by_x);", if i == 0 { "-" } else { "" });
        }
        text.push_str("}\n");
    }
    text
}
