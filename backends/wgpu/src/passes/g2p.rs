//! Grid to particles.

use crate::passes::binding::{
    Draft, Groups, IDS, LISTS, NODES, OWNERS, RECORD, REST, Role, STATUS, Uniform, Use, WATCH, written,
};
use crate::passes::scene::{damps, stiffens};
use crate::passes::sleep::{WATCH_WORDS, with_sleep};
use barchan_core::Plan;
use std::fmt::Write as _;

/// Sums over the 27 nodes around a particle, row by row. The first of three nodes along an axis stands in the near block, the last
/// in the far one, if that is another, and the middle one in either.
pub(crate) fn gather() -> String {
    let mut text = String::from(
        "var v = vec3<f32>(0.0);\nvar by_x = vec3<f32>(0.0);\nvar by_y = vec3<f32>(0.0);\nvar by_z = vec3<f32>(0.0);\n",
    );
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

/// From so many particles on, G2P's threads take several each, so that workgroups start less often. For fewer the loop costs more than it saves.
pub(crate) const VERY_MANY: usize = 1 << 22;
/// Origin of the materials that come with the project.
pub(crate) const BUILT_IN: &str = "built-in";

pub(crate) fn g2p(plan: &Plan, laws: &str, sleeps: bool, [particles, layers]: [usize; 2]) -> Draft {
    // Particles of blocks asleep stay as they are. To ask for the block's state would keep all waiting (a sixth of the pass on an H200), so that
    // the mass is marked.
    let texts = [
        ("$FIRST", "first_block = owner.x;"),
        ("$IF_AWAKE", " && (owner.y & OF_SLEEPERS) == 0u"),
        ("$NOTE_SPEED", "note_speed(b, v);"),
        // The last lines tell of the first block.
        (
            "$ELSE",
            " else if is_live(layer_now) && owner.x != first_block {\n\
             note_happened(owner.x, STEPPED);\n}",
        ),
        (
            "$NOTE_FIRST",
            "if is_live(first_layer) {\n\
             atomicOr(&watch[watch_word(first_block, HAPPENED)], select(STEPPED, STEPPED | FAST, atomicLoad(&is_fast) != 0u));\n}\n\
             if atomicLoad(&greatest_move) == 0u {\nreturn;\n}",
        ),
    ];
    let asks = layers > 1 || sleeps;
    let (by_workgroup, each, next) = if particles < VERY_MANY {
        (128, "let q = first + thread;\nif q < extent.particles", "")
    } else {
        (
            512,
            "let end = min(first + BY_WORKGROUP, extent.particles);\nfor (var q = first + thread; q < end; q += 128u)",
            "ask(q + 128u);",
        )
    };
    let of_one = if asks {
        [
            ("$ASKING", include_str!("../wgsl/asking.wgsl")),
            ("$ASK", "ask(first + thread);"),
            ("$OWN_BLOCK", "owner.x"),
            ("$OF_PARTICLE", "let mass = bitcast<f32>(owner.y);\nlet p = place;"),
            ("$NEXT", next),
        ]
    } else {
        [
            ("$ASKING", ""),
            ("$ASK", ""),
            ("$OWN_BLOCK", "owners[q].x"),
            ("$OF_PARTICLE", "let mass = bitcast<f32>(owners[q].y);\nlet p = record_of(q, 0u);"),
            ("$NEXT", ""),
        ]
    };
    let body = with_sleep(sleeps, include_str!("../wgsl/g2p.wgsl"), &texts).replace("$GATHER", &gather());
    let of_needs = [
        ("$NEED_VARIABLE", "var<workgroup> greatest_need: atomic<u32>;"),
        (
            "$SEE_NEED",
            "if layer_now != first_layer {\n\
             atomicMax(&status[need_word(step.number, layer_now)], need_now);\n\
             } else if need_now > atomicLoad(&greatest_need) {\n\
             atomicMax(&greatest_need, need_now);\n}",
        ),
        ("$NOTE_NEED", "atomicMax(&status[need_word(step.number, first_layer)], atomicLoad(&greatest_need));"),
    ];
    let of_damping = [
        ("$DAMPED_SUMS", include_str!("../wgsl/damped.wgsl")),
        ("$SEE_DAMPED", "see_damped(layer_now == first_layer);"),
        ("$NOTE_DAMPED", "damped_by[thread] = damped_there;"),
        ("$BOOK_DAMPED", "book_all_damped(first_layer);"),
    ];
    let (stiffens, damps) = (stiffens(plan), damps(&plan.materials));
    let body = of_damping.iter().fold(body, |body, (at, text)| body.replace(at, if damps { text } else { "" }));
    let body = of_needs.iter().fold(body, |body, (at, text)| body.replace(at, if stiffens { text } else { "" }));
    let body = of_one.iter().fold(body, |body, (at, text)| body.replace(at, text));
    let body = format!("const BY_WORKGROUP: u32 = {by_workgroup}u;\n") + &body.replace("$EACH", each);
    let watch = if sleeps { [WATCH_WORDS, include_str!("../wgsl/watch_g2p.wgsl")].concat() } else { String::new() };
    let mut uses = vec![written(RECORD), written(REST), OWNERS, LISTS, NODES, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    Draft {
        name: "G2P",
        entry: "g2p",
        body: body + &watch + laws,
        uses,
        uniform: Uniform::Params,
        groups: Groups::ParticlesBy(by_workgroup),
        // Particles and the nodes around their blocks are those that a sort has found. What plugins wrote may ask for anything.
        checked: plan.materials.iter().any(|m| m.material.origin != BUILT_IN),
    }
}

pub(crate) fn stress(laws: &str) -> Draft {
    Draft {
        name: "stress",
        entry: "stress_of_all",
        body: include_str!("../wgsl/stress.wgsl").to_owned() + laws,
        uses: vec![written(RECORD), written(REST), STATUS],
        uniform: Uniform::Params,
        groups: Groups::ParticlesBy(128),
        checked: true,
    }
}

/// The cells around soft bodies after a step, and whether levels must move before the next one.
pub(crate) fn soft(bodies: &[u16]) -> [Draft; 2] {
    let cases: String =
        bodies.iter().enumerate().map(|(i, body)| format!("case {body}u: {{ return {i}u; }} ")).collect();
    let constants = format!("const SOFTS: u32 = {}u;\n", bodies.len());
    let number = format!("fn number_of(body: u32) -> u32 {{ switch body {{ {cases}default: {{ return NONE; }} }} }}\n");
    let softs: Use = ("softs", "atomic<i32>", Role::Soft, true);
    let draft = |name, entry, body: String, uses, groups| Draft {
        name,
        entry,
        body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    let measure = constants.clone() + &number + include_str!("../wgsl/soft.wgsl");
    let uses = vec![RECORD, IDS, OWNERS, LISTS, softs, STATUS];
    [
        draft("soft bodies", "measure", measure, uses, Groups::ParticlesBy(128)),
        draft(
            "follow",
            "watch_soft",
            constants + include_str!("../wgsl/soft_watch.wgsl"),
            vec![softs, STATUS],
            Groups::One,
        ),
    ]
}
